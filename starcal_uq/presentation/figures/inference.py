"""The corner plot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.formatting import plural, pretty_unit
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import AxisScale, axis_scale, symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.inference.priors import Priors

# Probability inside the 1- and 2-sigma ellipses of a two-dimensional normal distribution: 1 -
# exp(-n^2 / 2).
CONTOUR_MASSES = (0.3935, 0.8647)


def plot_corner(
    post: Posterior, cal: Calibration | None = None, truth: Camera | None = None
) -> Figure:
    """Corner plot: one- and two-dimensional marginals of all sampled parameters.

    Parameters
    ----------
    post
        The posterior; parameters are plotted as value minus the printed mean.
    cal
        If given, the Gaussian approximation of the calibration is drawn over the draws (dashed), so
        that a departure from it is seen.
    truth
        If given, the camera of a simulation, drawn as a line and a cross.

    Returns
    -------
    Figure
        Contours hold 39 % and 86 % of the probability, as the 1- and 2-sigma ellipses of a normal
        distribution do.
    """
    names = sampled_names(post)
    scales, columns = scaled_draws(post)
    ends = [limits(column) for column in columns]
    gaussian = _gaussian(cal, scales, len(names)) if cal is not None else None
    marks = truth_marks(truth, names, scales)
    size = len(names)
    figure = style.new_figure(1.0 + 1.65 * size, 0.8 + 1.5 * size)
    # The last title is wider than its panel.
    grid = style.panels(figure, size, size, (0.74, 0.34, 0.52, 0.28), (0.13, 0.28))
    for row in range(size):
        for column in range(row + 1):
            ax = style.dress(figure.add_subplot(grid[row, column]))
            if row == column:
                histogram(ax, columns[row], ends[row], gaussian, row, marks[row])
                style.heading(ax, scales[row].title, style.TICK_SIZE)
            else:
                _density(ax, columns[column], columns[row])
                if gaussian is not None:
                    _ellipses(ax, gaussian, column, row)
                _mark(ax, marks[column], marks[row])
            _ticks(ax, row, column, size, scales, ends)
    _corner_key(figure, gaussian is not None, truth is not None, len(post.draws))
    return figure


def _gaussian(
    cal: Calibration, scales: list[AxisScale], size: int
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the Gaussian approximation, in plotted units; sigma is independent of
    the rest.
    """
    factors, references = np.transpose([(s.factor, s.reference) for s in scales])
    # The noise, where it was sampled, is the last.
    mean = np.append(cal.theta, cal.sigma)[:size]
    covariance = np.zeros((len(cal.theta) + 1,) * 2)
    covariance[:-1, :-1] = cal.covariance
    covariance[-1, -1] = cal.sigma_std**2
    return (mean - references) / factors, covariance[:size, :size] / np.outer(factors, factors)


def _density(ax: Axes, x: FloatArray, y: FloatArray) -> None:
    """Filled contours; binned along the principal axes of the cloud, so that smoothing does not
    fatten a narrow one.
    """
    from scipy.ndimage import gaussian_filter

    mean = np.array([x.mean(), y.mean()])
    values, vectors = np.linalg.eigh(np.cov(x, y))
    axes = vectors * np.sqrt(np.maximum(values, 1e-300))
    white = np.linalg.inv(axes) @ (np.stack([x, y]) - mean[:, None])
    reach = max(HALF_WIDTH_SD, float(np.quantile(np.abs(white), 0.9995)))
    counts, _, _ = np.histogram2d(white[0], white[1], bins=BINS, range=[(-reach, reach)] * 2)
    # Takes the counting noise off the contours and widens them by about 2 %.
    smooth = gaussian_filter(counts, 1.0, mode="constant", truncate=_BLUR)
    levels = mass_levels(smooth, CONTOUR_MASSES)
    if not np.all(np.diff(levels) > 0):
        return
    centre = reach * ((2.0 * np.arange(BINS) + 1.0) / BINS - 1.0)
    grid = (
        np.einsum("ij,jab->iab", axes, np.stack(np.meshgrid(centre, centre, indexing="ij")))
        + mean[:, None, None]
    )
    filled = ax.contourf(
        grid[0], grid[1], smooth, levels=[*levels, smooth.max() * 1.001], colors=_FILLS
    )
    # Edges of the fill are the contours.
    filled.set(edgecolor=style.BLUE, linewidth=0.9)


def mass_levels(density: FloatArray, masses: tuple[float, ...]) -> list[float]:
    """Density levels whose super-level sets hold these probabilities, in rising order of level."""
    ordered = np.sort(density, axis=None)[::-1]
    mass = np.cumsum(ordered) / ordered.sum()
    return sorted(
        float(ordered[min(int(np.searchsorted(mass, m)), ordered.size - 1)]) for m in masses
    )


