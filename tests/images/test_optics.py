"""What headers say of the place."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_uq.images.optics import common_place, place_of


def earth_fixed(latitude, longitude, height):
    """Geocentric place in metres, WGS 84."""
    lat, lon, flat = np.radians(latitude), np.radians(longitude), 1.0 / 298.257223563
    e2 = flat * (2.0 - flat)
    n = 6378137.0 / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    level = (n + height) * np.cos(lat)
    return level * np.cos(lon), level * np.sin(lon), (n * (1.0 - e2) + height) * np.sin(lat)


@pytest.mark.parametrize(
    "header",
    [
        {"SITELAT": "52 13 12", "SITELONG": "4 25 12", "SITEELEV": 10},
        {"SITELAT": 52.22, "SITELONG": 4.42, "SITEELEV": "10"},
        {"SITELAT": "+52:13:12.0", "SITELONG": "-355:34:48", "SITEELEV": 10.0},
        {"SITELAT": "52d13m12s N", "SITELONG": "04d25m12s E", "SITEELEV": 10.0},
        {"LAT-OBS": 52.22, "LONG-OBS": 4.42, "ALT-OBS": 10.0},
        dict(
            zip(("OBSGEO-X", "OBSGEO-Y", "OBSGEO-Z"), earth_fixed(52.22, 4.42, 10.0), strict=True)
        ),
    ],
)
def test_a_place_in_a_header(header):
    place = place_of(header)
    assert (place["latitude_deg"], place["longitude_deg"]) == pytest.approx((52.22, 4.42), abs=1e-6)
    assert place["height_m"] == pytest.approx(10.0, abs=1e-3)
    west = place_of({"SITELAT": "-24 36 00", "SITELONG": "70 24 00 W"})
    assert (west["latitude_deg"], west["longitude_deg"]) == pytest.approx((-24.6, -70.4))
    assert common_place([{}, place]) == place
    assert common_place([west, place]) == common_place([{}]) == {}


@pytest.mark.parametrize(
    "header",
    [
        {},
        {"SITELAT": 0.0, "SITELONG": 0.0},
        {"SITELAT": "unknown", "SITELONG": "4 25 12"},
        {"SITELAT": 95.0, "SITELONG": 4.0},
        {"SITELAT": "52 77 12", "SITELONG": "4 25 12"},
        {"OBSGEO-X": 1.0, "OBSGEO-Y": 2.0, "OBSGEO-Z": 3.0},
        {"SITELAT": 52.0, "SITELONG": 4.0, "SITEELEV": 400_000.0},
    ],
    ids=str,
)
def test_no_place_in_a_header(header):
    assert place_of(header) == {}
