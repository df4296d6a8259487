"""Projection by OpenCV, for Brown's model; its coefficients are in units of the focal length."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Result = dict[str, Any]
X0, Y0, F, K1, K2 = 500.0, 530.0, 70.2262 / 0.012, 2.0e-10, -3.5e-15


def pixels(points: int) -> np.ndarray:
    """Random places on the detector."""
    return np.random.default_rng(0).uniform(0.0, 1023.0, (points, 2))


def directions(points: int) -> np.ndarray:
    """Random directions inside the field."""
    xy = (pixels(points) - [X0, Y0]) / F
    b = np.column_stack([xy, np.ones(points)])
    return b / np.linalg.norm(b, axis=1, keepdims=True)


def _opencv() -> tuple[Any, np.ndarray, np.ndarray]:
    import cv2

    cv2.setNumThreads(1)
    return (
        cv2,
        np.array([[F, 0.0, X0], [0.0, F, Y0], [0.0, 0.0, 1.0]]),
        np.array([K1 * F**2, K2 * F**4, 0.0, 0.0]),
    )


def project(folder: Path, *, points: int) -> Callable[[], Result]:
    """`cv2.projectPoints`."""
    cv2, matrix, distortion = _opencv()
    b, zero = directions(points), np.zeros(3)
    return lambda: {"xy": cv2.projectPoints(b, zero, zero, matrix, distortion)[0][:1000, 0]}


def unproject(folder: Path, *, points: int) -> Callable[[], Result]:
    """`cv2.undistortPoints`, and unit vectors of what it gives; iterated to the precision that ours
    has.
    """
    cv2, matrix, distortion = _opencv()
    xy = pixels(points)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-12)

    def run() -> Result:
        plane = cv2.undistortPoints(xy, matrix, distortion, None, None, matrix, stop)[:, 0]
        b = np.column_stack([(plane - [X0, Y0]) / F, np.ones(points)])
        return {"b": (b / np.linalg.norm(b, axis=1, keepdims=True))[:1000]}

    return run
