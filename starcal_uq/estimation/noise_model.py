"""Centroid noise that varies: its variance as a smooth function of radius and magnitude, times a
factor per frame.

Its axes may differ, and correlate, alike for all stars: smear, or time delay and integration.

The squared residuals of a fit tell the variances. With H the hat matrix of attitudes and parameters
(weights as fitted), the two residuals of star i have the expected square ``v_i (2 - h_i)``, h_i the
trace of its block of H. Setting ``sum_i z_i (d_i / v_i - (2 - h_i)) = 0`` for every column z of a
log-linear model is restricted maximum likelihood (Smyth 2002, J. Comput. Graph. Stat. 11, 836): a
gamma regression of d_i / (2 - h_i). The factors of frames follow a scaled inverse chi-square
distribution whose degrees of freedom are estimated (Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3,
3): each frame's own variance is shrunk towards that of the others. Weights and estimate are
repeated until they settle.

A term stays only if it raises twice the log likelihood by more than the logarithm of the number of
stars (Schwarz's criterion), and the residuals have enough degrees of freedom, so that even noise is left as
it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.estimation.settings import ITERATIONS
from starcal_uq.estimation.stages import REFINEMENT_TOLERANCE, Search, refinement_stage
from starcal_uq.likelihood.arrays import BLOCK_STARS
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.maths.linear import root_diagonal, scaled_cholesky, scaled_inverse
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations

from starcal_uq.likelihood.noise_model import QUANTITIES, NoiseModel, log_variance_columns

# Degrees of freedom of the residuals, two a star, from which noise can be seen to vary.
_LEAST_DOF = 40.0
_HIGHEST_POWER = 2
_ROUNDS, _CHOOSING_ROUNDS, _SETTLED = 10, 2, 1e-3
_NEWTON_STEPS, _LONGEST_STEP, _STEP_SETTLED = 50, 2.0, 1e-8
# Logarithms of the degrees of freedom of the frames' distribution: from wild to hardly different.
_FRAME_LOG_DOF, _FRAME_LOG_DOF_START = (0.0, 9.0), 3.0
# Correlations beyond leave the noise no second axis.
_MOST_CORRELATED = 0.99
# Residuals that tails exceed with less probability than this are those of wrong stars.
_WRONG_P = 1e-3


def star_squares(
    likelihood: MarginalLikelihood, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Squared whitened residuals (N,) of the stars, two axes, and their expectation 2 - h (N,)
    where weights are right.

    `theta` (p,): estimate, px units.
    """
    state, *held = _held(likelihood, theta)
    leverage = sum(np.sum(columns**2, axis=(0, 1)) for columns in held)
    return np.sum(state.e**2, axis=0), np.maximum(2.0 - leverage, 1e-6)


def _held(
    likelihood: MarginalLikelihood, theta: FloatArray
) -> tuple[Profile, FloatArray, FloatArray]:
    """The model at theta (p,), and orthonormal columns that the attitude of each frame (3, 2, N)
    and all parameters (p, 2, N) span.
    """
    state, _ = likelihood.profile(theta)
    h = likelihood.slopes(state)
    flat = h.reshape(len(h), -1)
    camera = np.tensordot(scaled_cholesky(scaled_inverse(flat @ flat.T)).T, h, axes=1)
    return state, likelihood.attitudes(state).orthonormal, camera


class AxisNoise(NamedTuple):
    """Noise of x against that of y, by the residuals of a fit."""

    log_ratio: float  # Logarithm of the noise of x over that of y
    log_ratio_std: float  # Its standard error
    correlation: float  # Of their errors
    correlation_std: float  # Its standard error without one

    def z(self, model: NoiseModel | None = None) -> tuple[float, float]:
        """Standard normal statistics of ratio and correlation, of what a model leaves."""
        ratio, correlation = (
            (1.0, 0.0) if model is None else (model.axis_ratio, model.axis_correlation)
        )
        by_ratio = (self.log_ratio - np.log(ratio)) / self.log_ratio_std
        limited = np.clip([self.correlation, correlation], -_MOST_CORRELATED, _MOST_CORRELATED)
        by_correlation = (
            float(np.arctanh(limited[0]) - np.arctanh(limited[1])) / self.correlation_std
        )
        return float(by_ratio), by_correlation


