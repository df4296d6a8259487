"""How the results of the paper's wing are drawn, told and laid out, by class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from starcal_uq.core.display import View
from starcal_uq.paper.field.result import FieldExperiment
from starcal_uq.paper.interaction import HANDLING, InteractionStudy
from starcal_uq.paper.replicates import Replicates
from starcal_uq.paper.result import Reproduction
from starcal_uq.paper.show import field, figures, tables
from starcal_uq.presentation.html import card
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import told


def _view(
    title: str,
    text: Callable[[Any], str],
    table: Callable[[Any], TextTable],
    **drawn: Callable[..., Any],
) -> View:
    return View(text, lambda result: card(title, text(result), table(result)), drawn)


VIEWS: Mapping[type, View] = {
    Reproduction: _view(
        "Ye & Yang 2017 reproduced",
        partial(told, "reproduction", names=tables.METHOD_NAMES),
        lambda found: tables.printed_numbers(found.judged),
        trajectories=figures.plot_trajectories,
        error_fields=figures.plot_error_fields,
        printed_numbers=figures.plot_printed_numbers,
    ),
    Replicates: _view(
        "Replicates", tables.replicates_text, tables.replicates, spread=figures.plot_replicates
    ),
    InteractionStudy: _view(
        "Interaction of optics and distortion",
        partial(told, "interaction", handling=HANDLING),
        tables.thresholds,
        bias=figures.plot_interaction,
    ),
    FieldExperiment: _view(
        "Field experiment of Ye & Yang 2017",
        partial(told, "field_experiment"),
        field.table_3,
        rates=figures.plot_rates,
        errors=figures.plot_errors,
    ),
}
