"""Is refraction in the residuals, and where would the camera have stood?

Air raises a star at zenith distance z by about A tan z: what the attitude and the focal length leave of that is a
compression towards the zenith that grows with z. Where frames have times, a place on the Earth has one zenith for each;
without times all frames are taken to be of one moment. For places all over the globe from which every star was
above the horizon, the amplitude of refraction is fitted in units of the standard air's; the largest amplitude in its
sigmas is held against the largest of as many that noise gives, which are as correlated as their shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.settings import bounded
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.shapes import View, frame_shapes
from starcal_uq.estimation.marginal import MarginalLikelihood
from starcal_uq.estimation.noise_model import weighed
from starcal_uq.observations.splits import one_of_each
from starcal_uq.sky.refraction import refraction_constants, site_among_stars
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations

# False alarms where there is no air.
AIR_P = 1e-3
# The standard air at sea level, and up to 4 km.
_DENSITIES = (1.0, 0.85, 0.7)
# What leaves all of these with less probability is another misfit: chi-square of the amplitude.
_AIR_CHI2 = 10.8
_PLACES, _DRAWS, _FRAMES, _STARS = 600, 4000, 200, 4000
# Sine of the lowest altitude that is taken for possible.
_LOWEST = np.sin(np.radians(5.0))
_STEPS, _STEP_RAD = 8, 1e-3


@dataclass(frozen=True)
class AirTest:
    """Refraction in the residuals of directions that hold none.

    Attributes
    ----------
    p_value : float
        Probability of so large an amplitude anywhere if there is no refraction.
    amplitude, amplitude_std : float
        Amplitude in units of standard air, at the best of the places tried, and its standard error.
    is_air : bool
        Whether it is significant (`AIR_P`), the air of one place, as dense as from the sea to 4 km, explains as much,
        and frames have no more scale and shape of their own than that gives them.
    latitude_deg, longitude_deg : float
        That place, north and east positive; NaN where it is none, or frames have no times.
    latitude_std_deg, longitude_std_deg : float
        Standard errors.
    f_px, f_sigma : float
        How much too short f is without refraction, px and in its standard deviations; NaN where there is none.
    n_frames : int
        Frames that were looked at.
    """

    p_value: float
    amplitude: float
    amplitude_std: float
    is_air: bool
    latitude_deg: float
    longitude_deg: float
    latitude_std_deg: float
    longitude_std_deg: float
    f_px: float
    f_sigma: float
    n_frames: int


@bounded
def air_test(obs: Observations, cal: Calibration, *, seed: int = 0, rest: Remainder | None = None) -> AirTest | None:
    """Look for refraction in the residuals of a calibration.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them.
    seed : int
        Seed of the draws of noise.
    rest : Remainder, optional
        What is left of the residuals, where it is known already.

    Returns
    -------
    AirTest or None
        None where from no place all stars were above the horizon.
    """
    rest = rest or Remainder(obs, cal, seed)
    air = _Air(rest, cal.camera)
    places = air.possible(_sphere(_PLACES))
    if not len(places):
        return None
    columns, _ = air.columns(places)
    length = np.linalg.norm(columns, axis=1)
    z = columns @ rest.residuals / length / rest.sigma
    best = int(np.argmax(z))
    rng = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(columns @ columns.T / np.outer(length, length))
    kept = values > 1e-10 * values[-1]
    noise = rng.standard_normal((_DRAWS, int(np.count_nonzero(kept)))) @ (vectors[:, kept] * np.sqrt(values[kept])).T
    noise /= np.sqrt(rng.chisquare(rest.dof, _DRAWS) / rest.dof)[:, None]
    p_value = (1.0 + float(np.count_nonzero(noise.max(axis=1) >= z[best]))) / (_DRAWS + 1.0)
    nothing = float("nan")
    found = dict.fromkeys(("latitude_deg", "longitude_deg", "latitude_std_deg", "longitude_std_deg"), nothing)
    found |= {"f_px": nothing, "f_sigma": nothing}
    is_air = False
    for density in _DENSITIES if p_value < AIR_P else ():
        gain = 2.0 * density * columns @ rest.residuals - (density * length) ** 2
        place, gained, covariance = air.settled(places[np.argmax(gain)], density)
        is_air = bool(z[best] ** 2 - gained < _AIR_CHI2) and air.left_by_frame(place, density) > AIR_P
        if is_air:
            break
    if is_air:
        _, absorbed = air.columns(place[None])
        shift = -density * float(absorbed[0, 2])
        found |= {"f_px": shift, "f_sigma": shift / float(cal.sigmas[2])}
    if is_air and air.timed:
        latitude, longitude = np.arcsin(place[2]), np.arctan2(place[1], place[0])
        std = np.degrees(np.sqrt(np.diag(covariance)))
        found |= {"latitude_deg": float(np.degrees(latitude)), "longitude_deg": float(np.degrees(longitude))}
        found |= {"latitude_std_deg": float(std[0]), "longitude_std_deg": float(std[1] / max(np.cos(latitude), 1e-3))}
    size, error = float(z[best] * rest.sigma / length[best]), float(rest.sigma / length[best])
    return AirTest(p_value, size, error, is_air, n_frames=rest.obs.n_frames, **found)


class Remainder:
    """Residuals of some frames, and of what displaces stars that part which attitudes and parameters cannot take up.

    `residuals` (2 N,) are whitened, x of all stars before y, with `dof` degrees of freedom and scatter `sigma`.
    """

    def __init__(self, obs: Observations, cal: Calibration, seed: int) -> None:
        obs = weighed(obs, cal)
        chosen = one_of_each(obs.n_frames, min(_FRAMES, max(_STARS * obs.n_frames // obs.n_stars, 3)), seed)
        self.obs = obs if len(chosen) == obs.n_frames else obs.select_frames(obs.frame_ids[chosen])
        self.likelihood = MarginalLikelihood(self.obs, cal.camera.distortion)
        self.state, _ = self.likelihood.profile(cal.theta, quaternion_to_rotation(cal.quaternions[chosen]))
        slopes = self.likelihood.project_out(self.state, self.likelihood.derivatives(cal.theta, self.state))
        self.basis, self._triangle = np.linalg.qr(slopes.reshape(len(slopes), -1).T)
        e = self.likelihood.project_out(self.state, self.state.e[None]).reshape(-1)
        self.residuals: FloatArray = e - self.basis @ (self.basis.T @ e)
        self.dof = max(self.likelihood.dof - len(cal.theta), 1)
        self.sigma = float(np.sqrt(self.residuals @ self.residuals / self.dof))

    def shift(self, moved: FloatArray) -> FloatArray:
        """Whitened shifts (2, N) of images by small moves (3, N) of the stars, camera frame, rad."""
        shifts: FloatArray = np.einsum("ixn,in->xn", self.state.attitude, np.cross(self.state.b, moved, axis=0))
        return shifts

    def left(self, shifts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What is left (g, 2 N) of shifts (g, 2, N), and what parameters took up (g, p)."""
        flat = self.likelihood.project_out(self.state, shifts).reshape(len(shifts), -1)
        along = flat @ self.basis
        return flat - along @ self.basis.T, np.linalg.solve(self._triangle, along.T).T


