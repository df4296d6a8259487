"""What is swept, in words: the names, units and values of the axes of a study."""

from __future__ import annotations

import math
from typing import Any

from starcal_uq.camera.distortion import PARAMETERS
from starcal_uq.core.formatting import count, fixed, join_words, pretty_unit
from starcal_uq.core.types import AnyMapping
from starcal_uq.studies.axes import AXES

# Name, and how a value is said; the name of an axis that is missing here is said as it is.
_AXES = {
    "fov_deg": ("field of view", "a field of {}°"),
    "focal_mm": ("focal length", "a focal length of {} mm"),
    "pixels": ("detector's width", "{} px of detector"),
    "pixel_um": ("pixel pitch", "pixels of {} µm"),
    "x0_offset_px": ("offset of the principal point in x", "a principal point {} px off in x"),
    "y0_offset_px": ("offset of the principal point in y", "a principal point {} px off in y"),
    "distortion": ("distortion model", "the model {}"),
    "distortion_px": ("distortion at the corner", "{} px of distortion"),
    "max_mag": ("magnitude limit", "stars to magnitude {}"),
    "stars": ("number of stars per frame", "{} stars a frame"),
    "frames": ("number of frames", "{} frames"),
    "min_stars": ("fewest stars of a frame", "at least {} stars a frame"),
    "pointing": ("pointing", "{} pointing"),
    "sigma_px": ("centroid noise", "{} px of noise"),
    "noise_per_mag": ("growth of the noise per magnitude", "noise growing by {} dex per magnitude"),
    "noise_mag": ("magnitude of the stated noise", "noise as stated at magnitude {}"),
    "noise_floor_px": ("noise of bright stars", "a floor of {} px under the noise"),
    "direction_mas": ("errors of the stars' directions", "star errors of {} mas"),
    "prior": ("prior", "the prior {}"),
    "method": ("method", "the method {}"),
    "likelihood": ("likelihood", "the likelihood {}"),
}
# Units as they are printed, where that is not how they are written.
_PRINTED = {"deg": "°", "um": "µm"}


def axis_name(axis: str) -> str:
    """The axis in words, without its unit."""
    return _AXES.get(axis, (axis,))[0]


def axis_label(axis: str) -> str:
    """The axis with its unit, for an axis of a figure or the head of a column."""
    unit = AXES[axis].unit if axis in AXES else ""
    unit = _PRINTED.get(unit, pretty_unit(unit))
    return f"{axis_name(axis)} [{unit}]" if unit else axis_name(axis)


def value_words(value: Any) -> str:
    """A value of an axis, as short as it is exact to three digits."""
    if isinstance(value, str):
        return value
    number = float(value)
    if not math.isfinite(number):
        return fixed(number, 0)
    if number == round(number) and abs(number) < 1e7:
        whole = round(number)
        return count(whole) if abs(whole) >= 10_000 else str(whole).replace("-", "\N{MINUS SIGN}")
    return f"{number:.3g}".replace("-", "\N{MINUS SIGN}")


def said(axis: str, value: Any) -> str:
    """A value with its axis: ``a field of 10°``."""
    form = _AXES[axis][1] if axis in _AXES else axis + " {}"
    return form.format(value_words(value))


def capital(text: str) -> str:
    """First letter of a sentence; the name of a parameter stays as it is written."""
    return text if text.split(" ")[0].rstrip(":") in PARAMETERS else text[:1].upper() + text[1:]


def place(values: AnyMapping) -> str:
    """A place in the sweep: ``a field of 10° and 100 frames``."""
    return join_words([said(axis, value) for axis, value in values.items()])
