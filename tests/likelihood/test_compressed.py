"""The compressed form of the marginal likelihood."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize

from starcal_uq.likelihood.compressed import (
    CompressedLikelihood,
    _derivatives,
    combined,
    gram_sums,
    moved,
    optimum,
    scaled,
)
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import scaled_cholesky, symmetric_inverse
from tests.helpers.scenes import USUAL, camera, observations, with_sigmas


@pytest.mark.parametrize("model", ["brown", "brown_tangential", "inverse"])
def test_compressed_equals_exact_within_three_sigma(model):
    obs = observations(model, n_frames=200, max_mag=6.5)
    _compare(obs, model, 2e-3)


@pytest.mark.parametrize("n_frames", [10, 60])
def test_compressed_equals_exact_for_few_frames_and_stated_noise(n_frames):
    _compare(observations(n_frames=n_frames), "brown", 0.1)
    _compare(with_sigmas(observations(n_frames=n_frames)), "brown", 0.1)


def _estimate(obs, model):
    from starcal_uq.calibration.calibrate import calibrate
    from tests.helpers.scenes import nominal

    return calibrate(obs, nominal(camera(model)))


def _compare(obs, model, bound):
    cal = _estimate(obs, model)
    exact = MarginalLikelihood(obs, model)
    compressed = cal.compressed
    rng = np.random.default_rng(1)
    p = len(cal.theta)
    z = rng.standard_normal((30, p))
    z *= (rng.uniform(0, 3, 30) / np.linalg.norm(z, axis=1))[:, None]
    theta = cal.theta + z @ compressed.whitening.T
    difference = compressed.log_likelihood(theta, cal.sigma) - [
        exact.log_likelihood(t, cal.sigma) for t in theta
    ]
    assert np.max(np.abs(difference)) < bound
    # Control: without the second-derivative columns the likelihood is worse, so they matter and are
    # right.
    if model == "brown" and obs.n_frames == 10:
        gram = compressed.gram.copy()
        gram[1 + p :] = 0.0
        gram[:, 1 + p :] = 0.0
        import dataclasses

        linear = dataclasses.replace(compressed, gram=gram)
        worse = linear.log_likelihood(theta, cal.sigma) - [
            exact.log_likelihood(t, cal.sigma) for t in theta
        ]
        assert np.max(np.abs(worse)) > 3 * np.max(np.abs(difference))


@pytest.mark.parametrize("model", USUAL)
def test_slope_of_the_determinant_is_that_along_the_parameters(model):
    """The attitude columns change with the camera and with the attitudes that follow it."""
    import dataclasses

    plain = observations(model, n_frames=8, sigma_px=0.0)
    obs = dataclasses.replace(
        plain, sigma_px=np.random.default_rng(1).uniform(0.02, 0.1, len(plain))
    )
    exact, theta = MarginalLikelihood(obs, model), camera(model).theta
    whitening = 3.0 * scaled_cholesky(symmetric_inverse(exact.evaluate(theta).matrix))
    rotations = exact.start_rotations(theta)
    slope = gram_sums(
        exact.frames, model, theta, whitening, exact.sums(theta)
    ).log_determinant_slope
    ahead, behind = (
        [
            np.sum(exact.profile(theta + sign * column, rotations)[0].log_determinant)
            for column in whitening.T
        ]
        for sign in (0.5, -0.5)
    )
    assert np.allclose(slope, np.subtract(ahead, behind), rtol=0, atol=5e-4 * np.max(np.abs(slope)))


@pytest.mark.parametrize("model", ["brown", "brown_tangential"])
def test_gram_is_that_of_columns_without_what_attitudes_reproduce(model):
    exact, theta = (
        MarginalLikelihood(with_sigmas(observations(model, n_frames=8)), model),
        camera(model).theta,
    )
    whitening = scaled_cholesky(symmetric_inverse(exact.evaluate(theta).matrix))
    seen = []
    known = exact.sums(theta)
    found = gram_sums(
        exact.frames, model, theta, whitening, known, lambda _, columns: seen.append(columns)
    )
    (own,) = seen
    state, _ = exact.profile(theta, known[1].at(theta))
    columns = exact.project_out(state, own).reshape(len(own), -1)
    scale = 1.0 / np.linalg.norm(columns, axis=1)
    assert np.max(np.abs((found.gram - columns @ columns.T) * np.outer(scale, scale))) < 1e-6
    # Control: attitudes reproduce a large part of some second derivatives.
    raw = np.linalg.norm(own.reshape(len(columns), -1), axis=1)
    assert np.max(raw * scale) > 1.3


def test_moved_and_scaled_are_the_same_function():
    cal = _estimate(observations(n_frames=10), "brown")
    before, rng = cal.compressed, np.random.default_rng(5)
    theta = cal.theta + rng.standard_normal((40, 5)) @ before.whitening.T
    turned = before.whitening @ (np.eye(5) + 0.3 * rng.standard_normal((5, 5)))
    after = moved(before, theta[0], turned)
    assert np.allclose(after.gram, after.gram.T, rtol=1e-12)
    assert np.ptp(before.log_likelihood(theta, cal.sigma)) > 3.0
    assert np.allclose(
        after.log_likelihood(theta, cal.sigma), before.log_likelihood(theta, cal.sigma), atol=1e-7
    )
    # Control: without the slope of the log determinant.
    wrong = dataclasses.replace(after, log_determinant_slope=np.zeros(5))
    off = wrong.log_likelihood(theta, cal.sigma) - before.log_likelihood(theta, cal.sigma)
    assert np.max(np.abs(off)) > 1e-4
    unit, sigma = 0.04, np.linspace(0.03, 0.09, 40)
    difference = scaled(before, unit).log_likelihood(theta, sigma / unit) - before.log_likelihood(
        theta, sigma
    )
    expected = before.dof * np.log(unit) + 3.0 * before.n_frames * np.log(unit)
    assert np.allclose(difference, expected, atol=1e-7)


def test_combined_estimates_have_the_sum_of_the_precisions():
    rng = np.random.default_rng(3)
    roots = rng.standard_normal((3, 5, 5)) * np.array([0.1, 0.1, 0.1, 1e-10, 1e-15])[:, None]
    covariances, thetas = [root @ root.T for root in roots], camera().theta + roots[..., 0]
    mean, covariance = combined(thetas, covariances)
    precisions = [symmetric_inverse(matrix) for matrix in covariances]
    expected = symmetric_inverse(sum(precisions))
    scale = 1.0 / np.sqrt(np.diag(expected))
    assert np.allclose(
        covariance * np.outer(scale, scale), expected * np.outer(scale, scale), atol=1e-6
    )
    shift = expected @ sum(
        p @ (theta - thetas[0]) for p, theta in zip(precisions, thetas, strict=True)
    )
    assert np.allclose((mean - thetas[0]) * scale, shift * scale, atol=1e-4)


def test_the_optimum_of_an_expansion_from_where_it_curves_the_wrong_way():
    """A residual of ten that falls with the square."""
    residuals = np.array(
        [
            [10.0, -1.0, 0.0, -0.5, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            [0.5, 0.0, 1.0, 0.0, 0.0, 0.0],
        ]
    )
    compressed = CompressedLikelihood(
        np.zeros(2), np.eye(2), residuals.T @ residuals, 0.0, np.zeros(2), 100, 50, 5
    )
    assert np.linalg.eigvalsh(_derivatives(compressed)[1])[0] < 0.0
    found = optimum(compressed)
    best = minimize(lambda z: compressed.sum_of_squares(z[None])[0], [3.0, -0.5], tol=1e-12)
    np.testing.assert_allclose(found.trajectory[-1], best.x, atol=1e-4)
    assert found.sum_of_squares == pytest.approx(best.fun, rel=1e-6)
    assert np.all(np.diff(found.cost) < 0.0)
