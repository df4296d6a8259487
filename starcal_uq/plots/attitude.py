"""Figures of the attitude error and of the direction uncertainty over the field."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq._types import FloatArray
from starcal_uq.formatting import significant
from starcal_uq.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from starcal_uq.fieldmap import FieldMap
    from starcal_uq.propagation import AttitudeError

_STARS_SHOWN = 600
_WIDE = 5.0


def plot_attitude(error: AttitudeError, ax: Axes | None = None) -> Axes:
    """Bars of the three contributions to the attitude error per axis, 1 sigma, arcsec, on a log axis."""
    if ax is None:
        ax = style.new_axes(7.2, 3.4)
    style.dress(ax, grid=True)
    series = (
        ("centroid noise (NEA)", error.nea_arcsec, style.SKY, ""),
        ("calibration, common", error.common_arcsec, style.ORANGE, "//"),
        ("calibration, rest", error.rest_arcsec, style.GREEN, ".."),
    )
    values = np.array([np.asarray(v, dtype=np.float64) for _, v, _, _ in series])
    positive = values[values > 0]
    floor = 10.0 ** np.floor(np.log10(positive.min() * 0.7)) if positive.size else 1e-3
    place = np.arange(len(error.axes))
    for i, (name, _, colour, hatch) in enumerate(series):
        at = place + (i - 1) * 0.27
        ax.bar(at, np.maximum(values[i], floor), width=0.25, color=colour, hatch=hatch, edgecolor="white", label=name)
        for x, value in zip(at, values[i], strict=True):
            ax.annotate(
                f"{significant(float(value))}″",
                (x, max(value, floor)),
                xytext=(0, 3),
                ha="center",
                textcoords="offset points",
                fontsize=style.TICK_SIZE,
                color=style.INK,
            )
    ax.set_yscale("log")
    ax.set_ylim(floor, max(float(positive.max()) if positive.size else 1.0, floor) * 3.0)
    ax.set_xticks(place, error.axes, fontsize=style.LABEL_SIZE)
    ax.tick_params(axis="x", length=0)
    ax.grid(False, axis="x")
    style.legend(ax, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=3, columnspacing=1.4)
    style.label(ax, "", "", "1 sigma [arcsec]")
    return ax


def plot_field_map(field: FieldMap) -> Figure:
    """Direction uncertainty over the detector: absolute, and after the best constant rotation is removed."""
    # As tall as the panels, or the colour bars would outgrow them.
    figure = style.new_figure(11.0, 0.8 + 4.05 * float(np.ptp(field.y_px) / np.ptp(field.x_px)))
    left, right = figure.subplots(1, 2)
    _panel(left, field, field.sigma_absolute_arcsec, "Absolute")
    _panel(right, field, field.sigma_compensated_arcsec, "After removing the best constant rotation")
    return figure


def _panel(ax: Axes, field: FieldMap, values: FloatArray, title: str) -> None:
    from matplotlib.ticker import FuncFormatter

    style.dress(ax)
    x, y = np.asarray(field.x_px), np.asarray(field.y_px)
    levels, norm = _levels(values)
    image = ax.contourf(x, y, values, levels=levels, norm=norm, cmap="cividis")
    ax.contour(x, y, values, levels=levels[1:-1], colors="white", linewidths=0.5)
    # A sample is enough to show where stars were, and evenly spaced rows are a sample.
    some = slice(None, None, max(1, len(field.star_x_px) // _STARS_SHOWN))
    ax.scatter(field.star_x_px[some], field.star_y_px[some], s=2.0, color="white", alpha=0.45, linewidths=0)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[-1], y[0])
    ax.set_aspect("equal")
    style.label(ax, title, "x [px]", "y [px]")
    bar = style.colour_bar(ax, image, "1 sigma [arcsec]")
    bar.set_ticks(levels[:: max(1, len(levels) // 8)])
    bar.formatter = FuncFormatter(lambda value, _: f"{value:.6g}")
    bar.update_ticks()
    bar.ax.minorticks_off()


def _levels(values: FloatArray) -> tuple[FloatArray, Normalize | None]:
    """Round levels; in equal ratios where the map spans more than a factor of five, else a few would hold it all."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import MaxNLocator

    low, high = float(np.min(values)), float(np.max(values))
    if low > 0.0 and high > _WIDE * low:
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        steps = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high < 50.0 * low else (1.0, 2.0, 5.0)
        candidates = np.outer(decades, steps).ravel()
        first = int(np.searchsorted(candidates, low * (1.0 + 1e-9), side="right")) - 1
        last = int(np.searchsorted(candidates, high * (1.0 - 1e-9)))
        levels = candidates[first : last + 1]
        return levels, LogNorm(float(levels[0]), float(levels[-1]))
    if high - low <= 1e-9 * abs(high):
        # A map without relief still needs two levels to be filled.
        low, high = low - 0.05 * abs(low) - 1e-12, high + 0.05 * abs(high) + 1e-12
    return np.asarray(MaxNLocator(10).tick_values(low, high), dtype=np.float64), None
