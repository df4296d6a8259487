"""Convergence of the stages, after the paper's Fig. 3."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters as camera_parameters
from starcal_uq.core.formatting import pretty_unit
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.calibration import Calibration

_BANDS = ("#eef3f7", "#ffffff")


def plot_convergence(cal: Calibration, truth: Camera | None = None) -> Figure:
    """Every parameter against the iteration, stage by stage (Ye & Yang 2017, Fig. 3).

    Above: the value. Below: its distance from the truth if that is known, else from the final estimate, in units of the
    final standard deviation on an axis that is linear between -1 and 1 and logarithmic outside.
    """
    parameters = camera_parameters(cal.camera.distortion)
    values, starts = _joined(cal)
    reference = np.asarray(truth.theta) if _comparable(truth, cal) and truth is not None else np.asarray(cal.theta)
    figure = style.new_figure(1.2 + 2.0 * len(parameters), 5.1)
    axes = figure.subplots(2, len(parameters), sharex=True, squeeze=False)
    iteration = np.arange(len(values))
    to_mm = cal.camera.pixel_um / 1000.0
    for i, parameter in enumerate(parameters):
        upper, lower = (style.dress(ax) for ax in axes[:, i])
        factor = to_mm if parameter.name == "f" else 1.0 / parameter.scale
        unit = "mm" if parameter.name == "f" else pretty_unit(parameter.scaled_unit)
        for ax in (upper, lower):
            _mark_stages(ax, starts, len(values))
        upper.plot(iteration, values[:, i] * factor, color=style.BLUE, marker="o", markersize=3.2, linewidth=1.2)
        upper.axhline(reference[i] * factor, color=style.VERMILLION, linewidth=1.0, dashes=(4, 2))
        upper.set_title(f"{parameter.latex} [{unit}]", fontsize=style.TITLE_SIZE, color=style.INK, pad=16)
        upper.ticklabel_format(axis="y", useOffset=False, style="plain")
        error = (values[:, i] - reference[i]) / cal.sigmas[i]
        lower.axhspan(-1.0, 1.0, color=style.GREEN, alpha=0.2, linewidth=0)
        lower.axhline(0.0, color=style.VERMILLION, linewidth=1.0, dashes=(4, 2))
        lower.plot(iteration, error, color=style.BLUE, marker="o", markersize=3.2, linewidth=1.2)
        _error_axis(lower, float(np.abs(error).max()))
        lower.set_xlabel("iteration", fontsize=style.LABEL_SIZE, color=style.INK)
    what = "truth" if _comparable(truth, cal) else "final estimate"
    axes[0, 0].set_ylabel("value", fontsize=style.LABEL_SIZE, color=style.INK)
    axes[1, 0].set_ylabel(f"distance from {what}\n[final sigma]", fontsize=style.LABEL_SIZE, color=style.INK)
    _key(figure, cal, what)
    return figure


def _key(figure: Figure, cal: Calibration, what: str) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    stages = ", ".join(f"{i} {stage.name}" for i, stage in enumerate(cal.stages, 1))
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=style.BLUE, marker="o", markersize=3.2, linewidth=1.2, label="estimate"),
        Line2D([], [], color=style.VERMILLION, dashes=(4, 2), linewidth=1.0, label=what),
        Patch(facecolor=style.GREEN, alpha=0.2, label="within 1 sigma"),
        Line2D([], [], linestyle="none", label=f"Stages: {stages}"),
    ]
    figure.legend(
        handles=handles,
        loc="outside upper left",
        ncols=4,
        fontsize=style.LABEL_SIZE,
        frameon=False,
        labelcolor=style.INK,
        columnspacing=1.6,
        handlelength=1.8,
    )


def _comparable(truth: Camera | None, cal: Calibration) -> bool:
    return truth is not None and tuple(truth.parameter_names) == tuple(cal.parameter_names)


def _joined(cal: Calibration) -> tuple[FloatArray, list[int]]:
    """All trajectories in a row, and the position at which each stage begins."""
    starts, length = [], 0
    for stage in cal.stages:
        starts.append(length)
        length += len(stage.trajectory)
    return np.concatenate([np.asarray(s.trajectory, dtype=np.float64) for s in cal.stages]), starts


def _mark_stages(ax: Axes, starts: list[int], total: int) -> None:
    ends = [*starts[1:], total]
    for i, (first, last) in enumerate(zip(starts, ends, strict=True)):
        ax.axvspan(first - 0.5, last - 0.5, color=_BANDS[i % 2], linewidth=0, zorder=0)
        if ax.get_subplotspec().is_first_row():  # type: ignore[union-attr]
            ax.text(
                0.5 * (first + last - 1),
                1.03,
                str(i + 1),
                transform=ax.get_xaxis_transform(),
                ha="center",
                fontsize=style.TICK_SIZE,
                color=style.GREY,
            )
    ax.set_xlim(-0.5, total - 0.5)


def _error_axis(ax: Axes, largest: float) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter

    decades = max(1, int(np.ceil(np.log10(max(largest, 2.0)))))
    ax.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    ax.set_ylim(-(10.0 ** (decades + 0.15)), 10.0 ** (decades + 0.15))
    step = 1 if decades <= 2 else int(np.ceil(decades / 2))
    powers = [10.0**d for d in range(decades, 0, -step)]
    ax.yaxis.set_major_locator(FixedLocator([-p for p in powers] + [0.0, *sorted(powers)]))
    ax.yaxis.set_minor_locator(FixedLocator([-1.0, 1.0]))
    ax.yaxis.set_major_formatter(FuncFormatter(_power_text))


def _power_text(value: float, _: object) -> str:
    if value == 0.0:
        return "0"
    exponent = round(np.log10(abs(value)))
    body = f"{abs(value):.0f}" if exponent < 3 else f"10^{{{exponent}}}"
    return f"${'-' if value < 0 else ''}{body}$"
