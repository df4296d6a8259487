"""The camera: detector, optics and distortion, with units in every name.

Pixels: x to the right, y down, (0, 0) is the *centre* of the first pixel; the detector therefore spans
[-0.5, width_px - 0.5] x [-0.5, height_px - 0.5].
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import operator
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.distortion import get_model, model_names, parameter_names
from starcal_uq.camera.opencv import from_opencv, to_opencv
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CameraError, DistortionError
from starcal_uq.core.files import atomic_write_text, ensure_new
from starcal_uq.core.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic_core import ErrorDetails


@dataclass(frozen=True)
class Camera(Shown):
    """A star camera with square pixels.

    Attributes
    ----------
    width_px, height_px : int
        Size of the detector, pixels.
    pixel_um : float
        Pixel pitch, micrometres.
    focal_mm : float
        Focal length, millimetres.
    x0_px, y0_px : float
        Principal point, pixels; it may lie outside the detector.
    distortion : str
        Name of the distortion model (`starcal_uq.camera.distortion.model_names`).
    coefficients : tuple of float
        Coefficients of that model in its order, on offsets in pixels; zeros by default.
    name : str
        Free text.

    Raises
    ------
    CameraError
        If a value is not finite, a size is not positive, or the coefficients do not fit the distortion model.
    """

    width_px: int
    height_px: int
    pixel_um: float
    focal_mm: float
    x0_px: float
    y0_px: float
    distortion: str = "brown"
    coefficients: tuple[float, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        try:
            model = get_model(self.distortion)
        except DistortionError as error:
            raise CameraError(f"camera: {error}") from None
        for key in ("width_px", "height_px"):
            self._set(key, _whole(key, getattr(self, key)))
        for key in ("pixel_um", "focal_mm", "x0_px", "y0_px"):
            self._set(key, _finite(key, getattr(self, key)))
        for key in ("width_px", "height_px", "pixel_um", "focal_mm"):
            if getattr(self, key) <= 0:
                raise CameraError(f"camera: {key} is {getattr(self, key)!r}; it must be above 0.")
        names = [c.name for c in model.coefficients]
        given = tuple(self.coefficients) or (0.0,) * len(names)
        if len(given) != len(names):
            raise CameraError(
                f"camera: {len(given)} coefficients for distortion {model.name!r}; "
                f"give {len(names)} ({', '.join(names) or 'none'}), or leave them out for zeros."
            )
        self._set("coefficients", tuple(_finite(n, k) for n, k in zip(names, given, strict=True)))

    def _set(self, key: str, value: object) -> None:
        object.__setattr__(self, key, value)

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return self.focal_mm * 1000.0 / self.pixel_um

    @property
    def theta(self) -> FloatArray:
        """Parameters x0, y0, f, k... in pixels, shape (p,)."""
        return np.array([self.x0_px, self.y0_px, self.focal_px, *self.coefficients])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of `theta`."""
        return parameter_names(self.distortion)

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Full horizontal and vertical field of an ideal pinhole centred on the detector, degrees."""
        f = self.focal_px
        return (
            math.degrees(2.0 * math.atan(self.width_px / (2.0 * f))),
            math.degrees(2.0 * math.atan(self.height_px / (2.0 * f))),
        )

    @property
    def centre_px(self) -> tuple[float, float]:
        """Centre of the detector (x, y), pixels."""
        return (self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0

    @property
    def corner_radius_px(self) -> float:
        """Distance of the principal point from the farthest corner of the detector, pixels."""
        dx = max(abs(-0.5 - self.x0_px), abs(self.width_px - 0.5 - self.x0_px))
        dy = max(abs(-0.5 - self.y0_px), abs(self.height_px - 0.5 - self.y0_px))
        return math.hypot(dx, dy)

    def contains(self, xy: ArrayLike) -> BoolArray:
        """Whether each point lies on the detector, edges included.

        Parameters
        ----------
        xy
            Points, shape (..., 2), pixels; a point that is not finite is not on the detector.

        Returns
        -------
        array of bool, shape (...)
        """
        points = np.asarray(xy, dtype=np.float64)
        limit = np.array([self.width_px - 0.5, self.height_px - 0.5])
        inside: BoolArray = np.all((points >= -0.5) & (points <= limit), axis=-1)
        return inside

    def with_theta(self, theta: ArrayLike) -> Camera:
        """The same detector with other parameters.

        Parameters
        ----------
        theta
            x0, y0, f, k... in pixels, shape (p,), in the order of `parameter_names`.
        """
        values = np.asarray(theta, dtype=np.float64)
        if values.shape != (len(self.parameter_names),):
            raise CameraError(
                f"camera: theta has shape {values.shape}; give {len(self.parameter_names)} values "
                f"({', '.join(self.parameter_names)})."
            )
        x0, y0, f, *coefficients = values.tolist()
        focal_mm = f * self.pixel_um / 1000.0
        return self.replace(x0_px=x0, y0_px=y0, focal_mm=focal_mm, coefficients=tuple(coefficients))

    def replace(self, **changes: Any) -> Camera:
        """A copy with some attributes changed.

        With another `distortion` and no `coefficients`, those of the same name are kept and the others are
        zero; between a forward and an inverse model nothing can be kept.
        """
        if "distortion" in changes and "coefficients" not in changes:
            try:
                new = get_model(changes["distortion"])
            except DistortionError as error:
                raise CameraError(f"camera: {error}") from None
            old = get_model(self.distortion)
            kept: dict[str, float] = {}
            if new.direction == old.direction:
                kept = dict(zip((c.name for c in old.coefficients), self.coefficients, strict=True))
            changes["coefficients"] = tuple(kept.get(c.name, 0.0) for c in new.coefficients)
        known = {field.name for field in dataclasses.fields(self)}
        if unknown := sorted(set(changes) - known):
            raise CameraError(f"camera: no attribute {unknown[0]!r}; use one of {', '.join(sorted(known))}.")
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """The [camera] table: plain values, coefficients under their own names."""
        table = dataclasses.asdict(self)
        del table["coefficients"]
        name = table.pop("name")
        names = (c.name for c in get_model(self.distortion).coefficients)
        table.update(zip(names, self.coefficients, strict=True))
        return {"name": name, **table} if name else table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Camera:
        """A camera from the [camera] table; distortion (brown), coefficients (zero) and name may be left out.

        Raises
        ------
        CameraError
            For an unknown or missing key or a value that does not fit.
        """
        return cls(**parse_table(table, "camera"))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Camera:
        """Read a camera from a TOML file.

        Raises
        ------
        CameraError
            If the file cannot be read or its content does not fit; the message names file, key and remedy.
        """
        return cls(**read_camera(path))

    def save(self, path: str | os.PathLike[str], force: bool = False) -> None:
        """Write the camera to a TOML file without loss of digits.

        Raises
        ------
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        ensure_new(path, force)
        atomic_write_text(path, camera_text(self.to_dict()))

    def to_opencv(self) -> tuple[FloatArray, FloatArray]:
        """The same camera for OpenCV, whose pixel origin is ours.

        OpenCV distorts normalised coordinates: k1_cv = k1 f^2, k2_cv = k2 f^4, k3_cv = k3 f^6, p_cv = p f.

        Returns
        -------
        camera_matrix : array, shape (3, 3)
            Pixels.
        dist_coeffs : array, shape (5,)
            k1, k2, p1, p2, k3, dimensionless.

        Raises
        ------
        CameraError
            For an inverse distortion model, which OpenCV has not.
        """
        return to_opencv(self.distortion, self.theta)

    @classmethod
    def from_opencv(
        cls,
        camera_matrix: ArrayLike,
        dist_coeffs: ArrayLike | None,
        width_px: int,
        height_px: int,
        pixel_um: float,
        *,
        distortion: str | None = None,
        name: str = "",
    ) -> Camera:
        """A camera from OpenCV's matrix and coefficients.

        Parameters
        ----------
        camera_matrix
            Shape (3, 3), pixels.
        dist_coeffs
            k1, k2[, p1, p2[, k3]], any shape; None or empty for none. Further coefficients must be zero.
        width_px, height_px, pixel_um
            The detector, of which OpenCV keeps no record.
        distortion
            Distortion model to use; by default the smallest of brown, brown3 and brown_tangential that
            holds the coefficients.

        Raises
        ------
        CameraError
            For fx != fy, skew, or coefficients that the distortion model cannot hold.
        """
        model, theta = from_opencv(camera_matrix, dist_coeffs, distortion)
        return cls(
            width_px=width_px,
            height_px=height_px,
            pixel_um=pixel_um,
            focal_mm=theta[2] * pixel_um / 1000.0,
            x0_px=theta[0],
            y0_px=theta[1],
            distortion=model,
            coefficients=tuple(theta[3:]),
            name=name,
        )


def _whole(key: str, value: Any) -> int:
    try:
        if isinstance(value, bool):
            raise TypeError
        return operator.index(value)
    except TypeError:
        raise CameraError(f"camera: {key} is {value!r}; give a whole number.") from None


def _finite(key: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise CameraError(f"camera: {key} is {value!r}; give a number.") from None
    if not math.isfinite(number):
        raise CameraError(f"camera: {key} is {number!r}; give a finite number.")
    return number


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
