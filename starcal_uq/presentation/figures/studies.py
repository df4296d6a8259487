"""Figures of coupling studies: what couples with what, what would decouple it, and at what cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import parameter_called
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import percent, pretty_unit, significant
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, floats
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.coupling import correlation_text
from starcal_uq.presentation.figures.scales import round_levels, symbol, ticks_at_levels
from starcal_uq.presentation.figures.sweeps import (
    MARKERS,
    NAMED,
    colour_of,
    draw_bars,
    draw_lines,
    held_title,
    in_the_middle,
    legend,
    logarithmic,
    nothing,
    numeric,
    plain,
    positions,
    scale,
    short,
    some,
    target_line,
    target_words,
    ticks,
    two_axes,
)
from starcal_uq.presentation.words.axes import axis_label, capital, said, value_words
from starcal_uq.presentation.words.studies import model_bias
from starcal_uq.studies.findings import Lines, Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.studies.result import Study

_MOST_PANELS = 3
# A map of so many cells still shows their numbers.
_MOST_CELLS = 80
# Colours span at least this factor.
_RELIEF = 2.0
_CORRELATION_LEVELS = (-0.99, -0.97, -0.95, -0.9, -0.8, -0.5, 0.0, 0.5, 0.8, 0.9, 0.95, 0.97, 0.99)
_CORRELATION_TICKS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9999, 0.99999)
# Variables that a map or a line may show: words, unit, and whether a small number is good news.
_SHOWN = {
    "correlation": ("correlation of {0} and {1}", ""),
    "sigma": ("sigma of {0}", ""),
    "sigma_conditional": ("sigma of {0}, others known", ""),
    "variance_inflation": ("sigma of {0} / sigma if the others were known", ""),
    "condition_number": ("condition number", ""),
    "weak_variance": ("variance along the weakest direction", ""),
    "frame_error_arcsec": ("error that differs from frame to frame", "arcsec"),
    "common_rotation_arcsec": ("common rotation", "arcsec"),
    "nea_arcsec": ("centroid noise of one frame (NEA)", "arcsec"),
    "frames_needed": ("frames needed", ""),
    "mean_stars": ("stars per frame", ""),
}


def numbers_of(
    study: Study, variable: str, parameter: str | None = None, parameter_2: str | None = None
) -> tuple[FloatArray, str]:
    """A number of every cell as it is drawn (C,), and its label with the unit.

    Errors of attitude are per axis across the boresight; sigmas stand in the units in which
    parameters are printed; the inflation is that of the sigma, the root of the variance's.

    Raises
    ------
    ValueError
        For a variable or a parameter that the study does not have.
    """
    known = [name for name in _SHOWN if name in study.data]
    if variable not in known:
        raise ValueError(f"variable {variable!r} cannot be drawn: use one of {', '.join(known)}.")
    words, unit = _SHOWN[variable]
    for name, wanted in (("parameter", parameter), ("parameter_2", parameter_2)):
        if name in study.data[variable].dims and wanted not in study.parameter_names:
            raise ValueError(f"{variable} needs {name}: one of {', '.join(study.parameter_names)}.")
    numbers = study.values(variable, parameter=parameter, parameter_2=parameter_2, axis="cross")
    if variable == "variance_inflation":
        numbers = np.sqrt(numbers)
    if variable.startswith("sigma") and parameter is not None:
        spec = parameter_called(parameter)
        numbers, unit = numbers / spec.scale, pretty_unit(spec.scaled_unit)
    text = words.format(*map(symbol, filter(None, (parameter, parameter_2))))
    return numbers, f"{text} [{unit}]" if unit else text


def plot_study_correlation(
    study: Study,
    pairs: Sequence[tuple[str, str]] | None = None,
    *,
    along: str | None = None,
    by: str | None = None,
    at: AnyMapping | None = None,
) -> Figure:
    """Size of the correlation of pairs against a swept axis, a line for every value of a second
    one.

    The band is the range over seeds; in a simulated study, bars are the posterior's correlation,
    median and range over seeds. The scale grows towards one as the price in sigma does.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    pairs : sequence of (str, str), optional
        Names of parameters, or of a parameter and pitch, yaw or roll of the common rotation; those
        that are coupled most by default.
    along, by : str, optional
        Axes; the first two that were swept by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.
    """
    sweep = study.sweep
    along, by = two_axes(sweep, along, by)
    chosen = [tuple(pair) for pair in pairs] if pairs is not None else _main_pairs(sweep)
    figure, panels = _row(len(chosen), 2.4, 3.9)
    sampled = "posterior_correlation" in study.data
    top = 0.0
    for ax, (first, second) in zip(panels, chosen, strict=True):
        lines = sweep.lines(_correlation(study, first, second), along, by, at)
        style.dress(ax, grid=True)
        draw_lines(ax, _sizes(lines))
        if sampled and second not in AXES:
            drawn = study.values("posterior_correlation", parameter=first, parameter_2=second)
            draw_bars(ax, _sizes(sweep.lines(drawn, along, by, at)))
        top = max(top, np.nanmax(np.abs([lines.median, lines.low, lines.high]), initial=0.0))
        title = f"{symbol(first)} and {symbol(second)}{_sign_words(lines.median)}"
        style.label(ax, title, axis_label(along))
    style.label(panels[0], y="size of the correlation")
    _correlation_axis(panels[0], top)
    legend(figure, lines, sampled=sampled)
    return figure


def _row(n: int, beside_in: float, height_in: float) -> tuple[Figure, Any]:
    """A figure with panels side by side that share their vertical axis."""
    figure = style.new_figure(beside_in + 2.9 * n, height_in)
    return figure, figure.subplots(1, n, sharey=True, squeeze=False)[0]


def _correlation(study: Study, first: str, second: str) -> FloatArray:
    """Correlation of two parameters, or of a parameter and an axis of the common rotation, of every
    cell.
    """
    names = (*study.parameter_names, *AXES)
    if first not in study.parameter_names or second not in names:
        raise ValueError(
            f"no pair {first}, {second}: name two of {', '.join(names)}, a parameter first."
        )
    if second in AXES:
        return study.values("attitude_correlation", parameter=first, axis=second)
    return study.values("correlation", parameter=first, parameter_2=second)


def _main_pairs(sweep: Sweep) -> list[tuple[str, str]]:
    """The pairs to show where none was named: those that are coupled in most of the sweep, or the
    strongest.
    """
    shown = sorted(sweep.coupled or sweep.pairs[:_MOST_PANELS], key=lambda pair: -pair.mean_size)
    return [pair.names for pair in shown[:_MOST_PANELS]]


def _sign_words(r: FloatArray) -> str:
    signs = np.sign(r[np.abs(np.nan_to_num(r)) > 0.05])
    if not len(signs):
        return ""
    return " (opposite)" if signs.max() < 0 else " (alike)" if signs.min() > 0 else ""


def _sizes(lines: Lines) -> Lines:
    """Absolute values, the range over seeds with them."""
    low, high = np.sort(np.abs([lines.low, lines.high]), axis=0)
    low[lines.low * lines.high < 0.0] = 0.0
    return replace(lines, median=np.abs(lines.median), low=low, high=high)


def _correlation_axis(ax: Axes, top: float) -> None:
    """From zero to above the largest correlation, on the scale of Fisher's z."""
    top = min(max(top, 0.3), 0.999999)
    limit = np.tanh(np.arctanh(top) * 1.06 + 0.05)
    ax.set_yscale("function", functions=(_to_z, np.tanh))
    ax.set_ylim(0.0, limit)
    ticks = _CORRELATION_TICKS if limit > 0.6 else (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    ax.set_yticks([tick for tick in ticks if tick < limit])
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.minorticks_off()


def _to_z(r: FloatArray) -> FloatArray:
    return np.asarray(np.arctanh(np.clip(r, -1.0 + 1e-12, 1.0 - 1e-12)))


def plot_study_map(
    study: Study,
    variable: str = "frame_error_arcsec",
    *,
    parameter: str | None = None,
    parameter_2: str | None = None,
    x: str | None = None,
    y: str | None = None,
    at: AnyMapping | None = None,
    ax: Axes | None = None,
) -> Axes:
    """A number over two axes, median over seeds: cells with their numbers, or contours where they
    are many.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    variable : str
        A variable of the study's data: ``sigma``, ``correlation``, ``variance_inflation``,
        ``condition_number``, ``frame_error_arcsec``, ``common_rotation_arcsec``, ``nea_arcsec``,
        ``frames_needed``, ``mean_stars``.
    parameter, parameter_2 : str, optional
        For variables of a parameter or of a pair.
    x, y : str, optional
        Axes; the first two that were swept by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.
    ax : Axes, optional
        Where to draw; a new figure if not given.

    Raises
    ------
    ValueError
        For a study of fewer than two axes, or a name that it does not have.
    """
    x, y = two_axes(study.sweep, x, y, lines=False)
    if y is None:
        raise ValueError("a map needs two swept axes.")
    numbers, text = numbers_of(study, variable, parameter, parameter_2)
    if ax is None:
        ax = style.new_axes(5.6, 4.2)
    lines = study.sweep.lines(numbers, x, y, at)
    style.label(ax, capital(text), axis_label(x), axis_label(y))
    style.dress(ax)
    many = min(lines.median.shape) >= 6 and lines.median.size > _MOST_CELLS
    if not np.isfinite(lines.median).any():
        nothing(ax)
    elif many and numeric(lines.values) and numeric(lines.by_values):
        _contours(ax, lines, variable)
    else:
        _cells(ax, lines, variable)
    return ax


def _cells(ax: Axes, lines: Lines, variable: str) -> None:
    """One square a cell, with its number."""
    z = np.where(np.isfinite(lines.median), lines.median, np.nan)
    colours, norm, dark = _colours(z, variable)
    ax.imshow(z, cmap=colours, norm=norm, origin="lower", aspect="auto")
    n_y, n_x = z.shape
    ticks(ax.xaxis, lines.values, np.arange(n_x))
    ticks(ax.yaxis, lines.by_values, np.arange(n_y))
    style.squares(ax, n_x, n_y, 1.4)
    size = style.TICK_SIZE if n_x <= 7 else style.TICK_SIZE - 1.5
    for (row, column), value in np.ndenumerate(lines.median):
        text = "–" if np.isnan(value) else _written(variable)(value)
        colour = style.GREY if np.isnan(value) else style.INK
        if np.isfinite(value) and dark(value):
            colour = "white"
        style.in_cell(ax, text, row, column, fontsize=size, color=colour)


def _written(variable: str) -> Callable[[float], str]:
    """How a number of a map is written."""
    return correlation_text if variable == "correlation" else short


def _contours(ax: Axes, lines: Lines, variable: str) -> None:
    """Colours on true scales, with contours that carry their numbers."""
    x, y = (floats(values) for values in (lines.values, lines.by_values))
    z = np.ma.masked_invalid(lines.median)
    scale(ax.xaxis, lines.values)
    scale(ax.yaxis, lines.by_values)
    colours, norm, _ = _colours(lines.median, variable)
    levels, _ = round_levels(z.compressed())
    image = ax.pcolormesh(
        x, y, z, cmap=colours, norm=norm, shading="nearest" if z.mask.any() else "gouraud"
    )
    bar = style.colour_bar(ax, image, "")
    low, high = z.min(), z.max()
    if variable == "correlation":
        levels = np.array(_CORRELATION_LEVELS)
        shown = levels[(levels > low) & (levels < high)]
    else:
        least, most = np.ravel([image.norm.vmin, image.norm.vmax])
        ticks_at_levels(bar, levels[(levels >= least) & (levels <= most)])
        # Contours of little relief would be those of chance.
        shown = levels[1:-1][:: max(1, len(levels) // 6)] if high > 1.3 * low else levels[:0]
    if not len(shown):
        in_the_middle(ax, " to ".join(map(_written(variable), (low, high))), "white")
        return
    from matplotlib.patheffects import withStroke

    drawn = ax.contour(x, y, z, levels=shown, colors="white", linewidths=1.0, linestyles="solid")
    for text in ax.clabel(drawn, fmt=lambda value: f"{value:.3g}", fontsize=style.TICK_SIZE):
        text.set_path_effects([withStroke(linewidth=2.0, foreground=style.INK)])


def _colours(z: FloatArray, variable: str) -> tuple[str, Any, Any]:
    """Colour map, its norm, and whether a value is dark enough for white words."""
    from matplotlib.colors import LogNorm, Normalize

    good = z[np.isfinite(z)]
    if variable == "correlation":
        return "RdBu_r", Normalize(-1.0, 1.0), lambda value: abs(value) > 0.62
    low, high = good.min(), good.max()
    if low > 0.0 and high < _RELIEF * low:
        # Little relief gets little colour, so that chance does not look like a finding.
        middle = np.sqrt(low * high)
        low, high = middle / np.sqrt(_RELIEF), middle * np.sqrt(_RELIEF)
    norm = LogNorm(low, high) if low > 0.0 and high > 5.0 * low else Normalize(low, high)
    return "cividis_r", norm, lambda value: float(norm(value)) > 0.55


def plot_study_maps(study: Study, x: str | None = None, y: str | None = None) -> Figure:
    """Four maps over two axes: the coupling that changes most, the largest inflation, and both
    attitude errors.
    """
    sweep = study.sweep
    x, y = two_axes(sweep, x, y, lines=False)
    if y is None:
        raise ValueError("maps need two swept axes.")
    changing = max(
        sweep.coupled or sweep.pairs[:1],
        key=lambda pair: max((c.change for c in pair.costs), default=0.0),
    )
    first, second = changing.names
    figure = style.new_figure(11.0, 2.2 + 0.72 * max(5, min(10, len(sweep.values[y]))))
    inflated = _most_inflated(study)
    for ax, variable, parameter, other in zip(
        figure.subplots(2, 2).ravel(),
        *(("correlation", "variance_inflation", "frame_error_arcsec", "common_rotation_arcsec"),),
        *((first, inflated, None, None), (second, None, None, None)),
        strict=True,
    ):
        plot_study_map(study, variable, parameter=parameter, parameter_2=other, x=x, y=y, ax=ax)
    held_title(figure, sweep.held(x, y))
    return figure


def _most_inflated(study: Study) -> str:
    """The parameter whose sigma the others inflate most, over the whole sweep."""
    factors = np.where(study.sweep.ok[:, None], study.data["variance_inflation"].values, np.nan)
    return study.parameter_names[int(np.argmax(np.nan_to_num(np.sqrt(factors)).sum(axis=0)))]


def plot_weakest(
    study: Study,
    *,
    along: str | None = None,
    by: str | None = None,
    at: AnyMapping | None = None,
) -> Figure:
    """What the weakest direction is made of along an axis, for up to three values of a second one.

    The direction is the combination of parameters, each in its own sigma, that the data determine
    worst; shares are the squares of its entries, and the numbers above the bars its variance over
    that of uncoupled parameters.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    along, by : str, optional
        Axes; the first two that were swept by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.
    """
    sweep = study.sweep
    along, by = two_axes(sweep, along, by, names=True)
    shares = study.data["weak_direction"].values ** 2
    variance = sweep.lines(study.data["weak_variance"].values, along, by, at)
    rows = some(len(variance.median), _MOST_PANELS)
    figure, panels = _row(len(rows), 2.2, 3.8)
    places = np.arange(len(variance.values))
    names = study.parameter_names
    stack = np.array([sweep.lines(one, along, by, at).median for one in shares.T])
    total = np.nansum(stack, axis=0)
    parts = np.nan_to_num(stack / np.where(total > 0.0, total, np.nan))
    for ax, row in zip(panels, rows, strict=True):
        style.dress(ax)
        below = np.zeros(len(places))
        look: AnyDict = {"edgecolor": "white", "linewidth": 0.8}
        for name, height in zip(names, parts[:, row], strict=True):
            ax.bar(places, height, 0.78, bottom=below, color=colour_of(name), **look)
            below = below + height
        for at_x, value in zip(places, variance.median[row], strict=True):
            words = "–" if np.isnan(value) else f"×{significant(value)}"
            size = style.TICK_SIZE - 0.5
            style.note(ax, words, (at_x, 1.02), ha="center", va="bottom", fontsize=size)
        ax.set_ylim(0.0, 1.12)
        ax.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0], ["0", "25 %", "50 %", "75 %", "100 %"])
        ticks(ax.xaxis, variance.values, places)
        style.label(ax, _by_title(variance, row), axis_label(along))
    style.label(panels[0], y="share of the weakest direction")
    handles = [style.key(symbol(name), colour_of(name), linewidth=7.0) for name in names]
    style.legend_above(figure, handles)
    return figure


def _by_title(lines: Lines, row: int) -> str:
    """The value of the second axis, above a panel."""
    return "" if lines.by is None else capital(said(lines.by, lines.by_values[row]))


def plot_matrices(
    study: Study,
    *,
    along: str | None = None,
    by: str | None = None,
    at: AnyMapping | None = None,
) -> Figure:
    """The correlation matrix along an axis, and down a second one, median over seeds.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    along, by : str, optional
        Axes; the first two that were swept by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.
    """
    sweep = study.sweep
    along, by = two_axes(sweep, along, by, names=True)
    names = study.parameter_names
    r = study.data["correlation"].values
    p = len(names)
    lines = [sweep.lines(one, along, by, at) for one in r.reshape(-1, p * p).T]
    grid = np.array([entry.median for entry in lines]).reshape(p, p, *lines[0].median.shape)
    columns, rows = some(grid.shape[3], 5), some(grid.shape[2], _MOST_PANELS)
    figure = style.new_figure(11.0, 0.9 + 1.9 * len(rows))
    panels = style.panels(figure, len(rows), len(columns), (0.95, 0.8, 0.58, 0.32), (0.12, 0.12))
    for row, at_row in enumerate(rows):
        for column, at_column in enumerate(columns):
            ax = figure.add_subplot(panels[row, column])
            image = _matrix(ax, grid[:, :, at_row, at_column], names, row == 0, column == 0)
            if column == 0 and by is not None:
                style.label(ax, y=value_words(lines[0].by_values[at_row]))
            if row == len(rows) - 1:
                style.label(ax, x=value_words(lines[0].values[at_column]))
    figure.supxlabel(axis_label(along), fontsize=style.LABEL_SIZE, color=style.INK, y=0.01)
    if by is not None:
        figure.supylabel(axis_label(by), fontsize=style.LABEL_SIZE, color=style.INK, x=0.005)
    bar = figure.colorbar(image, cax=figure.add_axes((0.945, 0.2, 0.012, 0.6)))
    style.dress_bar(bar, "correlation")
    return figure


def _matrix(ax: Axes, matrix: FloatArray, names: Sequence[str], top: bool, left: bool) -> Any:
    ax.set_facecolor(style.LIGHT)
    # The diagonal says nothing.
    matrix = np.where(np.eye(len(names), dtype=np.bool_), np.nan, matrix)
    image = ax.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    ticks = np.arange(len(names))
    words = [symbol(name) for name in names]
    ax.set_xticks(ticks, words if top else [], fontsize=style.TICK_SIZE)
    ax.set_yticks(ticks, words if left else [], fontsize=style.TICK_SIZE)
    ax.tick_params(top=False, labeltop=top, bottom=False, labelbottom=False, colors=style.INK)
    style.squares(ax, len(names), len(names), 1.0)
    if len(names) <= 5:
        for (i, j), value in np.ndenumerate(matrix):
            if np.isfinite(value):
                colour = "white" if abs(value) > 0.62 else style.INK
                style.in_cell(ax, correlation_text(value), i, j, fontsize=6.5, color=colour)
    return image


def plot_needed(
    study: Study,
    *,
    along: str | None = None,
    by: str | None = None,
    target_arcsec: float | None = None,
    at: AnyMapping | None = None,
) -> Figure:
    """Frame-dependent attitude error along an axis with its target, and the frames that the target
    takes.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    along, by : str, optional
        Axes; the first two that were swept by default.
    target_arcsec : float, optional
        1 sigma per axis across the boresight; the study's own by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.
    """
    sweep = study.sweep
    along, by = two_axes(sweep, along, by)
    target = study.definition.target_arcsec if target_arcsec is None else target_arcsec
    n = 1 if target is None else 2
    figure = style.new_figure(5.8 * n, 4.0)
    panels = figure.subplots(1, n, squeeze=False)[0]
    lines = sweep.lines(sweep.frame_error, along, by, at)
    _line_panel(panels[0], lines)
    title = "Error that differs from frame to frame"
    style.label(panels[0], title, axis_label(along), "1 sigma per axis [arcsec]")
    if target is not None:
        low, high = panels[0].get_ylim()
        panels[0].set_ylim(min(low, target / 1.5), max(high, target * 1.5))
        plain(panels[0].yaxis)
        target_line(panels[0], target)
        ground = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8}
        target_words(panels[0], target, f"target {target:g} arcsec", bbox=ground)
        _line_panel(panels[1], sweep.lines(study.frames_for(target), along, by, at))
        style.label(panels[1], f"Frames for {target:g} arcsec", axis_label(along), "frames")
    legend(figure, lines)
    return figure


