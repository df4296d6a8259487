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
from starcal_uq.runfolder import provenance
from starcal_uq.solvers import is_singular
from starcal_uq.stages import Stage, distortion_stage, joint_stage, optics_stage, refinement_stage
from starcal_uq.status import Status

if TYPE_CHECKING:
    from starcal_uq.observations import Observations

METHODS = ("efficient", "three_stage")
SOLVERS = ("lm", "minpack", "ipopt")
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
    frames = StarFrames.from_observations(obs)
    likelihood = MarginalLikelihood(frames, camera.distortion)
    p = len(camera.theta)
    if likelihood.dof <= p:
        raise CalibrationError(
            f"{frames.n_stars} stars in {frames.n_frames} frames give {likelihood.dof} independent numbers for {p} "
            "parameters and the noise: add stars or frames, or choose a distortion model with fewer coefficients.",
            Status.SINGULAR,
        )
    pairs = PairObjective(frames, camera.distortion)
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
    calibration = _assemble(obs, camera, method, solver, likelihood, stages, status, pair_theta, pair_covariance)
    if throw and not calibration.status.ok:
        raise CalibrationError(
            f"the calibration did not end well ({calibration.status.name}): {calibration.status.remedy}.",
            calibration.status,
        )
    return calibration


def _pair_stages(pairs: PairObjective, camera: Camera, solver: str, max_iterations: int) -> list[Stage]:
    frames = pairs.frames
    stages = [optics_stage(frames, camera, solver, max_iterations)]
    # Without an optical axis there is nothing to attach the distortion to; later stages would only hide it.
    if len(camera.theta) > 3 and stages[0].status is not Status.NOT_FINITE:
        stages.append(distortion_stage(frames, camera, stages[0].theta))
        stages.append(joint_stage(pairs, camera, stages[1].theta, solver, max_iterations))
        if stages[-1].status is Status.NOT_FINITE:
            # The linear stage can overshoot into a fold; the undistorted optics are the safer start.
            stages[-1] = joint_stage(pairs, camera, stages[0].theta, solver, max_iterations)
    return stages


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
