"""Figures of the paper's experiments: their Figs. 3 to 6 and printed numbers, the field,
replicates, and the study.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import significant
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.paper.errors import detector_grid, map_error, reprojection_error_px
from starcal_uq.paper.field.published import FIELD_METHODS, RATE, printed_field
from starcal_uq.paper.interaction import AXES as STUDY_AXES
from starcal_uq.paper.published import PAPER_METHODS, printed
from starcal_uq.paper.result import QUANTITIES, per_px
from starcal_uq.paper.show.field import CAMERA_NAMES
from starcal_uq.paper.show.tables import METHOD_NAMES, NAMES
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import symbol, ticks_at_levels
from starcal_uq.presentation.figures.sweeps import plain, ticks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.estimation.stages import Stage
    from starcal_uq.paper.field.result import FieldExperiment
    from starcal_uq.paper.interaction import InteractionStudy
    from starcal_uq.paper.judgement import Judged
    from starcal_uq.paper.replicates import Replicates
    from starcal_uq.paper.result import Reproduction

# Points along each side of the maps of the error, and between two arrows.
_MAP_POINTS, _STEP = 49, 4
# Sizes of the error below this share of the largest have one colour.
_FOOT = 1e-4
# z-values within this are drawn to scale.
_LINEAR_Z = 3.0
_PALETTE = (style.VERMILLION, style.ORANGE, style.BLUE)
# Optics in the order of the paper's Fig. 3: unit, and end of the linear part of the axis.
_ORDER = {"f": ("mm", 1e-3), "x0": ("px", 0.1), "y0": ("px", 0.1)}


def plot_trajectories(found: Reproduction) -> Figure:
    """The optics on their way to the estimate (the paper's Fig. 3): batch methods by iteration,
    filters by frame.

    Distances from the truth, on axes that are linear near it and logarithmic beyond: the start is
    far away, and the end is what matters. Filters have the band of one claimed standard deviation;
    marks at the right edge are printed.
    """
    truth = found.run.truth
    figure = style.new_figure(10.0, 8.6)
    panels = figure.subplots(len(_ORDER), 2, sharey="row", sharex="col")
    for row, (name, (unit, threshold)) in zip(panels, _ORDER.items(), strict=True):
        index, to_unit = truth.parameter_names.index(name), per_px(truth, name)
        true = float(truth.theta[index]) * to_unit
        by_iteration, by_frame = (style.dress(ax, grid=True) for ax in row)
        for method, colour in zip(PAPER_METHODS, _PALETTE, strict=True):
            cal = found.run.of(method)
            ax, ends = by_iteration, []
            for stage in cal.stages:
                path = stage.trajectory[:, index] * to_unit - true
                if stage.name == "filter":
                    ax = by_frame
                    _by_frame(ax, stage, path, index, cal.n_frames, to_unit, colour)
                ends.append(path)
            if ax is by_iteration:
                # First stages of several methods coincide: the shorter path is drawn as rings
                # around the longer.
                look = style.look("path" if len(ends) > 1 else "path around")
                ax.plot(np.concatenate(ends), color=colour, **look)
            _mark_at_edge(ax, printed(method, QUANTITIES[name]).value - true, colour)
        for ax in row:
            ax.axhline(0.0, **style.look("truth line"))
        # Linear near the truth, logarithmic beyond, and reaching the start.
        style.log_scale(by_iteration.yaxis, threshold, linscale=0.6)
        by_iteration.margins(y=0.08)
        style.label(by_iteration, y=f"{symbol(name)} − {true:g} [{unit}]")
    by_frame.set_xscale("log")
    for ax, kind in zip((*panels[0], *panels[-1]), ("batch", "filter", "", "frames"), strict=True):
        style.named(ax, f"trajectories {kind}".strip())
    labels = map(found.run.label, PAPER_METHODS)
    handles = [
        style.key(text, colour, linewidth=1.6)
        for text, colour in zip(labels, _PALETTE, strict=True)
    ]
    style.legend_above(figure, handles + style.keys("trajectories"), columnspacing=1.4)
    return figure


def _by_frame(
    ax: Axes,
    stage: Stage,
    path: FloatArray,
    index: int,
    n_frames: int,
    to_unit: float,
    colour: str,
) -> None:
    """A filter's estimate and claimed band after each frame."""
    # The first entry is the start; a logarithmic axis begins at one frame.
    frames = np.linspace(0.0, n_frames, len(path))[1:]
    ax.plot(frames, path[1:], color=colour, linewidth=1.3)
    if stage.sigmas is not None:
        sigma = stage.sigmas[1:, index] * to_unit
        style.band(ax, frames, path[1:] - sigma, path[1:] + sigma, colour, alpha=0.18)


def _mark_at_edge(ax: Axes, y: float, colour: str) -> None:
    """A printed value at the right edge."""
    edge = ax.get_yaxis_transform()
    ax.plot(1.0, y, color=colour, transform=edge, clip_on=False, zorder=5, **style.look("printed"))


def plot_error_fields(found: Reproduction) -> Figure:
    """Errors over the detector without noise (the paper's Figs. 4 to 6): size as colour, direction
    as arrows, in each panel on a scale of its own.
    """
    truth, names = found.run.truth, (*PAPER_METHODS, "efficient")
    xy, _ = detector_grid(truth, _MAP_POINTS)
    x, y = xy[:_MAP_POINTS, 0], xy[::_MAP_POINTS, 1]
    errors = np.stack(
        [
            [of(truth, found.run.of(name).camera, xy).error_px for name in names]
            for of in (reprojection_error_px, map_error)
        ]
    ).reshape(2, len(names), _MAP_POINTS, _MAP_POINTS, 2)
    sizes = np.linalg.norm(errors, axis=-1)
    drawn = np.maximum(sizes, _FOOT * sizes.max())
    figure = style.new_figure(3.55 * len(names) + 0.9, 8.2)
    panels = figure.subplots(2, len(names), sharex=True, sharey=True)
    some = slice(_STEP // 2, None, _STEP)
    for (row, column), ax in np.ndenumerate(panels):
        name, largest = names[column], significant(sizes[row, column].max())
        title = f"{found.run.label(name)}, {('eq. 16', 'rotation removed')[row]}"
        title += f"\nlargest {largest} px"
        if name in PAPER_METHODS:
            title += f" (printed: {printed(name, 'max_residual_px').text})"
        image, levels = style.filled(ax, x, y, drawn[row, column], title, None, drawn)
        style.arrows(ax, x[some], y[some], errors[row, column][some, some], " px")
        ax.label_outer()
    bar = figure.colorbar(image, ax=panels, fraction=0.03, pad=0.015)
    style.dress_bar(bar, "size of the error [px]")
    ticks_at_levels(bar, levels)
    return figure


def plot_printed_numbers(found: Reproduction) -> Figure:
    """Every printed number as a distance from our draws: under the main reading, and under the
    closest one.

    The axis is to scale within three standard deviations and logarithmic beyond.
    """
    judged = found.judged[::-1]
    figure = style.new_figure(9.6, 1.5 + 0.285 * len(judged))
    ax = style.dress(figure.add_subplot())
    place = range(len(judged))
    main = np.array([one.main.z for one in judged])
    nearest = [min((t.z for t in one.trials), key=abs) for one in judged]
    ax.axvspan(-_LINEAR_Z, _LINEAR_Z, **style.look("within"))
    ax.axvline(0.0, color=style.GREY, linewidth=0.8)
    ax.hlines(place, nearest, main, color=style.LIGHT, linewidth=1.6, zorder=1)
    ax.plot(nearest, place, **style.look("nearest reading"))
    ax.plot(main, place, **style.look("main reading"))
    reach = 1.6 * max(10.0, float(np.abs(main).max()))
    inner = (-_LINEAR_Z, 0.0, _LINEAR_Z)
    style.signed_log(ax.xaxis, _LINEAR_Z, reach, inner, most=6, linscale=1.3)
    style.rows(ax, map(_axis_name, judged))
    ax.grid(True, axis="y", color=style.LIGHT, linewidth=0.5)
    ax.set_axisbelow(True)
    style.named(ax, "printed numbers")
    style.legend_above(figure, ax.get_legend_handles_labels()[0])
    return figure


def _axis_name(one: Judged) -> str:
    place, quantity = one.printed.place.partition(";")[0], one.printed.quantity
    words = NAMES[quantity] if one.printed.is_error_size else symbol(quantity.partition("_")[0])
    return f"{place} ({METHOD_NAMES[one.printed.method]}): {words}"


# Colours of the cameras.
_COLOURS = {
    "uncalibrated": style.VERMILLION,
    "least_squares": style.ORANGE,
    "samaan": style.PURPLE,
    "three_stage": style.BLUE,
    "truth": style.GREEN,
}
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
    keys = []
    for number, (name, colour) in enumerate(_COLOURS.items()):
        rows = rates[rates["camera"] == name].sort_values("tolerance_px")
        x = rows["tolerance_px"] * _SPREAD ** (number - 2)
        rate, low, high = 100.0 * rows[["rate", "low", "high"]].to_numpy().T
        style.errors(ax, x, rate, low, high, color=colour, **style.look("rate"))
        keys.append(style.key(CAMERA_NAMES[name], colour, **style.look("rate")))
        if name in FIELD_METHODS:
            _mark_at_edge(ax, printed_field(name, RATE).value, colour)
    ax.set_xscale("log")
    ax.minorticks_off()
    tolerances = np.unique(rates["tolerance_px"])
    ticks(ax.xaxis, tolerances.tolist(), tolerances, len(tolerances))
    ax.set_ylim(0.0, 102.0)
    style.named(ax, "rates")
    style.legend_above(figure, keys + style.keys("rates"))
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
    names = [CAMERA_NAMES[name].replace(" ", "\n") for name in cameras]
    for ax, axis in zip(panels, AXES, strict=True):
        style.dress(ax, grid=True)
        rows = parts[parts["axis"] == axis].set_index("camera").loc[cameras]
        for part, aside in (("rms", -0.17), ("aligned", 0.03)):
            value, low, high = rows[[part, f"{part}_low", f"{part}_high"]].to_numpy().T
            style.errors(ax, place + aside, value, low, high, **style.look(part))
        for part in ("common", "rest", "noise"):
            ax.plot(place + 0.22, rows[part].abs(), **style.look(part))
        for at, camera in enumerate(cameras):
            if camera in FIELD_METHODS:
                value = printed_field(camera, f"{axis}_arcsec").value
                ax.plot(at - 0.36, value, **style.look("printed here"))
        ax.set_yscale("log")
        ax.set_ylim(0.03, 9000.0)
        ax.set_xlim(-0.6, len(cameras) - 0.4)
        ax.set_xticks(place, names, fontsize=style.TICK_SIZE - 0.7)
        style.label(ax, axis.capitalize())
    style.named(panels[0], "attitude errors")
    style.legend_above(figure, style.keys("attitude errors"), columnspacing=1.3, handletextpad=0.5)
    return figure


# Errors up to this many bounds are drawn to scale, larger ones on a logarithmic axis.
_LINEAR = 4.0


def plot_replicates(found: Replicates) -> Figure:
    """Errors and widths of every method, one column of panels for each parameter, in units of the
    Cramer-Rao bound.

    Above, the mean error (dot) with the spread of the estimates (thick bar) and the claimed
    standard deviation (thin bar); the grey band is the bound around the truth. The axis is to scale
    near the truth and logarithmic beyond. Below, the widths alone: spread with its 95 % interval
    (dot), claim (diamond) and, where there is one, the claim by the formula of the textbooks
    (cross). Claims that the tests reject are red.
    """
    columns = parameters(found.truth.distortion)
    labels, table = found.labels[::-1], found.table()
    figure = style.new_figure(2.0 + 2.15 * len(columns), 1.5 + 0.62 * len(labels))
    panels = figure.subplots(2, len(columns), squeeze=False, sharey=True)
    for (above, below), parameter in zip(panels.T, columns, strict=True):
        some = table[table["parameter"] == parameter.name].set_index("method").reindex(labels)
        _errors(above, some)
        _widths(below, some)
        style.label(above, symbol(parameter.name))
        style.rows(above, labels)
        style.rows(below, labels)
    middle = len(columns) // 2
    style.named(panels[0, middle], "replicates errors")
    style.named(panels[1, middle], "replicates widths")
    frames = found.provenance.settings.get("n_frames")
    title = f"{found.n_replicates} replicates" + ("" if frames is None else f" of {frames} frames")
    look = {"title": title, "title_fontsize": style.TITLE_SIZE}
    style.legend_above(figure, style.keys("replicates"), **look)
    return figure


def _over_bound(rows: pd.DataFrame, *names: str) -> list[FloatArray]:
    """Columns of a table of replicates in units of the bound."""
    return [floats(rows[name] / rows["crlb"]) for name in names]


def _colours(wrong: pd.Series[bool]) -> list[str]:
    return [style.VERMILLION if one is True else style.BLUE for one in wrong]


def _errors(ax: Axes, rows: pd.DataFrame) -> None:
    style.dress(ax)
    bias, spread, claimed = _over_bound(rows, "bias", "spread", "claimed")
    place = np.arange(len(rows))
    ax.axvspan(-1.0, 1.0, color=style.LIGHT, linewidth=0)
    ax.axvline(0.0, color=style.GREY, linewidth=0.7)
    ax.errorbar(bias, place + 0.12, xerr=spread, **style.look("spread"))
    colours = _colours(rows["claim_wrong"])
    ax.hlines(place - 0.18, bias - claimed, bias + claimed, colors=colours, linewidth=1.4)
    reach = float(np.nanmax(np.abs(bias) + np.maximum(spread, claimed)))
    if reach <= _LINEAR:
        ax.set_xlim(-_LINEAR, _LINEAR)
    else:
        style.signed_log(ax.xaxis, _LINEAR, 1.5 * reach, linscale=1.2)


def _widths(ax: Axes, rows: pd.DataFrame) -> None:
    style.dress(ax)
    spread, claimed, textbook = _over_bound(rows, "spread", "claimed", "claimed_classical")
    low, high = (rows[f"efficiency_{end}"] ** -0.5 for end in ("high", "low"))
    place = np.arange(len(rows))
    ax.axvline(1.0, color=style.GREY, linewidth=0.9)
    style.errors(ax, place + 0.12, spread, low, high, across=True, **style.look("spread"))
    for values, wrong, marker in (
        (claimed, "claim_wrong", "D"),
        (textbook, "classical_wrong", "x"),
    ):
        ax.scatter(values, place - 0.18, s=18.0, c=_colours(rows[wrong]), marker=marker)
    ends = ax.dataLim.intervalx * (0.8, 1.25)
    ax.set_xscale("log")
    ax.set_xlim(*ends)
    plain(ax.xaxis, fine=False)


_METHOD_LOOKS = {
    "least squares": (style.VERMILLION, "o"),
    "samaan": (style.ORANGE, "s"),
    "three stages": (style.BLUE, "^"),
    "efficient": (style.GREEN, "D"),
}
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
    table = study.table.assign(bias=study.table["bias"].abs())
    optics = [p.name for p in parameters("none") if p.name in set(table["parameter"])]
    figure = style.new_figure(12.5, 0.9 + 2.55 * len(optics))
    size = len(optics), len(STUDY_AXES)
    panels = figure.subplots(*size, squeeze=False, sharex="col", sharey="row")
    for row, name in zip(panels, optics, strict=True):
        rows = table[table["parameter"] == name]
        low = _FLOOR * float(rows["spread"][rows["spread"] > 0.0].min())
        for ax, (axis, column) in zip(row, STUDY_AXES.items(), strict=True):
            style.dress(ax, grid=True)
            unseen = _panel(ax, rows[rows["axis"] == axis], column, low)
            if unseen and ax is row[0]:
                words = f"bias too small to show: {', '.join(unseen)}"
                style.note(ax, words, (0.03, 0.03), xycoords="axes fraction", color=style.GREY)
        row[0].set_yscale("log")
        row[0].set_ylim(low, 2.5 * float(rows[["bias", "spread"]].max(axis=None)))
        style.label(row[0], y=f"{symbol(name)} [px]")
    for (axis, column), ends in zip(STUDY_AXES.items(), panels[[0, -1]].T, strict=True):
        style.named(ends[0], f"interaction {axis}")
        style.named(ends[1], f"interaction along {axis}")
        _scale(ends[0], np.unique(table[table["axis"] == axis][column]))
    keys = [
        style.key(method, colour, marker=marker, markersize=4)
        for method, (colour, marker) in _METHOD_LOOKS.items()
        if method in set(table["method"])
    ]
    style.legend_above(figure, keys + style.keys("interaction"))
    return figure


def _panel(ax: Axes, rows: pd.DataFrame, column: str, low: float) -> list[str]:
    """Lines of every method; returned are the methods whose bias is too small to show."""
    unseen = []
    known = rows[np.isfinite(rows["spread"])].sort_values(column, kind="stable")
    for method, curve in known.groupby("method", sort=False):
        colour, marker = _METHOD_LOOKS[str(method)]
        at = curve[column]
        ax.plot(at, curve["spread"], "--", color=colour, linewidth=1.1)
        if (curve["spread"] / curve["noise"]).max() > _APART:
            ax.plot(at, curve["noise"], ":", color=colour, linewidth=1.3)
        if curve["bias"].max() < low:
            unseen.append(str(method))
            continue
        # A bias of zero has no place on the axis; the line then starts from below it.
        bias = np.maximum(curve["bias"], 1e-3 * low)
        ax.plot(at, bias, color=colour, marker=marker, markersize=3.5, linewidth=1.4)
    return unseen


def _scale(ax: Axes, values: FloatArray) -> None:
    """Logarithmic, with a place for zero where the axis starts there; ticks at some of the
    values.
    """
    if not len(values):
        return
    if values[0] <= 0.0 and len(values) > 1:
        ax.set_xscale("symlog", linthresh=values[1], linscale=0.4)
        ax.set_xlim(-0.1 * values[1], 1.4 * values[-1])
    else:
        ax.set_xscale("log")
    ticks(ax.xaxis, values.tolist(), values, 5)
    ax.set_xticks([], minor=True)
