"""Fingerprints of frames, and which frames hold the same measurement twice.

Two exposures of one sky have noise of their own: their positions differ by sqrt(2) sigma, even if
the camera stood still. An image that is measured again, by other software or with stars more or
fewer, keeps its noise. So a frame leaves its few most central stars, as positions with the size of
their errors, and two frames are one measurement where the positions differ by much less than the
errors would have them.

With u = (e_k - e_l) / sqrt(2) and v = (e_k + e_l) / sqrt(2) independent for independent errors e of
equal size, the share |u|^2 / (|u|^2 + |v|^2) = r / 2 has a beta distribution with half the degrees
of freedom on either side, whatever the noise is. r is 1 on average for two exposures, and eta^2 / 2
for positions that were measured again to within eta sigma.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from math import comb
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.polynomial.polynomial import polyvander2d
from numpy.typing import NDArray

from starcal_uq.core.types import BoolArray, FloatArray, IntArray, floats

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Stars of a frame that are kept, and of those the ones by whose triangles frames are looked up.
_MARKS, _CORNERS = 12, 5
_TRIANGLES = comb(_CORNERS, 3)
# Positions of one image by two programs may be off by another origin, px; stars are paired over
# twice that.
_SHIFT = 1.5
# Sides of triangles that look alike differ by less, in sigmas, and their places, px; of so many
# nearest triangles the frames are compared, so that a stare of many frames takes no longer.
REACH_SIGMAS, REACH_PX, _NEAREST = 8.0, 10.0 * _SHIFT, 12
# Largest r of one measurement: positions within 0.3 sigma, errors correlated by more than 0.95.
_SAME = 0.05
# From this factor on, residuals hold more than the noise that centroids state, and would make
# exposures look the same.
_INFLATED = 3.0
# Below it, no error that a star or a pixel repeats from exposure to exposure is so much larger than
# the noise.
_COPY = 0.002
# Probability that a table without repeated frames is said to have any.
_FALSE_ALARM = 1e-6
# From so many other frames of one pointing on, they tell how much error exposures share.
_STARE = 5
# Cells in which others of a triangle's likeness are looked up: their size, half the reach and a
# little, and what a step along each axis adds to the number of a cell.
_CELL, _HALF, _STEPS = 8.0, 0.5001, (1, 4099, 16801801, 68870582299)
# Pairs that are compared at once, and stars whose polynomial stays in the processor's cache.
_PART, _BLOCK = 20_000, 4096
# Terms of a smooth misfit up to the fifth degree, with so many stars for each, from about so many
# stars.
_DEGREE, _STARS_PER_TERM, _MOST_STARS = 5, 20, 3_000
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, eq=False)
class Fingerprints:
    """Fingerprints of the frames of a calibration: at most 12 stars each, 12 bytes a star.

    Attributes
    ----------
    sizes : (K,) array of int
        Stars in each frame; the min(12, size) nearest to the detector's centre are kept, frame by
        frame.
    xy_px : (M, 2) array of float32
        Their positions, px.
    error_px : (M,) array of float32
        Length of their residuals, px, without the part that varies smoothly over the detector, and
        brought to the noise by the degrees of freedom that the attitude takes.
    """

    sizes: IntArray
    xy_px: NDArray[np.float32]
    error_px: NDArray[np.float32]

    SHAPES: ClassVar = """
        k: sizes
        m 2: xy_px
        m: error_px
    """

    @classmethod
    def of(
        cls,
        obs: Observations,
        residuals_px: FloatArray,
        centre_px: tuple[float, float],
        frames: IntArray | slice = slice(None),
    ) -> Fingerprints:
        """Take those of a table with its residuals (N, 2), of all frames or of those at some
        places.
        """
        xy, sizes = obs.xy, obs.stars_per_frame[frames]
        first = np.cumsum(sizes) - sizes
        rows = np.repeat(obs.frame_starts[:-1][frames] - first, sizes) + np.arange(np.sum(sizes))
        rows = rows[_most_central(np.linalg.norm(xy[rows] - centre_px, axis=1), first, sizes)]
        frame = np.repeat(np.arange(len(sizes)), np.minimum(sizes, _MARKS))
        error = np.linalg.norm(_unsmooth(xy, residuals_px, rows), axis=1)
        error /= np.sqrt(1.0 - 1.5 / np.maximum(sizes, 2))[frame]
        stated = stated_noise(obs)
        if stated is not None:
            error /= _inflation(error / stated[rows], frame)
        return cls(sizes.astype(np.int64), xy[rows].astype(np.float32), error.astype(np.float32))

    @classmethod
    def joined(cls, parts: Sequence[Fingerprints]) -> Fingerprints:
        """Fingerprints of several runs, one after the other."""
        return cls(
            *(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls))
        )

    def equal(self, other: Fingerprints, pairs: IntArray) -> bool:
        """True if all pairs (n, 2) of frames, of `self` and `other`, have their stars at the same
        pixels.
        """
        mine, theirs = self.padded(self.xy_px), other.padded(other.xy_px)
        return np.array_equal(mine[pairs[:, 0]], theirs[pairs[:, 1]], equal_nan=True)

    def padded(self, values: NDArray[np.float32]) -> FloatArray:
        """Values (M, ...) of the stars as (K, 12, ...), NaN where a frame has fewer."""
        there = np.arange(_MARKS) < self.sizes[:, None]
        found = np.full((*there.shape, *values.shape[1:]), np.nan)
        found[there] = values
        return found


def stated_noise(obs: Observations) -> FloatArray | None:
    """Noise (N,) that the stars state, px per axis, without the floor that was found for all of
    them.
    """
    if obs.sigma_px is None:
        return None
    floor, scale = obs.origin.noise_floor_px or 0.0, obs.origin.noise_scale or 1.0
    variance = (obs.sigma_px / min(scale, 1.0)) ** 2 - (floor / scale) ** 2
    return np.asarray(np.sqrt(np.maximum(variance, 1e-4 * obs.sigma_px**2)))


def _inflation(ratio: FloatArray, frame: IntArray) -> FloatArray:
    """Factor (M,) by which the residuals of a star's frame exceed the noise that their centroids
    state; 1 where it is small.

    What a wrong camera among others or a poor model adds is common to exposures of one field, and
    is no noise. The mean logarithm of half a chi-square with two degrees of freedom is minus
    Euler's constant, and a few wrong stars hardly move it.
    """
    logs = np.bincount(frame, np.log(np.maximum(0.5 * ratio**2, _TINY)))
    factor = np.exp(0.5 * (logs / np.maximum(np.bincount(frame), 1) + np.euler_gamma))
    return np.where(factor > _INFLATED, factor, 1.0)[frame]


def _most_central(distance: FloatArray, starts: IntArray, sizes: IntArray) -> IntArray:
    """Rows of at most 12 stars of each frame, nearest first, frame by frame."""
    # One number, of the frame and a fraction for the distance, sorts in a tenth of the time of two.
    part = distance / (2.0 * np.max(distance, initial=_TINY))
    order = np.argsort(np.repeat(np.arange(len(sizes)), sizes) + part, kind="stable")
    return order[np.arange(len(order)) - np.repeat(starts, sizes) < _MARKS]


def _unsmooth(xy: FloatArray, residuals: FloatArray, rows: IntArray) -> FloatArray:
    """Residuals (n, 2) of some rows without a polynomial over the detector, from xy (N, 2) and
    residuals (N, 2).

    What a model cannot follow is no noise.
    """
    some = slice(None, None, max(1, len(xy) // _MOST_STARS))
    square = np.sum(residuals[some] ** 2, axis=1)
    # A few wrong stars would bend the polynomial for all others.
    used = square <= 25.0 * np.median(square)
    middle = xy[some].mean(axis=0)
    unit = np.abs(xy[some] - middle).max() or 1.0
    # The highest degree whose terms, (d + 1) (d + 2) / 2, have their stars.
    most = (np.sqrt(1.0 + 8.0 * len(xy) / _STARS_PER_TERM) - 3.0) // 2.0
    degree = int(np.clip(most, 0, _DEGREE))
    terms = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)) <= degree
    x, y = ((xy[some][used] - middle) / unit).T
    table = polyvander2d(x, y, [degree, degree])[:, terms.ravel()]
    solution = np.linalg.lstsq(table, residuals[some][used], rcond=None)[0]
    left = residuals[rows]
    for start in range(0, len(rows), _BLOCK):
        part = slice(start, start + _BLOCK)
        x, y = ((xy[rows[part]] - middle) / unit).T
        left[part] -= polyvander2d(x, y, [degree, degree])[:, terms.ravel()] @ solution
    return left


def shared(a: Fingerprints, b: Fingerprints) -> IntArray:
    """Places (n, 2) of frames of `a` that `b` repeats, and of those in `b`."""
    n = len(a.sizes)
    group = np.repeat([0, 1], [n, len(b.sizes)])
    return repeats(Fingerprints.joined([a, b]), group) - np.array([0, n], dtype=np.int64)


def alike(rotations: FloatArray, reach_rad: float) -> IntArray:
    """Places of frames whose attitude R_cam_icrs, of (K, 3, 3), may be within a reach of that of
    another.
    """
    # The boresight, and how its roll turns one axis, tell most attitudes apart.
    entries = rotations.reshape(-1, 9)[:, [2, 6, 7, 8]] / reach_rad
    place = np.flatnonzero(_crowded(entries.T))
    if not len(place):
        return place
    from scipy.spatial import cKDTree

    points = entries[place]
    near = cKDTree(points).query(points, 2, p=np.inf, distance_upper_bound=1.0)[0]
    return np.asarray(place[np.isfinite(near[:, 1])])


def repeats(
    marks: Fingerprints, group: IntArray | None = None, n_frames: int | None = None
) -> IntArray:
    """Places (n, 2), ascending in each row, of frames that are one measurement; with `group`, of
    different groups.

    `n_frames`: frames of the table, where `marks` are those of some that may be repeated.

    A pair counts where r is at most 0.05 and its probability for independent exposures, times the
    frames of the same pointing and the number of all frames, is below 1e-6; or, where pairs are
    less certain one by one, where more of them than chance gives (1e-6) have a probability below 1
    %. Frames of one pointing from five others on tell how much of their error exposures share (the
    stars' own, or the pixels'), and a repeated one then shares more.
    """
    nothing = np.empty((0, 2), dtype=np.int64)
    if np.count_nonzero(marks.sizes >= 3) < 2:
        return nothing
    pairs, partners = _lookalikes(marks)
    matches = _Matches.of(marks, pairs)
    shifts, n = matches.shift, matches.n_compared
    r, _, half = matches.compared(shifts)
    r *= n / (n - 1)
    near = r < 3.0 * _SAME
    if group is not None:
        near &= group[matches.pairs[:, 0]] != group[matches.pairs[:, 1]]
    if not near.any():
        return nothing
    common, common_half = _common(matches.pairs, r, half, len(marks.sizes))
    matches, shifts = matches.subset(near), shifts[near]
    # Another origin of the pixels shifts all of them alike; a camera that moves does not.
    shift = np.median(shifts, axis=0)
    spread = np.median(np.abs(shifts - shift), axis=0)
    steady = len(shifts) >= 3 and np.all(spread < 0.1 * _SHIFT)
    r, p, _ = matches.compared(shift if steady else np.zeros(2))
    pairs, first = matches.pairs, matches.pairs[:, 0]
    # Where a camera stares, what its exposures have in common is not what two measurements of one
    # have.
    crowded = (partners[pairs] >= _STARE).all(axis=1) & (r > _COPY)
    r = np.where(crowded, r / common[first], r)
    p = np.where(crowded, np.maximum(p, _probability(r, common_half[first])), p)
    p = np.minimum(1.0, p * np.maximum(1.0, partners[pairs].max(axis=1)))
    return pairs[_judged(pairs, r, p, partners, n_frames or len(partners))]


def _judged(
    pairs: IntArray, r: FloatArray, p: FloatArray, partners: IntArray, n_frames: int
) -> BoolArray:
    """Which pairs (P, 2) with these r and probabilities are one measurement."""
    from scipy.special import bdtrc

    same: BoolArray = (r < _SAME) & (p * n_frames < _FALSE_ALARM)
    possible = max(int(np.count_nonzero(partners)) // 2, 1)
    unlikely = pairs[(r < _SAME) & (p < 0.01)]
    # Every frame counts once, or exposures that happen to be near many would.
    apart = min(np.unique(unlikely[:, 0]).size, np.unique(unlikely[:, 1]).size, possible)
    if apart > 1 and bdtrc(apart - 1, possible, 0.01) < _FALSE_ALARM:
        same |= (r < _SAME) & (p < 0.05)
    # A table that repeats some frames may well repeat others less exactly, and one frame left out
    # harms little.
    return same | (same.any() & (r < 2.0 * _SAME) & (p < 1e-3))


def _lookalikes(marks: Fingerprints) -> tuple[IntArray, IntArray]:
    """Pairs (n, 2) of frames with a triangle of their most central stars in common, and how many
    other frames look the same way as each, (K,).
    """
    from scipy.spatial import cKDTree

    n, points = len(marks.sizes), _triangles(marks)
    # Most have no other near in four of the coordinates; a tree of the rest is small.
    place = np.flatnonzero(np.isfinite(points[:, 5]))
    place = place[_crowded(points[place, 2:].T)]
    points = points[place]
    # The triangle of the first three corners is every frame's first.
    frame, which = np.divmod(place, _TRIANGLES)
    first = which == 0
    tree = cKDTree(points)
    near = tree.query(points, _NEAREST, p=np.inf, distance_upper_bound=1.0)[1]
    row, column = np.nonzero(near < len(frame))
    low, high = np.sort([frame[row], frame[near[row, column]]], axis=0)
    pairs = np.stack(np.divmod(np.unique((low * n + high)[low != high]), n), axis=1)
    partners = np.zeros(n, dtype=np.int64)
    partners[frame[first]] = (
        tree.query_ball_point(points[first], 1.0, p=np.inf, return_length=True) - 1
    )
    return pairs, partners


def _triangles(marks: Fingerprints) -> FloatArray:
    """Triangles (10 K, 6) of the most central stars, frame by frame: a corner and the ways to the
    other two, x and y of each, in units of how far those that look alike may differ.
    """
    # Corners as complex numbers, which are sorted from left to right; NaN comes last.
    x, y = np.moveaxis(marks.padded(marks.xy_px)[:, :_CORNERS], 2, 0)
    corners = np.sort(x + 1j * y, axis=1)
    start, *others = np.transpose(list(combinations(range(_CORNERS), 3)))
    sides = [corners[:, start], *(corners[:, other] - corners[:, start] for other in others)]
    points = np.stack(sides, axis=-1).reshape(-1, 3).view(np.float64)
    # Median length of two normal errors, so that wrong stars do not count.
    reach = REACH_SIGMAS * (float(np.median(marks.error_px)) / 1.1774 + 1e-4)
    points /= np.repeat([REACH_PX, reach, reach], 2)
    return points


def _crowded(points: FloatArray) -> BoolArray:
    """Whether another of points (4, n) may be within one of each along all axes."""
    # Boxes of half that size around two such points overlap in a cell; most boxes lie in one alone.
    n = points.shape[1]
    bits = n.bit_length()
    row, cell = np.arange(n), np.zeros(n, dtype=np.int64)
    for values, step in zip(points, _STEPS, strict=True):
        low, high = (np.floor((values + side) / _CELL) for side in (-_HALF, _HALF))
        cell += step * low.astype(np.int64)[row]
        more = np.flatnonzero((low < high)[row])
        row, cell = np.append(row, row[more]), np.append(cell, cell[more] + step)
    # One number, of a cell and a point, sorts faster than two. Few cells share a number.
    number = np.sort(cell << bits | row)
    same = np.flatnonzero(np.diff(number >> bits) == 0)
    crowded = np.zeros(n, dtype=bool)
    crowded[number[[same, same + 1]] & (1 << bits) - 1] = True
    return crowded


def _common(
    pairs: IntArray, r: FloatArray, half: FloatArray, n_frames: int
) -> tuple[FloatArray, FloatArray]:
    """What r (P,) of pairs is for other exposures of the pointing of each frame, at most 1, and
    half its degrees of freedom.
    """
    import pandas as pd

    common, degrees = np.ones(n_frames), np.full(n_frames, 1.5)
    table = pd.DataFrame({"r": np.tile(r, 2), "half": np.tile(half, 2)})
    by_frame = table.groupby(pairs.T.ravel())
    known = by_frame.median()[by_frame.size() >= _STARE]
    # Trimmed of its largest differences, r is about 2/3 for independent exposures.
    common[known.index] = np.clip(1.5 * known["r"], 1e-12, 1.0)
    degrees[known.index] = known["half"]
    return common, degrees


def _probability(r: FloatArray, half: FloatArray) -> FloatArray:
    """Probability of a smaller r for independent errors, by half the degrees of freedom."""
    from scipy.special import betainc

    return floats(betainc(half, half, np.minimum(0.5 * r, 1.0)))


@dataclass(frozen=True)
class _Matches:
    """Pairs (P, 2) of frames with at least three stars, and half of them, in common.

    `gap` (P, 12, 2) are the differences of the positions of these stars, px, and `square` (P, 12)
    the sums of their squared errors; both are NaN where there is no star.
    """

    pairs: IntArray
    gap: FloatArray
    square: FloatArray

    @classmethod
    def of(cls, marks: Fingerprints, pairs: IntArray) -> _Matches:
        """Match the stars of pairs of frames."""
        parts = [cls._of(marks, pairs[i : i + _PART]) for i in range(0, max(len(pairs), 1), _PART)]
        return cls(*(np.concatenate([getattr(m, one.name) for m in parts]) for one in fields(cls)))

    @classmethod
    def _of(cls, marks: Fingerprints, pairs: IntArray) -> _Matches:
        xy, square = (marks.padded(values)[pairs] for values in (marks.xy_px, marks.error_px**2))
        gap = xy[:, 1, None] - xy[:, 0, :, None]
        distance = np.nan_to_num(np.sum(gap**2, axis=3), nan=np.inf)
        at = np.argmin(distance, axis=2)[..., None]
        back = np.take_along_axis(np.argmin(distance, axis=1)[:, None], at, axis=2)[..., 0]
        used = back == np.arange(_MARKS)
        used &= np.min(distance, axis=2) < (2.0 * _SHIFT) ** 2
        gap = np.take_along_axis(gap, at[..., None], axis=2)[:, :, 0]
        total = square[:, 0] + np.take_along_axis(square[:, 1], at[..., 0], axis=1)
        gap[~used] = total[~used] = np.nan
        count = np.count_nonzero(used, axis=1)
        least = np.minimum(marks.sizes, _MARKS)[pairs].min(axis=1)
        found = cls(pairs, gap, total)
        return found.subset((found.n_compared >= 3) & (2 * count >= least))

    def subset(self, chosen: BoolArray) -> _Matches:
        """Some of the pairs."""
        return _Matches(self.pairs[chosen], self.gap[chosen], self.square[chosen])

    @property
    def n_compared(self) -> IntArray:
        """Stars (P,) that are compared: one in five may be measured quite differently by another
        program.
        """
        count = np.count_nonzero(np.isfinite(self.square), axis=1)
        return np.asarray(count - count // 5)

    @property
    def shift(self) -> FloatArray:
        """Shift (P, 2) of the one frame against the other, px."""
        return floats(np.nanmedian(self.gap, axis=1))

    def compared(self, shift: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """r, its probability for independent errors, half the degrees of freedom, (P,) each, up to
        a shift (2,) or (P, 2).
        """
        from scipy.special import comb

        off = np.sum((self.gap - shift.reshape(-1, 1, 2)) ** 2, axis=2)
        n, count = self.n_compared, np.count_nonzero(np.isfinite(off), axis=1)
        limit = np.take_along_axis(np.sort(off, axis=1), n[:, None] - 1, axis=1)
        used = off <= limit
        square = np.where(used, self.square, np.nan)
        # The error of a wrong star is the same in every exposure.
        square = np.minimum(square, 9.0 * np.nanmedian(square, axis=1, keepdims=True))
        total = np.maximum(np.nansum(square, axis=1), _TINY)
        r = np.sum(off, where=used, axis=1) / total
        # Stars of unequal noise are worth fewer: those of equal noise have a relative variance of
        # 1/2.
        worth = 1.5 * total**2 / np.maximum(np.nansum(square**2, axis=1), _TINY) / n
        half = 0.5 * np.maximum((2.0 * n - 3.0) * np.minimum(worth, 1.0), 1.0)
        return r, np.minimum(_probability(r, half) * comb(count, count - n), 1.0), half
