"""Rows of a sensor's rate and age, beside attitudes that NumPy solves from drawn centroids."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.budgeting.file import load_budget_file
from starcal_uq.budgeting.tracker import noise_covariance, sensor_rows
from starcal_uq.core.errors import BudgetError
from starcal_uq.simulation.sensor import Sensor
from tests.helpers.pinhole import ARCSEC, FOCAL_PX, attitude_variance, directions
from tests.helpers.scenes import observations

SHEET = sc.Camera(1024, 1024, 10.0, 36.0, 511.5, 511.5, "none", ())
WORN = Sensor(
    rate_deg_s=0.5,
    age_years=10.0,
    transmission_loss_per_year=0.03,
    dark_growth_e_px_s=100.0,
)


def frames() -> sc.Observations:
    stars = sc.load_catalogue(max_mag=5.5, epoch=2026.9)
    return sc.simulate(stars, SHEET, n_frames=100, min_stars=5, max_stars=12, sigma_px=0.0, seed=1)


def in_camera(seen: sc.Observations) -> np.ndarray:
    x, y = (seen.x_px - 511.5) / FOCAL_PX, (seen.y_px - 511.5) / FOCAL_PX
    b = np.stack([x, y, np.ones(len(x))], axis=1)
    return b / np.linalg.norm(b, axis=1, keepdims=True)


def nea(sensor: Sensor, seen: sc.Observations) -> np.ndarray:
    """Noise-equivalent angles (3,) of attitudes that Wahba's problem gives for drawn centroids,
    arcsec.
    """
    rng = np.random.default_rng(2)
    sigma = sensor.noise(SHEET)(seen.mag)
    b, errors = in_camera(seen), []
    for frame in range(seen.n_frames):
        own = slice(*seen.frame_starts[frame : frame + 2])
        for _ in range(40):
            moved = b[own] / b[own, 2:]
            moved[:, :2] += sigma[own, None] * rng.standard_normal((len(moved), 2)) / FOCAL_PX
            moved /= np.linalg.norm(moved, axis=1, keepdims=True)
            u, _, vt = np.linalg.svd((moved / sigma[own, None] ** 2).T @ b[own])
            turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            errors.append([turn[2, 1], turn[0, 2], turn[1, 0]])
    return ARCSEC * np.sqrt(np.mean(np.square(errors), axis=0))


def test_rows_add_up_to_the_scatter_of_attitudes() -> None:
    seen = frames()
    still, moving = WORN.replace(rate_deg_s=0.0, age_years=0.0), WORN.replace(age_years=0.0)
    rows = sensor_rows(WORN, SHEET, seen)
    sigma = {
        name: np.array([row.sigma_arcsec for row in rows if row.name == name])
        for name in ("motion during exposure", "end-of-life noise")
    }
    base = np.diag(noise_covariance(still, SHEET, seen))
    total = np.sqrt(base + sum(value**2 for value in sigma.values()))
    # 4000 attitudes know their scatter to 1.1 %.
    assert total == pytest.approx(nea(WORN, seen), rel=0.04)
    assert np.sqrt(base) == pytest.approx(nea(still, seen), rel=0.04)
    assert np.hypot(np.sqrt(base), sigma["motion during exposure"]) == pytest.approx(
        nea(moving, seen), rel=0.04
    )
    # Control: without the row of the age it would not be the scatter.
    assert np.all(np.hypot(np.sqrt(base), sigma["motion during exposure"]) < 0.9 * total)


def test_the_noise_is_that_of_a_pinholes_geometry() -> None:
    seen = frames()
    r = directions(seen.ra_deg, seen.dec_deg)
    assert r.shape == (seen.n_stars, 3)
    sigma, b = WORN.noise(SHEET)(seen.mag), in_camera(seen)
    ends = zip(seen.frame_starts[:-1], seen.frame_starts[1:], strict=True)
    wanted = np.mean([attitude_variance(b[i:j], sigma[i:j]) for i, j in ends], axis=0)
    assert np.diag(noise_covariance(WORN, SHEET, seen)) == pytest.approx(
        ARCSEC**2 * wanted, rel=1e-6
    )


def test_a_sensor_at_rest_and_new_fills_no_row() -> None:
    assert sensor_rows(Sensor(), SHEET, frames()) == ()
    rows = sensor_rows(WORN.replace(rate_deg_s=0.0), SHEET, frames())
    assert {row.name for row in rows} == {"end-of-life noise"}


def test_frames_without_magnitudes_are_refused() -> None:
    from dataclasses import replace

    with pytest.raises(BudgetError):
        sensor_rows(WORN, SHEET, replace(frames(), mag=None))


def test_a_budget_file_names_its_sensor(tmp_path: Path) -> None:
    WORN.save(tmp_path / "sensor.toml")
    path = tmp_path / "budget.toml"
    path.write_text('[budget]\nsensor = "sensor.toml"\nrate_deg_s = 1.0\n')
    obs = observations()
    cal = sc.calibrate(obs, sc.paper.paper_start())
    post = sc.sample(obs, cal, n_steps=20, n_ensembles=2, seed=1)
    attitude = sc.propagate(post, obs, n_draws=50)
    made = sc.budget(post, obs, attitude, file=path, n_samples=10_000)
    found = {(row.name, row.axis): row for row in made.rows}
    assert all(
        found[name, axis].source == "file" and found[name, axis].sigma_arcsec > 0.0
        for name in ("motion during exposure", "end-of-life noise")
        for axis in ("pitch", "yaw", "roll")
    )
    # The rate of the budget goes before that of the sensor, and a stated row before both.
    assert "at 1 degrees per second" in found["motion during exposure", "pitch"].conditions
    with path.open("a") as file:
        file.write(
            '[[contributor]]\nname = "end-of-life noise"\naxis = "all"\nsigma_arcsec = 7.0\n'
            'provenance = "test"\n'
        )
    made = sc.budget(post, obs, attitude, file=path, n_samples=10_000)
    found = {(row.name, row.axis): row for row in made.rows}
    assert found["end-of-life noise", "roll"].sigma_arcsec == 7.0
    (tmp_path / "sensor.toml").write_text("[sensor]\nage_years = -1\n")
    with pytest.raises(BudgetError, match=r"key sensor: .*age_years is -1; write"):
        load_budget_file(path)
