"""Figures of the posterior: corner plot, and prior beside posterior."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq._types import FloatArray
from starcal_uq.plots import style
from starcal_uq.plots.scales import AxisScale, axis_scale, named_parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.calibrate import Calibration
    from starcal_uq.camera import Camera
    from starcal_uq.posterior import Posterior
    from starcal_uq.priors import Priors

# Probability inside the 1- and 2-sigma ellipses of a two-dimensional normal distribution: 1 - exp(-n^2 / 2).
CONTOUR_MASSES = (0.3935, 0.8647)
_BINS = 44
_HALF_WIDTH_SD = 3.6


def plot_corner(post: Posterior, cal: Calibration | None = None, truth: Camera | None = None) -> Figure:
    """Corner plot: one- and two-dimensional marginals of all sampled parameters.

    Parameters
    ----------
    post
        The posterior; parameters are plotted as value minus the printed mean.
    cal
        If given, the Gaussian approximation of the calibration is drawn over the draws (dashed), so that a departure
        from it is seen.
    truth
        If given, the camera of a simulation, drawn as a line and a cross.

    Returns
    -------
    Figure
        Contours hold 39 % and 86 % of the probability, as the 1- and 2-sigma ellipses of a normal distribution do.
    """
    names = tuple(post.parameter_names)
    draws = np.asarray(post.draws, dtype=np.float64)
    scales, columns = scaled_draws(post)
    limits = [_limits(column) for column in columns]
    gaussian = _gaussian(cal, scales, len(names)) if cal is not None else None
    marks = _truth_marks(truth, names, scales)
    size = len(names)
    figure = style.new_figure(1.0 + 1.62 * size, 0.9 + 1.5 * size)
    grid = figure.add_gridspec(size, size)
    for row in range(size):
        for column in range(row + 1):
            ax = style.dress(figure.add_subplot(grid[row, column]))
            if row == column:
                _histogram(ax, columns[row], limits[row], gaussian, row, marks[row])
                ax.set_title(scales[row].title, fontsize=style.TICK_SIZE, color=style.INK, pad=5)
            else:
                pair = (columns[column], columns[row])
                _density(ax, pair, (limits[column], limits[row]))
                if gaussian is not None:
                    _ellipses(ax, gaussian, column, row)
                _mark(ax, marks[column], marks[row])
            _ticks(ax, row, column, size, scales, limits)
    _corner_key(figure, gaussian is not None, truth is not None, draws.shape[0])
    figure.align_labels()
    return figure


def plot_prior_posterior(post: Posterior, truth: Camera | None = None) -> Figure:
    """Prior and posterior of every parameter: on the scale of the prior (above) and of the posterior (below).

    The upper row shows how much the data said, the lower row that the prior is flat where the posterior lives.
    """
    names = tuple(post.parameter_names)
    scales, columns = scaled_draws(post)
    marks = _truth_marks(truth, names, scales)
    figure = style.new_figure(1.0 + 1.75 * len(names), 4.1)
    grid = figure.add_gridspec(2, len(names))
    for i, name in enumerate(names):
        parameter = named_parameters(post.camera.distortion, (name,))[0]
        upper = style.dress(figure.add_subplot(grid[0, i]))
        wide = _prior_grid(post.priors, name, columns[i], scales[i])
        density = prior_density(post.priors, name, wide)
        upper.plot(wide / parameter.scale, density, color=style.ORANGE, linewidth=1.5, dashes=(4, 1.5))
        upper.axvline(float(np.mean(columns[i]) * scales[i].factor + scales[i].reference) / parameter.scale,
                      color=style.BLUE, linewidth=1.5)
        upper.set_title(parameter.latex, fontsize=style.TITLE_SIZE, color=style.INK, pad=5)
        upper.set_xlabel(_unit(parameter.scaled_unit), fontsize=style.TICK_SIZE, color=style.INK)
        _sparse(upper, y=False)
        lower = style.dress(figure.add_subplot(grid[1, i]))
        limits = _limits(columns[i])
        _histogram(lower, columns[i], limits, None, i, marks[i])
        near = np.linspace(*limits, 60)
        height = prior_density(post.priors, name, near * scales[i].factor + scales[i].reference)
        # The prior's own density in this unit would lie on the axis: only its slope can be shown.
        lower.plot(near, 0.5 * height, color=style.ORANGE, linewidth=1.5, dashes=(4, 1.5))
        lower.set_xlim(*limits)
        lower.set_xlabel(scales[i].label, fontsize=style.TICK_SIZE, color=style.INK)
        _sparse(lower, y=False)
        if i == 0:
            upper.set_ylabel("scale of\nthe prior", fontsize=style.LABEL_SIZE, color=style.INK)
            lower.set_ylabel("scale of\nthe posterior", fontsize=style.LABEL_SIZE, color=style.INK)
    _prior_key(figure, truth is not None)
    return figure


def scaled_draws(post: Posterior) -> tuple[list[AxisScale], list[FloatArray]]:
    """Axis scale and plotted draws of every sampled parameter."""
    names = tuple(post.parameter_names)
    draws = np.asarray(post.draws, dtype=np.float64)
    entries = named_parameters(post.camera.distortion, names)
    spreads, means = draws.std(axis=0, ddof=1), draws.mean(axis=0)
    scales = [axis_scale(p, float(m), float(s)) for p, m, s in zip(entries, means, spreads, strict=True)]
    return scales, [scale(draws[:, i]) for i, scale in enumerate(scales)]


def prior_density(priors: Priors, name: str, values: FloatArray) -> FloatArray:
    """Prior density of one parameter relative to its largest value on the grid: normal, or log-normal for the noise."""
    if name.startswith("sigma"):
        z = np.log(values / priors.sigma_median) / priors.sigma_log_sd
        logarithm = -0.5 * z * z - np.log(values)
    else:
        mean, sd = float(priors.mean((name,))[0]), float(priors.sd((name,))[0])
        logarithm = -0.5 * ((values - mean) / sd) ** 2
    return np.asarray(np.exp(logarithm - logarithm.max()))


def _prior_grid(priors: Priors, name: str, column: FloatArray, scale: AxisScale) -> FloatArray:
    centre = float(np.mean(column) * scale.factor + scale.reference)
    if name.startswith("sigma"):
        top = max(1.4 * centre, priors.sigma_median * np.exp(1.2 * priors.sigma_log_sd))
        return np.asarray(np.linspace(top / 400, top, 400))
    mean, sd = float(priors.mean((name,))[0]), float(priors.sd((name,))[0])
    return np.asarray(np.linspace(min(mean - 3 * sd, centre - 0.3 * sd), max(mean + 3 * sd, centre + 0.3 * sd), 300))


def _limits(column: FloatArray) -> tuple[float, float]:
    centre, spread = float(np.median(column)), float(np.std(column))
    low, high = np.quantile(column, (0.0005, 0.9995))
    return min(centre - _HALF_WIDTH_SD * spread, float(low)), max(centre + _HALF_WIDTH_SD * spread, float(high))


def _gaussian(cal: Calibration, scales: list[AxisScale], size: int) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the Gaussian approximation, in plotted units; sigma is independent of the rest."""
    mean, covariance = np.zeros(size), np.zeros((size, size))
    p = len(cal.theta)
    factors = np.array([s.factor for s in scales])
    mean[:p], covariance[:p, :p] = cal.theta, cal.covariance
    if size > p:
        mean[p], covariance[p, p] = cal.sigma, cal.sigma_std**2
    mean = (mean - np.array([s.reference for s in scales])) / factors
    return mean, covariance / np.outer(factors, factors)


