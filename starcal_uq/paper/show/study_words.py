"""Where the interaction of optics and distortion costs more than noise, in plain words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import count, fixed, join_words, plural, significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.statistics import ENOUGH_REPLICATES

if TYPE_CHECKING:
    from starcal_uq.paper.interaction_result import InteractionStudy, Threshold
    from starcal_uq.paper.replicates_result import Replicates

# Spread over noise that is worth a sentence.
_NOTICEABLE = 1.3


_NOUN = {
    "distortion": "of distortion at the corner",
    "field": "of field",
    "frames": "frames",
    "stars": "stars in a frame",
}


_EVERYWHERE = {
    "distortion": "at every distortion studied",
    "field": "at every field of view studied",
    "frames": "at every number of frames studied",
    "stars": "at every number of stars studied",
}


def interaction_verdict(study: InteractionStudy) -> str:
    """One paragraph: what is held fixed, then method by method."""
    from starcal_uq.paper.interaction_result import HANDLING

    sentences = [f"{_setting(study)} the bias of the optics exceeds one standard deviation of the noise:"]
    sentences += [sentence_on(study, method) for method in HANDLING]
    sentences += [_price(study)]
    if study.interrupted:
        sentences.append("The study was interrupted: later replicates are missing.")
    return " ".join(sentence for sentence in sentences if sentence)


def sentence_on(study: InteractionStudy, method: str) -> str:
    """Where the bias of one method passes one standard deviation of its noise."""
    from starcal_uq.paper.interaction_result import AXES, HANDLING

    found = [t for t in study.thresholds if t.method == method and t.kind == "bias"]
    if not found:
        return ""
    what = "ignores the distortion" if HANDLING[method] == "ignores" else f"{HANDLING[method]} the two"
    who = f"{method[:1].upper()}{method[1:]}, which {what}"
    if all(t.side == "never" for t in found):
        rows = study.table[study.table["method"] == method]
        largest = float(rows["bias_over_noise"].max())
        return f"{who}: nowhere (largest bias {significant(largest, 1)} standard deviations)."
    parts = []
    for axis in AXES:
        some = [t for t in found if t.axis == axis]
        if some:
            parts.append(_along(axis, some))
    return f"{who}: {'; '.join(parts)}.{_scatter(study, method)}"


def _scatter(study: InteractionStudy, method: str) -> str:
    """How much more than noise the spread holds at the unvaried point, where that is noticeable."""
    base = study.table[study.table["axis"] == "distortion"]["n_frames"]
    rows = study.table[(study.table["axis"] == "frames") & (study.table["method"] == method)]
    rows = rows[rows["n_frames"].isin(base)]
    ratio = (rows["spread"] / rows["noise"]).to_numpy()
    if len(ratio) == 0 or not ratio.min() > _NOTICEABLE:
        return ""
    return f" Its spread is {_span(ratio)} times the noise, because the bias depends on where the stars happen to be."


def _span(values: FloatArray) -> str:
    low, high = fixed(float(values.min()), 1), fixed(float(values.max()), 1)
    return low if low == high else f"{low} to {high}"


def _along(axis: str, found: list[Threshold]) -> str:
    """One axis, parameters with the same kind of answer together."""
    unit = {"distortion": "px ", "field": "deg "}.get(axis, "")
    parts = []
    for side, start, end in (("above", "from", " on"), ("below", "up to", "")):
        some = [t for t in found if t.side == side]
        if some:
            values = join_words([f"{_value(axis, t.value)} ({t.parameter})" for t in some])
            parts.append(f"{start} {values} {unit}{_NOUN[axis]}{end}")
    for side, words in (("always", _EVERYWHERE[axis]), ("never", _EVERYWHERE[axis].replace("at every", "at no"))):
        names = [t.parameter for t in found if t.side == side]
        if names:
            parts.append(words if len(names) == len(found) else f"{words} ({join_words(names)})")
    return ", ".join(parts)


def cell(axis: str, t: Threshold | None) -> str:
    """One threshold in a table: the value, or everywhere or nowhere along the axis."""
    if t is None:
        return ""
    if t.side == "always":
        return "everywhere"
    if t.side == "never":
        return "nowhere"
    return f"{'from' if t.side == 'above' else 'up to'} {_value(axis, t.value)}"


def _value(axis: str, value: float) -> str:
    # More digits than one would be those of chance.
    return count(int(float(f"{value:.0e}"))) if axis == "frames" else significant(value, 1)


def _setting(study: InteractionStudy) -> str:
    """What holds along the axes that do not vary it."""
    table = study.table
    base = table[table["axis"] == "distortion"]
    field = table[table["axis"] != "field"]
    corner = table[table["axis"] != "distortion"]["corner_size_px"]
    if base.empty or corner.empty:
        return "Where the axis does not say otherwise,"
    row = base.iloc[0]
    return (
        f"With {plural(int(row['n_frames']), 'frame')} of {fixed(float(row['stars_per_frame']), 0)} stars, a field of "
        f"{fixed(float(field['field_deg'].iloc[0]), 1)} deg, {significant(float(corner.iloc[0]))} px of distortion at "
        f"the corner and {significant(float(row['sigma_px']), 1)} px of noise, where the axis does not say otherwise,"
    )


def _price(study: InteractionStudy) -> str:
    """What coupling costs where there is nothing to couple, and from where on it pays."""
    from starcal_uq.paper.interaction_result import OPTICS, REFERENCE

    simple = "least squares"
    parts = []
    for parameter in OPTICS:
        one, two = (study.points("distortion", m, parameter) for m in (simple, REFERENCE))
        if one.empty or float(one["corner_size_px"].iloc[0]) != 0.0:
            return ""
        parts.append((parameter, float(two["spread"].iloc[0] / one["spread"].iloc[0])))
    price = join_words([f"{fixed(ratio, 1)} ({name})" for name, ratio in parts])
    text = f"Without distortion, coupling costs: the spread of {REFERENCE} is {price} times that of {simple}"
    pays = [study.threshold("distortion", simple, parameter, "rmse") for parameter in OPTICS]
    known = [f"{significant(t.value, 1)} px ({t.parameter})" for t in pays if np.isfinite(t.value)]
    return f"{text}; it pays from a distortion of {join_words(known)} at the corner on." if known else f"{text}."


NBSP = "\N{NO-BREAK SPACE}"


def replicates_verdict(found: Replicates) -> str:
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
