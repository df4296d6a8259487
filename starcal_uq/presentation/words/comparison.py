"""The outcome of a comparison in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import fixed, p_words, plural, plus_minus, significant
from starcal_uq.presentation.tables import TextTable

# Below this, arcsec, no one can tell a difference from none.
_NOTHING = 1e-6


def headline(found: CameraComparison) -> str:
    """The verdict in one short sentence."""
    a, b = found.labels
    # A phrase begins the sentence with a capital; the name of a run stays what it is.
    a = a[:1].upper() + a[1:] if " " in a else a
    size = f"{_size(found.rms_arcsec)} arcsec rms"
    if not found.tested:
        return (
            f"{a} and {b} differ by {size} over the detector; whether chance explains it was not "
            "tested."
        )
    expected = f"{significant(found.expected_rms_arcsec)} was to be expected"
    if found.verdict == "agree":
        return f"{a} and {b} agree: {size} over the detector, where {expected}."
    if found.verdict == "maps differ":
        return f"{a} and {b} differ by {size} over the detector, where {expected}."
    return (
        f"{a} and {b} map the field alike ({size}, where {expected}), but their parameters differ."
    )


def rotation_words(found: CameraComparison) -> str:
    """The rotation that was removed, with its uncertainty."""
    parts = []
    for name, value, sigma in zip(
        AXES, found.rotation_arcsec, found.rotation_sigma_arcsec, strict=True
    ):
        parts.append(f"{name} {_value(float(value), float(sigma))}")
    return f"{parts[0]}, {parts[1]}, {parts[2]} arcsec"


def _size(value: float) -> str:
    return significant(value) if value >= _NOTHING else "less than 10⁻⁶"


def _value(value: float, sigma: float) -> str:
    """A value with its sigma; tiny ones, which no one can tell from zero, without digits that mean
    nothing.
    """
    if not np.isfinite(sigma):
        return significant(value) if abs(value) >= _NOTHING else "0"
    if sigma < 5e-4:
        return f"{fixed(value, 3)} ± 0.000"
    return plus_minus(value, sigma)


def comparison_text(found: CameraComparison) -> str:
    """The verdict, the rotation and both p-values."""
    rotation = f"The rotation removed is {rotation_words(found)}."
    if not found.tested:
        return f"{headline(found)} {rotation} {found.rule}"
    tests = f"Map: {p_words(found.p_map)}"
    if np.isfinite(found.p_parameters):
        tests += (
            f"; parameters as a whole: {p_words(found.p_parameters)} "
            f"({plural(found.n_directions, 'direction')})"
        )
    return f"{headline(found)} {rotation} {tests}."


def comparison_table(found: CameraComparison) -> TextTable:
    """One row per quantity: the difference, and what was to be expected."""
    return TextTable.of(found.to_dataframe(), f"{found.labels[1]} minus {found.labels[0]}")
