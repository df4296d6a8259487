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
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from starcal_uq.core.types import BoolArray, FloatArray, IntArray, Shapes, floats

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from starcal_uq.observations.table import Observations

# Stars of a frame that are kept, and of those the ones by whose triangles frames are looked up.
_MARKS, _CORNERS = 12, 5
# Positions of one image by two programs may be off by another origin, px; stars are paired over
# twice that.
_SHIFT = 1.5
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
# From so many other frames of one pointing on, they tell how much error exposures share; so many
# are asked.
_STARE, _ASKED = 5, 8
_MOST_CANDIDATES, _PART = 2_000_000, 20_000
# Pairs that are tried one by one before a tree is quicker, and the width of the strips in which
# they are looked for.
_MOST_TRIED, _STRIP = 20_000_000, 3.0
# Terms of a smooth misfit up to the fifth degree, with so many stars for each, from about so many
# stars; stars whose terms stay in the cache.
_DEGREE, _STARS_PER_TERM, _MOST_STARS, _BLOCK = 5, 20, 3_000, 4096


@dataclass(frozen=True, eq=False)
class Fingerprints:
    """What identifies the frames of a calibration: at most 12 stars each, 12 bytes a star.

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

    SHAPES: ClassVar[Shapes] = {"sizes": ("k",), "xy_px": ("m", 2), "error_px": ("m",)}

    @classmethod
    def of(
        cls, obs: Observations, residuals_px: FloatArray, centre_px: tuple[float, float]
    ) -> Fingerprints:
        """Take those of a table with its residuals (N, 2)."""
        sizes, xy = obs.stars_per_frame, np.stack([obs.x_px, obs.y_px])
        offset = xy - np.asarray(centre_px)[:, None]
        rows = _most_central(
            np.sum(np.square(offset, out=offset), axis=0), obs.frame_starts[:-1], sizes
        )
        found = np.take(xy, rows, axis=1)
        left = _unsmooth(xy, residuals_px.T, rows, found)
        error = np.sqrt(left[0] ** 2 + left[1] ** 2)
        free = np.sqrt(1.0 - 1.5 / np.maximum(sizes, 2))
        kept = np.minimum(sizes, _MARKS)
        error /= np.repeat(free, kept)
        stated = stated_noise(obs)
        if stated is not None and len(rows):
            error /= np.repeat(_inflation(error / stated[rows], kept), kept)
        return cls(
            sizes.astype(np.int64), found.T.astype(np.float32, order="C"), error.astype(np.float32)
        )

    @classmethod
    def joined(cls, parts: Sequence[Fingerprints]) -> Fingerprints:
        """Those of several runs, one after the other."""
        return cls(
            np.concatenate([part.sizes for part in parts]),
            np.concatenate([part.xy_px for part in parts]),
            np.concatenate([part.error_px for part in parts]),
        )

    def equal(self, other: Fingerprints, pairs: IntArray) -> bool:
        """Whether all pairs (n, 2) of frames, those of `self` and of `other`, have their stars at
        the same pixels.
        """
        places = (np.split(one.xy_px, np.cumsum(one.counts)[:-1]) for one in (self, other))
        mine, theirs = places
        return all(np.array_equal(mine[i], theirs[j]) for i, j in pairs)

    @property
    def counts(self) -> IntArray:
        """Stars kept of each frame, (K,)."""
        return np.minimum(self.sizes, _MARKS)


def stated_noise(obs: Observations) -> FloatArray | None:
    """Noise (N,) that the stars state, px per axis, without the floor that was found for all of
    them.
    """
    if obs.sigma_px is None:
        return None
    floor, scale = obs.origin.noise_floor_px or 0.0, obs.origin.noise_scale or 1.0
    variance = (obs.sigma_px / min(scale, 1.0)) ** 2 - (floor / scale) ** 2
    return np.asarray(np.sqrt(np.maximum(variance, 1e-4 * obs.sigma_px**2)))


def _inflation(ratio: FloatArray, kept: IntArray) -> FloatArray:
    """Factor (K,) by which the residuals of frames exceed the noise that their centroids state; 1
    where it is small.

    What a wrong camera among others or a poor model adds is common to exposures of one field, and
    is no noise. The mean logarithm of half a chi-square with two degrees of freedom is minus
    Euler's constant, and a few wrong stars hardly move it.
    """
    there = kept > 0
    starts = (np.cumsum(kept) - kept)[there]
    logs = np.add.reduceat(np.log(np.maximum(0.5 * ratio**2, 1e-300)), starts) / kept[there]
    factor = np.ones(len(kept))
    factor[there] = np.exp(0.5 * (logs + np.euler_gamma))
    return np.where(factor > _INFLATED, factor, 1.0)


def _most_central(distance: FloatArray, starts: IntArray, sizes: IntArray) -> IntArray:
    """Rows of at most 12 stars of each frame, nearest first, frame by frame."""
    # Whole numbers sort in a fraction of the time: the frame, 2^39 distances or what there is room
    # for, and the place.
    low = int(sizes.max(initial=1)).bit_length()
    high = min(39, 62 - low - len(sizes).bit_length())
    keys = (distance * (2.0**high / max(float(np.max(distance, initial=0.0)), 1e-300))).astype(
        np.int64
    )
    keys += np.repeat(np.arange(len(sizes)) << (high + 1), sizes)
    keys = (keys << low) + (np.arange(len(distance)) - np.repeat(starts, sizes))
    keys.sort()
    kept = np.minimum(sizes, _MARKS)
    first = np.repeat(starts, kept)
    chosen = keys[first + np.arange(len(first)) - np.repeat(np.cumsum(kept) - kept, kept)]
    return np.asarray(first + (chosen & ((1 << low) - 1)))


def _unsmooth(xy: FloatArray, residuals: FloatArray, rows: IntArray, at: FloatArray) -> FloatArray:
    """Residuals (2, n) of some rows, which stand `at` (2, n), without a polynomial over the
    detector.

    What a model cannot follow is no noise.
    """
    step = max(1, xy.shape[1] // _MOST_STARS)
    some, found = xy[:, ::step], residuals[:, ::step]
    middle = some.mean(axis=1, keepdims=True)
    unit = np.abs(some - middle).max() or 1.0
    degree = max(
        d
        for d in range(_DEGREE + 1)
        if d == 0 or (d + 1) * (d + 2) // 2 * _STARS_PER_TERM <= xy.shape[1]
    )
    square = np.sum(found * found, axis=0)
    # A few wrong stars would bend the polynomial for all others.
    used = np.flatnonzero(square <= 25.0 * np.median(square))
    table = _powers((np.take(some, used, axis=1) - middle) / unit, degree)
    solution = np.linalg.lstsq(table @ table.T, table @ np.take(found, used, axis=1).T, rcond=None)[
        0
    ].T
    left = np.take(residuals, rows, axis=1)
    for first in range(0, len(rows), _BLOCK):
        part = slice(first, first + _BLOCK)
        left[:, part] -= solution @ _powers((at[:, part] - middle) / unit, degree)
    return left


def _powers(xy: FloatArray, degree: int) -> FloatArray:
    """All ``x^i y^j`` up to a degree, (t, n)."""
    x, y = xy
    table = np.empty(((degree + 1) * (degree + 2) // 2, len(x)))
    table[0] = 1.0
    for i in range(degree):
        np.multiply(table[i], x, out=table[i + 1])
    first = 0
    for count in range(degree, 0, -1):
        np.multiply(
            table[first : first + count], y, out=table[first + count + 1 : first + 2 * count + 1]
        )
        first += count + 1
    return table


def shared(a: Fingerprints, b: Fingerprints) -> IntArray:
    """Places (n, 2) of frames of `a` that `b` repeats, and of those in `b`."""
    n = len(a.sizes)
    group = np.repeat([0, 1], [n, len(b.sizes)])
    pairs: IntArray = repeats(Fingerprints.joined([a, b]), group) - np.array([0, n], dtype=np.int64)
    return pairs


def repeats(marks: Fingerprints, group: IntArray | None = None) -> IntArray:
    """Places (n, 2), ascending in each row, of frames that are one measurement; with `group`, of
    different groups.

    A pair counts where r is at most 0.05 and its probability for independent exposures, times the
    frames of the same pointing and the number of all frames, is below 1e-6; or, where pairs are
    less certain one by one, where more of them than chance gives (1e-6) have a probability below 1
    %. Frames of one pointing from five others on tell how much of their error exposures share (the
    stars' own, or the pixels'), and a repeated one then shares more.
    """
    nothing = np.empty((0, 2), dtype=np.int64)
    if np.count_nonzero(marks.sizes >= 3) < 2:
        return nothing
    search = _Search(marks)
    pairs = search.candidates(group)
    if not len(pairs):
        return nothing
    r, shift = search.compared(pairs, None)[0::2]
    pairs, shift = pairs[r < 3.0 * _SAME], shift[r < 3.0 * _SAME]
    if not len(pairs):
        return nothing
    # Another origin of the pixels shifts all of them alike; a camera that moves does not.
    common = np.median(shift, axis=0)
    steady = len(pairs) >= 3 and np.all(np.median(np.abs(shift - common), axis=0) < 0.1 * _SHIFT)
    r, p = search.compared(pairs, np.zeros(2))[:2]
    if steady:
        r, p = (
            np.minimum(at_none, value)
            for at_none, value in zip((r, p), search.compared(pairs, common)[:2], strict=True)
        )
    kept = r < 2.0 * _SAME
    pairs, r, p = pairs[kept], r[kept], p[kept]
    return pairs[search.judged(pairs, r, p)] if len(pairs) else nothing


def _near(points: FloatArray) -> IntArray | None:
    """Pairs (n, 2) of triangles (m, 6) that differ by at most 1 in every number; None where too
    many are to be tried.

    They are sorted into strips of the first number and, within them, by a sum of two sides, because
    those of one frame have single sides in common. For that few have one near, this takes a tenth
    of the time of SciPy's tree.
    """
    across = points[:, 0] - points[:, 0].min(initial=0.0)
    strip = np.floor(across / _STRIP)
    along = points[:, 2] + points[:, 4]
    along -= along.min(initial=0.0)
    length = along.max(initial=0.0) + 5.0
    keys = strip * length + along
    # In whole numbers of 31 bits, with the place behind them, they sort in half the time.
    unit = (2.0**31 - 2.0) / max(float(keys.max(initial=0.0)), 1.0)
    packed = np.sort(((keys * unit).astype(np.int64) << 32) + np.arange(len(keys)))
    keys, order = packed >> 32, packed & (2**32 - 1)
    reach, edge = int(2.0 * unit) + 3, (across - _STRIP * strip)[order] > _STRIP - 1.0 - 1e-6
    found = []
    for step in (0, 1):
        # Only those at the edge of a strip have any in the next one.
        one = np.flatnonzero(edge) if step else np.arange(len(keys))
        at = keys[one] + step * int(length * unit)
        first = np.searchsorted(keys, at - reach) if step else one + 1
        some = np.append(keys, 2**62)[first] <= at + reach
        one, at, first = one[some], at[some], first[some]
        count = np.searchsorted(keys, at + reach, side="right") - first
        if count.sum() > _MOST_TRIED:
            return None
        start = np.repeat(first - (np.cumsum(count) - count), count)
        pairs = order[np.column_stack([np.repeat(one, count), np.arange(len(start)) + start])]
        for axis in (2, 0, 1, 3, 4, 5):
            column = points[:, axis]
            pairs = pairs[np.abs(column[pairs[:, 0]] - column[pairs[:, 1]]) <= 1.0]
        found.append(pairs)
    return np.concatenate(found)


class _Search:
    """Frames looked up by the triangles of their most central stars."""

    def __init__(self, marks: Fingerprints) -> None:
        self.counts = marks.counts
        self.starts = np.cumsum(self.counts) - self.counts
        self.xy = floats(marks.xy_px)
        self.square = floats(marks.error_px) ** 2
        # Median length of two normal errors, so that wrong stars do not count; it is that of a
        # sample.
        self.sigma = (
            float(np.median(marks.error_px[:: max(1, len(marks.error_px) // _MOST_STARS)])) / 1.1774
            + 1e-4
        )
        # The most central stars from left to right; where a frame has fewer, what is missing comes
        # last.
        place = np.arange(_CORNERS)
        there = place < self.counts[:, None]
        corner = np.sort(
            np.where(there, self._point(np.where(there, self.starts[:, None] + place, 0)), np.nan),
            axis=1,
        )
        chosen = np.array(list(combinations(range(_CORNERS), 3)))
        whole = self.counts[:, None] > chosen[:, 2]
        triangle = np.take(corner, chosen, axis=1)
        if whole.all():
            self.frame, self.triangle = (
                np.repeat(np.arange(len(whole)), len(chosen)),
                _triangles(triangle.reshape(-1, 3)),
            )
        else:
            self.frame, self.triangle = np.nonzero(whole)[0], _triangles(triangle[whole])

    def _point(self, rows: IntArray) -> NDArray[np.complex128]:
        """Positions of stars as complex numbers, which are sorted from left to right."""
        points: NDArray[np.complex128] = self.xy.view(np.complex128)[rows, 0]
        return points

    @cached_property
    def first(self) -> IntArray:
        """Frames (H,) of three stars and more."""
        return np.flatnonzero(self.counts >= 3)

    @cached_property
    def points(self) -> FloatArray:
        """The triangle (H, 6) of the three most central stars of each of them, which tells which
        way a frame looks.
        """
        return (
            _triangles(np.sort(self._point(self.starts[self.first, None] + np.arange(3)), axis=1))
            / _SHIFT
        )

    @cached_property
    def partners(self) -> FloatArray:
        """How many other frames look the same way, (K,)."""
        partners = np.zeros(len(self.counts))
        near = _near(self.points)
        if near is not None:
            partners[self.first] = np.bincount(near.ravel(), minlength=len(self.first))
        else:
            partners[self.first] = (
                _tree(self.points).query_ball_point(self.points, 1.0, p=np.inf, return_length=True)
                - 1
            )
        return partners

    def candidates(self, group: IntArray | None) -> IntArray:
        """Pairs of frames with a triangle in common."""
        points = self.triangle / np.array([_SHIFT, _SHIFT, *[self.sigma] * 4])
        near = _near(points)
        if near is None or len(near) > _MOST_CANDIDATES:
            near = self._nearest(points)
        pairs = np.sort(self.frame[near], axis=1)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        if group is not None:
            pairs = pairs[group[pairs[:, 0]] != group[pairs[:, 1]]]
        return np.column_stack(
            np.divmod(np.unique(pairs[:, 0] * len(self.counts) + pairs[:, 1]), len(self.counts))
        )

    def _nearest(self, points: FloatArray) -> IntArray:
        """Pairs of triangles that look alike, by a tree."""
        tree, reach = _tree(points), 1.0
        # A stare of very many frames has too many neighbours: the nearer ones are then looked at.
        if self.partners.sum() > _MOST_CANDIDATES:
            while tree.count_neighbors(tree, reach, p=np.inf) > 2 * _MOST_CANDIDATES + len(
                self.frame
            ):
                reach *= 0.8
        return np.asarray(tree.query_pairs(reach, p=np.inf, output_type="ndarray"), dtype=np.int64)

    def compared(
        self, pairs: IntArray, offset: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Of pairs (P, 2): r, its probability for independent errors, the shift (P, 2), half the
        degrees of freedom.

        Positions may differ by the `offset`; each pair by one of its own where that is None.
        """
        parts = [self._compared(pairs[i : i + _PART], offset) for i in range(0, len(pairs), _PART)]
        r, p, shift, half = (np.concatenate(values) for values in zip(*parts, strict=True))
        return r, p, shift, half

    def _compared(
        self, pairs: IntArray, offset: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        from scipy.special import betainc, comb

        (a, in_a), (b, in_b) = self._rows(pairs[:, 0]), self._rows(pairs[:, 1])
        gap = self.xy[b][:, None, :, :] - self.xy[a][:, :, None, :]
        distance = np.where(in_a[:, :, None] & in_b[:, None, :], np.sum(gap**2, axis=3), np.inf)
        at = np.argmin(distance, axis=2)
        mutual = np.take_along_axis(np.argmin(distance, axis=1), at, axis=1) == np.arange(_MARKS)
        used = mutual & (np.min(distance, axis=2) < (2.0 * _SHIFT) ** 2)
        count = np.count_nonzero(used, axis=1)
        d = np.take_along_axis(gap, at[:, :, None, None], axis=2)[:, :, 0]
        shift = _median(d, used)
        off = np.sum((d - (shift[:, None] if offset is None else offset)) ** 2, axis=2)
        # One star in five may be measured quite differently by another program.
        left = count // 5
        rank = np.argsort(np.argsort(np.where(used, off, np.inf), axis=1), axis=1)
        used &= rank < (count - left)[:, None]
        n = np.maximum(count - left, 1)
        square = self.square[a] + np.take_along_axis(self.square[b], at, axis=1)
        # The error of a wrong star is the same in every exposure.
        square = np.minimum(square, 9.0 * _median(square[..., None], used)) * used
        total = np.maximum(square.sum(axis=1), np.finfo(np.float64).tiny)
        r = np.sum(off * used, axis=1) / total
        if offset is None:
            r *= n / np.maximum(n - 1, 1)
        # Stars of unequal noise are worth fewer: those of equal noise have a relative variance of
        # 1/2.
        worth = np.minimum(
            1.0,
            1.5 * total**2 / np.maximum(np.sum(square**2, axis=1), np.finfo(np.float64).tiny) / n,
        )
        half = 0.5 * np.maximum((2.0 * n - 3.0) * worth, 1.0)
        p = betainc(half, half, np.minimum(0.5 * r, 1.0)) * comb(count, left)
        enough = (n >= 3) & (2 * count >= np.minimum(*self.counts[pairs].T))
        return np.where(enough, r, np.inf), np.where(enough, np.minimum(p, 1.0), 1.0), shift, half

    def _rows(self, frames: IntArray) -> tuple[IntArray, BoolArray]:
        """Rows (P, 12) of the stars of frames, and where there is one."""
        place = np.arange(_MARKS)
        there = place < self.counts[frames][:, None]
        return np.where(there, self.starts[frames][:, None] + place, 0), there

    def judged(self, pairs: IntArray, r: FloatArray, p: FloatArray) -> BoolArray:
        """Which pairs (P, 2) with these r and probabilities are one measurement."""
        from scipy.special import bdtrc, betainc

        n_frames, partners = len(self.counts), self.partners
        # Where a camera stares, what its exposures have in common is not what two measurements of
        # one have.
        crowded = np.flatnonzero((partners[pairs] >= _STARE).all(axis=1) & (r > _COPY))
        if len(crowded):
            asking, inverse = np.unique(pairs[crowded, 0], return_inverse=True)
            share, half = (values[inverse] for values in self._common(asking))
            r[crowded] /= share
            p[crowded] = np.maximum(
                p[crowded], betainc(half, half, np.minimum(0.5 * r[crowded], 1.0))
            )
        p = np.minimum(1.0, p * np.maximum(1.0, partners[pairs].max(axis=1)))
        same: BoolArray = (r < _SAME) & (p * n_frames < _FALSE_ALARM)
        possible = max(int(np.count_nonzero(partners)) // 2, 1)
        unlikely = pairs[(r < _SAME) & (p < 0.01)]
        # Every frame counts once, or exposures that happen to be near many would.
        apart = min(np.unique(unlikely[:, 0]).size, np.unique(unlikely[:, 1]).size, possible)
        if apart > 1 and bdtrc(apart - 1, possible, 0.01) < _FALSE_ALARM:
            same |= (r < _SAME) & (p < 0.05)
        # A table that repeats some frames may well repeat others less exactly, and one frame left
        # out harms little.
        return same | (same.any() & (r < 2.0 * _SAME) & (p < 1e-3))

    def _common(self, frames: IntArray) -> tuple[FloatArray, FloatArray]:
        """What r is for other exposures of the pointing of frames, at most 1, and half its degrees
        of freedom.
        """
        points = self.triangle / _SHIFT
        _, near = _tree(points).query(
            self.points[np.searchsorted(self.first, frames)],
            k=4 * _ASKED,
            p=np.inf,
            distance_upper_bound=1.0,
        )
        others = np.append(self.frame, -1)[near]
        row, column = np.nonzero((others >= 0) & (others != frames[:, None]))
        r, half = np.full(others.shape, np.nan), np.full(others.shape, np.nan)
        values = self.compared(np.column_stack([frames[row], others[row, column]]), None)
        r[row, column], half[row, column] = (
            np.where(np.isfinite(values[0]), values[0], np.nan),
            values[3],
        )
        enough = np.count_nonzero(np.isfinite(r), axis=1) >= _STARE
        r[~enough], half[~enough] = 1.0, 1.5
        # Trimmed of its largest differences, r is about 2/3 for independent exposures.
        return np.clip(1.5 * np.nanmedian(r, axis=1), 1e-12, 1.0), np.nanmedian(half, axis=1)


def _triangles(corner: NDArray[np.complex128]) -> FloatArray:
    """Of corners (n, 3) from left to right: the first one, and the sides from there to the others,
    (n, 6).
    """
    first, *others = corner.T
    places = (first, *(other - first for other in others))
    # One number of all triangles after the other: they are looked at that way.
    return np.stack([part for place in places for part in (place.real, place.imag)]).T


def _tree(points: FloatArray) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(points)


def _median(values: FloatArray, used: BoolArray) -> FloatArray:
    """Median (P, c) over the used ones of values (P, n, c); zero where none is."""
    ordered = np.sort(np.where(used[..., None], values, np.inf), axis=1)
    count = np.count_nonzero(used, axis=1)
    low, high = (np.maximum(count - 1, 0) // 2), count // 2
    pick = [
        np.take_along_axis(ordered, at[:, None, None], axis=1)[:, 0]
        for at in (low, np.maximum(high, low))
    ]
    middle = 0.5 * (pick[0] + pick[1])
    return np.where(count[:, None] > 0, middle, 0.0)
