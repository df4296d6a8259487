"""The stars of one image: background, detection, measured PSF, fit, and the rejection of what is no
star.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.core.errors import ImageError
from starcal_uq.core.extras import extra
from starcal_uq.core.formatting import plural
from starcal_uq.core.types import AnyDict, IntArray
from starcal_uq.images.background import PreparedImage, of_neighbours, prepare_image
from starcal_uq.images.fits import (
    Stamps,
    StarFit,
    cut_stamps,
    disturbed,
    explained,
    fit_stars,
    near_pairs,
    window_positions,
    windowed,
)
from starcal_uq.images.image import Image
from starcal_uq.images.psf import (
    FIRST_SIGMA_PX,
    half_stamp_px,
    measure_psf,
    moment_sigma_px,
    pixel_at,
)

# Half the detection kernel: what lies farther out adds 1 % to the signal-to-noise ratio and doubles
# the time.
_KERNEL_HALF_SIGMAS, _KERNEL_HALF_MAX = 2.5, 5
_MAX_DETECTIONS = 5000
_ROWS_AT_ONCE = 64
# A width is preferred to that of the PSF if it lowers chi squared by this much.
_CHI2_MARGIN = 9.0
_BLOB_SIGMAS = 3.0
# Windowed centroids good to this are a start for the fit.
_START_STEP_PX = 0.05


@dataclass(frozen=True)
class DetectionOptions:
    """How stars are found: options of `starcal_uq.images.extract.extract_centroids`.

    Attributes
    ----------
    gain_e_per_count : float, optional
        Electrons per count; by default what the file says. Without it, it is read off the noise of
        the background where that is bright and uneven enough, for `sigma_px` only. Where it is not,
        the photon noise of the stars themselves is left away, so that `sigma_px` of bright stars
        comes out too small. A message says which.
    read_noise_e : float, optional
        Read noise, electrons per pixel: a floor for the measured noise (needs the gain).
    saturation : float, optional
        Counts at and above which a pixel is saturated; by default what the file says, or the full
        scale of its integers. Saturated pixels are not used.
    threshold_sigma : float
        Detection threshold in the image filtered by the PSF, in standard deviations of that image.
    min_pixels : int
        Pixels above the threshold that a star needs, in the filtered image.
    psf_sigma_px : float, optional
        Width of the star images before integration over pixels; by default it is measured in each
        image.
    max_stars : int, optional
        Keep at most so many stars per frame, the brightest.
    """

    gain_e_per_count: float | None = None
    read_noise_e: float | None = None
    saturation: float | None = None
    threshold_sigma: float = 5.0
    min_pixels: int = 1
    psf_sigma_px: float | None = None
    max_stars: int | None = None


@dataclass(frozen=True)
class FrameStars:
    """The stars of one image, brightest first, by columns of `Centroids` but ``frame``.

    Median background and noise, counts, and the width of the star images. Fluxes are in electrons
    by the gain that was given; one that was read off the noise of the background serves the noise
    of the stars only. Messages say what was left out, without the name of the image; centroids are
    `windowed` where star images are no round Gaussians.
    """

    columns: AnyDict
    background: float
    noise: float
    psf_sigma_px: float
    gain_e_per_count: float | None
    messages: list[str]
    measured_gain_e_per_count: float | None = None
    windowed: bool = False

    def __len__(self) -> int:
        return len(self.columns["x_px"])


def find_stars(image: Image, options: DetectionOptions) -> FrameStars:
    """Find and measure the stars of one image; `ImageError` if nothing can be measured."""
    name = image.name or "image"
    gain = options.gain_e_per_count or image.gain_e_per_count
    frame, background, noise = prepare_image(image, gain, options.read_noise_e, options.saturation)
    start = options.psf_sigma_px or FIRST_SIGMA_PX
    objects = _detect(frame, name, start, options)
    messages: list[str] = []
    if image.mosaic:
        messages.append(
            f"of the mosaic of colours ({image.mosaic}), the green pixels were measured, each at "
            "its own place."
        )
    objects, n_blobs = _without_blobs(objects, moment_sigma_px(objects, start))
    measured = measure_psf(frame, objects)
    sigma = start if measured is None else measured.sigma_px
    if options.psf_sigma_px is not None:
        sigma = options.psf_sigma_px
    elif measured is None and len(objects):
        messages.append(
            f"the stars do not suffice to measure the width of their images, so {sigma:g} px was "
            "taken; "
            "give psf_sigma_px."
        )
    stamps, fit = _fit(frame, objects, sigma)
    kind = _classify(
        frame, objects, stamps, fit, measured is not None or options.psf_sigma_px is not None
    )
    shape = "" if measured is None else measured.shape_words
    if shape:
        fit = windowed(frame, fit)
        messages.append(
            f"the star images are {shape}, so their centroids are windowed, and what their shape "
            "adds to the errors is "
            "not in sigma."
        )
    refused = np.bincount(kind, minlength=len(_KINDS))[1:]
    refused[1] += n_blobs
    if total := int(refused.sum()):
        words = [f"{n} {word}" for n, word in zip(refused, _KINDS[1:], strict=True) if n]
        were = "was" if total == 1 else "were"
        messages.append(
            f"{plural(total, 'detection')} {were} left out as no star: {', '.join(words)}."
        )
    keep = np.flatnonzero(kind == 0)
    order = keep[np.argsort(-fit.flux[keep], kind="stable")][: options.max_stars]
    columns = _columns(image, frame, fit, sigma, gain, order)
    if not len(order):
        messages.append("no star was found.")
    measured_gain = 1.0 / frame.counts_per_e if frame.gain_is_measured else None
    return FrameStars(
        columns, background, noise, float(sigma), gain, messages, measured_gain, bool(shape)
    )


def _detect(frame: PreparedImage, name: str, sigma: float, options: DetectionOptions) -> Any:
    """SExtractor's detections in the image filtered by the PSF, the brightest first."""
    with extra("images", "star images"):
        import sep
    half = int(np.clip(np.ceil(_KERNEL_HALF_SIGMAS * sigma), 1, _KERNEL_HALF_MAX))
    line = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    # The noise that is left of noise 1.
    left = np.sum(line**2) / line.sum() ** 2
    if frame.parity is not None:
        left *= _mosaic_noise(line)
    threshold = np.float32(options.threshold_sigma * left)
    filtered = _filtered(frame.counts, (line / line.sum()).astype(np.float32))
    # Whatever is found is among these, rounding included.
    above = np.flatnonzero(filtered > np.float32(0.9999) * threshold * frame.noise.min())
    # sep prepares a list for all pixels that it may have to keep, which takes longer than a small
    # image.
    most = sep.get_extract_pixstack()
    sep.set_extract_pixstack(min(most, len(above) + _PIXELS_MORE))
    try:
        objects, labels = sep.extract(
            filtered,
            threshold,
            err=frame.noise,
            minarea=options.min_pixels,
            filter_kernel=None,
            segmentation_map=True,
        )
    except Exception as error:  # sep raises bare exceptions when its buffers are full
        raise ImageError(
            f"{name}: there are too many bright pixels to tell stars apart; raise the threshold, "
            "or leave the image "
            "out."
        ) from error
    finally:
        sep.set_extract_pixstack(most)
    objects["flux"] = np.bincount(
        labels.ravel()[above], frame.counts.ravel()[above], minlength=len(objects) + 1
    )[1:]
    objects = objects[np.isfinite(objects["x"]) & np.isfinite(objects["y"])]
    return objects[np.argsort(-objects["cflux"], kind="stable")][:_MAX_DETECTIONS]


