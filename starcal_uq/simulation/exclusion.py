"""Where a tracker cannot look: too near to the Sun, the Moon or the Earth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.core.constants import AU_KM
from starcal_uq.core.errors import SensorError
from starcal_uq.core.times import julian_days
from starcal_uq.core.types import BoolArray, FloatArray, floats
from starcal_uq.simulation.sensor import Sensor

_EARTH_RADIUS_KM = 6378.137


@dataclass(frozen=True)
class Exclusion:
    """Cones of the sky that a boresight keeps out of. B bodies.

    Attributes
    ----------
    bodies : tuple of str
        What is in the middle of each cone: ``sun``, ``moon``, ``earth``.
    directions : tuple of (float, float, float)
        Unit vectors towards the bodies as the spacecraft sees them, ICRS axes.
    angles_deg : tuple of float
        Half-angles of the cones; that of the Earth holds its disc.
    """

    bodies: tuple[str, ...]
    directions: tuple[tuple[float, ...], ...]
    angles_deg: tuple[float, ...]

    @classmethod
    def of(
        cls, sensor: Sensor, time_utc: Any = None, position_km: Sequence[float] | None = None
    ) -> Exclusion | None:
        """The exclusion of a sensor at one time and place; None for a sensor that may look anywhere.

        Positions are those of `erfa.epv00` and `erfa.moon98`, without the time that light takes:
        good to 0.01 degrees.

        Parameters
        ----------
        sensor : Sensor
            Angles from the centres of Sun and Moon, and from the limb of the Earth.
        time_utc : str or datetime, optional
            UTC; needed for the Sun and the Moon.
        position_km : (3,) sequence, optional
            The spacecraft from the Earth's centre, ICRS axes, km; needed for the Earth. Without
            it, Sun and Moon are seen from the centre: the Moon is up to a degree elsewhere from a
            low orbit.

        Raises
        ------
        SensorError
            When an angle needs a time or a position that is not given, or the position lies inside
            the Earth.
        CatalogueError
            For a time that is not readable.
        """
        needs = {
            "sun": ("time_utc", time_utc),
            "moon": ("time_utc", time_utc),
            "earth": ("position_km", position_km),
        }
        wanted = {name: float(getattr(sensor, f"{name}_exclusion_deg")) for name in needs}
        wanted = {name: angle for name, angle in wanted.items() if angle > 0.0}
        for name, angle in wanted.items():
            key, given = needs[name]
            if given is None:
                raise SensorError(
                    f"sensor: {name}_exclusion_deg is {angle:g} and needs {key}; state it, or set "
                    f"{name}_exclusion_deg = 0."
                )
        if not wanted:
            return None
        place = np.zeros(3) if position_km is None else floats(position_km)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise SensorError(f"sensor: position_km is {position_km!r}; give three numbers in km.")
        centres = {"earth": np.zeros(3)} if time_utc is None else _centres_km(time_utc)
        angles = dict(wanted)
        if "earth" in wanted:
            distance_km = float(np.linalg.norm(place))
            if distance_km <= _EARTH_RADIUS_KM:
                raise SensorError(
                    f"sensor: position_km is {distance_km:.0f} km from the Earth's centre, below "
                    "its surface; give x, y and z in km from the centre, such as 6878, 0, 0."
                )
            angles["earth"] += math.degrees(math.asin(_EARTH_RADIUS_KM / distance_km))
        seen = [centres[name] - place for name in wanted]
        return cls(
            tuple(wanted),
            tuple(tuple((at / np.linalg.norm(at)).tolist()) for at in seen),
            tuple(angles.values()),
        )

    def inside(self, rotations: FloatArray) -> BoolArray:
        """True where the boresight of an attitude R_cam_icrs (n, 3, 3) lies in a cone, (n, B)."""
        cosine = rotations[:, 2] @ np.array(self.directions).T
        return np.asarray(cosine > np.cos(np.radians(self.angles_deg)))


def _centres_km(time_utc: Any) -> dict[str, FloatArray]:
    """Sun, Moon and Earth from the Earth's centre, ICRS axes, km."""
    import erfa

    days, _, _ = julian_days(time_utc)
    tt = float(days[0, 0]), float(days[0, 1])
    heliocentric, _ = erfa.epv00(*tt)
    return {
        "sun": -AU_KM * floats(heliocentric["p"]),
        "moon": AU_KM * floats(erfa.moon98(*tt)["p"]),
        "earth": np.zeros(3),
    }
