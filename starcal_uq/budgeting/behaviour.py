"""How a row of a budget behaves in time: what a mean over a window keeps of its error, and what
changes between two windows.

An error e(t) of variance S, whose mean over a window dt is m(t), is described by the share of its
variance that the mean keeps, K(dt) = var(m) / S. For a one-sided spectrum S(f), K(dt) = int
sinc(f dt)^2 S(f) df / int S(f) df, and the windows dt of which the second begins dt_s later than
the first differ by

    var(m(t + dt_s) - m(t)) dt^2 / S = 2 V(dt) + 2 V(dt_s) - V(dt + dt_s) - V(dt - dt_s),

with V(T) = T^2 K(T), the variance of an integral over T. That is the integral of sinc(f dt)^2 2 (1 -
cos(2 pi f dt_s)) S(f) of ECSS-E-ST-60-10C, without an integral where K is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from starcal_uq.attitude.profile import TableColumns, check_order, read_columns
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import BudgetError
from starcal_uq.core.files import listed
from starcal_uq.core.types import BoolArray, FloatArray, PathLike

Kind = Literal["constant", "white", "periodic", "correlated", "drift", "spectrum", "series"]
# The key of a budget file that states each behaviour.
KEYS: dict[Kind, str] = {
    "white": "sample_seconds",
    "periodic": "period_seconds",
    "correlated": "correlation_seconds",
    "drift": "drift_seconds",
    "spectrum": "psd",
    "series": "series",
}
_UNEVEN = 0.05
# Arguments below which the first terms of a series are exact to rounding.
_SMALL = 1e-3
# Lags at which autocovariances are compared, correlation times that are tried, lines of a spectrum.
_LAGS, _TIMES, _LINES = 80, 200, 4096
# Correlation times up to which they are to agree.
_WITHIN = 3.0


@dataclass(frozen=True, eq=False)
class Behaviour:
    """Behaviour of an error in time, independent of its size.

    Attributes
    ----------
    kind : str
        ``constant``; ``white`` (samples, each independent of the others); ``periodic`` (a sinusoid
        at a random moment); ``correlated`` (first-order Gauss-Markov); ``drift`` (linear, over a
        stated time); ``spectrum`` (power spectral density); ``series`` (a time series).
    seconds : float
        Time between samples, period, correlation time, or time of the drift, s.
    frequency_hz : array (n,)
        Frequencies of a spectrum, or of the lines of a series, Hz.
    power : array (n,)
        One-sided density, linear in between, arcsec^2 / Hz; mean squares of lines, arcsec^2.
    mean_arcsec : float
        Mean of a series, arcsec.
    """

    __dir__ = public_names

    kind: Kind
    seconds: float = math.nan
    frequency_hz: FloatArray = field(default_factory=lambda: np.empty(0))
    power: FloatArray = field(default_factory=lambda: np.empty(0))
    mean_arcsec: float = 0.0

    @property
    def text(self) -> str:
        """Kind and time, as rows of a budget state them."""
        return self.kind + ("" if math.isnan(self.seconds) else f", {self.seconds:.4g} s")

    @classmethod
    def of_text(cls, text: str) -> Behaviour | None:
        """Behaviour described by a text; None for spectra and series, which the text does not
        contain.
        """
        kind, _, seconds = text.partition(", ")
        if kind == "constant":
            return cls("constant")
        for stated in KEYS:
            if stated == kind and stated not in ("spectrum", "series"):
                return cls(stated, float(seconds.removesuffix(" s")))
        return None

    @property
    def sigma_arcsec(self) -> float:
        """Standard deviation of a spectrum or a series, arcsec; NaN if it is stated separately."""
        if self.kind == "spectrum":
            return math.sqrt(float(np.trapezoid(self.power, self.frequency_hz)))
        return math.sqrt(float(np.sum(self.power))) if self.kind == "series" else math.nan

    @property
    def longest_s(self) -> float:
        """Longest window for which the behaviour is known, s."""
        if self.kind == "drift":
            return self.seconds
        return 0.25 / float(self.frequency_hz[0]) if self.kind == "series" else math.inf

    def kept(self, window_s: float) -> float:
        """Share of the variance that the mean over a window keeps."""
        if self.kind == "constant" or window_s == 0.0:
            return 1.0
        t = window_s / self.seconds
        if self.kind == "white":
            return min(1.0, 1.0 / t)
        if self.kind == "periodic":
            return float(np.sinc(t) ** 2)
        if self.kind == "correlated":
            # 2 (t - 1 + exp(-t)) / t^2, where rounding leaves it.
            return 2.0 * (t + math.expm1(-t)) / t**2 if t > _SMALL else 1.0 - t / 3.0
        if self.kind == "drift":
            return max(1.0 - t, 0.0) ** 2
        if self.kind == "series":
            return float(self._response(window_s) @ self.power) / float(np.sum(self.power))
        return _passed(self.frequency_hz, self.power, window_s) / self.sigma_arcsec**2

    def _response(self, window_s: float) -> FloatArray:
        """Share of the power of each line that a mean of the samples of a window keeps."""
        f = self.frequency_hz
        kept = np.sinc(f * max(window_s, self.seconds)) / np.sinc(f * self.seconds)
        return kept**2

    def left(self, window_s: float) -> float:
        """Share of the variance that remains around the mean of the window."""
        if self.kind == "drift":
            return (window_s / self.seconds) ** 2
        return max(1.0 - self.kept(window_s), 0.0)

    def changed(self, window_s: float, later_s: float) -> float:
        """Variance of the difference of the means over two windows that begin `later_s` apart, over
        the variance.
        """
        if self.kind == "constant":
            return 0.0
        if self.kind == "drift":
            return 12.0 * (later_s / self.seconds) ** 2
        if self.kind == "white" and later_s >= window_s:
            return 2.0 * self.kept(window_s)
        if self.kind == "series":
            passed = self._response(window_s)
            passed *= 4.0 * np.sin(np.pi * self.frequency_hz * later_s) ** 2
            return float(passed @ self.power) / float(np.sum(self.power))
        if self.kind == "periodic":
            return self.kept(window_s) * 4.0 * math.sin(math.pi * later_s / self.seconds) ** 2
        one, other, both, apart = (
            t * t * self.kept(t)
            for t in (window_s, later_s, window_s + later_s, abs(window_s - later_s))
        )
        return max(2.0 * (one + other) - both - apart, 0.0) / window_s**2

    def gauss_markov(self) -> tuple[float, float, float]:
        """White share of the variance, correlation time of the first-order Gauss-Markov process that
        has the rest, s, and the largest difference of their autocovariance from that of a series
        or a spectrum up to three correlation times, in variances.

        Lags are even in their logarithm. Lines are of a record without its mean, in which a process
        shows the less of itself the longer it takes.
        """
        from scipy.optimize import nnls

        lines = self if self.kind == "series" else self._as_lines()
        step, n = lines.seconds, round(1.0 / (lines.frequency_hz[0] * lines.seconds))
        own = 0.5 * n * np.concatenate([[0.0], lines.power])
        own[-1] *= 2.0 if n % 2 == 0 else 1.0
        lag = np.arange(n)
        at = np.unique(np.rint(np.geomspace(1, n // 2, _LAGS)).astype(int)) - 1
        wanted = np.fft.irfft(own, n) / np.sum(lines.power)
        found = []
        for time in np.geomspace(0.5, 0.25 * n, _TIMES):
            known = np.stack([lag == 0, np.exp(-lag / time)])
            # Of a record: lags meet round its ends, and its mean is gone.
            known = ((n - lag) * known + lag * np.roll(known[:, ::-1], 1, axis=1)) / n
            known -= known.mean(axis=1, keepdims=True)
            shares, miss = nnls(known[:, at].T, wanted[at])
            apart = np.abs(shares @ known - wanted)[lag <= _WITHIN * time].max()
            found.append((miss, shares[0] / shares.sum(), time * step, apart / shares.sum()))
        _, white, seconds, apart = min(found)
        return float(white), float(seconds), float(apart)

    def _as_lines(self) -> Behaviour:
        """A spectrum as lines of a record."""
        step = 0.5 / float(self.frequency_hz[-1])
        f = np.arange(1, _LINES + 1) / (2 * _LINES * step)
        power = np.interp(f, self.frequency_hz, self.power, left=0.0) * f[0]
        return Behaviour("series", step, f, power)


def _passed(frequency: FloatArray, density: FloatArray, window_s: float) -> float:
    """Integral of sinc(f T)^2 S(f), exact for a density that is linear between its frequencies."""
    from scipy.special import sici

    c = 2.0 * np.pi * window_s
    u = c * frequency
    sine, cosine = sici(np.maximum(u, _SMALL))
    near = u < _SMALL
    # Integrals of 2 (1 - cos u) / u^2 and of 2 (1 - cos u) / u from 0.
    safe = np.where(near, 1.0, u)
    flat = np.where(near, u - u**3 / 36.0, 2.0 * (sine - 2.0 * np.sin(0.5 * safe) ** 2 / safe))
    rising = np.where(
        near, 0.5 * u**2 - u**4 / 48.0, 2.0 * (np.euler_gamma + np.log(safe) - cosine)
    )
    slope = np.diff(density) / np.diff(frequency)
    level = density[:-1] - slope * frequency[:-1]
    return float(np.sum(level / c * np.diff(flat) + slope / c**2 * np.diff(rising)))


def load_spectrum(path: PathLike) -> Behaviour:
    """Read a power spectral density: a table with ``frequency_hz`` and ``psd_arcsec2_hz``.

    Raises
    ------
    BudgetError
        When a column is missing, frequencies do not increase from 0 or more, or a density is
        negative.
    AttitudeProfileError
        When the table cannot be read.
    """
    table, (frequency, density) = _columns(path, "frequency_hz", "psd_arcsec2_hz")
    back = np.diff(frequency, prepend=-np.inf) <= 0.0
    back[0] = frequency[0] < 0.0
    if back.any():
        raise BudgetError(
            f"{_row(table, back)}: frequency_hz must increase from 0 or more; sort the rows."
        )
    if np.any(density < 0.0) or not np.any(density > 0.0):
        raise BudgetError(
            f"{_row(table, density == density.min())}: psd_arcsec2_hz is {density.min():g}; give "
            "densities that are not negative, some of them positive."
        )
    return Behaviour("spectrum", frequency_hz=frequency, power=density)


def load_series(path: PathLike) -> Behaviour:
    """Read a time series of an error: a table with ``time_s``, evenly spaced, and
    ``error_arcsec``.

    Raises
    ------
    BudgetError
        When a column is missing, times are not evenly spaced, or the error never changes.
    AttitudeProfileError
        When the table cannot be read, or times do not increase.
    """
    table, (time, error) = _columns(path, "time_s", "error_arcsec")
    check_order(f"{path}, ", table.word, table.numbers, time)
    step = float((time[-1] - time[0]) / (len(time) - 1))
    off = np.abs((time - time[0]) / step - np.arange(len(time))) > _UNEVEN
    if off.any():
        raise BudgetError(
            f"{_row(table, off)}: time_s is not evenly spaced (steps of {step:g} s); interpolate "
            "the series."
        )
    n, mean = len(error), float(error.mean())
    amplitude = np.abs(np.fft.rfft(error - mean)[1:]) / n
    power = 2.0 * amplitude**2
    if n % 2 == 0:
        power[-1] *= 0.5
    if not np.any(power > 0.0):
        raise BudgetError(f"{path}: error_arcsec never changes; state it as a constant.")
    return Behaviour("series", step, np.arange(1, len(power) + 1) / (n * step), power, mean)


def _columns(path: PathLike, *names: str) -> tuple[TableColumns, list[FloatArray]]:
    """A table, and columns of two finite numbers or more."""
    table = read_columns(path, f"{names[0]} and {names[1]}")
    columns = []
    for name in names:
        if name not in table.cells:
            raise BudgetError(
                f"{path}: column {name} is missing (the file has {listed(list(table.cells))}); "
                "name it in the header."
            )
        columns.append(table.numbers_of(name))
        if not np.isfinite(columns[-1]).all():
            odd = ~np.isfinite(columns[-1])
            raise BudgetError(f"{_row(table, odd)}: {name} is not finite; repair it.")
    if len(columns[0]) < 2:
        raise BudgetError(f"{path}: holds a single row; give two or more.")
    return table, columns


def _row(table: TableColumns, which: BoolArray) -> str:
    """The first of some rows, as messages call it."""
    return f"{table.path}, {table.word} {table.numbers[int(np.argmax(which))]}"
