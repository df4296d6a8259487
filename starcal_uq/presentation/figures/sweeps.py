"""Small multiples of what was swept: a panel for each number, lines with bands along an axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.formatting import count, fixed, significant
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, floats
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.words.axes import axis_label, place, value_words
from starcal_uq.presentation.words.numbers import capital
from starcal_uq.studies.findings import Sweep

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_LINES = 5
_NAMED = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.VERMILLION)
_MARKERS = "osD^v"


def two_axes(
    sweep: Sweep, along: str | None, by: str | None, *, lines: bool = True
) -> tuple[str, str | None]:
    """The axis to draw along, and the one that tells lines apart: as named, or the first that are
    left.

    Lines run along numbers, and names tell them apart. With `lines`, axes of a Latin hypercube tell
    no lines apart.
    """
    if not sweep.axes:
        raise ValueError("nothing was swept: give [sweep] an axis with more than one value.")
    if not sweep.ok.any():
        raise ValueError("no cell of the study has numbers: see the status of its cells.")
    named = [axis for axis in (along, by) if axis is not None]
    for axis in named:
        sweep.check(axis)
    free = [axis for axis in sweep.axes if axis not in named]
    # Sorting keeps the order of equals.
    free.sort(key=lambda axis: not numeric(sweep.values[axis]))
    if along is None:
        along = free.pop(0)
    # What was drawn and not laid out makes no lines: the other drawn axes are in the band.
    free = [axis for axis in free if not (axis in sweep.drawn and lines)]
    free.sort(key=lambda axis: numeric(sweep.values[axis]))
    return along, free[0] if by is None and free else by


def some(n: int, most: int) -> list[int]:
    """Up to `most` of n indices, both ends among them."""
    return sorted({round(i) for i in np.linspace(0, n - 1, min(n, most))})


def numeric(values: Sequence[Any]) -> bool:
    return not any(isinstance(value, str) for value in values)


def _geometric(values: Sequence[Any]) -> bool:
    """Whether values are spaced by ratios rather than by differences."""
    x = floats(values)
    if len(x) < 3 or x[0] <= 0.0 or x[-1] < 4.0 * x[0]:
        return False
    steps, ratios = np.diff(x), np.diff(np.log(x))
    return bool(np.std(ratios) / np.mean(ratios) < np.std(steps) / np.mean(steps))


def _scale(ax: Axes, values: Sequence[Any]) -> FloatArray:
    """Scale and ticks along an axis of the sweep; where the values stand on it."""
    numbers = numeric(values)
    if numbers and _geometric(values):
        ax.set_xscale("log")
        ax.minorticks_off()
    places = floats(values if numbers else range(len(values)))
    ticks(ax.xaxis, values, places)
    return places


def ticks(axis: Any, values: Sequence[Any], places: FloatArray, most: int = 8) -> None:
    """Ticks at the swept values, every second or third where they are many; long names stand
    aslant.
    """
    shown = some(len(values), most)
    words = [value_words(values[i]) for i in shown]
    axis.set_ticks(places[shown], words)
    if axis.axis_name == "x" and not numeric(values) and max(map(len, words)) * len(words) > 26:
        axis.set_tick_params(rotation=28)


def plot_swept(
    sweep: Sweep,
    panels: Mapping[str, FloatArray],
    beside: Mapping[str, FloatArray] | None = None,
    *,
    along: str | None = None,
    by: str | None = None,
    at: AnyMapping | None = None,
    **look: Any,
) -> tuple[Figure, list[Axes]]:
    """`small_multiples` of numbers (C,), by the titles of their panels: a sweep's lines along one
    axis, by a second one, with others held at values, and dashed those of `beside`.
    """
    import pandas as pd
    import xarray as xr

    along, by = two_axes(sweep, along, by)
    titles = pd.Index(panels, name="panel")
    found = xr.concat([sweep.lines(panels[t], along, by, at) for t in titles], titles)
    if beside:
        lines = [sweep.lines(beside[t], along, by, at)["median"] for t in titles]
        found["dashed"] = xr.concat(lines, titles)
    # Values at which no cell has numbers are left out.
    for axis in filter(None, (along, by)):
        found = found.dropna(axis, how="all")
    return small_multiples(found, along, by, **look)


def small_multiples(
    data: xr.Dataset,
    x: str,
    hue: str | None = None,
    *,
    log: bool = True,
    sharey: bool = False,
    wide: float = 1.0,
    dashed: str = "",
) -> tuple[Figure, list[Axes]]:
    """A panel for each value of ``panel``, in it a line along `x` for some values of `hue`.

    Lines are the variable ``median`` with a band from ``low`` to ``high``, and, where there is one,
    the variable ``dashed``, which the legend calls `dashed`. More than three panels stand in two
    rows; `wide` is the width of one over the usual one.
    """
    from matplotlib.patheffects import withStroke

    data = data.expand_dims("line") if hue is None else data.rename({hue: "line"})
    data = data.isel(line=some(data.sizes["line"], _MOST_LINES))
    names = data["line"].values.tolist() if hue else [""]
    looks = _looks(names)
    # Dashed lines are seen on full ones, too.
    edge = {"path_effects": [withStroke(linewidth=2.8, foreground="white")]}
    titles = data["panel"].values
    rows = 1 if len(titles) <= 3 else 2
    columns = -(-len(titles) // rows)
    figure = style.new_figure(2.4 + 2.9 * wide * columns, 0.8 + (3.1 if rows == 1 else 2.75) * rows)
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
    for ax, title in zip(axes, titles, strict=False):
        style.dress(ax, grid=True)
        places = _scale(ax, data[x].values.tolist())
        for number, look in enumerate(looks):
            one = data.sel(panel=title).isel(line=number)
            good = one["median"].notnull().values
            low, median, high = (one[name].values[good] for name in ("low", "median", "high"))
            style.band(ax, places[good], low, high, look["color"], alpha=0.2)
            ax.plot(places[good], median, **look)
            if "dashed" in data:
                ax.plot(
                    places, one["dashed"], color=look["color"], linewidth=1.2, dashes=(4, 2), **edge
                )
        if log:
            logarithmic(ax, data if sharey else data.sel(panel=title))
        style.label(ax, title, axis_label(x))
    for spare in axes[len(titles) :]:
        spare.set_visible(False)
    keys = []
    if hue:
        words = [value_words(name) for name in names]
        words[0] = capital(f"{axis_label(hue)}: {words[0]}")
        keys = [style.key(text, **look) for text, look in zip(words, looks, strict=True)]
    if "dashed" in data:
        keys.append(style.key(dashed, color=style.GREY, dashes=(4, 2)))
    if keys:
        style.legend_above(figure, keys, columnspacing=1.4)
    held_title(figure, data.attrs.get("held", {}))
    return figure, axes[: len(titles)]


def _looks(names: Sequence[Any]) -> list[AnyDict]:
    """Colours and markers of lines: in order of numbers, or apart for names; the first ones are
    wider, so that all are seen where they coincide.
    """
    colours: Sequence[Any] = _NAMED
    if numeric(names):
        import matplotlib

        colours = list(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.86, len(names))))
    sizes = range(len(names) - 1, -1, -1)
    return [
        {"color": c, "marker": m, "markersize": 4.5 + size, "linewidth": 1.5 + 0.9 * size}
        for c, m, size in zip(colours, _MARKERS, sizes, strict=False)
    ]


def held_title(figure: Figure, held: AnyMapping) -> None:
    if held:
        figure.suptitle(
            f"For {place(held)}", fontsize=style.LABEL_SIZE, color=style.GREY, x=0.01, ha="left"
        )


def logarithmic(ax: Axes, data: xr.Dataset) -> None:
    """A logarithmic axis in plain numbers over what is drawn, of at least a factor of two."""
    values = data.to_array().values.ravel()
    values = values[np.isfinite(values) & (values > 0.0)]
    if not len(values):
        style.note(ax, "no cell has this", (0.5, 0.5), xycoords="axes fraction", ha="center")
        return
    low, high = float(values.min()) / 1.15, float(values.max()) * 1.15
    wider = max(1.0, np.sqrt(2.25 * low / high))
    ax.set_ylim(low / wider, high * wider)
    ax.set_yscale("log")
    plain(ax.yaxis)


def plain(axis: Any, *, fine: bool = True) -> None:
    """Plain numbers on a logarithmic axis, at 1, 2 and 5 where it spans little, and `fine` ones
    where it spans less.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axis.get_view_interval()
    span = high / low
    subs = [1.0, 2.0, 5.0] if span < 150.0 else [1.0]
    if fine and span < 6.0:
        subs = [1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0]
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    whole = 10.0 if fine else 1.0
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: count(int(value)) if value >= whole else f"{value:.6g}")
    )
    axis.set_minor_locator(NullLocator())


def target_line(ax: Axes, value: float) -> None:
    """What is aimed at."""
    ax.axhline(value, color=style.VERMILLION, linewidth=1.2, dashes=(5, 2))


def target_words(ax: Axes, value: float, words: str, **look: Any) -> None:
    """Words at the left end of the line of a target."""
    place = {"xycoords": ("axes fraction", "data"), "color": style.VERMILLION}
    style.note(ax, words, (0.02, value), (0, 4), **place, **look)


def short(value: float) -> str:
    """At most three digits, no power of ten where plain zeros are few."""
    if 100.0 <= abs(value) < 1e6:
        return fixed(float(f"{value:.3g}"), 0)
    return significant(value, 3 if abs(value) < 100.0 else 2)