def _filtered(counts: Any, line: Any) -> Any:
    """Counts filtered by the product of a symmetric `line` with itself, dark beyond the edges.

    Blocks of rows stay in the processor's cache, where sums of shifted rows take a third of the
    time of SciPy's filter, which goes line by line in double precision.
    """
    half = len(line) // 2

    def along(rows: Any) -> Any:
        n = len(rows) - 2 * half
        total = line[half] * rows[half : half + n]
        pair = np.empty_like(total)
        for k in range(half):
            np.add(rows[k : k + n], rows[2 * half - k :][:n], out=pair)
            pair *= line[k]
            total += pair
        return total

    padded, size = np.pad(counts, half), _ROWS_AT_ONCE
    tops = range(0, len(counts), size)
    return np.concatenate([along(along(padded[k : k + size + 2 * half]).T).T for k in tops])


def _mosaic_noise(line: Any) -> float:
    """Factor of the noise left by a filter, the product of `line` with itself, where half of the
    pixels were measured.

    The others are the mean of their four neighbours, so that each that was measured has some of the
    weights of these.
    """
    weights = np.pad(np.outer(line, line), 2)
    own = weights[1:-1, 1:-1] + 0.25 * of_neighbours(weights)
    place = np.add.outer(np.arange(len(own)), np.arange(len(own))) % 2
    worst = max(np.sum(own[place == parity] ** 2) for parity in (0, 1))
    return float(np.sqrt(worst / np.sum(weights**2)))


# The list of pixels is longer than those above the threshold by so many.
_PIXELS_MORE = 100


