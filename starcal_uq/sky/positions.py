"""Right ascension and declination to unit vectors and back."""

from __future__ import annotations

import numpy as np

from starcal_uq.attitude.rotations import ra_dec_deg as ra_dec_deg
from starcal_uq.attitude.rotations import unit_vectors as unit_vectors
from starcal_uq.core.types import FloatArray, floats

_RAD_PER_MAS = np.pi / (180.0 * 3600.0 * 1000.0)


def propagate_proper_motion(
    ra_deg: FloatArray,
    dec_deg: FloatArray,
    pm_ra_mas_yr: FloatArray,
    pm_dec_mas_yr: FloatArray,
    years: float | FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Positions (deg) and proper motions (mas/yr) some Julian years later: uniform motion with no
    radial velocity.

    The star moves along the straight line u + mu t in space, on a great circle of the sky, so that
    nothing special happens near the poles (The Hipparcos Catalogue, ESA 1997, volume 1, section
    1.5.5, with its radial terms left out). The proper motion in right ascension includes cos(dec).
    """
    position = unit_vectors(ra_deg, dec_deg)
    east, north = _tangent(position)
    motion = _RAD_PER_MAS * (
        east * floats(pm_ra_mas_yr)[:, None] + north * floats(pm_dec_mas_yr)[:, None]
    )
    moved = position + motion * np.broadcast_to(floats(years), len(position))[:, None]
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    moved /= length
    rate = (motion - moved * (moved * motion).sum(axis=1, keepdims=True)) / length / _RAD_PER_MAS
    east, north = _tangent(moved)
    ra, dec = ra_dec_deg(moved)
    return ra, dec, (rate * east).sum(axis=1), (rate * north).sum(axis=1)


def _tangent(position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors towards east and north; at a pole, those of right ascension zero."""
    x, y, z = position[:, 0], position[:, 1], position[:, 2]
    rho = np.hypot(x, y)
    at_pole = rho == 0.0
    safe = np.where(at_pole, 1.0, rho)
    sin_ra, cos_ra = np.where(at_pole, 0.0, y / safe), np.where(at_pole, 1.0, x / safe)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(z)], axis=-1)
    return east, np.stack([-z * cos_ra, -z * sin_ra, rho], axis=-1)
