"""The budget in sentences and tables: contributors, totals, requirements, and why two bounds
differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from starcal_uq.budgeting.result import Budget, by_contributor
from starcal_uq.budgeting.rows import AXIS_LABELS, SCOPES, Contributor, confidence_text
from starcal_uq.budgeting.shapes import one_axis_factor, two_axis_radius
from starcal_uq.core.constants import AXES, TOTAL_AXES
from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import join_words
from starcal_uq.core.types import AnyDict
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.numbers import bound
from starcal_uq.presentation.words.sentences import rows, table, told
from starcal_uq.propagation.attitude_error import IF_MODEL_HOLDS, NOT_ASSESSED, WITH_MISFIT_FOUND

Row = AnyDict
_MIXED = "mixed"
_MEANING = {
    "mixed": "a sensor and a moment at random",
    "ensemble": "a sensor at random, at its worst moment",
    "temporal": "the worst sensor, at a moment at random",
}


def tables(budget: Budget) -> AnyDict:
    """All rows and sentences."""
    return {
        "title": budget.title,
        "confidence": confidence_text(budget.confidence),
        "rows": contributor_rows(budget),
        "has_means": any(row.assessed and row.mean_arcsec != 0.0 for row in budget.rows),
        "classes": class_rows(budget),
        "totals": total_rows(budget).records,
        "indices": index_rows(budget).records,
        "filter": rows("filter", budget) if budget.filter else None,
        "interpretations": _MEANING,
        "requirements": table("outcomes", it=budget.outcomes).records,
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
    found = by_contributor(budget.rows)
    figures = map(_figures, found.values())
    return table("contributors", name=found, axes=found.values(), figures=figures).records


def _figures(axes: dict[str, Contributor]) -> dict[str, list[str]]:
    """What the posterior fills, by the two names that every attitude error has; empty where there
    is one figure.
    """
    if any(math.isnan(row.if_model_holds_arcsec) for row in axes.values()):
        return {}
    found = [bound(row.with_misfit_found_arcsec, False, 2) for row in axes.values()]
    held = [bound(row.if_model_holds_arcsec, False, 2) for row in axes.values()]
    return {} if found == held else {WITH_MISFIT_FOUND: found, IF_MODEL_HOLDS: held}


def class_rows(budget: Budget) -> list[Row]:
    """One row per class of the standard: sigma on its axes after alignment."""
    found: dict[str, list[str]] = {}
    for name, _, sigma, at_least in budget.classes_dataframe().itertuples(index=False):
        found.setdefault(name, []).append(bound(sigma, at_least))
    return [{"name": name, "sigma": cells} for name, cells in found.items()]


def total_rows(budget: Budget) -> TextTable:
    """One row per scope and axis: mean, sigma, factor and the bounds of all interpretations."""
    return _totals(budget, ("AKE",), SCOPES)


def index_rows(budget: Budget) -> TextTable:
    """One row per error index and axis after alignment; empty where no index was asked for."""
    return _totals(budget, budget.indices if budget.index_totals else (), SCOPES[1:])


def _totals(budget: Budget, indices: Sequence[str], scopes: Sequence[str]) -> TextTable:
    places = list(product(indices, scopes, TOTAL_AXES))
    found = {
        kind: [budget.total(axis, scope, kind, index) for index, scope, axis in places]
        for kind in _MEANING
    }
    return table("totals", **found)


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
    axes = by_contributor(budget.rows).values()
    for row, figures in zip(contributor_rows(budget), map(_figures, axes), strict=True):
        # What is not assessed is said once where it holds for all axes.
        sigma = [row[axis] for axis in AXES] if row["assessed"] else [NOT_ASSESSED, "", ""]
        shown = ("", "", "") if figures else sigma
        rows.append(
            (row["name"], row["ecss_class"], *shown, row["interpretation"], row["absorbed"])
        )
        rows += [(f"  {name}", "", *values, "", "") for name, values in figures.items()]
    heads = ("contributor", "class", *AXES, "random over", "absorbed")
    return TextTable(
        heads, tuple(rows), f"{budget.title}: contributors, 1 sigma, arcsec", "lllllll"
    )


_BOUNDS = ("axis", "sigma", "rule", "sampled")


def totals_table(budget: Budget) -> TextTable:
    """One row per scope and axis, in the mixed interpretation."""
    title = f"Totals at {confidence_text(budget.confidence)}, mixed interpretation, arcsec"
    return total_rows(budget).part(("scope", *_BOUNDS), title)


def indices_table(budget: Budget) -> TextTable:
    """One row per error index and axis after alignment, in the mixed interpretation."""
    title = f"Error indices at {confidence_text(budget.confidence)} after alignment, arcsec"
    taken = dict.fromkeys(name for entry in budget.index_totals for name in entry.at_most)
    if taken:
        title += f"; at most, as their behaviour in time is not stated: {join_words([*taken])}"
    return index_rows(budget).part(("index", *_BOUNDS), title)
