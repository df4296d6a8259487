"""A plan as one HTML file, and the tables and figures beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from starcal_uq.budgeting.rows import confidence_text
from starcal_uq.core.files import atomic_write_bytes, atomic_write_text, new_folder, write_csv
from starcal_uq.core.manifest import making
from starcal_uq.core.records import to_plain, write_json
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.planning.check import ForecastCheck
from starcal_uq.planning.costs import EffectCosts
from starcal_uq.planning.design import FrameChoice
from starcal_uq.planning.planned import Plan
from starcal_uq.presentation.figures.planning import (
    plot_forecast,
    plot_forecast_check,
    plot_frame_choice,
    plot_plan_sweeps,
)
from starcal_uq.presentation.figures.style import svg_bytes
from starcal_uq.presentation.html import page
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.numbers import span
from starcal_uq.presentation.words.planning import costs_table
from starcal_uq.presentation.words.sentences import SCOPE_NAMES, rows, table, told

PAGE = "plan.html"
# Settings that the record has as they are.
_RECORDED = (
    "sigma_px",
    "max_mag",
    "min_stars",
    "mean_stars",
    "sky_fraction",
    "confidence",
    "scope",
    "target_arcsec",
)


def write_plan(
    plan: Plan,
    folder: PathLike,
    choice: FrameChoice | None = None,
    check: ForecastCheck | None = None,
) -> Path:
    """Write ``plan.html`` (self-contained), the tables as CSV, ``plan.json`` and the figures into a
    folder.

    All files count at once, when they are complete, in place of those of an earlier plan. `choice`
    are the frames to take, for the page and ``frames.csv``, `check` is the forecast against
    simulation, for the page and ``check.csv``.
    """
    images = plan_figures(plan, choice, check)
    text = render_plan(plan, images, choice, check)
    tables = {
        "plan": plan.to_dataframe(),
        "sweeps": plan.sweeps,
        "frames": None if choice is None else choice.to_dataframe(),
        "check": None if check is None else check.to_dataframe(),
        "effects": None if plan.effects is None else plan.effects.to_dataframe(),
    }
    with making(folder, "plan", PAGE, force=True) as path:
        figures = new_folder(path / "figures")
        for name, svg in images.items():
            atomic_write_bytes(figures / f"{name}.svg", svg)
        for name, rows in tables.items():
            if rows is not None:
                write_csv(rows, path / f"{name}.csv")
        write_json(plan_record(plan), path / "plan.json")
        atomic_write_text(path / PAGE, text)
    return Path(folder) / PAGE


def plan_record(plan: Plan) -> AnyDict:
    """The plan as plain values: settings, what is needed, and the forecast by number of frames."""
    return {
        "verdict": plan.text,
        "camera": plan.camera.to_dict(),
        **{name: getattr(plan, name) for name in _RECORDED},
        "effects": None if plan.effects is None else _costs(plan.effects),
        "distortion": None if plan.distortion is None else to_plain(plan.distortion, null=True),
        "distortion_words": told("open_distortion", plan),
        "needs": to_plain(plan.needs),
        # What a campaign does not determine is infinite.
        "forecast": to_plain(plan.to_dataframe().to_dict("records"), null=True),
        "provenance": plan.provenance,
    }


def _costs(costs: EffectCosts) -> AnyDict:
    """Effects with their scales, and their costs, model by model."""
    rows = to_plain(costs.to_dataframe().to_dict("records"), null=True)
    planned: AnyDict = to_plain(costs.planned)
    return planned | {"n_frames": costs.n_frames, "costs": rows}


def plan_figures(
    plan: Plan, choice: FrameChoice | None = None, check: ForecastCheck | None = None
) -> dict[str, bytes]:
    """Every figure as SVG, by name."""
    figures = {"forecast": plot_forecast(plan)}
    if plan.sweeps is not None:
        figures["sweeps"] = plot_plan_sweeps(plan)
    if choice is not None:
        figures["choice"] = plot_frame_choice(choice)
    if check is not None:
        figures["check"] = plot_forecast_check(check)
    return {name: svg_bytes(figure) for name, figure in figures.items()}


def render_plan(
    plan: Plan,
    images: Mapping[str, bytes],
    choice: FrameChoice | None = None,
    check: ForecastCheck | None = None,
) -> str:
    """The page; `images` are SVG by the names of `plan_figures`."""
    return page(
        "plan.html.j2",
        plan.provenance,
        plan=plan,
        choice=choice,
        check=check,
        needs=_needs_table(plan),
        forecast=rows("forecast", plan),
        infinite=lambda values: not np.isfinite(values).all(),
        level=confidence_text(plan.confidence),
        scope=SCOPE_NAMES[plan.scope],
        distortion_span="" if plan.distortion is None else span(plan.distortion),
        costs_table=costs_table,
        images=images,
    )


def _needs_table(plan: Plan) -> TextTable:
    """Frames needed, by part of the error; the part that was asked for is marked."""
    spread = plan.distortion
    over = "" if spread is None else span(spread)
    return table(
        "needs",
        {"over": over, "scope": plan.scope, "names": SCOPE_NAMES},
        () if over else ("Distortion of",),
        it=plan.needs,
        frames=[spread and spread.frames_range(need.scope) for need in plan.needs],
    )
