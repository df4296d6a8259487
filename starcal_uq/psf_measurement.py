"""The width of the star images, measured on the stars of one image."""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq._types import BoolArray, IntArray
from starcal_uq.centroid_fits import Stamps, cut_stamps, explained, fit_stars
from starcal_uq.image_background import PreparedImage

FIRST_SIGMA_PX = 1.2
_STAMP_HALF_SIGMAS = 4.0
_PSF_STARS, _PSF_SNR, _MISFIT_SNR = 40, 15.0, 30.0
_WIDTHS = (0.25, 15.0)


def moment_sigma_px(objects: Any, default: float) -> float:
    """Width of the typical detection by its moments, pixels."""
    if not len(objects):
        return default
    moments: Any = np.sqrt(objects["a"] * objects["b"])[:_PSF_STARS]
    return float(np.clip(np.nanmedian(moments), 0.4, 4.0 * default))


def measure_psf(frame: PreparedImage, objects: Any) -> tuple[float, float] | None:
    """Width of the star images, and the light they have beyond a Gaussian as a part of it; None where unknown.

    The median over bright stars that stand alone; where there is none, the common width that suits the faint ones.
    """
    sigma = moment_sigma_px(objects, FIRST_SIGMA_PX)
    noise = frame.noise[pixel_at(objects["y"], frame.counts.shape[0]), pixel_at(objects["x"], frame.counts.shape[1])]
    snr = objects["flux"] / (noise * np.sqrt(4.0 * np.pi) * sigma)
    alone = objects["flag"] == 0
    bright = alone & (snr > _PSF_SNR)
    if not bright.any():
        return _common_width(frame, objects[alone], sigma)
    chosen = objects[bright][: 10 * _PSF_STARS]
    # The brightest of equally faint stars are those whose noise adds light and width: then more are taken.
    clear = np.count_nonzero(snr[bright] > 4.0 * _PSF_SNR) >= _PSF_STARS
    most = _PSF_STARS if clear else 5 * _PSF_STARS
    excess = 0.0
    for _ in range(2):
        chosen, stamps = _clean_stamps(frame, chosen, sigma, most)
        if not len(chosen):
            return None
        x, y = chosen["x"].astype(np.float64), chosen["y"].astype(np.float64)
        fit = fit_stars(stamps, x, y, sigma, free_sigma=True)
        good = (np.hypot(fit.x_px - x, fit.y_px - y) < 1.0 + sigma) & (fit.flux > 0.0)
        if not good.any():
            return None
        sigma = float(np.clip(np.median(fit.sigma_px[good]), *_WIDTHS))
    stamps = cut_stamps(
        frame.counts, frame.usable, fit.x_px, fit.y_px, half_stamp_px(sigma), frame.noise, frame.counts_per_e
    )
    fit = fit_stars(stamps, fit.x_px, fit.y_px, sigma)
    # Fainter stars that are found are those whose noise adds light.
    good &= stamps.good.all((1, 2)) & (fit.flux > _MISFIT_SNR * np.sqrt(fit.covariance[:, 2, 2]))
    if np.count_nonzero(good) > 3:
        beyond = stamps.counts[good].sum((1, 2)) / fit.flux[good] - 1.0
        middle = float(np.median(beyond))
        error = 1.9 * float(np.median(np.abs(beyond - middle))) / np.sqrt(len(beyond))
        excess = middle if abs(middle) > 3.0 * error else 0.0
    return sigma, excess


def _common_width(frame: PreparedImage, objects: Any, sigma: float) -> tuple[float, float] | None:
    """The one width that lowers chi squared most over all stars, found by parabolas in its logarithm."""
    chosen = objects[: 5 * _PSF_STARS]
    for _ in range(6):
        chosen, stamps = _clean_stamps(frame, chosen, sigma, 5 * _PSF_STARS)
        if len(chosen) < 3:
            return None
        fit = fit_stars(stamps, chosen["x"].astype(np.float64), chosen["y"].astype(np.float64), sigma)
        low, here, high = (float(np.sum(explained(stamps, fit, scale))) for scale in (0.8, 1.0, 1.25))
        bend = low - 2.0 * here + high
        step = 0.5 * (low - high) / bend if bend < 0.0 else np.sign(high - low)
        last, sigma = sigma, float(np.clip(sigma * 1.25 ** np.clip(step, -2.0, 2.0), *_WIDTHS))
        if abs(sigma / last - 1.0) < 1e-3:
            break
    return sigma, 0.0


def _clean_stamps(frame: PreparedImage, objects: Any, sigma: float, most: int) -> tuple[Any, Stamps]:
    """Detections with all their pixels and no hot pixel, and their stamps."""
    x, y = objects["x"].astype(np.float64), objects["y"].astype(np.float64)
    stamps = cut_stamps(frame.counts, frame.usable, x, y, half_stamp_px(sigma), frame.noise, frame.counts_per_e)
    clean = np.flatnonzero(stamps.good.all((1, 2)) & ~_single_pixels(stamps))[:most]
    return objects[clean], stamps.subset(clean)


def half_stamp_px(sigma: float) -> int:
    return int(np.ceil(_STAMP_HALF_SIGMAS * sigma)) + 1


def _single_pixels(stamps: Stamps) -> BoolArray:
    """Stamps in which one pixel holds more than its eight neighbours together: hot pixels."""
    c = stamps.counts.shape[1] // 2
    core = stamps.counts[:, c - 1 : c + 2, c - 1 : c + 2]
    highest = core.max((1, 2))
    hot: BoolArray = highest > 0.6 * core.sum((1, 2))
    return hot


def pixel_at(position: Any, size: int) -> IntArray:
    """The pixel of a position, inside the image."""
    pixel: IntArray = np.rint(position).astype(np.int64).clip(0, size - 1)
    return pixel
