"""Pixels of any format: refusals of damaged files, luminance of colours, missing values, saturation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.files import check_size
from starcal_uq.core.formatting import plural

# Beyond, sums over pixels leave the range of 32-bit numbers, and no counts are.
LARGEST_COUNTS = 1e30
# Rec. 601, as pillow weighs the colours of 8-bit images.
_LUMINANCE = (0.299, 0.587, 0.114)
# Full scale of the converters that write into 16 bits without shifting.
_FULL_SCALES = (1023, 4095, 16383)
# What is said of an image that was made of colours.
COLOURS_WORDS = (
    "the colour image was turned into luminance; colours sampled in a mosaic make centroids "
    "worse than predicted."
)


def broken(path: Path) -> ImageError:
    return ImageError(f"{path}: the file is truncated or damaged; copy it again or leave it out.")


def check_declared(path: Path, declared: int, stored: int) -> None:
    """Refuse an image of `declared` bytes that a file of `stored` bytes cannot hold, before memory
    is taken for it.
    """
    try:
        check_size(declared, stored)
    except ValueError as error:
        raise too_much(path, error) from None


def too_much(path: Path, error: ValueError) -> ImageError:
    return ImageError(
        f"{path}: the file is damaged ({error}); copy it again, or save the image without "
        "compression."
    )


def grey(colours: list[Any], full_scale: float | None) -> tuple[Any, float | None, list[str]]:
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


def checked(path: Path, pixels: Any, messages: list[str]) -> Any:
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


def full_scale_of(pixels: Any) -> float | None:
    """Saturation of integers: the highest value of their type, or of a converter with fewer bits
    that is reached.
    """
    if pixels.dtype.kind not in "ui" or pixels.dtype.itemsize > 2:
        return None
    highest = int(pixels.max())
    if highest in _FULL_SCALES and np.count_nonzero(pixels == highest) > 1:
        return float(highest)
    return float(np.iinfo(pixels.dtype).max)
