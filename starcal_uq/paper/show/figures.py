"""Figures of the paper's experiments: their Figs. 3 to 6 and printed numbers, the field,
replicates, and the study.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import Parameter, parameters
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import fixed, significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.errors import detector_grid, map_error, reprojection_error_px
from starcal_uq.paper.field.published import FIELD_METHODS, RATE, printed_field
from starcal_uq.paper.interaction import AXES as STUDY_AXES
from starcal_uq.paper.published import PAPER_METHODS, printed
from starcal_uq.paper.result import QUANTITIES, per_px
from starcal_uq.paper.show.field import CAMERA_NAMES
from starcal_uq.paper.show.tables import METHOD_NAMES, NAMES
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import symbol
from starcal_uq.presentation.figures.sweeps import ticks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.paper.field.result import FieldExperiment
    from starcal_uq.paper.interaction import InteractionStudy
    from starcal_uq.paper.judgement import Judged
    from starcal_uq.paper.replicates import Replicates
    from starcal_uq.paper.result import Reproduction

# Points along each side of the maps of the error.
_MAP_POINTS = 49
# Arrows along each side of the detector.
_ARROWS = 12
# z-values within this are drawn to scale.
_LINEAR_Z = 3.0
_PALETTE = (style.VERMILLION, style.ORANGE, style.BLUE, style.GREEN, style.PURPLE, style.SKY)
# First stages of several methods coincide: the shorter path is drawn as rings around the longer.
_RINGS: AnyDict = {"markersize": 7.5, "markerfacecolor": "none", "linewidth": 2.6, "alpha": 0.75}
_DOTS: AnyDict = {"markersize": 3.6, "linewidth": 1.3}
# Optics in the order of the paper's Fig. 3: unit, and end of the linear part of the axis.
_ORDER = {"f": ("mm", 1e-3), "x0": ("px", 0.1), "y0": ("px", 0.1)}


def plot_trajectories(found: Reproduction) -> Figure:
    """The optics on their way to the estimate (the paper's Fig. 3): batch methods by iteration,
    filters by frame.

    Distances from the truth, on axes that are linear near it and logarithmic beyond: the start is
    far away, and the end is what matters. Filters have the band of one claimed standard deviation;
    marks at the right edge are printed.
    """
    run, truth = found.run, found.run.truth
    calibrations = {run.label(method): run.of(method) for method in PAPER_METHODS}
    filters = [
        name for name, cal in calibrations.items() if any(s.name == "filter" for s in cal.stages)
    ]
    colours = dict(zip(calibrations, _PALETTE, strict=False))
    names = [p.name for p in parameters("none")]
    figure = style.new_figure(10.0, 8.6)
    panels = figure.subplots(len(_ORDER), 2, sharey="row", sharex="col")
    for row, (name, (unit, threshold)) in enumerate(_ORDER.items()):
        index = names.index(name)
        true, to_unit = float(truth.theta[index]), per_px(truth, name)
        by_iteration, by_frame = (style.dress(ax, grid=True) for ax in panels[row])
        for method, (label, cal) in zip(PAPER_METHODS, calibrations.items(), strict=True):
            colour, ax = colours[label], by_frame if label in filters else by_iteration
            if label in filters:
                _by_frame(ax, cal, index, true, to_unit, colour)
            else:
                path = np.concatenate([s.trajectory[:, index] for s in cal.stages])
                look = _RINGS if len(cal.stages) == 1 else _DOTS
                ax.plot((path - true) * to_unit, color=colour, marker="o", **look)
            value = printed(method, QUANTITIES[name]).value - true * to_unit
            _mark(ax, 1.0, value, colour, edge=True)
        for ax in (by_iteration, by_frame):
            ax.axhline(0.0, color=style.INK, linewidth=1.0, dashes=(4, 2))
        # Linear near the truth, logarithmic beyond, and reaching the start.
        style.log_scale(by_iteration.yaxis, threshold, linscale=0.6)
        by_iteration.margins(y=0.08)
        name = symbol(parameters("none")[index].name)
        style.label(by_iteration, y=f"{name} − {true * to_unit:g} [{unit}]")
    by_frame.set_xscale("log")
    style.label(panels[0, 0], "Batch methods: by iteration")
    style.label(panels[0, 1], "Filter: by frame, with its claimed standard deviation")
    style.label(panels[-1, 0], x="iteration, all stages in a row")
    style.label(panels[-1, 1], x="frames")
    handles = [style.key(label, colour, linewidth=1.6) for label, colour in colours.items()]
    handles.append(style.key("truth", style.INK, linewidth=1.0, dashes=(4, 2)))
    handles.append(_printed_key("<"))
    style.legend_above(
        figure, handles, fontsize=style.LABEL_SIZE, columnspacing=1.4, handlelength=1.8
    )
    return figure


def _by_frame(
    ax: Axes, cal: Calibration, index: int, true: float, to_unit: float, colour: str
) -> None:
    """A filter's estimate and claimed band after each frame."""
    stage = next(s for s in cal.stages if s.name == "filter")
    values = (stage.trajectory[:, index] - true) * to_unit
    # The first entry is the start; a logarithmic axis begins at one frame.
    frames = np.linspace(0.0, cal.n_frames, len(values))[1:]
    ax.plot(frames, values[1:], color=colour, linewidth=1.3)
    if stage.sigmas is not None:
        sigma = stage.sigmas[1:, index] * to_unit
        style.band(ax, frames, values[1:] - sigma, values[1:] + sigma, colour, alpha=0.18)


def _mark(ax: Axes, x: float, y: float, colour: str, *, edge: bool = False) -> None:
    """A printed value: at a place, or at the right edge for x = 1."""
    look: AnyDict = {"markersize": 7.0, "markeredgecolor": style.INK, "markeredgewidth": 0.6}
    if edge:
        look |= {"transform": ax.get_yaxis_transform(), "clip_on": False, "zorder": 5}
    ax.plot(x, y, color=colour, linestyle="none", marker="<" if edge else ">", **look)


def _printed_key(
    marker: str, colour: str = style.GREY, text: str = "printed in the paper"
) -> Line2D:
    return style.key(
        text, colour, marker=marker, markersize=7.0, markeredgecolor=style.INK, linestyle=""
    )


def plot_error_fields(found: Reproduction) -> Figure:
    """Errors over the detector without noise (the paper's Figs. 4 to 6): size as colour, direction
    as arrows.
    """
    from matplotlib.colors import LogNorm

    truth, names = found.run.truth, (*PAPER_METHODS, "efficient")
    xy, _ = detector_grid(truth, _MAP_POINTS)
    cameras = {name: found.run.of(name).camera for name in names}
    fields = {
        name: (
            reprojection_error_px(truth, camera, xy).error_px,
            map_error(truth, camera, xy).error_px,
        )
        for name, camera in cameras.items()
    }
    figure = style.new_figure(3.55 * len(fields) + 0.9, 8.2)
    panels = figure.subplots(2, len(fields), squeeze=False, sharex=True, sharey=True)
    sizes = [np.hypot(*part.T) for parts in fields.values() for part in parts]
    top = 10.0 ** np.ceil(np.log10(max(float(size.max()) for size in sizes)))
    norm = LogNorm(1e-4 * top, top)
    kinds = ("eq. 16", "rotation removed")
    for column, (name, parts) in enumerate(fields.items()):
        for row, (kind, error) in enumerate(zip(kinds, parts, strict=True)):
            image = _error_panel(panels[row, column], xy, error, norm)
            note = (
                f" (printed: {printed(name, 'max_residual_px').text})"
                if name in PAPER_METHODS
                else ""
            )
            title = (
                f"{found.run.label(name)}, {kind}\nlargest "
                f"{significant(np.hypot(*error.T).max())} px{note}"
            )
            style.label(
                panels[row, column], title, "x [px]" if row else "", "y [px]" if column == 0 else ""
            )
    bar = figure.colorbar(image, ax=panels, fraction=0.03, pad=0.015, extend="min")
    style.dress_bar(bar, "size of the error [px]")
    return figure


def _error_panel(ax: Axes, xy: FloatArray, error: FloatArray, norm: LogNorm) -> QuadMesh:
    style.dress(ax)
    n = round(np.sqrt(len(xy)))
    x, y = xy[:n, 0], xy[::n, 1]
    size = np.hypot(*error.T).reshape(n, n)
    low = float(norm.vmin or 0.0)
    image = ax.pcolormesh(
        x, y, np.maximum(size, low), norm=norm, cmap="cividis", shading="gouraud", rasterized=True
    )
    some = np.unique(np.linspace(0, n - 1, _ARROWS + 2).round().astype(int)[1:-1])
    grid = np.ix_(some, some)
    along = [part.reshape(n, n)[grid] for part in (*xy.T, *error.T)]
    longest = float(np.hypot(*error.T).max())
    if longest > 0.0:
        # Arrows tell the direction; their length, the root of the size over the panel's largest,
        # keeps small ones seen.
        length = np.sqrt(np.hypot(*along[2:]) * longest)
        along[2:] = [part / np.maximum(length, 1e-300) for part in along[2:]]
        scale = 1.0 / (0.95 * (x[some[1]] - x[some[0]]))
        units: AnyDict = {"angles": "xy", "scale_units": "xy", "pivot": "mid"}
        ax.quiver(*along, scale=scale, color="white", width=0.005, headwidth=3.6, **units)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[-1], y[0])
    ax.set_aspect("equal")
    return image


