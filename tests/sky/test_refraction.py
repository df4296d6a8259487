"""Zenith and refraction against astropy, erfa and a table of stars."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_uq.sky.apparent import (
    aberrate,
    apparent_directions,
    catalogue_directions,
    earth_velocity_km_s,
)
from starcal_uq.sky.positions import unit_vectors
from starcal_uq.sky.refraction import (
    altitude_deg,
    refract,
    refraction_constants,
    shrinking,
    site_among_stars,
)
from starcal_uq.sky.site import Site
from tests.helpers.ground_scenes import SITE

TIME = "2019-07-29T20:47:26"
ARCSEC = 648000.0 / np.pi
NOORDWIJK = Site(latitude_deg=52.2, longitude_deg=4.42, temperature_c=20.0, name="Noordwijk")


def above(site: Site, time: str, lowest_deg: float, n: int = 300, seed: int = 1) -> np.ndarray:
    """Random directions above an altitude."""
    vectors = np.random.default_rng(seed).normal(size=(20 * n, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    zenith, _ = site_among_stars(site, time)
    return vectors[altitude_deg(vectors, zenith) > lowest_deg][:n]


def rotated_onto(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    rotation, _ = Rotation.align_vectors(b, a)
    return rotation.apply(a)


def _astropy():
    from astropy.coordinates import EarthLocation
    from astropy.time import Time
    from astropy.utils import iers

    return EarthLocation, Time, iers


def test_site_against_astropy():
    EarthLocation, Time, iers = _astropy()
    times = [TIME, "2026-11-21T03:04:05.6"]
    with (
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        place = EarthLocation.from_geodetic(SITE.longitude_deg, SITE.latitude_deg, SITE.height_m)
        time = Time(times, scale="utc")
        time.delta_ut1_utc = 0.0
        position, velocity = place.get_gcrs_posvel(time)
    zenith, ours = site_among_stars(SITE, times)
    assert zenith.shape == ours.shape == (2, 3)
    expected = velocity.xyz.to_value("km/s").T
    # Astropy differentiates nothing but leaves precession out of the axis as well: 1e-6 of 0.44
    # km/s.
    assert np.abs(ours - expected).max() < 2e-5
    assert np.linalg.norm(ours, axis=1) == pytest.approx(
        0.465 * np.cos(np.radians(SITE.latitude_deg)), rel=2e-3
    )
    # The geocentric direction differs from the zenith by the flattening, 0.19 degrees times sin(2
    # latitude).
    there = position.xyz.value.T
    there /= np.linalg.norm(there, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.sum(zenith * there, axis=1)))
    assert angle == pytest.approx(0.1924 * abs(np.sin(np.radians(2 * SITE.latitude_deg))), rel=0.01)
    one, _ = site_among_stars(SITE, times[1])
    assert np.allclose(one, zenith[1], rtol=0, atol=1e-15)
    # UT1 - UTC turns the zenith: 15 arcsec a second times the cosine of the latitude.
    moved, _ = site_among_stars(SITE, TIME, ut1_minus_utc_s=0.5)
    turned = np.linalg.norm(moved - zenith[0]) * ARCSEC
    assert turned == pytest.approx(7.52 * np.cos(np.radians(SITE.latitude_deg)), rel=0.01)


@pytest.mark.parametrize("site", [SITE, NOORDWIJK])
def test_apparent_directions_against_astropy(site):
    """Astropy's AltAz with pressure, after the best rotation: what is left is the Sun's deflection
    of light.
    """
    from astropy import units as u
    from astropy.coordinates import AltAz, SkyCoord

    EarthLocation, Time, iers = _astropy()
    directions = above(site, TIME, 12.0)
    time = TIME if site is NOORDWIJK else "2019-07-30T04:00:00"
    directions = above(site, time, 12.0)
    ours = apparent_directions(directions, time, site=site)
    with (
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        frame = AltAz(
            obstime=Time(time, scale="utc"),
            location=EarthLocation.from_geodetic(
                site.longitude_deg, site.latitude_deg, site.height_m
            ),
            pressure=site.air_pressure_hpa * u.hPa,
            temperature=site.air_temperature_c * u.deg_C,
            relative_humidity=site.relative_humidity,
            obswl=site.wavelength_um * u.micron,
        )
        sky = SkyCoord(*directions.T, representation_type="cartesian", frame="icrs")
        sky = SkyCoord(sky.spherical.lon, sky.spherical.lat, frame="icrs")
        seen = sky.transform_to(frame)
        astropy = unit_vectors(seen.az.deg, seen.alt.deg)
    # Azimuth runs from north over east: a left-handed system.
    astropy[:, 1] *= -1.0
    left = np.linalg.norm(rotated_onto(ours, astropy) - astropy, axis=1) * ARCSEC
    high = seen.alt.deg > 20.0
    assert left[high].max() < 0.012
    assert left.max() < 0.15
    assert (
        np.abs(altitude_deg(ours, site_among_stars(site, time)[0]) - seen.alt.deg).max() * 3600.0
        < 16.0
    )
    # The control: without refraction, seconds of arc are left.
    control = aberrate(directions, earth_velocity_km_s(time))
    assert np.linalg.norm(rotated_onto(control, astropy) - astropy, axis=1).max() * ARCSEC > 20.0


@pytest.mark.parametrize("altitude", [90.0, 60.0, 45.0, 25.0])
def test_how_much_small_angles_shrink(altitude):
    constants = refraction_constants(NOORDWIJK)
    zenith, small = np.array([0.0, 0.0, 1.0]), 1e-3
    z = np.radians(90.0 - altitude)
    centre = np.array([np.sin(z), 0.0, np.cos(z)])
    up, side = np.array([-np.cos(z), 0.0, np.sin(z)]), np.array([0.0, 1.0, 0.0])
    parts = []
    for axis in (up, side):
        ends = np.array([centre + sign * small * axis for sign in (1, -1)])
        ends /= np.linalg.norm(ends, axis=1, keepdims=True)
        seen = refract(ends, zenith, constants)
        before, after = (np.linalg.norm(pair[0] - pair[1]) for pair in (ends, seen))
        parts.append(1.0 - after / before)
    assert float(shrinking(altitude, constants)) == pytest.approx(np.mean(parts), rel=5e-3)
    if altitude == 45.0:
        # The textbook: R = A tan z to a thousandth, hence (A / 2) (1 + 1 / cos^2 z).
        assert float(shrinking(45.0, constants)) == pytest.approx(1.5 * constants[0], rel=0.01)


def test_catalogue_directions_are_the_inverse():
    for site, lowest in ((SITE, 10.5), (None, -90.0)):
        directions = above(SITE, TIME, lowest)
        seen = apparent_directions(directions, TIME, site=site)
        back = catalogue_directions(seen, TIME, site=site)
        assert np.linalg.norm(back - directions, axis=1).max() * ARCSEC < 1e-4
        assert np.linalg.norm(seen - directions, axis=1).max() * ARCSEC > 15.0


def test_the_table_of_real_stars(real_data):
    """Its apparent directions are those of air at 0 °C over 51.96° N, 4.51° E, without diurnal
    aberration.
    """
    with (real_data / "esa_tetra3_observations.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    column = {
        name: np.array([float(row[name]) for row in rows])
        for name in rows[0]
        if name.endswith("deg")
    }
    catalogue = unit_vectors(column["ra_deg"], column["dec_deg"])
    expected = unit_vectors(column["ra_apparent_deg"], column["dec_apparent_deg"])

    def left(site: Site) -> float:
        zenith, _ = site_among_stars(site, TIME)
        ours = refract(
            aberrate(catalogue, earth_velocity_km_s(TIME)), zenith, refraction_constants(site)
        )
        return float(np.linalg.norm(ours - expected, axis=1).max()) * ARCSEC

    cold = Site(51.96, 4.51, pressure_hpa=1013.25, temperature_c=0.0, wavelength_um=0.55)
    assert left(cold) < 0.06
    # The controls: another pressure, another place.
    assert left(replace(cold, pressure_hpa=1000.0)) > 0.5
    assert left(replace(cold, latitude_deg=52.96)) > 0.5
    assert left(replace(cold, longitude_deg=-4.51)) > 5.0
