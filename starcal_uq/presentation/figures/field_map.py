"""Direction uncertainty over the detector: size as colour, shape as ellipses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import significant
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.levels import round_levels, ticks_at_levels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.propagation.field import FieldMap

_STARS_SHOWN = 600
# Ellipses along each side (about), and the share of the space between them that the largest semi-axis takes.
_ELLIPSES = 6
_FILL = 0.46


def plot_field_map(field: FieldMap) -> Figure:
    """Direction uncertainty over the detector: absolute, and after the best constant rotation is removed.

    Colours are the 1-sigma error per axis, root mean square of the two; ellipses are the 1-sigma ellipses, enlarged
    from panel to panel by the factor that the key shows. A map of an earlier version has no ellipses.
    """
    # As tall as the panels, or the colour bars would outgrow them.
    figure = style.new_figure(11.0, 0.85 + 4.05 * float(np.ptp(field.y_px) / np.ptp(field.x_px)))
    left, right = figure.subplots(1, 2)
    _panel(left, field, field.sigma_absolute_arcsec, field.covariance_absolute_arcsec2, "Absolute")
    title = "Best constant rotation removed"
    _panel(right, field, field.sigma_compensated_arcsec, field.covariance_compensated_arcsec2, title)
    return figure


def _panel(ax: Axes, field: FieldMap, values: FloatArray, covariance: FloatArray | None, title: str) -> None:
    style.dress(ax)
    x, y = np.asarray(field.x_px), np.asarray(field.y_px)
    levels, norm = round_levels(values)
    image = ax.contourf(x, y, values, levels=levels, norm=norm, cmap="cividis")
    ax.contour(x, y, values, levels=levels[1:-1], colors="white", linewidths=0.5)
    # A sample is enough to show where stars were, and evenly spaced rows are a sample.
    some = slice(None, None, max(1, len(field.star_x_px) // _STARS_SHOWN))
    ax.scatter(field.star_x_px[some], field.star_y_px[some], s=2.0, color="white", alpha=0.45, linewidths=0)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[-1], y[0])
    ax.set_aspect("equal")
    style.label(ax, title, "x [px]", "y [px]")
    bar = style.colour_bar(ax, image, "1 sigma per axis [arcsec]")
    ticks_at_levels(bar, levels)
    if covariance is not None:
        _ellipses(ax, x, y, covariance)


def _ellipses(ax: Axes, x: FloatArray, y: FloatArray, covariance: FloatArray) -> None:
    """1-sigma ellipses in the middle of equal cells, drawn at one scale, and a key that says which."""
    from matplotlib.collections import EllipseCollection

    columns, rows = (_middles(axis) for axis in (x, y))
    chosen = covariance[np.ix_(rows, columns)].reshape(-1, 2, 2)
    centres = np.column_stack([grid.ravel() for grid in np.meshgrid(x[columns], y[rows])])
    values, vectors = np.linalg.eigh(chosen)
    semi = np.sqrt(np.maximum(values, 0.0))
    if not semi.max() > 0.0:
        return
    spacing = min(abs(float(axis[1] - axis[0])) * (lines[1] - lines[0]) for axis, lines in ((x, columns), (y, rows)))
    scale = _FILL * spacing / float(semi.max())
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    for colour, width in (("white", 2.6), (style.INK, 1.1)):
        ax.add_collection(
            EllipseCollection(
                2.0 * scale * semi[:, 1],
                2.0 * scale * semi[:, 0],
                angle,
                facecolors="none",
                edgecolors=colour,
                linewidths=width,
                units="xy",
                offsets=centres,
                offset_transform=ax.transData,
            )
        )
    _key(ax, scale, float(semi.max()))


def _middles(axis: FloatArray) -> list[int]:
    """Evenly spaced grid lines, as far from the edges as half their distance or nearly so."""
    step = max(1, round((len(axis) - 1) / _ELLIPSES))
    count = max(2, (len(axis) - 1) // step)
    first = (len(axis) - 1 - step * (count - 1)) // 2
    return [first + step * place for place in range(count)]


def _key(ax: Axes, scale: float, largest: float) -> None:
    """A bar of a round length above the panel's right end, with its value."""
    exponent = np.floor(np.log10(largest))
    length = max(step * 10.0**exponent for step in (1.0, 2.0, 5.0) if step * 10.0**exponent <= largest)
    share = length * scale / float(np.ptp(ax.get_xlim()))
    ax.plot([1.0 - share, 1.0], [1.022, 1.022], color=style.INK, linewidth=1.6, transform=ax.transAxes, clip_on=False)
    ax.annotate(
        f"semi-axis {significant(length, 1)}″",
        (1.0 - share, 1.022),
        xycoords="axes fraction",
        xytext=(-5, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=style.TICK_SIZE,
        color=style.INK,
        annotation_clip=False,
    )
