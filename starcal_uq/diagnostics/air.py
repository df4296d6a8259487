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

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.beside import (
    FRAMES,
    StarNoise,
    images_beside,
    without_effects,
)
from starcal_uq.diagnostics.residuals import of_heard
from starcal_uq.diagnostics.stars import StarTest, own_noise, star_test
from starcal_uq.estimation.noise_model import fit_noise
from starcal_uq.estimation.weights import weighed
from starcal_uq.estimation.zenith import (
    Images,
    Settled,
    found_air,
    of_each_frame,
    of_one_place,
    orthonormal,
)
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.likelihood.shapes import focal_drift, lens_shapes
from starcal_uq.maths.linear import principal

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# False alarms where there is no air.
AIR_P = 1e-3
# Density of the air in that of the standard air at sea level: least (4 km) and most.
_THIN, _THICK = 0.64, 1.06
# What leaves all of these with less probability is another misfit: chi-square of the amplitude, or
# a share of what air explains that refraction by two constants may leave.
_AIR_CHI2, _INEXACT = 10.8, 0.01
_DRAWS = 4000
# Frames that are looked at where each gets a zenith.
_FRAMES_APIECE = 80
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
    obs: Observations, cal: Calibration, *, seed: Seed = 0, stars: StarTest | None = None
) -> AirTest | None:
    """Look for refraction in the residuals of a calibration.

    Parameters
    ----------
    obs, cal
        The data and the estimate made from them.
    seed : int or Generator
        Seed of the draws of noise.
    stars : StarTest, optional
        Errors that stars bring along, where they are known already.

    Returns
    -------
    AirTest or None
        None where the camera was in space, or where from no place all stars were above the horizon
        and frames by themselves hold no scale and shape.
    """
    seed = seed_of(seed)
    if obs.origin.without_air:
        return None
    stars = star_test(obs, cal) if stars is None else stars
    obs, cal = of_heard(weighed(obs, cal), cal)
    errors = _star_noise(obs, cal, stars)
    air = _Air(obs, cal, seed, errors)
    found = air.test()
    if found is None or not (found.is_air or found.like_others) or cal.noise_model is not None:
        return found
    # Noise that grows towards the edge looks like scale and shape of single frames.
    model = air.noise()
    if not model.varies:
        return found
    weighted = obs.weighted(model.sigma_px(obs), model.axes)
    if errors is not None:
        squares = [float(np.mean(one.sigma_or_one**2)) for one in (obs, weighted)]
        errors = errors._replace(sigma=errors.sigma * np.sqrt(squares[0] / squares[1]))
    again = _Air(weighted, cal, seed, errors)
    found = again.test()
    if found is None or np.isnan(found.f_px):
        return found
    # What the estimate took up of it is by the weights that it was made with.
    f_px = air.f_px(again.seen_px)
    return replace(found, f_px=f_px, f_sigma=f_px / float(cal.sigmas[2]))


def _star_noise(obs: Observations, cal: Calibration, found: StarTest) -> StarNoise | None:
    """Direction errors that recurring stars show."""
    # Effects hold what stars bring along, where the data support that.
    if not found.tau_px > 0.0 or cal.known_effects.fitted:
        return None
    own = float(np.sqrt(own_noise(obs, cal.sigma**2, found.tau_px**2)))
    return StarNoise(found.tau_px, own, found.n_recurring)


