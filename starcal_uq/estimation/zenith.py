"""Zeniths that explain the images best where refraction may be in them: of one place for all
frames, and of each frame by itself.

Gauss-Newton steps with Levenberg's damping, from the best place of a grid, or from what the shears
of single frames say: refraction k (1 + t t^T) with t the tangent of the zenith distance has shears
of k t^2 / 2, along the direction to the zenith or away from it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.earth import LOWEST, air_constants, normalised, sphere
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.fitted_effects import Effects, FoundAir
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import View
from starcal_uq.likelihood.zenith import Zeniths, frame_axes

if TYPE_CHECKING:
    from starcal_uq.core.types import FloatArray
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Places of the grid; frames that get a zenith each, and fewest stars that tell one. What noise does
# to the density of the air by way of each frame's zenith is known to first order: of more frames,
# what is left of it would exceed the errors.
_PLACES, _APIECE, _FEWEST = 500, 12, 4
_STEPS, _SETTLED = 30, 0.05
# Half width of differences, rad.
_STEP_RAD = 0.02
# Tangents of a zenith's distance from which a frame's search starts.
_TANGENTS = (0.2, 3.0)


class Images:
    """Images of some frames around an estimate, and what of shifts attitudes and parameters leave."""

    def __init__(self, obs: Observations, cal: Calibration, rotations: FloatArray) -> None:
        self.obs = obs
        self.likelihood = MarginalLikelihood(obs, cal.camera.distortion, axes=True)
        self.state, _ = self.likelihood.profile(cal.theta, rotations)
        self.view = View.of(self.likelihood, self.state, cal.theta, slice(None))
        self.slopes = self.likelihood.slopes(cal.theta, self.state)
        h = self.slopes.reshape(len(cal.theta), -1)
        self._basis = np.linalg.qr((h / np.linalg.norm(h, axis=1)[:, None]).T)[0]
        e = self.likelihood.project_out(self.state, self.state.e[None])
        self.e = self.left(e)[0]
        self.sigma = float(np.sqrt(self.e @ self.e / max(self.likelihood.dof - len(h), 1)))

    def left(self, columns: FloatArray) -> FloatArray:
        """Whitened columns (q, 2, N) without attitudes, as (q, 2 N) without parameters."""
        flat = columns.reshape(len(columns), -1)
        return np.asarray(flat - (flat @ self._basis) @ self._basis.T)

    def of_air(self, zeniths: Zeniths) -> FloatArray:
        """What is left of the columns of the effect, (m, 2 N)."""
        columns = zeniths.shape(self.obs).columns(self.view)
        self.likelihood.frames.whiten(columns)
        return self.left(self.likelihood.project_out(self.state, columns))

    def by_frame(self, zeniths: Zeniths) -> FloatArray:
        """Products (K, 3, 3) of the columns of zeniths of single frames, attitudes removed."""
        columns = zeniths.shape(self.obs).columns(self.view)[:-1]
        frames = self.likelihood.frames
        # Every frame has three of its own, which are zero elsewhere.
        own = columns.reshape(3, -1, *columns.shape[1:]).sum(axis=1)
        frames.whiten(own)
        own = self.likelihood.project_out(self.state, own)
        return products_by_frame(frames, own, own)

    @property
    def boresights(self) -> FloatArray:
        """Boresights (K, 3), ICRS axes."""
        return self.state.rotations[:, 2]


def candidates(obs: Observations, cal: Calibration, rotations: FloatArray) -> list[Zeniths]:
    """Zeniths of one place and of each frame, as far as the table allows them.

    `rotations` (K, 3, 3): attitudes. None where refraction is in the directions, or cannot be; none
    of one place where from none all stars were above the horizon. That directions are apparent is
    what a user states, and the frames may show otherwise.
    """
    origin = obs.origin
    if origin.air == "corrected" or origin.without_air or origin.simulated or obs.n_frames == 0:
        return []
    images = Images(obs, cal, rotations)
    axes, timed = frame_axes(obs)
    found = []
    places = _possible(images, axes)
    if len(places):
        start = Zeniths(obs.frame_ids, axes, places[:1], timed)
        found.append(_settled(images, _best_place(images, start, places)))
    if 1 < obs.n_frames <= _APIECE and obs.stars_per_frame.min() >= _FEWEST:
        level = np.tile(np.eye(3), (obs.n_frames, 1, 1))
        start = Zeniths(obs.frame_ids, level, images.boresights, False)
        found.append(_settled(images, _by_shears(images, start)))
    return found


def _possible(images: Images, axes: FloatArray) -> FloatArray:
    """Places (g, 3) of a grid from which all stars were above the horizon."""
    frames, places = images.likelihood.frames, sphere(_PLACES)
    lowest = np.full(len(places), np.inf)
    for k, (first, last) in enumerate(zip(frames.starts[:-1], frames.starts[1:], strict=True)):
        seen = places @ (axes[k] @ frames.r[:, first:last])
        lowest = np.minimum(lowest, seen.min(axis=1))
    return places[lowest > LOWEST]


def _best_place(images: Images, start: Zeniths, places: FloatArray) -> Zeniths:
    """The place of a grid (g, 3) whose air explains the most."""
    trials = [replace(start, places=place[None]) for place in places]
    return trials[int(np.argmin([_cost(images, trial) for trial in trials]))]


def _by_shears(images: Images, start: Zeniths) -> Zeniths:
    """Zeniths that the shears of single frames point to, on either side."""
    frames, state, k = images.likelihood.frames, images.state, images.likelihood.frames.n_frames
    u, v = state.b[:2] / state.b[2]
    rates = np.zeros((2, 3, frames.n_stars))
    # Angles that grow as (u, -v) and as (v, u), as moves of the stars across the boresight.
    rates[0, :2], rates[1, :2] = (u, -v), (v, u)
    moved = np.cross(state.b[None], rates, axis=1)
    shifts = np.einsum("ixn,ain->axn", state.attitude, moved)
    number = np.repeat(np.arange(k), frames.sizes)
    apart = np.zeros((2, k, 2, frames.n_stars))
    apart[:, number, :, np.arange(frames.n_stars)] = shifts.transpose(2, 0, 1)
    columns = images.left(images.likelihood.project_out(state, apart.reshape(2 * k, 2, -1)))
    shear = np.linalg.lstsq(columns.T, images.e)[0].reshape(2, k)
    # Refraction moves stars to the zenith, so that the field shrinks along that way.
    tangent = np.clip(np.sqrt(2.0 * np.hypot(*shear) / air_constants()[0]), *_TANGENTS)
    angle = 0.5 * np.arctan2(-shear[1], -shear[0])
    across = np.stack([tangent * np.cos(angle), tangent * np.sin(angle), np.ones(k)], axis=1)
    return replace(start, places=normalised(np.einsum("kji,kj->ki", state.rotations, across)))


def _cost(images: Images, zeniths: Zeniths) -> float:
    """Chi-square with air below these zeniths, density and choice of a side the best ones."""
    moves = zeniths.sizes[0]
    columns = images.of_air(zeniths)[moves:] / images.sigma
    mean, prior = zeniths.mean[moves:], zeniths.prior[moves:]
    e = images.e / images.sigma - mean @ columns
    step = np.linalg.solve(columns @ columns.T + np.diag(prior**-2), columns @ e)
    return float(e @ e - step @ (columns @ e))


def _settled(images: Images, zeniths: Zeniths) -> Zeniths:
    """The zeniths near to these whose air explains the most."""
    known, least, damping, trial = zeniths, np.inf, 1e-3, zeniths
    for _ in range(_STEPS):
        cost = _cost(images, trial)
        if cost < least:
            gained, known, least, damping = least - cost, trial, cost, 0.2 * damping
            if gained < _SETTLED:
                break
            columns = images.of_air(known) / images.sigma
            pull = columns @ (images.e / images.sigma - known.mean @ columns)
            matrix = columns @ columns.T + np.diag(known.prior**-2)
        else:
            damping *= 10.0
        diagonal = np.diag(matrix)
        trial = known.moved(
            np.linalg.solve(matrix + np.diag(damping * diagonal), pull), images.boresights
        )
    return known


def pulled(images: Images, zeniths: Zeniths, sigma: float) -> Zeniths:
    """Zeniths of single frames with the slopes of the volume that the data leave to them.

    Noise lengthens the shears of frames, and so takes zeniths too far from the boresight, all of
    them alike: the density of the air would come out too small. What the images leave open of a
    zenith is a larger part of the sky where it is nearer; integrated over the sky it balances that.
    """
    if not zeniths.apiece:
        return zeniths
    n, precision = len(zeniths.places), np.diag(zeniths.prior[[0, 0, -2]] ** -2)

    def volume(step: FloatArray) -> FloatArray:
        turned = np.zeros(len(zeniths.prior))
        turned[: 2 * n] = np.repeat(step, n)
        moved = zeniths.moved(turned, images.boresights)
        found = images.by_frame(moved) / sigma**2
        return np.asarray(-0.5 * np.linalg.slogdet(found + precision)[1])

    slopes = [volume(step) - volume(-step) for step in _STEP_RAD * np.eye(2)]
    products = images.by_frame(zeniths) / sigma**2
    left = np.linalg.solve(products + precision, products)
    density = -float(np.trace(left[:, :2, :2], axis1=1, axis2=2).sum())
    pull = np.concatenate([np.ravel(slopes) / (2.0 * _STEP_RAD), np.zeros(n), [density]])
    return replace(zeniths, pull=pull)


def found_air(effects: Effects, zeniths: Zeniths, rotations: FloatArray) -> FoundAir:
    """The air of estimated effects; `rotations` (K, 3, 3) are the attitudes of the frames."""
    place = effects.at("zenith")
    coefficients, covariance = effects.coefficients[place], effects.covariance[place, place]
    n = zeniths.sizes[0] // 2
    moves = np.stack([covariance[[i, i, n + i, n + i], [i, n + i, i, n + i]] for i in range(n)])
    worst = np.sqrt(np.linalg.eigvalsh(moves.reshape(n, 2, 2))[:, 1])
    level = np.sum(zeniths.among_stars * rotations[:, 2], axis=1)
    distances = np.degrees(np.arccos(np.clip(level, -1.0, 1.0)))
    found = FoundAir(
        "frames" if zeniths.apiece else "place" if zeniths.timed else "moment",
        float(coefficients[-1]),
        float(np.sqrt(covariance[-1, -1])),
        float(distances.min()),
        float(distances.max()),
        float(np.degrees(np.median(worst))),
    )
    if zeniths.apiece:
        return found
    x, y, z = zeniths.moved(coefficients, rotations[:, 2]).places[0]
    north, east = np.degrees(np.sqrt(np.diag(covariance)[:2]))
    found = replace(
        found, latitude_deg=float(np.degrees(np.arcsin(z))), latitude_std_deg=float(north)
    )
    if not zeniths.timed:
        return found
    return replace(
        found,
        longitude_deg=float(np.degrees(np.arctan2(y, x))),
        longitude_std_deg=float(east / max(np.hypot(x, y), 1e-3)),
    )
