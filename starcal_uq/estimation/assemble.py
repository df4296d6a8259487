"""From an estimate to a `Calibration`: residuals, attitudes, information and the compressed
likelihood at it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import undistorted
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.later import Later
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
from starcal_uq.likelihood.compressed import CompressedLikelihood, compress, settled
from starcal_uq.likelihood.marginal import TURN_RAD, MarginalLikelihood
from starcal_uq.likelihood.solvers import Normal, is_singular, reason_of
from starcal_uq.likelihood.sums import Attitudes
from starcal_uq.maths.linear import scaled_inverse

if TYPE_CHECKING:
    from starcal_uq.observations.frames import StarFrames
    from starcal_uq.observations.table import Observations

# Noise above this fraction of the detector's width means that the stars are not the ones they are
# said to be.
IMPLAUSIBLE_NOISE = 0.01
# What may be left of the way to the estimate, in standard deviations, and most passes over the stars.
_REST, _PASSES = 3e-10, 12
# Attitudes this near to the best ones tell such a noise.
_NEARLY_RAD = 1e-4
# Noise that is assumed where there is no estimate to take it from.
_USUAL_NOISE_PX = 0.1


class PairEstimate(NamedTuple):
    """Estimate from interstar angles."""

    theta: FloatArray  # (p,): px units
    covariance: FloatArray  # (p, p)


# Stages, and the estimate from interstar angles that they led to.
Way = tuple[list[Stage], PairEstimate]


class Peak(NamedTuple):
    """The end of a search, and the normal equations there."""

    least: FloatArray  # (p,): end of the stages, px units, or, settled, the least sum of squares
    theta: FloatArray  # (p,): the estimate, px units
    normal: Normal  # At `least`
    attitudes: Attitudes  # Near `least`
    refined: bool  # Whether positions led there


def peak_near(likelihood: MarginalLikelihood, theta: FloatArray) -> Peak | None:
    """The maximum of a likelihood a few sigmas from theta (p,); None where steps of Gauss and Newton
    do not settle.
    """
    dof, before = likelihood.dof - len(theta), 0.0
    for _ in range(_PASSES):
        found = likelihood.sums(theta, tolerance=np.inf)
        normal = found[0].normal
        if is_singular(normal.matrix):
            return None
        likelihood.use_sums(*found)
        unit = scaled_inverse(normal.matrix)
        step = unit @ normal.gradient
        theta, gain, variance = theta - step, float(step @ normal.gradient), normal.cost / dof
        # The next two steps shrink as this one did.
        if gain**3 <= (_REST * min(before, variance)) ** 2 * variance:
            # The rotation-volume term of the likelihood moves its maximum by about 0.01 sigma.
            slope = likelihood.slope(theta, variance**0.5, found[1])
            return Peak(theta, theta - unit @ slope, normal, found[1], True)
        before = gain
    return None


def assemble(
    obs: Observations,
    nominal: Camera,
    likelihood: MarginalLikelihood,
    stages: list[Stage],
    status: Status,
    pairs: Callable[[], PairEstimate],
    settings: AnyDict,
) -> Calibration:
    """The calibration of the end of its last stage; one named ``refinement`` is near the maximum of
    `likelihood`.

    The rest is as for `calibration_at`.
    """
    theta, refined = stages[-1].theta, stages[-1].name == "refinement"
    peak = peak_near(likelihood, theta) if refined and status.ok else None
    if peak is None:
        sums, attitudes = likelihood.sums(theta, tolerance=TURN_RAD)
        peak = Peak(theta, theta, sums.normal, attitudes, refined)
    return calibration_at(
        obs, nominal, likelihood, peak, status, lambda: (stages, pairs()), settings
    )


def calibration_at(
    obs: Observations,
    nominal: Camera,
    likelihood: MarginalLikelihood,
    peak: Peak,
    status: Status,
    way: Callable[[], Way],
    settings: AnyDict,
) -> Calibration:
    """Everything that a calibration tells about an estimate.

    `way` is called when its stages or the estimate from interstar angles are first needed. Where the
    estimate is not refined, its covariance is that of the latter. `settings` hold ``method`` and
    ``solver``. CalibrationError when there is no estimate that residuals could be taken at.
    """
    normal, least, theta, attitudes = peak.normal, peak.least, peak.theta, peak.attitudes
    if is_singular(normal.matrix):
        raise failed(likelihood, least, nominal, reason_of(status, normal.cost))
    dof = likelihood.dof - len(theta)
    sigma = float(np.sqrt(normal.cost / dof))
    settling = peak.refined and status.ok
    status = check_camera(nominal.with_theta(least), status)
    names, factors = undetermined(likelihood, least, normal.matrix, sigma, nominal, status)
    wide = np.outer(factors, factors)
    efficient = scaled_inverse(normal.matrix) * sigma**2
    rotations = attitudes.at(theta)
    e = likelihood.residuals(theta, rotations)
    gone = Later(way)
    there = Later(lambda: likelihood.sums(theta)[1])

    def compressed() -> CompressedLikelihood:
        found = compress(likelihood, least, efficient, attitudes.at(least))
        return settled(found) if settling else found

    pair_covariance = Later(lambda: gone.value[1].covariance * wide)
    return Calibration.of(
        nominal,
        KeptFrames.of(obs, likelihood.frames, rotations, e, nominal),
        settings | {"distortion": nominal.distortion},
        theta=theta,
        sigma=sigma,
        dof=dof,
        status=Status.SINGULAR if names else status,
        record={"kernels": likelihood.kernels} | coma_record(nominal, factors),
        covariance=efficient * wide if peak.refined else pair_covariance.value,
        stages=Later(lambda: tuple(gone.value[0])),
        undetermined=names,
        chi2=float(np.sum(e**2)),
        information=normal.matrix / sigma**2,
        rotation_per_theta=Later(lambda: np.mean(there.value.response, axis=2)),
        attitude_noise=Later(lambda: np.mean(there.value.inverse, axis=2) * sigma**2),
        pair_theta=Later(lambda: gone.value[1].theta),
        pair_covariance=pair_covariance,
        compressed=Later(compressed),
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
    return float(np.sqrt(cost / (2.0 * np.sum(frames.noise**-2.0))))


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
