"""Runs from a run file, and the one that every run writes."""

from __future__ import annotations

import starcal_uq as sc
from tests.helpers.remedy_chains import options_of

FILE = """
[run]
inputs = "obs.csv"
camera = "camera.toml"
out = "first"
directions = "apparent"
effects = "none"
seed = 5
draws = 50
alignment_frames = 20
ensembles = 2
walkers = 14
steps = 20
"""


def test_a_run_writes_the_file_that_repeats_it_and_changes_of_it_are_made_by_set(
    cli, inputs, tmp_path
):
    (inputs / "first.toml").write_text(FILE, encoding="utf-8")
    given = "--directions apparent --effects none --seed 5 --draws 50 --alignment-frames 20"
    given += " --ensembles 2 --walkers 14 --steps 20 -o first"
    words = f"run {inputs}/obs.csv {inputs}/camera.toml {given}"
    assert options_of(["run", str(inputs / "first.toml")]) == options_of(words.split())
    cli.ok("run inputs/first.toml", among=(0, 1))
    first = sc.Run(inputs / "first")

    # The file of a run repeats it in its place, which takes --force, or elsewhere.
    file = inputs / "first" / "run.toml"
    assert options_of(["run", str(file)]) == options_of(words.split())
    cli.refuses("--force", "run", file)
    out, err = cli.ok("run", file, "--set", "seed=6", "-o", "second", "-q", "-v", among=(0, 1))
    assert out == "" and "calibrate: done" in err and "report: done" in err
    assert "note:" not in err
    second = sc.Run(tmp_path / "second")
    assert not first.posterior.to_dataframe().equals(second.posterior.to_dataframe())
    assert second.folder.manifest.words[-2:] == ("--seed", "6")
    # What it prints to try edits the file.
    for order in second.verdict.to_try:
        for step in order.steps:
            assert step.files == (str(second.path.resolve() / "run.toml"),) or step.action != "run"


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
        cli.refuses(said, "run", file)
    file.write_text(head, encoding="utf-8")
    assert cli.refuses("", "run", file, "--draws", "7").startswith("error: --draws '7'")
    cli.refuses(
        "--set 'a=b' changes a key of a run file: give the file first",
        "run inputs/obs.csv inputs/camera.toml --set a=b -o r",
    )


def test_help_shows_what_matters_and_all_of_it_where_asked(cli):
    short, whole = cli("run --help")[1], cli("run --help-all")[1]
    assert "--effects" in short and "--help-all" in short and "--walkers" not in short
    assert "--walkers" in whole and "--set" in whole
    assert len(short.splitlines()) < 0.4 * len(whole.splitlines())
    # The second one leaves no trace in the process.
    assert cli("run --help")[1] == short
