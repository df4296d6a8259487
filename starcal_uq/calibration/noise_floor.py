"""What every star's noise has beyond what it states: a floor that bright stars show.

Centroiding states the noise of the pixels. Air, the shape of the star images and faint neighbours
displace stars by amounts that do not shrink with their brightness. With v_i = s^2 sigma_i^2 + F^2
the variance per axis of star i, the residuals of a calibration say whether F is needed: bright
stars then scatter by F, whatever they state. s and F follow from the likelihood of the residuals:
t_i = e^T (I - H)^-1 e of a star (`outliers`), times its variance in the fit, is v_i times a
chi-square with two degrees of freedom where the weights of the fit are right. Stars beyond 4.5
sigma are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.findings import clause
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.outliers import star_residuals
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# A floor is added when noise without one gives such a likelihood ratio less often than this.
LEAST_P_VALUE = 1e-3
_LIMIT_SIGMA, _ROUNDS = 4.5, 4
# Calibrations with a floor, until it changes by less than this share.
_SETTLE_ROUNDS, _SETTLED = 4, 0.02
_MIN_STARS = 30
Floor = Enum("Floor", "OF_NOISE")


@dataclass(frozen=True)
class NoiseFloor:
    """A floor under the stated noise."""

    floor_px: float  # F, px per axis; zero where the residuals ask for none
    scale: float  # s, the factor on the stated noise beside it
    p_value: float  # How often noise without a floor gives such a likelihood ratio

    @property
    def needed(self) -> bool:
        """Whether the floor is beyond chance."""
        return self.floor_px > 0.0 and self.p_value < LEAST_P_VALUE

    def __str__(self) -> str:
        return clause(Floor.OF_NOISE, it=self)


def noise_floor(
    cal: Calibration, obs: Observations, stated_px: FloatArray | None = None
) -> NoiseFloor:
    """The noise that the residuals of a calibration have beyond what its observations state.

    `sigma_px` in every row are the weights of the calibration; `stated_px` (N,) is what the stars
    state, px, where a floor is in `sigma_px` already. CalibrationError when the observations state
    no noise.
    """
    from scipy.special import erfc

    if obs.sigma_px is None:
        raise CalibrationError("a noise floor needs the noise that every star states (sigma_px).")
    if obs.n_stars < _MIN_STARS:
        return NoiseFloor(0.0, float(cal.sigma), 1.0)
    frames = StarFrames.from_observations(obs)
    found = star_residuals(
        frames, cal.camera.distortion, cal.theta, np.ones(obs.n_stars, dtype=np.bool_)
    )
    known = np.isfinite(found.t)
    squares = found.t[known] * obs.sigma_px[known] ** 2
    stated = (obs.sigma_px if stated_px is None else stated_px)[known] ** 2
    kept = np.ones(len(squares), dtype=np.bool_)
    for _ in range(_ROUNDS):
        scale, floor = _fitted(squares[kept], stated[kept])
        now = squares < _LIMIT_SIGMA**2 * (scale * stated + floor)
        if np.array_equal(now, kept) or now.sum() < _MIN_STARS:
            break
        kept = now
    without = _cost(
        squares[kept], stated[kept] * float(np.mean(squares[kept] / stated[kept]) / 2.0)
    )
    ratio = max(0.0, without - _cost(squares[kept], scale * stated[kept] + floor))
    # The floor cannot be negative: half of the chi-square with one degree of freedom.
    p_value = 0.5 * float(erfc(np.sqrt(0.5 * ratio))) if floor > 0.0 else 1.0
    return NoiseFloor(float(np.sqrt(floor)), float(np.sqrt(scale)), p_value)


def settle_noise(obs: Observations, cal: Calibration) -> Observations:
    """The observations (with `sigma_px` in every row) with a floor in their noise, if their
    residuals need one.

    Without a floor bright stars have too much weight and hence too small residuals: it is found
    from a first calibration, and again from ones that know it.
    """
    from starcal_uq.calibration.calibrate import calibrate

    found = noise_floor(cal, obs)
    raised = with_noise_floor(obs, found)
    for _ in range(_SETTLE_ROUNDS):
        if not found.needed:
            break
        before = found.floor_px
        try:
            # More noise may leave terms of the model open: a simpler one then tells the rest.
            again = calibrate(raised, cal.nominal, duplicates="keep")
        except CalibrationError:
            # The calibration of the run will say what is open.
            break
        found = noise_floor(again, raised, obs.sigma_px)
        raised = with_noise_floor(obs, found)
        if abs(found.floor_px - before) < _SETTLED * before:
            break
    return raised


def with_noise_floor(obs: Observations, floor: NoiseFloor) -> Observations:
    """The observations with the floor in every star's noise, where it is needed;
    ``origin.noise_floor_px`` says it.

    A factor on the stated noise that is more than one is left to the calibration; a smaller one,
    which a floor above all noise stated leaves unknown, is taken up here, so that the noise is the
    scatter seen.
    """
    if not floor.needed or obs.sigma_px is None:
        return obs
    raised: FloatArray = np.hypot(obs.sigma_px, floor.floor_px / floor.scale) * min(
        floor.scale, 1.0
    )
    raised_obs = replace(obs, sigma_px=raised)
    return raised_obs.with_origin(noise_floor_px=floor.floor_px, noise_scale=floor.scale)


def _cost(squares: FloatArray, variance: FloatArray) -> float:
    """-2 log likelihood of the squared lengths of residuals of two axes."""
    return float(np.sum(2.0 * np.log(variance) + squares / variance))


def _fitted(squares: FloatArray, stated: FloatArray) -> tuple[float, float]:
    """s^2 and F^2 of the greatest likelihood."""
    from scipy.optimize import minimize_scalar

    typical = float(np.median(stated))

    def profile(share: float) -> tuple[float, float]:
        """Cost and common factor, for F^2 = factor * share * typical and s^2 = factor * (1 -
        share).
        """
        shape = (1.0 - share) * stated + share * typical
        factor = float(np.mean(squares / shape) / 2.0)
        return _cost(squares, factor * shape), factor

    found = minimize_scalar(lambda share: profile(share)[0], bounds=(0.0, 0.999), method="bounded")
    share = float(found.x)
    if profile(0.0)[0] <= profile(share)[0]:
        share = 0.0
    factor = profile(share)[1]
    return factor * (1.0 - share), factor * share * typical