class _Air:
    """Refraction of some frames from any place."""

    def __init__(self, rest: Remainder, camera: Camera) -> None:
        self._rest, self._camera = rest, camera
        self._axes, self.timed = _earth(rest.obs)
        self._constants = refraction_constants(Site(45.0, 0.0))

    def possible(self, places: FloatArray) -> FloatArray:
        """Those places (g, 3) from which all stars were above the horizon."""
        frames = self._rest.likelihood.frames
        turned = [frames.spread(np.ascontiguousarray(self._axes[:, axis].T)) for axis in range(3)]
        seen = np.stack([np.sum(axis * frames.r, axis=0) for axis in turned])
        found: FloatArray = places[np.min(places @ seen, axis=1) > _LOWEST]
        return found

    def columns(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened shifts (g, 2 N) by standard air as seen from places (g, 3), and what parameters took up (g, p)."""
        a, b = self._constants
        frames, state = self._rest.likelihood.frames, self._rest.state
        shifts = np.empty((len(places), 2, frames.n_stars))
        for number, place in enumerate(places):
            zenith = np.einsum("kij,akj,a->ik", state.rotations, self._axes.transpose(1, 0, 2), place)
            up = frames.spread(np.ascontiguousarray(zenith))
            sine = np.maximum(np.sum(up * state.b, axis=0), _LOWEST)
            shifts[number] = self._rest.shift(up * ((a + b * (1.0 / sine**2 - 1.0)) / sine))
        return self._rest.left(shifts)

    def left_by_frame(self, place: FloatArray, density: float) -> float:
        """Probability that frames by themselves, without that air, differ so much in scale and shape by noise."""
        from scipy.special import fdtrc

        frames, theta = self._rest.likelihood.frames, self._camera.theta
        view = View.of(self._rest.likelihood, self._rest.state, theta, slice(0, frames.n_stars))
        weight = 1.0 if frames.weight is None else frames.weight
        own = self._rest.likelihood.project_out(self._rest.state, frame_shapes(self._camera).columns(view) * weight)
        number = np.repeat(np.arange(frames.n_frames), frames.sizes)
        spread = np.zeros((3, frames.n_frames, 2, frames.n_stars))
        spread[:, number, :, np.arange(frames.n_stars)] = own.transpose(2, 0, 1)
        flat = spread.reshape(3 * frames.n_frames, -1)
        flat -= (flat @ self._rest.basis) @ self._rest.basis.T
        left = self._rest.residuals - self.columns(place[None])[0][0] * density
        values, vectors = np.linalg.eigh(flat @ flat.T)
        kept = values > 1e-8 * values[-1]
        explained = float(np.sum((vectors[:, kept].T @ (flat @ left)) ** 2 / values[kept]))
        rank = int(np.count_nonzero(kept))
        dof = self._rest.dof - rank
        if dof < 1:
            return 1.0
        return float(fdtrc(rank, dof, explained / rank / ((float(left @ left) - explained) / dof)))

    def settled(self, place: FloatArray, density: float) -> tuple[FloatArray, float, FloatArray]:
        """The place (3,) near to one whose air explains the most, chi-square gained, covariance (2, 2), rad.

        The covariance is that of moves to the north and to the east.
        """
        scale = self._rest.sigma**2
        for _ in range(_STEPS):
            north, east = _tangents(place)
            beside = [_unit(place + _STEP_RAD * way) for way in (north, east)]
            here, *moved = self.columns(np.stack([place, *beside]))[0] * density
            slopes = (np.stack(moved) - here) / _STEP_RAD
            covariance = np.linalg.inv(slopes @ slopes.T) * scale
            step = covariance @ slopes @ (self._rest.residuals - here) / scale
            size = float(np.hypot(*step))
            place = _unit(place + min(1.0, 0.2 / max(size, 1e-12)) * (step[0] * north + step[1] * east))
            if size < _STEP_RAD:
                break
        last = self.columns(place[None])[0][0] * density
        return place, float(2.0 * last @ self._rest.residuals - last @ last) / scale, covariance


def _earth(obs: Observations) -> tuple[FloatArray, bool]:
    """Axes of the Earth among the stars for each frame, (K, 3, 3) by rows, and whether they are known.

    Without times of all frames one moment's will do, whose Earth is turned as if it did not matter.
    """
    first = obs.frame_starts[:-1]
    if obs.time_utc is None or (obs.time_utc[first] == "").any():
        return np.broadcast_to(np.eye(3), (obs.n_frames, 3, 3)), False
    ways = ((0.0, 0.0), (0.0, 90.0), (90.0, 0.0))
    try:
        axes = [site_among_stars(Site(latitude, longitude), obs.time_utc[first])[0] for latitude, longitude in ways]
    except StarcalError:
        return np.broadcast_to(np.eye(3), (obs.n_frames, 3, 3)), False
    return np.stack(axes, axis=1), True


def _sphere(n: int) -> FloatArray:
    """Directions (n, 3) evenly over the sphere, on a spiral."""
    place = np.arange(n) + 0.5
    z = 1.0 - 2.0 * place / n
    angle = np.pi * (1.0 + np.sqrt(5.0)) * place
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _tangents(place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors to the north and to the east of a place."""
    east = np.array([-place[1], place[0], 0.0]) if np.hypot(*place[:2]) > 1e-6 else np.array([0.0, 1.0, 0.0])
    east = _unit(east)
    return np.cross(place, east), east


def _unit(vector: FloatArray) -> FloatArray:
    found: FloatArray = vector / np.linalg.norm(vector)
    return found
