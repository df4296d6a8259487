"""Conversion of a camera's parameters to OpenCV's matrix and distortion coefficients, and back.

OpenCV distorts normalised coordinates (x - x0) / f, this package offsets in pixels; the pixel
origin is the same. So k1_cv = k1 f^2, k2_cv = k2 f^4, k3_cv = k3 f^6 and p_cv = p f (OpenCV,
"Camera Calibration and 3D Reconstruction").
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import CameraError, DistortionError
from starcal_uq.core.types import FloatArray, floats

# Place in OpenCV's (k1, k2, p1, p2, k3), and the power of f that makes our coefficient
# dimensionless.
_OPENCV = {"k1": (0, 2), "k2": (1, 4), "p1": (2, 1), "p2": (3, 1), "k3": (4, 6)}
# fx and fy of one focal length may differ by rounding in a text file, not by more.
_SQUARE_RTOL = 1e-9


def to_opencv(distortion: str, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Camera matrix (3, 3) in pixels and coefficients k1, k2, p1, p2, k3 (5,) from x0, y0, f, k...
    in pixels.

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
    dist = np.zeros(5)
    for coefficient, value in zip(model.coefficients, coefficients, strict=True):
        index, power = _OPENCV[coefficient.name]
        dist[index] = value * f**power
    return np.array([[f, 0.0, x0], [0.0, f, y0], [0.0, 0.0, 1.0]]), dist


def from_opencv(
    camera_matrix: ArrayLike, dist_coeffs: ArrayLike | None, distortion: str | None
) -> tuple[str, list[float]]:
    """Distortion model and x0, y0, f, k... in pixels; see ``Camera.from_opencv``."""
    x0, y0, f = _pinhole(floats(camera_matrix))
    dist = np.zeros(0) if dist_coeffs is None else floats(dist_coeffs).ravel()
    if not np.all(np.isfinite(dist)):
        raise CameraError("dist_coeffs: give finite numbers.")
    if np.any(dist[5:] != 0.0):
        raise CameraError(
            "dist_coeffs: rational, thin-prism and tilt terms have no counterpart here; "
            "repeat OpenCV's calibration without those flags."
        )
    dist = np.concatenate([dist, np.zeros(5)])[:5]
    values = {key: float(dist[index]) / f**power for key, (index, power) in _OPENCV.items()}
    try:
        model = get_model(distortion or _smallest_model(values))
    except DistortionError as error:
        raise CameraError(f"camera: {error}") from None
    own = [c.name for c in model.coefficients]
    lost = [key for key, value in values.items() if value != 0.0 and key not in own]
    if model.direction != "forward":
        lost = ["coefficients that map ideal to distorted points"]
    if lost:
        raise CameraError(
            f"dist_coeffs: distortion {model.name!r} cannot hold {', '.join(lost)}; choose "
            "another distortion, "
            "or repeat OpenCV's calibration with k3, or p1 and p2, fixed at zero."
        )
    return model.name, [x0, y0, f, *(values[key] for key in own)]


def _pinhole(matrix: FloatArray) -> tuple[float, float, float]:
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)):
        raise CameraError("camera_matrix: give a 3x3 matrix of finite numbers.")
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    if fx <= 0.0:
        raise CameraError(f"camera_matrix: the focal length is {fx!r}; it must be above 0.")
    if abs(fy - fx) > _SQUARE_RTOL * fx:
        raise CameraError(
            f"camera_matrix: fx = {fx!r} and fy = {fy!r} differ, but pixels are square here; "
            "repeat OpenCV's calibration with CALIB_FIX_ASPECT_RATIO."
        )
    if matrix[0, 1] != 0.0 or matrix[1, 0] != 0.0 or tuple(matrix[2]) != (0.0, 0.0, 1.0):
        raise CameraError(
            "camera_matrix: it has skew or a scaled last row; give [[f, 0, x0], [0, f, y0], [0, "
            "0, 1]]."
        )
    return float(matrix[0, 2]), float(matrix[1, 2]), fx


def _smallest_model(values: Mapping[str, float]) -> str:
    if values["p1"] != 0.0 or values["p2"] != 0.0:
        return "brown_tangential"
    return "brown3" if values["k3"] != 0.0 else "brown"
