"""The command line as a user meets it: whole runs, JSON, help, and one sentence for every
mistake.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.cli.schemas import document
from starcal_uq.core.settings import Starter
from starcal_uq.studies.definition import StudyDefinition
from tests.cli.conftest import check_document
from tests.helpers.commands import SMALL, files
from tests.helpers.outside import campaign
from tests.helpers.scenes import observations


def test_run_writes_everything_and_ends_with_its_summary(painting_cli, inputs, tmp_path):
    status, out, err = painting_cli(
        "run", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", *SMALL
    )
    assert status in (0, 1)
    for heading in ("Calibration", "posterior ± 1 sigma", "Attitude error", "Report:"):
        assert heading in out
    assert "Neither time nor observer velocity was declared" in err
    run = sc.runs.RunFolder(tmp_path / "run")
    for path in (
        run.observations,
        run.camera,
        run.calibration,
        run.posterior,
        run.coupling,
        run.attitude,
        run.report,
    ):
        assert path.stat().st_size > 0, path
    page = run.report.read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "")
    for name in ("corner", "residuals"):
        assert (run.figures / f"{name}.svg").stat().st_size > 20_000, "figures are painted"
    # The same verdict for programs.
    verdict = check_document(run.verdict.read_text("utf-8"), status)
    found = sc.Run(run.path).verdict
    assert verdict == document("verdict", found, status) == found.to_dict()
    assert verdict["headline"] in " ".join(out.split())
    assert [check["name"] for check in verdict["checks"]] == [
        c.name for c in sc.Run(run.path).verdict.checks
    ]
    assert all(
        check["remedy"] or check["advice"] or check["level"] == "pass"
        for check in verdict["checks"]
    )
    # The same seed repeats the posterior bit for bit, step by step too.
    painting_cli("calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "again")
    painting_cli("sample", "again", *SMALL)
    again = sc.Posterior.load(tmp_path / "again" / "posterior.nc")
    assert np.array_equal(again.draws, sc.Posterior.load(run.posterior).draws)


def test_steps_one_by_one_with_json(cli, inputs):
    status, out, _ = cli(
        "calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", "--json"
    )
    assert status == 0
    table = json.loads(out)["calibration"]
    assert table["status"] == "CONVERGED"
    assert [row["parameter"] for row in table["parameters"]] == [
        "x0",
        "y0",
        "f",
        "k1",
        "k2",
        "sigma",
    ]
    status, out, _ = cli("coupling", "run")
    assert status == 0
    assert "what not knowing the others costs" in out
    status, out, _ = cli("sample", "run", "--json", "--seed", "3", *SMALL)
    assert status in (0, 1)
    assert len(json.loads(out)["posterior"]["parameters"]) == 6
    status, out, _ = cli("coupling", "run", "--json")
    assert status == 0
    assert 0.9 < json.loads(out)["coupling"]["parameters"][0]["contraction"] <= 1.0
    status, out, _ = cli("propagate", "run", "--json", "--draws", "60")
    assert status == 0
    assert {row["axis"] for row in json.loads(out)["attitude"]["contributors"]} >= {
        "pitch",
        "yaw",
        "roll",
    }
    status, out, _ = cli("report", "run", "--json")
    assert status == 0
    assert json.loads(out)["report"] == "run/report.html"


def test_new_sampling_removes_what_the_old_one_led_to(cli, inputs, tmp_path):
    cli("calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run")
    cli("sample", "run", *SMALL)
    cli("propagate", "run", "--draws", "60")
    assert (tmp_path / "run" / "attitude.csv").exists()
    status, _, err = cli("sample", "run", *SMALL)
    assert status == 2
    assert "--force" in err
    assert (tmp_path / "run" / "attitude.csv").exists()
    cli("sample", "run", "--force", *SMALL)
    assert not (tmp_path / "run" / "attitude.csv").exists()


def test_simulate_writes_a_table_that_calibrates(cli, inputs, tmp_path):
    status, out, _ = cli(
        "simulate", inputs / "camera.toml", "-o", "obs.parquet", "--frames", 30, "--seed", 5
    )
    assert status == 0
    assert "30 frames" in out
    first = (tmp_path / "obs.parquet").read_bytes()
    status, _, err = cli("simulate", inputs / "camera.toml", "-o", "obs.parquet", "--frames", 30)
    assert status == 2
    assert "--force" in err
    assert (tmp_path / "obs.parquet").read_bytes() == first
    status, out, err = cli("calibrate", "obs.parquet", inputs / "camera.toml", "-o", "run")
    assert status == 0
    assert "truth" in out
    assert "warning" not in err


def test_demo_ends_with_the_table_of_truth_and_the_report(cli, tmp_path):
    status, out, _ = cli("demo", "--out", "demo", "--frames", 60, "--json")
    assert status == 0
    found = json.loads(out)
    assert found["calibration"]["parameters"][2]["truth"] == sc.paper.paper_camera().focal_px
    assert found["verdict"]["level"] != "fail" and found["report"] == "demo/report.html"
    assert (tmp_path / "demo" / "report.html").exists()


@pytest.mark.parametrize(
    "command",
    [
        (),
        ("demo",),
        ("simulate",),
        ("calibrate",),
        ("sample",),
        ("coupling",),
        ("propagate",),
        ("report",),
        ("run",),
    ],
)
def test_help_teaches(cli, command):
    status, out, _ = cli(*command, "--help")
    assert status == 0
    assert "Usage" in out
    assert len(out.splitlines()) > 8


def test_options_stand_under_what_they_are_for_and_a_missing_file_under_the_command_that_writes_it(
    cli, inputs
):
    out = cli("run", "--help")[1]
    panels = (
        "Options",
        "How a camera is estimated",
        "What belongs to images alone",
        "How a posterior is sampled",
    )
    places = [out.index(f" {words} ") for words in panels]
    assert (
        places == sorted(places)
        and places[1] < out.index("--effects") < places[2] < out.index("--gain") < places[3]
    )
    status, _, err = cli("calibrate", inputs / "obs.csv", "site/camera.toml", "-o", "run")
    assert (
        status == 2
        and "site/camera.toml': does not exist; check the path, or starcal-uq new camera" in err
    )
    assert "starcal-uq new" not in cli("calibrate", inputs / "obs.csv", "mine.toml", "-o", "run")[2]
    said = cli(
        "calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", "--only-frames", "a"
    )[2]
    assert "is no list of frame numbers" in said


def _line(path, number, text):
    lines = path.read_text().splitlines()
    lines[number - 1] = text
    path.write_text("\n".join(lines) + "\n")


def _cell(path, number, column, text):
    lines = path.read_text().splitlines()
    index = lines[0].split(",").index(column)
    cells = lines[number - 1].split(",")
    cells[index] = text
    _line(path, number, ",".join(cells))


def _drop_column(folder):
    path = folder / "obs.csv"
    lines = [line.split(",") for line in path.read_text().splitlines()]
    index = lines[0].index("y_px")
    path.write_text("\n".join(",".join(c[:index] + c[index + 1 :]) for c in lines) + "\n")


def _short_frame(folder):
    path = folder / "obs.csv"
    lines = path.read_text().splitlines()
    path.write_text(
        "\n".join(lines[:3] + [line for line in lines[3:] if not line.startswith("0,")]) + "\n"
    )


def _duplicate_star(folder):
    path = folder / "obs.csv"
    lines = path.read_text().splitlines()
    header = lines[0].split(",")
    a, b = lines[1].split(","), lines[2].split(",")
    for column in ("ra_deg", "dec_deg", "star_id"):
        b[header.index(column)] = a[header.index(column)]
    _line(path, 3, ",".join(b))


def _text(name, old, new):
    def change(folder):
        path = folder / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


def _cells(number, column, text):
    return lambda folder: _cell(folder / "obs.csv", number, column, text)


def _directory(folder):
    (folder / "obs.csv").unlink()
    (folder / "obs.csv").mkdir()


MISTAKES = {
    "missing column": (_drop_column, ["obs.csv", "y_px"]),
    "text in a number column": (_cells(7, "x_px", "abc"), ["obs.csv", "line 7", "x_px", "abc"]),
    "NaN": (_cells(9, "dec_deg", "nan"), ["obs.csv", "line 9", "dec_deg"]),
    "pixel outside the detector": (_cells(5, "y_px", "1030.0"), ["obs.csv", "line 5", "y_px"]),
    "too few stars": (_short_frame, ["obs.csv", "frame 0"]),
    "duplicate star": (_duplicate_star, ["obs.csv", "line 3"]),
    "declination of 91": (_cells(4, "dec_deg", "91.0"), ["obs.csv", "line 4", "dec_deg", "91"]),
    "unknown key": (
        _text("camera.toml", "[camera]", "[camera]\nfocal_length = 70.0"),
        ["camera.toml", "focal_length"],
    ),
    "missing key": (
        _text("camera.toml", "focal_mm =", "# focal_mm ="),
        ["camera.toml", "focal_mm"],
    ),
    "missing section": (_text("camera.toml", "[camera]", "[kamera]"), ["camera.toml", "camera"]),
    "broken TOML": (_text("camera.toml", "[camera]", "[camera"), ["camera.toml"]),
    "empty file": (lambda folder: (folder / "obs.csv").write_text(""), ["obs.csv", "empty"]),
    "a directory": (_directory, ["obs.csv", "director"]),
    "missing file": (lambda folder: (folder / "obs.csv").unlink(), ["obs.csv"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("command", ["calibrate", "run"])
def test_every_mistake_is_one_sentence_and_touches_nothing(cli, inputs, tmp_path, mistake, command):
    spoil, words = MISTAKES[mistake]
    spoil(inputs)
    before = files(tmp_path)
    status, out, err = cli(command, inputs / "obs.csv", inputs / "camera.toml", "-o", "run")
    assert status == 2
    lines = [line for line in err.splitlines() if line.strip()]
    assert len(lines) == 1, err
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0], (word, lines[0])
    assert "Traceback" not in err + out
    assert files(tmp_path) == before


def test_output_that_exists_is_kept(cli, inputs, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep me")
    before = files(tmp_path)
    status, _, err = cli("run", inputs / "obs.csv", inputs / "camera.toml", "-o", "run")
    assert status == 2
    assert "--force" in err
    assert files(tmp_path) == before
    status, _, _ = cli(
        "calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", "--force"
    )
    assert status == 0
    assert (tmp_path / "run" / "mine.txt").read_text() == "keep me"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sample", "nowhere"], ["nowhere"]),
        (["report", "nowhere"], ["nowhere"]),
        (["propagate", "nowhere"], ["nowhere"]),
        (["calibrate"], ["OBS"]),
        (["nonsense"], ["nonsense"]),
    ],
)
def test_wrong_calls_end_with_status_2(cli, arguments, words):
    status, _, err = cli(*arguments)
    assert status == 2
    for word in words:
        assert word in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--directions", "catalogue", "time_utc"),
        ("--observer-velocity", "1,2", "three numbers"),
        ("--column", "ra_deg", "NAME=IN_FILE"),
        ("--column", "ra_deg=nothing", "nothing"),
    ],
)
def test_wrong_options_are_named(cli, inputs, tmp_path, option, value, words):
    before = files(tmp_path)
    status, _, err = cli(
        "calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "run", option, value
    )
    assert status == 2
    assert words in err
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
    assert cli("calibrate", "obs.csv", "camera.toml", "-o", "made", "--in-space")[0] == 0
    for call, words in WRONG_FILES.items():
        status, _, err = cli(*call.split(), "-o", "run")
        assert (status, len(err.splitlines())) == (2, 1) and err.startswith(f"error: {words}"), err
    assert not (inputs / "run").exists()


def test_a_calibration_that_fails_leaves_no_folder(cli, inputs, tmp_path):
    rng = np.random.default_rng(0)
    obs = observations()
    shuffled = rng.permutation(obs.n_stars)
    import dataclasses

    # Right ascensions keep the rows distinct; the declinations belong to other stars.
    wrong = dataclasses.replace(
        obs, dec_deg=-obs.dec_deg[shuffled], ra_deg=obs.ra_deg, star_id=None
    )
    wrong.save(inputs / "wrong.csv")
    status, _, err = cli("calibrate", inputs / "wrong.csv", inputs / "camera.toml", "-o", "run")
    assert status == 2
    assert "error: the calibration" in err
    assert not (tmp_path / "run").exists()


def test_declared_directions_and_renamed_columns(cli, inputs):
    text = (inputs / "obs.csv").read_text().replace("ra_deg", "alpha", 1)
    (inputs / "obs.csv").write_text(text)
    status, _, err = cli(
        "calibrate",
        inputs / "obs.csv",
        inputs / "camera.toml",
        "-o",
        "run",
        "--column",
        "ra_deg=alpha",
        "--directions",
        "apparent",
    )
    assert status == 0
    assert "warning" not in err


def test_folder_of_partitions_from_simulation_to_posterior(cli, inputs):
    made = (
        "simulate",
        inputs / "camera.toml",
        "-o",
        "frames",
        "--frames",
        "50",
        "--min-stars",
        "5",
        "--max-mag",
        "7",
    )
    status, out, err = cli(*made, "--partition-frames", "20", "--workers", "0")
    assert (status, out.split(" stars ")[1]) == (0, "in 50 frames, 3 files: frames\n"), err
    status, out, err = cli(
        "calibrate", "frames", inputs / "camera.toml", "-o", "run", "--workers", "0"
    )
    assert status == 0 and "in 50 frames" in out, err
    assert cli("sample", "run", *SMALL)[0] in (0, 1)
    for words, arguments in (
        ("give --partition-frames", (*made, "--workers", "2", "--force")),
        (
            "needs a folder of partitions",
            ("calibrate", inputs / "obs.csv", inputs / "camera.toml", "-o", "no", "--workers", "2"),
        ),
        (
            "--screen needs one table",
            ("calibrate", "frames", inputs / "camera.toml", "-o", "no", "--screen"),
        ),
        ("not empty; name another", (*made, "--partition-frames", "20", "--seed", "9")),
    ):
        status, _, err = cli(*arguments)
        assert status == 2 and words in err, err


@pytest.mark.parametrize("what", sorted({*get_args(Starter)} - {"example"}))
def test_a_starter_file_is_read_as_it_is(what, cli, tmp_path):
    status, out, _ = cli("new", what)
    assert status == 0
    assert f"{what}.toml" in out
    assert "#" in (tmp_path / f"{what}.toml").read_text()
    load = {
        "camera": sc.Camera.load,
        "sensor": sc.simulation.Sensor.load,
        "site": sc.sky.Site.load,
        "budget": sc.budgeting.load_budget_file,
        "study": StudyDefinition.load,
    }[what]
    load(tmp_path / f"{what}.toml")
    status, _, err = cli("new", what)
    assert status == 2
    assert "exists already" in err


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
    status, out, _ = cli("new", "example")
    assert status == 0 and "starcal-uq run esa/stars.ecsv esa/camera.toml -o RUN" in out
    assert {path.name for path in (tmp_path / "esa").iterdir()} == {
        "NOTICE",
        "camera.toml",
        "site.toml",
        "stars.ecsv",
    }
    status, _, err = cli("new", "example")
    assert status == 2 and "exists already" in err


def test_python_runs_the_package_and_shells_complete_its_commands():
    command = [sys.executable, "-m", "starcal_uq"]
    told = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert told.stdout.startswith("starcal-uq ")
    words = {
        "_STARCAL_UQ_COMPLETE": "complete_bash",
        "COMP_WORDS": "starcal-uq cal",
        "COMP_CWORD": "1",
    }
    code = (
        "import sys; sys.argv = ['starcal-uq']; from starcal_uq.cli.app import program; program()"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **words}, capture_output=True, text=True
    )
    assert told.stdout.split() == ["calibrate"]


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
    command = [
        "run",
        tmp_path / "obs.csv",
        tmp_path / "camera.toml",
        "-o",
        tmp_path / "run",
        "--in-space",
    ]
    sampling = ["--ensembles", "2", "--walkers", "14", "--steps", "40"]
    status, _, err = cli(*command, *sampling)
    assert (
        status == 2
        and "do not determine" in err
        and not (tmp_path / "run" / "calibration.json").exists()
    )
    status, out, err = cli(*command, *sampling, "--priors", tmp_path / "priors.toml")
    assert status in (0, 1), err
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text("utf-8"))
    assert "estimation (warning, singular)" in " ".join(out.split())
    assert any(
        "there the posterior is that of the priors" in check["sentence"]
        for check in verdict["checks"]
    )
    # Two checks ask for more steps, one of them for ten times as many: one command.
    assert sum(" sample " in command for command in verdict["commands"]) == 1
    assert (tmp_path / "run" / "report.html").exists()
