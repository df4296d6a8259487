"""Two budgets side by side, and a requirement shared out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from starcal_uq.budgeting.rows import COMMON
from starcal_uq.budgeting.whatif import allocation, budget_difference
from starcal_uq.core.errors import BudgetError
from tests.budgeting.test_budget import attitude, made
from tests.budgeting.test_indices import ROW, written

# Two-sided quantile of a Gaussian error for 99.7 %.
FACTOR = 2.9677379253417833
LIMIT = '[[requirement]]\nname = "R-1"\naxis = "X"\nlimit_arcsec = {}\njudged_by = "rule"\n'


def test_two_budgets_differ_in_what_was_changed(tmp_path: Path) -> None:
    keys = "sigma_arcsec = {}\nconditions = {!r}"
    before = made(
        written(tmp_path, ROW.format(name="own", kind="mixed", keys=keys.format(3, "hot")))
    )
    after = made(
        written(tmp_path, ROW.format(name="own", kind="mixed", keys=keys.format(5, "cold"))),
        attitude=attitude(),
    )
    found = budget_difference(before, after)
    assert found[["name", "axis", "causes"]].to_numpy().tolist() == [["own", "pitch", "conditions"]]
    (row,) = found.to_dict("records")
    assert (row["sigma_arcsec_before"], row["sigma_arcsec_after"]) == (3.0, 5.0)
    assert row["mean_square_change_arcsec2"] == 25.0 - 9.0
    gone = budget_difference(before, made())
    assert set(gone["causes"]) == {"row is gone"} and gone["axis"].tolist()[0] == "pitch"
    assert budget_difference(before, before).empty


def test_allocated_rows_reach_the_limit(tmp_path: Path) -> None:
    row = ROW.format(name="own", kind="mixed", keys="sigma_arcsec = 3.0\nmean_arcsec = 1.0")
    found = allocation(made(written(tmp_path, row, LIMIT.format(8.0))), "R-1")
    (allocated,) = found.loc[found["name"] == "own", "allocated_arcsec"]
    assert found["share"].sum() == pytest.approx(1.0) and allocated < 3.0
    # With every row at its allocation the bound is the limit; no two of these rows err together.
    assert 1.0 + FACTOR * np.hypot.reduce(found["allocated_arcsec"]) == pytest.approx(8.0)
    assert 1.0 + FACTOR * np.hypot.reduce(found["sigma_arcsec"]) > 9.0
    assert COMMON not in set(found["name"])


@pytest.mark.parametrize(
    ("requirement", "words"),
    [
        ('[[requirement]]\nname = "R-1"\naxis = "X"\nlimit_arcsec = 0.5\n', "means reach 1"),
        (
            '[[requirement]]\nname = "R-1"\naxis = "X"\nlimit_arcsec = 5\nindex = "RKE"\n'
            "window_seconds = 9.0\n",
            "is about RKE 9 s",
        ),
        ('[[requirement]]\nname = "R-2"\naxis = "X"\nlimit_arcsec = 5\n', "'R-1' is unknown"),
    ],
)
def test_what_cannot_be_shared_out_is_refused(tmp_path: Path, requirement: str, words: str) -> None:
    row = ROW.format(name="own", kind="mixed", keys="sigma_arcsec = 3.0\nmean_arcsec = 1.0")
    with pytest.raises(BudgetError, match=words):
        allocation(made(written(tmp_path, row, requirement)), "R-1")
