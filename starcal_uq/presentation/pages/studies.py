"""A coupling study as one HTML file, and its figures beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.files import atomic_write_bytes, atomic_write_text, new_folder
from starcal_uq.core.formatting import count, plural
from starcal_uq.core.types import PathLike
from starcal_uq.presentation.figures.studies import (
    plot_coverage,
    plot_inflation,
    plot_matrices,
    plot_needed,
    plot_simpler,
    plot_study_correlation,
    plot_study_maps,
    plot_weakest,
)
from starcal_uq.presentation.figures.style import svg_bytes
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import axis_label, value_words
from starcal_uq.presentation.words.studies import (
    study_advice,
    study_answer,
    study_limits,
    study_tables,
    study_text,
    summary,
)
from starcal_uq.studies.result import Study

PAGE = "report.html"
_TEMPLATE = "study.html.j2"
_CELLS_SHOWN = 60

_CAPTIONS = {
    "correlation": (
        "What couples, and what changes it",
        "Size of the correlation, on a scale that grows as its price in sigma does; a pair whose "
        "entries err together "
        "is marked alike, else opposite. {band}",
    ),
    "maps": (
        "Over two axes",
        "Medians over seeds. Left below: the error of the calibration that differs from frame to "
        "frame, 1 sigma per "
        "axis across the boresight; right below: the rotation common to all frames, which "
        "alignment absorbs.",
    ),
    "matrices": (
        "The whole matrix",
        "Correlations of the parameters; grey where a model lacks one.",
    ),
    "weakest": (
        "The weakest direction",
        "The combination of parameters, each in its own sigma, that is determined worst: its "
        "variance over that of uncoupled parameters, and the shares of the parameters that take "
        "part.",
    ),
    "inflation": (
        "Sigmas and the price of coupling",
        (
            "Full lines: all parameters unknown. Dashed: all others known. The gap is the price of "
            "coupling. {band}"
        ),
    ),
    "needed": (
        "What a target takes",
        "The error that differs from frame to frame, 1 sigma per axis across the boresight, and, "
        "where there is a "
        "target, the frames that it takes. {band}",
    ),
    "simpler": (
        "Would a simpler model do?",
        "Frame-dependent attitude error across the boresight that a simpler distortion model "
        "would leave, beside that of the calibration (dashed). Where a full line lies below the "
        "dashed one of its colour, the simpler model is rich enough.",
    ),
    "coverage": (
        "Coverage",
        "Simulated cells whose 95 % interval holds the truth, with exact 95 % bounds of that part.",
    ),
}
_SIMULATED = " Dashed: the posterior's correlation, median over seeds."


def write_study(study: Study, folder: PathLike) -> Path:
    """Write the figures into a folder, then ``report.html`` (self-contained), in place of those of
    before.
    """
    path = new_folder(folder)
    images = study_figures(study)
    page = render_study(study, images)
    figures = new_folder(path / "figures")
    for name, svg in images.items():
        atomic_write_bytes(figures / f"{name}.svg", svg)
    atomic_write_text(path / PAGE, page)
    return path / PAGE


def study_figures(study: Study) -> dict[str, bytes]:
    """Every figure that the study has something for, as SVG, by name."""
    sweep = study.sweep
    if not sweep.axes or not sweep.ok.any():
        return {}
    drawn = {"correlation": plot_study_correlation(study)} if sweep.pairs else {}
    if len(sweep.axes) > 1:
        drawn["maps"] = plot_study_maps(study)
    drawn |= {
        "matrices": plot_matrices(study),
        "weakest": plot_weakest(study),
        "inflation": plot_inflation(study),
        "needed": plot_needed(study),
    }
    if "simpler" in study.data.dims and np.any(
        np.nan_to_num(study.data["model_bias_arcsec"].values) > 0.0
    ):
        drawn["simpler"] = plot_simpler(study)
    if "covered_95" in study.data:
        drawn["coverage"] = plot_coverage(study)
    return {name: svg_bytes(figure) for name, figure in drawn.items()}


def render_study(study: Study, images: Mapping[str, bytes]) -> str:
    """The page; `images` are SVG by the names of `study_figures`."""
    definition, data = study.definition, study.data
    over = "what else was drawn" if study.sweep.drawn else "seeds"
    band = f"Bands: range over {over}."
    figures = [
        {"name": name, "title": _CAPTIONS[name][0], "caption": _CAPTIONS[name][1].format(band=band)}
        for name in images
    ]
    if "posterior_correlation" in data:
        for figure in figures:
            figure["caption"] += _SIMULATED if figure["name"] == "correlation" else ""
    context = {
        "title": definition.name,
        "question": definition.question,
        "created": data.attrs.get("created_utc", ""),
        "version": data.attrs.get("starcal_uq", ""),
        "verdict": study_text(study),
        "answer": study_answer(study)[1:],
        "advice": study_advice(study),
        "limits": study_limits(study),
        "failed": not study.ok.all(),
        "tables": study_tables(study),
        "figures": figures,
        "cells": cells_table(study, _CELLS_SHOWN),
        "cells_words": (
            f"{plural(min(_CELLS_SHOWN, len(study.sweep.ok)), 'cell')} of "
            f"{count(len(study.sweep.ok))}"
        ),
        "provenance": _provenance(study),
        "images": images,
    }
    return template_environment().get_template(_TEMPLATE).render(context) + "\n"


def cells_table(study: Study, n: int) -> TextTable:
    """The first cells, one a row: where, and the numbers of the summary."""
    import pandas as pd

    columns, forms = summary(study) if study.ok.any() else ({}, {})
    data = study.data
    where = {axis_label(axis): data[axis].values for axis in study.axes}
    frame = {"Seed": data["seed_index"].values} | columns | {"Status": data["status"].values}
    table = TextTable.of(
        pd.DataFrame(where | frame).head(n), formats={**forms, **dict.fromkeys(where, value_words)}
    )
    return replace(table, marks=tuple("" if good else "warning" for good in study.ok[:n]))


def _provenance(study: Study) -> list[tuple[str, str]]:
    """Settings and origin of the study, as rows."""
    rows = []
    for key, value in study.definition.to_dict().items():
        entries = value.items() if isinstance(value, Mapping) else [("", value)]
        rows += [(f"{key}: {name}" if name else key, _told(entry)) for name, entry in entries]
    rows += [
        (str(key), _told(value))
        for key, value in study.data.attrs.items()
        if key not in ("definition", "title")
    ]
    return rows


def _told(value: Any) -> str:
    if isinstance(value, str):
        return value
    return json.dumps(value, default=str).strip('"')
