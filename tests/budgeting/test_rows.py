"""Rows of a budget."""

from __future__ import annotations

import math

import pytest

from starcal_uq.budgeting.rows import confidence_text


@pytest.mark.parametrize(
    ("confidence", "text"),
    [
        (0.997, "99.7"),
        (0.95, "95"),
        (math.erf(3.0 / math.sqrt(2.0)), "99.73"),
        (0.9999999, "99.99999"),
        (0.999999999999, "99.9999999999"),
        (0.0001, "0.01"),
        (1e-9, "0.0000001"),
        (0.99712345, "99.7123"),
        (0.999991234, "99.999123"),
        (0.00001234567, "0.00123"),
        (0.5, "50"),
        (1.0, "100"),
        (0.0, "0"),
    ],
)
def test_a_confidence_keeps_its_nines_and_three_digits_of_what_misses(confidence, text):
    assert confidence_text(confidence) == f"{text}\N{NO-BREAK SPACE}%"
