"""Intervals of shares, and p-values of many tests together."""

import pytest

from starcal_uq.maths.intervals import binomial_interval, holm, wilson_interval


def test_binomial_interval():
    # Clopper & Pearson's own example: 3 of 10 at 95 %.
    assert binomial_interval(3, 10) == pytest.approx((0.0667, 0.6525), abs=1e-4)
    assert binomial_interval(0, 10)[0] == 0.0
    assert binomial_interval(6, 6)[1] == 1.0


def test_wilson_interval():
    # Newcombe (1998), Statistics in Medicine 17, 857-872, table I: 81 of 263, 15 of 148, 0 of 20.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=1e-4)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert wilson_interval(20, 20)[1] == 1.0


def test_holm_is_that_of_the_textbook():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert holm([]).size == 0
    # Tests without a p-value are none.
    p = [0.01, 0.04, float("nan"), 0.03, 0.005]
    assert (holm(p) <= 0.05).tolist() == [True, False, False, False, True]
