"""Figure of the attitude error by contributor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.formatting import percent, significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.estimation import plot_residual_map
from starcal_uq.presentation.figures.scales import round_below
from starcal_uq.propagation.attitude_error import IF_MODEL_HOLDS, NOT_ASSESSED, WITH_MISFIT_FOUND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.distortion import DistortionCurve
    from starcal_uq.propagation.field import FieldMap
    from starcal_uq.propagation.spectrum import ErrorSpectrum
    from starcal_uq.propagation.thermal import ThermalError


def plot_attitude(error: AttitudeError, ax: Axes | None = None) -> Axes:
    """Bars of the three contributions to the attitude error per axis, 1 sigma, arcsec, on a log
    axis.

    Bars and their numbers are with the misfit found, lines across them if the model holds; open
    bars are not assessed.
    """
    ax = style.panel(ax, 7.2, 3.4, grid=True)
    series = (
        ("centroid noise (NEA)", style.SKY, ""),
        ("calibration, common", style.ORANGE, "//"),
        ("calibration, rest", style.GREEN, ".."),
    )
    held, values = (v[:3, :3] for v in (error.if_model_holds_arcsec, error.headline_arcsec))
    tested = error.misfit is not None
    positive = np.concatenate([values[values > 0], held[held > 0]])
    floor = 10.0 ** np.floor(np.log10(positive.min() * 0.7)) if positive.size else 1e-3
    place = np.arange(len(error.axes))
    for i, (name, colour, hatch) in enumerate(series):
        at = place + (i - 1) * 0.27
        look: AnyDict = {"color": colour, "edgecolor": "white"}
        if not tested:
            look = {"color": "none", "edgecolor": colour}
        ax.bar(at, np.maximum(values[i], floor), width=0.25, hatch=hatch, label=name, **look)
        for x, value, first in zip(at, values[i], held[i], strict=True):
            if tested:
                ax.plot(
                    [x - 0.125, x + 0.125], [max(first, floor)] * 2, color=style.INK, linewidth=1.6
                )
            top = (x, max(value, floor))
            style.note(ax, f"{significant(value)}″", top, (0, 3), ha="center")
    style.log_scale(ax.yaxis)
    ax.set_ylim(floor, 3.0 * positive.max(initial=floor if positive.size else 1.0))
    ax.set_xticks(place, error.axes, fontsize=style.LABEL_SIZE)
    ax.tick_params(axis="x", length=0)
    ax.grid(False, axis="x")
    style.legend_on_top(ax, columnspacing=1.4)
    which = f"bars: {WITH_MISFIT_FOUND}; lines: {IF_MODEL_HOLDS}"
    if not tested:
        which = f"{IF_MODEL_HOLDS}; {WITH_MISFIT_FOUND}: {NOT_ASSESSED}"
    words = "\n".join(filter(None, (which, _interaction_words(error))))
    style.label(ax, "", words, "1 sigma [arcsec]")
    return ax


def _interaction_words(error: AttitudeError) -> str:
    """The interaction is far too small for a bar beside the others."""
    values = np.asarray(getattr(error, "interaction_arcsec", np.nan))
    if not np.isfinite(values).all():
        return ""
    return (
        f"interaction of calibration and noise: at most {significant(values.max())}″ on "
        "any axis (not drawn)"
    )


_STARS_SHOWN = 600
# Ellipses along each side (about), and the share of the space between them that the largest
# semi-axis takes.
_ELLIPSES = 6
_FILL = 0.46


def plot_field_map(field: FieldMap) -> Figure:
    """Direction uncertainty over the detector: absolute, and after the best constant rotation is
    removed.

    Colours are the 1-sigma error per axis, root mean square of the two; ellipses are the 1-sigma
    ellipses, enlarged from panel to panel by the factor that the key shows. A map of an earlier
    version has no ellipses.
    """
    shape = float(np.ptp(field.y_px) / np.ptp(field.x_px))
    figure = style.new_figure(11.0, 0.88 + 3.76 * shape)
    left, right = figure.subplots(1, 2)
    _panel(left, field, field.sigma_absolute_arcsec, field.covariance_absolute_arcsec2, "Absolute")
    title = "Best constant rotation removed"
    known = field.covariance_compensated_arcsec2
    _panel(right, field, field.sigma_compensated_arcsec, known, title)
    return figure


def glance_attitude(error: AttitudeError) -> Axes:
    """The bars of `plot_attitude` for a first page, which says what else there is to say."""
    ax = plot_attitude(error, style.new_axes(4.9, 3.1))
    style.legend_on_top(ax, columnspacing=0.8, handlelength=1.2)
    ax.set_xlabel("")
    return ax


def glance_residuals(cal: Calibration, obs: Observations) -> Axes | None:
    """Mean residuals over the detector for a first page; None of residuals that are summed."""
    if not len(cal.residuals_px):
        return None
    ax = plot_residual_map(cal, obs, style.new_axes(3.1, 3.1))
    style.label(ax, "", "x [px]")
    ax.set_title("", loc="left")
    return ax


def glance_field(field: FieldMap) -> Axes:
    """Uncertainty of directions without the best constant rotation, for the first page."""
    ax = style.new_axes(3.5, 3.1)
    _panel(ax, field, field.sigma_compensated_arcsec, None, "", "")
    return ax


def _panel(
    ax: Axes,
    field: FieldMap,
    values: FloatArray,
    covariance: FloatArray | None,
    title: str,
    scale: str = "1 sigma per axis [arcsec]",
) -> None:
    x, y = field.x_px, field.y_px
    _, levels = style.filled(ax, x, y, values, title, scale)
    ax.contour(x, y, values, levels=levels[1:-1], colors="white", linewidths=0.5)
    # A sample is enough to show where stars were, and evenly spaced rows are a sample.
    some = slice(None, None, max(1, len(field.star_x_px) // _STARS_SHOWN))
    ax.scatter(
        field.star_x_px[some], field.star_y_px[some], s=2.0, color="white", alpha=0.45, linewidths=0
    )
    if covariance is not None:
        _ellipses(ax, x, y, covariance)


def _ellipses(ax: Axes, x: FloatArray, y: FloatArray, covariance: FloatArray) -> None:
    """1-sigma ellipses in the middle of equal cells, drawn at one scale, and a key that says
    which.
    """
    from matplotlib.collections import EllipseCollection

    columns, rows = (_middles(axis) for axis in (x, y))
    chosen = covariance[np.ix_(rows, columns)].reshape(-1, 2, 2)
    centres = np.column_stack([grid.ravel() for grid in np.meshgrid(x[columns], y[rows])])
    values, vectors = np.linalg.eigh(chosen)
    semi = np.sqrt(np.maximum(values, 0.0))
    if not semi.max() > 0.0:
        return
    spacing = min(
        abs(float(axis[1] - axis[0])) * (lines[1] - lines[0])
        for axis, lines in ((x, columns), (y, rows))
    )
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
    length = round_below(largest)
    share = length * scale / np.ptp(ax.get_xlim())
    ax.plot(
        [1.0 - share, 1.0],
        [1.022, 1.022],
        color=style.INK,
        linewidth=1.6,
        transform=ax.transAxes,
        clip_on=False,
    )
    style.note(
        *(ax, f"semi-axis {significant(length, 1)}″", (1.0 - share, 1.022), (-5, 0)),
        xycoords="axes fraction",
        ha="right",
        va="center",
        annotation_clip=False,
    )


# A longer profile is drawn in minutes.
_MINUTES = 10.0
_COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
_DASHES = ("-", "--", "-")
_BINS_PER_DECADE = 10
# A spectrum is shown over so many decades below its top; what lies deeper is rounding.
_DECADES = 9.0


def plot_spectrum(spectrum: ErrorSpectrum, ax: Axes | None = None) -> Axes:
    """Power spectral density of the frame-dependent part per axis, over the white floor of centroid
    noise.
    """
    ax = style.panel(ax, 7.2, 4.2, grid=True)
    f = spectrum.frequency_hz
    top, bottom = 0.0, np.inf
    for i, axis in enumerate(spectrum.axes):
        x, y = _binned(f, spectrum.psd_arcsec2_hz[:, i])
        rest = significant(spectrum.rest_arcsec[i])
        ax.plot(x, y, _DASHES[i], color=_COLOURS[i], lw=1.5, label=f"calibration, {axis}: {rest}″")
        top, bottom = max(top, float(y.max())), min(bottom, y[y > 0.0].min(initial=np.inf))
    for names, members in (("across the boresight", [0, 1]), ("roll", [2])):
        level = float(np.mean(spectrum.nea_psd_arcsec2_hz[members]))
        nea = significant(np.sqrt(np.mean(spectrum.nea_arcsec[members] ** 2)))
        ax.plot(f[[0, -1]], [level, level], ":", color=style.INK, lw=1.3)
        words = f"centroid noise, {names}: {nea}″ a frame"
        style.note(ax, words, (f[-1], level), (-4, 3), ha="right")
        top = max(top, level)
    style.log_scale(ax.xaxis)
    style.log_scale(ax.yaxis)
    ax.set_xlim(f[0], f[-1])
    ax.set_ylim(max(bottom * 0.5, top * 10.0**-_DECADES), top * 8.0)
    style.legend_on_top(ax, columnspacing=1.4)
    style.label(ax, "", "frequency [Hz]", "power spectral density [arcsec²/Hz]")
    return ax


def plot_thermal(error: ThermalError) -> Figure:
    """Temperature of the optics over time, and the attitude error that it causes: across the
    boresight and in roll, with one camera for all temperatures and with effects aboard.
    """
    figure = style.new_figure(7.2, 4.4)
    panels = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 2.0))
    above, below = (style.dress(ax, grid=True) for ax in panels)
    time, unit = error.profile.time_s, "s"
    if np.ptp(time) > _MINUTES * 60.0:
        time, unit = time / 60.0, "min"
    style.band(above, time[[0, -1]], error.lowest_c, error.highest_c, style.SKY, alpha=0.35)
    above.plot(time, error.profile.temperature_c, color=style.INK, lw=1.4)
    above.axhline(error.aligned_c, color=style.VERMILLION, lw=1.0, ls=":")
    style.legend_on_top(above, handles=style.keys("temperature"), columnspacing=1.4)
    style.named(above, "temperature")
    for sizes, look, aboard in (
        (error.model_arcsec, "-", "model"),
        (error.effects_arcsec, "--", "effects"),
    ):
        across = np.sqrt(np.mean(sizes[:, :2] ** 2, axis=1))
        for values, colour, axis in (
            (across, style.BLUE, "across the boresight"),
            (sizes[:, 2], style.ORANGE, "roll"),
        ):
            below.plot(time, values, look, color=colour, lw=1.4, label=f"{axis}, {aboard} aboard")
    below.set_xlim(time[0], time[-1])
    below.set_ylim(bottom=0.0)
    style.legend_on_top(below, columnspacing=1.4, ncols=2)
    style.label(below, "", f"time [{unit}]", "1 sigma after\nalignment [arcsec]")
    return figure


def plot_error_series(spectrum: ErrorSpectrum, ax: Axes | None = None) -> Axes:
    """Standard deviation of the frame-dependent part over the posterior, at every instant, on a log
    axis.
    """
    ax = style.panel(ax, 7.2, 3.2, grid=True)
    for i, axis in enumerate(spectrum.axes):
        sigma = np.maximum(spectrum.sigma_arcsec[:, i], 1e-12)
        ax.plot(spectrum.time_s, sigma, color=_COLOURS[i], lw=0.9, label=axis)
    style.log_scale(ax.yaxis)
    shown = spectrum.sigma_arcsec[spectrum.sigma_arcsec > 0.0]
    if shown.size:
        ax.set_ylim(0.7 * np.quantile(shown, 0.002), 1.5 * shown.max())
    ax.set_xlim(spectrum.time_s[0], spectrum.time_s[-1])
    style.legend_on_top(ax)
    style.label(ax, "", "time [s]", "1 sigma of the\nframe-dependent part [arcsec]")
    return ax


def _binned(f: FloatArray, psd: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of a spectrum over bins of equal ratio; single frequencies stay as they are."""
    place = np.floor(_BINS_PER_DECADE * np.log10(f / f[0]) + 1e-9).astype(int)
    _, start, count = np.unique(place, return_index=True, return_counts=True)
    mean_f = np.exp(np.add.reduceat(np.log(f), start) / count)
    return mean_f, np.add.reduceat(psd, start) / count


