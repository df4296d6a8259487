"""The focal length of an unknown camera, from the stars alone: patterns that know no scale, as
plate solvers use them.

Four stars make a pattern whose shape depends on neither scale nor roll (Lang, Hogg et al. 2010, AJ
139, 1782): the two farthest apart define axes, and the places of the other two are the pattern's
code. The catalogue's patterns are made of the brightest stars of the sky, twice as many on each
level as on the one before, each star with the nearest of its level; so some level suits any field
of view. Like codes give an attitude and a focal length, what else they explain among the frame's
bright stars ranks them, and a match of all stars (`match`) decides.

All work is counted: so many patterns of so many frames, so many of them matched.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import combinations, pairwise, product
from math import log10, pi
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from starcal_uq.camera.camera import Camera
from starcal_uq.core.types import FloatArray, IntArray, PathLike
from starcal_uq.identification.growth import Patch, grow, matched_patch
from starcal_uq.identification.match import match_frame, start_state
from starcal_uq.identification.nearby import NearbyStars
from starcal_uq.identification.pairs import (
    angle_between,
    cached,
    digest_of,
    remembered,
    rows_of,
)
from starcal_uq.identification.pyramid import (
    SIGMAS,
    CameraTolerance,
    FieldGeometry,
    Hypothesis,
    axes_along,
    axes_of,
    unit_directions,
)
from starcal_uq.identification.result import FoundOptics
from starcal_uq.sky.catalogue import StarCatalogue

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Stars of the whole sky on the first level; each next one has twice as many.
_FIRST_LEVEL = 64
LEVELS = [_FIRST_LEVEL << k for k in range(12)]
# Levels searched together: those that are made in a second first, then the deeper ones, which only
# narrow fields need.
FIRST_GROUP = 20_000
_GROUPS = (FIRST_GROUP, 40_000, 80_000, 160_000)
# Stars of a level that a field holds, at the least and at the most, for each star down to a
# pattern's faintest.
_LEAST_IN_FIELD, _MOST_IN_FIELD = 0.3, 8.0
# Nearest stars that a star makes patterns with, on levels of up to so many stars.
_NEAREST = ((10_000, 7), (40_000, 6), (200_000, 5))
# Patterns whose codes are computed together.
_AT_ONCE = 20_000
# Patterns of a frame are made of this many of its brightest stars, each with as many of its
# nearest.
_BRIGHTEST, _FRAME_NEAREST = (8, 11, 16, 22, 32), 7
# Codes differ by less than this, in units of the pattern's longest side: noise, and what an unknown
# lens bends.
_CODE_TOLERANCE = 0.012
# The frame's brightest stars that a pattern's attitude must explain, and how well, as a part of
# their distance.
_EXPLAINED, _BEND = 24, 0.008
# Patterns are flat in narrow fields; those above 30 degrees are seen with these focal lengths, in
# detector widths.
_FLAT, _FOCAL_STEPS = 1.7, (1.85, 1.45, 1.15, 0.92, 0.75, 0.61, 0.5, 0.42)
_FOCAL_STEP = 1.17
# Candidates of a frame and parity that are matched with all stars, and the camera tolerances then.
_MATCHED = 12
_FOCAL, _CENTRE, _DISTORTION = 0.02, 0.02, 0.004
# Patterns of so many stars are looked up first, in levels that are soon made and then in all; what
# they show ends the search where chance does so less often than this, log10, and it then matches
# beyond doubt.
_FIRST_STARS, _FIRST_LEVELS, _CLEAR = 11, 5000, -5.0
# Candidates that explain as much as chance does less often than this, log10, are tried with a lens
# that bends.
_WORTH_GROWING = -5.0
# Decimal logarithms of the wrong attitudes expected for a frame to count, and to count alone.
_COUNTS, _ALONE = -4.0, -9.0
# Frames that are searched, those of them that must agree where they can, and the stars that one
# must have.
_PROBES, _ENOUGH, _LEAST_STARS = 10, 3, 5
# Frames of one camera agree in their focal length to this.
AGREEMENT = 0.02
# Focal lengths of fields of view from 105 to 0.5 degrees, in detector widths.
FOCAL_RANGE = (0.38, 115.0)
# The search for a focal length anywhere, instead of within the tolerance of a match.
_ANYWHERE = log10(np.log(180.0) / (2.0 * _FOCAL))


@lru_cache(maxsize=8)
def _threes(k: int) -> IntArray:
    return np.array(list(combinations(range(1, k + 1), 3)), dtype=np.int64)


_IN_KEY = [1, 0, 3, 2]


def quads_of(neighbours: IntArray) -> IntArray:
    """Different sets of four (q, 4): a point, first in its row of `neighbours` (n, k + 1), and
    three of its nearest.
    """
    three = _threes(neighbours.shape[1] - 1)
    own = np.repeat(neighbours[:, 0], len(three))[:, None]
    quads = np.sort(np.hstack([own, neighbours.take(three, axis=1).reshape(-1, 3)]), axis=1)
    # One key, or two, are sorted faster than rows of four: the last number of a key counts most.
    kind = "<u2" if quads.max(initial=0) < 1 << 16 else "<u4"
    keys = quads.take(_IN_KEY, axis=1).astype(kind).view("<u8")
    keys = np.sort(keys, axis=0) if keys.shape[1] == 1 else keys[np.lexsort(keys.T)]
    new = np.append(True, np.any(keys[1:] != keys[:-1], axis=1))[: len(keys)]
    different: IntArray = keys[new].view(kind).take(_IN_KEY, axis=1).astype(np.int64)
    return different


# Of four points, the ends of each side and the other two.
_ENDS = np.array([[0, 0, 0, 1, 1, 2], [1, 2, 3, 2, 3, 3], [2, 1, 1, 0, 0, 0], [3, 3, 2, 3, 2, 1]])


def codes_of(directions: FloatArray, quads: IntArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Codes (q, 4), the quads with their points in the code's order (a, b, c, d), and the angles
    from a to b, rad.

    The points are seen in the plane that touches the sphere at their middle, a at 0 and b at 1 of
    the complex numbers: the code is c and d, with a the end that they are nearer to, and c before
    d.
    """
    # Patterns along the last axis, so that NumPy's inner loops run over them.
    v = directions.T.take(quads.T, axis=1)
    p = np.einsum("ikq,aiq->akq", v, axes_along(v, 0, 1))
    p = (p[0] + 1j * p[1]) / p[2]
    apart = p[_ENDS[0]] - p[_ENDS[1]]
    order = _ENDS.take(np.argmax(apart.real**2 + apart.imag**2, axis=0), axis=1)
    p = np.take_along_axis(p, order, axis=0)
    c = (p[2:] - p[0]) / (p[1] - p[0])
    turn = c.real.sum(axis=0) > 1.0
    c = np.where(turn, 1.0 - c, c)
    order[:2] = np.where(turn, order[1::-1], order[:2])
    swap = c[0].real > c[1].real
    c = np.where(swap, c[::-1], c)
    order[2:] = np.where(swap, order[:1:-1], order[2:])
    quads = np.take_along_axis(quads, order.T, axis=1)
    codes = np.ascontiguousarray(c.T).view(np.float64)
    ends = (directions.take(end, axis=0) for end in quads.T[:2])
    return codes, quads, angle_between(*ends)


