"""The image of a point: a Gaussian along each axis, integrated over each pixel or sampled at its
centre.
"""

from __future__ import annotations

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray

# Light farther out than this many sigma is left away: 2e-9 of it along each axis.
_REACH_SIGMAS = 6.0


def half_width_px(sigma_px: float) -> int:
    """Pixels on each side of the nearest one that a stamp holds."""
    return int(np.ceil(_REACH_SIGMAS * sigma_px + 0.5))


def profiles(centre_px: FloatArray, sigma_px: float, kind: str) -> tuple[IntArray, FloatArray]:
    """Fractions of the light along one axis, around each of many centres (n,); a whole number is
    the centre of a pixel.

    `sigma_px` is that of the Gaussian before integration over pixels (which adds 1/12 px^2 to its
    square); the kind ``sampled`` takes the density at each pixel's centre instead. The first pixel
    of each row (n,), and the fractions (n, w) in the pixels from there on.
    """
    reach = half_width_px(sigma_px)
    first = np.rint(centre_px).astype(np.int64) - reach
    offset = (first - centre_px)[:, None]
    if kind == "gaussian":
        from scipy.special import erf

        edges = offset + (np.arange(2 * reach + 2) - 0.5)
        return first, 0.5 * np.diff(erf(edges / (np.sqrt(2.0) * sigma_px)), axis=1)
    z = (offset + np.arange(2 * reach + 1)) / sigma_px
    return first, np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * sigma_px)
