"""What the figures of the posterior share: scaled draws, histograms, axes with few and short tick labels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import AxisScale, axis_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from starcal_uq.camera.camera import Camera
    from starcal_uq.inference.posterior import Posterior

BINS = 44
HALF_WIDTH_SD = 3.6


def scaled_draws(post: Posterior) -> tuple[list[AxisScale], list[FloatArray]]:
    """Axis scale and plotted draws of every sampled parameter."""
    draws = post.draws[:, list(post.sampled)]
    spreads, means = draws.std(axis=0, ddof=1), draws.mean(axis=0)
    entries = [post.parameters[i] for i in post.sampled]
    scales = [axis_scale(p, float(m), float(s)) for p, m, s in zip(entries, means, spreads, strict=True)]
    return scales, [scale(draws[:, i]) for i, scale in enumerate(scales)]


def sampled_names(post: Posterior) -> tuple[str, ...]:
    """Names of the parameters that were sampled."""
    return tuple(post.parameter_names[i] for i in post.sampled)


def limits(column: FloatArray) -> tuple[float, float]:
    """Ends of the axis of one parameter."""
    centre, spread = float(np.median(column)), float(np.std(column))
    low, high = np.quantile(column, (0.0005, 0.9995))
    return min(centre - HALF_WIDTH_SD * spread, float(low)), max(centre + HALF_WIDTH_SD * spread, float(high))


def truth_marks(truth: Camera | None, names: tuple[str, ...], scales: list[AxisScale]) -> list[float | None]:
    """The truth in plotted numbers; None where it is not known."""
    if truth is None:
        return [None] * len(names)
    values = dict(zip(truth.parameter_names, truth.theta, strict=True))
    return [float(scales[i](values[name])) if name in values else None for i, name in enumerate(names)]


def histogram(
    ax: Axes,
    column: FloatArray,
    limits: tuple[float, float],
    gaussian: tuple[FloatArray, FloatArray] | None,
    index: int,
    mark: float | None,
) -> None:
    """Histogram of one parameter, with the normal curve of entry `index` of `gaussian` (mean, covariance)."""
    counts, edges = np.histogram(column, bins=BINS, range=limits)
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


def sparse(ax: Axes, *, y: bool) -> None:
    """Three ticks at most, without offsets; no vertical axis unless `y`."""
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    if y:
        ax.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    else:
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_major_formatter().set_useOffset(False)  # type: ignore[attr-defined]
