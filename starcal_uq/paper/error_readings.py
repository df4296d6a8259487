"""The readings of "reprojection error" and "residual": what the paper's Table 2 and Figs. 4 to 6 may show.

Eq. 16 leaves open whether measured points carry noise, which r enters eq. 14, and whether eq. 14 or eq. 6 undistorts.
Section 3.3 does not define its residual at all. Every reading below is computed, for each method and seed, so that no
printed number is called irreproducible before all of them were tried.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import DistortionError
from starcal_uq.core.types import FloatArray
from starcal_uq.paper.errors import (
    Optics,
    PointErrors,
    Undistortion,
    detector_grid,
    map_error,
    reprojection_error_px,
)


@dataclass(frozen=True)
class ErrorReading:
    """One way to compute an error of a calibrated camera in pixels.

    Attributes
    ----------
    key : str
        Short name, in tables.
    words : str
        In words.
    faithful : bool
        Whether the paper's text allows it.
    undistortion, optics
        As in `reprojection_error_px`; the undistortion ``crossed`` puts the coefficients into the other equation.
    noisy : bool
        With centroid noise.
    rotated : bool
        After the best rotation of the field instead (`map_error`).
    per_axis : bool
        Per coordinate instead of per star.
    whole_field : bool
        Over the detector instead of over the stars.
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


# Table 2, last column. The first is the main reading.
REPROJECTION = (
    ErrorReading("eq16", "eq. 16 without noise", True),
    ErrorReading("eq16 r measured", "eq. 16, r of the measured point", True, undistortion="eq14_measured"),
    ErrorReading("eq16 crossed", "eq. 16, coefficients put into the other equation", True, undistortion="crossed"),
    ErrorReading("eq16 noisy", "eq. 16 with centroid noise", True, noisy=True),
    ErrorReading("eq16 per axis", "eq. 16 per coordinate", False, per_axis=True),
    ErrorReading("eq16 own f", "eq. 16, ideal points with the estimated f", False, optics="focal"),
    ErrorReading("eq16 own optics", "eq. 16, ideal points with all estimated optics", False, optics="estimate"),
    ErrorReading("map", "best rotation removed", False, rotated=True),
    ErrorReading("map per axis", "best rotation removed, per coordinate", False, rotated=True, per_axis=True),
)
# Figs. 4 to 6: the largest. The text allows all of them.
MAXIMUM = (
    ErrorReading("eq16 field", "eq. 16 over the detector", True, whole_field=True),
    ErrorReading("eq16 stars", "eq. 16 at the stars", True),
    ErrorReading("eq16 noisy", "eq. 16 at the stars, with noise", True, noisy=True),
    ErrorReading("eq16 crossed", "eq. 16, coefficients put into the other equation", True, "crossed", whole_field=True),
    ErrorReading("eq16 own f", "eq. 16, ideal points with the estimated f", True, optics="focal", whole_field=True),
    ErrorReading("eq16 own optics", "eq. 16, all estimated optics", True, optics="estimate", whole_field=True),
    ErrorReading("map field", "best rotation removed, over the detector", True, rotated=True, whole_field=True),
    ErrorReading("map stars", "best rotation removed, at the stars", True, rotated=True),
)


def point_errors(
    reading: ErrorReading, truth: Camera, estimate: Camera, xy_px: FloatArray, noise_px: FloatArray | None = None
) -> tuple[PointErrors, FloatArray]:
    """Errors of one reading, and the weights (n,) of the points, which sum to one.

    Parameters
    ----------
    reading : ErrorReading
        What to compute.
    truth, estimate : Camera
        The cameras.
    xy_px : (N, 2) array
        Where stars are seen without noise.
    noise_px : (N, 2) array, optional
        Their noise, for readings that have some; none is added without it.
    """
    points, weight = np.asarray(xy_px, dtype=np.float64), np.full(len(xy_px), 1.0 / len(xy_px))
    if reading.whole_field:
        points, weight = detector_grid(truth)
    if reading.rotated:
        return PointErrors(map_error(truth, estimate, points).error_px), weight
    how: Undistortion = "model"
    if reading.undistortion == "crossed":
        how = "eq6" if truth.distortion == "brown" else "eq14"
    elif reading.undistortion == "eq14_measured" and truth.distortion == "brown":
        how = "eq14_measured"
    found = reprojection_error_px(
        truth,
        estimate,
        points,
        noise_px=noise_px if reading.noisy else None,
        undistortion=how,
        optics=reading.optics,
    )
    return found, weight


def error_sizes(
    truth: Camera, estimate: Camera, xy_px: FloatArray, noise_px: FloatArray
) -> Iterator[tuple[str, ErrorReading, float]]:
    """Every reading of the reprojection error and of the largest residual: quantity, reading and value in px.

    Readings that an estimate does not have, because its distortion folds over within the field, are left out.
    """
    found: dict[tuple[object, ...], tuple[PointErrors, FloatArray] | None] = {}
    for quantity, readings in (("reprojection_px", REPROJECTION), ("max_residual_px", MAXIMUM)):
        for reading in readings:
            # Several readings look at the same points.
            key = (reading.undistortion, reading.optics, reading.noisy, reading.rotated, reading.whole_field)
            if key not in found:
                try:
                    found[key] = point_errors(reading, truth, estimate, xy_px, noise_px)
                except DistortionError:
                    found[key] = None
            errors = found[key]
            if errors is not None:
                value = rms_px(reading, *errors) if quantity == "reprojection_px" else errors[0].max_px
                yield quantity, reading, value


def rms_px(reading: ErrorReading, errors: PointErrors, weight: FloatArray) -> float:
    """Root mean square of the errors of a reading, px, from what `point_errors` gives."""
    square = float(np.sum(weight * np.sum(errors.error_px**2, axis=1)))
    return float(np.sqrt(0.5 * square if reading.per_axis else square))
