"""Distortion against radius: the curve, and below it the bands around its mean, which the curve would hide."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.formatting import percent
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.propagation.distortion import DistortionCurve

_COLOURS = (
    style.BLUE,
    style.ORANGE,
    style.GREEN,
    style.VERMILLION,
    style.PURPLE,
    style.SKY,
    style.INK,
    style.GREY,
)


def plot_distortion_curve(curve: DistortionCurve) -> Figure:
    """Mean radial displacement (left), and the bands around it in px and arcsec (right)."""
    figure = style.new_figure(10.4, 3.7)
    left, right = figure.subplots(1, 2)
    for ax in (left, right):
        style.dress(ax, grid=True)
        ax.set_xlim(0.0, curve.radius_px[-1])
        _beyond_stars(ax, curve)
    azimuths = curve.azimuth_deg if len(curve.azimuth_deg) > 1 else [np.nan]
    for row, azimuth in enumerate(azimuths):
        colour = _COLOURS[row % len(_COLOURS)]
        left.plot(curve.radius_px, curve.mean_px[row], color=colour, linewidth=1.6, label=f"{azimuth:g}°")
    left.axhline(0.0, color=style.INK, linewidth=0.8)
    if len(curve.azimuth_deg) > 1:
        # Azimuths differ little in the width of the band; the widest stands for all.
        style.legend(left, title="azimuth", title_fontsize=style.TICK_SIZE, ncols=2)
    widest = int(np.argmax(curve.sd_px.max(axis=1)))
    _bands(right, curve, widest)
    where = "" if len(curve.azimuth_deg) == 1 else f", azimuth {curve.azimuth_deg[widest]:g}° (the widest)"
    style.label(left, "Distortion", "distance from the principal point [px]", "radial displacement [px]")
    style.label(right, f"Its uncertainty{where}", "distance from the principal point [px]", "minus the mean [px]")
    return figure


def _bands(ax: Axes, curve: DistortionCurve, row: int) -> None:
    share = percent(curve.level)
    mean = curve.mean_px[row]
    simultaneous = (curve.lower_simultaneous_px[row] - mean, curve.upper_simultaneous_px[row] - mean)
    pointwise = (curve.lower_px[row] - mean, curve.upper_px[row] - mean)
    ax.fill_between(
        curve.radius_px, *simultaneous, color=style.SKY, alpha=0.35, linewidth=0, label=f"{share}, whole curves"
    )
    ax.fill_between(
        curve.radius_px, *pointwise, color=style.BLUE, alpha=0.45, linewidth=0, label=f"{share} at each radius"
    )
    ax.axhline(0.0, color=style.INK, linewidth=0.8)
    style.legend(ax, loc="upper left")
    # The scale of angles changes by a per cent over the field; one right-hand axis would lie by as much.
    middle = float(curve.arcsec_per_px[0])
    second = ax.secondary_yaxis("right", functions=(_times(middle), _times(1.0 / middle)))
    second.set_ylabel("arcsec, at the scale of the centre", fontsize=style.LABEL_SIZE, color=style.INK)
    second.tick_params(labelsize=style.TICK_SIZE, colors=style.INK, color=style.GREY, length=3.0, width=0.7)
    second.spines["right"].set_visible(False)


def _times(factor: float) -> Callable[[Any], Any]:
    return lambda values: values * factor


def _beyond_stars(ax: Axes, curve: DistortionCurve) -> None:
    """Grey where no star was."""
    if np.isfinite(curve.star_radius_px) and curve.star_radius_px < curve.radius_px[-1]:
        ax.axvspan(curve.star_radius_px, curve.radius_px[-1], color=style.LIGHT, alpha=0.8, linewidth=0, zorder=0)
