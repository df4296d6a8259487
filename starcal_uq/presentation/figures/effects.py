"""What effects of a calibration do, each in a panel of its own, and how large they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.formatting import join_words, plural, plus_minus
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.effect_curves import (
    EffectCurve,
    FoundZeniths,
    effect_curves,
    found_zeniths,
)
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.scales import symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.likelihood.fitted_effects import Effects
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.site import Site

_COLOURS = (style.BLUE, style.VERMILLION, style.GREEN)
_MARKERS = "osD"
_MAPS = ("axes", "field", "radial")
_COLUMNS, _WIDTH_IN, _HEIGHT_IN = 3, 3.9, 3.4
_GRID, _ARROWS = 41, 9
# Points above which each is drawn as a dot without its interval.
_MOST_BARS = 200
# Shorter shifts are none.
_LEAST_PX = 1e-4
_TITLES = {
    "axes": "Shift by the axes",
    "field": "Shift by the field",
    "radial": "Shift along the radius",
    "frame": "Frames: scale and shears",
    "temperature": "Change with the temperature",
    "time": "Change over the run",
    "epoch": "Offsets of the nights",
    "star": "Offsets of the stars",
    "phase": "Shift with the pixel phase",
    "magnitude": "Shift with the magnitude",
}


def plot_effects(
    cal: Calibration,
    obs: Observations,
    names: str | Sequence[str] | None = None,
    site: Site | None = None,
) -> Figure:
    """What each effect does, with one standard deviation, and the scales of all.

    Parameters
    ----------
    cal, obs
        A calibration with effects, and its table.
    names : str or sequence of str, optional
        Effects to draw; all of them, with their scales, by default.
    site : Site, optional
        Where the camera stood, if that is known: its zenith is drawn beside the one found.

    Raises
    ------
    CalibrationError
        Where the calibration lacks such an effect.
    """
    panels = _panels(cal, obs, names, site)
    columns = min(len(panels), _COLUMNS)
    rows = -(-len(panels) // columns)
    figure = style.new_figure(_WIDTH_IN * columns, _HEIGHT_IN * rows)
    for number, draw in enumerate(panels, start=1):
        draw(style.dress(figure.add_subplot(rows, columns, number)))
    return figure


def plot_fitted_effects(cal: Calibration, obs: Observations) -> Figure | None:
    """`plot_effects`; None where no shift was fitted."""
    return plot_effects(cal, obs) if cal.effects is not None and cal.effects.fitted else None


def plot_effect_scales(effects: Effects, ax: Axes | None = None) -> Axes:
    """Scale of every effect with its 95 % interval, and the shift that it explains."""
    ax = style.panel(ax, 4.6, 1.3 + 0.35 * len(effects.fitted))
    place = np.arange(len(effects.fitted))
    scale, low, high, size = np.array(
        [(e.scale_px, e.low_px, e.high_px, e.size_px) for e in effects.fitted]
    ).T
    told = low < high
    bars = np.stack([scale - low, high - scale])[:, told]
    look: AnyDict = style.BARS | {
        "marker": "o",
        "color": style.BLUE,
        "label": "scale, 95 % interval",
    }
    ax.errorbar(scale[told], place[told], xerr=bars, **look)
    hollow: AnyDict = {"markersize": 6.0, "markerfacecolor": "none", "linestyle": "none"}
    ax.plot(size, place, marker="D", color=style.VERMILLION, label="shift rms", **hollow)
    style.log_scale(ax.xaxis)
    reach = np.log10(np.maximum([*low[told], *high[told], *size], _LEAST_PX))
    ax.set_xlim(10.0 ** np.floor(reach.min()), 10.0 ** np.ceil(reach.max()))
    ax.set_yticks(place, [effect.name for effect in effects.fitted])
    ax.set_ylim(len(place) - 0.4, -1.2)
    style.legend(ax, loc="upper left", ncols=2, columnspacing=1.0, handletextpad=0.2)
    style.label(ax, "Scales (1 σ at the corner)", "px")
    return ax


def _panels(
    cal: Calibration, obs: Observations, names: str | Sequence[str] | None, site: Site | None
) -> list[Callable[[Axes], object]]:
    """What draws each panel."""
    found = cal.effects
    held = () if found is None else found.names
    if found is None or not held:
        raise CalibrationError(
            "the calibration holds no effects: calibrate with effects='auto', or name some."
        )
    wanted = held if names is None else (names,) if isinstance(names, str) else tuple(names)
    for name in wanted:
        if name not in held:
            raise CalibrationError(
                f"the calibration holds no effect {name!r}: it holds {join_words(held)}."
            )
    every: dict[str, Callable[[Axes], object]] = {name: partial(_map, cal, name) for name in _MAPS}
    every |= {curve.effect: partial(_curve, curve) for curve in effect_curves(cal, obs)}
    sky = found_zeniths(cal, _true_zeniths(obs, site)) if "zenith" in wanted else None
    if sky is not None:
        every["zenith"] = partial(_sky, found, sky)
    panels = [every[name] for name in wanted if name in every]
    if names is None or not panels:
        panels.append(partial(plot_effect_scales, found))
    return panels


def _true_zeniths(obs: Observations, site: Site | None) -> FloatArray | None:
    from starcal_uq.sky.refraction import site_among_stars

    if site is None or obs.time_utc is None:
        return None
    return site_among_stars(site, obs.time_utc[obs.frame_starts[:-1]])[0]


def _map(cal: Calibration, name: str, ax: Axes) -> None:
    """Arrows of the shift over its standard deviation."""
    sides = cal.camera.width_px, cal.camera.height_px
    x, y = (np.linspace(0.0, side - 1.0, _GRID) for side in sides)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    shift, covariance = cal.displacement(pixels.reshape(-1, 2), (name,))
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2)).reshape(_GRID, _GRID)
    of = np.maximum(sigma, 1e-2 * sigma.max())
    style.filled(ax, x, y, sigma, _TITLES[name], "1 σ of the shift [px]", of)
    step = (_GRID - 1) // (_ARROWS - 1)
    some = slice(step // 2, None, step)
    style.arrows(ax, x[some], y[some], shift.reshape(_GRID, _GRID, 2)[some, some], " px")


def _curve(curve: EffectCurve, ax: Axes) -> None:
    """Lines with their bands, or points with their bars, one standard deviation."""
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)
    apart = 0.0 if curve.joined else 0.006 * float(np.ptp(curve.x))
    many = len(curve.x) > _MOST_BARS
    for i, (name, value, sigma) in enumerate(
        zip(curve.names, curve.values, curve.sigmas, strict=True)
    ):
        look: AnyDict = {"color": _COLOURS[i], "label": symbol(name)}
        if curve.joined:
            ax.plot(curve.x, value, linewidth=1.4, **look)
            style.band(ax, curve.x, value - sigma, value + sigma, _COLOURS[i], alpha=0.22)
        elif many:
            ax.plot(curve.x, value, ".", markersize=2.0, rasterized=True, **look)
        else:
            at = curve.x + (i - 0.5 * (len(curve.names) - 1)) * apart
            ax.errorbar(at, value, sigma, marker=_MARKERS[i], **(style.BARS | look))
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.22 * (high - low))
    style.legend(ax, loc="upper left", ncols=3, columnspacing=1.0, handletextpad=0.4)
    if curve.against in ("night", "frame, in order"):
        ax.locator_params(axis="x", integer=True)
    where = f", {curve.place}" if curve.place else ""
    what = "change" if curve.names[0] == "x0" else "shift"
    spread = f"; median 1 σ {np.median(curve.sigmas):.2g} px" if many else ""
    style.label(ax, _TITLES[curve.effect], curve.against + spread, f"{what} [px{where}]")


def _sky(effects: Effects, sky: FoundZeniths, ax: Axes) -> None:
    """Zeniths found, boresights, and the zenith of the site."""
    dot: AnyDict = {"linestyle": "none", "markersize": 4.0}
    ax.plot(*sky.boresights.T, marker="s", color=style.GREY, label="boresights", **dot)
    sigma = np.sqrt(np.diagonal(sky.covariances, axis1=1, axis2=2)).T
    look: AnyDict = style.BARS | {"marker": "o", "color": style.BLUE, "label": "zenith found, 1 σ"}
    x, y = sky.zeniths.T
    ax.errorbar(x, y, xerr=sigma[0], yerr=sigma[1], **look)
    if len(sky.truth):
        ring: AnyDict = dot | {"markersize": 9.0, "markerfacecolor": "none", "markeredgewidth": 1.4}
        ax.plot(
            *sky.truth.T, marker="o", color=style.VERMILLION, label="zenith of the site", **ring
        )
    every = np.concatenate([sky.boresights, sky.zeniths, sky.truth])
    reach = 1.2 * float(np.abs(every).max())
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, 1.6 * reach)
    ax.set_aspect("equal")
    style.legend(ax, loc="upper left", handletextpad=0.2)
    title = f"Zenith of {plural(len(sky.zeniths), 'frame')}"
    if effects.air is not None:
        title += f", air {plus_minus(effects.air.density, effects.air.density_std)}"
    style.label(ax, title, "to the east [deg]", "to the north [deg]")
