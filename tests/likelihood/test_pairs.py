"""The pair objective in O(stars) against the explicit sum over pairs."""

import numpy as np
import pytest

from starcal_uq.likelihood import arrays
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.observations.frames import StarFrames
from tests.helpers.scenes import USUAL, camera, observations


def _offset(cam, size):
    """Parameters that move the corner by about `size` px."""
    shift = np.array([size, -size, 2 * size] + [0.0] * len(cam.coefficients))
    return (
        cam.theta + shift + np.concatenate([np.zeros(3), np.array(cam.coefficients) * 0.1 * size])
    )


@pytest.mark.parametrize("model", USUAL)
@pytest.mark.parametrize("size", [0.0, 0.2, 12.0])
def test_equals_the_explicit_sum_over_pairs(model, size):
    objective = PairObjective(StarFrames.from_observations(observations(model)), model)
    theta = _offset(camera(model), size)
    residuals, jacobian = objective.residuals(theta)
    assert len(residuals) == objective.n_pairs
    normal = objective.evaluate(theta)
    assert normal.cost == pytest.approx(np.sum(residuals**2), rel=1e-9)
    assert objective.cost(theta) == normal.cost
    gradient = jacobian.T @ residuals
    scale = np.linalg.norm(jacobian, axis=0) * np.linalg.norm(residuals)
    assert np.max(np.abs(normal.gradient - gradient) / scale) < 1e-9
    matrix = jacobian.T @ jacobian
    assert np.allclose(normal.matrix / matrix, 1.0, rtol=0, atol=1e-6)


def test_noise_free_cost_is_tiny_and_exact():
    """The naive formula ends at 1e-13 or below zero here."""
    objective = PairObjective(
        StarFrames.from_observations(observations("brown", sigma_px=0.0)), "brown"
    )
    cost = objective.cost(camera("brown").theta)
    assert 0.0 <= cost < 1e-26
    off = camera("brown").theta + np.array([0.0, 0.0, 1e-3, 0.0, 0.0])
    assert objective.cost(off) == pytest.approx(np.sum(objective.residuals(off)[0] ** 2), rel=1e-6)


def test_stage_one_takes_only_the_optics():
    frames = StarFrames.from_observations(observations())
    whole = PairObjective(frames, "brown")
    pinhole = PairObjective(frames, "none")
    theta = camera("none").theta
    undistorted = np.append(theta, [0.0, 0.0])
    assert pinhole.n_parameters == 3
    assert pinhole.cost(theta) == pytest.approx(whole.cost(undistorted), rel=1e-12)
    assert np.allclose(
        pinhole.evaluate(theta).matrix, whole.evaluate(undistorted).matrix[:3, :3], rtol=1e-9
    )


def test_the_turn_of_the_catalogue_does_not_matter():
    """Evaluating far away first leaves another reference rotation behind."""
    frames = StarFrames.from_observations(observations())
    theta = _offset(camera(), 0.1)
    fresh, used = PairObjective(frames, "brown"), PairObjective(frames, "brown")
    used.cost(theta + np.array([20.0, -20.0, 25.0, 0.0, 0.0]))
    assert used.cost(theta) == pytest.approx(fresh.cost(theta), rel=1e-9)
    assert np.allclose(used.evaluate(theta).gradient, fresh.evaluate(theta).gradient, rtol=1e-6)


def test_attitudes_are_those_of_the_last_finite_point():
    frames = StarFrames.from_observations(observations())
    objective, theta = PairObjective(frames, "brown"), camera().theta
    assert objective.rotations is None
    objective.cost(theta)
    best = MarginalLikelihood(frames, "brown").profile(theta)[0].rotations
    assert np.max(np.abs(objective.rotations - best)) < 1e-4
    # The distortion folds over 620 px from the centre, beyond which some frames have stars and some
    # have none.
    folded = np.array([*theta[:2], theta[2] + 100.0, -1.0 / (3.0 * 930.0**2), 0.0])
    assert np.isnan(objective.cost(folded)) and objective.rotations is None
    assert (
        0.2
        < np.mean(
            objective.frames.sum(np.isnan(objective.directions(folded, frames)[0][0]) * 1.0) > 0
        )
        < 0.8
    )
    assert objective.cost(theta) == pytest.approx(
        PairObjective(frames, "brown").cost(theta), rel=1e-12
    )


def test_parameters_that_are_not_finite_have_no_cost():
    objective = PairObjective(StarFrames.from_observations(observations()), "brown")
    normal = objective.evaluate(np.array([np.nan, *camera().theta[1:]]))
    assert normal.cost == np.inf
    assert normal.gradient.shape == (5,) and normal.matrix.shape == (5, 5)
    assert np.isnan(normal.gradient).all() and np.isnan(normal.matrix).all()


def test_time_grows_with_stars_and_not_with_pairs():
    """Blocks of frames give the same sums as all frames at once."""
    obs = observations("brown", n_frames=400)
    frames = StarFrames.from_observations(obs)
    whole = PairObjective(frames, "brown")
    theta = _offset(camera(), 0.3)
    assert len(frames.parts(arrays.PAIR_STARS)) > 1
    parts = [PairObjective(frames.part(a, b), "brown") for a, b in ((0, 150), (150, 400))]
    assert whole.cost(theta) == pytest.approx(sum(part.cost(theta) for part in parts), rel=1e-12)
    assert np.allclose(
        whole.evaluate(theta).matrix, sum(p.evaluate(theta).matrix for p in parts), rtol=1e-10
    )


@pytest.mark.parametrize("n_frames", [4, 9])
def test_godambe_is_the_scatter_of_the_scores_of_single_frames(n_frames):
    """From all pairs, frame by frame, with k / (k - p) for few frames."""
    frames, theta = (
        StarFrames.from_observations(observations(n_frames=n_frames)),
        camera("none").theta,
    )
    objective, far = PairObjective(frames, "none"), theta + np.array([0.0, 0.0, 20.0])

    def scatter(theta):
        both = [
            PairObjective(frames.part(k, k + 1), "none").residuals(theta) for k in range(n_frames)
        ]
        scores = np.stack([jacobian.T @ residuals for residuals, jacobian in both])
        inverse = np.linalg.inv(sum(jacobian.T @ jacobian for _, jacobian in both))
        return inverse @ scores.T @ scores @ inverse * n_frames / (n_frames - 3)

    assert np.allclose(objective.godambe(theta), scatter(theta), rtol=1e-6)
    assert np.array_equal(objective.godambe(theta + 1e-9, tolerance=1e-3), objective.godambe(theta))
    assert np.allclose(objective.godambe(far, tolerance=1e-3), scatter(far), rtol=1e-6)