# Codes are kept by cells of this width, so that what is like a code lies in one or two of them along
# each axis. The number of a cell has a byte for each axis, to which the next one along some axes
# adds `_NEXT`.
_CELL = 4.0 * _CODE_TOLERANCE
_BYTES = 1 << np.array([24, 16, 8, 0])
_NEXT = np.array(list(product((0, 1), repeat=4))) @ _BYTES
# Neighbouring cells are spread over the table of a level by this factor.
_SPREAD = np.uint64(0x9E3779B97F4A7C15)


def _cells_near(codes: FloatArray) -> tuple[IntArray, IntArray]:
    """Cells that hold what is like each of some codes (q, 4): the rows of codes, and cells."""
    low = np.floor((codes - _CODE_TOLERANCE) / _CELL).astype(np.int64)
    more = np.floor((codes + _CODE_TOLERANCE) / _CELL).astype(np.int64) - low
    used = ((more @ _BYTES)[:, None] & _NEXT) == _NEXT
    return np.nonzero(used)[0], ((low @ _BYTES)[:, None] + _NEXT)[used]


def _places(cells: IntArray, n: int) -> IntArray:
    """Places of cells in a table of n, a power of two."""
    mixed = cells.astype(np.uint64) * _SPREAD
    return (mixed >> np.uint64(65 - n.bit_length())).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Level:
    """The brightest stars of the sky, (n, 3), and their q patterns, sorted by the places of their
    codes in a table of t.

    Points (q, 4), longest sides (q,) and codes (q, 4) of the patterns; `start` (t + 1,) is the
    first of each place.
    """

    directions: FloatArray
    quads: NDArray[np.int32]
    size_rad: FloatArray
    codes: NDArray[np.float32]
    start: NDArray[np.int32]

    @property
    def fits(self) -> bool:
        q, places = len(self.quads), len(self.start) - 1
        whole = len(self.size_rad) == len(self.codes) == q == int(self.start[-1])
        return (
            whole
            and places & (places - 1) == 0
            and int(self.quads.max(initial=-1)) < len(self.directions)
        )

    @cached_property
    def stars(self) -> cKDTree:
        """The stars as a tree of `directions`."""
        from scipy.spatial import cKDTree

        return cKDTree(self.directions)

    def alike(self, codes: FloatArray, row: IntArray, cell: IntArray) -> tuple[IntArray, IntArray]:
        """Rows of codes (q, 4), and patterns of the level, that are alike, looking at these cells
        for these rows.
        """
        place = _places(cell, len(self.start) - 1)
        start = self.start[place].astype(np.int64)
        count = self.start[place + 1] - start
        mine, theirs = np.repeat(row, count), rows_of(start, count)
        apart = self.codes.take(theirs, axis=0) - codes.take(mine, axis=0)
        near = np.einsum("ij,ij->i", apart, apart) < _CODE_TOLERANCE**2
        # Cells of one row that share a place show the same patterns.
        n = max(len(self.codes), 1)
        return np.divmod(np.unique(mine[near] * n + theirs[near]), n)