def plot_printed_numbers(found: Reproduction) -> Figure:
    """Every printed number as a distance from our draws: under the main reading, and under the
    closest one.

    The axis is to scale within three standard deviations and logarithmic beyond.
    """
    judged = found.judged
    figure = style.new_figure(9.6, 1.5 + 0.285 * len(judged))
    ax = style.dress(figure.add_subplot())
    place = np.arange(len(judged))[::-1]
    main = np.array([one.main.z for one in judged])
    nearest = np.array([min((t.z for t in one.trials), key=abs) for one in judged])
    ax.axvspan(-_LINEAR_Z, _LINEAR_Z, color=style.GREEN, alpha=0.15, linewidth=0)
    ax.axvline(0.0, color=style.GREY, linewidth=0.8)
    ax.hlines(place, nearest, main, color=style.LIGHT, linewidth=1.6, zorder=1)
    open_: AnyDict = {"color": "white", "markeredgecolor": style.GREY, "markersize": 5.0}
    ax.plot(nearest, place, "o", label="closest of all readings", **open_)
    ax.plot(main, place, "o", color=style.BLUE, markersize=5.0, label="as printed (main reading)")
    reach = 1.6 * max(10.0, float(np.abs(main).max()))
    inner = (-_LINEAR_Z, 0.0, _LINEAR_Z)
    style.signed_log(ax.xaxis, _LINEAR_Z, reach, inner, most=6, linscale=1.3)
    ax.set_yticks(place, [_axis_name(one) for one in judged])
    ax.tick_params(axis="y", length=0.0)
    ax.set_ylim(-0.7, len(judged) - 0.3)
    ax.grid(True, axis="y", color=style.LIGHT, linewidth=0.5)
    ax.set_axisbelow(True)
    style.label(ax, "", "(printed − our mean) / standard deviation of a new run")
    style.legend_above(figure, ax.get_legend_handles_labels()[0], fontsize=style.LABEL_SIZE)
    return figure


