"""Frames read from files: FITS, TIFF, PNG, JPEG and BMP become arrays whose first row is y = 0."""

from __future__ import annotations

import io
import math
import os
import re
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.files import check_fits, check_size, unpack
from starcal_uq.core.formatting import plural
from starcal_uq.core.times import FIRST_YEAR, LAST_YEAR, utc_of_scale
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

FITS_ENDINGS = (".fits", ".fit", ".fts", ".fits.gz", ".fit.gz", ".fts.gz")
IMAGE_ENDINGS = (*FITS_ENDINGS, ".tiff", ".tif", ".png", ".jpg", ".jpeg", ".bmp")
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
_SIZES = re.compile(rb"NAXIS[1-9] *= *(\d{1,20})")
# Bytes of a pixel by Pillow's modes; four for all others.
_PIXEL_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2}
# Ten blocks, of 36 cards each.
_HEADER_BYTES = 28800
# ISO 8601 as far as names of files allow it: colons are left out or replaced.
_TIME_IN_NAME = re.compile(
    r"(?<!\d)(\d{4})-?(\d\d)-?(\d\d)T(\d\d)[-:_.]?(\d\d)[-:_.]?(\d\d)(?:[.,](\d{1,6})(?!\d))?(?!\d)", re.ASCII
)


@dataclass(frozen=True, eq=False)
class Image:
    """One frame.

    Attributes
    ----------
    data : array, shape (height, width)
        Counts; ``data[y, x]`` is the pixel whose centre is (x, y). Integers as the file holds them, or floating-point
        numbers, where NaN marks a pixel without a value.
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
    """

    data: np.ndarray[Any, Any]
    name: str = ""
    time_utc: str | None = None
    exposure_s: float | None = None
    saturation: float | None = None
    header: AnyDict = field(default_factory=dict)
    gain_e_per_count: float | None = None
    messages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        data = np.asarray(self.data)
        if data.ndim != 2 or data.dtype.kind not in "buif":
            raise ImageError(
                f"{self._label}: the pixels are {data.dtype} of shape {data.shape}; give numbers in rows and columns."
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

    def check_size(self, camera: Camera) -> None:
        """Refuse an image that is not the size of the camera's detector.

        Raises
        ------
        ImageError
            If width or height differ.
        """
        if (self.width_px, self.height_px) != (camera.width_px, camera.height_px):
            raise ImageError(
                f"{self._label}: the image is {self.width_px} x {self.height_px} px and the camera has "
                f"{camera.width_px} x {camera.height_px} px; give the camera file that belongs to it."
            )

    def __repr__(self) -> str:
        size = f"{self.width_px} x {self.height_px} px, {self.data.dtype}"
        return f"Image({self.name!r}, {size}{', ' + self.time_utc if self.time_utc else ''})"


def read_image(path: str | os.PathLike[str], camera: Camera | None = None) -> Image:
    """Read one frame (``.fits``, ``.fit``, ``.fits.gz``, ``.tiff``, ``.png``, ``.jpg``, ``.bmp``).

    The rows are kept in the order of the file, so the first row is y = 0. A colour image becomes its luminance; of a
    file with several planes the first is taken, of a FITS file with several images the first of the camera's size, or
    the largest; without a time in the header, one in the file's name is taken (such as
    2019-07-29T204726); `messages` of the result say so.

    Parameters
    ----------
    path
        The file.
    camera
        If given, the image must be the size of its detector.

    Raises
    ------
    ImageError
        If the file is missing, truncated, no image, of the wrong size, declares more pixels than it can hold, or has
        colours of 16 bits, of which half would be lost.
    """
    image = read_any_size(path, camera)
    if camera is not None:
        image.check_size(camera)
    return image


def read_any_size(path: str | os.PathLike[str], camera: Camera | None = None) -> Image:
    """`read_image`, which prefers an image of the camera's size but takes another where there is none."""
    path = Path(path)
    data = _read_bytes(path)
    name = path.name.lower()
    if not name.endswith(IMAGE_ENDINGS):
        raise ImageError(f"{path}: the ending {path.suffix or '(none)'} is unknown; use {', '.join(IMAGE_ENDINGS)}.")
    image = _read_fits(path, data, camera) if name.endswith(FITS_ENDINGS) else _read_picture(path, data)
    time = time_in_name(path.name)
    if image.time_utc is None and time is not None:
        image = replace(image, time_utc=time, messages=(*image.messages, time_in_name_message(path.name)))
    return image


def is_rendered(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a FITS image that this package rendered."""
    if not Path(path).name.lower().endswith(FITS_ENDINGS):
        return False
    try:
        with open(path, "rb") as file:
            return b"CREATOR = 'starcal-uq" in file.read(_HEADER_BYTES)
    except OSError:
        return False


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
    return f"{name}: the time was taken from the name of the file, as UTC; the file itself has none."


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
        raise ImageError(f"{path}: cannot be read ({error.strerror}); check its permissions.") from error
    if not data:
        raise ImageError(f"{path}: the file is empty; copy it again or leave it out.")
    return data


def _broken(path: Path) -> ImageError:
    return ImageError(f"{path}: the file is truncated or damaged; copy it again or leave it out.")


def _check_declared(path: Path, declared: int, stored: int) -> None:
    """Refuse an image of `declared` bytes that a file of `stored` bytes cannot hold, before memory is taken for it."""
    try:
        check_size(declared, stored)
    except ValueError as error:
        raise _too_much(path, error) from None


def _too_much(path: Path, error: ValueError) -> ImageError:
    return ImageError(f"{path}: the file is damaged ({error}); copy it again, or save the image without compression.")


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


def _read_fits(path: Path, data: bytes, camera: Camera | None) -> Image:
    from astropy.io import fits

    stored = len(data)
    if data.startswith(b"\x1f\x8b"):
        data = _unpacked(path, data)
    if not data.startswith(b"SIMPLE"):
        raise ImageError(f"{path}: the file is not a FITS image; check what it is, or name it by its format.")
    _check_counts(path, data)
    messages: list[str] = []
    with warnings.catch_warnings():
        # Astropy warns of a truncated file and then pads it or fails later; both are one error here.
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*(truncated|Error validating header).*")
        try:
            with fits.open(io.BytesIO(data), memmap=False) as hdus:
                chosen, n_images = _science_image(hdus, camera)
                if chosen is None:
                    raise ImageError(f"{path}: the FITS file holds no image; leave it out.")
                hdu = hdus[chosen]
                _check_declared(path, math.prod(hdu.shape) * abs(hdu.header["BITPIX"]) // 8, max(stored, len(data)))
                pixels, header = np.array(hdu.data), _plain(hdu.header)
                unit = next((str(h.comments["GAIN"]) for h in (hdu.header, hdus[0].header) if "GAIN" in h), "")
                if chosen and header.get("INHERIT", True):
                    # Exposures of several images say in the first header what is common to them.
                    header = _plain(hdus[0].header) | header
        except ImageError:
            raise
        except Exception as error:  # astropy raises whatever the broken bytes lead to
            raise _broken(path) from error
    if not pixels.size:
        raise ImageError(f"{path}: the image has no pixels; leave it out.")
    if n_images > 1:
        messages.append(
            f"{path.name}: of {n_images} images in the file, the one of {pixels.shape[-1]} x {pixels.shape[-2]} px in "
            f"HDU {chosen} was taken."
        )
    if pixels.ndim > 2:
        planes = int(np.prod(pixels.shape[:-2]))
        pixels = pixels.reshape(-1, *pixels.shape[-2:])[0]
        if planes > 1:
            messages.append(f"{path.name}: the first of {planes} planes was taken.")
    pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
    exposure = _positive(header, "EXPTIME", "EXPOSURE")
    time, words = _middle(header, exposure)
    messages += [f"{path.name}: {words}"] if words else []
    gain = _positive(header, "EGAIN")
    if gain is None and (bare := _positive(header, "GAIN")) is not None:
        # Of many cameras it is a setting.
        gain = bare if _PER_COUNT.search(unit) else None
        if gain is None:
            messages.append(
                f"{path.name}: GAIN ({bare:g}) does not say that it is in electrons per count and was not used; give "
                "the gain."
            )
    if mosaic := str(header.get("BAYERPAT", "")).strip():
        messages.append(
            f"{path.name}: the pixels are a mosaic of colours ({mosaic}) and were read as grey, which makes centroids "
            "worse than predicted."
        )
    return Image(
        _checked(path, pixels, messages),
        path.name,
        time_utc=time,
        exposure_s=exposure,
        saturation=_positive(header, "SATURATE", "SATLEVEL") or _full_scale(pixels),
        header=header,
        gain_e_per_count=gain,
        messages=tuple(messages),
    )


def _check_counts(path: Path, data: bytes) -> None:
    try:
        check_fits(data)
    except ValueError:
        raise _broken(path) from None


def _science_image(hdus: Any, camera: Camera | None) -> tuple[int | None, int]:
    """The place of the first image of the camera's size, or else of the largest; the number of images."""
    shapes: dict[int, tuple[int, ...]] = {}
    size = None if camera is None else (camera.height_px, camera.width_px)
    try:
        for place, hdu in enumerate(hdus):
            if hdu.is_image and len(hdu.shape) >= 2:
                shapes[place] = hdu.shape[-2:]
    except Exception as error:
        # Bytes after the last image do no harm, nor does a damaged one after that of the camera.
        if not shapes or ("truncated" in str(error) and size not in shapes.values()):
            raise
    if not shapes:
        return None, 0
    return max(shapes, key=lambda place: (shapes[place] == size, np.prod(shapes[place]))), len(shapes)


def _plain(header: Any) -> AnyDict:
    plain: AnyDict = {}
    for card in header.cards:
        try:
            key, value = card.keyword, card.value
        except Exception:  # astropy raises errors of its own for a value that is none; the others are as good as before
            continue
        if key and key not in ("COMMENT", "HISTORY") and isinstance(value, str | bool | int | float):
            plain.setdefault(key, value)
    return plain


def _read_picture(path: Path, data: bytes) -> Image:
    import PIL.Image

    # Otherwise Pillow loads all that it can read before it knows a TIFF file.
    import PIL.TiffImagePlugin

    messages: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        most, PIL.Image.MAX_IMAGE_PIXELS = PIL.Image.MAX_IMAGE_PIXELS, None
        try:
            picture: Any = PIL.Image.open(io.BytesIO(data), formats=_PICTURES)
        except PIL.UnidentifiedImageError:
            if data.startswith(b"SIMPLE"):
                raise ImageError(f"{path}: the file is a FITS image; give its name the ending .fits.") from None
            raise ImageError(
                f"{path}: the file is not an image, is damaged, or is of a kind that is not read (such as colour in "
                "16 bits); save it as FITS or as a grey TIFF or PNG."
            ) from None
        except Exception as error:
            raise _broken(path) from error
        finally:
            # Its own limit knows neither the size of the file nor of sensors.
            PIL.Image.MAX_IMAGE_PIXELS = most
        _check_declared(path, picture.width * picture.height * _PIXEL_BYTES.get(picture.mode, 4), len(data))
        # Depth and kind of colour of a PNG file.
        if picture.format == "PNG" and data[24] == 16 and data[25] != 0:
            raise ImageError(
                f"{path}: the colours have 16 bits, of which only 8 would be read; save the image as FITS, or as a "
                "grey TIFF or PNG."
            )
        try:
            picture.load()
            # A palette or transparency is resolved first; black and white become 0 and 255.
            if picture.mode in ("P", "PA", "CMYK", "YCbCr", "RGBA", "LAB", "HSV"):
                picture = picture.convert("RGB")
            elif picture.mode in ("1", "LA"):
                picture = picture.convert("L")
            pixels = np.array(picture)
            planes = getattr(picture, "n_frames", 1)
        except Exception as error:  # decoders raise whatever the broken bytes lead to
            raise _broken(path) from error
    if pixels.ndim == 3:
        # Grey pictures saved as RGB lose nothing.
        colours = [np.ascontiguousarray(pixels[..., k]) for k in range(3)]
        grey = all(np.array_equal(colours[0], colour) for colour in colours[1:])
        saturation: float | None = 255.0
        pixels = colours[0]
        if not grey:
            parts = [colour * np.float32(part) for colour, part in zip(colours, _LUMINANCE, strict=True)]
            pixels = parts[0] + parts[1] + parts[2]
            # One saturated colour spoils the sum before the sum reaches its own limit.
            pixels[np.maximum(np.maximum(*colours[:2]), colours[2]) == 255] = 255.0
            messages.append(
                f"{path.name}: the colour image was turned into luminance; colours sampled in a mosaic make centroids "
                "worse than predicted."
            )
    else:
        saturation = _full_scale(pixels)
    if picture.format == "JPEG" or path.suffix.lower() in (".jpg", ".jpeg"):
        messages.append(f"{path.name}: JPEG compression changes the noise; use FITS, TIFF or PNG where you can.")
    if planes > 1:
        messages.append(f"{path.name}: the first of {planes} planes was taken.")
    return Image(_checked(path, pixels, messages), path.name, saturation=saturation, messages=tuple(messages))


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
            f"{path.name}: {plural(bad, 'pixel')} without a value (NaN) {'was' if bad == 1 else 'were'} masked."
        )
    return pixels.astype(np.float32)


def _full_scale(pixels: Any) -> float | None:
    """Saturation of integers: the highest value of their type, or of a converter with fewer bits that is reached."""
    if pixels.dtype.kind not in "ui" or pixels.dtype.itemsize > 2:
        return None
    highest = int(pixels.max())
    if highest in _FULL_SCALES and np.count_nonzero(pixels == highest) > 1:
        return float(highest)
    return float(np.iinfo(pixels.dtype).max)


def _positive(header: Mapping[str, Any], *keys: str) -> float | None:
    for key in keys:
        try:
            value = float(header[key])
        except (KeyError, TypeError, ValueError):
            continue
        if np.isfinite(value) and value > 0.0:
            return value
    return None


def _middle(header: Mapping[str, Any], exposure_s: float | None) -> tuple[str | None, str]:
    """Middle of the exposure, UTC: DATE-AVG, or DATE-OBS (its start) plus half the exposure; why a time is not used."""
    problem = ""
    for key, delay in (("DATE-AVG", 0.0), ("DATE-OBS", 0.5 * (exposure_s or 0.0))):
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
            problem = f"{key} is of the year {time.year}, not of {FIRST_YEAR} to {LAST_YEAR}, and was not used."
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
