"""Quantities and times of astropy as plain values, in the units that end the names of parameters.

They are known by what they offer: astropy is loaded by those who use it, and only by them.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from starcal_uq.core.errors import SettingError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import shown

_UNITS = tomllib.loads(Path(__file__).with_name("units.toml").read_text("utf-8"))
# The longest unit that ends a name.
_OF_NAME = re.compile(rf".*?_({'|'.join(_UNITS)})")


def plain(name: str, value: Any) -> Any:
    """A Quantity as numbers in the unit of a name, such as `focal_mm`, and a Time as text (UTC), as
    a catalogue's `epoch` a Julian year; anything else as it is.

    SettingError where the unit is another kind of quantity.
    """
    if hasattr(value, "isot"):
        return value.jyear if name == "epoch" else value.utc.isot
    stated = _OF_NAME.fullmatch(name) if hasattr(value, "to_value") else None
    if stated is None:
        return value
    with extra("images", "quantities"):
        from astropy import units

    unit = _UNITS[stated[1]]
    try:
        return value.to_value(unit, units.temperature())
    except units.UnitConversionError:
        raise SettingError(f"{name} is {shown(value)}: give a quantity in {unit}.") from None
