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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray

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


@dataclass(frozen=True)
class TextFormat:
    """How a program writes a camera: its name, the ending of its files, what they keep of k1, k2,
    p1, p2, k3, stretch and skew, and their text.
    """

    title: str
    ending: str
    kept: tuple[str, ...]
    text: str


_ALL = ("k1", "k2", "p1", "p2", "k3")
_MATRIX = ("stretch", "skew")
TEXT_FORMATS = {
    "opencv": TextFormat(
        "OpenCV",
        ".yaml",
        (*_ALL, *_MATRIX),
        """\
%YAML:1.0
---
{pitch}camera_name: "{name}"
image_width: {width}
image_height: {height}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {fx}, {skew}, {x0}, 0.0, {fy}, {y0}, 0.0, 0.0, 1.0 ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ {terms} ]
""",
    ),
    "ros": TextFormat(
        "ROS camera_info",
        ".yaml",
        (*_ALL, *_MATRIX),
        """\
{pitch}image_width: {width}
image_height: {height}
camera_name: "{name}"
camera_matrix:
  rows: 3
  cols: 3
  data: [{fx}, {skew}, {x0}, 0.0, {fy}, {y0}, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [{terms}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
projection_matrix:
  rows: 3
  cols: 4
  data: [{fx}, {skew}, {x0}, 0.0, 0.0, {fy}, {y0}, 0.0, 0.0, 0.0, 1.0, 0.0]
""",
    ),
    "kalibr": TextFormat(
        "Kalibr",
        ".yaml",
        (*_ALL[:4], "stretch"),
        """\
{pitch}cam0:
  camera_model: pinhole
  intrinsics: [{fx}, {fy}, {x0}, {y0}]
  distortion_model: radtan
  distortion_coeffs: [{terms}]
  resolution: [{width}, {height}]
  rostopic: /cam0/image_raw
""",
    ),
    "mrcal": TextFormat(
        "mrcal",
        ".cameramodel",
        (*_ALL, "stretch"),
        """\
{pitch}{{
    'lensmodel': 'LENSMODEL_OPENCV5',

    # fx, fy, cx, cy, k1, k2, p1, p2, k3
    'intrinsics': [{fx}, {fy}, {x0}, {y0}, {terms}],

    'extrinsics': [0, 0, 0, 0, 0, 0],

    'imagersize': [{width}, {height}],
}}
""",
    ),
}


def write_pinhole(camera: Pinhole, to: str) -> str:
    """Content of a file in one of the `TEXT_FORMATS`."""
    form = TEXT_FORMATS[to]
    matrix = camera.matrix.tolist()
    coefficients = zip(_ALL, camera.dist_coeffs.tolist(), strict=True)
    terms = [value for name, value in coefficients if name in form.kept]
    return form.text.format(
        pitch="" if camera.pixel_um is None else f"# pixel_um: {camera.pixel_um!r}\n",
        # A name is free text; these files get what cannot end a line or a quotation.
        name=re.sub(r"[^\w .+-]", "_", camera.name, flags=re.ASCII) or "star_camera",
        width=camera.width_px,
        height=camera.height_px,
        fx=matrix[0][0],
        fy=matrix[1][1],
        skew=matrix[0][1],
        x0=matrix[0][2],
        y0=matrix[1][2],
        terms=", ".join(map(repr, terms)),
    )


def read_pinhole(text: str) -> Pinhole:
    """What a file of any of the four holds; ValueError says what else its text is."""
    pitch, content = _PITCH.search(text), _content(text)
    read = next((reader for key, reader in _READERS.items() if key in content), None)
    if read is None:
        raise ValueError(
            "it has none of camera_matrix (OpenCV, ROS), cam0 (Kalibr) and lensmodel (mrcal)"
        )
    width, height, name, intrinsics, coefficients = read(content)
    numbers = [*intrinsics, *coefficients]
    if not all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in numbers
    ):
        raise ValueError("a value of the optics is no number")
    fx, fy, x0, y0, *skew = intrinsics
    if any(coefficients[5:]):
        raise ValueError(
            "it has rational, thin-prism or tilt terms, which have no counterpart here"
        )
    found = np.zeros(5)
    found[: min(5, len(coefficients))] = coefficients[:5]
    matrix = np.array(
        [[fx, *(skew or [0.0]), x0], [0.0, fy, y0], [0.0, 0.0, 1.0]], dtype=np.float64
    )
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


def _opencv(content: Mapping[str, Any]) -> _Read:
    """OpenCV's sample programs and ROS use the same keys."""
    kind = content.get("distortion_model", "plumb_bob")
    if kind not in ("plumb_bob", "rational_polynomial"):
        raise ValueError(
            f"its distortion model is {kind!r}, and only plumb_bob has a counterpart here"
        )
    matrix = [float(value) for value in content["camera_matrix"]["data"]]
    if len(matrix) != 9 or matrix[3]:
        raise ValueError("its camera matrix has not nine numbers, or one below its diagonal")
    return (
        int(content["image_width"]),
        int(content["image_height"]),
        str(content.get("camera_name", "")),
        (matrix[0], matrix[4], matrix[2], matrix[5], matrix[1]),
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


# By the key that none of the others has.
_READERS: Mapping[str, Callable[[Mapping[str, Any]], Any]] = {
    "lensmodel": _mrcal,
    "cam0": _kalibr,
    "camera_matrix": _opencv,
}
