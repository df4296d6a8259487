"""Figures of the attitude error along a slew: its spectrum, and its size over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import significant
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from starcal_uq.propagation.spectrum_result import ErrorSpectrum

_COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
_DASHES = ("-", "--", "-")
_BINS_PER_DECADE = 10
# A spectrum is shown over so many decades below its top; what lies deeper is rounding.
_DECADES = 9.0


def plot_spectrum(spectrum: ErrorSpectrum, ax: Axes | None = None) -> Axes:
    """Power spectral density of the frame-dependent part per axis, over the white floor of centroid noise."""
    if ax is None:
        ax = style.new_axes(7.2, 4.2)
    style.dress(ax, grid=True)
    f = spectrum.frequency_hz
    top, bottom = 0.0, np.inf
    for i, axis in enumerate(spectrum.axes):
        x, y = _binned(f, spectrum.psd_arcsec2_hz[:, i])
        rest = significant(float(spectrum.rest_arcsec[i]))
        ax.plot(x, y, _DASHES[i], color=_COLOURS[i], lw=1.5, label=f"calibration, {axis}: {rest}″")
        top, bottom = max(top, float(y.max())), min(bottom, float(y[y > 0.0].min(initial=np.inf)))
    for names, members in (("pitch and yaw", [0, 1]), ("roll", [2])):
        level = float(np.mean(spectrum.nea_psd_arcsec2_hz[members]))
        nea = significant(float(np.sqrt(np.mean(spectrum.nea_arcsec[members] ** 2))))
        ax.plot(f[[0, -1]], [level, level], ":", color=style.INK, lw=1.3)
        ax.annotate(
            f"centroid noise, {names}: {nea}″ a frame",
            (f[-1], level),
            xytext=(-4, 3),
            ha="right",
            textcoords="offset points",
            fontsize=style.TICK_SIZE,
            color=style.INK,
        )
        top = max(top, level)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(f[0], f[-1])
    ax.set_ylim(max(bottom * 0.5, top * 10.0**-_DECADES), top * 8.0)
    style.legend(ax, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=3, columnspacing=1.4)
    style.label(ax, "", "frequency [Hz]", "power spectral density [arcsec²/Hz]")
    return ax


def plot_error_series(spectrum: ErrorSpectrum, ax: Axes | None = None) -> Axes:
    """Standard deviation of the frame-dependent part over the posterior, at every instant, on a log axis."""
    if ax is None:
        ax = style.new_axes(7.2, 3.2)
    style.dress(ax, grid=True)
    for i, axis in enumerate(spectrum.axes):
        ax.plot(
            spectrum.time_s,
            np.maximum(spectrum.sigma_arcsec[:, i], 1e-12),
            color=_COLOURS[i],
            lw=0.9,
            label=axis,
        )
    ax.set_yscale("log")
    shown = spectrum.sigma_arcsec[spectrum.sigma_arcsec > 0.0]
    if shown.size:
        ax.set_ylim(0.7 * float(np.quantile(shown, 0.002)), 1.5 * float(shown.max()))
    ax.set_xlim(spectrum.time_s[0], spectrum.time_s[-1])
    style.legend(ax, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=3)
    style.label(ax, "", "time [s]", "1 sigma of the\nframe-dependent part [arcsec]")
    return ax


def _binned(f: FloatArray, psd: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of a spectrum over bins of equal ratio; single frequencies stay as they are."""
    place = np.floor(_BINS_PER_DECADE * np.log10(f / f[0]) + 1e-9).astype(int)
    _, start, count = np.unique(place, return_index=True, return_counts=True)
    mean_f = np.exp(np.add.reduceat(np.log(f), start) / count)
    return mean_f, np.add.reduceat(psd, start) / count
