"""Frames read from files: FITS, TIFF, PNG, JPEG, BMP and raw files become arrays whose first row is
y = 0.
"""

from __future__ import annotations

import io
import math
import os
import re
import warnings
import zlib
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import check_fits, check_size, unpack
from starcal_uq.core.formatting import plural
from starcal_uq.core.settings import Bayer, Mosaic
from starcal_uq.core.times import FIRST_YEAR, LAST_YEAR, utc_of_scale
from starcal_uq.core.types import AnyDict, AnyMapping, PathLike
from starcal_uq.images.optics import exif_of

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

FITS_ENDINGS = (".fits", ".fit", ".fts", ".fits.gz", ".fit.gz", ".fts.gz")
RAW_ENDINGS = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".pef")
IMAGE_ENDINGS = (*FITS_ENDINGS, ".tiff", ".tif", ".png", ".jpg", ".jpeg", ".bmp", *RAW_ENDINGS)
# What the 2 x 2 pixels in the corner of a mosaic of colours see, row by row.
MOSAICS = get_args(Mosaic)
# Of Pillow's formats: others start programs (EPS) or turn the image upside down (FITS).
_PICTURES = ("TIFF", "PNG", "JPEG", "BMP")
# Beyond, sums over pixels leave the range of 32-bit numbers, and no counts are.
LARGEST_COUNTS = 1e30
# Rec. 601, as pillow weighs the colours of 8-bit images.
_LUMINANCE = (0.299, 0.587, 0.114)
# Full scale of the converters that write into 16 bits without shifting.
_FULL_SCALES = (1023, 4095, 16383)
# What the comment of GAIN says where it is electrons per count.
_PER_COUNT = re.compile(r"electron|\be-? ?(/|per )", re.IGNORECASE | re.ASCII)
# Images beside the frame itself, by the names that their extensions have.
_BESIDES = re.compile(
    r"(ERR|VAR|IVAR|SIGMA|RMS|NOISE|DQ|QUAL|MASK|FLAG|BPM|WEIGHT|WHT|WT|BKG|BACKG|SKY|DARK|FLAT|BIAS|THUMB|PREVIEW)"
)
# A frame of a file that holds several.
_ONE_OF = re.compile(r"(.+)\[(\d+(?:,\d+)?)\]")
_SIZES = re.compile(rb"NAXIS[1-9] *= *(\d{1,20})")
# Bytes of a pixel by Pillow's modes; four for all others.
_PIXEL_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}
# ISO 8601 as far as names of files allow it: colons are left out or replaced.
_TIME_IN_NAME = re.compile(
    r"(?<!\d)(\d{4})-?(\d\d)-?(\d\d)T(\d\d)[-:_.]?(\d\d)[-:_.]?(\d\d)(?:[.,](\d{1,6})(?!\d))?(?!\d)",
    re.ASCII,
)