def _truth_marks(truth: Camera | None, names: tuple[str, ...], scales: list[AxisScale]) -> list[float | None]:
    if truth is None:
        return [None] * len(names)
    values = dict(zip(truth.parameter_names, truth.theta, strict=True))
    return [float(scales[i](values[name])) if name in values else None for i, name in enumerate(names)]


def _histogram(
    ax: Axes,
    column: FloatArray,
    limits: tuple[float, float],
    gaussian: tuple[FloatArray, FloatArray] | None,
    index: int,
    mark: float | None,
) -> None:
    counts, edges = np.histogram(column, bins=_BINS, range=limits)
    peak = counts.max()
    ax.stairs(counts / peak, edges, fill=True, color=style.SKY, alpha=0.45)
    ax.stairs(counts / peak, edges, color=style.BLUE, linewidth=1.0)
    if gaussian is not None:
        mean, sd = gaussian[0][index], np.sqrt(gaussian[1][index, index])
        x = np.linspace(*limits, 200)
        height = column.size * (edges[1] - edges[0]) / (sd * np.sqrt(2 * np.pi)) / peak
        ax.plot(x, height * np.exp(-0.5 * ((x - mean) / sd) ** 2), color=style.INK, linewidth=1.0, dashes=(4, 2))
    if mark is not None:
        ax.axvline(mark, color=style.VERMILLION, linewidth=1.3)
    ax.set_ylim(0.0, 1.12)


