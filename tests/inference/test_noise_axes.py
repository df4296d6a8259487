"""What is made of the draws knows the noise of each axis as the likelihood does."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.estimation.weights import weighed
from starcal_uq.inference.groups import LOG_LIKELIHOOD, arviz_data
from starcal_uq.inference.named import find_source, resolved_dof
from tests.helpers.outside import campaign

SHORT = {"seed": 0, "n_ensembles": 2, "n_walkers": 16, "n_steps": 40}


def smeared(tails: bool) -> tuple[sc.Observations, sc.Camera]:
    """Twenty frames whose centroids err four times as much along x."""
    c = campaign(np.random.default_rng(3), n_frames=20, sigma_px=0.0)
    rng, n = np.random.default_rng(4), len(c.columns["frame"])
    scale = np.sqrt(5.0 / rng.chisquare(5.0, n)) if tails else 1.0
    for name, sigma in (("x_px", 0.12), ("y_px", 0.03)):
        c.columns[name] = c.columns[name] + sigma * scale * rng.standard_normal(n)
    return sc.Observations(**c.columns), sc.Camera(**c.camera_toml())


@pytest.fixture(scope="module")
def gaussian() -> tuple[sc.Observations, sc.Calibration]:
    obs, camera = smeared(tails=False)
    cal = sc.calibrate(obs, camera, effects="noise")
    assert cal.fitted_noise is not None and cal.fitted_noise.axis_ratio > 2.0
    return obs, cal


def test_densities_of_frames_add_up_to_the_likelihood(gaussian):
    obs, cal = gaussian
    post = sc.sample(obs, cal, **SHORT)
    data = arviz_data(post, obs, groups=["log_likelihood"], n_draws=12)
    sums = np.asarray(data["log_likelihood"][LOG_LIKELIHOOD]).sum(axis=-1).ravel()
    per_chain = post.n_walkers * post.n_steps
    places = (np.arange(2)[:, None] * per_chain + np.arange(6) * per_chain // 6).ravel()
    draws = post.draws[places]
    wanted = cal.log_likelihood(draws[:, :-1], draws[:, -1])
    np.testing.assert_allclose(sums - sums[0], wanted - wanted[0], atol=0.05)


def test_drawn_images_scatter_along_each_axis_as_the_data_do(gaussian):
    obs, cal = gaussian
    post = sc.sample(obs, cal, **SHORT)
    data = arviz_data(post, obs, groups=["observed_data", "posterior_predictive"], n_draws=40)
    spread = {
        (group, axis): float(np.std(np.asarray(data[group][f"residual_{axis}_px"])))
        for group in ("observed_data", "posterior_predictive")
        for axis in "xy"
    }
    for axis in "xy":
        ratio = spread["posterior_predictive", axis] / spread["observed_data", axis]
        assert 0.8 < ratio < 1.25


def test_tails_have_their_maximum_at_the_estimate():
    obs, camera = smeared(tails=True)
    cal = sc.calibrate(obs, camera, effects=["noise", "tails"])
    assert cal.fitted_noise is not None and cal.fitted_noise.axis_ratio > 2.0
    source = find_source("student_t", weighed(obs, cal), cal, resolved_dof(cal, None))
    assert np.max(np.abs(source.theta - cal.theta) / cal.sigmas) < 0.01
    sigmas = np.sqrt(np.diag(np.linalg.inv(source.information)))
    np.testing.assert_allclose(sigmas, cal.sigmas, rtol=0.01)
