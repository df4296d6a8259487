"""Intervals for fractions and estimates, Holm's correction for many tests, and a quick median.

The closed forms stand here because `scipy.stats.binomtest(...).proportion_ci` finds the exact
interval by a search that ends at 5e-13, and SciPy has no correction of Holm's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray, floats

# Standard deviations of a normal 95 % interval.
HALF_WIDTH_95, HALF_WIDTH_997 = 1.959963984540054, 2.9677379253417833


def mean_and_sd(values: FloatArray) -> tuple[float, float]:
    """Mean of a sample, and its standard deviation with one degree of freedom less."""
    return float(np.mean(values)), float(np.std(values, ddof=1))


def student_quantile(probability: float, dof: float) -> float:
    """Half-width of an interval for a mean whose standard deviation was estimated, in those
    standard deviations.
    """
    from scipy.special import stdtrit

    return float(stdtrit(max(dof, 1.0), 0.5 * (1.0 + probability)))


def chi_square_both_sides(statistic: FloatArray | float, dof: FloatArray | float) -> FloatArray:
    """Probability of a chi-square as far from its degrees of freedom, either way; NaN without any."""
    from scipy.special import chdtr, chdtrc

    p_value = 2.0 * np.minimum(chdtr(dof, statistic), chdtrc(dof, statistic))
    return np.where(floats(dof) > 0.0, p_value, np.nan)


def binomial_interval(successes: int, n: int, probability: float = 0.95) -> tuple[float, float]:
    """Exact interval for a fraction (Clopper & Pearson 1934)."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - probability)
    low = float(beta.ppf(tail, successes, n - successes + 1)) if successes > 0 else 0.0
    high = float(beta.ppf(1.0 - tail, successes + 1, n - successes)) if successes < n else 1.0
    return low, high


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """95 % interval for a fraction (Wilson 1927)."""
    if n == 0:
        return float("nan"), float("nan")
    z, fraction = HALF_WIDTH_95, successes / n
    centre = fraction + z**2 / (2 * n)
    half = z * np.sqrt(fraction * (1.0 - fraction) / n + (z / (2 * n)) ** 2)
    scale = 1.0 + z**2 / n
    # Rounding must not leave the fraction outside.
    low = 0.0 if successes == 0 else float((centre - half) / scale)
    high = 1.0 if successes == n else float((centre + half) / scale)
    return low, high


def holm(p_values: Sequence[float]) -> FloatArray:
    """p-values (m,) of several tests after Holm's step-down correction (1979); NaN stands for no
    test.
    """
    p = floats(p_values)
    order = np.argsort(p)[: np.count_nonzero(np.isfinite(p))]
    stepped = np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1))
    corrected = np.full(len(p), np.nan)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def median_of(values: Any) -> Any:
    """`np.median` along the last axis, in a third of its time: there is no NaN to look for."""
    n = values.shape[-1]
    parted = np.partition(values, n // 2, axis=-1)
    upper = parted[..., n // 2]
    return upper if n % 2 else 0.5 * (upper + parted[..., : n // 2].max(axis=-1))