def _axis_name(one: Judged) -> str:
    place, quantity = one.printed.place.partition(";")[0], one.printed.quantity
    words = NAMES[quantity] if one.printed.is_error_size else symbol(quantity.partition("_")[0])
    return f"{place} ({METHOD_NAMES[one.printed.method]}): {words}"


_COLOURS = {
    "uncalibrated": style.VERMILLION,
    "least_squares": style.ORANGE,
    "samaan": style.PURPLE,
    "three_stage": style.BLUE,
    "truth": style.GREEN,
}
_PARTS = {
    "common": (style.GREY, "common rotation"),
    "rest": (style.ORANGE, "rest"),
    "noise": (style.SKY, "noise"),
}
_DASH: AnyDict = {"linestyle": "", "marker": "_", "markersize": 9.0, "markeredgewidth": 2.4}
# Cameras of one tolerance stand side by side, so that their bars can be told apart.
_SPREAD = 1.035


def plot_rates(found: FieldExperiment) -> Figure:
    """Identification rate against tolerance, with Wilson intervals; the paper's rates at the right
    edge.
    """
    rates, main_px = found.rates(), found.tolerance_px
    figure = style.new_figure(8.6, 4.6)
    ax = style.dress(figure.add_subplot(), grid=True)
    ax.axvline(main_px, color=style.GREY, linewidth=1.0, dashes=(4, 3))
    style.note(ax, "main table", (main_px, 0.0), (4, 3), color=style.GREY)
    for number, (name, colour) in enumerate(_COLOURS.items()):
        rows = rates[rates["camera"] == name].sort_values("tolerance_px")
        x = rows["tolerance_px"].to_numpy() * _SPREAD ** (number - 2)
        y = 100.0 * rows["rate"].to_numpy()
        error = 100.0 * np.stack([rows["rate"] - rows["low"], rows["high"] - rows["rate"]])
        ax.errorbar(
            x, y, error, color=colour, marker="o", markersize=4.0, linewidth=1.4, elinewidth=1.0
        )
        if name in FIELD_METHODS:
            _mark(ax, 1.0, printed_field(name, RATE).value, colour, edge=True)
    ax.set_xscale("log")
    plain_ticks(ax, sorted(set(rates["tolerance_px"])))
    ax.set_ylim(0.0, 102.0)
    style.label(
        ax,
        x="tolerance: displacement in the corner that the camera may be wrong by [px]",
        y="identified [%]",
    )
    line: AnyDict = {"marker": "o", "markersize": 4.0, "linewidth": 1.4}
    keys = [style.key(CAMERA_NAMES[name], colour, **line) for name, colour in _COLOURS.items()]
    style.legend_above(figure, [*keys, _printed_key("<")])
    return figure


