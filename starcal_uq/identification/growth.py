"""From a patch of matched stars to the whole field: a lens that bends is learnt from the middle
outwards.

The stars that a search at any focal length matched lie where a pinhole is right to a pixel.
Attitude, focal length, principal point and two radial terms are fitted to them and predict the
stars around them, each with its uncertainty. A star is looked for within that, but only among as
many of the brightest as leave hardly one there by chance; the fit to all that are found reaches
farther, until nothing more is found. The number of brightest stars and centroids that are compared
follows from the uncertainty, at each place.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log, pi

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.fields import detector_corners
from starcal_uq.camera.projection import before_fold, forward_kernel, unproject_theta
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.identification.match import Match, log10_choices, noise_variance
from starcal_uq.identification.nearby import NearbyStars
from starcal_uq.identification.pyramid import SIGMAS, FieldGeometry
from starcal_uq.maths.intervals import median_of
from starcal_uq.maths.linear import scaled_inverse

# What is fitted; k1 and k2 are known to so much, as displacements at the corner in units of its
# distance.
_MODEL, _BEND_SD = "brown", (0.1, 0.05)
# Standard deviations of the logarithm of the focal length, and of the principal point in detector
# widths.
_FOCAL_SD, _CENTRE_SD = 0.05, 0.015
# Centroids met by chance in a gate, at the most, and those that are compared, for each star and in
# addition.
_CHANCE, _PER_STAR, _MORE = 0.1, 1.5, 8
# Rounds of fitting and matching, and steps of one fit.
_ROUNDS, _STEPS = 30, 4
# Catalogue and lens have errors of their own, px; and no lens of two terms that misses by more, in
# corner distances.
_LEAST_NOISE_PX, _WORST_NOISE = 0.1, 0.01
# A field is learnt from no fewer stars: twice as many numbers as are fitted, and some more.
_LEAST_STARS = 12


@dataclass(frozen=True, eq=False)
class Patch:
    """Stars of one frame that are matched: rows (m,) of its centroids, brightest first, and
    directions (m, 3).

    `rotation` (3, 3) is its attitude, b = R r.
    """

    rotation: FloatArray
    focal_px: float
    centroid: IntArray
    directions: FloatArray


def matched_patch(match: Match, focal_px: float, directions: FloatArray) -> Patch:
    """The patch of a match with a camera of this focal length, from the catalogue's directions."""
    focal = focal_px * exp(match.state.shared[0])
    return Patch(match.state.rotation, focal, match.centroid, directions[match.star])


@dataclass(frozen=True, eq=False)
class GrownField:
    """A camera as one frame shows it, with the covariance of its parameters, and the stars that
    show it.

    `log10_false` is the decimal logarithm of the number of wrong attitudes on the whole sky, with
    any such lens, that are expected to match as well.
    """

    camera: Camera
    covariance: FloatArray
    patch: Patch
    log10_false: float

    @property
    def bend_px(self) -> float:
        """Displacement at the detector's corner."""
        corner = self.camera.corner_radius_px
        return float(np.dot(self.camera.coefficients, (corner**3, corner**5)))


@dataclass(frozen=True, eq=False)
class _Fit:
    theta: FloatArray
    rotation: FloatArray
    covariance: FloatArray
    noise: float


