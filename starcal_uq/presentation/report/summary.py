"""The first page of a report and the last lines in a terminal: what may be used, its numbers, a
paragraph to paste.
"""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from starcal_uq.budgeting.result import by_contributor
from starcal_uq.budgeting.rows import AXIS_LABELS, confidence_text
from starcal_uq.core.constants import CROSS_BORESIGHT
from starcal_uq.core.formatting import significant
from starcal_uq.core.status import Level, Note, Question, worst
from starcal_uq.presentation.html import WIDTH, template_environment, wrapped
from starcal_uq.presentation.report.tables import parameter_rows
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.numbers import two_figures
from starcal_uq.presentation.words.sentences import table
from starcal_uq.propagation.attitude_error import (
    IF_MODEL_HOLDS,
    NOT_ASSESSED,
    WITH_MISFIT_FOUND,
)

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.presentation.report.results import Results
    from starcal_uq.propagation.attitude_error import AttitudeError

# What is nearer to the corner than this is no extrapolation worth the name.
_SEEN = 0.97
AFTER = "after alignment"
# Rows of an attitude error, in the order of what a mission asks for.
_PARTS = ((1, "Common rotation"), (2, "Frame-dependent rest"), (0, "Centroid noise"))
_PARTS_SAID = (
    "Common: one constant, which alignment calibration takes away. Frame-dependent: nothing "
    "takes it away. Noise: new "
    "in every frame."
)


def uses(results: Results) -> tuple[list[str], list[str]]:
    """What of the run can be used, and what cannot or only with care; sentences."""
    curve = results.distortion_curve
    text = (
        template_environment()
        .get_template("uses.txt.j2")
        .render(
            {
                one.__name__: one
                for one in (Level, Note, Question, by_contributor, worst, two_figures)
            },
            results=results,
            unseen=curve is not None and curve.star_radius_px < _SEEN * curve.radius_px[-1],
        )
    )
    usable, unusable = (part.strip().splitlines() for part in text.partition("\n---")[::2])
    return usable, unusable


def attitude_summary(error: AttitudeError) -> TextTable:
    """The parts of the attitude error by both their figures, across the boresight and in roll."""
    tested = error.misfit is not None
    kinds = ([WITH_MISFIT_FOUND] if tested else []) + [IF_MODEL_HOLDS]
    values = {
        WITH_MISFIT_FOUND: error.with_misfit_found_arcsec,
        IF_MODEL_HOLDS: error.if_model_holds_arcsec,
    }
    rows = tuple(
        (name, *(significant(values[kind][row, axis]) for axis in (3, 2) for kind in kinds))
        for row, name in _PARTS
    )
    heads = tuple(f"{where}, {kind}" for where in ("Across", "Roll") for kind in kinds)
    said = (
        "" if tested else f" {WITH_MISFIT_FOUND[0].upper()}{WITH_MISFIT_FOUND[1:]}: {NOT_ASSESSED}."
    )
    if tested and all(
        found == held
        for _, *cells in rows
        for found, held in zip(cells[::2], cells[1::2], strict=True)
    ):
        heads, rows = (
            ("Across the boresight", "Roll"),
            tuple((name, across, roll) for name, across, _, roll, _ in rows),
        )
    title = f"arcsec, 1 sigma; across the boresight per axis. {_PARTS_SAID}{said}"
    return TextTable(("Contribution", *heads), rows, title)


def budget_summary(budget: Budget) -> TextTable:
    """Each requirement against what is reached; without any, the totals after alignment."""
    if budget.outcomes:
        return table("requirements", it=budget.outcomes)
    totals = [budget.total(axis, AFTER) for axis in (CROSS_BORESIGHT, "roll")]
    given = {"confidence": budget.confidence, "labels": AXIS_LABELS}
    return table("after_alignment", given, it=totals)


def terminal_summary(results: Results) -> list[str]:
    """The run in lines of at most 80 columns, without the verdict; commands can be copied."""
    text = (
        template_environment()
        .get_template("summary.txt.j2")
        .render(
            {one.__name__: one for one in _KNOWN},
            results=results,
            parts=_PARTS,
            both=_both,
            changed=lambda error: any("(" in _both(error, r, c) for r, _ in _PARTS for c in (3, 2)),
            shell=_shell,
        )
    )
    # A filter of nothing leaves an empty line.
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def verdict_lines(verdict: Verdict) -> list[str]:
    """The verdict in at most 80 columns."""
    return wrapped(f"Verdict ({verdict.level.value}): {verdict.headline}").splitlines()


def _both(error: AttitudeError, row: int, axis: int) -> str:
    held = significant(error.if_model_holds_arcsec[row, axis])
    found = held if error.misfit is None else significant(error.with_misfit_found_arcsec[row, axis])
    return held if found == held else f"{found} ({held})"


def _shell(text: str) -> str:
    """A command over lines that a shell puts together again."""
    lines = ["    try:"]
    for word in shlex.split(text):
        written = word if word == "&&" else shlex.quote(word)
        # Room for the backslash.
        if len(lines[-1]) + len(written) + 3 > WIDTH and lines[-1].strip():
            lines.append("     ")
        lines[-1] += f" {written}"
    return " \\\n".join(lines)


_KNOWN = (
    Level,
    Question,
    parameter_rows,
    confidence_text,
    budget_summary,
    by_contributor,
    uses,
    zip,
)
