"""How far a calibrated camera is from the true one, in pixels of its image.

Two measures, both of which need a truth and therefore a simulation:

- `reprojection_error_px` is eq. 16 of Ye & Yang 2017: undistorted measured points against ideal
  ones. Ideal points of the true camera (their eq. 15 with their Table 1) make it blind to a wrong
  focal length; those of the estimated one under the true attitude make it a measure of the
  principal point.
- `map_error` compares the directions that two cameras give to the same pixels, after the best
  common rotation, which every attitude takes up, is removed. It is blind to nothing that angles
  between stars can see.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from starcal_uq.attitude.rotations import rotation_vector
from starcal_uq.attitude.wahba import aligned
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.fields import detector_axes, grid_points
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import DistortionError, check_known
from starcal_uq.core.types import FloatArray, floats

_GRID = 33
_FIXED_POINT_STEPS = 40
Undistortion = Literal["model", "eq14", "eq14_measured", "eq6"]
UNDISTORTIONS: tuple[Undistortion, ...] = get_args(Undistortion)
Optics = Literal["truth", "focal", "estimate"]
OPTICS: tuple[Optics, ...] = get_args(Optics)


@dataclass(frozen=True)
class PointErrors:
    """Errors of points of the image, estimated minus true, (N, 2) px."""

    error_px: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square length, px: eq. 16, whose sum runs over points and not over
        coordinates.
        """
        return float(np.sqrt(np.mean(np.sum(self.error_px**2, axis=1))))

    @property
    def max_px(self) -> float:
        """Largest length, px."""
        return float(np.max(np.hypot(*self.error_px.T)))


@dataclass(frozen=True)
class MapError(PointErrors):
    """Difference of the direction maps of two cameras at places (N, 2) px, the best common rotation
    removed.

    `error_px` (N, 2) is what the true camera would have to displace the point by to give the
    estimated direction, `error_arcsec` (N,) the angle between the two; `weight` (N,) sums to one;
    `rotation_arcsec` (3,) is the pitch, yaw and roll that were removed, and that the wrong camera
    adds to every attitude.
    """

    xy_px: FloatArray
    error_arcsec: FloatArray
    weight: FloatArray
    rotation_arcsec: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square length, px."""
        return float(np.sqrt(np.sum(self.weight * np.sum(self.error_px**2, axis=1))))

    @property
    def rms_arcsec(self) -> float:
        """Root mean square angle."""
        return float(np.sqrt(np.sum(self.weight * self.error_arcsec**2)))

    @property
    def max_arcsec(self) -> float:
        """Largest angle."""
        return float(np.max(self.error_arcsec))


def detector_grid(camera: Camera, n: int = _GRID) -> tuple[FloatArray, FloatArray]:
    """Points (n^2, 2) from edge to edge of the detector, and weights (n^2,) that make a mean over
    its area.

    Raises ValueError for fewer than two points along a side.
    """
    if n < 2:
        raise ValueError(f"a grid needs at least 2 points along each side, not {n}.")
    # Simpson's rule where it applies: the squared distortion grows as the tenth power of the
    # radius.
    side = np.ones(n)
    side[[0, -1]] = 0.5
    if n % 2 == 1:
        side = np.where(np.arange(n) % 2 == 1, 4.0, 2.0) / 3.0
        side[[0, -1]] = 1.0 / 3.0
    weight = np.outer(side, side).ravel()
    return grid_points(*detector_axes(camera, n)), weight / weight.sum()


def map_error(
    truth: Camera, estimate: Camera, xy_px: FloatArray | None = None, *, n: int = _GRID
) -> MapError:
    """Compare the directions that two cameras give to the same pixels, the best common rotation
    removed.

    At places `xy_px` (N, 2), such as those of stars, with equal weights; without them on a grid of
    `n` points along each side of the detector, weighted by area. DistortionError when a distortion
    folds over within these points.
    """
    if xy_px is None:
        xy, weight = detector_grid(truth, n)
    else:
        xy = floats(xy_px).reshape(-1, 2)
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


def undistorted(camera: Camera, xy_px: FloatArray, how: Undistortion = "model") -> FloatArray:
    """Points (N, 2) freed of distortion; a camera without coefficients leaves them where they are.

    With `how` ``model`` as the camera's own distortion model says. The others take its first two
    coefficients as those of one equation of the paper: eq. 14 with r of the ideal point, which
    makes it implicit; eq. 14 with r of the measured point; eq. 6. DistortionError when the camera's
    own distortion folds over within these points.
    """
    xy = floats(xy_px).reshape(-1, 2)
    check_known("undistortion", how, UNDISTORTIONS, ValueError)
    centre = camera.theta[:2]
    if how == "model":
        b = unproject(camera, xy)
        return centre + camera.focal_px * b[:, :2] / b[:, 2:]
    k1, k2 = (*camera.coefficients[:2], 0.0, 0.0)[:2]
    offset = xy - centre

    def growth(points: FloatArray) -> FloatArray:
        r2: FloatArray = np.sum(points**2, axis=1, keepdims=True)
        return k1 * r2 + k2 * r2**2

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

    The true camera sees the stars at `xy_px` (N, 2), to which `noise_px` (N, 2) is added before
    they are undistorted (`undistorted`) by the estimated coefficients. `optics` are the origin of
    the ideal points of eq. 15, under the true attitude: f and principal point of Table 1, the
    estimated f ("focal") with the principal point of Table 1, or both estimated. DistortionError
    when a distortion folds over within these points.
    """
    check_known("optics", optics, OPTICS, ValueError)
    xy = floats(xy_px).reshape(-1, 2)
    ideal = undistorted(truth, xy)
    corrected = undistorted(estimate, xy if noise_px is None else xy + noise_px, undistortion)
    if optics == "truth":
        return PointErrors(corrected - ideal)
    offset = (ideal - truth.theta[:2]) * (estimate.focal_px / truth.focal_px)
    return PointErrors(corrected - offset - (truth if optics == "focal" else estimate).theta[:2])


