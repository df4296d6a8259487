"""Is refraction in the residuals, and where would the camera have stood?

Air raises a star at zenith distance z by about A tan z: what the attitude and the focal length
leave of that is a compression towards the zenith that grows with z. Where frames have times, a
place on the Earth has one zenith for each; without times all frames are taken to be of one moment.
For places all over the globe from which every star was above the horizon, the amplitude of
refraction is fitted in units of the standard air's; the largest amplitude in its sigmas is compared
with the largest of as many that noise gives, which are as correlated as their shapes. Frames
without times that are not of one moment get a zenith each.

Noise is that of the calibration: its model of the images' noise, and the direction errors of stars
that it fitted or, where it fitted none, that the stars which recur show. Terms that the lens may
lack are fitted beside the air. What these explain as well as air does cannot be separated from it.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.attitude.earth import (
    DENSITY_SPREAD,
    LOWEST,
    air_constants,
    normalised,
    raising,
    sphere,
    tangents,
)
from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.settings import bounded
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.diagnostics.beside import has_effects, with_effects_of, without_effects
from starcal_uq.diagnostics.residuals import of_heard
from starcal_uq.diagnostics.stars import StarTest, star_test
from starcal_uq.estimation.noise_model import fit_noise
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.effect_sums import EffectLikelihood
from starcal_uq.likelihood.effects import star_effect
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.likelihood.shapes import View, focal_drift, frame_shapes, lens_shapes
from starcal_uq.likelihood.star_errors import StarModel, star_numbers
from starcal_uq.likelihood.zenith import frame_axes
from starcal_uq.maths.linear import principal
from starcal_uq.observations.splits import one_of_each

if TYPE_CHECKING:
    from collections.abc import Callable

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# False alarms where there is no air.
AIR_P = 1e-3
# Density of the air in that of the standard air at sea level: least (4 km) and most.
_THIN, _THICK = 0.64, 1.06
# What leaves all of these with less probability is another misfit: chi-square of the amplitude, or
# a share of what air explains that refraction by two constants may leave.
_AIR_CHI2, _INEXACT = 10.8, 0.01
_PLACES, _DRAWS, _FRAMES, _STARS = 600, 4000, 200, 4000
# Frames that get a zenith each.
_FRAMES_APIECE = 80
# Damped steps towards the best zeniths, until chi-square falls by less than a tenth.
_STEPS, _STEP_RAD, _LONGEST_RAD, _SETTLED = 24, 1e-3, 0.2, 0.1
# Zeniths that are tried for a frame by itself: distances from its boresight, degrees, and
# directions. Tangents of a distance common to all frames from which the search starts, and its
# rounds.
_DISTANCES_DEG, _AROUND, _TANGENTS, _ROUNDS = np.arange(5.0, 81.0, 7.5), 16, (0.4, 1.0, 2.0), 6
# A share of a shape's square that is not there, where all of the rest is absorbed.
_ABSORBED = 1e-8


@dataclass(frozen=True)
class AirTest:
    """Refraction in the residuals of directions that hold none.

    Attributes
    ----------
    p_value : float
        Probability of so large an amplitude anywhere, or of so much explained by a zenith for each
        frame, if there is no refraction, whatever terms the lens lacks.
    amplitude, amplitude_std : float
        Amplitude in units of standard air and its standard error: the density of the air found, or
        where there is none the largest amplitude in its errors of the places tried.
    is_air : bool
        Whether it is significant (`AIR_P`), the air of one place, as dense as from the sea to 4 km,
        explains as much, and frames have no more scale and shape of their own than that gives them.
    latitude_deg, longitude_deg : float
        That place, north and east positive; NaN where it is none, or frames have no times.
    latitude_std_deg, longitude_std_deg : float
        Standard errors.
    f_px, f_sigma : float
        How much too short f is without refraction, px and in its standard deviations; NaN where
        there is none.
    n_frames : int
        Frames that were looked at.
    like_others : bool
        Whether air explains what is left, and terms that the lens may lack or a drift of f explain
        it as well: where the horizon keeps its place in the camera, refraction is a scale and skew
        of the axes. Then `f_px` is what would hold if it is air.
    """

    p_value: float
    amplitude: float
    amplitude_std: float
    is_air: bool = False
    latitude_deg: float = np.nan
    longitude_deg: float = np.nan
    latitude_std_deg: float = np.nan
    longitude_std_deg: float = np.nan
    f_px: float = np.nan
    f_sigma: float = np.nan
    n_frames: int = 0
    like_others: bool = False


@bounded
@one_thread()
def air_test(
    obs: Observations, cal: Calibration, *, seed: int = 0, stars: StarTest | None = None
) -> AirTest | None:
    """Look for refraction in the residuals of a calibration.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them.
    seed : int
        Seed of the draws of noise.
    stars : StarTest, optional
        Errors that stars bring along, where they are known already.

    Returns
    -------
    AirTest or None
        None where the camera was in space, or where from no place all stars were above the horizon
        and frames by themselves hold no scale and shape.
    """
    if obs.origin.without_air:
        return None
    stars = star_test(obs, cal) if stars is None else stars
    obs, cal = of_heard(weighed(obs, cal), cal)
    errors = _star_noise(obs, cal, stars)
    air = _Air(obs, cal, seed, errors)
    found = air.test(seed)
    if found is None or not (found.is_air or found.like_others) or cal.noise_model is not None:
        return found
    # Noise that grows towards the edge looks like scale and shape of single frames.
    model = air.noise()
    if not model.varies:
        return found
    weighted = obs.weighted(model.sigma_px(obs), model.axes)
    if errors is not None:
        own = errors.sigma * _rms(obs.sigma_px) / _rms(weighted.sigma_px)
        errors = errors._replace(sigma=own)
    again = _Air(weighted, cal, seed, errors)
    found = again.test(seed)
    if found is None or np.isnan(found.f_px):
        return found
    # What the estimate took up of it is by the weights that it was made with.
    f_px = air.f_px(again.seen_px)
    return replace(found, f_px=f_px, f_sigma=f_px / float(cal.sigmas[2]))


def _rms(sigma_px: FloatArray | None) -> float:
    return 1.0 if sigma_px is None else float(np.sqrt(np.mean(sigma_px**2)))


class _StarNoise(NamedTuple):
    """Direction errors of the stars per axis, px, the noise of their images, and how many recur."""

    tau_px: float
    sigma: float
    n_recurring: int


def _star_noise(obs: Observations, cal: Calibration, found: StarTest) -> _StarNoise | None:
    """Direction errors that recurring stars show."""
    # Effects hold what stars bring along, where the data ask for that.
    if not found.tau_px > 0.0 or has_effects(cal):
        return None
    # The estimate's noise holds both.
    of_stars = found.tau_px**2 * float(np.mean(obs.sigma_or_one**-2.0))
    own = float(np.sqrt(max(cal.sigma**2 - of_stars, 0.1 * cal.sigma**2)))
    return _StarNoise(found.tau_px, own, found.n_recurring)


class Remainder:
    """Residuals of some frames, and of what displaces stars that part which attitudes and
    parameters cannot take up.

    `obs` has the noise of its stars as the estimate weighs them. `residuals` (m,) are whitened,
    with `dof` degrees of freedom and scatter `sigma`: m = 2 N, x of all stars before y, and where
    stars bring errors along, which `errors` holds with the noise of images, two more for each star;
    or one more for each coefficient of the effects of the calibration. `clean` are the images
    without these.
    """

    def __init__(
        self,
        obs: Observations,
        cal: Calibration,
        seed: int,
        errors: _StarNoise | None = None,
        most: int = _FRAMES,
    ) -> None:
        chosen = one_of_each(
            obs.n_frames, min(most, max(_STARS * obs.n_frames // obs.n_stars, 3)), seed
        )
        clean = without_effects(obs, cal)
        self.obs, self.clean = (
            one if len(chosen) == obs.n_frames else one.select_frames(obs.frame_ids[chosen])
            for one in (obs, clean)
        )
        model, rotations = cal.camera.distortion, quaternion_to_rotation(cal.quaternions[chosen])
        self.focal_px = cal.camera.focal_px
        self.likelihood = MarginalLikelihood(self.obs, model, axes=True)
        if errors is not None:
            stars = star_effect(StarModel(self.obs, float(cal.theta[2])))
            ratio = {stars.name: (errors.tau_px / errors.sigma) ** 2}
            at = (cal.theta, rotations, errors.sigma)
            frames = self.likelihood.frames
            self.likelihood = EffectLikelihood(frames, model, [stars], ratio, *at)
        elif has_effects(cal):
            self.likelihood = with_effects_of(self.obs, cal, rotations, obs)
        self.state, _ = self.likelihood.profile(cal.theta, rotations)
        slopes = self.likelihood.whitened(
            self.state, self.likelihood.derivatives(cal.theta, self.state)
        )
        self.basis, self._triangle = np.linalg.qr(slopes.T)
        e = self.likelihood.whitened(self.state, self.state.e[None])[0]
        self.residuals: FloatArray = e - self.basis @ (self.basis.T @ e)
        self.dof = max(self.likelihood.dof - len(cal.theta), 1)
        # Errors of few stars are known less well than the noise of their images.
        self.least_dof = (
            self.dof if errors is None else max(2 * errors.n_recurring - 3 - len(cal.theta), 1)
        )

    @cached_property
    def groups(self) -> tuple[IntArray, IntArray]:
        """Star and frame of every image, (N,) each, from 0."""
        numbers = star_numbers(self.obs, self.focal_px)
        return numbers, np.repeat(np.arange(self.obs.n_frames), self.likelihood.frames.sizes)

    @property
    def sigma(self) -> float:
        """Scatter of the residuals."""
        return float(np.sqrt(self.residuals @ self.residuals / self.dof))

    def shift(self, moved: FloatArray) -> FloatArray:
        """Whitened shifts (2, N) of images by small moves (3, N) of the stars, camera frame,
        rad.
        """
        shifts: FloatArray = np.einsum(
            "ixn,in->xn", self.state.attitude, np.cross(self.state.b, moved, axis=0)
        )
        return shifts

    def left(self, shifts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What is left (g, m) of shifts (g, 2, N), and what parameters took up (g, p)."""
        flat = self.likelihood.whitened(self.state, shifts)
        along = flat @ self.basis
        taken = np.linalg.solve(self._triangle, along[:, : len(self._triangle)].T).T
        return flat - along @ self.basis.T, taken

    def cleared(self, columns: FloatArray) -> FloatArray:
        """Columns (g, m) without what is fitted."""
        left: FloatArray = columns - (columns @ self.basis) @ self.basis.T
        return left

    def beside(self, shifts: FloatArray) -> Remainder:
        """The same where shifts (g, 2, N) are fitted as well."""
        flat = (
            self.left(shifts)[0] / np.linalg.norm(shifts.reshape(len(shifts), -1), axis=1)[:, None]
        )
        more = _orthonormal(flat)
        found = copy(self)
        found.basis = np.concatenate([self.basis, more.T], axis=1)
        found.residuals = self.residuals - (more @ self.residuals) @ more
        found.dof = max(self.dof - len(more), 1)
        return found


