"""The sky as seen from the ground: the zenith, the motion of the site, refraction.

Everything is done on unit vectors along the ICRS axes: what turns the whole sky (precession,
nutation, the rotation of the Earth) only decides where the zenith is among the stars, because
attitudes are free. So UT1 - UTC, which is not known without a table from the network, may be taken
as zero: it is below 0.9 s, which moves the zenith by at most 13.5 arcsec and refraction, at 30
degrees of altitude, by 15 mas. Polar motion (0.3 arcsec) is left out for the same reason.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.attitude.earth import air_constants, earth_axes
from starcal_uq.attitude.rotations import unit_vectors
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.sky.site import Site

# Below this altitude refraction depends on the layers of the air, which two constants do not
# describe: at 10 degrees the formula is 0.6 arcsec off in 320, at 5 degrees tens of arcsec.
LEAST_ALTITUDE_DEG = 10.0
# Sine of the altitude below which `refract` goes on as if the star were there; the limit of
# `erfa.atioq`.
_LEAST_SINE = 0.05
_TURNS_PER_UT1_DAY = 1.00273781191135448
_EARTH_RATE_RAD_S = 2.0 * np.pi * _TURNS_PER_UT1_DAY / 86400.0
_WGS84 = 1
_NEWTON_STEPS = 4


def site_among_stars(
    site: Site, time_utc: Any, ut1_minus_utc_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Zenith and velocity of a site, ICRS axes, at one UTC time (shape (3,)) or a sequence (n, 3).

    The zenith is the outward normal of the ellipsoid (WGS 84); the velocity, relative to the
    Earth's centre, is at most 0.465 km/s: the cause of diurnal aberration, 0.32 arcsec. UT1 - UTC,
    seconds, turns the site together with its sky. Precession and nutation are those of IAU
    2006/2000A (`erfa.c2t06a`); polar motion is left out.
    """
    import erfa

    axes = earth_axes(time_utc, ut1_minus_utc_s)
    latitude, longitude = np.radians(site.latitude_deg), np.radians(site.longitude_deg)
    up = unit_vectors(site.longitude_deg, site.latitude_deg)
    place_km = floats(erfa.gd2gc(_WGS84, longitude, latitude, site.height_m)) / 1000.0
    velocity = _EARTH_RATE_RAD_S * np.array([-place_km[1], place_km[0], 0.0])
    # Rows times the rotation are columns times its transpose: from the axes of the Earth to those
    # of the stars.
    return up @ axes, velocity @ axes


def refraction_constants(site: Site) -> tuple[float, float]:
    """A and B of the refraction R = A tan z + B tan^3 z at a site, with z the zenith distance as
    seen; rad (`air_constants`).
    """
    return air_constants(
        site.air_pressure_hpa, site.air_temperature_c, site.relative_humidity, site.wavelength_um
    )


def refract(
    directions: FloatArray, zenith: FloatArray, constants: tuple[float, float]
) -> FloatArray:
    """Directions (n, 3) as seen through the air: each is raised towards the zenith, by
    `refraction_constants`.

    Lower than 3 degrees the refraction of 3 degrees is taken; check `altitude_deg` before.
    """
    a, b = constants
    sine = np.sum(directions * zenith, axis=-1)
    level = directions - sine[..., None] * zenith
    cosine = np.linalg.norm(level, axis=-1)
    z_vacuum = np.arctan2(cosine, sine)
    z_limit = np.minimum(z_vacuum, np.arccos(_LEAST_SINE))
    z = z_limit
    for _ in range(_NEWTON_STEPS):
        tangent = np.tan(z)
        excess = z + a * tangent + b * tangent**3 - z_limit
        z = z - excess / (1.0 + (a + 3.0 * b * tangent**2) * (1.0 + tangent**2))
    raised = z_limit - z
    # At the zenith itself there is no direction to be raised along, and nothing to raise.
    along = level / np.where(cosine > 0.0, cosine, 1.0)[..., None]
    seen = z_vacuum - raised
    return floats(np.cos(seen)[..., None] * zenith + np.sin(seen)[..., None] * along)


def altitude_deg(directions: FloatArray, zenith: FloatArray) -> FloatArray:
    """Altitude of directions above the horizon, degrees; shapes as for `refract`."""
    sine = np.sum(directions * zenith, axis=-1)
    altitude: FloatArray = np.degrees(
        np.arctan2(sine, np.linalg.norm(directions - sine[..., None] * zenith, axis=-1))
    )
    return altitude


def shrinking(altitude_seen_deg: FloatArray | float, constants: tuple[float, float]) -> FloatArray:
    """By which part of themselves refraction shrinks small angles, mean of vertical and horizontal.

    Vertically dR/dz = (A + 3 B tan^2 z) / cos^2 z, horizontally R / tan z = A + B tan^2 z. A focal
    length that is estimated without refraction is too short by this part.
    """
    a, b = constants
    squared = np.tan(np.radians(90.0 - floats(altitude_seen_deg))) ** 2
    return 0.5 * ((a + 3.0 * b * squared) * (1.0 + squared) + a + b * squared)
