"""One call in Python does what the command ``run`` does."""

from __future__ import annotations

import gc
from contextlib import nullcontext

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from starcal_uq.cli.schemas import document
from tests.helpers.commands import Commands, check_document
from tests.helpers.outside import campaign
from tests.helpers.scenes import observations

FEW = {"n_steps": 20, "n_draws": 50, "n_ensembles": 2}
TYPED = "--steps 20 --draws 50 --ensembles 2"


@pytest.fixture
def few(tmp_path):
    """A table in memory and in a file, with its camera."""
    stars = observations(n_frames=12)
    stars.save(tmp_path / "obs.ecsv")
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    return stars


@pytest.fixture
def cli(unpainted, monkeypatch, capsys, tmp_path):
    """Commands in one process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("starcal_uq.core.tasks.processes", lambda *_: nullcontext())
    return Commands(monkeypatch, capsys)


def test_the_command_writes_everything_and_the_call_has_its_numbers(few, cli):
    status, out, _ = cli(f"run obs.ecsv camera.toml -o run {TYPED} --seed 3")
    assert status in (0, 1)
    for heading in ("Calibration", "posterior ± 1 sigma", "Attitude error", "Report:"):
        assert heading in out
    typed = sc.Run("run")
    run = sc.runs.RunFolder(typed.path)
    stars = (run.observations, run.camera, run.calibration)
    for path in (*stars, run.posterior, run.coupling, run.attitude, run.report):
        assert path.stat().st_size > 0, path
    page = run.report.read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "")
    # The same verdict for programs.
    verdict = check_document(run.verdict.read_text("utf-8"), status)
    found = typed.verdict
    assert verdict == document("verdict", found, status) == found.to_dict()
    assert verdict["headline"] in " ".join(out.split())
    assert [check["name"] for check in verdict["checks"]] == [c.name for c in found.checks]
    assert all(
        check["remedy"] or check["advice"] or check["level"] == "pass"
        for check in verdict["checks"]
    )
    made = sc.run(few, sc.paper.paper_start(), seed=3, **FEW)
    assert np.array_equal(made.posterior.draws, typed.posterior.draws)
    assert np.array_equal(made.attitude.headline_arcsec, typed.attitude.headline_arcsec)
    assert made.error_budget.to_dataframe().equals(typed.error_budget.to_dataframe())
    assert made.calibration.effects.names == typed.calibration.effects.names
    assert made.verdict.headline == typed.verdict.headline
    # Draws of another seed differ.
    draws = sc.sample(made.observations, made.calibration, n_steps=20, n_ensembles=2, seed=4).draws
    assert not np.array_equal(draws, typed.posterior.draws)
    # A call without a folder is shown by its verdict, and its files are there as long as it is.
    for shown in (repr(made), made._repr_html_()):
        assert made.verdict.headline in shown and "Across the boresight" in shown
    assert repr(made).startswith(made.verdict.headline)
    place = made.path
    assert made.has("budget") and not made.has("report")
    del made
    gc.collect()
    assert not place.parent.exists()


START = {"start": {"focal_mm": 71.123456789}, "frames": [(0, 5), (7, 11)]}


@pytest.mark.slow
def test_a_run_in_a_folder_has_a_report_and_the_command_that_repeats_it(few, tmp_path, cli):
    files = (tmp_path / "obs.ecsv", tmp_path / "camera.toml")
    files[0].write_text(files[0].read_text("utf-8").replace("x_px", "column"), "utf-8")
    columns = {"x_px": "column"}
    run = sc.run(*files, out="run", effects=["tails"], columns=columns, seed=2, **START, **FEW)
    assert (
        run.has("report")
        and run.has("run_file")
        and run.place.words[:3] == ("run", *map(str, files))
    )
    draws = run.posterior.draws
    cli.ok(*run.place.words, "-o", "again", among=(0, 1))
    assert np.array_equal(draws, sc.Run("again").posterior.draws)
    with pytest.raises(sc.StarcalError):
        sc.run(*files, out="run", **FEW)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"n_stps": 20}, r"n_stps is unknown; did you mean n_steps\?"),
        ({"epoch": 2020.0}, "epoch belongs to images"),
        ({"n_steps": 0}, "n_steps is 0"),
        ({"temperature_profile": "p.csv", "effects": "tails"}, "needs effects='auto' or effects="),
        ({"effects": "tails", "method": "samaan"}, "exclude|needs"),
        ({"camera": None}, "needs the nominal camera"),
    ],
)
def test_settings_that_make_no_sense_are_refused_in_one_sentence(few, settings, words):
    given = {"camera": sc.paper.paper_start(), **settings}
    with pytest.raises(sc.StarcalError, match=words) as refused:
        sc.run(few, **given)
    assert "\n" not in str(refused.value)


def test_a_call_that_fails_names_a_call_and_that_call_works(monkeypatch):
    # What follows the calibration is not asked about.
    monkeypatch.setattr("starcal_uq.runs.whole.finish", lambda *_, **__: None)
    # The command line cannot name stars that are in memory alone.
    seen = campaign(np.random.default_rng(3), n_frames=20, stars_per_frame=15)
    stars, wrong = pd.DataFrame(seen.columns), slice(0, 300, 20)
    pixels = stars.loc[wrong, ["x_px", "y_px"]].to_numpy()
    stars.loc[wrong, ["x_px", "y_px"]] = pixels[::-1]
    camera = sc.Camera.from_dict(seen.camera_toml())
    with pytest.raises(sc.errors.CalibrationError) as failed:
        sc.run(stars, camera, **FEW, effects="none")
    assert "`sc.run(source, camera, ..., screening=True)`" in str(failed.value)
    screened = sc.run(stars, camera, **FEW, effects="none", screening=True)
    assert screened.calibration.status.name == "CONVERGED"
    with pytest.raises(sc.errors.CalibrationError) as failed:
        sc.calibrate(sc.Observations.from_dataframe(stars, camera=camera), camera)
    assert "`sc.calibration.screen(obs, camera)`" in str(failed.value)
