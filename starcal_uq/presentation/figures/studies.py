"""Figures of coupling studies: small multiples along a swept axis, and maps over two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import parameter_called
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import pretty_unit
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.coupling import heat_map
from starcal_uq.presentation.figures.scales import symbol
from starcal_uq.presentation.figures.sweeps import (
    held_title,
    plain,
    plot_swept,
    short,
    small_multiples,
    some,
    target_line,
    ticks,
    two_axes,
)
from starcal_uq.presentation.words.axes import axis_label, value_words
from starcal_uq.presentation.words.numbers import capital, correlation_text
from starcal_uq.presentation.words.studies import best_axis, model_bias, simpler_models
from starcal_uq.propagation.coupling import PART

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
    **where: Any,
) -> Figure:
    """Size of the correlation of pairs against a swept axis, a line for every value of a second
    one.

    The band is the range over seeds; in a simulated study, dashed lines are the posterior's
    correlation, median over seeds. The scale grows towards one as the price in sigma does.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    pairs : sequence of (str, str), optional
        Names of parameters, or of a parameter and pitch, yaw or roll of the common rotation; those
        that are coupled most by default.
    **where
        ``along`` and ``by``, names of axes, the first two that were swept by default; and ``at``, values
        at which other axes are held, their middle ones by default.
    """
    sweep = study.sweep
    if pairs is None:
        # The pairs that are coupled in most of the sweep, or the strongest.
        main = sorted(sweep.coupled or sweep.pairs[:_MOST_PANELS], key=lambda pair: -pair.mean_size)
        pairs = [pair.names for pair in main[:_MOST_PANELS]]
    panels, posterior = {}, {}
    for first, second in pairs:
        r = _correlation(study, first, second)
        title = f"{symbol(first)} and {symbol(second)}{_sign_words(r[sweep.ok])}"
        panels[title] = np.abs(r)
        if "posterior_correlation" in study.data and second not in AXES:
            r = study.values("posterior_correlation", parameter=first, parameter_2=second)
            posterior[title] = np.abs(r)
    look: AnyDict = {"log": False, "sharey": True, "dashed": "posterior"}
    figure, axes = plot_swept(sweep, panels, posterior, **where, **look)
    style.label(axes[0], y="size of the correlation")
    drawn = [*panels.values(), *posterior.values()]
    _correlation_axis(axes[0], max(float(np.nanmax(r[sweep.ok])) for r in drawn))
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


def _sign_words(r: FloatArray) -> str:
    signs = set(np.sign(r[np.abs(r) > 0.05]))
    return {(-1.0,): " (opposite)", (1.0,): " (alike)"}.get(tuple(signs), "")


def _correlation_axis(ax: Axes, top: float) -> None:
    """From zero to above the largest correlation, on the scale of Fisher's z."""
    limit = np.tanh(np.arctanh(min(max(top, 0.3), 0.999999)) * 1.06 + 0.05)
    ax.set_yscale("function", functions=(_to_z, np.tanh))
    ax.set_ylim(0.0, limit)
    marks = _CORRELATION_TICKS if limit > 0.6 else np.arange(0.0, 0.6, 0.1)
    ax.set_yticks([mark for mark in marks if mark < limit])
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
    """A number over two axes, median over seeds: cells with their numbers, or with a colour bar
    where they are many.

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
    ax = style.panel(ax, 5.6, 4.2)
    median = study.sweep.lines(numbers, x, y, at)["median"]
    z = np.where(np.isfinite(median), median, np.nan)
    style.label(ax, capital(text), axis_label(x), axis_label(y))
    n_y, n_x = z.shape
    ticks(ax.xaxis, median[x].values.tolist(), np.arange(n_x, dtype=np.float64))
    ticks(ax.yaxis, median[y].values.tolist(), np.arange(n_y, dtype=np.float64))
    style.squares(ax, n_x, n_y, 1.4)
    of_pair = variable == "correlation"
    colours, norm = _colours(z, of_pair)
    image = ax.imshow(z, cmap=colours, norm=norm, origin="lower", aspect="auto")
    if z.size > _MOST_CELLS:
        style.colour_bar(ax, image, "")
        return ax
    size = style.TICK_SIZE if n_x <= 7 else style.TICK_SIZE - 1.5
    for (row, column), value in np.ndenumerate(z):
        dark = abs(value) > 0.62 if of_pair else norm(value) > 0.55
        words = (correlation_text if of_pair else short)(value) if np.isfinite(value) else "–"
        look: AnyDict = {"fontsize": size, "color": "white" if dark else style.INK}
        style.in_cell(ax, words, row, column, **look)
    return ax


def _colours(z: FloatArray, of_pair: bool) -> tuple[str, Any]:
    """Colour map and its norm."""
    from matplotlib.colors import LogNorm, Normalize

    if of_pair:
        return "RdBu_r", Normalize(-1.0, 1.0)
    low, high = np.nanmin(z), np.nanmax(z)
    if low > 0.0 and high < _RELIEF * low:
        # Little relief gets little colour, so that chance does not look like a finding.
        middle = np.sqrt(low * high)
        low, high = middle / np.sqrt(_RELIEF), middle * np.sqrt(_RELIEF)
    return "cividis_r", (LogNorm if 5.0 * low < high and low > 0.0 else Normalize)(low, high)


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
    inflation = study.data["variance_inflation"][sweep.ok].fillna(0.0).sum("cell")
    inflated = study.parameter_names[int(np.argmax(inflation.values))]
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
    **where: Any,
) -> Figure:
    """What the weakest direction is made of along an axis, and its variance, a line for every value
    of a second one.

    The direction is the combination of parameters, each in its own sigma, that the data determine
    worst; shares are the squares of its entries, and its variance is relative to that of uncoupled
    parameters.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    **where
        ``along`` and ``by``, names of axes, the first two that were swept by default; and ``at``, values
        at which other axes are held, their middle ones by default.
    """
    panels = {"Variance along it / of uncoupled ones": study.values("weak_variance")}
    for name in study.parameter_names:
        share = study.values("weak_direction", parameter=name) ** 2
        if np.nanmax(share) >= PART**2:
            panels[f"Share of {symbol(name)} [%]"] = 100.0 * share
    figure, axes = plot_swept(study.sweep, panels, **where, log=False)
    for ax in axes[1:]:
        ax.set_ylim(0.0, 105.0)
    axes[0].set_ylim(0.0)
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
    import xarray as xr

    along, by = two_axes(study.sweep, along, by)
    names, sweep = study.parameter_names, study.sweep
    held = sweep.held(along, by, at)
    dims = [along] if by is None else [by, along]
    entries = study.data["correlation"].values.reshape(study.n_cells, -1).T
    data = xr.concat([sweep.over(r, dims=dims, at=held) for r in entries], "entry")
    data = data.expand_dims(line=[""]) if by is None else data.rename({by: "line"})
    columns, rows = some(data.sizes[along], 5), some(data.sizes["line"], _MOST_PANELS)
    figure = style.new_figure(11.0, 1.1 + 1.9 * len(rows))
    axes = figure.subplots(len(rows), len(columns), sharex=True, sharey=True, squeeze=False)
    for (i, j), ax in np.ndenumerate(axes):
        one = data.isel({"line": rows[i], along: columns[j]})
        image = heat_map(ax, one.values.reshape(len(names), -1), names, small=True)
        style.label(ax, x=value_words(one[along].item()), y=value_words(one["line"].item()))
        ax.label_outer()
    look: AnyDict = {"fontsize": style.LABEL_SIZE, "color": style.INK}
    figure.supxlabel(axis_label(along), **look)
    figure.supylabel(axis_label(by) if by else "", **look)
    bar = figure.colorbar(image, ax=axes, fraction=0.012, pad=0.01)
    style.dress_bar(bar, "correlation")
    return figure


def plot_needed(
    study: Study,
    *,
    target_arcsec: float | None = None,
    **where: Any,
) -> Figure:
    """Frame-dependent attitude error along an axis with its target, and the frames that the target
    takes.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    target_arcsec : float, optional
        1 sigma per axis across the boresight; the study's own by default.
    **where
        ``along`` and ``by``, names of axes, the first two that were swept by default; and ``at``, values
        at which other axes are held, their middle ones by default.
    """
    target = study.definition.target_arcsec if target_arcsec is None else target_arcsec
    title = "Error that differs from frame to frame [arcsec]"
    panels = {
        title if target is None else f"{title}; dashed: target {target:g}": study.sweep.frame_error
    }
    if target is not None:
        panels[f"Frames for {target:g} arcsec"] = study.frames_for(target)
    figure, (ax, *_) = plot_swept(study.sweep, panels, **where, wide=2.0)
    figure.supxlabel("\n".join(best_axis(study)), fontsize=style.LABEL_SIZE, color=style.GREY)
    if target is not None:
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, target / 1.5), max(high, target * 1.5))
        plain(ax.yaxis)
        target_line(ax, target)
    return figure


def plot_inflation(
    study: Study,
    **where: Any,
) -> Figure:
    """Sigma of every parameter along an axis, with all others unknown and, dashed, with all others
    known.

    The gap between both is the price of coupling.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    **where
        ``along`` and ``by``, names of axes, the first two that were swept by default; and ``at``, values
        at which other axes are held, their middle ones by default.
    """
    panels, known = {}, {}
    for name in study.parameter_names:
        numbers, text = numbers_of(study, "sigma", name)
        panels[capital(text)] = numbers
        known[capital(text)], _ = numbers_of(study, "sigma_conditional", name)
    dashed = "all others known"
    return plot_swept(study.sweep, panels, known, **where, dashed=dashed)[0]


def plot_simpler(
    study: Study,
    **where: Any,
) -> Figure:
    """Attitude error that a simpler distortion model would leave, beside the error of the
    calibration itself.

    Where a full line lies below the dashed one of its colour, that model is rich enough.

    Parameters
    ----------
    study : Study
        Result of `starcal_uq.study`.
    **where
        ``along`` and ``by``, names of axes, the first two that were swept by default; and ``at``, values
        at which other axes are held, their middle ones by default.

    Raises
    ------
    ValueError
        For a study in which no simpler model was tried.
    """
    left = {model: model_bias(study, model) for model in simpler_models(study)}
    # A model that leaves out zeros alone was not tried.
    panels = {
        f"Left by the model {model} [arcsec]": bias
        for model, bias in left.items()
        if np.any(np.nan_to_num(bias) > 0.0)
    }
    if not panels:
        raise ValueError("no simpler distortion model was tried in this study.")
    known = dict.fromkeys(panels, study.sweep.frame_error)
    look: AnyDict = {"sharey": True, "dashed": "error of the calibration"}
    return plot_swept(study.sweep, panels, known, **where, **look)[0]


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
    import pandas as pd
    import xarray as xr

    along, _ = two_axes(study.sweep, along, None)
    found = []
    for name in study.parameter_names:
        covered = study.values("covered_95", parameter=name)
        n, rate = (study.sweep.over(covered, of, [along]) for of in ("count", "mean"))
        rate = rate.dropna(along)
        ends = [
            binomial_interval(round(float(n.sel(r.coords) * r)), int(n.sel(r.coords))) for r in rate
        ]
        low, high = np.transpose(ends)
        bounds = {"low": (along, low), "high": (along, high)}
        found.append(rate.to_dataset(name="median").assign(bounds))
    titles = list(map(symbol, study.parameter_names))
    data = 100.0 * xr.concat(found, pd.Index(titles, name="panel"))
    figure, axes = small_multiples(data, along, log=False, sharey=True)
    for ax in axes:
        ax.axhline(95.0, color=style.INK, linewidth=0.9)
    style.label(axes[0], y="95 % intervals that hold the truth [%]")
    return figure
