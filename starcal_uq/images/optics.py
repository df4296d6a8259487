"""What image files say of lens, detector and place: pixel pitch, focal length and site, where they
do.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import AnyDict, AnyMapping, floats

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
_PLACES = (
    ("OBSGEO-B", "OBSGEO-L", "OBSGEO-H"),
    ("SITELAT", "SITELONG", "SITEELEV"),
    ("LAT-OBS", "LONG-OBS", "ALT-OBS"),
)
# Values beyond are no sensor's and no lens's.
_PIXEL_UM, _FOCAL_MM = (0.3, 200.0), (0.5, 50_000.0)


def optics_of(header: AnyMapping, width_px: int, height_px: int) -> AnyDict:
    """Size of an image, and ``pixel_um``, ``focal_mm`` and ``focal_px`` as far as its header has
    them.

    Of FITS: XPIXSZ, PIXSIZE1 (um), FOCALLEN (mm), and the scale of PIXSCALE, SECPIX (arcsec) or a
    tangent plane's CDELT1 or CD1_1, CD2_1 (deg). Of Exif: FocalLength, FocalPlaneXResolution,
    FocalLengthIn35mmFilm.
    """
    found: AnyDict = {"width_px": int(width_px), "height_px": int(height_px)}
    pixel = _within(_PIXEL_UM, header, "XPIXSZ", "PIXSIZE1", "PIXSIZE")
    focal = _within(_FOCAL_MM, header, "FOCALLEN", "FocalLength")
    per_unit = _number(header, "FocalPlaneXResolution")
    if pixel is None and per_unit and per_unit > 0.0:
        unit = _number(header, "FocalPlaneResolutionUnit")
        pixel = _within(_PIXEL_UM, {"": _UNIT_UM.get(unit or 2.0, 0.0) / per_unit}, "")
    scale = _within((1e-3, 3600.0), header, "PIXSCALE", "SECPIX")
    focal_px = ARCSEC / scale if scale else None
    if focal_px is None and "TAN" in str(header.get("CTYPE1", "")):
        step = np.hypot(_number(header, "CD1_1") or 0.0, _number(header, "CD2_1") or 0.0)
        step = step or abs(_number(header, "CDELT1") or 0.0)
        focal_px = 1.0 / float(np.radians(step)) if 3e-7 < step < 1.0 else None
    film = _number(header, "FocalLengthIn35mmFilm")
    if focal_px is None and not (pixel and focal) and film and film > 0.0:
        focal_px = film / _DIAGONAL_35_MM * float(np.hypot(width_px, height_px))
    lengths = {"pixel_um": pixel, "focal_mm": focal, "focal_px": focal_px}
    return found | {name: float(value) for name, value in lengths.items() if value is not None}


def place_of(header: AnyMapping) -> AnyDict:
    """Latitude and longitude (degrees, north and east positive), height (m) and the keys that say
    so, or nothing.

    Of FITS: OBSGEO-B, -L, -H or OBSGEO-X, -Y, -Z (m), SITELAT and SITELONG, LAT-OBS and LONG-OBS
    with ALT-OBS; degrees as a number or as "52 13 04.5".
    """
    for north, east, up in _PLACES:
        latitude, longitude = _angle(header, north), _angle(header, east)
        if latitude is None or longitude is None:
            continue
        if abs(latitude) <= 90.0 and abs(longitude) <= 360.0:
            return _place(latitude, longitude, _number(header, up) or 0.0, f"{north}, {east}")
    # NaN where one is missing.
    xyz = floats([_number(header, f"OBSGEO-{axis}") for axis in "XYZ"])
    if 6.3e6 < np.linalg.norm(xyz) < 6.4e6:
        import erfa

        *angles, height = erfa.gc2gd(1, xyz)
        longitude, latitude = np.degrees(angles).tolist()
        return _place(latitude, longitude, float(height), "OBSGEO-X, -Y, -Z")
    return {}


def _place(latitude: float, longitude: float, height: float, keys: str) -> AnyDict:
    if latitude == longitude == 0.0 or not -500.0 <= height <= 9000.0:
        # What programs write that do not know.
        return {}
    longitude = (longitude + 180.0) % 360.0 - 180.0
    return {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height, "keys": keys}


def _angle(header: AnyMapping, key: str) -> float | None:
    """Degrees, of a number or of degrees, minutes and seconds in a text."""
    if (value := _number(header, key)) is not None:
        return value
    words = re.findall(r"\d+(?:\.\d+)?", str(header.get(key, "")))
    if not 2 <= len(words) <= 3 or any(float(word) >= 60.0 for word in words[1:]):
        return None
    size = sum(float(word) / 60.0**power for power, word in enumerate(words))
    text = str(header[key]).strip().upper()
    return -size if text.startswith("-") or text.endswith(("S", "W")) else size


def common_place(places: Sequence[AnyDict]) -> AnyDict:
    """The place that all images state which state one; nothing where they differ by more than a
    kilometre.
    """
    said = [place for place in places if place]
    if not said:
        return {}
    ends = np.array([[place["latitude_deg"], place["longitude_deg"]] for place in said])
    return said[0] if np.all(np.ptp(ends, axis=0) < 0.01) else {}


def other_sizes(optics: Mapping[int, AnyDict], common: AnyDict) -> dict[str, list[int]]:
    """Sizes of the images, by frame number, that are not of the common size."""
    size = [common.get("width_px"), common.get("height_px")]
    sizes = {str(n): [said["width_px"], said["height_px"]] for n, said in optics.items()}
    return {number: other for number, other in sizes.items() if other != size}


def common_optics(optics: Sequence[AnyDict]) -> AnyDict:
    """What most images say, of those of the size that most have; nothing of none."""
    if not optics:
        return {}
    sizes = [(said["width_px"], said["height_px"]) for said in optics]
    most = Counter(sizes).most_common(1)[0][0]
    alike = (said for said, size in zip(optics, sizes, strict=True) if size == most)
    return dict(Counter(tuple(sorted(said.items())) for said in alike).most_common(1)[0][0])


def exif_of(picture: Any) -> AnyDict:
    """The entries of a picture that say something of its lens."""
    try:
        entries = picture.getexif().get_ifd(0x8769)
        return {name: float(entries[tag]) for tag, name in EXIF.items() if tag in entries}
    except Exception:  # whatever is wrong with them, the pixels are good
        return {}


def _within(limits: tuple[float, float], header: AnyMapping, *keys: str) -> float | None:
    values = [_number(header, key) for key in keys]
    return next((v for v in values if v is not None and limits[0] <= v <= limits[1]), None)


def _number(header: AnyMapping, key: str) -> float | None:
    try:
        value = float(header.get(key, np.nan))
    except (TypeError, ValueError):
        return None
    return value if np.isfinite(value) else None
