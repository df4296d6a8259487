"""What needs a library that is not always there: cameras' raw files (rawpy) and colours of 16 bits
(OpenCV).
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.extras import extra
from starcal_uq.images.image import MOSAICS, Image
from starcal_uq.images.pixels import check_declared

_SIZE_TAGS = 256, 257


def read_raw(path: Path, data: bytes) -> Image:
    """A raw file as the detector gave it, black borders left out.

    Its clock is the camera's own, of no stated zone, and is not taken for a time.
    """
    with extra(
        "raw",
        f"{path}: raw files of cameras",
        "save the image as FITS without turning it into colours",
    ):
        import rawpy
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            pixels = np.array(raw.raw_image_visible)
            pattern, names = raw.raw_pattern, raw.color_desc.decode("ascii")
            colours = "".join(names[k] for k in raw.raw_colors_visible[:2, :2].ravel())
            said = (raw.white_level, raw.other.shutter_speed, raw.other.focal_length)
            white, exposure, focal = (float(value or 0.0) or None for value in said)
    except Exception as error:  # whatever the broken bytes lead to
        raise ImageError(
            f"{path}: the file is damaged, or no raw file that LibRaw reads; copy it again, or "
            "save it as FITS."
        ) from error
    mosaic = "" if pattern is None else colours
    if pixels.ndim != 2 or (mosaic and (pattern.shape != (2, 2) or mosaic not in MOSAICS)):
        raise ImageError(
            f"{path}: its mosaic of colours is not red, green, green and blue; save a grey image "
            "as FITS."
        )
    header = {"EXPTIME": exposure, "FOCALLEN": focal}
    return Image(
        pixels,
        path.name,
        exposure_s=exposure,
        saturation=white,
        header={key: value for key, value in header.items() if value is not None},
        mosaic=mosaic,
    )


def deep_colours(path: Path, data: bytes) -> list[Any] | None:
    """Pages (height, width, 3) of 16 bits of a colour PNG or TIFF file, red first; None where it is
    none.
    """
    is_png = data.startswith(b"\x89PNG")
    if not is_png and not _is_deep_tiff(path, data):
        return None
    with extra(
        "raw", f"{path}: colours of 16 bits", "save the image as FITS, or as a grey TIFF or PNG"
    ):
        import cv2
    content = np.frombuffer(data, dtype=np.uint8)
    # What is wrong with a file is said in one sentence, and not by the library too.
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        if is_png:
            pages: Any = [cv2.imdecode(content, cv2.IMREAD_UNCHANGED)]
        else:
            pages = cv2.imdecodemulti(content, cv2.IMREAD_UNCHANGED)[1]
    except cv2.error:
        return None
    finally:
        logging.setLogLevel(level)
    if not len(pages) or any(
        page is None or page.dtype != np.uint16 or page.ndim != 3 for page in pages
    ):
        return None
    # OpenCV has blue first, and perhaps transparency last.
    return [page[..., 2::-1] for page in pages]


def _is_deep_tiff(path: Path, data: bytes) -> bool:
    """Whether a file is a TIFF of three or four colours of 16 bits that can hold the pixels that it
    declares.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        tags = ImageFileDirectory_v2(data[:8])
        stream = io.BytesIO(data)
        stream.seek(tags.next)
        tags.load(stream)
        width, height = (int(tags[tag]) for tag in _SIZE_TAGS)
        depths = tuple(tags[258])
    except Exception:  # Pillow raises whatever the bytes lead to
        return False
    if depths not in ((16,) * 3, (16,) * 4):
        return False
    check_declared(path, width * height * 8, len(data))
    return True
