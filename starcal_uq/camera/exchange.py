"""A camera for other programs: what their own files can hold of it, and how far that is from the
camera itself.

Where a format has the same terms, nothing is lost; where not, its terms are fitted to the camera
over the detector.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import Parameter, get_model, shared_names, with_axes
from starcal_uq.camera.formats import TEXT_FORMATS, Pinhole, write_pinhole
from starcal_uq.camera.nearest import nearest_theta
from starcal_uq.camera.planes import PINHOLE
from starcal_uq.camera.projection import project, unproject
from starcal_uq.camera.sip import EXACT_PX, POINTS, in_front, pixel_grid, sip_header, sip_terms
from starcal_uq.camera.spice import NO_INSTRUMENT, kernel_text
from starcal_uq.core.errors import CameraError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_path, ensure_new
from starcal_uq.core.types import AnyDict, FloatArray, PathLike


@dataclass(frozen=True)
class Exported:
    """A camera in the words of another program: the file, and one sentence on what it holds and how
    near it is.

    `error_px` is the largest distance over the detector between what the file and the camera make
    of the same direction, px; 0 where the format has the camera's own terms.
    """

    path: Path
    error_px: float
    note: str


def export_camera(
    camera: Camera,
    to: str,
    path: PathLike,
    *,
    force: bool = False,
    write: Writer | None = None,
) -> Exported:
    """Write a camera for another program, one of `CAMERA_FORMATS`, by the format's own writer or
    another; without `Camera.name` the file gets a neutral one.

    CameraError for an unknown format or a camera that folds over within its detector.
    """
    if to not in CAMERA_FORMATS:
        raise CameraError(
            f"{to!r} is no format for a camera: use one of {', '.join(CAMERA_FORMATS)}."
        )
    ensure_new(path, force)
    if camera.folds:
        raise CameraError(
            "the distortion folds over within the detector: a camera that does has no counterpart."
        )
    with atomic_path(Path(path)) as temporary:
        error, note = (write or CAMERA_FORMATS[to].write)(camera, temporary)
    return Exported(Path(path), error, note)


Writer = Callable[[Camera, Path], tuple[float, str]]


def nearest(camera: Camera, distortion: str, without: tuple[str, ...] = ()) -> tuple[Camera, float]:
    """The camera with this forward model of a pinhole that differs least over the detector, and by
    how much at most, px.

    All its parameters but those `without` are fitted to the directions of a grid of pixels; the
    orientation of the camera stays.
    """
    known = dict(zip(camera.parameter_names, camera.theta, strict=True))
    common = set(shared_names(camera.distortion, distortion)) - set(without)
    names = [c.name for c in get_model(distortion).coefficients]
    start = camera.replace(
        distortion=distortion,
        coefficients=tuple(known[name] if name in common else 0.0 for name in names),
    )
    pixels = pixel_grid(camera, POINTS)
    seen = unproject(camera, pixels)
    theta, _ = nearest_theta(
        distortion, start.theta, seen[:, :2] / seen[:, 2:], pixels, fixed=without
    )
    found = start.with_theta(theta)
    between = pixel_grid(camera, 2 * POINTS + 1)
    return found, float(
        np.max(np.linalg.norm(project(found, unproject(camera, between)) - between, axis=1))
    )


def _held(camera: Camera, kept: tuple[str, ...], fisheye: bool = False) -> tuple[Camera, float]:
    """The camera itself if a format keeps its coefficients, or the nearest one that it can hold."""
    model = get_model(camera.distortion)
    if model.plane is not PINHOLE and fisheye and ("skew" in kept or not camera.axes[1]):
        return camera, 0.0
    used = {
        c.name
        for c, value in zip(model.coefficients, camera.coefficients, strict=True)
        if value != 0.0
    }
    own = model.direction == "forward" and model.plane is PINHOLE and used <= set(kept)
    if own or (not used and model.plane is PINHOLE):
        return camera, 0.0
    in_front(camera)
    wanted = "brown_tangential"
    if model.radial:
        wanted = "brown3" if "k3" in kept else "brown"
    axes = ("stretch", "skew")
    if model.axes and set(axes) & set(kept):
        return nearest(camera, with_axes(wanted), tuple(name for name in axes if name not in kept))
    return nearest(camera, wanted)


def _said(error: float, what: str) -> str:
    if error <= EXACT_PX:
        return f"{what}: the same camera, to rounding."
    return (
        f"{what}: fitted, because it lacks this camera's terms; up to {error:.2g} px off over "
        "the detector."
    )


def _pinhole_file(to: str, camera: Camera, path: Path) -> tuple[float, str]:
    form = TEXT_FORMATS[to]
    held, error = _held(camera, form.kept, form.fisheye is not None)
    # OpenCV has terms for a camera without distortion, of whatever model.
    plane = get_model(held.distortion).plane
    bare = held if any(held.coefficients) else held.replace(distortion=plane.bare, coefficients=())
    size = held.width_px, held.height_px
    fisheye = plane is not PINHOLE
    plain = Pinhole(*size, *bare.to_opencv(), held.pixel_um, held.name, fisheye)
    path.write_text(write_pinhole(plain, to), encoding="utf-8")
    stretch, skew = held.axes
    # GIANT has the skew in its formula.
    if not skew or to == "giant":
        return error, _said(error, form.title)
    # The functions of OpenCV, which are also those of ROS, read fx, fy, cx and cy alone.
    behind = (pixel_grid(held, 2)[:, 1] - held.y0_px) / (1.0 + stretch)
    error = float(np.max(np.abs(skew * behind)))
    return error, (
        f"{form.title}: the same camera, with the skew in the camera matrix; functions of OpenCV leave "
        f"it out, which is up to {error:.2g} px over the detector."
    )


def _tetra3rs(camera: Camera, path: Path) -> tuple[float, str]:
    with extra("tetra3rs", "cameras for tetra3rs"):
        import tetra3rs as library
    held, error = _held(camera, ("k1", "k2", "k3", "p1", "p2"))
    names = [c.name for c in get_model(held.distortion).lens]
    terms: AnyDict = dict(zip(names, held.coefficients, strict=False))
    centre = np.subtract((held.x0_px, held.y0_px), held.centre_px)
    distortion = library.RadialDistortion(**terms) if any(terms.values()) else None
    library.CameraModel(
        held.focal_px, held.width_px, held.height_px, centre.tolist(), False, distortion
    ).save_to_file(os.fspath(path))
    return error, _said(
        error, "tetra3rs, CameraModel.load_from_file (pixels from the image's centre)"
    )


def _tetra3(camera: Camera, path: Path) -> tuple[float, str]:
    """`fov_estimate` and `distortion` of tetra3 and cedar-solve: r_u = r_d (1 - k (2 r_d /
    width)^2) / (1 - k).

    They have the centre of the image for a principal point; what a tilt of the attitude takes up is
    not counted.
    """
    from scipy.optimize import least_squares

    pixels, seen = pixel_grid(camera, POINTS), in_front(camera)
    offsets = pixels - camera.centre_px
    half = camera.width_px / 2.0
    fraction = np.sum((offsets / half) ** 2, axis=1, keepdims=True)

    def off(p: FloatArray) -> FloatArray:
        focal, k, x, y = p
        # A small turn about x and y, which the solver's attitude takes up.
        turned = seen + np.cross([x, y, 0.0], seen)
        ideal = focal * camera.focal_px * turned[:, :2] / turned[:, 2:]
        return np.asarray(ideal - offsets * (1.0 - k * fraction) / (1.0 - k)).ravel()

    tilt = np.subtract((camera.x0_px, camera.y0_px), camera.centre_px) / camera.focal_px
    found = least_squares(
        off, [1.0, 0.0, -tilt[1], tilt[0]], x_scale=[1e-3, 1e-2, 1e-3, 1e-3], xtol=1e-14, ftol=1e-14
    )
    error = float(np.max(np.linalg.norm(off(found.x).reshape(-1, 2), axis=1)))
    field = float(np.degrees(2.0 * np.arctan(half / (found.x[0] * camera.focal_px))))
    path.write_text(
        json.dumps({"fov_estimate": field, "distortion": float(found.x[1])}, indent=1) + "\n"
    )
    return error, _said(error, "tetra3 and cedar-solve, arguments of solve_from_centroids")


def write_kernel(
    camera: Camera,
    path: Path,
    instrument: int = NO_INSTRUMENT,
    sigmas: Sequence[tuple[Parameter, float]] = (),
) -> tuple[float, str]:
    """Write a text instrument kernel of SPICE: FOCAL_LENGTH, PIXEL_SIZE, PIXEL_SAMPLES,
    PIXEL_LINES and CCD_CENTER (pixels count from 0), the field of view for GETFOV, and
    SIP_AP_p_q and SIP_BP_p_q, the polynomials from the ideal to the measured pixel offset.

    `sigmas`, standard deviations in the parameters' units, stand as comments. Returns the largest
    error, px, and a sentence. CameraError without a pixel pitch.
    """
    if camera.focal_mm is None or camera.pixel_um is None:
        raise CameraError(
            "a kernel has its focal length in mm: state pixel_um in the camera's file first."
        )
    pixels, seen = pixel_grid(camera, POINTS), in_front(camera)
    centre = np.array([camera.x0_px, camera.y0_px])
    ideal, scale = camera.focal_px * seen[:, :2] / seen[:, 2:], camera.corner_radius_px
    names = ("SIP_AP", "SIP_BP")
    terms, error = sip_terms(names, ideal, pixels - centre, scale, 1, EXACT_PX / 1e3)
    corners = unproject(camera, pixel_grid(camera, 2)[[0, 1, 3, 2]])
    values: dict[str, object] = {
        "FOCAL_LENGTH": camera.focal_mm,
        "PIXEL_SIZE": camera.pixel_um,
        "PIXEL_SAMPLES": camera.width_px,
        "PIXEL_LINES": camera.height_px,
        "CCD_CENTER": (camera.x0_px, camera.y0_px),
        "FOV_FRAME": f"'{re.sub(r'[^A-Z0-9]+', '_', camera.name.upper())[:26] or 'STAR_CAMERA'}'",
        "FOV_SHAPE": "'POLYGON'",
        "FOV_CLASS_SPEC": "'CORNERS'",
        "BORESIGHT": (0.0, 0.0, 1.0),
        "FOV_BOUNDARY_CORNERS": tuple(corners.ravel().tolist()),
        **terms,
    }
    known = "".join(f"   {spec.name:8} {sd:12.4g} {spec.unit}\n" for spec, sd in sigmas)
    path.write_text(kernel_text(instrument, values, known), encoding="ascii")
    return error, _said(error, f"SPICE instrument kernel of INS{instrument}")


def _sip(camera: Camera, path: Path) -> tuple[float, str]:
    header, error = sip_header(camera)
    path.write_text(header.tostring(sep="\n", endcard=True, padding=False) + "\n", encoding="ascii")
    return error, (
        f"FITS header with TAN-SIP polynomials: up to {error:.2g} px off over the detector; set "
        "CRVAL and turn CD for "
        "a frame."
    )


def _asdf(camera: Camera, path: Path) -> tuple[float, str]:
    with extra("asdf", "ASDF files"):
        import asdf as library
    content: AnyDict = {
        "camera": camera.to_dict(),
        "pixel_origin": "centre of the first pixel; x to the right, y down",
        "parameter_names": list(camera.parameter_names),
        "theta_px": camera.theta,
    }
    library.AsdfFile(content).write_to(path)
    return 0.0, _said(0.0, "ASDF")


@dataclass(frozen=True)
class CameraFormat:
    """The ending of a file's name, and ``write(camera, path) -> (largest error in px,
    sentence)``.
    """

    ending: str
    write: Writer


CAMERA_FORMATS = {
    name: CameraFormat(form.ending, partial(_pinhole_file, name))
    for name, form in TEXT_FORMATS.items()
} | {
    "tetra3rs": CameraFormat(".bin", _tetra3rs),
    "tetra3": CameraFormat(".json", _tetra3),
    "sip": CameraFormat(".hdr", _sip),
    "spice": CameraFormat(".ti", write_kernel),
    "asdf": CameraFormat(".asdf", _asdf),
}
