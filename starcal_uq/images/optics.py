"""What image files say of the lens and the detector: pixel pitch and focal length, where they do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import AnyDict

# Exif's names, as the header of a picture has them.
EXIF = {
    37386: "FocalLength",
    41486: "FocalPlaneXResolution",
    41488: "FocalPlaneResolutionUnit",
    41989: "FocalLengthIn35mmFilm",
}
# Micrometres of Exif's units of resolution: inch, centimetre, millimetre, micrometre.
_UNIT_UM = {2.0: 25400.0, 3.0: 10000.0, 4.0: 1000.0, 5.0: 1.0}
_DIAGONAL_35_MM = 43.27
# Values beyond are no sensor's and no lens's.
_PIXEL_UM, _FOCAL_MM = (0.3, 200.0), (0.5, 50_000.0)


def optics_of(header: Mapping[str, Any], width_px: int, height_px: int) -> AnyDict:
    """Size of an image, and ``pixel_um``, ``focal_mm`` and ``focal_px`` as far as its header has them.

    Of FITS: XPIXSZ, PIXSIZE1 (um), FOCALLEN (mm), and the scale of PIXSCALE, SECPIX (arcsec) or a tangent plane's
    CDELT1 or CD1_1, CD2_1 (deg). Of Exif: FocalLength, FocalPlaneXResolution, FocalLengthIn35mmFilm.
    """
    found: AnyDict = {"width_px": int(width_px), "height_px": int(height_px)}
    pixel = _within(_PIXEL_UM, header, "XPIXSZ", "PIXSIZE1", "PIXSIZE")
    focal = _within(_FOCAL_MM, header, "FOCALLEN", "FocalLength")
    per_unit, unit = _number(header, "FocalPlaneXResolution"), _number(header, "FocalPlaneResolutionUnit")
    if pixel is None and per_unit and per_unit > 0.0:
        pixel = _UNIT_UM.get(unit or 2.0, 0.0) / per_unit
        pixel = pixel if _PIXEL_UM[0] <= pixel <= _PIXEL_UM[1] else None
    scale = _within((1e-3, 3600.0), header, "PIXSCALE", "SECPIX")
    focal_px = ARCSEC / scale if scale else None
    if focal_px is None and "TAN" in str(header.get("CTYPE1", "")):
        step = np.hypot(_number(header, "CD1_1") or 0.0, _number(header, "CD2_1") or 0.0)
        step = step or abs(_number(header, "CDELT1") or 0.0)
        focal_px = 1.0 / float(np.radians(step)) if 3e-7 < step < 1.0 else None
    film = _number(header, "FocalLengthIn35mmFilm")
    if focal_px is None and not (pixel and focal) and film and film > 0.0:
        focal_px = film / _DIAGONAL_35_MM * float(np.hypot(width_px, height_px))
    for name, value in (("pixel_um", pixel), ("focal_mm", focal), ("focal_px", focal_px)):
        if value is not None:
            found[name] = float(value)
    return found


def other_sizes(optics: Mapping[int, AnyDict], common: AnyDict) -> dict[str, list[int]]:
    """Sizes of the images, by frame number, that are not of the common size."""
    size = [common.get("width_px"), common.get("height_px")]
    sizes = {str(n): [said["width_px"], said["height_px"]] for n, said in optics.items()}
    return {number: other for number, other in sizes.items() if other != size}


def common_optics(optics: Sequence[AnyDict]) -> AnyDict:
    """What most images say; nothing of none."""
    if not optics:
        return {}
    return dict(Counter(tuple(sorted(said.items())) for said in optics).most_common(1)[0][0])


def exif_of(picture: Any) -> AnyDict:
    """The entries of a picture that say something of its lens."""
    try:
        entries = picture.getexif().get_ifd(0x8769)
        return {name: float(entries[tag]) for tag, name in EXIF.items() if tag in entries}
    except Exception:  # whatever is wrong with them, the pixels are good
        return {}


def _within(limits: tuple[float, float], header: Mapping[str, Any], *keys: str) -> float | None:
    values = [_number(header, key) for key in keys]
    return next((v for v in values if v is not None and limits[0] <= v <= limits[1]), None)


def _number(header: Mapping[str, Any], key: str) -> float | None:
    try:
        value = float(header.get(key, np.nan))
    except (TypeError, ValueError):
        return None
    return value if np.isfinite(value) else None
