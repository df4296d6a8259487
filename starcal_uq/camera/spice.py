"""Cameras in text instrument kernels (IK) of SPICE.

A text kernel holds assignments between ``\\begindata`` and ``\\begintext``. Which keywords describe
a camera is a matter of each mission; those of Dawn FC, MESSENGER MDIS, New Horizons LORRI and
OSIRIS-REx OCAMS are read, with X = FOCAL_LENGTH P1 / P3 and Y = FOCAL_LENGTH P2 / P3 in mm:

- ``RAD_DIST_COEFF``: dX = E1 X R^2 (Dawn);
- ``OOC_EM`` and ``OOC_KMAT``: dX = X (EM2 R^2 + EM5 Y + EM6 X), the same for Y (LORRI);
- ``OD_T_X`` and ``OD_T_Y`` with ``ITRANSS`` and ``ITRANSL``: a Taylor series to third order (MDIS);
- ``SIP_AP_p_q`` and ``SIP_BP_p_q``: polynomials of the ideal pixel offset (LORRI; Shupe et al. 2005).

Sources: NAIF, "Kernel Required Reading", and the kernels dawn_fc_v10.ti, msgr_mdis_v160.ti,
nh_lorri_v201.ti and orx_ocams_v07.ti.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike

from starcal_uq.camera.distortion import get_model, powers, with_axes
from starcal_uq.camera.nearest import nearest_theta
from starcal_uq.core.types import AnyDict, FloatArray, floats

_BLOCK = re.compile(r"^\s*\\begindata(.*?)(?:^\s*\\begintext|\Z)", re.DOTALL | re.MULTILINE)
_ASSIGNED = re.compile(r"([^\s=+]+)\s*\+?=\s*(\([^)]*\)|'[^']*'|[^\s,()]+)")
_VALUE = re.compile(r"'([^']*)'|([^\s,()']+)")
_INSTRUMENT = re.compile(r"INS(-?\d+)_(.+)")
# Keywords of distortion whose formula is known, and words in the names of others.
_SIP = re.compile(r"SIP_([AB])P_(\d)_(\d)")
_TERMS = ("RAD_DIST_COEFF", "OOC_EM", "OD_T_X", "SIP_AP_ORDER")
_OTHERS = re.compile(r"OD_K|OPTICAL_DIST|DISTORTION_COEF|RADIAL")
_MODELS = ("none", "k1", "brown", "brown3", "brown_tangential", "thin_prism", "cubic")
# Points along each side of the detector.
_POINTS = 25
# Rounding: px of a displacement, and radians or shares of axes that are none.
_CLOSE_PX, _ROUNDING = 1e-7, 1e-11
# NAIF ID of a camera that has none yet.
NO_INSTRUMENT = -999000

Keywords = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class KernelCamera:
    """One instrument of a kernel.

    `terms` are the polynomial that gives sample and line, px from 0 at the centre of the first
    pixel: coefficients (2,) by the powers of the slopes P1 / P3 and P2 / P3.
    """

    frame: str
    width_px: int
    height_px: int
    pixel_um: float
    terms: Mapping[tuple[int, int], FloatArray]


def read_kernel(text: str, instrument: int | None = None) -> KernelCamera:
    """The camera of an instrument kernel; ValueError says what the text lacks.

    `instrument` is the NAIF ID; it may be left out where the kernel describes one camera.
    """
    held = _instruments(text)
    cameras = {
        key: words for key, words in held.items() if {"FOCAL_LENGTH", "PIXEL_SAMPLES"} <= set(words)
    }
    if instrument is None and len({tuple(sorted(c.items())) for c in cameras.values()}) == 1:
        instrument = next(iter(cameras))
    if instrument not in cameras:
        listed = ", ".join(map(str, cameras)) or "none"
        raise ValueError(
            "it has no camera with FOCAL_LENGTH and PIXEL_SAMPLES"
            if not cameras
            else f"it has the cameras {listed}: put one of them behind the name of the file, as in "
            f"FILE.ti#{next(iter(cameras))}"
        )
    return _camera(instrument, cameras[instrument])


def kernel_text(instrument: int, values: Mapping[str, object], known: str = "") -> str:
    """A kernel of one instrument; `known` are lines on the standard deviations of its values."""

    def shown(value: object) -> str:
        if isinstance(value, tuple):
            return "( " + ",\n      ".join(map(repr, value)) + " )"
        return str(value)

    assigned = "".join(f"   INS{instrument}_{key} = {shown(v)}\n" for key, v in values.items())
    comment = f"\nStandard deviations of the calibration:\n\n{known}" if known else ""
    return _KERNEL.format(instrument=instrument, assigned=assigned, comment=comment)


_KERNEL = """\
KPL/IK

