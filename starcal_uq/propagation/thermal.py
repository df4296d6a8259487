"""What the temperature of the optics does to attitudes along an orbit.

The effect `temperature` of a calibration moves x0, y0 and f by w a, with w = (T - mean) / spread of
the temperatures that were seen and a known coefficients and covariance. Software that uses one
camera for all temperatures then errs, in frame k at the time t, by

    phi_k(t) = -w(t) R_k a,

with R_k the turn by x0, y0 and f. Alignment is calibrated over the profile and takes up what its
frames see at its mean, -w_m R_m a. The rest is -(w(t) R_k - w_m R_m) a. Software that follows the
temperature knows the expected a and is left with the covariance, which grows with the square of the
distance from the mean of the calibration, within the temperatures that were seen and beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.profile import check_order, read_columns
from starcal_uq.core.constants import ARCSEC, TOTAL_AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import AttitudeProfileError, CalibrationError
from starcal_uq.core.files import listed, write_csv
from starcal_uq.core.remedy import CAMERA, OBS, RUN, Remedy
from starcal_uq.core.types import BoolArray, FloatArray, IntArray, PathLike
from starcal_uq.propagation.onboard_error import EffectError, with_cross

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.core.settings import OnboardModel
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

TEMPERATURE = "temperature"
# Spelt out, as all that a command names.
_WITH_IT = Remedy("calibrate", (OBS, CAMERA), {"effects": "temperature"})
# Temperatures of optics, degC; others are of another unit.
_COLDEST_C, _HOTTEST_C = -150.0, 150.0


@dataclass(frozen=True, eq=False)
class TemperatureProfile:
    """Temperatures of the optics over time.

    Attributes
    ----------
    time_s : (T,) array
        Strictly increasing times, s.
    temperature_c : (T,) array
        Temperatures, degC.
    name : str
        Origin, such as the path of a file.
    """

    time_s: FloatArray
    temperature_c: FloatArray
    name: str = "the temperature profile"

    def __post_init__(self) -> None:
        rows = np.arange(1, len(self.time_s) + 1)
        _check(f"{self.name}, ", "row", rows, self.time_s, self.temperature_c)

    @property
    def shares(self) -> FloatArray:
        """Share of the time (T,) at each temperature: half of both neighbouring steps."""
        steps = np.diff(self.time_s)
        around = np.append(steps, 0.0) + np.insert(steps, 0, 0.0)
        return np.asarray(around / around.sum())


def load_temperature_profile(path: PathLike) -> TemperatureProfile:
    """Read a temperature profile (``.csv``, ``.ecsv`` or ``.parquet``).

    Parameters
    ----------
    path
        A table with ``time_s`` (seconds) or ``time_utc`` (ISO 8601), and ``temperature_c``.
        Comments start with ``#``.

    Raises
    ------
    AttitudeProfileError
        When the file cannot be read, a column is missing, times do not increase, or a value is no
        temperature in degC.
    """
    table = read_columns(path, "a time and a temperature")
    if "temperature_c" not in table.cells:
        raise AttitudeProfileError(
            f"{path}: column temperature_c is missing; give it, in degrees Celsius, beside time_s "
            f"or time_utc (the file has {listed(list(table.cells)) or 'no columns'})."
        )
    warmth, time_s = table.numbers_of("temperature_c"), table.time_s
    _check(f"{path}, ", table.word, table.numbers, time_s, warmth)
    return TemperatureProfile(time_s, warmth, table.path.name)


def _check(
    where: str, word: str, numbers: IntArray, time_s: FloatArray, warmth: FloatArray
) -> None:
    """Refuse times that do not increase, and what is no temperature in degC."""
    if len(numbers) < 2:
        raise AttitudeProfileError(
            f"{where}{word} {numbers[0]}: is the only one; give temperatures at two times or more."
        )
    bad = np.flatnonzero(~np.isfinite(time_s))
    if bad.size:
        raise AttitudeProfileError(
            f"{where}{word} {numbers[bad[0]]}: the time is not finite; repair it."
        )
    check_order(where, word, numbers, time_s)
    odd = np.flatnonzero(~((warmth >= _COLDEST_C) & (warmth <= _HOTTEST_C)))
    if odd.size:
        i = odd[0]
        raise AttitudeProfileError(
            f"{where}{word} {numbers[i]}: temperature_c is {warmth[i]:g}, outside of {_COLDEST_C:g} "
            f"to {_HOTTEST_C:g}; give degrees Celsius."
        )


def read_again(path: PathLike) -> TemperatureProfile:
    """The profile of a table that `ThermalError.save` wrote."""
    table = read_columns(path, "a time and a temperature")
    if not {"time_s", "temperature_c", "profile"} <= set(table.cells):
        again = Remedy("propagate", (RUN,), {"temperature_profile": "FILE", "force": True})
        raise AttitudeProfileError(f"{path}: is no such table; make it again with `{again.words}`.")
    each = slice(None, None, len(TOTAL_AXES))
    time_s, warmth = table.time_s[each], table.numbers_of("temperature_c")[each]
    return TemperatureProfile(time_s, warmth, table.cells["profile"][0])


@dataclass(frozen=True, eq=False)
class ThermalResponse:
    """How attitudes follow the temperature of the optics, whatever the profile.

    Attributes
    ----------
    mean_c, spread_c : float
        Mean and standard deviation of the temperatures of the calibration, degC.
    lowest_c, highest_c : float
        Their range, degC.
    change : (3,) array
        Expected change of x0, y0 and f, px, for one standard deviation of the temperature.
    covariance : (3, 3) array
        Its covariance, px^2.
    together : (3, 3) array
        Common rotation, by x0, y0 and f, of the frames of the alignment, rad/px.
    mean_turn : (3, 3) array
        Mean turn of the mission's frames, rad/px.
    products : (3, 3, 3, 3) array
        Mean over the mission's frames of the products of turns of two axes by two parameters, in
        the order axis, parameter, axis, parameter, rad^2/px^2.
    """

    mean_c: float
    spread_c: float
    lowest_c: float
    highest_c: float
    change: FloatArray
    covariance: FloatArray
    together: FloatArray
    mean_turn: FloatArray
    products: FloatArray

    @classmethod
    def of(
        cls,
        post: Posterior,
        calibrated: Observations,
        response: FloatArray,
        together: FloatArray,
    ) -> ThermalResponse | None:
        """From the turns (K, 3, p) of the mission's frames by the parameters, and those in common
        (3, p); None where the calibration holds no such effect.
        """
        found, seen = post.effects, calibrated.temperature_c
        if found is None or TEMPERATURE not in found.names or seen is None:
            return None
        at, turns = found.at(TEMPERATURE), response[:, :, :3]
        return cls(
            *found.temperature_c,
            float(np.nanmin(seen)),
            float(np.nanmax(seen)),
            found.coefficients[at],
            found.covariance[at, at],
            together[:, :3],
            turns.mean(axis=0),
            np.einsum("kia,kjb->iajb", turns, turns) / len(turns),
        )

    def over(self, profile: TemperatureProfile) -> ThermalError:
        """The attitude error over a profile, with alignment calibrated at its mean temperature."""
        warmth = (profile.temperature_c - self.mean_c) / self.spread_c
        aligned = float(profile.shares @ warmth)
        squared = float(profile.shares @ warmth**2)
        sizes, errors = [], []
        for known in (np.zeros(3), self.change):
            unknown = self.change - known
            moments = self.covariance + np.outer(unknown, unknown)
            there = np.einsum("iajb,ab->ij", self.products, moments)
            beside = self.mean_turn @ moments @ self.together.T
            removed = self.together @ moments @ self.together.T
            parts = [np.diag(each) for each in (there, beside + beside.T, removed)]
            powers = np.stack([warmth**2, -warmth * aligned, np.full(len(warmth), aligned**2)])
            sizes.append(np.sqrt(np.maximum(powers.T @ np.stack(parts), 0.0)) * ARCSEC)
            # Over time and frames together.
            apart = aligned * (self.mean_turn - self.together)
            mean = -apart @ unknown
            rest = squared * there + aligned**2 * (removed - beside - beside.T)
            errors.append(
                EffectError.of(
                    TEMPERATURE,
                    (
                        -aligned * self.together @ unknown * ARCSEC,
                        aligned**2 * self.together @ self.covariance @ self.together.T * ARCSEC**2,
                    ),
                    (mean * ARCSEC, (rest - np.outer(mean, mean)) * ARCSEC**2),
                    np.diag(apart @ self.covariance @ apart.T) * ARCSEC**2,
                )
            )
        return ThermalError(
            profile=profile,
            aligned_c=self.mean_c + aligned * self.spread_c,
            lowest_c=self.lowest_c,
            highest_c=self.highest_c,
            model_arcsec=sizes[0],
            effects_arcsec=sizes[1],
            model=errors[0],
            effects=errors[1],
        )


@dataclass(frozen=True, eq=False)
class ThermalError(Shown):
    """Attitude error from the temperature of the optics over a profile, arcsec, 1 sigma.

    Attributes
    ----------
    profile : TemperatureProfile
        The temperatures.
    aligned_c : float
        Temperature at which alignment is calibrated, the mean over the profile, degC.
    lowest_c, highest_c : float
        Range of temperatures of the calibration, degC.
    model_arcsec, effects_arcsec : (T, 3) array
        Root mean square over frames about pitch, yaw and roll at every time, after alignment: where
        the software uses one camera for all temperatures, and where it follows the temperature.
    model, effects : EffectError
        The same over the whole profile, with the common rotation that alignment absorbs.
    """

    profile: TemperatureProfile
    aligned_c: float
    lowest_c: float
    highest_c: float
    model_arcsec: FloatArray
    effects_arcsec: FloatArray
    model: EffectError
    effects: EffectError

    @property
    def outside(self) -> BoolArray:
        """True (T,) where the temperature is outside of those of the calibration."""
        warmth = self.profile.temperature_c
        return (warmth < self.lowest_c) | (warmth > self.highest_c)

    @property
    def outside_share(self) -> float:
        """Share of the time outside of the temperatures of the calibration."""
        return float(self.profile.shares[self.outside].sum())

    def share(self, onboard: OnboardModel) -> EffectError:
        """The error over the whole profile with an onboard model."""
        return self.model if onboard == "model" else self.effects

    def peak_arcsec(self, onboard: OnboardModel) -> FloatArray:
        """Largest error (3,) of the profile with an onboard model."""
        sizes = self.model_arcsec if onboard == "model" else self.effects_arcsec
        return np.asarray(sizes.max(axis=0))

    def to_dataframe(self) -> pd.DataFrame:
        """One row per time and axis: ``time_s``, ``temperature_c``, ``axis``,
        ``onboard_model_arcsec`` and ``onboard_effects_arcsec``, 1 sigma after alignment.

        Cross-boresight rows hold the root mean square of pitch and yaw.
        """
        import pandas as pd

        n, axes = len(self.profile.time_s), len(TOTAL_AXES)
        model, effects = (
            np.concatenate([with_cross(line) for line in sizes])
            for sizes in (self.model_arcsec, self.effects_arcsec)
        )
        return pd.DataFrame(
            {
                "time_s": np.repeat(self.profile.time_s, axes),
                "temperature_c": np.repeat(self.profile.temperature_c, axes),
                "axis": np.array(TOTAL_AXES * n, dtype=object),
                "onboard_model_arcsec": model,
                "onboard_effects_arcsec": effects,
            }
        )

    def save(self, path: PathLike) -> None:
        """Write the table as CSV, atomically and to the last digit; overwritten."""
        write_csv(self.to_dataframe().assign(profile=self.profile.name), path)


def thermal_error(
    response: ThermalResponse | None, profile: TemperatureProfile | PathLike
) -> ThermalError:
    """The attitude error over a profile or the file of one.

    Raises
    ------
    CalibrationError
        Where the calibration holds no effect of the temperature.
    """
    if not isinstance(profile, TemperatureProfile):
        profile = load_temperature_profile(profile)
    if response is None:
        raise CalibrationError(
            f"{profile.name}: the calibration holds no effect {TEMPERATURE!r}, so that no "
            "temperature acts on attitudes: leave the profile out, or calibrate a table whose "
            f"temperature_c varies with `{_WITH_IT.words}`."
        )
    return response.over(profile)
