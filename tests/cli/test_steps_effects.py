"""Effects beyond the camera on the command line: asked for, shown, stored, and refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.settings import EffectName
from starcal_uq.presentation.words.sentences import templates
from tests.helpers.effects import breathing, moving, sheet, table
from tests.helpers.outside import campaign


@pytest.fixture
def breathed(tmp_path):
    """A table whose frames have a scale and shears of their own, and its camera."""
    rng = np.random.default_rng(3)
    c = campaign(rng, n_frames=10, displaced=breathing(rng, 10, 0.3))
    obs = table(c)
    obs.select(np.abs(obs.xy - 511.5).max(axis=1) < 511.0).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    return "obs.csv camera.toml"


def test_the_terminal_shows_what_was_taken_up_and_what_was_not(cli, breathed) -> None:
    out, _ = cli.ok(f"calibrate {breathed} -o run --effects auto --in-space")
    effects = sc.Run("run").calibration.effects
    assert effects.names == ("frame",)
    row = next(line for line in out.splitlines() if line.startswith("│ frame "))
    assert f"{effects.fitted[0].gain_nat:.1f}" in row
    assert "Effects that the data support: frame. Not taken up (an effect has to gain" in out
    # The same words stand wherever a calibration or its effects are shown.
    shown = sc.Run("run").calibration
    assert effects.text in shown.text
    assert "moved most" in shown._repr_html_() and "moved most" in effects._repr_html_()
    frame = effects.to_dataframe()
    assert list(frame["name"][frame["taken"]]) == ["frame"]
    assert len(frame) == 1 + len(effects.refused)
    stored = json.loads(Path("run/run.json").read_text("utf-8"))
    assert stored["steps"]["calibrate"]["settings"]["effects"] == ["frame"]


def test_a_document_holds_the_effects(cli, breathed) -> None:
    found = cli.document(f"calibrate {breathed} --effects frame -o a")["calibration"]["effects"]
    assert [each["name"] for each in found["fitted"]] == ["frame"]
    assert not found["selected"] and found["refused"] == []
    found = cli.document(f"calibrate {breathed} --effects none -o b")["calibration"]["effects"]
    assert found is None


def test_nothing_taken_up_is_one_sentence(cli, tmp_path) -> None:
    c = campaign(np.random.default_rng(12), n_frames=10)
    table(c).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    out, _ = cli.ok("calibrate obs.csv camera.toml -o run --effects auto")
    assert "The data support no effect beyond the camera. Not taken up (an effect has" in out
    assert "moved most" not in out


def test_a_wrong_name_is_one_sentence(cli, breathed) -> None:
    for given, sentence in (
        ("fild", "effect 'fild' is unknown: use none alone, or some of auto, axes, field,"),
        ("none,field", "effect 'none' is unknown: use none alone, or some of auto, axes"),
        ("temperature", "the effect 'temperature' needs what does not vary in this table"),
    ):
        cli.refuses(sentence, f"calibrate {breathed} -o run --effects {given}")


def test_every_effect_has_a_meaning_in_words() -> None:
    told = {name.partition(".")[2] for name in templates() if name.startswith("Effect.")}
    assert told == set(get_args(EffectName))


@pytest.mark.slow
def test_the_remedy_that_a_misfit_prints_first_leads_to_a_usable_answer(cli, tmp_path) -> None:
    rng = np.random.default_rng(3)
    c = campaign(rng, n_frames=30, displaced=breathing(rng, 30, 0.5))
    obs = table(c)
    obs.select(np.abs(obs.xy - 511.5).max(axis=1) < 511.0).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    small = "--ensembles 2 --walkers 16 --steps 100 --draws 50"
    cli.ok(f"run obs.csv camera.toml -o run --in-space {small} --effects none", among=(1,))
    run = sc.Run("run")
    assert run.diagnosis.effects == ("frame",)
    verdict = json.loads(Path("run/verdict.json").read_text("utf-8"))
    structure = next(c for c in verdict["checks"] if c["name"] == "Unexplained structure")
    assert "would take up the effect frame." in structure["sentence"]
    command = verdict["commands"][0]
    assert "--set effects=auto" in command
    status, _, err = cli(*command.split()[1:])
    verdict = json.loads(Path("run/verdict.json").read_text("utf-8"))
    assert status == 0 and verdict["level"] != "fail", (err, verdict["headline"])
    assert "with this effect: frame" in verdict["headline"]
    report = Path("run/report.html").read_text("utf-8")
    section = report.partition('id="effects"')[2].partition('id="misfit"')[0]
    assert "Every frame has a scale and two shears" in section and "not taken up" in section
    assert command not in verdict["commands"]


@pytest.fixture(scope="module")
def calibrated_warm(tmp_path_factory):
    """A run whose calibration follows the temperature, and a profile of an orbit beside it."""
    folder = tmp_path_factory.mktemp("warm")
    rng = np.random.default_rng(8)
    warmth = rng.uniform(-1.0, 1.0, 12)
    c = campaign(rng, n_frames=12, displaced=moving(0.5, warmth))
    obs = table(c, temperature_c=-25.0 + 15.0 * warmth[c.columns["frame"]])
    obs.save(folder / "obs.csv")
    sheet(c).save(folder / "camera.toml")
    run = sc.Run(folder / "run")
    run.calibrate(obs, sheet(c), effects="temperature")
    run.sample(seed=0, n_ensembles=2, n_walkers=16, n_steps=20)
    (folder / "orbit.csv").write_text("time_s,temperature_c\n0,-40\n60,-10\n90,5\n", "utf-8")
    return folder


@pytest.fixture
def warmed(calibrated_warm, tmp_path):
    shutil.copytree(calibrated_warm, tmp_path, dirs_exist_ok=True)


def test_a_temperature_profile_goes_from_the_command_line_into_the_budget(cli, warmed) -> None:
    words = "propagate run --draws 50"
    attitude = cli.document(f"{words} --temperature-profile orbit.csv")["attitude"]
    assert attitude["onboard"] == "model"
    parts = {row["part"] for row in attitude["aboard"]}
    assert {"rest", "temperature, rest", "camera parameters, rest"} <= parts
    assert [row["temperature_c"] for row in attitude["thermal"]][::4] == [-40.0, -10.0, 5.0]
    # The budget of the run takes it from the folder.
    stored = sc.Run("run")
    assert stored.attitude.thermal.profile.name == "orbit.csv"
    made = stored.budget()
    row = next(each for each in made.rows if each.name == "thermo-elastic of the optics")
    assert row.sigma_arcsec == stored.attitude.thermal.model.rest_covariance_arcsec2[0, 0] ** 0.5
    assert "temperatures of orbit.csv, " in row.conditions
    assert "of the time outside of those of the calibration" in row.conditions
    # Another profile may be given to the budget alone.
    Path("mild.csv").write_text("time_s,temperature_c\n0,-26\n60,-24\n", "utf-8")
    document = cli.document("budget run --temperature-profile mild.csv --force")
    rows = document["budget"]["contributors"]
    mild = next(each for each in rows if each["name"] == row.name)
    assert mild["sigma_arcsec"] < 0.2 * row.sigma_arcsec
    # Without a profile the folder holds none, and the row is that of the calibration's range.
    cli.ok(f"{words} --force")
    assert not Path("run/thermal.csv").exists()
    plain = next(each for each in sc.Run("run").budget().rows if each.name == row.name)
    assert "orbit.csv" not in plain.conditions


def test_a_profile_that_cannot_act_is_one_sentence(cli, warmed) -> None:
    Path("bad.csv").write_text("time_s,temperature_c\n0,1\n1,warm\n", "utf-8")
    plain = sc.Run("plain")
    plain.calibrate(sc.load_observations("obs.csv"), sc.Camera.load("camera.toml"))
    plain.sample(seed=0, n_ensembles=2, n_walkers=16, n_steps=20)
    plain.propagate(n_draws=20)
    for words, sentence in (
        (
            "propagate run --temperature-profile bad.csv --force",
            "bad.csv, line 3: temperature_c is",
        ),
        (
            "run obs.csv camera.toml -o other --effects field --temperature-profile orbit.csv",
            "--temperature-profile orbit.csv needs --effects auto or --effects temperature: give both",
        ),
        ("budget plain --temperature-profile orbit.csv", "holds no effect 'temperature', so that"),
    ):
        cli.refuses(sentence, words)
