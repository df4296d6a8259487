"""The report on the reproduction as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from starcal_uq.core.formatting import count
from starcal_uq.paper.judgement import Outcome
from starcal_uq.paper.published import N_STARS
from starcal_uq.paper.show import report_tables as tables
from starcal_uq.paper.show import reproduction_words as words
from starcal_uq.presentation.html import embedded_image, template_environment

if TYPE_CHECKING:
    from starcal_uq.paper.result import Reproduction

TEMPLATE = "reproduce.html.j2"
_MAP_DPI = 130


def draw_figures(found: Reproduction) -> dict[str, bytes]:
    """Every figure as PNG, by name."""
    from starcal_uq.presentation.figures.style import DPI, png_bytes

    # The maps are smooth: fewer pixels show as much of them.
    smooth = {"error_fields": _MAP_DPI}
    drawn = {
        "printed_numbers": found.plot_printed_numbers(),
        "trajectories": found.plot_trajectories(),
        "error_fields": found.plot_error_fields(),
        "replicates": found.replicates.plot(),
    }
    if found.study is not None:
        drawn["interaction"] = found.study.plot()
    return {name: png_bytes(figure, smooth.get(name, DPI)) for name, figure in drawn.items()}


def render(found: Reproduction, figures: Mapping[str, bytes]) -> str:
    """The report.

    Parameters
    ----------
    found
        What to report.
    figures
        PNG images by the names of `draw_figures`; a missing one is left out.
    """
    return template_environment().get_template(TEMPLATE).render(context(found, figures)) + "\n"


def context(found: Reproduction, figures: Mapping[str, bytes]) -> dict[str, Any]:
    """What the template shows."""
    versions = found.provenance["versions"]
    reprojection, maximum = (tables.error_reading_rows(found, q) for q in ("reprojection_px", "max_residual_px"))
    return {
        "found": found,
        "created": found.provenance["created_utc"],
        "version": versions.get("starcal_uq") or "",
        "headline": words.headline(found),
        "method_verdicts": words.method_verdicts(found),
        "data_sentence": words.data_sentence(found),
        "frames_warning": words.frames_warning(found),
        "focal_sentence": words.focal_sentence(found),
        "ratio_sentence": words.ratio_sentence(found),
        "rows_sentence": words.rows_sentence(found),
        "checks_sentence": words.checks_sentence(found.checks),
        "method_sentences": words.method_sentences(found),
        "table_heads": tables.table_heads(found),
        "table_rows": tables.table_rows(found),
        "printed_rows": tables.printed_rows(found.judged),
        "not_reproduced": tables.printed_rows(found.outcome(Outcome.NOT_REPRODUCED)),
        "checks": found.checks,
        "reprojection_rows": reprojection,
        "reprojection_sentence": words.one_reading_sentence(reprojection),
        "maximum_rows": maximum,
        "maximum_sentence": words.one_reading_sentence(maximum),
        "printed_errors": words.printed_errors(),
        "error_rows": tables.error_rows(found),
        "replicate_rows": tables.replicate_rows(found),
        "replicate_sentences": words.replicate_sentences(found),
        "study_verdict": "" if found.study is None else found.study.verdict,
        "n_stars": count(N_STARS),
        "equation": words.EQUATIONS[found.run.convention],
        "provenance_rows": words.provenance_rows(found),
        "images": {name: embedded_image(png) for name, png in figures.items()},
    }
