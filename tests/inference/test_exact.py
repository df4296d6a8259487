"""The exact likelihood at many points, and of a sample of frames."""

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.inference.exact import ExactMarginal, FrameSample
from starcal_uq.likelihood.marginal import MarginalLikelihood
from tests.helpers.scenes import camera, nominal, observations


def test_points_together_and_one_by_one() -> None:
    """Few stars are evaluated at many points at a time; what it gives is the same."""
    obs = observations(n_frames=20)
    cal = calibrate(obs, nominal(camera()))
    theta = cal.theta + 3.0 * cal.sigmas * np.random.default_rng(1).standard_normal((50, 5))
    sigma = np.linspace(0.9, 1.1, 50) * cal.sigma
    likelihood = MarginalLikelihood(obs, "brown")
    one_by_one = np.array(
        [likelihood.log_likelihood(t, s) for t, s in zip(theta, sigma, strict=True)]
    )
    exact = ExactMarginal(obs, cal)
    np.testing.assert_allclose(exact.log_likelihood(theta, sigma), one_by_one, rtol=0.0, atol=1e-5)
    # A point that no camera can have is nothing, and spoils no other.
    theta[7, 2] = np.nan
    found = exact.log_likelihood(theta, sigma)
    others = np.arange(50) != 7
    assert not np.isfinite(found[7])
    np.testing.assert_allclose(found[others], one_by_one[others], rtol=0.0, atol=1e-5)


def test_frames_in_batches_say_what_the_expansion_leaves_out() -> None:
    """Where as many frames are in each batch, what they leave out is what all of them do."""
    obs = observations(n_frames=20)
    cal = calibrate(obs, nominal(camera()))
    theta = cal.theta + 3.0 * cal.sigmas * np.random.default_rng(1).standard_normal((4, 5))
    sigma = np.full(4, 1.1 * cal.sigma)
    batches = FrameSample(obs, cal)
    assert (batches.n_frames, batches.of_frames) == (20, 20)
    exact = ExactMarginal(obs, cal).log_likelihood(theta, sigma)
    compressed = cal.compressed.log_likelihood(theta, sigma)
    assert np.abs(np.diff(exact - compressed)).max() > 0.01
    left = batches.log_likelihood(theta, sigma) - exact
    assert (
        np.abs(left - left[0]).max()
        < 0.02 * np.abs(exact - compressed - (exact - compressed)[0]).max() + 1e-3
    )
    assert batches.left_out(theta, sigma).shape == (10, 4)
    # Of frames that stand for more, the expansion is that of all, and what is left out grows with
    # them.
    more = FrameSample(obs, cal, of_frames=40)
    np.testing.assert_allclose(more.left_out(theta, sigma), 2.0 * batches.left_out(theta, sigma))
