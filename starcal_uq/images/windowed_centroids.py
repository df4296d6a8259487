"""Centroids in a Gaussian window, for star images of a shape that no Gaussian fits, and their covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.images.background import PreparedImage
from starcal_uq.images.fits import StarFit, cut_stamps, near_pairs

# Wide enough to bridge the pixels of an undersampled image.
_WINDOW_SIGMA_PX = 1.5
# Stars whose second moments can be measured one by one, and how many of them it takes.
_GRADIENT_SNR, _GRADIENT_STARS = 30.0, 4
_LEAST_GRADIENT = 0.1


def windowed(frame: PreparedImage, fit: StarFit) -> StarFit:
    """`fit` with windowed centroids and their covariance for the stars that stand alone."""
    import sep

    window = np.maximum(_WINDOW_SIGMA_PX, 1.2 * fit.sigma_px)
    x, y, flags = sep.winpos(frame.counts, fit.x_px, fit.y_px, window)
    half = int(np.ceil(4.0 * window.max(initial=_WINDOW_SIGMA_PX)))
    stamps = cut_stamps(frame.counts, None, x, y, half, frame.noise, frame.counts_per_e)
    steps = np.arange(2 * half + 1)
    u = (steps + stamps.x0[:, None])[:, None, :] - x[:, None, None]
    v = (steps + stamps.y0[:, None])[:, :, None] - y[:, None, None]
    weight = np.exp(-0.5 * (u * u + v * v) / window[:, None, None] ** 2) * stamps.good
    light = np.sum(weight * stamps.counts, (1, 2))
    variance = stamps.variance[:, None, None] + stamps.counts_per_e * np.maximum(stamps.counts, 0.0)
    near = near_pairs(fit.x_px, fit.y_px, 4.0 * float(window.max(initial=0.0)))
    use = (flags == 0) & (light > 0.0) & (np.hypot(x - fit.x_px, y - fit.y_px) < 1.0) & stamps.good.all((1, 2))
    use[near[fit.flux[near[:, 1]] > 0.01 * fit.flux[near[:, 0]], 0]] = False
    offsets = np.stack(np.broadcast_arrays(u, v), axis=1)
    gradient = _window_gradient(weight * stamps.counts, offsets, window, fit, use)
    scale = weight**2 * variance / np.where(light > 0.0, light, np.inf)[:, None, None] ** 2
    noise = np.einsum("nhw,nihw,njhw->nij", scale, offsets, offsets)
    inverse = np.linalg.inv(gradient)
    covariance = fit.covariance.copy()
    covariance[:, :2, :2] = inverse @ noise @ inverse.transpose(0, 2, 1)
    x, y = np.where(use, x, fit.x_px), np.where(use, y, fit.y_px)
    return replace(fit, x_px=x, y_px=y, covariance=np.where(use[:, None, None], covariance, fit.covariance))


def _window_gradient(
    light: FloatArray, offsets: FloatArray, window: FloatArray, fit: StarFit, alone: BoolArray
) -> FloatArray:
    """How far a windowed first moment falls when its window moves on by 1 px, shape (n, 2, 2).

    The window follows the star, so that noise in the moment moves the centroid by the inverse of this: by a factor 2
    where the window is as wide as the star (SExtractor's ERRX2WIN takes that for all), by hardly more than 1 where it
    is wide. The second moments of the light in the window are the median of the bright stars'; one faint star's are
    noise.
    """
    bright = alone & (fit.flux > _GRADIENT_SNR * np.sqrt(fit.covariance[:, 2, 2]))
    star = fit.sigma_px**2 + 1.0 / 12.0
    moments = (star * window**2 / (star + window**2))[:, None, None] * np.eye(2)
    if np.count_nonzero(bright) >= _GRADIENT_STARS:
        inside, at = light[bright], offsets[bright]
        second = np.einsum("nhw,nihw,njhw->nij", inside, at, at) / inside.sum((1, 2))[:, None, None]
        moments = np.broadcast_to(np.median(second, axis=0), moments.shape)
    # Light without a peak does not hold the window; the floor keeps the errors finite.
    values, axes = np.linalg.eigh(np.eye(2) - moments / window[:, None, None] ** 2)
    gradient: FloatArray = (axes * np.maximum(values, _LEAST_GRADIENT)[:, None, :]) @ axes.transpose(0, 2, 1)
    return gradient
