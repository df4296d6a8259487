"""The sensor of Ye & Yang 2017, and where their calibration starts."""

from __future__ import annotations

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CameraError, check_known

# The equation of Ye & Yang 2017 that is read as the distortion of their simulation, and the model
# that says the same.
CONVENTIONS = {"eq14": "brown", "eq6": "inverse"}


def paper_camera(convention: str = "eq14") -> Camera:
    """The sensor of Table 1 of Ye & Yang 2017: 1024 x 1024 pixels of 12 um behind 70.2262 mm, about
    10 degrees.

    Parameters
    ----------
    convention : {"eq14", "eq6"}
        The equation that the coefficients belong to: eq. 14 takes ideal points to distorted ones
        (model ``brown``), eq. 6 distorted points to ideal ones (model ``inverse``). The paper has
        both.

    Raises
    ------
    CameraError
        For another convention.
    """
    check_known("convention", convention, CONVENTIONS, CameraError)
    return Camera(
        width_px=1024,
        height_px=1024,
        pixel_um=12.0,
        focal_mm=70.2262,
        x0_px=500.0,
        y0_px=530.0,
        distortion=CONVENTIONS[convention],
        coefficients=(2.0e-10, -3.5e-15),
        name="Ye & Yang 2017, Table 1",
    )


def paper_start(convention: str = "eq14") -> Camera:
    """The start of the paper's section 3.2: 72 mm, principal point (512, 512), no distortion."""
    return paper_camera(convention).replace(
        focal_mm=72.0,
        x0_px=512.0,
        y0_px=512.0,
        coefficients=(0.0, 0.0),
        name="start of Ye & Yang 2017",
    )