def _nearest(n: int) -> int:
    """Nearest stars that a star makes patterns with, on a level of n."""
    return next((k for most, k in _NEAREST if n <= most), _NEAREST[-1][1])


def make_level(directions: FloatArray) -> Level:
    """The level of these stars."""
    from scipy.spatial import cKDTree

    quads = quads_of(cKDTree(directions).query(directions, _nearest(len(directions)) + 1)[1])
    # In blocks that stay in the processor's cache.
    blocks = [codes_of(directions, quads[k : k + _AT_ONCE]) for k in range(0, len(quads), _AT_ONCE)]
    codes, quads, size = (np.concatenate(column) for column in zip(*blocks, strict=True))
    codes = codes.astype(np.float32)
    n = 1 << len(codes).bit_length()
    place = _places(np.floor(codes / _CELL).astype(np.int64) @ _BYTES, n)
    # A sort of numbers that end in their places takes half the time of a stable `argsort`.
    order = np.sort((place << 32) + np.arange(len(place))) & 0xFFFFFFFF
    start = np.append(0, np.cumsum(np.bincount(place, minlength=n))).astype(np.int32)
    points = quads.astype(np.int32).take(order, axis=0)
    return Level(directions, points, size.take(order), codes.take(order, axis=0), start)


# Levels of before: catalogues of any depth share those of the bright stars.
_KEPT_LEVELS = 13
_made: dict[str, Level] = {}
# To be raised when what a level holds changes, or how it is made.
_VERSION = 1


