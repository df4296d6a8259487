"""Figures of coupling studies: small multiples along a swept axis, and maps over two."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

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
    Panel,
    colour_of,
    draw_bars,
    held_title,
    legend,
    numeric,
    plain,
    row_of_panels,
    scale,
    short,
    small_multiples,
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
    chosen = _main_pairs(sweep) if pairs is None else pairs
    values = [_correlation(study, *pair) for pair in chosen]
    titles = [
        f"{symbol(first)} and {symbol(second)}{_sign_words(r[sweep.ok])}"
        for (first, second), r in zip(chosen, values, strict=True)
    ]
    panels = [Panel(title, np.abs(r)) for title, r in zip(titles, values, strict=True)]
    figure, axes, lines = small_multiples(sweep, panels, along, by, at, log=False, sharey=True)
    sampled = "posterior_correlation" in study.data
    if sampled:
        for ax, (first, second) in zip(axes, chosen, strict=True):
            if second not in AXES:
                r = study.values("posterior_correlation", parameter=first, parameter_2=second)
                draw_bars(ax, sweep.lines(np.abs(r), along, by, at))
    style.label(axes[0], y="size of the correlation")
    top = np.nanmax(np.concatenate([[0.3], *[np.ravel(line.high) for line in lines]]))
    _correlation_axis(axes[0], float(top))
    legend(figure, lines[0], sampled=sampled)
    return figure


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
    """The pairs that are coupled in most of the sweep, or the strongest."""
    shown = sorted(sweep.coupled or sweep.pairs[:_MOST_PANELS], key=lambda pair: -pair.mean_size)
    return [pair.names for pair in shown[:_MOST_PANELS]]


def _sign_words(r: FloatArray) -> str:
    signs = np.sign(r[np.abs(np.nan_to_num(r)) > 0.05])
    if not len(signs) or signs.min() != signs.max():
        return ""
    return " (opposite)" if signs[0] < 0 else " (alike)"


def _correlation_axis(ax: Axes, top: float) -> None:
    """From zero to above the largest correlation, on the scale of Fisher's z."""
    limit = np.tanh(np.arctanh(min(top, 0.999999)) * 1.06 + 0.05)
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
    if many and numeric(lines.values) and numeric(lines.by_values):
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
    x, y, z = floats(lines.values), floats(lines.by_values), np.ma.masked_invalid(lines.median)
    scale(ax.xaxis, lines.values)
    scale(ax.yaxis, lines.by_values)
    colours, norm, _ = _colours(lines.median, variable)
    shading: Literal["nearest", "gouraud"] = "nearest" if z.mask.any() else "gouraud"
    image = ax.pcolormesh(x, y, z, cmap=colours, norm=norm, shading=shading)
    bar = style.colour_bar(ax, image, "")
    levels, _ = round_levels(z.compressed())
    levels = levels[(levels >= z.min()) & (levels <= z.max())]
    # Contours of little relief would be those of chance.
    if z.max() - z.min() < (0.1 if variable == "correlation" else 0.25 * z.max()):
        ends = " to ".join(map(_written(variable), (z.min(), z.max())))
        style.note(ax, ends, (0.5, 0.5), xycoords="axes fraction", ha="center")
        return
    if variable != "correlation":
        ticks_at_levels(bar, levels)
    look: AnyDict = {"colors": "white", "linewidths": 1.0, "linestyles": "solid"}
    drawn = ax.contour(x, y, z, levels=levels[:: max(1, len(levels) // 6)], **look)
    ax.clabel(drawn, fmt=lambda value: f"{value:.3g}", fontsize=style.TICK_SIZE)


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
    inflation = np.nan_to_num(np.sqrt(study.data["variance_inflation"].values[sweep.ok]))
    inflated = study.parameter_names[int(np.argmax(inflation.sum(axis=0)))]
    figure = style.new_figure(11.0, 2.2 + 0.72 * max(5, min(10, len(sweep.values[y]))))
    shown = (
        ("correlation", *changing.names),
        ("variance_inflation", inflated, None),
        ("frame_error_arcsec", None, None),
        ("common_rotation_arcsec", None, None),
    )
    for ax, (variable, parameter, other) in zip(figure.subplots(2, 2).flat, shown, strict=True):
        plot_study_map(study, variable, parameter=parameter, parameter_2=other, x=x, y=y, ax=ax)
    held_title(figure, sweep.held(x, y))
    return figure


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
    variance = sweep.lines(study.data["weak_variance"].values, along, by, at)
    names, weights = study.parameter_names, study.data["weak_direction"].values
    stack = np.array([sweep.lines(one**2, along, by, at).median for one in weights.T])
    total = np.nansum(stack, axis=0)
    parts = np.nan_to_num(stack / np.where(total > 0.0, total, np.nan))
    rows = some(len(variance.median), _MOST_PANELS)
    figure, panels = row_of_panels(len(rows), 3.8)
    places = np.arange(len(variance.values))
    small: AnyDict = {"ha": "center", "va": "bottom", "fontsize": style.TICK_SIZE - 0.5}
    for ax, row in zip(panels, rows, strict=True):
        style.dress(ax)
        below = np.cumsum(parts[:, row], axis=0) - parts[:, row]
        for name, height, bottom in zip(names, parts[:, row], below, strict=True):
            ax.bar(places, height, 0.78, bottom=bottom, color=colour_of(name), edgecolor="white")
        for place, value in zip(places, variance.median[row], strict=True):
            words = "–" if np.isnan(value) else f"×{significant(value)}"
            style.note(ax, words, (place, 1.02), **small)
        ax.set_ylim(0.0, 1.12)
        ax.yaxis.set_major_formatter(lambda value, _: percent(value) if value <= 1.0 else "")
        ticks(ax.xaxis, variance.values, places)
        title = "" if by is None else capital(said(by, variance.by_values[row]))
        style.label(ax, title, axis_label(along))
    style.label(panels[0], y="share of the weakest direction")
    handles = [style.key(symbol(name), colour_of(name), linewidth=7.0) for name in names]
    style.legend_above(figure, handles)
    return figure


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
    names, r = study.parameter_names, study.data["correlation"].values
    p = len(names)
    lines = [sweep.lines(one, along, by, at) for one in r.reshape(-1, p * p).T]
    grid = np.array([entry.median for entry in lines]).reshape(p, p, *lines[0].median.shape)
    columns, rows = some(grid.shape[3], 5), some(grid.shape[2], _MOST_PANELS)
    figure = style.new_figure(11.0, 0.9 + 1.9 * len(rows))
    panels = style.panels(figure, len(rows), len(columns), (0.95, 0.8, 0.58, 0.32), (0.12, 0.12))
    axes = panels.subplots(sharex=True, sharey=True, squeeze=False)
    for (row, column), ax in np.ndenumerate(axes):
        image = _matrix(ax, grid[:, :, rows[row], columns[column]], names)
        ax.tick_params(labeltop=row == 0, labelbottom=False, labelleft=column == 0)
    for row, ax in zip(rows, axes[:, 0], strict=True):
        style.label(ax, y="" if by is None else value_words(lines[0].by_values[row]))
    for column, ax in zip(columns, axes[-1], strict=True):
        style.label(ax, x=value_words(lines[0].values[column]))
    look: AnyDict = {"fontsize": style.LABEL_SIZE, "color": style.INK}
    figure.supxlabel(axis_label(along), y=0.01, **look)
    figure.supylabel("" if by is None else axis_label(by), x=0.005, **look)
    bar = figure.colorbar(image, cax=figure.add_axes((0.945, 0.2, 0.012, 0.6)))
    style.dress_bar(bar, "correlation")
    return figure


def _matrix(ax: Axes, matrix: FloatArray, names: Sequence[str]) -> Any:
    ax.set_facecolor(style.LIGHT)
    # The diagonal says nothing.
    matrix = np.where(np.eye(len(names), dtype=np.bool_), np.nan, matrix)
    image = ax.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    words = [symbol(name) for name in names]
    ax.set_xticks(range(len(names)), words, fontsize=style.TICK_SIZE)
    ax.set_yticks(range(len(names)), words, fontsize=style.TICK_SIZE)
    ax.tick_params(colors=style.INK)
    style.squares(ax, len(names), len(names), 1.0)
    for (i, j), value in np.ndenumerate(matrix):
        if np.isfinite(value) and len(names) <= 5:
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
    title = "Error that differs from frame to frame, 1 sigma per axis [arcsec]"
    panels = [Panel(title, sweep.frame_error)]
    if target is not None:
        panels.append(Panel(f"Frames for {target:g} arcsec", study.frames_for(target)))
    figure, axes, lines = small_multiples(sweep, panels, along, by, at, wide=2.0)
    if target is not None:
        low, high = axes[0].get_ylim()
        axes[0].set_ylim(min(low, target / 1.5), max(high, target * 1.5))
        plain(axes[0].yaxis)
        target_line(axes[0], target)
        ground = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8}
        target_words(axes[0], target, f"target {target:g} arcsec", bbox=ground)
    legend(figure, lines[0])
    return figure


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
    along, by = two_axes(study.sweep, along, by)
    panels = []
    for name in study.parameter_names:
        numbers, text = numbers_of(study, "sigma", name)
        known, _ = numbers_of(study, "sigma_conditional", name)
        panels.append(Panel(capital(text), numbers, known))
    columns = len(panels) if len(panels) <= 3 else -(-len(panels) // 2)
    figure, _, lines = small_multiples(study.sweep, panels, along, by, at, columns=columns)
    legend(figure, lines[0], dashed="all others known")
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

    Where a full line lies below the dashed one of its colour, that model is rich enough.

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
    sweep = study.sweep
    # A model that leaves out zeros alone was not tried.
    panels = [
        Panel(f"Left by the model {model} [arcsec]", left, sweep.frame_error)
        for model, left in bias.items()
        if np.any(np.nan_to_num(left) > 0.0)
    ]
    if not panels:
        raise ValueError("no simpler distortion model was tried in this study.")
    along, by = two_axes(sweep, along, by)
    figure, _, lines = small_multiples(sweep, panels, along, by, at, sharey=True)
    legend(figure, lines[0], dashed="error of the calibration")
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
    ax = style.dress(style.new_figure(8.6, 4.0).subplots(), grid=True)
    places = np.arange(len(sweep.values[along]))
    names = study.parameter_names
    dots: AnyDict = {"marker": "o", "markersize": 6, "linestyle": "none"}
    for i, name in enumerate(names):
        covered = study.values("covered_95", parameter=name)
        n, rate = (sweep.pooled(covered, along, statistic=what) for what in ("count", "mean"))
        seen = np.isfinite(rate)
        hits = np.round(rate[seen] * n[seen]).astype(int)
        x = places[seen] + 0.62 * ((i + 0.5) / len(names) - 0.5)
        ends = [binomial_interval(*pair) for pair in zip(hits, n[seen].astype(int), strict=True)]
        ax.vlines(x, *np.transpose(ends), color=colour_of(name), linewidth=1.4)
        ax.plot(x, rate[seen], color=colour_of(name), label=symbol(name), **dots)
    ax.axhline(0.95, color=style.INK, linewidth=0.9)
    ticks(ax.xaxis, sweep.values[along], places)
    ax.set_ylim(max(0.0, min(0.9, ax.dataLim.y0) - 0.06), 1.015)
    ax.yaxis.set_major_formatter(lambda value, _: percent(value))
    style.label(ax, "", axis_label(along), "95 % intervals that hold the truth")
    figure = style.figure_of(ax)
    style.legend_above(figure, ax.get_legend_handles_labels()[0])
    return figure
