"""Replicates of all methods, in which slow ones take part in fewer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.methods import METHODS, Method
from starcal_uq.paper.replicates import replicate
from starcal_uq.paper.replicates_result import Replicates

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.tasks import Progress

# One in so many replicates for options of a method, which are there to show what they claim.
SHARE = 4
_LEAST = 8


def is_slow(method: Method) -> bool:
    """Whether a method takes part in one of `SHARE` replicates only: the filter that forms every pair."""
    return method.recursion is not None and method.recursion.pair_covariance == "diagonal"


def replicate_shared(
    truth: Camera,
    start: Camera,
    *,
    n_replicates: int,
    n_frames: int,
    seed: int,
    workers: int | None,
    progress: Progress | None,
    methods: Sequence[Method] = METHODS,
) -> Replicates:
    """As `replicate`, but with slow methods in the first replicates only; the others hold NaN for them.

    Raises
    ------
    SamplingError
        If processes cannot be used.
    CalibrationError
        When a method never gave a result.
    """
    fast, slow = (tuple(m for m in methods if is_slow(m) is kind) for kind in (False, True))
    options: AnyDict = {"truth": truth, "start": start, "n_frames": n_frames, "seed": seed, "workers": workers}
    n_few = min(n_replicates, max(_LEAST, n_replicates // SHARE)) if slow else 0
    total = n_replicates + n_few

    def part(before: int) -> Progress | None:
        return None if progress is None else lambda done, _: progress(before + done, total)

    most = replicate(methods=fast, n_replicates=n_replicates, progress=part(0), **options)
    if not slow or most.interrupted:
        return most
    few = replicate(methods=slow, n_replicates=n_few, progress=part(n_replicates), **options)
    return joined(most, few, methods)


def joined(most: Replicates, few: Replicates, methods: Sequence[Method]) -> Replicates:
    """Two sets of replicates with different methods as one.

    Parameters
    ----------
    most, few : Replicates
        Of the same seed, truth and start; the replicates of `few` are the first ones of `most`, with the same data.
    methods : sequence of Method
        Those of both, in the order of the result.

    Raises
    ------
    ValueError
        When the replicates of `few` are not the first ones of `most`.
    """
    n, k = most.n_replicates, few.n_replicates
    if not np.array_equal(most.replicate[:k], few.replicate) or not np.allclose(most.crlb[:k], few.crlb):
        raise ValueError("the replicates to join are not of the same data: give both the same seed and settings.")

    def one(name: str, method: Method) -> FloatArray:
        if method in most.methods:
            return np.asarray(getattr(most, name)[most.methods.index(method)])
        values = getattr(few, name)[few.methods.index(method)]
        padding = np.full((n - k, *values.shape[1:]), np.nan)
        return np.concatenate([values, padding])

    arrays = ("estimates", "claimed", "classical", "map_px", "map_arcsec", "reprojection_px")
    none = ("",) * (n - k)
    failures = tuple(
        most.failures[most.methods.index(m)] if m in most.methods else (*few.failures[few.methods.index(m)], *none)
        for m in methods
    )
    changes: AnyDict = {name: np.stack([one(name, method) for method in methods]) for name in arrays}
    interrupted = most.interrupted or few.interrupted
    return dataclasses.replace(most, methods=tuple(methods), failures=failures, interrupted=interrupted, **changes)