def plot_errors(found: FieldExperiment) -> Figure:
    """Attitude errors about each axis: total, what alignment leaves, the three parts, and the
    printed number.
    """
    parts = found.parts()
    figure = style.new_figure(10.4, 4.6)
    panels = figure.subplots(1, 3, sharey=True)
    cameras = [name for name in _COLOURS if name in set(parts["camera"])]
    place = np.arange(len(cameras))
    for ax, axis in zip(panels, AXES, strict=True):
        style.dress(ax, grid=True)
        rows = parts[parts["axis"] == axis].set_index("camera").loc[cameras]
        for part, x, colour, marker in (
            ("rms", -0.17, style.INK, "s"),
            ("aligned", 0.03, style.BLUE, "o"),
        ):
            value, low, high = (rows[f"{part}{end}"].to_numpy() for end in ("", "_low", "_high"))
            ends = np.maximum([value - low, high - value], 0.0)
            look: AnyDict = {"fmt": marker, "markersize": 5.5, "elinewidth": 1.2}
            ax.errorbar(place + x, value, ends, color=colour, **look)
        for part, (colour, _) in _PARTS.items():
            ax.plot(place + 0.22, rows[part].abs(), color=colour, **_DASH)
        for at, camera in enumerate(cameras):
            if camera in FIELD_METHODS:
                value = printed_field(camera, f"{axis}_arcsec").value
                _mark(ax, at - 0.36, value, style.VERMILLION)
        ax.set_yscale("log")
        ax.set_ylim(0.03, 9000.0)
        ax.set_xlim(-0.6, len(cameras) - 0.4)
        ax.set_xticks(
            range(len(cameras)), [CAMERA_NAMES[name].replace(" ", "\n") for name in cameras]
        )
        ax.tick_params(axis="x", labelsize=style.TICK_SIZE - 0.7)
        style.label(ax, axis.capitalize())
    style.label(panels[0], y="error, root mean square [arcsec]")
    plain: AnyDict = {"linestyle": "", "markersize": 6.0}
    keys = [
        _printed_key(">", style.VERMILLION, "printed"),
        style.key("against the true attitude", style.INK, marker="s", **plain),
        style.key("after alignment", style.BLUE, marker="o", **plain),
    ]
    keys += [style.key(words, colour, **_DASH) for colour, words in _PARTS.values()]
    style.legend_above(figure, keys, columnspacing=1.3, handletextpad=0.5)
    return figure


# Errors up to this many bounds are drawn to scale, larger ones on a logarithmic axis.
_LINEAR = 4.0
_RIGHT, _WRONG = style.BLUE, style.VERMILLION


