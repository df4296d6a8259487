"""Fits of a Gaussian star image, integrated over pixels, to the pixels around many detections at once.

Each star has position and flux; weights are the inverse variances that the fitted star itself implies, iterated. This
is maximum likelihood to first order, so that its scatter is the Cramer-Rao bound, and it has no pixel-phase error
because the integration over pixels is in the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.images.background import PreparedImage

_ITERATIONS = 12
_TOLERANCE_PX = 1e-4
_SQRT_2PI = float(np.sqrt(2.0 * np.pi))


@dataclass(frozen=True)
class Stamps:
    """Squares of pixels around n positions.

    Attributes
    ----------
    x0, y0 : array of int64, shape (n,)
        First column and row.
    counts : array, shape (n, m, m)
        Counts above the background; 0 where not `good`.
    good : array of bool, shape (n, m, m)
        Pixels to use.
    variance : array, shape (n,)
        Variance of the background, counts squared.
    counts_per_e : float
        Inverse gain; 0 leaves photon noise of the star away.
    """

    x0: IntArray
    y0: IntArray
    counts: FloatArray
    good: BoolArray
    variance: FloatArray
    counts_per_e: float = 0.0

    def subset(self, chosen: Any) -> Stamps:
        """The stamps of some of the stars."""
        names = ("x0", "y0", "counts", "good", "variance")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


@dataclass(frozen=True)
class StarFit:
    """Result of `fit_stars` for n stars.

    Attributes
    ----------
    x_px, y_px : array, shape (n,)
        Position in the image.
    flux : array, shape (n,)
        Counts.
    covariance : array, shape (n, 3, 3)
        Covariance of (x, y, flux), px and counts; infinite where the pixels do not determine the star.
    sigma_px : array, shape (n,)
        Width of the star image, before integration over pixels.
    weight : array, shape (n, m, m)
        Inverse variance of each pixel, 0 where it was not used.
    residual : array, shape (n, m, m)
        Counts minus the other stars of the field that reach into the stamp.
    """

    x_px: FloatArray
    y_px: FloatArray
    flux: FloatArray
    covariance: FloatArray
    sigma_px: FloatArray
    weight: FloatArray
    residual: FloatArray


def cut_stamps(
    counts: Any, usable: BoolArray | None, x: FloatArray, y: FloatArray, half_px: int, noise: Any, counts_per_e: float
) -> Stamps:
    """Cut the pixels around positions; what lies outside the image or is not `usable` is marked as not good."""
    height, width = counts.shape
    steps = np.arange(-half_px, half_px + 1)
    x0, y0 = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    columns, rows = x0[:, None] + steps, y0[:, None] + steps
    inside = ((columns >= 0) & (columns < width))[:, None, :] & ((rows >= 0) & (rows < height))[:, :, None]
    at = (rows.clip(0, height - 1)[:, :, None], columns.clip(0, width - 1)[:, None, :])
    good = inside if usable is None else inside & usable[at]
    variance = np.asarray(noise[y0.clip(0, height - 1), x0.clip(0, width - 1)], dtype=np.float64) ** 2
    stamp = np.where(good, counts[at], 0.0).astype(np.float64)
    return Stamps(x0 - half_px, y0 - half_px, stamp, good, variance, counts_per_e)


def profile(centre: FloatArray, sigma: FloatArray, n_pixels: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fractions of the light in pixels 0, 1, ... along an axis, and derivatives by centre and by log width; (n, m)."""
    from scipy.special import ndtr

    z = (np.arange(n_pixels + 1) - 0.5 - centre[:, None]) / sigma[:, None]
    density = np.exp(-0.5 * z * z) / _SQRT_2PI
    return np.diff(ndtr(z)), -np.diff(density) / sigma[:, None], -np.diff(z * density)


def _gaussian(px: FloatArray, py: FloatArray) -> FloatArray:
    image: FloatArray = py[:, :, None] * px[:, None, :]
    return image


