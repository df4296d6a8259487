"""Figures of plans: errors against number of frames, what changes them, chosen frames, and the
check of a forecast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import count
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style
from starcal_uq.presentation.words.planning import level, need_words

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
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
    n = np.asarray(table["n_frames"], dtype=np.float64)
    for ax, axes, title in (
        (panels[0, 0], _CROSS, "Across the boresight, per axis"),
        (panels[0, 1], ("roll",), "About the boresight"),
    ):
        _attitude_panel(ax, table, n, axes)
        style.label(ax, title, "frames", "1 sigma [arcsec]")
    style.legend_above(figure, panels[0, 0].get_lines())
    _radius_panel(panels[1, 0], plan, n)
    _parameter_panel(panels[1, 1], plan, table, n)
    return figure


def _attitude_panel(ax: Axes, table: pd.DataFrame, n: FloatArray, axes: tuple[str, ...]) -> None:
    _logarithmic(ax)
    for part, words, colour, marker in (
        ("nea", "centroid noise (NEA), every frame anew", style.SKY, None),
        ("common", "calibration, common rotation", style.ORANGE, "o"),
        ("rest", "calibration, rest", style.GREEN, "s"),
    ):
        squares = sum(
            np.asarray(table[f"{part}_{axis}_arcsec"], dtype=np.float64) ** 2 for axis in axes
        )
        ax.plot(
            n,
            np.sqrt(squares / len(axes)),
            color=colour,
            marker=marker,
            markersize=4,
            linewidth=1.5,
            label=words,
        )
    _plain_ticks(ax)


def _radius_panel(ax: Axes, plan: Plan, n: FloatArray) -> None:
    _logarithmic(ax)
    found = plan.forecast
    if plan.distortion is not None:
        radii = plan.distortion.radius_arcsec
        ax.fill_between(
            n, radii.min(axis=0), radii.max(axis=0), color=style.LIGHT, linewidth=0, zorder=0
        )
    ax.fill_between(
        n, found.radius_low, found.radius_high, color=style.BLUE, alpha=0.2, linewidth=0
    )
    ax.plot(n, found.radius, color=style.BLUE, marker="o", markersize=4, linewidth=1.5)
    if plan.target_arcsec is not None:
        ax.axhline(plan.target_arcsec, color=style.VERMILLION, linewidth=1.2, dashes=(5, 2))
        needed = plan.frames_needed
        words = f"target {plan.target_arcsec:g} arcsec"
        if needed is not None and plan.need is not None:
            words += f": {need_words(plan.need, plan.need.frames)}"
            _continued(ax, plan, n, needed)
            ax.plot(
                needed,
                plan.target_arcsec,
                linestyle="",
                marker="D",
                color=style.VERMILLION,
                markersize=6,
                zorder=4,
            )
        ax.annotate(
            words,
            (0.02, plan.target_arcsec),
            xycoords=("axes fraction", "data"),
            xytext=(0, 4),
            textcoords="offset points",
            fontsize=style.TICK_SIZE,
            color=style.VERMILLION,
        )
    _plain_ticks(ax)
    title = f"Two-axis error at {level(plan.confidence)}, {_SCOPES[plan.scope]}"
    style.label(ax, title, "frames", "error across the boresight [arcsec]")


def _continued(ax: Axes, plan: Plan, n: FloatArray, needed: int) -> None:
    """The curve from its nearest end to the number of frames that is needed."""
    if n[0] <= needed <= n[-1]:
        return
    place = 0 if needed < n[0] else -1
    ends = (
        (n[place], plan.forecast.radius[place]),
        (float(needed), float(plan.target_arcsec or np.nan)),
    )
    ax.plot(*np.transpose(ends), color=style.BLUE, linewidth=1.3, linestyle=":")


def _parameter_panel(ax: Axes, plan: Plan, table: pd.DataFrame, n: FloatArray) -> None:
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
        ax.plot(n, values, color=colour, marker=marker, markersize=4, linewidth=1.5, label=words)
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
    _plain_axis(ax.xaxis, ax.get_xlim())
    _plain_axis(ax.yaxis, ax.get_ylim())


def _plain_axis(axis: Axis, limits: tuple[float, float]) -> None:
    """Numbers instead of powers of ten, at 1, 2 and 5 where an axis spans less than two decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    narrow = limits[1] < 150.0 * limits[0]
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if narrow else (1.0,), numticks=20))
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: count(int(value)) if value >= 1.0 else f"{value:.6g}")
    )


