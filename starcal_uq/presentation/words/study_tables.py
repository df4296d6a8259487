"""Tables of a coupling study: medians along every axis, and what a row tells of a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import parameter_called
from starcal_uq.core.formatting import (
    count,
    pretty_unit,
    significant,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.presentation.figures.coupling import correlation_text
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import (
    axis_label,
    value_words,
)
from starcal_uq.presentation.words.studies import dashed
from starcal_uq.studies.findings import Pair

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study


def correlations(study: Study, pair: Pair) -> FloatArray:
    """Correlation of a pair in every cell (C,)."""
    return study.values("correlation", parameter=pair.names[0], parameter_2=pair.names[1])


def study_table(study: Study) -> TextTable | None:
    """One row for every value of every axis, all else at its median."""
    sweep = study.sweep
    if not sweep.axes or not sweep.ok.any():
        return None
    columns = summary_columns(study)
    rows = []
    for axis in sweep.axes:
        pooled = [other for other in sweep.axes if other != axis]
        grids = [sweep.over(numbers, "median", pooled).ravel() for _, numbers, _ in columns]
        for i, value in enumerate(sweep.values[axis]):
            cells = (
                form(float(grid[i])) for (_, _, form), grid in zip(columns, grids, strict=True)
            )
            rows.append((axis_label(axis) if i == 0 else "", value_words(value), *cells))
    heads = ("Along", "Value", *(head for head, _, _ in columns))
    title = (
        "Medians over seeds and all other axes; pairs: correlation; rest: error that differs "
        "from frame to frame"
    )
    return TextTable(heads, tuple(rows), title, "ll" + "r" * len(columns))


def summary_columns(study: Study) -> list[tuple[str, FloatArray, Any]]:
    """Heads, numbers (C,) and forms of what a row of a table tells of a cell."""
    sweep = study.sweep
    coupled = sorted(sweep.coupled or sweep.pairs[:1], key=lambda pair: -pair.mean_size)
    unit = pretty_unit(parameter_called("f").scaled_unit)
    columns: list[tuple[str, FloatArray, Any]] = [
        *((dashed(pair), correlations(study, pair), _correlation) for pair in coupled[:2]),
        (f"Sigma f [{unit}]", study.values("sigma", parameter="f"), _number),
        ("Price f", np.sqrt(study.values("variance_inflation", parameter="f")), _number),
        ("Common [arcsec]", sweep.common_rotation, _number),
        ("Rest [arcsec]", sweep.frame_error, _number),
    ]
    target = study.definition.target_arcsec
    if target is not None:
        columns.append((f"Frames for {target:g} arcsec", study.frames_for(target), _frames))
    return columns


def _correlation(value: float) -> str:
    return "–" if np.isnan(value) else correlation_text(value)


def _number(value: float) -> str:
    return "–" if np.isnan(value) else significant(value, 3)


def _frames(value: float) -> str:
    return "–" if np.isnan(value) else "never" if np.isinf(value) else count(int(np.ceil(value)))
