"""Where a camera looks during a calibration: patterns of attitudes over the sky."""

from __future__ import annotations

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation, random_rotations
from starcal_uq.core.types import FloatArray

# random: anywhere; stare: one place and one roll; roll: one place, turned about the boresight;
# raster: steps of a quarter of the field around one place; scan: along a great circle, a tenth of
# the field at a time.
POINTINGS = ("random", "stare", "roll", "raster", "scan")
_RASTER_SIDE, _RASTER_STEP, _SCAN_STEP = 5, 0.25, 0.1


def pattern_rotations(
    pattern: str, n: int, rng: np.random.Generator, fov_deg: float, place: FloatArray | None = None
) -> FloatArray:
    """Attitudes (n, 3, 3) of a pattern, R_cam_icrs.

    "random": anywhere; "stare": always the same; "roll": one place with the roll going once around;
    "raster": five by five places that are a quarter of the field apart, in turn; "scan": along a
    great circle with a tenth of the field from frame to frame. They start from an attitude `place`
    (3, 3), or from a drawn one.
    """
    if pattern == "random":
        return random_rotations(n, rng)
    start = random_rotations(1, rng)[0] if place is None else place
    field, number = np.deg2rad(fov_deg), np.arange(n)
    turn = np.zeros((n, 3))
    if pattern == "roll":
        turn[:, 2] = 2.0 * np.pi * number / n
    elif pattern == "scan":
        turn[:, 1] = _SCAN_STEP * field * number
    elif pattern == "raster":
        half = 0.5 * (_RASTER_SIDE - 1)
        turn[:, 0] = _RASTER_STEP * field * (number % _RASTER_SIDE - half)
        turn[:, 1] = _RASTER_STEP * field * (number // _RASTER_SIDE % _RASTER_SIDE - half)
    elif pattern != "stare":
        raise ValueError(f"pattern {pattern!r} is unknown: use one of {', '.join(POINTINGS)}.")
    return exp_rotation(turn) @ start
