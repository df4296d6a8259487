"""The camera: detector, optics and distortion, with units in every name.

Pixels: x to the right, y down, (0, 0) is the *centre* of the first pixel; the detector therefore
spans [-0.5, width_px - 0.5] x [-0.5, height_px - 0.5].
"""

from __future__ import annotations

import dataclasses
import math
import operator
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.distortion import (
    AXES_SUFFIX,
    PARAMETERS,
    get_model,
    model_names,
    parameter_names,
    shared_names,
    undistorted,
    with_axes,
)
from starcal_uq.camera.formats import read_pinhole
from starcal_uq.camera.opencv import from_opencv, to_opencv
from starcal_uq.camera.spice import fitted_optics, read_kernel
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import CameraError, DistortionError
from starcal_uq.core.files import reading, shown, split_part
from starcal_uq.core.settings import KEYS, ModelName
from starcal_uq.core.toml import Key, Section, read_section, unknown_key, write_section
from starcal_uq.core.types import AnyDict, AnyMapping, BoolArray, FloatArray, PathLike, floats
from starcal_uq.core.units import plain


@dataclass(frozen=True)
class Camera(Shown):
    """A star camera.

    Attributes
    ----------
    width_px, height_px : int
        Size of the detector, pixels.
    pixel_um : float or None
        Pixel pitch along x, micrometres; None where it is unknown, and then nothing has
        millimetres.
    focal_mm : float or None
        Focal length, millimetres; None where the pitch is unknown. It may be left to `focal_px`.
    x0_px, y0_px : float
        Principal point, pixels; it may lie outside the detector.
    distortion : str
        Name of the distortion model (`starcal_uq.camera.distortion.model_names`); with ``+axes``
        behind it, the pixels need not be square.
    coefficients : tuple of float
        Coefficients of that model in its order, on offsets in pixels, with ``+axes`` followed by
        stretch and skew of the axes; zeros by default.
    name : str
        Free text.
    focal_px : float
        Focal length, pixels: that of `focal_mm` and `pixel_um` where both are given.

    Raises
    ------
    CameraError
        If a value is not finite, the focal length is neither given in pixels nor with the pitch, a
        size is not positive, or the coefficients do not fit the distortion model.
    """

    width_px: int
    height_px: int
    pixel_um: float | None
    focal_mm: float | None
    x0_px: float
    y0_px: float
    distortion: str = "brown"
    coefficients: tuple[float, ...] = ()
    name: str = ""
    focal_px: float = 0.0

    def __post_init__(self) -> None:
        try:
            model = get_model(self.distortion)
        except DistortionError as error:
            raise CameraError(f"camera: {error}") from None
        for key in ("width_px", "height_px"):
            self._set(key, _whole(key, getattr(self, key)))
        lengths = ["focal_px" if self.focal_mm is None else "focal_mm"]
        if self.pixel_um is not None:
            lengths.append("pixel_um")
        for key in (*lengths, "x0_px", "y0_px"):
            self._set(key, _finite(key, plain(key, getattr(self, key))))
        for key in ("width_px", "height_px", *lengths):
            if getattr(self, key) <= 0:
                raise CameraError(f"camera: {key} is {getattr(self, key)!r}; it must be above 0.")
        if self.focal_mm is None:
            if self.pixel_um is not None:
                self._set("focal_mm", self.length_mm(self.focal_px))
        elif self.pixel_um is None:
            raise CameraError(
                f"camera: focal_mm is {self.focal_mm!r}, but the pixel pitch is unknown: give "
                "pixel_um as well, or "
                "focal_px in its place."
            )
        if self.focal_mm is not None and self.pixel_um is not None:
            self._set("focal_px", self.focal_mm * 1000.0 / self.pixel_um)
        names = [c.name for c in model.coefficients]
        given = tuple(self.coefficients) or (0.0,) * len(names)
        if len(given) != len(names):
            raise CameraError(
                f"camera: {len(given)} coefficients for distortion {model.name!r}; "
                f"give {len(names)} ({', '.join(names) or 'none'}), or leave them out for zeros."
            )
        self._set("coefficients", tuple(_finite(n, k) for n, k in zip(names, given, strict=True)))
        if self.axes[0] <= -1.0:
            raise CameraError(f"camera: stretch is {self.axes[0]!r}; it must be above -1.")

    def _set(self, key: str, value: object) -> None:
        object.__setattr__(self, key, value)

    @property
    def theta(self) -> FloatArray:
        """Parameters x0, y0, f, k... in pixels, shape (p,)."""
        return np.array([self.x0_px, self.y0_px, self.focal_px, *self.coefficients])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of `theta`."""
        return parameter_names(self.distortion)

    @property
    def axes(self) -> tuple[float, float]:
        """Stretch (scale along y over that along x, less one) and skew; zeros of square pixels."""
        stretch, skew = self.coefficients[-2:] if get_model(self.distortion).axes else (0.0, 0.0)
        return stretch, skew

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Full horizontal and vertical field of the ideal projection centred on the detector,
        degrees.
        """
        angle, f = get_model(self.distortion).plane.angle, self.focal_px
        return (
            math.degrees(2.0 * angle(self.width_px / (2.0 * f))),
            math.degrees(2.0 * angle(self.height_px / (2.0 * f))),
        )

    @property
    def centre_px(self) -> tuple[float, float]:
        """Centre of the detector (x, y), pixels."""
        return (self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0

    @property
    def corner_px(self) -> tuple[float, float]:
        """The farthest corner of the detector, from the principal point, pixels."""
        x, y = (
            max(-0.5 - at, size - 0.5 - at, key=abs)
            for size, at in ((self.width_px, self.x0_px), (self.height_px, self.y0_px))
        )
        return x, y

    @property
    def corner_radius_px(self) -> float:
        """Distance of the principal point from the farthest corner of the detector, pixels."""
        return math.hypot(*self.corner_px)

    @property
    def half_diagonal_px(self) -> float:
        """Half of the detector's diagonal, pixels: the corner's distance from the centre."""
        return 0.5 * math.hypot(self.width_px, self.height_px)

    def length_mm(self, length_px: float) -> float:
        """Millimetres of a length on the detector.

        Raises
        ------
        CameraError
            If the pixel pitch is unknown.
        """
        if self.pixel_um is None:
            raise CameraError(
                "camera: nothing is in millimetres, because the pixel pitch is unknown; state "
                "pixel_um."
            )
        return length_px * self.pixel_um / 1000.0

    def length_text(self, length_px: float, digits: int) -> str:
        """A length on the detector, such as the focal length: in millimetres, or in pixels of
        unknown pitch.
        """
        if self.pixel_um is None:
            return f"{length_px:.{digits}g} px"
        return f"{self.length_mm(length_px):.{digits}g} mm"

    @property
    def model(self) -> ModelName:
        """The distortion model by its name, as `starcal_uq.calibrate` takes it."""
        return cast("ModelName", self.distortion)

    @property
    def folds(self) -> bool:
        """True if the distortion folds over within the detector."""
        from starcal_uq.camera.projection import fold_radius_px

        radius = self.corner_radius_px
        return fold_radius_px(self.distortion, self.theta, radius) <= radius

    def contains(self, xy: ArrayLike) -> BoolArray:
        """True for each point on the detector, edges included.

        Parameters
        ----------
        xy
            Points, shape (..., 2), pixels; a point that is not finite is not on the detector.

        Returns
        -------
        array of bool, shape (...)
        """
        points = floats(xy)
        limit = np.array([self.width_px - 0.5, self.height_px - 0.5])
        inside: BoolArray = np.all((points >= -0.5) & (points <= limit), axis=-1)
        return inside

    def project(self, b_cam: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of directions (..., 3) in the camera frame (`camera.project`)."""
        from starcal_uq.camera.projection import project

        directions = floats(b_cam)
        return project(self, directions).reshape(*directions.shape[:-1], 2)

    def unproject(self, xy_px: ArrayLike) -> FloatArray:
        """Unit vectors (..., 3) in the camera frame of pixels (..., 2) (`camera.unproject`)."""
        from starcal_uq.camera.projection import unproject

        pixels = floats(xy_px)
        return unproject(self, pixels).reshape(*pixels.shape[:-1], 3)

    def wcs(self, attitude: ArrayLike, tolerance_px: float = 0.01) -> Any:
        """`astropy.wcs.WCS` (TAN-SIP) of a frame with a quaternion (4,); `camera.sip.camera_wcs`."""
        from starcal_uq.camera.sip import camera_wcs

        return camera_wcs(self, attitude, tolerance_px)

    def with_theta(self, theta: ArrayLike) -> Camera:
        """The same detector with other parameters.

        Parameters
        ----------
        theta
            x0, y0, f, k... in pixels, shape (p,), in the order of `parameter_names`.
        """
        values = floats(theta)
        if values.shape != (len(self.parameter_names),):
            raise CameraError(
                f"camera: theta has shape {values.shape}; give {len(self.parameter_names)} values "
                f"({', '.join(self.parameter_names)})."
            )
        x0, y0, f, *coefficients = values.tolist()
        return self.replace(x0_px=x0, y0_px=y0, focal_px=f, coefficients=tuple(coefficients))

    def data_sheet(self) -> Camera:
        """Camera of the data sheet: principal point in the centre, no distortion, the same axes."""
        x0, y0 = self.centre_px
        return self.with_theta(undistorted(self.distortion, self.theta)).replace(x0_px=x0, y0_px=y0)

    def replace(self, **changes: Any) -> Camera:
        """A copy with some attributes changed.

        With another `distortion` and no `coefficients`, those of the same name are kept and the
        others are zero; between a forward and an inverse model only the axes can be kept. A
        `pixel_um` where there was none keeps `focal_px`, and so does None.

        Raises
        ------
        CameraError
            For an unknown attribute, or a `distortion` that would make square what is not.
        """
        if "distortion" in changes and "coefficients" not in changes:
            try:
                new = get_model(changes["distortion"])
            except DistortionError as error:
                raise CameraError(f"camera: {error}") from None
            if not new.axes and any(self.axes):
                raise CameraError(
                    f"camera: distortion {new.name!r} has square pixels, and those of this camera "
                    f"are not square or have skewed axes; use {with_axes(new.name)!r}."
                )
            own = dict(zip(self.parameter_names[3:], self.coefficients, strict=True))
            kept = {name: own[name] for name in shared_names(self.distortion, new.name)}
            changes["coefficients"] = tuple(kept.get(c.name, 0.0) for c in new.coefficients)
        known = {field.name for field in dataclasses.fields(self)}
        if unknown := sorted(set(changes) - known):
            raise CameraError(
                f"camera: no attribute {unknown[0]!r}; use one of {', '.join(sorted(known))}."
            )
        if "focal_px" in changes or None in (self.pixel_um, changes.get("pixel_um", self.pixel_um)):
            changes.setdefault("focal_mm", None)
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> AnyDict:
        """The [camera] table: plain values, coefficients under their own names."""
        table = dataclasses.asdict(self)
        for key in (
            "coefficients",
            *(("focal_px",) if self.pixel_um is not None else ("pixel_um", "focal_mm")),
        ):
            del table[key]
        name = table.pop("name")
        names = (c.name for c in get_model(self.distortion).coefficients)
        table.update(zip(names, self.coefficients, strict=True))
        return {"name": name, **table} if name else table

    @classmethod
    def from_dict(cls, table: AnyMapping) -> Camera:
        """Camera from the [camera] table; distortion (brown), coefficients (zero) and name are
        optional.

        Raises
        ------
        CameraError
            For an unknown or missing key or a value that does not fit.
        """
        return cls(**_checked(table, "camera"))

    @classmethod
    def load(cls, path: PathLike) -> Camera:
        """Read a camera from a TOML file, or from one of OpenCV, ROS, Kalibr, mrcal, GIANT or SPICE by its
        ending.

        A SPICE instrument kernel (``.ti``) with several cameras takes the NAIF ID of one of them
        behind a ``#``: ``"nh_lorri_v201.ti#-98301"``. x is its sample, y its line.

        Raises
        ------
        CameraError
            If the file cannot be read or its content does not fit; the message names file, key and
            remedy.
        """
        if os.fspath(path).endswith((".yaml", ".yml", ".cameramodel", ".xml")):
            return cls._of_others(path)
        file, instrument = split_part(path)
        if file.lower().endswith(".ti"):
            return cls._of_kernel(file, instrument)
        return cls(
            **_checked(read_section(path, "camera", CameraError), f"{path}, section [camera]")
        )

    @classmethod
    def _of_others(cls, path: PathLike) -> Camera:
        with reading(
            path, "a camera of OpenCV, ROS, Kalibr, mrcal or GIANT", "check the file", CameraError
        ):
            held = read_pinhole(Path(path).read_text(encoding="utf-8"))
        try:
            return cls.from_opencv(
                held.matrix,
                held.dist_coeffs,
                held.width_px,
                held.height_px,
                held.pixel_um,
                fisheye=held.fisheye,
                name=held.name,
            )
        except CameraError as error:
            raise CameraError(f"{path}: {error}") from None

    @classmethod
    def _of_kernel(cls, path: str, instrument: int | None) -> Camera:
        with reading(path, "an instrument kernel of SPICE", "check the file", CameraError):
            held = read_kernel(Path(path).read_text(encoding="utf-8", errors="replace"), instrument)
            return cls(**fitted_optics(held))

    def save(self, path: PathLike, force: bool = False) -> None:
        """Write the camera to a TOML file without loss of digits.

        Raises
        ------
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        header = _HEADER if self.pixel_um is not None else _HEADER.replace(_LENGTHS, _PIXELS)
        model = get_model(self.distortion)
        header += _AXES_HEADER if model.axes else ""
        header += _DIRECTION[model.direction].format(model.plane.name) + "\n"
        write_section(path, "camera", self.to_dict(), header, force)

    def to_opencv(self) -> tuple[FloatArray, FloatArray]:
        """Matrix and coefficients of the camera for OpenCV, which has the same pixel origin.

        OpenCV distorts normalised coordinates: k1_cv = k1 f^2, k2_cv = k2 f^4, k3_cv = k3 f^6, p_cv
        = p f; its thin-prism terms s1 and s3 are our s1 f and s2 f. The coefficients of `f_theta`,
        `equidistant` and `fisheye` are those of ``cv2.fisheye``.

        Returns
        -------
        camera_matrix : array, shape (3, 3)
            Pixels.
        dist_coeffs : array, shape (5,), (12,) with a thin prism, or (4,) of a fisheye
            Dimensionless, in OpenCV's order.

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
        pixel_um: float | None,
        *,
        distortion: str | None = None,
        fisheye: bool = False,
        name: str = "",
    ) -> Camera:
        """A camera from OpenCV's matrix and coefficients.

        Parameters
        ----------
        camera_matrix
            Shape (3, 3), pixels.
        dist_coeffs
            k1, k2[, p1, p2[, k3, ...]], or of a fisheye k1, k2, k3, k4; any shape; None or empty
            for none. Coefficients without a counterpart must be zero.
        width_px, height_px, pixel_um
            The detector, of which OpenCV keeps no record; the pitch may be None.
        distortion
            Distortion model to use; by default the smallest of brown, brown3, brown_tangential and
            thin_prism, or of equidistant and fisheye, that holds the coefficients, with ``+axes``
            for fx != fy or skew.
        fisheye
            Whether the coefficients are those of ``cv2.fisheye``.

        Raises
        ------
        CameraError
            For fx != fy, skew, or coefficients that the distortion model cannot hold.
        """
        model, theta = from_opencv(camera_matrix, dist_coeffs, distortion, fisheye)
        return cls(
            width_px=width_px,
            height_px=height_px,
            pixel_um=pixel_um,
            focal_mm=None,
            focal_px=theta[2],
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
# k1 px^-2, k2 px^-4, k3 px^-6, k4 px^-8, p1, p2, s1 and s2 px^-1.
"""
_AXES_HEADER = """\
# stretch: scale along y over that along x, less one. skew: shift along x with the offset along y.
# pixel_um and the focal length are those along x.
"""

_LENGTHS = "pixel_um: micrometres. focal_mm: millimetres."
_PIXELS = "focal_px: pixels; where the pitch is known, pixel_um and focal_mm."
_DIRECTION = {
    "forward": "# distortion maps ideal ({}) points to distorted (measured) points.\n",
    "inverse": "# distortion maps distorted (measured) points to ideal ({}) points.\n",
}

_WORDS = {
    "width_px": "the width of the detector in pixels",
    "height_px": "the height of the detector in pixels",
    "pixel_um": (
        "the pitch of the pixels in micrometres, or [along x, along y] (if it is unknown, focal_px "
        "in place of focal_mm)"
    ),
    "focal_mm": "the focal length in millimetres",
    "focal_px": "the focal length in pixels",
    "x0_px": "the principal point along x in pixels",
    "y0_px": "the principal point along y in pixels",
}
_KEYS = {
    **{name: Key.number(KEYS[name], words, required=True) for name, words in _WORDS.items()},
    "distortion": Key(
        str,
        f"the name of the distortion model, one of {', '.join(model_names())}, with {AXES_SUFFIX} "
        "behind it for free axes",
    ),
    "name": Key(str, "a name in quotes"),
}


@dataclass(frozen=True)
class _CameraSection(Section):
    """Schema of the [camera] table, which names the coefficients of its distortion model."""

    distortion: str = ""

    def unknown(self, key: str) -> str:
        own = [c.name for c in get_model(self.distortion).coefficients]
        models = [n for n in model_names() if key in {c.name for c in get_model(n).lens}]
        plane = get_model(self.distortion).plane
        models = [n for n in models if get_model(n).plane is plane] or models
        if key in PARAMETERS and not models:
            models = [with_axes(self.distortion)]
        if key == "focal_mm":
            return "keys focal_mm and focal_px both state the focal length; remove one"
        if not models:
            return unknown_key(key, self.keys)
        return (
            f"key {key} is no coefficient of distortion {self.distortion!r} (it has "
            f"{', '.join(own) or 'none'}); "
            f"remove it or set distortion to {' or '.join(map(repr, models))}"
        )


@lru_cache
def _section(distortion: str, in_pixels: bool) -> Section:
    """Schema for a focal length in pixels, where the pitch may be unknown, or in millimetres."""
    keys = {
        name: key
        for name, key in _KEYS.items()
        if name != ("focal_mm" if in_pixels else "focal_px")
    }
    if in_pixels:
        keys["pixel_um"] = Key.number(KEYS["pixel_um"], _WORDS["pixel_um"])
    own = {
        c.name: Key.number(KEYS["coefficient"], "the coefficient")
        for c in get_model(distortion).coefficients
    }
    return _CameraSection({**keys, **own}, CameraError, distortion=distortion)


def _checked(table: AnyMapping, where: str) -> AnyDict:
    """Arguments of ``Camera`` from a [camera] table, which `where` names in messages."""
    distortion = table.get("distortion", "brown")
    if not isinstance(distortion, str):
        raise CameraError(
            f"{where}: key distortion is {distortion!r}; write {_KEYS['distortion'].wanted}."
        )
    try:
        if isinstance(table.get("pixel_um"), (list, tuple)):
            table, distortion = _pitches(table, with_axes(distortion), where), with_axes(distortion)
        coefficients = get_model(distortion).coefficients
    except DistortionError as error:
        raise CameraError(f"{where}: key distortion: {error}") from None
    values = _section(distortion, "focal_px" in table).check(table, where)
    values = {"pixel_um": None, "focal_mm": None, **values}
    values["coefficients"] = tuple(values.pop(c.name, 0.0) for c in coefficients)
    return values


def _pitches(table: AnyMapping, distortion: str, where: str) -> AnyDict:
    """The table with the pitch along x, and the stretch of the axes that both pitches state."""
    pitches, limit = list(table["pixel_um"]), KEYS["pixel_um"]
    numbers = [v for v in pitches if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(pitches) != 2 or len(numbers) != 2 or not limit.holds(numbers):
        raise CameraError(
            f"{where}: key pixel_um is {shown(pitches)}; write one pitch in micrometres, or two in "
            f"brackets, [along x, along y], each {limit.wanted().removeprefix('give ')}."
        )
    if "stretch" in table:
        raise CameraError(
            f"{where}: key pixel_um states two pitches, and key stretch their ratio; remove one."
        )
    along_x, along_y = map(float, numbers)
    return {
        **table,
        "pixel_um": along_x,
        "distortion": distortion,
        "stretch": along_x / along_y - 1.0,
    }
