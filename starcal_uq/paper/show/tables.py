"""Tables and headlines of the paper's experiments; every number and verdict in them is computed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import (
    MINUS,
    fixed,
    plus_minus,
    pretty_unit,
    significant,
)
from starcal_uq.core.provenance import Provenance
from starcal_uq.paper.errors import ERROR_READINGS
from starcal_uq.paper.interaction import AXES, HANDLING, OPTICS
from starcal_uq.paper.judgement import Judged, Trial, trial
from starcal_uq.paper.published import LEAST_SQUARES, PAPER_METHODS, PROPOSED, SAMAAN, printed
from starcal_uq.paper.readings import AS_PRINTED
from starcal_uq.paper.statistics import ENOUGH_REPLICATES
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table, told

if TYPE_CHECKING:
    from starcal_uq.paper.interaction import InteractionStudy, Threshold
    from starcal_uq.paper.replicates import Replicates
    from starcal_uq.paper.result import Reproduction

NAMES = {
    **{"x0": "x₀", "y0": "y₀", "f": "f", "k1": "k₁", "k2": "k₂"},
    **{"x0_px": "x₀", "y0_px": "y₀", "f_mm": "f", "y0_error_px": "error of y₀"},
    **{"reprojection_px": "reprojection error", "max_residual_px": "largest residual"},
}
METHOD_NAMES = {
    PROPOSED: "the proposed method",
    LEAST_SQUARES: "least squares",
    SAMAAN: "Samaan’s method",
}
# Coefficients are tiny, and are shown in powers of ten.
_COEFFICIENTS = {p.name: p for p in parameters("brown")[3:]}


def _unit(quantity: str) -> tuple[float, str]:
    """Scale and unit in which a printed quantity is shown."""
    p = _COEFFICIENTS.get(quantity)
    return (
        (1.0, quantity.rpartition("_")[2]) if p is None else (p.scale, pretty_unit(p.scaled_unit))
    )


def _named(quantity: str) -> str:
    return f"{NAMES[quantity]} [{_unit(quantity)[1]}]"


def _known(value: float, digits: int = 2) -> str:
    return significant(value, digits) if np.isfinite(value) else "–"


def _spread(value: float, spread: float, quantity: str = "") -> str:
    """Mean and spread in the unit shown."""
    scale = _unit(quantity)[0]
    if not np.isfinite(spread) or spread <= 1e-9 * abs(value):
        return significant(value / scale, 3) if np.isfinite(value) else "–"
    return plus_minus(value / scale, spread / scale)


def signed(z: float) -> str:
    """A z-value with its sign."""
    if not np.isfinite(z):
        return "–"
    text = fixed(z, 1 if abs(z) < 100.0 else 0)
    return f"+{text}" if z > 0 and float(text) > 0 else text


def _minus(text: str) -> str:
    return text.partition("e")[0].replace("-", MINUS)


def reading_words(one: Trial) -> str:
    """A reading with a mark where it contradicts the text."""
    return one.reading if one.faithful else f"{one.reading} (against the text)"


def printed_numbers(judged: Sequence[Judged]) -> TextTable:
    """Every printed number with its main and its best reading, and what became of it."""
    given = {"methods": METHOD_NAMES, "named": _named, "minus": _minus, "spread": _spread}
    given |= {"signed": signed, "reading_words": reading_words}
    return table(
        "printed_numbers", given, it=judged, other=[one.best is not one.main for one in judged]
    )


def table_2(found: Reproduction) -> TextTable:
    """Table 2 of the paper for every method."""
    rows = found.table_2().to_dict("records")
    given = {"named": _named, "minus": _minus, "spread": _spread, "known": _known, "signed": signed}
    return table("table_2", given, it=rows, scale=[_unit(row["quantity"])[0] for row in rows])


def methods(found: Reproduction) -> TextTable:
    """What each method does."""
    return table("paper_methods", it=found.run.methods)


def row_tests(found: Reproduction) -> TextTable:
    """Each row of Table 2 as one draw."""
    return table("paper_rows", it=found.rows)


def error_readings(found: Reproduction, quantity: str) -> TextTable:
    """The paper's three methods under every reading of one error size: is there one that fits all
    three?
    """
    rows, marks = [], []
    for reading in ERROR_READINGS[quantity]:
        cells = [reading.words if reading.faithful else f"{reading.words} (against the text)"]
        fits = []
        for method in PAPER_METHODS:
            draws = found.readings.of(AS_PRINTED, method, quantity, reading.key)
            if len(draws) < 2:
                cells += ["–", "–"]
                continue
            one = trial(printed(method, quantity), reading.words, reading.faithful, draws)
            cells += [_spread(one.mean, one.spread, quantity), signed(one.z)]
            fits.append(one.accepted)
        rows.append(tuple(cells))
        marks.append("pass" if len(fits) == len(PAPER_METHODS) and all(fits) else "")
    heads = [
        (f"{METHOD_NAMES[m]}, printed {printed(m, quantity).text}", "z") for m in PAPER_METHODS
    ]
    return TextTable(
        ("Reading", *(text for pair in heads for text in pair)),
        tuple(rows),
        (
            f"The {NAMES[quantity]} as printed, in px, under each reading; one that fits all three "
            "methods is green."
        ),
        marks=tuple(marks),
    )


def checks(found: Reproduction) -> TextTable:
    """The paper against itself."""
    return table("paper_checks", it=found.checks)


def errors(found: Reproduction) -> TextTable:
    """Errors of the one run, in px and arcsec."""
    return table("paper_errors", {"known": _known}, it=found.errors().to_dict("records"))


def replicates_text(found: Replicates) -> str:
    """Who is honest, who is biased, and who claims too little or too much."""
    named: dict[str, set[str]] = {}
    if found.n_replicates >= ENOUGH_REPLICATES:
        rows = found.table()
        little = rows["claimed_over_spread"] < 1.0
        wrong = {
            "biased": rows["biased"],
            "claiming too little": rows["claim_wrong"] & little,
            "claiming too much": rows["claim_wrong"] & ~little,
        }
        named = {what: set(rows["method"][some]) for what, some in wrong.items()}
        named = {"honest": set(found.labels).difference(*named.values()), **named}
    return told(
        "replicates",
        found,
        frames=found.provenance.settings.get("n_frames"),
        enough=ENOUGH_REPLICATES,
        groups={what: [one for one in found.labels if one in some] for what, some in named.items()},
    )


def replicates(found: Replicates) -> TextTable:
    """Bias, spread and claims of every method and parameter."""
    rows = found.table().to_dict("records")
    by_name = {p.name: p for p in parameters(found.truth.distortion)}
    specs = [by_name[row["parameter"]] for row in rows]
    return table("replicates", it=rows, spec=specs, name=[NAMES[spec.name] for spec in specs])


def thresholds(study: InteractionStudy) -> TextTable:
    """Where the bias of each method passes one standard deviation of its noise."""
    by_axis: dict[tuple[str, str], dict[str, Threshold | None]] = {}
    for one in study.thresholds:
        if one.kind == "bias":
            axes = by_axis.setdefault((one.method, one.parameter), dict.fromkeys(AXES))
            axes[one.axis] = one
    places = [place for place in product(HANDLING, OPTICS) if place in by_axis]
    return table(
        "thresholds",
        {"side": _side},
        method=[method for method, _ in places],
        parameter=[NAMES[parameter] for _, parameter in places],
        found=[by_axis[place] for place in places],
    )


def _side(one: Threshold | None) -> str:
    if one is None:
        return ""
    if one.side in ("always", "never"):
        return "everywhere" if one.side == "always" else "nowhere"
    # More digits than one would be those of chance.
    return f"{'from' if one.side == 'above' else 'up to'} {significant(one.value, 1)}"


def provenance_table(record: Provenance) -> TextTable:
    """What is needed to repeat an experiment."""
    settings: Iterable[tuple[str, object]] = record.settings.items()
    rows = (
        ("Data, SHA-256", str(record.data_sha256)),
        ("Seed", str(record.seed)),
        (
            "Settings",
            ", ".join(f"{k} = {v if isinstance(v, str) else json.dumps(v)}" for k, v in settings),
        ),
        ("Time", record.created_utc),
        (
            "Versions",
            record.software(),
        ),
    )
    return TextTable(("What", "Value"), rows, align="ll")