def fit_stars(
    stamps: Stamps, x: FloatArray, y: FloatArray, sigma_px: float, *, free_sigma: bool = False, pairs: Any = None
) -> StarFit:
    """Fit position and flux of each star from x, y (n,) in the image, and with `free_sigma` its own width too.

    `pairs` (p, 2) are stars (i, j) of which j reaches into the stamp of i; it is subtracted there.
    """
    n, m = stamps.counts.shape[:2]
    u, v = x - stamps.x0, y - stamps.y0
    log_sigma = np.full(n, np.log(sigma_px))
    flux = np.zeros(n)
    others = np.zeros_like(stamps.counts)
    n_free = 4 if free_sigma else 3
    normal = np.zeros((n, n_free, n_free))
    weight = stamps.good / stamps.variance[:, None, None]
    for iteration in range(_ITERATIONS + 1):
        sigma = np.exp(log_sigma)
        (px, dx, sx), (py, dy, sy) = profile(u, sigma, m), profile(v, sigma, m)
        shape = _gaussian(px, py)
        if iteration == 0:
            # The flux is linear: start at its best value.
            flux = _ratio(np.sum(weight * shape * stamps.counts, (1, 2)), np.sum(weight * shape * shape, (1, 2)))
        if pairs is not None and len(pairs):
            others = _others(stamps, u, v, flux, sigma, pairs)
        bright = np.maximum(flux[:, None, None] * shape + others, 0.0)
        weight = stamps.good / (stamps.variance[:, None, None] + stamps.counts_per_e * bright)
        f = flux[:, None, None]
        columns = [f * _gaussian(dx, py), f * _gaussian(px, dy), shape]
        if free_sigma:
            columns.append(f * (_gaussian(sx, py) + _gaussian(px, sy)))
        design = np.stack([c.reshape(n, m * m) for c in columns], axis=1)
        weighted = design * weight.reshape(n, 1, m * m)
        normal = weighted @ design.transpose(0, 2, 1)
        if iteration == _ITERATIONS:
            break
        rest = (stamps.counts - others - f * shape).reshape(n, m * m, 1)
        step = _solve(normal, weighted @ rest)
        # Far from the solution the linear step overshoots.
        moved = np.maximum(np.hypot(step[:, 0], step[:, 1]) / (0.5 * sigma), 1.0)
        u, v, flux = u + step[:, 0] / moved, v + step[:, 1] / moved, flux + step[:, 2]
        if free_sigma:
            log_sigma = (log_sigma + np.clip(step[:, 3], -0.3, 0.3)).clip(np.log(0.15), np.log(0.5 * m))
        if not n or np.abs(step[:, :2]).max() < _TOLERANCE_PX:
            break
    covariance = _inverse(normal)[:, :3, :3]
    residual = stamps.counts - others
    return StarFit(u + stamps.x0, v + stamps.y0, flux, covariance, np.exp(log_sigma), weight, residual)


def explained(stamps: Stamps, fit: StarFit, scale: float) -> FloatArray:
    """Drop of chi squared by a star of `scale` times the width at the fitted place, shape (n,)."""
    m = stamps.counts.shape[1]
    sigma = scale * fit.sigma_px
    shape = _gaussian(profile(fit.x_px - stamps.x0, sigma, m)[0], profile(fit.y_px - stamps.y0, sigma, m)[0])
    projected = np.sum(fit.weight * shape * fit.residual, (1, 2))
    return _ratio(projected * np.abs(projected), np.sum(fit.weight * shape * shape, (1, 2)))


def _others(
    stamps: Stamps, u: FloatArray, v: FloatArray, flux: FloatArray, sigma: FloatArray, pairs: Any
) -> FloatArray:
    here, there = pairs[:, 0], pairs[:, 1]
    m = stamps.counts.shape[1]
    px = profile(u[there] + stamps.x0[there] - stamps.x0[here], sigma[there], m)[0]
    py = profile(v[there] + stamps.y0[there] - stamps.y0[here], sigma[there], m)[0]
    total = np.zeros_like(stamps.counts)
    np.add.at(total, here, np.maximum(flux[there], 0.0)[:, None, None] * _gaussian(px, py))
    return total


def _ratio(top: FloatArray, bottom: FloatArray) -> FloatArray:
    return np.divide(top, bottom, out=np.zeros_like(top), where=bottom > 0.0)


def _determined(normal: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Which matrices can be inverted, and each scaled to a unit diagonal (the identity where it cannot)."""
    diagonal = np.einsum("nii->ni", normal)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    fine = np.isfinite(scaled).all((1, 2)) & (diagonal > 0.0).all(1)
    scaled = np.where(fine[:, None, None], scaled, np.eye(normal.shape[1]))
    fine &= np.linalg.det(scaled) > 1e-9
    return fine, np.where(fine[:, None, None], scaled, np.eye(normal.shape[1]))


def _inverse(normal: FloatArray) -> FloatArray:
    fine, scaled = _determined(normal)
    scale = np.sqrt(np.where(fine[:, None], np.einsum("nii->ni", normal), 1.0))
    inverse: FloatArray = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
    return np.where(fine[:, None, None], inverse, np.inf)


def _solve(normal: FloatArray, right: FloatArray) -> FloatArray:
    inverse = _inverse(normal)
    steps: FloatArray = (np.where(np.isfinite(inverse), inverse, 0.0) @ right)[:, :, 0]
    return steps


def near_pairs(x: FloatArray, y: FloatArray, reach: float) -> IntArray:
    """Pairs (i, j), in both orders, of positions closer than `reach`."""
    from scipy.spatial import cKDTree

    if len(x) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = cKDTree(np.column_stack([x, y])).query_pairs(reach, output_type="ndarray").astype(np.int64)
    return np.concatenate([pairs, pairs[:, ::-1]])


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
