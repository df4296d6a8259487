"""The pyramid search: from bare centroids to hypotheses about attitude and focal length.

After Mortari, Samaan, Bruccoleri & Junkins 2004, Navigation 51(3), 171-183: triangles of centroids,
in an order that does not stay with one centroid, so that a false one costs little; a triangle is
looked up in the catalogue by its sides, and a fourth star confirms it. Here the focal length is
only known within a tolerance. Each catalogue pair that may be the first side fixes it, and the
other sides are compared after dividing by it: their tolerance holds only noise, the shift of the
principal point and distortion.

Points are *ideal pixels*: offsets from the principal point, with the distortion of the nominal
camera removed, shape (n, 2); the direction is (x, y, f).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.identification.pairs import StarPairs, angle_between

# Tolerances hold this many standard deviations.
SIGMAS = 3.5
# Triangles of this many successive ones in Mortari's order are taken by size, small ones first.
_GROUP = 10
# A base shorter than this share of the detector's width fixes the focal length badly.
_LEAST_BASE = 0.12
# Hypotheses of one triangle that are handed on, those with most support.
_HANDED_ON = 6
# Catalogue triangles that one search of a frame looks at. More than three times as many as any that
# found an attitude took; so many fit by chance where the camera is too little known for the noise,
# and more of them would say no more.
_MOST_CANDIDATES = 100_000
# Pairs of the catalogue that one search of a frame tries as a base: twice as many as any took in
# fields of two degrees and more, half of whose brightest detections were false.
_MOST_PAIRS = 5_000_000


@dataclass(frozen=True)
class CameraTolerance:
    """How far the camera may be from its nominal values.

    Relative error of the focal length, error of the principal point per axis, px, and unknown
    displacement at the farthest corner, px.
    """

    focal: float
    centre_px: float
    distortion_px: float

    def information(self, radial: bool) -> FloatArray:
        """Information (4,) on ln F, d and kappa, the tolerances being two standard deviations;
        kappa is known to be zero where it is not `radial`.
        """
        last = self.distortion_px if radial else 2e-6
        sd = 0.5 * np.array([self.focal, self.centre_px, self.centre_px, last])
        return floats(np.maximum(sd, 1e-9) ** -2.0)

    def at_most(self, focal: float, centre_px: float, distortion_px: float) -> CameraTolerance:
        """These tolerances where they are smaller."""
        return CameraTolerance(
            min(focal, self.focal),
            min(centre_px, self.centre_px),
            min(distortion_px, self.distortion_px),
        )


@dataclass(frozen=True)
class FieldGeometry:
    """The nominal camera as the search sees it; `corner_px` is from the principal point."""

    focal_px: float
    width_px: float
    height_px: float
    corner_px: float

    def relative_bias(self, tolerance: CameraTolerance) -> float:
        """By how much the scale may vary over the field, from principal point and distortion."""
        shift = tolerance.centre_px * max(self.width_px, self.height_px) / self.focal_px**2
        return shift + 2.0 * tolerance.distortion_px / self.corner_px


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An attitude to be verified: rotation (3, 3), b = R r, and the focal length over its nominal
    value.
    """

    rotation: FloatArray
    scale: float


