"""Derivatives by differences against those in closed form."""

import numpy as np

from starcal_uq.maths.differences import derivatives


def test_derivatives_of_a_quadratic_are_exact():
    matrix = np.array([[2.0, 0.5, -0.1], [0.5, 3.0, 0.2], [-0.1, 0.2, 1.0]])
    slope = np.array([1.0, -2.0, 0.5])
    value, gradient, hessian = derivatives(
        lambda x: 4.0 + x @ slope + 0.5 * np.sum((x @ matrix) * x, axis=1), 3, 0.1
    )
    assert value == 4.0
    np.testing.assert_allclose(gradient, slope, rtol=1e-12)
    np.testing.assert_allclose(hessian, matrix, rtol=1e-9, atol=1e-12)


def test_points_without_a_value_leave_no_derivatives():
    _, gradient, hessian = derivatives(lambda x: np.where(x[:, 0] > 0.0, np.inf, 0.0), 2, 0.1)
    assert not np.isfinite(gradient[0]) and not np.isfinite(hessian[0, 0])