@dataclass(frozen=True, eq=False)
class Image:
    """One frame.

    Attributes
    ----------
    data : array, shape (height, width)
        Counts; ``data[y, x]`` is the pixel whose centre is (x, y). Integers as the file holds them,
        or floating-point numbers, where NaN marks a pixel without a value.
    name : str
        Name, in messages and tables; of a file its name without the folder.
    time_utc : str or None
        Middle of the exposure, UTC, ISO 8601; where the file does not say it, the time in its name.
    exposure_s : float or None
        Exposure time, seconds.
    saturation : float or None
        Counts at and above which a pixel is saturated.
    header : dict
        Keywords of the file and their plain values.
    gain_e_per_count : float or None
        Electrons per count.
    messages : tuple of str
        Notes on what was done to the pixels in reading, one sentence each.
    mosaic : {"", "RGGB", "BGGR", "GRBG", "GBRG"}
        Colours of the 2 x 2 pixels in the first corner, row by row, where each pixel sees one
        colour; empty where all see the same.
    of_colours : bool
        Whether each pixel was put together from several colours in reading.
    """

    data: np.ndarray[Any, Any]
    name: str = ""
    time_utc: str | None = None
    exposure_s: float | None = None
    saturation: float | None = None
    header: AnyDict = field(default_factory=dict)
    gain_e_per_count: float | None = None
    messages: tuple[str, ...] = ()
    mosaic: str = ""
    of_colours: bool = False

    def __post_init__(self) -> None:
        data = np.asarray(self.data)
        if self.mosaic and self.mosaic not in MOSAICS:
            raise ImageError(
                f"{self._label}: the mosaic is {self.mosaic!r}; give one of {', '.join(MOSAICS)}."
            )
        if data.ndim != 2 or data.dtype.kind not in "buif":
            raise ImageError(
                f"{self._label}: the pixels are {data.dtype} of shape {data.shape}; give numbers "
                "in rows and columns."
            )
        if not data.size:
            raise ImageError(f"{self._label}: the image has no pixels; leave it out.")
        object.__setattr__(self, "data", data)

    @property
    def _label(self) -> str:
        return self.name or "image"

    @property
    def height_px(self) -> int:
        """Number of rows."""
        return int(self.data.shape[0])

    @property
    def width_px(self) -> int:
        """Number of columns."""
        return int(self.data.shape[1])

    @property
    def green_parity(self) -> int | None:
        """Remainder of (x + y) / 2 of the pixels that see green in a mosaic; None where there is
        none.
        """
        return (self.mosaic[0] != "G") if self.mosaic else None

    def as_mosaic(self, bayer: Bayer | None) -> Image:
        """The image with the mosaic that the user declares, "none" for none; as it is where that is
        None.
        """
        if bayer is None:
            return self
        if self.of_colours:
            raise ImageError(
                f"{self._label}: the colours of its mosaic were put together before; leave out "
                "bayer."
            )
        return replace(self, mosaic="" if bayer == "none" else bayer)

    def check_size(self, camera: Camera) -> None:
        """Refuse an image that is not the size of the camera's detector.

        Raises
        ------
        ImageError
            If width or height differ.
        """
        if (self.width_px, self.height_px) != (camera.width_px, camera.height_px):
            raise ImageError(
                f"{self._label}: the image is {self.width_px} x {self.height_px} px and the "
                "camera has "
                f"{camera.width_px} x {camera.height_px} px; give the camera file that belongs "
                "to it."
            )

    def __repr__(self) -> str:
        size = f"{self.width_px} x {self.height_px} px, {self.data.dtype}"
        return f"Image({self.name!r}, {size}{', ' + self.time_utc if self.time_utc else ''})"


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
    data = _read_bytes(path)
    name = path.name.lower()
    if not name.endswith(IMAGE_ENDINGS):
        raise ImageError(
            f"{path}: the ending {path.suffix or '(none)'} is unknown; use "
            f"{', '.join(IMAGE_ENDINGS)}."
        )
    if name.endswith(FITS_ENDINGS):
        images = _read_fits(path, data, camera, every)
    elif name.endswith(RAW_ENDINGS):
        from starcal_uq.images.raw import read_raw

        raw = read_raw(path, data)
        header = {"EXPTIME": raw.exposure_s, "FOCALLEN": raw.focal_mm}
        header = {key: value for key, value in header.items() if value is not None}
        images = [
            Image(
                raw.pixels,
                path.name,
                None,
                raw.exposure_s,
                raw.saturation,
                header,
                mosaic=raw.mosaic,
            )
        ]
    else:
        images = _read_picture(path, data, camera, every)
    return [_with_named_time(image) for image in images]


def _with_named_time(image: Image) -> Image:
    time = time_in_name(image.name)
    if image.time_utc is not None or time is None:
        return image
    return replace(
        image, time_utc=time, messages=(*image.messages, time_in_name_message(image.name))
    )


def _few(names: list[str]) -> list[str]:
    return names if len(names) < 5 else [*names[:2], "...", names[-1]]


def time_in_name(name: str) -> str | None:
    """The UTC time in a file's name, such as 2019-07-29T204726, as ISO 8601 text."""
    for match in _TIME_IN_NAME.finditer(name):
        year, month, day, hour, minute, second = (int(group) for group in match.groups()[:6])
        try:
            time = datetime(year, month, day, hour, minute, second)
        except ValueError:
            continue
        if not FIRST_YEAR <= year <= LAST_YEAR:
            continue
        return f"{time.isoformat()}{'.' + match[7] if match[7] else ''}"
    return None


def time_in_name_message(name: str) -> str:
    """What is said of an image whose time is that in its name."""
    return (
        f"{name}: the time was taken from the name of the file, as UTC; the file itself has none."
    )


def _read_bytes(path: Path) -> bytes:
    if os.path.isdir(path):
        raise ImageError(f"{path}: is a directory; name an image file.")
    if os.path.exists(path) and not os.path.isfile(path):
        raise ImageError(f"{path}: is not a regular file; name an image file.")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ImageError(f"{path}: the file does not exist; check the path.") from None
    except OSError as error:
        raise ImageError(
            f"{path}: cannot be read ({error.strerror}); check its permissions."
        ) from error
    if not data:
        raise ImageError(f"{path}: the file is empty; copy it again or leave it out.")
    return data


