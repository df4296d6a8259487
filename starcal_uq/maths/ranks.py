"""Are ranks uniform? Exact simultaneous bands for an empirical distribution, the p-value that goes
with them.

The rank of a true value among L independent posterior draws is uniform on 0 .. L when the posterior
is right. With ranks scaled to (0, 1], the empirical distribution of n of them at z_i = i / K is
binomial, n F(z_i) ~ Bin(n, z_i). The band of Saeilynoja, Buerkner & Vehtari (2022, "Graphical test
for discrete uniformity and its applications in goodness of fit evaluation and multiple sample
comparison", Statistics and Computing 32:32) holds the tails of each of these at one common level,
small enough that the whole curve stays inside with the wanted probability. That probability is
computed exactly, by carrying the distribution of the count from z_i to z_(i+1) and dropping what
leaves the band: the increments are independent Poisson numbers, given their sum. The p-value of a
sample is the probability that a uniform one comes as near to a tail anywhere, so that p < 0.05 and
a curve outside the 95 % band are one statement.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray

_BISECTIONS = 40
_MAX_POINTS = 128


def evaluation_points(n_values: int) -> int:
    """Number K of points at which the distribution of ranks 0 .. n_values - 1 is compared: at most
    128, and a divisor.

    Only where K divides the number of values is the count of ranks below i / K binomial with
    probability i / K.
    """
    return next(k for k in range(min(_MAX_POINTS, n_values), 0, -1) if n_values % k == 0)


def counts_below(ranks: IntArray, n_values: int) -> IntArray:
    """Number of ranks (n,), of 0 .. K - 1, below i / K for i = 1 .. K - 1; K is one more than the
    number of draws.
    """
    k = evaluation_points(n_values)
    edges = np.arange(1, k) * (n_values // k)
    return np.asarray(np.searchsorted(np.sort(ranks), edges, side="left"), dtype=np.int64)


def uniformity_p_value(ranks: IntArray, n_values: int) -> float:
    """Probability that uniform ranks (n,), of 0 .. n_values - 1, come at least as near to a tail,
    anywhere, as these.

    Exact for independent ranks; NaN without ranks.
    """
    from scipy.stats import binom

    n, counts = len(ranks), counts_below(ranks, n_values)
    if n == 0 or len(counts) == 0:
        return float("nan")
    z = np.arange(1, len(counts) + 1) / (len(counts) + 1)
    tails = np.minimum(binom.cdf(counts, n, z), binom.sf(counts - 1, n, z))
    return max(
        0.0, 1.0 - _probability_inside(*_limits(n, len(counts) + 1, float(np.min(tails))), n)
    )


@lru_cache(maxsize=64)
def uniformity_band(
    n: int, n_values: int, probability: float = 0.95
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Band that holds the whole empirical distribution of n uniform ranks with at least the given
    probability.

    Points z = i / K, and the smallest and largest fraction of ranks below them, (K - 1,) each, for
    ranks of 0 .. K - 1.
    """
    k = evaluation_points(n_values)
    inside, outside = 0.0, 0.5
    # The wider the tails that are cut off, the narrower the band.
    for _ in range(_BISECTIONS):
        tail = 0.5 * (inside + outside)
        if _probability_inside(*_limits(n, k, tail), n) >= probability:
            inside = tail
        else:
            outside = tail
    lower, upper = _limits(n, k, inside)
    return np.arange(1, k) / k, lower / n, upper / n


def _limits(n: int, k: int, tail: float) -> tuple[IntArray, IntArray]:
    """Smallest and largest counts at i / K, i = 1 .. K - 1, whose tail probability exceeds
    `tail`.
    """
    from scipy.stats import binom

    z = np.arange(1, k) / k
    # The factor keeps a count whose own probability is `tail` outside, whatever rounding does.
    lower = binom.ppf(min(tail * (1.0 + 1e-9), 1.0), n, z).astype(np.int64)
    return np.maximum(lower, 0), n - np.maximum(lower[::-1], 0)


def _probability_inside(lower: IntArray, upper: IntArray, n: int) -> float:
    """Probability that the counts of n uniform values stay within [lower, upper] at i / K, i = 1 ..
    K - 1.
    """
    from scipy.stats import poisson

    rate = n / (len(lower) + 1)
    low, mass = 0, np.ones(1)
    for first, last in zip(lower.tolist(), upper.tolist(), strict=True):
        if first > last:
            return 0.0
        moved = np.convolve(mass, poisson.pmf(np.arange(last - low + 1), rate))
        mass, low = moved[first - low : last - low + 1], first
    rest = n - low - np.arange(len(mass))
    return float(mass @ poisson.pmf(rest, rate) / poisson.pmf(n, n))
