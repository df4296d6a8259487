"""Figures of the field experiment of Ye & Yang 2017: identification against tolerance, and attitude errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {
    "uncalibrated": style.VERMILLION,
    "least_squares": style.ORANGE,
    "samaan": style.PURPLE,
    "three_stage": style.BLUE,
    "truth": style.GREEN,
}
_NAMES = {
    "uncalibrated": "uncalibrated",
    "least_squares": "least squares",
    "samaan": "Samaan",
    "three_stage": "proposed",
    "truth": "true camera",
}
_PARTS = {"common": (style.GREY, "common rotation"), "rest": (style.ORANGE, "rest"), "noise": (style.SKY, "noise")}
_AXES = ("pitch", "yaw", "roll")
# Cameras of one tolerance stand side by side, so that their bars can be told apart.
_SPREAD = 1.035


def plot_rates(rates: pd.DataFrame, printed: Mapping[str, float], main_px: float) -> Figure:
    """Identification rate against tolerance, with Wilson intervals; the paper's rates at the right edge.

    Parameters
    ----------
    rates : DataFrame
        As of `FieldExperiment.rates`.
    printed : mapping
        Camera to the printed rate, per cent.
    main_px : float
        The tolerance of the main table.
    """
    figure = style.new_figure(8.6, 4.6)
    ax = style.dress(figure.add_subplot(), grid=True)
    ax.axvline(main_px, color=style.GREY, linewidth=1.0, dashes=(4, 3))
    ax.annotate(
        "main table",
        (main_px, 0.0),
        xytext=(4, 3),
        textcoords="offset points",
        fontsize=style.TICK_SIZE,
        color=style.GREY,
    )
    for number, (name, colour) in enumerate(_COLOURS.items()):
        rows = rates[rates["camera"] == name].sort_values("tolerance_px")
        x = rows["tolerance_px"].to_numpy() * _SPREAD ** (number - 2)
        y = 100.0 * rows["rate"].to_numpy()
        error = 100.0 * np.stack([rows["rate"] - rows["low"], rows["high"] - rows["rate"]])
        ax.errorbar(x, y, error, color=colour, marker="o", markersize=4.0, linewidth=1.4, elinewidth=1.0)
        if name in printed:
            ax.plot(
                1.0,
                printed[name],
                marker="<",
                markersize=7.0,
                color=colour,
                markeredgecolor=style.INK,
                markeredgewidth=0.6,
                clip_on=False,
                zorder=5,
                transform=ax.get_yaxis_transform(),
            )
    ax.set_xscale("log")
    ticks = sorted(set(rates["tolerance_px"]))
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.xaxis.minorticks_off()
    ax.set_ylim(0.0, 102.0)
    style.label(ax, x="tolerance: displacement in the corner that the camera may be wrong by [px]", y="identified [%]")
    style.legend_above(figure, _camera_keys(tuple(_COLOURS), printed=True))
    return figure


def plot_errors(parts: pd.DataFrame, printed: Mapping[tuple[str, str], float]) -> Figure:
    """Attitude errors about each axis: total, what alignment leaves, the three parts, and the printed number.

    Parameters
    ----------
    parts : DataFrame
        As of `FieldExperiment.parts`.
    printed : mapping
        (camera, axis) to the printed error, arcsec.
    """
    figure = style.new_figure(10.4, 4.6)
    panels = figure.subplots(1, 3, sharey=True)
    cameras = [name for name in _COLOURS if name in set(parts["camera"])]
    for ax, axis in zip(panels, _AXES, strict=True):
        style.dress(ax, grid=True)
        for place, camera in enumerate(cameras):
            row = parts[(parts["camera"] == camera) & (parts["axis"] == axis)].iloc[0]
            _camera_column(ax, place, row, printed.get((camera, axis)))
        ax.set_yscale("log")
        ax.set_ylim(0.03, 9000.0)
        ax.set_xlim(-0.6, len(cameras) - 0.4)
        ax.set_xticks(range(len(cameras)), [_NAMES[name].replace(" ", "\n") for name in cameras])
        ax.tick_params(axis="x", labelsize=style.TICK_SIZE - 0.7)
        style.label(ax, axis.capitalize())
    style.label(panels[0], y="error, root mean square [arcsec]")
    style.legend_above(figure, _error_keys(), columnspacing=1.3, handletextpad=0.5)
    return figure


def _camera_column(ax: Axes, place: int, row: pd.Series, printed: float | None) -> None:
    """One camera in one panel."""
    for part, x, colour, marker in (("rms", -0.17, style.INK, "s"), ("aligned", 0.03, style.BLUE, "o")):
        value = float(row[part])
        error = [[max(value - float(row[f"{part}_low"]), 0.0)], [max(float(row[f"{part}_high"]) - value, 0.0)]]
        ax.errorbar(place + x, value, error, color=colour, marker=marker, markersize=5.5, linestyle="", elinewidth=1.2)
    for part, (colour, _) in _PARTS.items():
        ax.plot(place + 0.22, abs(float(row[part])), marker="_", markersize=9.0, markeredgewidth=2.4, color=colour)
    if printed is not None:
        ax.plot(
            place - 0.36,
            printed,
            marker=">",
            markersize=7.0,
            color=style.VERMILLION,
            markeredgecolor=style.INK,
            markeredgewidth=0.6,
        )


def _camera_keys(cameras: tuple[str, ...], printed: bool) -> list[object]:
    from matplotlib.lines import Line2D

    keys: list[object] = [
        Line2D([], [], color=_COLOURS[name], marker="o", markersize=4.0, linewidth=1.4, label=_NAMES[name])
        for name in cameras
    ]
    if printed:
        mark = {"color": style.GREY, "marker": "<", "markersize": 7.0, "markeredgecolor": style.INK, "linestyle": ""}
        keys.append(Line2D([], [], label="printed in the paper", **mark))  # type: ignore[arg-type]
    return keys


def _error_keys() -> list[object]:
    from matplotlib.lines import Line2D

    plain = {"linestyle": "", "markersize": 6.0}
    keys: list[object] = [
        Line2D([], [], marker=">", color=style.VERMILLION, markeredgecolor=style.INK, label="printed", **plain),  # type: ignore[arg-type]
        Line2D([], [], marker="s", color=style.INK, label="against the true attitude", **plain),  # type: ignore[arg-type]
        Line2D([], [], marker="o", color=style.BLUE, label="after alignment", **plain),  # type: ignore[arg-type]
    ]
    bar = {"linestyle": "", "marker": "_", "markersize": 9.0, "markeredgewidth": 2.4}
    keys += [Line2D([], [], color=colour, label=words, **bar) for colour, words in _PARTS.values()]  # type: ignore[arg-type]
    return keys
