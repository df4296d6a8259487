"""What questions the model, in pictures: p-values of the tests, residuals against everything, jackknife, models."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.diagnostics.residuals import Profile1D, residual_profiles
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.diagnostics.jackknife import Jackknife
    from starcal_uq.diagnostics.misfit import Misfit
    from starcal_uq.diagnostics.models import ModelComparison
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations

_ALPHA = 0.05
_SMALLEST_P = 1e-12


def plot_misfit(misfit: Misfit, ax: Axes | None = None, *, alpha: float = _ALPHA) -> Axes:
    """Corrected p-value of every test on a logarithmic axis; beyond the line is more than noise."""
    if ax is None:
        ax = style.new_axes(7.2, 0.27 * len(misfit.tests) + 1.0)
    style.dress(ax, grid=True)
    tests = misfit.tests[::-1]
    p = np.maximum([test.p_holm for test in tests], _SMALLEST_P)
    rows = np.arange(len(tests))
    for chosen, colour, marker in ((p >= alpha, style.BLUE, "o"), (p < alpha, style.VERMILLION, "D")):
        ax.scatter(p[chosen], rows[chosen], color=colour, marker=marker, s=30, zorder=3)
    ax.axvline(alpha, color=style.INK, linewidth=1.0, dashes=(4, 2))
    ax.set_xscale("log")
    ax.set_xlim(2.5, min(float(p.min()), alpha / 30.0) / 2.5)
    ax.set_ylim(-0.7, len(tests) - 0.3)
    ax.set_yticks(rows, [test.name for test in tests], fontsize=style.TICK_SIZE)
    style.label(ax, "", f"p-value, corrected for {len(tests)} tests (line: {alpha:g})")
    return ax


def plot_jackknife(found: Jackknife, ax: Axes | None = None) -> Axes:
    """Jackknife over formal sigma of every parameter, with the range that chance gives."""
    if ax is None:
        ax = style.new_axes(4.2, 3.2)
    style.dress(ax, grid=True)
    rows = np.arange(len(found.ratio))
    low, high = found.expected()
    ax.bar(rows, high - low, bottom=low, width=0.62, color=style.LIGHT, label="chance (95 %)")
    ax.scatter(rows - 0.08, found.ratio, color=style.BLUE, s=32, zorder=3, label="jackknife")
    ax.scatter(
        rows + 0.08, found.sandwich_ratio, color=style.ORANGE, marker="s", s=26, zorder=3, label="cluster-robust"
    )
    ax.axhline(1.0, color=style.INK, linewidth=0.9)
    ax.set_xticks(rows, found.parameter_names)
    top = max(float(np.max([high, found.ratio, found.sandwich_ratio])), 1.2)
    ax.set_ylim(min(0.5, float(low.min()) - 0.05), 1.0 + 1.8 * (top - 1.0))
    style.legend(ax, loc="upper left", ncols=2, columnspacing=0.7, handletextpad=0.2, handlelength=1.0)
    style.label(ax, "Frames against formal errors", "", "ratio to formal sigma")
    return ax


def plot_comparison(found: ModelComparison, ax: Axes | None = None) -> Axes:
    """Loss in predicting left-out frames against the best model, with two standard errors."""
    if ax is None:
        ax = style.new_axes(4.6, 3.2)
    style.dress(ax, grid=True)
    scores = found.scores[::-1]
    rows = np.arange(len(scores))
    for row, score in zip(rows, scores, strict=True):
        colour = style.VERMILLION if score.rejected else style.BLUE
        spread = 2.0 * score.difference_se
        ax.errorbar(-score.difference, row, xerr=spread, color=colour, marker="o", markersize=5, elinewidth=1.4)
    names = [f"{s.model} (fitted)" if s.model == found.fitted else s.model for s in scores]
    ax.set_yticks(rows, names, fontsize=style.TICK_SIZE)
    ax.set_ylim(-0.6, len(scores) - 0.4)
    ax.axvline(0.0, color=style.INK, linewidth=0.9)
    # Rejected models can be thousands of nat away and the others tenths of one.
    ax.set_xscale("symlog", linthresh=10.0)
    reach = max(10.0, *(-s.difference + 2.0 * s.difference_se for s in scores))
    ax.set_xlim(-10.0, 2.0 * reach)
    style.label(ax, "Distortion models", "loss of predictive density [nat], ± 2 s.e.")
    return ax


def plot_diagnosis(found: Diagnosis) -> Figure:
    """Tests for misfit, jackknife and comparison of models side by side."""
    figure = style.new_figure(11.0, 5.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    plot_misfit(found.misfit, figure.add_subplot(grid[:, 0]))
    upper, lower = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    if found.jackknife is not None:
        plot_jackknife(found.jackknife, upper)
    if found.comparison is not None:
        plot_comparison(found.comparison, lower)
    for panel, result in ((upper, found.jackknife), (lower, found.comparison)):
        panel.set_visible(result is not None)
    return figure


def plot_residual_profiles(cal: Calibration, obs: Observations) -> Figure:
    """Mean residuals against azimuth, pixel phase, magnitude, time or order of frames, and temperature."""
    profiles = residual_profiles(cal, obs)
    columns = 3
    rows = -(-len(profiles) // columns)
    figure = style.new_figure(11.0, 2.75 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, profile in zip(panels, profiles, strict=False):
        _plot_profile(panel, profile)
    for panel in panels[len(profiles) :]:
        panel.set_visible(False)
    return figure


def _plot_profile(ax: Axes, profile: Profile1D) -> None:
    style.dress(ax, grid=True)
    shift = 0.006 * np.ptp(profile.centres)
    looks = ((style.BLUE, "o", -shift), (style.ORANGE, "s", shift))
    for name, means, (colour, marker, aside) in zip(profile.names, profile.means, looks, strict=True):
        ax.errorbar(
            profile.centres + aside,
            means,
            profile.errors,
            color=colour,
            marker=marker,
            markersize=4.0,
            linestyle="none",
            elinewidth=1.1,
            label=name,
        )
    ax.axhline(0.0, color=style.INK, linewidth=0.9)
    top = 1.4 * max(np.abs(ax.get_ylim()))
    ax.set_ylim(-top, top)
    style.legend(ax, loc="upper left", ncols=2, columnspacing=1.0, handletextpad=0.2)
    style.label(ax, profile.title, profile.label, "mean residual [px]")
