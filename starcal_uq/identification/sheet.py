"""The camera before its frames are identified, and its tolerances."""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import Protocol

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import IdentificationError
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.identification.pyramid import CameraTolerance
from starcal_uq.identification.search import CentroidTable
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.observations.origin import CentroidsOrigin

# A frame is searched again when a tolerance is smaller than this part of what it was.
_BETTER = 0.7
# Error of the principal point that is allowed for: a part of the detector's width, but not more
# than so many pixels.
CENTRE, LARGEST_CENTRE_PX = 0.02, 20.0
# Where images do not say it: a focal length in detector widths to begin with.
_ASSUMED_FOCAL = 5.0


class CalibratedCamera(Protocol):
    """A `Calibration` or a `Posterior`: a camera with the covariance of its parameters."""

    @property
    def camera(self) -> Camera: ...
    @property
    def covariance(self) -> FloatArray: ...


def sheet_of(centroids: CentroidTable) -> tuple[Camera, bool]:
    """The camera as its images describe it, and whether they say its focal length; their size must
    be stated.
    """
    said = CentroidsOrigin.of(getattr(centroids, "meta", {})).optics
    if not said:
        raise IdentificationError(
            "the centroids do not say the size of their images: give a camera, or measure the "
            "images again."
        )
    width, height = int(said["width_px"]), int(said["height_px"])
    pixel, focal_mm, focal_px = said.get("pixel_um"), said.get("focal_mm"), said.get("focal_px")
    if focal_px is None and pixel and focal_mm:
        focal_px = 1000.0 * focal_mm / pixel
    focal = focal_px if focal_px else _ASSUMED_FOCAL * width
    centre = (width - 1) / 2.0, (height - 1) / 2.0
    camera = Camera(
        width, height, pixel, None, *centre, name="camera of the images", focal_px=focal
    )
    return camera, bool(focal_px)


def bending(tolerance: CameraTolerance, camera: Camera, bend_px: float) -> CameraTolerance:
    """Tolerances for a lens that bends by this much at the corner, whatever the sheet states."""
    return replace(
        tolerance,
        centre_px=max(tolerance.centre_px, CENTRE * camera.width_px),
        distortion_px=max(tolerance.distortion_px, 1.5 * abs(bend_px)),
    )


def calibrated_tolerance(
    calibration: CalibratedCamera, largest: CameraTolerance
) -> CameraTolerance:
    """Four standard deviations of a calibration, at most the given tolerances."""
    camera = calibration.camera
    p = len(camera.parameter_names)
    covariance = floats(calibration.covariance)[:p, :p]
    sd = 4.0 * root_diagonal(covariance)
    orders = [c.order for c in get_model(camera.distortion).coefficients]
    corner = camera.corner_radius_px ** np.array(orders, dtype=np.float64)
    bend = 4.0 * float(np.sqrt(corner @ covariance[3:, 3:] @ corner)) if orders else 0.0
    x0, y0, focal = sd[:3].tolist()
    return largest.at_most(max(focal / camera.focal_px, 1e-5), max(x0, y0, 0.05), max(bend, 0.05))


def much_narrower(one: CameraTolerance, other: CameraTolerance) -> bool:
    """Whether the camera is known so much better that a search may find what it did not find
    before.
    """
    return any(a < _BETTER * b for a, b in zip(astuple(one), astuple(other), strict=True))
