"""Real stars: a table measured in night-sky images of the European Space Agency, against an
independent bundle fit.
"""

from __future__ import annotations

import csv

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.status import Level
from verification import ground

# Independent bundle fit of the table (apparent directions, SNR >= 10, 242 stars): value and
# standard error.
INDEPENDENT = {
    "x0": (517.3, 1.0),
    "y0": (389.9, 1.4),
    "f": (5116.54, 0.28),
    "k1f2": (0.078, 0.017),
    "k2f4": (1.5, 1.1),
}


@pytest.fixture(scope="module")
def camera(real_data):
    return sc.Camera.load(real_data / "esa_tetra3_camera.toml")


@pytest.fixture(scope="module")
def table(real_data):
    return real_data / "esa_tetra3_observations.csv"


def _select(table, camera):
    obs = sc.load_observations(
        table, camera, columns={"ra_deg": "ra_apparent_deg", "dec_deg": "dec_apparent_deg"}
    ).with_meta(directions="apparent")
    with table.open() as stream:
        snr = np.array([float(row["snr"]) for row in csv.DictReader(stream)])
    return obs.select(snr >= 10)


def test_all_stars_as_a_user_would_run_them(camera, table):
    obs = sc.load_observations(table, camera)
    assert not obs.directions_declared
    cal = sc.calibrate(obs, camera)
    assert (cal.n_stars, cal.n_frames) == (567, 8)
    assert 0.08 < cal.sigma < 0.16
    assert np.hypot(cal.theta[0] - 511.5, cal.theta[1] - 383.5) < 15.0
    assert abs(cal.theta[2] - 5115.0) < 5.0
    assert cal.correlation[3, 4] < -0.9


def test_agrees_with_the_independent_fit(camera, table):
    obs = _select(table, camera)
    assert obs.n_stars == 242
    cal = sc.calibrate(obs, camera)
    f = cal.theta[2]
    ours = dict(
        zip(INDEPENDENT, [*cal.theta[:3], cal.theta[3] * f**2, cal.theta[4] * f**4], strict=True)
    )
    sigmas = [*cal.sigmas[:3], cal.sigmas[3] * f**2, cal.sigmas[4] * f**4]
    for (name, (value, error)), sigma in zip(INDEPENDENT.items(), sigmas, strict=True):
        assert abs(ours[name] - value) < 0.3 * error, name
        assert sigma == pytest.approx(error, rel=0.1), name
    assert cal.sigma == pytest.approx(0.070, abs=0.002)
    # The control: directions without aberration and refraction do not agree.
    wrong = sc.calibrate(sc.load_observations(table, camera), camera)
    assert abs(wrong.theta[2] - INDEPENDENT["f"][0]) > 5 * INDEPENDENT["f"][1]


def test_one_coefficient_is_enough(camera, table):
    cal = sc.calibrate(_select(table, camera), camera.replace(distortion="k1", coefficients=(0.0,)))
    f = cal.theta[2]
    assert cal.theta[3] * f**2 == pytest.approx(0.100, abs=0.004)
    assert cal.sigmas[3] * f**2 == pytest.approx(0.004, rel=0.1)


def test_posterior_of_few_frames_agrees_with_its_independent_check(camera, table):
    obs = _select(table, camera)
    cal = sc.calibrate(obs, camera)
    post = sc.sample(obs, cal, seed=1)
    assert post.diagnostics.ok, post.diagnostics.failures
    assert np.all(np.abs(post.mean - cal.theta) / cal.sigmas < 0.3)
    assert np.allclose(np.sqrt(np.diag(post.covariance)), cal.sigmas, rtol=0.1)


def test_refraction_is_found_without_site_and_times(camera, table):
    obs = sc.load_observations(table, camera)
    cal = sc.calibrate(obs, camera, effects="auto")
    assert "zenith" in cal.effects.names
    air = cal.effects.air
    assert air.kind == "moment"
    # A refraction fit with the altitudes in the names of the images gives a latitude of 52 degrees.
    assert abs(air.latitude_deg - 52.0) < 3.0 * air.latitude_std_deg
    assert air.latitude_std_deg < 3.0
    # The images' names state altitudes of 40 and 60 degrees.
    assert 25.0 < air.least_deg < 35.0
    assert 45.0 < air.most_deg < 55.0
    with_site = sc.load_observations(
        table, camera, columns={"ra_deg": "ra_apparent_deg", "dec_deg": "dec_apparent_deg"}
    ).with_meta(directions="apparent")
    f = sc.calibrate(with_site, camera, effects="auto").theta[2]
    assert abs(cal.theta[2] - f) < 3.0 * cal.sigmas[2]
    # Control: what knows no air is further away.
    plain = sc.calibrate(obs, camera)
    assert f - plain.theta[2] > 5.0 * plain.sigmas[2]


@pytest.fixture(scope="module")
def seen(camera, table):
    """All frames at the time in the images' names, and no site."""
    return ground.seen(table, camera, "2019-07-29T20:47:26")


@pytest.mark.slow
def test_each_frame_is_predicted_from_the_others(camera, seen):
    chi2, dof, density = np.sum(ground.left_out(seen, camera, "auto"), axis=0)
    assert abs(chi2 / dof - 1.0) < 0.25
    # Control: a camera without effects calls air noise, so that its chi-square is right as well,
    # but it predicts worse.
    _, _, plain = np.sum(ground.left_out(seen, camera, "none"), axis=0)
    assert density > plain + 50.0


@pytest.mark.slow
def test_attitudes_by_two_usable_models_agree_within_their_errors(camera, seen):
    levels, found = ground.attitudes(seen, camera)
    assert Level.FAIL not in levels
    for rest, stated in found.values():
        assert np.all(rest < 2.0 * stated)
    # Control: a lens without distortion is not usable, and its attitudes are further away.
    levels, found = ground.attitudes(seen, camera, (ground.MODELS[0], ("none", "none")))
    assert levels[1] is Level.FAIL
    rest, stated = found["effects"]
    assert np.any(rest > 2.0 * stated)
