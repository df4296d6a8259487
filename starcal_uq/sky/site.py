"""Where on the ground a camera stood, and the air above it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from starcal_uq.core.errors import SiteError
from starcal_uq.core.toml import Section, Stated

# By which a place turns among the stars in an hour.
HOUR_DEG = 15.041067


@dataclass(frozen=True)
class Site(Stated):
    """A place on the ground and the air above it.

    Attributes
    ----------
    latitude_deg, longitude_deg : float
        Geodetic, degrees; north and east are positive.
    height_m : float
        Height, metres.
    pressure_hpa : float or None
        Pressure at the site (not reduced to sea level), hPa; None for that of the standard
        atmosphere.
    temperature_c : float or None
        Temperature of the air, Celsius; None for that of the standard atmosphere.
    relative_humidity : float
        0 to 1. Between dry and wet air refraction differs by 0.2 %.
    wavelength_um : float
        Effective wavelength, micrometres. From 0.5 to 0.7 refraction changes by 1.1 %.
    name : str
        A name, for reports.

    Raises
    ------
    SiteError
        If a value is no number or out of range.
    SettingError
        If a quantity of astropy is of another kind.
    """

    SECTION = Section.of_data(__package__, "site", SiteError)

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    pressure_hpa: float | None = None
    temperature_c: float | None = None
    relative_humidity: float = 0.5
    wavelength_um: float = 0.6
    name: str = ""

    @classmethod
    def of(cls, place: Any) -> Site | None:
        """A site from one, from the path of its file, or from astropy's `EarthLocation`; None for
        none.
        """
        if hasattr(place, "geodetic"):
            return cls(place.lat, place.lon, place.height)
        return place if place is None or isinstance(place, Site) else cls.load(place)

    @property
    def air_pressure_hpa(self) -> float:
        """Pressure, hPa: as given, or that of the International Standard Atmosphere at the site's
        height.
        """
        if self.pressure_hpa is not None:
            return self.pressure_hpa
        return float(1013.25 * (1.0 - 2.25577e-5 * self.height_m) ** 5.25588)

    @property
    def air_temperature_c(self) -> float:
        """Temperature, Celsius: as given, or that of the International Standard Atmosphere at the
        site's height.
        """
        return 15.0 - 0.0065 * self.height_m if self.temperature_c is None else self.temperature_c

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of pressure and temperature, as far as the standard atmosphere replaces them."""
        given = {"pressure": self.pressure_hpa, "temperature": self.temperature_c}
        return tuple(name for name, value in given.items() if value is None)

    @property
    def words(self) -> str:
        """Latitude and longitude."""
        north, east = self.latitude_deg, (self.longitude_deg + 180.0) % 360.0 - 180.0
        return (
            f"{abs(north):.2f}° {'N' if north >= 0 else 'S'}, {abs(east):.2f}° "
            f"{'E' if east >= 0 else 'W'}"
        )

    def later(self, hours: float) -> Site:
        """Place further east that has the sky of some hours later."""
        return replace(
            self, longitude_deg=(self.longitude_deg + HOUR_DEG * hours + 180.0) % 360.0 - 180.0
        )

    def __str__(self) -> str:
        return f"{self.name + ', ' if self.name else ''}{self.words}, {self.height_m:.0f} m"


def check_sky(directions: str | None, site: Site | None, in_space: bool) -> None:
    """Refuse a site together with what contradicts it."""
    if site is not None and in_space:
        raise SiteError("A camera in space has no site on the ground: give one or the other.")
    if site is not None and directions not in (None, "catalogue"):
        raise SiteError(
            f"With a site the directions are made apparent, but they are declared {directions}: "
            "leave out the site or "
            "the declaration."
        )