def level_of(stars: StarCatalogue, n: int, folder: PathLike | None) -> Level:
    """The level of the brightest n stars, made once, and kept in a `folder` where there is one."""
    bright = stars.brightest_first[1][:n]

    def make() -> Level:
        key = digest_of((bright,), _VERSION, _CELL, _nearest(len(bright)))
        return cached(Level, f"star-patterns-{key}", partial(make_level, bright), folder)

    return remembered(_made, _KEPT_LEVELS, stars.digest(n), make)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Candidates of a frame: attitudes (c, 3, 3), focal lengths (c,), and how unlikely what they
    explain is, log10.

    Of their patterns the points (c, 4) and directions (c, 4, 3).
    """

    rotation: FloatArray
    focal_px: FloatArray
    log10_chance: FloatArray
    points: IntArray
    directions: FloatArray


@dataclass(frozen=True, eq=False)
class Solved:
    """A frame's stars that are matched, how often chance does so with any focal length, log10, and
    the lens's bend.
    """

    patch: Patch
    log10_false: float
    bend_px: float


class BlindSearch:
    """One catalogue and one size of detector, of a camera whose focal length may be anything.

    The catalogue's patterns are kept in a `folder` where there is one.
    """

    def __init__(
        self, stars: StarCatalogue, width_px: int, height_px: int, folder: PathLike | None = None
    ) -> None:
        self.stars, self.folder = stars, folder
        self.width, self.height = float(width_px), float(height_px)
        corner = 0.5 * float(np.hypot(width_px, height_px))
        self.geometry = FieldGeometry(self.width, self.width, self.height, corner)
        self.tolerance = CameraTolerance(
            _FOCAL, _CENTRE * self.width, max(1.0, _DISTORTION * corner)
        )
        self.sky = NearbyStars(stars, self.geometry)

    def sizes(self, most: int, focal_px: tuple[float, float]) -> list[int]:
        """Levels with at most this number of stars, of which a field shows enough."""
        return [n for n in LEVELS if n <= most and _useful(n, self.width * self.height, focal_px)]

    def candidates(
        self,
        u: FloatArray,
        sigma_px: FloatArray,
        quads: IntArray,
        sizes: list[int],
        focal_px: tuple[float, float],
    ) -> _Seen:
        """What patterns of a frame, points (n, 2) from the middle, brightest first, have like ones
        on these levels.
        """
        found = [
            part
            for focal, low, high in self._focal_steps(focal_px)
            for part in self._alike(u, quads, sizes, focal, low, high)
        ]
        parts = [self._explained(u, sigma_px, *part) for part in found]
        shapes = (0, 3, 3), 0, 0, (0, 4), (0, 4, 3)
        columns = zip(*parts, strict=True) if parts else ([np.empty(shape)] for shape in shapes)
        return _Seen(*map(np.concatenate, columns))

    def _focal_steps(self, focal_px: tuple[float, float]) -> Iterator[tuple[float, float, float]]:
        """Focal lengths to look with, each with the range of those that it may find."""
        low, high = focal_px
        flat = _FLAT * self.width
        if high > flat:
            yield 20.0 * self.width, max(low, flat), high
        for step in _FOCAL_STEPS:
            focal = step * self.width
            a, b = max(low, focal / _FOCAL_STEP), min(high, focal * _FOCAL_STEP)
            if a < b:
                yield focal, a, b

    def _alike(
        self,
        u: FloatArray,
        quads: IntArray,
        sizes: list[int],
        focal: float,
        low: float,
        high: float,
    ) -> Iterator[tuple[Level, IntArray, IntArray, FloatArray]]:
        """For each level, its patterns and the frame's that are alike, and the focal lengths that
        follow.
        """
        rays = unit_directions(u, np.array([focal]))[0]
        codes, quads, size = codes_of(rays, quads)
        row, cell = _cells_near(codes)
        faintest = quads.max(axis=1) + 1
        least, most = _LEAST_IN_FIELD * faintest, _MOST_IN_FIELD * np.maximum(faintest, 12)
        for n in sizes:
            # Stars of the level in the field, for a focal length of one pixel.
            stars = n * self.width * self.height / (4.0 * pi)
            use = (most > stars / high**2) & (least < stars / low**2)
            if not use.any():
                continue
            level, used = level_of(self.stars, n, self.folder), use[row]
            mine, theirs = level.alike(codes, row[used], cell[used])
            f = focal * size[mine] / level.size_rad[theirs]
            expected = stars / f**2
            ok = (f >= low) & (f <= high) & (expected > least[mine]) & (expected < most[mine])
            if ok.any():
                yield level, quads[mine[ok]], level.quads[theirs[ok]], f[ok]

    def _explained(
        self,
        u: FloatArray,
        sigma_px: FloatArray,
        level: Level,
        mine: IntArray,
        theirs: IntArray,
        focal: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:
        """Columns of `_Seen`: like patterns, and the odds that their attitudes explain other stars
        by chance.
        """
        m = min(len(u), _EXPLAINED)
        b, rows = unit_directions(u, focal), np.arange(len(mine))[:, None]
        directions = level.directions.take(theirs, axis=0)
        rotation = axes_of(b[rows, mine], 0, 1).transpose(0, 2, 1) @ axes_of(directions, 0, 1)
        sky = b[:, :m] @ rotation
        corner = u[mine]
        span = np.hypot(*(corner[:, 1] - corner[:, 0]).T)[:, None]
        reach = np.hypot(*(u[:m] - corner.mean(axis=1)[:, None]).transpose(2, 0, 1))
        gate = SIGMAS * sigma_px[:m] + _BEND * (reach + span)
        distance, _ = level.stars.query(
            sky.reshape(-1, 3), distance_upper_bound=float((gate / focal[:, None]).max())
        )
        own = np.any(np.arange(m)[:, None] == mine[:, None, :], axis=2)
        near = (distance.reshape(len(mine), m) * focal[:, None] < gate) & ~own
        density = len(level.directions) / (4.0 * pi * focal**2)
        chance = np.clip(density[:, None] * pi * gate**2, 1e-9, 1.0)
        # The sum of the logarithms, less that of the choices among the stars that might have been
        # explained.
        log10_chance = np.where(near, np.log10(chance * m), 0.0).sum(axis=1)
        return rotation, focal, log10_chance, mine, directions

    def solve(
        self, u: FloatArray, sigma_px: FloatArray, sizes: list[int], focal_px: tuple[float, float]
    ) -> Solved | None:
        """The best attitude of a frame and focal length of the camera, where there is one that
        counts.
        """
        if len(u) < _LEAST_STARS:
            return None
        quads = _frame_quads(u)
        first = quads[quads.max(axis=1) < _FIRST_STARS]
        made = bisect(sizes, _FIRST_LEVELS)
        for levels in (sizes[:made], sizes[made:]) if len(first) < len(quads) else ():
            seen = self.candidates(u, sigma_px, first, levels, focal_px)
            found = self._best(u, sigma_px, seen, _CLEAR)
            if found is not None and found.log10_false < _ALONE:
                return found
        best = self._best(u, sigma_px, self.candidates(u, sigma_px, quads, sizes, focal_px), -1.0)
        return best if best is not None and best.log10_false < _COUNTS else None

    def _best(
        self, u: FloatArray, sigma_px: FloatArray, seen: _Seen, log10_chance: float
    ) -> Solved | None:
        """The surest of the first candidates, of those that chance makes less often than this."""
        from scipy.spatial import cKDTree

        best: Solved | None = None
        tree = cKDTree(u)
        tried: list[tuple[float, FloatArray]] = []
        for row in np.argsort(seen.log10_chance, kind="stable"):
            if len(tried) == _MATCHED or seen.log10_chance[row] >= log10_chance:
                break
            focal, rotation = float(seen.focal_px[row]), seen.rotation[row]
            # Patterns of one solution say the same.
            if any(
                abs(f / focal - 1.0) < 0.01 and np.abs(r - rotation).max() < 0.01 for f, r in tried
            ):
                continue
            tried.append((focal, rotation))
            solved = self._match(tree, sigma_px, focal, rotation)
            if solved is None and seen.log10_chance[row] < _WORTH_GROWING:
                solved = self._grow(
                    u, sigma_px, Patch(rotation, focal, seen.points[row], seen.directions[row])
                )
            if solved is not None and (best is None or solved.log10_false < best.log10_false):
                best = solved
                if solved.log10_false < _ALONE:
                    break
        return best

    def _match(
        self, tree: cKDTree, sigma_px: FloatArray, focal: float, rotation: FloatArray
    ) -> Solved | None:
        """What a lens that hardly bends explains."""
        sky = self.sky.seen_by(replace(self.geometry, focal_px=focal))
        start = start_state(Hypothesis(rotation, 1.0))
        match = match_frame(
            tree, sigma_px, sky, start, self.tolerance, log10_wanted=_COUNTS - _ANYWHERE
        )
        if match is None:
            return None
        patch = matched_patch(match, focal, self.stars.directions_icrs)
        return Solved(patch, match.log10_false + _ANYWHERE, float(match.state.shared[3]))

    def _grow(self, u: FloatArray, sigma_px: FloatArray, pattern: Patch) -> Solved | None:
        """What a lens that bends explains."""
        size = int(self.width), int(self.height)
        middle = 0.5 * (np.array(size) - 1.0)
        x0, y0 = middle.tolist()
        camera = Camera(*size, None, None, x0, y0, focal_px=pattern.focal_px)
        grown = grow(u + middle, sigma_px, pattern, self.sky, camera)
        if grown is None:
            return None
        return Solved(grown.patch, grown.log10_false + _ANYWHERE, grown.bend_px)


def _frame_quads(u: FloatArray) -> IntArray:
    """Patterns of a frame's brightest stars."""
    from scipy.spatial import cKDTree

    parts = []
    for m in sorted({min(m, len(u)) for m in _BRIGHTEST}):
        parts.append(quads_of(cKDTree(u[:m]).query(u[:m], min(_FRAME_NEAREST + 1, m))[1]))
    quads = np.concatenate(parts)
    # Rows as numbers of four digits are sorted in a tenth of the time.
    number = quads @ _BRIGHTEST[-1] ** np.arange(3, -1, -1)
    return quads[np.unique(number, return_index=True)[1]]


