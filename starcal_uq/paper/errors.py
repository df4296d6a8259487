"""How far a calibrated camera is from the true one, in pixels of its image.

Two measures, both of which need a truth and therefore a simulation:

- `reprojection_error_px` is eq. 16 of Ye & Yang 2017: undistorted measured points against ideal ones. Ideal points of
  the true camera (their eq. 15 with their Table 1) make it blind to a wrong focal length; those of the estimated one
  under the true attitude make it a measure of the principal point.
- `map_error` compares the directions that two cameras give to the same pixels, after the best common rotation, which
  every attitude takes up, is removed. It is blind to nothing that angles between stars can see.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from starcal_uq.attitude.rotations import rotation_vector
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.types import FloatArray

ARCSEC = 648_000.0 / np.pi
_GRID = 33
_FIXED_POINT_STEPS = 40

Undistortion = Literal["model", "eq14", "eq14_measured", "eq6"]
UNDISTORTIONS: tuple[Undistortion, ...] = ("model", "eq14", "eq14_measured", "eq6")
Optics = Literal["truth", "focal", "estimate"]
OPTICS: tuple[Optics, ...] = ("truth", "focal", "estimate")


@dataclass(frozen=True)
class PointErrors:
    """Errors of points of the image.

    Attributes
    ----------
    error_px : (N, 2) array
        Estimated minus true, px.
    """

    error_px: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square length, px: eq. 16, whose sum runs over points and not over coordinates."""
        return float(np.sqrt(np.mean(np.sum(self.error_px**2, axis=1))))

    @property
    def rms_per_axis_px(self) -> float:
        """Root mean square of a coordinate, px."""
        return float(np.sqrt(np.mean(self.error_px**2)))

    @property
    def max_px(self) -> float:
        """Largest length, px."""
        return float(np.max(np.hypot(*self.error_px.T)))


@dataclass(frozen=True)
class MapError:
    """Difference of the direction maps of two cameras, the best common rotation removed.

    Attributes
    ----------
    xy_px : (N, 2) array
        Where they are compared.
    error_px : (N, 2) array
        By how much the true camera would have to displace the point to give the estimated direction, px.
    error_arcsec : (N,) array
        Angle between the two directions.
    weight : (N,) array
        Share of each point in the mean squares; sums to one.
    rotation_arcsec : (3,) array
        The rotation removed: pitch, yaw and roll that the wrong camera adds to every attitude.
    """

    xy_px: FloatArray
    error_px: FloatArray
    error_arcsec: FloatArray
    weight: FloatArray
    rotation_arcsec: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square length, px."""
        return float(np.sqrt(np.sum(self.weight * np.sum(self.error_px**2, axis=1))))

    @property
    def max_px(self) -> float:
        """Largest length, px."""
        return float(np.max(np.hypot(*self.error_px.T)))

    @property
    def rms_arcsec(self) -> float:
        """Root mean square angle."""
        return float(np.sqrt(np.sum(self.weight * self.error_arcsec**2)))

    @property
    def max_arcsec(self) -> float:
        """Largest angle."""
        return float(np.max(self.error_arcsec))


def detector_grid(camera: Camera, n: int = _GRID) -> tuple[FloatArray, FloatArray]:
    """Points (n^2, 2) from edge to edge of the detector, and weights (n^2,) that make a mean over its area.

    Raises
    ------
    ValueError
        For fewer than two points along a side.
    """
    if n < 2:
        raise ValueError(f"a grid needs at least 2 points along each side, not {n}.")
    x = np.linspace(-0.5, camera.width_px - 0.5, n)
    y = np.linspace(-0.5, camera.height_px - 0.5, n)
    # Simpson's rule where it applies: the squared distortion grows as the tenth power of the radius.
    side = np.ones(n)
    side[[0, -1]] = 0.5
    if n % 2 == 1:
        side = np.where(np.arange(n) % 2 == 1, 4.0, 2.0) / 3.0
        side[[0, -1]] = 1.0 / 3.0
    weight = np.outer(side, side).ravel()
    return np.column_stack([grid.ravel() for grid in np.meshgrid(x, y)]), weight / weight.sum()


def map_error(truth: Camera, estimate: Camera, xy_px: FloatArray | None = None, *, n: int = _GRID) -> MapError:
    """Compare the directions that two cameras give to the same pixels, the best common rotation removed.

    Parameters
    ----------
    truth, estimate : Camera
        The cameras; their distortion models may differ.
    xy_px : (N, 2) array, optional
        Where, such as the places of stars, with equal weights; without it, a grid over the detector, weighted by area.
    n : int
        Grid points along each side.

    Raises
    ------
    DistortionError
        When the distortion of a camera folds over within these points.
    """
    if xy_px is None:
        xy, weight = detector_grid(truth, n)
    else:
        xy = np.asarray(xy_px, dtype=np.float64).reshape(-1, 2)
        weight = np.full(len(xy), 1.0 / len(xy))
    true = unproject(truth, xy)
    turned, rotation = aligned(unproject(estimate, xy), true, weight)
    chord = np.linalg.norm(turned - true, axis=1)
    return MapError(
        xy_px=xy,
        error_px=project(truth, turned) - xy,
        error_arcsec=2.0 * np.arcsin(0.5 * chord) * ARCSEC,
        weight=weight,
        rotation_arcsec=rotation_vector(rotation) * ARCSEC,
    )


def aligned(estimated: FloatArray, true: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turn directions (N, 3) by the rotation that brings them closest to others, in weighted least squares.

    Returns
    -------
    (N, 3) array
        The turned directions.
    (3, 3) array
        The rotation that was taken off: ``estimated = R true`` but for what remains.
    """
    rotation = quest(estimated, true, np.array([0, len(true)]), weight, covariance=False).rotations[0]
    return estimated @ rotation, rotation


