"""From a hypothesis to matched stars: the rest of the stars, refined camera and attitude, and the
odds of chance.

In ideal pixels u (offsets from the nominal principal point, nominal distortion removed) a star at
direction r is at

    u = F p (1 + kappa |p|^2 / |p_c|^2 / (F |p_c|)) + d,    p = (q_x, q_y) / q_z,    q = exp([phi]x)
    R r

with F the focal length, d the shift of the principal point, and kappa px of radial displacement at
the corner p_c. The parameters (phi, ln F, d, kappa) follow from damped least squares, the damping
being the stated tolerances.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import lgamma, log, pi
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.identification.brightness import unlike_brightness
from starcal_uq.identification.nearby import NearbyStars
from starcal_uq.identification.pyramid import SIGMAS, CameraTolerance, FieldGeometry, Hypothesis
from starcal_uq.maths.intervals import median_of

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Parameters after the three of the attitude: ln F, d_x, d_y, kappa.
N_SHARED = 4
# Catalogue and lens have errors of their own: no gate is narrower than for this noise.
_LEAST_GATE_SIGMA_PX = 0.1
# A star is ambiguous if the next one, on the sky or on the detector, is not this much farther in
# sigma^2: exp(-14).
_DISTINCT = 28.0


@dataclass(frozen=True, eq=False)
class CameraState:
    """Attitude (b = R r) and camera relative to the nominal one.

    `shared` (4,) are ln of the focal length over its nominal value, shift of the principal point
    (px), kappa (px).
    """

    rotation: FloatArray
    shared: FloatArray


@dataclass(frozen=True, eq=False)
class Match:
    """Stars of one frame: rows (m,) of its centroids and of the catalogue, with residuals (m, 2),
    px.

    `gate_px` is the largest distance accepted, for the centroid of median noise; `noise_scale` the
    noise found over that stated, at least 1; `log10_false` the decimal logarithm of the expected
    number of wrong attitudes on the whole sky that match as well. `n_ambiguous` centroids fit more
    than one star; `n_unlike_brightness` were left out because they are farther from their star, and
    less of its brightness, than chance explains; no match has more than `n_possible`, the
    centroids, or the stars in the field if those are fewer. `information` (4, 4) is on the shared
    parameters, attitude eliminated; times their best value it is `gradient` (4,).
    """

    state: CameraState
    centroid: IntArray
    star: IntArray
    residual_px: FloatArray
    gate_px: float
    noise_scale: float
    log10_false: float
    n_ambiguous: int
    n_unlike_brightness: int
    n_possible: int
    information: FloatArray
    gradient: FloatArray

    def __len__(self) -> int:
        return len(self.star)


def start_state(hypothesis: Hypothesis) -> CameraState:
    """The state that a hypothesis stands for."""
    return CameraState(hypothesis.rotation, np.array([np.log(hypothesis.scale), 0.0, 0.0, 0.0]))


def match_frame(
    tree: cKDTree,
    sigma_px: FloatArray,
    sky: NearbyStars,
    start: CameraState,
    tolerance: CameraTolerance,
    *,
    log10_wanted: float,
    mag: FloatArray | None = None,
    radial: bool = True,
    polished: bool = False,
) -> Match | None:
    """Match all centroids of a frame, the `tree` of their ideal pixels (n, 2), with a gate that
    shrinks to the noise.

    With instrumental magnitudes (n,), NaN where not known, doubtful matches of unlike brightness
    are left out. `radial` says whether kappa is fitted, and `polished` that `start` is good to the
    noise already, so that the gate starts small. None where fewer than four stars are matched, or
    where it shows on the way that there will be too few for less than ten to the `log10_wanted`
    false matches.
    """
    g, u = sky.geometry, tree.data
    focal = g.focal_px * float(np.exp(start.shared[0]))
    radius = float(np.arctan(1.03 * g.corner_px / focal)) + 1e-3
    depth = sky.depth(len(u))
    ranks = sky.around(start.rotation[2], radius, depth)
    if len(ranks) < 4:
        return None
    r = sky.directions[ranks]
    # None about the attitude.
    prior = np.concatenate([np.zeros(3), tolerance.information(radial)])
    bias = g.relative_bias(tolerance)
    # Each centroid has its own gate: a faint star may be farther off than a bright one.
    final = SIGMAS * np.maximum(sigma_px, _LEAST_GATE_SIGMA_PX)
    typical = float(median_of(final))
    wide = 2.0 * typical + 0.5 * bias * g.corner_px
    predicted = _predict(start, r, g)[0]
    predicted = predicted[_on_detector(predicted, g)]
    enough = _enough(len(u), len(predicted), depth, typical, g, tolerance, log10_wanted)
    # One look at what is near a centroid, where a match takes four fits.
    if np.isfinite(tree.query(predicted, distance_upper_bound=_WIDER * wide)[0]).sum() < enough:
        return None
    gates = (1.5 * final, final)
    if not polished:
        # One between them, where the first is much wider than the others.
        between = (0.5 * (wide + final),) if wide > _MUCH_WIDER * typical else ()
        gates = (wide + 0.0 * final, *between, *gates)
    state, noise_scale = start, 1.0
    centroid = star = np.empty(0, dtype=np.int64)
    for number, gate in enumerate(gates):
        predicted, _ = _predict(state, r, g)
        limit = np.maximum(gate, final * noise_scale)
        centroid, star, _ = _mutual(tree, predicted, limit)
        if len(star) < (enough if number else 4):
            return None
        state, e = _fit(state, _linearised(state, u, sigma_px, r, centroid, star, g), prior)
        if number >= len(gates) - 2:
            noise_scale = _noise_scale(e, sigma_px[centroid])
    predicted, _ = _predict(state, r, g)
    limit = final * noise_scale
    centroid, star, ambiguous = _mutual(
        tree, predicted, limit, (sigma_px * noise_scale) ** 2 * _DISTINCT
    )
    if len(star) < 4:
        return None
    e = u[centroid] - predicted[star]
    refused = np.zeros(len(star), dtype=np.bool_)
    if mag is not None:
        misfit = (
            np.sum(e * e, axis=1)
            / (np.maximum(sigma_px[centroid], _LEAST_GATE_SIGMA_PX) * noise_scale) ** 2
        )
        refused = unlike_brightness(mag[centroid] - sky.mag[ranks[star]], misfit)
    if refused.any():
        centroid, star = centroid[~refused], star[~refused]
        if len(star) < 4:
            return None
        state, e = _fit(state, _linearised(state, u, sigma_px, r, centroid, star, g), prior)
    information, gradient = _information(
        state, _linearised(state, u, sigma_px * noise_scale, r, centroid, star, g)
    )
    in_field = max(int(_on_detector(predicted, g).sum()), 4)
    density = in_field / (g.width_px * g.height_px)
    expected = log10_false_matches(
        len(u), len(star), density, depth, typical * noise_scale, g, tolerance
    )
    return Match(
        state,
        centroid,
        sky.rows[ranks[star]],
        e,
        typical * noise_scale,
        noise_scale,
        expected,
        int(ambiguous),
        int(refused.sum()),
        min(len(u), in_field),
        information,
        gradient,
    )


_MUCH_WIDER = 3.0
# At the start stars may lie this many times the first gate away, and this part of those wanted must
# be seen.
_WIDER, _SEEN = 1.5, 0.7


@lru_cache(maxsize=1024)
def _enough(
    n: int,
    in_field: int,
    depth: int,
    gate_px: float,
    g: FieldGeometry,
    tolerance: CameraTolerance,
    log10_wanted: float,
) -> int:
    """Stars of n centroids that are matched on the way to fewer than ten to the `log10_wanted`
    false matches.
    """
    density = max(in_field, 4) / (g.width_px * g.height_px)
    wanted = 4
    for wanted in range(4, n + 1):
        if log10_false_matches(n, wanted, density, depth, gate_px, g, tolerance) < log10_wanted:
            break
    # Of few, one may be missing.
    return max(4, min(wanted - 1, round(_SEEN * wanted)))


def _on_detector(predicted: FloatArray, g: FieldGeometry) -> BoolArray:
    """Which stars are on the detector, or just outside."""
    inside: BoolArray = np.all(
        np.abs(predicted) < 0.5 * np.array([g.width_px, g.height_px]) + 30.0, axis=1
    )
    return inside


def log10_false_matches(
    n: int,
    m: int,
    density_px2: float,
    n_sky: int,
    gate_px: float,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
) -> float:
    """Log10 of the number of wrong attitudes, on the whole sky, at which m of n centroids have a
    star within the gate.

    A first centroid is any of the `n_sky` stars, a second one any star at its distance within the
    tolerance of the focal length; each of the other m - 2 has a star within the gate with
    probability ``density pi gate^2``. What the free principal point and distortion can take up
    widens the gate.
    """
    length = 0.4 * max(geometry.width_px, geometry.height_px)
    bias = geometry.relative_bias(tolerance)
    area = pi * (gate_px**2 + (0.5 * bias * length) ** 2)
    ring = 2.0 * pi * length**2 * 2.0 * (tolerance.focal + bias + gate_px / length)
    hit = min(density_px2 * area, 1.0)
    return (log(n_sky) + log(density_px2 * ring) + (m - 2) * log(hit)) / log(10.0) + log10_choices(
        n, m
    )


def log10_choices(n: int, m: int) -> float:
    """Log10 of the ways to choose m of n."""
    return (lgamma(n + 1) - lgamma(m + 1) - lgamma(n - m + 1)) / log(10.0)


def _predict(state: CameraState, r: FloatArray, g: FieldGeometry) -> tuple[FloatArray, FloatArray]:
    """Ideal pixels (n, 2) of directions (n, 3), and tangent-plane coordinates (n, 2)."""
    q = r @ state.rotation.T
    p = q[:, :2] / q[:, 2:]
    log_scale, dx, dy, kappa = state.shared
    focal = g.focal_px * np.exp(log_scale)
    u = focal * p
    if kappa:
        u = u * (1.0 + kappa / g.corner_px**3 * np.einsum("ni,ni->n", u, u))[:, None]
    return u + np.array([dx, dy]), p


def _jacobian(state: CameraState, r: FloatArray, g: FieldGeometry) -> tuple[FloatArray, FloatArray]:
    """Predictions (n, 2) and derivatives (2, n, 7) with respect to phi, ln F, d and kappa."""
    u, p = _predict(state, r, g)
    x, y = p.T
    focal = g.focal_px * float(np.exp(state.shared[0]))
    j = np.zeros((2, len(r), 3 + N_SHARED))
    j[0, :, 0], j[0, :, 1], j[0, :, 2] = -x * y, 1.0 + x * x, -y
    j[1, :, 0], j[1, :, 1], j[1, :, 2] = -(1.0 + y * y), x * y, x
    j[:, :, :3] *= focal
    j[:, :, 3] = focal * p.T
    j[0, :, 4] = j[1, :, 5] = 1.0
    j[:, :, 6] = (
        focal * p.T * (np.einsum("ni,ni->n", p, p) * (focal / g.corner_px) ** 2 / g.corner_px)
    )
    return u, j


_Linear: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _linearised(
    state: CameraState,
    u: FloatArray,
    sigma_px: FloatArray,
    r: FloatArray,
    centroid: IntArray,
    star: IntArray,
    g: FieldGeometry,
) -> _Linear:
    """Residuals (2, m), their derivatives (2, m, q), weights (m,), and the weighted derivatives as
    rows (2 m, q).
    """
    predicted, j = _jacobian(state, r[star], g)
    weight = 1.0 / sigma_px[centroid]
    return (u[centroid] - predicted).T, j, weight, (j * weight[:, None]).reshape(-1, j.shape[2])


def _fit(state: CameraState, linear: _Linear, prior: FloatArray) -> tuple[CameraState, FloatArray]:
    """One damped Gauss-Newton step, and the residuals (m, 2) that it predicts."""
    e, j, weight, a = linear
    normal = a.T @ a
    normal.flat[:: len(normal) + 1] += prior
    gradient = a.T @ (e * weight).ravel()
    gradient[3:] -= prior[3:] * state.shared
    scale = 1.0 / np.sqrt(normal.diagonal())
    step = scale * np.linalg.solve(normal * scale * scale[:, None], gradient * scale)
    left = e - j @ step
    return CameraState(exp_rotation(step[:3]) @ state.rotation, state.shared + step[3:]), left.T


def _information(state: CameraState, linear: _Linear) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the shared parameters with the attitude eliminated."""
    e, _, weight, a = linear
    attitude, shared = a[:, :3], a[:, 3:]
    e = (e * weight).ravel()
    onto = np.linalg.solve(attitude.T @ attitude, attitude.T @ np.column_stack([shared, e]))
    rest = shared - attitude @ onto[:, :-1]
    information = rest.T @ rest
    return information, rest.T @ (e - attitude @ onto[:, -1]) + information @ state.shared


