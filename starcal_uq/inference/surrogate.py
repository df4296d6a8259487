"""A polynomial in place of a log likelihood that costs milliseconds.

Many stars make a log likelihood nearly quadratic within the posterior's reach, whatever its form;
the third order (and the fourth, where the data are few) is what remains. A few hundred exact
evaluations around the mode determine it, after which an evaluation costs microseconds for any
number of stars. Every run compares it with the exact likelihood at posterior draws.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from starcal_uq.core.errors import SamplingError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.inference.target import Target, curvature
from starcal_uq.maths.linear import whitened

# Points per coefficient, and their spread against the posterior's.
_OVERSAMPLING = 2.5
_SPREAD = 1.25
# Beyond this radius (standard deviations, plus the root of the dimension) the higher orders stay
# what they are there: a cubic has no business far from its points.
_REACH = 2.0
# Negative curvature in every direction, the mode's own being one, of a posterior that the
# polynomial can stand for.
_LEAST_CURVATURE = 0.1
_CHUNK = 4096


@dataclass(frozen=True)
class PolynomialLikelihood:
    """Log likelihood as a polynomial in the whitened coordinates of a target."""

    target: Target  # Coordinates; its origin is the mode
    exponents: tuple[
        IntArray, ...
    ]  # (n_k, k): coordinates multiplied in every monomial, by degree from 0 on
    coefficients: tuple[FloatArray, ...]  # (n_k,): coefficients of the monomials
    reach: float  # Radius up to which degrees above two vary

    def log_likelihood(
        self, theta: FloatArray, sigma: FloatArray, *extra: FloatArray
    ) -> FloatArray:
        """Log likelihood (n,) at theta (n, p), sigma (n,) and a further parameter where there is
        one.
        """
        columns = [theta] if self.target.sigma is not None else [theta, np.log(sigma)]
        if self.target.extra is not None:
            columns.append(np.log(extra[0] - self.target.extra.bound))
        point = np.column_stack(columns)
        u = whitened(point - self.target.centre, self.target.transform)
        return np.concatenate([self._at(u[i : i + _CHUNK]) for i in range(0, len(u), _CHUNK)])

    def _at(self, u: FloatArray) -> FloatArray:
        radius = np.linalg.norm(u, axis=1, keepdims=True)
        near = u * np.minimum(1.0, self.reach / np.maximum(radius, self.reach))
        value = np.zeros(len(u))
        for degree, (exponents, coefficients) in enumerate(
            zip(self.exponents, self.coefficients, strict=True)
        ):
            value += _monomials(u if degree <= 2 else near, exponents) @ coefficients
        return value


def _monomials(u: FloatArray, exponents: IntArray) -> FloatArray:
    product: FloatArray = np.ones((len(u), len(exponents)))
    for column in exponents.T:
        product *= u[:, column]
    return product


def fit_polynomial(
    target: Target, degree: int, rng: np.random.Generator
) -> PolynomialLikelihood | None:
    """Fit a polynomial to the log likelihood of a target that `laplace_approximation` has centred
    and whitened.

    None where the posterior with it has no clear maximum there: a likelihood with several, of few
    stars with wrong ones among them, is no polynomial, and draws would run away.
    """
    d = target.dim
    exponents = tuple(
        np.array(list(combinations_with_replacement(range(d), k)), dtype=np.int64)
        for k in range(degree + 1)
    )
    sizes = [len(e) for e in exponents]
    reach = float(np.sqrt(d)) + _REACH
    u = _SPREAD * rng.standard_normal((round(_OVERSAMPLING * sum(sizes)), d))
    u *= np.minimum(1.0, reach / np.linalg.norm(u, axis=1, keepdims=True))
    u[0] = 0.0
    values = target.likelihood_at(u)
    if not np.isfinite(values).all():
        raise SamplingError(
            "the likelihood is not finite around its maximum: use evaluation='exact', or check "
            "the identifications."
        )
    columns = np.concatenate([_monomials(u, e) for e in exponents], axis=1)
    # A large constant would cost digits of everything else.
    solution = np.linalg.lstsq(columns, values - values[0], rcond=None)[0]
    parts = np.split(solution, np.cumsum(sizes)[:-1])
    parts[0] = parts[0] + values[0]
    fitted = PolynomialLikelihood(target, exponents, tuple(parts), reach)
    posterior = replace(target, log_likelihood=fitted.log_likelihood)
    return fitted if np.min(np.linalg.eigvalsh(curvature(posterior))) > _LEAST_CURVATURE else None
