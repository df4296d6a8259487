"""Figure of an error budget: what each contributor reaches, and the totals against their limits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.budgeting.rows import SCOPES, Contributor, confidence_text
from starcal_uq.budgeting.shapes import one_axis_factor, two_axis_radius
from starcal_uq.budgeting.totals import covariance
from starcal_uq.core.constants import AXES, CROSS_BORESIGHT
from starcal_uq.core.formatting import plural, significant
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.figures import style
from starcal_uq.propagation.attitude_error import IF_MODEL_HOLDS, NOT_ASSESSED, WITH_MISFIT_FOUND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from starcal_uq.budgeting.result import Budget

_PANELS = (
    (CROSS_BORESIGHT, "Across the boresight, two axes together"),
    ("roll", "Roll"),
)
_COLOURS = {"posterior": style.SKY, "file": style.ORANGE}
_TALL = 0.31


def plot_budget(budget: Budget) -> Figure:
    """What each contributor reaches at the budget's confidence, and the totals (mixed
    interpretation), in two panels.

    Contributors that nobody assessed are counted below, for nothing drawn would read as zero.
    Limits are drawn of requirements that the totals may be compared with: at the budget's
    confidence, and mixed.
    """
    names = list(dict.fromkeys(row.name for row in budget.rows if row.assessed))
    without = len({row.name for row in budget.rows} - set(names))
    missing = f"\n{plural(without, 'contributor')} without a row: not assessed" if without else ""
    figure = style.new_figure(11.5, 1.6 + _TALL * (len(names) + 3))
    panels = figure.subplots(1, 2, sharey=True)
    for ax, (axis, title) in zip(panels, _PANELS, strict=True):
        _panel(ax, budget, names, axis)
        style.label(
            ax, title, f"|mean| + n sigma at {confidence_text(budget.confidence)} [arcsec]{missing}"
        )
    style.legend_above(figure, _handles(budget), columnspacing=1.2, handlelength=1.6)
    return figure


def _panel(ax: Axes, budget: Budget, names: list[str], axis: str) -> None:
    style.dress(ax, grid=True)
    ax.grid(False, axis="y")
    by_name = {name: [row for row in budget.rows if row.name == name] for name in names}
    reaches = {name: _reach(rows, axis, budget.confidence) for name, rows in by_name.items()}
    sums = [budget.total(axis, scope) for scope in SCOPES]
    limits = [outcome for outcome in budget.comparable if outcome.requirement.axis == axis]
    shown = [
        *filter(None, reaches.values()),
        *(s.rule_arcsec for s in sums if s.rule_arcsec > 0.0),
        *(outcome.requirement.limit_arcsec for outcome in limits),
    ]
    low, high = min(shown, default=0.1), max(shown, default=1.0)
    left = 10.0 ** np.floor(np.log10(low * 0.7))
    # Room on the right for the numbers.
    ax.set_xlim(left, high * (high / left) ** 0.22)
    style.log_scale(ax.xaxis)
    for place, name in enumerate(names):
        row = by_name[name][0]
        value = reaches[name]
        if not value or not _present(budget, name, axis):
            text = "0" if row.applies else "does not apply"
            if not _present(budget, name, axis):
                text = "–"
            elif value is None:
                text = NOT_ASSESSED
            _write(ax, left, place, text)
            continue
        hatch = "///" if row.absorbed_by_alignment == "yes" else ""
        source = next((r.source for r in by_name[name] if r.assessed), "file")
        look: AnyDict = {"color": _COLOURS[source], "hatch": hatch, "edgecolor": "white"}
        ax.barh(place, value - left, left=left, height=0.66, **look)
        _write(ax, value, place, f"{significant(value)}″", style.INK)
    for offset, entry in enumerate(sums):
        at = len(names) + 0.7 + offset
        if not entry.rule_arcsec > 0.0:
            _write(ax, left, at, NOT_ASSESSED)
            continue
        ax.plot(entry.rule_arcsec, at, **style.look("by the rule"))
        ax.plot(entry.sampled_arcsec, at, **style.look("by sampling"))
        least = "≥ " if entry.at_least else ""
        mine = [
            outcome.requirement.limit_arcsec
            for outcome in limits
            if outcome.total.scope == entry.scope
        ]
        larger = entry.rule_arcsec if entry.unresolved else entry.larger_arcsec
        _write(
            ax, max(larger, *mine, 0.0), at, f"{least}{significant(larger, 3)}″", style.INK, shift=8
        )
    for outcome in limits:
        at = len(names) + 0.7 + SCOPES.index(outcome.requirement.scope)
        colour = style.VERMILLION if outcome.verdict == "violated" else style.GREEN
        limit = outcome.requirement.limit_arcsec
        ax.plot([limit, limit], [at - 0.42, at + 0.42], color=colour, linewidth=2.4)
    ax.axhline(len(names) - 0.15, color=style.GREY, linewidth=0.7)
    ax.set_ylim(len(names) + 2.4, -0.7)
    places = [*range(len(names)), *(len(names) + 0.7 + i for i in range(2))]
    ax.set_yticks(
        places, [*names, *(f"total {scope}" for scope in SCOPES)], fontsize=style.TICK_SIZE
    )
    ax.tick_params(axis="y", length=0)


def _present(budget: Budget, name: str, axis: str) -> bool:
    """False for a contributor of the user's own that its file names on other axes only."""
    axes = AXES[:2] if axis == CROSS_BORESIGHT else (axis,)
    return any(row.name == name and row.axis in axes for row in budget.rows)


def _reach(rows: list[Contributor], axis: str, confidence: float) -> float | None:
    """|mean| + n sigma of one contributor; None if it is not assessed on this axis."""
    axes = AXES[:2] if axis == CROSS_BORESIGHT else (axis,)
    chosen = [row for row in rows if row.axis in axes and row.assessed]
    if not chosen or len(chosen) < len([row for row in rows if row.axis in axes]):
        return None
    mean = math.hypot(*(row.mean_arcsec for row in chosen))
    if len(chosen) == 2:
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance(chosen)[:2, :2]), 0.0))
        return mean + two_axis_radius(confidence, float(sigma[1]), float(sigma[0]))
    return mean + one_axis_factor(confidence) * chosen[0].sigma_arcsec


def _write(
    ax: Axes, x: float, y: float, text: str, colour: str = style.GREY, shift: int = 4
) -> None:
    slant = "normal"
    if text == NOT_ASSESSED:
        colour, slant = style.VERMILLION, "italic"
    # The limits of the axis leave room for it.
    look = {"va": "center", "color": colour, "style": slant, "in_layout": False}
    style.note(ax, text, (x, y), (shift, 0), **look)


def _handles(budget: Budget) -> list[Any]:
    tested = any(row.with_misfit_found_arcsec >= 0.0 for row in budget.rows)
    handles = style.keys("budget")
    handles[0].set_label(f"from the posterior, {WITH_MISFIT_FOUND if tested else IF_MODEL_HOLDS}")
    if budget.comparable:
        handles += style.keys("limit")
    if any(outcome.verdict == "violated" for outcome in budget.comparable):
        handles += style.keys("violated")
    return handles