def plot_plan_sweeps(plan: Plan) -> Figure:
    """Frames that the target needs, with one thing changed at a time; the diamond is the plan.

    Triangles at the upper edge mark what takes more than ten million frames. Without a target, or
    with one that the plan itself cannot keep, the two-axis error after 1000 frames is drawn
    instead.
    """
    if plan.sweeps is None:
        raise ValueError("this plan was made without sweeps: call plan with sweeps=True.")
    of_frames = plan.frames_needed is not None
    column = "frames_needed" if of_frames else "radius_arcsec"
    open_distortion = plan.distortion is not None
    figure = style.new_figure(11.0, 3.6)
    panels = figure.subplots(1, 3 + open_distortion, sharey=True)
    here = {"magnitude limit": plan.max_mag, "noise": plan.sigma_px, "part of the detector": 1.0}
    if plan.distortion is not None:
        _distortion_panel(panels[3], plan, of_frames)
    for ax, (name, words, logarithmic) in zip(panels[:3], _SWEEPS, strict=True):
        rows = plan.sweeps[plan.sweeps["sweep"] == name]
        x, y = (np.asarray(rows[key], dtype=np.float64) for key in ("value", column))
        style.dress(ax, grid=True)
        ax.set_yscale("log")
        if logarithmic:
            ax.set_xscale("log")
        ax.set_xticks(x, [f"{value:.3g}" for value in x])
        ax.minorticks_off()
        good = np.isfinite(y)
        ax.plot(x[good], y[good], color=style.BLUE, marker="o", markersize=4.5, linewidth=1.5)
        edge = ax.get_xaxis_transform()
        ax.plot(
            x[~good],
            np.full((~good).sum(), 0.97),
            "^",
            color=style.GREY,
            markersize=6,
            transform=edge,
        )
        present = good & np.isclose(x, here[name], rtol=1e-6)
        ax.plot(
            x[present], y[present], marker="D", color=style.VERMILLION, markersize=7, linestyle=""
        )
        if plan.target_arcsec is not None and not of_frames:
            ax.axhline(plan.target_arcsec, color=style.VERMILLION, linewidth=1.2, dashes=(5, 2))
        style.label(ax, "", words)
    if of_frames:
        style.label(panels[0], "", "", "frames")
        title = (
            f"Frames for {plan.target_arcsec:g} arcsec at {level(plan.confidence)}, "
            f"{_SCOPES[plan.scope]}"
        )
    else:
        style.label(panels[0], "", "", f"error at {level(plan.confidence)} [arcsec]")
        title = (
            f"Two-axis error after {count(int(plan.sweeps['n_frames'].iloc[0]))} frames, "
            f"{_SCOPES[plan.scope]}"
        )
        title += (
            "" if plan.target_arcsec is None else f"; line: target {plan.target_arcsec:g} arcsec"
        )
    style.label(panels[0], title)
    _plain_axis(panels[0].yaxis, panels[0].get_ylim())
    return figure


def _distortion_panel(ax: Axes, plan: Plan, of_frames: bool) -> None:
    found = plan.distortion
    assert found is not None
    y = found.frames[:, found.scopes.index(plan.scope)] if of_frames else found.radius_after_arcsec
    style.dress(ax, grid=True)
    ax.set_yscale("log")
    ax.minorticks_off()
    good = np.isfinite(y)
    ax.plot(
        found.percent[good], y[good], color=style.BLUE, marker="o", markersize=4.5, linewidth=1.5
    )
    ax.plot(
        *(found.percent[~good], np.full((~good).sum(), 0.97), "^"),
        color=style.GREY,
        markersize=6,
        transform=ax.get_xaxis_transform(),
    )
    own = int(np.argmin(np.abs(found.percent - found.own_percent)))
    if good[own]:
        ax.plot(
            found.percent[own],
            y[own],
            marker="D",
            color=style.VERMILLION,
            markersize=7,
            linestyle="",
        )
    style.label(ax, "", "distortion at the corner [%]")


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
    right.plot(
        n[first:],
        choice.random_path[first:],
        color=style.GREY,
        linewidth=1.5,
        label="random frames, mean",
    )
    right.plot(
        n[first:], choice.score_path[first:], color=style.BLUE, linewidth=1.8, label="chosen frames"
    )
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
    n = np.asarray(check.forecast.n_frames, dtype=np.float64)
    style.dress(left, grid=True)
    left.set_xscale("log")
    left.axhspan(0.95, 1.05, color=style.LIGHT, linewidth=0, zorder=0)
    left.axhline(1.0, color=style.INK, linewidth=0.9)
    shown = [entry for entry in _CHECKED if entry[0] in check.forecast.names]
    for i, (name, words, colour, marker) in enumerate(shown):
        j = check.forecast.names.index(name)
        at = n * 1.045 ** (i - 0.5 * (len(shown) - 1))
        bar = 1.96 * check.ratio_se[:, j]
        left.errorbar(
            at,
            check.ratio[:, j],
            yerr=bar,
            color=colour,
            marker=marker,
            markersize=4,
            linestyle="",
            label=words,
        )
    reach = max(0.075, 1.1 * float(np.max(np.abs(check.ratio - 1.0) + 1.96 * check.ratio_se)))
    left.set_ylim(1.0 - reach, 1.0 + 1.9 * reach)
    style.legend(left, loc="upper right", ncols=3)
    style.label(
        left, f"Sigmas of {check.n_campaigns} campaigns each", "frames", "stated / forecast"
    )

    style.dress(right, grid=True)
    right.set_xscale("log")
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
