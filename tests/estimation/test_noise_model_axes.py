"""Noise that differs between the axes of the detector."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.records import from_plain
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.misfit import misfit_tests
from starcal_uq.diagnostics.shape_sums import ShapeSums
from starcal_uq.diagnostics.verdict.estimate import even_noise
from starcal_uq.estimation.merging import merge
from starcal_uq.estimation.noise_model import axis_noise
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.likelihood.shapes import View, shapes
from starcal_uq.planning.information import random_frames
from starcal_uq.simulation.frames import Tracker
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.outside import Campaign, attitude_errors, campaign

SMEARED = np.array([[0.12**2, 0.0], [0.0, 0.03**2]])
TURNED = np.array([[0.08**2, 0.6 * 0.08 * 0.05], [0.6 * 0.08 * 0.05, 0.05**2]])
EVEN = 0.06**2 * np.eye(2)
SHORT = {"seed": 0, "n_ensembles": 2, "n_walkers": 16, "n_steps": 40}


def observed(covariance: np.ndarray, seed: int, n_frames: int = 20, **options) -> Campaign:
    """A campaign whose centroids err with a covariance (2, 2), px^2."""
    c = campaign(np.random.default_rng(seed), n_frames=n_frames, sigma_px=0.0, **options)
    rng = np.random.default_rng([seed, 1])
    noise = np.linalg.cholesky(covariance) @ rng.standard_normal((2, len(c.columns["frame"])))
    for name, error in zip(("x_px", "y_px"), noise, strict=True):
        c.columns[name] = c.columns[name] + error
    return c


def given(c: Campaign) -> tuple[sc.Observations, sc.Camera]:
    return sc.Observations(**c.columns), sc.Camera(**c.camera_toml())


def statistics(covariance: np.ndarray, n: int, **options) -> np.ndarray:
    """Normal statistics (n, 2) of the ratio of the axes and of their correlation."""
    found = []
    for seed in range(n):
        obs, camera = given(observed(covariance, seed, **options))
        cal = sc.calibrate(obs, camera)
        found.append(axis_noise(MarginalLikelihood(obs, "brown"), cal.theta).z())
    return np.array(found)


@pytest.mark.slow
def test_the_axes_of_even_noise_are_alike():
    """With six stars a frame, attitudes take half of the residuals, and not the same of x and y."""
    z = np.concatenate([statistics(EVEN, 12), statistics(EVEN, 12, n_frames=40, stars_per_frame=6)])
    assert np.all(np.abs(z.mean(axis=0)) < 3.0 / np.sqrt(len(z)))
    assert np.all(np.abs(z.std(axis=0) - 1.0) < 0.35)
    # Noise of 1.5 to 1 and a correlation of one half are hardly ever missed.
    assert np.all(statistics(np.diag([0.09**2, 0.06**2]), 3)[:, 0] > 3.0)
    assert np.all(statistics(EVEN + 0.5 * 0.06**2 * (1.0 - np.eye(2)), 3)[:, 1] > 3.0)


@pytest.mark.slow
def test_attitude_noise_is_that_of_the_axes():
    covariance = TURNED
    c = observed(covariance, 0, n_frames=60)
    obs, camera = given(c)
    true = np.sqrt(np.mean(attitude_errors(c, c.theta) ** 2, axis=0))
    by_noise = {}
    for effects in ("none", "noise"):
        cal = sc.calibrate(obs, camera, effects=effects)
        found = misfit_tests(obs, cal)
        by_noise[effects] = cal, found, sc.propagate(sc.sample(obs, cal, **SHORT), obs).nea_arcsec
    cal, found, stated = by_noise["noise"]
    # 60 frames tell a standard deviation to 9 %.
    assert np.all(np.abs(np.log(stated / true)) < 0.25)
    model = cal.noise_model
    ratio = np.sqrt(covariance[0, 0] / covariance[1, 1])
    assert model.axis_ratio == pytest.approx(ratio, rel=0.15)
    rho = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert model.axis_correlation == pytest.approx(rho, abs=0.1)
    assert np.linalg.det(model.axes) == pytest.approx(1.0)
    assert even_noise(found).level is Level.PASS
    # One noise for both axes is found to be wrong, and so is its attitude noise.
    common, found, stated = by_noise["none"]
    check = even_noise(found)
    assert (
        check.level is Level.WARN
        and "--effects noise" in check.remedy
        and "along x as along y" in check.sentence
    )
    assert np.max(np.abs(np.log(stated / true))) > 0.25
    # What differs is weighed: the same stars tell more.
    assert np.all(cal.sigmas < 0.9 * common.sigmas)


def test_axes_go_with_compressed_likelihoods_and_plans():
    c = observed(SMEARED, 2, n_frames=40)
    obs, camera = given(c)
    whole = sc.calibrate(obs, camera, effects="noise")
    halves = [
        sc.calibrate(obs.select_frames(ids), camera, effects="noise")
        for ids in (np.arange(20), np.arange(20, 40))
    ]
    merged = merge(halves)
    np.testing.assert_allclose(merged.sigmas, whole.sigmas, rtol=0.1)
    assert np.all(np.abs(merged.theta - whole.theta) < 0.5 * whole.sigmas)
    exact = sc.sample(obs, whole, **SHORT)
    assert exact.diagnostics.compressed_max_difference < 0.1
    # A plan with the fitted noise expects what stars with such axes tell.
    stars = load_catalogue(max_mag=6.0)
    model = whole.noise_model
    frames = random_frames(stars, Tracker(whole.camera, model, 8), n_frames=10, seed=0)
    alike = random_frames(stars, Tracker(whole.camera, model.level_px, 8), n_frames=10, seed=0)
    nea = [np.sqrt(np.einsum("kii->i", found.noise)[:2]) for found in (frames, alike)]
    # An error along x turns about y.
    assert nea[0][1] / nea[0][0] == pytest.approx(model.axis_ratio, rel=0.3)
    assert nea[1][1] / nea[1][0] == pytest.approx(1.0, rel=0.3)


def test_a_model_of_an_earlier_version_has_no_axes():
    obs, camera = given(observed(EVEN, 3))
    record = sc.calibrate(obs, camera, effects="noise").noise_model.record()
    older = {name: value for name, value in record.items() if not name.startswith("axis_")}
    assert from_plain(NoiseModel, older).axes is None


def test_shapes_are_whitened_as_their_residuals_are():
    """Sums over cells of the field are those of their columns."""
    obs, camera = given(observed(TURNED, 4))
    cal = sc.calibrate(obs, camera, effects="noise")
    obs, families = weighed(obs, cal), shapes(obs, cal.camera)
    part = MarginalLikelihood(obs, "brown")
    state, _ = part.profile(cal.theta)
    view = View.of(part, state, cal.theta, slice(None))
    cells = families[-1].columns(view)
    part.frames.whiten(cells)
    flat = part.project_out(state, cells).reshape(len(cells), -1)
    found = ShapeSums(obs, cal, families).gram[-len(cells) :, -len(cells) :]
    np.testing.assert_allclose(found, flat @ flat.T, atol=1e-9 * np.abs(flat @ flat.T).max())


@pytest.mark.slow
def test_misfit_tests_keep_their_size_with_fitted_axes():
    """Shapes along one axis alone meet the noise of that axis alone."""
    least = {"noise": [], "none": []}
    for seed in range(20):
        obs, camera = given(observed(SMEARED, seed))
        for effects, found in least.items():
            tests = misfit_tests(obs, sc.calibrate(obs, camera, effects=effects)).tests
            found.append([test.p_value for test in tests if not test.is_of_noise])
    rejected = {effects: np.mean(np.array(found) < 0.05) for effects, found in least.items()}
    assert rejected["noise"] < 0.09
    assert rejected["none"] > rejected["noise"]


@pytest.mark.slow
def test_intervals_with_fitted_axes_hold():
    inside, wrong = [], []
    for seed in range(40):
        c = observed(TURNED, seed)
        obs, camera = given(c)
        cal = sc.calibrate(obs, camera, effects="noise")
        low, high = cal.interval(0.95).T
        inside.append((low < c.theta) & (c.theta < high))
        # The control: intervals as narrow for the estimate that weighs both axes alike.
        error = np.abs(sc.calibrate(obs, camera).theta - c.theta)
        wrong.append(error < 0.5 * (high - low))
    assert 0.91 < np.mean(inside) < 0.985
    assert np.mean(wrong) < 0.9
