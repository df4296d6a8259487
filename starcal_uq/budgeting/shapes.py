"""Distributions of the rows of a budget, scaled to mean 0 and standard deviation 1, and the
quantiles of the rules.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from starcal_uq.budgeting.rows import GAUSSIAN_997
from starcal_uq.core.types import FloatArray

_RAYLEIGH_MEAN = math.sqrt(math.pi / 2.0)
_RAYLEIGH_SD = math.sqrt(2.0 - math.pi / 2.0)
# Mean of a Rayleigh distribution in units of its standard deviation.
RAYLEIGH_MEAN = _RAYLEIGH_MEAN / _RAYLEIGH_SD
# Half-width over standard deviation of the distributions that have one.
HALF_WIDTHS = {"uniform": math.sqrt(3.0), "arcsine": math.sqrt(2.0), "constant": 0.0}
_LARGEST_SPREAD = 1.2
_NODES, _ANGLES = 60, 400


@lru_cache(maxsize=2)
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of expectations over a standard normal variable."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    return nodes, weights / np.sum(weights)


def one_axis_factor(confidence: float) -> float:
    """Two-sided quantile of a standard Gaussian error: 2.968 for 99.7 %, 3 for 99.73 %."""
    from scipy.special import ndtri

    # From the side where the last digits of a high confidence count.
    return -float(ndtri(0.5 * (1.0 - confidence)))


@lru_cache(maxsize=1024)
def two_axis_radius(
    confidence: float, sigma_x: float, sigma_y: float, spread: float = 0.0
) -> float:
    """Radius that holds this share of a Gaussian error on two axes with these standard deviations.

    With equal sigmas it is the Rayleigh quantile: 2.448 sigma for 95 %, 3.409 for 99.7 %, 3.439 for
    99.73 %; with one sigma zero it is the two-sided quantile of the other. In between, in polar
    coordinates of the standardised plane,

        P(r) = 1 - 1 / (2 pi) int exp(-r^2 / (2 (sigma_x^2 cos^2 t + sigma_y^2 sin^2 t))) dt,

    which generalises Craig's formula and is integrated exactly by the trapezoidal rule. Where the
    sigmas change from frame to frame by a common factor, `spread` is the standard deviation of its
    logarithm (see `mixture_spread`).
    """
    large, small = max(sigma_x, sigma_y), min(sigma_x, sigma_y)
    if large == 0.0:
        return 0.0
    from scipy.optimize import brentq

    angle = (np.arange(_ANGLES) + 0.5) * (0.5 * math.pi / _ANGLES)
    variance = np.cos(angle) ** 2 + (small / large) ** 2 * np.sin(angle) ** 2
    nodes, weights = _nodes(_NODES if spread > 0.0 else 1)
    scale = np.exp(spread * nodes - spread * spread)

    def excess(radius: float) -> float:
        beyond = np.exp(-0.5 * (radius / scale[:, None]) ** 2 / variance).mean(axis=1)
        return float(weights @ beyond) - (1.0 - confidence)

    reach = 4.0
    while excess(reach) > 0.0:
        reach *= 2.0
    return large * float(brentq(excess, 0.0, reach, xtol=1e-13))


def _mixture_miss(limit: float, spread: float) -> float:
    """Probability that a Gaussian error with log-normal sigma, of variance 1 in all, exceeds the
    limit.
    """
    from scipy.special import ndtr

    nodes, weights = _nodes(_NODES)
    scale = np.exp(spread * nodes - spread * spread)
    return float(np.sum(weights * 2.0 * ndtr(-limit / scale)))


@lru_cache(maxsize=256)
def mixture_spread(tail_997: float) -> float:
    """Standard deviation of log sigma that gives a Gaussian mixture this 99.7 % half-width, in
    standard deviations.

    0 for a Gaussian tail or a lighter one; at most 1.2, beyond which the half-width grows no
    further.
    """
    if tail_997 <= GAUSSIAN_997 * (1.0 + 1e-6):
        return 0.0
    from scipy.optimize import brentq

    # Where the probability beyond the limit is largest: it falls again once most errors are tiny.
    grid = np.linspace(0.0, _LARGEST_SPREAD, 61)
    widest = float(grid[int(np.argmax([_mixture_miss(tail_997, float(s)) for s in grid]))])
    if _mixture_miss(tail_997, widest) <= 0.003:
        return widest
    return float(brentq(lambda s: _mixture_miss(tail_997, s) - 0.003, 0.0, widest))


@lru_cache(maxsize=1024)
def half_width(distribution: str, confidence: float, tail_997: float = GAUSSIAN_997) -> float:
    """Deviation, in standard deviations, that this share of the errors stays below; the end of
    bounded ones.
    """
    if distribution in HALF_WIDTHS:
        return HALF_WIDTHS[distribution]
    if distribution == "rayleigh":
        low = -RAYLEIGH_MEAN
        high = math.sqrt(-2.0 * math.log1p(-confidence)) / _RAYLEIGH_SD - RAYLEIGH_MEAN
        return max(abs(low), high)
    spread = mixture_spread(tail_997)
    if spread == 0.0:
        return one_axis_factor(confidence)
    from scipy.optimize import brentq

    reach = 60.0
    while _mixture_miss(reach, spread) > 1.0 - confidence:
        reach *= 2.0
    return float(brentq(lambda x: _mixture_miss(x, spread) - (1.0 - confidence), 0.0, reach))


def deviates(
    distribution: str, uniform: FloatArray, log_scale: FloatArray, tail_997: float
) -> FloatArray:
    """Deviations of mean 0 and standard deviation 1 at probabilities `uniform` (n,); rows that
    share one err together.

    `log_scale` (n,) are standard normal deviates that decide about sigma where it changes from
    frame to frame; `distribution` and `tail_997` are those of a `Contributor`.
    """
    from scipy.special import ndtri

    if distribution == "constant":
        return np.zeros_like(uniform)
    if distribution == "uniform":
        return math.sqrt(12.0) * (uniform - 0.5)
    if distribution == "arcsine":
        return math.sqrt(2.0) * np.sin(np.pi * (uniform - 0.5))
    if distribution == "rayleigh":
        return (np.sqrt(-2.0 * np.log1p(-uniform)) - _RAYLEIGH_MEAN) / _RAYLEIGH_SD
    normal: FloatArray = ndtri(uniform)
    spread = mixture_spread(tail_997)
    return normal if spread == 0.0 else normal * np.exp(spread * log_scale - spread * spread)
