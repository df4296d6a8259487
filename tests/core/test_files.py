"""Cells of tables that may be opened as spreadsheets."""

from __future__ import annotations

import csv
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import starcal_uq as sc
from starcal_uq.core.files import cell_content, cell_text, write_csv
from tests.helpers.mutants import _observations

FORMULAS = ("=1+1", "=cmd|' /C calc'!A0", "+1+1", "-1+1", "@SUM(A1)", "\t=1", "\n=1", "'=1")


@given(st.text(alphabet="='+-@\t\n 1.e5a", max_size=6))
@example("'=")
def test_every_text_is_found_again_and_none_begins_a_formula(text: str) -> None:
    cell = cell_text(text)
    assert cell_content(cell) == text
    if cell[:1] in tuple("=+-@\t\n") and len(cell) > 1:
        float(cell)


def test_numbers_stay_numbers() -> None:
    for number in ("-1", "+2.5e-3", "-inf", "-", "-0.0", "1"):
        assert cell_text(number) == number
    assert cell_text("a\rb\r\nc") == "a\nb\nc"


def test_no_table_that_is_written_begins_a_formula(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    write_csv(pd.DataFrame({"name": FORMULAS, "value": -1.5}), path)
    with path.open(newline="") as file:
        cells = [row[0] for row in csv.reader(file)][1:]
    assert all(cell[0] == "'" for cell in cells) and tuple(map(cell_content, cells)) == FORMULAS
    assert list(pd.read_csv(path)["value"]) == [-1.5] * len(FORMULAS)


@pytest.mark.parametrize("ending", ["csv", "ecsv", "parquet"])
def test_names_of_stars_come_back(tmp_path: Path, ending: str) -> None:
    obs = _observations()
    names = [f"{FORMULAS[i % 5]}{i}" if i % 2 else f"-{i}" for i in range(obs.n_stars)]
    odd = sc.Observations(**{**obs.columns, "star_id": names})
    odd.save(tmp_path / f"o.{ending}")
    again = sc.load_observations(tmp_path / f"o.{ending}")
    assert list(again.star_id) == list(odd.star_id)
    text = (tmp_path / f"o.{ending}").read_bytes()
    assert ending != "csv" or (b",=" not in text and b",@" not in text and b",-1+1" not in text)
