"""Background and noise of an image, by SExtractor's code (`sep`), and which of its pixels can be
used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.extras import extra
from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.images.image import Image
from starcal_uq.images.pixels import LARGEST_COUNTS
from starcal_uq.maths.intervals import median_of

# SExtractor's clipping at 3 sigma takes this part of Gaussian noise.
_CLIPPED = 0.983
_MESH_PX = 64
_SATURATED_FRACTION = 0.2
# Noise in counts below which an image is coarse: its median is wrong by up to half a count.
_COARSE = 20.0
# Random numbers of the blur, repeated over the image: drawing one for every pixel would take as
# long as the rest.
_BLUR_TILE = 65_537
_UNEVEN = 1.15
# With this part of the pixels at the lowest value, the noise below is cut off.
_CUT_OFF = 0.05


@dataclass(frozen=True)
class PreparedImage:
    """An image made ready for detection and fits.

    `counts` (height, width) are above the background, 0 where there is no value; `noise` is that of
    the background. Of pixels, all are `usable` and none `saturated` where these are None.
    `counts_per_e` is the inverse gain, 0 where unknown; it may be measured, read off the noise of
    the background. `parity` is the remainder of (x + y) / 2 of the pixels that were measured, those
    that see green in a mosaic of colours; the others hold the mean of their neighbours, and are not
    usable. None where all were measured.
    """

    counts: Any
    noise: Any
    usable: BoolArray | None
    saturated: BoolArray | None
    counts_per_e: float
    gain_is_measured: bool = False
    parity: int | None = None


def prepare_image(
    image: Image, gain: float | None, read_noise_e: float | None, saturation: float | None
) -> tuple[PreparedImage, float, float]:
    """Background and noise of an image, and their medians (counts).

    Without a `gain` (electrons per count) it is read off the noise of the background if that will
    do; `read_noise_e` (electrons, a floor of the noise) needs the gain. `saturation` (counts) is
    what the image says where it is None. Refused are images without a pixel that has a value, with
    equal ones alone, or with too many saturated.
    """
    with extra("images", "star images"):
        import sep

    name = image.name or "image"
    parity, shape = image.green_parity, image.data.shape
    if parity is not None:
        image = replace(image, data=_measured_pixels(image.data, parity), mosaic="")
    # A copy, which becomes the counts above the background where it stands: a new array for each
    # step takes longer than the step.
    with np.errstate(over="ignore"):
        data = np.array(image.data, dtype=np.float32, order="C")
    # Whole numbers are all finite.
    usable = None
    if image.data.dtype.kind == "f":
        usable = np.abs(data) < LARGEST_COUNTS
        if usable.all():
            usable = None
    mask = None if usable is None else ~usable
    values = data if usable is None else data[usable]
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
                f"{name}: {100.0 * fraction:.0f} % of the pixels are saturated; expose shorter, "
                "or leave the image out."
            )
    if low == high:
        raise ImageError(
            f"{name}: every pixel has the value {low:g}; check the exposure, or leave the image "
            "out."
        )
    if too_bright is not None:
        usable = ~too_bright if usable is None else usable & ~too_bright
    if mask is not None:
        data[mask] = np.median(values)
    counts_per_e = 1.0 / gain if gain else 0.0
    if not gain and image.data.dtype.kind in "ui" and image.data.dtype.itemsize > 1:
        counts_per_e = counts_per_electron(data)
    cut_off = np.count_nonzero(values == low) > _CUT_OFF * values.size
    mesh = min(_MESH_PX, *data.shape)
    # Every other column of a mosaic was left out.
    mesh_x = mesh if parity is None else min(mesh, max(_MESH_PX // 2, 1))
    background = sep.Background(_smooth(image, data), mask=mask, bw=mesh_x, bh=mesh)
    background.subfrom(data)
    counts = data
    spread = background
    if background.globalrms > _UNEVEN * 1.4826 * float(median_of(np.abs(counts[::5, ::5]).ravel())):
        # Where the background is steep, its slope inside a mesh is no noise.
        spread = sep.Background(counts, mask=mask, bw=mesh_x, bh=mesh)
    # Numbers are rounded to whole counts at best; floating-point images without noise get a floor
    # to divide by.
    floor = 12.0**-0.5 if image.data.dtype.kind in "ui" else 1e-7 * (high - low)
    if gain and read_noise_e:
        floor = max(floor, read_noise_e / gain)
    if cut_off:
        cut_noise, left = _cut_noise(counts)
        floor = max(floor, cut_noise)
        counts -= np.float32(left)
    noise = spread.rms()
    noise *= np.float32(1.0 / _CLIPPED)
    if noise.min() < floor:
        np.maximum(noise, np.float32(floor), out=noise)
    if mask is not None:
        counts[mask] = 0.0
    if parity is not None:
        everywhere = np.ones(counts.shape, dtype=np.bool_)
        usable = _at_their_places(everywhere if usable is None else usable, parity, shape)
        too_bright = None if too_bright is None else _at_their_places(too_bright, parity, shape)
        counts = _filled(_at_their_places(counts, parity, shape), parity)
        noise = np.pad(np.repeat(noise, 2, axis=1), ((0, 0), (0, shape[1] % 2)), mode="edge")
    frame = PreparedImage(
        counts, noise, usable, too_bright, counts_per_e, not gain and counts_per_e > 0.0, parity
    )
    return frame, float(background.globalback), max(float(spread.globalrms) / _CLIPPED, floor)


def _measured_pixels(data: Any, parity: int) -> Any:
    """The pixels (x, y) of a mosaic whose x + y has this parity, row by row: half as wide."""
    half = data.shape[1] // 2
    pixels = np.empty((data.shape[0], half), dtype=data.dtype)
    for row in (0, 1):
        pixels[row::2] = data[row::2, (parity + row) % 2 :: 2][:, :half]
    return pixels


def _at_their_places(pixels: Any, parity: int, shape: tuple[int, ...]) -> Any:
    """Inverse of `_measured_pixels`, with zeros between."""
    whole = np.zeros(shape, dtype=pixels.dtype)
    for row in (0, 1):
        whole[row::2, (parity + row) % 2 :: 2][:, : pixels.shape[1]] = pixels[row::2]
    return whole


def of_neighbours(padded: Any) -> Any:
    """Sum of the four neighbours of each pixel, from pixels with one more on every side."""
    return padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]


def _filled(counts: Any, parity: int) -> Any:
    """`counts` with the mean of the neighbours, which have been measured, where they are zero for a
    mosaic.
    """
    height, width = counts.shape
    padded = np.pad(counts, 1, mode="reflect") if min(height, width) > 1 else np.pad(counts, 1)
    means = of_neighbours(padded)
    means *= np.float32(0.25)
    for row in (0, 1):
        counts[row::2, (parity + row + 1) % 2 :: 2] = means[row::2, (parity + row + 1) % 2 :: 2]
    return counts


def _smooth(image: Image, filled: Any) -> Any:
    """Counts whose median means something: whole numbers with little noise are blurred by up to
    half a count.

    Their median jumps from one to the next, and the mode, 2.5 medians less 1.5 means, jumps
    further: a fifth of a count is a sigma of the filtered image.
    """
    if image.data.dtype.kind not in "ui":
        return filled
    sample = filled[::5, ::5].ravel()
    if 1.4826 * median_of(np.abs(sample - np.float32(median_of(sample)))) > _COARSE:
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


_CELL_PX = 64
# The slope counts where it is known this well, on so many meshes and with so little scatter about
# the line.
_LARGEST_ERROR, _FEWEST_MESHES, _LARGEST_CHI2 = 0.1, 24, 2.0
# Variance that is left of Gaussian noise clipped at 3 sigma.
_CLIPPED_VARIANCE = 0.9733


def counts_per_electron(data: Any) -> float:
    """Inverse gain of an image, from counts with background; 0 where its background does not say
    it.
    """
    height, width = (size // _CELL_PX for size in data.shape)
    if height * width < _FEWEST_MESHES:
        return 0.0
    rows = data[: height * _CELL_PX : 2, : width * _CELL_PX]
    first = rows[:, ::2]

    def meshes(pixels: Any) -> Any:
        cells = pixels.reshape(height, _CELL_PX // 2, width, _CELL_PX // 2)
        return cells.transpose(0, 2, 1, 3).reshape(height * width, -1)

    # Neighbours differ by their noise alone.
    difference = meshes(rows[:, 1::2] - first)
    level = median_of(meshes(first)[:, ::5])
    size = np.abs(difference)
    limit = 3.0 * 1.4826 * median_of(size[:, ::3])[:, None]
    inside = size <= limit
    n = np.count_nonzero(inside, axis=1)
    difference *= inside
    variance = np.einsum("ij,ij->i", difference, difference) / n / (2.0 * _CLIPPED_VARIANCE)
    good = np.isfinite(variance) & np.isfinite(level) & (variance > 0.0)
    if np.count_nonzero(good) < _FEWEST_MESHES:
        return 0.0
    x, y = level[good].astype(np.float64), variance[good].astype(np.float64)
    # All with the typical error: by its own, a mesh whose variance is low by chance would weigh
    # more.
    return _slope(x, y, float(np.median(y) * np.sqrt(2.0 / np.median(n[good]))))


def _slope(x: FloatArray, y: FloatArray, sigma: float) -> float:
    """Slope of the straight line through points, 0 where it is not positive, not well known, or no
    line fits.
    """
    use = np.ones(len(x), dtype=np.bool_)
    slope, error = 0.0, np.inf
    for _ in range(3):
        dx, dy = x - x[use].mean(), y - y[use].mean()
        spread = float(np.sum(dx[use] ** 2))
        if spread <= 0.0:
            return 0.0
        slope = float(np.sum(dx[use] * dy[use])) / spread
        z = np.abs(dy - slope * dx) / sigma
        scatter = max(float(np.median(z)) / 0.6745, 1.0)
        error = scatter * sigma / np.sqrt(spread)
        # Meshes with the Moon or a bright star.
        use = z < 4.0 * scatter
    return slope if error < _LARGEST_ERROR * slope and scatter**2 < _LARGEST_CHI2 else 0.0
