"""The posterior density in whitened coordinates, its Laplace approximation, and importance sampling
around it.

Coordinates are ``(theta, log sigma) = centre + transform @ u``, with u of unit covariance at the
mode. A parameter of 5000 px and one of 1e-15 px^-4 are then alike, and nothing below needs to know
their scales.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from starcal_uq.core.errors import SamplingError
from starcal_uq.core.types import FloatArray
from starcal_uq.inference.posterior import Laplace
from starcal_uq.inference.priors import Priors
from starcal_uq.maths.differences import derivatives
from starcal_uq.maths.linear import scaled_cholesky, symmetric, symmetric_inverse

# Half width of the finite differences in standard deviations: the density is so near to a parabola
# over it that truncation is below 1e-3, while rounding of a log likelihood of 1e5 stays below 1e-8.
_STEP = 0.05
_NEWTON_STEPS = 20
# Expected gain of a further Newton step, nat: the mode is then known to 1 % of a standard
# deviation.
_GAIN = 1e-4

# From theta (n, p), sigma (n,) and, where the likelihood has one, its further parameter (n,).
LogLikelihood = Callable[..., FloatArray]
Density = Callable[[FloatArray], FloatArray]


class Likelihood(Protocol):
    """What can be sampled: a log likelihood of many points at once."""

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Log likelihood (n,) at theta (n, p) in px units and sigma (n,)."""


@dataclass(frozen=True)
class Extra:
    """A parameter of the likelihood beyond theta and sigma, sampled as the logarithm of what
    exceeds its bound.
    """

    name: str  # Name of the parameter
    log_prior: Callable[[FloatArray], FloatArray]  # Log prior density of that logarithm
    value: float  # Start
    log_sd: float  # Expected standard deviation of that logarithm
    bound: float  # The parameter is larger


@dataclass(frozen=True)
class Target:
    """Posterior density over u."""

    # ``(theta (n, p), sigma (n,)) -> (n,)``, with `extra` ``(theta, sigma, extra (n,))``
    log_likelihood: LogLikelihood
    priors: Priors  # Proper priors
    # (d,): origin of u: theta, then log sigma if it is sampled, then that of `extra` if there is
    # one.
    centre: FloatArray
    transform: FloatArray  # (d, d): square root of the covariance at the origin
    sigma: float | None  # The noise if it is given
    extra: Extra | None = None  # A further parameter of the likelihood

    @property
    def dim(self) -> int:
        """Number of sampled parameters."""
        return len(self.centre)

    def natural(self, u: FloatArray) -> FloatArray:
        """Parameters at u (n, d): theta in px units, sigma, and `extra` if there is one: (n, p+1)
        or (n, p+2).
        """
        point = self.centre + u @ self.transform.T
        p = len(self.priors.names) - 1
        noise = np.exp(point[:, p]) if self.sigma is None else np.full(len(point), self.sigma)
        columns = [point[:, :p], noise]
        if self.extra is not None:
            columns.append(self.extra.bound + np.exp(point[:, -1]))
        return np.column_stack(columns)

    def arguments(self, natural: FloatArray) -> tuple[FloatArray, ...]:
        """Columns of `natural` as the likelihood takes them."""
        p = len(self.priors.names) - 1
        return (natural[:, :p], *natural[:, p:].T)

    def likelihood_at(self, u: FloatArray) -> FloatArray:
        """Log likelihood (n,) at u (n, d)."""
        return self.log_likelihood(*self.arguments(self.natural(u)))

    def log_density(self, u: FloatArray) -> FloatArray:
        """Log posterior density (n,) per unit of theta and log sigma, up to a constant; -inf where
        undefined.
        """
        theta, sigma, *extra = self.arguments(self.natural(u))
        value = self.log_likelihood(theta, sigma, *extra) + self.priors.log_density_theta(theta)
        if self.sigma is None:
            # The prior of log sigma, not of sigma: the coordinate is log sigma, so no Jacobian is
            # owed.
            value = value + self.priors.log_density_log_sigma(np.log(sigma))
        if self.extra is not None:
            value = value + self.extra.log_prior(np.log(extra[0] - self.extra.bound))
        return np.where(np.isnan(value), -np.inf, value)


def start_target(
    log_likelihood: LogLikelihood,
    priors: Priors,
    theta: FloatArray,
    information: FloatArray,
    sigma: float,
    dof: float,
    sigma_given: bool,
    extra: Extra | None = None,
) -> Target:
    """A target whitened by Fisher information plus prior precision at an estimate.

    `information` (p, p) is that of the data at `sigma`; a Gaussian likelihood of `dof` independent
    residuals has the curvature ``2 dof`` in log sigma. SamplingError if information and prior
    together do not determine every parameter.
    """
    p = len(theta)
    d = p + (not sigma_given) + (extra is not None)
    precision, centre = np.zeros((d, d)), np.zeros(d)
    precision[:p, :p] = information + priors.precision(priors.names[:-1])
    centre[:p] = theta
    if not sigma_given:
        precision[p, p] = 2.0 * dof + priors.sigma_log_sd**-2.0
        centre[p] = np.log(sigma)
    if extra is not None:
        precision[-1, -1], centre[-1] = extra.log_sd**-2.0, np.log(extra.value - extra.bound)
    try:
        transform = scaled_cholesky(symmetric_inverse(precision))
    except np.linalg.LinAlgError:
        transform = np.full((d, d), np.nan)
    if not np.all(np.isfinite(transform)):
        raise SamplingError(
            "the Fisher information of the calibration is not positive definite: repeat the "
            "calibration, with more "
            "stars or a distortion model with fewer coefficients."
        )
    return Target(log_likelihood, priors, centre, transform, sigma if sigma_given else None, extra)


