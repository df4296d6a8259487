"""The command line as a user meets it: whole runs, JSON, help, and one sentence for every
mistake.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.cli import HELP
from starcal_uq.cli.commands import app
from starcal_uq.core.runfile import expanded
from starcal_uq.core.settings import Starter
from starcal_uq.studies.definition import StudyDefinition
from tests.helpers.commands import SMALL, files
from tests.helpers.outside import campaign


def test_simulate_writes_a_table_that_calibrates(cli, inputs, tmp_path):
    words = "simulate inputs/camera.toml -o obs.parquet --frames 30"
    out, _ = cli.ok(f"{words} --seed 5")
    assert "30 frames" in out
    first = (tmp_path / "obs.parquet").read_bytes()
    cli.refuses("--force", words)
    assert (tmp_path / "obs.parquet").read_bytes() == first
    out, err = cli.ok("calibrate obs.parquet inputs/camera.toml -o run")
    assert "truth" in out
    assert "warning" not in err


def test_help_of_the_program_is_that_of_its_commands_which_it_does_not_load(cli):
    text = cli("--help")[1]
    assert text == HELP.read_text("utf-8") and max(map(len, text.splitlines())) <= 80
    rows = re.findall(r"^  (\S+) +(\S.*(?:\n {3,}.*)*)", text, re.MULTILINE)
    listed = {name: " ".join(words.split()) for name, words in rows}
    options = [option for one in app.params for option in one.opts]
    assert list(listed) == [*options, "--help", *app.commands]
    for name, command in app.commands.items():
        said = inspect.getdoc(inspect.unwrap(command.callback)).partition("\n\n")[0]
        assert listed[name] == " ".join(said.split()), name


def test_help_teaches(cli):
    for command in ((), *((name,) for name in app.commands)):
        status, out, _ = cli(*command, "--help")
        assert status == 0 and "Usage" in out and len(out.splitlines()) > 8, command


def test_options_stand_under_what_they_are_for_and_a_missing_file_under_the_command_that_writes_it(
    cli, inputs
):
    out = cli("run --help-all")[1]
    panels = (
        "Options",
        "How a camera is estimated",
        "What belongs to images alone",
        "How a posterior is sampled",
    )
    places = [out.index(f"\n{words}:") for words in panels]
    assert (
        places == sorted(places)
        and places[1] < out.index("--effects") < places[2] < out.index("--gain") < places[3]
    )
    cli.refuses(
        "site/camera.toml': does not exist; check the path, or starcal-uq new camera",
        "calibrate inputs/obs.csv site/camera.toml -o run",
    )
    assert "starcal-uq new" not in cli("calibrate inputs/obs.csv mine.toml -o run")[2]
    words = "calibrate inputs/obs.csv inputs/camera.toml -o run --only-frames a"
    cli.refuses("is no list of frame numbers", words)


def _cell(path, number, column, text):
    table = [line.split(",") for line in path.read_text().splitlines()]
    table[number - 1][table[0].index(column)] = text
    path.write_text("\n".join(map(",".join, table)) + "\n")


def _cells(number, column, text):
    return lambda folder: _cell(folder / "obs.csv", number, column, text)


def _directory(folder):
    (folder / "obs.csv").unlink()
    (folder / "obs.csv").mkdir()


# One of each kind: what else may be wrong with a table or a camera stands with their loaders.
MISTAKES = {
    "NaN": (_cells(9, "dec_deg", "nan"), ["obs.csv", "line 9", "dec_deg"]),
    "broken TOML": (lambda folder: (folder / "camera.toml").write_text("[camera"), ["camera.toml"]),
    "a directory": (_directory, ["obs.csv", "director"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("command", ["calibrate", "run"])
def test_every_mistake_is_one_sentence_and_touches_nothing(cli, inputs, tmp_path, mistake, command):
    spoil, words = MISTAKES[mistake]
    spoil(inputs)
    before = files(tmp_path)
    err = cli.refuses("", f"{command} inputs/obs.csv inputs/camera.toml -o run")
    assert len(err.splitlines()) == 1 and all(word in err for word in words), err
    assert files(tmp_path) == before


def test_output_that_exists_is_kept(cli, inputs, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep me")
    before = files(tmp_path)
    cli.refuses("--force", "run inputs/obs.csv inputs/camera.toml -o run")
    assert files(tmp_path) == before
    _, err = cli.ok("calibrate inputs/obs.csv inputs/camera.toml -o run --force")
    assert "Neither time nor observer velocity was declared" in err
    assert (tmp_path / "run" / "mine.txt").read_text() == "keep me"


def test_wrong_options_are_named(cli, inputs, tmp_path):
    before = files(tmp_path)
    for option, said in (
        ("--directions catalogue", "time_utc"),
        ("--observer-velocity 1,2", "three numbers"),
        ("--column ra_deg", "NAME=IN_FILE"),
        ("--column ra_deg=nothing", "nothing"),
    ):
        cli.refuses(said, f"calibrate inputs/obs.csv inputs/camera.toml -o run {option}")
    assert files(tmp_path) == before


WRONG_FILES = {
    "calibrate camera.toml obs.csv": "obs.csv: is no TOML, as a camera file is; check the order of the arguments.",
    "calibrate obs.csv site.toml": "site.toml: section [camera] is missing, and [site] is there; give another file, or",
    "calibrate made camera.toml": "made: is the folder of a run; name its table, made/observations.parquet.",
    "run camera.toml obs.csv": "camera.toml is a camera: give it last.",
    "run obs.csv": "a table of stars needs the nominal camera (TOML) after it; only images do without.",
    "run bad.png camera.toml": "no image can be used: Frame 0 was left out: bad.png: the file is not an image",
    "run obs.csv camera.toml --priors site.toml": "site.toml: section [priors] is missing, and [site] is there; give",
}


def test_files_of_another_kind_are_named_before_any_work(cli, inputs, tmp_path, monkeypatch):
    monkeypatch.chdir(inputs)
    sc.sky.Site(52.0, 4.4, 10.0).save("site.toml")
    (inputs / "bad.png").write_bytes(b"no image")
    cli.ok("calibrate obs.csv camera.toml -o made --in-space")
    for call, words in WRONG_FILES.items():
        err = cli.refuses("", f"{call} -o run")
        assert len(err.splitlines()) == 1 and err.startswith(f"error: {words}"), err
    assert not (inputs / "run").exists()


def test_folder_of_partitions_from_simulation_to_posterior(cli, inputs):
    made = "simulate inputs/camera.toml -o frames --frames 50 --min-stars 5 --max-mag 7"
    out, _ = cli.ok(f"{made} --partition-frames 20 --workers 0")
    assert out.split(" stars ")[1] == "in 50 frames, 3 files: frames\n"
    out, _ = cli.ok("calibrate frames inputs/camera.toml -o run --workers 0")
    assert "in 50 frames" in out
    cli.ok("sample", "run", *SMALL, among=(0, 1))
    for said, words in (
        ("give --partition-frames", f"{made} --workers 2 --force"),
        (
            "needs a folder of partitions",
            "calibrate inputs/obs.csv inputs/camera.toml -o no --workers 2",
        ),
        ("--screen needs one table", "calibrate frames inputs/camera.toml -o no --screen"),
        ("not empty; name another", f"{made} --partition-frames 20 --seed 9"),
    ):
        cli.refuses(said, words)


@pytest.mark.parametrize("what", sorted({*get_args(Starter)} - {"example"}))
def test_a_starter_file_is_read_as_it_is(what, cli, tmp_path):
    out, _ = cli.ok("new", what)
    assert f"{what}.toml" in out
    assert "#" in (tmp_path / f"{what}.toml").read_text()
    load = {
        "run": lambda path: expanded(path, [], ("out", "seed"), ()),
        "camera": sc.Camera.load,
        "sensor": sc.simulation.Sensor.load,
        "site": sc.sky.Site.load,
        "budget": sc.budgeting.load_budget_file,
        "study": StudyDefinition.load,
    }[what]
    load(tmp_path / f"{what}.toml")
    cli.refuses("exists already", "new", what)


def test_the_starter_camera_looks_through_the_centre_of_its_detector(cli, tmp_path):
    """The centre of the first pixel is (0, 0), so that of a detector lies half a pixel before half
    its width.
    """
    assert cli("new", "camera")[0] == 0
    camera = sc.Camera.load(tmp_path / "camera.toml")
    assert (
        (camera.x0_px, camera.y0_px)
        == (0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1))
        == (511.5, 511.5)
    )
    # Control: the start that the paper prints stays what it is.
    assert sc.paper.paper_start().x0_px == 512.0


def test_the_example_is_written_into_a_folder(cli, tmp_path):
    out, _ = cli.ok("new example")
    assert "starcal-uq run esa/stars.ecsv esa/camera.toml -o RUN" in out
    names = {path.name for path in (tmp_path / "esa").iterdir()}
    assert names == {"NOTICE", "camera.toml", "site.toml", "stars.ecsv"}
    cli.refuses("exists already", "new example")


def test_python_runs_the_package_and_shells_complete_its_commands():
    command = [sys.executable, "-m", "starcal_uq"]
    told = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert told.stdout.startswith("starcal-uq ")
    # What the version and the help need, and nothing else; the help of a command, and completion.
    heavy, parsing = {"matplotlib", "numpy", "rich", "typer"}, {"rich", "typer"}
    code = (
        "import sys, starcal_uq.cli.app as app; sys.argv[0] = 'starcal-uq'\n"
        "try:\n    app.program()\nfinally:\n"
        f"    print(*{heavy} & sys.modules.keys(), file=sys.stderr)"
    )

    def run(words, loaded, **environment):
        told = subprocess.run(
            [sys.executable, "-c", code, *words],
            env=os.environ | environment,
            capture_output=True,
            text=True,
        )
        assert set(told.stderr.split()) <= loaded
        return told.stdout

    assert run(["--version"], set()) == told.stdout
    assert run(["--help"], set()) == run([], set()) == HELP.read_text("utf-8")
    assert "--effects" in run(["run", "--help"], parsing)
    for words, found in (
        ("starcal-uq cal", ["calibrate"]),
        ("starcal-uq run --eff", ["--effects"]),
        ("starcal-uq run --solver mi", ["minpack"]),
    ):
        asked = {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
        told = run([], parsing, _STARCAL_UQ_COMPLETE="complete_bash", **asked)
        assert told.split() == found, words


@pytest.mark.slow
def test_a_run_with_priors_goes_to_the_end(tmp_path, cli):
    c = campaign(
        np.random.default_rng(0), n_frames=3, stars_per_frame=4, field_deg=2.0, sigma_px=0.2
    )
    obs, camera = (
        sc.Observations(**c.columns),
        sc.Camera(**c.camera_toml()).replace(distortion="none"),
    )
    obs.save(tmp_path / "obs.csv")
    camera.save(tmp_path / "camera.toml")
    (tmp_path / "priors.toml").write_text("[priors]\nprincipal_point_px = 10.0\n")
    command = "run obs.csv camera.toml -o run --in-space --ensembles 2 --walkers 14 --steps 40"
    cli.refuses("do not determine", command)
    assert not (tmp_path / "run" / "calibration.json").exists()
    out, _ = cli.ok(f"{command} --priors priors.toml", among=(0, 1))
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text("utf-8"))
    assert "estimation (warning, singular)" in " ".join(out.split())
    assert any(
        "there the posterior is that of the priors" in check["sentence"]
        for check in verdict["checks"]
    )
    # Two checks ask for more steps, one of them for ten times as many: one command.
    assert sum(" sample " in command for command in verdict["commands"]) == 1
    assert (tmp_path / "run" / "report.html").exists()