def _line_panel(ax: Axes, lines: Lines, dashed: Lines | None = None) -> None:
    """Lines on a logarithmic axis."""
    style.dress(ax, grid=True)
    draw_lines(ax, lines)
    if dashed is not None:
        draw_lines(ax, dashed, dashed=True)
    logarithmic(ax, lines, *filter(None, [dashed]))


def plot_inflation(
    study: Study,
    *,
    along: str | None = None,
    by: str | None = None,
    at: AnyMapping | None = None,
) -> Figure:
    """Sigma of every parameter along an axis, with all others unknown and, dashed, with all others
    known.

    The gap between both is the price of coupling.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    along, by : str, optional
        Axes; the first two that were swept by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.
    """
    sweep = study.sweep
    along, by = two_axes(sweep, along, by)
    names = study.parameter_names
    columns = len(names) if len(names) <= 3 else -(-len(names) // 2)
    rows = -(-len(names) // columns)
    figure = style.new_figure(11.0, 0.8 + 2.75 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, name in zip(panels, names, strict=False):
        numbers, text = numbers_of(study, "sigma", name)
        known, _ = numbers_of(study, "sigma_conditional", name)
        lines = sweep.lines(numbers, along, by, at)
        _line_panel(ax, lines, sweep.lines(known, along, by, at))
        style.label(ax, capital(text), axis_label(along))
    for ax in panels[len(names) :]:
        ax.set_visible(False)
    legend(figure, lines, dashed="all others known")
    return figure


def plot_simpler(
    study: Study,
    *,
    along: str | None = None,
    by: str | None = None,
    at: AnyMapping | None = None,
) -> Figure:
    """Attitude error that a simpler distortion model would leave, beside the error of the
    calibration itself.

    Where a model's line lies below the grey one, that model is rich enough.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    along, by : str, optional
        Axes; the first two that were swept by default.
    at : dict, optional
        Values at which other axes are held, their middle ones by default.

    Raises
    ------
    ValueError
        For a study in which no simpler model was tried.
    """
    models = list(map(str, study.data["simpler"].values)) if "simpler" in study.data else []
    bias = {model: model_bias(study, model) for model in models}
    # A model that leaves out zeros alone was not tried.
    bias = {model: left for model, left in bias.items() if np.any(np.nan_to_num(left) > 0.0)}
    if not bias:
        raise ValueError("no simpler distortion model was tried in this study.")
    sweep = study.sweep
    along, by = two_axes(sweep, along, by)
    error = sweep.lines(sweep.frame_error, along, by, at)
    curves = [sweep.lines(left, along, by, at) for left in bias.values()]
    looks = [
        (NAMED[n % 5], {"marker": MARKERS[n % 5], "markersize": 4.5}) for n in range(len(bias))
    ]
    rows = some(len(error.median), _MOST_PANELS)
    figure, panels = _row(len(rows), 2.2, 3.9)
    x = positions(error.values)
    for ax, row in zip(panels, rows, strict=True):
        style.dress(ax, grid=True)
        style.band(ax, x, error.low[row], error.high[row], style.GREY, alpha=0.25)
        ax.plot(x, error.median[row], color=style.GREY, linewidth=2.2)
        for curve, (colour, look) in zip(curves, looks, strict=True):
            ax.plot(x, curve.median[row], color=colour, **look)
        scale(ax.xaxis, error.values)
        style.label(ax, _by_title(error, row), axis_label(along))
    logarithmic(panels[0], error, *curves)
    style.label(panels[0], y="arcsec")
    keys = [
        style.key(f"left by the model {model}", colour, **look)
        for model, (colour, look) in zip(bias, looks, strict=True)
    ]
    style.legend_above(
        figure, [style.key("error of the calibration", style.GREY, linewidth=2.2), *keys]
    )
    return figure


def plot_coverage(study: Study, *, along: str | None = None) -> Figure:
    """Part of the simulated cells whose 95 % interval holds the truth, with exact 95 % bounds of
    that part.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study` in the mode ``simulate``.
    along : str, optional
        Axis; the first that was swept by default.

    Raises
    ------
    ValueError
        For a study that was not simulated.
    """
    if "covered_95" not in study.data:
        raise ValueError('coverage needs simulated cells: set mode = "simulate" in [study].')
    sweep = study.sweep
    along, _ = two_axes(sweep, along, None)
    covered = study.data["covered_95"].values
    others = [axis for axis in sweep.axes if axis != along]
    figure = style.new_figure(8.6, 4.0)
    ax = style.dress(figure.subplots(), grid=True)
    places = np.arange(len(sweep.values[along]))
    names = study.parameter_names
    lowest = 0.9
    for i, name in enumerate(names):
        n, rate = (sweep.over(covered[:, i], what, others).ravel() for what in ("count", "mean"))
        shift = 0.62 * ((i + 0.5) / len(names) - 0.5)
        for at_x, part, size in zip(places + shift, rate, n, strict=True):
            if np.isfinite(part):
                low, high = binomial_interval(round(part * size), int(size))
                ax.vlines(at_x, low, high, color=colour_of(name), linewidth=1.4)
                ax.plot(at_x, part, marker="o", markersize=6, color=colour_of(name))
                lowest = min(lowest, low)
    ax.axhline(0.95, color=style.INK, linewidth=0.9)
    ticks(ax.xaxis, sweep.values[along], places)
    ax.set_ylim(max(0.0, lowest - 0.06), 1.015)
    ax.yaxis.set_major_formatter(lambda value, _: percent(value))
    style.label(ax, "", axis_label(along), "95 % intervals that hold the truth")
    dots: AnyDict = {"marker": "o", "markersize": 6}
    style.legend_above(figure, [style.key(symbol(name), colour_of(name), **dots) for name in names])
    return figure
