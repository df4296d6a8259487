"""Correlation heat maps and the price of coupling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import significant
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import symbol
from starcal_uq.presentation.words.numbers import correlation_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from starcal_uq.propagation.coupling import Coupling

# A small map of so many parameters still shows their numbers.
_MOST_NUMBERED = 5


def plot_correlation(coupling: Coupling, ax: Axes | None = None, *, extended: bool = False) -> Axes:
    """Heat map of the correlation matrix with its numbers.

    Parameters
    ----------
    coupling
        Result of `starcal_uq.coupling`.
    ax
        Where to draw; a new figure if not given.
    extended
        With the constant attitude errors pitch, yaw and roll that the parameters cause.
    """
    names = coupling.extended_names if extended else coupling.parameter_names
    if ax is None:
        side = 1.4 + 0.62 * len(names)
        ax = style.new_axes(side + 0.8, side)
    image = _extended(ax, coupling) if extended else heat_map(ax, coupling.correlation, names)
    title = "With the constant attitude error they cause" if extended else "Camera parameters"
    style.label(ax, title, pad=24)
    style.colour_bar(ax, image, "correlation")
    return ax


def plot_correlations(coupling: Coupling) -> Figure:
    """Both matrices side by side: the camera parameters alone, and with the boresight."""
    p, q = len(coupling.parameter_names), len(coupling.extended_names)
    width, margins, across, bar = 11.0, (0.45, 0.75, 0.1, 0.62), 0.65, 0.35
    # Cells of both maps have one size.
    cell = (width - margins[0] - margins[1] - 2.0 * across) / (p + q + bar)
    figure = style.new_figure(width, q * cell + margins[2] + margins[3])
    grid = style.panels(figure, 1, 3, margins, (across, 0.0), width_ratios=(p, q, bar))
    left, right, scale = (figure.add_subplot(grid[i]) for i in range(3))
    heat_map(left, coupling.correlation, coupling.parameter_names)
    left.set_anchor("N")
    image = _extended(right, coupling)
    style.label(left, "Camera parameters", pad=24)
    style.label(right, "With the constant attitude error they cause", pad=24)
    style.dress_bar(figure.colorbar(image, cax=scale), "correlation")
    return figure


def plot_couplings(coupling: Coupling, ax: Axes | None = None) -> Axes:
    """How many times larger each sigma is because the other parameters are unknown too."""
    ax = style.panel(ax, 4.6, 2.6, grid=True)
    ratio = coupling.sigma_marginal / coupling.sigma_conditional
    rows = np.arange(len(ratio))
    ax.barh(rows, ratio, color=style.BLUE, height=0.62)
    for row, value in zip(rows, ratio, strict=True):
        style.note(ax, f"×{significant(value)}", (value, row), (4, 0), va="center")
    ax.axvline(1.0, color=style.INK, linewidth=1.0)
    ax.set_yticks(rows, [symbol(n) for n in coupling.parameter_names], fontsize=style.LABEL_SIZE)
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.18 * ratio.max())
    ax.grid(False, axis="y")
    style.label(ax, "Price of coupling", "sigma / sigma if all other parameters were known")
    return ax


def _extended(ax: Axes, coupling: Coupling) -> AxesImage:
    image = heat_map(ax, coupling.extended_correlation, coupling.extended_names)
    split = len(coupling.parameter_names) - 0.5
    ax.axhline(split, color=style.INK, linewidth=1.2)
    ax.axvline(split, color=style.INK, linewidth=1.2)
    return image


def heat_map(
    ax: Axes, matrix: FloatArray, names: Sequence[str], *, small: bool = False
) -> AxesImage:
    """Correlations with their numbers, grey where there is none; a `small` map of many parameters
    has colours alone.
    """
    image = ax.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    style.dress(ax).set_facecolor(style.LIGHT)
    ax.tick_params(top=True, labeltop=True, bottom=False, labelbottom=False)
    size = style.TICK_SIZE if small else style.LABEL_SIZE
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_ticks(range(len(names)), list(map(symbol, names)), fontsize=size)
    style.squares(ax, len(names), len(names), 1.0 if small else 1.6)
    ax.tick_params(which="minor", top=False, bottom=False, left=False)
    if small and len(names) > _MOST_NUMBERED:
        return image
    for (row, column), value in np.ndenumerate(matrix):
        colour = "white" if abs(value) > 0.62 else style.INK
        weight = "bold" if row != column and abs(value) >= 0.7 else "normal"
        text = "" if np.isnan(value) else correlation_text(value, row == column)
        look = {"color": colour, "weight": weight, "fontsize": size - 2.0 if small else size - 1.0}
        # Inside its cell: nothing for the layout to make room for.
        style.in_cell(ax, text, row, column, in_layout=False, **look)
    return image
