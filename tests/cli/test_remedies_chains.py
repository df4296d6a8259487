"""What a run prints to try is followed literally, to its end."""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.verdict.estimate import stars
from tests.helpers.ground_scenes import CAMERA
from tests.helpers.outside import campaign
from tests.helpers.remedy_chains import PLANTED, SMALL, follow, plant

QUICK = ("decentring, 0.5 px", "refraction, without times")
SLOW = (
    "errors of the stars, 0.05 px",
    "2 % wrong stars",
)


@pytest.fixture
def call(cli):
    return lambda words: cli(*words)


def test_there_are_thirty_misfits():
    assert len(set(PLANTED)) >= 30


@pytest.mark.slow
def test_effects_take_up_what_was_planted(call, tmp_path):
    """The directions were declared apparent, and lack refraction: that is stated, and f is
    right.
    """
    steps = follow(call, plant(QUICK[1], tmp_path), tmp_path)
    assert len(steps) == 1 and steps[0].doubts[0] == 0 and steps[0].doubts[1] > 0
    cal = sc.Run(tmp_path / "run").calibration
    assert "zenith" in cal.effects.names
    assert abs(cal.theta[2] - CAMERA.focal_px) < 3.0 * cal.sigmas[2]


@pytest.mark.parametrize("name", [pytest.param(QUICK[0], marks=pytest.mark.slow), QUICK[1]])
def test_what_is_printed_without_effects_is_followed_to_its_end(name, call, tmp_path):
    steps = follow(call, (*plant(name, tmp_path), "--effects", "none"), tmp_path)
    if name == "decentring, 0.5 px":
        assert [step.options["--effects"] for step in steps] == [("none",), ("auto",)]
        assert steps[0].doubts[0] > 0 and steps[-1].doubts[0] == 0
    else:
        # Where the times are not known no command can be copied, and no other is printed before
        # they are.
        assert len(steps) == 1 and "would tell: the time of every frame in UTC" in steps[0].said


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_more_of_what_is_printed_is_followed_to_its_end(name, call, tmp_path):
    follow(call, plant(name, tmp_path), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["shipped", "images", "openstartracker"])
def test_what_is_printed_for_real_data_is_followed_to_its_end(what, call, tmp_path, real_data):
    data = real_data
    if what == "shipped":
        assert call(["new", "example", "-o", str(tmp_path / "esa")])[0] == 0
        given = [tmp_path / "esa" / "stars.ecsv", tmp_path / "esa" / "camera.toml"]
    elif what == "images":
        given = [data / "esa-tetra3", data / "esa_tetra3_camera.toml"]
    else:
        given = [data / "openstartracker"]
    steps = follow(call, ("run", *map(str, given), *SMALL), tmp_path)
    # No site was given: usable at once, and the air that is assumed is stated.
    assert steps[0].doubts[0] == steps[-1].doubts[0] == 0
    if what == "images":
        checks = sc.Run(tmp_path / "run").verdict.checks
        assert any("Refraction is estimated" in str(check) for check in checks)


def test_errors_of_stars_that_no_catalogue_has_are_no_way_out():
    """Three frames of one field: what is wrong with the directions looks like an error of each
    star.
    """
    rng = np.random.default_rng(3)
    levels = {}
    for size in (0.1, 5.0):
        c = campaign(rng, n_frames=6, stars_per_frame=25, patch_stars=30, star_sigma_px=size)
        obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
        cal = sc.calibrate(
            obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)), effects="star"
        )
        levels[size] = stars(sc.diagnostics.star_test(obs, cal))
    assert levels[0.1].level is Level.PASS
    assert levels[5.0].level is Level.FAIL and "Leave star out of the list" in levels[5.0].advice


def test_a_calibration_alone_is_no_verdict_and_names_the_command_that_makes_one(cli, tmp_path):
    plant("decentring, 0.5 px", tmp_path)
    words = ["table.csv", "sheet.toml", "--directions", "apparent", "--in-space", "--model", "k1"]
    out, _ = cli.ok("calibrate", *words, "-o", "alone")
    assert "No verdict has been made" in out
    told = next(line for line in out.splitlines() if "No verdict" in line).split("What asks: ")[1]
    assert (
        told.startswith("starcal-uq run ") and "--model k1" in told and told.endswith("-o alone-2")
    )
    # What was given then is given again when its checks ask for more.
    run = sc.Run(tmp_path / "alone")
    commands = run.verdict.commands
    assert commands and all(
        "--in-space --model" in command and "alone-2" in command for command in commands
    )
