"""Prior and posterior side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import pretty_unit
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.marginals import (
    histogram,
    limits,
    sampled_names,
    scaled_draws,
    sparse,
    truth_marks,
)
from starcal_uq.presentation.figures.scales import AxisScale

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from starcal_uq.camera.camera import Camera
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.inference.priors import Priors


def plot_prior_posterior(post: Posterior, truth: Camera | None = None) -> Figure:
    """Prior and posterior of every parameter: on the scale of the prior (above) and of the posterior (below).

    The upper row shows how much the data said, the lower row that the prior is flat where the posterior lives.
    """
    names = sampled_names(post)
    scales, columns = scaled_draws(post)
    marks = truth_marks(truth, names, scales)
    figure = style.new_figure(1.0 + 1.75 * len(names), 4.1)
    grid = figure.add_gridspec(2, len(names))
    for i, name in enumerate(names):
        parameter = post.parameters[post.sampled[i]]
        upper = style.dress(figure.add_subplot(grid[0, i]))
        wide = _prior_grid(post.priors, name, columns[i], scales[i])
        density = _relative_prior(post.priors, name, wide)
        upper.plot(wide / parameter.scale, density, color=style.GREEN, linewidth=1.5, dashes=(4, 1.5))
        upper.axvline(
            float(np.mean(columns[i]) * scales[i].factor + scales[i].reference) / parameter.scale,
            color=style.BLUE,
            linewidth=1.5,
        )
        upper.set_title(parameter.latex, fontsize=style.TITLE_SIZE, color=style.INK, pad=5)
        upper.set_xlabel(_unit(parameter.scaled_unit), fontsize=style.TICK_SIZE, color=style.INK)
        sparse(upper, y=False)
        lower = style.dress(figure.add_subplot(grid[1, i]))
        ends = limits(columns[i])
        histogram(lower, columns[i], ends, None, i, marks[i])
        near = np.linspace(*ends, 60)
        height = _relative_prior(post.priors, name, near * scales[i].factor + scales[i].reference)
        # The prior's own density in this unit would lie on the axis: only its slope can be shown.
        lower.plot(near, 0.5 * height, color=style.GREEN, linewidth=1.5, dashes=(4, 1.5))
        lower.set_xlim(*ends)
        lower.set_xlabel(scales[i].label, fontsize=style.TICK_SIZE, color=style.INK)
        sparse(lower, y=False)
        if i == 0:
            upper.set_ylabel("scale of\nthe prior", fontsize=style.LABEL_SIZE, color=style.INK)
            lower.set_ylabel("scale of\nthe posterior", fontsize=style.LABEL_SIZE, color=style.INK)
    _prior_key(figure, truth is not None)
    return figure


def _relative_prior(priors: Priors, name: str, values: FloatArray) -> FloatArray:
    """Prior density relative to its largest value on the grid; flat where it underflows all over."""
    density = priors.marginal_density(name, values)
    return density / density.max() if density.max() > 0.0 else np.ones_like(density)


def _prior_grid(priors: Priors, name: str, column: FloatArray, scale: AxisScale) -> FloatArray:
    centre = float(np.mean(column) * scale.factor + scale.reference)
    if name.startswith("sigma"):
        top = max(1.4 * centre, priors.sigma_median * np.exp(1.2 * priors.sigma_log_sd))
        return np.asarray(np.linspace(top / 400, top, 400))
    mean, sd = float(priors.mean((name,))[0]), float(priors.sd((name,))[0])
    return np.asarray(np.linspace(min(mean - 3 * sd, centre - 0.3 * sd), max(mean + 3 * sd, centre + 0.3 * sd), 300))


def _prior_key(figure: Figure, truth: bool) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=style.GREEN, dashes=(4, 1.5), linewidth=1.5, label="prior (below: its slope only)"),
        Line2D([], [], color=style.BLUE, linewidth=1.5, label="posterior"),
    ]
    if truth:
        handles.append(Line2D([], [], color=style.VERMILLION, linewidth=1.3, label="truth of the simulation"))
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncols=3,
        fontsize=style.LABEL_SIZE,
        frameon=False,
        labelcolor=style.INK,
    )


def _unit(text: str) -> str:
    return f"[{pretty_unit(text)}]" if pretty_unit(text) else ""