@dataclass(frozen=True)
class _Vote:
    frame: int
    mirrored: bool
    solved: Solved

    @property
    def focal_px(self) -> float:
        return self.solved.patch.focal_px


def find_optics(
    frames: Sequence[tuple[FloatArray, FloatArray]],
    stars: Callable[[int], StarCatalogue],
    width_px: int,
    height_px: int,
    ranges: Sequence[tuple[float, float]],
    folder: PathLike | None = None,
) -> tuple[FoundOptics, int, Patch] | None:
    """The focal length that frames agree on, and the surest frame with its stars; None where there
    is none.

    A frame is points (n, 2) from the detector's middle, brightest first, and their noise (n,), px.
    `stars` gives a catalogue of at least so many stars of the whole sky, or of all that there are.
    `ranges` are focal lengths, px, to look for first in the first, then in the next; no level of
    the catalogue is searched twice for one range. The catalogue's patterns are kept in a `folder`
    where there is one.

    A frame alone counts where chance makes what it shows less than once in 10^9; otherwise two must
    agree.
    """
    probes = _probes([len(points) for points, _ in frames])
    if not probes:
        return None
    search: BlindSearch | None = None
    for limits in ranges:
        for low, high in pairwise((0, *_GROUPS)):
            sizes = [
                n for n in LEVELS if low < n <= high and _useful(n, width_px * height_px, limits)
            ]
            if not sizes:
                continue
            catalogue = stars(sizes[-1])
            if search is None or catalogue is not search.stars:
                search = BlindSearch(catalogue, width_px, height_px, folder)
            sizes = [n for n in sizes if n <= len(catalogue)]
            found = _agreed(search, frames, probes, sizes, limits)
            if found is not None:
                return found
    return None


