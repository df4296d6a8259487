"""Estimates of many replicates against the truth, the Cramer-Rao bound, and what their method
claims.

The spread of n Gaussian estimates follows a chi distribution, ``(n - 1) s^2 / sigma^2 ~
chi-square(n - 1)``: from it come the intervals of claimed over spread and of the efficiency. Three
things are tested of every method and parameter: is the mean error zero (t test), is the spread what
is claimed (chi-square test; another for the textbook's claim), and does the claimed 95 % interval
hold the truth 95 times in a hundred (binomial test). All p-values of a table go through Holm's
procedure together, so that chance is called a finding in one of a hundred such tables.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.maths.intervals import HALF_WIDTH_95, chi_square_both_sides, wilson_interval

# Of one false finding among all tests of a table.
FAMILY_LEVEL = 0.01
# With fewer, claims that are half of the spread could go unnoticed.
ENOUGH_REPLICATES = 50
_INTERVAL = 0.95
# A bias below this fraction of the spread matters to nobody, however surely it is there.
_SLIGHT = 0.5
HONEST = "honest"
TOO_FEW = "too few replicates to judge"


def summarise(
    error: FloatArray, claimed: FloatArray, classical: FloatArray, crlb: float
) -> AnyDict:
    """Statistics of one parameter of one method, as the columns of `Replicates.table`.

    From errors, the standard deviations that the method gives, those by the formula of the
    textbooks (NaN where there is none), each (n,), and the bound. Keys of p-values end in ``_p``.
    """
    from scipy.stats import binomtest, t

    n = len(error)
    # NumPy numbers, which divide by zero without an exception.
    bias = np.mean(error)
    spread = np.std(error, ddof=1) if n > 1 else np.float64(np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        bias_se = spread / np.sqrt(n)
        rmse = np.sqrt(np.mean(error**2))
        low, high = chi_interval(n)
        values: AnyDict = {
            "n": n,
            "bias": bias,
            "bias_se": bias_se,
            "bias_over_spread": bias / spread,
            "spread": spread,
            "spread_se": spread / np.sqrt(2.0 * max(n - 1, 1)),
            "crlb": crlb,
            **_with_ends(
                "efficiency", *((crlb / spread * factor) ** 2 for factor in (1.0, low, high))
            ),
            "rmse": rmse,
            "rmse_over_crlb": rmse / crlb,
            "bias_p": float(2.0 * t.sf(abs(bias / bias_se), n - 1)),
        }
        for suffix, sigmas in (("", claimed), ("_classical", classical)):
            size = np.sqrt(np.mean(sigmas**2))
            known = bool(np.isfinite(size))
            held = int(np.sum(np.abs(error) <= HALF_WIDTH_95 * sigmas))
            wilson = wilson_interval(held, n) if known else (np.nan, np.nan)
            values |= {
                f"claimed{suffix}": size,
                **_with_ends(
                    f"claimed{suffix}_over_spread",
                    *(size / spread * factor for factor in (1.0, low, high)),
                ),
                f"claimed{suffix}_over_rmse": size / rmse,
                **_with_ends(f"coverage95{suffix}", held / n if known else np.nan, *wilson),
                f"claimed{suffix}_p": chi_p_value(spread / size, n) if known else np.nan,
                f"coverage95{suffix}_p": float(binomtest(held, n, _INTERVAL).pvalue)
                if known
                else np.nan,
            }
    return values


def _with_ends(name: str, value: Any, low: Any, high: Any) -> AnyDict:
    return {name: value, f"{name}_low": low, f"{name}_high": high}


def chi_interval(n: int) -> tuple[float, float]:
    """Factors (low, high) on ``1 / s`` that give the 95 % interval of ``1 / sigma`` for n Gaussian
    values.
    """
    from scipy.stats import chi2

    if n < 2:
        return float("nan"), float("nan")
    tail = 0.5 * (1.0 - _INTERVAL)
    low, high = np.sqrt(chi2.ppf([tail, 1.0 - tail], n - 1) / (n - 1))
    return float(low), float(high)


def chi_p_value(ratio: float, n: int) -> float:
    """Two-sided p-value of ``s / sigma`` when sigma is the true standard deviation of n Gaussian
    values.
    """
    return float(chi_square_both_sides((n - 1) * ratio**2, n - 1))


def words(row: AnyDict, bias: bool, claim: bool, coverage: bool) -> str:
    """Verdict on one parameter of one method, given which tests object."""
    if row["n"] < ENOUGH_REPLICATES:
        return TOO_FEW
    from starcal_uq.presentation.words.sentences import say

    tests = {"bias": bias, "claim": claim, "coverage": coverage}
    return say("Replicates.verdict", row=row, slight=_SLIGHT, honest=HONEST, **tests)


def classical_words(row: AnyDict, rejected: bool) -> str:
    """The same for the formula of the textbooks; empty where there is none."""
    if not np.isfinite(row["claimed_classical"]):
        return ""
    if row["n"] < ENOUGH_REPLICATES:
        return TOO_FEW
    if not rejected:
        return HONEST
    from starcal_uq.presentation.words.sentences import say

    return say("Replicates.claim", ratio=row["claimed_classical_over_spread"])
