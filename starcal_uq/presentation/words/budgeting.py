"""The budget in sentences and tables: contributors, totals, requirements, and why two bounds
differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from starcal_uq.budgeting.result import Budget, by_contributor
from starcal_uq.budgeting.rows import AXIS_LABELS, SCOPES, Contributor, confidence_text
from starcal_uq.budgeting.shapes import one_axis_factor, two_axis_radius
from starcal_uq.budgeting.totals import Total
from starcal_uq.core.constants import AXES, TOTAL_AXES
from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import decimals_for, fixed, join_words, significant
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.numbers import bound
from starcal_uq.presentation.words.sentences import rows, table, told
from starcal_uq.propagation.attitude_error import IF_MODEL_HOLDS, NOT_ASSESSED, WITH_MISFIT_FOUND

Row = AnyDict
NOT_RESOLVED = "not resolved"
# Above what rounding makes of 2.968.
_GAUSSIAN_TAIL = 2.98
_MIXED, *_OTHERS = ("mixed", "ensemble", "temporal")

# What may differ between the axes of a contributor, by the fields of its rows.
_LISTED = {
    **{name: name for name in ("ecss_class", "interpretation", "combination", "behaviour")},
    "absorbed": "absorbed_by_alignment",
    "group": "correlation_group",
    "conditions": "conditions",
}
_MEANING = {
    "mixed": "a sensor and a moment at random",
    "ensemble": "a sensor at random, at its worst moment",
    "temporal": "the worst sensor, at a moment at random",
}


def tables(budget: Budget) -> AnyDict:
    """All rows and sentences."""
    sampled = [_sampled(outcome.total) for outcome in budget.outcomes]
    return {
        "title": budget.title,
        "confidence": confidence_text(budget.confidence),
        "rows": contributor_rows(budget),
        "has_means": any(row.assessed and row.mean_arcsec != 0.0 for row in budget.rows),
        "classes": class_rows(budget),
        "totals": total_rows(budget),
        "indices": index_rows(budget),
        "filter": rows("filter", budget) if budget.filter else None,
        "interpretations": [{"name": name, "meaning": text} for name, text in _MEANING.items()],
        "requirements": table("outcomes", it=budget.outcomes, sampled=sampled).records,
        "headline": told("budget", budget),
        "not_drawn": len(budget.outcomes) - len(budget.comparable),
        "violated": bool(budget.violations),
        "open": bool(budget.not_assessed or budget.open_requirements),
        "explanations": explanations(budget),
        "notes": list(budget.notes),
        "factors": told(
            "factor",
            budget.confidence,
            one_axis=one_axis_factor(budget.confidence),
            two_axes=two_axis_radius(budget.confidence, 1.0, 1.0),
        ),
    }


def contributor_rows(budget: Budget) -> list[Row]:
    """One row per contributor, its three axes side by side; what differs between axes is listed."""
    return [_contributor_row(name, axes) for name, axes in by_contributor(budget.rows).items()]


def _contributor_row(name: str, axes: dict[str, Contributor]) -> Row:
    stated = [row for row in axes.values() if row.assessed]
    first = next(iter(axes.values()))
    every = stated or [first]

    figures = _figures(axes)
    listed = {key: _several(every, field) for key, field in _LISTED.items()}
    return {
        "name": name,
        **listed,
        "sigma": [_sigma(axes.get(axis)) for axis in AXES],
        "figures": figures,
        "figures_text": "; ".join(f"{name}: {_listed(values)}" for name, values in figures),
        "mean": _means(axes),
        "missing": [axis in axes and not axes[axis].assessed for axis in AXES],
        "distribution": " / ".join(
            dict.fromkeys(row.distribution if row.applies else "does not apply" for row in stated)
        ),
        "tail": _tails(stated),
        "provenance": _several(stated, "provenance"),
        "source": _several(axes.values(), "source"),
        "inflated": any(row.inflated for row in stated),
        "assessed": bool(stated),
    }


def _several(rows: Iterable[Contributor], field: str) -> str:
    """What rows have in a field, each once."""
    return " / ".join(dict.fromkeys(filter(None, (getattr(row, field) for row in rows))))


def _sigma(row: Contributor | None) -> str:
    if row is None:
        return "–"
    if not row.assessed:
        return NOT_ASSESSED
    # With the digits of the attitude table, where it is the same number.
    return (
        significant(row.sigma_arcsec, 2 if row.source == "posterior" else 3)
        if row.applies
        else "n/a"
    )


def _figures(axes: dict[str, Contributor]) -> list[tuple[str, list[str]]]:
    """What the posterior fills, by the two names that every attitude error has; empty where there
    is one figure.
    """
    rows = list(axes.values())
    if any(math.isnan(row.if_model_holds_arcsec) for row in rows):
        return []
    pairs = (
        (WITH_MISFIT_FOUND, [row.with_misfit_found_arcsec for row in rows]),
        (IF_MODEL_HOLDS, [row.if_model_holds_arcsec for row in rows]),
    )
    told = [
        (name, [NOT_ASSESSED if math.isnan(v) else significant(v) for v in values])
        for name, values in pairs
    ]
    return told if told[0][1] != told[1][1] else []


def _listed(values: list[str]) -> str:
    return NOT_ASSESSED if set(values) == {NOT_ASSESSED} else f"{', '.join(values)} arcsec"


def _means(axes: dict[str, Contributor]) -> str:
    """Means of the three axes, or one 0 for all."""
    values = [
        axes[axis].mean_arcsec if axis in axes and axes[axis].assessed else None for axis in AXES
    ]
    if not any(values):
        return "0" if any(value is not None for value in values) else ""
    return ", ".join("–" if value is None else significant(value, 3) for value in values)


def _tails(rows: list[Contributor]) -> str:
    """The range of the tails where sigma changes from frame to frame."""
    tails = [
        row.tail_997
        for row in rows
        if row.distribution == "gaussian" and row.tail_997 > _GAUSSIAN_TAIL
    ]
    if not tails:
        return ""
    ends = " to ".join(dict.fromkeys(significant(tail, 3) for tail in (min(tails), max(tails))))
    return f"sigma varies by frame: 99.7 % within {ends} σ"


def class_rows(budget: Budget) -> list[Row]:
    """One row per class of the standard: sigma on its axes after alignment."""
    found: dict[str, list[str]] = {}
    for name, _, sigma, at_least in budget.classes_dataframe().itertuples(index=False):
        found.setdefault(name, []).append(bound(sigma, at_least))
    return [{"name": name, "sigma": cells} for name, cells in found.items()]


def _known(value: float) -> str:
    return "–" if math.isnan(value) else significant(value, 3)


def total_rows(budget: Budget) -> list[Row]:
    """One row per scope and axis: mean, sigma, factor and the bounds of all interpretations."""
    rows = []
    for scope in SCOPES:
        for axis in TOTAL_AXES:
            mixed = budget.total(axis, scope)
            rows.append(
                {
                    "scope": scope,
                    "axis": AXIS_LABELS[axis],
                    "mean": _known(mixed.mean_arcsec),
                    "sigma": bound(mixed.sigma_arcsec, mixed.at_least),
                    "factor": "–" if math.isnan(mixed.factor) else fixed(mixed.factor, 3),
                    "rule": bound(mixed.rule_arcsec, mixed.at_least),
                    "sampled": _sampled(mixed),
                    "others": [_pair(budget.total(axis, scope, kind)) for kind in _OTHERS],
                    "dominant": mixed.dominant or "–",
                }
            )
    return rows


def index_rows(budget: Budget) -> list[Row]:
    """One row per error index and axis after alignment; empty where no index was asked for."""
    return [
        {
            "index": label if axis == TOTAL_AXES[0] else "",
            "axis": AXIS_LABELS[axis],
            "sigma": bound(mixed.sigma_arcsec, mixed.at_least),
            **_pair(mixed),
            "others": [_pair(budget.total(axis, SCOPES[1], kind, label)) for kind in _OTHERS],
            "at_most": join_words(mixed.at_most) if axis == TOTAL_AXES[0] else "",
        }
        for label in (budget.indices if budget.index_totals else ())
        for axis in TOTAL_AXES
        for mixed in [budget.total(axis, SCOPES[1], index=label)]
    ]


def _sampled(total: Total) -> str:
    if total.unresolved:
        return NOT_RESOLVED
    if math.isnan(total.sampled_arcsec):
        return NOT_ASSESSED
    digits = max(decimals_for(total.sampled_se_arcsec, 1), decimals_for(total.sampled_arcsec, 2))
    digits = min(digits, decimals_for(total.sampled_arcsec, 3))
    return ("≥ " if total.at_least else "") + fixed(total.sampled_arcsec, digits)


def _pair(total: Total) -> dict[str, str]:
    return {"rule": bound(total.rule_arcsec, total.at_least), "sampled": _sampled(total)}


def explanations(budget: Budget) -> list[str]:
    """Why rule and sampling differ, one line per distinct reason, for the mixed interpretation.

    Reasons that differ in their numbers alone are one, with the ranges of these.
    """
    found: dict[Any, tuple[list[str], list[Finding]]] = {}
    for entry in budget.totals:
        if entry.interpretation == _MIXED and entry.difference is not None:
            where, alike = found.setdefault(_without_numbers(entry.difference), ([], []))
            where.append(f"{AXIS_LABELS[entry.axis]}, {entry.scope}")
            alike.append(entry.difference)
    every = len(SCOPES) * len(TOTAL_AXES)
    return [
        f"{'All totals' if len(where) == every else '; '.join(where)}: {_ranged(alike).sentence}"
        for where, alike in found.values()
    ]


def _without_numbers(finding: Finding) -> tuple[Any, ...]:
    """What findings have in common that differ in their numbers alone."""
    return (finding.code, *(_without(value) for value in finding.values.values()))


def _without(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_without(item) for item in value)
    if isinstance(value, Finding):
        return _without_numbers(value)
    return value if isinstance(value, str) else None


def _ranged(alike: Sequence[Finding]) -> Finding:
    """Findings that differ in their numbers alone as one, with the ranges of these."""
    first = alike[0]
    columns = ([one.values[name] for one in alike] for name in first.values)
    return replace(first, values=dict(zip(first.values, map(_range, columns), strict=True)))


def _range(values: Sequence[Any]) -> Any:
    first = values[0]
    if isinstance(first, tuple):
        return tuple(_range(items) for items in zip(*values, strict=True))
    if isinstance(first, Finding):
        return _ranged(values)
    return first if isinstance(first, str) else (min(values), max(values))


def contributors_table(budget: Budget) -> TextTable:
    """One row per contributor, 1 sigma on its axes; what the posterior fills by both its
    figures.
    """
    rows: list[tuple[str, ...]] = []
    for row in contributor_rows(budget):
        # What is not assessed is said once where it holds for all axes.
        sigma = row["sigma"] if row["assessed"] else (NOT_ASSESSED, "", "")
        shown = ("", "", "") if row["figures"] else sigma
        rows.append(
            (row["name"], row["ecss_class"], *shown, row["interpretation"], row["absorbed"])
        )
        rows += [(f"  {name}", "", *values, "", "") for name, values in row["figures"]]
    heads = ("contributor", "class", *AXES, "random over", "absorbed")
    return TextTable(
        heads, tuple(rows), f"{budget.title}: contributors, 1 sigma, arcsec", "lllllll"
    )


def totals_table(budget: Budget) -> TextTable:
    """One row per scope and axis, in the mixed interpretation."""
    title = f"Totals at {confidence_text(budget.confidence)}, mixed interpretation, arcsec"
    return _bounds("scope", total_rows(budget), title)


def _bounds(first: str, rows: list[Row], title: str) -> TextTable:
    heads = (first, "axis", "sigma", "rule", "sampled")
    cells = tuple(tuple(row[name] for name in heads) for row in rows)
    return TextTable(heads, cells, title, "lllll")


def indices_table(budget: Budget) -> TextTable:
    """One row per error index and axis after alignment, in the mixed interpretation."""
    title = f"Error indices at {confidence_text(budget.confidence)} after alignment, arcsec"
    taken = dict.fromkeys(name for entry in budget.index_totals for name in entry.at_most)
    if taken:
        title += f"; at most, as their behaviour in time is not stated: {join_words([*taken])}"
    return _bounds("index", index_rows(budget), title)
