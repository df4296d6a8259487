"""Tied attitudes against dense normal equations of all frames together."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude import RelativeAttitudes
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.ties import TiedLikelihood, Ties
from tests.helpers.effects import sheet, table
from tests.helpers.outside import campaign
from tests.helpers.ties import ARCSEC, gyro, known_of

K, SIGMA = 6, 0.05


@pytest.fixture(scope="module")
def scene() -> tuple[sc.Observations, sc.Calibration, RelativeAttitudes]:
    rng = np.random.default_rng(3)
    c = campaign(rng, n_frames=K, stars_per_frame=9)
    obs = table(c)
    return obs, sc.calibrate(obs, sheet(c)), known_of(gyro(rng, c, 20.0))


def pieces(obs: sc.Observations, cal: sc.Calibration) -> tuple[np.ndarray, ...]:
    """Residuals and derivatives (p + 1, 2 N), attitude columns (3 K, 2 N), attitudes (K, 3, 3)."""
    likelihood = MarginalLikelihood(obs, cal.camera.distortion)
    state, _ = likelihood.profile(cal.theta)
    h = state.slopes
    member = np.repeat(np.arange(K), likelihood.frames.sizes)
    own = [np.where(member == k, state.attitude, 0.0) for k in range(K)]
    x = np.concatenate([state.e[None], h]).reshape(6, -1)
    return x, np.concatenate(own).reshape(3 * K, -1), state.rotations


def vector(r: np.ndarray) -> np.ndarray:
    """Rotation vector of a small turn."""
    return 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])


@pytest.mark.parametrize("kind", ["chain", "aligned", "mount"])
def test_sums_are_those_of_one_dense_system(scene, kind):
    obs, cal, known = scene
    x, a, r = pieces(obs, cal)
    unknown = np.zeros((0, 3))
    if kind == "mount":
        # Any rotations do for the algebra, with errors to match.
        known = RelativeAttitudes(
            np.zeros(0, dtype=int),
            obs.frame_ids,
            np.concatenate([known.quaternions, known.quaternions[:1]]),
            np.full((K, 1), 5e5),
        )
        unknown = -np.tile(np.eye(3), (K, 1))
    if kind == "aligned":
        known = RelativeAttitudes(
            known.frame_a, known.frame_b, known.quaternions, known.sigma_arcsec, 300.0
        )
    likelihood = TiedLikelihood(obs, cal.camera.distortion, Ties.of(obs.frame_ids, known), SIGMA)
    tied = likelihood.tied(likelihood.sums(cal.theta)[1])
    t = len(known)
    j, w0 = np.zeros((3 * t, 3 * K)), tied.rest
    for i, b in enumerate(known.frame_b):
        rows = slice(3 * i, 3 * i + 3)
        j[rows, 3 * b : 3 * b + 3] = np.eye(3)
        if kind != "mount":
            first = known.frame_a[i]
            turn = r[b] @ r[first].T
            j[rows, 3 * first : 3 * first + 3] = -turn
            xyzw = known.quaternions[i]
            u, w = xyzw[:3], xyzw[3]
            cross = np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])
            measured = np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
            np.testing.assert_allclose(w0[rows], vector(turn @ measured.T), atol=1e-9)
    if kind == "aligned":
        unknown = np.concatenate([np.eye(3) - r[b] @ r[b - 1].T for b in known.frame_b])
    s = (np.ravel(known.sigma_arcsec) / ARCSEC) ** 2 / SIGMA**2
    # Rows: stars, ties, and the prior of the alignment; unknowns: turns, the common one, theta.
    stars = np.concatenate([a, np.zeros((unknown.shape[1] if len(unknown) else 0, a.shape[1]))])
    columns = np.concatenate([stars, x[1:]]).T
    ties = np.concatenate([j, unknown, np.zeros((3 * t, 5))], axis=1) if len(unknown) else None
    ties = np.concatenate([j, np.zeros((3 * t, 5))], axis=1) if ties is None else ties
    rows = [columns, ties / np.sqrt(s)[:, None]]
    values = [x[0], -w0 / np.sqrt(s)]
    if kind == "aligned":
        prior = np.zeros((3, columns.shape[1]))
        prior[:, 3 * K : 3 * K + 3] = np.eye(3) * SIGMA * ARCSEC / 300.0
        rows.append(prior)
        values.append(np.zeros(3))
    design, value = np.concatenate(rows), np.concatenate(values)
    n = design.shape[1] - 5
    q = np.linalg.qr(design[:, :n])[0]
    left, h = value - q @ (q.T @ value), design[:, n:] - q @ (q.T @ design[:, n:])
    sums = likelihood.sums(cal.theta)[0]
    scale = np.sqrt(np.diag(h.T @ h))
    assert sums.cost == pytest.approx(left @ left, rel=1e-7)
    np.testing.assert_allclose(
        sums.matrix / np.outer(scale, scale), h.T @ h / np.outer(scale, scale), atol=1e-6
    )
    np.testing.assert_allclose(
        -sums.gradient / scale, h.T @ left / scale, atol=1e-6 * np.sqrt(sums.cost)
    )
    # Control: without the ties the sums differ.
    plain = MarginalLikelihood(obs, cal.camera.distortion).sums(cal.theta)[0]
    assert sums.cost > plain.cost * (1.0 + 1e-6)


def test_the_compressed_likelihood_is_the_exact_one_within_three_sigma(scene):
    obs, plain, known = scene
    cal = sc.calibrate(obs, plain.nominal, relative_attitudes=known)
    exact = TiedLikelihood(
        obs, cal.camera.distortion, Ties.of(obs.frame_ids, known), cal.ties.sigma
    )
    z = np.random.default_rng(1).standard_normal((20, 5))
    points = (
        cal.theta
        + z @ np.linalg.cholesky(cal.covariance / np.outer(cal.sigmas, cal.sigmas)).T * cal.sigmas
    )
    sigma = np.full(20, cal.sigma)
    difference = exact.log_likelihoods(points, sigma) - cal.log_likelihood(points, sigma)
    assert np.ptp(difference) < 0.02
    # Control: it is not the likelihood of free attitudes.
    free = MarginalLikelihood(obs, cal.camera.distortion)
    assert np.ptp(free.log_likelihoods(points, sigma) - cal.log_likelihood(points, sigma)) > 1.0