def _useful(n: int, detector_px2: float, focal_px: tuple[float, float]) -> bool:
    """Whether a field shows so many of a level's stars, at some focal length, that a pattern may be
    among them.
    """
    least, most = (n * detector_px2 / (4.0 * pi * f * f) for f in reversed(focal_px))
    return least < _MOST_IN_FIELD * _BRIGHTEST[-1] and most > 4.0 * _LEAST_IN_FIELD


def _probes(n_stars: Sequence[int]) -> list[int]:
    """Frames to be searched: those with most stars, and others of all kinds, because most may be
    clouds or trees.
    """
    useful = (k for k, n in enumerate(n_stars) if n >= _LEAST_STARS)
    order = sorted(useful, key=lambda k: -n_stars[k])
    half = _PROBES // 2
    rest = order[half:]
    return order[:half] + [rest[i * len(rest) // half] for i in range(min(half, len(rest)))]


def _agreed(
    search: BlindSearch,
    frames: Sequence[tuple[FloatArray, FloatArray]],
    probes: Sequence[int],
    sizes: list[int],
    limits: tuple[float, float],
) -> tuple[FoundOptics, int, Patch] | None:
    """What frames agree on, with the patterns of these levels."""
    votes: list[_Vote] = []
    for k in probes:
        vote = _vote(search, frames[k], k, sizes, limits, (False, True))
        if vote is None:
            continue
        votes.append(vote)
        near = vote.focal_px * (1.0 - AGREEMENT), vote.focal_px * (1.0 + AGREEMENT)
        same = [v for v in votes if v.mirrored == vote.mirrored and near[0] < v.focal_px < near[1]]
        others = [other for other in probes if other not in {v.frame for v in votes}]
        for other in others:
            if len(same) >= _ENOUGH:
                break
            second = _vote(search, frames[other], other, sizes, near, (vote.mirrored,))
            same += [] if second is None else [second]
        if len(same) > 1 or vote.solved.log10_false < _ALONE:
            # The median of two is one of them, so that it is a focal length that was seen.
            focal = sorted(v.focal_px for v in same)[(len(same) - 1) // 2]
            bend = max(abs(v.solved.bend_px) for v in same)
            best = min(same, key=lambda v: v.solved.log10_false)
            odds = best.solved.log10_false
            optics = FoundOptics(focal, vote.mirrored, len(same), len(probes), bend, odds)
            return optics, best.frame, best.solved.patch
    return None


def _vote(
    search: BlindSearch,
    frame: tuple[FloatArray, FloatArray],
    number: int,
    sizes: list[int],
    limits: tuple[float, float],
    parities: Sequence[bool],
) -> _Vote | None:
    points, sigma = frame
    for mirrored in parities:
        solved = search.solve(points * [-1.0, 1.0] if mirrored else points, sigma, sizes, limits)
        if solved is not None:
            return _Vote(number, mirrored, solved)
    return None
