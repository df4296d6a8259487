"""From catalogue directions to apparent ones: the Earth's velocity and the aberration of light.

An observer that moves with velocity v sees every star displaced towards v by up to v/c: 20.5 arcsec
for the Earth. The attitude absorbs the mean displacement of a frame; its change across the field
(3.6 arcsec over 10 degrees) stretches the star pattern and would otherwise end up in the focal
length.

An observer on the ground also moves with the Earth's rotation and looks through the air
(`starcal_uq.sky.site`).

Not modelled: the deflection of light by the Sun (4 mas at 90 degrees from the Sun, 15 mas at 30)
and annual parallax (0.75 arcsec for the nearest star, below 0.1 arcsec for all but a few dozen
stars of naked-eye brightness).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.constants import ARCSEC, AU_KM, LIGHT_SPEED_KM_S
from starcal_uq.core.errors import CatalogueError, ObservationError
from starcal_uq.core.findings import clause
from starcal_uq.core.formatting import plural
from starcal_uq.core.settings import bounded
from starcal_uq.core.times import julian_days
from starcal_uq.core.types import AnyDict, FloatArray, floats
from starcal_uq.sky.positions import ra_dec_deg, unit_vectors
from starcal_uq.sky.refraction import (
    LEAST_ALTITUDE_DEG,
    altitude_deg,
    refract,
    refraction_constants,
    shrinking,
    site_among_stars,
)
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

AU_PER_DAY_KM_S = AU_KM / 86400.0
# No spacecraft has exceeded 200 km/s; a velocity given in m/s does.
MAX_VELOCITY_KM_S = 1000.0
SUN_DISTANCE_AU = 1.0
# Faster than this relative to the Earth's centre, an observer is in space: the ground moves at 0.46
# km/s.
_IN_SPACE_KM_S = 1.0
_STARS_PER_FRAME = 4
# Hours by which a zone's time differs from UTC at most.
_ZONES = 14
# Where stars are that cannot have been seen.
Horizon = Enum("Horizon", "BELOW")


def earth_velocity_km_s(time_utc: Any) -> FloatArray:
    """Barycentric velocity of the Earth's centre, ICRS axes.

    Parameters
    ----------
    time_utc
        One UTC time or a sequence of them: ISO 8601 text ("2026-11-21T03:04:05.6", a trailing "Z"
        or an offset such as "+02:00" is understood), `datetime.datetime` or `numpy.datetime64`. A
        time without an offset is UTC.

    Returns
    -------
    ndarray, shape (3,) for one time, (n, 3) for a sequence
        Velocity in km/s, from `erfa.epv00` (a fit to DE405, good to 5 mm/s between 1900 and 2100).
        TT stands for TDB: their difference of 2 ms moves the velocity by 1e-8 km/s.

    Raises
    ------
    CatalogueError
        A time is not readable; the message quotes it and gives its place in the sequence, from 1.
    """
    import erfa

    days, _, inverse = julian_days(time_utc)
    _, barycentric = erfa.epv00(days[:, 0], days[:, 1])
    velocity = (floats(barycentric["v"]) * AU_PER_DAY_KM_S)[inverse]
    return velocity[0] if np.ndim(time_utc) == 0 else velocity


@bounded
def aberrate(directions: FloatArray, velocity_km_s: FloatArray | Sequence[float]) -> FloatArray:
    """Apparent directions for a moving observer: special-relativistic aberration.

    Parameters
    ----------
    directions
        Unit vectors of the stars for an observer at rest in the solar system's barycentre, shape
        (n, 3) or (3,).
    velocity_km_s
        The observer's barycentric velocity in the same axes, km/s, shape (3,) or one row for each
        direction.

    Returns
    -------
    ndarray, same shape as `directions`
        Unit vectors, from `erfa.ab`. Its gravitational term is that of an observer 1 au from the
        Sun, 0.4 micro-arcsec.

    Raises
    ------
    CatalogueError
        The velocity is not three finite numbers, or is too large to be meant in km/s.
    """
    import erfa

    velocity = (
        check_velocity(velocity_km_s, len(directions) if directions.ndim == 2 else None)
        / LIGHT_SPEED_KM_S
    )
    inverse_gamma = np.sqrt(1.0 - np.sum(velocity**2, axis=-1))
    return floats(erfa.ab(directions, velocity, SUN_DISTANCE_AU, inverse_gamma))


@bounded
def apparent_directions(
    directions: FloatArray,
    time_utc: Any,
    observer_velocity_km_s: FloatArray | Sequence[float] | None = None,
    site: Site | None = None,
) -> FloatArray:
    """Directions as a moving observer, or one at a site on the ground, sees them.

    Parameters
    ----------
    directions
        Unit vectors at the epoch of the observation, ICRS axes, shape (n, 3).
    time_utc
        One UTC time or n of them, as for `earth_velocity_km_s`.
    observer_velocity_km_s
        Velocity relative to the Earth's centre, ICRS axes, km/s, shape (3,) or (n, 3).
    site
        With a site its own velocity and the refraction of its air are added.

    Returns
    -------
    ndarray, shape (n, 3)
        Unit vectors, still along the ICRS axes: precession, nutation and the Earth's rotation are
        not applied, which only an attitude would notice.
    """
    velocity = earth_velocity_km_s(time_utc)
    if observer_velocity_km_s is not None:
        velocity = velocity + check_velocity(observer_velocity_km_s, len(directions))
    if site is None:
        return aberrate(directions, velocity)
    zenith, moving = site_among_stars(site, time_utc)
    return refract(aberrate(directions, velocity + moving), zenith, refraction_constants(site))


@bounded
def catalogue_directions(
    apparent: FloatArray,
    time_utc: Any,
    observer_velocity_km_s: FloatArray | Sequence[float] | None = None,
    site: Site | None = None,
) -> FloatArray:
    """The inverse of `apparent_directions`, by iteration.

    Parameters
    ----------
    apparent
        Unit vectors as seen, ICRS axes, shape (n, 3).
    time_utc, observer_velocity_km_s, site
        Times, velocity (km/s) and site as `apparent_directions` takes them.

    Returns
    -------
    ndarray, shape (n, 3)
        Unit vectors; good to 1e-4 arcsec from an altitude of ten degrees upwards.
    """
    directions = apparent
    for _ in range(4):
        directions = (
            directions
            + apparent
            - apparent_directions(directions, time_utc, observer_velocity_km_s, site)
        )
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return directions


@bounded
def make_apparent(
    obs: Observations,
    observer_velocity_km_s: FloatArray | Sequence[float] | None = None,
    site: Site | None = None,
) -> Observations:
    """Observations with directions as the moving observer saw them, from space or from the ground.

    Aberration is added, and refraction where there is a site: the catalogue directions must already
    be at the epoch of the observations.

    Parameters
    ----------
    obs
        Observations with a `time_utc` in every row, whose directions are those of a catalogue
        (undeclared ones are taken to be).
    observer_velocity_km_s
        Velocity relative to the Earth's centre, ICRS axes, km/s, shape (3,) or one row for each
        observation; zero by default. A low orbit adds 7.6 km/s (5 arcsec), a site on the ground at
        most 0.47 km/s (0.3 arcsec).
    site
        Place on the ground where the camera stood; it gives the velocity, so that none is given
        beside it.

    Returns
    -------
    Observations
        Rows as before; `origin.directions` is "apparent", `origin.observer_velocity_km_s` is the
        mean of the barycentric velocities that were applied, one for each row; `origin.observer`
        is "ground" with a site, "space" with a velocity above 1 km/s or where it said so, else
        "unknown". With a site, `origin.site` holds it and `origin.atmosphere` the air that was
        taken and what it does.

    Raises
    ------
    ObservationError
        The directions are apparent already, a time is missing or unreadable, or stars are below the
        horizon of the site or lower than ten degrees (`without_low_stars` leaves these out).
    CatalogueError
        The velocity is not usable.
    """
    if obs.origin.apparent:
        raise ObservationError(
            "The directions of these observations are apparent already; aberration would be "
            "applied twice, "
            'so leave out make_apparent or set meta["directions"] to "catalogue".'
        )
    if site is not None and observer_velocity_km_s is not None:
        raise ObservationError(
            "A site has a velocity of its own: give the site or the observer's velocity, not both."
        )
    velocity = _earth_velocity(obs)
    if observer_velocity_km_s is not None:
        own = check_velocity(observer_velocity_km_s, len(obs))
        velocity = velocity + own
    directions = unit_vectors(obs.ra_deg, obs.dec_deg)
    facts: AnyDict = {"directions": "apparent"}
    if site is None:
        seen = aberrate(directions, velocity)
        moving = (
            observer_velocity_km_s is not None
            and float(np.linalg.norm(own, axis=-1).max()) > _IN_SPACE_KM_S
        )
        known = obs.origin.observer if obs.origin.without_air else "unknown"
        facts["observer"] = "space" if moving else known
    else:
        altitude = _altitudes(obs, site, directions, velocity)
        low = altitude < LEAST_ALTITUDE_DEG
        if low.any():
            raise ObservationError(
                f"{plural(int(low.sum()), 'star')} {'is' if low.sum() == 1 else 'are'} lower than "
                f"{LEAST_ALTITUDE_DEG:g} degrees (the first in frame {obs.frame[low][0]}), where "
                "refraction is not "
                "known well enough; leave them out with without_low_stars.",
                column="time_utc",
            )
        zenith, moved = site_among_stars(site, obs.time_utc)
        velocity = velocity + moved
        constants = refraction_constants(site)
        seen = refract(aberrate(directions, velocity), zenith, constants)
        facts |= {
            "observer": "ground",
            "site": site.to_dict(),
            "atmosphere": _atmosphere(site, constants, altitude),
        }
    ra, dec = ra_dec_deg(seen)
    facts["observer_velocity_km_s"] = velocity.mean(axis=0).tolist()
    return replace(obs, ra_deg=ra, dec_deg=dec).with_origin(**facts)


@bounded
def without_low_stars(
    obs: Observations, site: Site, least_altitude_deg: float = LEAST_ALTITUDE_DEG
) -> Observations:
    """Stars above a minimum altitude at a site, in frames that keep at least four.

    Parameters
    ----------
    obs
        Observations with catalogue directions and a `time_utc` in every row.
    site
        Place on the ground where the camera stood.
    least_altitude_deg
        Altitude as seen, refraction included.

    Returns
    -------
    Observations
        The other rows; `origin.low_stars` says how many were left out.

    Raises
    ------
    ObservationError
        A time is missing or unreadable, or a frame shows stars that were below the horizon: then
        the site, the time or the identification is wrong.
    """
    altitude = _altitudes(obs, site, unit_vectors(obs.ra_deg, obs.dec_deg), _earth_velocity(obs))
    kept = obs.select(altitude >= least_altitude_deg)
    kept = kept.select_frames(kept.frame_ids[kept.stars_per_frame >= _STARS_PER_FRAME])
    if not kept.n_stars:
        raise ObservationError(
            f"No frame has {_STARS_PER_FRAME} stars higher than {least_altitude_deg:g} degrees "
            f"at the site ({site}), "
            "below which refraction is not known well enough: take images of higher stars."
        )
    return kept.with_origin(low_stars=obs.n_stars - kept.n_stars)


def _earth_velocity(obs: Observations) -> FloatArray:
    if obs.time_utc is None:
        raise ObservationError(
            "The observations have no column 'time_utc', which the Earth's velocity depends on; "
            "add it "
            "(UTC, such as 2026-11-21T03:04:05) or give directions that are apparent already.",
            column="time_utc",
        )
    try:
        return earth_velocity_km_s(obs.time_utc)
    except CatalogueError as error:
        raise ObservationError(f"Column 'time_utc': {error}", column="time_utc") from error


def _altitudes(
    obs: Observations, site: Site, directions: FloatArray, velocity: FloatArray
) -> FloatArray:
    """Altitude of every star as seen, degrees; an error where a frame's stars were below the
    horizon.
    """
    starts = np.searchsorted(obs.frame, obs.frame_ids)

    def seen_from(place: Site) -> tuple[FloatArray, FloatArray]:
        """Altitude of the stars, and their mean in each frame."""
        zenith, moving = site_among_stars(place, obs.time_utc)
        seen = refract(aberrate(directions, velocity + moving), zenith, refraction_constants(site))
        altitude = altitude_deg(seen, zenith)
        return altitude, np.add.reduceat(altitude, starts) / obs.stars_per_frame

    if not obs.n_stars:
        return np.empty(0)
    altitude, mean = seen_from(site)
    below = np.flatnonzero(mean < 0.0)
    if len(below):
        first = below[0]
        # Times of a zone that were taken for UTC are off by hours, and no frame was taken through
        # the ground.
        zones = sorted(range(-_ZONES, _ZONES + 1), key=abs)
        hours = next(
            (h for h in zones if seen_from(site.later(h))[1].min() > LEAST_ALTITUDE_DEG), None
        )
        facts: AnyDict = {
            "frame": obs.frame_ids[first],
            "others": len(below) - 1,
            "below_deg": -mean[first],
            "site": site,
            "time_utc": None if obs.time_utc is None else obs.time_utc[starts[first]],
            "hours": hours,
        }
        raise ObservationError(clause(Horizon.BELOW, **facts), column="time_utc")
    return altitude


def _atmosphere(site: Site, constants: tuple[float, float], altitude: FloatArray) -> AnyDict:
    """What was taken for the air, and what it does, in plain values."""
    return {
        "pressure_hpa": site.air_pressure_hpa,
        "temperature_c": site.air_temperature_c,
        "relative_humidity": site.relative_humidity,
        "wavelength_um": site.wavelength_um,
        "assumed": list(site.assumed),
        "refraction_a_arcsec": constants[0] * ARCSEC,
        "refraction_b_arcsec": constants[1] * ARCSEC,
        "altitude_min_deg": float(altitude.min(initial=90.0)),
        "altitude_max_deg": float(altitude.max(initial=0.0)),
        "shrinking": float(np.mean(shrinking(altitude, constants))) if len(altitude) else 0.0,
    }


def check_velocity(
    velocity_km_s: FloatArray | Sequence[float], rows: int | None = None
) -> FloatArray:
    """The velocity as an array, or a CatalogueError that says what is wrong with it.

    Its shape must be (3,), or (rows, 3) where `rows` directions are given.
    """
    try:
        velocity = floats(velocity_km_s)
    except (TypeError, ValueError):
        velocity = np.empty(0)
    shapes: tuple[tuple[int, ...], ...] = ((3,),) if rows is None else ((3,), (rows, 3))
    if velocity.shape not in shapes or not np.isfinite(velocity).all():
        raise CatalogueError(
            "The observer's velocity must be three finite numbers in km/s (ICRS axes)"
            + (f", or {rows} rows of them" if rows is not None else "")
            + f"; it is {np.array2string(np.asarray(velocity_km_s), threshold=6)}."
        )
    fastest = float(np.sqrt((velocity**2).sum(axis=-1)).max(initial=0.0))
    if fastest > MAX_VELOCITY_KM_S:
        raise CatalogueError(
            f"An observer's velocity of {fastest:.6g} km/s is not believable; was it in m/s?"
        )
    return velocity