def _ellipses(ax: Axes, gaussian: tuple[FloatArray, FloatArray], i: int, j: int) -> None:
    mean, covariance = gaussian
    block = covariance[np.ix_((i, j), (i, j))]
    values, vectors = np.linalg.eigh(block)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    ring = vectors @ (
        np.sqrt(np.maximum(values, 0.0))[:, None] * np.stack([np.cos(angle), np.sin(angle)])
    )
    for n_sigma in (1.0, 2.0):
        x, y = mean[[i, j]][:, None] + n_sigma * ring
        ax.plot(x, y, color=style.INK, linewidth=0.9, dashes=(4, 2))


def _mark(ax: Axes, x: float | None, y: float | None) -> None:
    if x is not None and y is not None:
        ax.plot([x], [y], **style.look("truth cross"))


def _ticks(
    ax: Axes,
    row: int,
    column: int,
    size: int,
    scales: list[AxisScale],
    ends: list[tuple[float, float]],
) -> None:
    ax.set_xlim(*ends[column])
    if row != column:
        ax.set_ylim(*ends[row])
    sparse(ax, y=row != column)
    if row == size - 1:
        style.label(ax, x=scales[column].label, size=style.TICK_SIZE)
    else:
        ax.tick_params(labelbottom=False)
    if column == 0 and row > 0:
        style.label(ax, y=scales[row].label, size=style.TICK_SIZE)
    else:
        ax.tick_params(labelleft=False)


def _corner_key(figure: Figure, gaussian: bool, truth: bool, n_draws: int) -> None:
    handles = style.keys("corner")
    if gaussian:
        handles += style.keys("gaussian")
    if truth:
        handles += style.keys("truth cross")
    figure.legend(
        handles=handles,
        loc="upper right",
        fontsize=style.LABEL_SIZE,
        frameon=False,
        labelcolor=style.INK,
        title=plural(n_draws, "draw"),
        title_fontsize=style.LABEL_SIZE,
        alignment="left",
    )


def plot_prior_posterior(post: Posterior, truth: Camera | None = None) -> Figure:
    """Prior and posterior of every parameter: on the scale of the prior (above) and of the
    posterior (below).

    The upper row shows how much the data said, the lower row that the prior is flat where the
    posterior lives.
    """
    names = sampled_names(post)
    scales, columns = scaled_draws(post)
    marks = truth_marks(truth, names, scales)
    figure = style.new_figure(1.0 + 1.75 * len(names), 4.1)
    grid = style.panels(figure, 2, len(names), (0.46, 0.14, 0.5, 0.6), (0.22, 0.56))
    for i, name in enumerate(names):
        parameter = post.parameters[post.sampled[i]]
        upper = style.dress(figure.add_subplot(grid[0, i]))
        wide = _prior_grid(post.priors, name, columns[i], scales[i])
        density = _relative_prior(post.priors, name, wide)
        upper.plot(wide / parameter.scale, density, **style.look("prior"))
        upper.axvline(
            _centre(columns[i], scales[i]) / parameter.scale, color=style.BLUE, linewidth=1.5
        )
        style.heading(upper, symbol(name))
        style.label(upper, x=_unit(parameter.scaled_unit), size=style.TICK_SIZE)
        sparse(upper, y=False)
        lower = style.dress(figure.add_subplot(grid[1, i]))
        ends = limits(columns[i])
        histogram(lower, columns[i], ends, None, i, marks[i])
        near = np.linspace(*ends, 60)
        height = _relative_prior(post.priors, name, near * scales[i].factor + scales[i].reference)
        # The prior's own density in this unit would lie on the axis: only its slope can be shown.
        lower.plot(near, 0.5 * height, **style.look("prior"))
        lower.set_xlim(*ends)
        style.label(lower, x=scales[i].label, size=style.TICK_SIZE)
        sparse(lower, y=False)
        if i == 0:
            style.label(upper, y="scale of\nthe prior")
            style.label(lower, y="scale of\nthe posterior")
    handles = style.keys("prior") + (style.keys("truth") if truth is not None else [])
    style.legend_above(figure, handles, loc="upper left", fontsize=style.LABEL_SIZE)
    return figure


def _relative_prior(priors: Priors, name: str, values: FloatArray) -> FloatArray:
    """Prior density relative to its largest value on the grid; flat where it underflows all
    over.
    """
    density = priors.marginal_density(name, values)
    return density / density.max() if density.max() > 0.0 else np.ones_like(density)


