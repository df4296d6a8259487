"""From an estimate to a `Calibration`: residuals, attitudes, information and the compressed likelihood at it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import sigma_parameter
from starcal_uq.camera.projection import fold_radius_px
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.provenance import provenance
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.estimation.compressed import compress
from starcal_uq.estimation.fingerprints import Fingerprints
from starcal_uq.estimation.marginal import MarginalLikelihood
from starcal_uq.estimation.solvers import is_singular
from starcal_uq.estimation.stages import Stage
from starcal_uq.maths.linear import scaled_inverse

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Noise above this fraction of the detector's width means that the stars are not the ones they are said to be.
IMPLAUSIBLE_NOISE = 0.01


def assemble(
    obs: Observations,
    nominal: Camera,
    method: str,
    solver: str,
    likelihood: MarginalLikelihood,
    stages: list[Stage],
    status: Status,
    pair_theta: FloatArray,
    pair_covariance: FloatArray,
    *,
    settings: dict[str, Any] | None = None,
) -> Calibration:
    """Everything that a calibration tells about the end of its last stage.

    The last of `stages` ends in the estimate; one named ``refinement`` is the maximum of `likelihood`. Without it, the
    covariance of the result is `pair_covariance`, that of the estimate from interstar angles.

    Raises
    ------
    CalibrationError
        When there is no estimate that residuals could be taken at.
    """
    theta = stages[-1].theta
    refined = stages[-1].name == "refinement"
    p = len(theta)
    if not status.ok and not np.isfinite(noise_px(likelihood, theta)):
        raise CalibrationError(f"the calibration failed ({status.name}): {status.remedy}.", status)
    normal = likelihood.evaluate(theta)
    if not np.isfinite(normal.cost) or is_singular(normal.matrix):
        reason = status if not status.ok else Status.SINGULAR if np.isfinite(normal.cost) else Status.NOT_FINITE
        raise CalibrationError(f"the calibration failed ({reason.name}): {reason.remedy}.", reason)
    dof = likelihood.dof - p
    sigma = float(np.sqrt(normal.cost / dof))
    efficient = scaled_inverse(normal.matrix) * sigma**2
    compressed = compress(likelihood, theta, efficient, likelihood.rotations_at(theta))
    if refined:
        # The rotation-volume term of the likelihood moves its maximum by about 0.01 sigma: one Newton step.
        theta = theta - 0.5 * compressed.whitening @ compressed.log_determinant_slope
    state, cost = likelihood.profile(theta, likelihood.rotations_at(theta))
    response = likelihood.attitude_response(state, likelihood.derivatives(theta, state))
    camera = nominal.with_theta(theta)
    residuals = likelihood.frames.in_pixels(state.e).T
    record: dict[str, Any] = {"method": method, "solver": solver, "distortion": nominal.distortion}
    return Calibration(
        camera=camera,
        nominal=nominal,
        method=method,
        solver=solver,
        theta=theta,
        covariance=efficient if refined else pair_covariance,
        sigma=sigma,
        sigma_std=sigma / float(np.sqrt(2.0 * dof)),
        sigma_name=sigma_parameter(likelihood.frames.weight is not None).name,
        stages=tuple(stages),
        status=check_camera(camera, status),
        frame_ids=obs.frame_ids,
        quaternions=rotation_to_quaternion(state.rotations),
        residuals_px=residuals,
        chi2=cost,
        dof=dof,
        information=normal.matrix / sigma**2,
        rotation_per_theta=-np.mean(response, axis=2).T,
        attitude_noise=np.mean(state.inverse, axis=2) * sigma**2,
        pair_theta=pair_theta,
        pair_covariance=pair_covariance,
        compressed=compressed,
        provenance=provenance(None, record | (settings or {}), obs.data_hash),
        fingerprints=Fingerprints.of(obs, residuals, nominal.centre_px),
    )


def noise_px(likelihood: MarginalLikelihood, theta: FloatArray) -> float:
    """Root mean square of the residuals per axis, px; infinite when the model is not finite."""
    state, cost = likelihood.profile(theta)
    if not np.isfinite(cost):
        return float("inf")
    return float(np.sqrt(np.mean(likelihood.frames.in_pixels(state.e) ** 2)))


def check_camera(camera: Camera, status: Status) -> Status:
    """`status`, unless the principal point left the detector or the distortion folds over inside the field."""
    if not status.ok:
        return status
    if not camera.contains(camera.theta[:2]):
        return Status.OUTSIDE_DETECTOR
    if fold_radius_px(camera.distortion, camera.theta, camera.corner_radius_px) <= camera.corner_radius_px:
        return Status.FOLDED
    return status
