"""Names, units and values of the axes of a study."""

from __future__ import annotations

import math
from typing import Any

from starcal_uq.camera.distortion import COEFFICIENTS
from starcal_uq.core.formatting import count, fixed, join_words, pretty_unit
from starcal_uq.core.types import AnyMapping
from starcal_uq.studies.axes import AXES

# Units as they are printed, where that is not how they are written.
_PRINTED = {"deg": "°", "um": "µm"}


def axis_name(axis: str) -> str:
    """The axis in words, without its unit."""
    return axis if axis in COEFFICIENTS else AXES[axis].words


def _unit(axis: str) -> str:
    unit = AXES[axis].unit
    return _PRINTED.get(unit, pretty_unit(unit))


def axis_label(axis: str) -> str:
    """The axis with its unit, for an axis of a figure or the head of a column."""
    unit = _unit(axis)
    return f"{axis_name(axis)} [{unit}]" if unit else axis_name(axis)


def value_words(value: Any) -> str:
    """A value of an axis, as short as it is exact to three digits."""
    if isinstance(value, str):
        return value
    number = float(value)
    if not math.isfinite(number):
        return fixed(number, 0)
    if number == round(number) and abs(number) < 1e7:
        return count(round(number)) if abs(number) >= 10_000 else fixed(number, 0)
    return f"{number:.3g}".replace("-", "\N{MINUS SIGN}")


def said(axis: str, value: Any) -> str:
    """A value with its axis: ``field of view 10°``."""
    unit = _unit(axis)
    space = "" if unit in ("", "°") else " "
    return f"{axis_name(axis)} {value_words(value)}{space}{unit}"


def place(values: AnyMapping) -> str:
    """A place in the sweep: ``field of view 10° and number of frames 100``."""
    return join_words([said(axis, value) for axis, value in values.items()])