_BAND_COLOURS = (
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
        colour = _BAND_COLOURS[row % len(_BAND_COLOURS)]
        left.plot(
            curve.radius_px, curve.mean_px[row], color=colour, linewidth=1.6, label=f"{azimuth:g}°"
        )
    if len(curve.azimuth_deg) > 1:
        # Azimuths differ little in the width of the band; the widest stands for all.
        style.legend(left, title="azimuth", title_fontsize=style.TICK_SIZE, ncols=2)
    widest = int(np.argmax(curve.sd_px.max(axis=1)))
    _bands(right, curve, widest)
    where = (
        ""
        if len(curve.azimuth_deg) == 1
        else f", azimuth {curve.azimuth_deg[widest]:g}° (the widest)"
    )
    for ax, title, y in (
        (left, "Distortion", "radial displacement [px]"),
        (right, f"Its uncertainty{where}", "minus the mean [px]"),
    ):
        ax.axhline(0.0, color=style.INK, linewidth=0.8)
        style.label(ax, title, "distance from the principal point [px]", y)
    return figure


def _bands(ax: Axes, curve: DistortionCurve, row: int) -> None:
    for low, high, words, colour, alpha in (
        (
            *(curve.lower_simultaneous_px, curve.upper_simultaneous_px),
            *(", whole curves", style.SKY, 0.35),
        ),
        (curve.lower_px, curve.upper_px, " at each radius", style.BLUE, 0.45),
    ):
        low, high = low[row] - curve.mean_px[row], high[row] - curve.mean_px[row]
        words = percent(curve.level) + words
        style.band(ax, curve.radius_px, low, high, colour, alpha=alpha, label=words)
    style.legend(ax, loc="upper left")
    # The scale of angles changes by a per cent over the field; one right-hand axis would lie by as
    # much.
    middle = curve.arcsec_per_px[0]
    second = ax.secondary_yaxis("right", functions=(_times(middle), _times(1.0 / middle)))
    second.set_ylabel(
        "arcsec, at the scale of the centre", fontsize=style.LABEL_SIZE, color=style.INK
    )
    second.tick_params(
        labelsize=style.TICK_SIZE, colors=style.INK, color=style.GREY, length=3.0, width=0.7
    )
    second.spines["right"].set_visible(False)


def _times(factor: float) -> Callable[[Any], Any]:
    return lambda values: values * factor


def _beyond_stars(ax: Axes, curve: DistortionCurve) -> None:
    """Grey where no star was."""
    if np.isfinite(curve.star_radius_px) and curve.star_radius_px < curve.radius_px[-1]:
        ax.axvspan(
            curve.star_radius_px,
            curve.radius_px[-1],
            color=style.LIGHT,
            alpha=0.8,
            linewidth=0,
            zorder=0,
        )
