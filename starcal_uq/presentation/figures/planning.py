"""Figures of plans: errors against number of frames, what changes them, chosen frames, and the
check of a forecast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import count
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, floats
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.figures.sweeps import plain, target_line, target_words
from starcal_uq.presentation.words.planning import level, need_words

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.planning.check import ForecastCheck
    from starcal_uq.planning.design import FrameChoice
    from starcal_uq.planning.plan import Plan

_SCOPES = {
    "common": "common rotation",
    "rest": "rest",
    "calibration": "calibration",
    "total": "calibration and centroid noise",
}
_CROSS = AXES[:2]
_LINE: AnyDict = {"markersize": 4, "linewidth": 1.5}
_SWEEPS = (
    ("magnitude limit", "faintest magnitude", False),
    ("noise", "centroid noise [px per axis]", True),
    ("part of the detector", "part of the detector's area used", False),
)
# What is drawn of a check, by column.
_CHECKED = (
    ("x0_px", "x₀", style.BLUE, "o"),
    ("f_px", "f", style.ORANGE, "s"),
    ("distortion_corner_px", "distortion", style.PURPLE, "^"),
    ("common_pitch_arcsec", "common rotation, pitch", style.VERMILLION, "D"),
    ("rest_pitch_arcsec", "rest, pitch", style.GREEN, "v"),
    ("rest_roll_arcsec", "rest, roll", style.SKY, "P"),
)


def plot_forecast(plan: Plan) -> Figure:
    """Attitude errors across and about the boresight, the two-axis error with the target, and the
    parameters.

    All against number of frames, on logarithmic axes. The band of the two-axis error holds 90 % of
    the campaigns, the grey one its range over the distortion that the sheet leaves open; where the
    target needs more frames than were forecast, the curve is continued with dots.
    """
    figure = style.new_figure(11.0, 7.6)
    panels = figure.subplots(2, 2)
    table = plan.to_dataframe()
    n = floats(table["n_frames"])
    for ax, axes, title in (
        (panels[0, 0], _CROSS, "Across the boresight, per axis"),
        (panels[0, 1], ("roll",), "About the boresight"),
    ):
        _attitude_panel(ax, table, n, axes)
        style.label(ax, title, "frames", "1 sigma [arcsec]")
    style.legend_above(figure, panels[0, 0].get_lines())
    _radius_panel(panels[1, 0], plan, n)
    _parameter_panel(panels[1, 1], table, n)
    return figure


def _attitude_panel(ax: Axes, table: pd.DataFrame, n: FloatArray, axes: tuple[str, ...]) -> None:
    _logarithmic(ax)
    for part, words, colour, marker in (
        ("nea", "centroid noise (NEA), every frame anew", style.SKY, None),
        ("common", "calibration, common rotation", style.ORANGE, "o"),
        ("rest", "calibration, rest", style.GREEN, "s"),
    ):
        squares = (table[[f"{part}_{axis}_arcsec" for axis in axes]] ** 2).mean(axis=1)
        ax.plot(n, np.sqrt(squares), color=colour, marker=marker, label=words, **_LINE)
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
    title = f"Two-axis error at {level(plan.confidence)}, {_SCOPES[plan.scope]}"
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


def _parameter_panel(ax: Axes, table: pd.DataFrame, n: FloatArray) -> None:
    _logarithmic(ax)
    point = np.sqrt(0.5 * (table["x0_px"] ** 2 + table["y0_px"] ** 2))
    shown = [
        (point, "principal point, per axis", style.BLUE, "o"),
        (table["f_px"], "focal length", style.ORANGE, "D"),
    ]
    if "distortion_corner_px" in table:
        shown.append(
            (table["distortion_corner_px"], "distortion, at the farthest corner", style.PURPLE, "^")
        )
    for values, words, colour, marker in shown:
        ax.plot(n, values, color=colour, marker=marker, label=words, **_LINE)
    _plain_ticks(ax)
    style.legend(ax, loc="lower left", bbox_to_anchor=(0.0, 0.0))
    style.label(ax, "Parameters", "frames", "1 sigma [px]")


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
    figure = style.new_figure(11.0, 3.6)
    panels = figure.subplots(1, 3 + (found is not None), sharey=True)
    here = {"magnitude limit": plan.max_mag, "noise": plan.sigma_px, "part of the detector": 1.0}
    if found is not None:
        drawn = found.radius_after_arcsec
        if of_frames:
            drawn = found.frames[:, found.scopes.index(plan.scope)]
        own = np.abs(found.percent - found.own_percent)
        _changed(
            panels[3],
            *(found.percent, drawn),
            *(np.arange(len(own)) == np.argmin(own), "distortion at the corner [%]"),
        )
    for ax, (name, words, logarithmic) in zip(panels[:3], _SWEEPS, strict=True):
        rows = plan.sweeps[plan.sweeps["sweep"] == name]
        if rows.empty:
            ax.set_visible(False)
            continue
        x, y = rows[["value", column]].to_numpy(np.float64).T
        if logarithmic:
            ax.set_xscale("log")
        ax.set_xticks(x, [f"{value:.3g}" for value in x])
        _changed(ax, x, y, np.isclose(x, here[name], rtol=1e-6), words)
        if plan.target_arcsec is not None and not of_frames:
            target_line(ax, plan.target_arcsec)
    at = level(plan.confidence)
    if of_frames:
        title, words = f"Frames for {plan.target_arcsec:g} arcsec at {at}", "frames"
    else:
        after = count(int(plan.sweeps["n_frames"].iloc[0]))
        title, words = f"Two-axis error after {after} frames", f"error at {at} [arcsec]"
    title += f", {_SCOPES[plan.scope]}"
    if plan.target_arcsec is not None and not of_frames:
        title += f"; line: target {plan.target_arcsec:g} arcsec"
    style.label(panels[0], title, y=words)
    plain(panels[0].yaxis, fine=False)
    return figure


def _changed(ax: Axes, x: FloatArray, y: FloatArray, own: BoolArray, words: str) -> None:
    """What is needed with one thing changed; triangles where it is beyond all numbers."""
    style.dress(ax, grid=True)
    ax.set_yscale("log")
    ax.minorticks_off()
    good = np.isfinite(y)
    ax.plot(x[good], y[good], color=style.BLUE, marker="o", markersize=4.5, linewidth=1.5)
    edge = ax.get_xaxis_transform()
    beyond = np.full((~good).sum(), 0.97)
    ax.plot(x[~good], beyond, "^", color=style.GREY, markersize=6, transform=edge)
    _diamond(ax, x[good & own], y[good & own], markersize=7)
    style.label(ax, "", words)


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

    _logarithmic(right)
    n = np.arange(1, len(table) + 1)
    # The first frames alone hardly determine the parameters.
    first = min(3, len(n) - 1)
    for path, colour, width, words in (
        (choice.random_path, style.GREY, 1.5, "random frames, mean"),
        (choice.score_path, style.BLUE, 1.8, "chosen frames"),
    ):
        right.plot(n[first:], path[first:], color=colour, linewidth=width, label=words)
    _plain_ticks(right)
    style.legend(right, loc="upper right")
    if choice.criterion == "D":
        style.label(right, "Gain", "frames", "sigma per parameter, of the choice's")
    else:
        style.label(right, f"Gain: {_SCOPES[choice.scope]}", "frames", "1 sigma per axis [arcsec]")
    return figure


def plot_forecast_check(check: ForecastCheck) -> Figure:
    """Stated sigmas over forecast sigmas with the 5 % band, and squared errors over their
    expectation.

    Bars hold 95 % of chance: of the mean over the campaigns on the left, of the pooled squared
    errors on the right.
    """
    figure = style.new_figure(11.0, 3.9)
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    n = floats(check.forecast.n_frames)
    for ax in (left, right):
        style.dress(ax, grid=True)
        ax.set_xscale("log")
    left.axhspan(0.95, 1.05, color=style.LIGHT, linewidth=0, zorder=0)
    left.axhline(1.0, color=style.INK, linewidth=0.9)
    bars = 1.96 * check.ratio_se
    shown = [entry for entry in _CHECKED if entry[0] in check.forecast.names]
    for i, (name, words, colour, marker) in enumerate(shown):
        j = check.forecast.names.index(name)
        at = n * 1.045 ** (i - 0.5 * (len(shown) - 1))
        left.errorbar(
            *(at, check.ratio[:, j], bars[:, j]),
            color=colour,
            marker=marker,
            markersize=4,
            linestyle="",
            label=words,
        )
    reach = max(0.075, 1.1 * np.max(np.abs(check.ratio - 1.0) + bars))
    left.set_ylim(1.0 - reach, 1.0 + 1.9 * reach)
    style.legend(left, loc="upper right", ncols=3)
    style.label(
        left, f"Sigmas of {check.n_campaigns} campaigns each", "frames", "stated / forecast"
    )

    found, low, high = check.nees_ratio()
    right.vlines(n, low, high, color=style.LIGHT, linewidth=9.0)
    right.axhline(1.0, color=style.INK, linewidth=0.9)
    right.plot(n, found, color=style.BLUE, marker="o", markersize=5, linestyle="")
    style.label(right, "Squared errors of the parameters", "frames", "mean / expected")
    for ax in (left, right):
        ax.set_xticks(n, [count(int(value)) for value in n])
        ax.minorticks_off()
        ax.set_xlim(n[0] / 1.4, n[-1] * 1.4)
    return figure
