"""Poisson numbers of one mean for a whole detector, ten times as fast as NumPy's and as exact."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray

# The unit interval is cut into this many buckets. Nearly all of them lie within one step of the distribution function,
# so that 16 random bits decide; in the others a further uniform number does.
_BUCKETS = 1 << 16
# Beyond, the steps become as narrow as the buckets, and NumPy's own method takes over.
_MAX_MEAN = 1000.0


@lru_cache(maxsize=8)
def _table(mean: float) -> tuple[FloatArray, np.ndarray[Any, Any]]:
    """Distribution function of 0, 1, ..., and the value of each bucket (-1: undecided)."""
    from scipy.special import gammaln

    k = np.arange(int(mean + 12.0 * np.sqrt(mean)) + 40)
    cumulative = np.cumsum(np.exp(k * np.log(mean) - mean - gammaln(k + 1.0)))
    cumulative /= cumulative[-1]
    edges = np.arange(_BUCKETS + 1) / _BUCKETS
    low = np.searchsorted(cumulative, edges[:-1], side="right")
    high = np.searchsorted(cumulative, edges[1:], side="left")
    return cumulative, np.where(low == high, low, -1).astype(np.float32)


def uniform_shot_noise(mean: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """Independent Poisson numbers.

    Parameters
    ----------
    mean : float
        Their mean, 0 or more.
    shape : tuple of int
        Size of the detector.
    rng : numpy.random.Generator
        Source of the randomness.

    Returns
    -------
    array of float32
        Whole numbers; single precision holds them exactly up to 16 million.
    """
    if mean == 0.0:
        return np.zeros(shape, dtype=np.float32)
    if mean > _MAX_MEAN:
        return rng.poisson(mean, shape).astype(np.float32)
    cumulative, values = _table(mean)
    bucket = rng.integers(0, _BUCKETS, shape, dtype=np.uint16).reshape(-1)
    drawn: np.ndarray[Any, Any] = values[bucket]
    undecided = np.flatnonzero(drawn < 0.0)
    u = (bucket[undecided] + rng.random(len(undecided))) / _BUCKETS
    drawn[undecided] = np.searchsorted(cumulative, u, side="right")
    return drawn.reshape(shape)
