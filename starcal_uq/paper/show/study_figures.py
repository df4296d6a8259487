"""Figure of replicates: what every method does, against what it claims and what is possible."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import Parameter, parameters
from starcal_uq.core.formatting import fixed
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.paper.replicates_result import Replicates

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
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=style.INK, marker="o", linestyle="", markersize=4, label="mean error; spread"),
        Line2D([], [], color=style.SKY, linewidth=4, label="± spread; its 95 % interval"),
        Line2D([], [], color=_RIGHT, marker="D", markersize=4, label="claimed"),
        Line2D([], [], color=_RIGHT, marker="x", linestyle="", markersize=5, label="claimed by the textbook's formula"),
        Line2D([], [], color=_WRONG, linewidth=1.5, label="claims that the tests reject"),
        Patch(color=style.LIGHT, label="Cramer-Rao bound"),
    ]
    frames = found.provenance["settings"].get("n_frames")
    style.legend_above(
        figure,
        handles,
        title=f"{found.n_replicates} replicates" + ("" if frames is None else f" of {frames} frames"),
        title_fontsize=style.TITLE_SIZE,
    )
