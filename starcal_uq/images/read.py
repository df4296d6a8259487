"""Frames read from files: FITS, TIFF, PNG, JPEG, BMP and raw files become arrays whose first row is
y = 0.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.files import read_bytes
from starcal_uq.core.times import FIRST_YEAR, LAST_YEAR
from starcal_uq.core.types import PathLike
from starcal_uq.images.fits_files import read_fits
from starcal_uq.images.image import Image
from starcal_uq.images.optics import exif_of
from starcal_uq.images.pixels import (
    COLOURS_WORDS,
    broken,
    check_declared,
    checked,
    full_scale_of,
    grey,
)
from starcal_uq.images.raw import deep_colours, read_raw

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

FITS_ENDINGS = (".fits", ".fit", ".fts", ".fits.gz", ".fit.gz", ".fts.gz")
RAW_ENDINGS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".pef")
IMAGE_ENDINGS = (*FITS_ENDINGS, ".tiff", ".tif", ".png", ".jpg", ".jpeg", ".bmp", *RAW_ENDINGS)
# Of Pillow's formats: others start programs (EPS) or turn the image upside down (FITS).
_PICTURES = ("TIFF", "PNG", "JPEG", "BMP")
# A frame of a file that holds several.
_ONE_OF = re.compile(r"(.+)\[(\d+(?:,\d+)?)\]")
# Bytes of a pixel by Pillow's modes; four for all others.
_PIXEL_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}
# ISO 8601 as far as names of files allow it: colons are left out or replaced.
_TIME_IN_NAME = re.compile(
    r"(?<!\d)(\d{4})-?(\d\d)-?(\d\d)T(\d\d)[-:_.]?(\d\d)[-:_.]?(\d\d)(?:[.,](\d{1,6})(?!\d))?(?!\d)",
    re.ASCII,
)


def read_image(path: PathLike, camera: Camera | None = None) -> Image:
    """Read one frame (``.fits``, ``.fits.gz``, ``.tiff``, ``.png``, ``.jpg``, ``.bmp``, or a
    camera's raw file).

    The rows are kept in the order of the file, so the first row is y = 0. A colour image becomes
    its luminance; of a file with several frames the first is taken, of a FITS file with several
    images the first of the camera's size, or the largest; without a time in the header, one in the
    file's name is taken (such as 2019-07-29T204726); `messages` of the result say so.

    Parameters
    ----------
    path
        The file, or one frame of it as `read_images` names them (``cube.fits[3]``).
    camera
        If given, the image must be the size of its detector.

    Raises
    ------
    ImageError
        If the file is missing, truncated, no image, of the wrong size, or declares more pixels than
        it can hold.
    MissingExtraError
        If the library for its format is not installed.
    """
    path = Path(path)
    part = _ONE_OF.fullmatch(path.name)
    if part is None or os.path.exists(path):
        image = _read(path, camera, every=False)[0]
    else:
        images = {image.name: image for image in _read(path.with_name(part[1]), camera, every=True)}
        if path.name not in images:
            raise ImageError(
                f"{path}: there is no such frame; the file has {', '.join(_few(list(images)))}."
            )
        image = images[path.name]
    if camera is not None:
        image.check_size(camera)
    return image


def read_images(path: PathLike, camera: Camera | None = None) -> list[Image]:
    """Read all frames of a file: planes of a FITS cube, images of a FITS file, pages of a TIFF
    file.

    Those of one size are taken, that of the camera or the largest. A file with several frames names
    them ``cube.fits[0]``, ``cube.fits[1]`` and so on, by the plane or the page; where a FITS file
    has several images, by their HDU, ``images.fits[1]``, and cubes among them by HDU and plane,
    ``cubes.fits[1,0]``. Each plane of a cube has a time of its own where the header states the time
    between planes (``KCT``, a third axis of time, ``DATE-END``) or the exposure, after which the
    next is then taken to have begun.

    Parameters
    ----------
    path
        The file.
    camera
        Images of its size are preferred.

    Raises
    ------
    ImageError
        As `read_image`; another size is let through.
    """
    return _read(Path(path), camera, every=True)


def _read(path: Path, camera: Camera | None, every: bool) -> list[Image]:
    data = read_bytes(path, "an image file", ImageError)
    name = path.name.lower()
    if not name.endswith(IMAGE_ENDINGS):
        raise ImageError(
            f"{path}: the ending {path.suffix or '(none)'} is unknown; use "
            f"{', '.join(IMAGE_ENDINGS)}."
        )
    if name.endswith(FITS_ENDINGS):
        images = read_fits(path, data, camera, every)
    elif name.endswith(RAW_ENDINGS):
        images = [read_raw(path, data)]
    else:
        images = _read_picture(path, data, camera, every)
    return [_with_named_time(image) for image in images]


def _with_named_time(image: Image) -> Image:
    time = time_in_name(image.name)
    if image.time_utc is not None or time is None:
        return image
    messages = (*image.messages, time_in_name_message(image.name))
    return replace(image, time_utc=time, messages=messages)


def _few(names: list[str]) -> list[str]:
    return names if len(names) < 5 else [*names[:2], "...", names[-1]]


def time_in_name(name: str) -> str | None:
    """The UTC time in a file's name, such as 2019-07-29T204726, as ISO 8601 text."""
    for match in _TIME_IN_NAME.finditer(name):
        *parts, fraction = match.groups()
        with suppress(ValueError):
            time = datetime.fromisoformat("{}-{}-{}T{}:{}:{}".format(*parts))
            if FIRST_YEAR <= time.year <= LAST_YEAR:
                return f"{time.isoformat()}{'.' + fraction if fraction else ''}"
    return None


def time_in_name_message(name: str) -> str:
    """What is said of an image whose time is that in its name."""
    return (
        f"{name}: the time was taken from the name of the file, as UTC; the file itself has none."
    )


@cache
def _silence_libtiff() -> None:
    """Pillow raises what is wrong with a TIFF file; its library also prints it, into the words of a
    command.
    """
    import ctypes

    from PIL import _imaging

    with suppress(AttributeError, OSError):
        # The library that Pillow has loaded; where it is part of Pillow, it has no such name.
        set_handler = ctypes.CDLL(_imaging.__file__).TIFFSetErrorHandler
        set_handler.argtypes, set_handler.restype = [ctypes.c_void_p], ctypes.c_void_p
        set_handler(None)


def _read_picture(path: Path, data: bytes, camera: Camera | None, every: bool) -> list[Image]:
    import PIL.Image

    # Otherwise Pillow loads all that it can read before it knows a TIFF file.
    import PIL.TiffImagePlugin

    _silence_libtiff()
    pages: list[tuple[Any, float | None, list[str]]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        most, PIL.Image.MAX_IMAGE_PIXELS = PIL.Image.MAX_IMAGE_PIXELS, None
        try:
            picture: Any = PIL.Image.open(io.BytesIO(data), formats=_PICTURES)
        except PIL.UnidentifiedImageError:
            if data.startswith(b"SIMPLE"):
                raise ImageError(
                    f"{path}: the file is a FITS image; give its name the ending .fits."
                ) from None
            picture = None
        except Exception as error:
            raise broken(path) from error
        finally:
            # Its own limit knows neither the size of the file nor of sensors.
            PIL.Image.MAX_IMAGE_PIXELS = most
        if picture is None or _is_deep(picture, data):
            if picture is not None:
                check_declared(path, picture.width * picture.height * 8, len(data))
            deep = deep_colours(path, data)
            if deep is None:
                raise ImageError(
                    f"{path}: the file is not an image, is damaged, or is of a kind that is not "
                    "read; save it as FITS "
                    "or as a grey TIFF or PNG."
                )
            pages = [_of_colours(page, 65535.0) for page in deep]
            n_pages = len(pages)
        else:
            declared = 0
            try:  # decoders raise whatever the broken bytes lead to
                n_pages = int(getattr(picture, "n_frames", 1))
                for number in range(n_pages if every else 1):
                    picture.seek(number)
                    # Pages may share their bytes.
                    declared += picture.width * picture.height * _PIXEL_BYTES.get(picture.mode, 4)
                    check_declared(path, declared, len(data))
                    pages.append(_page(picture))
            except ImageError:
                raise
            except Exception as error:
                raise broken(path) from error
    size = None if camera is None else (camera.height_px, camera.width_px)
    sizes = [pixels.shape for pixels, _, _ in pages]
    best = max(sizes, key=lambda shape: (shape == size, np.prod(shape)))
    chosen = [k for k, shape in enumerate(sizes) if shape == best][: None if every else 1]
    words = []
    if "JPEG" in (picture and picture.format, path.suffix.upper().replace("JPG", "JPEG")[1:]):
        words.append("JPEG compression changes the noise; use FITS, TIFF or PNG where you can.")
    if n_pages > 1 and not every:
        words.append(f"the first of {n_pages} planes was taken.")
    elif n_pages > len(chosen):
        words.append(
            f"of {n_pages} pages, {len(chosen)} of {best[1]} x {best[0]} px were read as frames."
        )
    elif n_pages > 1:
        words.append(f"{n_pages} pages were read as frames.")
    found: list[Image] = []
    for k in chosen:
        pixels, saturation, notes = pages[k]
        name = f"{path.name}[{k}]" if len(chosen) > 1 else path.name
        messages = [f"{path.name}: {text}" for text in (*notes, *words)] if not found else []
        found.append(
            Image(
                checked(path, pixels, messages),
                name,
                saturation=saturation,
                header={} if picture is None else exif_of(picture),
                messages=tuple(messages),
                of_colours=COLOURS_WORDS in notes,
            )
        )
    return found


def _is_deep(picture: Any, data: bytes) -> bool:
    """Whether a picture has colours of 16 bits, of which Pillow reads 8 without a word."""
    if picture.format == "PNG":
        return bool(data[24] == 16 and data[25] != 0)
    depths = picture.tag_v2.get(258, ()) if picture.format == "TIFF" else ()
    return len(depths) > 1 and max(depths) > 8


def _page(picture: Any) -> tuple[Any, float | None, list[str]]:
    """Pixels, saturation and notes of the page that a picture stands at."""
    picture.load()
    # A palette or transparency is resolved first; black and white become 0 and 255.
    if picture.mode in ("P", "PA", "CMYK", "YCbCr", "RGBA", "LAB", "HSV"):
        picture = picture.convert("RGB")
    elif picture.mode in ("1", "LA"):
        picture = picture.convert("L")
    pixels = np.array(picture)
    if pixels.ndim == 3:
        return _of_colours(pixels, 255.0)
    return pixels, full_scale_of(pixels), []


def _of_colours(pixels: Any, full_scale: float) -> tuple[Any, float | None, list[str]]:
    return grey([np.ascontiguousarray(pixels[..., k]) for k in range(3)], full_scale)
