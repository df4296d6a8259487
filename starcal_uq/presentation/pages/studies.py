"""A coupling study as one HTML file, and its figures beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from starcal_uq.core.files import atomic_write_bytes, atomic_write_text, new_folder
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.types import PathLike
from starcal_uq.presentation.figures.style import svg_bytes
from starcal_uq.presentation.html import page
from starcal_uq.presentation.pages.explorer import explorer
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words import studies as words
from starcal_uq.presentation.words.axes import axis_label, value_words
from starcal_uq.studies.result import Study

PAGE = "report.html"
_CELLS_SHOWN = 60


def write_study(study: Study, folder: PathLike) -> Path:
    """Write the figures into a folder, then ``report.html`` (self-contained), in place of those of
    before.
    """
    path = new_folder(folder)
    images = study_figures(study)
    text = render_study(study, images)
    figures = new_folder(path / "figures")
    for name, svg in images.items():
        atomic_write_bytes(figures / f"{name}.svg", svg)
    atomic_write_text(path / PAGE, text)
    return path / PAGE


def study_figures(study: Study) -> dict[str, bytes]:
    """Every figure that the study has something for, as SVG, by name."""
    sweep = study.sweep
    if not sweep.axes or not sweep.ok.any():
        return {}
    simpler = study.data.get("model_bias_arcsec", 0.0)
    wanted = {
        "correlation": bool(sweep.pairs),
        "maps": len(sweep.axes) > 1,
        **dict.fromkeys(("matrices", "weakest", "inflation", "needed"), True),
        "simpler": bool(np.any(np.nan_to_num(simpler) > 0.0)),
        "coverage": "covered_95" in study.data,
    }
    return {name: svg_bytes(getattr(study.plot, name)()) for name, one in wanted.items() if one}


def render_study(study: Study, images: Mapping[str, bytes]) -> str:
    """The page; `images` are SVG by the names of `study_figures`."""
    attrs = study.data.attrs
    versions = {"starcal_uq": attrs.get("starcal_uq", "")}
    return page(
        "study.html.j2",
        Provenance(created_utc=attrs.get("created_utc", ""), versions=versions),
        study=study,
        words=words,
        cells=cells_table(study, _CELLS_SHOWN),
        images=images,
        explorer=explorer(study),
    )


def cells_table(study: Study, n: int) -> TextTable:
    """The first cells, one a row: where, and the numbers of the summary."""
    import pandas as pd

    columns, forms = words.summary(study) if study.ok.any() else ({}, {})
    data = study.data
    where = {axis_label(axis): data[axis].values for axis in study.axes}
    frame = {"Seed": data["seed_index"].values} | columns | {"Status": data["status"].values}
    table = TextTable.of(
        pd.DataFrame(where | frame).head(n), formats={**forms, **dict.fromkeys(where, value_words)}
    )
    return replace(table, marks=tuple("" if good else "warning" for good in study.ok[:n]))
