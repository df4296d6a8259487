"""Quantities and times of astropy stand for numbers and text."""

import subprocess
import sys

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import EarthLocation
from astropy.time import Time

import starcal_uq as sc
from starcal_uq.sky import Site
from tests.helpers.scenes import observations

MOMENT = "2026-11-21T03:04:05.600"


def test_a_camera_and_a_site_of_quantities_are_those_of_numbers():
    plain = sc.Camera(1024, 1024, 15.0, 50.0, 511.5, 511.5)
    pitch, focal, centre = 0.015 * u.mm, 5 * u.cm, 511.5 * u.pix
    camera = sc.Camera(1024, 1024, pitch, focal, centre, 511.5)
    assert np.allclose(camera.theta, plain.theta, rtol=1e-15)
    assert camera.replace(focal_mm=0.06 * u.m).focal_mm == pytest.approx(60.0)
    place = Site(0.5 * u.rad, 1 * u.hourangle, 2.4 * u.km, temperature_c=283.15 * u.K)
    values = place.latitude_deg, place.longitude_deg, place.height_m, place.temperature_c
    assert values == pytest.approx((np.degrees(0.5), 15.0, 2400.0, 10.0))
    assert {type(value) for value in values} == {float}
    there = EarthLocation.from_geodetic(15 * u.deg, 45 * u.deg, 100 * u.m)
    assert Site.of(there).latitude_deg == pytest.approx(45.0, abs=1e-9)
    assert Site.of(there).height_m == pytest.approx(100.0, abs=1e-6)


def test_functions_take_quantities_and_times():
    stars, camera = sc.load_catalogue(5.0), sc.paper.paper_camera()
    moment = Time(MOMENT, scale="utc")
    assert np.array_equal(
        sc.load_catalogue(5.0, epoch=moment).ra_deg, sc.load_catalogue(5.0, moment.jyear).ra_deg
    )
    noises = [
        sc.simulate(stars, camera, n_frames=2, sigma_px=sigma).xy for sigma in (0.5, 0.5 * u.pix)
    ]
    assert np.array_equal(*noises)
    seen = [
        sc.sky.apparent_directions(stars.directions_icrs[:5], time, velocity)
        for time, velocity in (
            (MOMENT, (7.6, 0.0, 0.0)),
            (moment.tai, (7600.0, 0.0, 0.0) * u.m / u.s),
        )
    ]
    assert np.array_equal(*seen)


def test_columns_are_converted():
    obs = observations(n_frames=3)
    hours = (obs.ra_deg / 15.0) * u.hourangle
    times = Time([MOMENT] * len(obs))
    made = sc.Observations(
        obs.frame, obs.x_px * u.pix, obs.y_px, hours, obs.dec_deg, time_utc=times.tt
    )
    assert np.allclose(made.ra_deg, obs.ra_deg, rtol=1e-14)
    assert set(made.time_utc) == {MOMENT}


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: sc.Camera(1024, 1024, 15.0 * u.deg, 50.0, 511.5, 511.5),
        lambda: Site(0.5 * u.m, 0.0),
        lambda: sc.simulate(sc.load_catalogue(4.0), sc.paper.paper_camera(), sigma_px=1 * u.m),
    ],
)
def test_another_kind_of_quantity_is_refused_in_one_sentence(wrong):
    with pytest.raises(sc.StarcalError, match="give a quantity in") as refused:
        wrong()
    assert "\n" not in str(refused.value)


def test_a_function_still_refuses_arguments_that_it_does_not_have():
    with pytest.raises(TypeError):
        sc.sky.without_low_stars(observations(n_frames=2), None, 10.0, 20.0)


def test_astropy_is_not_loaded_without_quantities():
    code = (
        "import sys, starcal_uq as sc; sc.Camera(8, 8, 15.0, 50.0, 3.5, 3.5);"
        "sc.simulate(sc.load_catalogue(4.0), sc.paper.paper_camera(), n_frames=1);"
        "assert 'astropy' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_run_takes_the_site_of_a_location():
    there = EarthLocation.from_geodetic(15 * u.deg, 45 * u.deg, 100 * u.m)
    with pytest.raises(sc.StarcalError, match="site and in_space=True exclude each other"):
        sc.run(observations(n_frames=4), sc.paper.paper_start(), site=there, in_space=True)
