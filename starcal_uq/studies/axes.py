"""What a study can vary, and the camera that follows from it."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcal_uq.calibration.calibrate import METHODS
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import COEFFICIENTS, get_model, model_names
from starcal_uq.camera.fields import corner_displacement_px
from starcal_uq.core.errors import StarcalError, StudyError
from starcal_uq.core.files import shown
from starcal_uq.core.settings import KEYS, Limit
from starcal_uq.core.types import AnyDict, AnyMapping
from starcal_uq.inference.named import LIKELIHOODS
from starcal_uq.planning.effects import PlannedEffects
from starcal_uq.simulation.pointing import POINTINGS

FLAT = "flat"
# A calibration without effects, and the axes that are about those of one that holds some.
NO_EFFECTS = "none"
EFFECT_AXES = ("effects", "temperature_range_c", "nights")
# Terms of a distortion that cancel to less than this share of their sum have no size that could be
# scaled.
_CANCELLED = 0.02


@dataclass(frozen=True)
class Axis:
    """Something that a study can vary: its key in files, and words and unit for labels.

    It takes numbers within a limit, or names, any where there are no `choices`. `base` is its value
    where nothing is said; None leaves it to the camera, or to nature.
    """

    name: str
    words: str
    unit: str = ""
    limit: Limit | None = None
    choices: tuple[str, ...] = ()
    base: Any = None
    parse: Callable[[str], object] | None = None  # What refuses names that are none

    def check(self, value: Any, where: str) -> Any:
        """The value in its own type; `StudyError` with `where` in front if it does not fit."""
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if self.limit is None:
            good = isinstance(value, str) and (not self.choices or value in self.choices)
        else:
            # Whole numbers may come as floats.
            if self.limit.whole and number and math.isfinite(value) and value % 1 == 0:
                value = int(value)
            good = number and self.limit.holds(value)
        if not good:
            raise StudyError(f"{where}: {self.name} is {shown(value)}; {self.wanted}.")
        if self.parse is not None:
            try:
                self.parse(value)
            except StarcalError as error:
                raise StudyError(f"{where}: {error}") from None
        return float(value) if self.kind == "number" else value

    @property
    def kind(self) -> str:
        """Values that it takes: ``number``, ``whole`` or ``name``."""
        return "name" if self.limit is None else "whole" if self.limit.whole else "number"

    @property
    def wanted(self) -> str:
        """What to write, as an order."""
        if self.limit is None:
            return (
                f"write one of {', '.join(self.choices)}"
                if self.choices
                else "write a name in quotes"
            )
        return self.limit.wanted().replace("give", "write", 1)


def planned_effects(settings: AnyMapping) -> PlannedEffects | None:
    """Effects of the calibration of a cell; None without any."""
    text = settings.get("effects", NO_EFFECTS)
    if text == NO_EFFECTS:
        return None
    spread = {name: settings[name] for name in EFFECT_AXES[1:] if name in settings}
    return PlannedEffects.parsed(text, **spread)


def _check_effects(text: str) -> None:
    if text != NO_EFFECTS:
        PlannedEffects.parsed(text)


_DECLARED = tomllib.loads(Path(__file__).with_name("axes.toml").read_text("utf-8"))
_COEFFICIENTS = {
    name: {"words": c.description, "unit": c.unit, "limit": KEYS["coefficient"]}
    for name, c in COEFFICIENTS.items()
}
_OF_NAMES: AnyDict = {
    "distortion": {"choices": model_names(axes=True)},
    "pointing": {"choices": POINTINGS},
    "method": {"choices": METHODS},
    "likelihood": {"choices": LIKELIHOODS},
    "effects": {"parse": _check_effects},
}
AXES = {
    name: Axis(name, **{"limit": KEYS.get(name)} | _OF_NAMES.get(name, {}) | entry)
    for name, entry in (_DECLARED["camera"] | _COEFFICIENTS | _DECLARED["observation"]).items()
}
# Axes that change the sensor of a study, and those that its noise takes the place of.
SENSOR_AXES = ("exposure_s", "rate_deg_s", "age_years")
NOISE_AXES = ("sigma_px", "noise_per_mag", "noise_mag", "noise_floor_px")
# Axes that make another camera.
CAMERA_AXES = (*_DECLARED["camera"], *COEFFICIENTS)
# Both set the focal length; the coefficients and the size of the distortion both set the
# distortion.
EXCLUSIVE = (
    ("fov_deg", "focal_mm"),
    *((name, "distortion_px") for name, c in COEFFICIENTS.items() if c.order > 1),
)


def base_settings(given: AnyMapping) -> AnyDict:
    """Values of every axis that has one, those that are given before the usual ones."""
    usual = {axis.name: axis.base for axis in AXES.values() if axis.base is not None}
    return usual | dict(given)


def camera_of(base: Camera, settings: AnyMapping) -> Camera:
    """The camera of a cell.

    The distortion stays what it is in millimetres on the detector when pixels change, and in pixels
    when the focal length does. StudyError for a distortion that folds over inside the field, or
    terms that cancel.
    """
    camera = base
    if "pixels" in settings:
        n = settings["pixels"]
        camera = _resampled(camera, n / camera.width_px, n, n)
    if "pixel_um" in settings:
        if camera.pixel_um is None:
            raise StudyError(
                "the axis pixel_um needs the pitch of the camera: state pixel_um under [camera]."
            )
        camera = _resampled(
            camera, camera.pixel_um / settings["pixel_um"], camera.width_px, camera.height_px
        )
    if "fov_deg" in settings:
        half_rad = 0.5 * math.radians(settings["fov_deg"])
        plane = get_model(settings.get("distortion", camera.distortion)).plane
        camera = camera.replace(focal_px=camera.width_px / (2.0 * plane.radius(half_rad)))
    if "focal_mm" in settings:
        camera = camera.replace(focal_mm=settings["focal_mm"])
    if "x0_offset_px" in settings:
        camera = camera.replace(x0_px=camera.centre_px[0] + settings["x0_offset_px"])
    if "y0_offset_px" in settings:
        camera = camera.replace(y0_px=camera.centre_px[1] + settings["y0_offset_px"])
    if "distortion" in settings:
        camera = camera.replace(distortion=settings["distortion"])
    names = [c.name for c in get_model(camera.distortion).coefficients]
    own = {name: settings[name] for name in names if name in settings}
    if own:
        known = dict(zip(names, camera.coefficients, strict=True)) | own
        camera = camera.replace(coefficients=tuple(known.values()))
    if "distortion_px" in settings and get_model(camera.distortion).lens:
        camera = _with_displacement(camera, settings["distortion_px"])
    if camera.folds:
        raise StudyError("the distortion folds over inside the field: make it smaller.")
    return camera


def _resampled(camera: Camera, finer: float, width: int, height: int) -> Camera:
    """The same optics over `width` x `height` pixels, `finer` of them to an old one."""
    orders = [c.order for c in get_model(camera.distortion).coefficients]
    new = camera.replace(
        width_px=width,
        height_px=height,
        pixel_um=None if camera.pixel_um is None else camera.pixel_um / finer,
        focal_px=camera.focal_px * finer,
        coefficients=tuple(
            k * finer ** (1 - n) for k, n in zip(camera.coefficients, orders, strict=True)
        ),
    )
    x, y = camera.centre_px
    return new.replace(
        x0_px=new.centre_px[0] + finer * (camera.x0_px - x),
        y0_px=new.centre_px[1] + finer * (camera.y0_px - y),
    )


def _with_displacement(camera: Camera, wanted_px: float) -> Camera:
    """All coefficients scaled alike, so that the corner moves outwards by so much; the first alone,
    where all are 0.
    """
    model = get_model(camera.distortion)
    n = len(model.lens)
    given, axes = camera.coefficients[:n], camera.coefficients[n:]
    if not any(given):
        given = (1.0, *given[1:])
    terms = [
        corner_displacement_px(camera, [k * (i == j) for j in range(len(given))])
        for i, k in enumerate(given)
    ]
    total = sum(terms)
    if abs(total) <= _CANCELLED * sum(map(abs, terms)):
        raise StudyError(
            "distortion_px: the terms of the camera's distortion cancel in the corner, so that "
            "it has no size; "
            "change the coefficients of [camera], or set them to zero."
        )
    sign = 1.0 if model.direction == "forward" else -1.0
    return camera.replace(coefficients=(*(sign * wanted_px / total * k for k in given), *axes))
