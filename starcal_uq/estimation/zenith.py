"""Zeniths that explain the images best where refraction may be in them: of one place for all
frames, and of each frame by itself.

Gauss-Newton steps with Levenberg's damping, from the best place of a grid, or from what the shears
of single frames say: refraction k (1 + t t^T) with t the tangent of the zenith distance has shears
of k t^2 / 2, along the direction to the zenith or away from it.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.attitude.earth import LOWEST, air_constants, normalised, sphere
from starcal_uq.core.types import floats
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.fitted_effects import FoundAir
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import Shape, View, frame_shapes
from starcal_uq.likelihood.star_errors import star_numbers
from starcal_uq.likelihood.zenith import Zeniths, frame_axes, raised
from starcal_uq.maths.linear import principal

if TYPE_CHECKING:
    from starcal_uq.core.types import FloatArray, IntArray
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Places of the grid; frames that get a zenith each, and fewest stars that tell one. What noise does
# to the density of the air by way of each frame's zenith is known to first order: of more frames,
# what is left of it would exceed the errors.
_PLACES, _APIECE, _FEWEST = 600, 12, 4
_STEPS, _SETTLED = 30, 0.05
# Half width of differences, rad.
_STEP_RAD = 0.02
# Tangents of a zenith's distance from which a frame's search starts.
_TANGENTS = (0.2, 3.0)


class Images:
    """Images of some frames around an estimate, and what of shifts attitudes and parameters leave.

    `e` (m,) are whitened residuals with `dof` degrees of freedom: m = 2 N, x of all stars before y,
    and where a likelihood has effects, one more for each of their coefficients. `rotations` (K, 3,
    3) are attitudes.
    """

    def __init__(
        self,
        obs: Observations,
        cal: Calibration,
        rotations: FloatArray,
        likelihood: MarginalLikelihood | None = None,
    ) -> None:
        if likelihood is None:
            likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        self.obs, self.camera, self.likelihood = obs, cal.camera, likelihood
        self.state, _ = likelihood.profile(cal.theta, rotations)
        self.view = View.of(likelihood, self.state, cal.theta, slice(None))
        h = self.state.slopes
        self.basis, self._triangle = np.linalg.qr(likelihood.whitened(self.state, h).T)
        self.e = self.cleared(likelihood.whitened(self.state, self.state.e[None]))[0]
        self.dof = max(likelihood.dof - len(h), 1)

    @property
    def sigma(self) -> float:
        """Scatter of the residuals."""
        return float(np.sqrt(self.e @ self.e / self.dof))

    @property
    def boresights(self) -> FloatArray:
        """Boresights (K, 3), ICRS axes."""
        return self.state.rotations[:, 2]

    @cached_property
    def groups(self) -> tuple[IntArray, IntArray]:
        """Star and frame of every image, (N,) each, from 0."""
        frames = self.likelihood.frames
        numbers = star_numbers(self.obs, self.camera.focal_px)
        return numbers, np.repeat(np.arange(frames.n_frames), frames.sizes)

    def cleared(self, columns: FloatArray) -> FloatArray:
        """Columns (g, m) without what is fitted."""
        return np.asarray(columns - (columns @ self.basis) @ self.basis.T)

    def left(self, shifts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What is left (g, m) of whitened shifts (g, 2, N), and what parameters took up (g, p)."""
        flat = self.likelihood.whitened(self.state, shifts)
        along = flat @ self.basis[:, : len(self._triangle)]
        return self.cleared(flat), np.linalg.solve(self._triangle, along.T).T

    def beside(self, shifts: FloatArray) -> Images:
        """The same where whitened shifts (g, 2, N) are fitted as well."""
        unit = np.linalg.norm(shifts, axis=(1, 2))[:, None]
        more = orthonormal(self.left(shifts)[0] / unit)
        found = copy(self)
        found.basis = np.concatenate([self.basis, more.T], axis=1)
        found.e = self.e - (more @ self.e) @ more
        found.dof = max(self.dof - len(more), 1)
        return found

    def whitened(self, shape: Shape) -> FloatArray:
        """Whitened shifts (q, 2, N) by a shape."""
        columns = shape.columns(self.view)
        self.likelihood.frames.whiten(columns)
        return columns

    def of_air(self, zeniths: Zeniths) -> FloatArray:
        """Whitened shifts (m, 2, N) by the coefficients of the effect."""
        return self.whitened(zeniths.shape(self.obs))

    @cached_property
    def by_frame(self) -> FloatArray:
        """Whitened shifts (3, K, 2, N) by scale and shape of each frame by itself."""
        own, frames = self.whitened(frame_shapes(self.camera)), self.likelihood.frames
        spread = np.zeros((len(own), frames.n_frames, *own.shape[1:]))
        spread[:, self.groups[1], :, np.arange(frames.n_stars)] = own.transpose(2, 0, 1)
        return spread

    @cached_property
    def _towards(self) -> FloatArray:
        """Axes of the sky, or of the Earth where there are times, at every star: (3, 3, N), camera
        frame.
        """
        axes = frame_axes(self.obs)[0]
        turned = self.state.rotations @ np.swapaxes(axes, 1, 2)
        return self.likelihood.frames.spread(turned.T)

    def possible(self) -> FloatArray:
        """Places (g, 3) of a grid from which all stars were above the horizon."""
        places = sphere(_PLACES)
        sines = places @ np.einsum("jin,in->jn", self._towards, self.state.b)
        return np.asarray(places[sines.min(axis=1) > LOWEST])

    def below(self, places: FloatArray) -> FloatArray:
        """What is left (g, m) of shifts by standard air below places (g, 3)."""
        b, air = self.state.b, air_constants()
        moves = (raised(b, np.tensordot(place, self._towards, 1), air) for place in places)
        return self.left(np.stack([self.state.shifts(move) for move in moves]))[0]


