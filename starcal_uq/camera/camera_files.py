"""Camera files: TOML in and out, and the sentences that say what is wrong with one."""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.camera.distortion import get_model, model_names
from starcal_uq.core.errors import CameraError, DistortionError

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic_core import ErrorDetails

_HEADER = """\
# Star camera.
#
# Pixels: x to the right, y down; (0, 0) is the centre of the first pixel, so that the detector spans
# -0.5 ... width_px - 0.5 along x and -0.5 ... height_px - 0.5 along y.
# width_px, height_px, x0_px, y0_px: pixels. pixel_um: micrometres. focal_mm: millimetres.
# x0_px, y0_px: principal point. Distortion coefficients act on offsets in pixels from it:
# k1 px^-2, k2 px^-4, k3 px^-6, p1 and p2 px^-1.
"""
_DIRECTION = {
    "forward": "# distortion maps ideal (pinhole) points to distorted (measured) points.\n",
    "inverse": "# distortion maps distorted (measured) points to ideal (pinhole) points.\n",
}
# What to write for a key: said wherever the key is missing or wrong.
_WANTED = {
    "width_px": "the width of the detector in pixels, a whole number above 0",
    "height_px": "the height of the detector in pixels, a whole number above 0",
    "pixel_um": "the pitch of the square pixels in micrometres, a number above 0",
    "focal_mm": "the focal length in millimetres, a number above 0",
    "x0_px": "the principal point along x in pixels, a finite number",
    "y0_px": "the principal point along y in pixels, a finite number",
    "distortion": "the name of the distortion model, one of " + ", ".join(model_names()),
    "name": "a name in quotes",
}


@lru_cache
def _schema(distortion: str) -> type[BaseModel]:
    """Schema of the [camera] table: it depends on the model, which names its own coefficients."""
    from pydantic import ConfigDict, Field, create_model

    pixels = (int, Field(gt=0))
    positive = (float, Field(gt=0.0))
    fields: dict[str, Any] = {
        "width_px": pixels,
        "height_px": pixels,
        "pixel_um": positive,
        "focal_mm": positive,
        "x0_px": (float, ...),
        "y0_px": (float, ...),
        "distortion": (str, "brown"),
        "name": (str, ""),
    }
    fields.update({c.name: (float, 0.0) for c in get_model(distortion).coefficients})
    # Strict: a whole number may stand for a float, but no text or truth value for a number.
    config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    return create_model("CameraTable", __config__=config, **fields)


def _problem(error: ErrorDetails, distortion: str) -> str:
    key = str(error["loc"][0])
    wanted = _WANTED.get(key, "a finite number")
    if error["type"] == "missing":
        return f"key {key} is missing; add {wanted}"
    if error["type"] != "extra_forbidden":
        return f"key {key} is {error['input']!r}; write {wanted}"
    own = [c.name for c in get_model(distortion).coefficients]
    models = [n for n in model_names() if key in {c.name for c in get_model(n).coefficients}]
    if models:
        return (
            f"key {key} is no coefficient of distortion {distortion!r} (it has {', '.join(own) or 'none'}); "
            f"remove it or set distortion to {' or '.join(map(repr, models))}"
        )
    near = difflib.get_close_matches(key, [*_WANTED, *own], n=1)
    hint = f"did you mean {near[0]}?" if near else f"remove it (known: {', '.join([*_WANTED, *own])})"
    return f"key {key} is unknown; {hint}"


def parse_table(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Arguments of ``Camera`` from a [camera] table.

    Parameters
    ----------
    table
        Keys and values of the table.
    where
        What to call the table in messages, such as ``"camera.toml, section [camera]"``.

    Raises
    ------
    CameraError
        For an unknown or missing key, or a value of the wrong type, not finite or out of range.
    """
    from pydantic import ValidationError

    distortion = table.get("distortion", "brown")
    if not isinstance(distortion, str):
        raise CameraError(f"{where}: key distortion is {distortion!r}; write {_WANTED['distortion']}.")
    try:
        coefficients = get_model(distortion).coefficients
    except DistortionError as error:
        raise CameraError(f"{where}: key distortion: {error}") from None
    try:
        values = _schema(distortion).model_validate(dict(table)).model_dump()
    except ValidationError as error:
        problems = [_problem(e, distortion) for e in error.errors()]
        others = len(problems) - 1
        more = f" ({others} more bad key{'s' if others > 1 else ''})" if others else ""
        end = "" if problems[0].endswith("?") and not more else "."
        raise CameraError(f"{where}: {problems[0]}{more}{end}") from None
    values["coefficients"] = tuple(values.pop(c.name) for c in coefficients)
    return values


def read_camera(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Arguments of ``Camera`` from a TOML file.

    Raises
    ------
    CameraError
        If the file cannot be read, is no TOML, has no [camera] section, or its section is wrong.
    """
    path = Path(path)
    if os.path.isdir(path):
        raise CameraError(f"{path}: is a directory; name the camera's TOML file.")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise CameraError(f"{path}: the camera file does not exist; check the path.") from None
    except OSError as error:
        raise CameraError(
            f"{path}: the camera file cannot be read ({error.strerror}); check its permissions."
        ) from error
    except UnicodeDecodeError:
        raise CameraError(f"{path}: the camera file is not UTF-8 text; save it as TOML in UTF-8.") from None
    if not text.strip():
        raise CameraError(f"{path}: the camera file is empty; write a [camera] section with its keys.")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise CameraError(f"{path}: the camera file is not valid TOML: {error}; correct that line.") from None
    section = content.pop("camera", None)
    if section is None:
        raise CameraError(f"{path}: section [camera] is missing; write [camera] above the camera's keys.")
    if not isinstance(section, dict):
        raise CameraError(f"{path}: camera is no section; write [camera] above the camera's keys.")
    if content:
        first = next(iter(content))
        raise CameraError(f"{path}: {first} stands outside section [camera]; remove it or move it below [camera].")
    return parse_table(section, f"{path}, section [camera]")


def camera_text(table: Mapping[str, Any]) -> str:
    """The TOML file of a [camera] table, with the conventions as comments; numbers keep every digit."""
    import tomli_w

    direction = get_model(table["distortion"]).direction
    return _HEADER + _DIRECTION[direction] + "\n" + tomli_w.dumps({"camera": dict(table)})
