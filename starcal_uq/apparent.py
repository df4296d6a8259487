"""From catalogue directions to apparent ones: the Earth's velocity and the aberration of light.

An observer that moves with velocity v sees every star displaced towards v by up to v/c: 20.5 arcsec for the Earth.
The attitude absorbs the mean displacement of a frame; its change across the field (3.6 arcsec over 10 degrees)
stretches the star pattern and would otherwise end up in the focal length.

Not modelled: the deflection of light by the Sun (4 mas at 90 degrees from the Sun, 15 mas at 30), annual parallax
(0.75 arcsec for the nearest star, below 0.1 arcsec for all but a few dozen stars of naked-eye brightness) and
refraction.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq._types import FloatArray
from starcal_uq.directions import ra_dec_deg, unit_vectors
from starcal_uq.errors import CatalogueError, ObservationError

if TYPE_CHECKING:
    from starcal_uq.observations import Observations

LIGHT_SPEED_KM_S = 299792.458
AU_PER_DAY_KM_S = 149597870.7 / 86400.0
# No spacecraft has exceeded 200 km/s; a velocity given in m/s does.
MAX_VELOCITY_KM_S = 1000.0
SUN_DISTANCE_AU = 1.0
FIRST_YEAR, LAST_YEAR = 1960, 2100

_ISO = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)(?:[T ](\d\d):(\d\d)(?::(\d\d(?:\.\d*)?))?)?\s*(Z|UTC|[+-]\d\d:?\d\d)?", re.ASCII
)


def earth_velocity_km_s(time_utc: Any) -> FloatArray:
    """Barycentric velocity of the Earth's centre, ICRS axes.

    Parameters
    ----------
    time_utc
        One UTC time or a sequence of them: ISO 8601 text ("2026-11-21T03:04:05.6", a trailing "Z" or an offset such
        as "+02:00" is understood), `datetime.datetime` or `numpy.datetime64`. A time without an offset is UTC.

    Returns
    -------
    ndarray, shape (3,) for one time, (n, 3) for a sequence
        Velocity in km/s, from `erfa.epv00` (a fit to DE405, good to 5 mm/s between 1900 and 2100). TT stands for
        TDB: their difference of 2 ms moves the velocity by 1e-8 km/s.

    Raises
    ------
    CatalogueError
        A time is not readable; the message quotes it and gives its place in the sequence, from 1.
    """
    import erfa

    times = np.atleast_1d(np.asarray(time_utc))
    # A table of observations repeats one time for every star of a frame.
    unique, inverse = np.unique(times.astype(str), return_inverse=True)
    days = np.array([_terrestrial_time(str(text), times) for text in unique], dtype=np.float64).reshape(-1, 2)
    _, barycentric = erfa.epv00(days[:, 0], days[:, 1])
    velocity = np.asarray(barycentric["v"], dtype=np.float64) * AU_PER_DAY_KM_S
    velocity = velocity[inverse.reshape(-1)]
    return velocity[0] if np.ndim(time_utc) == 0 else velocity


def julian_year(time_utc: Any) -> float:
    """Mean of some UTC times as a Julian year, for the epoch of a catalogue.

    Parameters
    ----------
    time_utc
        As for `earth_velocity_km_s`.

    Raises
    ------
    CatalogueError
        As `earth_velocity_km_s`.
    """
    times = np.atleast_1d(np.asarray(time_utc))
    days = [sum(_terrestrial_time(str(text), times)) for text in times.astype(str)]
    return float(2000.0 + (np.mean(days) - 2451545.0) / 365.25)


def aberrate(directions: FloatArray, velocity_km_s: FloatArray | Sequence[float]) -> FloatArray:
    """Apparent directions for a moving observer: special-relativistic aberration.

    Parameters
    ----------
    directions
        Unit vectors of the stars for an observer at rest in the solar system's barycentre, shape (n, 3) or (3,).
    velocity_km_s
        The observer's barycentric velocity in the same axes, km/s, shape (3,) or one row for each direction.

    Returns
    -------
    ndarray, same shape as `directions`
        Unit vectors, from `erfa.ab`. Its gravitational term is that of an observer 1 au from the Sun, 0.4
        micro-arcsec.

    Raises
    ------
    CatalogueError
        The velocity is not three finite numbers, or is too large to be meant in km/s.
    """
    import erfa

    velocity = check_velocity(velocity_km_s, len(directions) if directions.ndim == 2 else None) / LIGHT_SPEED_KM_S
    inverse_gamma = np.sqrt(1.0 - np.sum(velocity**2, axis=-1))
    return np.asarray(erfa.ab(directions, velocity, SUN_DISTANCE_AU, inverse_gamma), dtype=np.float64)


def make_apparent(
    obs: Observations, observer_velocity_km_s: FloatArray | Sequence[float] | None = None
) -> Observations:
    """Observations with directions as the moving observer saw them.

    Only aberration is added: the catalogue directions must already be at the epoch of the observations.

    Parameters
    ----------
    obs
        Observations with a `time_utc` in every row, whose directions are those of a catalogue (undeclared ones are
        taken to be).
    observer_velocity_km_s
        Velocity relative to the Earth's centre, ICRS axes, km/s, shape (3,) or one row for each observation; zero by
        default. A low orbit adds 7.6 km/s (5 arcsec), a site on the ground at most 0.47 km/s (0.3 arcsec).

    Returns
    -------
    Observations
        The same rows; `meta["directions"]` is "apparent", `meta["observer_velocity_km_s"]` is the mean of the
        barycentric velocities that were applied, one for each row.

    Raises
    ------
    ObservationError
        The directions are apparent already, or a time is missing or unreadable.
    CatalogueError
        The velocity is not usable.
    """
    if obs.meta.get("directions") == "apparent":
        raise ObservationError(
            "The directions of these observations are apparent already; aberration would be applied twice, "
            'so leave out make_apparent or set meta["directions"] to "catalogue".'
        )
    if obs.time_utc is None:
        raise ObservationError(
            "The observations have no column 'time_utc', which the Earth's velocity depends on; add it "
            "(UTC, such as 2026-11-21T03:04:05) or give directions that are apparent already.",
            column="time_utc",
        )
    try:
        velocity = earth_velocity_km_s(obs.time_utc)
    except CatalogueError as error:
        raise ObservationError(f"Column 'time_utc': {error}", column="time_utc") from error
    if observer_velocity_km_s is not None:
        velocity = velocity + check_velocity(observer_velocity_km_s, len(obs))
    ra, dec = ra_dec_deg(aberrate(unit_vectors(obs.ra_deg, obs.dec_deg), velocity))
    mean = [float(component) for component in velocity.mean(axis=0)]
    return replace(
        obs, ra_deg=ra, dec_deg=dec, meta={**obs.meta, "directions": "apparent", "observer_velocity_km_s": mean}
    )


def check_velocity(velocity_km_s: FloatArray | Sequence[float], rows: int | None = None) -> FloatArray:
    """The velocity as an array, or a CatalogueError that says what is wrong with it.

    Its shape must be (3,), or (rows, 3) where `rows` directions are given.
    """
    try:
        velocity = np.asarray(velocity_km_s, dtype=np.float64)
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
        raise CatalogueError(f"An observer's velocity of {fastest:.6g} km/s is not believable; was it in m/s?")
    return velocity


def _terrestrial_time(text: str, times: Any) -> tuple[float, float]:
    """Two-part Julian date, TT, of one UTC time."""
    import erfa

    match = _ISO.fullmatch(text.strip())
    try:
        if match is None:
            raise ValueError("not ISO 8601")
        if not FIRST_YEAR <= int(match[1]) <= LAST_YEAR:
            raise ValueError("outside the years of UTC and of the Earth's ephemeris")
        year, month, day, hour, minute = (int(group or 0) for group in match.groups()[:5])
        second = float(match[6] or 0.0)
        with warnings.catch_warnings():
            # "Dubious year": leap seconds of the future are not known; ten of them change the velocity by 6e-5 km/s.
            # "Time is after end of day" and the like are errors of the input.
            warnings.simplefilter("error", erfa.ErfaWarning)
            warnings.filterwarnings("ignore", message=".*dubious year", category=erfa.ErfaWarning)
            utc = erfa.dtf2d("UTC", year, month, day, hour, minute, second)
            tt1, tt2 = erfa.taitt(*erfa.utctai(*utc))
    except (ValueError, erfa.ErfaError, erfa.ErfaWarning) as error:
        place = int(np.flatnonzero(times.astype(str) == text)[0]) + 1
        raise CatalogueError(
            f"The time {text!r} (number {place}) is not a UTC time between {FIRST_YEAR} and {LAST_YEAR}; "
            "write it as 2026-11-21T03:04:05.6."
        ) from error
    return float(tt1), float(tt2) - _offset_days(match[7])


def _offset_days(zone: str | None) -> float:
    """Offset of a local time from UTC, days east positive."""
    if zone is None or zone[0] not in "+-":
        return 0.0
    digits = zone[1:].replace(":", "")
    minutes = 60 * int(digits[:2]) + int(digits[2:])
    return (minutes if zone[0] == "+" else -minutes) / 1440.0
