"""Requirements of a budget, and why its two bounds differ, in words.

A number may be a range, (least, most), where several findings are told as one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

from starcal_uq.budgeting.file import SENSOR, Requirement
from starcal_uq.budgeting.result import Outcome
from starcal_uq.budgeting.rows import AXIS_LABELS, confidence_text
from starcal_uq.budgeting.totals import Difference
from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import join_words, significant
from starcal_uq.core.status import Code, Level
from starcal_uq.presentation.sentences.table import SENTENCES, Told, entry
from starcal_uq.propagation.attitude_error import NOT_ASSESSED

NOT_RESOLVED = "not resolved"
Number: TypeAlias = float | tuple[float, float]

_REASONS = {
    Difference.IN_WORDS: "{words}",
    Difference.NO_ERROR: "No error is left: all rows are zero.",
    Difference.SMALL_MOSTLY: (
        "the sigma of {row!r} changes from frame to frame, so that at this confidence more of its "
        "errors are small than of a Gaussian error"
    ),
    Difference.GROUP: (
        "rows of a correlation group that are not Gaussian add to a longer tail than their "
        "sigmas say"
    ),
    Difference.MEAN_ADDED: (
        "the rule adds the whole mean to the spread, as if both always pointed the same way"
    ),
    Difference.MEAN_SHIFTS: (
        "a mean shifts the errors to one side, where fewer sigmas hold the same share than on "
        "both sides"
    ),
    Difference.WORST_CASE: (
        "a worst case points one way, where fewer sigmas hold the same share than on both sides"
    ),
    Difference.CORNERS: (
        "bounded distributions on two axes leave less in the corners than Gaussian errors do"
    ),
}
SENTENCES |= {code: reason.format for code, reason in _REASONS.items()}


def without_numbers(finding: Finding) -> tuple[Any, ...]:
    """What findings have in common that differ in their numbers alone."""
    return (finding.code, *(_without(value) for value in finding.values.values()))


def _without(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_without(item) for item in value)
    if isinstance(value, Finding):
        return without_numbers(value)
    return value if isinstance(value, str) else None


def ranged(alike: Sequence[Finding]) -> Finding:
    """Findings that differ in their numbers alone as one, with the ranges of these."""
    first = alike[0]
    columns = ([one.values[name] for one in alike] for name in first.values)
    return replace(first, values=dict(zip(first.values, map(_range, columns), strict=True)))


def _range(values: Sequence[Any]) -> Any:
    first = values[0]
    if isinstance(first, tuple):
        return tuple(_range(items) for items in zip(*values, strict=True))
    if isinstance(first, Finding):
        return ranged(values)
    return first if isinstance(first, str) else (min(values), max(values))


def _digits(value: Number, digits: int, scale: float = 1.0) -> str:
    ends = value if isinstance(value, tuple) else (value,)
    return " to ".join(dict.fromkeys(significant(scale * end, digits) for end in ends))


def _percent(value: Number, digits: int = 2) -> str:
    return f"{_digits(value, digits, 100.0)}\N{NO-BREAK SPACE}%"


@entry(Difference.NOT_RESOLVED)
def _not_resolved(n_samples: Number, confidence: Number) -> str:
    n, level = (
        value[0] if isinstance(value, tuple) else value for value in (n_samples, confidence)
    )
    return (
        f"{n} samples do not resolve a confidence of {confidence_text(level)}: there is no sampled "
        "bound."
    )


@entry(Difference.AGREE)
def _agree(within: Number) -> str:
    return f"Both bounds agree within {_percent(within, 1)}."


@entry(Difference.DIFFER)
def _differ(size: Number, side: str, reasons: Sequence[Finding]) -> str:
    said = "; ".join(reason.sentence for reason in reasons)
    why = said or "the rows together are not Gaussian, as the rule takes them to be"
    return f"The rule is {_percent(size)} {side} the sampled bound: {why}."


@entry(Difference.CHANGING_SIGMA)
def _changing_sigma(row: str, tail_sigma: Number) -> str:
    return (
        f"the sigma of {row!r} changes from frame to frame, so that 99.7 % of its errors reach "
        f"{_digits(tail_sigma, 3)} sigma where a Gaussian error reaches 2.97"
    )


def _share(row: str, share: Number) -> str:
    return f"{row!r} has {_percent(share)} of the squared half-widths"


@entry(Difference.ONE_SIDED)
def _one_sided(row: str, share: Number) -> str:
    return (
        f"{_share(row, share)} and is one-sided (Rayleigh), with a longer tail than a Gaussian "
        "error"
    )


@entry(Difference.REACHES_FURTHER)
def _reaches_further(row: str, share: Number, shape: str) -> str:
    return (
        f"{_share(row, share)}; its distribution is {shape}, and at this confidence reaches "
        "further than a Gaussian error of the same sigma"
    )


@entry(Difference.ENDS)
def _ends(row: str, share: Number, shape: str, end_sigma: Number, factor: Number) -> str:
    return (
        f"{_share(row, share)}; its distribution is {shape} and ends at {_digits(end_sigma, 3)} "
        f"sigma, where the rule takes {_digits(factor, 3)}"
    )


@entry(Difference.BOUNDED)
def _bounded(rows: Sequence[str], factor: Number) -> str:
    each = "" if len(rows) == 1 else " of each"
    names = join_words([repr(row) for row in rows])
    return (
        f"{names} cannot exceed a fixed size, while the rule takes {_digits(factor, 3)} sigma{each}"
    )


def bound(value: float, at_least: bool, digits: int = 3) -> str:
    """A bound in arcsec, with "≥" while contributors are missing."""
    if math.isnan(value):
        return NOT_ASSESSED
    return ("≥ " if at_least else "") + significant(value, digits)


def axis_label(asked: Requirement) -> str:
    """Axis of a requirement, with the frame where it is not the sensor's."""
    label = AXIS_LABELS[asked.axis]
    return label if asked.frame == SENSOR else f"{label.split(' (')[0]} of {asked.frame}"


