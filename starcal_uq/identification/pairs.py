"""Pairs of catalogue stars sorted by angle: what a pattern search looks things up in, kept on disk.

Patterns are made of the brightest stars of each neighbourhood only, so that a field holds about as
many of them everywhere on the sky. A range of angles is a slice of the sorted pairs (the purpose of
the k-vector of Mortari et al. 2004, reached by binary search). The neighbours of each star are
sorted by angle too, and a table of equal steps says where each step begins: thousands of questions
"which stars are at this angle from that star" are one look-up.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path
from starcal_uq.core.records import read_arrays
from starcal_uq.core.types import FloatArray, IntArray, PathLike

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

K = TypeVar("K")
V = TypeVar("V")
# Stars a field should hold; a star with this many brighter ones within a field's area around it is
# no pattern star.
PATTERN_STARS = 18
# Pairs that are listed at the most, about: in narrow fields, with most stars, those at larger
# angles are left out.
_MOST_PAIRS = 5_000_000
# Steps of angle in the table of neighbours of a star, and of all of them.
_STEPS, _ALL_STEPS = (8, 256), 1 << 22
# Pairs whose angles are computed together.
_AT_ONCE = 1 << 17
# Part of the key of every cache file: to be raised when the content or its meaning changes.
_VERSION = 2


@dataclass(frozen=True, eq=False)
class StarPairs:
    """Pattern stars and the angles between them; n stars, P pairs.

    `star` (n,) are rows of the catalogue; pairs are of pattern stars `first` and `second` (P,),
    sorted by `angle`, rad. `neighbour` (2 P,) are the partners of pattern star 0, then of star 1
    and so on, those of one star by increasing angle, with `neighbour_angle` (2 P,), rad;
    `neighbour_start` (n + 1,) is the first of each star.
    """

    star: IntArray
    directions: FloatArray
    first: NDArray[np.int32]
    second: NDArray[np.int32]
    angle: FloatArray
    neighbour: NDArray[np.int32]
    neighbour_angle: FloatArray
    neighbour_start: IntArray

    def __len__(self) -> int:
        return len(self.star)

    @property
    def fits(self) -> bool:
        n, p = len(self.star), len(self.angle)
        sizes = {
            "directions": n,
            "first": p,
            "second": p,
            "neighbour": 2 * p,
            "neighbour_angle": 2 * p,
            "neighbour_start": n + 1,
        }
        return all(len(getattr(self, name)) == size for name, size in sizes.items())

    def near_angle(
        self, star: IntArray, angle_rad: FloatArray, tolerance_rad: float
    ) -> tuple[IntArray, IntArray]:
        """Pattern stars at angles (m,) from pattern stars `star` (m,), each within the tolerance.

        Of each hit the index into `star`, and the pattern star, (h,) each.
        """
        edges, steps, per_rad = self._steps
        place = star * steps
        # NumPy's `clip` takes longer than these arrays of some thousand numbers deserve.
        first = np.maximum((angle_rad - tolerance_rad) * per_rad, 0.0).astype(np.int64)
        last = np.minimum((angle_rad + tolerance_rad) * per_rad, steps - 1.0).astype(np.int64)
        start = edges[place + np.minimum(first, steps - 1)]
        count = edges[place + last + 1] - start
        # A range beyond the largest angle is the last step, which the comparison below empties.
        some = np.flatnonzero(count > 0)
        question = np.repeat(some, count[some])
        row = rows_of(start[some], count[some])
        inside = np.flatnonzero(
            np.abs(self.neighbour_angle[row] - angle_rad[question]) <= tolerance_rad
        )
        return question[inside], self.neighbour[row[inside]]

    def ready(self) -> StarPairs:
        """The same, with what is derived made now, so that no frame waits for it."""
        _ = self.tree, self._steps
        return self

    @cached_property
    def tree(self) -> cKDTree:
        """The pattern stars as a tree of `directions`."""
        from scipy.spatial import cKDTree

        return cKDTree(self.directions)

    @cached_property
    def _steps(self) -> tuple[NDArray[np.int32], int, float]:
        """Where each step of each star's neighbours begins, (n * steps + 1,), the steps, and how
        many of them a rad.
        """
        steps = min(max(_ALL_STEPS // max(len(self), 1), _STEPS[0]), _STEPS[1])
        width = (float(self.angle[-1]) if len(self.angle) else 1.0) / steps * (1.0 + 1e-12)
        star = np.repeat(
            np.arange(len(self), dtype=np.int32) * np.int32(steps), np.diff(self.neighbour_start)
        )
        star += np.minimum(self.neighbour_angle * (1.0 / width), steps - 1.0).astype(np.int32)
        edges = np.zeros(len(self) * steps + 1, dtype=np.int32)
        np.cumsum(np.bincount(star, minlength=len(edges) - 1), out=edges[1:])
        return edges, steps, 1.0 / width


def rows_of(start: Any, count: Any) -> Any:
    """Rows of ranges, one range after the other."""
    total = np.cumsum(count)
    n = int(total[-1]) if len(total) else 0
    return np.arange(n) + np.repeat(start - (total - count), count)


def find_star_pairs(
    directions: FloatArray,
    mag: FloatArray,
    field_sr: float,
    max_angle_rad: float,
    per_field: int = PATTERN_STARS,
) -> StarPairs:
    """Choose pattern stars, `per_field` of them in a field of view, and list their pairs up to the
    largest angle.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    order = np.argsort(mag, kind="stable")
    # Twice as many as needed on average leaves enough far from the Milky Way.
    order = order[: int(np.ceil(2.5 * per_field * 4.0 * np.pi / field_sr))]
    near = (
        cKDTree(directions[order])
        .query_pairs(_chord(np.sqrt(field_sr / np.pi)), output_type="ndarray")
        .reshape(-1, 2)
    )
    brighter = np.bincount(near[:, 1], minlength=len(order))
    star = order[brighter < per_field].astype(np.int64)
    chosen = np.ascontiguousarray(directions[star])
    # Stars at random have n^2 (1 - cos angle) / 4 pairs, which is n^2 angle^2 / 8 where there are
    # many.
    max_angle_rad = min(max_angle_rad, float(np.sqrt(8.0 * _MOST_PAIRS) / max(len(star), 1)))
    pairs = (
        cKDTree(chosen)
        .query_pairs(_chord(max_angle_rad), output_type="ndarray")
        .reshape(-1, 2)
        .astype(np.int32)
    )
    angle = np.empty(len(pairs))
    for rows in (slice(k, k + _AT_ONCE) for k in range(0, len(pairs), _AT_ONCE)):
        angle[rows] = angle_between(chosen[pairs[rows, 0]], chosen[pairs[rows, 1]])
    rank = np.argsort(angle).astype(np.int32)
    pairs, angle = pairs[rank], angle[rank]
    # Equal angles in an order that does not depend on the library's.
    same = np.flatnonzero(np.diff(angle) == 0.0)
    same = np.union1d(same, same + 1)
    pairs[same] = pairs[same[np.lexsort((pairs[same, 1], pairs[same, 0], angle[same]))]]

    def by_star(values: Any) -> Any:
        """Values of both stars of each pair, star by star, those of one star in the order of angles,
        which transposing a sparse row keeps: by counts, without comparing.
        """
        ends = np.array([0, 2 * len(pairs)], dtype=np.int32)
        return csr_array((values, pairs.ravel(), ends), shape=(1, len(star))).tocsc()

    neighbour = by_star(pairs[:, ::-1].ravel())
    first, second = np.ascontiguousarray(pairs.T)
    start, angles = neighbour.indptr.astype(np.int64), by_star(np.repeat(angle, 2)).data
    return StarPairs(star, chosen, first, second, angle, neighbour.data, angles, start)