def _broken(path: Path) -> ImageError:
    return ImageError(f"{path}: the file is truncated or damaged; copy it again or leave it out.")


def _check_declared(path: Path, declared: int, stored: int) -> None:
    """Refuse an image of `declared` bytes that a file of `stored` bytes cannot hold, before memory
    is taken for it.
    """
    try:
        check_size(declared, stored)
    except ValueError as error:
        raise _too_much(path, error) from None


def _too_much(path: Path, error: ValueError) -> ImageError:
    return ImageError(
        f"{path}: the file is damaged ({error}); copy it again, or save the image without "
        "compression."
    )


def _unpacked(path: Path, data: bytes) -> bytes:
    """Content of a file of gzip."""
    content = bytearray()
    try:
        for piece in unpack(data):
            if not content:
                # What the first header says spares the rest.
                sizes = _SIZES.findall(piece.partition(b"END" + b" " * 77)[0])
                _check_declared(path, math.prod(map(int, sizes)) if sizes else 0, len(data))
            content += piece
    except ValueError as error:
        raise _too_much(path, error) from None
    except (OSError, EOFError, zlib.error) as error:
        raise _broken(path) from error
    return bytes(content)


def _read_fits(path: Path, data: bytes, camera: Camera | None, every: bool) -> list[Image]:
    with extra("images", f"{path}: FITS images"):
        from astropy.io import fits

    stored = len(data)
    if data.startswith(b"\x1f\x8b"):
        data = _unpacked(path, data)
    if not data.startswith(b"SIMPLE"):
        raise ImageError(
            f"{path}: the file is not a FITS image; check what it is, or name it by its format."
        )
    _check_counts(path, data)
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
                    hdu = hdus[place]
                    _check_declared(
                        path,
                        math.prod(hdu.shape) * abs(hdu.header["BITPIX"]) // 8,
                        max(stored, len(data)),
                    )
                    pixels, header = np.array(hdu.data), _plain(hdu.header)
                    unit = next(
                        (
                            str(h.comments["GAIN"])
                            for h in (hdu.header, hdus[0].header)
                            if "GAIN" in h
                        ),
                        "",
                    )
                    if place and header.get("INHERIT", True):
                        # Exposures of several images say in the first header what is common to
                        # them.
                        header = _plain(hdus[0].header) | header
                    taken.append((place, pixels, header, unit))
        except ImageError:
            raise
        except Exception as error:  # astropy raises whatever the broken bytes lead to
            raise _broken(path) from error
    if not taken:
        raise ImageError(f"{path}: the FITS file holds no image; leave it out.")
    if not all(pixels.size and pixels.ndim > 1 for _, pixels, _, _ in taken):
        raise ImageError(f"{path}: the image has no pixels; leave it out.")
    shape = taken[0][1].shape
    size = f"{shape[-1]} x {shape[-2]} px"
    if len(images) > len(taken):
        what = (
            f"the one of {size} in HDU {chosen[0]} was"
            if len(taken) == 1
            else f"{len(taken)} of {size} were"
        )
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


def _planes(pixels: Any, header: AnyMapping) -> tuple[Any, list[str]]:
    """Frames (n, height, width) of the pixels of one HDU, and what is to be said of them."""
    frames = pixels.reshape(-1, *pixels.shape[-2:])
    n = len(frames)
    if n == 1:
        return frames, []
    if n == 3 and "RGB" in f"{header.get('CTYPE3', '')} {header.get('COLORSPC', '')}".upper():
        return _grey([np.ascontiguousarray(colour) for colour in frames], None)[0][None], [
            COLOURS_WORDS
        ]
    cycle, by = _cycle_s(header, n)
    if cycle is None:
        return frames, [
            f"{n} planes were read as frames; the header does not say how they follow in time."
        ]
    if by == "EXPTIME":
        return frames, [
            f"{n} planes were read as frames, each taken to begin where the one before ends ({by})."
        ]
    return frames, [f"{n} planes were read as frames, {cycle:g} s apart ({by})."]


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
        _checked(path, pixels, messages),
        name,
        time_utc=time,
        exposure_s=exposure,
        saturation=_positive(header, "SATURATE", "SATLEVEL") or _full_scale(pixels),
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


def _check_counts(path: Path, data: bytes) -> None:
    try:
        check_fits(data)
    except ValueError:
        raise _broken(path) from None


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
    beside = [place for place in alike if place != best and _BESIDES.match(names[place])]
    if beside:
        words.append(
            f"{', '.join(names[place] for place in beside)} were not read, being no frames by "
            "their names."
        )
    return [place for place in alike if place not in beside], shapes, words


