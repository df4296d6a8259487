"""Figures of plans: errors against number of frames, what changes them, chosen frames, and the
check of a forecast.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.budgeting.rows import confidence_text
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import count
from starcal_uq.core.types import AnyDict, FloatArray, floats
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.sweeps import (
    plain,
    small_multiples,
    target_line,
    target_words,
)
from starcal_uq.presentation.words.numbers import need_words
from starcal_uq.presentation.words.sentences import SCOPE_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.planning.check import ForecastCheck
    from starcal_uq.planning.design import FrameChoice
    from starcal_uq.planning.planned import Plan

_LINE: AnyDict = {"markersize": 4, "linewidth": 1.5}
_COLOURS = (style.ORANGE, style.GREEN, style.BLUE, style.PURPLE)
# Points of a curve that still have markers.
_MARKED = 20
_SWEEPS = {
    "magnitude limit": "faintest magnitude",
    "noise": "centroid noise [px per axis]",
    "part of the detector": "part of the detector's area used",
    "distortion": "distortion at the corner [%]",
}
# What is drawn of a check, by column.
_CHECKED = {
    "x0_px": "x₀",
    "f_px": "f",
    "distortion_corner_px": "Distortion",
    "common_pitch_arcsec": "Common rotation, pitch",
    "rest_pitch_arcsec": "Rest, pitch",
    "rest_roll_arcsec": "Rest, roll",
}


def plot_forecast(plan: Plan) -> Figure:
    """Attitude errors across the boresight and in roll, the two-axis error with the target, and the
    parameters.

    All against number of frames, on logarithmic axes. The band of the two-axis error holds 90 % of
    the campaigns, the grey one its range over the distortion that the sheet leaves open; where the
    target needs more frames than were forecast, the curve is continued with dots.
    """
    figure = style.new_figure(11.0, 7.6)
    panels = figure.subplots(2, 2)
    table = plan.to_dataframe()
    n = floats(table["n_frames"])
    parts = {
        "calibration, common rotation": "common",
        "calibration, rest": "rest",
        "centroid noise (NEA), every frame anew": "nea",
    }
    for ax, axes, title in (
        (panels[0, 0], AXES[:2], "Across the boresight, per axis"),
        (panels[0, 1], AXES[2:], "Roll"),
    ):
        squares = {
            words: table[[f"{part}_{axis}_arcsec" for axis in axes]] ** 2
            for words, part in parts.items()
        }
        _curves(ax, n, {words: np.sqrt(square.mean(axis=1)) for words, square in squares.items()})
        style.label(ax, title, "frames", "1 sigma [arcsec]")
    style.legend_above(figure, panels[0, 0].get_lines())
    _radius_panel(panels[1, 0], plan, n)
    sigmas = {
        "principal point, per axis": np.hypot(table["x0_px"], table["y0_px"]) / np.sqrt(2.0),
        "focal length": table["f_px"],
    }
    if "distortion_corner_px" in table:
        sigmas["distortion, at the farthest corner"] = table["distortion_corner_px"]
    _curves(panels[1, 1], n, sigmas)
    style.legend(panels[1, 1], loc="lower left", bbox_to_anchor=(0.0, 0.0))
    style.label(panels[1, 1], "Parameters", "frames", "1 sigma [px]")
    return figure


def _curves(ax: Axes, x: FloatArray, curves: Mapping[str, Any]) -> None:
    """Curves by their words, on logarithmic axes in plain numbers."""
    _logarithmic(ax)
    markers = "os^D" if len(x) <= _MARKED else " " * len(curves)
    for (words, values), colour, marker in zip(curves.items(), _COLOURS, markers, strict=False):
        ax.plot(x, values, color=colour, marker=marker, label=words, **_LINE)
    _plain_ticks(ax)


def _radius_panel(ax: Axes, plan: Plan, n: FloatArray) -> None:
    _logarithmic(ax)
    found = plan.forecast
    if plan.distortion is not None:
        radii = plan.distortion.radius_arcsec
        style.band(ax, n, radii.min(axis=0), radii.max(axis=0), style.LIGHT, zorder=0)
    style.band(ax, n, found.radius_low, found.radius_high, style.BLUE, alpha=0.2)
    ax.plot(n, found.radius, color=style.BLUE, marker="o", **_LINE)
    if plan.target_arcsec is not None:
        target_line(ax, plan.target_arcsec)
        needed = plan.frames_needed
        words = f"target {plan.target_arcsec:g} arcsec"
        if needed is not None and plan.need is not None:
            words += f": {need_words(plan.need, plan.need.frames)}"
            _continued(ax, plan, n, needed, plan.target_arcsec)
            _diamond(ax, needed, plan.target_arcsec, markersize=6, zorder=4)
        target_words(ax, plan.target_arcsec, words)
    _plain_ticks(ax)
    title = f"Two-axis error at {confidence_text(plan.confidence)}, {SCOPE_NAMES[plan.scope]}"
    style.label(ax, title, "frames", "error across the boresight [arcsec]")


def _continued(ax: Axes, plan: Plan, n: FloatArray, needed: int, target: float) -> None:
    """The curve from its nearest end to the number of frames that is needed."""
    if n[0] <= needed <= n[-1]:
        return
    place = 0 if needed < n[0] else -1
    x, y = (n[place], needed), (plan.forecast.radius[place], target)
    ax.plot(x, y, color=style.BLUE, linewidth=1.3, linestyle=":")


def _diamond(ax: Axes, x: Any, y: Any, **look: Any) -> None:
    """The plan itself."""
    ax.plot(x, y, linestyle="", marker="D", color=style.VERMILLION, **look)


def _logarithmic(ax: Axes) -> None:
    style.dress(ax, grid=True)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.minorticks_off()


def _plain_ticks(ax: Axes) -> None:
    """Numbers instead of powers of ten on both logarithmic axes."""
    plain(ax.xaxis, fine=False)
    plain(ax.yaxis, fine=False)


def plot_plan_sweeps(plan: Plan) -> Figure:
    """Frames that the target needs, with one thing changed at a time; the diamond is the plan.

    Triangles at the upper edge mark what takes more than ten million frames. Without a target, or
    with one that the plan itself cannot keep, the two-axis error after 1000 frames is drawn
    instead.
    """
    if plan.sweeps is None:
        raise ValueError("this plan was made without sweeps: call plan with sweeps=True.")
    of_frames, found = plan.frames_needed is not None, plan.distortion
    column = "frames_needed" if of_frames else "radius_arcsec"
    here = {"magnitude limit": plan.max_mag, "noise": plan.sigma_px, "part of the detector": 1.0}
    shown = {
        name: rows[["value", column]].to_numpy().T for name, rows in plan.sweeps.groupby("sweep")
    }
    if found is not None:
        drawn = found.radius_after_arcsec
        if of_frames:
            drawn = found.frames[:, found.scopes.index(plan.scope)]
        shown["distortion"] = np.stack([found.percent, drawn])
        here["distortion"] = found.percent[np.argmin(np.abs(found.percent - found.own_percent))]
    swept = [name for name in _SWEEPS if name in shown]
    figure = style.new_figure(2.0 + 3.0 * len(swept), 3.6)
    panels = figure.subplots(1, len(swept), sharey=True, squeeze=False)[0]
    target = None if of_frames else plan.target_arcsec
    for ax, name in zip(panels, swept, strict=True):
        style.dress(ax, grid=True)
        x, y = shown[name]
        ax.set_yscale("log")
        if name == "noise":
            ax.set_xscale("log")
        ax.minorticks_off()
        if name != "distortion":
            ax.set_xticks(x, [f"{value:.3g}" for value in x])
        good = np.isfinite(y)
        ax.plot(x[good], y[good], color=style.BLUE, marker="o", markersize=4.5, linewidth=1.5)
        beyond = np.full((~good).sum(), 0.97)
        edge = ax.get_xaxis_transform()
        ax.plot(x[~good], beyond, "^", color=style.GREY, markersize=6, transform=edge)
        own = good & np.isclose(x, here[name], rtol=1e-6)
        _diamond(ax, x[own], y[own], markersize=7)
        style.label(ax, "", _SWEEPS[name])
        if target is not None:
            target_line(ax, target)
    at, scope = confidence_text(plan.confidence), SCOPE_NAMES[plan.scope]
    title, words = f"Frames for {plan.target_arcsec or 0:g} arcsec at {at}, {scope}", "frames"
    if not of_frames:
        after = count(int(plan.sweeps["n_frames"].iloc[0]))
        line = "" if target is None else f"; line: target {target:g} arcsec"
        title = f"Two-axis error after {after} frames, {scope}{line}"
        words = f"error at {at} [arcsec]"
    style.label(panels[0], title, y=words)
    plain(panels[0].yaxis, fine=False)
    return figure


def plot_frame_choice(choice: FrameChoice) -> Figure:
    """Where the chosen frames point, and the criterion after each of them beside random frames."""
    figure = style.new_figure(11.0, 3.9)
    left, right = figure.subplots(1, 2, width_ratios=(1.35, 1.0))
    table = choice.to_dataframe()
    style.dress(left, grid=True)
    size = 12.0 + 60.0 * np.clip(30.0 / len(table), 0.1, 1.0)
    image = left.scatter(
        table["ra_deg"], table["dec_deg"], c=table["n_stars"], s=size, cmap="cividis", linewidths=0
    )
    left.set_xlim(360.0, 0.0)
    left.set_ylim(-90.0, 90.0)
    left.set_xticks(range(0, 361, 60))
    left.set_yticks(range(-90, 91, 30))
    style.colour_bar(left, image, "stars in the frame")
    style.label(
        left, "Boresights of the chosen frames", "right ascension [deg]", "declination [deg]"
    )

    n = np.arange(1.0, len(table) + 1.0)
    # The first frames alone hardly determine the parameters.
    first = min(3, len(n) - 1)
    paths = {"random frames, mean": choice.random_path, "chosen frames": choice.score_path}
    _curves(right, n[first:], {words: path[first:] for words, path in paths.items()})
    style.legend(right, loc="upper right")
    if choice.criterion == "D":
        style.label(right, "Gain", "frames", "sigma per parameter, of the choice's")
    else:
        style.label(
            right, f"Gain: {SCOPE_NAMES[choice.scope]}", "frames", "1 sigma per axis [arcsec]"
        )
    return figure


def plot_forecast_check(check: ForecastCheck) -> Figure:
    """Stated sigmas over forecast sigmas with the 5 % band, and squared errors over their
    expectation.

    Coloured bands hold 95 % of chance: of the mean over the campaigns, and, in the last panel, of
    the pooled squared errors.
    """
    import xarray as xr

    names, found = check.forecast.names, []
    for name in _CHECKED:
        if name in names:
            ratio, bar = (each[:, names.index(name)] for each in (check.ratio, check.ratio_se))
            found.append((_CHECKED[name], ratio, ratio - 1.96 * bar, ratio + 1.96 * bar))
    titles, *numbers = zip(*found, ("Squared errors", *check.nees_ratio()), strict=True)
    where = {"panel": list(titles), "frames": list(check.forecast.n_frames)}
    data = xr.Dataset(
        {
            name: (("panel", "frames"), np.array(values))
            for name, values in zip(("median", "low", "high"), numbers, strict=True)
        },
        where,
    )
    figure, panels = small_multiples(data, "frames", log=False)
    for ax in panels:
        ax.axhline(1.0, color=style.INK, linewidth=0.9)
    for ax in panels[:-1]:
        ax.axhspan(0.95, 1.05, color=style.LIGHT, linewidth=0, zorder=0)
        ax.set_ylim(min(0.93, ax.get_ylim()[0]), max(1.07, ax.get_ylim()[1]))
    style.label(panels[0], y="stated / forecast")
    style.label(panels[-1], y="mean / expected")
    return figure
