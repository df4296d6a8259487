"""Frames of FITS files: which images and planes, their times, gain and mosaic."""

from __future__ import annotations

import io
import math
import re
import warnings
import zlib
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import check_fits, unpack
from starcal_uq.core.times import FIRST_YEAR, LAST_YEAR, utc_of_scale
from starcal_uq.core.types import AnyDict, AnyMapping
from starcal_uq.images.image import MOSAICS, Image
from starcal_uq.images.pixels import (
    COLOURS_WORDS,
    broken,
    check_declared,
    checked,
    full_scale_of,
    grey,
    too_much,
)

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# What the comment of GAIN says where it is electrons per count.
_PER_COUNT = re.compile(r"electron|\be-? ?(/|per )", re.IGNORECASE | re.ASCII)
# Images beside the frame itself, by the names that their extensions have.
_BESIDES = re.compile(
    r"(ERR|VAR|IVAR|SIGMA|RMS|NOISE|DQ|QUAL|MASK|FLAG|BPM|WEIGHT|WHT|WT|BKG|BACKG|SKY|DARK|FLAT|BIAS|THUMB|PREVIEW)"
)
_SIZES = re.compile(rb"NAXIS[1-9] *= *(\d{1,20})")


def read_fits(path: Path, data: bytes, camera: Camera | None, every: bool) -> list[Image]:
    with extra("images", f"{path}: FITS images"):
        from astropy.io import fits

    stored = len(data)
    if data.startswith(b"\x1f\x8b"):
        data = _unpacked(path, data)
    if not data.startswith(b"SIMPLE"):
        raise ImageError(
            f"{path}: the file is not a FITS image; check what it is, or name it by its format."
        )
    try:
        check_fits(data)
    except ValueError:
        raise broken(path) from None
    taken: list[tuple[int, Any, AnyDict, str]] = []
    with warnings.catch_warnings():
        # Astropy warns of a truncated file and then pads it or fails later; both are one error
        # here.
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*(truncated|Error validating header).*")
        try:
            with fits.open(io.BytesIO(data), memmap=False) as hdus:
                chosen, images, words = _science_images(hdus, camera)
                for place in chosen if every else chosen[:1]:
                    hdu, first = hdus[place], hdus[0].header
                    declared = math.prod(hdu.shape) * abs(hdu.header["BITPIX"]) // 8
                    check_declared(path, declared, max(stored, len(data)))
                    header = _plain(hdu.header)
                    units = (str(h.comments["GAIN"]) for h in (hdu.header, first) if "GAIN" in h)
                    if place and header.get("INHERIT", True):
                        # Exposures of several images say in the first header what is common to
                        # them.
                        header = _plain(first) | header
                    taken.append((place, np.array(hdu.data), header, next(units, "")))
        except ImageError:
            raise
        except Exception as error:  # astropy raises whatever the broken bytes lead to
            raise broken(path) from error
    if not taken:
        raise ImageError(f"{path}: the FITS file holds no image; leave it out.")
    if not all(pixels.size and pixels.ndim > 1 for _, pixels, _, _ in taken):
        raise ImageError(f"{path}: the image has no pixels; leave it out.")
    shape = taken[0][1].shape
    size = f"{shape[-1]} x {shape[-2]} px"
    if len(images) > len(taken):
        what = f"{len(taken)} of {size} were"
        if len(taken) == 1:
            what = f"the one of {size} in HDU {chosen[0]} was"
        words = [f"of {len(images)} images in the file, {what} taken.", *words]
    found: list[Image] = []
    for place, pixels, header, unit in taken:
        frames, notes = _planes(pixels, header)
        if not every and len(frames) > 1:
            frames, notes = frames[:1], [f"the first of {len(frames)} planes was taken."]
        for number, plane in enumerate(frames):
            parts = ([place] if len(chosen) > 1 else []) + ([number] if len(frames) > 1 else [])
            name = f"{path.name}[{','.join(map(str, parts))}]" if parts and every else path.name
            # What is said of the file is said with its first frame.
            said = words if not found else []
            said = [f"{path.name}: {text}" for text in (*said, *(notes if number == 0 else []))]
            image = _fits_image(path, name, plane, header, unit, said, (number, len(frames)))
            found.append(replace(image, of_colours=COLOURS_WORDS in notes))
    return found


