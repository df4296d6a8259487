"""Camera files of OpenCV, ROS, Kalibr, mrcal and GIANT: the same optics, each in its own words.

All hold a pinhole with OpenCV's dimensionless k1, k2, p1, p2, k3, and all but mrcal and GIANT its fisheye;
their pixel origin is the centre of the first pixel. None has a place for the pixel pitch, which a
comment keeps: ``# pixel_um: 6.9``.

Sources: OpenCV, "FileStorage" and "Camera Calibration and 3D Reconstruction"; ROS,
sensor_msgs/CameraInfo as camera_calibration_parsers writes it; Kalibr, "YAML formats"; mrcal,
"Camera models"; GIANT, `giant.camera_models.opencv_model` and `camera_model.save`.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from starcal_uq.core.types import FloatArray

_PITCH = re.compile(r"^\s*# pixel_um: (\S+)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Pinhole:
    """What such a file holds: size and matrix (3, 3) in px, and dimensionless coefficients: (5,) or
    (12,) of a pinhole, (4,) of a fisheye, in OpenCV's order.

    `pixel_um` is the pixel pitch, micrometres, where it is stated.
    """

    width_px: int
    height_px: int
    matrix: FloatArray
    dist_coeffs: FloatArray
    pixel_um: float | None = None
    name: str = ""
    fisheye: bool = False


@dataclass(frozen=True)
class TextFormat:
    """How a program writes a camera: its name, the ending of its files, what they keep of k1, k2,
    p1, p2, k3, s1, s2, stretch and skew, their text, and their words for a pinhole and a fisheye;
    None where there is no fisheye.
    """

    title: str
    ending: str
    kept: tuple[str, ...]
    text: str
    pinhole: str = ""
    fisheye: str | None = None
    order: tuple[int, ...] = ()  # Places in OpenCV's order of all twelve coefficients


_ALL = ("k1", "k2", "p1", "p2", "k3")
# OpenCV's k1, k2, p1, p2, k3, k4, k5, k6 and four of a thin prism, as GIANT has them.
_GIANT = (0, 1, 4, 5, 6, 7, 2, 3, 8, 9, 10, 11)
_PRISM, _MATRIX = ("s1", "s2"), ("stretch", "skew")
TEXT_FORMATS = {
    "opencv": TextFormat(
        "OpenCV",
        ".yaml",
        (*_ALL, *_PRISM, *_MATRIX),
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
   cols: {n}
   dt: d
   data: [ {terms} ]
{lens}""",
        fisheye="fisheye_model: 1\n",
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
distortion_model: {lens}
distortion_coefficients:
  rows: 1
  cols: {n}
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
        "plumb_bob",
        "equidistant",
    ),
    "kalibr": TextFormat(
        "Kalibr",
        ".yaml",
        (*_ALL[:4], "stretch"),
        """\
{pitch}cam0:
  camera_model: pinhole
  intrinsics: [{fx}, {fy}, {x0}, {y0}]
  distortion_model: {lens}
  distortion_coeffs: [{terms}]
  resolution: [{width}, {height}]
  rostopic: /cam0/image_raw
""",
        "radtan",
        "equidistant",
    ),
    "mrcal": TextFormat(
        "mrcal",
        ".cameramodel",
        (*_ALL, *_PRISM, "stretch"),
        """\
{pitch}{{
    'lensmodel': 'LENSMODEL_OPENCV{n}',

    # fx, fy, cx, cy, and the coefficients of OpenCV
    'intrinsics': [{fx}, {fy}, {x0}, {y0}, {terms}],

    'extrinsics': [0, 0, 0, 0, 0, 0],

    'imagersize': [{width}, {height}],
}}
""",
    ),
    "giant": TextFormat(
        "GIANT",
        ".xml",
        (*_ALL, *_PRISM, *_MATRIX),
        """\
<CameraModels>
  <{name} module="giant.camera_models.opencv_model" type="OpenCVModel">
    <field_of_view>{half_diagonal_deg}</field_of_view>
    <intrinsic_matrix>array([[{fx}, {skew}, {x0}], [0.0, {fy}, {y0}]])</intrinsic_matrix>
    <distortion_coefficients>array([{terms}])</distortion_coefficients>
    <temperature_coefficients>array([0.0, 0.0, 0.0])</temperature_coefficients>
    <n_rows>{height}</n_rows>
    <n_cols>{width}</n_cols>
  </{name}>
</CameraModels>
{pitch_xml}""",
        order=_GIANT,
    ),
}


