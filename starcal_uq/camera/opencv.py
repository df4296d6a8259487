"""Conversion of a camera's parameters to OpenCV's matrix and distortion coefficients, and back.

OpenCV distorts normalised coordinates (x - x0) / f, this package offsets in pixels; the pixel
origin is the same. So k1_cv = k1 f^2, k2_cv = k2 f^4, k3_cv = k3 f^6 and p_cv = p f (OpenCV,
"Camera Calibration and 3D Reconstruction"). Both apply the camera matrix last, so that fx = f, fy =
f (1 + stretch), and the matrix's element (0, 1) is f skew.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.distortion import get_model, with_axes
from starcal_uq.camera.planes import EQUIDISTANT
from starcal_uq.core.errors import CameraError, DistortionError
from starcal_uq.core.types import FloatArray, floats

# Place in OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4), of which the first thin-prism
# terms of each axis are s1 and s3, and the power of f that makes our coefficient dimensionless.
_PINHOLE = {"k1": (0, 2), "k2": (1, 4), "p1": (2, 1), "p2": (3, 1), "k3": (4, 6)}
_PINHOLE |= {"s1": (8, 1), "s2": (10, 1)}
# The same in the (k1, k2, k3, k4) of OpenCV's fisheye.
_FISHEYE = {"k1": (0, 2), "k2": (1, 4), "k3": (2, 6), "k4": (3, 8)}
# fx and fy of one focal length may differ by rounding in a text file, not by more.
_SQUARE_RTOL = 1e-9


def to_opencv(distortion: str, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Camera matrix (3, 3) in pixels and coefficients (5,), with a thin prism (12,), of a fisheye
    (4,), from x0, y0, f, k... in pixels.

    CameraError for an inverse distortion model.
    """
    model = get_model(distortion)
    if model.direction != "forward":
        raise CameraError(
            f"camera: distortion {distortion!r} maps distorted to ideal points, which OpenCV has "
            "no "
            "coefficients for; calibrate with 'brown' to use OpenCV."
        )
    x0, y0, f, *coefficients = theta.tolist()
    places = _FISHEYE if model.plane is EQUIDISTANT else _PINHOLE
    last = max((places[c.name][0] for c in model.lens), default=0)
    dist = np.zeros(4 if places is _FISHEYE else 12 if last >= 5 else 5)
    for coefficient, value in zip(model.lens, coefficients, strict=False):
        index, power = places[coefficient.name]
        dist[index] = value * f**power
    stretch, skew = coefficients[-2:] if model.axes else (0.0, 0.0)
    return np.array([[f, f * skew, x0], [0.0, f * (1.0 + stretch), y0], [0.0, 0.0, 1.0]]), dist


def from_opencv(
    camera_matrix: ArrayLike,
    dist_coeffs: ArrayLike | None,
    distortion: str | None,
    fisheye: bool = False,
) -> tuple[str, list[float]]:
    """Distortion model and x0, y0, f, k... in pixels; see ``Camera.from_opencv``."""
    x0, y0, f, axes = _pinhole(floats(camera_matrix))
    dist = np.zeros(0) if dist_coeffs is None else floats(dist_coeffs).ravel()
    if not np.all(np.isfinite(dist)):
        raise CameraError("dist_coeffs: give finite numbers.")
    places = _FISHEYE if fisheye else _PINHOLE
    known = [index for index, _ in places.values()]
    if np.any(np.delete(dist, [index for index in known if index < len(dist)]) != 0.0):
        raise CameraError(
            "dist_coeffs: rational and tilt terms, and the thin-prism terms s2 and s4 of OpenCV, "
            "have no counterpart here; repeat OpenCV's calibration without those flags."
        )
    dist = np.concatenate([dist, np.zeros(12)])
    values = {key: float(dist[index]) / f**power for key, (index, power) in places.items()}
    try:
        smallest = _smallest_model(values)
        model = get_model(distortion or (with_axes(smallest) if any(axes) else smallest))
    except DistortionError as error:
        raise CameraError(f"camera: {error}") from None
    if any(axes) and not model.axes:
        raise CameraError(
            f"camera_matrix: it has fx != fy or skew, and distortion {model.name!r} has square "
            f"pixels; use {with_axes(model.name)!r}."
        )
    own = [c.name for c in model.lens]
    lost = [key for key, value in values.items() if value != 0.0 and key not in own]
    if fisheye is not (model.plane is EQUIDISTANT):
        lost = ["the projection of a fisheye" if fisheye else "a pinhole projection"]
    if model.direction != "forward":
        lost = ["coefficients that map ideal to distorted points"]
    if lost:
        raise CameraError(
            f"dist_coeffs: distortion {model.name!r} cannot hold {', '.join(lost)}; choose "
            "another distortion, or repeat OpenCV's calibration with fewer coefficients (k3, p1 "
            "and p2, or the thin prism, fixed at zero)."
        )
    return model.name, [x0, y0, f, *(values[key] for key in own), *(axes if model.axes else ())]


def _pinhole(matrix: FloatArray) -> tuple[float, float, float, tuple[float, float]]:
    """x0, y0 and f in px, and stretch and skew of the axes."""
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)):
        raise CameraError("camera_matrix: give a 3x3 matrix of finite numbers.")
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    if min(fx, fy) <= 0.0:
        raise CameraError(
            f"camera_matrix: the focal lengths are {fx!r} and {fy!r}; they must be above 0."
        )
    if matrix[1, 0] != 0.0 or tuple(matrix[2]) != (0.0, 0.0, 1.0):
        raise CameraError(
            "camera_matrix: it has a scaled last row, or a number below its diagonal; give "
            "[[fx, s, x0], [0, fy, y0], [0, 0, 1]]."
        )
    stretch = (fy - fx) / fx
    if abs(stretch) <= _SQUARE_RTOL:
        stretch = 0.0
    return float(matrix[0, 2]), float(matrix[1, 2]), fx, (stretch, float(matrix[0, 1]) / fx)


def _smallest_model(values: Mapping[str, float]) -> str:
    used = {name for name, value in values.items() if value != 0.0}
    if "k4" in values:
        return "fisheye" if used & {"k3", "k4"} else "equidistant"
    if used & {"s1", "s2"}:
        return "thin_prism"
    if used & {"p1", "p2"}:
        return "brown_tangential"
    return "brown3" if "k3" in used else "brown"