def _unpacked(path: Path, data: bytes) -> bytes:
    """Content of a file of gzip."""
    content = bytearray()
    try:
        for piece in unpack(data):
            if not content:
                # What the first header says spares the rest.
                sizes = _SIZES.findall(piece.partition(b"END" + b" " * 77)[0])
                check_declared(path, math.prod(map(int, sizes)) if sizes else 0, len(data))
            content += piece
    except ValueError as error:
        raise too_much(path, error) from None
    except (OSError, EOFError, zlib.error) as error:
        raise broken(path) from error
    return bytes(content)


def _science_images(
    hdus: Any, camera: Camera | None
) -> tuple[list[int], dict[int, tuple[int, ...]], list[str]]:
    """Places of the images of the camera's size, or else of the largest; the sizes of all; what is
    to be said.

    Images of that size that are named as the noise, quality or background of another are not among
    them.
    """
    shapes: dict[int, tuple[int, ...]] = {}
    words: list[str] = []
    size = None if camera is None else (camera.height_px, camera.width_px)
    try:
        for place, hdu in enumerate(hdus):
            if hdu.is_image and len(hdu.shape) >= 2:
                shapes[place] = hdu.shape[-2:]
    except Exception as error:
        # Bytes after the last image do no harm, nor does a damaged one after that of the camera.
        if not shapes or ("truncated" in str(error) and size not in shapes.values()):
            raise
        if "truncated" in str(error):
            words.append(
                f"the file is cut off after HDU {max(shapes)}, and what follows was not read."
            )
    if not shapes:
        return [], {}, []
    best = max(shapes, key=lambda place: (shapes[place] == size, np.prod(shapes[place])))
    alike = [place for place in shapes if shapes[place] == shapes[best]]
    names = {place: str(hdus[place].header.get("EXTNAME", "")).strip().upper() for place in alike}
    beside = {k: name for k, name in names.items() if k != best and _BESIDES.match(name)}
    if beside:
        words.append(f"{', '.join(beside.values())} were not read, being no frames by their names.")
    return [place for place in alike if place not in beside], shapes, words


def _plain(header: Any) -> AnyDict:
    plain: AnyDict = {}
    for card in header.cards:
        # astropy raises errors of its own for a value that is none; the others are as good as
        # before
        with suppress(Exception):
            if isinstance(card.value, str | bool | int | float):
                plain.setdefault(card.keyword, card.value)
    for key in ("", "COMMENT", "HISTORY"):
        plain.pop(key, None)
    return plain


def _planes(pixels: Any, header: AnyMapping) -> tuple[Any, list[str]]:
    """Frames (n, height, width) of the pixels of one HDU, and what is to be said of them."""
    frames = pixels.reshape(-1, *pixels.shape[-2:])
    n = len(frames)
    if n == 1:
        return frames, []
    if n == 3 and "RGB" in f"{header.get('CTYPE3', '')} {header.get('COLORSPC', '')}".upper():
        return grey([np.ascontiguousarray(colour) for colour in frames], None)[0][None], [
            COLOURS_WORDS
        ]
    cycle, by = _cycle_s(header, n)
    how = f", each taken to begin where the one before ends ({by})"
    if cycle is None:
        how = "; the header does not say how they follow in time"
    elif by != "EXPTIME":
        how = f", {cycle:g} s apart ({by})"
    return frames, [f"{n} planes were read as frames{how}."]


def _cycle_s(header: AnyMapping, n: int) -> tuple[float | None, str]:
    """Seconds from one of n planes to the next, and the keyword that says it."""
    if kinetic := _positive(header, "KCT"):
        return kinetic, "KCT"
    unit = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}.get(
        str(header.get("CUNIT3", "")).strip()
    )
    if str(header.get("CTYPE3", "")).strip().upper() in ("TIME", "UTC", "UT") and unit:
        return (step * unit if (step := _positive(header, "CDELT3")) else None), "CDELT3"
    try:
        first, last = (
            datetime.fromisoformat(str(header[key]).strip()) for key in ("DATE-OBS", "DATE-END")
        )
        span = (last - first).total_seconds()
    except (KeyError, ValueError, TypeError):
        span = 0.0
    if span > 0.0:
        return span / n, "DATE-END"
    return _positive(header, "EXPTIME", "EXPOSURE"), "EXPTIME"