def plot_replicates(found: Replicates) -> Figure:
    """Errors and widths of every method, one column of panels for each parameter, in units of the
    Cramer-Rao bound.

    Above, the mean error (dot) with the spread of the estimates (thick bar) and the claimed
    standard deviation (thin bar with caps); the grey band is the bound around the truth. The axis
    is to scale near the truth and logarithmic beyond, where the mean error is also given as a
    number. Below, the widths alone: spread with its 95 % interval (dot), claim (diamond) and, where
    there is one, the claim by the formula of the textbooks (cross). Claims that the tests reject
    are red.
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
    style.label(
        panels[0, middle], x="error / Cramer-Rao bound (to scale up to ±4, logarithmic beyond)"
    )
    style.label(panels[1, middle], x="standard deviation / Cramer-Rao bound")
    _legend(figure, found)
    return figure


def _errors(ax: Axes, rows: list[AnyDict], places: list[int], parameter: Parameter) -> None:
    style.dress(ax)
    ax.axvspan(-1.0, 1.0, color=style.LIGHT, linewidth=0)
    ax.axvline(0.0, color=style.GREY, linewidth=0.7)
    for row, place in zip(rows, places, strict=True):
        bias, spread, claimed = (row[name] / row["crlb"] for name in ("bias", "spread", "claimed"))
        _range(ax, (bias - spread, bias + spread), bias, place)
        look: AnyDict = {"color": _colour(row["claim_wrong"]), "capsize": 2.5, "fmt": "none"}
        ax.errorbar(bias, place - 0.18, xerr=claimed, linewidth=1.1, **look)
        if abs(bias) > _LINEAR:
            # The logarithmic part has few ticks.
            side = -np.sign(bias)
            end = bias + side * max(spread, claimed)
            small: AnyDict = {"fontsize": style.TICK_SIZE - 1.0, "color": style.GREY}
            small |= {"ha": "right" if side < 0.0 else "left", "va": "center"}
            style.note(ax, fixed(bias, 0), (end, place), (side * 5.0, 0.0), **small)
    _signed_axis(ax, float(np.abs(ax.dataLim.intervalx).max()))
    style.label(ax, symbol(parameter.name))


def _colour(wrong: bool) -> str:
    return _WRONG if wrong else _RIGHT


def _range(ax: Axes, ends: Sequence[float], middle: float, place: float) -> None:
    """A bar from end to end with a dot."""
    ax.plot(ends, [place + 0.12] * 2, color=style.SKY, linewidth=4.0, solid_capstyle="butt")
    ax.plot(middle, place + 0.12, "o", color=style.INK, markersize=3.5)


def _signed_axis(ax: Axes, reach: float) -> None:
    if reach <= _LINEAR:
        ax.set_xlim(-_LINEAR, _LINEAR)
        plain_ticks(ax, (-3.0, 0.0, 3.0))
    else:
        style.signed_log(ax.xaxis, _LINEAR, 1.5 * reach, linscale=1.2)


def plain_ticks(ax: Axes, ticks: Sequence[float] | FloatArray) -> None:
    """Ticks along x that say plain numbers, and no others."""
    ax.set_xticks(ticks, [f"{tick:g}".replace("-", "−") for tick in ticks])
    ax.set_xticks([], minor=True)


def _widths(ax: Axes, rows: list[AnyDict], places: list[int]) -> None:
    style.dress(ax)
    ax.axvline(1.0, color=style.GREY, linewidth=0.9)
    for row, place in zip(rows, places, strict=True):
        spread, claimed, classical = (
            row[name] / row["crlb"] for name in ("spread", "claimed", "claimed_classical")
        )
        ends = [1.0 / np.sqrt(row[f"efficiency_{end}"]) for end in ("high", "low")]
        _range(ax, ends, spread, place)
        colour, other = _colour(row["claim_wrong"]), _colour(row["classical_wrong"])
        ax.plot(claimed, place - 0.18, "D", color=colour, markersize=4.0)
        ax.plot(classical, place - 0.18, "x", color=other, markersize=4.5)
    low, high = ax.dataLim.intervalx * (0.8, 1.25)
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    ticks = np.array([0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0])
    plain_ticks(ax, ticks[(ticks >= low) & (ticks <= high)])


def _legend(figure: Figure, found: Replicates) -> None:
    from matplotlib.patches import Patch

    handles = [
        style.key("mean error; spread", style.INK, marker="o", linestyle="", markersize=4),
        style.key("± spread; its 95 % interval", style.SKY, linewidth=4),
        style.key("claimed", _RIGHT, marker="D", markersize=4),
        style.key(
            "claimed by the textbook's formula", _RIGHT, marker="x", linestyle="", markersize=5
        ),
        style.key("claims that the tests reject", _WRONG, linewidth=1.5),
        Patch(color=style.LIGHT, label="Cramer-Rao bound"),
    ]
    frames = found.provenance.settings.get("n_frames")
    title = f"{found.n_replicates} replicates" + ("" if frames is None else f" of {frames} frames")
    style.legend_above(figure, handles, title=title, title_fontsize=style.TITLE_SIZE)


# Label and title of each axis of the study.
_AXES = {
    "distortion": ("displacement at the corner [px]", "Size of the distortion"),
    "field": ("full field [deg], as many stars", "Field of view"),
    "frames": ("frames", "Number of frames"),
    "stars": ("mean stars in a frame", "Stars in a frame"),
}
_METHOD_COLOURS = {
    "least squares": style.VERMILLION,
    "samaan": style.ORANGE,
    "three stages": style.BLUE,
    "efficient": style.GREEN,
}
_MARKERS = {"least squares": "o", "samaan": "s", "three stages": "^", "efficient": "D"}
# Biases this far below the smallest spread are rounding; they are counted in words rather than
# drawn.
_FLOOR = 0.2
# Spread over noise from which on both are drawn.
_APART = 1.3


def plot_interaction(study: InteractionStudy) -> Figure:
    """Size of the bias and spread of x0, y0 and f for every method, along the four axes.

    Solid lines are the bias (from data without noise), dashed ones the spread (with noise). Where
    the bias depends on where the stars are, the spread holds more than the noise, which is then
    dotted. Where a solid line is above the noise of its colour, the interaction costs more than
    noise. Biases far below every spread are not drawn: the methods that have them are named in the
    first panel.
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
        for j, (axis, (words, title)) in enumerate(_AXES.items()):
            ax, column = style.dress(panels[i, j], grid=True), STUDY_AXES[axis]
            some = rows[rows["axis"] == axis].sort_values(column, kind="stable")
            _panel(ax, some, column, methods, low, j == 0)
            ax.set_yscale("log")
            ax.set_ylim(low, high)
            last = i == len(optics) - 1
            name = f"{symbol(parameter.name)} [px]" if j == 0 else ""
            style.label(ax, title if i == 0 else "", words if last else "", name)
    for j, axis in enumerate(_AXES):
        _scale(panels[0, j], table[table["axis"] == axis][STUDY_AXES[axis]].to_numpy())
    _interaction_legend(figure, methods)
    return figure


