"""The reports on the paper's experiments as one HTML file each: a headline, tables and figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from starcal_uq.core.display import Shown
from starcal_uq.core.types import AnyDict
from starcal_uq.paper.field import published
from starcal_uq.paper.published import N_FRAMES
from starcal_uq.paper.show import field, tables
from starcal_uq.presentation.figures.style import DPI, png_bytes
from starcal_uq.presentation.html import page

if TYPE_CHECKING:
    from starcal_uq.paper.field.result import FieldExperiment
    from starcal_uq.paper.result import Reproduction

# The maps are smooth: fewer pixels show as much of them.
_DPI = {"error_fields": 130}


def reproduction_figures(found: Reproduction) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    drawn = _drawn(found, "printed_numbers", "trajectories", "error_fields")
    drawn["replicates"] = png_bytes(found.replicates.plot.spread(), DPI)
    if found.study is not None:
        drawn["interaction"] = png_bytes(found.study.plot.bias(), DPI)
    return drawn


def field_figures(found: FieldExperiment) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    return {f"field_{name}": png for name, png in _drawn(found, "rates", "errors").items()}


def _drawn(found: Shown, *names: str) -> dict[str, bytes]:
    return {name: png_bytes(getattr(found.plot, name)(), _DPI.get(name, DPI)) for name in names}


def reproduction_page(found: Reproduction, figures: Mapping[str, bytes]) -> str:
    """The report; `figures` are PNG images by the names of `reproduction_figures`, a missing one is
    left out.
    """
    known: AnyDict = {"found": found, "tables": tables, "N_FRAMES": N_FRAMES}
    return page("reproduction.html.j2", found.provenance, **known, images=figures)


def field_page(found: FieldExperiment, figures: Mapping[str, bytes]) -> str:
    """The report; `figures` are PNG images by the names of `field_figures`."""
    known: AnyDict = {"found": found, "field": field, "tables": tables, "published": published}
    return page("field.html.j2", found.provenance, **known, images=figures)
