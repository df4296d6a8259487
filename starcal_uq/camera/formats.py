"""Camera files of OpenCV, ROS, Kalibr and mrcal: the same optics, each in its own words.

All four hold a pinhole with OpenCV's dimensionless k1, k2, p1, p2, k3, and a pixel origin at the
centre of the first pixel. None has a place for the pixel pitch, which a comment keeps: ``#
pixel_um: 6.9``.

Sources: OpenCV, "FileStorage" and "Camera Calibration and 3D Reconstruction"; ROS,
sensor_msgs/CameraInfo as camera_calibration_parsers writes it; Kalibr, "YAML formats"; mrcal,
"Camera models".
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray

# What each of them keeps of k1, k2, p1, p2, k3.
_ALL = ("k1", "k2", "p1", "p2", "k3")
KEPT = {"opencv": _ALL, "ros": _ALL, "mrcal": _ALL, "kalibr": _ALL[:4]}
ENDINGS = {"opencv": ".yaml", "ros": ".yaml", "kalibr": ".yaml", "mrcal": ".cameramodel"}
_PITCH = re.compile(r"^\s*# pixel_um: (\S+)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Pinhole:
    """What such a file holds: size and matrix (3, 3) in px, and k1, k2, p1, p2, k3 (5,),
    dimensionless.

    `pixel_um` is the pixel pitch, micrometres, where it is stated.
    """

    width_px: int
    height_px: int
    matrix: FloatArray
    dist_coeffs: FloatArray
    pixel_um: float | None = None
    name: str = ""


def write_pinhole(camera: Pinhole, to: str) -> str:
    """Content of a file in the format of ``opencv``, ``ros``, ``kalibr`` or ``mrcal``."""
    f, x0, y0 = (repr(float(camera.matrix[i])) for i in ((0, 0), (0, 2), (1, 2)))
    width, height, d = (
        camera.width_px,
        camera.height_px,
        [repr(float(value)) for value in camera.dist_coeffs],
    )
    matrix = f"{f}, 0.0, {x0}, 0.0, {f}, {y0}, 0.0, 0.0, 1.0"
    pitch = "" if camera.pixel_um is None else f"# pixel_um: {camera.pixel_um!r}\n"
    # A name is free text; these files get what cannot end a line or a quotation.
    name = re.sub(r"[^\w .+-]", "_", camera.name, flags=re.ASCII) or "star_camera"
    if to == "opencv":
        return (
            f'%YAML:1.0\n---\n{pitch}camera_name: "{name}"\nimage_width: {width}\nimage_height: '
            f"{height}\n"
            f"camera_matrix: {_opencv_matrix(3, 3, matrix)}distortion_coefficients: "
            f"{_opencv_matrix(1, 5, ', '.join(d))}"
        )
    if to == "ros":
        return (
            f'{pitch}image_width: {width}\nimage_height: {height}\ncamera_name: "{name}"\n'
            f"camera_matrix:\n{_ros_matrix(3, 3, matrix)}distortion_model: plumb_bob\n"
            f"distortion_coefficients:\n{_ros_matrix(1, 5, ', '.join(d))}"
            f"rectification_matrix:\n{_ros_matrix(3, 3, '1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0')}"
            f"projection_matrix:\n"
            f"{_ros_matrix(3, 4, f'{f}, 0.0, {x0}, 0.0, 0.0, {f}, {y0}, 0.0, 0.0, 0.0, 1.0, 0.0')}"
        )
    if to == "kalibr":
        return (
            f"{pitch}cam0:\n  camera_model: pinhole\n  intrinsics: [{f}, {f}, {x0}, {y0}]\n"
            f"  distortion_model: radtan\n  distortion_coeffs: [{', '.join(d[:4])}]\n"
            f"  resolution: [{width}, {height}]\n  rostopic: /cam0/image_raw\n"
        )
    return (
        f"{pitch}{{\n    'lensmodel': 'LENSMODEL_OPENCV5',\n\n    # fx, fy, cx, cy, k1, k2, p1, "
        "p2, k3\n"
        f"    'intrinsics': [{', '.join([f, f, x0, y0, *d])}],\n\n    'extrinsics': [0, 0, 0, 0, "
        "0, 0],\n\n"
        f"    'imagersize': [{width}, {height}],\n}}\n"
    )


def _opencv_matrix(rows: int, columns: int, data: str) -> str:
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def _ros_matrix(rows: int, columns: int, data: str) -> str:
    return f"  rows: {rows}\n  cols: {columns}\n  data: [{data}]\n"


def read_pinhole(text: str) -> Pinhole:
    """What a file of any of the four holds; ValueError says what else its text is."""
    pitch = _PITCH.search(text)
    content = _content(text)
    read = _reader(content)
    width, height, name, intrinsics, coefficients = read(content)
    numbers = [*intrinsics, *coefficients]
    if not all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in numbers
    ):
        raise ValueError("a value of the optics is no number")
    fx, fy, x0, y0 = intrinsics
    if any(coefficients[5:]):
        raise ValueError(
            "it has rational, thin-prism or tilt terms, which have no counterpart here"
        )
    found = np.zeros(5)
    found[: min(5, len(coefficients))] = coefficients[:5]
    matrix = np.array([[fx, 0.0, x0], [0.0, fy, y0], [0.0, 0.0, 1.0]], dtype=np.float64)
    return Pinhole(width, height, matrix, found, float(pitch[1]) if pitch else None, name)


_Read = tuple[int, int, str, Sequence[float], Sequence[float]]


def _content(text: str) -> Mapping[str, Any]:
    bare = re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE).strip()
    if bare.startswith("{"):
        content = ast.literal_eval(bare)
    else:
        import yaml

        # OpenCV has a tag of its own on plain tables, and a directive that is not YAML's.
        plain = re.sub(r"^%YAML.*$|!!opencv-matrix", "", bare, flags=re.MULTILINE)
        content = yaml.safe_load(plain)
    if not isinstance(content, Mapping):
        raise ValueError("it is no table of keys")
    return content


def _reader(content: Mapping[str, Any]) -> Any:
    if "lensmodel" in content:
        return _mrcal
    if "cam0" in content:
        return _kalibr
    if "camera_matrix" in content:
        return _opencv
    raise ValueError(
        "it has none of camera_matrix (OpenCV, ROS), cam0 (Kalibr) and lensmodel (mrcal)"
    )


def _opencv(content: Mapping[str, Any]) -> _Read:
    """OpenCV's sample programs and ROS use the same keys."""
    kind = content.get("distortion_model", "plumb_bob")
    if kind not in ("plumb_bob", "rational_polynomial"):
        raise ValueError(
            f"its distortion model is {kind!r}, and only plumb_bob has a counterpart here"
        )
    matrix = [float(value) for value in content["camera_matrix"]["data"]]
    if len(matrix) != 9 or matrix[1] or matrix[3]:
        raise ValueError("its camera matrix has skew, or not nine numbers")
    return (
        int(content["image_width"]),
        int(content["image_height"]),
        str(content.get("camera_name", "")),
        (matrix[0], matrix[4], matrix[2], matrix[5]),
        list(content["distortion_coefficients"]["data"]),
    )


def _kalibr(content: Mapping[str, Any]) -> _Read:
    camera = content["cam0"]
    model, lens = camera.get("camera_model"), camera.get("distortion_model")
    if model != "pinhole" or lens not in ("radtan", "none"):
        raise ValueError(
            f"its cam0 is {model} with {lens}, and only pinhole with radtan has a counterpart here"
        )
    width, height = camera["resolution"]
    return int(width), int(height), "", camera["intrinsics"], camera.get("distortion_coeffs", [])


def _mrcal(content: Mapping[str, Any]) -> _Read:
    lens = content["lensmodel"]
    if lens not in (
        "LENSMODEL_PINHOLE",
        "LENSMODEL_OPENCV4",
        "LENSMODEL_OPENCV5",
        "LENSMODEL_OPENCV8",
    ):
        raise ValueError(f"its lens is {lens!r}, and only OpenCV's have a counterpart here")
    width, height = content["imagersize"]
    return int(width), int(height), "", content["intrinsics"][:4], content["intrinsics"][4:]
