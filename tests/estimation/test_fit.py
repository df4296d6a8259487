"""Calibration: every solver on every scene, statuses, results that save themselves."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from tests.helpers.scenes import USUAL, camera, nominal, observations, with_sigmas


@pytest.mark.parametrize("model", (*USUAL, "thin_prism+axes", "fisheye"))
def test_solvers_agree_on_every_model(model):
    truth, obs = camera(model), observations(model, max_mag=6.5)
    cal = sc.calibrate(obs, nominal(truth))
    assert cal.status is Status.CONVERGED
    z = (cal.theta - truth.theta) / cal.sigmas
    assert np.max(np.abs(z)) < 4.0
    assert cal.sigma == pytest.approx(0.05, rel=0.1)
    for solver in ("minpack", "ipopt") if model in ("brown", "inverse") else ():
        other = sc.calibrate(obs, nominal(truth), solver=solver)
        assert other.status is Status.CONVERGED
        assert np.max(np.abs(other.pair_theta - cal.pair_theta) / cal.sigmas) < 1e-4
        assert np.max(np.abs(other.theta - cal.theta) / cal.sigmas) < 1e-5


def test_three_stages_as_the_paper_describes_them():
    obs = observations(n_frames=300)
    cal = sc.calibrate(obs, sc.paper.paper_start(), method="three_stage")
    assert [stage.name for stage in cal.stages] == ["optics", "distortion", "all"]
    optics, linear, joint = cal.stages
    assert np.array_equal(optics.trajectory[0], [512.0, 512.0, 6000.0, 0.0, 0.0])
    assert (optics.trajectory[:, 3:] == 0.0).all()
    assert np.array_equal(linear.trajectory[0, :3], optics.theta[:3])
    assert np.array_equal(joint.trajectory[0], linear.theta)
    for stage in (optics, joint):
        # Each step lowers the cost, down to where the cost itself is rounding.
        assert (np.diff(stage.cost) <= 1e-10 * stage.cost[:-1]).all()
    assert np.array_equal(cal.theta, cal.pair_theta)
    assert np.array_equal(cal.covariance, cal.pair_covariance)
    efficient = sc.calibrate(obs, sc.paper.paper_start())
    assert [stage.name for stage in efficient.stages] == [
        "optics",
        "distortion",
        "all",
        "refinement",
    ]
    # The Cramer-Rao bound of the paper's 1000 frames, which another path found.
    bound = np.sqrt(1000.0 / 300.0) * np.array([0.14, 0.14, 0.026, 0.36e-10, 0.068e-15])
    assert np.allclose(efficient.sigmas, bound, rtol=0.1)
    # The paper's estimator pays for weighting pairs alike.
    assert (cal.sigmas > efficient.sigmas).all()


def test_residuals_and_attitudes_are_those_of_the_estimate():
    obs = observations()
    cal = sc.calibrate(obs, sc.paper.paper_start())
    from starcal_uq.attitude.rotations import quaternion_to_rotation

    rotations = np.repeat(quaternion_to_rotation(cal.quaternions), obs.stars_per_frame, axis=0)
    b = np.einsum("nij,nj->ni", rotations, obs.directions_icrs)
    assert np.max(np.abs(obs.xy - sc.camera.project(cal.camera, b) - cal.residuals_px)) < 1e-8
    assert cal.chi2 == pytest.approx(np.sum(cal.residuals_px**2), rel=1e-9)
    assert cal.dof == 2 * obs.n_stars - 3 * obs.n_frames - 5
    assert cal.sigma == pytest.approx(np.sqrt(cal.chi2 / cal.dof), rel=1e-6)
    assert np.allclose(cal.correlation.diagonal(), 1.0)


@pytest.mark.slow
def test_stated_noise_is_used():
    """Stars with large stated noise must count less."""
    clean = observations(n_frames=60, sigma_px=0.0)
    errors, claimed, unweighted = [], [], []
    for seed in range(25):
        obs = with_sigmas(clean, seed)
        cal = sc.calibrate(obs, sc.paper.paper_start())
        errors.append(cal.theta - camera().theta)
        claimed.append(cal.sigmas)
        # These hardly change from seed to seed: five give their mean.
        if seed < 5:
            unweighted.append(
                sc.calibrate(dataclasses.replace(obs, sigma_px=None), sc.paper.paper_start()).sigmas
            )
    assert (np.mean(claimed, axis=0) < 0.65 * np.mean(unweighted, axis=0)).all()
    ratio = np.std(errors, axis=0) / np.mean(claimed, axis=0)
    bound = 4.0 / np.sqrt(2 * 25)
    assert np.allclose(ratio, 1.0, atol=bound)
    # Control: the unweighted sigmas would not pass for the spread of the weighted estimates.
    assert not np.allclose(np.std(errors, axis=0) / np.mean(unweighted, axis=0), 1.0, atol=0.1)


def test_data_without_noise_give_the_truth():
    cal = sc.calibrate(observations(sigma_px=0.0), sc.paper.paper_start())
    assert cal.status is Status.CONVERGED
    assert np.allclose(cal.theta[:3], camera().theta[:3], rtol=0, atol=1e-9)
    assert np.allclose(cal.theta[3:], camera().theta[3:], rtol=1e-8)


def test_mirrored_axes_are_not_called_a_calibration():
    """Interstar angles cannot see a mirror; the attitude fit can."""
    obs = observations()
    mirrored = dataclasses.replace(obs, y_px=1023.0 - obs.y_px)
    with pytest.raises(CalibrationError) as caught:
        sc.calibrate(mirrored, sc.paper.paper_start())
    assert caught.value.status is Status.INCONSISTENT


@pytest.mark.slow
def test_random_starts_reach_one_optimum():
    """Principal point anywhere within 15 % of the width of the centre, focal length within 10 %."""
    obs = observations(n_frames=25)
    reference = sc.calibrate(obs, sc.paper.paper_start())
    rng = np.random.default_rng(8)
    failures, worst = 0, 0.0
    for _ in range(60):
        x, y = 511.5 + rng.uniform(-0.15, 0.15, 2) * 1024
        start = sc.paper.paper_start().replace(
            x0_px=x, y0_px=y, focal_mm=sc.paper.paper_camera().focal_mm * rng.uniform(0.9, 1.1)
        )
        cal = sc.calibrate(obs, start, throw=False)
        if cal.status.ok:
            worst = max(worst, float(np.max(np.abs(cal.theta - reference.theta) / cal.sigmas)))
        else:
            failures += 1
    assert worst < 1e-6
    assert failures == 0


def test_intervals_without_sampling_are_students_and_stand_in_the_table():
    obs = observations(n_frames=60).select_frames(range(3))
    cal = sc.calibrate(obs, sc.paper.paper_start())
    half = stats.t.ppf(0.975, cal.dof) * cal.sigmas
    assert cal.interval() == pytest.approx(np.stack([cal.theta - half, cal.theta + half], axis=1))
    assert half[0] > 1.01 * 1.96 * cal.sigmas[0], "the normal interval, the control, is shorter"
    low, high = cal.sigma_interval()
    assert stats.chi2.cdf(
        cal.dof * cal.sigma**2 / np.array([high, low]) ** 2, cal.dof
    ) == pytest.approx([0.025, 0.975])
    table = cal.to_dataframe()
    assert (
        table["low"].to_numpy()[:5] == pytest.approx(cal.interval()[:, 0])
        and table["high"].iloc[-1] == high
    )
