"""Sentences of a report that depend on the run."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from starcal_uq.core.types import AnyDict, AnyMapping
from starcal_uq.diagnostics.verdict.observed import refraction
from starcal_uq.presentation.html import card, listed
from starcal_uq.presentation.words.estimation import calibration_table
from starcal_uq.presentation.words.inference import posterior_table
from starcal_uq.presentation.words.sentences import told

if TYPE_CHECKING:
    from starcal_uq.presentation.report.results import Results


def run_html(results: Results) -> str:
    """The same for a notebook, with the table of the parameters and the checks that did not
    pass.
    """
    post, cal = results.posterior, results.calibration
    table = calibration_table(cal, results.truth) if post is None else posterior_table(post)
    doubts = (str(check) for check in results.verdict.doubts)
    return card(f"Run {results.name}", told("run", results), table) + listed(doubts)


def data_sentence(results: Results) -> str:
    """What the result rests on, in one or two sentences."""
    obs, cal = results.observations, results.calibration
    n_different = 0 if obs.star_id is None else len(obs.named.names)
    return told("data", results, n_different=n_different, refraction=refraction(obs, cal))


# What makes sums over all stars, by the name that a provenance has for it.
_PATHS = {"numpy": "NumPy", "numba": "compiled loops (Numba)"}


def provenance_rows(results: Results) -> list[tuple[str, str]]:
    """What is needed to repeat the run."""
    cal = results.calibration
    path = cal.provenance.kernels
    rows: AnyDict = {
        "Data, SHA-256": cal.data_hash_of(results.observations),
        "Source of the data": results.observations.origin.source,
        "Nominal camera": results.camera_changed,
    }
    steps = {"Calibration": cal, "Sampling": results.posterior, "Diagnosis": results.diagnosis}
    made = {name: of.provenance for name, of in steps.items() if of is not None}
    for name, step in made.items():
        rows[f"{name}, time"] = step.created_utc or "unknown"
        rows[f"{name}, seed"] = step.seed
        rows[f"{name}, settings"] = _settings_text(step.settings)
    rows |= {"Sums over stars": path and _PATHS[path], "Versions": step.software()}
    return [(name, str(value)) for name, value in rows.items() if value not in (None, "")]


def _settings_text(settings: AnyMapping) -> str:
    return ", ".join(f"{name} = {_plain(value)}" for name, value in settings.items()) or "none"


def _plain(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value, default=str)