def orthonormal(rows: FloatArray, least: float = 1e-6) -> FloatArray:
    """Directions (r, m) of rows (g, m) whose squares are above `least` of the rows'."""
    values, vectors = principal(rows @ rows.T, least)
    return (vectors / np.sqrt(values)).T @ rows


class Settled(NamedTuple):
    """Zeniths whose air explains the most, the coefficients (m,) there and their covariance."""

    zeniths: Zeniths
    coefficients: FloatArray
    covariance: FloatArray


def candidates(obs: Observations, cal: Calibration, rotations: FloatArray) -> list[Zeniths]:
    """Zeniths of one place and of each frame, as far as the table allows them.

    `rotations` (K, 3, 3): attitudes. None where refraction is in the directions, or cannot be; none
    of one place where from none all stars were above the horizon. That directions are apparent is
    what a user states, and the frames may show otherwise.
    """
    origin = obs.origin
    if origin.air == "corrected" or origin.without_air or origin.simulated or obs.n_frames == 0:
        return []
    images, found = Images(obs, cal, rotations), []
    places = images.possible()
    if len(places):
        found.append(of_one_place(images, places, images.below(places)).zeniths)
    if 1 < obs.n_frames <= _APIECE and obs.stars_per_frame.min() >= _FEWEST:
        found.append(of_each_frame(images, images).zeniths)
    return found


def of_one_place(images: Images, places: FloatArray, columns: FloatArray) -> Settled:
    """The place near the best of some (g, 3), below which air leaves columns (g, m)."""
    gain = 2.0 * columns @ images.e - np.sum(columns**2, axis=1)
    axes, timed = frame_axes(images.obs)
    place = places[np.argmax(gain)][None]
    return _settled(images, Zeniths(images.obs.frame_ids, axes, place, timed))


