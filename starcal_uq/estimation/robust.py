"""Estimation with a Student-t likelihood: a start that wrong stars do not spoil, and the refinement
from there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import undistorted
from starcal_uq.camera.projection import unproject_theta
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray
from starcal_uq.estimation.assemble import raise_unless_good
from starcal_uq.estimation.stages import Stage
from starcal_uq.likelihood.arrays import attitudes
from starcal_uq.likelihood.compressed import CompressedLikelihood, compress
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.solvers import is_singular
from starcal_uq.likelihood.student import (
    DEFAULT_DOF,
    DOF_RANGE,
    Information,
    StudentLikelihood,
    StudentState,
    log_excess_prior,
)
from starcal_uq.maths.linear import root_diagonal, scaled_inverse, unit_diagonal, unit_inverse
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# A star whose angles to the others are this many times worse than the typical star's is left out of
# the start.
_DISTRUST = 5.0
_ROUNDS = 8
# Fits of the optics alone come first: distortion is a fraction of a pixel, wrong stars are not.
_OPTICS_ROUNDS = 2
_TRUSTED_SHARE = 0.5
_PARTNERS, _STARS_AT_ONCE, _SEED = 400, 2000, 20170925
_NEGLIGIBLE_WEIGHT = 1e-9
# Stars in the field keep a say, however far they are off.
_LEAST_WEIGHT, _NO_WEIGHT = 1e-7, 1e-18
_MAX_STEPS = 60
# Gains, nat, that are worth no further round: a thousandth of a standard deviation, and a two
# hundredth for the noise.
_GAIN = 1e-7
_SHAPE_GAIN = 1e-5
_STEP = 0.02
_LEAST_EXCESS = 1e-3
# Median length of a vector with two standard normal components.
_RAYLEIGH_MEDIAN = 1.1774

FitStages = Callable[[StarFrames, bool], list[Stage]]


@dataclass(frozen=True)
class RobustStart:
    """Where the refinement starts."""

    stages: list[Stage]  # The paper's stages on the trusted stars
    trusted: BoolArray  # (N,): stars whose interstar angles agree with those of their frame
    frames: StarFrames  # The trusted stars, without frames that hold fewer than three of them
    rotations: FloatArray  # (K, 3, 3): attitudes from the trusted stars


def star_scores(frames: StarFrames, model_name: str, theta: FloatArray) -> FloatArray:
    """Median over other stars of its frame, at most 400, of the error of the angle to them, px, for
    every star (N,).

    More than half of a frame's angles to a right star are right where more than half of its stars
    are, whatever the rest is: no attitude is needed, and no single star decides.
    """
    b = unproject_theta(model_name, theta, frames.pixel.T).T
    scores, rng = np.empty(frames.n_stars), np.random.default_rng(_SEED)
    for start, stop in zip(frames.starts[:-1].tolist(), frames.starts[1:].tolist(), strict=True):
        others = np.arange(start, stop)
        if len(others) > _PARTNERS:
            # A draw of so many has a majority of right ones as well, and the time does not grow
            # with the square.
            others = np.sort(rng.choice(others, _PARTNERS, replace=False))
        for first in range(start, stop, _STARS_AT_ONCE):
            mine = np.arange(first, min(first + _STARS_AT_ONCE, stop))
            # Chords, not cosines: their error is that of the angle at any distance.
            seen = np.linalg.norm(b[:, mine, None] - b[:, None, others], axis=0)
            known = np.linalg.norm(frames.r[:, mine, None] - frames.r[:, None, others], axis=0)
            error = np.abs(seen - known)
            error[mine[:, None] == others] = np.nan
            scores[mine] = np.nanmedian(error, axis=1)
    return np.where(np.isfinite(scores), scores * theta[2], np.inf)


def usable_stars(frames: StarFrames, model_name: str, theta: FloatArray) -> BoolArray:
    """Stars of frames in which at least three agree with the others, so that there is an attitude
    to speak of.
    """
    scores = star_scores(frames, model_name, theta)
    return frames.in_threes(scores <= _DISTRUST * np.median(scores))


def subset(frames: StarFrames, kept: BoolArray) -> StarFrames:
    """Some of the stars, without frames that keep fewer than three."""
    return frames.select(kept & frames.in_threes(kept))


def robust_start(
    frames: StarFrames, model_name: str, theta: FloatArray, fit: FitStages
) -> RobustStart:
    """Alternate between the paper's stages and leaving out stars that do not fit their frame.

    ``fit(frames, all_parameters)`` gives the stages of Ye & Yang 2017, the first one only, or all.
    CalibrationError when most stars fit neither their frame nor each other.
    """
    trusted = np.zeros(frames.n_stars, dtype=np.bool_)
    # Coefficients start from zero, as in the paper: a nominal distortion is a guess.
    at = undistorted(model_name, theta)
    stages: list[Stage] = []
    for round_ in range(_ROUNDS):
        scores = star_scores(frames, model_name, at)
        kept = scores <= _DISTRUST * np.median(scores)
        if round_ > _OPTICS_ROUNDS and np.array_equal(kept, trusted):
            break
        trusted = kept
        used = subset(frames, trusted)
        if used.n_stars < _TRUSTED_SHARE * frames.n_stars:
            raise CalibrationError(
                f"only {used.n_stars} of {frames.n_stars} stars agree with the others of their "
                "frame",
                Status.INCONSISTENT,
                reason=Status.INCONSISTENT.remedy,
            )
        stages = fit(used, round_ >= _OPTICS_ROUNDS)
        at = stages[-1].theta
        raise_unless_good(stages[-1].status)
    weight = np.where(trusted | ~frames.in_threes(trusted), 1.0, _NEGLIGIBLE_WEIGHT)
    if frames.weight is not None:
        weight = weight * frames.weight**2
    rotations = attitudes(frames, model_name, at, weight)
    return RobustStart(stages, trusted, subset(frames, trusted), rotations)


@dataclass(frozen=True)
class RobustFit:
    """Maximum of the Student-t likelihood."""

    stage: Stage  # Trajectory; its cost is -2 log likelihood
    likelihood: StudentLikelihood  # Started at the attitudes found
    state: StudentState  # The model there
    # `sigma`, `nu`: scale and degrees of freedom.
    sigma: float
    nu: float
    # `sigma_std`, `nu_std`: standard errors of both; `nu_std` is 0 where nu was given, and not
    # finite at a bound.
    sigma_std: float
    nu_std: float
    information: Information  # Derivatives at the maximum

    @property
    def covariance(self) -> FloatArray:
        """Sandwich covariance (p, p): observed information around the scatter of the stars'
        scores.
        """
        p = len(self.information.score)
        n = 2 * int(np.sum(self.state.seen))
        inverse, scale = unit_inverse(self.information.matrix)
        middle = self.information.variability * np.outer(scale, scale) * n / (self.state.dof - p)
        return (inverse @ middle @ inverse) * np.outer(scale, scale)


def refine(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    nu: float | None,
    max_iterations: int,
) -> RobustFit:
    """Maximise the Student-t likelihood over theta, sigma and, where it is None, nu.

    Camera and shape of the noise are nearly independent (one is odd in the residuals, the other
    even), so that Newton's method on one and the other in turn converges in a few rounds. A free nu
    has the prior of `starcal_uq.likelihood.student.log_excess_prior`, without which clean data
    would send it to infinity.
    """
    began = perf_counter()
    theta = np.array(theta, dtype=np.float64)
    likelihood = StudentLikelihood(
        frames, model_name, theta, rotations, usable_stars(frames, model_name, theta)
    )
    free = nu is None
    nu = DEFAULT_DOF if nu is None else nu
    # The scale from the middle of the residuals; the state's sigma enters only through the weights.
    sigma = 1.0 if frames.weight is not None else 0.1
    for _ in range(3):
        e = likelihood.state(theta, sigma, nu).e
        sigma = float(np.median(np.hypot(e[0], e[1]))) / _RAYLEIGH_MEDIAN
    trajectory, costs, status, evaluations = [theta], [], Status.MAX_ITERATIONS, 3
    shape = np.zeros((1 + free, 1 + free))
    for _ in range(min(max_iterations, _MAX_STEPS)):
        state = likelihood.state(theta, sigma, nu)
        if not np.isfinite(state.value):
            status = Status.NOT_FINITE
            break
        costs.append(-2.0 * state.value)
        found = likelihood.information(theta, state, sigma)
        likelihood.follow(theta, state, found)
        if is_singular(found.reweighted):
            status = Status.SINGULAR
            break
        theta, gain = _step(likelihood, theta, sigma, nu, state, found)
        sigma, nu, shape, shape_gain = _shape_step(likelihood, theta, sigma, nu, free)
        evaluations += 2 + len(shape) ** 2 * 2
        trajectory.append(theta)
        if gain < _GAIN and shape_gain < _SHAPE_GAIN:
            status = Status.CONVERGED
            break
    if status.ok:
        theta = _volume_step(likelihood, theta, sigma, nu)
        trajectory[-1] = theta
    state = likelihood.state(theta, sigma, nu)
    information = likelihood.information(theta, state, sigma)
    likelihood.follow(theta, state, information)
    costs.append(-2.0 * state.value)
    trajectory, costs = trajectory[: len(costs)], costs[: len(trajectory)]
    stage = Stage(
        "refinement",
        np.array(trajectory),
        np.array(costs),
        status,
        evaluations,
        perf_counter() - began,
    )
    with np.errstate(all="ignore"):
        errors = (
            root_diagonal(np.linalg.inv(-shape)) if np.any(shape) else np.full(1 + free, np.nan)
        )
    return RobustFit(
        stage=stage,
        likelihood=likelihood,
        state=state,
        sigma=sigma,
        nu=nu,
        sigma_std=float(sigma * errors[0]),
        nu_std=float((nu - DOF_RANGE[0]) * errors[1]) if free else 0.0,
        information=information,
    )


def _step(
    likelihood: StudentLikelihood,
    theta: FloatArray,
    sigma: float,
    nu: float,
    state: StudentState,
    information: Information,
) -> tuple[FloatArray, float]:
    """Newton's step where the observed information allows it, the reweighted one elsewhere; halved
    until it gains.
    """
    reweighted, scale = unit_diagonal(information.reweighted)
    observed = information.matrix * np.outer(scale, scale)
    slope = information.score * scale
    sound = np.linalg.eigvalsh(observed)[0] > 0.1 * np.linalg.eigvalsh(reweighted)[0]
    step = np.linalg.solve(observed if sound else reweighted, slope)
    gain = 0.5 * float(step @ slope)
    for _ in range(12):
        trial = theta + scale * step
        there = likelihood.state(trial, sigma, nu)
        # The scores leave out the volume of the attitudes, which comes last.
        if gain < 1e-6 or there.value - there.log_volume >= state.value - state.log_volume:
            return trial, gain
        step = 0.5 * step
    return theta, 0.0


def _volume_step(
    likelihood: StudentLikelihood, theta: FloatArray, sigma: float, nu: float
) -> FloatArray:
    """One Newton step for the volume of the attitudes, which the scores leave out: a few tenths of
    a sigma.
    """
    information = likelihood.information(theta, likelihood.state(theta, sigma, nu), sigma)
    matrix, sd = unit_diagonal(information.matrix)
    ends = [
        [likelihood.log_likelihood(theta + s * e, sigma, nu) for e in _STEP * np.diag(sd)]
        for s in (1.0, -1.0)
    ]
    slope = (np.array(ends[0]) - np.array(ends[1])) / (2.0 * _STEP)
    moved: FloatArray = theta + sd * np.linalg.solve(matrix, slope)
    return moved if np.isfinite(moved).all() else theta


def _shape_step(
    likelihood: StudentLikelihood, theta: FloatArray, sigma: float, nu: float, free: bool
) -> tuple[float, float, FloatArray, float]:
    """One Newton step in log sigma and, if free, log(nu - 2); also the Hessian and the gain that
    was promised.
    """
    bound, highest = DOF_RANGE
    start = np.log([sigma, max(nu - bound, _LEAST_EXCESS)]) if free else np.log([sigma])
    d = len(start)

    def density(point: FloatArray) -> float:
        at = bound + float(np.exp(point[1])) if free else nu
        prior = float(log_excess_prior(point[1:])[0]) if free else 0.0
        return likelihood.log_likelihood(theta, float(np.exp(point[0])), at) + prior

    unit = _STEP * np.eye(d)
    value = density(start)
    plus, minus = (np.array([density(start + sign * u) for u in unit]) for sign in (1.0, -1.0))
    if not np.isfinite([value, *plus, *minus]).all():
        return sigma, nu, np.full((d, d), np.nan), float("inf")
    slope = (plus - minus) / (2.0 * _STEP)
    hessian = np.diag((plus + minus - 2.0 * value) / _STEP**2)
    if free:
        both, neither = (density(start + sign * unit.sum(axis=0)) for sign in (1.0, -1.0))
        mixed = both + neither - plus.sum() - minus.sum() + 2.0 * value
        hessian[0, 1] = hessian[1, 0] = mixed / (2.0 * _STEP**2)
    if not np.isfinite(hessian).all():
        return sigma, nu, hessian, float("inf")
    values, vectors = np.linalg.eigh(-hessian)
    # Away from the maximum the density need not be concave: go uphill all the same.
    step = vectors @ ((vectors.T @ slope) / np.maximum(np.abs(values), 1e-3))
    step *= min(1.0, 1.0 / max(float(np.max(np.abs(step))), 1e-300))
    for _ in range(12):
        trial = start + step
        if free:
            trial[1] = np.clip(trial[1], np.log(_LEAST_EXCESS), np.log(highest - bound))
        if density(trial) >= value - 1e-9:
            moved = trial - start
            gain = 0.5 * abs(float(moved @ hessian @ moved))
            return (
                float(np.exp(trial[0])),
                bound + float(np.exp(trial[1])) if free else nu,
                hessian,
                gain,
            )
        step = 0.5 * step
    return sigma, nu, hessian, 0.0


def compress_reweighted(fit: RobustFit) -> CompressedLikelihood:
    """The Gaussian likelihood whose stars have the weights of the fit, compressed around it.

    Its maximum is that of the Student t; it treats the weights as known. Stars without weight are
    left out.
    """
    frames, theta = fit.likelihood.frames, fit.stage.theta
    kept = fit.state.weight > _NEGLIGIBLE_WEIGHT
    remaining = kept & frames.in_threes(kept)
    weight = (np.sqrt(fit.state.weight) / frames.noise)[remaining]
    rotations = fit.state.rotations[frames.sum(remaining.astype(np.float64)) > 0.0]
    likelihood = MarginalLikelihood(
        replace(frames.select(remaining), weight=weight), fit.likelihood.model_name
    )
    return compress(likelihood, theta, fit.covariance, rotations)


def with_tail_weights(obs: Observations, cal: Calibration) -> Calibration:
    """A calibration with tails whose stars keep the weights that these have at its estimate.

    `weighed` gives the stars these weights, so that a Gaussian likelihood can take further parts.
    Its sigmas are wider by `Calibration.tail_factors`: weights that follow the residuals tell less
    than known ones, and the scatter of the stars' scores says by how much. `obs`: as `weighed`
    gives them for the calibration.
    """
    record: AnyDict = {
        "theta": cal.theta.tolist(),
        "sigma": cal.sigma,
        "dof": cal.provenance.student_t["dof"],
    }
    weights = tail_weights(obs, cal, record)
    weighted = by_weights(obs, weights)
    likelihood = MarginalLikelihood(weighted, cal.camera.distortion, cal.rotations)
    normal = likelihood.evaluate(cal.theta)
    sigma = float(np.sqrt(normal.cost / (likelihood.dof - len(cal.theta))))
    alone = root_diagonal(scaled_inverse(normal.matrix)) * sigma
    wide = cal.sigmas if cal.coma_factors is None else cal.sigmas / cal.coma_factors
    record["factors"] = dict(zip(cal.parameter_names, (wide / alone).tolist(), strict=True))
    return replace(
        cal,
        sigma=sigma,
        provenance=cal.provenance.adding(tail_weights=record),
        star_weights=weights,
    )


def tail_weights(obs: Observations, cal: Calibration, record: AnyDict) -> FloatArray:
    """Weights (N,) that the tails of a calibration leave its stars.

    `obs`: with the noise that the calibration has without them. `record`: parameters, scale and
    degrees of freedom.
    """
    model = cal.camera.distortion
    frames = StarFrames.from_observations(obs)
    likelihood = StudentLikelihood(
        frames,
        model,
        np.array(record["theta"]),
        cal.rotations,
        usable_stars(frames, model, cal.pair_theta),
    )
    state = likelihood.state(np.array(record["theta"]), record["sigma"], record["dof"])
    return np.where(state.seen, np.maximum(state.weight, _LEAST_WEIGHT), _NO_WEIGHT)


def by_weights(obs: Observations, weights: FloatArray) -> Observations:
    """Stars with the noise that weights (N,) leave them, px."""
    # Where they state none, weights alone, so that the noise of the estimate stays in px.
    return obs.weighted(obs.sigma_or_one / np.sqrt(weights), obs.noise_axes)
