"""From an estimate to a `Calibration`: residuals, attitudes, information and the compressed
likelihood at it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import undistorted
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.kept import KeptFrames
from starcal_uq.estimation.result import Calibration, check_camera
from starcal_uq.estimation.stages import Stage
from starcal_uq.estimation.undetermined import (
    EXPLAINED,
    WEAK,
    coma_record,
    open_parameters,
    remedy_of,
    undetermined,
)
from starcal_uq.likelihood.compressed import compress, settled, unit_covariance
from starcal_uq.likelihood.marginal import TURN_RAD, MarginalLikelihood
from starcal_uq.likelihood.solvers import is_singular, reason_of
from starcal_uq.maths.linear import scaled_inverse, symmetric_inverse

if TYPE_CHECKING:
    from starcal_uq.observations.frames import StarFrames
    from starcal_uq.observations.table import Observations

# Noise above this fraction of the detector's width means that the stars are not the ones they are
# said to be.
IMPLAUSIBLE_NOISE = 0.01
# Attitudes this near to the best ones tell such a noise.
_NEARLY_RAD = 1e-4
# Noise that is assumed where there is no estimate to take it from.
_USUAL_NOISE_PX = 0.1


class PairEstimate(NamedTuple):
    """Estimate from interstar angles."""

    theta: FloatArray  # (p,): px units
    covariance: FloatArray  # (p, p)


def assemble(
    obs: Observations,
    nominal: Camera,
    likelihood: MarginalLikelihood,
    stages: list[Stage],
    status: Status,
    pairs: PairEstimate,
    settings: AnyDict,
) -> Calibration:
    """Everything that a calibration tells about the end of its last stage.

    The last of `stages` ends in the estimate; one named ``refinement`` is the maximum of
    `likelihood`. Without it, the covariance of the result is that of `pairs`, the estimate from
    interstar angles. `settings` hold ``method`` and ``solver``. CalibrationError when there is no
    estimate that residuals could be taken at.
    """
    theta = stages[-1].theta
    refined = stages[-1].name == "refinement"
    p = len(theta)
    if not status.ok and not np.isfinite(noise_px(likelihood, theta)):
        raise failed(likelihood, nominal.theta, nominal, status)
    normal = likelihood.sums(theta, tolerance=TURN_RAD)[0].normal
    if not np.isfinite(normal.cost) or is_singular(normal.matrix):
        raise failed(likelihood, theta, nominal, reason_of(status, normal.cost))
    dof = likelihood.dof - p
    sigma = float(np.sqrt(normal.cost / dof))
    status = check_camera(nominal.with_theta(theta), status)
    names, factors = undetermined(likelihood, theta, normal.matrix, sigma, nominal, status)
    if names:
        status = Status.SINGULAR
    pair_covariance = pairs.covariance * np.outer(factors, factors)
    efficient, information = scaled_inverse(normal.matrix) * sigma**2, normal.matrix / sigma**2
    compressed = compress(likelihood, theta, efficient)
    if refined and status.ok:
        compressed = settled(compressed)
        theta, last = compressed.theta_hat, stages[-1]
        sigma = float(np.sqrt(compressed.gram[0, 0] / dof))
        efficient = unit_covariance(compressed) * sigma**2
        information = symmetric_inverse(efficient)
        ended = replace(
            last,
            trajectory=np.vstack([last.trajectory, theta]),
            cost=np.append(last.cost, compressed.gram[0, 0]),
        )
        stages = [*stages[:-1], ended]
    if refined:
        # The rotation-volume term of the likelihood moves its maximum by about 0.01 sigma: one
        # Newton step.
        theta = theta - 0.5 * compressed.whitening @ compressed.log_determinant_slope
    e = np.empty((2, likelihood.frames.n_stars))
    sums, attitudes = likelihood.sums(theta, e)
    made = {name: settings[name] for name in ("method", "solver")}
    return Calibration.of(
        nominal,
        KeptFrames.of(obs, likelihood.frames, attitudes.rotations, e, nominal),
        made | {"distortion": nominal.distortion} | settings,
        theta=theta,
        sigma=sigma,
        dof=dof,
        status=status,
        record={"kernels": likelihood.kernels} | coma_record(nominal, factors),
        covariance=efficient * np.outer(factors, factors) if refined else pair_covariance,
        stages=tuple(stages),
        undetermined=names,
        chi2=sums.normal.cost,
        information=information,
        rotation_per_theta=np.mean(attitudes.response, axis=2),
        attitude_noise=np.mean(attitudes.inverse, axis=2) * sigma**2,
        pair_theta=pairs.theta,
        pair_covariance=pair_covariance,
        compressed=compressed,
    )


def failed(
    likelihood: MarginalLikelihood, theta: FloatArray, nominal: Camera, status: Status
) -> CalibrationError:
    """The error of a calibration without an estimate: what its stars hardly determine at theta, or
    else its status.
    """
    noise = _USUAL_NOISE_PX if likelihood.frames.weight is None else 1.0
    # Where coefficients ended that nothing holds, others may seem to be open as well.
    plain = undistorted(nominal.distortion, theta)
    found = []
    for at in (theta, plain, nominal.theta) if status in EXPLAINED else ():
        own = MarginalLikelihood(likelihood.frames, likelihood.model_name)
        found.append(open_parameters(own.evaluate(at).matrix, noise, nominal, WEAK))
    names = min(filter(None, found), key=len, default=())
    status = Status.SINGULAR if names else status
    reason = remedy_of(status, names, nominal.distortion)
    return CalibrationError(f"the calibration failed ({status.name})", status, names, reason=reason)


def noise_px(likelihood: MarginalLikelihood, theta: FloatArray) -> float:
    """Root mean square of the residuals per axis, px, stars weighted by what they state; infinite
    without a model.

    `likelihood` starts its later attitude searches from those found here.
    """
    found = likelihood.sums(theta, tolerance=_NEARLY_RAD)
    noise = noise_of(found[0].normal.cost, likelihood.frames)
    if np.isfinite(noise):
        likelihood.use_sums(*found)
    return noise


def noise_of(cost: float, frames: StarFrames) -> float:
    """As `noise_px`, from the sum of squares over these frames."""
    if not np.isfinite(cost):
        return float("inf")
    return float(
        np.sqrt(
            cost / (2.0 * (frames.n_stars if frames.weight is None else np.sum(frames.weight**2)))
        )
    )


def check_noise(noise: float, camera: Camera, status: Status) -> Status:
    """`status`, unless residuals of this size, px, say that the stars are not the ones they are
    said to be.
    """
    return (
        Status.INCONSISTENT if status.ok and noise > IMPLAUSIBLE_NOISE * camera.width_px else status
    )


def check_count(likelihood: MarginalLikelihood, camera: Camera) -> None:
    """Raise `CalibrationError` where there are fewer numbers than unknowns."""
    p, frames = len(camera.theta), likelihood.frames
    if likelihood.dof <= p:
        raise CalibrationError(
            f"{frames.n_stars} stars in {frames.n_frames} frames give {likelihood.dof} "
            f"independent numbers for {p} parameters and the noise",
            Status.SINGULAR,
            reason="add stars or frames, or choose a distortion model with fewer coefficients",
        )


def raise_unless_good(
    status: Status, remedy: str = "", calibration: Calibration | None = None
) -> None:
    """Raise the `CalibrationError` of a status that is not CONVERGED."""
    if not status.ok:
        outcome = f"the calibration did not end well ({status.name})"
        reason = remedy or status.remedy
        raise CalibrationError(outcome, status, calibration=calibration, reason=reason)