def _panel(
    ax: Axes, rows: pd.DataFrame, column: str, methods: list[str], low: float, named: bool
) -> None:
    unseen = []
    for method in methods:
        curve = rows[rows["method"] == method]
        curve = curve[np.isfinite(curve["spread"])]
        if curve.empty:
            continue
        at, bias = curve[column].to_numpy(), curve["bias"].abs().to_numpy()
        colour = _METHOD_COLOURS.get(method, style.GREY)
        ax.plot(at, curve["spread"], "--", color=colour, linewidth=1.1)
        if np.max(curve["spread"] / curve["noise"]) > _APART:
            ax.plot(at, curve["noise"], ":", color=colour, linewidth=1.3)
        if np.max(bias) < low:
            unseen.append(method)
            continue
        # A bias of zero has no place on the axis; the line then starts from below it.
        look: AnyDict = {"marker": _MARKERS.get(method, "o"), "markersize": 3.5}
        ax.plot(at, np.maximum(bias, 1e-3 * low), color=colour, linewidth=1.4, **look)
    if unseen and named:
        words, small = f"bias too small to show: {', '.join(unseen)}", style.TICK_SIZE - 1.0
        ax.text(0.03, 0.03, words, transform=ax.transAxes, fontsize=small, color=style.GREY)


def _scale(ax: Axes, at: FloatArray) -> None:
    """Logarithmic, with a place for zero where the axis starts there; ticks at some of the
    values.
    """
    values = np.unique(at)
    if not len(values):
        return
    positive = values[values > 0.0]
    if values[0] <= 0.0 and len(positive):
        ax.set_xscale("symlog", linthresh=float(positive[0]), linscale=0.4)
        ax.set_xlim(-0.1 * float(positive[0]), 1.4 * float(positive[-1]))
    else:
        ax.set_xscale("log")
    ticks(ax.xaxis, values.tolist(), values, 5)
    ax.set_xticks([], minor=True)


def _interaction_legend(figure: Figure, methods: list[str]) -> None:
    handles = [
        style.key(m, _METHOD_COLOURS.get(m, style.GREY), marker=_MARKERS.get(m, "o"), markersize=4)
        for m in methods
    ]
    lines = {"-": "bias", "--": "spread", ":": "noise alone, where it differs from the spread"}
    handles += [style.key(text, style.INK, linestyle=line) for line, text in lines.items()]
    style.legend_above(figure, handles)
