"""The corner plot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.marginals import (
    BINS,
    HALF_WIDTH_SD,
    histogram,
    limits,
    sampled_names,
    scaled_draws,
    sparse,
    truth_marks,
)
from starcal_uq.presentation.figures.scales import AxisScale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.inference.posterior import Posterior

# Probability inside the 1- and 2-sigma ellipses of a two-dimensional normal distribution: 1 - exp(-n^2 / 2).
CONTOUR_MASSES = (0.3935, 0.8647)


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
    names = sampled_names(post)
    scales, columns = scaled_draws(post)
    ends = [limits(column) for column in columns]
    gaussian = _gaussian(cal, scales, len(names)) if cal is not None else None
    marks = truth_marks(truth, names, scales)
    size = len(names)
    figure = style.new_figure(1.0 + 1.62 * size, 0.9 + 1.5 * size)
    grid = figure.add_gridspec(size, size)
    for row in range(size):
        for column in range(row + 1):
            ax = style.dress(figure.add_subplot(grid[row, column]))
            if row == column:
                histogram(ax, columns[row], ends[row], gaussian, row, marks[row])
                ax.set_title(scales[row].title, fontsize=style.TICK_SIZE, color=style.INK, pad=5)
            else:
                _density(ax, columns[column], columns[row])
                if gaussian is not None:
                    _ellipses(ax, gaussian, column, row)
                _mark(ax, marks[column], marks[row])
            _ticks(ax, row, column, size, scales, ends)
    _corner_key(figure, gaussian is not None, truth is not None, len(post.draws))
    figure.align_labels()
    return figure


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


def _density(ax: Axes, x: FloatArray, y: FloatArray) -> None:
    """Filled contours; binned along the principal axes of the cloud, so that smoothing does not fatten a narrow one."""
    mean = np.array([x.mean(), y.mean()])
    values, vectors = np.linalg.eigh(np.cov(x, y))
    axes = vectors * np.sqrt(np.maximum(values, 1e-300))
    u, v = np.linalg.solve(axes, np.stack([x, y]) - mean[:, None])
    reach = max(HALF_WIDTH_SD, float(np.quantile(np.abs(np.stack([u, v])), 0.9995)))
    counts, edges, _ = np.histogram2d(u, v, bins=BINS, range=((-reach, reach), (-reach, reach)))
    smooth = _smooth(counts)
    levels = mass_levels(smooth, CONTOUR_MASSES)
    if not np.all(np.diff(levels) > 0):
        return
    centre = 0.5 * (edges[1:] + edges[:-1])
    grid = np.einsum("ij,jab->iab", axes, np.stack(np.meshgrid(centre, centre, indexing="ij"))) + mean[:, None, None]
    ax.contourf(grid[0], grid[1], smooth, levels=[*levels, smooth.max() * 1.001], colors=["#cfe3f1", "#6fb0d9"])
    ax.contour(grid[0], grid[1], smooth, levels=levels, colors=[style.BLUE], linewidths=0.9)


def mass_levels(density: FloatArray, masses: tuple[float, ...]) -> list[float]:
    """Density levels whose super-level sets hold these probabilities, in rising order of level."""
    ordered = np.sort(density, axis=None)[::-1]
    mass = np.cumsum(ordered) / ordered.sum()
    return sorted(float(ordered[min(int(np.searchsorted(mass, m)), ordered.size - 1)]) for m in masses)


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
    ax: Axes, row: int, column: int, size: int, scales: list[AxisScale], ends: list[tuple[float, float]]
) -> None:
    sparse(ax, y=row != column)
    ax.set_xlim(*ends[column])
    if row != column:
        ax.set_ylim(*ends[row])
    if row == size - 1:
        ax.set_xlabel(scales[column].label, fontsize=style.TICK_SIZE, color=style.INK)
    else:
        ax.tick_params(labelbottom=False)
    if column == 0 and row > 0:
        ax.set_ylabel(scales[row].label, fontsize=style.TICK_SIZE, color=style.INK)
    else:
        ax.tick_params(labelleft=False)


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
            Line2D(
                [], [], color=style.VERMILLION, marker="+", markersize=9, linewidth=1.3, label="truth of the simulation"
            )
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
