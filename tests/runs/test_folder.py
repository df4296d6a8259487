"""Run folder: names, atomic writes, provenance."""

from __future__ import annotations

import json
import os
import stat
import sys
from pathlib import Path

import pytest

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path, atomic_write_bytes, atomic_write_text, ensure_new
from starcal_uq.core.provenance import provenance
from starcal_uq.runs.folder import RunFolder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_atomic_writes(tmp_path):
    atomic_write_text(tmp_path / "a.txt", "é\n\r\n")
    atomic_write_bytes(tmp_path / "b.bin", b"\x00\xff")
    assert (tmp_path / "a.txt").read_bytes() == "é\n\r\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\x00\xff"
    atomic_write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "new"
    assert names(tmp_path) == ["a.txt", "b.bin"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failure_half_way_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old", encoding="utf-8")
    with pytest.raises(error), atomic_path(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".txt")
        temporary.write_text("half", encoding="utf-8")
        raise error
    assert path.read_text(encoding="utf-8") == "old"
    assert names(tmp_path) == ["a.txt"]


def test_full_disk_is_reported_with_the_file(tmp_path):
    message = r"a\.txt: cannot be written \(No space left on device\)"
    with pytest.raises(RunFolderError, match=message), atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("half", encoding="utf-8")
        raise OSError(28, "No space left on device")
    assert names(tmp_path) == []


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_text("", encoding="utf-8")
    atomic_write_text(tmp_path / "ours", "")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "ours")]
    assert modes[0] == modes[1]


def test_link_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "real" / "a.txt")
    atomic_write_text(link, "text")
    assert link.is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text(encoding="utf-8") == "text"


def test_where_nothing_can_be_written(tmp_path):
    with pytest.raises(RunFolderError, match=r"the folder .* does not exist; create it first"):
        atomic_write_text(tmp_path / "no" / "a.txt", "")
    with pytest.raises(RunFolderError, match="is a directory"):
        atomic_write_text(tmp_path, "")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RunFolderError, match="not a regular file"):
        atomic_write_text(tmp_path / "pipe", "")
    assert names(tmp_path) == ["pipe"]


def test_ensure_new(tmp_path):
    path = tmp_path / "a.txt"
    ensure_new(path)
    path.write_text("old", encoding="utf-8")
    with pytest.raises(RunFolderError, match=r"a\.txt: the file exists already; .*--force"):
        ensure_new(path)
    ensure_new(path, force=True)
    with pytest.raises(RunFolderError, match="is a directory"):
        ensure_new(tmp_path, force=True)


def test_provenance_is_plain_and_imports_nothing_heavy():
    before = set(sys.modules)
    record = provenance(7, {"n_steps": 200, "sigma": "sampled"}, "ab" * 32)
    assert not {"casadi", "emcee", "arviz", "scipy"} & (set(sys.modules) - before)
    assert json.loads(json.dumps(record)) == record
    assert set(record) == {"created_utc", "seed", "settings", "data_sha256", "versions"}
    assert set(record["versions"]) == {
        "python",
        "starcal_uq",
        "numpy",
        "scipy",
        "casadi",
        "emcee",
        "arviz",
    }
    assert record["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert record["versions"]["numpy"]
    assert record["created_utc"].endswith("Z")


def test_run_folder_names(tmp_path):
    run = RunFolder(str(tmp_path / "run"))
    assert run == RunFolder(tmp_path / "run")
    shown = {
        "observations": "observations.parquet",
        "camera": "camera.toml",
        "calibration": "calibration.json",
        "arrays": "calibration.npz",
        "posterior": "posterior.nc",
        "coupling": "coupling.csv",
        "attitude": "attitude.csv",
        "field_map": "field_map.npz",
        "budget": "budget.csv",
        "figures": "figures",
        "report": "report.html",
    }
    for attribute, name in shown.items():
        assert getattr(run, attribute) == tmp_path / "run" / name


def test_require_names_the_command(tmp_path):
    run = RunFolder(tmp_path / "run")
    with pytest.raises(
        RunFolderError, match="does not exist; check the path, or run `starcal-uq calibrate"
    ):
        run.require("calibration")
    assert run.create() is run
    run.create()
    with pytest.raises(
        RunFolderError, match=r"has no posterior\.nc; run `starcal-uq sample RUN` first\."
    ):
        run.require("posterior")
    run.posterior.write_bytes(b"")
    assert run.require("posterior") == run.posterior
    with pytest.raises(ValueError, match="no 'posteriors'"):
        run.require("posteriors")


def test_a_budget_makes_what_rests_on_it_older_and_takes_nothing_away(tmp_path):
    run = RunFolder(tmp_path / "run")

    def do(step, name):
        with run.step(step, {}) as files:
            atomic_write_text(files.path / name, step)

    for step, name in (
        ("propagate", "attitude.csv"),
        ("budget", "budget.csv"),
        ("report", "report.html"),
    ):
        do(step, name)
    do("notebook", "report.ipynb")
    assert not any(map(run.is_older, run.manifest.steps))
    do("budget", "budget.csv")
    assert [step for step in run.manifest.steps if run.is_older(step)] == ["report", "notebook"]
    assert run.report.exists() and run.notebook.exists() and run.resting_on("budget") == []
    do("report", "report.html")
    assert [step for step in run.manifest.steps if run.is_older(step)] == ["notebook"]
    # Control: another step takes away what rests on its result.
    do("propagate", "attitude.csv")
    assert (
        list(run.manifest.steps) == ["propagate"]
        and not run.report.exists()
        and not run.budget.exists()
    )


def test_a_file_is_no_run_folder(tmp_path):
    path = tmp_path / "run"
    path.write_text("", encoding="utf-8")
    with pytest.raises(RunFolderError):
        RunFolder(path).require("calibration")
    with pytest.raises(RunFolderError):
        RunFolder(path).create()


def test_the_page_on_files_names_each_of_a_run():
    from starcal_uq.runs.folder import _OTHERS, RunFolder

    run = RunFolder("run")
    paths = [
        path
        for name in dir(RunFolder)
        if isinstance(path := getattr(run, name, None), Path) and path.parent == run.path
    ]
    told = (Path(__file__).parents[2] / "docs" / "reference" / "files.md").read_text("utf-8")
    assert len(paths) > 15
    names = {path.name for path in paths} | set(_OTHERS)
    assert {name for name in names if f"`{name.rstrip('/')}" not in told} == set()
