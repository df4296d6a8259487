"""Are all frames of one camera? Each frame's own focal length, and whether these fall into groups.

A frame tells its focal length by itself, through the angles between its stars. Frames of one camera
scatter around one value, by noise and by what the model leaves over; those of two, around two. The
split of the sorted values that leaves the least scatter within is compared with that of as many
values of one camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.planes import PINHOLE, Plane
from starcal_uq.core.findings import clause
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.estimation.consensus import focal_lengths, ideal_frames
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.splits import one_of_each

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations

# False alarms of frames of one camera.
GROUPS_P = 1e-3
# Relative difference that thermal drift and poor frames do not reach.
_LEAST_APART, _SIGMAS_APART = 3e-3, 6.0
_LEAST_FRAMES, _LEAST_STARS, _FRAMES, _DRAWS, _STEPS = 4, 4, 300, 4000, 6
# Groups that are looked for together; each may fall into more.
_MOST_AT_ONCE = 4
# What the frames say of cameras.
Mixed = Enum("Mixed", "CAMERAS")
# Of the sample of frames, and of the draws that a split is compared with.
_SEED = 0


@dataclass(frozen=True)
class FrameFocals:
    """Focal length of each frame by itself."""

    frame_ids: IntArray  # (K,): frames with at least four stars; of more than 300, a sample
    # `focal_px`, `sigma_px`, (K,): estimate at the given distortion, and its standard error from
    # the scatter of the frame's stars, px.
    focal_px: FloatArray
    sigma_px: FloatArray
    # (K,): number of the group that a frame is of, from 0, by focal length; all 0 where there is
    # one camera.
    group: IntArray
    p_value: float  # Probability that frames of one camera fall apart so

    @property
    def n_groups(self) -> int:
        """Number of cameras that the frames ask for."""
        return int(self.group.max()) + 1 if len(self.group) else 0

    @property
    def largest(self) -> str:
        """Frames of the largest group, as ``--only-frames`` takes them."""
        return frame_ranges(self.frame_ids[self.group == np.bincount(self.group).argmax()])

    def words(self, camera: Camera) -> str:
        """Each group's focal length and frames, in one clause, with the option that selects a
        group.
        """
        groups = []
        for number in range(self.n_groups):
            mine = self.group == number
            focal = camera.length_text(float(np.median(self.focal_px[mine])), 4)
            ids = self.frame_ids[mine]
            groups.append((focal, len(ids), frame_ranges(ids)))
        return clause(Mixed.CAMERAS, groups=groups, largest=self.largest)


@dataclass(frozen=True)
class MixedCameras:
    """Frames that ask for several cameras."""

    n: int  # Number of cameras
    words: str  # What is known of them, in one clause
    frames: str  # Frames of the largest group, as ``--only-frames`` takes them

    @classmethod
    def of(cls, obs: Observations, camera: Camera) -> MixedCameras | None:
        """Several cameras, where the frames of a calibration with this camera ask for them."""
        found = frame_focals(obs, camera)
        if found.n_groups < 2:
            return None
        return cls(found.n_groups, found.words(camera), found.largest)


def frame_ranges(frames: IntArray) -> str:
    """Frame numbers as ``--only-frames`` takes them, such as 0-4,7."""
    ends = np.flatnonzero(np.diff(frames) != 1)
    first, last = frames[np.concatenate([[0], ends + 1])], frames[np.append(ends, len(frames) - 1)]
    return ",".join(
        str(a) if a == b else f"{a}-{b}" for a, b in zip(first.tolist(), last.tolist(), strict=True)
    )


def frame_focals(obs: Observations, camera: Camera) -> FrameFocals:
    """Estimate the focal length of every frame by itself, and look for groups among them.

    `camera`: principal point and distortion, and the focal length to start from.
    """
    numbers, frames = frames_with_focals(obs)
    plane = get_model(camera.distortion).plane
    return focals_of(numbers, ideal_frames(camera, frames), camera.focal_px, plane)


def frames_with_focals(obs: Observations) -> tuple[IntArray, StarFrames]:
    """Numbers (K,) and stars of the frames that have enough of them; of many frames, a sample."""
    enough = np.flatnonzero(obs.stars_per_frame >= _LEAST_STARS)
    chosen = np.zeros(obs.n_frames, dtype=bool)
    chosen[enough[one_of_each(len(enough), _FRAMES, _SEED)]] = True
    frames = StarFrames.from_observations(obs)
    return obs.frame_ids[chosen], frames.select(np.repeat(chosen, frames.sizes))


def focals_of(
    numbers: IntArray, ideal: StarFrames, start_px: float, plane: Plane = PINHOLE
) -> FrameFocals:
    """The same of frames with these numbers (K,) by their ideal points, from a focal length in
    px.
    """
    none = FrameFocals(
        np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64), 1.0
    )
    if not len(numbers):
        return none
    theta = np.array([0.0, 0.0, start_px])
    log_scale = np.log(start_px / focal_lengths(ideal, start_px, plane, by_frame=True))
    for _ in range(_STEPS):
        pixel = np.ascontiguousarray(ideal.pixel * ideal.spread(np.exp(log_scale)))
        likelihood = MarginalLikelihood(replace(ideal, pixel=pixel), plane.bare)
        state, cost = likelihood.profile(theta)
        if not np.isfinite(cost):
            return none
        # A focal length that is longer by one per cent is a pattern that is larger by as much.
        slope = likelihood.slopes(state)[2] * start_px
        curvature = ideal.sum(np.sum(slope**2, axis=0))
        step = ideal.sum(np.sum(slope * state.e, axis=0)) / curvature
        log_scale -= np.clip(step, -0.2, 0.2)
    left = ideal.sum(np.sum(state.e**2, axis=0))
    sigma = np.sqrt(left / np.maximum(2 * ideal.sizes - 4, 1) / curvature)
    group, p_value = _grouped(-log_scale, sigma)
    focal = start_px * np.exp(-log_scale)
    return FrameFocals(numbers, focal, sigma * focal, group, p_value)


def _grouped(value: FloatArray, sigma: FloatArray) -> tuple[IntArray, float]:
    """Groups of values (K,), numbered upwards, and the probability of the first split."""
    group = np.zeros(len(value), dtype=np.int64)
    rng = np.random.default_rng(_SEED)
    order = np.argsort(value)
    first, todo, done = 1.0, [order], 0
    while todo:
        rows = todo.pop(0)
        parts, p_value = _split(value[rows], sigma[rows], rng)
        first = p_value if len(rows) == len(order) else first
        if len(parts) > 1:
            todo = [rows[part] for part in parts] + todo
            continue
        group[rows] = done
        done += 1
    return group, first


def _split(
    value: FloatArray, sigma: FloatArray, rng: np.random.Generator
) -> tuple[list[slice], float]:
    """Groups of sorted values, one where they are no more, and the probability of so clear ones
    among one camera's.
    """
    n, whole = len(value), [slice(0, len(value))]
    if n < _LEAST_FRAMES:
        return whole, 1.0
    smallest = 1.0
    for number in range(2, min(_MOST_AT_ONCE, n - 2) + 1):
        # What frames scatter by beyond their own noise is the same for all of them.
        cuts, _ = _cut(value[None], np.ones(n), number)
        common = max(_within(value, cuts[0]) - float(np.median(sigma) ** 2), 0.0)
        weight = 1.0 / (np.maximum(sigma, 1e-12) ** 2 + common)
        cuts, ratio = _cut(value[None], weight, number)
        null = np.sort(rng.standard_normal((_DRAWS, n)) / np.sqrt(weight), axis=1)
        as_clear = np.count_nonzero(_cut(null, np.ones(n), number)[1] >= ratio[0])
        p_value = (1.0 + float(as_clear)) / (_DRAWS + 1.0) * (_MOST_AT_ONCE - 1.0)
        smallest = min(smallest, p_value)
        edges = [0, *cuts[0].tolist(), n]
        parts = [slice(low, high) for low, high in pairwise(edges)]
        apart = np.diff([np.median(value[part]) for part in parts])
        if p_value < GROUPS_P and np.min(apart) > max(
            _LEAST_APART, _SIGMAS_APART / np.sqrt(np.median(weight))
        ):
            return parts, smallest
    return whole, smallest


def _within(value: FloatArray, cuts: IntArray) -> float:
    """Mean square of sorted values around the medians of their groups."""
    return float(
        np.mean(np.concatenate([part - np.median(part) for part in np.split(value, cuts)]) ** 2)
    )


def _cut(value: FloatArray, weight: FloatArray, number: int) -> tuple[IntArray, FloatArray]:
    """Where rows of sorted values (d, n) fall into groups, (d, number - 1), and scatter between
    over within, (d,).

    Two groups are those with the least scatter within, more are cut at the widest gaps.
    """
    mass = np.concatenate([[0.0], np.cumsum(weight)])
    running = np.concatenate([np.zeros((len(value), 1)), np.cumsum(value * weight, axis=1)], axis=1)
    middle = running[:, -1:] / mass[-1]
    if number == 2:
        part = mass[1:-1]
        cuts = (
            1
            + np.argmax(
                (running[:, 1:-1] - part * middle) ** 2 / (part * (mass[-1] - part)), axis=1
            )[:, None]
        )
    else:
        cuts = (
            np.sort(
                np.argpartition(-np.diff(value, axis=1), number - 2, axis=1)[:, : number - 1],
                axis=1,
            )
            + 1
        )
    edges = np.concatenate(
        [np.zeros((len(value), 1), dtype=int), cuts, np.full((len(value), 1), value.shape[1])],
        axis=1,
    )
    sums = np.diff(np.take_along_axis(running, edges, axis=1), axis=1)
    between = np.sum(sums**2 / np.diff(mass[edges], axis=1), axis=1) - middle[:, 0] ** 2 * mass[-1]
    within = np.sum(weight * (value - middle) ** 2, axis=1) - between
    return cuts, between / np.maximum(within, 1e-300)
