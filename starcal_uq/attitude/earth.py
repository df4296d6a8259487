"""The Earth under a camera: its axes among the stars, and the air that raises stars."""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.core.times import julian_days
from starcal_uq.core.types import FloatArray, floats

# The standard atmosphere at sea level, half saturated, at an effective wavelength in micrometres.
_STANDARD_AIR = (1013.25, 15.0, 0.5, 0.6)
# Sine of the lowest altitude that is taken for possible where the zenith is not known.
LOWEST = float(np.sin(np.radians(5.0)))
# Density of the air in that of the standard air at sea level: its spread before any data.
DENSITY_SPREAD = 0.2


def earth_axes(time_utc: Any, ut1_minus_utc_s: float = 0.0) -> FloatArray:
    """Axes of the Earth among the stars at one UTC time (3, 3) or a sequence (n, 3, 3), by rows: x
    through latitude and longitude zero, z to the pole.

    Precession and nutation are those of IAU 2006/2000A (`erfa.c2t06a`); polar motion is left out.
    UT1 - UTC is in seconds.
    """
    import erfa

    tt, ut1, inverse = julian_days(time_utc, ut1_minus_utc_s)
    axes = erfa.c2t06a(tt[:, 0], tt[:, 1], ut1[:, 0], ut1[:, 1], 0.0, 0.0)
    found = floats(axes).reshape(-1, 3, 3)[inverse]
    return found[0] if np.ndim(time_utc) == 0 else found


def air_constants(
    pressure_hpa: float = _STANDARD_AIR[0],
    temperature_c: float = _STANDARD_AIR[1],
    relative_humidity: float = _STANDARD_AIR[2],
    wavelength_um: float = _STANDARD_AIR[3],
) -> tuple[float, float]:
    """A and B of the refraction R = A tan z + B tan^3 z, with z the zenith distance as seen; rad.

    From `erfa.refco` (8 mas RMS, 62 mas at worst against ray tracing down to 15 degrees of
    altitude). The standard air at sea level by default.
    """
    import erfa

    a, b = erfa.refco(pressure_hpa, temperature_c, relative_humidity, wavelength_um)
    return float(a), float(b)


def raising(sine: FloatArray, constants: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Length of the move towards the zenith that raises a star by refraction, rad, and its
    derivative by the sine of the altitude.

    A star b is raised to ``b + length * zenith``, normalised: its part across b is A tan z + B tan^3
    z. Below the lowest altitude that is possible, that one counts.
    """
    a, b = constants
    sine = np.maximum(sine, LOWEST)
    square = 1.0 / sine**2
    return (a - b + b * square) / sine, -(a - b + 3.0 * b * square) * square


def tangents(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors (n, 3) to the north and to the east of places (n, 3)."""
    east = np.column_stack([-places[:, 1], places[:, 0], np.zeros(len(places))])
    east[np.hypot(*places[:, :2].T) < 1e-6] = (0.0, 1.0, 0.0)
    east = normalised(east)
    return np.cross(places, east), east


def sphere(n: int) -> FloatArray:
    """Directions (n, 3) evenly over the sphere, on a spiral."""
    place = np.arange(n) + 0.5
    z = 1.0 - 2.0 * place / n
    angle = np.pi * (1.0 + np.sqrt(5.0)) * place
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def normalised(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 3) of length one."""
    return floats(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
