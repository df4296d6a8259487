"""Right ascension and declination to unit vectors and back."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.types import FloatArray


def unit_vectors(ra_deg: FloatArray, dec_deg: FloatArray) -> FloatArray:
    """Unit vectors of directions on the sky.

    Parameters
    ----------
    ra_deg, dec_deg
        Right ascension and declination, deg, shape (n,).

    Returns
    -------
    ndarray, shape (n, 3)
        Unit vectors: x towards (0, 0), y towards (90, 0), z towards declination 90.
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    cos_dec = np.cos(dec)
    return np.stack([cos_dec * np.cos(ra), cos_dec * np.sin(ra), np.sin(dec)], axis=-1)


def ra_dec_deg(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right ascension in [0, 360) and declination, deg, of vectors of any length.

    Parameters
    ----------
    vectors
        Shape (n, 3).

    Returns
    -------
    tuple of ndarray, shape (n,) each
        The declination comes from the arc tangent, which keeps its digits at the poles where the arc sine loses half.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    ra = np.degrees(np.arctan2(y, x)) % 360.0
    # A right ascension of -1e-17 becomes exactly 360 under the modulo.
    return np.where(ra >= 360.0, 0.0, ra), np.degrees(np.arctan2(z, np.hypot(x, y)))
