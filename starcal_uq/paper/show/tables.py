"""Tables and headlines of the paper's experiments; every number and verdict in them is computed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import (
    MINUS,
    count,
    fixed,
    percent,
    plus_minus,
    pretty_unit,
    significant,
    with_sigma,
)
from starcal_uq.core.provenance import Provenance
from starcal_uq.paper.checks import NO
from starcal_uq.paper.errors import ERROR_READINGS
from starcal_uq.paper.interaction import AXES, HANDLING, OPTICS
from starcal_uq.paper.judgement import Judged, Outcome, Trial, trial
from starcal_uq.paper.published import LEAST_SQUARES, PAPER_METHODS, PROPOSED, SAMAAN, printed
from starcal_uq.paper.readings import AS_PRINTED
from starcal_uq.paper.statistics import ENOUGH_REPLICATES
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import told

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
_MARKS = {
    Outcome.AGAINST_TEXT: "warning",
    Outcome.BY_CHOICE: "warning",
    Outcome.NOT_REPRODUCED: "fail",
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


def _known(value: float) -> str:
    return significant(value) if np.isfinite(value) else "–"


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
    rows = []
    for one in judged:
        number, main, best = one.printed, one.main, one.best
        what = (
            f"{number.place}: {METHOD_NAMES[number.method]}",
            _named(number.quantity),
            _minus(number.text),
        )
        ours, other = (
            (_spread(t.mean, t.spread, number.quantity), signed(t.z)) for t in (main, best)
        )
        better = ("", "", "") if best is main else (*other, reading_words(best))
        chance = "" if np.isnan(one.by_chance) else percent(one.by_chance)
        rows.append((*what, str(one.noise_digits), *ours, *better, chance, one.outcome.value))
    return TextTable(
        (
            "Place",
            "Number",
            "Printed",
            "Noise digits",
            "Ours",
            "z",
            "Best",
            "z",
            "Reading",
            "Fits anything",
            "Outcome",
        ),
        tuple(rows),
        (
            "Mean ± spread over seeds under the main reading and, where that one does not agree, "
            "under the best of all."
        ),
        "llrrrrrrlrl",
        tuple(_MARKS.get(one.outcome, "") for one in judged),
    )


def table_2(found: Reproduction) -> TextTable:
    """Table 2 of the paper for every method."""
    rows = []
    for row in found.table_2().to_dict("records"):
        scale, _ = _unit(row["quantity"])
        ours, spread = row["ours"] / scale, row["spread"] / scale
        one_run = with_sigma(ours, spread) if np.isfinite(spread) else significant(ours)
        what = (
            row["method"],
            _named(row["quantity"]),
            f"{row['truth'] / scale:g}".replace("-", MINUS),
        )
        sigmas = (_known(row[name] / scale) for name in ("sigma_claimed", "sigma_crlb"))
        z = signed(row["z_printed"]) if row["printed"] else ""
        over_seeds = _spread(row["mean"], row["spread"], row["quantity"])
        rows.append((*what, one_run, over_seeds, *sigmas, _minus(row["printed"]), z))
    return TextTable(
        (
            "Method",
            "",
            "Truth",
            "This run",
            "Over seeds",
            "Claimed σ",
            "Cramér–Rao bound",
            "Printed",
            "z",
        ),
        tuple(rows),
        "One run, mean ± spread over seeds, and what the paper prints.",
        "llrrrrrrr",
    )


def methods(found: Reproduction) -> TextTable:
    """What each method does."""
    rows = tuple((method.label, method.description) for method in found.run.methods)
    return TextTable(("Method", "What it does"), rows, align="ll")


def row_tests(found: Reproduction) -> TextTable:
    """Each row of Table 2 as one draw."""
    return TextTable(
        ("Place", "Parameters", "Replicates", "T²", "p"),
        tuple(
            (row.place, str(row.p), count(row.n), significant(row.t2, 3), significant(row.p_value))
            for row in found.rows
        ),
        "The parameters of each row, taken together, as one draw (Hotelling’s T², with rounding).",
    )


def error_readings(found: Reproduction, quantity: str) -> TextTable:
    """The paper's three methods under every reading of one error size: is there one that fits all
    three?
    """
    rows, marks = [], []
    for reading in ERROR_READINGS[quantity]:
        cells, fits = (
            [reading.words if reading.faithful else f"{reading.words} (against the text)"],
            [],
        )
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
    return TextTable(
        ("Statement", "Place", "Printed", "What follows from its other numbers", "Agrees"),
        tuple(
            (one.statement, one.place, one.text, one.follows, one.agrees) for one in found.checks
        ),
        "Printed parameters put into the paper’s own formulas.",
        "llrll",
        tuple("fail" if one.agrees == NO else "" for one in found.checks),
    )


def errors(found: Reproduction) -> TextTable:
    """Errors of the one run, in px and arcsec."""
    heads = {
        **{
            "method": "Method",
            "eq16_px": "Eq. 16 [px]",
            "eq16_max_px": "largest",
            "eq16_noisy_px": "with noise",
        },
        **{
            "residual_px": "Residuals [px]",
            "map_px": "Directions [px]",
            "map_max_px": "largest [px]",
        },
        **{"map_arcsec": "Directions [arcsec]", "map_max_arcsec": "largest [arcsec]"},
        **{"across": "Rotation across [arcsec]", "roll_arcsec": "roll [arcsec]"},
    }
    frame = found.errors()
    frame["across"] = np.hypot(frame["pitch_arcsec"], frame["yaw_arcsec"])
    frame = frame.rename(columns=heads)[list(heads.values())]
    title = (
        "Errors without noise, unless it is named; directions over the detector, best rotation "
        "removed."
    )
    return TextTable.of(frame, title)


def replicates_text(found: Replicates) -> str:
    """Who is honest, who is biased, and who claims too little or too much."""
    named: dict[str, set[str]] = {}
    if found.n_replicates >= ENOUGH_REPLICATES:
        table = found.table()
        little = table["claimed_over_spread"] < 1.0
        wrong = {
            "biased": table["biased"],
            "claiming too little": table["claim_wrong"] & little,
            "claiming too much": table["claim_wrong"] & ~little,
        }
        named = {what: set(table["method"][rows]) for what, rows in wrong.items()}
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
    by_name = {p.name: p for p in parameters(found.truth.distortion)}
    rows = []
    for row in found.table().to_dict("records"):
        p = by_name[row["parameter"]]
        bias, bias_se, spread, bound = (
            row[name] / p.scale for name in ("bias", "bias_se", "spread", "crlb")
        )
        claimed, low, high = (
            fixed(row[f"claimed_over_spread{end}"], 2) for end in ("", "_low", "_high")
        )
        textbook = row["claimed_classical_over_spread"]
        what = (row["method"], f"{NAMES[p.name]} [{pretty_unit(p.scaled_unit)}]", count(row["n"]))
        sizes = (significant(size) for size in (spread, bound, row["rmse_over_crlb"]))
        efficiency = "–" if row["biased"] else fixed(row["efficiency"], 2)
        claims = (
            f"{claimed} ({low} to {high})",
            fixed(textbook, 2) if np.isfinite(textbook) else "–",
        )
        mean = plus_minus(bias, bias_se)
        rows.append(
            (
                *what,
                mean,
                *sizes,
                efficiency,
                *claims,
                percent(row["coverage95"], 3),
                row["verdict"],
            )
        )
    return TextTable(
        (
            *("Method", "", "n", "Bias", "Spread", "Bound", "RMSE / bound", "Efficiency"),
            *("Claimed / spread", "Textbook / spread", "Coverage", "Verdict"),
        ),
        tuple(rows),
        (
            "What every method does over seeds, against its own standard deviation and that of the "
            "textbooks."
        ),
        "llrrrrrrrrrl",
    )


def thresholds(study: InteractionStudy) -> TextTable:
    """Where the bias of each method passes one standard deviation of its noise."""
    units = {
        "distortion": "px at the corner",
        "field": "deg",
        "frames": "frames",
        "stars": "stars in a frame",
    }
    found = {(t.method, t.parameter, t.axis): t for t in study.thresholds if t.kind == "bias"}
    rows = [
        (method, NAMES[parameter], *(_side(found.get((method, parameter, axis))) for axis in AXES))
        for method in HANDLING
        for parameter in OPTICS
        if any((method, parameter, axis) in found for axis in AXES)
    ]
    return TextTable(
        ("Method", "", *(f"{axis} [{units[axis]}]" for axis in AXES)),
        tuple(rows),
        "Where the bias exceeds one standard deviation of the noise.",
        "llllll",
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