def _fits_image(
    path: Path,
    name: str,
    pixels: Any,
    header: AnyDict,
    unit: str,
    messages: list[str],
    plane: tuple[int, int],
) -> Image:
    """The image of pixels and header; `plane` is its place among planes, and `unit` the comment of
    GAIN.
    """
    pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
    exposure = _positive(header, "EXPTIME", "EXPOSURE")
    time, words = _middle(header, exposure, *plane)
    messages += [f"{name}: {words}"] if words else []
    gain = _positive(header, "EGAIN")
    if gain is None and (bare := _positive(header, "GAIN")) is not None:
        # Of many cameras it is a setting.
        gain = bare if _PER_COUNT.search(unit) else None
        if gain is None:
            messages.append(
                f"{name}: GAIN ({bare:g}) does not say that it is in electrons per count and was "
                "not used; give "
                "the gain."
            )
    mosaic, words = _stated_mosaic(header, pixels.shape[0])
    messages += [f"{name}: {words}"] if words else []
    return Image(
        checked(path, pixels, messages),
        name,
        time_utc=time,
        exposure_s=exposure,
        saturation=_positive(header, "SATURATE", "SATLEVEL") or full_scale_of(pixels),
        header=header,
        gain_e_per_count=gain,
        messages=tuple(messages),
        mosaic=mosaic,
    )


def _stated_mosaic(header: AnyMapping, height: int) -> tuple[str, str]:
    """The mosaic of colours that a header states, from the first row stored; or why it is not
    used.
    """
    stated = str(header.get("BAYERPAT", "") or header.get("COLORTYP", "")).strip().upper()
    if stated not in MOSAICS:
        if "BAYERPAT" not in header or not stated:
            return "", ""
        return "", (
            f"the pixels are a mosaic of colours ({stated}) that is not known here and were read "
            "as grey, which makes "
            f"centroids worse than predicted; give bayer, one of {', '.join(MOSAICS)}."
        )
    across, down = (int(header.get(key, 0) or 0) % 2 for key in ("XBAYROFF", "YBAYROFF"))
    if str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP":
        # The pattern counts from the upper row, which is then stored last.
        down = (down + height - 1) % 2
    rows = (stated[:2], stated[2:])
    return "".join(rows[(k + down) % 2][(j + across) % 2] for k in (0, 1) for j in (0, 1)), ""


def _positive(header: AnyMapping, *keys: str) -> float | None:
    for key in keys:
        try:
            value = float(header[key])
        except (KeyError, TypeError, ValueError):
            continue
        if np.isfinite(value) and value > 0.0:
            return value
    return None


def _middle(
    header: AnyMapping, exposure_s: float | None, plane: int = 0, planes: int = 1
) -> tuple[str | None, str]:
    """Middle of the exposure, UTC: DATE-AVG, or DATE-OBS (its start) plus half the exposure; why a
    time is not used.

    Of several planes, DATE-AVG is the middle of all, and DATE-OBS the start of the first.
    """
    problem = ""
    cycle = (_cycle_s(header, planes)[0] or 0.0) if planes > 1 else 0.0
    if planes > 1 and exposure_s is not None and cycle:
        # Some state the exposure of all planes together.
        exposure_s = min(exposure_s, cycle)
    delays = (plane - 0.5 * (planes - 1)) * cycle, plane * cycle + 0.5 * (exposure_s or 0.0)
    for key, delay in zip(("DATE-AVG", "DATE-OBS"), delays, strict=True):
        text = str(header.get(key, "")).strip().rstrip("Z")
        if key == "DATE-OBS" and "T" not in text and header.get("TIME-OBS"):
            text = f"{text}T{str(header['TIME-OBS']).strip()}"
        try:
            time = datetime.fromisoformat(text)
        except ValueError:
            continue
        # A date alone is no time of day.
        if "T" not in text:
            continue
        if not FIRST_YEAR <= time.year <= LAST_YEAR:
            problem = (
                f"{key} is of the year {time.year}, not of {FIRST_YEAR} to {LAST_YEAR}, and was "
                "not used."
            )
            continue
        if time.tzinfo is not None:
            time = time.astimezone(UTC).replace(tzinfo=None)
        scale = str(header.get("TIMESYS", "")).partition("(")[0].strip().upper() or "UTC"
        try:
            utc = utc_of_scale(time, scale) + timedelta(seconds=delay)
        except OverflowError:
            continue
        except ValueError:
            problem = f"{key} is in {scale} by TIMESYS, which is not known here, and was not used."
            continue
        if not FIRST_YEAR <= utc.year <= LAST_YEAR:
            continue
        return utc.isoformat(timespec="microseconds"), ""
    return None, problem
