"""UTC times as text to two-part Julian dates."""

from __future__ import annotations

import re
import warnings
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.files import shown
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.core.units import plain

FIRST_YEAR, LAST_YEAR = 1960, 2100
_EXAMPLE = "2026-11-21T03:04:05.6"
# How images of several nights are given theirs.
TIMES_IN_NAMES = "where they differ a time in each file's name (2026-11-21T030405_1.fits)"

# Scales that are UTC within 0.9 s, and seconds by which others are ahead of TAI; barycentric time
# is TT within 2 ms.
_UTC_NAMES = ("UTC", "UT", "UT1", "GMT")
_AHEAD_OF_TAI_S = {
    "TAI": 0.0,
    "IAT": 0.0,
    "GPS": -19.0,
    "TT": 32.184,
    "TDT": 32.184,
    "ET": 32.184,
    "TDB": 32.184,
}

_ISO = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)(?:[T ](\d\d):(\d\d)(?::(\d\d(?:\.\d*)?))?)?\s*(Z|UTC|[+-]\d\d:?\d\d)?",
    re.ASCII,
)


def julian_days(
    time_utc: Any, ut1_minus_utc_s: float = 0.0
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Two-part Julian dates TT and UT1 (m, 2) of the different times among n, and which of them
    each time is (n,).

    A time is ISO 8601 text ("2026-11-21T03:04:05.6", a trailing "Z" or an offset such as "+02:00"
    is understood), `datetime.datetime` or `numpy.datetime64`, UTC without an offset, or a `Time` of
    astropy. CatalogueError quotes one that is not readable, with its place among several, from 1.
    """
    times = plain("time_utc", time_utc)
    if not isinstance(times, Texts):
        times = Texts.of(np.ravel(times).astype(str))
    days = np.array(
        [_days(text, times, ut1_minus_utc_s) for text in times.names.tolist()], dtype=np.float64
    ).reshape(-1, 2, 2)
    return days[:, 0], days[:, 1], times.codes.astype(np.int64)


def julian_year(time_utc: Any) -> float:
    """Mean of some UTC times (ISO 8601) as a Julian year, for the epoch of a catalogue."""
    tt, _, inverse = julian_days(time_utc)
    return float(2000.0 + (np.mean(tt.sum(axis=1)[inverse]) - 2451545.0) / 365.25)


def utc_text(time: Any) -> str:
    """One UTC time (text, datetime or astropy Time) as tables hold it, YYYY-MM-DDTHH:MM:SS[.f]; an
    offset such as "+02:00" is taken out.

    CatalogueError quotes one that is not readable, or a date alone.
    """
    time = str(plain("time", time))
    match = _ISO.fullmatch(time.strip())
    if match is not None and match[4] is None and match[7] is None:
        # Dates that do not exist are named as such.
        julian_days(time)
        raise CatalogueError(
            f"The time {shown(time)} is a date without a time of day; write it as {_EXAMPLE}."
        )
    try:
        if match is None or match[4] is None:
            raise ValueError("not ISO 8601")
        # Seconds stay text: a leap second is none to datetime.
        minute = datetime(*(int(group) for group in match.groups()[:5]))  # type: ignore[arg-type]
        minute -= timedelta(days=_offset_days(match[7]))
    except (ValueError, OverflowError) as error:
        raise _unreadable(time) from error
    text = f"{minute.isoformat(timespec='minutes')}:{(match[6] or '00').rstrip('.')}"
    try:
        julian_days(text)
    except CatalogueError as error:
        raise _unreadable(time) from error
    return text


def utc_of_scale(time: datetime, scale: str) -> datetime:
    """UTC of a time without zone in another scale, such as TAI or TT; ValueError for an unknown
    one.
    """
    import erfa

    if scale in _UTC_NAMES:
        return time
    if scale not in _AHEAD_OF_TAI_S:
        raise ValueError(scale)
    tai = time - timedelta(seconds=_AHEAD_OF_TAI_S[scale])
    second = tai.second + 1e-6 * tai.microsecond
    days = erfa.dtf2d("TAI", tai.year, tai.month, tai.day, tai.hour, tai.minute, second)
    with warnings.catch_warnings():
        # Leap seconds of the future are not known.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        utc = erfa.taiutc(*days)
    return tai - timedelta(seconds=round(86400.0 * float(np.subtract(days, utc).sum()), 3))


def _unreadable(text: str, place: str = "") -> CatalogueError:
    years = f"between {FIRST_YEAR} and {LAST_YEAR}"
    return CatalogueError(
        f"The time {shown(text)}{place} is not a UTC time {years}; write it as {_EXAMPLE}."
    )


def _days(
    text: str, times: Any, ut1_minus_utc_s: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two-part Julian dates, TT and UT1, of one UTC time."""
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
            # "Dubious year": leap seconds of the future are not known; ten of them change the
            # Earth's velocity by 6e-5 km/s. "Time is after end of day" and the like are errors of
            # the input.
            warnings.simplefilter("error", erfa.ErfaWarning)
            warnings.filterwarnings("ignore", message=".*dubious year", category=erfa.ErfaWarning)
            utc = erfa.dtf2d("UTC", year, month, day, hour, minute, second)
            tt1, tt2 = erfa.taitt(*erfa.utctai(*utc))
            ut1, ut2 = erfa.utcut1(*utc, ut1_minus_utc_s)
    except (ValueError, erfa.ErfaError, erfa.ErfaWarning) as error:
        place = int(np.flatnonzero(times == text)[0]) + 1
        raise _unreadable(text, f" (number {place})" if len(times) > 1 else "") from error
    offset = _offset_days(match[7])
    return (float(tt1), float(tt2) - offset), (float(ut1), float(ut2) - offset)


def _offset_days(zone: str | None) -> float:
    """Offset of a local time from UTC, days east positive."""
    if zone is None or zone[0] not in "+-":
        return 0.0
    digits = zone[1:].replace(":", "")
    minutes = 60 * int(digits[:2]) + int(digits[2:])
    return (minutes if zone[0] == "+" else -minutes) / 1440.0
