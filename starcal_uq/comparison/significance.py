"""The difference of two cameras on a grid, compared with the covariance that it should have."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.fields import rotated, rotation_response, tangent_axes
from starcal_uq.camera.projection import unproject_jacobian
from starcal_uq.comparison.covariance import Rule, is_efficient
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.maths.linear import scaled_cholesky
from starcal_uq.maths.quadratic_forms import weighted_chi_square_tail

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Directions in which the maps change less than this share of the largest are left out: of the same
# model, whose derivatives are taken at one point, only rounding is; of different models, what two
# linearisations blur.
_TOLERANCE, _TOLERANCE_OTHER = 1e-8, 0.02
# Variance of a Hausman difference over that of the two estimates together: below the first, a
# direction is not tested; below the second, two linearisations decide it, and no standard deviation
# is given.
_LEAST_SHARE, _RESOLVED = 0.02, 1e-3
# Share of the largest expected length below which a point has none.
_LEAST_SIGMA = 1e-6


@dataclass(frozen=True)
class Estimate:
    """Parameters, covariance, the noise behind it and its degrees of freedom."""

    camera: Camera
    theta: FloatArray
    covariance: FloatArray
    dof: float
    noise: float
    efficient: bool

    @property
    def root(self) -> FloatArray:
        """Square root of the covariance."""
        return scaled_cholesky(self.covariance)


@dataclass(frozen=True)
class Linear:
    """Derivatives on the grid: of directions with the rotation removed (2N, p), of the rotation (3,
    p).
    """

    map: FloatArray
    rotation: FloatArray


def linearised(
    a: Estimate, b: Estimate, xy: FloatArray, weight: FloatArray
) -> tuple[Linear, Linear]:
    """Of the same model half-way between the two, which leaves errors of third order only."""
    if a.camera.distortion == b.camera.distortion:
        both = _derivatives(a.camera.distortion, 0.5 * (a.theta + b.theta), xy, weight)
        return both, both
    return (
        _derivatives(a.camera.distortion, a.theta, xy, weight),
        _derivatives(b.camera.distortion, b.theta, xy, weight),
    )


def _derivatives(model: str, theta: FloatArray, xy: FloatArray, weight: FloatArray) -> Linear:
    b, B = unproject_jacobian(model, theta, xy)
    response = rotation_response(b, B, weight)
    inside = tangent_axes(b) @ (B + rotated(-response, b))
    return Linear(inside.reshape(2 * len(xy), -1), response)


def difference_matrix(
    rule: Rule, linear: tuple[FloatArray, FloatArray], estimates: tuple[Estimate, Estimate]
) -> FloatArray:
    """Covariance of the difference of linear functions of both estimates; NaN where it is not
    known.
    """
    size = len(linear[0])
    if rule.signs is None:
        return np.full((size, size), np.nan)
    first, second = (
        L @ estimate.covariance @ L.T for L, estimate in zip(linear, estimates, strict=True)
    )
    total: FloatArray = rule.signs[0] * first + rule.signs[1] * second
    lost = np.diag(total) < _RESOLVED * np.diag(first + second)
    total[lost], total[:, lost] = np.nan, np.nan
    return total


def estimate_of(result: Any) -> Estimate:
    """Posterior mean and covariance, or the estimate of a calibration."""
    theta = floats(result.mean if hasattr(result, "mean") else result.theta)
    covariance = floats(result.covariance)
    noise = (
        float(np.mean(result.sigma_draws))
        if hasattr(result, "sigma_draws")
        else float(result.sigma)
    )
    dof = float(getattr(result, "dof", np.inf))
    return Estimate(
        result.camera.with_theta(theta), theta, covariance, dof, noise, is_efficient(result)
    )


def one_noise(a: Estimate, b: Estimate, rule: Rule) -> tuple[Estimate, Estimate]:
    """Both covariances at the noise of the efficient estimate, where they are subtracted.

    The difference of two nearly equal covariances would otherwise be that of their noise estimates.
    """
    if rule.signs in (None, (1.0, 1.0)) or not (a.efficient and b.efficient):
        return a, b
    noise = a.noise if rule.signs == (-1.0, 1.0) else b.noise
    first, second = (
        replace(e, covariance=e.covariance * (noise / e.noise) ** 2, noise=noise) for e in (a, b)
    )
    return first, second


@dataclass(frozen=True)
class DifferenceTests:
    """A difference on the grid compared with its covariance; NaN where that is not known.

    `outside` is the root mean square of what no error of the parameters explains, arcsec; `sigma`
    and `ratio` (N,) are the expected length at each point, arcsec, and the length found over it;
    `expected` is the root mean square length expected, arcsec. The others are the numbers of
    `CameraComparison` with these names, of `n_directions` tested.
    """

    outside: float
    sigma: FloatArray
    ratio: FloatArray
    expected: float = np.nan
    p_map: float = np.nan
    p_parameters: float = np.nan
    statistic: float = np.nan
    n_directions: int = 0
    p_worst: float = np.nan
    p_worst_error: float = np.nan


def difference_tests(
    a: Estimate,
    b: Estimate,
    linear: tuple[Linear, Linear],
    rule: Rule,
    e: FloatArray,
    weight: FloatArray,
    n_draws: int,
    seed: int,
) -> DifferenceTests:
    """Hold the difference e (N, 2), rad, against its covariance.

    All is done in the few directions in which errors of the parameters bend the map: the left
    singular vectors of the weighted derivatives times the roots of both covariances.
    """
    root_weight = np.repeat(np.sqrt(weight), 2)
    factors = [
        root_weight[:, None] * (L.map @ estimate.root)
        for L, estimate in zip(linear, (a, b), strict=True)
    ]
    same_model = a.camera.distortion == b.camera.distortion
    modes, sizes, _ = np.linalg.svd(np.hstack(factors), full_matrices=False)
    kept = sizes > (_TOLERANCE if same_model else _TOLERANCE_OTHER) * sizes[0]
    modes, sizes = modes[:, kept], sizes[kept]
    weighted = root_weight * e.ravel()
    amplitudes = modes.T @ weighted
    outside = float(np.linalg.norm(weighted - modes @ amplitudes)) * ARCSEC
    if same_model:
        # The difference of the parameters is free of what the linearisation leaves out.
        amplitudes = modes.T @ (root_weight * (linear[0].map @ (b.theta - a.theta)))
    nothing = np.full(len(weight), np.nan)
    if rule.signs is None:
        return DifferenceTests(outside, nothing, nothing)
    parts = [modes.T @ factor for factor in factors]
    joint = rule.signs[0] * (parts[0] @ parts[0].T) + rule.signs[1] * (parts[1] @ parts[1].T)
    share, along = np.linalg.eigh(joint / np.outer(sizes, sizes))
    counted = share > _LEAST_SHARE
    if not counted.any():
        return DifferenceTests(outside, nothing, nothing)
    field = modes / root_weight[:, None] * ARCSEC
    independent = rule.signs == (1.0, 1.0)
    if not (independent or (a.efficient and b.efficient)):
        return _rough_tests(field, joint, amplitudes, outside)
    # Coordinates of unit variance in the directions that can be tested, and the map of each at
    # every point.
    z = (along.T @ (amplitudes / sizes))[counted] / np.sqrt(share[counted])
    root = sizes[:, None] * along[:, counted] * np.sqrt(share[counted])
    sigma, unit = _unit_points(field @ root)
    ratio = np.linalg.norm(unit @ z, axis=1)
    p_worst, p_worst_error = _worst(unit, float(ratio.max()), n_draws, seed)
    dof = _effective_dof((a, b), parts, sizes) if independent else np.inf
    variances = np.maximum(np.linalg.eigvalsh(root.T @ root), 0.0)
    # What two models cannot agree on counts in full; of one model, it is what the linearisation
    # leaves out.
    unexplained = 0.0 if same_model or not independent else (outside / ARCSEC) ** 2
    return DifferenceTests(
        outside=outside,
        sigma=sigma,
        ratio=ratio,
        expected=float(np.sqrt(variances.sum())) * ARCSEC,
        p_map=weighted_chi_square_tail(
            variances, float(np.sum((root @ z) ** 2)) + unexplained, dof
        ),
        p_parameters=_chi_square_tail(float(z @ z), len(z), dof),
        statistic=float(z @ z),
        n_directions=len(z),
        p_worst=p_worst,
        p_worst_error=p_worst_error,
    )


def _rough_tests(
    field: FloatArray, joint: FloatArray, amplitudes: FloatArray, outside: float
) -> DifferenceTests:
    """The map alone, where the covariance (r, r) of the difference in the modes (r,) is known
    roughly.

    All directions count: to choose among them would favour those whose variance came out too large.
    """
    variances, vectors = np.linalg.eigh(joint)
    variances = np.maximum(variances, 0.0)
    sigma, _ = _unit_points(field @ (vectors * np.sqrt(variances)))
    return DifferenceTests(
        outside=outside,
        sigma=sigma,
        ratio=np.linalg.norm((field @ amplitudes).reshape(-1, 2), axis=1)
        / np.maximum(sigma, _LEAST_SIGMA * sigma.max()),
        expected=float(np.sqrt(variances.sum())) * ARCSEC,
        p_map=weighted_chi_square_tail(variances, float(amplitudes @ amplitudes)),
    )


def _unit_points(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Expected lengths (N,) of displacements points (2N, r) per unit normal, and these (N, 2, r)
    over the lengths.
    """
    vectors = points.reshape(len(points) // 2, 2, -1)
    sigma = np.sqrt(np.sum(vectors**2, axis=(1, 2)))
    return sigma, vectors / np.maximum(sigma, _LEAST_SIGMA * sigma.max())[:, None, None]


def _effective_dof(
    estimates: tuple[Estimate, Estimate], parts: list[FloatArray], sizes: FloatArray
) -> float:
    """Welch's degrees of freedom of the sum of two covariances, from the share that each has
    in it.
    """
    loss = 0.0
    for estimate, part in zip(estimates, parts, strict=True):
        share = float(np.sum((part / sizes[:, None]) ** 2)) / len(sizes)
        loss += share**2 / estimate.dof
    return 1.0 / loss if loss > 0.0 else np.inf


def _chi_square_tail(statistic: float, count: int, dof: float) -> float:
    from scipy.special import chdtrc, fdtrc

    return (
        float(fdtrc(count, dof, statistic / count))
        if np.isfinite(dof)
        else float(chdtrc(count, statistic))
    )


def _worst(pixels: FloatArray, ratio: float, n_draws: int, seed: int) -> tuple[float, float]:
    """Share of draws whose largest ratio exceeds this one, and its standard error; pixels (N, 2, r)
    of unit size.
    """
    z = np.random.default_rng(seed).standard_normal((n_draws, pixels.shape[2]))
    shifts = (z @ pixels.reshape(-1, pixels.shape[2]).T).reshape(n_draws, -1, 2)
    larger = int(np.sum(np.max(np.sum(shifts**2, axis=2), axis=1) >= ratio**2))
    # Counting the observed one keeps the test valid for any number of draws.
    p = (larger + 1) / (n_draws + 1)
    return p, float(np.sqrt(p * (1.0 - p) / n_draws))
