"""Runs from a run file, and the one that every run writes."""

from __future__ import annotations

import starcal_uq as sc
from tests.helpers.remedy_chains import SMALL


def test_a_run_writes_the_file_that_repeats_it_and_changes_of_it_are_made_by_set(
    cli, inputs, tmp_path
):
    given = ("obs.csv", "camera.toml", "--directions", "apparent", "--effects", "none", *SMALL)
    (tmp_path / "inputs" / "first.toml").write_text(
        '[run]\ninputs = "obs.csv"\ncamera = "camera.toml"\nout = "first"\n'
        'directions = "apparent"\neffects = "none"\ndraws = 50\nalignment_frames = 20\nseed = 5\n',
        encoding="utf-8",
    )
    status, out, err = cli("run", inputs / "first.toml")
    assert status in (0, 1), err
    first = sc.Run(inputs / "first")
    words = [str(inputs / name) if (inputs / name).exists() else name for name in given]
    status, _, err = cli("run", *words, "--seed", "5", "-o", "second", "-q")
    assert status in (0, 1) and "note:" not in err
    second = sc.Run(tmp_path / "second")
    assert first.posterior.to_dataframe().equals(second.posterior.to_dataframe())

    # The file of a run repeats it in its place, which takes --force, or elsewhere.
    file = tmp_path / "second" / "run.toml"
    status, _, err = cli("run", file)
    assert status == 2 and "--force" in err
    status, out, err = cli("run", file, "--set", "seed=6", "-o", "third", "-q", "-v")
    assert status in (0, 1) and out == "" and "calibrate: done" in err and "report: done" in err
    third = sc.Run(tmp_path / "third")
    assert not first.posterior.to_dataframe().equals(third.posterior.to_dataframe())
    assert third.folder.manifest.words[-2:] == ("--seed", "6")
    # What it prints to try edits the file.
    for order in third.verdict.to_try:
        for step in order.steps:
            assert step.files == (str(third.path.resolve() / "run.toml"),) or step.action != "run"


def test_errors_of_a_run_file_name_the_file(cli, inputs):
    file = inputs / "run.toml"
    head = '[run]\ninputs = "obs.csv"\ncamera = "camera.toml"\nout = "r"\n'
    for line, said in (
        ("draws = 7", f"{file}: --draws '7': give a whole number"),
        ('site = "no.toml"', f"{file}: --site '"),
        ('model = "brwn"', f"{file}: --model 'brwn' is unknown"),
        ("sed = 1", f"{file}: key sed is unknown; did you mean seed?"),
    ):
        file.write_text(head + line + "\n", encoding="utf-8")
        status, _, err = cli("run", file)
        assert status == 2 and said in err, (line, err)
    file.write_text(head, encoding="utf-8")
    status, _, err = cli("run", file, "--draws", "7")
    assert status == 2 and err.startswith("error: --draws '7'"), err
    status, _, err = cli(
        "run", inputs / "obs.csv", inputs / "camera.toml", "--set", "a=b", "-o", "r"
    )
    assert status == 2 and "--set 'a=b' changes a key of a run file: give the file first" in err


def test_help_shows_what_matters_and_all_of_it_where_asked(cli):
    short, whole = cli("run", "--help")[1], cli("run", "--help-all")[1]
    assert "--effects" in short and "--help-all" in short and "--walkers" not in short
    assert "--walkers" in whole and "--set" in whole
    assert len(short.splitlines()) < 0.4 * len(whole.splitlines())
    # The second one leaves no trace in the process.
    assert cli("run", "--help")[1] == short
