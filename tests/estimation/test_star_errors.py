"""Errors of the stars in the covariance: the algebra against dense matrices, the estimate against
its truth.
"""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.errors import CalibrationError, SamplingError
from starcal_uq.likelihood.compressed import compress
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import StarErrors, StarLikelihood, StarModel, sky_axes
from starcal_uq.likelihood.terms import Eliminated, TermSums
from tests.helpers.outside import campaign


def observed(seed, star_sigma_px=0.03, n_frames=60, **options):
    """Frames on one patch of forty stars, and the data sheet."""
    options = {"patch_stars": 40, "star_sigma_px": star_sigma_px} | options
    c = campaign(np.random.default_rng([seed, 5]), n_frames=n_frames, **options)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    return c, obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))


@pytest.fixture(scope="module")
def made():
    c, obs, camera = observed(1)
    return c, obs, camera, sc.calibrate(obs, camera), sc.calibrate(obs, camera, star_errors=True)


def dense(obs, cal, model, ratio):
    """Residuals (2 N,) and their weight W (2 N, 2 N) in units of sigma^-2, attitudes integrated
    out, as written.
    """
    likelihood = MarginalLikelihood(obs, cal.camera.distortion)
    state, _ = likelihood.profile(cal.theta, quaternion_to_rotation(cal.quaternions))
    n, s = obs.n_stars, len(model.images)
    z, a = np.zeros((2, n, 2 * s)), np.zeros((2, n, 3 * obs.n_frames))
    frame = np.searchsorted(obs.frame_ids, obs.frame)
    # Derivatives by finite turns of the directions and of the camera, without the columns under
    # test.
    axes = sky_axes(model.directions, model.numbers)
    for i in range(2):
        step = 1e-7
        turned = np.einsum("nij,jn->in", state.rotations[frame], axes[i])
        z[:, np.arange(n), 2 * model.numbers + i] = (
            (
                sc.camera.project(cal.camera, (state.b + step * turned).T).T
                - sc.camera.project(cal.camera, state.b.T).T
            )
            / step
            / model.focal_px
        )
    for i in range(3):
        a[:, np.arange(n), 3 * frame + i] = state.attitude[i]
    z, a = z.reshape(2 * n, -1), a.reshape(2 * n, -1)
    v = np.linalg.inv(np.eye(2 * n) + z * ratio @ z.T)
    return state.e.ravel(), v - v @ a @ np.linalg.solve(a.T @ v @ a, a.T @ v)


def test_products_are_those_of_the_covariance_as_written():
    _, obs, camera = observed(4, n_frames=12, stars_per_frame=8)
    cal = sc.calibrate(obs, camera)
    model = StarModel(obs, cal.theta[2])
    ratio = model.ratio(0.03**2, 0.05)
    e, w = dense(obs, cal, model, ratio)
    likelihood = MarginalLikelihood(obs, "brown")
    rotations = quaternion_to_rotation(cal.quaternions)
    found = compress(likelihood, cal.theta, cal.covariance, rotations, model.term(0.03), 0.05)
    assert found.gram[0, 0] == pytest.approx(e @ w @ e, rel=1e-6)
    # The control: star errors matter here.
    assert found.gram[0, 0] < 0.9 * e @ e
    errors = StarErrors(0.03, 0.0, 0.0, cal.theta[2], 0, 0)
    exact = StarLikelihood(obs, "brown", cal.theta, rotations, errors, 0.05)
    assert exact.log_likelihood(cal.theta, 0.05) == pytest.approx(
        float(found.log_likelihood(cal.theta[None], 0.05)[0]), abs=1e-6
    )


def test_either_side_can_be_eliminated():
    _, obs, camera = observed(4, n_frames=20, stars_per_frame=8)
    cal = sc.calibrate(obs, camera)
    likelihood, model = MarginalLikelihood(obs, "brown"), StarModel(obs, cal.theta[2])
    state, _ = likelihood.profile(cal.theta)
    sums, ratio = TermSums(model.term()), model.ratio(0.03**2, 0.05)
    sums.add(likelihood, state, likelihood.project_out(state, state.e[None]), slice(None))
    ways = []
    for by_star in (True, False):
        solved = Eliminated(sums, ratio, by_star)
        ways.append((float(solved.correction()[0, 0]), solved.log_determinant))
    assert ways[0] == pytest.approx(ways[1], rel=1e-9)
    g = np.eye(len(ratio)) + ratio[:, None] * sums.matrix.toarray()
    assert ways[0][1] == pytest.approx(np.linalg.slogdet(g)[1], rel=1e-9)


