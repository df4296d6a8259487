"""A run: each result is loaded once, what is stale goes, and data of another calibration are
refused.
"""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.diagnostics.diagnose import Diagnosis
from starcal_uq.runs.steps.posterior import is_quick, sampling_of
from tests.helpers.commands import Commands
from tests.helpers.scenes import observations

READERS: tuple[tuple[type, str], ...] = (
    (sc.Calibration, "load"),
    (sc.Posterior, "load"),
    (sc.propagation.AttitudeError, "load"),
    (sc.propagation.FieldMap, "load"),
    (sc.budgeting.Budget, "load"),
    (Diagnosis, "load"),
)
# Modules that hold a function, and its name.
FUNCTIONS = (
    ("starcal_uq.runs.stored", "load_observations"),
    ("starcal_uq.diagnostics.verdict.judge", "judge"),
    ("starcal_uq.propagation.coupling", "coupling"),
)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each reader of a file, the judge and the couplings were called."""
    counts: Counter[str] = Counter()

    def counted(label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **options: Any) -> Any:
            counts[label] += 1
            return function(*given, **options)

        return call

    for owner, name in READERS:
        monkeypatch.setattr(owner, name, counted(owner.__name__, getattr(owner, name)))
    for module, name in FUNCTIONS:
        place = import_module(module)
        monkeypatch.setattr(place, name, counted(name, getattr(place, name)))
    return counts


def test_a_demo_reads_each_file_once_at_most_and_is_judged_once(
    calls: Counter[str],
    unpainted: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    out = tmp_path / "demo"
    commands = Commands(monkeypatch, capsys)
    # It ends with the table of truth and the report.
    found = commands.document("demo", "--frames", "60", "--out", str(out))
    assert found["calibration"]["parameters"][2]["truth"] == sc.paper.paper_camera().focal_px
    assert found["verdict"]["level"] != "fail" and Path(found["report"]).samefile(
        out / "report.html"
    )
    assert max(calls.values()) == 1
    # What a step gave is not read again, but for what a file keeps in part.
    assert set(calls) == {"AttitudeError", "Diagnosis", "judge", "coupling"}
    # The control: a new object reads what the report needs, each file once.
    calls.clear()
    sc.Run(tmp_path / "demo").report(force=True)
    assert set(calls.values()) == {1}
    assert {"Calibration", "Posterior", "load_observations", "Budget"} <= set(calls)


def test_steps_give_what_they_write_and_remove_what_is_stale(tmp_path: Path) -> None:
    run = sc.Run(tmp_path / "run")
    with pytest.raises(sc.errors.RunFolderError):
        _ = run.calibration
    obs = observations(n_frames=60)
    cal = run.calibrate(obs, sc.paper.paper_start())
    assert [part.remedy.action for part in run.missing] == ["sample", "propagate", "diagnose"]
    assert run.best is cal
    assert run.results.posterior is None
    posterior = run.sample(n_steps=50, seed=1)
    run.couple()
    run.propagate(n_draws=60, seed=1)
    assert [part.remedy.action for part in run.missing] == ["diagnose", "budget"]
    run.budget()
    assert [part.remedy.action for part in run.missing] == ["diagnose"]
    again = sc.Run(tmp_path / "run")
    assert np.array_equal(again.posterior.draws, posterior.draws)
    assert again.error_budget.to_dict() == run.error_budget.to_dict()
    assert again.observations.data_hash == run.observations.data_hash
    assert again.verdict.headline == run.verdict.headline
    run.calibrate(obs, sc.paper.paper_start(), force=True)
    assert [part.remedy.action for part in run.missing] == ["sample", "propagate", "diagnose"]
    assert run.best is run.calibration
    with pytest.raises(sc.errors.RunFolderError):
        _ = run.error_budget


def test_a_run_shows_what_its_folder_holds_now(tmp_path: Path) -> None:
    run = sc.Run(tmp_path / "run")
    assert repr(run) == f"Run({str(run.path)!r})"
    assert "the run folder does not exist" in run._repr_html_()
    # Another process adds to the folder while this object lives.
    sc.Run(run.path).calibrate(observations(), sc.paper.paper_start())
    assert "The posterior: not there yet (`starcal-uq sample " in repr(run)
    assert "Calibration" in run._repr_html_()
    sc.Run(run.path).sample(n_steps=20, seed=1)
    shown = repr(run)
    assert run.verdict.headline in shown
    assert "The posterior" not in shown
    assert len(shown.splitlines()) < 10
    assert "R-hat" in run._repr_html_()
    arviz = sc.Run(run.path).arviz(groups=["prior"], n_draws=8)
    assert arviz["prior"].sizes["draw"] == arviz["posterior"].sizes["draw"] * 4 == 8


@pytest.mark.parametrize("step", ["sample", "diagnose", "report"])
def test_data_of_another_calibration_are_refused_with_one_sentence(
    step: str, tmp_path: Path
) -> None:
    sc.Run(tmp_path).calibrate(observations(), sc.paper.paper_start())
    observations(seed=4).save(tmp_path / "observations.parquet", force=True)
    with pytest.raises(sc.errors.RunFolderError, match="not the file that this run"):
        getattr(sc.Run(tmp_path), step)()
    # A folder of a version without records.
    (tmp_path / "run.json").unlink()
    with pytest.raises(sc.errors.RunFolderError, match="made from other observations"):
        getattr(sc.Run(tmp_path), step)()


def test_another_process_may_sample_where_that_is_quick(tmp_path: Path) -> None:
    run = sc.Run(tmp_path / "run")
    run.calibrate(observations(), sc.paper.paper_start())
    assert is_quick(run, {"n_steps": 200, "priors": None})
    # Whoever asks for more wants to see how far it is.
    assert not is_quick(run, {"n_steps": 400})
    few = {"n_ensembles": 2, "n_steps": 20, "seed": 1}
    call = pickle.loads(pickle.dumps(sampling_of(run, **few)))
    assert np.array_equal(run.sample(apart=call, **few).draws, call().draws)
    # The control: without an answer the draws are made here, of the seed that is given.
    here = run.sample(apart=lambda: None, force=True, **{**few, "seed": 2})
    assert not np.array_equal(here.draws, call().draws)