def axis_noise(likelihood: MarginalLikelihood, theta: FloatArray) -> AxisNoise:
    """Noise of x and y and their correlation, free of what attitudes and parameters take from the
    residuals.

    With U the orthonormal columns that attitudes and parameters span, residuals are ``(I - U U^T)``
    times the errors, and the sums of squares and products of their axes expect linear combinations
    of the variances and the covariance with traces of products of ``U_x^T U_x``, ``U_y^T U_y`` and
    ``U_x^T U_y``. Standard errors are those of the scatter of the stars' products, which know the
    tails of the noise.

    `likelihood`: of weights whose axes are alike.
    `theta` (p,): estimate, px units.
    """
    state, attitude, camera = _held(likelihood, theta)
    sums = AxisSums()
    sums.add(likelihood.frames, attitude, camera, state.e)
    return sums.noise(likelihood.dof)


class AxisSums:
    """Sums over the stars of any frames from which the same follows; frames are added to them."""

    def __init__(self) -> None:
        self._n, self._traces, self._products = 0, np.zeros(4), np.zeros((4, 4))
        self._camera: FloatArray = np.zeros((4, 1, 1))
        self._sums, self._squares = np.zeros(3), np.zeros((3, 3))

    def add(
        self, frames: StarFrames, attitude: FloatArray, camera: FloatArray, e: FloatArray
    ) -> None:
        """Add residuals e (2, N) beside orthonormal columns of every frame (a, 2, N) and of all
        stars (p, 2, N).
        """
        a, p = len(attitude), len(camera)
        self._n += frames.n_stars
        for first, last in frames.parts(BLOCK_STARS):
            rows = slice(int(frames.starts[first]), int(frames.starts[last]))
            held = np.concatenate([attitude[..., rows], camera[..., rows]])
            x, y = e[:, rows]
            # U^T U over the stars, for x with x, x with y, y with x and y with y: of attitudes,
            # frame by frame, of these with the camera, and of the camera.
            own = np.einsum("isn,btn->stibn", held[:a], held).reshape(4, a, a + p, -1)
            by_frame = frames.part(first, last).sum(own)
            inner, mixed = by_frame[:, :, :a], by_frame[:, :, a:]
            self._traces += np.einsum("siik->s", inner)
            for part in (inner, mixed, mixed[[0, 2, 1, 3]]):
                flat = part.reshape(4, -1)
                self._products += flat @ flat.T
            of_all = np.einsum("isn,jtn->stij", held[a:], held[a:]).reshape(4, p, p)
            self._camera = self._camera + of_all
            values = np.stack([x**2, y**2, x * y])
            self._sums += values.sum(axis=1)
            self._squares += values @ values.T

    def noise(self, left: int) -> AxisNoise:
        """Noise of the axes; `left` are the degrees of freedom of the residuals, where those of all
        stars are few with or without.
        """
        n, flat = self._n, self._camera.reshape(4, -1)
        taken = self._traces + np.einsum("sii->s", self._camera)
        products = self._products + flat @ flat.T
        free = np.array(
            [
                [n - 2.0 * taken[0] + products[0, 0], products[0, 3]],
                [products[0, 3], n - 2.0 * taken[3] + products[3, 3]],
            ]
        )
        variances = np.linalg.solve(free, self._sums[:2])
        dof = n - taken[0] - taken[3] + products[1, 1] + products[1, 2]
        if not (np.all(variances > 0.0) and dof > 0.0):
            return AxisNoise(0.0, np.inf, 0.0, np.inf)
        sigma = np.sqrt(variances)
        covariance = (self._sums[2] + float(np.mean(variances)) * taken[1]) / dof
        correlation = covariance / (sigma[0] * sigma[1])
        by_star = np.linalg.inv(free) / variances[:, None]
        scatter = by_star[0] - by_star[1]
        about_mean = self._squares - np.outer(self._sums, self._sums) / n
        # Residuals are smaller than errors: the scatter of their products grows by the square of
        # the share that is left.
        grown = 2.0 * n / left
        log_ratio_std = 0.5 * float(np.sqrt(grown * (scatter @ about_mean[:2, :2] @ scatter)))
        correlation_std = float(np.sqrt(grown * about_mean[2, 2]) / (sigma[0] * sigma[1])) / dof
        log_ratio = float(np.log(sigma[0] / sigma[1]))
        return AxisNoise(log_ratio, log_ratio_std, float(correlation), float(correlation_std))