def _density(ax: Axes, pair: tuple[FloatArray, FloatArray], limits: tuple[tuple[float, float], ...]) -> None:
    counts, x_edges, y_edges = np.histogram2d(*pair, bins=_BINS, range=limits)
    smooth = _smooth(counts)
    levels = mass_levels(smooth, CONTOUR_MASSES)
    x, y = 0.5 * (x_edges[1:] + x_edges[:-1]), 0.5 * (y_edges[1:] + y_edges[:-1])
    if np.all(np.diff(levels) > 0):
        ax.contourf(x, y, smooth.T, levels=[*levels, smooth.max() * 1.001], colors=["#cfe3f1", "#6fb0d9"])
        ax.contour(x, y, smooth.T, levels=levels, colors=[style.BLUE], linewidths=0.9)


def mass_levels(density: FloatArray, masses: tuple[float, ...]) -> list[float]:
    """Density levels whose super-level sets hold these probabilities, in rising order of level."""
    ordered = np.sort(density, axis=None)[::-1]
    mass = np.cumsum(ordered) / ordered.sum()
    return sorted(float(ordered[min(np.searchsorted(mass, m), ordered.size - 1)]) for m in masses)


def _smooth(counts: FloatArray) -> FloatArray:
    """Blur by one bin: takes the counting noise off the contours and widens them by about 2 %."""
    offsets = np.arange(-3, 4)
    kernel = np.exp(-0.5 * offsets**2)
    kernel /= kernel.sum()
    for axis in (0, 1):
        counts = np.apply_along_axis(np.convolve, axis, counts, kernel, "same")
    return counts


def _ellipses(ax: Axes, gaussian: tuple[FloatArray, FloatArray], i: int, j: int) -> None:
    mean, covariance = gaussian
    block = covariance[np.ix_((i, j), (i, j))]
    values, vectors = np.linalg.eigh(block)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    ring = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    for n_sigma in (1.0, 2.0):
        ax.plot(mean[i] + n_sigma * ring[0], mean[j] + n_sigma * ring[1], color=style.INK, linewidth=0.9, dashes=(4, 2))


def _mark(ax: Axes, x: float | None, y: float | None) -> None:
    if x is not None and y is not None:
        ax.plot([x], [y], marker="+", markersize=9, markeredgewidth=1.8, color=style.VERMILLION, linestyle="none")


def _ticks(
    ax: Axes, row: int, column: int, size: int, scales: list[AxisScale], limits: list[tuple[float, float]]
) -> None:
    _sparse(ax, y=row != column)
    ax.set_xlim(*limits[column])
    if row != column:
        ax.set_ylim(*limits[row])
    if row == size - 1:
        ax.set_xlabel(scales[column].label, fontsize=style.TICK_SIZE, color=style.INK)
    else:
        ax.tick_params(labelbottom=False)
    if column == 0 and row > 0:
        ax.set_ylabel(scales[row].label, fontsize=style.TICK_SIZE, color=style.INK)
    else:
        ax.tick_params(labelleft=False)


def _sparse(ax: Axes, *, y: bool) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    if y:
        ax.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    else:
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_major_formatter().set_useOffset(False)  # type: ignore[attr-defined]


def _corner_key(figure: Figure, gaussian: bool, truth: bool, n_draws: int) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Patch | Line2D] = [
        Patch(facecolor="#6fb0d9", edgecolor=style.BLUE, label="39 % of the draws (1 sigma)"),
        Patch(facecolor="#cfe3f1", edgecolor=style.BLUE, label="86 % of the draws (2 sigma)"),
    ]
    if gaussian:
        handles.append(Line2D([], [], color=style.INK, dashes=(4, 2), linewidth=1.0, label="Gaussian approximation"))
    if truth:
        handles.append(
            Line2D([], [], color=style.VERMILLION, marker="+", markersize=9, linewidth=1.3, label="truth of the simulation")
        )
    figure.legend(
        handles=handles,
        loc="upper right",
        fontsize=style.LABEL_SIZE,
        frameon=False,
        labelcolor=style.INK,
        title=f"{n_draws:,} draws".replace(",", " "),
        title_fontsize=style.LABEL_SIZE,
        alignment="left",
    )


def _prior_key(figure: Figure, truth: bool) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=style.ORANGE, dashes=(4, 1.5), linewidth=1.5, label="prior (below: its slope only)"),
        Line2D([], [], color=style.BLUE, linewidth=1.5, label="posterior"),
    ]
    if truth:
        handles.append(Line2D([], [], color=style.VERMILLION, linewidth=1.3, label="truth of the simulation"))
    figure.legend(
        handles=handles, loc="outside upper left", ncols=3, fontsize=style.LABEL_SIZE, frameon=False, labelcolor=style.INK
    )


def _unit(text: str) -> str:
    from starcal_uq.formatting import pretty_unit

    return f"[{pretty_unit(text)}]" if pretty_unit(text) else ""
