"""The width of the star images, measured on the stars of one image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.images.background import PreparedImage
from starcal_uq.images.fits import (
    Stamps,
    StarFit,
    cut_stamps,
    explained,
    fit_stars,
    fit_widths,
    window_moments,
)
from starcal_uq.maths.intervals import median_of

FIRST_SIGMA_PX = 1.2
_STAMP_HALF_SIGMAS = 4.0
_PSF_STARS, _PSF_SNR, _MISFIT_SNR = 40, 15.0, 30.0
_WIDTHS = (0.25, 15.0)
# Star images with this part of their light beyond the Gaussian, or so much longer than wide, are no
# round Gaussians.
_MISFIT, _ELONGATED = 0.1, 1.2
_MOMENT_WINDOW_PX = 1.5
# The fits of this part of the stars need not have converged: for the size of stamps, and for a
# median.
_LEFT_MOVING = (0.8, 0.15)


@dataclass(frozen=True)
class Psf:
    """What the star images of a frame look like: width, px, before integration over pixels.

    `beyond` is light beyond the Gaussian as a part of it, 0 where it is not significant;
    `elongation` is length over width, with the pixel, 1 where it is not significant.
    """

    sigma_px: float
    beyond: float = 0.0
    elongation: float = 1.0

    @property
    def shape_words(self) -> str:
        """What keeps the star images from being round Gaussians; empty where nothing does."""
        words = []
        if abs(self.beyond) > _MISFIT:
            words.append(
                f"no Gaussians ({abs(100.0 * self.beyond):.0f} % of their light is elsewhere)"
            )
        if self.elongation > _ELONGATED:
            words.append(f"elongated ({self.elongation:.1f} : 1)")
        return " and ".join(words)


def moment_sigma_px(objects: Any, default: float) -> float:
    """Width of the typical detection by its moments, pixels."""
    if not len(objects):
        return default
    moments: Any = np.sqrt(objects["a"] * objects["b"])[:_PSF_STARS]
    return float(np.clip(np.nanmedian(moments), 0.4, 4.0 * default))


def measure_psf(frame: PreparedImage, objects: Any) -> Psf | None:
    """Width and shape of the star images; None where unknown.

    The median over bright stars that stand alone; where there is none, the common width that suits
    the faint ones.
    """
    sigma = moment_sigma_px(objects, FIRST_SIGMA_PX)
    noise = frame.noise[
        pixel_at(objects["y"], frame.counts.shape[0]), pixel_at(objects["x"], frame.counts.shape[1])
    ]
    snr = objects["flux"] / (noise * np.sqrt(4.0 * np.pi) * sigma)
    alone = objects["flag"] == 0
    bright = alone & (snr > _PSF_SNR)
    if not bright.any():
        return _common_width(frame, objects[alone], sigma)
    chosen = objects[bright][: 10 * _PSF_STARS]
    # The brightest of equally faint stars are those whose noise adds light and width: then more are
    # taken.
    clear = np.count_nonzero(snr[bright] > 4.0 * _PSF_SNR) >= _PSF_STARS
    most = _PSF_STARS if clear else 5 * _PSF_STARS
    # Moments are of the filtered image, in which stars are wider.
    first = max(float(np.sqrt(max(sigma**2 - FIRST_SIGMA_PX**2, 0.0))), 0.6 * sigma)
    x, y = chosen["x"].astype(np.float64), chosen["y"].astype(np.float64)
    widths = np.full(len(chosen), first)
    for left_moving in _LEFT_MOVING:
        clean, stamps = _clean_stamps(frame, chosen, sigma, most)
        if not len(clean):
            return None
        chosen = chosen[clean]
        x, y, flux, widths = fit_widths(stamps, x[clean], y[clean], widths[clean], left_moving)
        good = (np.hypot(x - chosen["x"], y - chosen["y"]) < 1.0 + sigma) & (flux > 0.0)
        if not good.any():
            return None
        sigma = float(np.clip(median_of(widths[good]), *_WIDTHS))
        # The second fit, of stamps that suit the width, starts where the first has ended.
        x, y = np.where(good, x, chosen["x"]), np.where(good, y, chosen["y"])
        widths = np.where(good, widths, sigma)
    # All pixels with the same weight, so that what counts as core and wings does not hang on
    # whether the gain is known.
    stamps = cut_stamps(replace(frame, counts_per_e=0.0), x, y, half_stamp_px(sigma))
    width = sigma
    if frame.counts_per_e:
        x, y, _, widths = fit_widths(stamps, x, y, widths, _LEFT_MOVING[0])
        width = float(np.clip(median_of(widths[good]), *_WIDTHS))
    fit = fit_stars(stamps, x, y, width, once=True)
    # Fainter stars that are found are those whose noise adds light.
    good &= stamps.fine.all((0, 1)) & (fit.flux > _MISFIT_SNR * np.sqrt(fit.covariance[:, 2, 2]))
    if np.count_nonzero(good) <= 3:
        return Psf(sigma)
    return Psf(
        sigma,
        _significant(stamps.counts[..., good].sum((0, 1)) / fit.flux[good] - 1.0),
        _elongation(stamps, fit, good),
    )


def _significant(values: FloatArray) -> float:
    """Median of numbers, 0 where their scatter explains it."""
    middle = float(median_of(values))
    error = 1.9 * float(median_of(np.abs(values - middle))) / np.sqrt(len(values))
    return middle if abs(middle) > 3.0 * error else 0.0


def _elongation(stamps: Stamps, fit: StarFit, good: BoolArray) -> float:
    """Length over width of the star images by their second moments in a window, whose part is taken
    out.
    """
    window = max(_MOMENT_WINDOW_PX, 1.2 * float(median_of(fit.sigma_px)))
    sums = window_moments(stamps, stamps.counts, fit.x_px, fit.y_px, window)[..., good]
    xx, yy, xy = sums[[0, 2, 1], [2, 0, 1]] / sums[0, 0]
    mean = 0.5 * float(median_of(xx + yy))
    apart = float(np.hypot(_significant(0.5 * (xx - yy)), _significant(xy)))
    if not apart < mean < window**2 - apart:
        return 1.0
    long, wide = (1.0 / (1.0 / (mean + sign * apart) - window**-2) for sign in (1.0, -1.0))
    return float(np.sqrt(long / wide))


def _common_width(frame: PreparedImage, objects: Any, sigma: float) -> Psf | None:
    """The one width that lowers chi squared most over all stars, found by parabolas in its
    logarithm.
    """
    chosen = objects[: 5 * _PSF_STARS]
    for _ in range(6):
        clean, stamps = _clean_stamps(frame, chosen, sigma, 5 * _PSF_STARS)
        chosen = chosen[clean]
        if len(chosen) < 3:
            return None
        fit = fit_stars(
            stamps, chosen["x"].astype(np.float64), chosen["y"].astype(np.float64), sigma
        )
        low, here, high = (
            float(np.sum(explained(stamps, fit, scale))) for scale in (0.8, 1.0, 1.25)
        )
        bend = low - 2.0 * here + high
        step = 0.5 * (low - high) / bend if bend < 0.0 else np.sign(high - low)
        last, sigma = sigma, float(np.clip(sigma * 1.25 ** np.clip(step, -2.0, 2.0), *_WIDTHS))
        if abs(sigma / last - 1.0) < 1e-3:
            break
    return Psf(sigma)


def _clean_stamps(
    frame: PreparedImage, objects: Any, sigma: float, most: int
) -> tuple[IntArray, Stamps]:
    """Which detections have all their pixels and no hot pixel, and their stamps."""
    x, y = objects["x"].astype(np.float64), objects["y"].astype(np.float64)
    stamps = cut_stamps(frame, x, y, half_stamp_px(sigma))
    clean = np.flatnonzero(stamps.fine.all((0, 1)) & ~_single_pixels(stamps))[:most]
    return clean.astype(np.int64), stamps.subset(clean)


def half_stamp_px(sigma: float) -> int:
    return int(np.ceil(_STAMP_HALF_SIGMAS * sigma)) + 1


def _single_pixels(stamps: Stamps) -> BoolArray:
    """Stamps in which one pixel holds more than its eight neighbours together: hot pixels."""
    c = stamps.counts.shape[1] // 2
    box = slice(c - 1, c + 2), slice(c - 1, c + 2)
    core = stamps.counts[box] * stamps.good[box]
    highest = core.max((0, 1))
    hot: BoolArray = highest > 0.6 * core.sum((0, 1))
    return hot


def pixel_at(position: Any, size: int) -> IntArray:
    """The pixel of a position, inside the image."""
    pixel: IntArray = np.rint(position).astype(np.int64).clip(0, size - 1)
    return pixel
