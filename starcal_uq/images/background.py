"""Background and noise of an image, by SExtractor's code (`sep`), and which of its pixels can be used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.types import BoolArray
from starcal_uq.images.image import Image
from starcal_uq.images.photon_transfer import counts_per_electron

# SExtractor's clipping at 3 sigma takes this part of Gaussian noise.
_CLIPPED = 0.983
_MESH_PX = 64
_SATURATED_FRACTION = 0.2
# Noise in counts below which an image is coarse: its median is wrong by up to half a count.
_COARSE = 20.0
# Random numbers of the blur, repeated over the image: drawing one for every pixel would take as long as the rest.
_BLUR_TILE = 65_537
_UNEVEN = 1.15
# With this part of the pixels at the lowest value, the noise below is cut off.
_CUT_OFF = 0.05


@dataclass(frozen=True)
class PreparedImage:
    """An image made ready for detection and fits.

    Attributes
    ----------
    counts : array of float32, shape (height, width)
        Counts above the background; 0 where there is no value.
    noise : array, shape (height, width)
        Noise of the background, counts.
    usable, saturated : array of bool, shape (height, width), or None
        Pixels to use, None for all; saturated pixels, None for none.
    counts_per_e : float
        Inverse gain, 0 where unknown.
    gain_is_measured : bool
        Whether the gain was read off the noise of the background because none is known.
    """

    counts: Any
    noise: Any
    usable: BoolArray | None
    saturated: BoolArray | None
    counts_per_e: float
    gain_is_measured: bool = False


def prepare_image(
    image: Image, gain: float | None, read_noise_e: float | None, saturation: float | None
) -> tuple[PreparedImage, float, float]:
    """Background and noise of an image.

    Parameters
    ----------
    image
        The image.
    gain
        Electrons per count, None where unknown: it is then read off the noise of the background if that will do.
    read_noise_e
        Floor of the noise, electrons (needs the gain).
    saturation
        Counts at and above which a pixel is saturated, None to take what the image says.

    Returns
    -------
    prepared : PreparedImage
    background, noise : float
        Medians, counts.

    Raises
    ------
    ImageError
        If no pixel has a value, all are equal, or too many are saturated.
    """
    import sep

    name = image.name or "image"
    data = np.ascontiguousarray(image.data, dtype=np.float32)
    finite = np.isfinite(data)
    whole = bool(finite.all())
    values = data if whole else data[finite]
    if not values.size:
        raise ImageError(f"{name}: no pixel has a value; leave the image out.")
    low, high = float(values.min()), float(values.max())
    level = saturation if saturation is not None else image.saturation
    too_bright = None
    if level is not None and high >= level:
        too_bright = data >= level
        fraction = np.count_nonzero(too_bright) / data.size
        if fraction > _SATURATED_FRACTION:
            raise ImageError(
                f"{name}: {100.0 * fraction:.0f} % of the pixels are saturated; expose shorter, or leave the image out."
            )
    if low == high:
        raise ImageError(f"{name}: every pixel has the value {low:g}; check the exposure, or leave the image out.")
    usable = None if whole else finite
    if too_bright is not None:
        usable = finite & ~too_bright
    filled = data if whole else np.where(finite, data, np.float32(np.median(values)))
    mesh = min(_MESH_PX, *data.shape)
    mask = None if whole else ~finite
    background = sep.Background(_smooth(image, filled), mask=mask, bw=mesh, bh=mesh)
    counts = filled - background.back()
    spread = background
    if background.globalrms > _UNEVEN * 1.4826 * float(np.median(np.abs(counts[::5, ::5]))):
        # Where the background is steep, its slope inside a mesh is no noise.
        spread = sep.Background(counts, mask=mask, bw=mesh, bh=mesh)
    # Numbers are rounded to whole counts at best; floating-point images without noise get a floor to divide by.
    floor = 12.0**-0.5 if image.data.dtype.kind in "ui" else 1e-7 * (high - low)
    if gain and read_noise_e:
        floor = max(floor, read_noise_e / gain)
    if np.count_nonzero(values == low) > _CUT_OFF * values.size:
        cut_noise, left = _cut_noise(counts)
        floor = max(floor, cut_noise)
        counts -= np.float32(left)
    noise = np.maximum(spread.rms() / _CLIPPED, floor)
    if not whole:
        counts[~finite] = 0.0
    counts_per_e = 1.0 / gain if gain else 0.0
    if not gain and image.data.dtype.kind in "ui" and image.data.dtype.itemsize > 1:
        counts_per_e = counts_per_electron(filled)
    frame = PreparedImage(counts, noise, usable, too_bright, counts_per_e, not gain and counts_per_e > 0.0)
    return frame, float(background.globalback), max(float(spread.globalrms) / _CLIPPED, floor)


def _smooth(image: Image, filled: Any) -> Any:
    """Counts whose median means something: whole numbers with little noise are blurred by up to half a count.

    Their median jumps from one to the next, and the mode, 2.5 medians less 1.5 means, jumps further: a fifth of a count
    is a sigma of the filtered image.
    """
    sample = filled[::5, ::5]
    scatter = 1.4826 * float(np.median(np.abs(sample - np.median(sample))))
    if image.data.dtype.kind not in "ui" or scatter > _COARSE:
        return filled
    blur = np.random.default_rng(0).random(_BLUR_TILE, dtype=np.float32) - np.float32(0.5)
    return filled + np.resize(blur, filled.shape)


def _cut_noise(counts: Any) -> tuple[float, float]:
    """Noise, and what is left of the background, of counts cut off at black.

    There, clipping takes most of the noise, and the median differs from the mean.
    """
    sample = counts[::3, ::3]
    middle, high = np.percentile(sample, [50.0, 99.0])
    scale = (high - middle) / 2.326
    inner = sample[np.abs(sample - middle) < 4.0 * scale + 0.5]
    return float(max(scale, inner.std())), float(inner.mean())