def of_each_frame(images: Images, start: Images) -> Settled:
    """Zeniths of single frames, near to those that the shears of frames in `start` point to."""
    k = start.obs.n_frames
    own = start.by_frame[1:].reshape(2 * k, 2, -1)
    shear = np.linalg.lstsq(start.left(own)[0].T, start.e)[0].reshape(2, k)
    shear = shear / start.camera.corner_radius_px
    # Refraction moves stars to the zenith, so that the field shrinks along that way.
    tangent = np.clip(np.sqrt(2.0 * np.hypot(*shear) / air_constants()[0]), *_TANGENTS)
    angle = 0.5 * np.arctan2(-shear[1], -shear[0])
    across = np.stack([tangent * np.cos(angle), tangent * np.sin(angle), np.ones(k)], axis=1)
    places = normalised(np.einsum("kji,kj->ki", start.state.rotations, across))
    axes = np.tile(np.eye(3), (k, 1, 1))
    return _settled(images, Zeniths(images.obs.frame_ids, axes, places, False))


def _settled(images: Images, start: Zeniths) -> Settled:
    """The zeniths near to these whose air explains the most."""
    least, damping, trial = np.inf, 1e-3, start
    for _ in range(_STEPS):
        columns = images.left(images.of_air(trial))[0] / images.sigma
        e = images.e / images.sigma - trial.mean @ columns
        own = columns @ e, columns @ columns.T + np.diag(trial.prior**-2)
        # Density and choice of a side are the best ones.
        free = slice(trial.sizes[0], None)
        cost = float(e @ e - own[0][free] @ np.linalg.solve(own[1][free, free], own[0][free]))
        gained = least - cost
        if gained > 0.0:
            known, pull, matrix = trial, *own
            least, damping = cost, 0.2 * damping
            if gained < _SETTLED:
                break
        else:
            damping *= 10.0
        step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), pull)
        trial = known.moved(step, images.boresights)
    covariance = floats(np.linalg.inv(matrix))
    return Settled(known, known.mean + covariance @ pull, covariance)


def pulled(images: Images, zeniths: Zeniths, sigma: float) -> Zeniths:
    """Zeniths of single frames with the slopes of the volume that the data leave to them.

    Noise lengthens the shears of frames, and so takes zeniths too far from the boresight, all of
    them alike: the density of the air would come out too small. What the images leave open of a
    zenith is a larger part of the sky where it is nearer; integrated over the sky it balances that.
    """
    if not zeniths.apiece:
        return zeniths
    n, precision = len(zeniths.places), np.diag(zeniths.prior[[0, 0, -2]] ** -2)
    likelihood = images.likelihood

    def products(zeniths: Zeniths) -> FloatArray:
        """Products (K, 3, 3) of the columns of each frame, which are zero in all others."""
        own = images.of_air(zeniths)[:-1].reshape(3, n, 2, -1).sum(axis=1)
        own = likelihood.project_out(images.state, own)
        return products_by_frame(likelihood.frames, own, own) / sigma**2

    def volume(step: FloatArray) -> FloatArray:
        turned = np.zeros(len(zeniths.prior))
        turned[: 2 * n] = np.repeat(step, n)
        found = products(zeniths.moved(turned, images.boresights))
        return np.asarray(-0.5 * np.linalg.slogdet(found + precision)[1])

    slopes = [volume(step) - volume(-step) for step in _STEP_RAD * np.eye(2)]
    own = products(zeniths)
    left = np.linalg.solve(own + precision, own)
    density = -float(np.trace(left[:, :2, :2], axis1=1, axis2=2).sum())
    pull = np.concatenate([np.ravel(slopes) / (2.0 * _STEP_RAD), np.zeros(n), [density]])
    return replace(zeniths, pull=pull)


def found_air(
    zeniths: Zeniths, coefficients: FloatArray, covariance: FloatArray, boresights: FloatArray
) -> FoundAir:
    """The air of coefficients (m,) with this covariance; `boresights` (K, 3) are along ICRS axes."""
    n = zeniths.sizes[0] // 2
    each = np.arange(n)
    moves = covariance[: 2 * n, : 2 * n].reshape(2, n, 2, n)[:, each, :, each]
    worst = np.sqrt(np.linalg.eigvalsh(moves)[:, 1])
    level = np.sum(zeniths.among_stars * boresights, axis=1)
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
    x, y, z = zeniths.moved(coefficients, boresights).places[0]
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
