"""Figure of the interaction study: bias and spread of the optics along four axes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.paper.interaction_result import InteractionStudy

# Axis, column of the table, label, title.
_AXES = (
    ("distortion", "corner_size_px", "displacement at the corner [px]", "Size of the distortion"),
    ("field", "field_deg", "full field [deg], as many stars", "Field of view"),
    ("frames", "n_frames", "frames", "Number of frames"),
    ("stars", "stars_per_frame", "mean stars in a frame", "Stars in a frame"),
)
_COLOURS = {
    "least squares": style.VERMILLION,
    "samaan": style.ORANGE,
    "three stages": style.BLUE,
    "efficient": style.GREEN,
}
_MARKERS = {"least squares": "o", "samaan": "s", "three stages": "^", "efficient": "D"}
# Biases this far below the smallest spread are rounding; they are counted in words rather than drawn.
_FLOOR = 0.2
# Spread over noise from which on both are drawn.
_APART = 1.3


def plot_interaction(study: InteractionStudy) -> Figure:
    """Size of the bias and spread of x0, y0 and f for every method, along the four axes.

    Solid lines are the bias (from data without noise), dashed ones the spread (with noise). Where the bias depends on
    where the stars are, the spread holds more than the noise, which is then dotted. Where a solid line is above the
    noise of its colour, the interaction costs more than noise. Biases far below every spread are not drawn: the methods
    that have them are named in the first panel.
    """
    table = study.to_dataframe()
    optics = [p for p in parameters("none") if p.name in set(table["parameter"])]
    methods = list(dict.fromkeys(table["method"]))
    figure = style.new_figure(12.5, 0.9 + 2.55 * len(optics))
    panels = figure.subplots(len(optics), len(_AXES), squeeze=False, sharex="col", sharey="row")
    for i, parameter in enumerate(optics):
        rows = table[table["parameter"] == parameter.name]
        spread = rows["spread"][rows["spread"] > 0.0]
        low = _FLOOR * float(spread.min())
        high = 2.5 * max(float(rows["bias"].abs().max()), float(spread.max()))
        for j, (axis, column, words, title) in enumerate(_AXES):
            ax = style.dress(panels[i, j], grid=True)
            some = rows[rows["axis"] == axis].sort_values(column, kind="stable")
            _panel(ax, some, column, methods, low, j == 0)
            ax.set_yscale("log")
            ax.set_ylim(low, high)
            last = i == len(optics) - 1
            style.label(ax, title if i == 0 else "", words if last else "", f"{parameter.latex} [px]" if j == 0 else "")
    for j, (axis, column, _, _) in enumerate(_AXES):
        _scale(panels[0, j], table[table["axis"] == axis][column].to_numpy())
    _legend(figure, methods)
    return figure


def _panel(ax: Axes, rows: pd.DataFrame, column: str, methods: list[str], low: float, named: bool) -> None:
    unseen = []
    for method in methods:
        curve = rows[rows["method"] == method]
        curve = curve[np.isfinite(curve["spread"])]
        if curve.empty:
            continue
        at, bias = curve[column].to_numpy(), curve["bias"].abs().to_numpy()
        colour = _COLOURS.get(method, style.GREY)
        ax.plot(at, curve["spread"], "--", color=colour, linewidth=1.1)
        if np.max(curve["spread"] / curve["noise"]) > _APART:
            ax.plot(at, curve["noise"], ":", color=colour, linewidth=1.3)
        if np.max(bias) < low:
            unseen.append(method)
            continue
        marker = _MARKERS.get(method, "o")
        # A bias of zero has no place on the axis; the line then starts from below it.
        ax.plot(at, np.maximum(bias, 1e-3 * low), "-", color=colour, linewidth=1.4, marker=marker, markersize=3.5)
    if unseen and named:
        ax.text(
            0.03,
            0.03,
            f"bias too small to show: {', '.join(unseen)}",
            transform=ax.transAxes,
            fontsize=style.TICK_SIZE - 1.0,
            color=style.GREY,
        )


def _scale(ax: Axes, at: FloatArray) -> None:
    """Logarithmic, with a place for zero where the axis starts there; ticks that say plain numbers."""
    if len(at) == 0:
        return
    positive = np.unique(at[at > 0.0])
    if at.min() <= 0.0 and len(positive):
        ax.set_xscale("symlog", linthresh=float(positive[0]), linscale=0.4)
        ax.set_xlim(-0.1 * float(positive[0]), 1.4 * float(positive[-1]))
    else:
        ax.set_xscale("log")
    ticks = _ticks(positive) if len(positive) else positive
    zero = [0.0] if at.min() <= 0.0 else []
    ax.set_xticks([*zero, *ticks], ["0"] * len(zero) + [f"{tick:g}" for tick in ticks])
    ax.set_xticks([], minor=True)


def _ticks(values: FloatArray) -> FloatArray:
    """Round numbers within the range: decades where it is wide, also 2 and 5 where it is not."""
    low, high = np.log10(values[0]), np.log10(values[-1])
    steps = (1.0,) if high - low > 2.2 else (1.0, 3.0) if high - low > 1.5 else (1.0, 2.0, 5.0)
    decades = 10.0 ** np.arange(np.floor(low) - 1.0, np.ceil(high) + 1.0)
    candidates: FloatArray = np.sort(np.outer(decades, steps).ravel())
    chosen: FloatArray = candidates[(candidates > 0.95 * values[0]) & (candidates < 1.05 * values[-1])]
    return chosen


def _legend(figure: Figure, methods: list[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=_COLOURS.get(m, style.GREY), marker=_MARKERS.get(m, "o"), markersize=4, label=m)
        for m in methods
    ]
    handles += [
        Line2D([], [], color=style.INK, linestyle="-", label="bias"),
        Line2D([], [], color=style.INK, linestyle="--", label="spread"),
        Line2D([], [], color=style.INK, linestyle=":", label="noise alone, where it differs from the spread"),
    ]
    style.legend_above(figure, handles)
