"""How the results of the paper's wing are drawn, told and laid out, by class."""

from __future__ import annotations

import html
from collections.abc import Mapping

from starcal_uq.core.display import View
from starcal_uq.paper.field.result import FieldExperiment
from starcal_uq.paper.interaction import InteractionStudy
from starcal_uq.paper.replicates import Replicates
from starcal_uq.paper.result import Reproduction
from starcal_uq.paper.show import field, figures, study_figures, tables
from starcal_uq.presentation.tables import TextTable


def _html(text: str, table: TextTable) -> str:
    return f"<p>{html.escape(text)}</p>{table.html()}"


VIEWS: Mapping[type, View] = {
    Reproduction: View(
        text=tables.reproduction_text,
        html=lambda found: _html(tables.reproduction_text(found), tables.printed_numbers(found.judged)),
        figures={
            "trajectories": figures.plot_trajectories,
            "error_fields": figures.plot_error_fields,
            "printed_numbers": figures.plot_printed_numbers,
        },
    ),
    Replicates: View(
        text=tables.replicates_text,
        html=lambda found: _html(tables.replicates_text(found), tables.replicates(found)),
        figures={"spread": study_figures.plot_replicates},
    ),
    InteractionStudy: View(
        text=tables.study_text,
        html=lambda study: _html(tables.study_text(study), tables.thresholds(study)),
        figures={"bias": study_figures.plot_interaction},
    ),
    FieldExperiment: View(
        text=field.headline,
        html=lambda found: _html(field.headline(found), field.table_3(found)),
        figures={"rates": figures.plot_rates, "errors": figures.plot_errors},
    ),
}
