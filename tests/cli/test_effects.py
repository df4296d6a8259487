"""Effects beyond the camera on the command line: asked for, shown, stored, and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.settings import EffectName
from starcal_uq.presentation.words.effects import MEANINGS
from tests.helpers.effects import breathing, sheet, table
from tests.helpers.outside import campaign


@pytest.fixture
def breathed(tmp_path):
    """A table whose frames have a scale and shears of their own, and its camera."""
    rng = np.random.default_rng(3)
    c = campaign(rng, n_frames=10, displaced=breathing(rng, 10, 0.3))
    obs = table(c)
    obs.select(np.abs(obs.xy - 511.5).max(axis=1) < 511.0).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    return "obs.csv", "camera.toml"


def test_the_terminal_shows_what_was_taken_up_and_what_was_not(cli, breathed) -> None:
    status, out, err = cli("calibrate", *breathed, "-o", "run", "--effects", "auto", "--in-space")
    assert status == 0, err
    effects = sc.Run("run").calibration.effects
    assert effects.names == ("frame",)
    row = next(line for line in out.splitlines() if line.startswith("│ frame "))
    assert f"{effects.fitted[0].gain_nat:.1f}" in row
    assert "Effects that the data ask for: frame. Not taken up (an effect has to gain" in out
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
    words = ("calibrate", *breathed, "--json", "--effects")
    _, out, _ = cli(*words, "frame", "-o", "a")
    found = json.loads(out)["calibration"]["effects"]
    assert [each["name"] for each in found["fitted"]] == ["frame"]
    assert not found["selected"] and found["refused"] == []
    _, out, _ = cli(*words, "none", "-o", "b")
    assert json.loads(out)["calibration"]["effects"] is None


def test_nothing_taken_up_is_one_sentence(cli, tmp_path) -> None:
    c = campaign(np.random.default_rng(12), n_frames=10)
    table(c).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    _, out, _ = cli("calibrate", "obs.csv", "camera.toml", "-o", "run", "--effects", "auto")
    assert "The data ask for no effect beyond the camera. Not taken up (an effect has" in out
    assert "moved most" not in out


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ("fild", "effect 'fild' is unknown: use auto or none alone, or some of axes, field,"),
        ("auto,field", "effect 'auto' is unknown: use auto or none alone"),
        ("temperature", "the effect 'temperature' needs what does not vary in this table"),
    ],
)
def test_a_wrong_name_is_one_sentence(cli, breathed, given, sentence) -> None:
    status, _, err = cli("calibrate", *breathed, "-o", "run", "--effects", given)
    assert status == 2
    assert sentence in err.splitlines()[-1]


def test_every_effect_has_a_meaning_in_words() -> None:
    assert set(MEANINGS) == set(get_args(EffectName))


def test_the_remedy_that_a_misfit_prints_first_leads_to_a_usable_answer(cli, tmp_path) -> None:
    rng = np.random.default_rng(3)
    c = campaign(rng, n_frames=30, displaced=breathing(rng, 30, 0.5))
    obs = table(c)
    obs.select(np.abs(obs.xy - 511.5).max(axis=1) < 511.0).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    small = ("--ensembles", "2", "--walkers", "16", "--steps", "100", "--draws", "50")
    words = ("run", "obs.csv", "camera.toml", "-o", "run", "--in-space", *small)
    status, _, _ = cli(*words, "--effects", "none")
    run = sc.Run("run")
    assert status == 1 and run.diagnosis.effects == ("frame",)
    verdict = json.loads(Path("run/verdict.json").read_text("utf-8"))
    structure = next(c for c in verdict["checks"] if c["name"] == "Unexplained structure")
    assert "would take up the effect frame." in structure["sentence"]
    command = verdict["commands"][0]
    assert "--effects auto" in command
    status, _, err = cli(*command.split()[1:])
    verdict = json.loads(Path("run/verdict.json").read_text("utf-8"))
    assert status == 0 and verdict["level"] != "fail", (err, verdict["headline"])
    assert "with this effect: frame" in verdict["headline"]
    report = Path("run/report.html").read_text("utf-8")
    section = report.partition('id="effects"')[2].partition('id="misfit"')[0]
    assert "Every frame has a scale and two shears" in section and "not taken up" in section
    assert command not in verdict["commands"]
