"""Tail of weighted sums of squared normal variables, against closed forms and draws."""

import numpy as np
import pytest
from scipy.stats import chi2, f

from starcal_uq.maths.quadratic_forms import weighted_chi_square_tail


@pytest.mark.parametrize("count", [1, 2, 5, 9])
@pytest.mark.parametrize("x", [1e-6, 0.1, 1.0, 2.0, 5.0, 20.0, 100.0, 300.0])
def test_equal_weights_give_chi_square(count: int, x: float) -> None:
    """To relative accuracy, down to 1e-67."""
    assert weighted_chi_square_tail(np.full(count, 2.5), 2.5 * x) == pytest.approx(
        chi2.sf(x, count), rel=1e-8
    )


@pytest.mark.parametrize(("a", "b"), [(1.0, 0.5), (1.0, 0.01), (1.0, 1e-4), (3.0, 2.9)])
@pytest.mark.parametrize("x", [1e-6, 0.5, 3.0, 10.0, 50.0, 200.0])
def test_pairs_of_weights_give_a_difference_of_exponentials(a: float, b: float, x: float) -> None:
    exact = (a * np.exp(-x / (2 * a)) - b * np.exp(-x / (2 * b))) / (a - b)
    assert weighted_chi_square_tail(np.array([a, a, b, b]), x) == pytest.approx(exact, rel=1e-7)


@pytest.mark.parametrize("count", [1, 3, 5])
@pytest.mark.parametrize("dof", [20, 100, 20_000])
def test_an_estimated_noise_gives_f(count: int, dof: int) -> None:
    for x in (0.1, 1.0, 3.0, 10.0, 30.0):
        tail = weighted_chi_square_tail(np.ones(count), x, dof)
        assert tail == pytest.approx(f.sf(x / count, count, dof), rel=1e-5)
    # Control: taking the noise as known is wrong where it rests on few numbers.
    assert weighted_chi_square_tail(np.ones(5), 20.0) < 0.7 * weighted_chi_square_tail(
        np.ones(5), 20.0, 20
    )


def test_unequal_weights_agree_with_draws() -> None:
    weights = np.array([1.0, 0.3, 0.1, 0.02])
    sums = np.random.default_rng(0).standard_normal((400_000, 4)) ** 2 @ weights
    for x in (0.3, 1.0, 3.0, 6.0):
        share = float(np.mean(sums > x))
        assert weighted_chi_square_tail(weights, x) == pytest.approx(
            share, abs=4 * np.sqrt(share / 400_000)
        )


def test_what_is_no_quadratic_form_is_refused() -> None:
    assert weighted_chi_square_tail(np.ones(3), 0.0) == 1.0
    for weights in (np.array([1.0, -0.1]), np.zeros(2)):
        with pytest.raises(ValueError, match="must not be negative"):
            weighted_chi_square_tail(weights, 1.0)
