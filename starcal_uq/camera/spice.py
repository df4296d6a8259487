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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.distortion import get_model, with_axes
from starcal_uq.core.types import FloatArray, floats

_BLOCK = re.compile(r"^\s*\\begindata(.*?)(?:^\s*\\begintext|\Z)", re.DOTALL | re.MULTILINE)
_ASSIGNED = re.compile(r"([^\s=+]+)\s*\+?=\s*(\([^)]*\)|'[^']*'|[^\s,()]+)")
_VALUE = re.compile(r"'([^']*)'|([^\s,()']+)")
_INSTRUMENT = re.compile(r"INS(-?\d+)_(.+)")
# Keywords of distortion whose formula is known, and words in the names of others.
_SIP = re.compile(r"SIP_([AB])P_(\d)_(\d)")
_TERMS = ("RAD_DIST_COEFF", "OOC_EM", "OD_T_X", "SIP_AP_ORDER")
_OTHERS = re.compile(r"OD_K|OPTICAL_DIST|DISTORTION_COEF|RADIAL")
_MODELS = ("none", "k1", "brown", "brown3", "brown_tangential", "thin_prism", "cubic")
# Order of the polynomial that gives centre and axes, and points along each side of the detector.
_ORDER, _POINTS = 9, 25
# Rounding: px of a displacement, and radians or shares of axes that are none.
_CLOSE_PX, _NO_AXES, _NO_TURN = 1e-7, 1e-11, 1e-11
# NAIF ID of a camera that has none yet.
NO_INSTRUMENT = -999000

