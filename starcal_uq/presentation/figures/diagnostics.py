"""What questions the model, in pictures: p-values of the tests, residuals against everything,
jackknife, models.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters, sigma_parameter
from starcal_uq.core.formatting import SMALLEST_P, fixed, significant
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.misfit import ALPHA
from starcal_uq.diagnostics.residuals import Profile1D, residual_profiles
from starcal_uq.maths.ranks import counts_below, uniformity_band
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.diagnostics.jackknife import Jackknife
    from starcal_uq.diagnostics.misfit import Misfit
    from starcal_uq.diagnostics.models import ModelComparison
    from starcal_uq.diagnostics.validation.result import Validation
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations


def plot_misfit(misfit: Misfit, ax: Axes | None = None, *, alpha: float = ALPHA) -> Axes:
    """Corrected p-value of every test on a logarithmic axis; beyond the line is more than noise."""
    ax = style.panel(ax, 7.2, 0.27 * len(misfit.tests) + 1.0, grid=True)
    tests = misfit.tests[::-1]
    p = np.maximum([test.p_holm for test in tests], SMALLEST_P)
    rows = np.arange(len(tests))
    for chosen, colour, marker in (
        (p >= alpha, style.BLUE, "o"),
        (p < alpha, style.VERMILLION, "D"),
    ):
        ax.scatter(p[chosen], rows[chosen], color=colour, marker=marker, s=30, zorder=3)
    ax.axvline(alpha, color=style.INK, linewidth=1.0, dashes=(4, 2))
    style.log_scale(ax.xaxis)
    ax.set_xlim(2.5, min(float(p.min()), alpha / 30.0) / 2.5)
    ax.set_ylim(-0.7, len(tests) - 0.3)
    ax.set_yticks(rows, [test.name for test in tests], fontsize=style.TICK_SIZE)
    style.label(ax, "", f"p-value, corrected for {len(tests)} tests (line: {alpha:g})")
    return ax


def plot_jackknife(jackknife: Jackknife, ax: Axes | None = None) -> Axes:
    """Cluster-robust and jackknife over formal sigma of every parameter, with the range that chance
    gives.
    """
    ax = style.panel(ax, 4.2, 3.2, grid=True)
    rows = np.arange(len(jackknife.ratio))
    low, high = jackknife.expected()
    ax.bar(rows, high - low, bottom=low, width=0.62, color=style.LIGHT, label="chance (95 %)")
    for ratio, aside, colour, marker, size, words in (
        (jackknife.ratio, -0.08, style.BLUE, "o", 32, "cluster-robust"),
        (jackknife.jackknife_ratio, 0.08, style.ORANGE, "s", 26, "jackknife"),
    ):
        ax.scatter(rows + aside, ratio, color=colour, marker=marker, s=size, zorder=3, label=words)
    ax.axhline(1.0, color=style.INK, linewidth=0.9)
    ax.set_xticks(rows, jackknife.parameter_names)
    top = np.max([high, jackknife.ratio, jackknife.jackknife_ratio], initial=1.2)
    ax.set_ylim(min(0.5, low.min() - 0.05), 1.0 + 1.8 * (top - 1.0))
    style.legend(
        ax, loc="upper left", ncols=2, columnspacing=0.7, handletextpad=0.2, handlelength=1.0
    )
    style.label(ax, "Frames against formal errors", "", "ratio to formal sigma")
    return ax


def plot_comparison(models: ModelComparison, ax: Axes | None = None) -> Axes:
    """Loss in predicting left-out frames against the best model, with two standard errors."""
    ax = style.panel(ax, 4.6, 3.2, grid=True)
    scores = models.scores[::-1]
    rows = np.arange(len(scores))
    for row, score in zip(rows, scores, strict=True):
        colour = style.VERMILLION if score.rejected else style.BLUE
        ax.errorbar(
            *(-score.difference, row),
            xerr=2.0 * score.difference_se,
            color=colour,
            marker="o",
            markersize=5,
            elinewidth=1.4,
        )
    names = [f"{s.model} (fitted)" if s.model == models.fitted else s.model for s in scores]
    ax.set_yticks(rows, names, fontsize=style.TICK_SIZE)
    ax.set_ylim(-0.6, len(scores) - 0.4)
    ax.axvline(0.0, color=style.INK, linewidth=0.9)
    # Rejected models can be thousands of nat away and the others tenths of one.
    style.log_scale(ax.xaxis, 10.0)
    reach = max(10.0, *(-s.difference + 2.0 * s.difference_se for s in scores))
    ax.set_xlim(-10.0, 2.0 * reach)
    style.label(ax, "Distortion models", "loss of predictive density [nat], ± 2 s.e.")
    return ax


def plot_diagnosis(diagnosis: Diagnosis) -> Figure:
    """Tests for misfit, jackknife and comparison of models side by side."""
    figure = style.new_figure(11.0, 5.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    plot_misfit(diagnosis.misfit, figure.add_subplot(grid[:, 0]))
    if diagnosis.jackknife is not None:
        plot_jackknife(diagnosis.jackknife, figure.add_subplot(grid[0, 1]))
    if diagnosis.comparison is not None:
        plot_comparison(diagnosis.comparison, figure.add_subplot(grid[1, 1]))
    return figure


def plot_residual_profiles(cal: Calibration, obs: Observations) -> Figure:
    """Mean residuals against azimuth, pixel phase, magnitude, time or order of frames, and
    temperature.
    """
    # The radius stands beside the map of the residuals.
    profiles = residual_profiles(cal, obs)[1:]
    columns = 3
    rows = -(-len(profiles) // columns)
    figure = style.new_figure(11.0, 2.75 * rows)
    grid = style.panels(figure, rows, columns, (0.92, 0.14, 0.5, 0.34), (0.92, 0.76))
    for place, profile in enumerate(profiles):
        plot_profile(profile, figure.add_subplot(grid[place]))
    return figure


def plot_profile(profile: Profile1D, ax: Axes) -> Axes:
    """Means of both components with their standard errors."""
    style.dress(ax, grid=True)
    shift = 0.006 * np.ptp(profile.centres)
    looks = ((style.BLUE, "o", -shift), (style.ORANGE, "s", shift))
    for name, means, (colour, marker, aside) in zip(
        profile.names, profile.means, looks, strict=True
    ):
        at = profile.centres + aside
        ax.errorbar(
            at, means, profile.errors, color=colour, marker=marker, label=name, **style.BARS
        )
    style.about_zero(ax)
    style.label(ax, profile.title, profile.label, "mean residual [px]")
    return ax


_BAND = 0.95
_COLUMNS = 4
_NEES_BINS = 30


def plot_validation(validation: Validation) -> Figure:
    """Rank curves of every quantity with their simultaneous 95 % bands, coverage, and NEES against
    chi-square.

    A rank curve is the empirical distribution of the truth's rank minus the uniform one. High on
    the left and low on the right means that intervals are too narrow, the reverse that they are too
    wide; a curve to one side, that estimates are too high (above zero) or too low.
    """
    n_panels = len(validation.quantities) + 2
    rows = -(-n_panels // _COLUMNS)
    figure = style.new_figure(11.0, 0.5 + 2.35 * rows)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    names = _symbols(validation)
    for i, name in enumerate(names):
        _rank_panel(panels[i], validation, i, name)
        if i % _COLUMNS == 0:
            style.label(panels[i], y="fraction below − expected")
    _coverage_panel(panels[len(names)], validation, names)
    _nees_panel(panels[len(names) + 1], validation)
    for spare in panels[n_panels:]:
        spare.set_axis_off()
    return figure


def _symbols(validation: Validation) -> list[str]:
    specs = (*parameters(validation.camera.distortion), sigma_parameter(False))
    known = {p.name for p in specs}
    return [symbol(q) if q in known else q.replace("_", " ") for q in validation.quantities]


def _rank_panel(ax: Axes, validation: Validation, i: int, name: str) -> None:
    style.dress(ax)
    n, n_values = validation.n_replicates, validation.n_ranked + 1
    z, lower, upper = uniformity_band(n, n_values, _BAND)
    at = np.concatenate([[0.0], z, [1.0]])

    def ended(values: FloatArray) -> FloatArray:
        return np.concatenate([[0.0], values - z, [0.0]])

    outside = bool(validation.rank_p_value[i] < 1.0 - _BAND)
    style.band(ax, at, ended(lower), ended(upper), style.LIGHT)
    ax.axhline(0.0, color=style.GREY, linewidth=0.7)
    curve = ended(counts_below(validation.ranks[:, i], n_values) / n)
    ax.plot(at, curve, color=style.VERMILLION if outside else style.BLUE, linewidth=1.3)
    reach = 1.15 * max(np.max(np.abs(curve)), np.max(upper - z))
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(-reach, reach)
    style.label(ax, f"{name}:  p {_p(validation.rank_p_value[i])}", "rank of the truth / draws")


def _coverage_panel(ax: Axes, validation: Validation, names: list[str]) -> None:
    style.dress(ax)
    place = np.arange(len(names))[::-1]
    low, high = 100.0 * validation.coverage_interval.T
    outside = (low > 95.0) | (high < 95.0)
    ax.axvline(95.0, color=style.GREY, linewidth=0.9)
    for some, colour in ((~outside, style.BLUE), (outside, style.VERMILLION)):
        ax.hlines(place[some], low[some], high[some], color=colour, linewidth=1.3)
        ax.plot(100.0 * validation.coverage[some], place[some], "o", color=colour, markersize=3.5)
    ax.set_yticks(place, [name.replace("log likelihood", "log lik.") for name in names])
    ax.set_ylim(-0.6, len(names) - 0.4)
    style.label(ax, "Coverage of 95 % intervals", "replicates [%], with 95 % interval")


def _nees_panel(ax: Axes, validation: Validation) -> None:
    from scipy.stats import chi2

    style.dress(ax)
    p = validation.n_parameters
    # What lies beyond is counted in the last bar, so that one outlier does not flatten all others.
    end = float(chi2.ppf(1.0 - 1e-4, p))
    edges = np.linspace(0.0, end, _NEES_BINS + 1)
    counts, _ = np.histogram(np.minimum(validation.nees, end * (1.0 - 1e-9)), edges)
    width = edges[1]
    heights = counts / (validation.n_replicates * width)
    ax.bar(edges[:-1], heights, width, align="edge", color=style.SKY, edgecolor="white")
    grid = np.linspace(0.0, end, 200)
    ax.plot(
        grid, chi2.pdf(grid, p), color=style.INK, linewidth=1.2, label=f"chi-square, {p} d.o.f."
    )
    ax.set_xlim(0.0, end)
    ax.set_yticks([])
    style.legend(ax, loc="upper right")
    ratio = fixed(validation.nees_ratio, 3 if validation.nees_ratio < 2.0 else 1)
    style.label(
        ax, f"NEES/{p} = {ratio}:  p {_p(validation.nees_p_value)}", "normalised squared error"
    )


def _p(value: float) -> str:
    return "< 0.0001" if value < 1e-4 else f"= {significant(value)}"
