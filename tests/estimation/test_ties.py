"""Known rotations between frames, by a simulator of NumPy alone: covered, found wrong, refused."""

from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from tests.helpers.effects import sheet, table
from tests.helpers.outside import Campaign, campaign
from tests.helpers.ties import gyro, known_of, stare

N = 30


def observed(seed: int, arcsec: float = 1.0) -> tuple[Campaign, dict[str, np.ndarray]]:
    """A chain of frames, and the rotations that a gyro measured."""
    rng = np.random.default_rng(seed)
    c = campaign(rng, n_frames=N)
    return c, gyro(rng, c, arcsec)


def on_a_mount(seed: int, arcsec: float = 1.0) -> tuple[Campaign, sc.Observations]:
    """Frames that the Earth turns, five minutes apart, with their times."""
    rng = np.random.default_rng(seed)
    path, times = stare(rng, N, 5.0, 40.0, arcsec)
    c = campaign(rng, n_frames=N, path=path)
    return c, table(c, time_utc=times[c.columns["frame"]])


def test_a_gyro_tells_the_principal_point_from_the_boresight() -> None:
    c, columns = observed(1)
    plain = sc.calibrate(table(c), sheet(c))
    cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known_of(columns))
    np.testing.assert_array_equal(cal.ties.sigmas_without, plain.sigmas)
    assert np.all(cal.sigmas[:2] < 0.03 * plain.sigmas[:2])
    assert np.all(np.abs(cal.theta - c.theta) < 4.0 * cal.sigmas)
    assert cal.dof == plain.dof + 3 * (N - 1)
    assert cal.ties.p_value > 0.001
    # Attitudes are as good as the point: 1 arcsec is 0.02 px here, and the free ones err by 0.3 px.
    assert np.abs(cal.residuals_px).max() < 0.3


def test_rotations_that_contradict_the_stars_are_found() -> None:
    c, columns = observed(2, 5.0)
    cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known_of(columns, 0.2))
    assert cal.ties.p_value < 1e-6
    assert cal.ties.error_factor == pytest.approx(5.0, rel=0.25)
    again = sc.calibrate(
        table(c), sheet(c), relative_attitudes=cal.ties.known.scaled(cal.ties.error_factor)
    )
    assert again.ties.p_value > 0.1


def test_axes_that_are_not_known_in_the_camera_tell_no_principal_point() -> None:
    c, columns = observed(3)
    plain = sc.calibrate(table(c), sheet(c))
    known = replace(known_of(columns), alignment_arcsec=60.0)
    cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known)
    assert np.all(cal.sigmas[:2] > 0.8 * plain.sigmas[:2])


def test_a_fixed_mount_leaves_the_common_rotation_free() -> None:
    c, obs = on_a_mount(4)
    plain = sc.calibrate(obs, sheet(c))
    cal = sc.calibrate(obs, sheet(c), mount="fixed", mount_sigma_arcsec=1.0)
    assert cal.dof == plain.dof + 3 * (N - 1)
    assert cal.ties.p_value > 0.001
    assert np.all(cal.sigmas[:3] < plain.sigmas[:3])
    assert np.all(cal.sigmas[:2] > 0.8 * plain.sigmas[:2])
    # Control: the Earth does not turn at once by as much as from frame to frame.
    at_once = table(c, time_utc=np.full(len(obs), obs.time_utc[0]))
    with pytest.raises(CalibrationError, match="a fixed mount contradicts the stars"):
        sc.calibrate(at_once, sheet(c), mount="fixed", mount_sigma_arcsec=1.0)


def test_a_narrow_field_whose_point_the_stars_leave_open_is_determined() -> None:
    rng = np.random.default_rng(5)
    c = campaign(rng, n_frames=10, field_deg=0.5, corner_px=(0.0, 0.0))
    camera = sheet(c).replace(distortion="none")
    with pytest.raises(CalibrationError, match="x0 and y0"):
        sc.calibrate(table(c), camera)
    cal = sc.calibrate(table(c), camera, relative_attitudes=known_of(gyro(rng, c, 1.0)))
    assert cal.status.ok
    assert np.all(np.abs(cal.theta - c.theta[:3]) < 4.0 * cal.sigmas)
    assert np.all(cal.sigmas[:2] < 1.0)
    # Around the point that the stars alone give, hundreds of pixels away, nothing is linear.
    assert cal.ties.p_value > 0.001
    assert sc.diagnose(table(c), cal, models=(), n_starts=2).starts is None


def test_a_calibration_with_ties_is_sampled() -> None:
    c, columns = observed(6, 10.0)
    cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known_of(columns))
    post = sc.sample(table(c), cal, seed=1)
    assert post.diagnostics.likelihood_used == "compressed"
    assert post.diagnostics.compressed_max_difference < 0.01
    np.testing.assert_allclose(post.theta_draws.std(axis=0), cal.sigmas, rtol=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(("arcsec", "first"), [(1.0, 1000), (10.0, 2000)])
def test_intervals_of_a_chain_cover(arcsec: float, first: int) -> None:
    z, chi2 = [], []
    for seed in range(30):
        c, columns = observed(first + seed, arcsec)
        cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known_of(columns))
        z.append((cal.theta - c.theta) / cal.sigmas)
        chi2.append(cal.ties.chi2 / cal.ties.dof)
    covered = np.mean(np.abs(z) < 1.96, axis=0)
    print("covered", covered, "rms", np.sqrt(np.mean(np.square(z), axis=0)), np.mean(chi2))
    # 60 intervals of x0 and y0: 0.95 with a standard deviation of 0.028; the others go together.
    assert 0.88 <= covered[:2].mean() <= 0.99
    assert 0.85 <= covered[2:].mean() <= 1.0
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_intervals_of_a_chain_with_errors_five_times_the_stated_do_not_cover() -> None:
    z, found = [], []
    for seed in range(12):
        c, columns = observed(300 + seed, 5.0)
        cal = sc.calibrate(table(c), sheet(c), relative_attitudes=known_of(columns, 0.2))
        z.append((cal.theta - c.theta)[:2] / cal.sigmas[:2])
        found.append(cal.ties.p_value < 0.001)
    assert np.all(found)
    assert np.mean(np.abs(z) < 1.96) < 0.75


@pytest.mark.slow
def test_intervals_on_a_fixed_mount_cover() -> None:
    z = []
    for seed in range(20):
        c, obs = on_a_mount(500 + seed)
        cal = sc.calibrate(obs, sheet(c), mount="fixed", mount_sigma_arcsec=1.0)
        z.append((cal.theta - c.theta) / cal.sigmas)
    covered = np.mean(np.abs(z) < 1.96, axis=0)
    print("covered", covered, "rms", np.sqrt(np.mean(np.square(z), axis=0)))
    assert covered.mean() > 0.88 and np.sqrt(np.mean(np.square(z))) > 0.75
