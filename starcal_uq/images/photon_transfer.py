"""The gain of a detector, read off the noise of one image's background.

Photon noise makes the variance of the background a straight line over its level, whose slope is the inverse gain
whatever bias and read noise are. Where the background is bright and uneven, by vignetting or twilight, one image is
enough.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray

_MESH_PX = 64
# The slope counts where it is known this well, on so many meshes and with so little scatter about the line.
_LARGEST_ERROR, _FEWEST_MESHES, _LARGEST_CHI2 = 0.1, 24, 2.0
# Variance that is left of Gaussian noise clipped at 3 sigma.
_CLIPPED_VARIANCE = 0.9733


def counts_per_electron(data: Any) -> float:
    """Inverse gain of an image, 0 where its background does not say it.

    Parameters
    ----------
    data
        Counts with background, shape (height, width).
    """
    height, width = (size // _MESH_PX for size in data.shape)
    if height * width < _FEWEST_MESHES:
        return 0.0
    rows = data[: height * _MESH_PX : 2, : width * _MESH_PX]
    meshes = rows.reshape(height, _MESH_PX // 2, width, _MESH_PX)
    pixels = meshes.transpose(0, 2, 1, 3).reshape(height * width, -1, 2)
    # Neighbours differ by their noise alone.
    difference = pixels[:, :, 1] - pixels[:, :, 0]
    level = np.median(pixels[:, ::5, 0], axis=1)
    limit = 3.0 * 1.4826 * np.median(np.abs(difference[:, ::3]), axis=1, keepdims=True)
    inside = np.abs(difference) <= limit
    n = np.count_nonzero(inside, axis=1)
    difference *= inside
    variance = np.einsum("ij,ij->i", difference, difference) / n / (2.0 * _CLIPPED_VARIANCE)
    good = np.isfinite(variance) & np.isfinite(level) & (variance > 0.0)
    if np.count_nonzero(good) < _FEWEST_MESHES:
        return 0.0
    x, y = level[good].astype(np.float64), variance[good].astype(np.float64)
    # All with the typical error: by its own, a mesh whose variance is low by chance would weigh more.
    return _slope(x, y, float(np.median(y) * np.sqrt(2.0 / np.median(n[good]))))


def _slope(x: FloatArray, y: FloatArray, sigma: float) -> float:
    """Slope of the straight line through points, 0 where it is not positive, not well known, or no line fits."""
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
