"""From observations to a calibration: three stages, then refinement on the attitude-marginalised likelihood."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq._types import FloatArray
from starcal_uq.attitude import rotation_to_quaternion
from starcal_uq.calibration import Calibration
from starcal_uq.camera import Camera
from starcal_uq.compressed import compress
from starcal_uq.distortion import sigma_parameter
from starcal_uq.errors import CalibrationError
from starcal_uq.frames import StarFrames
from starcal_uq.likelihood import MarginalLikelihood
from starcal_uq.pairs import PairObjective
from starcal_uq.projection import fold_radius_px
from starcal_uq.robust import compress_reweighted, refine, robust_start
from starcal_uq.runfolder import provenance
from starcal_uq.solvers import is_singular
from starcal_uq.stages import Stage, distortion_stage, joint_stage, optics_stage, refinement_stage
from starcal_uq.status import Status
from starcal_uq.student import parse_dof

if TYPE_CHECKING:
    from starcal_uq.observations import Observations

METHODS = ("efficient", "three_stage")
LIKELIHOODS = ("marginal", "student_t")
SOLVERS = ("lm", "minpack", "ipopt")
# Stage 1 that moves the principal point by more than this fraction of the width has met strong distortion.
_FAR = 0.05
# Noise above this fraction of the detector's width means that the stars are not the ones they are said to be.
_IMPLAUSIBLE_NOISE = 0.01


def calibrate(
    obs: Observations,
    camera: Camera,
    *,
    method: str = "efficient",
    solver: str = "lm",
    max_iterations: int = 200,
    throw: bool = True,
    likelihood: str = "marginal",
    dof: float | str | None = None,
) -> Calibration:
    """Estimate optics and distortion from identified stars.

    Parameters
    ----------
    obs : Observations
        Stars with pixel positions and catalogue directions; at least three per frame.
    camera : Camera
        Start values; its `distortion` names the model. The coefficients start from zero, as in the paper.
    method : {"efficient", "three_stage"}
        ``three_stage`` is Ye & Yang 2017: interstar angles without distortion, linear distortion, interstar angles with
        both; its covariance is the sandwich of composite likelihood. ``efficient`` goes on to the
        attitude-marginalised likelihood, whose covariance is the Cramer-Rao bound.
    solver : {"lm", "minpack", "ipopt"}
        Levenberg-Marquardt on normal equations, MINPACK on explicit pairs (where there are at most 500,000 of them), or
        IPOPT with the principal point kept on the detector, f > 0 and the distortion monotonic. The refinement always
        uses the first.
    max_iterations : int
        Limit for each stage.
    throw : bool
        Raise when the estimate is not good; otherwise `Calibration.status` says so, as long as there is an estimate.
    likelihood : {"marginal", "student_t"}
        What the refinement maximises: Gaussian noise, or a Student t per star for tables with wrong identifications.
        With ``student_t`` the stages see only stars whose angles agree with those of their frame, the refinement sees
        all that can be in the field, `covariance` is the sandwich one, `information` the observed one, `sigma` the
        scale of the t, `chi2` is summed with the stars' weights, and `compressed` is the Gaussian likelihood of the
        reweighted stars.
    dof : float or "free", optional
        Degrees of freedom of ``student_t``, 2 to 200, by default 4; "free" estimates them, with the gamma prior of
        Juarez & Steel (2010) on what exceeds 2.

    Returns
    -------
    Calibration
        With estimate, covariance, residuals, attitudes and the trajectory of every stage.

    Raises
    ------
    CalibrationError
        When there are too few stars, or, with `throw`, when the status is not CONVERGED.
    """
    if method not in METHODS:
        raise CalibrationError(f"method {method!r} is unknown: use one of {', '.join(METHODS)}.")
    if solver not in SOLVERS:
        raise CalibrationError(f"solver {solver!r} is unknown: use one of {', '.join(SOLVERS)}.")
    if likelihood not in LIKELIHOODS:
        raise CalibrationError(f"likelihood {likelihood!r} is unknown: use one of {', '.join(LIKELIHOODS)}.")
    nu = parse_dof(dof, CalibrationError)
    if likelihood == "marginal" and dof is not None:
        raise CalibrationError("degrees of freedom (dof) belong to likelihood='student_t': leave dof out, or use that.")
    if likelihood == "student_t" and method != "efficient":
        raise CalibrationError(
            f"method {method!r} has no Student-t likelihood: use method='efficient', or likelihood='marginal'."
        )
    frames = StarFrames.from_observations(obs)
    gaussian = MarginalLikelihood(frames, camera.distortion)
    p = len(camera.theta)
    if gaussian.dof <= p:
        raise CalibrationError(
            f"{frames.n_stars} stars in {frames.n_frames} frames give {gaussian.dof} independent numbers for {p} "
            "parameters and the noise: add stars or frames, or choose a distortion model with fewer coefficients.",
            Status.SINGULAR,
        )
    if likelihood == "student_t":
        calibration = _robust(obs, camera, frames, solver, max_iterations, nu)
    else:
        calibration = _gaussian(obs, camera, gaussian, method, solver, max_iterations)
    if throw and not calibration.status.ok:
        raise CalibrationError(
            f"the calibration did not end well ({calibration.status.name}): {calibration.status.remedy}.",
            calibration.status,
        )
    return calibration


def _gaussian(
    obs: Observations, camera: Camera, likelihood: MarginalLikelihood, method: str, solver: str, max_iterations: int
) -> Calibration:
    pairs = PairObjective(likelihood.frames, camera.distortion)
    stages = _pair_stages(pairs, camera, solver, max_iterations)
    pair_theta = stages[-1].theta
    pair_covariance = pairs.godambe(pair_theta)
    status = stages[-1].status
    if status.ok:
        likelihood.use_rotations(likelihood.start_rotations(pair_theta))
        if _noise_px(likelihood, pair_theta) > _IMPLAUSIBLE_NOISE * camera.width_px:
            # Interstar angles do not see a mirror, nor does their noise show a few wrong stars; positions do.
            status = Status.INCONSISTENT
        elif method == "efficient":
            stages.append(refinement_stage(likelihood, pair_theta, max_iterations))
            status = stages[-1].status
    return _assemble(obs, camera, method, solver, likelihood, stages, status, pair_theta, pair_covariance)


def _robust(
    obs: Observations, camera: Camera, frames: StarFrames, solver: str, max_iterations: int, nu: float | None
) -> Calibration:
    model = camera.distortion

    def fit(trusted: StarFrames, all_parameters: bool) -> list[Stage]:
        if all_parameters:
            return _pair_stages(PairObjective(trusted, model), camera, solver, max_iterations)
        return [optics_stage(trusted, camera, solver, max_iterations)]

    start = robust_start(frames, model, camera.theta, fit)
    pair_theta = start.stages[-1].theta
    found = refine(frames, model, pair_theta, start.rotations, nu, max_iterations)
    theta, sigma, state, information = found.stage.theta, found.sigma, found.state, found.information
    status = found.stage.status
    if not np.isfinite(state.value) or is_singular(information.matrix):
        reason = status if not status.ok else Status.SINGULAR
        raise CalibrationError(f"the calibration failed ({reason.name}): {reason.remedy}.", reason)
    weight = frames.weight
    result = camera.with_theta(theta)
    residuals = state.e if weight is None else state.e / weight
    settings: dict[str, object] = {"method": "efficient", "solver": solver, "distortion": model}
    settings |= {"likelihood": "student_t", "dof": "free" if nu is None else nu}
    record = provenance(None, settings, obs.data_hash)
    record["student_t"] = {"dof": found.nu, "dof_std": found.nu_std, "stars_out_of_field": int(np.sum(~state.seen))}
    return Calibration(
        camera=result,
        nominal=camera,
        method="efficient",
        solver=solver,
        theta=theta,
        covariance=found.covariance,
        sigma=sigma,
        sigma_std=found.sigma_std,
        sigma_name=sigma_parameter(weight is not None).name,
        stages=(*start.stages, found.stage),
        status=_check(result, status),
        frame_ids=obs.frame_ids,
        quaternions=rotation_to_quaternion(state.rotations),
        residuals_px=residuals.T,
        chi2=float(np.sum(state.weight * state.e**2)),
        dof=state.dof - len(theta),
        information=information.matrix,
        rotation_per_theta=information.rotation_per_theta,
        attitude_noise=information.attitude_noise,
        pair_theta=pair_theta,
        pair_covariance=PairObjective(start.frames, model).godambe(pair_theta),
        compressed=compress_reweighted(found),
        provenance=record,
    )


def _pair_stages(pairs: PairObjective, camera: Camera, solver: str, max_iterations: int) -> list[Stage]:
    frames = pairs.frames
    stages = [optics_stage(frames, camera, solver, max_iterations)]
    # Without an optical axis there is nothing to attach the distortion to; later stages would only hide it.
    if len(camera.theta) > 3 and stages[0].status is not Status.NOT_FINITE:
        stages.append(distortion_stage(frames, camera, stages[0].theta))
        stages.append(joint_stage(pairs, camera, stages[1].theta, solver, max_iterations))
        moved = float(np.max(np.abs(stages[0].theta[:2] - camera.theta[:2])))
        if not stages[-1].status.ok or moved > _FAR * camera.width_px:
            # Distortion of tens of pixels pulls the undistorted fit far from the axis, and the linear stage may then
            # lead to another minimum or into a fold; the nominal optics without distortion are the safer start.
            start = np.concatenate([camera.theta[:3], np.zeros(len(camera.theta) - 3)])
            again = joint_stage(pairs, camera, start, solver, max_iterations)
            stages[-1] = min(stages[-1], again, key=_badness)
    return stages


def _badness(stage: Stage) -> tuple[bool, float]:
    """Converged before not, then by cost."""
    cost = float(stage.cost[-1])
    return not stage.status.ok, cost if np.isfinite(cost) else float("inf")


def _noise_px(likelihood: MarginalLikelihood, theta: FloatArray) -> float:
    """Root mean square of the residuals per axis, px; infinite when the model is not finite."""
    state, cost = likelihood.profile(theta)
    if not np.isfinite(cost):
        return float("inf")
    weight = likelihood.frames.weight
    return float(np.sqrt(np.mean((state.e if weight is None else state.e / weight) ** 2)))


def _check(camera: Camera, status: Status) -> Status:
    if not status.ok:
        return status
    x0, y0 = camera.theta[:2]
    if not (-0.5 <= x0 <= camera.width_px - 0.5 and -0.5 <= y0 <= camera.height_px - 0.5):
        return Status.OUTSIDE_DETECTOR
    if fold_radius_px(camera.distortion, camera.theta, camera.corner_radius_px) <= camera.corner_radius_px:
        return Status.FOLDED
    return status


def _assemble(
    obs: Observations,
    nominal: Camera,
    method: str,
    solver: str,
    likelihood: MarginalLikelihood,
    stages: list[Stage],
    status: Status,
    pair_theta: FloatArray,
    pair_covariance: FloatArray,
) -> Calibration:
    """Covariance, noise, residuals and the compressed likelihood at the estimate."""
    theta = stages[-1].theta
    refined = stages[-1].name == "refinement"
    p = len(theta)
    if not status.ok and not np.isfinite(_noise_px(likelihood, theta)):
        raise CalibrationError(f"the calibration failed ({status.name}): {status.remedy}.", status)
    normal = likelihood.evaluate(theta)
    if not np.isfinite(normal.cost) or is_singular(normal.matrix):
        reason = status if not status.ok else Status.SINGULAR if np.isfinite(normal.cost) else Status.NOT_FINITE
        raise CalibrationError(f"the calibration failed ({reason.name}): {reason.remedy}.", reason)
    dof = likelihood.dof - p
    sigma = float(np.sqrt(normal.cost / dof))
    efficient = _scaled_inverse(normal.matrix) * sigma**2
    compressed = compress(likelihood, theta, efficient, likelihood.rotations_at(theta))
    if refined:
        # The rotation-volume term of the likelihood moves its maximum by about 0.01 sigma: one Newton step.
        theta = theta - 0.5 * compressed.whitening @ compressed.log_determinant_slope
    state, cost = likelihood.profile(theta, likelihood.rotations_at(theta))
    response = likelihood.attitude_response(state, likelihood.derivatives(theta, state))
    weight = likelihood.frames.weight
    camera = nominal.with_theta(theta)
    residuals = state.e if weight is None else state.e / weight
    return Calibration(
        camera=camera,
        nominal=nominal,
        method=method,
        solver=solver,
        theta=theta,
        covariance=efficient if refined else pair_covariance,
        sigma=sigma,
        sigma_std=sigma / float(np.sqrt(2.0 * dof)),
        sigma_name=sigma_parameter(weight is not None).name,
        stages=tuple(stages),
        status=_check(camera, status),
        frame_ids=obs.frame_ids,
        quaternions=rotation_to_quaternion(state.rotations),
        residuals_px=residuals.T,
        chi2=cost,
        dof=dof,
        information=normal.matrix / sigma**2,
        rotation_per_theta=-np.mean(response, axis=2).T,
        attitude_noise=np.mean(state.inverse, axis=2) * sigma**2,
        pair_theta=pair_theta,
        pair_covariance=pair_covariance,
        compressed=compressed,
        provenance=provenance(
            None,
            {"method": method, "solver": solver, "distortion": nominal.distortion},
            obs.data_hash,
        ),
    )


def _scaled_inverse(matrix: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse: FloatArray = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return inverse
