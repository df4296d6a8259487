"""Where a tracker looks when Sun, Moon and Earth are in the way, beside an almanac of a few lines."""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.core.errors import CatalogueError, SensorError
from starcal_uq.simulation.exclusion import Exclusion
from starcal_uq.simulation.frames import Tracker
from starcal_uq.simulation.sensor import Sensor
from starcal_uq.studies import StudyDefinition
from starcal_uq.studies.geometry import Heaven, geometry_key, take_frames

SHEET = sc.Camera(1024, 1024, 10.0, 36.0, 511.5, 511.5, "none", ())
TIME = "2026-11-26T12:00:00"
# Days since 2000-01-01T12:00 of that time.
DAYS = 9826.0


def on_ecliptic(longitude_deg: float, latitude_deg: float) -> np.ndarray:
    """Unit vector in equatorial axes of 2000, for a longitude of date."""
    lam = np.radians(longitude_deg - 1.397 * DAYS / 36525.0)
    beta, eps = np.radians(latitude_deg), np.radians(23.4393)
    x, y, z = np.cos(beta) * np.cos(lam), np.cos(beta) * np.sin(lam), np.sin(beta)
    return np.array([x, np.cos(eps) * y - np.sin(eps) * z, np.sin(eps) * y + np.cos(eps) * z])


def sun() -> np.ndarray:
    """The Astronomical Almanac's low-precision Sun, good to 0.01 degrees."""
    g = np.radians(357.528 + 0.9856003 * DAYS)
    longitude = 280.460 + 0.9856474 * DAYS + 1.915 * np.sin(g) + 0.020 * np.sin(2.0 * g)
    return on_ecliptic(longitude, 0.0)


def moon() -> np.ndarray:
    """The Astronomical Almanac's low-precision Moon, good to 0.3 degrees."""
    t = DAYS / 36525.0
    terms = (
        (6.29, 135.0, 477198.87),
        (-1.27, 259.3, -413335.36),
        (0.66, 235.7, 890534.22),
        (0.21, 269.9, 954397.74),
        (-0.19, 357.5, 35999.05),
        (-0.11, 186.5, 966404.03),
    )
    longitude = (
        218.32 + 481267.881 * t + sum(a * np.sin(np.radians(b + c * t)) for a, b, c in terms)
    )
    terms = ((5.13, 93.3, 483202.02), (0.28, 228.2, 960400.89), (-0.28, 318.3, 6003.15))
    latitude = sum(a * np.sin(np.radians(b + c * t)) for a, b, c in terms)
    latitude -= 0.17 * np.sin(np.radians(217.6 - 407332.21 * t))
    return on_ecliptic(longitude, latitude)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))


def baffle(**changes: float) -> Exclusion:
    found = Exclusion.of(Sensor(sun_exclusion_deg=40.0, moon_exclusion_deg=20.0, **changes), TIME)
    assert found is not None
    return found


def test_sun_and_moon_are_where_an_almanac_has_them() -> None:
    found = baffle()
    assert found.bodies == ("sun", "moon") and found.angles_deg == (40.0, 20.0)
    assert angle_deg(np.array(found.directions[0]), sun()) < 0.03
    assert angle_deg(np.array(found.directions[1]), moon()) < 0.5


def test_the_earth_is_excluded_from_its_limb() -> None:
    place = np.array([0.0, 6878.137, 0.0])
    found = Exclusion.of(Sensor(earth_exclusion_deg=25.0), position_km=place)
    assert found is not None and found.directions == ((0.0, -1.0, 0.0),)
    # The limb seen from 500 km stands 68 degrees from the nadir.
    assert found.angles_deg[0] == pytest.approx(25.0 + np.degrees(np.arcsin(6378.137 / 6878.137)))
    with pytest.raises(SensorError):
        Exclusion.of(Sensor(earth_exclusion_deg=25.0), position_km=[0.0, 500.0, 0.0])


def test_no_frame_is_taken_beside_sun_or_moon() -> None:
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    free, _ = Tracker(SHEET, min_stars=5).frames(stars, np.random.default_rng(1), 300)
    kept, frames = Tracker(SHEET, min_stars=5, exclusion=baffle()).frames(
        stars, np.random.default_rng(1), 300
    )
    for body, angle in ((sun(), 40.5), (moon(), 20.5)):
        assert angle_deg(kept[:, 2], body).min() > angle - 1.0
        # Control: without exclusion some frames look there.
        assert angle_deg(free[:, 2], body).min() < angle - 5.0
    assert all(len(index) >= 5 for index, _ in frames)
    # Frames that were allowed are the same ones.
    allowed = (angle_deg(free[:, 2], sun()) > 41.0) & (angle_deg(free[:, 2], moon()) > 21.0)
    assert np.abs(free[allowed][:50, None] - kept[None]).max(axis=(2, 3)).min(axis=1).max() == 0.0


def test_given_attitudes_that_look_at_the_sun_are_refused() -> None:
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    rotations = random_rotations(200, np.random.default_rng(3))
    near = int(np.argmin(angle_deg(rotations[:, 2], sun())))
    with pytest.raises(CatalogueError, match="index 0 looks within 40 degrees of the sun"):
        sc.simulate(stars, SHEET, attitudes=rotations[[near]], min_stars=3, exclusion=baffle())


def test_a_study_looks_where_its_sensor_may() -> None:
    sensor = Sensor(sun_exclusion_deg=60.0)
    options = {"camera": SHEET, "sweep": {"frames": (50,)}, "sensor": sensor}
    study = StudyDefinition(**options, time_utc=TIME)
    study.check()
    assert StudyDefinition.from_dict(study.to_dict()).exclusion == study.exclusion
    settings = study.cells()[0].settings
    heaven = Heaven(sc.load_catalogue(max_mag=6.0, epoch=2026.9))
    seen = take_frames(geometry_key(SHEET, settings, 1, 0, False), heaven, 300)
    assert angle_deg(seen.rotations[:, 2], sun()).min() > 59.9
    del settings["exclusion"]
    every = take_frames(geometry_key(SHEET, settings, 1, 0, False), heaven, 300)
    assert angle_deg(every.rotations[:, 2], sun()).min() < 55.0
    with pytest.raises(sc.core.errors.StudyError):
        StudyDefinition(**options).check()


def test_what_an_exclusion_needs_is_said() -> None:
    assert Exclusion.of(Sensor()) is None
    with pytest.raises(SensorError):
        Exclusion.of(Sensor(earth_exclusion_deg=20.0), TIME)
    with pytest.raises(CatalogueError):
        Exclusion.of(Sensor(sun_exclusion_deg=20.0), "tomorrow")