def _plain(header: Any) -> AnyDict:
    plain: AnyDict = {}
    for card in header.cards:
        try:
            key, value = card.keyword, card.value
        # astropy raises errors of its own for a value that is none; the others are as good as
        # before
        except Exception:
            continue
        if (
            key
            and key not in ("COMMENT", "HISTORY")
            and isinstance(value, str | bool | int | float)
        ):
            plain.setdefault(key, value)
    return plain


# What is said of an image that was made of colours.
COLOURS_WORDS = (
    "the colour image was turned into luminance; colours sampled in a mosaic make centroids "
    "worse than predicted."
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
            raise _broken(path) from error
        finally:
            # Its own limit knows neither the size of the file nor of sensors.
            PIL.Image.MAX_IMAGE_PIXELS = most
        if picture is None or _is_deep(picture, data):
            from starcal_uq.images.raw import deep_colours

            if picture is not None:
                _check_declared(path, picture.width * picture.height * 8, len(data))
            deep = deep_colours(path, data, _check_declared)
            if deep is None:
                raise ImageError(
                    f"{path}: the file is not an image, is damaged, or is of a kind that is not "
                    "read; save it as FITS "
                    "or as a grey TIFF or PNG."
                )
            pages = [
                _grey([np.ascontiguousarray(page[..., k]) for k in range(3)], 65535.0)
                for page in deep
            ]
            n_pages = len(pages)
        else:
            declared = 0
            try:  # decoders raise whatever the broken bytes lead to
                n_pages = int(getattr(picture, "n_frames", 1))
                for number in range(n_pages if every else 1):
                    picture.seek(number)
                    # Pages may share their bytes.
                    declared += picture.width * picture.height * _PIXEL_BYTES.get(picture.mode, 4)
                    _check_declared(path, declared, len(data))
                    pages.append(_page(picture))
            except ImageError:
                raise
            except Exception as error:
                raise _broken(path) from error
    size = None if camera is None else (camera.height_px, camera.width_px)
    sizes = [pixels.shape for pixels, _, _ in pages]
    best = max(sizes, key=lambda shape: (shape == size, np.prod(shape)))
    chosen = [k for k, shape in enumerate(sizes) if shape == best][: None if every else 1]
    words = []
    if (picture is not None and picture.format == "JPEG") or path.suffix.lower() in (
        ".jpg",
        ".jpeg",
    ):
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
                _checked(path, pixels, messages),
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
        return _grey([np.ascontiguousarray(pixels[..., k]) for k in range(3)], 255.0)
    return pixels, _full_scale(pixels), []


def _grey(colours: list[Any], full_scale: float | None) -> tuple[Any, float | None, list[str]]:
    """Luminance of three colours, its saturation, and what is to be said of it."""
    # Grey pictures saved as RGB lose nothing.
    if all(np.array_equal(colours[0], colour) for colour in colours[1:]):
        return colours[0], full_scale, []
    parts = [colour * np.float32(part) for colour, part in zip(colours, _LUMINANCE, strict=True)]
    pixels = parts[0] + parts[1] + parts[2]
    if full_scale is not None:
        # One saturated colour spoils the sum before the sum reaches its own limit.
        pixels[np.maximum(np.maximum(*colours[:2]), colours[2]) == full_scale] = full_scale
    return pixels, full_scale, [COLOURS_WORDS]


def _checked(path: Path, pixels: Any, messages: list[str]) -> Any:
    """`pixels` as 32-bit floats where they are floats; a message where some are no numbers."""
    if pixels.dtype.kind != "f":
        return pixels
    good = np.abs(pixels) < LARGEST_COUNTS
    bad = int(np.count_nonzero(~good))
    if bad == pixels.size:
        raise ImageError(f"{path}: no pixel has a value; leave the image out.")
    if bad:
        pixels = np.where(good, pixels, np.nan)
        messages.append(
            f"{path.name}: {plural(bad, 'pixel')} without a value (NaN) "
            f"{'was' if bad == 1 else 'were'} masked."
        )
    return pixels.astype(np.float32)


def _full_scale(pixels: Any) -> float | None:
    """Saturation of integers: the highest value of their type, or of a converter with fewer bits
    that is reached.
    """
    if pixels.dtype.kind not in "ui" or pixels.dtype.itemsize > 2:
        return None
    highest = int(pixels.max())
    if highest in _FULL_SCALES and np.count_nonzero(pixels == highest) > 1:
        return float(highest)
    return float(np.iinfo(pixels.dtype).max)


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