def outcome_text(outcome: Outcome) -> str:
    """A requirement and what became of it, in one sentence."""
    asked, total = outcome.requirement, outcome.total
    axis = axis_label(asked)
    what = f"{axis}, {confidence_text(asked.confidence)}, {asked.scope}, {asked.interpretation}"
    limit = f"against a limit of {significant(asked.limit_arcsec, 3)}"
    numbers = f"{significant(outcome.bound_arcsec, 3)} arcsec {limit}"
    named = f"{asked.name!r} ({what}) is"
    least = "at least " if total.at_least else ""
    if outcome.unresolved:
        return (
            f"{named} open: {total.explanation.removesuffix('.')}. The rule, which knows Gaussian "
            f"tails only, says {least}{significant(total.rule_arcsec, 3)} arcsec {limit}; "
            "judged_by = 'rule' would let it judge alone."
        )
    if math.isnan(outcome.bound_arcsec):
        return f"{named} open: no contributor is assessed."
    lower = significant(outcome.least_arcsec, 3)
    if outcome.verdict == "violated":
        cause = f"; {total.dominant!r} dominates" if total.dominant else ""
        if outcome.least_arcsec < outcome.bound_arcsec:
            least = "at least "
        return f"{named} violated: {least}{lower} arcsec {limit}{cause}."
    if outcome.between:
        so_far = " so far" if total.at_least else ""
        return f"{named} open: at the least {lower} and at most {numbers}{so_far}."
    if outcome.verdict == "open":
        count = len(total.not_assessed)
        missing = f"{count} contributors are" if count > 1 else "1 contributor is"
        return f"{named} open: {numbers} so far, but {missing} not assessed."
    return f"{named} met: {numbers}, margin {significant(outcome.margin_arcsec, 3)} arcsec."


@entry(Code.REQUIREMENT)
def _requirement(good: bool, outcome: Outcome, limit_arcsec: float) -> Told:
    reached = outcome.least_arcsec if outcome.level is Level.FAIL else outcome.bound_arcsec
    value = (
        NOT_RESOLVED if outcome.unresolved else f"{bound(reached, outcome.total.at_least)} arcsec"
    )
    return value, f"at most {significant(limit_arcsec, 3)} arcsec", outcome_text(outcome)
