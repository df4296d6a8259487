"""A pinhole under the real sky, looked at with NumPy alone."""

from __future__ import annotations

import numpy as np

FOCAL_PX, SIDE_PX = 3600.0, 1024
ARCSEC = 648_000.0 / np.pi


def directions(ra_deg: np.ndarray, dec_deg: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3)."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)


def on_detector(
    r: np.ndarray, mag: np.ndarray, rotation: np.ndarray, margin_px: float
) -> np.ndarray:
    """Numbers of the stars that a pinhole shows, brightest first."""
    b = r @ rotation.T
    front = b[:, 2] > 0.1
    x, y = (FOCAL_PX * b[:, axis] / np.where(front, b[:, 2], 1.0) for axis in (0, 1))
    half = 0.5 * SIDE_PX - margin_px
    seen = np.flatnonzero(front & (np.abs(x) < half) & (np.abs(y) < half))
    return seen[np.argsort(mag[seen], kind="stable")]


def attitude_variance(b: np.ndarray, sigma_px: np.ndarray) -> np.ndarray:
    """Variances (3,) of an attitude, rad^2, by centroid noise (n,) of stars in the camera (n, 3)."""
    x, y, one = b[:, 0] / b[:, 2], b[:, 1] / b[:, 2], np.ones(len(b))
    # A small turn moves the image (x, y) of a pinhole by these columns.
    rows = (
        np.stack([x * y, -(one + x * x), y], axis=1),
        np.stack([one + y * y, -x * y, -x], axis=1),
    )
    a = FOCAL_PX * np.concatenate(rows) / np.tile(sigma_px, 2)[:, None]
    return np.diag(np.linalg.inv(a.T @ a))