def _prior_grid(priors: Priors, name: str, column: FloatArray, scale: AxisScale) -> FloatArray:
    centre = _centre(column, scale)
    if name.startswith("sigma"):
        top = max(1.4 * centre, priors.sigma_median * np.exp(1.2 * priors.sigma_log_sd))
        return np.linspace(top / 400, top, 400)
    mean, sd = priors.mean((name,))[0], priors.sd((name,))[0]
    low = min(mean - 3 * sd, centre - 0.3 * sd)
    return np.linspace(low, max(mean + 3 * sd, centre + 0.3 * sd), 300)


def _centre(column: FloatArray, scale: AxisScale) -> float:
    """Mean of the draws, in computation units."""
    return float(np.mean(column) * scale.factor + scale.reference)


def _unit(text: str) -> str:
    return f"[{pretty_unit(text)}]" if pretty_unit(text) else ""


BINS = 44
HALF_WIDTH_SD = 3.6
# Share of an axis at either end without ticks: about half a label.
_MARGIN = 0.12
# Bins on either side over which counts are blurred, and the colours within two sigma and within
# one.
_BLUR = 3
_FILLS = ("#cfe3f1", "#6fb0d9")


def scaled_draws(post: Posterior) -> tuple[list[AxisScale], list[FloatArray]]:
    """Axis scale and plotted draws of every sampled parameter."""
    draws = post.draws[:, list(post.sampled)]
    spreads, means = draws.std(axis=0, ddof=1), draws.mean(axis=0)
    scales = [
        axis_scale(post.parameters[i], float(m), float(s))
        for i, m, s in zip(post.sampled, means, spreads, strict=True)
    ]
    return scales, [scale(draws[:, i]) for i, scale in enumerate(scales)]


def sampled_names(post: Posterior) -> tuple[str, ...]:
    """Names of the parameters that were sampled."""
    return tuple(post.parameter_names[i] for i in post.sampled)


def limits(column: FloatArray) -> tuple[float, float]:
    """Ends of the axis of one parameter."""
    centre, reach = float(np.median(column)), HALF_WIDTH_SD * float(np.std(column))
    low, high = map(float, np.quantile(column, (0.0005, 0.9995)))
    return min(centre - reach, low), max(centre + reach, high)


def truth_marks(
    truth: Camera | None, names: tuple[str, ...], scales: list[AxisScale]
) -> list[float | None]:
    """The truth in plotted numbers; None where it is not known."""
    if truth is None:
        return [None] * len(names)
    values = dict(zip(truth.parameter_names, truth.theta, strict=True))
    return [
        float(scales[i](values[name])) if name in values else None for i, name in enumerate(names)
    ]


def histogram(
    ax: Axes,
    column: FloatArray,
    limits: tuple[float, float],
    gaussian: tuple[FloatArray, FloatArray] | None,
    index: int,
    mark: float | None,
) -> None:
    """Histogram of one parameter, with the normal curve of entry `index` of `gaussian` (mean,
    covariance).
    """
    counts, edges = np.histogram(column, bins=BINS, range=limits)
    peak = counts.max()
    ax.stairs(counts / peak, edges, fill=True, color=style.SKY, alpha=0.45)
    ax.stairs(counts / peak, edges, color=style.BLUE, linewidth=1.0)
    if gaussian is not None:
        mean, sd = gaussian[0][index], np.sqrt(gaussian[1][index, index])
        x = np.linspace(*limits, 200)
        height = column.size * (edges[1] - edges[0]) / (sd * np.sqrt(2 * np.pi)) / peak
        curve = height * np.exp(-0.5 * ((x - mean) / sd) ** 2)
        ax.plot(x, curve, color=style.INK, linewidth=1.0, dashes=(4, 2))
    if mark is not None:
        ax.axvline(mark, color=style.VERMILLION, linewidth=1.3)
    ax.set_ylim(0.0, 1.12)


def sparse(ax: Axes, *, y: bool) -> None:
    """A few ticks between the present limits, without offsets; no vertical axis unless `y`."""
    from matplotlib.ticker import FixedLocator

    ax.spines["left"].set_visible(y)
    for axis, shown in ((ax.xaxis, True), (ax.yaxis, y)):
        axis.set_major_locator(
            FixedLocator(inner_ticks(*axis.get_view_interval()) if shown else [])
        )
        axis.get_major_formatter().set_useOffset(False)  # type: ignore[attr-defined]


def inner_ticks(low: float, high: float) -> Any:
    """Round values, two to five, so far from both ends that their labels do not touch those of the
    next panel.
    """
    from matplotlib.ticker import MaxNLocator

    margin = _MARGIN * (high - low)
    inside = np.empty(0)
    for intervals in range(3, 8):
        ticks = floats(MaxNLocator(intervals).tick_values(low, high))
        inside = ticks[(ticks >= low + margin) & (ticks <= high - margin)]
        if len(inside) > 1:
            break
    return inside
