"""The field experiment of Ye & Yang 2017 by simulation."""

import dataclasses
import itertools
import re

import numpy as np
import pandas as pd
import pytest

from starcal_uq.attitude.rotations import exp_rotation, random_rotations, rotation_to_quaternion
from starcal_uq.camera.projection import fold_radius_px, project, unproject
from starcal_uq.core.errors import CalibrationError, RunFolderError
from starcal_uq.paper.field.attitudes import FieldStars, attitude_errors, single_faults
from starcal_uq.paper.field.experiment import field_experiment
from starcal_uq.paper.field.frames import true_pixels
from starcal_uq.paper.field.published import (
    AXES,
    FIELD_CAMERAS,
    FIELD_DEG,
    FIELD_METHODS,
    RATE,
    READINGS,
    TABLE_3,
    TRUE_CAMERA,
    UNCALIBRATED,
    X0_PX,
    Y0_PX,
    printed_field,
    printed_sensor,
)
from starcal_uq.paper.field.result import ALIGNED, AS_IT_STANDS, BOTH, NEITHER
from tests.helpers.painting import without_painting

ARCSEC = np.degrees(1.0) * 3600.0


def test_table_3_is_complete() -> None:
    assert len(TABLE_3) == 16
    assert [printed_field(method, RATE).text for method in FIELD_METHODS] == [
        "89",
        "93",
        "95",
        "96",
    ]
    assert printed_field(UNCALIBRATED, AXES[2]).text == "127.2"


@pytest.mark.parametrize("name", READINGS)
def test_reading_is_one_consistent_sensor(name: str) -> None:
    reading = READINGS[name]
    truth = reading.truth
    kept = {fact: good for fact, _, good, _ in printed_sensor(reading)}
    assert kept["field"] == (name == "window") and len(kept) == 5
    assert (abs(truth.fov_deg[0] - FIELD_DEG) < 0.05) == kept["field"]
    assert (truth.x0_px + reading.offset_px, truth.y0_px + reading.offset_px) == pytest.approx(
        (X0_PX, Y0_PX)
    )
    # The window is the middle of the detector, so that both readings have one centre.
    assert truth.centre_px[0] + reading.offset_px == 1023.5
    reach = 1.2 * truth.corner_radius_px
    assert fold_radius_px(truth.distortion, truth.theta, reach) >= reach


def test_distortion_displaces_by_pixels_in_the_corner() -> None:
    shift = {}
    for name, reading in READINGS.items():
        truth = reading.truth
        r = truth.corner_radius_px
        k1, k2 = truth.coefficients
        shift[name] = r * (k1 * r**2 + k2 * r**4)
    assert shift["window"] == pytest.approx(-5.27, abs=0.01)
    assert shift["full"] == pytest.approx(-10.38, abs=0.01)


def _scene(n_frames: int = 300, n_stars: int = 9, sigma_px: float = 0.2) -> FieldStars:
    """Stars at random places of the window, with noise."""
    rng = np.random.default_rng(5)
    truth = READINGS["window"].truth
    n = n_frames * n_stars
    xy = rng.uniform(0.0, truth.width_px - 1.0, (n, 2))
    rotations = random_rotations(n_frames, rng)
    frame = np.repeat(np.arange(n_frames), n_stars)
    directions = np.einsum("nji,nj->ni", rotations[frame], unproject(truth, xy))
    return FieldStars(
        xy + sigma_px * rng.standard_normal(xy.shape),
        xy,
        directions,
        np.full(n, sigma_px),
        np.arange(0, n + 1, n_stars),
        rotation_to_quaternion(rotations),
    )


def test_true_camera_leaves_noise_alone() -> None:
    stars = _scene()
    errors = attitude_errors(stars, READINGS["window"].truth)
    assert np.all(np.abs(errors.common) < 1e-6) and np.all(errors.rest < 1e-6)
    # sigma / sqrt(stars) across, and over the mean distance from the centre in roll.
    across = 0.2 / 3.0 / READINGS["window"].truth.focal_px * ARCSEC
    assert errors.noise[:2] == pytest.approx([across, across], rel=0.12)
    assert errors.rms == pytest.approx(errors.noise)
    assert stars.noise_scale == pytest.approx(1.0, abs=0.04)


