"""What replicates found, in plain words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import count, fixed, join_words, plural, significant
from starcal_uq.core.types import AnyDict
from starcal_uq.paper.statistics import ENOUGH_REPLICATES

if TYPE_CHECKING:
    from starcal_uq.paper.replicates_result import Replicates


NBSP = "\N{NO-BREAK SPACE}"


def verdict(found: Replicates) -> str:
    """One paragraph: who is biased, who claims too little or too much, and who is honest."""
    frames = found.provenance["settings"].get("n_frames")
    data = "" if frames is None else f" of {plural(int(frames), 'frame')}"
    opening = f"Over {plural(found.n_replicates, 'replicate')}{data}: "
    if found.n_replicates < ENOUGH_REPLICATES:
        return f"{opening}too few to judge (give at least {ENOUGH_REPLICATES}).{_interrupted(found)}"
    return opening + " ".join(f"{verdict_of(found, label)}" for label in found.labels) + _interrupted(found)


def verdict_of(found: Replicates, label: str) -> str:
    """One sentence on one method."""
    rows = [row for row in found.table().to_dict("records") if row["method"] == label]
    parts = []
    biased = [row for row in rows if row["biased"]]
    if biased:
        sizes = join_words([f"{significant(abs(row['bias_over_spread']))} ({row['parameter']})" for row in biased])
        parts.append(f"is biased by {sizes} of its sigmas")
    wrong = [row for row in rows if row["claim_wrong"]]
    for phrase, some in (
        ("claims too little", [row for row in wrong if row["claimed_over_spread"] < 1.0]),
        ("claims too much", [row for row in wrong if row["claimed_over_spread"] > 1.0]),
    ):
        if some:
            where = "" if len(some) == len(rows) else f" in {join_words([row['parameter'] for row in some])}"
            parts.append(f"{phrase}{where}: {_range(some, 'claimed_over_spread')} of its spread")
    if not wrong:
        honest = "claims what it spreads" if biased else "is honest"
        parts.append(f"{honest} ({_range(rows, 'claimed_over_spread')} of its spread)")
    if biased:
        parts.append(
            f"but {_range(rows, 'claimed_over_rmse')} of its error: its 95{NBSP}% intervals hold the truth in "
            f"{_percents(rows, 'coverage95')} of the cases"
        )
    classical = [row for row in rows if np.isfinite(row["claimed_classical"])]
    if classical:
        formula = "by the textbook's formula it would claim"
        parts.append(f"{formula} {_range(classical, 'claimed_classical_over_spread')} of its spread")
    complete = len(rows) == len(found.parameter_names)
    if complete and not biased:
        parts.append(f"has an efficiency of {_range(rows, 'efficiency')}")
    failed = found.n_failed(label)
    if failed:
        parts.append(f"gave no result in {count(failed)} of {plural(found.n_replicates, 'replicate')}")
    return f"{label[:1].upper()}{label[1:]} {'; '.join(parts)}."


def _percents(rows: list[AnyDict], key: str) -> str:
    low, high = (fixed(100.0 * end(row[key] for row in rows), 0) for end in (min, max))
    return f"{low}{NBSP}%" if low == high else f"{low} to {high}{NBSP}%"


def _range(rows: list[AnyDict], key: str) -> str:
    values = [row[key] for row in rows]
    low, high = (significant(v, 1) if v < 0.095 else fixed(v, 2) for v in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _interrupted(found: Replicates) -> str:
    if not found.interrupted:
        return ""
    return f" The run was interrupted after {count(found.n_replicates)} of {count(found.n_requested)}."