class Refit(NamedTuple):
    """An estimate for stars of given weights."""

    theta: FloatArray  # (p,): px units
    weight: FloatArray  # (N,): precision of each star relative to its scale; 0 where it has no say
    dof: float  # Degrees of freedom of the tails of its residuals; infinite without any


# An estimate for frames, from theta (p,), in one of the rounds; None where it is not found.
Refitting = Callable[[StarFrames, FloatArray, int], Refit | None]


def without_tails(camera: Camera, max_iterations: int = ITERATIONS) -> Refitting:
    """The refinement of a Gaussian fit, which begins at its end."""
    search = Search(max_iterations=max_iterations, tolerance=REFINEMENT_TOLERANCE)

    def refit(frames: StarFrames, theta: FloatArray, turn: int) -> Refit | None:
        if turn > 0:
            likelihood = MarginalLikelihood(frames, camera.distortion)
            stage = refinement_stage(likelihood, theta, search)
            if not stage.status.ok:
                return None
            theta = stage.theta
        return Refit(theta, np.ones(frames.n_stars), np.inf)

    return refit


def fit_noise(
    obs: Observations, camera: Camera, refit: Refitting | None = None, *, rounds: int = _ROUNDS
) -> tuple[NoiseModel, FloatArray]:
    """Fit the noise model around an estimate, weights and estimate in turn until they settle.

    Given its precision, a star with tails is Gaussian, and the mean of its weighted square is that
    of the scale. Wrong stars, which no noise explains, say nothing of it.

    `obs`: identified stars; a noise that they state is multiplied.
    `refit`: that `without_tails` by default. `rounds`: largest number of fits; with 1 the estimate
    of a Gaussian fit stays where it is. Returns the model, and the estimate (p,) with its weights.
    CalibrationError where an estimate is not found at once.
    """
    refit = without_tails(camera) if refit is None else refit
    obs, theta = obs.unweighted, camera.theta
    plain, sigma_px = StarFrames.from_observations(obs), obs.sigma_or_one
    found: _Round | None = None
    for turn in range(rounds):
        axes = None if found is None else found.model.axes
        frames = replace(plain, weight=1.0 / sigma_px, axes=axes)
        again = refit(frames, theta, turn)
        if again is None:
            break
        theta = again.theta
        right = again.weight >= (1.0 + 2.0 / again.dof) * _WRONG_P ** (2.0 / again.dof)
        if np.isfinite(again.dof):
            right &= frames.in_threes(right)
        part, weight = obs.select(right), np.sqrt(again.weight[right])
        own = replace(frames.select(right), weight=weight / sigma_px[right])
        likelihood = MarginalLikelihood(own, camera.distortion)
        variance = (sigma_px[right] / part.sigma_or_one) ** 2
        last, before = found, sigma_px
        found = _round(part, camera.with_theta(theta), likelihood, variance, weight, last)
        sigma_px = found.model.sigma_px(obs)
        if not found.model.varies or _settled(found, last, sigma_px**2, before**2):
            break
    if found is None:
        raise CalibrationError(
            "how the noise varies cannot be fitted: leave the effect 'noise' out."
        )
    return found.model, theta


class _Round(NamedTuple):
    """One regression."""

    model: NoiseModel
    fit: _Fit
    number: int  # Of the regressions before


