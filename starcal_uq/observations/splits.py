"""Parts of one set of frames: two halves, or a sample; and how many frames two tables share."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

import numpy as np

from starcal_uq.core.errors import ComparisonError, check_known
from starcal_uq.core.settings import Seed, Split, bounded, seed_of
from starcal_uq.core.types import IntArray

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

SPLITS = get_args(Split)
_LABELS = {
    "odd-even": ("odd frames", "even frames"),
    "halves": ("first half", "second half"),
    "random": ("random half", "the other frames"),
}


@bounded
def split_frames(
    obs: Observations, how: str = "odd-even", *, seed: Seed = 0
) -> tuple[Observations, Observations]:
    """Two tables that share no frame and together are the whole.

    Parameters
    ----------
    obs : Observations
        At least two frames.
    how : {"odd-even", "halves", "random"}
        Every other frame in their order (the first, third... are the odd ones, whatever their
        numbers); the first and the second half; or a random half.
    seed : int or Generator
        Seed of the random half.

    Raises
    ------
    ComparisonError
        For another `how`, or fewer than two frames.
    """
    seed = seed_of(seed)
    labels = split_labels(how)
    if obs.n_frames < 2:
        raise ComparisonError(
            f"observations: {obs.n_frames} frame cannot be split in two; give at least two frames."
        )
    place = np.arange(obs.n_frames)
    if how == "odd-even":
        first = place % 2 == 0
    elif how == "halves":
        first = place < (obs.n_frames + 1) // 2
    else:
        first = np.random.default_rng(seed).permutation(obs.n_frames) < (obs.n_frames + 1) // 2
    parts = [obs.select_frames(obs.frame_ids[mask]) for mask in (first, ~first)]
    return parts[0].with_meta(split=labels[0]), parts[1].with_meta(split=labels[1])


def one_of_each(n: int, limit: int, seed: int = 0) -> IntArray:
    """Places of at most `limit` out of n in ascending order: one at random of each of `limit` equal
    stretches.

    A stratified sample: it follows whatever changes along a run, and meets no pattern of its own.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.asarray(edges[:-1] + np.random.default_rng((seed, 23)).integers(np.diff(edges)))


def frame_sample(obs: Observations, limit: int, seed: int = 0) -> tuple[Observations, IntArray]:
    """At most `limit` frames as a table, all if there are no more, and their places among the
    frames.
    """
    chosen = one_of_each(obs.n_frames, limit, seed)
    return (
        obs if len(chosen) == obs.n_frames else obs.select_frames(obs.frame_ids[chosen])
    ), chosen


def split_labels(how: str) -> tuple[str, str]:
    """What the two halves are called."""
    check_known("split", how, SPLITS, ComparisonError)
    return _LABELS[how]


def shared_frames(a: Observations, b: Observations) -> int:
    """Number of frames of `a` that `b` holds as well, whatever their numbers: the same pixels and
    directions.
    """
    theirs = set(_frames(b))
    return sum(frame in theirs for frame in _frames(a))


def _frames(obs: Observations) -> list[bytes]:
    """Every frame as bytes of its rows, sorted."""
    rows = np.column_stack([obs.x_px, obs.y_px, obs.ra_deg, obs.dec_deg]) + 0.0
    starts = obs.frame_starts
    parts = (rows[starts[k] : starts[k + 1]] for k in range(obs.n_frames))
    return [part[np.lexsort(part.T)].tobytes() for part in parts]