class ErrorReading(NamedTuple):
    """One way to compute an error of a calibrated camera in pixels.

    `faithful` says whether the paper's text allows it; undistortion and optics are as in
    `reprojection_error_px`, and the undistortion ``crossed`` puts the coefficients into the other
    equation. Errors may be taken with centroid noise, after the best rotation of the field, per
    coordinate instead of per star, or over the whole detector.
    """

    key: str
    words: str
    faithful: bool
    undistortion: str = "model"
    optics: Optics = "truth"
    noisy: bool = False
    rotated: bool = False
    per_axis: bool = False
    whole_field: bool = False


_DECLARED = tomllib.loads(Path(__file__).with_name("error_readings.toml").read_text("utf-8"))
# Readings of the error sizes that are printed, by their quantities; the main one of each first.
ERROR_READINGS = {
    quantity: tuple(ErrorReading(**row) for row in rows) for quantity, rows in _DECLARED.items()
}


def point_errors(
    reading: ErrorReading,
    truth: Camera,
    estimate: Camera,
    xy_px: FloatArray,
    noise_px: FloatArray | None = None,
) -> tuple[PointErrors, FloatArray]:
    """Errors of one reading, and the weights (n,) of the points, which sum to one.

    Stars are seen at `xy_px` (N, 2) without noise; `noise_px` is added for readings that have some.
    """
    points, weight = floats(xy_px), np.full(len(xy_px), 1.0 / len(xy_px))
    if reading.whole_field:
        points, weight = detector_grid(truth)
    if reading.rotated:
        return PointErrors(map_error(truth, estimate, points).error_px), weight
    how: Undistortion = "model"
    if reading.undistortion == "crossed":
        how = "eq6" if truth.distortion == "brown" else "eq14"
    elif reading.undistortion == "eq14_measured" and truth.distortion == "brown":
        how = "eq14_measured"
    noise = noise_px if reading.noisy else None
    found = reprojection_error_px(
        truth, estimate, points, noise_px=noise, undistortion=how, optics=reading.optics
    )
    return found, weight


def error_sizes(
    truth: Camera, estimate: Camera, xy_px: FloatArray, noise_px: FloatArray
) -> Iterator[tuple[str, ErrorReading, float]]:
    """Every reading of the reprojection error and of the largest residual: quantity, reading and
    value in px.

    Readings that an estimate does not have, because its distortion folds over within the field, are
    left out.
    """
    found: dict[tuple[object, ...], tuple[PointErrors, FloatArray] | None] = {}
    for quantity, readings in ERROR_READINGS.items():
        for reading in readings:
            # Several readings look at the same points.
            key = (
                reading.undistortion,
                reading.optics,
                reading.noisy,
                reading.rotated,
                reading.whole_field,
            )
            if key not in found:
                try:
                    found[key] = point_errors(reading, truth, estimate, xy_px, noise_px)
                except DistortionError:
                    found[key] = None
            errors = found[key]
            if errors is not None:
                yield quantity, reading, error_size(quantity, reading, *errors)


def error_size(
    quantity: str, reading: ErrorReading, errors: PointErrors, weight: FloatArray
) -> float:
    """Largest length, or root mean square, of what `point_errors` gives for a reading, px."""
    if quantity == "max_residual_px":
        return errors.max_px
    square = float(np.sum(weight * np.sum(errors.error_px**2, axis=1)))
    return float(np.sqrt(0.5 * square if reading.per_axis else square))
