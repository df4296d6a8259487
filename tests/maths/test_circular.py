"""Quantiles of the radius of two Gaussian axes."""

import numpy as np
import pytest

from starcal_uq.budgeting.shapes import two_axis_radius
from starcal_uq.maths.circular import mixture_radius


def test_unequal_axes_and_mixtures_against_sampling():
    rng = np.random.default_rng(0)
    covariances = np.array([[[1.0, 0.3], [0.3, 0.2]], [[0.1, 0.0], [0.0, 0.4]]])
    drawn = np.concatenate([rng.multivariate_normal(np.zeros(2), C, 400_000) for C in covariances])
    sampled = np.quantile(np.hypot(*drawn.T), 0.99)
    assert mixture_radius(covariances, 0.99) == pytest.approx(sampled, rel=0.01)
    # Control: the mean covariance is not the mixture.
    assert mixture_radius(covariances.mean(axis=0), 0.99) != pytest.approx(sampled, rel=0.03)


def test_the_budget_says_the_same_of_unequal_axes():
    for small in (0.0, 0.3, 1.0):
        expected = two_axis_radius(0.997, 2.0, 2.0 * small)
        assert mixture_radius(np.diag([4.0, 4.0 * small**2]), 0.997) == pytest.approx(
            expected, rel=1e-4
        )


def test_a_confidence_that_is_no_probability_is_refused():
    with pytest.raises(ValueError, match="probability"):
        mixture_radius(np.eye(2), 99.7)