def _round(
    obs: Observations,
    camera: Camera,
    likelihood: MarginalLikelihood,
    variance: FloatArray,
    precision: FloatArray,
    last: _Round | None,
) -> _Round:
    """The regression of residuals at the estimate of a camera, weighed with `variance` (N,) and,
    relative to it, the square of `precision` (N,).
    """
    number = 0 if last is None else last.number + 1
    squares, share = star_squares(likelihood, camera.theta)
    stars = _Stars.of(obs, camera, squares * variance, share)
    # The first residuals come from wrong weights: terms are chosen again.
    fit = (
        _chosen(stars)
        if last is None or number < _CHOOSING_ROUNDS
        else _fitted(stars, last.fit.terms, last.fit.frame_dof is not None)
    )
    weight = precision / (obs.sigma_or_one * np.sqrt(fit.variance(stars)))
    alike = MarginalLikelihood(
        replace(likelihood.frames, weight=weight, axes=None), camera.distortion
    )
    model = _model(obs, camera, stars, fit, axis_noise(alike, camera.theta))
    return _Round(model, fit, number)


def _settled(found: _Round, last: _Round | None, now: FloatArray, before: FloatArray) -> bool:
    """Whether two regressions have nearly the same axes, and variances (N,)."""
    if last is None or abs(found.model.axis_ratio / last.model.axis_ratio - 1.0) >= _SETTLED:
        return False
    return bool(np.max(np.abs(now / before - 1.0)) < _SETTLED)


def uneven_p(
    obs: Observations, camera: Camera, squares: FloatArray, share: FloatArray
) -> list[float]:
    """Probabilities of so much less even noise by chance: by radius, by magnitude and from frame
    to frame.

    `squares`, `share` (N,): as of `star_squares` where all stars have one noise.
    """
    from scipy.special import chdtrc

    stars = _Stars.of(obs, camera, squares, share)
    even, found = _fitted(stars, (), False), []
    for name in QUANTITIES:
        power = stars.highest(name)
        if power:
            fit = _fitted(stars, _terms({name: power}), False)
            gain = max(fit.log_likelihood - even.log_likelihood, 0.0)
            found.append(float(chdtrc(power, 2.0 * gain)))
    if stars.n_frames > 2:
        dof, x = stars.per_frame(share), np.append(even.beta, _FRAME_LOG_DOF[1])
        alike = -_frames_cost(x, stars, np.ones((len(share), 1)), dof)[0]
        gain = max(_fitted(stars, (), True).log_likelihood - alike, 0.0)
        # A variance on its bound.
        found.append(0.5 * float(chdtrc(1.0, 2.0 * gain)))
    return found


def axes_p(likelihood: MarginalLikelihood, theta: FloatArray) -> float:
    """Probability of so much noise of x against that of y, and correlation, by chance."""
    from scipy.special import chdtrc

    return float(chdtrc(2.0, np.sum(np.square(axis_noise(likelihood, theta).z()))))


def sigma_ratios(obs: Observations, camera: Camera, model: NoiseModel, sigma: float) -> FloatArray:
    """Real over stated standard deviations (p,) of an estimate with one noise, if the noise is that
    of a model.

    `obs`: identified stars, with the weights of the estimate.
    `sigma`: noise of the estimate, px or a factor on what the stars state.
    """
    likelihood = MarginalLikelihood(obs, camera.distortion)
    state, _ = likelihood.profile(camera.theta)
    h = likelihood.slopes(state)
    whitened = model.sigma_px(obs) / obs.sigma_or_one
    turned = (
        h if model.axes is None else np.einsum("pxn,xy->pyn", h, np.linalg.cholesky(model.axes))
    )
    flat, noisy = h.reshape(len(h), -1), (turned * whitened).reshape(len(h), -1)
    inverse = scaled_inverse(flat @ flat.T)
    real = inverse @ (noisy @ noisy.T) @ inverse
    return np.sqrt(np.diag(real) / np.diag(inverse)) / sigma