def mortari_order(n: int) -> IntArray:
    """Triangles of n centroids, (n choose 3, 3), in Mortari's order: neighbours in the list first,
    and none twice.
    """
    triangles = [
        (i, i + dj, i + dj + dk)
        for dj in range(1, n - 1)
        for dk in range(1, n - dj)
        for i in range(n - dj - dk)
    ]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def first_order(n: int, more: bool) -> IntArray:
    """The triangles of a first search among n centroids: all of them, or the first half where there
    are more centroids.

    Half of the triangles find what most of them would; the rest are better spent on other
    centroids.
    """
    triangles = mortari_order(n)
    return triangles[: len(triangles) // 2] if more else triangles


def remaining_order(n: int, searched: int) -> IntArray:
    """Triangles of n centroids whose numbers are all even or all odd, without those of a first
    search.

    A quarter of all triangles, and yet any five true stars have three of one parity among them.
    """
    triangles = mortari_order(n)
    parity = triangles % 2
    kept = triangles[np.all(parity == parity[:, :1], axis=1)]
    done = {tuple(three) for three in first_order(searched, n > searched).tolist()}
    return np.array(
        [three for three in kept.tolist() if tuple(three) not in done], dtype=np.int64
    ).reshape(-1, 3)


def hypotheses(
    pairs: StarPairs,
    points: FloatArray,
    sigma_px: FloatArray,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
    max_centroids: int,
    searched: int,
) -> Iterator[list[Hypothesis]]:
    """For each triangle, the hypotheses that a fourth star supports, best first.

    Triangles are made of the first `max_centroids` of `points` (n, 2), ideal pixels, brightest
    first; only those that a search of the first `searched` has left (`remaining_order`). Ends where
    too many pairs or triangles of the catalogue fit.
    """
    n = min(len(points), max_centroids)
    if n < 4:
        return
    triangles = remaining_order(n, searched) if searched else first_order(n, len(points) > n)
    u, sigma = points[:n], sigma_px[:n]
    b = unit_directions(u, np.array([geometry.focal_px]))[0]
    angle = angle_between(b[:, None], b[None])
    length = np.hypot(*(u[:, None] - u[None]).transpose(2, 0, 1))
    bases: dict[tuple[int, int], tuple[IntArray, IntArray, FloatArray]] = {}
    left, pairs_left = _MOST_CANDIDATES, _MOST_PAIRS
    for triangle in _sorted_triangles(triangles, length, geometry):
        candidates = _look_up(triangle, b, angle, sigma, pairs, geometry, tolerance, bases)
        left -= len(candidates)
        pairs_left -= len(bases[_key(triangle)][0])
        if left < 0 or pairs_left < 0:
            return
        if len(candidates):
            yield _supported(
                triangle, candidates, u, sigma, angle, length, pairs, geometry, tolerance
            )


def _sorted_triangles(
    triangles: IntArray, length: FloatArray, geometry: FieldGeometry
) -> list[tuple[int, int, int]]:
    """Triangles as (i, j, k) with the base i-j: the shortest side that is long enough, otherwise
    the longest.

    Star k is nearer to i than to j, which leaves the fewest stars to look at.
    """
    sides = np.array([(0, 1, 2), (1, 2, 0), (2, 0, 1)])
    options = triangles[:, sides]
    size = length[options[..., 0], options[..., 1]]
    enough = size >= _LEAST_BASE * geometry.width_px
    rank = np.where(enough, size, np.where(enough.any(axis=1, keepdims=True), np.inf, -size))
    best = np.argmin(rank, axis=1)
    rows = np.arange(len(triangles))
    chosen, base = options[rows, best], size[rows, best]
    order = np.lexsort((base, rows // _GROUP))
    return [
        (i, j, k) if length[i, k] <= length[j, k] else (j, i, k)
        for i, j, k in chosen[order].tolist()
    ]


def _key(triangle: tuple[int, int, int]) -> tuple[int, int]:
    """The base of a triangle, in ascending order."""
    return min(triangle[:2]), max(triangle[:2])


def _look_up(
    triangle: tuple[int, int, int],
    b: FloatArray,
    angle: FloatArray,
    sigma: FloatArray,
    pairs: StarPairs,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
    bases: dict[tuple[int, int], tuple[IntArray, IntArray, FloatArray]],
) -> IntArray:
    """Catalogue triangles (m, 3) with these sides and this handedness; `bases` keeps the pairs for
    each base.
    """
    i, j, k = triangle
    f, bias = geometry.focal_px, geometry.relative_bias(tolerance)
    noise = SIGMAS * np.sqrt(2.0) * float(max(sigma[i], sigma[j], sigma[k])) / f
    base = angle[i, j]
    key = _key(triangle)
    if key not in bases:
        slack = base * (tolerance.focal + bias) + SIGMAS * np.hypot(sigma[i], sigma[j]) / f
        low, high = np.searchsorted(pairs.angle, (base - slack, base + slack))
        one, two, size = pairs.first[low:high], pairs.second[low:high], pairs.angle[low:high] / base
        a, c = (
            np.concatenate([one, two], dtype=np.int64),
            np.concatenate([two, one], dtype=np.int64),
        )
        bases[key] = a, c, np.concatenate([size, size])
    a, c, scale = bases[key]
    near, far = angle[i, k], angle[j, k]
    near_tol, far_tol = (noise * np.hypot(1.0, side / base) + bias * side for side in (near, far))
    row, third = pairs.near_angle(a, scale * near, near_tol)
    second, expected = c[row], scale[row] * far
    keep = (
        np.abs(angle_between(pairs.directions[second], pairs.directions[third]) - expected)
        < far_tol
    )
    row, second, third = row[keep], second[keep], third[keep]
    candidates = np.column_stack([a[row], second, third])
    # A flat triangle has no handedness beyond the noise.
    volume = float(np.linalg.det(b[[i, j, k]]))
    if abs(volume) > 2.0 * noise * max(base, near, far):
        candidates = candidates[np.sign(_triple(pairs.directions, candidates)) == np.sign(volume)]
    return candidates


def _supported(
    triangle: tuple[int, int, int],
    candidates: IntArray,
    u: FloatArray,
    sigma: FloatArray,
    angle: FloatArray,
    length: FloatArray,
    pairs: StarPairs,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
) -> list[Hypothesis]:
    """Hypotheses with a fourth star among the bright centroids, those with most of them first."""
    i, j, k = corner = list(triangle)
    r = pairs.directions[candidates]
    perimeter = angle[i, j] + angle[j, k] + angle[k, i]
    measured = sum(angle_between(r[:, m], r[:, (m + 1) % 3]) for m in range(3)) / perimeter
    scale = 1.0 / measured
    b = unit_directions(u, geometry.focal_px * scale)
    # Roll from the longest side.
    p, q = max(((0, 1), (1, 2), (2, 0)), key=lambda side: length[corner[side[0]], corner[side[1]]])
    camera_axes = axes_of(b[:, corner], p, q)
    rotation = camera_axes.transpose(0, 2, 1) @ axes_of(r, p, q)
    others = np.delete(np.arange(len(u)), corner)
    sky = b[:, others] @ rotation
    span = length[corner[p], corner[q]]
    reach = np.hypot(*(u[others] - u[corner].mean(axis=0)).T)
    noise = float(np.max(sigma[corner]))
    gate_px = SIGMAS * np.hypot(sigma[others], noise * (1.0 + 1.5 * reach / span))
    gate_px = gate_px + geometry.relative_bias(tolerance) * (reach + span)
    gate = gate_px / geometry.focal_px
    distance, _ = pairs.tree.query(sky, distance_upper_bound=float(gate.max()))
    support = np.count_nonzero(distance < gate, axis=1)
    best = np.argsort(-support, kind="stable")
    best = best[support[best] > 0][:_HANDED_ON]
    return [Hypothesis(rotation[m], float(scale[m])) for m in best]


def unit_directions(u: FloatArray, focal_px: FloatArray) -> FloatArray:
    """Unit vectors (m, n, 3) of ideal pixels (n, 2) for focal lengths (m,)."""
    b = np.empty((len(focal_px), len(u), 3))
    b[..., :2] = u
    b[..., 2] = focal_px[:, None]
    b /= np.sqrt(np.einsum("mni,mni->mn", b, b))[..., None]
    return b


def _triple(directions: FloatArray, triangles: IntArray) -> FloatArray:
    """Triple products (m,) of triangles (m, 3)."""
    a, b, c = (directions[triangles[:, column]].T for column in range(3))
    return floats(np.einsum("im,im->m", a, _cross(b, c)))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


def axes_along(v: FloatArray, p: int, q: int) -> FloatArray:
    """Orthonormal axes (3 axes, 3, m) of sets of directions (3, k, m): towards the middle, and along
    the side from p to q.
    """
    z = v.sum(axis=1)
    z = z / np.sqrt(np.einsum("im,im->m", z, z))
    x = v[:, q] - v[:, p]
    x = x - np.einsum("im,im->m", x, z) * z
    x = x / np.sqrt(np.einsum("im,im->m", x, x))
    return np.stack([x, _cross(z, x), z])


def axes_of(v: FloatArray, p: int, q: int) -> FloatArray:
    """`axes_along` as matrices (m, 3 axes, 3), of directions (m, k, 3)."""
    return np.ascontiguousarray(axes_along(v.transpose(2, 1, 0), p, q).transpose(2, 0, 1))
