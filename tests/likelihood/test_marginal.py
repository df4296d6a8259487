"""The marginal likelihood, its information, and its compressed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.projection import project
from starcal_uq.core.records import from_plain, to_plain
from starcal_uq.likelihood import compressed as module
from starcal_uq.likelihood.compressed import (
    CompressedLikelihood,
    _derivatives,
    combined,
    compress,
    gram_sums,
    moved,
    optimum,
    scaled,
)
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import scaled_cholesky, symmetric_inverse
from tests.helpers.scenes import USUAL, camera, observations, with_sigmas


def _information_scale(matrix):
    return 1.0 / np.sqrt(np.diag(matrix))


def test_attitudes_are_searched_from_where_it_was_said(monkeypatch):
    likelihood, theta = (
        MarginalLikelihood(with_sigmas(observations(n_frames=20)), "brown"),
        camera().theta,
    )
    assert likelihood.rotations is None and likelihood.last_sums is None
    assert likelihood.kernels == "numpy"
    best = likelihood.profile(theta)[0].rotations

    def off(rotations):
        return np.linalg.norm(rotations - best, axis=(1, 2))

    # QUEST on the stars' own noise begins nearer than on one noise for all.
    plain = MarginalLikelihood(
        dataclasses.replace(likelihood.frames, weight=None), "brown"
    ).start_rotations(theta)
    assert np.median(off(likelihood.start_rotations(theta))) < 0.5 * np.median(off(plain))
    sums, attitudes = likelihood.sums(theta)
    likelihood.use_sums(sums, attitudes)
    assert likelihood.last_sums == (sums, attitudes)
    assert np.max(off(likelihood.rotations)) < 1e-9
    # They serve the compressed likelihood at their own point alone.
    known = []
    monkeypatch.setattr(
        module, "gram_sums", lambda *given: known.append(given[-1]) or gram_sums(*given)
    )
    for point in (theta, theta + np.array([1e-3, 0.0, 0.0, 0.0, 0.0])):
        compress(likelihood, point, symmetric_inverse(sums.normal.matrix))
    assert known[0] == (sums, attitudes) and known[1][0].cost != sums.cost
    likelihood.use_rotations(best)
    assert likelihood.last_sums is None and likelihood.rotations is best
    assert np.max(off(likelihood.rotations_at(theta))) < 1e-9


def test_derivatives_are_whitened_and_no_model_is_likeliest_where_it_is_not_finite():
    likelihood, theta = (
        MarginalLikelihood(with_sigmas(observations(n_frames=20)), "brown"),
        camera().theta,
    )
    state, _ = likelihood.profile(theta)
    # A principal point shifts every star, in units of its own noise.
    along, across = likelihood.derivatives(theta, state)[0]
    assert np.allclose(along, likelihood.frames.weight, rtol=1e-12)
    assert np.max(np.abs(across)) == 0.0
    assert likelihood.log_likelihood(np.array([*theta[:2], np.nan, *theta[3:]]), 1.0) == -np.inf


def test_profile_is_the_least_squares_attitude_of_every_frame():
    obs = with_sigmas(observations(n_frames=20))
    likelihood = MarginalLikelihood(obs, "brown")
    cam = camera()
    state, cost = likelihood.profile(cam.theta)
    total = 0.0
    for k in range(obs.n_frames):
        rows = slice(obs.frame_starts[k], obs.frame_starts[k + 1])
        rotation = state.rotations[k]

        def residual(phi, rows=rows, rotation=rotation):
            b = obs.directions_icrs[rows] @ (exp_rotation(phi) @ rotation).T
            return ((obs.xy[rows] - project(cam, b)) / obs.sigma_px[rows, None]).ravel()

        solution = least_squares(
            residual, np.full(3, 1e-5), method="lm", x_scale=1e-6, xtol=1e-14, ftol=1e-14
        )
        total += 2.0 * solution.cost
        # Cross-boresight to 1e-9 rad; roll is weaker by the width of the field.
        assert np.max(np.abs(solution.x)) < 1e-7
    assert cost == pytest.approx(total, rel=1e-10)


def test_information_is_the_schur_complement_of_the_attitudes():
    obs = observations(n_frames=12)
    likelihood = MarginalLikelihood(obs, "brown")
    theta = camera().theta
    state, _ = likelihood.profile(theta)
    h = likelihood.derivatives(theta, state).reshape(5, -1).T
    n, k = obs.n_stars, obs.n_frames
    a = np.zeros((2, n, 3 * k))
    for frame in range(k):
        rows = slice(obs.frame_starts[frame], obs.frame_starts[frame + 1])
        a[:, rows, 3 * frame : 3 * frame + 3] = state.attitude[:, :, rows].transpose(1, 2, 0)
    a = a.reshape(2 * n, 3 * k)
    schur = h.T @ h - h.T @ a @ np.linalg.solve(a.T @ a, a.T @ h)
    scale = _information_scale(schur)
    difference = (likelihood.evaluate(theta).matrix - schur) * np.outer(scale, scale)
    assert np.max(np.abs(difference)) < 1e-8


@pytest.mark.parametrize("model", USUAL)
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


def test_compressed_adds_over_frames_and_survives_a_round_trip():
    obs = observations(n_frames=60)
    cal = _estimate(obs, "brown")
    whole = cal.compressed
    parts = [
        compress(
            MarginalLikelihood(obs.select_frames(ids), "brown"),
            whole.theta_hat,
            whole.whitening @ whole.whitening.T,
        )
        for ids in (obs.frame_ids[:25], obs.frame_ids[25:])
    ]
    assert np.allclose(
        sum(part.gram for part in parts), whole.gram, rtol=1e-6, atol=1e-7 * whole.gram.max() * 1e-3
    )
    assert sum(part.log_determinant for part in parts) == pytest.approx(
        whole.log_determinant, rel=1e-12
    )
    again = from_plain(CompressedLikelihood, to_plain(whole))
    assert np.array_equal(again.gram, whole.gram)
    assert np.array_equal(
        again.log_likelihood(cal.theta[None], 0.05), whole.log_likelihood(cal.theta[None], 0.05)
    )


def test_scaling_the_stated_noise_only_rescales_sigma():
    import dataclasses

    obs = with_sigmas(observations(n_frames=30, sigma_px=0.0))
    doubled = dataclasses.replace(obs, sigma_px=2.0 * obs.sigma_px)
    a, b = _estimate(obs, "brown"), _estimate(doubled, "brown")
    assert a.sigma_name == "sigma_scale"
    assert a.sigma == pytest.approx(2.0 * b.sigma, rel=1e-9)
    assert np.allclose(a.theta, b.theta, rtol=1e-9)
    assert np.allclose(a.covariance, b.covariance, rtol=1e-6)
    assert 0.8 < a.sigma < 1.2


def test_derivatives_of_the_compressed_sum_of_squares():
    """Of any expansion: that of an estimate has next to no slope, and bends by second derivatives
    alone.
    """
    rng = np.random.default_rng(4)
    root = rng.standard_normal((30, 21))
    compressed = CompressedLikelihood(
        np.zeros(5), np.eye(5), root.T @ root, 0.0, np.zeros(5), 100, 50, 5
    )
    slope, hessian = _derivatives(compressed)
    unit = 1e-3 * np.eye(5)

    def value(z):
        return compressed.sum_of_squares(np.atleast_2d(z))[0]

    steps = [(value(e) - value(-e)) / 2e-3 for e in unit]
    bends = [
        [(value(a + b) - value(a - b) - value(b - a) + value(-a - b)) / 4e-6 for a in unit]
        for b in unit
    ]
    np.testing.assert_allclose(slope, steps, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(hessian, bends, rtol=1e-3, atol=1e-2)


def test_the_optimum_of_an_expansion_from_where_it_curves_the_wrong_way():
    """A residual of ten that falls with the square: the full Hessian has a negative direction,
    Gauss-Newton's none.
    """
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