def test_parts_add_up_and_are_told_apart() -> None:
    stars, reading = _scene(), READINGS["window"]
    errors = attitude_errors(stars, reading.nominal())
    assert errors.sum_of_squares == pytest.approx(errors.rms, rel=0.06)
    # A principal point that is d off turns every attitude by d / f.
    shift = (reading.truth.theta - reading.nominal().theta)[:2] / reading.truth.focal_px * ARCSEC
    assert np.abs(errors.common[:2]) == pytest.approx(np.abs(shift[::-1]), rel=0.02)
    assert errors.aligned[0] < 0.1 * errors.rms[0]
    # Negative control: a focal length is nearly all rest, and a rotation of all frames is not in
    # the rest.
    faults = single_faults(reading.truth, reading.nominal())
    focal = attitude_errors(stars, faults["focal length"])
    assert np.all(np.abs(focal.common[:2]) < 0.02 * np.abs(errors.common[:2]))
    assert np.all(focal.rest[:2] > np.abs(focal.common[:2])) and np.all(focal.rest[:2] > 30.0)
    turn = exp_rotation(np.array([3e-5, -2e-5, 5e-5]))
    turned = dataclasses.replace(
        stars,
        xy_px=project(reading.truth, unproject(reading.truth, stars.xy_px) @ turn.T),
        true_px=project(reading.truth, unproject(reading.truth, stars.true_px) @ turn.T),
    )
    rigid = attitude_errors(turned, reading.truth)
    assert rigid.common == pytest.approx(np.array([3e-5, -2e-5, 5e-5]) * ARCSEC, rel=1e-3)
    assert np.all(rigid.rest < 0.01)


def test_frames_can_be_drawn_again() -> None:
    stars = _scene(6)
    again = stars.frames(np.array([4, 0, 4]))
    assert again.n_frames == 3 and again.starts.tolist() == [0, 9, 18, 27]
    errors = attitude_errors(stars, READINGS["window"].nominal()).total
    assert attitude_errors(again, READINGS["window"].nominal()).total == pytest.approx(
        errors[[4, 0, 4]]
    )