def laplace_approximation(start: Target) -> tuple[Target, Laplace]:
    """Newton's method to the mode, re-whitened with the Hessian at every step.

    The target that comes back has its origin at the mode and unit curvature there. SamplingError if
    the density is not finite around the start.
    """
    target, converged, steps = start, False, 0
    while not converged and steps < _NEWTON_STEPS:
        value, gradient, hessian = _derivatives(target)
        square_root = _inverse_square_root(-hessian)
        step = square_root @ (square_root.T @ gradient)
        converged = 0.5 * float(gradient @ step) < _GAIN
        step = _shorten(target, step, value)
        target = dataclasses.replace(
            target,
            centre=target.centre + target.transform @ step,
            transform=scaled_cholesky(_outer(target.transform @ square_root)),
        )
        steps += 1
    names = list(target.priors.names[:-1]) + (["log_sigma"] if target.sigma is None else [])
    if target.extra is not None:
        names.append(f"log_{target.extra.name}")
    covariance = _outer(target.transform)
    return target, Laplace(
        tuple(names), target.centre, covariance, target.transform, steps, converged
    )


def _outer(factor: FloatArray) -> FloatArray:
    return symmetric(factor @ factor.T)


def curvature(target: Target) -> FloatArray:
    """Negative second derivatives (d, d) of the log density at a target's origin, in its
    coordinates.
    """
    return -_derivatives(target)[2]


def _derivatives(target: Target) -> tuple[float, FloatArray, FloatArray]:
    """Value, gradient and Hessian of the log density at the origin of a target."""
    value, gradient, hessian = derivatives(target.log_density, target.dim, _STEP)
    if not (np.isfinite(gradient).all() and np.isfinite(hessian).all()):
        raise SamplingError(
            "the posterior density is not finite around the calibrated camera: check that the "
            "calibration converged, "
            "that the observations are its own and that the priors allow its estimate."
        )
    return value, gradient, hessian


def _inverse_square_root(curvature: FloatArray) -> FloatArray:
    """S with S S^T = curvature^-1; directions that are not concave keep their present length."""
    values, vectors = np.linalg.eigh(curvature)
    return vectors / np.sqrt(np.where(values > 1e-3, values, 1.0))


def _shorten(target: Target, step: FloatArray, value: float) -> FloatArray:
    trials = 0.5 ** np.arange(12)[:, None] * step
    better = np.flatnonzero(target.log_density(trials) >= value)
    return trials[better[0]] if len(better) else np.zeros_like(step)


def student_t_log_density(u: FloatArray, df: float) -> FloatArray:
    """Log density (n,) of a standard multivariate t at u (n, d), up to a constant."""
    return np.asarray(-0.5 * (df + u.shape[1]) * np.log1p(np.sum(u * u, axis=1) / df))


def importance_draws(
    target: Target, n: int, df: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, float]:
    """Draws (n, p+1) of a multivariate t around the mode, their Pareto-smoothed weights (n,), and
    the weights' shape; arguments as of `importance_check`.
    """
    from starcal_uq.inference.arviz import psis

    u = rng.standard_normal((n, target.dim)) / np.sqrt(rng.chisquare(df, (n, 1)) / df)
    log_weights, khat = psis(target.log_density(u) - student_t_log_density(u, df))
    return target.natural(u), np.exp(log_weights), float(khat)


@dataclass(frozen=True)
class ImportanceCheck:
    """Moments of the posterior by importance sampling."""

    khat: float  # Pareto shape of the weights
    # `mean`, `sd`, (p+1,): moments of the parameters, px units.
    mean: FloatArray
    sd: FloatArray
    ess: float  # ``1 / sum w^2``: equivalent number of independent draws


def importance_check(
    target: Target, n: int, df: float, rng: np.random.Generator
) -> ImportanceCheck:
    """Estimate the moments from n multivariate t draws around the mode, with Pareto-smoothed
    weights.

    `target` is one that `laplace_approximation` has centred and whitened; `df` are the proposal's
    degrees of freedom.
    """
    natural, weights, khat = importance_draws(target, n, df, rng)
    # Moments about a point among the draws: 5000 px with a sd of 0.03 px would lose digits in a raw
    # second moment.
    origin = target.natural(np.zeros((1, target.dim)))[0]
    shift = weights @ (natural - origin)
    variance = weights @ (natural - origin - shift) ** 2
    return ImportanceCheck(khat, origin + shift, np.sqrt(variance), float(1.0 / np.sum(weights**2)))