def _noise_scale(e: FloatArray, sigma_px: FloatArray) -> float:
    """Noise found over noise stated, from the median of the squared residuals; between 1 and 4.

    Less one standard deviation of that, so that chance does not widen the gates: false stars come
    with their area.
    """
    # Seven parameters were fitted, damped.
    m = len(e)
    noise = float(np.sqrt(noise_variance(np.sum(e * e, axis=1) / sigma_px**2, 2.5)))
    noise /= 1.0 + 0.5 / (np.log(2.0) * np.sqrt(m))
    return min(max(noise, 1.0), 4.0) if m >= 6 else 1.0


def noise_variance(squared: FloatArray, fitted: float) -> float:
    """Variance of the noise, from the median of squared whitened residuals (m,), of which `fitted`
    stars were used up by a fit: chi-square with two degrees of freedom has the median 2 ln 2.
    """
    share = max(1.0 - fitted / len(squared), 0.3)
    return float(median_of(squared)) / (2.0 * log(2.0) * share)


def _mutual(
    tree: cKDTree,
    predicted: FloatArray,
    limit_px: FloatArray,
    distinct_px2: FloatArray | None = None,
) -> tuple[IntArray, IntArray, int]:
    """Nearest mutual neighbours within limits (n,): centroids, stars, and how many were left out as
    ambiguous.

    `tree` is that of the centroids (n, 2), of which only those nearest to a star are looked at
    further.
    """
    u, farthest = tree.data, float(limit_px.max())
    if distinct_px2 is not None:
        # A star that is not the nearest one of any centroid may make another ambiguous.
        farthest = float(np.sqrt(farthest**2 + distinct_px2.max()))
    farthest *= 1.0 + 1e-9
    nearest_centroid = tree.query(predicted, distance_upper_bound=farthest)[1]
    near = np.flatnonzero(nearest_centroid < len(u))
    predicted, nearest_centroid = predicted[near], nearest_centroid[near]
    rows = np.unique(nearest_centroid[nearest_centroid < len(u)])
    if not len(rows):
        return rows.astype(np.int64), rows.astype(np.int64), 0
    d2 = (u[rows, 0, None] - predicted[:, 0]) ** 2 + (u[rows, 1, None] - predicted[:, 1]) ** 2
    star = np.argmin(d2, axis=1)
    nearest = d2[np.arange(len(rows)), star]
    mutual = (nearest_centroid[star] == rows) & (nearest <= limit_px[rows] ** 2)
    ambiguous = np.zeros(len(rows), dtype=np.bool_)
    if distinct_px2 is not None:
        next_star = (
            np.partition(d2, 1, axis=1)[:, 1] if d2.shape[1] > 1 else np.full(len(rows), np.inf)
        )
        next_centroid = tree.query(predicted[star], k=[2])[0][:, 0] ** 2
        ambiguous = mutual & (np.minimum(next_star, next_centroid) - nearest < distinct_px2[rows])
    keep = mutual & ~ambiguous
    return rows[keep].astype(np.int64), near[star[keep]].astype(np.int64), int(ambiguous.sum())