Keywords = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class KernelCamera:
    """One instrument of a kernel.

    `to_pixels` maps (n, 2) slopes P1 / P3, P2 / P3 to (n, 2) samples and lines, px, that count from
    0 at the centre of the first pixel.
    """

    instrument: int
    frame: str
    width_px: int
    height_px: int
    pixel_um: float
    to_pixels: Callable[[FloatArray], FloatArray]


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
    def numbers(*names: str, count: int = 1) -> FloatArray | None:
        for name in names:
            if name in words:
                values = floats([float(v.upper().replace("D", "E")) for v in words[name]])
                if len(values) not in (1, count) or not np.all(np.isfinite(values)):
                    raise ValueError(f"INS{instrument}_{name} has not {count} finite numbers")
                return np.resize(values, count)
        return None

    unknown = [name for name in words if _OTHERS.search(name) and name not in _TERMS]
    if unknown and not set(_TERMS) & set(words):
        raise ValueError(
            f"INS{instrument}_{unknown[0]} is a distortion whose formula depends on the mission; "
            f"give it as one of {', '.join(_TERMS)}"
        )
    pitch_um = numbers("PIXEL_SIZE", count=2)
    if pitch_um is None:
        pitch_mm = numbers("PIXEL_PITCH", count=2)
        pitch_um = None if pitch_mm is None else 1e3 * pitch_mm
    size = [numbers(name) for name in ("PIXEL_SAMPLES", "PIXEL_LINES")]
    centre = numbers("OOC_CCD_CENTER", "CCD_CENTER", count=2)
    focal = numbers("OOC_FOCAL_LENGTH", "FOCAL_LENGTH")
    if pitch_um is None or centre is None or focal is None or size[1] is None or size[0] is None:
        raise ValueError(
            f"INS{instrument} lacks one of FOCAL_LENGTH, PIXEL_SIZE, PIXEL_LINES and CCD_CENTER"
        )
    width, height = int(size[0][0]), int(size[1][0])
    # A centre at (n + 1) / 2 counts pixels from 1, as MDIS does; others count from 0.
    if np.array_equal(2.0 * centre, (width + 1.0, height + 1.0)):
        centre = centre - 1.0
    to_px = np.diag(1e3 / pitch_um)
    rows = numbers("ITRANSS", count=3), numbers("ITRANSL", count=3)
    if rows[0] is not None and rows[1] is not None:
        to_px = np.stack([rows[0][1:], rows[1][1:]])
    matrix = numbers("OOC_KMAT", count=4)
    if matrix is not None:
        to_px = matrix.reshape(2, 2)
    radial, keystone = numbers("RAD_DIST_COEFF"), numbers("OOC_EM", count=3)
    series = [
        v for v in (numbers("OD_T_X", count=10), numbers("OD_T_Y", count=10)) if v is not None
    ]
    sip = {
        ("AB".index(term[1]), int(term[2]), int(term[3])): float(words[name][0])
        for name in words
        if (term := _SIP.fullmatch(name))
    }

    def to_pixels(slopes: FloatArray) -> FloatArray:
        ideal = focal * slopes
        x, y = ideal.T
        r2 = x * x + y * y
        if keystone is not None:
            e2, e5, e6 = keystone
            return floats((ideal * (1.0 + e2 * r2 + e5 * y + e6 * x)[:, None]) @ to_px.T + centre)
        if len(series) == 2:
            one = np.ones_like(x)
            powers = [one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
            return floats(np.stack(powers, axis=1) @ np.stack(series).T @ to_px.T + centre)
        if radial is not None:
            return floats((ideal * (1.0 + radial * r2)[:, None]) @ to_px.T + centre)
        offset = ideal @ to_px.T
        moved = offset + centre
        for (column, p, q), value in sip.items():
            moved[:, column] += value * offset[:, 0] ** p * offset[:, 1] ** q
        return floats(moved)

    frame = (words.get("FOV_FRAME") or words.get("FRAME") or (str(instrument),))[0]
    return KernelCamera(instrument, frame, width, height, float(pitch_um[0]), to_pixels)


@dataclass(frozen=True)
class Optics:
    """Parameters of a `Camera` that does what a kernel's formula does, and a name that states how.

    The camera's frame may be turned about the boresight: a `Camera` has its x axis along the rows
    of the detector.
    """

    centre_px: tuple[float, float]
    focal_px: float
    distortion: str
    coefficients: tuple[float, ...]
    name: str


def fitted_optics(kernel: KernelCamera) -> Optics:
    """Parameters of the smallest forward model that agrees with a kernel over its detector, or of
    the nearest one.

    All models are polynomials of the ideal point that are linear in their coefficients, so that the
    parameters follow by linear least squares.
    """
    slopes, pixels = _over_detector(kernel)
    scale = float(np.max(np.abs(slopes)))
    powers = [(n - q, q) for n in range(_ORDER + 1) for q in range(n + 1)]
    terms = np.stack([np.prod((slopes / scale) ** power, axis=1) for power in powers], axis=1)
    centre, *linear = np.linalg.lstsq(terms, pixels, rcond=None)[0][:3]
    # Lines that count upwards are counted downwards: no rotation makes the one of the other.
    matrix = np.stack(linear, axis=1) / scale
    mirrored = np.linalg.det(matrix) < 0.0
    if mirrored:
        turn = np.array([1.0, -1.0])
        matrix = matrix * turn[:, None]
        pixels, centre = (turn * v + [0.0, kernel.height_px - 1.0] for v in (pixels, centre))
    # matrix = f [[1, skew], [0, 1 + stretch]] [[c, -s], [s, c]]
    angle = float(np.arctan2(matrix[1, 0], matrix[1, 1]))
    c, s = np.cos(angle), np.sin(angle)
    (focal, shear), (_, along_y) = matrix @ [[c, s], [-s, c]]
    stretch, skew = along_y / focal - 1.0, shear / focal
    if max(abs(stretch), abs(skew)) < _NO_AXES:
        stretch = skew = 0.0
    u, v = (focal * slopes @ [[c, s], [-s, c]]).T
    shift = np.linalg.solve([[focal, focal * skew], [0.0, focal * (1.0 + stretch)]], np.eye(2))
    lens = focal * (pixels - centre) @ shift.T - np.stack([u, v], axis=1)
    model, coefficients, error = _fitted_lens(u, v, lens)
    axes = (float(stretch), float(skew)) if stretch or skew else ()
    notes = [kernel.frame]
    if abs(angle) > _NO_TURN:
        notes.append(f"frame turned by {np.degrees(angle):.9g} deg about its z axis")
    notes += ["lines counted from the other side"] if mirrored else []
    notes += [f"up to {error:.2g} px from the kernel"] if error > _CLOSE_PX else []
    return Optics(
        (float(centre[0]), float(centre[1])),
        float(focal),
        with_axes(model) if axes else model,
        (*coefficients, *axes),
        ", ".join(notes),
    )


def _over_detector(kernel: KernelCamera) -> tuple[FloatArray, FloatArray]:
    """Slopes (n, 2) of directions that cover the detector, and their pixels (n, 2)."""
    sides = np.linspace(-1.0, 1.0, _POINTS)
    unit = np.stack(np.meshgrid(sides, sides), axis=-1).reshape(-1, 2)
    origin = kernel.to_pixels(np.zeros((1, 2)))[0]
    step = 1e-6
    along = (kernel.to_pixels(step * np.eye(2)) - origin) / step
    size = np.array([kernel.width_px, kernel.height_px])
    edge = np.maximum(size - 0.5 - origin, origin + 0.5)
    # Without distortion the edges are here; with it, near.
    slopes = np.linalg.solve(along.T, (unit * edge).T).T
    return floats(slopes), kernel.to_pixels(slopes)


def _fitted_lens(
    u: FloatArray, v: FloatArray, lens: FloatArray
) -> tuple[str, tuple[float, ...], float]:
    """Name, coefficients and largest error (px) of the first model that has a displacement
    (n, 2), px, or of the nearest.
    """
    found: list[tuple[str, tuple[float, ...], float]] = []
    for name in _MODELS:
        model = get_model(name)
        basis = np.empty((2 * len(u), len(model.lens)))
        for column, unit in enumerate(np.eye(len(model.lens)).tolist()):
            basis[:, column] = np.concatenate(model.displacement(u, v, unit))
        size = np.max(np.abs(basis), axis=0)
        k = np.linalg.lstsq(basis / size, lens.T.ravel(), rcond=None)[0] / size
        error = float(np.max(np.abs(basis @ k - lens.T.ravel())))
        found.append((name, tuple(k.tolist()), error))
        if error < _CLOSE_PX:
            break
    return min(found, key=lambda one: one[2])
