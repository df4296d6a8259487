"""Figure of a validation: where the truth lies among posterior draws, coverage, and squared errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters, sigma_parameter
from starcal_uq.core.formatting import fixed, significant
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.ranks import counts_below, uniformity_band
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.diagnostics.validation.result import Validation

_BAND = 0.95
_COLUMNS = 4
_NEES_BINS = 30


def plot_validation(found: Validation) -> Figure:
    """Rank curves of every quantity with their simultaneous 95 % bands, coverage, and NEES against chi-square.

    A rank curve is the empirical distribution of the truth's rank minus the uniform one. High on the left and low on
    the right means that intervals are too narrow, the reverse that they are too wide; a curve to one side, that
    estimates are too high (above zero) or too low.
    """
    n_panels = len(found.quantities) + 2
    rows = -(-n_panels // _COLUMNS)
    figure = style.new_figure(11.0, 0.5 + 2.35 * rows)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    names = _symbols(found)
    for i, name in enumerate(names):
        _rank_panel(panels[i], found, i, name)
        if i % _COLUMNS == 0:
            style.label(panels[i], y="fraction below − expected")
    _coverage_panel(panels[len(names)], found, names)
    _nees_panel(panels[len(names) + 1], found)
    for spare in panels[n_panels:]:
        spare.set_axis_off()
    return figure


def _symbols(found: Validation) -> list[str]:
    known = {p.name: p.latex for p in (*parameters(found.camera.distortion), sigma_parameter(False))}
    return [known.get(q, q.replace("_", " ")) for q in found.quantities]


def _rank_panel(ax: Axes, found: Validation, i: int, name: str) -> None:
    style.dress(ax)
    n, n_values = found.n_replicates, found.n_ranked + 1
    z, lower, upper = uniformity_band(n, n_values, _BAND)
    at = np.concatenate([[0.0], z, [1.0]])

    def ended(values: FloatArray) -> FloatArray:
        return np.concatenate([[0.0], values - z, [0.0]])

    outside = bool(found.rank_p_value[i] < 1.0 - _BAND)
    ax.fill_between(at, ended(lower), ended(upper), color=style.LIGHT, linewidth=0)
    ax.axhline(0.0, color=style.GREY, linewidth=0.7)
    curve = ended(counts_below(found.ranks[:, i], n_values) / n)
    ax.plot(at, curve, color=style.VERMILLION if outside else style.BLUE, linewidth=1.3)
    reach = 1.15 * max(float(np.max(np.abs(curve))), float(np.max(upper - z)))
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(-reach, reach)
    style.label(ax, f"{name}:  p {_p(found.rank_p_value[i])}", "rank of the truth / draws")


def _coverage_panel(ax: Axes, found: Validation, names: list[str]) -> None:
    style.dress(ax)
    place = np.arange(len(names))[::-1]
    low, high = 100.0 * found.coverage_interval.T
    outside = (low > 95.0) | (high < 95.0)
    ax.axvline(95.0, color=style.GREY, linewidth=0.9)
    for some, colour in ((~outside, style.BLUE), (outside, style.VERMILLION)):
        ax.hlines(place[some], low[some], high[some], color=colour, linewidth=1.3)
        ax.plot(100.0 * found.coverage[some], place[some], "o", color=colour, markersize=3.5)
    ax.set_yticks(place, [name.replace("log likelihood", "log lik.") for name in names])
    ax.set_ylim(-0.6, len(names) - 0.4)
    style.label(ax, "Coverage of 95 % intervals", "replicates [%], with 95 % interval")


def _nees_panel(ax: Axes, found: Validation) -> None:
    from scipy.stats import chi2

    style.dress(ax)
    p = found.n_parameters
    # What lies beyond is counted in the last bar, so that one outlier does not flatten all others.
    end = float(chi2.ppf(1.0 - 1e-4, p))
    edges = np.linspace(0.0, end, _NEES_BINS + 1)
    counts, _ = np.histogram(np.minimum(found.nees, end * (1.0 - 1e-9)), edges)
    width = edges[1]
    ax.bar(edges[:-1], counts / (found.n_replicates * width), width, align="edge", color=style.SKY, edgecolor="white")
    grid = np.linspace(0.0, end, 200)
    ax.plot(grid, chi2.pdf(grid, p), color=style.INK, linewidth=1.2, label=f"chi-square, {p} d.o.f.")
    ax.set_xlim(0.0, end)
    ax.set_yticks([])
    style.legend(ax, loc="upper right")
    ratio = fixed(found.nees_ratio, 3 if found.nees_ratio < 2.0 else 1)
    style.label(ax, f"NEES/{p} = {ratio}:  p {_p(found.nees_p_value)}", "normalised squared error")


def _p(value: float) -> str:
    return "< 0.0001" if value < 1e-4 else f"= {significant(float(value))}"
