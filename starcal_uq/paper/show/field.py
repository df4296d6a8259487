"""The report on the field experiment as one HTML file, and the files beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from starcal_uq.core.files import atomic_path, atomic_write_bytes, atomic_write_text, new_folder
from starcal_uq.paper.field.published import REJECTED_READINGS
from starcal_uq.paper.show import field_words as words
from starcal_uq.presentation.html import embedded_image, template_environment

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.paper.field.result import FieldExperiment

_TEMPLATE = "field.html.j2"


def write_field(found: FieldExperiment) -> None:
    """Everything that is computed, the report last: it is there only if all else is."""
    figures = field_figures(found)
    tables = _tables(found)
    page = render_field(found, figures)
    new_folder(found.path)
    folder = new_folder(found.path / "figures")
    for name, png in figures.items():
        atomic_write_bytes(folder / f"{name}.png", png)
    for name, table in tables.items():
        with atomic_path(found.path / f"{name}.csv") as temporary:
            table.to_csv(temporary, index=False, lineterminator="\n")
    atomic_write_text(found.report, page)


def field_figures(found: FieldExperiment) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    from starcal_uq.presentation.figures.style import png_bytes

    return {"field_rates": png_bytes(found.plot_rates()), "field_errors": png_bytes(found.plot_errors())}


def render_field(found: FieldExperiment, figures: Mapping[str, bytes]) -> str:
    """The report; `figures` are PNG images by the names of `field_figures`."""
    return template_environment().get_template(_TEMPLATE).render(_context(found, figures)) + "\n"


def _context(found: FieldExperiment, figures: Mapping[str, bytes]) -> dict[str, Any]:
    return {
        "created": found.provenance["created_utc"],
        "version": found.provenance["versions"].get("starcal_uq") or "",
        "headline": words.headline(found),
        "findings": words.findings(found),
        "reading": found.reading,
        "rejected": REJECTED_READINGS,
        "assumptions": words.assumptions(found),
        "table_rows": words.table_rows(found),
        "part_rows": words.part_rows(found),
        "source_rows": words.source_rows(found),
        "rate_heads": [f"{tolerance:g}" for tolerance in found.tolerances],
        "rate_rows": words.rate_rows(found),
        "sheet_rows": words.sheet_rows(found),
        "camera_rows": words.camera_rows(found),
        "tolerance": f"{found.tolerance_px:g}",
        "provenance_rows": words.provenance_rows(found),
        "images": {name: embedded_image(png) for name, png in figures.items()},
    }


def _tables(found: FieldExperiment) -> dict[str, pd.DataFrame]:
    return {
        "table_3": found.table_3(),
        "rates": found.rates(),
        "parts": found.parts(),
        "sources": found.sources(),
        "data_sheets": found.other_data_sheets(),
        "cameras": found.camera_table(),
        "frames": found.frame_table(),
    }
