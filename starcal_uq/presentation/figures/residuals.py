"""Residuals over the field: what the model does not explain shows here and nowhere in the posterior."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import significant
from starcal_uq.diagnostics.residuals import bin_residuals, normalised_residuals, residual_scale
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations

# chi-square with 2 degrees of freedom at 99 %: a mean vector beyond it is drawn as significant.
_CHI2_2_99 = 9.21


def plot_residuals(cal: Calibration, obs: Observations) -> Figure:
    """Mean residual vectors over the field, residual against radius, and the histogram against a Gaussian."""
    figure = style.new_figure(11.0, 4.1)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.12, 1.0, 0.95))
    plot_residual_map(cal, obs, left)
    plot_residual_radius(cal, obs, middle)
    plot_residual_histogram(cal, obs, right)
    return figure


def plot_residual_map(cal: Calibration, obs: Observations, ax: Axes | None = None) -> Axes:
    """Mean residual vectors (observed minus predicted) in cells of the detector, with a key."""
    if ax is None:
        ax = style.new_axes(5.0, 4.6)
    style.dress(ax)
    binned = bin_residuals(cal, obs)
    width, height = cal.camera.width_px, cal.camera.height_px
    style.label(ax, "Mean residuals", "x [px]", "y [px]")
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_aspect("equal")
    for spine in ax.spines.values():
        spine.set_visible(True)
    ax.scatter(
        obs.x_px,
        obs.y_px,
        s=1.0,
        color=style.GREY,
        alpha=float(np.clip(4000 / obs.n_stars, 0.2, 0.6)),
        linewidths=0,
        rasterized=True,
    )
    ax.plot([cal.camera.x0_px], [cal.camera.y0_px], marker="+", color=style.INK, markersize=10, markeredgewidth=1.2)
    if len(binned.counts) == 0:
        ax.text(0.5, 0.5, "too few stars per cell", transform=ax.transAxes, ha="center", color=style.INK)
        return ax
    key = float(np.sqrt(2.0 * np.mean(binned.noise_px**2)))
    longest = max(float(np.sqrt((binned.means**2).sum(1)).max()), key)
    scale = longest / (0.95 * binned.cell_px)
    strong = binned.chi2 > _CHI2_2_99
    for chosen, colour, thick in ((~strong, style.BLUE, 0.0045), (strong, style.VERMILLION, 0.0085)):
        if np.any(chosen):
            arrows = ax.quiver(
                *binned.centres[chosen].T,
                *binned.means[chosen].T,
                angles="xy",
                scale_units="xy",
                scale=scale,
                color=colour,
                width=thick,
                pivot="mid",
            )
    ax.quiverkey(
        arrows,
        0.66,
        1.045,
        key,
        f"{significant(key)} px (noise)",
        coordinates="axes",
        labelpos="E",
        labelcolor=style.INK,
        fontproperties={"size": style.TICK_SIZE},
    )
    ax.set_xlabel(
        f"x [px]\n{np.count_nonzero(strong)} of {strong.size} arrows bold: beyond 99 % of pure noise",
        fontsize=style.LABEL_SIZE,
        color=style.INK,
    )
    return ax


def plot_residual_radius(cal: Calibration, obs: Observations, ax: Axes | None = None) -> Axes:
    """Radial and tangential residual against the distance from the principal point, with one standard error."""
    if ax is None:
        ax = style.new_axes(4.4, 3.8)
    style.dress(ax, grid=True)
    offset = np.stack([obs.x_px - cal.camera.x0_px, obs.y_px - cal.camera.y0_px], axis=1)
    radius = np.hypot(*offset.T)
    unit = offset / np.maximum(radius, 1e-9)[:, None]
    residuals = np.asarray(cal.residuals_px)
    parts = (np.sum(residuals * unit, axis=1), unit[:, 0] * residuals[:, 1] - unit[:, 1] * residuals[:, 0])
    n_bins = int(np.clip(obs.n_stars // 60, 4, 14))
    # Bins of equal number, so that all error bars mean the same.
    edges = np.quantile(radius, np.linspace(0.0, 1.0, n_bins + 1))
    index = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, n_bins - 1)
    counts = np.maximum(np.bincount(index, minlength=n_bins), 1)
    centre = np.bincount(index, radius, n_bins) / counts
    spread = np.sqrt(np.bincount(index, residual_scale(cal, obs) ** 2, n_bins)) / counts
    looks = ((style.BLUE, "o", "radial", -1), (style.ORANGE, "s", "tangential", 1))
    for part, (colour, marker, name, side) in zip(parts, looks, strict=True):
        mean = np.bincount(index, part, n_bins) / counts
        ax.errorbar(
            centre + side * 0.004 * radius.max(),
            mean,
            spread,
            color=colour,
            marker=marker,
            markersize=4.5,
            linestyle="none",
            elinewidth=1.2,
            label=name,
        )
    ax.axhline(0.0, color=style.INK, linewidth=0.9)
    top = 1.35 * max(np.abs(ax.get_ylim()))
    ax.set_ylim(-top, top)
    style.legend(ax, loc="upper left", ncols=2, columnspacing=1.0, handletextpad=0.3)
    style.label(ax, "Against radius", "distance from principal point [px]", "mean residual [px]")
    return ax


def plot_residual_histogram(cal: Calibration, obs: Observations, ax: Axes | None = None) -> Axes:
    """Residuals in units of their expected standard deviation, against the standard normal, on a log axis."""
    if ax is None:
        ax = style.new_axes(4.2, 3.8)
    style.dress(ax)
    z = normalised_residuals(cal, obs).ravel()
    reach = float(np.clip(np.ceil(np.abs(z).max()), 4.0, 8.0))
    n_bins = int(np.clip(np.sqrt(z.size), 16, 60))
    edges = np.linspace(-reach, reach, n_bins + 1)
    counts, _ = np.histogram(np.clip(z, -reach, reach), bins=edges)
    ax.stairs(counts, edges, fill=True, color=style.SKY, alpha=0.5)
    ax.stairs(counts, edges, color=style.BLUE, linewidth=1.0, label="residuals")
    x = np.linspace(-reach, reach, 300)
    expected = z.size * (edges[1] - edges[0]) * np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    ax.plot(x, expected, color=style.INK, linewidth=1.2, dashes=(4, 2), label="Gaussian")
    ax.set_yscale("log")
    ax.set_ylim(0.5, 6.0 * max(float(counts.max()), 1.0))
    style.legend(ax, loc="upper left", ncols=2, columnspacing=1.0)
    style.label(ax, "Against a Gaussian", "residual / expected sigma", "number per bin")
    return ax
