"""Where on the ground a camera stood, and the air above it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from starcal_uq.core.errors import SiteError
from starcal_uq.core.toml import Key, Section, read_section, write_section
from starcal_uq.core.types import AnyDict, AnyMapping, PathLike

# By which a place turns among the stars in an hour.
HOUR_DEG = 15.041067
_HEADER = """\
# Site of a camera on the ground.
#
# latitude_deg, longitude_deg: geodetic (as maps and GPS give them); north and east are positive.
# height_m: above the ellipsoid or the sea. pressure_hpa: at the site itself, not reduced to sea level.
# temperature_c: of the air. Without pressure or temperature, those of the standard atmosphere at this height.
# relative_humidity: 0 to 1. wavelength_um: effective wavelength of lens and detector, micrometres.

"""
_SECTION = Section(
    {
        "latitude_deg": Key(
            float,
            "the latitude in degrees, north positive, from -90 to 90",
            required=True,
            ge=-90.0,
            le=90.0,
        ),
        "longitude_deg": Key(
            float,
            "the longitude in degrees, east positive, from -180 to 360",
            required=True,
            ge=-180.0,
            le=360.0,
        ),
        "height_m": Key(float, "the height in metres, from -500 to 9000", ge=-500.0, le=9000.0),
        "pressure_hpa": Key(
            float | None,
            "the pressure at the site in hPa, from 200 to 1100, or leave it out",
            ge=200.0,
            le=1100.0,
        ),
        "temperature_c": Key(
            float | None,
            "the temperature in degrees Celsius, from -90 to 60, or leave it out",
            ge=-90.0,
            le=60.0,
        ),
        "relative_humidity": Key(float, "the relative humidity, from 0 to 1", ge=0.0, le=1.0),
        "wavelength_um": Key(
            float, "the effective wavelength in micrometres, from 0.3 to 2.5", ge=0.3, le=2.5
        ),
        "name": Key(str, "a name in quotes"),
    },
    SiteError,
)


@dataclass(frozen=True)
class Site:
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
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    pressure_hpa: float | None = None
    temperature_c: float | None = None
    relative_humidity: float = 0.5
    wavelength_um: float = 0.6
    name: str = ""

    def __post_init__(self) -> None:
        table = {name: value for name, value in vars(self).items() if value is not None}
        for name, value in _SECTION.check(table, "site").items():
            object.__setattr__(self, name, value)

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
        """What of pressure and temperature is that of the standard atmosphere."""
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
        """The place that has the sky of so many hours later: one further east."""
        return replace(
            self, longitude_deg=(self.longitude_deg + HOUR_DEG * hours + 180.0) % 360.0 - 180.0
        )

    def __str__(self) -> str:
        return f"{self.name + ', ' if self.name else ''}{self.words}, {self.height_m:.0f} m"

    def to_dict(self) -> AnyDict:
        """Keys and values of a [site] table; what is not given is left out."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def from_dict(cls, table: AnyMapping) -> Site:
        """From keys and values of a [site] table.

        Raises
        ------
        SiteError
            For the reasons that `load` has.
        """
        return cls(**_SECTION.check(table, "site"))

    @classmethod
    def load(cls, path: PathLike) -> Site:
        """From a TOML file with a [site] table.

        Raises
        ------
        SiteError
            If the file cannot be read, is no TOML, has no [site] table, or a key is missing,
            unknown or wrong.
        """
        return cls(
            **_SECTION.check(read_section(path, "site", SiteError), f"{path}, section [site]")
        )

    def save(self, path: PathLike, force: bool = False) -> None:
        """Write a TOML file without loss of digits.

        Raises
        ------
        RunFolderError
            If the file exists and `force` is false, or cannot be written.
        """
        write_section(path, "site", self.to_dict(), _HEADER, force)


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