def write_pinhole(camera: Pinhole, to: str) -> str:
    """Content of a file in one of the `TEXT_FORMATS`."""
    form = TEXT_FORMATS[to]
    matrix = camera.matrix.tolist()
    terms = camera.dist_coeffs.tolist()
    if len(terms) == len(_ALL):
        terms = [value for name, value in zip(_ALL, terms, strict=True) if name in form.kept]
    if form.order:
        terms = [(terms + [0.0] * 12)[place] for place in form.order]
    # A name is free text; these files get what cannot end a line or a quotation.
    name = re.sub(r"[^\w .+-]", "_", camera.name, flags=re.ASCII) or "star_camera"
    if to == "giant":
        name = re.sub(r"^(?![A-Za-z_])|\W+", "_", name)
    pitch = "" if camera.pixel_um is None else f"# pixel_um: {camera.pixel_um!r}\n"
    corner = math.hypot(camera.width_px, camera.height_px) / 2.0
    return form.text.format(
        pitch=pitch,
        pitch_xml=f"<!--\n{pitch}-->\n" if pitch else "",
        name=name,
        half_diagonal_deg=math.degrees(math.atan2(corner, matrix[0][0])),
        width=camera.width_px,
        height=camera.height_px,
        fx=matrix[0][0],
        fy=matrix[1][1],
        skew=matrix[0][1],
        x0=matrix[0][2],
        y0=matrix[1][2],
        lens=form.fisheye if camera.fisheye else form.pinhole,
        n=len(terms),
        terms=", ".join(map(repr, terms)),
    )


def read_pinhole(text: str) -> Pinhole:
    """What a file of any of the four holds; ValueError says what else its text is."""
    pitch, content = _PITCH.search(text), _content(text)
    read = next((reader for key, reader in _READERS.items() if key in content), None)
    if read is None:
        raise ValueError(
            "it has none of camera_matrix (OpenCV, ROS), cam0 (Kalibr), lensmodel (mrcal) and "
            "CameraModels (GIANT)"
        )
    width, height, name, intrinsics, coefficients, fisheye = read(content)
    numbers = [*intrinsics, *coefficients]
    if not all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in numbers
    ):
        raise ValueError("a value of the optics is no number")
    fx, fy, x0, y0, *skew = intrinsics
    found = np.array(coefficients, dtype=np.float64)
    matrix = np.array(
        [[fx, *(skew or [0.0]), x0], [0.0, fy, y0], [0.0, 0.0, 1.0]], dtype=np.float64
    )
    pixel_um = float(pitch[1]) if pitch else None
    return Pinhole(width, height, matrix, found, pixel_um, name, fisheye)


_Read = tuple[int, int, str, Sequence[float], Sequence[float], bool]


def _content(text: str) -> Mapping[str, Any]:
    bare = re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE).strip()
    if bare.startswith("<"):
        return {"CameraModels": ElementTree.fromstring(bare)}
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
    usual = "equidistant" if content.get("fisheye_model") else "plumb_bob"
    kind = content.get("distortion_model", usual)
    if kind not in ("plumb_bob", "rational_polynomial", "equidistant"):
        raise ValueError(
            f"its distortion model is {kind!r}, and only plumb_bob and equidistant have a "
            "counterpart here"
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
        kind == "equidistant",
    )


def _kalibr(content: Mapping[str, Any]) -> _Read:
    camera = content["cam0"]
    model, lens = camera.get("camera_model"), camera.get("distortion_model")
    if model != "pinhole" or lens not in ("radtan", "none", "equidistant"):
        raise ValueError(
            f"its cam0 is {model} with {lens}, and only pinhole with radtan or equidistant has a "
            "counterpart here"
        )
    (width, height), terms = camera["resolution"], camera.get("distortion_coeffs", [])
    return int(width), int(height), "", camera["intrinsics"], terms, lens == "equidistant"


def _mrcal(content: Mapping[str, Any]) -> _Read:
    lens = content["lensmodel"]
    if lens not in (
        "LENSMODEL_PINHOLE",
        "LENSMODEL_OPENCV4",
        "LENSMODEL_OPENCV5",
        "LENSMODEL_OPENCV8",
        "LENSMODEL_OPENCV12",
    ):
        raise ValueError(f"its lens is {lens!r}, and only OpenCV's have a counterpart here")
    width, height = content["imagersize"]
    intrinsics = content["intrinsics"]
    return int(width), int(height), "", intrinsics[:4], intrinsics[4:], False


def _giant(content: Mapping[str, Any]) -> _Read:
    models = content["CameraModels"].findall(".//*[@type]")
    kinds = {model.get("type") for model in models}
    if len(models) != 1 or kinds != {"OpenCVModel"}:
        raise ValueError(
            f"it has {len(models)} cameras ({', '.join(sorted(map(str, kinds)))}), and one "
            "OpenCVModel is read"
        )

    def numbers(name: str) -> list[float]:
        return [
            float(v) for v in re.findall(r"[-+.\d]+(?:e[-+]?\d+)?", models[0].findtext(name, ""))
        ]

    matrix, terms = numbers("intrinsic_matrix"), numbers("distortion_coefficients")
    if len(matrix) != 6 or len(terms) != 12 or any(numbers("temperature_coefficients")):
        raise ValueError(
            "its OpenCVModel has no matrix of 2 x 3, not 12 coefficients, or a focal length that "
            "follows the temperature"
        )
    (width,), (height,) = numbers("n_cols"), numbers("n_rows")
    ordered = [terms[_GIANT.index(place)] for place in range(12)]
    intrinsics = matrix[0], matrix[4], matrix[2], matrix[5], matrix[1]
    return int(width), int(height), models[0].tag, intrinsics, ordered, False


# By the key that none of the others has.
_READERS: Mapping[str, Callable[[Mapping[str, Any]], Any]] = {
    "lensmodel": _mrcal,
    "cam0": _kalibr,
    "camera_matrix": _opencv,
    "CameraModels": _giant,
}