Camera INS{instrument}

   FOCAL_LENGTH is in mm, PIXEL_SIZE in micrometres. Pixels count from 0 at the centre of the
   first one; x is the sample, y the line. The boresight is the z axis of the camera's frame.
   With U = FOCAL_LENGTH P1 / P3 and V = FOCAL_LENGTH P2 / P3, in pixels, the measured offset
   from CCD_CENTER is U plus the sum of SIP_AP_p_q U^p V^q and V plus that of SIP_BP_p_q U^p V^q.

\\begindata

{assigned}
\\begintext
{comment}"""


def _instruments(text: str) -> dict[int, dict[str, tuple[str, ...]]]:
    found: dict[int, dict[str, tuple[str, ...]]] = {}
    for block in _BLOCK.findall(text):
        for name, value in _ASSIGNED.findall(block):
            if match := _INSTRUMENT.fullmatch(name):
                # The last assignment of a keyword stands.
                values = tuple(quoted or bare for quoted, bare in _VALUE.findall(value))
                found.setdefault(int(match[1]), {})[match[2]] = values
    return found


def _camera(instrument: int, words: Keywords) -> KernelCamera:
    def numbers(count: int, *names: str, default: ArrayLike | None = None) -> FloatArray:
        name = next((n for n in names if n in words), "")
        if not name and default is None:
            raise ValueError(f"INS{instrument} lacks {names[-1]}")
        values = [v.upper().replace("D", "E") for v in words[name]] if name else default
        found = floats(values).ravel()
        if len(found) not in (1, count) or not np.all(np.isfinite(found)):
            raise ValueError(f"INS{instrument}_{name} has not {count} finite numbers")
        return np.resize(found, count)

    unknown = [name for name in words if _OTHERS.search(name) and name not in _TERMS]
    if unknown and not set(_TERMS) & set(words):
        raise ValueError(
            f"INS{instrument}_{unknown[0]} is a distortion whose formula depends on the mission; "
            f"give it as one of {', '.join(_TERMS)}"
        )
    size = np.concatenate([numbers(1, name) for name in ("PIXEL_SAMPLES", "PIXEL_LINES")])
    centre = numbers(2, "OOC_CCD_CENTER", "CCD_CENTER")
    # A centre at (n + 1) / 2 counts pixels from 1, as MDIS does; others count from 0.
    centre -= np.array_equal(2.0 * centre, size + 1.0)
    pitch_mm = (
        numbers(2, "PIXEL_PITCH") if "PIXEL_PITCH" in words else numbers(2, "PIXEL_SIZE") / 1e3
    )
    (a, b), (c, d) = np.diag(1.0 / pitch_mm)
    rows = numbers(3, "ITRANSS", default=[0, a, b]), numbers(3, "ITRANSL", default=[0, c, d])
    to_px = numbers(4, "OOC_KMAT", default=np.stack(rows)[:, 1:]).reshape(2, 2)
    e2, e5, e6 = numbers(3, "OOC_EM", default=[*numbers(1, "RAD_DIST_COEFF", default=0.0), 0, 0])
    x = numbers(10, "OD_T_X", default=[0, 1, 0, e6, e5, 0, e2, 0, e2, 0])
    y = numbers(10, "OD_T_Y", default=[0, 0, 1, 0, e6, e5, 0, e2, 0, e2])
    focal_px = numbers(1, "OOC_FOCAL_LENGTH", "FOCAL_LENGTH") * to_px
    terms = {
        power: focal_px @ xy * (focal_px[0, 0] / to_px[0, 0]) ** (sum(power) - 1)
        for power, xy in zip(powers(3, 0), np.stack([x, y], axis=1), strict=True)
    }
    terms[0, 0] = terms[0, 0] + centre
    for match in () if "OOC_EM" in words else filter(None, map(_SIP.fullmatch, words)):
        axis, power = "AB".index(match[1]), (int(match[2]), int(match[3]))
        value = float(words[match[0]][0]) * np.prod(np.diag(focal_px) ** power)
        terms[power] = terms.get(power, np.zeros(2)) + value * np.eye(2)[axis]
    frame = (words.get("FOV_FRAME") or words.get("FRAME") or (str(instrument),))[0]
    return KernelCamera(frame, int(size[0]), int(size[1]), float(1e3 * pitch_mm[0]), terms)


def fitted_optics(kernel: KernelCamera) -> AnyDict:
    """Fields of a `Camera` of the smallest forward model that agrees with a kernel over its
    detector, or of the nearest one.

    The camera's frame may be turned about the boresight, as its name states: a `Camera` has its
    x axis along the rows of the detector.
    """
    centre, *linear = (kernel.terms[power] for power in ((0, 0), (1, 0), (0, 1)))
    matrix = np.stack(linear, axis=1)
    size = np.array([kernel.width_px, kernel.height_px])
    side = np.linspace(-1.0, 1.0, _POINTS)
    unit = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    # Without distortion the edges of the detector are here; with it, near.
    slopes = unit * np.maximum(size - 0.5 - centre, centre + 0.5) @ np.linalg.inv(matrix).T
    offsets = sum(
        (np.outer(np.prod(slopes**power, axis=1), xy) for power, xy in kernel.terms.items()),
        start=-centre,
    )
    # Lines that count upwards are counted downwards: no rotation makes the one of the other.
    mirrored = np.linalg.det(matrix) < 0.0
    if mirrored:
        offsets, matrix = offsets * [1.0, -1.0], matrix * [[1.0], [-1.0]]
        centre = np.array([centre[0], kernel.height_px - 1.0 - centre[1]])
    # matrix = f [[1, skew], [0, 1 + stretch]] [[c, -s], [s, c]]
    angle = np.arctan2(matrix[1, 0], matrix[1, 1])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    upper = matrix @ turn
    focal = float(upper[0, 0])
    axes = [float(upper[1, 1] / focal - 1.0), float(upper[0, 1] / focal)]
    if np.max(np.abs(axes)) < _ROUNDING:
        axes = []
    found: list[tuple[float, str, FloatArray]] = []
    for name in _MODELS:
        model = with_axes(name) if axes else name
        lens = np.zeros(len(get_model(name).lens))
        theta = np.concatenate([centre, [focal], lens, axes])
        fixed = ("x0", "y0", "f", "stretch", "skew")
        theta, error = nearest_theta(model, theta, slopes @ turn, offsets + centre, fixed)
        found.append((error, model, theta))
        if error < _CLOSE_PX:
            break
    error, model, theta = min(found, key=itemgetter(0))
    notes = [kernel.frame]
    if abs(angle) > _ROUNDING:
        notes.append(f"frame turned by {np.degrees(angle):.9g} deg about its z axis")
    notes += ["lines counted from the other side"] if mirrored else []
    notes += [f"up to {error:.2g} px from the kernel"] if error > _CLOSE_PX else []
    return {
        "width_px": kernel.width_px,
        "height_px": kernel.height_px,
        "pixel_um": kernel.pixel_um,
        "focal_mm": None,
        "focal_px": focal,
        "x0_px": float(centre[0]),
        "y0_px": float(centre[1]),
        "distortion": model,
        "coefficients": tuple(theta[3:].tolist()),
        "name": ", ".join(notes),
    }
