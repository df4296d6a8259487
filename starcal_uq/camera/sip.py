"""A camera in FITS headers: TAN-SIP polynomials over the detector, and world coordinates of a
frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.distortion import get_model, powers
from starcal_uq.camera.projection import Optics, unproject
from starcal_uq.core.errors import CameraError
from starcal_uq.core.extras import extra
from starcal_uq.core.types import FloatArray, floats

# Points along each side of the detector at which a fit is made, and checked between them.
POINTS = 33
_MOST_ORDERS = 9
# A polynomial this near needs no further order, px.
_CLOSE_PX = 1e-4
# Rounding, px: differences below it are none.
EXACT_PX = 1e-6
# A field up to 80 degrees from the axis can be written as one of a pinhole.
_LEAST_COSINE = np.cos(np.radians(80.0))


class Detector(Optics, Protocol):
    """A camera, as far as these functions know it."""

    @property
    def width_px(self) -> int:
        """Columns."""

    @property
    def height_px(self) -> int:
        """Rows."""

    @property
    def x0_px(self) -> float:
        """Principal point, px."""

    @property
    def y0_px(self) -> float:
        """Principal point, px."""

    @property
    def focal_px(self) -> float:
        """Focal length, px."""


def pixel_grid(camera: Detector, points: int) -> FloatArray:
    """Pixels (n^2, 2) over the whole detector, edges included."""
    x, y = (np.linspace(-0.5, size - 0.5, points) for size in (camera.width_px, camera.height_px))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def in_front(camera: Detector) -> FloatArray:
    """Directions of a grid of pixels; CameraError where a pinhole does not reach one of them."""
    seen = unproject(camera, pixel_grid(camera, POINTS))
    if np.min(seen[:, 2]) < _LEAST_COSINE:
        raise CameraError(
            "the field of this camera is too wide for a pinhole, and so for this format: export "
            "to opencv, ros or kalibr, which have a fisheye."
        )
    return seen


def sip_header(camera: Detector) -> tuple[Any, float]:
    """FITS header (TAN-SIP) of a camera that looks at right ascension and declination 0, and its
    largest error, px.

    CRVAL and a rotation of CD make it that of a frame. A and B carry pixels to the tangent plane,
    AP and BP back; their order is the least that is near enough. Pixels count from 1, as FITS does.
    Source: Shupe et al. 2005, "The SIP convention for representing distortion in FITS image
    headers".
    """
    with extra("images", "FITS headers"):
        from astropy.io import fits

    pixels, seen = pixel_grid(camera, POINTS), in_front(camera)
    measured = pixels - [camera.x0_px, camera.y0_px]
    model, theta = get_model(camera.distortion), camera.theta
    ideal = camera.focal_px * seen[:, :2] / seen[:, 2:]
    # SIP has no linear terms: the axes of the detector are part of CD.
    ideal = np.column_stack(model.stretched(ideal[:, 0], ideal[:, 1], theta))
    along_x, along_y = np.eye(2)
    axes = np.stack(model.unstretched(along_x, along_y, theta))
    scale = camera.corner_radius_px
    header = fits.Header()
    header.update(WCSAXES=2, IMAGEW=camera.width_px, IMAGEH=camera.height_px)
    sides = (("RA---TAN-SIP", camera.x0_px), ("DEC--TAN-SIP", camera.y0_px))
    for axis, (kind, centre) in enumerate(sides, 1):
        # x and y of a pixel run against right ascension and declination for who looks at the sky
        # from within.
        step = -np.degrees(1.0 / camera.focal_px) * axes[axis - 1]
        own = {"CTYPE": kind, "CRPIX": centre + 1.0, "CRVAL": 0.0, "CUNIT": "deg"}
        header.update({f"{name}{axis}": value for name, value in own.items()})
        header.update({f"CD{axis}_{i}": float(value) for i, value in enumerate(step, 1)})
    worst = 0.0
    for names, start, end in ((("A", "B"), measured, ideal), (("AP", "BP"), ideal, measured)):
        terms, error = sip_terms(names, start, end, scale)
        header.update(terms)
        worst = max(worst, error)
    return header, worst


def camera_wcs(camera: Detector, attitude: ArrayLike, tolerance_px: float = 0.01) -> Any:
    """World coordinates (TAN-SIP) of a frame.

    Parameters
    ----------
    camera : Detector
        The camera.
    attitude : array_like (4,)
        Quaternion of the rotation from ICRS to the camera frame, scalar last.
    tolerance_px : float, default 0.01
        Largest error of the polynomials over the detector, px.

    Returns
    -------
    astropy.wcs.WCS
        Its pixels count from 0, as those of the package do.

    Raises
    ------
    CameraError
        If the attitude is no quaternion, or the polynomials are not near enough.
    """
    quaternion = floats(attitude)
    if quaternion.shape != (4,) or not 0.0 < np.linalg.norm(quaternion) < np.inf:
        raise CameraError(
            f"camera: {quaternion.tolist()} is no attitude; give a quaternion (x, y, z, w)."
        )
    header, error = sip_header(camera)
    if error > tolerance_px:
        raise CameraError(
            f"camera: TAN-SIP is up to {error:.2g} px off over the detector; give a tolerance_px "
            "above that, or use project and unproject."
        )
    from astropy.wcs import WCS
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(quaternion).as_matrix()
    x, y, z = axes[2]
    right_ascension, declination = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    sine, cosine = np.sin(right_ascension), np.cos(right_ascension)
    east = np.array([-sine, cosine, 0.0])
    north = np.cross(axes[2], east)
    header["CRVAL1"], header["CRVAL2"] = np.degrees([right_ascension % (2.0 * np.pi), declination])
    # Otherwise a frame at the pole would be turned by 180 degrees.
    header["LONPOLE"] = 180.0
    # The header's own camera has x and y against east and north.
    step = [[header[f"CD{row}_{column}"] for column in (1, 2)] for row in (1, 2)]
    turned = -np.stack([east, north]) @ axes[:2].T @ step
    header.update({f"CD{i + 1}_{j + 1}": turned[i, j] for i in (0, 1) for j in (0, 1)})
    return WCS(header)


def sip_terms(
    names: Sequence[str],
    start: FloatArray,
    end: FloatArray,
    scale: float,
    least: int = 2,
    close_px: float = _CLOSE_PX,
) -> tuple[dict[str, float], float]:
    """Coefficients and order of the polynomials that carry points (n, 2) to others, px, by the
    names of a header or a kernel, with terms from the order `least` on, and their largest error,
    px. Their order is the least that is near enough.
    """
    at, shift = start / scale, (end - start) / scale
    for order in range(2, _MOST_ORDERS + 1):
        places = powers(order, least)
        terms = np.stack([at[:, 0] ** p * at[:, 1] ** q for p, q in places], axis=1)
        found = floats(np.linalg.lstsq(terms, shift, rcond=None)[0])
        error = scale * float(np.max(np.linalg.norm(terms @ found - shift, axis=1)))
        if error < close_px:
            break
    held: dict[str, float] = {}
    for column, name in enumerate(names):
        held[f"{name}_ORDER"] = order
        for (p, q), value in zip(places, found[:, column].tolist(), strict=True):
            # Below it no pixel of the detector moves by the millionth part of rounding.
            if abs(value) * scale > EXACT_PX / 1e6:
                held[f"{name}_{p}_{q}"] = value * scale ** (1 - p - q)
    return held, error
