"""The only importer of ArviZ: one set of functions over ArviZ 0.23 (`InferenceData`) and 1.x
(`DataTree`).

The containers differ. Numbers come from the array functions of `arviz_stats`, the package behind
1.x, beside 0.23 too: they need NumPy and SciPy alone, while 0.23 loads matplotlib, xarray and all
of its plots, which takes seconds. Its `psislw` takes *negated* log weights, where 0.23's takes log
weights, without complaint when given the wrong ones.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

# Tail ESS is the smaller of the ESS of these two quantiles (Vehtari et al. 2021), stated because
# the default differs.
_TAIL = (0.05, 0.95)
# Log weights closer than this are equal for every purpose, and a Pareto tail cannot be fitted to
# them.
_EQUAL_WEIGHTS = 1e-9


@lru_cache(maxsize=1)
def is_legacy() -> bool:
    """True for ArviZ below 1.0."""
    return int(importlib.metadata.version("arviz").split(".")[0]) < 1


@lru_cache(maxsize=1)
def _legacy() -> Any:
    with warnings.catch_warnings():
        # 0.23 announces 1.x once a day; nothing that a user of this package could act on.
        warnings.filterwarnings(
            "ignore", message=r"\s*ArviZ is undergoing a major refactor", category=FutureWarning
        )
        return importlib.import_module("arviz")


@lru_cache(maxsize=1)
def _array_stats() -> Any:
    return importlib.import_module("arviz_stats.base").array_stats


def _diagnostic(name: str, values: FloatArray, **options: Any) -> float:
    return float(getattr(_array_stats(), name)(values, **options))


def to_arviz(groups: Mapping[str, xr.Dataset]) -> Any:
    """Wrap datasets (chain, draw), by their names in ArviZ's schema, in the container of the
    installed ArviZ.
    """
    if is_legacy():
        return _legacy().InferenceData(**groups)
    import xarray as xr

    return xr.DataTree.from_dict(dict(groups))


def rhat(values: FloatArray) -> float:
    """Rank-normalised split R-hat of draws (chain, draw)."""
    return _diagnostic("rhat", values)


def ess_bulk(values: FloatArray) -> float:
    """Bulk effective sample size of draws (chain, draw)."""
    return _diagnostic("ess", values, method="bulk")


def ess_tail(values: FloatArray) -> float:
    """Tail effective sample size (5 % and 95 % quantiles) of draws (chain, draw)."""
    return _diagnostic("ess", values, method="tail", prob=_TAIL)


def mcse_mean(values: FloatArray) -> float:
    """Monte Carlo standard error of the mean of draws (chain, draw)."""
    return _diagnostic("mcse", values, method="mean")


def power_sensitivity(
    values: FloatArray, weights: Sequence[FloatArray], powers: tuple[float, float]
) -> float:
    """How fast draws (n,) move per doubling of a power at 1: the cumulative Jensen-Shannon distance
    to the draws with weights (n,) at a power below, and at one above.
    """
    rows = (np.atleast_2d(row) for row in (values, *weights))
    return float(_array_stats().power_scale_sense(*rows, *powers))


def psis(log_weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pareto-smoothed importance sampling (Vehtari et al. 2024) of rows of the log of target over
    proposal (..., n).

    Returns the smoothed logarithms, normalised so that the weights of a row sum to one, and the
    shape of the fitted Pareto tail (...), below 0.7 of which the weights can be trusted: 0 where
    the largest weights are all equal, which leaves no tail to fit.
    """
    values = np.array(log_weights, dtype=float)
    n = values.shape[-1]
    n_tail = max(5, int(min(n / 5, 3 * np.sqrt(n))))
    largest = np.sort(values, axis=-1)[..., -n_tail:]
    flat = largest[..., -1] - largest[..., 0] < _EQUAL_WEIGHTS
    khat = np.zeros(values.shape[:-1])
    top = largest[..., -1:]
    smoothed = values - top - np.log(np.sum(np.exp(values - top), axis=-1, keepdims=True))
    if not np.all(flat):
        # Trial shapes of the tail fit that are out of the question get the weight exp(-large), by
        # way of 1 / inf.
        with np.errstate(over="ignore"):
            smoothed[~flat], khat[~flat] = _array_stats().psislw(-values[~flat])
    return smoothed, khat
