"""Intervals of shares, and p-values of many tests together."""

from __future__ import annotations

import pytest

from starcal_uq.maths.intervals import binomial_interval, holm


def test_binomial_interval():
    # Clopper & Pearson's own example: 3 of 10 at 95 %.
    assert binomial_interval(3, 10) == pytest.approx((0.0667, 0.6525), abs=1e-4)
    assert binomial_interval(0, 10)[0] == 0.0
    assert binomial_interval(6, 6)[1] == 1.0


def test_holm_is_that_of_the_textbook():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert holm([]).size == 0
