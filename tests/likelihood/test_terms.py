"""Terms with a prior, eliminated: products against the covariance as written, as a dense matrix."""

import dataclasses

import numpy as np
import pytest
from scipy.sparse import csr_array

from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.terms import Eliminated, Term, TermSums
from starcal_uq.observations.frames import StarFrames
from tests.helpers.scenes import camera, observations

SIGMA = 0.05


@pytest.fixture(scope="module")
def seen():
    """Frames whose stars have weights of their own, as a noise model and Student's t give them, and
    axes that differ.
    """
    rng = np.random.default_rng(5)
    theta, frames = camera().theta, StarFrames.from_observations(observations(n_frames=6))
    weight = rng.uniform(0.3, 2.0, frames.n_stars)
    axes = np.array([[1.3, 0.2], [0.2, (1.0 + 0.2**2) / 1.3]])
    likelihood = MarginalLikelihood(dataclasses.replace(frames, weight=weight, axes=axes), "brown")
    return likelihood, theta, likelihood.profile(theta)[0]


def groups_of(likelihood, grouping):
    frames = likelihood.frames
    frame = np.repeat(np.arange(frames.n_frames), frames.sizes)
    by_grouping = {
        "frame": frame,
        "star": np.arange(frames.n_stars) % 40,
        "run": np.zeros(frames.n_stars, dtype=np.int64),
    }
    return by_grouping[grouping]


def stretch(likelihood, state, rows):
    """Scale along x and along y, whitened."""
    u = (likelihood.frames.pixel - 500.0) / 500.0
    columns = np.zeros((2, *u.shape))
    columns[0, 0], columns[1, 1] = u
    likelihood.frames.whiten(columns)
    return columns[..., rows]


def dense(likelihood, state, term, ratio):
    """W (2 N, 2 N) in units of sigma^-2, attitudes projected out, and the columns Z (2 N, 2 G)."""
    n, k = likelihood.frames.n_stars, likelihood.frames.n_frames
    z, a = np.zeros((2, n, ratio.size)), np.zeros((2, n, 3 * k))
    columns = stretch(likelihood, state, slice(None))
    frame = groups_of(likelihood, "frame")
    for i in range(2):
        z[:, np.arange(n), 2 * term.groups + i] = columns[i]
    for i in range(3):
        a[:, np.arange(n), 3 * frame + i] = state.attitude[i]
    z, a = z.reshape(2 * n, -1), a.reshape(2 * n, -1)
    v = np.linalg.inv(np.eye(2 * n) + z * ratio @ z.T)
    return v - v @ a @ np.linalg.solve(a.T @ v @ a, a.T @ v), z


@pytest.mark.parametrize("by_group", [True, False])
@pytest.mark.parametrize("grouping", ["frame", "star", "run"])
def test_products_and_determinant_are_those_of_the_covariance(seen, grouping, by_group):
    likelihood, _, state = seen
    groups = groups_of(likelihood, grouping)
    ratio = np.random.default_rng(1).uniform(0.4, 4.0, 2 * (int(groups.max()) + 1)) ** 2
    term = Term(groups, int(groups.max()) + 1, stretch)
    w, z = dense(likelihood, state, term, ratio)
    sums = TermSums(term)
    columns = np.concatenate([state.slopes, state.e[None]])
    projected = likelihood.project_out(state, columns)
    sums.add(likelihood, state, projected, slice(None))
    flat, left = columns.reshape(len(columns), -1), projected.reshape(len(columns), -1)
    solved = Eliminated(sums, ratio, csr_array((len(ratio), 0)), by_group)
    found = left @ left.T - sums.cross.T @ solved.coefficients(sums.cross)
    expected = flat @ w @ flat.T
    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.max(np.abs(found - expected) / unit) < 1e-9
    # The control: the term takes something.
    assert np.max(np.abs(left @ left.T - expected) / unit) > 1e-3
    alone = likelihood.project_out(state, z.T.reshape(-1, *state.e.shape)).reshape(len(z.T), -1)
    g = np.eye(len(ratio)) + ratio[:, None] * (alone @ alone.T)
    assert solved.log_determinant == pytest.approx(np.linalg.slogdet(g)[1], rel=1e-9)