def grow(
    xy: FloatArray, sigma_px: FloatArray, patch: Patch, sky: NearbyStars, camera: Camera
) -> GrownField | None:
    """The camera of a frame, centroids (n, 2) with noise (n,), px, brightest first, from its
    matched patch.

    `sky` is searched as deep as the frame needs; `camera` gives size, pitch and name, and the
    principal point that is expected. None where too few stars are matched, or where they do not
    determine the lens.
    """
    corner, area = camera.corner_radius_px, float(camera.width_px * camera.height_px)
    sigma = np.hypot(sigma_px, _LEAST_NOISE_PX)
    prior = _prior(camera, patch.focal_px)
    fit = _Fit(prior[0], patch.rotation, np.empty(0), 1.0)
    centroid, r = patch.centroid, patch.directions
    best, seen = 0, set[bytes]()
    for _ in range(_ROUNDS):
        fit = _fitted(fit, xy[centroid], sigma[centroid], r, prior)
        noise = fit.noise * sigma
        if float(median_of(noise)) > _WORST_NOISE * corner:
            return None
        stars = _in_field(fit, sky, camera, len(xy))
        centroid, rank = _near(fit, xy, noise, sky.directions[stars], area)
        r = sky.directions[stars[rank]]
        key = centroid.tobytes() + stars[rank].tobytes()
        if len(centroid) < _LEAST_STARS or key in seen:
            break
        seen.add(key)
        best = max(best, len(centroid))
    if len(centroid) < max(_LEAST_STARS, best // 2):
        return None
    fit = _fitted(fit, xy[centroid], sigma[centroid], r, prior)
    grown = camera.replace(distortion=_MODEL).with_theta(fit.theta)
    # No lens shows the detector's corners more than once.
    if not np.isfinite(unproject_theta(_MODEL, fit.theta, detector_corners(camera))).all():
        return None
    typical = fit.noise * float(median_of(sigma))
    expected = _log10_false(
        len(xy), len(centroid), len(stars), sky.depth(len(xy)), typical, area, len(fit.theta)
    )
    found = Patch(fit.rotation, grown.focal_px, centroid, r)
    return GrownField(grown, fit.covariance, found, expected)


def _prior(camera: Camera, focal_px: float) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviations (p,) of the camera's parameters."""
    corner = camera.corner_radius_px
    centre = _CENTRE_SD * camera.width_px
    sd = [centre, centre, _FOCAL_SD * focal_px, _BEND_SD[0] / corner**2, _BEND_SD[1] / corner**4]
    return np.array([*camera.centre_px, focal_px, 0.0, 0.0]), np.array(sd)


def _fitted(
    fit: _Fit,
    xy: FloatArray,
    sigma: FloatArray,
    r: FloatArray,
    prior: tuple[FloatArray, FloatArray],
) -> _Fit:
    """Least squares with the prior, of stars (m, 2) with directions (m, 3), and the noise that they
    show.
    """
    mean, sd = prior
    # Offsets count in units of the prior, angles in pixels.
    scale = np.concatenate([sd, np.full(3, 1.0 / mean[2])])
    theta, rotation, noise = fit.theta, fit.rotation, fit.noise
    m, p = len(xy), len(mean)
    inverse = np.eye(p + 3)
    for _ in range(_STEPS):
        b = np.ascontiguousarray((r @ rotation.T).T)
        place, d_theta, d_phi = forward_kernel(_MODEL, "first")(m, theta, b, np.zeros(2))
        e = (xy.T - place) / sigma
        noise = max(1.0, float(np.sqrt(noise_variance(np.sum(e * e, axis=0), 4.0))))
        weight = np.minimum(1.0, SIGMAS * noise / np.maximum(np.hypot(*e), 1e-9)) / noise**2
        j = np.concatenate([d_theta, d_phi]).reshape(p + 3, 2, m) / sigma * scale[:, None, None]
        normal = np.einsum("iam,jam,m->ij", j, j, weight)
        gradient = np.einsum("iam,am,m->i", j, e, weight)
        normal[range(p), range(p)] += 1.0
        gradient[:p] -= (theta - mean) / sd
        inverse = scaled_inverse(normal)
        step = scale * (inverse @ gradient)
        theta, rotation = theta + step[:p], exp_rotation(step[p:]) @ rotation
    return _Fit(theta, rotation, inverse * scale * scale[:, None], noise)


def _in_field(fit: _Fit, sky: NearbyStars, camera: Camera, n_centroids: int) -> IntArray:
    """Stars, by brightness, that fall on the detector."""
    focal = float(fit.theta[2])
    geometry = FieldGeometry(focal, camera.width_px, camera.height_px, camera.corner_radius_px)
    sky = sky.seen_by(geometry)
    # What barrel distortion draws in stands at most half as far out again.
    radius = float(np.arctan(1.5 * camera.corner_radius_px / focal))
    ranks = np.sort(sky.around(fit.rotation[2], radius, sky.depth(n_centroids)))
    b = np.ascontiguousarray((sky.directions[ranks] @ fit.rotation.T).T)
    (place,) = forward_kernel(_MODEL, "value")(len(ranks), fit.theta, b, np.zeros(2))
    inside = camera.contains(place.T) & before_fold(_MODEL, fit.theta, focal * b[:2] / b[2])
    return ranks[inside]


def _near(
    fit: _Fit, xy: FloatArray, noise: FloatArray, r: FloatArray, area: float
) -> tuple[IntArray, IntArray]:
    """Centroids and stars, by rank in brightness of directions (n, 3), where the one is predicted
    from the other.
    """
    from scipy.spatial import cKDTree

    n = len(r)
    b = np.ascontiguousarray((r @ fit.rotation.T).T)
    place, d_theta, d_phi = forward_kernel(_MODEL, "first")(n, fit.theta, b, np.zeros(2))
    j = np.concatenate([d_theta, d_phi]).reshape(len(fit.covariance), 2, n)
    # Of the two axes the mean, which is what the area of the gate is made of.
    spread = 0.5 * np.einsum("ian,ik,kan->n", j, fit.covariance, j)
    gate = SIGMAS * np.sqrt(float(median_of(noise)) ** 2 + spread)
    # As many stars as leave little to chance, in steps of two: each step has its own centroids.
    level = np.exp2(np.floor(np.log2(np.maximum(_CHANCE * area / (pi * gate**2), 1.0)))).astype(
        np.int64
    )
    used = np.flatnonzero(np.arange(n) < level)
    level = np.minimum(level, int(np.exp2(np.ceil(np.log2(max(n, len(xy), 1))))))
    centroid = np.full(n, -1)
    miss = np.full(n, np.inf)
    for size in np.unique(level[used]):
        rows = used[level[used] == size]
        distance, nearest = cKDTree(xy[: int(_PER_STAR * size) + _MORE]).query(place[:, rows].T)
        hit = distance < gate[rows]
        centroid[rows[hit]], miss[rows[hit]] = nearest[hit], distance[hit] / gate[rows[hit]]
    star = np.flatnonzero(centroid >= 0)
    # Of stars with the same centroid the nearest.
    star = star[np.argsort(miss[star], kind="stable")]
    first = np.unique(centroid[star], return_index=True)[1]
    star = star[first]
    return centroid[star], star


def _log10_false(
    n: int, m: int, in_field: int, n_sky: int, noise_px: float, area: float, n_lens: int
) -> float:
    """Log10 of the wrong attitudes on the sky, with any lens, at which m of n centroids have a star
    within the gate.

    Attitude and lens are free to be right for half as many stars as they have numbers: a first one
    is any of the sky, the others any of the field. The rest are met by chance.
    """
    free = (n_lens + 3 + 1) // 2
    hit = min(in_field / area * pi * (SIGMAS * noise_px) ** 2, 1.0)
    return (log(n_sky) + (free - 1) * log(max(in_field, 2)) + (m - free) * log(hit)) / log(
        10.0
    ) + log10_choices(n, m)
