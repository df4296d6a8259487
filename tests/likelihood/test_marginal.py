"""The marginal likelihood, its information, and its compressed form."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.projection import project
from starcal_uq.likelihood import compressed as module
from starcal_uq.likelihood.compressed import (
    compress,
    gram_sums,
)
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import symmetric_inverse
from tests.helpers.scenes import camera, observations, with_sigmas


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
    assert np.max(off(likelihood.profile(theta)[0].rotations)) < 1e-9


def test_derivatives_are_whitened_and_no_model_is_likeliest_where_it_is_not_finite():
    likelihood, theta = (
        MarginalLikelihood(with_sigmas(observations(n_frames=20)), "brown"),
        camera().theta,
    )
    state, _ = likelihood.profile(theta)
    # A principal point shifts every star, in units of its own noise.
    along, across = state.slopes[0]
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
    h = state.slopes.reshape(5, -1).T
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
