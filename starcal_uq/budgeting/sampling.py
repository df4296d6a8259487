"""Rows of a budget by sampling: their errors, added up by kind of randomness, and quantiles of the
sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starcal_uq.budgeting.rows import (
    AFTER_AT_LEAST,
    GAUSSIAN_997,
    INTERPRETATIONS,
    SCOPES,
    Contributor,
)
from starcal_uq.budgeting.shapes import deviates
from starcal_uq.core.constants import AXES
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.linear import principal

N_SAMPLES = 200_000
# Two standard errors of a quantile, as order statistics.
_SPREAD = 2.0
# Samples beyond a quantile with fewer say little about it: its standard error is unknown, or the
# samples end before it.
_RESOLVED = 20.0
# A bound that is surely below a quantile: of every so manyth sample, at a share so much smaller.
_EVERY, _BELOW = 20, 0.01
# Cases on either side of a quantile that stand for it where they point in different directions.
_NEIGHBOURS = 4


@dataclass(frozen=True, eq=False)
class Samples:
    """Sums of sampled rows per scope and kind of randomness, arcsec: ``sums[scope,
    interpretation]`` is (3, n).
    """

    sums: dict[tuple[str, str], FloatArray]

    def along(self, axes: FloatArray, scope: str, kinds: Sequence[str]) -> FloatArray:
        """What rows of these kinds add up to along axes (k, 3): (k, n), or (k, 1) zeros without
        kinds.
        """
        return axes @ sum((self.sums[scope, kind] for kind in kinds), start=np.zeros((3, 1)))


def draw(rows: Sequence[Contributor], n_samples: int = N_SAMPLES, seed: int = 0) -> Samples:
    """Sample every assessed row around its mean and add up what has the same kind of randomness.

    Rows of one correlation group share their probabilities, and axes of one contributor are
    correlated as it states. A sigma that changes from frame to frame is the same for all axes of a
    contributor.
    """
    from scipy.special import ndtr

    scopes = (
        (*SCOPES, AFTER_AT_LEAST)
        if any(row.absorbed_by_alignment == "in part" for row in rows)
        else SCOPES
    )
    sums = {(scope, kind): np.zeros((3, n_samples)) for scope in scopes for kind in INTERPRETATIONS}
    shared: dict[str, FloatArray] = {}
    scales: dict[str, FloatArray] = {}
    joint = {
        name: _joint(rows, name, n_samples, seed)
        for name in {row.name for row in rows if row.axis_correlation}
    }
    for index, row in enumerate(rows):
        if not (row.assessed and row.applies and row.sigma_arcsec > 0.0):
            continue
        group, sign = row.group
        if group and group in shared:
            uniform = shared[group]
        elif row.axis_correlation:
            uniform = ndtr(joint[row.name][AXES.index(row.axis)])
        else:
            uniform = np.random.default_rng((seed, 1, index)).random(n_samples)
        if group:
            shared[group] = uniform
        if row.tail_997 > GAUSSIAN_997 and row.name not in scales:
            scales[row.name] = np.random.default_rng((seed, 2, index)).standard_normal(n_samples)
        log_scale = scales.get(row.name, uniform)
        errors = (
            sign * row.sigma_arcsec * deviates(row.distribution, uniform, log_scale, row.tail_997)
        )
        for scope in scopes:
            if row.counts(scope):
                sums[scope, row.interpretation][AXES.index(row.axis)] += errors
    return Samples(sums)


def _joint(rows: Sequence[Contributor], name: str, n_samples: int, seed: int) -> FloatArray:
    """Standard normal deviates (3, n) with the correlations of a contributor's axes."""
    own = {row.axis: row for row in rows if row.name == name and row.axis_correlation}
    matrix = np.eye(3)
    for axis, row in own.items():
        matrix[AXES.index(axis)] = row.axis_correlation
    # The symmetric root: unlike eigenvectors, it has no sign or order that rounding decides.
    values, vectors = principal(matrix, 0.0)
    index = next(place for place, row in enumerate(rows) if row.name == name)
    plain = np.random.default_rng((seed, 1, index)).standard_normal((n_samples, 3))
    return (vectors * np.sqrt(values)) @ vectors.T @ plain.T


def one_of_many(rest: FloatArray, chance: FloatArray, confidence: float) -> float:
    """What chance reaches at the confidence where the rest is as large as it is in one case of 1 /
    (1 - confidence).
    """
    size = size_of(rest)
    at = math.ceil(confidence * len(size)) - 1
    near = (
        range(max(at - _NEIGHBOURS, 0), min(at + _NEIGHBOURS + 1, len(size)))
        if len(rest) > 1
        else (at,)
    )
    order = np.argpartition(size, list(near))
    return float(
        np.mean([quantile(rest[:, order[place], None] + chance, confidence)[0] for place in near])
    )


def size_of(errors: FloatArray) -> FloatArray:
    """Size (n,) of errors (axes, n)."""
    size: FloatArray = (
        np.abs(errors[0])
        if len(errors) == 1
        else np.sqrt(np.square(errors[0]) + np.square(errors[1]))
    )
    return size


def quantile(errors: FloatArray, confidence: float) -> tuple[float, float]:
    """Quantile of the size of errors (axes, n), and its standard error; NaN if unresolved."""
    size = size_of(errors)
    n = len(size)
    if size.min() == size.max():
        return float(size[0]), 0.0
    if n * min(confidence, 1.0 - confidence) < _RESOLVED * (1.0 - 1e-9):
        return math.nan, math.nan
    step = _SPREAD * math.sqrt(n * confidence * (1.0 - confidence))
    places = [
        min(max(math.ceil(confidence * n + shift) - 1, 0), n - 1) for shift in (-step, 0.0, step)
    ]
    low, here, high = _ranked(size, places)
    return here, (high - low) / (2.0 * _SPREAD)


def _ranked(values: FloatArray, places: Sequence[int]) -> list[float]:
    """The values at these places of their order; what is surely below the first place is not put
    into order.
    """
    some = values[::_EVERY]
    first = int((places[0] / len(values) - _BELOW) * len(some))
    if first > 0:
        upper = values[values >= np.partition(some, first)[first]]
        if len(values) - len(upper) <= places[0]:
            places = [place - len(values) + len(upper) for place in places]
            values = upper
    ranked: list[float] = np.partition(values, places)[places].tolist()
    return ranked