def test_stars_behind_the_camera_have_no_place() -> None:
    place = true_pixels(
        READINGS["window"].truth, np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 1], [0, 0, -1]])
    )
    assert np.isfinite(place[0]).all() and np.isnan(place[1]).all()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"reading": "half"}, "reading 'half'"),
        ({"n_frames": 5}, "n_frames is 5"),
        ({"n_replicates": 1}, "n_replicates"),
    ],
)
def test_refuses_what_makes_no_sense(tmp_path, wrong, words) -> None:
    with pytest.raises(CalibrationError, match=words):
        field_experiment(tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()


def test_refuses_a_used_folder(tmp_path) -> None:
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(RunFolderError):
        field_experiment(tmp_path)


# A small experiment for the tests, smaller than users are let: its parts are those of a large one.
SMALL = {"n_frames": 3, "n_calibration_frames": 8, "n_replicates": 3}


@pytest.fixture(scope="module")
def small_sizes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("starcal_uq.paper.field.experiment._LEAST", 3)
        patch.setattr("starcal_uq.paper.field.experiment.TOLERANCES_PX", (0.5, 2.0))
        yield


@pytest.fixture(scope="module")
def small(tmp_path_factory, small_sizes):
    """The experiment, interrupted in each of its parts and gone on with, and what its progress
    callback was told.
    """
    folder = tmp_path_factory.mktemp("field") / "out"
    seen: list[int] = []
    end = 0

    def show(done: int, total: int) -> None:
        seen.append(100 * done // total)
        if seen[-1] >= end:
            raise KeyboardInterrupt

    with without_painting():
        for part in (20, 60, 88):
            end = part
            seen.clear()
            with pytest.raises(KeyboardInterrupt):
                field_experiment(folder, workers=0, progress=show, **SMALL)
            assert [path.name for path in folder.iterdir()] == [".unfinished"]
        end = 101
        seen.clear()
        found = field_experiment(folder, workers=0, progress=show, **SMALL)
    return found, seen


def test_writes_report_and_tables(small) -> None:
    found, seen = small
    names = {"table_3", "rates", "parts", "sources", "data_sheets", "cameras", "frames"}
    assert {path.stem for path in found.path.glob("*.csv")} == names
    assert {path.name for path in (found.path / "figures").iterdir()} == {
        "field_rates.png",
        "field_errors.png",
    }
    page = found.report.read_text(encoding="utf-8")
    assert "http" not in page and "<script" not in page and not re.search(r"\b(nan|None)\b", page)
    assert "127.2" in page and found.text.split(".")[0] in page
    assert seen == sorted(seen) and seen[-1] == 100
    assert len(pd.read_csv(found.path / "frames.csv")) == SMALL["n_frames"] * len(FIELD_CAMERAS)
    assert found.provenance["seed"] == 2017 and found.provenance["settings"]["reading"] == "window"


def test_table_says_what_comes_out(small) -> None:
    table = small[0].table_3()
    assert len(table) == 16 and set(table["agrees"]) <= {
        "yes",
        AS_IT_STANDS,
        ALIGNED,
        BOTH,
        NEITHER,
    }
    rates = table[table["quantity"] == RATE]
    inside = (rates["low"] <= rates["printed"].astype(float)) & (
        rates["printed"].astype(float) <= rates["high"]
    )
    assert list(rates["agrees"] == "yes") == list(inside)


def test_control_has_noise_alone(small) -> None:
    found = small[0]
    errors = found.errors[TRUE_CAMERA]
    assert (
        np.all(np.abs(errors.common) < 1e-3)
        and np.all(errors.rest < 1e-3)
        and np.all(errors.noise > 0.3)
    )
    # The uncalibrated camera is the negative control of this control.
    if UNCALIBRATED in found.errors:
        assert np.all(found.errors[UNCALIBRATED].rest > 1.0)
    for camera in found.cameras:
        assert not found.identified(camera).wrong.any()


@pytest.mark.slow
def test_does_not_depend_on_interrupts(small, tmp_path) -> None:
    found = small[0]
    with without_painting():
        again = field_experiment(tmp_path / "out", workers=0, **SMALL)
    for name in ("table_3", "rates", "parts", "frames", "cameras"):
        assert (found.path / f"{name}.csv").read_bytes() == (
            again.path / f"{name}.csv"
        ).read_bytes()


@pytest.mark.slow
def test_the_full_experiment(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("starcal_uq.paper.field.experiment.TOLERANCES_PX", (0.1, 0.5, 5.0))
    sizes = {"n_frames": 60, "n_calibration_frames": 60, "n_replicates": 20}
    found = field_experiment(tmp_path / "out", **sizes)
    errors, parts = found.errors, found.parts()
    # A third of random attitudes show more than six stars, as 200 of the paper's 600 frames.
    assert 0.25 < found.frames.share < 0.42
    assert found.identified(TRUE_CAMERA).correct.sum() >= 58
    assert not any(
        result.wrong.any() for (name, _), result in found.sweep.items() if name == TRUE_CAMERA
    )
    # The better the camera the smaller the rest, on every axis.
    for worse, better in itertools.pairwise(FIELD_METHODS):
        assert np.all(errors[worse].rest > errors[better].rest)
    # Least squares and Samaan's method are hundreds of arcsec off in common; the printed numbers
    # cannot contain that.
    for method in FIELD_METHODS[:3]:
        assert np.hypot(*errors[method].common[:2]) > 1000.0
    # Of the proposed method next to nothing is left but noise after alignment.
    assert np.all(errors["three_stage"].rest < 0.2 * errors["three_stage"].noise)
    assert np.allclose(parts["sum_of_squares"], parts["rms"], rtol=0.2)
    control = parts[parts["camera"] == TRUE_CAMERA]
    assert (control["rest"] < 1e-3).all() and (control["common"].abs() < 1e-3).all()
    # A wrong focal length costs identifications where the tolerance is small.
    rates = {name: found.identified(name).correct.sum() for name in FIELD_CAMERAS}
    assert (
        rates[UNCALIBRATED] < 0.6 * rates["least_squares"]
        and rates["least_squares"] <= rates[TRUE_CAMERA]
    )