def undistorted(camera: Camera, xy_px: FloatArray, how: Undistortion = "model") -> FloatArray:
    """Points (N, 2) freed of distortion.

    Parameters
    ----------
    camera : Camera
        Principal point and coefficients; a camera without coefficients leaves the points where they are.
    xy_px : (N, 2) array
        Measured points.
    how : {"model", "eq14", "eq14_measured", "eq6"}
        ``model``: as the camera's own distortion model says. The others take its first two coefficients as those of one
        equation of the paper: eq. 14 with r of the ideal point, which makes it implicit; eq. 14 with r of the measured
        point; eq. 6.

    Raises
    ------
    ValueError
        For another `how`.
    DistortionError
        When the camera's own distortion folds over within these points.
    """
    xy = np.asarray(xy_px, dtype=np.float64).reshape(-1, 2)
    if how not in UNDISTORTIONS:
        raise ValueError(f"undistortion {how!r} is unknown: use one of {', '.join(UNDISTORTIONS)}.")
    centre = camera.theta[:2]
    if how == "model":
        b = unproject(camera, xy)
        return centre + camera.focal_px * b[:, :2] / b[:, 2:]
    k1, k2 = (*camera.coefficients[:2], 0.0, 0.0)[:2]
    offset = xy - centre

    def growth(points: FloatArray) -> FloatArray:
        r2: FloatArray = np.sum(points**2, axis=1, keepdims=True)
        return np.asarray(k1 * r2 + k2 * r2**2)

    if how == "eq6":
        return centre + offset * (1.0 + growth(offset))
    ideal = offset / (1.0 + growth(offset))
    for _ in range(_FIXED_POINT_STEPS if how == "eq14" else 0):
        ideal = offset / (1.0 + growth(ideal))
    return centre + ideal


def reprojection_error_px(
    truth: Camera,
    estimate: Camera,
    xy_px: FloatArray,
    *,
    noise_px: FloatArray | None = None,
    undistortion: Undistortion = "model",
    optics: Optics = "truth",
) -> PointErrors:
    """The paper's reprojection error (eq. 16) under one of its readings.

    Parameters
    ----------
    truth, estimate : Camera
        The cameras.
    xy_px : (N, 2) array
        Where the true camera sees the stars without noise.
    noise_px : (N, 2) array, optional
        Centroid noise added to the points before they are undistorted.
    undistortion : {"model", "eq14", "eq14_measured", "eq6"}
        How the estimated coefficients are applied (`undistorted`).
    optics : {"truth", "focal", "estimate"}
        Whose f and principal point make the ideal points of eq. 15, under the true attitude: those of Table 1, the
        estimated f with the principal point of Table 1, or both estimated.

    Returns
    -------
    PointErrors
        Undistorted minus ideal points.

    Raises
    ------
    DistortionError
        When the distortion of a camera folds over within these points.
    """
    if optics not in OPTICS:
        raise ValueError(f"optics {optics!r} is unknown: use one of {', '.join(OPTICS)}.")
    xy = np.asarray(xy_px, dtype=np.float64).reshape(-1, 2)
    ideal = undistorted(truth, xy)
    corrected = undistorted(estimate, xy if noise_px is None else xy + noise_px, undistortion)
    if optics == "truth":
        return PointErrors(corrected - ideal)
    offset = (ideal - truth.theta[:2]) * (estimate.focal_px / truth.focal_px)
    return PointErrors(corrected - offset - (truth if optics == "focal" else estimate).theta[:2])
