"""Numbers as people read them."""

import math

import pytest

from starcal_uq.core.formatting import (
    count,
    decimals_for,
    fixed,
    join_words,
    p_words,
    percent,
    plural,
    pretty_unit,
    significant,
    superscript,
    with_sigma,
)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (499.87234, 0.1512, "499.87"),
        (5852.1833, 0.028, "5852.183"),
        (-3.5, 0.0996, "−3.50"),
        (-3.5, 0.00999, "−3.500"),
        (1234.5, 20.0, "1234"),
        (-0.0004, 0.15, "0.00"),
        (2.0, 0.0, "2.00000"),
        (2.0, math.nan, "2.00000"),
    ],
)
def test_digits_end_at_the_second_digit_of_sigma(value, sigma, text):
    assert with_sigma(value, sigma) == text


def test_decimals_follow_the_rounded_sigma():
    """0.0996 rounds to 0.10, so two decimals are enough."""
    assert [decimals_for(s) for s in (0.0994, 0.0996, 1.0, 12.0, 0.0, math.inf)] == [
        3,
        2,
        1,
        0,
        0,
        0,
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (5.449, "5.4"),
        (0.0214, "0.021"),
        (99.6, "100"),
        (1234.0, "1200"),
        (1.4e-5, "1.4×10⁻⁵"),
        (-2.5e8, "−2.5×10⁸"),
        (math.nan, "not known"),
        (-math.inf, "−∞"),
    ],
)
def test_significant(value, text):
    assert significant(value) == text


def test_no_negative_zero():
    assert fixed(-0.001, 2) == "0.00"
    assert fixed(-0.01, 2) == "−0.01"


def test_units_and_words():
    assert pretty_unit("1e-10 px^-2") == "10⁻¹⁰ px⁻²"
    assert pretty_unit("1") == ""
    assert superscript(-15) == "⁻¹⁵"
    assert percent(0.0512) == "5.1\N{NO-BREAK SPACE}%"
    assert count(17927) == "17\N{NARROW NO-BREAK SPACE}927"
    assert plural(1, "frame") == "1 frame"
    ps = (0.314, 4.3e-68, 0.0, 1.0, math.nan)
    assert [p_words(p) for p in ps] == [
        "p = 0.31",
        "p < 10⁻¹²",
        "p < 10⁻¹²",
        "p = 1.0",
        "p not known",
    ]
    assert [p_words(p, 1 / 500) for p in (0.0, 0.002, 1.0)] == [
        "p < 0.002",
        "p = 0.0020",
        "p > 0.998",
    ]
    assert plural(0, "frame") == "0 frames"
    assert [join_words(w) for w in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "",
        "a",
        "a and b",
        "a, b and c",
    ]
