"""Difference of two cameras over the detector, beside what was to be expected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.comparison.result import CameraComparison

_ARROWS = 9
# Share of the largest length below which all colours are the same.
_FOOT = 0.04
# Below this, arcsec, only rounding is left.
_NOTHING = 1e-9
_TIMES = (1.0, 2.0, 3.0)


def plot_camera_comparison(comparison: CameraComparison) -> Figure:
    """Arrows and size of the difference, and beside it the size that the joint uncertainty gives,
    in the same colours.

    White lines in the left panel are where the difference is one, two and three times the joint
    standard deviation of its length. Without a covariance there is the left panel alone.
    """
    tall = 1.0 + 4.05 * float(np.ptp(comparison.y_px) / np.ptp(comparison.x_px))
    figure = style.new_figure(11.0 if comparison.tested else 6.6, tall)
    panels = figure.subplots(1, 2 if comparison.tested else 1, squeeze=False)[0]
    length = np.linalg.norm(comparison.difference_arcsec, axis=-1)
    if length.max() < _NOTHING:
        length = np.zeros_like(length)
    both = np.stack([length, comparison.sigma_arcsec]) if comparison.tested else length
    # Lengths vanish at points; what is a small share of the largest has one colour.
    foot = _FOOT * float(both.max())
    of = np.maximum(both, foot)
    a, b = comparison.labels
    shown = [(length, f"{b} minus {a}")]
    if comparison.tested:
        shown.append((comparison.sigma_arcsec, "Expected from both uncertainties (1 sigma)"))
    unit = "difference of directions [arcsec]"
    for ax, (values, title) in zip(panels, shown, strict=True):
        style.filled(ax, comparison.x_px, comparison.y_px, values, title, unit, of)
    if comparison.tested:
        _multiples(panels[0], comparison)
    if length.max() > 0.0:
        _arrows(panels[0], comparison)
    return figure


def _multiples(ax: Axes, comparison: CameraComparison) -> None:
    """Contours of the difference in its standard deviations."""
    lines = ax.contour(
        comparison.x_px,
        comparison.y_px,
        comparison.ratio,
        levels=_TIMES,
        colors="white",
        linewidths=(0.9, 1.3, 1.8),
    )
    ax.clabel(lines, fmt=lambda v: f"{v:g}σ", fontsize=style.TICK_SIZE, colors="white")


def _arrows(ax: Axes, comparison: CameraComparison) -> None:
    step = max(1, (len(comparison.x_px) - 1) // (_ARROWS - 1))
    some = slice(step // 2, None, step)
    d = comparison.difference_arcsec[some, some]
    style.arrows(ax, comparison.x_px[some], comparison.y_px[some], d, "″")
