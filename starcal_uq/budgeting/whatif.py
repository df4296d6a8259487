"""What changes a budget, and what its rows may grow to: two budgets row by row, and a requirement
shared out over the rows of one.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.file import SENSOR
from starcal_uq.budgeting.result import Budget
from starcal_uq.budgeting.rows import CONTROL, Contributor
from starcal_uq.budgeting.totals import covariance
from starcal_uq.core.constants import AXES, CROSS_BORESIGHT
from starcal_uq.core.errors import BudgetError, check_known

if TYPE_CHECKING:
    import pandas as pd

_SIZES = ("mean_arcsec", "sigma_arcsec")
_DERIVED = (*_SIZES, "if_model_holds_arcsec", "with_misfit_found_arcsec")


def budget_difference(before: Budget, after: Budget) -> pd.DataFrame:
    """Rows in which two budgets differ, the largest change of the mean square first.

    Parameters
    ----------
    before, after : Budget
        Two budgets, such as those of two sensors, or of one with another file.

    Returns
    -------
    DataFrame
        ``name``, ``axis``; ``mean_arcsec`` and ``sigma_arcsec`` of both, with the suffixes
        ``_before`` and ``_after``, NaN where a row is missing or not assessed;
        ``mean_square_change_arcsec2``, where what is not assessed counts as nothing; and
        ``causes``: the entries of the row that differ beside its size.
    """
    import pandas as pd

    rows = [{(row.name, row.axis): row for row in budget.rows} for budget in (before, after)]
    records = []
    for name, axis in dict.fromkeys((*rows[0], *rows[1])):
        old, new = (by_place.get((name, axis)) for by_place in rows)
        if repr(old) == repr(new):
            continue
        sizes = {
            f"{size}_{when}": math.nan if row is None else getattr(row, size)
            for when, row in (("before", old), ("after", new))
            for size in _SIZES
        }
        change = float(np.nansum(np.square([sizes[f"{size}_after"] for size in _SIZES])))
        change -= float(np.nansum(np.square([sizes[f"{size}_before"] for size in _SIZES])))
        missing = "row is new" if old is None else "row is gone" if new is None else ""
        causes = missing or ", ".join(
            f.name
            for f in fields(Contributor)
            if f.name not in _DERIVED and repr(getattr(old, f.name)) != repr(getattr(new, f.name))
        )
        records.append((name, axis, *sizes.values(), change, causes))
    heads = [f"{size}_{when}" for when in ("before", "after") for size in _SIZES]
    columns = ["name", "axis", *heads, "mean_square_change_arcsec2", "causes"]
    found = pd.DataFrame(records, columns=columns)
    order = found["mean_square_change_arcsec2"].abs().sort_values(ascending=False, kind="stable")
    return found.loc[order.index].reset_index(drop=True)


def allocation(budget: Budget, requirement: str) -> pd.DataFrame:
    """Allocation of a requirement: the size of each row if all rows grow or shrink by one factor.

    Parameters
    ----------
    budget : Budget
        The budget.
    requirement : str
        Name of one of its requirements, on the absolute knowledge error in the sensor's frame.

    Returns
    -------
    DataFrame
        One row per contributor and axis of the requirement: ``name``, ``axis``, ``sigma_arcsec``,
        its ``share`` of the variance of the total, and ``allocated_arcsec``, its sigma where the
        bound is the limit. Means, which no allocation scales, are taken from the limit first.

    Raises
    ------
    BudgetError
        For a requirement that there is not, that is about another index or frame, or whose means
        alone exceed the limit.
    """
    import pandas as pd

    known = {outcome.requirement.name: outcome for outcome in budget.outcomes}
    check_known("requirement", requirement, known, BudgetError)
    asked, total = known[requirement].requirement, known[requirement].total
    if asked.index != "AKE" or asked.frame != SENSOR:
        raise BudgetError(
            f"the requirement {requirement!r} is about {asked.limited.label} in the frame "
            f"{asked.frame!r}: choose one on AKE in the frame {SENSOR!r}."
        )
    axes = AXES[:2] if asked.axis == CROSS_BORESIGHT else (asked.axis,)
    counted = [
        row
        for row in budget.rows
        if row.axis in axes and row.counts(asked.scope) and row.assessed and row.applies
    ]
    counted = [row for row in counted if row.part != CONTROL]
    mean = abs(total.mean_arcsec)
    if not known[requirement].bound_arcsec > mean or asked.limit_arcsec <= mean:
        raise BudgetError(
            f"the requirement {requirement!r} has no sigma to share out: its means reach "
            f"{mean:.4g} of {asked.limit_arcsec:.4g} arcsec."
        )
    scale = (asked.limit_arcsec - mean) / (known[requirement].bound_arcsec - mean)
    places = [AXES.index(axis) for axis in axes]
    whole = float(np.diag(covariance(counted))[places].sum())
    # What is left without a row: rows of one group share what they have together.
    rest = [
        float(np.diag(covariance([one for one in counted if one is not row]))[places].sum())
        for row in counted
    ]
    apart = np.maximum(whole - np.array(rest), 0.0)
    records = [
        (row.name, row.axis, row.sigma_arcsec, share, row.sigma_arcsec * scale)
        for row, share in zip(counted, apart / max(float(apart.sum()), 1e-300), strict=True)
    ]
    columns = ["name", "axis", "sigma_arcsec", "share", "allocated_arcsec"]
    return pd.DataFrame(records, columns=columns)
