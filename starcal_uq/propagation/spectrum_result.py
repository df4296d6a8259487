"""Spectrum of the frame-dependent attitude error along a slew: the result of `starcal_uq.propagation.spectrum`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.files import reading_archive, write_archive
from starcal_uq.core.formatting import join_words, percent, significant
from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.propagation.attitude_error import AXES, OBSERVED

if TYPE_CHECKING:
    import pandas as pd

_KIND = "starcal_uq error spectrum 1"
_AVERAGES = 60
# Smaller is rounding.
_ROUNDING_ARCSEC = 1e-9


@dataclass(frozen=True, eq=False)
class ErrorSpectrum:
    """Spectrum of the frame-dependent attitude error of a calibration along a series of frames.

    Axes are pitch, yaw and roll, as for `AttitudeError`.

    Attributes
    ----------
    frequency_hz : (F,) array
        Frequencies, from one over the duration to half the frame rate, Hz.
    psd_arcsec2_hz : (F, 3) array
        One-sided power spectral density of the frame-dependent part, average over the posterior, arcsec^2 / Hz.
    nea_psd_arcsec2_hz : (3,) array
        That of centroid noise, which is white, arcsec^2 / Hz.
    variance_arcsec2 : (3,) array
        Mean square of the frame-dependent part over time and posterior, found without the spectrum, arcsec^2.
    nea_arcsec : (3,) array
        Centroid noise of a frame, root mean square over frames, arcsec.
    lag_s : (L,) array
        Lags of the autocorrelation, s; up to half the duration.
    autocorrelation : (L, 3) array
        Autocorrelation of the frame-dependent part, averaged over the posterior.
    time_s : (K,) array
        Instants of the uniform series, s.
    sigma_arcsec : (K, 3) array
        Standard deviation of the frame-dependent part over the posterior at each instant, first order, arcsec.
    step_s : float
        Time between frames, s.
    gap_share : float
        Share of instants without a frame, over which the series was interpolated.
    n_draws : int
        Draws that went through QUEST.
    frames : str
        Which frames these are.
    """

    frequency_hz: FloatArray
    psd_arcsec2_hz: FloatArray
    nea_psd_arcsec2_hz: FloatArray
    variance_arcsec2: FloatArray
    nea_arcsec: FloatArray
    lag_s: FloatArray
    autocorrelation: FloatArray
    time_s: FloatArray
    sigma_arcsec: FloatArray
    step_s: float
    gap_share: float
    n_draws: int
    frames: str = OBSERVED

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three axes."""
        return AXES

    @property
    def rest_arcsec(self) -> FloatArray:
        """Standard deviation (3,) of the frame-dependent part over time and posterior, arcsec."""
        return np.sqrt(self.variance_arcsec2)

    @property
    def integral_arcsec2(self) -> FloatArray:
        """Integral (3,) of the spectrum over all frequencies; equals `variance_arcsec2` if all is well."""
        total: FloatArray = self.psd_arcsec2_hz.sum(axis=0) * self.frequency_hz[0]
        return total

    @property
    def correlation_time_s(self) -> FloatArray:
        """Lag (3,) at which the autocorrelation falls below 1/e, s; NaN where it never does."""
        return np.array([_crossing(self.lag_s, column) for column in self.autocorrelation.T])

    def averaged_arcsec(self, seconds: float) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (3,) of the frame-dependent part and of noise after averaging over some time, arcsec.

        An average over n frames dt apart passes the share (sin(pi f n dt) / (n sin(pi f dt)))^2 of the power at
        frequency f; noise falls with the root of the frames.

        Raises
        ------
        ValueError
            For less than one frame, or more than a quarter of the duration, over which the spectrum knows nothing.
        """
        longest = self._longest_s
        if not self.step_s * (1.0 - 1e-9) <= seconds <= longest * (1.0 + 1e-9):
            raise ValueError(f"averaging over {seconds:g} s: choose {self.step_s:g} s to {longest:g} s.")
        passed = (np.sinc(self.frequency_hz * seconds) / np.sinc(self.frequency_hz * self.step_s)) ** 2
        rest: FloatArray = np.sqrt(passed @ self.psd_arcsec2_hz * self.frequency_hz[0])
        return rest, self.nea_arcsec * np.sqrt(self.step_s / seconds)

    @property
    def dominates_after_s(self) -> FloatArray:
        """Averaging time (3,) from which the frame-dependent part exceeds noise, s; NaN if not within a quarter."""
        times = np.geomspace(self.step_s, self._longest_s, _AVERAGES)
        larger = np.array([np.greater(*self.averaged_arcsec(float(t))) for t in times])
        return np.where(larger.any(axis=0), times[np.argmax(larger, axis=0)], np.nan)

    @property
    def _longest_s(self) -> float:
        return 0.25 * self.step_s * len(self.time_s)

    def share_below(self, frequency_hz: float) -> FloatArray:
        """Share (3,) of the variance of the frame-dependent part at frequencies up to `frequency_hz`."""
        low = self.psd_arcsec2_hz[self.frequency_hz <= frequency_hz].sum(axis=0)
        total = self.psd_arcsec2_hz.sum(axis=0)
        share: FloatArray = low / np.where(total > 0.0, total, np.nan)
        return share

    def below_arcsec(self, frequency_hz: float) -> FloatArray:
        """Standard deviation (3,) of the frame-dependent part at frequencies up to `frequency_hz`, arcsec."""
        low = self.psd_arcsec2_hz[self.frequency_hz <= frequency_hz].sum(axis=0)
        sigma: FloatArray = np.sqrt(low * self.frequency_hz[0])
        return sigma

    @property
    def sentence(self) -> str:
        """The spectrum in words."""
        rest, tau, nyquist = self.rest_arcsec, self.correlation_time_s, float(self.frequency_hz[-1])
        share = self.share_below(0.1 * nyquist)
        if not np.all(rest > _ROUNDING_ARCSEC):
            return "The calibration has no frame-dependent part along this profile: its frames all show the same stars."
        words = (
            f"Along {self.frames}, the frame-dependent part of the calibration error is {_listed(rest)} arcsec "
            f"({', '.join(AXES)}), beside {_listed(self.nea_arcsec)} arcsec of centroid noise in each frame. It keeps "
            f"its value for about {_listed(tau)} s; {', '.join(percent(float(v)) for v in share)} of its variance lie "
            f"below a tenth of the highest frequency ({significant(0.1 * nyquist)} Hz). {self._averaging_words()}"
        )
        if self.gap_share > 0.0:
            words += f" {percent(self.gap_share)} of the instants have no frame and were interpolated."
        return words

    def _averaging_words(self) -> str:
        after = self.dominates_after_s
        if np.isfinite(after).any():
            axes = [f"{axis} after {significant(t)} s" for axis, t in zip(AXES, after, strict=True) if np.isfinite(t)]
            return f"Where frames are averaged, it comes to exceed centroid noise: {join_words(axes)}."
        rest, noise = self.averaged_arcsec(self._longest_s)
        return (
            f"Averaging of frames, up to {significant(self._longest_s)} s, leaves it below centroid noise: "
            f"{_listed(rest)} against {_listed(noise)} arcsec."
        )

    def to_dataframe(self) -> pd.DataFrame:
        """One row per frequency and axis: ``frequency_hz``, ``axis``, ``rest_arcsec2_hz``, ``nea_arcsec2_hz``."""
        import pandas as pd

        n = len(self.frequency_hz)
        return pd.DataFrame(
            {
                "frequency_hz": np.repeat(self.frequency_hz, 3),
                "axis": np.array(AXES * n, dtype=object),
                "rest_arcsec2_hz": self.psd_arcsec2_hz.ravel(),
                "nea_arcsec2_hz": np.tile(self.nea_psd_arcsec2_hz, n),
            }
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one ``.npz`` file, atomically and without loss; overwritten."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        document = {name: getattr(self, name) for name in ("step_s", "gap_share", "n_draws", "frames")}
        write_archive(path, _KIND, document, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ErrorSpectrum:
        """Read what `save` wrote.

        Raises
        ------
        RunFolderError
            If the file is missing or is not such a spectrum.
        """
        with reading_archive(
            path,
            _KIND,
            missing="compute it again with error_spectrum",
            wrong="is not an error spectrum; compute it again with error_spectrum",
        ) as (document, arrays):
            return cls(**{name: arrays[name] for name in _ARRAYS}, **document)

    def plot_spectrum(self, **options: Any) -> Any:
        """The spectrum with the floor of the noise; options as for `starcal_uq.presentation.figures.spectrum.plot_spectrum`."""
        from starcal_uq.presentation.figures.spectrum import plot_spectrum

        return plot_spectrum(self, **options)

    def plot_time_series(self, **options: Any) -> Any:
        """Standard deviation over time; options as for `starcal_uq.presentation.figures.spectrum.plot_error_series`."""
        from starcal_uq.presentation.figures.spectrum import plot_error_series

        return plot_error_series(self, **options)

    def _repr_html_(self) -> str:
        import pandas as pd

        table = pd.DataFrame(
            {
                "axis": AXES,
                "frame-dependent part [arcsec]": self.rest_arcsec,
                "correlation time [s]": self.correlation_time_s,
                "centroid noise of a frame [arcsec]": self.nea_arcsec,
                "exceeds averaged noise after [s]": self.dominates_after_s,
            }
        )
        html = table.to_html(index=False, float_format=significant, na_rep="not known", border=0)
        return f"<p><b>Error spectrum</b>: {self.n_draws} posterior draws.</p>{html}<p>{self.sentence}</p>"


_ARRAYS = (
    "frequency_hz", "psd_arcsec2_hz", "nea_psd_arcsec2_hz", "variance_arcsec2", "nea_arcsec", "lag_s",
    "autocorrelation", "time_s", "sigma_arcsec",
)  # fmt: skip


def _crossing(lag: FloatArray, correlation: FloatArray) -> float:
    """First lag at which a correlation falls below 1/e, between samples linearly; NaN if there is none."""
    below: BoolArray = correlation < np.exp(-1.0)
    if not below.any() or below[0]:
        return float("nan")
    i = int(np.argmax(below))
    upper, lower = correlation[i - 1], correlation[i]
    return float(lag[i - 1] + (lag[i] - lag[i - 1]) * (upper - np.exp(-1.0)) / (upper - lower))


def _listed(values: FloatArray) -> str:
    return ", ".join(significant(float(v)) if np.isfinite(v) else "an unknown number of" for v in values)