def angle_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles (...) in rad between unit vectors (..., 3), from the chord, which keeps its digits at
    small angles.
    """
    difference = a - b
    chord = np.sqrt(np.einsum("...i,...i->...", difference, difference))
    angle: FloatArray = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    return angle


def remembered(kept: dict[K, V], most: int, key: K, make: Callable[[], V]) -> V:
    """What was made for a key, of which the last ones are kept."""
    found = kept.pop(key, None)
    if found is None:
        found = make()
        while len(kept) >= most:
            del kept[next(iter(kept))]
    kept[key] = found
    return found


def digest_of(arrays: Iterable[FloatArray], *parameters: Any) -> str:
    """What something is made of, in 24 letters."""
    digest = hashlib.sha256(repr(parameters).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()[:24]


def cached_star_pairs(
    directions: FloatArray,
    mag: FloatArray,
    field_sr: float,
    max_angle_rad: float,
    folder: PathLike | None,
) -> StarPairs:
    """`find_star_pairs`, `cached` in the folder."""
    given = directions, mag, field_sr, max_angle_rad
    key = digest_of((directions, mag), _VERSION, field_sr, max_angle_rad, PATTERN_STARS)
    return cached(StarPairs, f"star-pairs-{key}", partial(find_star_pairs, *given), folder)


class Fitting(Protocol):
    """A dataclass of arrays."""

    @property
    def fits(self) -> bool:
        """Whether the arrays fit together."""


F = TypeVar("F", bound=Fitting)


def cached(kind: type[F], name: str, make: Callable[[], F], folder: PathLike | None) -> F:
    """A dataclass of arrays from a file of the `folder` where there is one, leaving one there where
    there is none; without a folder, one that is made.

    The `name` holds a hash of all that it is made of. A damaged file is replaced; a folder that
    cannot be written to does no harm.
    """
    if folder is None:
        return make()
    path = Path(folder) / f"{name}.npz"
    stored = _read(path, kind)
    if stored is not None:
        return stored
    made = make()
    # The cache only saves time: without it everything works.
    with suppress(OSError, RunFolderError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            np.savez(temporary, **{name: getattr(made, name) for name in _names(kind)})
    return made


def _names(kind: Any) -> list[str]:
    return [field.name for field in fields(kind)]


def _read(path: Path, kind: type[F]) -> F | None:
    """What is in a file; None where it is missing, damaged or does not fit together."""
    try:
        archive = read_arrays(path)
        found = kind(**{name: archive[name] for name in _names(kind)})
        return found if found.fits else None
    except Exception:  # whatever is wrong with a file of the cache, its content is made again
        return None


def _chord(angle_rad: float) -> float:
    return 2.0 * float(np.sin(0.5 * min(angle_rad, np.pi)))
