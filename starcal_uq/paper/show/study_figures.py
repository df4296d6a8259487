"""Figure of replicates: what every method does, against what it claims and what is possible."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import Parameter, parameters
from starcal_uq.core.formatting import fixed
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.paper.interaction import InteractionStudy
    from starcal_uq.paper.replicates import Replicates

# Errors up to this many bounds are drawn to scale, larger ones on a logarithmic axis.
_LINEAR = 4.0
_RIGHT, _WRONG = style.BLUE, style.VERMILLION


def plot_replicates(found: Replicates) -> Figure:
    """Errors and widths of every method, one column of panels for each parameter, in units of the Cramer-Rao bound.

    Above, the mean error (dot) with the spread of the estimates (thick bar) and the claimed standard deviation (thin
    bar with caps); the grey band is the bound around the truth. The axis is to scale near the truth and logarithmic
    beyond, where the mean error is also given as a number. Below, the widths alone: spread with its 95 % interval
    (dot), claim (diamond) and, where there is one, the claim by the formula of the textbooks (cross). Claims that the
    tests reject are red.
    """
    columns = parameters(found.truth.distortion)
    rows = found.table().to_dict("records")
    labels = found.labels
    figure = style.new_figure(2.0 + 2.15 * len(columns), 1.5 + 0.62 * len(labels))
    panels = figure.subplots(2, len(columns), squeeze=False, sharey=True)
    for j, parameter in enumerate(columns):
        some = [row for row in rows if row["parameter"] == parameter.name]
        places = [len(labels) - 1 - labels.index(row["method"]) for row in some]
        _errors(panels[0, j], some, places, parameter)
        _widths(panels[1, j], some, places)
        for ax in panels[:, j]:
            ax.set_ylim(-0.6, len(labels) - 0.4)
            ax.set_yticks(range(len(labels)), labels[::-1])
            ax.tick_params(axis="y", length=0.0)
    middle = len(columns) // 2
    style.label(panels[0, middle], x="error / Cramer-Rao bound (to scale up to ±4, logarithmic beyond)")
    style.label(panels[1, middle], x="standard deviation / Cramer-Rao bound")
    _legend(figure, found)
    return figure


def _errors(ax: Axes, rows: list[AnyDict], places: list[int], parameter: Parameter) -> None:
    style.dress(ax)
    ax.axvspan(-1.0, 1.0, color=style.LIGHT, linewidth=0)
    ax.axvline(0.0, color=style.GREY, linewidth=0.7)
    reach = 0.0
    for row, place in zip(rows, places, strict=True):
        bias, spread, claimed = (row[name] / row["crlb"] for name in ("bias", "spread", "claimed"))
        colour = _WRONG if row["claim_wrong"] else _RIGHT
        ax.plot(
            [bias - spread, bias + spread], [place + 0.12] * 2, color=style.SKY, linewidth=4.0, solid_capstyle="butt"
        )
        ax.errorbar(bias, place - 0.18, xerr=claimed, color=colour, linewidth=1.1, capsize=2.5, fmt="none")
        ax.plot(bias, place + 0.12, "o", color=style.INK, markersize=3.5)
        if abs(bias) > _LINEAR:
            # The logarithmic part has few ticks.
            side = -1.0 if bias > 0.0 else 1.0
            ax.annotate(
                fixed(bias, 0),
                (bias + side * max(spread, claimed), place),
                xytext=(side * 5.0, 0.0),
                textcoords="offset points",
                ha="right" if side < 0.0 else "left",
                va="center",
                fontsize=style.TICK_SIZE - 1.0,
                color=style.GREY,
            )
        reach = max(reach, abs(bias) + max(spread, claimed))
    _signed_axis(ax, reach)
    style.label(ax, parameter.latex)


def _signed_axis(ax: Axes, reach: float) -> None:
    if reach <= _LINEAR:
        ax.set_xlim(-_LINEAR, _LINEAR)
        ticks: FloatArray = np.array([-3.0, 0.0, 3.0])
    else:
        ax.set_xscale("symlog", linthresh=_LINEAR, linscale=1.2)
        ax.set_xlim(-1.5 * reach, 1.5 * reach)
        powers = 10.0 ** np.arange(1, np.floor(np.log10(1.5 * reach)) + 1)
        ticks = np.concatenate([-powers[::-1], [0.0], powers])
    ax.set_xticks(ticks, [f"{tick:g}".replace("-", "−") for tick in ticks])
    ax.set_xticks([], minor=True)


def _widths(ax: Axes, rows: list[AnyDict], places: list[int]) -> None:
    style.dress(ax)
    ax.axvline(1.0, color=style.GREY, linewidth=0.9)
    smallest, largest = 1.0, 1.0
    for row, place in zip(rows, places, strict=True):
        spread, claimed, classical = (row[name] / row["crlb"] for name in ("spread", "claimed", "claimed_classical"))
        colour = _WRONG if row["claim_wrong"] else _RIGHT
        ends = [1.0 / np.sqrt(row[f"efficiency_{end}"]) for end in ("high", "low")]
        ax.plot(ends, [place + 0.12] * 2, color=style.SKY, linewidth=4.0, solid_capstyle="butt")
        ax.plot(spread, place + 0.12, "o", color=style.INK, markersize=3.5)
        ax.plot(claimed, place - 0.18, "D", color=colour, markersize=4.0)
        shown = [*ends, claimed]
        if np.isfinite(classical):
            ax.plot(classical, place - 0.18, "x", color=_WRONG if row["classical_wrong"] else _RIGHT, markersize=4.5)
            shown.append(classical)
        smallest, largest = min(smallest, *shown), max(largest, *shown)
    ax.set_xscale("log")
    low, high = 0.8 * smallest, 1.25 * largest
    ax.set_xlim(low, high)
    ticks = [tick for tick in (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0) if low <= tick <= high]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.set_xticks([], minor=True)


def _legend(figure: Figure, found: Replicates) -> None:
    from matplotlib.patches import Patch

    handles = [
        style.key("mean error; spread", style.INK, marker="o", linestyle="", markersize=4),
        style.key("± spread; its 95 % interval", style.SKY, linewidth=4),
        style.key("claimed", _RIGHT, marker="D", markersize=4),
        style.key("claimed by the textbook's formula", _RIGHT, marker="x", linestyle="", markersize=5),
        style.key("claims that the tests reject", _WRONG, linewidth=1.5),
        Patch(color=style.LIGHT, label="Cramer-Rao bound"),
    ]
    frames = found.provenance["settings"].get("n_frames")
    style.legend_above(
        figure,
        handles,
        title=f"{found.n_replicates} replicates" + ("" if frames is None else f" of {frames} frames"),
        title_fontsize=style.TITLE_SIZE,
    )


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
    table = study.table
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
    _interaction_legend(figure, methods)
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


def _interaction_legend(figure: Figure, methods: list[str]) -> None:
    handles = [style.key(m, _COLOURS.get(m, style.GREY), marker=_MARKERS.get(m, "o"), markersize=4) for m in methods]
    lines = {"-": "bias", "--": "spread", ":": "noise alone, where it differs from the spread"}
    handles += [style.key(text, style.INK, linestyle=line) for line, text in lines.items()]
    style.legend_above(figure, handles)