def _orthonormal(rows: FloatArray, least: float = 1e-6) -> FloatArray:
    """Directions (r, m) of rows (g, m) whose squares are above `least` of the rows'."""
    values, vectors = principal(rows @ rows.T, least)
    found: FloatArray = (vectors / np.sqrt(values)).T @ rows
    return found


class _Settled(NamedTuple):
    """Zeniths (n, 3) whose air explains the most, its density, shifts (2, N) by it, what is left of
    these (m,).
    """

    zeniths: FloatArray
    density: float
    shift: FloatArray
    column: FloatArray
    # Standard errors: of moves of the zeniths along their tangents, rad, and of the density
    errors: FloatArray


class _Air:
    """Refraction of some frames from any place."""

    def __init__(
        self,
        obs: Observations,
        cal: Calibration,
        seed: int,
        errors: _StarNoise | None,
    ) -> None:
        rest = Remainder(obs, cal, seed, errors, _FRAMES if obs.timed else _FRAMES_APIECE)
        # Air is looked for beside terms that the lens may lack and a drift of f; `_alone` is
        # without these.
        likelihood, state, camera = rest.likelihood, rest.state, cal.camera
        view = View.of(likelihood, state, camera.theta, slice(0, likelihood.frames.n_stars))
        others = (*lens_shapes(camera), *focal_drift(rest.obs))
        shifts = np.concatenate([shape.columns(view) for shape in others])
        self._alone, self._rest = rest, rest.beside(shifts)
        own = frame_shapes(camera).columns(view)
        for columns in (shifts, own):
            likelihood.frames.whiten(columns)
        own = self._apart(own)
        self._own = own.reshape(3, -1, *own.shape[1:])
        self._cal = cal
        self._axes, self.timed = frame_axes(rest.obs)
        self._constants = air_constants()
        self.seen_px = np.zeros((2, likelihood.frames.n_stars))

    def test(self, seed: int) -> AirTest | None:
        """Test the air of one place, and without times of a zenith for each frame."""
        found = self.of_one_place(seed)
        if not self.timed and (found is None or not found.is_air):
            apiece = self.of_each_frame()
            if apiece is not None and (found is None or apiece.is_air or apiece.like_others):
                return apiece
        return found

    def _taken(self, shift_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened shifts (1, 2, N) of shifts (2, N) of images, px, and what parameters take up of
        them (p,).
        """
        shifts = np.array(shift_px)[None]
        self._alone.likelihood.frames.whiten(shifts)
        return shifts, self._alone.left(shifts)[1][0]

    def f_px(self, shift_px: FloatArray) -> float:
        """How much too short f is without air that shifts images so, (2, N) px."""
        return -float(self._taken(shift_px)[1][2])

    def noise(self) -> NoiseModel:
        """Fit the noise that the images have without the air that was found."""
        rest, theta = self._alone, self._cal.theta
        shifts, taken = self._taken(self.seen_px)
        left = shifts[0] - np.tensordot(taken, rest.likelihood.derivatives(theta, rest.state), 1)
        likelihood = rest.likelihood
        if has_effects(self._cal) and isinstance(likelihood, EffectLikelihood):
            # Effects have taken their part of it off the images already.
            left = likelihood.conditioned(rest.state, left[None])[0][0]
        x, y = likelihood.frames.in_pixels(left)
        clean = replace(rest.clean, x_px=rest.clean.x_px - x, y_px=rest.clean.y_px - y)
        return fit_noise(clean, self._cal.camera, rounds=1)[0]

    def _apart(self, shifts: FloatArray) -> FloatArray:
        """Shifts (q, 2, N) of each frame by itself, (q K, 2, N)."""
        frames = self._rest.likelihood.frames
        number = self._rest.groups[1]
        spread = np.zeros((len(shifts), frames.n_frames, 2, frames.n_stars))
        spread[:, number, :, np.arange(frames.n_stars)] = shifts.transpose(2, 0, 1)
        return spread.reshape(-1, 2, frames.n_stars)

    def _raised(self, zenith: FloatArray) -> FloatArray:
        """Whitened shifts (2, N) by standard air below zeniths (3, N), camera frame."""
        sine = np.sum(zenith * self._rest.state.b, axis=0)
        return self._rest.shift(zenith * raising(sine, self._constants)[0])

    def _above(self, places: FloatArray) -> FloatArray:
        """Zeniths (K, 3) of the frames, camera frame, at one place (1, 3)."""
        found: FloatArray = np.einsum(
            "kij,akj,a->ki", self._rest.state.rotations, self._axes.transpose(1, 0, 2), places[0]
        )
        return found

    def _shift(self, zeniths: FloatArray) -> FloatArray:
        """Whitened shifts (2, N) by standard air below zeniths (K, 3) of the frames, camera
        frame.
        """
        return self._raised(self._rest.likelihood.frames.spread(np.ascontiguousarray(zeniths.T)))

    def _possible(self, places: FloatArray) -> FloatArray:
        """Those places (g, 3) from which all stars were above the horizon."""
        frames = self._rest.likelihood.frames
        turned = [frames.spread(np.ascontiguousarray(self._axes[:, axis].T)) for axis in range(3)]
        seen = np.stack([np.sum(axis * frames.r, axis=0) for axis in turned])
        found: FloatArray = places[np.min(places @ seen, axis=1) > LOWEST]
        return found

    def of_one_place(self, seed: int) -> AirTest | None:
        """The air of one place; None where from no place all stars were above the horizon."""
        places = self._possible(sphere(_PLACES))
        if not len(places):
            return None
        alone, _ = self._alone.left(
            np.stack([self._shift(self._above(place[None])) for place in places])
        )
        rest, columns = self._rest, self._rest.cleared(alone)
        p_value, amplitude, std = _largest(rest, columns, seed)
        found = AirTest(p_value, amplitude, std, n_frames=rest.obs.n_frames)
        if p_value >= AIR_P:
            if _largest(self._alone, alone, seed)[0] >= AIR_P:
                return found
            rest, columns = self._alone, alone
        gain = 2.0 * columns @ rest.residuals - np.sum(columns**2, axis=1)
        settled = self._settled(rest, places[np.argmax(gain)][None], self._above)
        gained, most = _gained(rest, settled.column), _most(rest, columns)
        good = most - gained < max(_AIR_CHI2, _INEXACT * most) and self._nothing_else(
            rest, settled.column
        )
        if not good:
            return found
        found = self._with(found, settled, rest)
        if not (self.timed and found.is_air):
            return found
        x, y, z = settled.zeniths[0]
        north, east, _ = np.degrees(settled.errors)
        return replace(
            found,
            latitude_deg=float(np.degrees(np.arcsin(z))),
            longitude_deg=float(np.degrees(np.arctan2(y, x))),
            latitude_std_deg=float(north),
            longitude_std_deg=float(east / max(np.hypot(x, y), 1e-3)),
        )

    def of_each_frame(self) -> AirTest | None:
        """Air with a zenith for every frame; None where frames by themselves hold no scale and
        shape.
        """
        found = self._of_each_frame(self._rest)
        return (
            self._of_each_frame(self._alone) if found is None or found.p_value >= AIR_P else found
        )

    def _of_each_frame(self, rest: Remainder) -> AirTest | None:
        own, k = self._own_shapes(rest), rest.obs.n_frames
        if _f_tail(_explained(rest, own), len(own), rest) >= AIR_P:
            return None
        settled = self._settled(rest, self._zeniths_apiece(), lambda zeniths: zeniths)
        gained = _gained(rest, settled.column)
        p_value = _f_tail(gained * rest.sigma**2, len(own), rest)
        good = p_value < AIR_P and self._nothing_else(rest, settled.column, k)
        if rest is not self._alone:
            # A focal length of each frame, or a shape without the scale of air, is not air: that
            # has to explain more than either, even with all that noise gives to what that one
            # leaves out.
            for first, last in ((0, 1), (1, 3)):
                one = _explained(rest, self._own_shapes(rest, slice(first, last))) / rest.sigma**2
                good = good and gained > one + (3 - last + first) * k + _AIR_CHI2
        found = AirTest(p_value, settled.density, float(settled.errors[-1]), n_frames=k)
        return self._with(found, settled, rest) if good else found

    def _with(self, found: AirTest, settled: _Settled, rest: Remainder) -> AirTest:
        """What was found, with the air that explains it, beside terms of the lens or only without
        these.
        """
        self.seen_px = rest.likelihood.frames.in_pixels(settled.shift)
        f_px = self.f_px(self.seen_px)
        alike, errors = rest is self._alone, float(settled.errors[-1])
        found = replace(
            found,
            amplitude=settled.density,
            amplitude_std=errors,
            is_air=not alike,
            like_others=alike,
        )
        return replace(found, f_px=f_px, f_sigma=f_px / float(self._cal.sigmas[2]))

    @cached_property
    def _own_left(self) -> FloatArray:
        """What is left of scale and shape of each frame by itself, (3, K, m)."""
        rows, _ = self._alone.left(self._own.reshape(-1, *self._own.shape[2:]))
        return rows.reshape(*self._own.shape[:2], -1)

    def _own_shapes(self, rest: Remainder, which: slice = slice(None)) -> FloatArray:
        """What is left of scale and shape of each frame by itself, as orthonormal rows; `which` of
        the three.
        """
        shifts = self._own[which].reshape(-1, *self._own.shape[2:])
        rows = self._own_left[which].reshape(len(shifts), -1)
        if rest is self._rest:
            rows = rest.cleared(rows)
        return _orthonormal(
            rows / np.linalg.norm(shifts.reshape(len(rows), -1), axis=1)[:, None], _ABSORBED
        )

    def _nothing_else(self, rest: Remainder, column: FloatArray, fitted: int = 0) -> bool:
        """Whether frames by themselves, without that air, differ in scale and shape no more than by
        noise.

        `fitted` is how many numbers of the air the frames' own shapes have determined.
        """
        left, rows = rest.residuals - column, self._own_shapes(rest)
        explained = float(np.sum((rows @ left) ** 2))
        tail = _f_tail(explained, max(len(rows) - fitted, 1), rest, float(left @ left))
        return tail > AIR_P or explained < _INEXACT * float(column @ column)

    def _settled(
        self, rest: Remainder, zeniths: FloatArray, above: Callable[[FloatArray], FloatArray]
    ) -> _Settled:
        """The zeniths (n, 3) near to these whose air explains the most; `above` makes the frames'
        (K, 3) of them.

        Levenberg's damped steps; the density of the air is fitted as well, with what is known of
        it.
        """
        scale, damping, least = rest.sigma**2, 1e-3, np.inf
        known, density, trial, trial_density = zeniths, 1.0, zeniths, 1.0
        for _ in range(_STEPS):
            shift = trial_density * self._shift(above(trial))
            column = rest.left(shift[None])[0][0]
            away = (trial_density - 1.0) / DENSITY_SPREAD
            cost = float(np.sum((rest.residuals - column) ** 2)) / scale + away**2
            if cost < least:
                gained, least, damping = least - cost, cost, 0.2 * damping
                known, density, found = trial, trial_density, (shift, column)
                ways = tangents(known)
                moved = [
                    self._shift(above(normalised(known + _STEP_RAD * way))) * density
                    for way in ways
                ]
                slopes = (np.stack(moved) - shift) / _STEP_RAD
                if len(known) > 1:
                    slopes = self._apart(slopes)
                rows = np.concatenate([rest.left(slopes)[0], column[None] / density])
                matrix, pull = rows @ rows.T / scale, rows @ (rest.residuals - column) / scale
                matrix[-1, -1] += DENSITY_SPREAD**-2
                pull[-1] -= away / DENSITY_SPREAD
                if gained < _SETTLED:
                    break
            else:
                damping *= 10.0
            diagonal = np.diag(matrix)
            step = np.linalg.solve(
                matrix + np.diag(damping * (diagonal + 1e-9 * diagonal.max())), pull
            )
            turn = step[:-1].reshape(2, -1)
            turn = turn * np.minimum(1.0, _LONGEST_RAD / np.maximum(np.hypot(*turn), 1e-12))
            trial = normalised(known + turn[0][:, None] * ways[0] + turn[1][:, None] * ways[1])
            trial_density = float(np.clip(density + step[-1], _THIN, _THICK))
        return _Settled(
            known, density, *found, np.sqrt(np.diag(np.linalg.pinv(matrix, hermitian=True)))
        )

    def _zeniths_apiece(self) -> FloatArray:
        """Zeniths (K, 3), camera frame, that explain the most of each frame by itself, from a grid.

        What all frames take up together, most of all the focal length, is fitted in turn with them.
        """
        likelihood, state = self._rest.likelihood, self._rest.state
        frames, n = likelihood.frames, likelihood.frames.n_stars
        grid = _around(_DISTANCES_DEG)
        shifts = np.stack(
            [self._raised(np.broadcast_to(zenith[:, None], (3, n))) for zenith in grid]
        )
        lowest = np.minimum.reduceat(grid @ state.b, frames.starts[:-1], axis=1)
        columns = likelihood.project_out(state, shifts)
        size = np.where(lowest > LOWEST, frames.sum(np.sum(columns**2, axis=1)), np.inf)
        h = likelihood.slopes(self._cal.theta, state)
        e = likelihood.project_out(state, state.e[None])[0]
        basis = np.linalg.qr(h.reshape(len(h), -1).T)[0]
        number, star = self._rest.groups[1], np.arange(n)
        best, least = np.zeros(frames.n_frames, dtype=np.int64), np.inf
        for tangent in _TANGENTS:
            left = e - h[2] * (
                self._cal.camera.focal_px * self._constants[0] * (1.0 + 0.5 * tangent**2)
            )
            for _ in range(_ROUNDS):
                gain = 2.0 * frames.sum(np.sum(columns * left, axis=1)) - size
                chosen = np.argmax(gain, axis=0)
                total = columns[chosen[number], :, star].T
                left = e - (basis @ (basis.T @ (e - total).ravel())).reshape(2, -1)
                cost = float(np.sum((left - total) ** 2))
                if cost < least:
                    best, least = chosen, cost
        return grid[best]


def _largest(rest: Remainder, columns: FloatArray, seed: int) -> tuple[float, float, float]:
    """Probability that noise gives so large an amplitude of one of columns (g, m); that amplitude
    and its error.
    """
    length = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    z = columns @ rest.residuals / length / rest.sigma
    best = int(np.argmax(z))
    rng = np.random.default_rng(seed)
    products = columns @ columns.T / np.outer(length, length)
    values, vectors = principal(products, 1e-10, relative=True)
    noise = rng.standard_normal((_DRAWS, len(values))) @ (vectors * np.sqrt(values)).T
    dof = min(rest.dof, rest.least_dof)
    noise /= np.sqrt(rng.chisquare(dof, _DRAWS) / dof)[:, None]
    p_value = (1.0 + float(np.count_nonzero(noise.max(axis=1) >= z[best]))) / (_DRAWS + 1.0)
    return p_value, float(z[best] * rest.sigma / length[best]), float(rest.sigma / length[best])


def _explained(rest: Remainder, rows: FloatArray) -> float:
    """Sum of squares that orthonormal rows (r, m) explain."""
    return float(np.sum((rows @ rest.residuals) ** 2))


def _gained(rest: Remainder, column: FloatArray) -> float:
    """Chi-square that a column (m,) explains as it stands."""
    return float(2.0 * column @ rest.residuals - column @ column) / rest.sigma**2


def _most(rest: Remainder, columns: FloatArray) -> float:
    """Chi-square that the best of columns (g, m) explains with an amplitude of its own."""
    along = np.maximum(columns @ rest.residuals, 0.0)
    return float(np.max(along**2 / np.maximum(np.sum(columns**2, axis=1), 1e-300))) / rest.sigma**2


def _f_tail(explained: float, rank: int, rest: Remainder, total: float | None = None) -> float:
    """Probability that noise gives so much of a sum of squares `total`, that of the residuals, to
    `rank` numbers.
    """
    from scipy.special import fdtrc

    dof = rest.dof - rank
    if dof < 1 or rank < 1:
        return 1.0
    total = float(rest.residuals @ rest.residuals) if total is None else total
    return float(fdtrc(rank, dof, max(explained, 0.0) / rank / ((total - explained) / dof)))


def _around(distances_deg: FloatArray) -> FloatArray:
    """Directions (g, 3) at some distances from +z, all around."""
    distance, angle = (
        grid.ravel()
        for grid in np.meshgrid(
            np.radians(distances_deg), 2.0 * np.pi / _AROUND * np.arange(_AROUND), indexing="ij"
        )
    )
    return np.column_stack(
        [np.sin(distance) * np.cos(angle), np.sin(distance) * np.sin(angle), np.cos(distance)]
    )
