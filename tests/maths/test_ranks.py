"""Ranks of truths among draws: uniform or not."""

import numpy as np
import pytest

from starcal_uq.maths.ranks import (
    counts_below,
    evaluation_points,
    uniformity_band,
    uniformity_p_value,
)


def test_band_and_p_value_say_the_same_and_are_exact():
    """Of 200 uniform samples, 5 % leave the 95 % band, which are those with p < 0.05."""
    rng = np.random.default_rng(1)
    n, n_values = 50, 64
    _, lower, upper = uniformity_band(n, n_values)
    outside, below = 0, 0
    p_values = []
    for _ in range(200):
        ranks = rng.integers(0, n_values, n)
        curve = counts_below(ranks, n_values) / n
        left = bool(np.any((curve < lower) | (curve > upper)))
        p_values.append(uniformity_p_value(ranks, n_values))
        outside += left
        below += p_values[-1] < 0.05
        assert left == (p_values[-1] < 0.05)
    assert below == outside
    # Counts are discrete, so that the band holds at least 95 %; four standard errors of the
    # simulation.
    assert 0.01 < outside / 200 <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / 200)
    assert np.mean(p_values) == pytest.approx(0.5, abs=0.08)


@pytest.mark.parametrize("n_values", [1280, 320, 1000, 7])
def test_points_divide_the_ranks(n_values):
    k = evaluation_points(n_values)
    assert n_values % k == 0
    assert 1 < k <= 128
    assert counts_below(np.arange(n_values), n_values).tolist() == [
        i * n_values // k for i in range(1, k)
    ]


@pytest.mark.parametrize(
    "transform",
    [lambda u: 0.5 + 0.8 * (u - 0.5), lambda u: u**1.2, lambda u: np.where(u < 0.5, u**1.5, u)],
)
def test_ranks_that_are_not_uniform_are_found(transform):
    u = (np.arange(1000) + 0.5) / 1000
    assert uniformity_p_value((u * 1280).astype(int), 1280) > 0.99
    assert uniformity_p_value((transform(u) * 1280).astype(int), 1280) < 1e-3
