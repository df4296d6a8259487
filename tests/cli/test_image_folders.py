"""Folders of pictures as they come: few stars, other cameras, damaged files, nothing that is a star."""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.pipeline.images import observations_from_images
from tests.helpers.sky_pictures import SIZE, attitude, picture

FAST = ("--steps", 20, "--draws", 50, "--ensembles", 2)


def sheet(path, focal_px, model="brown"):
    centre = 0.5 * (SIZE - 1)
    sc.Camera(SIZE, SIZE, 10.0, 1e-2 * focal_px, centre, centre, model).save(path)


@pytest.fixture
def noisy_frame(tmp_path):
    """One frame whose bright stars show so much noise that the terms of its sheet's model are open."""
    rng = np.random.default_rng(2)
    rng.integers(4)
    picture(tmp_path / "frame.tiff", attitude(rng), 6000.0, jitter_px=0.4, max_mag=9.0, seed=2)
    sheet(tmp_path / "camera.toml", 6000.0)
    return tmp_path / "frame.tiff"


def test_a_model_that_is_asked_for_is_fitted_whatever_the_sheet_has(cli, noisy_frame, tmp_path):
    status, _, err = cli("run", noisy_frame, "camera.toml", "-o", "run", "--model", "none", *FAST)
    assert status in (0, 1), err
    assert sc.Run(tmp_path / "run").calibration.camera.distortion == "none"


def test_images_fall_back_to_a_simpler_model_as_a_table_does(noisy_frame, tmp_path):
    camera = sc.Camera.load(tmp_path / "camera.toml")
    obs, _, found = observations_from_images([noisy_frame], camera)
    assert obs.meta["noise_floor_px"] == pytest.approx(0.4, rel=0.3)
    cal = sc.calibrate(obs, found.rounds[0][0].nominal)
    assert cal.camera.distortion == "none"
    assert cal.provenance["fallback"]["model"] == "brown"
    # What is asked for by name is fitted or refused there as well, and the way out leads out.
    with pytest.raises(CalibrationError, match="'none' converges"):
        sc.calibrate(obs, found.rounds[0][0].nominal, model="brown")