def test_the_scale_is_found_and_the_intervals_grow(made):
    c, _, _, plain, cal = made
    errors = cal.star_errors
    assert errors is not None
    assert abs(errors.tau_px - 0.03) < 3.0 * errors.tau_px_std < 0.02
    assert cal.sigma == pytest.approx(0.05, rel=0.07)
    # The estimate is another one as well, which has less to bear than the plain one.
    assert np.max(cal.sigmas / plain.sigmas) > 1.15
    assert np.max(np.abs(cal.theta - c.theta) / cal.sigmas) < 3.5
    # A frame of a mission has stars with errors, too.
    ratio = np.sqrt(np.trace(cal.attitude_noise) / np.trace(plain.attitude_noise))
    assert ratio == pytest.approx(np.hypot(cal.sigma, errors.tau_px) / plain.sigma, rel=0.01)


def test_without_errors_nothing_changes():
    _, obs, camera = observed(1, star_sigma_px=0.0)
    plain, cal = sc.calibrate(obs, camera), sc.calibrate(obs, camera, star_errors=True)
    assert cal.star_errors.tau_px < 0.006
    assert cal.sigmas == pytest.approx(plain.sigmas, rel=0.1)


def test_compressed_and_exact_agree_and_the_record_is_kept(made, tmp_path):
    _, obs, _, _, cal = made
    exact = StarLikelihood(
        obs, "brown", cal.theta, quaternion_to_rotation(cal.quaternions), cal.star_errors, cal.sigma
    )
    rng = np.random.default_rng(0)
    theta = (
        cal.theta
        + rng.standard_normal((12, 5)) @ np.linalg.cholesky(cal.correlation).T * cal.sigmas
    )
    difference = [exact.log_likelihood(t, 0.05) for t in theta] - cal.compressed.log_likelihood(
        theta, 0.05
    )
    assert np.ptp(difference) < 0.02
    # The control: the likelihood that knows of no stars.
    plain = MarginalLikelihood(obs, "brown")
    assert (
        np.ptp(
            [plain.log_likelihood(t, 0.05) for t in theta]
            - cal.compressed.log_likelihood(theta, 0.05)
        )
        > 1.0
    )
    cal.save(tmp_path / "calibration.json")
    assert sc.Calibration.load(tmp_path / "calibration.json").star_errors == cal.star_errors


def test_stated_errors_are_taken_and_only_the_rest_is_estimated(made):
    c, obs, camera, _, cal = made
    mas = np.full(obs.n_stars, 1e3 * np.degrees(0.03 / c.theta[2]) * 3600.0)
    stated = sc.calibrate(sc.Observations(**c.columns, direction_mas=mas), camera, star_errors=True)
    assert stated.star_errors.stated_px == pytest.approx(0.03, rel=0.01)
    assert stated.star_errors.tau_px < 0.02
    # The total is what is estimated without being told, as far as 40 stars can say.
    assert stated.star_errors.total_px == pytest.approx(cal.star_errors.tau_px, rel=0.2)
    assert stated.sigmas == pytest.approx(cal.sigmas, rel=0.2)


def test_what_cannot_be_is_refused(made):
    _, obs, camera, _, cal = made
    with pytest.raises(CalibrationError, match="method='efficient'"):
        sc.calibrate(obs, camera, method="three_stage", star_errors=True)
    fresh = campaign(np.random.default_rng(3), n_frames=6)
    with pytest.raises(CalibrationError, match="0 stars of 90"):
        sc.calibrate(sc.Observations(**fresh.columns), camera, star_errors=True)
    with pytest.raises(SamplingError, match="errors of the stars"):
        sc.sample(obs, cal, likelihood="student_t")
    with pytest.raises(CalibrationError, match="share"):
        sc.estimation.merge([cal, cal])


def test_other_models_are_compared_on_equal_terms(made):
    _, obs, _, plain, cal = made
    moves = [
        sc.diagnostics.compare_models(obs, one, ("brown3",)).of("brown3").common_arcsec
        for one in (plain, cal)
    ]
    assert moves[1] == pytest.approx(moves[0], abs=0.05)


@pytest.mark.slow
def test_coverage_is_nominal_with_the_option_and_not_without():
    """Forty runs; `benchmarks/regimes.py` has 150 of each regime."""
    inside, without, squared = [], [], []
    for i in range(40):
        c, obs, camera = observed(500 + i)
        cal = sc.calibrate(obs, camera, star_errors=True)
        error = (cal.theta - c.theta) / cal.sigmas
        squared.append(error @ np.linalg.solve(cal.correlation, error) / 5.0)
        inside.append(np.abs(error) < 1.96)
        if i < 20:
            plain = sc.calibrate(obs, camera)
            without.append(np.abs((plain.theta - c.theta) / plain.sigmas) < 1.96)
    assert 0.90 < np.mean(inside) < 0.985
    assert np.mean(squared) == pytest.approx(1.0, abs=0.3)
    # The control.
    assert np.mean(without) < 0.87