class _Air:
    """Refraction of some frames from any place."""

    def __init__(
        self, obs: Observations, cal: Calibration, seed: int, errors: StarNoise | None
    ) -> None:
        self._timed, self._seed = obs.timed, seed
        most = FRAMES if obs.timed else _FRAMES_APIECE
        # Air is looked for beside terms that the lens may lack and a drift of f; `_alone` is
        # without these.
        self._alone = alone = images_beside(obs, cal, seed, errors, most)
        others = (*lens_shapes(cal.camera), *focal_drift(alone.obs))
        self._rest = alone.beside(np.concatenate([alone.whitened(shape) for shape in others]))
        # Errors of few stars are known less well than the noise of their images.
        p, few = len(cal.theta), np.inf if errors is None else errors.n_recurring
        self._most_dof = max(2 * few - 3 - p, 1)
        own = alone.by_frame
        rows = alone.left(own.reshape(-1, *own.shape[2:]))[0].reshape(*own.shape[:2], -1)
        self._own = rows / np.linalg.norm(own, axis=(2, 3))[:, :, None]
        self._cal, self._whole = cal, obs
        self.seen_px = np.zeros_like(alone.state.e)

    def test(self) -> AirTest | None:
        """Test the air of one place, and without times of a zenith for each frame."""
        found = self.of_one_place()
        if not self._timed and (found is None or not found.is_air):
            apiece = self.of_each_frame()
            if apiece is not None and (found is None or apiece.is_air or apiece.like_others):
                return apiece
        return found

    def _taken(self, shift_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Whitened shifts (1, 2, N) of shifts (2, N) of images, px, what is left of them (1, m) and
        what parameters take up of them (p,).
        """
        shifts = np.array(shift_px)[None]
        self._alone.likelihood.frames.whiten(shifts)
        left, taken = self._alone.left(shifts)
        return shifts, left, taken[0]

    def f_px(self, shift_px: FloatArray) -> float:
        """How much too short f is without air that shifts images so, (2, N) px."""
        return -float(self._taken(shift_px)[2][2])

    def noise(self) -> NoiseModel:
        """Fit the noise that the images have without the air that was found."""
        images = self._alone
        likelihood, state = images.likelihood, images.state
        shifts, _, taken = self._taken(self.seen_px)
        left = shifts[0] - np.tensordot(taken, state.slopes, 1)
        if self._cal.known_effects.fitted and isinstance(likelihood, EffectLikelihood):
            # Effects have taken their part of it off the images already.
            left = likelihood.conditioned(state, left[None])[0][0]
        x, y = likelihood.frames.in_pixels(left)
        clean = without_effects(self._whole, self._cal).select_frames(images.obs.frame_ids)
        clean = replace(clean, x_px=clean.x_px - x, y_px=clean.y_px - y)
        return fit_noise(clean, self._cal.camera, rounds=1)[0]

    def of_one_place(self) -> AirTest | None:
        """The air of one place; None where from no place all stars were above the horizon."""
        places = self._alone.possible()
        if not len(places):
            return None
        below = self._alone.below(places)
        rest = self._rest
        columns = self._rest.cleared(below)
        most = (self._most_dof, self._seed)
        p_value, amplitude, std = _largest(rest, columns, *most)
        found = AirTest(p_value, amplitude, std, n_frames=rest.obs.n_frames)
        if p_value >= AIR_P:
            if _largest(self._alone, below, *most)[0] >= AIR_P:
                return found
            rest, columns = self._alone, below
        settled = of_one_place(rest, places, columns)
        shift, column = self._of(settled, rest)
        chi2 = _most(rest, columns)
        good = chi2 - _gained(rest, column) < max(_AIR_CHI2, _INEXACT * chi2)
        if not good or not self._nothing_else(rest, column):
            return found
        found = self._with(found, settled, shift, rest)
        if not (self._timed and found.is_air):
            return found
        air = found_air(*settled, rest.boresights)
        return replace(
            found,
            latitude_deg=air.latitude_deg,
            longitude_deg=air.longitude_deg,
            latitude_std_deg=air.latitude_std_deg,
            longitude_std_deg=air.longitude_std_deg,
        )

    def of_each_frame(self) -> AirTest | None:
        """Air with a zenith for every frame; None where frames by themselves hold no scale and
        shape.
        """
        found = self._of_each_frame(self._rest)
        return (
            self._of_each_frame(self._alone) if found is None or found.p_value >= AIR_P else found
        )

    def _of_each_frame(self, rest: Images) -> AirTest | None:
        own = self._own_shapes(rest)
        k = rest.obs.n_frames
        if _f_tail(_explained(rest, own), len(own), rest) >= AIR_P:
            return None
        settled = of_each_frame(rest, self._alone)
        shift, column = self._of(settled, rest)
        gained = _gained(rest, column)
        p_value = _f_tail(gained * rest.sigma**2, len(own), rest)
        good = p_value < AIR_P and self._nothing_else(rest, column, k)
        if rest is not self._alone:
            # A focal length of each frame, or a shape without the scale of air, is not air: that
            # has to explain more than either, even with all that noise gives to what that one
            # leaves out.
            for first, last in ((0, 1), (1, 3)):
                one = _explained(rest, self._own_shapes(rest, slice(first, last))) / rest.sigma**2
                good = good and gained > one + (3 - last + first) * k + _AIR_CHI2
        found = AirTest(p_value, *_density(settled), n_frames=k)
        return self._with(found, settled, shift, rest) if good else found

    def _of(self, settled: Settled, rest: Images) -> tuple[FloatArray, FloatArray]:
        """Shifts px (2, N) by the air that was found, of a density that there is, and what is left
        of them (m,).
        """
        air, (moves, *_) = settled.coefficients.copy(), settled.zeniths.sizes
        air[:moves], air[-1] = 0.0, np.clip(air[-1], _THIN, _THICK)
        shift = rest.likelihood.frames.in_pixels(np.tensordot(air, rest.of_air(settled.zeniths), 1))
        return shift, rest.cleared(self._taken(shift)[1])[0]

    def _with(
        self, found: AirTest, settled: Settled, shift_px: FloatArray, rest: Images
    ) -> AirTest:
        """What was found, with the air that explains it, beside terms of the lens or only without
        these.
        """
        self.seen_px = shift_px
        f_px = self.f_px(shift_px)
        alike = rest is self._alone
        amplitude, std = _density(settled)
        return replace(
            found,
            amplitude=amplitude,
            amplitude_std=std,
            is_air=not alike,
            like_others=alike,
            f_px=f_px,
            f_sigma=f_px / float(self._cal.sigmas[2]),
        )

    def _own_shapes(self, rest: Images, which: slice = slice(None)) -> FloatArray:
        """What is left of scale and shape of each frame by itself, as orthonormal rows; `which` of
        the three.
        """
        rows = self._own[which].reshape(-1, self._own.shape[2])
        return orthonormal(rest.cleared(rows), _ABSORBED)

    def _nothing_else(self, rest: Images, column: FloatArray, fitted: int = 0) -> bool:
        """Whether frames by themselves, without that air, differ in scale and shape no more than by
        noise.

        `fitted` is how many numbers of the air the frames' own shapes have determined.
        """
        left = rest.e - column
        rows = self._own_shapes(rest)
        explained = float(np.sum((rows @ left) ** 2))
        tail = _f_tail(explained, max(len(rows) - fitted, 1), rest, float(left @ left))
        return tail > AIR_P or explained < _INEXACT * float(column @ column)


def _density(settled: Settled) -> tuple[float, float]:
    """Density of the air, as far as there is air of it, and its standard error."""
    density = float(np.clip(settled.coefficients[-1], _THIN, _THICK))
    return density, float(np.sqrt(settled.covariance[-1, -1]))


def _largest(
    rest: Images, columns: FloatArray, most_dof: float, seed: int
) -> tuple[float, float, float]:
    """Probability that noise gives so large an amplitude of one of columns (g, m); that amplitude
    and its error.
    """
    length = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    z = columns @ rest.e / length / rest.sigma
    best = int(np.argmax(z))
    rng = np.random.default_rng(seed)
    products = columns @ columns.T / np.outer(length, length)
    values, vectors = principal(products, 1e-10, relative=True)
    noise = rng.standard_normal((_DRAWS, len(values))) @ (vectors * np.sqrt(values)).T
    dof = min(rest.dof, most_dof)
    noise /= np.sqrt(rng.chisquare(dof, _DRAWS) / dof)[:, None]
    p_value = (1.0 + float(np.count_nonzero(noise.max(axis=1) >= z[best]))) / (_DRAWS + 1.0)
    return p_value, float(z[best] * rest.sigma / length[best]), float(rest.sigma / length[best])


def _explained(rest: Images, rows: FloatArray) -> float:
    """Sum of squares that orthonormal rows (r, m) explain."""
    return float(np.sum((rows @ rest.e) ** 2))


def _gained(rest: Images, column: FloatArray) -> float:
    """Chi-square that a column (m,) explains as it stands."""
    return float(2.0 * column @ rest.e - column @ column) / rest.sigma**2


def _most(rest: Images, columns: FloatArray) -> float:
    """Chi-square that the best of columns (g, m) explains with an amplitude of its own."""
    along = np.maximum(columns @ rest.e, 0.0)
    return float(np.max(along**2 / np.maximum(np.sum(columns**2, axis=1), 1e-300))) / rest.sigma**2


def _f_tail(explained: float, rank: int, rest: Images, total: float | None = None) -> float:
    """Probability that noise gives so much of a sum of squares `total`, that of the residuals, to
    `rank` numbers.
    """
    from scipy.special import fdtrc

    dof = rest.dof - rank
    if dof < 1 or rank < 1:
        return 1.0
    total = float(rest.e @ rest.e) if total is None else total
    return float(fdtrc(rank, dof, max(explained, 0.0) / rank / ((total - explained) / dof)))
