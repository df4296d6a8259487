"""Figure of the attitude error by contributor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import significant
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from starcal_uq.propagation.attitude_error import AttitudeError


def plot_attitude(error: AttitudeError, ax: Axes | None = None) -> Axes:
    """Bars of the three contributions to the attitude error per axis, 1 sigma, arcsec, on a log axis."""
    if ax is None:
        ax = style.new_axes(7.2, 3.4)
    style.dress(ax, grid=True)
    series = (
        ("centroid noise (NEA)", error.nea_arcsec, style.SKY, ""),
        ("calibration, common", error.common_arcsec, style.ORANGE, "//"),
        ("calibration, rest", error.rest_arcsec, style.GREEN, ".."),
    )
    values = np.array([np.asarray(v, dtype=np.float64) for _, v, _, _ in series])
    positive = values[values > 0]
    floor = 10.0 ** np.floor(np.log10(positive.min() * 0.7)) if positive.size else 1e-3
    place = np.arange(len(error.axes))
    for i, (name, _, colour, hatch) in enumerate(series):
        at = place + (i - 1) * 0.27
        ax.bar(at, np.maximum(values[i], floor), width=0.25, color=colour, hatch=hatch, edgecolor="white", label=name)
        for x, value in zip(at, values[i], strict=True):
            ax.annotate(
                f"{significant(float(value))}″",
                (x, max(value, floor)),
                xytext=(0, 3),
                ha="center",
                textcoords="offset points",
                fontsize=style.TICK_SIZE,
                color=style.INK,
            )
    ax.set_yscale("log")
    ax.set_ylim(floor, max(float(positive.max()) if positive.size else 1.0, floor) * 3.0)
    ax.set_xticks(place, error.axes, fontsize=style.LABEL_SIZE)
    ax.tick_params(axis="x", length=0)
    ax.grid(False, axis="x")
    style.legend(ax, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=3, columnspacing=1.4)
    style.label(ax, "", _interaction_words(error), "1 sigma [arcsec]")
    return ax


def _interaction_words(error: AttitudeError) -> str:
    """The interaction is far too small for a bar beside the others."""
    values = np.asarray(getattr(error, "interaction_arcsec", np.nan))
    if not np.isfinite(values).all():
        return ""
    return f"interaction of calibration and noise: at most {significant(float(values.max()))}″ on any axis (not drawn)"
