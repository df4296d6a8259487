"""How fast the attitude error of a wrong calibration changes along a slew: its spectrum, beside
that of the noise.

Along an attitude profile stars enter, cross and leave the field. A wrong camera then causes an
attitude error that follows them: constant over seconds, different after a field has passed. It is a
FOV spatial error in the sense of ECSS-E-ST-60-20C Rev. 2, which the angular rate of the sensor
turns into a temporal one, here exactly for a given profile. Averaging over frames lowers centroid
noise, which is white, but hardly this part.

The spectrum is one-sided, PSD_j = 2 dt / K |X_j|^2 at f_j = j / (K dt) for K frames dt apart
(without the 2 at the Nyquist frequency), averaged over posterior draws, so that its sum times df is
the mean square of the error over time. As in `starcal_uq.propagation.propagate`, the first-order
response of QUEST gives the average over the whole posterior, and draws through QUEST give what
first order misses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.core.constants import ARCSEC, AXES
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import AttitudeProfileError, SamplingError
from starcal_uq.core.records import Saved
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.propagation.attitude_error import OBSERVED
from starcal_uq.propagation.geometry import FrameGeometry

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations


MIN_SPECTRUM_FRAMES = 16
_MAX_GAPS = 0.2
# Times of a uniform series may be rounded, to milliseconds say; more than this share of a step is
# another series.
_UNEVEN = 0.05
# Averaging times that are tried, evenly in their logarithm.
_AVERAGES = 60


@bounded
def error_spectrum(
    post: Posterior,
    obs: Observations,
    times_s: FloatArray | None = None,
    *,
    n_draws: int = 100,
    seed: Seed = 0,
) -> ErrorSpectrum:
    """Spectrum of the frame-dependent part of the calibration error along a series of frames.

    Parameters
    ----------
    post : Posterior
        Draws of the camera and the noise.
    obs : Observations
        Frames along an attitude profile (`starcal_uq.simulation.profile_frames`), or any others
        that are evenly spaced in time.
    times_s : (K,) array, optional
        Time of each frame, s, in the order of frame numbers; those of `profile_frames` by default.
    n_draws : int
        Draws that go through QUEST; all if there are fewer.
    seed : int or Generator
        Chooses them.

    Raises
    ------
    AttitudeProfileError
        When times are missing, not evenly spaced, or more than a fifth of the instants has no
        frame.
    SamplingError
        For fewer than two draws.
    DistortionError, ObservationError, DegenerateFrameError
        For the reasons that `starcal_uq.propagate` has.
    """
    time, index = _series(obs, times_s)
    step, size = float((time[-1] - time[0]) / (len(time) - 1)), len(time)
    filled, weight = _neighbours(index, size)
    draws = post.thin(n_draws, seed)[:, :-1]
    if len(draws) < 2:
        raise SamplingError("a spectrum needs at least two posterior draws: raise n_draws.")
    frames = FrameGeometry.of(post, obs)
    response = _deviations(_filled(frames.response, filled, weight))
    first = response @ _square_root(post.covariance)
    # Amplitudes of the first-order error: columns are independent, so that squares add up.
    power = _power(first).sum(axis=-1)
    square = np.mean(np.sum(first * first, axis=-1), axis=0)
    # Draws beside first order on the same draws: only the difference is sampled.
    for part, phi in frames.rotations(draws):
        shift = draws[part] - post.mean
        for sampled, linear in zip(phi, np.einsum("kip,dp->dki", response, shift), strict=True):
            series = _deviations(_filled(sampled, filled, weight))
            power += (_power(series) - _power(linear)) / len(draws)
            square += np.mean(series * series - linear * linear, axis=0) / len(draws)
    scale = np.full(len(power), 2.0 * step / size)
    if size % 2 == 0:
        scale[-1] *= 0.5
    nea = np.sqrt(np.diagonal(frames.noise_covariance, axis1=1, axis2=2).mean(axis=0)) * ARCSEC
    lag, correlation = _autocorrelation(first, step)
    return ErrorSpectrum(
        frequency_hz=np.arange(1, len(power) + 1) / (size * step),
        psd_arcsec2_hz=np.maximum(power, 0.0) * scale[:, None] * ARCSEC**2,
        nea_psd_arcsec2_hz=2.0 * step * nea**2,
        variance_arcsec2=np.maximum(square, 0.0) * ARCSEC**2,
        nea_arcsec=nea,
        lag_s=lag,
        autocorrelation=correlation,
        time_s=time,
        sigma_arcsec=np.sqrt(np.sum(first * first, axis=-1)) * ARCSEC,
        step_s=step,
        gap_share=1.0 - len(index) / size,
        n_draws=len(draws),
        frames=str(obs.origin.frames or OBSERVED),
    )


def _series(obs: Observations, times_s: FloatArray | None) -> tuple[FloatArray, IntArray]:
    """Instants (K,) of the uniform series, and the place in it of every frame."""
    given = obs.origin.frame_times_s if times_s is None else times_s
    if given is None:
        raise AttitudeProfileError(
            "these frames carry no times: pass times_s, one for each frame, or frames of "
            "profile_frames."
        )
    time = np.asarray(given, dtype=float)
    if time.shape != (obs.n_frames,):
        raise AttitudeProfileError(
            f"times_s has shape {time.shape}, but there are {obs.n_frames} frames; give one time "
            "for each."
        )
    if len(time) < MIN_SPECTRUM_FRAMES:
        raise AttitudeProfileError(
            f"a spectrum needs at least {MIN_SPECTRUM_FRAMES} frames, not {len(time)}: raise the "
            "rate, or propagate "
            "without a spectrum."
        )
    steps = np.diff(time)
    step = float(np.median(steps))
    if not (np.all(np.isfinite(time)) and np.all(steps > 0.0)):
        raise AttitudeProfileError("times_s must be finite and increase from frame to frame.")
    # The median step is rounded as the times are; the whole series gives it better.
    whole = np.cumsum(np.maximum(np.rint(steps / step), 1.0))
    step = float((time[-1] - time[0]) / whole[-1])
    place = np.concatenate([[0.0], whole])
    if np.any(np.abs((time - time[0]) / step - place) > _UNEVEN):
        raise AttitudeProfileError(
            "the frames are not evenly spaced in time: interpolate the profile, with rate_hz."
        )
    size = int(place[-1]) + 1
    if len(time) < (1.0 - _MAX_GAPS) * size:
        raise AttitudeProfileError(
            f"{size - len(time)} of {size} evenly spaced instants have no frame, more than a "
            "spectrum can bridge (the "
            f"longest gap begins at {time[int(np.argmax(steps))]:g} s): where frames show too "
            "few stars, raise max_mag "
            "or lower min_stars; where the profile has no attitudes, cut it there."
        )
    return time[0] + step * np.arange(size), place.astype(np.int64)


def _neighbours(index: IntArray, size: int) -> tuple[IntArray, FloatArray]:
    """For every instant the frame before it (size,), and the weight (size,) of the next one."""
    before = np.clip(np.searchsorted(index, np.arange(size), side="right") - 1, 0, len(index) - 2)
    weight = (np.arange(size) - index[before]) / (index[before + 1] - index[before])
    return before, weight


def _filled(values: FloatArray, before: IntArray, weight: FloatArray) -> FloatArray:
    """A series (K, ...) of frames on the uniform instants, linear over gaps."""
    w = weight.reshape(-1, *(1,) * (values.ndim - 1))
    return values[before] * (1.0 - w) + values[before + 1] * w


def _square_root(covariance: FloatArray) -> FloatArray:
    """L (p, p) with L L^T = covariance, whose entries differ by thirty orders of magnitude and may
    be singular.
    """
    sd = root_diagonal(covariance)
    scale = np.where(sd > 0.0, sd, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root: FloatArray = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _deviations(series: FloatArray) -> FloatArray:
    deviations: FloatArray = series - series.mean(axis=0)
    return deviations


def _power(series: FloatArray) -> FloatArray:
    """Squared amplitudes (F, ...) of a series (K, ...) at all frequencies but zero."""
    amplitude = np.fft.rfft(series, axis=0)[1:]
    return amplitude.real**2 + amplitude.imag**2


def _autocorrelation(first: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Lags and the autocorrelation (L, 3) of independent amplitudes (K, 3, p), without wrapping
    round.
    """
    size = len(first)
    amplitude = np.fft.rfft(first, n=2 * size, axis=0)
    products = np.fft.irfft(
        np.sum(amplitude.real**2 + amplitude.imag**2, axis=-1), n=2 * size, axis=0
    )[: size // 2]
    products /= np.arange(size, size - size // 2, -1)[:, None]
    power = np.where(products[0] > 0.0, products[0], 1.0)
    lag: FloatArray = step * np.arange(size // 2, dtype=float)
    return lag, products / power


@dataclass(frozen=True, eq=False)
class ErrorSpectrum(Shown, Saved):
    """Spectrum of the frame-dependent attitude error of a calibration along a series of frames.

    Axes are pitch, yaw and roll, as for `AttitudeError`.

    Attributes
    ----------
    frequency_hz : (F,) array
        Frequencies, from one over the duration to half the frame rate, Hz.
    psd_arcsec2_hz : (F, 3) array
        One-sided power spectral density of the frame-dependent part, average over the posterior,
        arcsec^2 / Hz.
    nea_psd_arcsec2_hz : (3,) array
        That of centroid noise, which is white, arcsec^2 / Hz.
    variance_arcsec2 : (3,) array
        Mean square of the frame-dependent part over time and posterior, found without the spectrum,
        arcsec^2.
    nea_arcsec : (3,) array
        Centroid noise of a frame, root mean square over frames, arcsec.
    lag_s : (L,) array
        Lags of the autocorrelation, s; up to half the duration.
    autocorrelation : (L, 3) array
        Autocorrelation of the frame-dependent part, averaged over the posterior.
    time_s : (K,) array
        Instants of the uniform series, s.
    sigma_arcsec : (K, 3) array
        Standard deviation of the frame-dependent part over the posterior at each instant, first
        order, arcsec.
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

    KIND = "starcal_uq error spectrum 1"
    FILE = "an error spectrum", "compute it with error_spectrum"
    SHAPES: ClassVar = """
        f: frequency_hz
        f 3: psd_arcsec2_hz
        l: lag_s
        l 3: autocorrelation
        3: nea_psd_arcsec2_hz variance_arcsec2 nea_arcsec
        k: time_s
        k 3: sigma_arcsec
    """

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the three axes."""
        return AXES

    @property
    def rest_arcsec(self) -> FloatArray:
        """Standard deviation (3,) of the frame-dependent part over time and posterior, arcsec."""
        return np.sqrt(self.variance_arcsec2)

    @property
    def correlation_time_s(self) -> FloatArray:
        """Lag (3,) at which the autocorrelation falls below 1/e, s; NaN where it never does."""
        return np.array([_crossing(self.lag_s, column) for column in self.autocorrelation.T])

    def averaged_arcsec(self, seconds: float) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (3,) of the frame-dependent part and of noise after averaging over
        some time, arcsec.

        An average over n frames dt apart passes the share (sin(pi f n dt) / (n sin(pi f dt)))^2 of
        the power at frequency f; noise falls with the root of the frames.

        Raises
        ------
        ValueError
            For less than one frame, or more than a quarter of the duration, over which the spectrum
            knows nothing.
        """
        longest = self.longest_average_s
        if not self.step_s * (1.0 - 1e-9) <= seconds <= longest * (1.0 + 1e-9):
            raise ValueError(
                f"averaging over {seconds:g} s: choose {self.step_s:g} s to {longest:g} s."
            )
        passed = (
            np.sinc(self.frequency_hz * seconds) / np.sinc(self.frequency_hz * self.step_s)
        ) ** 2
        rest: FloatArray = np.sqrt(passed @ self.psd_arcsec2_hz * self.frequency_hz[0])
        return rest, self.nea_arcsec * np.sqrt(self.step_s / seconds)

    @property
    def dominates_after_s(self) -> FloatArray:
        """Averaging time (3,) from which the frame-dependent part exceeds noise, s; NaN if not
        within a quarter.
        """
        times = np.geomspace(self.step_s, self.longest_average_s, _AVERAGES)
        larger = np.array([np.greater(*self.averaged_arcsec(float(t))) for t in times])
        return np.where(larger.any(axis=0), times[np.argmax(larger, axis=0)], np.nan)

    @property
    def longest_average_s(self) -> float:
        """Longest time to average over, s: a quarter of the duration."""
        return 0.25 * self.step_s * len(self.time_s)

    def share_below(self, frequency_hz: float) -> FloatArray:
        """Share (3,) of the variance of the frame-dependent part at frequencies up to
        `frequency_hz`.
        """
        low = self.psd_arcsec2_hz[self.frequency_hz <= frequency_hz].sum(axis=0)
        total = self.psd_arcsec2_hz.sum(axis=0)
        share: FloatArray = low / np.where(total > 0.0, total, np.nan)
        return share

    def to_dataframe(self) -> pd.DataFrame:
        """One row per frequency and axis: ``frequency_hz``, ``axis``, ``rest_arcsec2_hz``,
        ``nea_arcsec2_hz``.
        """
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


def _crossing(lag: FloatArray, correlation: FloatArray) -> float:
    """First lag at which a correlation falls below 1/e, between samples linearly; NaN if there is
    none.
    """
    below: BoolArray = correlation < np.exp(-1.0)
    if not below.any() or below[0]:
        return float("nan")
    i = int(np.argmax(below))
    upper, lower = correlation[i - 1], correlation[i]
    return float(lag[i - 1] + (lag[i] - lag[i - 1]) * (upper - np.exp(-1.0)) / (upper - lower))
