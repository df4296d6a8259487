"""Noise beyond what the stars state: found where it is, and not where it is not."""

from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.calibration.noise_floor import (
    LEAST_P_VALUE,
    noise_floor,
    settle_noise,
    with_noise_floor,
)
from starcal_uq.estimation.outliers import star_residuals
from starcal_uq.observations.frames import StarFrames
from tests.helpers.scenes import camera, nominal, observations


def measured(
    floor_px: float, scale: float = 1.0, seed: int = 0, n_frames: int = 40
) -> sc.Observations:
    """Stars that state from 0.005 to 0.3 px, with that noise, times `scale`, and a floor."""
    obs = observations(n_frames=n_frames, seed=5, sigma_px=1e-9)
    rng = np.random.default_rng(seed)
    stated = np.exp(rng.uniform(np.log(0.005), np.log(0.3), obs.n_stars))
    noise = np.hypot(scale * stated, floor_px)
    x, y = rng.standard_normal((2, obs.n_stars)) * noise
    return replace(obs, x_px=obs.x_px + x, y_px=obs.y_px + y, sigma_px=stated)


@pytest.mark.parametrize(("floor_px", "scale"), [(0.04, 1.0), (0.02, 1.3), (0.1, 1.0)])
def test_floor_and_scale_are_found(floor_px: float, scale: float) -> None:
    settled = settle_noise(obs := measured(floor_px, scale), sc.calibrate(obs, nominal(camera())))
    assert settled.meta["noise_floor_px"] == pytest.approx(floor_px, rel=0.1)
    cal = sc.calibrate(settled, nominal(camera()))
    assert cal.sigma == pytest.approx(scale, rel=0.06)
    # Bright stars now scatter as they state; without the floor they do not.
    assert _pulls(cal, settled, bright := obs.sigma_px < 0.02) == pytest.approx(1.0, abs=0.25)
    assert _pulls(sc.calibrate(obs, nominal(camera())), obs, bright) > 1.5


def test_noise_below_the_floor_is_not_blown_up() -> None:
    """Where stars state far too much, as of JPEG images, the noise is the scatter seen."""
    settled = settle_noise(obs := measured(0.2, 0.05), sc.calibrate(obs, nominal(camera())))
    assert np.median(settled.sigma_px) == pytest.approx(0.2, rel=0.05)
    assert sc.calibrate(settled, nominal(camera())).sigma == pytest.approx(1.0, abs=0.03)


def _pulls(cal: sc.Calibration, obs: sc.Observations, chosen: np.ndarray) -> float:
    """Mean squared deleted residual of some stars over what the calibration expects."""
    found = star_residuals(
        StarFrames.from_observations(obs), "brown", cal.theta, np.ones(obs.n_stars, bool)
    )
    return float(np.mean(found.t[chosen]) / (2.0 * cal.sigma**2))


@pytest.mark.slow
def test_errors_are_what_the_covariance_says_once_the_floor_is_known() -> None:
    truth, with_floor, without = camera().theta, [], []
    for seed in range(40):
        obs = measured(0.04, seed=seed, n_frames=30)
        plain = sc.calibrate(obs, nominal(camera()))
        settled = sc.calibrate(settle_noise(obs, plain), nominal(camera()))
        for cal, squares in ((settled, with_floor), (plain, without)):
            off = cal.theta - truth
            squares.append(off @ np.linalg.solve(cal.covariance, off) / len(off))
    # 200 squared errors: one sigma of their mean is 10 %. The control is the same stars
    # without a floor.
    assert np.mean(with_floor) == pytest.approx(1.0, abs=0.25)
    assert np.mean(without) > 2.0


def test_noise_as_stated_has_no_floor() -> None:
    p_values = []
    for seed in range(40):
        obs = measured(0.0, 1.2, seed, n_frames=12)
        p_values.append(noise_floor(sc.calibrate(obs, nominal(camera())), obs).p_value)
    # Half of the likelihood ratios are zero, and the others a chi-square: small p-values are as
    # rare as they say.
    assert np.mean(np.array(p_values) < 0.1) < 0.25
    assert min(p_values) > LEAST_P_VALUE
    assert np.mean(np.array(p_values) == 1.0) > 0.2


def test_wrong_stars_make_no_floor() -> None:
    obs = measured(0.0, n_frames=40)
    # As far off as the gate of the identification lets pass.
    wrong = replace(
        obs,
        x_px=np.where(np.arange(obs.n_stars) % 40 == 0, obs.x_px + 7.0 * obs.sigma_px, obs.x_px),
    )
    assert not noise_floor(sc.calibrate(wrong, nominal(camera())), wrong).needed


def test_what_is_not_needed_changes_nothing() -> None:
    obs = measured(0.0)
    cal = sc.calibrate(obs, nominal(camera()))
    assert settle_noise(obs, cal) is obs
    found = noise_floor(cal, obs)
    assert with_noise_floor(obs, found) is obs
    assert "no noise beyond" in str(found)
    assert "0.050 px" in str(replace(found, floor_px=0.05, p_value=1e-9))


def test_unstated_noise_is_refused() -> None:
    obs = replace(observations(n_frames=12), sigma_px=None)
    with pytest.raises(sc.errors.CalibrationError):
        noise_floor(sc.calibrate(obs, nominal(camera())), obs)