class _Stars(NamedTuple):
    """What the regression needs of the stars: squared residuals and their degrees of freedom, and
    the quantities.
    """

    squares: FloatArray
    share: FloatArray
    radius: FloatArray
    mag: FloatArray
    frame: IntArray
    n_frames: int

    @classmethod
    def of(
        cls, obs: Observations, camera: Camera, squares: FloatArray, share: FloatArray
    ) -> _Stars:
        x0, y0 = camera.theta[:2]
        radius = np.hypot(obs.x_px - x0, obs.y_px - y0) / camera.half_diagonal_px
        mag = (
            np.zeros(obs.n_stars)
            if obs.mag is None
            else np.nan_to_num(obs.mag - np.nanmean(obs.mag))
        )
        return cls(
            squares, share, radius, mag, np.searchsorted(obs.frame_ids, obs.frame), obs.n_frames
        )

    def per_frame(self, values: FloatArray) -> FloatArray:
        """Sums over the stars of each frame."""
        return floats(np.bincount(self.frame, values, self.n_frames))

    def price(self, n_terms: int) -> float:
        """What terms must gain by Schwarz's criterion; few stars follow any of them by chance."""
        few = np.sum(self.share) < _LEAST_DOF
        return np.inf if few and n_terms else float(n_terms * np.log(len(self.share)))

    def highest(self, name: str) -> int:
        """Highest power of a quantity that the stars can tell."""
        distinct = len(np.unique(self.radius if name == "radius" else self.mag))
        return min(_HIGHEST_POWER, distinct - 1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Terms with their coefficients (the first is that of the level), and the frames' distribution
    and factors.
    """

    terms: tuple[str, ...]
    beta: FloatArray
    errors: FloatArray
    frame_dof: float | None
    factors: FloatArray
    log_likelihood: float = -np.inf

    @property
    def varies(self) -> bool:
        return bool(self.terms) or self.frame_dof is not None

    def score(self, stars: _Stars) -> float:
        """Schwarz's criterion, the larger the better."""
        n_terms = len(self.terms) + (self.frame_dof is not None)
        return 2.0 * self.log_likelihood - stars.price(n_terms)

    def variance(self, stars: _Stars) -> FloatArray:
        """Variance of every star."""
        smooth: FloatArray = np.exp(_design(stars, self.terms) @ self.beta)
        return smooth * self.factors[stars.frame]


def _design(stars: _Stars, terms: tuple[str, ...]) -> FloatArray:
    return np.column_stack(
        [np.ones(len(stars.radius)), log_variance_columns(terms, stars.radius, stars.mag)]
    )


def _chosen(stars: _Stars) -> _Fit:
    """The fit with the best criterion that is reached from even noise by one quantity at a time."""
    powers, frames = dict.fromkeys(QUANTITIES, 0), False
    best = _fitted(stars, (), False)
    while True:
        trials = [
            (_fitted(stars, _terms(more), apart), more, apart)
            for more, apart in _near(stars, powers, frames)
        ]
        found = max(trials, key=lambda trial: trial[0].score(stars))
        if found[0].score(stars) <= best.score(stars):
            return best
        best, powers, frames = found


def _near(
    stars: _Stars, powers: dict[str, int], frames: bool
) -> Iterator[tuple[dict[str, int], bool]]:
    """Choices of terms that differ in one quantity."""
    for name, power in powers.items():
        for other in range(stars.highest(name) + 1):
            if other != power:
                yield {**powers, name: other}, frames
    yield powers, not frames and stars.n_frames > 2


def _terms(powers: dict[str, int]) -> tuple[str, ...]:
    return tuple(
        f"{name}^{i}" if i > 1 else name
        for name, power in powers.items()
        for i in range(1, power + 1)
    )


def _fitted(stars: _Stars, terms: tuple[str, ...], with_frames: bool) -> _Fit:
    """Restricted maximum likelihood of the coefficients, and of the frames' distribution where
    frames differ.
    """
    design = _design(stars, terms)
    information = 0.5 * (design.T * stars.share) @ design
    beta = _scored(design, stars.squares, stars.share, information)
    errors = root_diagonal(np.linalg.inv(information))
    if not with_frames:
        eta = design @ beta
        log_likelihood = -0.5 * float(
            np.sum(stars.squares * np.exp(-eta) + stars.share * (eta + np.log(2.0)))
        )
        return _Fit(terms, beta, errors, None, np.ones(stars.n_frames), log_likelihood)
    from scipy.optimize import minimize

    dof = stars.per_frame(stars.share)
    bounds = [*[(None, None)] * len(beta), _FRAME_LOG_DOF]
    start = np.append(beta, _FRAME_LOG_DOF_START)
    found = minimize(
        _frames_cost, start, (stars, design, dof), jac=True, method="L-BFGS-B", bounds=bounds
    )
    beta, nu = found.x[:-1], float(np.exp(found.x[-1]))
    sums = stars.per_frame(stars.squares * np.exp(-design @ beta))
    return _Fit(terms, beta, errors, nu, (nu + sums) / (nu + dof), -float(found.fun))


def _scored(
    design: FloatArray, squares: FloatArray, share: FloatArray, information: FloatArray
) -> FloatArray:
    """Fisher's scoring from one noise for all."""
    beta = np.zeros(design.shape[1])
    beta[0] = np.log(np.sum(squares) / np.sum(share))
    for _ in range(_NEWTON_STEPS):
        step = np.linalg.solve(
            information, 0.5 * design.T @ (squares * np.exp(-design @ beta) - share)
        )
        longest = float(np.max(np.abs(design @ step)))
        beta = beta + step * min(1.0, _LONGEST_STEP / max(longest, 1e-300))
        if longest < _STEP_SETTLED:
            break
    return beta


def _frames_cost(
    x: FloatArray, stars: _Stars, design: FloatArray, dof: FloatArray
) -> tuple[float, FloatArray]:
    """Minus the log likelihood of coefficients and log degrees of freedom of the frames, and its
    gradient.

    Whitened sums of squares of frames are chi-squares times nu over a chi-square of nu degrees of
    freedom.
    """
    from scipy.special import digamma, gammaln

    eta, nu = design @ x[:-1], float(np.exp(x[-1]))
    whitened = stars.squares * np.exp(-eta)
    sums = stars.per_frame(whitened)
    value = gammaln(0.5 * (dof + nu)) - gammaln(0.5 * nu) - 0.5 * dof * np.log(nu)
    value -= 0.5 * (dof + nu) * np.log1p(sums / nu)
    precision = (nu + dof) / (nu + sums)
    by_beta = 0.5 * design.T @ (precision[stars.frame] * whitened - stars.share)
    by_nu = (
        digamma(0.5 * (dof + nu))
        - digamma(0.5 * nu)
        - dof / nu
        - np.log1p(sums / nu)
        + precision * sums / nu
    )
    slope = np.append(by_beta, 0.5 * nu * np.sum(by_nu))
    return -float(np.sum(value) - 0.5 * stars.share @ eta), -slope


def _model(
    obs: Observations, camera: Camera, stars: _Stars, fit: _Fit, axes: AxisNoise
) -> NoiseModel:
    known = np.zeros(1) if obs.mag is None else obs.mag[np.isfinite(obs.mag)]
    apart = fit.frame_dof is not None
    # Schwarz's criterion, as for the terms.
    ratio, correlation = (z**2 > stars.price(1) for z in axes.z())
    return NoiseModel(
        terms=fit.terms,
        coefficients=fit.beta[1:],
        errors=fit.errors[1:],
        level_px=float(np.exp(0.5 * fit.beta[0])),
        multiplies=obs.sigma_px is not None,
        centre_px=np.array(camera.theta[:2]),
        corner_px=camera.half_diagonal_px,
        radius_range=np.array([stars.radius.min(), stars.radius.max()]),
        mag_range=np.array([known.min(), known.max()]),
        mag_reference=float(np.mean(known)),
        frame_dof=fit.frame_dof,
        frame_ids=np.array(obs.frame_ids) if apart else np.zeros(0, dtype=np.int64),
        frame_factors=fit.factors if apart else np.zeros(0),
        frame_mean=float(np.mean(fit.factors)),
        axis_ratio=float(np.exp(axes.log_ratio)) if ratio else 1.0,
        axis_correlation=float(np.clip(axes.correlation, -_MOST_CORRELATED, _MOST_CORRELATED))
        if correlation
        else 0.0,
    )
