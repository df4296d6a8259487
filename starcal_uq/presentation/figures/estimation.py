"""Convergence of the stages, after the paper's Fig. 3."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters as camera_parameters
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.formatting import pretty_unit, significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.diagnostics.residuals import bin_residuals, normalised_residuals, residual_profiles
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.diagnostics import plot_profile
from starcal_uq.presentation.figures.scales import symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_BANDS = ("#eef3f7", "#ffffff")


def plot_convergence(cal: Calibration, truth: Camera | None = None) -> Figure:
    """Every parameter against the iteration, stage by stage (Ye & Yang 2017, Fig. 3).

    Above: the value. Below: its distance from the truth if that is known, else from the final
    estimate, in units of the final standard deviation on an axis that is linear between -1 and 1
    and logarithmic outside.
    """
    parameters = camera_parameters(cal.camera.distortion)
    values, starts = _joined(cal)
    known = truth is not None and tuple(truth.parameter_names) == tuple(cal.parameter_names)
    reference = truth.theta if known and truth is not None else cal.theta
    figure = style.new_figure(1.2 + 2.0 * len(parameters), 5.1)
    grid = style.panels(figure, 2, len(parameters), (0.9, 0.12, 0.5, 0.72), (0.56, 0.18))
    axes = grid.subplots(sharex=True, squeeze=False)
    iteration = np.arange(len(values))
    pixel_um = cal.camera.pixel_um
    for i, parameter in enumerate(parameters):
        upper, lower = (style.dress(ax) for ax in axes[:, i])
        factor, unit = 1.0 / parameter.scale, pretty_unit(parameter.scaled_unit)
        if parameter.name == "f" and pixel_um is not None:
            factor, unit = pixel_um / 1000.0, "mm"
        for ax in (upper, lower):
            _mark_stages(ax, starts, len(values))
        upper.plot(iteration, values[:, i] * factor, **style.look("iterations"))
        upper.axhline(reference[i] * factor, **style.look("reference"))
        style.heading(upper, f"{symbol(parameter.name)} [{unit}]", pad=16)
        upper.ticklabel_format(axis="y", useOffset=False, style="plain")
        error = (values[:, i] - reference[i]) / cal.sigmas[i]
        lower.axhspan(-1.0, 1.0, **style.look("one sigma"))
        lower.axhline(0.0, **style.look("reference"))
        lower.plot(iteration, error, **style.look("iterations"))
        decades = max(1.0, np.ceil(np.log10(max(np.abs(error).max(), 2.0))))
        style.signed_log(lower.yaxis, 1.0, 10.0 ** (decades + 0.15), linscale=0.6)
        style.label(lower, x="iteration")
    what = "truth" if known else "final estimate"
    style.label(axes[0, 0], y="value")
    style.label(axes[1, 0], y=f"distance from {what}\n[final sigma]")
    _key(figure, cal, what)
    return figure


def _key(figure: Figure, cal: Calibration, what: str) -> None:
    stages = ", ".join(f"{i} {stage.name}" for i, stage in enumerate(cal.stages, 1))
    handles = style.keys("convergence")
    handles[1].set_label(what)
    handles[-1].set_label(f"Stages: {stages}")
    look = {"columnspacing": 1.6, "handlelength": 1.8, "fontsize": style.LABEL_SIZE}
    style.legend_above(figure, handles, loc="upper left", **look)


def _joined(cal: Calibration) -> tuple[FloatArray, list[int]]:
    """All trajectories in a row, and the position at which each stage begins."""
    paths = [stage.trajectory for stage in cal.stages]
    return np.concatenate(paths), np.cumsum([0, *map(len, paths)])[:-1].tolist()


def _mark_stages(ax: Axes, starts: list[int], total: int) -> None:
    ends = [*starts[1:], total]
    for i, (first, last) in enumerate(zip(starts, ends, strict=True)):
        ax.axvspan(first - 0.5, last - 0.5, color=_BANDS[i % 2], linewidth=0, zorder=0)
        if ax.get_subplotspec().is_first_row():  # type: ignore[union-attr]
            at = (0.5 * (first + last - 1), 1.03)
            place = {"xycoords": ax.get_xaxis_transform(), "ha": "center"}
            style.note(ax, str(i + 1), at, color=style.GREY, **place)
    ax.set_xlim(-0.5, total - 0.5)


# chi-square with 2 degrees of freedom at 99 %: a mean vector beyond it is drawn as significant.
_CHI2_2_99 = 9.21


def plot_residuals(cal: Calibration, obs: Observations) -> Figure:
    """Mean residual vectors over the field, residual against radius, and the histogram against a
    Gaussian.

    Raises
    ------
    CalibrationError
        For the result of a stream of frames, whose stars are gone.
    """
    if len(cal.residuals_px) == 0:
        raise CalibrationError(
            "this calibration comes from a stream of frames and kept no residuals: calibrate "
            "loaded observations."
        )
    figure = style.new_figure(11.0, 4.1)
    panels = figure.subplots(1, 3, width_ratios=(1.12, 1.0, 0.95))
    for plot, ax in zip(
        (plot_residual_map, plot_residual_radius, plot_residual_histogram), panels, strict=True
    ):
        plot(cal, obs, ax)
    return figure


def plot_residual_map(cal: Calibration, obs: Observations, ax: Axes | None = None) -> Axes:
    """Mean residual vectors (observed minus predicted) in cells of the detector, with a key."""
    ax = style.panel(ax, 5.0, 4.6)
    binned = bin_residuals(cal, obs)
    width, height = cal.camera.width_px, cal.camera.height_px
    style.label(ax, "Mean residuals", "x [px]", "y [px]")
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_aspect("equal")
    ax.spines[:].set_visible(True)
    ax.scatter(
        obs.x_px,
        obs.y_px,
        s=1.0,
        color=style.GREY,
        alpha=np.clip(4000 / obs.n_stars, 0.2, 0.6),
        linewidths=0,
        rasterized=True,
    )
    cross: AnyDict = {"marker": "+", "markersize": 10, "markeredgewidth": 1.2}
    ax.plot([cal.camera.x0_px], [cal.camera.y0_px], color=style.INK, **cross)
    if len(binned.counts) == 0:
        ax.text(
            0.5, 0.5, "too few stars per cell", transform=ax.transAxes, ha="center", color=style.INK
        )
        return ax
    key = float(np.sqrt(2.0 * np.mean(binned.noise_px**2)))
    longest = max(float(np.sqrt((binned.means**2).sum(1)).max()), key)
    scale = longest / (0.95 * binned.cell_px)
    strong = binned.chi2 > _CHI2_2_99
    for chosen, colour, thick in (
        (~strong, style.BLUE, 0.0045),
        (strong, style.VERMILLION, 0.0085),
    ):
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
        0.93,
        1.045,
        key,
        f"{significant(key)} px (noise)",
        coordinates="axes",
        labelpos="W",
        labelcolor=style.INK,
        fontproperties={"size": style.TICK_SIZE},
    )
    bold = f"{np.count_nonzero(strong)} of {strong.size} arrows bold"
    style.label(ax, x=f"x [px]\n{bold}: beyond 99 % of pure noise")
    return ax


def plot_residual_radius(cal: Calibration, obs: Observations, ax: Axes | None = None) -> Axes:
    """Radial and tangential residual against the distance from the principal point, with one
    standard error.
    """
    return plot_profile(residual_profiles(cal, obs)[0], style.panel(ax, 4.4, 3.8))


def plot_residual_histogram(cal: Calibration, obs: Observations, ax: Axes | None = None) -> Axes:
    """Residuals in units of their expected standard deviation, against the standard normal, on a
    log axis.
    """
    ax = style.panel(ax, 4.2, 3.8)
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
    style.log_scale(ax.yaxis)
    ax.set_ylim(0.5, 6.0 * max(float(counts.max()), 1.0))
    style.legend(ax, loc="upper left", ncols=2, columnspacing=1.0)
    style.label(ax, "Against a Gaussian", "residual / expected sigma", "number per bin")
    return ax
