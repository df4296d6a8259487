"""Directions over the detector: grid, tangent axes, and the rotation that fits a field of
displacements best.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera


def detector_axes(camera: Camera, n: int) -> tuple[FloatArray, FloatArray]:
    """Grid lines x (n,) and y (n,) in px, from edge to edge of the detector; ValueError for fewer
    than two.
    """
    if n < 2:
        raise ValueError(f"a map needs at least 2 grid points along each side, not {n}.")
    return np.linspace(-0.5, camera.width_px - 0.5, n), np.linspace(-0.5, camera.height_px - 0.5, n)


def grid_points(x: FloatArray, y: FloatArray) -> FloatArray:
    """Points (ny * nx, 2) of a grid; x runs fastest."""
    return np.column_stack([grid.ravel() for grid in np.meshgrid(x, y)])


def detector_corners(camera: Camera) -> FloatArray:
    """Corners (4, 2) of the detector, px."""
    return grid_points(*detector_axes(camera, 2))


def corner_displacement_px(camera: Camera, coefficients: Sequence[Any]) -> Any:
    """Displacement of the farthest corner away from the principal point, px, by coefficients that
    are numbers or (n,).
    """
    u, v = camera.corner_px
    du, dv = get_model(camera.distortion).displacement(u, v, coefficients)
    return (du * u + dv * v) / math.hypot(u, v)


def area_weights(n: int) -> FloatArray:
    """Weights (n * n,) by the trapezoidal rule, of sum one: points on an edge stand for half the
    area.
    """
    side = np.ones(n)
    side[[0, -1]] = 0.5
    weights = np.outer(side, side).ravel()
    normalised: FloatArray = weights / weights.sum()
    return normalised


def tangent_axes(b: FloatArray) -> FloatArray:
    """Axes (N, 2, 3) of the tangent planes of directions b (N, 3): camera X laid into the plane,
    and b cross that.
    """
    along_x = np.array([1.0, 0.0, 0.0]) - b[:, :1] * b
    along_x /= np.linalg.norm(along_x, axis=1, keepdims=True)
    return np.stack([along_x, np.cross(b, along_x)], axis=1)


def rotation_response(b: FloatArray, B: FloatArray, w: FloatArray) -> FloatArray:
    """Rotation (3, p) that fits the displacements B (N, 3, p) of directions b (N, 3) best, with
    weights w (N,).

    A phi = phi x b, so that A^T A = I - b b^T and A^T B = b x B.
    """
    normal = np.einsum("n,nij->ij", w, np.eye(3) - b[:, :, None] * b[:, None, :])
    torque = np.einsum("n,npi->ip", w, np.cross(b[:, None], np.swapaxes(B, 1, 2)))
    return np.linalg.solve(normal, torque)


def rotated(K: FloatArray, b: FloatArray) -> FloatArray:
    """Displacements (N, 3, p) of the directions b (N, 3) by the rotations K (3, p)."""
    return np.swapaxes(np.cross(K.T[None], b[:, None]), 1, 2)
