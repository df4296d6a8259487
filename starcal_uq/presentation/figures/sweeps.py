"""Lines, bars and axes of what a study has swept, drawn alike in all of its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.formatting import count, fixed, significant
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, floats
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.words.axes import axis_label, capital, place, value_words
from starcal_uq.studies.findings import Lines, Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


_MOST_LINES = 5
_PARAMETER_COLOURS = {
    "x0": style.BLUE,
    "y0": style.SKY,
    "f": style.ORANGE,
    "k1": style.PURPLE,
    "k2": style.VERMILLION,
    "k3": style.INK,
    "p1": style.GREEN,
    "p2": "#F0E442",
}
_NAMED = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.VERMILLION)
_MARKERS = "osD^v"


def two_axes(
    sweep: Sweep, along: str | None, by: str | None, *, names: bool = False, lines: bool = True
) -> tuple[str, str | None]:
    """The axis to draw along, and the one that tells lines apart: as named, or the first that are
    left.

    Lines run along numbers, and names tell them apart; with `names` it is the other way round. With
    `lines`, axes of a Latin hypercube tell no lines apart.
    """
    if not sweep.axes:
        raise ValueError("nothing was swept: give [sweep] an axis with more than one value.")
    if not sweep.ok.any():
        raise ValueError("no cell of the study has numbers: see the status of its cells.")
    named = [axis for axis in (along, by) if axis is not None]
    for axis in named:
        sweep.check(axis)
    free = [axis for axis in sweep.axes if axis not in named]
    if along is None:
        along = next((axis for axis in free if numeric(sweep.values[axis]) is not names), free[0])
        free.remove(along)
    # What was drawn and not laid out makes no lines: the other drawn axes are in the band.
    free = [axis for axis in free if not (axis in sweep.drawn and lines)]
    if by is None and free:
        by = next((axis for axis in free if numeric(sweep.values[axis]) is names), free[0])
    return along, by


def some(n: int, most: int) -> list[int]:
    """Up to `most` of n indices, both ends among them."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most))})


def numeric(values: Sequence[Any]) -> bool:
    return not any(isinstance(value, str) for value in values)


def _geometric(values: Sequence[Any]) -> bool:
    """Whether values are spaced by ratios rather than by differences."""
    if not numeric(values) or len(values) < 3:
        return False
    x = floats(values)
    if np.any(x <= 0.0) or x[-1] < 4.0 * x[0]:
        return False
    steps, ratios = np.diff(x), np.diff(np.log(x))
    return bool(np.std(ratios) / np.mean(ratios) < np.std(steps) / np.mean(steps))


def positions(values: Sequence[Any]) -> FloatArray:
    """Where values stand on an axis: names side by side, numbers where they are."""
    return floats(values if numeric(values) else range(len(values)))


def scale(axis: Any, values: Sequence[Any]) -> None:
    """Scale and ticks of an axis of the sweep."""
    if _geometric(values):
        axis._set_axes_scale("log")
    ticks(axis, values, positions(values))
    axis.set_minor_locator(_no_ticks())


def _no_ticks() -> Any:
    from matplotlib.ticker import NullLocator

    return NullLocator()


def ticks(axis: Any, values: Sequence[Any], places: NDArray[Any]) -> None:
    """Ticks at the swept values, every second or third where they are many; long names stand
    aslant.
    """
    shown = some(len(values), 8)
    words = [value_words(values[i]) for i in shown]
    axis.set_ticks(np.asarray(places)[shown], words)
    if axis.axis_name == "x" and not numeric(values) and max(map(len, words)) * len(words) > 26:
        for tick in axis.get_ticklabels():
            tick.set(rotation=28, ha="right", rotation_mode="anchor")


def _line_colours(lines: Lines) -> dict[int, Any]:
    """The lines to draw, by their number, each with its colour: in order of the second axis'
    values.
    """
    rows = some(len(lines.median), _MOST_LINES)
    if lines.by is None:
        return {rows[0]: style.BLUE}
    if not numeric(lines.by_values):
        return {row: _NAMED[i % len(_NAMED)] for i, row in enumerate(rows)}
    import matplotlib

    ramp = matplotlib.colormaps["viridis"]
    return {row: ramp(0.86 * i / max(1, len(rows) - 1)) for i, row in enumerate(rows)}


def _marked(number: int) -> AnyDict:
    return {"marker": _MARKERS[number % len(_MARKERS)], "markersize": 4.5}


def draw_lines(ax: Axes, lines: Lines, *, dashed: bool = False) -> None:
    """A line with its band over seeds for some values of the second axis."""
    x = positions(lines.values)
    for number, (row, colour) in enumerate(_line_colours(lines).items()):
        good = np.isfinite(lines.median[row])
        if dashed:
            ax.plot(x[good], lines.median[row][good], color=colour, linewidth=1.2, dashes=(4, 2))
            continue
        low, middle, high = (part[row][good] for part in (lines.low, lines.median, lines.high))
        style.band(ax, x[good], low, high, colour, alpha=0.2)
        ax.plot(x[good], middle, color=colour, linewidth=1.5, **_marked(number))
    scale(ax.xaxis, lines.values)


def draw_bars(ax: Axes, lines: Lines) -> None:
    """What the posterior says beside the line: median and range over seeds, those of other lines a
    little aside.
    """
    from matplotlib.transforms import ScaledTranslation

    x = positions(lines.values)
    colours = _line_colours(lines)
    for number, (row, colour) in enumerate(colours.items()):
        middle = lines.median[row]
        good = np.isfinite(middle)
        bars = np.stack([middle - lines.low[row], lines.high[row] - middle])[:, good]
        aside = ScaledTranslation(
            0.09 * (number - 0.5 * (len(colours) - 1)), 0.0, style.figure_of(ax).dpi_scale_trans
        )
        ax.errorbar(
            *(x[good], middle[good]),
            yerr=np.abs(bars),
            color=colour,
            fmt="x",
            markersize=6,
            elinewidth=1.1,
            capsize=3,
            transform=ax.transData + aside,
        )


