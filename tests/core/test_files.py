"""Cells of tables that may be opened as spreadsheets, and files that are written together."""

import csv
import errno
import os
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import (
    atomic_write_bytes,
    cell_content,
    cell_text,
    default_cache_dir,
    write_csv,
)
from starcal_uq.runs.folder import RunFolder
from tests.damage.samples import observations

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
    obs = observations()
    names = [f"{FORMULAS[i % 5]}{i}" if i % 2 else f"-{i}" for i in range(obs.n_stars)]
    odd = sc.Observations(**{**obs.columns, "star_id": names})
    odd.save(tmp_path / f"o.{ending}")
    again = sc.load_observations(tmp_path / f"o.{ending}")
    assert list(again.star_id) == list(odd.star_id)
    text = (tmp_path / f"o.{ending}").read_bytes()
    assert ending != "csv" or (b",=" not in text and b",@" not in text and b",-1+1" not in text)


def test_files_of_a_step_are_on_the_disk_before_they_count(tmp_path, monkeypatch):
    done: list[str] = []
    flush, rename = os.fsync, os.replace

    def flushed(handle: int) -> None:
        done.append(f"flush {os.fstat(handle).st_ino}")
        flush(handle)

    def renamed(source: os.PathLike[str], target: os.PathLike[str]) -> None:
        done.append(f"name {Path(target).name}")
        rename(source, target)

    monkeypatch.setattr(os, "fsync", flushed)
    monkeypatch.setattr(os, "replace", renamed)
    run = RunFolder(tmp_path)
    with run.step("calibrate", {}) as stage:
        for name in ("a", "b"):
            atomic_write_bytes(stage.path / name, b"content")
        files = [f"flush {(stage.path / name).stat().st_ino}" for name in ("a", "b")]
    counts = done.index("name run.json")
    assert set(files) <= set(done[:counts])
    assert done[counts - 1].startswith("flush") and done[counts - 1] not in files


def test_a_disk_that_refuses_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunFolderError, match="second: cannot be written"):
        atomic_write_bytes(tmp_path / "second", b"content")


def test_cache_folder_of_the_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "starcal_uq"