def _without_blobs(objects: Any, sigma: float) -> tuple[Any, int]:
    """Detections without those much larger than a star, such as the Moon, and without what lies on
    them.
    """
    large = objects["a"] > _BLOB_SIGMAS * max(sigma, 1.0)
    keep = ~large
    for blob in objects[large]:
        margin = 3.0 + 0.3 * float(blob["b"])
        off = [
            (objects[axis] < blob[f"{axis}min"] - margin)
            | (objects[axis] > blob[f"{axis}max"] + margin)
            for axis in "xy"
        ]
        keep &= off[0] | off[1]
    return objects[keep], int(np.count_nonzero(~keep))


def _fit(frame: PreparedImage, objects: Any, sigma: float) -> tuple[Stamps, StarFit]:
    """Windowed centroids as a start, then the fit of the pixel-integrated star image."""
    half = half_stamp_px(sigma)
    x, y = objects["x"].astype(np.float64), objects["y"].astype(np.float64)
    stamps = cut_stamps(frame, x, y, half)
    width = np.full(len(x), sigma)
    xw, yw, good = window_positions(
        stamps, frame.counts.shape, x, y, np.hypot(width, 12.0**-0.5), width, _START_STEP_PX
    )
    # In a crowd, and where its window is cut, the windowed position runs away.
    good &= np.hypot(xw - x, yw - y) < 1.0
    x, y = np.where(good, xw, x), np.where(good, yw, y)
    return stamps, fit_stars(stamps, x, y, sigma, pairs=near_pairs(x, y, 2.0 * half))


_KINDS = ("star", "too sharp for a star (hot pixel or cosmic ray)", "extended", "not measurable")


def _classify(
    frame: PreparedImage, objects: Any, stamps: Stamps, fit: StarFit, psf_known: bool
) -> IntArray:
    """Index into `_KINDS` of each detection."""
    height, width = frame.counts.shape
    kind = np.zeros(len(objects), dtype=np.int64)
    at_psf = explained(stamps, fit, 1.0)
    core = stamps.whole_within(fit.x_px, fit.y_px, 2.0 * fit.sigma_px) & psf_known
    kind[core & (explained(stamps, fit, 2.0) > at_psf + _CHI2_MARGIN)] = 2
    kind[core & (explained(stamps, fit, 0.5) > at_psf + _CHI2_MARGIN)] = 1
    inside = True
    for place, size in ((fit.x_px, width), (fit.y_px, height)):
        inside &= np.abs(place - 0.5 * (size - 1)) < 0.5 * size
    moved = np.hypot(fit.x_px - objects["x"], fit.y_px - objects["y"]) > 1.0 + 1.5 * fit.sigma_px
    measured = inside & ~moved & (fit.flux > 0.0) & np.isfinite(fit.covariance).all((1, 2))
    kind[(kind == 0) & ~measured] = 3
    return kind


def _columns(
    image: Image,
    frame: PreparedImage,
    fit: StarFit,
    sigma: float,
    gain: float | None,
    order: IntArray,
) -> AnyDict:
    """The columns of the table for the chosen stars."""
    height, width = frame.counts.shape
    x, y, flux, covariance = (
        values[order] for values in (fit.x_px, fit.y_px, fit.flux, fit.covariance)
    )

    def box(reach: int) -> tuple[IntArray, IntArray]:
        """Rows and columns of the pixels around each star."""
        steps = np.arange(-reach, reach + 1)
        rows = (pixel_at(y, height)[:, None] + steps).clip(0, height - 1)
        columns = (pixel_at(x, width)[:, None] + steps).clip(0, width - 1)
        return rows[:, :, None], columns[:, None]

    margin = np.minimum.reduce([x, width - 1 - x, y, height - 1 - y]) + 0.5
    blended = np.zeros(len(order), dtype=np.bool_)
    blended[disturbed(x, y, flux, 6.0 * sigma)] = True
    return {
        "x_px": x,
        "y_px": y,
        "var_x_px2": covariance[:, 0, 0],
        "var_y_px2": covariance[:, 1, 1],
        "cov_xy_px2": covariance[:, 0, 1],
        "flux": flux * (gain or 1.0),
        "snr": flux / np.sqrt(covariance[:, 2, 2]),
        "peak": np.nanmax(image.data[box(1)].astype(np.float64), axis=(1, 2), initial=-np.inf),
        "saturated": np.zeros(len(order), np.bool_)
        if frame.saturated is None
        else frame.saturated[box(max(1, int(np.ceil(2.0 * sigma))))].any((1, 2)),
        "blended": blended,
        "edge": margin < 3.0 * sigma,
    }