def legend(figure: Figure, lines: Lines, *, sampled: bool = False, dashed: str = "") -> None:
    """One legend above all panels: the values of the second axis, and what is not a plain line."""
    keys = []
    if lines.by is not None:
        for number, (row, colour) in enumerate(_line_colours(lines).items()):
            words = value_words(lines.by_values[row])
            if not number:
                words = capital(f"{axis_label(lines.by)}: {words}")
            keys.append(style.key(words, colour, **_marked(number)))
    if sampled:
        keys.append(
            style.key("posterior, range over seeds", style.GREY, marker="x", linestyle="none")
        )
    if dashed:
        keys.append(style.key(dashed, style.GREY, dashes=(4, 2)))
    if keys:
        style.legend_above(figure, keys, columnspacing=1.4)
    held_title(figure, lines.held)


def held_title(figure: Figure, held: AnyMapping) -> None:
    if held:
        figure.suptitle(
            f"For {place(held)}", fontsize=style.LABEL_SIZE, color=style.GREY, x=0.01, ha="left"
        )


def logarithmic(ax: Axes, lines: Sequence[Lines]) -> None:
    """A logarithmic axis in plain numbers over what is drawn, of at least a factor of two."""
    values = np.concatenate([np.ravel((one.median, one.low, one.high)) for one in lines])
    values = values[np.isfinite(values) & (values > 0.0)]
    if not len(values):
        middle: AnyDict = {"xycoords": "axes fraction", "ha": "center", "color": style.GREY}
        style.note(ax, "no cell has this", (0.5, 0.5), **middle)
        return
    low, high = float(values.min()) / 1.15, float(values.max()) * 1.15
    wider = max(1.0, np.sqrt(2.25 * low / high))
    ax.set_ylim(low / wider, high * wider)
    ax.set_yscale("log")
    plain(ax.yaxis)


@dataclass(frozen=True)
class Panel:
    """A number of every cell (C,) with its title, and another one to draw dashed."""

    title: str
    numbers: FloatArray
    dashed: FloatArray | None = None


def row_of_panels(n: int, height_in: float) -> tuple[Figure, Any]:
    """A figure with panels side by side that share their vertical axis."""
    figure = style.new_figure(2.3 + 2.9 * n, height_in)
    return figure, figure.subplots(1, n, sharey=True, squeeze=False)[0]


def small_multiples(
    sweep: Sweep,
    panels: Sequence[Panel],
    along: str,
    by: str | None,
    at: AnyMapping | None,
    *,
    columns: int | None = None,
    log: bool = True,
    sharey: bool = False,
    wide: float = 1.0,
) -> tuple[Figure, list[Axes], list[Lines]]:
    """A panel for each number along one axis, a line with its band for each value of another.

    In rows of `columns` panels, all in one by default; `wide` is the width of one over the usual
    one. Returns the figure, its panels, and the lines of each.
    """
    columns = len(panels) if columns is None else columns
    rows = -(-len(panels) // columns)
    figure = style.new_figure(2.4 + 2.9 * wide * columns, 0.8 + (3.1 if rows == 1 else 2.75) * rows)
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
    drawn = []
    for ax, panel in zip(axes, panels, strict=False):
        style.dress(ax, grid=True)
        lines = sweep.lines(panel.numbers, along, by, at)
        draw_lines(ax, lines)
        drawn.append([lines])
        if panel.dashed is not None:
            dashed = sweep.lines(panel.dashed, along, by, at)
            draw_lines(ax, dashed, dashed=True)
            drawn[-1].append(dashed)
        style.label(ax, panel.title, axis_label(along))
    for spare in axes[len(panels) :]:
        spare.set_visible(False)
    if log:
        together = [lines for some in drawn for lines in some]
        for ax, own in zip(axes, drawn, strict=False):
            logarithmic(ax, together if sharey else own)
    return figure, axes[: len(panels)], [lines[0] for lines in drawn]


def plain(axis: Any, *, fine: bool = True) -> None:
    """Plain numbers on a logarithmic axis, at 1, 2 and 5 where it spans little, and `fine` ones
    where it spans less.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator

    low, high = axis.get_view_interval()
    span = high / low
    subs = (
        (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
        if fine and span < 6.0
        else (1.0, 2.0, 5.0)
        if span < 150.0
        else (1.0,)
    )
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    whole = 10.0 if fine else 1.0
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: count(int(value)) if value >= whole else f"{value:.6g}")
    )
    axis.set_minor_locator(_no_ticks())


def target_line(ax: Axes, value: float) -> None:
    """What is aimed at."""
    ax.axhline(value, color=style.VERMILLION, linewidth=1.2, dashes=(5, 2))


def target_words(ax: Axes, value: float, words: str, **look: Any) -> None:
    """Words at the left end of the line of a target."""
    place = {"xycoords": ("axes fraction", "data"), "color": style.VERMILLION}
    style.note(ax, words, (0.02, value), (0, 4), **place, **look)


def short(value: float) -> str:
    """At most three digits, no power of ten where plain zeros are few."""
    return (
        significant(value, 3)
        if abs(value) < 100.0
        else fixed(float(f"{value:.3g}"), 0)
        if abs(value) < 1e6
        else significant(value, 2)
    )


def colour_of(name: str) -> str:
    return _PARAMETER_COLOURS.get(name, style.GREY)
