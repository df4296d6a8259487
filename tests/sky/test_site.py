"""The sky from the ground: zenith, diurnal aberration and refraction against astropy, erfa and a
table of stars.
"""

from __future__ import annotations

import csv
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import ObservationError, SiteError
from starcal_uq.core.times import utc_text
from starcal_uq.diagnostics.verdict.observed import corrected
from starcal_uq.images.read import read_image, time_in_name
from starcal_uq.pipeline.images import observations_from_images, with_time
from starcal_uq.sky.apparent import (
    apparent_directions,
    make_apparent,
    without_low_stars,
)
from starcal_uq.sky.positions import unit_vectors
from starcal_uq.sky.refraction import (
    refraction_constants,
    shrinking,
)
from starcal_uq.sky.site import Site
from tests.helpers.ground_scenes import CAMERA, NOMINAL, SITE, ground_frames

TIME = "2019-07-29T20:47:26"
ARCSEC = 648000.0 / np.pi
NOORDWIJK = Site(latitude_deg=52.2, longitude_deg=4.42, temperature_c=20.0, name="Noordwijk")


@pytest.fixture(scope="module")
def stars():
    return sc.load_catalogue(max_mag=6.5, epoch=2026.9)


# --- site


def test_site_goes_through_its_file(tmp_path):
    site = Site(-24.6272, -70.4042, 2635.0, temperature_c=11.5, name="Paranal")
    site.save(tmp_path / "site.toml")
    assert Site.load(tmp_path / "site.toml") == site
    assert Site.from_dict(site.to_dict()) == site
    assert str(site) == "Paranal, 24.63° S, 70.40° W, 2635 m"
    # The standard atmosphere: 743 hPa is what Paranal has.
    assert site.air_pressure_hpa == pytest.approx(734.0, abs=2.0)
    assert site.assumed == ("pressure",)
    assert Site(0.0, 0.0).air_temperature_c == 15.0
    # Whole numbers are numbers.
    (tmp_path / "whole.toml").write_text(
        "[site]\nlatitude_deg = 52\nlongitude_deg = 4\npressure_hpa = 1000\n"
    )
    assert Site.load(tmp_path / "whole.toml") == Site(52.0, 4.0, pressure_hpa=1000.0)
    with pytest.raises(sc.errors.RunFolderError):
        site.save(tmp_path / "site.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "[site]\nlatitude_deg = 52.0\n",
            "key longitude_deg is missing; add the longitude in degrees, east positive",
        ),
        (
            "[site]\nlatitude_deg = 152\nlongitude_deg = 4\n",
            "key latitude_deg is 152; write the latitude",
        ),
        (
            "[site]\nlatitude_deg = 52\nlongitude_deg = 4\npressure_hpa = 101325\n",
            "pressure_hpa is 101325.*in hPa",
        ),
    ],
)
def test_wrong_site_files_say_what_to_do(tmp_path, text, words):
    path = tmp_path / "site.toml"
    path.write_text(text)
    with pytest.raises(SiteError, match=words) as caught:
        Site.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value).strip()


def test_wrong_sites_are_refused():
    with pytest.raises(SiteError):
        Site(91.0, 0.0)
    with pytest.raises(SiteError):
        Site(52.0, 4.0, temperature_c=288.0)


# --- observations


def test_make_apparent_at_a_site(stars):
    obs = ground_frames(stars, np.array([50.0, 35.0]))
    apparent = make_apparent(obs, site=SITE)
    assert apparent.meta["directions"] == "apparent"
    assert apparent.meta["observer"] == "ground"
    assert Site.from_dict(apparent.meta["site"]) == SITE
    air = apparent.meta["atmosphere"]
    assert (air["pressure_hpa"], air["temperature_c"], air["assumed"]) == (743.0, 12.0, [])
    assert 27.0 < air["altitude_min_deg"] < 33.0
    assert 54.0 < air["altitude_max_deg"] < 58.0
    expected = apparent_directions(obs.directions_icrs, obs.time_utc, site=SITE)
    assert np.linalg.norm(apparent.directions_icrs - expected, axis=1).max() < 1e-15
    assert apparent.data_hash != make_apparent(obs).data_hash
    assert make_apparent(obs).meta["observer"] == "unknown"
    assert make_apparent(obs, (0.0, 7.6, 0.0)).meta["observer"] == "space"
    assert make_apparent(obs, (0.0, 0.3, 0.0)).meta["observer"] == "unknown"
    assert make_apparent(obs.with_meta(observer="space")).meta["observer"] == "space"
    with pytest.raises(ObservationError, match="not both"):
        make_apparent(obs, (0.0, 0.3, 0.0), site=SITE)
    with pytest.raises(ObservationError, match="no column 'time_utc'"):
        make_apparent(replace(obs, time_utc=None), site=SITE)


def test_stars_below_the_horizon_mean_a_wrong_site_or_time(stars):
    obs = ground_frames(stars, np.array([50.0, 60.0, 45.0]))
    # The sign of the longitude is the usual mistake.
    flipped = replace(SITE, longitude_deg=-SITE.longitude_deg)
    for function in (make_apparent, without_low_stars):
        words = (
            r"frame 0 .*degrees below the horizon of the site \(24.60° S, 70.40° E, 2635 m\) at "
            r"2026-11-25T02:00:00 "
        )
        with pytest.raises(
            ObservationError, match=words + r"UTC: correct the site \(north and east are positive\)"
        ):
            function(obs, site=flipped)
    # A clock that is ten hours off does the same.
    local = replace(obs, time_utc=np.char.replace(obs.time_utc, "T0", "T1"))
    with pytest.raises(
        ObservationError,
        match=r"which must be UTC; times \d hours earlier put all frames above it\.$",
    ):
        make_apparent(local, site=SITE)
    # The control: with the right site nothing is said.
    assert without_low_stars(obs, SITE).n_stars == obs.n_stars


def test_low_stars_are_left_out(stars):
    obs = ground_frames(stars, np.array([12.0, 50.0, 4.0]))
    with pytest.raises(ObservationError, match=r"lower than 10 degrees .*without_low_stars"):
        make_apparent(obs, site=SITE)
    high = without_low_stars(obs, SITE)
    assert 0 < high.meta["low_stars"] == obs.n_stars - high.n_stars
    # All of the last frame is low, half of the first.
    assert high.frame_ids.tolist() == [0, 1]
    assert make_apparent(high, site=SITE).meta["atmosphere"]["altitude_min_deg"] >= 10.0
    with pytest.raises(ObservationError):
        without_low_stars(obs.select_frames([2]), SITE)


def test_refraction_moves_f_and_the_site_puts_it_right(stars):
    obs = ground_frames(stars, np.random.default_rng(5).uniform(35.0, 80.0, 40), seed=3)
    right = sc.calibrate(make_apparent(obs, site=SITE), NOMINAL)
    z = (right.theta - CAMERA.theta) / right.sigmas
    assert np.all(np.abs(z) < 4.0)
    assert right.sigma == pytest.approx(0.05, rel=0.08)
    # The control: without the site f is short by what the formula says, many sigma.
    wrong = sc.calibrate(make_apparent(obs), NOMINAL)
    predicted = make_apparent(obs, site=SITE).meta["atmosphere"]["shrinking"] * CAMERA.focal_px
    assert predicted > 10.0 * wrong.sigmas[2]
    assert wrong.theta[2] - CAMERA.theta[2] == pytest.approx(-predicted, abs=4.0 * wrong.sigmas[2])


# --- report


def _first_paragraph(obs, **meta):
    from starcal_uq.diagnostics.verdict.judge import judge
    from starcal_uq.presentation.report.results import Results
    from starcal_uq.presentation.report.words import data_sentence

    obs = obs.with_meta(**meta)
    cal = sc.calibrate(obs, NOMINAL)
    check = next(c for c in judge(obs, cal).checks if c.name == "Catalogue directions")
    return data_sentence(Results("run", obs, cal)), check, cal


def test_report_says_that_f_is_conditional_on_refraction(stars):
    obs = ground_frames(stars, np.full(12, 45.0))
    text, check, cal = _first_paragraph(make_apparent(obs))
    assert "directions that include aberration but no refraction" in text
    found = re.search(r"f is too short by ([\d.]+) px .* zenith and by ([\d.]+) px .* at 45°", text)
    assert found is not None
    constants = refraction_constants(Site(0.0, 0.0))
    sizes = [
        float(shrinking(altitude, constants)) * cal.camera.focal_px for altitude in (90.0, 45.0)
    ]
    assert [float(size) for size in found.groups()] == pytest.approx(sizes, rel=0.05)
    assert check.level.value == "warning"
    assert "--site" in check.sentence
    for declared in ("undeclared", "catalogue"):
        text, check, _ = _first_paragraph(obs, directions=declared)
        assert "is conditional on refraction" in text
        assert "is conditional on refraction" in check.sentence
        assert "Annual aberration" in check.sentence


def test_report_is_silent_where_there_is_no_air(stars):
    obs = ground_frames(stars, np.full(12, 45.0))
    apparent = make_apparent(obs, site=SITE)
    plain = replace(apparent, meta={"directions": "apparent"})
    for table in (
        plain,
        replace(apparent, meta={"directions": "undeclared", "source": "simulated"}),
        make_apparent(obs.with_meta(observer="space")),
        make_apparent(obs, (0.0, 7.6, 0.0)),
    ):
        text, check, _ = _first_paragraph(table)
        assert "refraction" not in text
        assert "refraction" not in check.sentence


def test_report_states_site_air_and_what_refraction_does(stars):
    obs = ground_frames(stars, np.full(12, 45.0))
    text, check, cal = _first_paragraph(make_apparent(obs, site=SITE))
    assert "aberration and refraction included" in text
    assert (
        "Site: 24.60° S, 70.40° W, 2635 m. Refraction in air of 743 hPa and 12 °C is in the "
        "directions"
    ) in text
    size = float(re.search(r"f would come out ([\d.]+) px", text)[1])
    without = sc.calibrate(make_apparent(obs), NOMINAL)
    assert size == pytest.approx(cal.theta[2] - without.theta[2], rel=0.05)
    assert "conditional" not in text
    assert check.level.value == "pass"
    assert "standard atmosphere" not in text
    # What is assumed is said; where the weather may matter more than noise, that too.
    text, _, _ = _first_paragraph(make_apparent(obs, site=replace(SITE, pressure_hpa=None)))
    assert "(pressure of the standard atmosphere)" in text
    assert "The weather may differ" not in text
    cal = replace(cal, covariance=0.04 * cal.covariance)
    sharper = corrected(make_apparent(obs, site=replace(SITE, pressure_hpa=None)), cal).sentence
    assert "more than the sigma of f: state pressure and temperature" in sharper


# --- images


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("2019-07-29T204726_Alt40_Azi-135_Try1.tiff", "2019-07-29T20:47:26"),
        ("cam1_20190729T204726.png", "2019-07-29T20:47:26"),
        ("2019-07-29T20-47-26.25Z.fits", "2019-07-29T20:47:26.25"),
        ("2019-07-29T20_47_26.fits", "2019-07-29T20:47:26"),
        ("2019-13-29T204726.png", None),
        ("1019-07-29T204726.png", None),
        ("2019-07-29T2047261.png", None),
        ("2019-07-29.png", None),
        ("img0.png", None),
    ],
)
def test_times_in_names_of_files(name, time):
    assert time_in_name(name) == time


@pytest.mark.slow
@pytest.mark.parametrize(("longitude", "used"), [("4 25 12", True), ("184 25 12", False)])
def test_the_place_in_headers_is_used_where_the_stars_are_above_its_horizon(
    tmp_path, real_data, longitude, used
):
    from astropy.io import fits

    for path in sorted((real_data / "esa-tetra3").glob("*Alt60*.tiff")):
        frame = fits.PrimaryHDU(read_image(path).data)
        frame.header["DATE-OBS"], frame.header["EXPTIME"] = "2019-07-29T20:47:26", 0.001
        frame.header["SITELAT"], frame.header["SITELONG"] = "52 13 12", longitude
        frame.writeto(tmp_path / f"{path.stem}.fits")
    told = []
    camera = sc.Camera.load(real_data / "esa_tetra3_camera.toml")
    obs, _, _ = observations_from_images([tmp_path], camera, max_mag=7.0, tell=told.append)
    note = next(text for text in told if "site in the headers" in text)
    assert "SITELAT, SITELONG: 52.22° N" in note and ("was used" in note) is used
    assert obs.meta["observer"] == "ground" if used else "site" not in obs.meta


def test_an_images_own_time_wins(tmp_path):
    from astropy.io import fits
    from PIL import Image as Pillow

    pixels = np.random.default_rng(0).normal(100.0, 3.0, (48, 64)).astype(np.uint16)
    Pillow.fromarray(pixels).save(tmp_path / "2019-07-29T204726.png")
    Pillow.fromarray(pixels).save(tmp_path / "plain.png")
    own = fits.PrimaryHDU(pixels)
    own.header["DATE-OBS"], own.header["EXPTIME"] = "2020-01-02T03:04:05", 2.0
    own.writeto(tmp_path / "2019-07-29T204726.fits")
    named = read_image(tmp_path / "2019-07-29T204726.png")
    assert named.time_utc == "2019-07-29T20:47:26"
    assert any("from the name of the file, as UTC" in message for message in named.messages)
    header = read_image(tmp_path / "2019-07-29T204726.fits")
    assert header.time_utc == "2020-01-02T03:04:06.000000"
    assert not header.messages
    table = sc.images.extract_centroids(tmp_path)
    assert table.image.tolist() == ["2019-07-29T204726.fits", "2019-07-29T204726.png", "plain.png"]
    given = with_time(table, "2021-05-06T07:08:09")
    assert given.time_utc.tolist() == ["2020-01-02T03:04:06.000000"] + 2 * ["2021-05-06T07:08:09"]
    assert not any("name of the file" in message for message in given.messages)
    assert with_time(table, None) is table
    # Tables hold UTC without an offset.
    assert with_time(table, "2019-07-29T22:47:26+02:00").time_utc[2] == TIME
    with pytest.raises(sc.errors.CatalogueError):
        with_time(table, "2019-07-29")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2019-07-29T20:47:26", TIME),
        (" 2019-07-29 20:47:26Z", TIME),
        ("2019-07-29T22:47:26+02:00", TIME),
        ("2019-07-29T20:47", "2019-07-29T20:47:00"),
        ("2019-07-30T00:17:26.250+0330", "2019-07-29T20:47:26.250"),
        ("2017-01-01T01:59:60.5+02:00", "2016-12-31T23:59:60.5"),
        ("2019-12-31T23:00:00.-02:00", "2020-01-01T01:00:00"),
    ],
)
def test_times_as_tables_hold_them(text, expected):
    assert utc_text(text) == expected


def test_a_missing_image_is_left_out_once(stars, tmp_path):
    """With the centroids, not as a frame without them; the control is an image without stars."""
    dark = sc.images.Image(np.random.default_rng(0).normal(100.0, 3.0, (768, 1024)), "dark")
    table = sc.images.extract_centroids([tmp_path / "missing.png", dark], camera=NOMINAL)
    assert (table.problem != "").tolist() == [True, False]
    found = sc.identification.identify(table, NOMINAL, stars)
    assert found.n_left_out == 1 and len(found.frames) == 2
    assert found.text == "0 of 1 frame is identified. Left out: 1 with fewer than four centroids."


@pytest.mark.usefixtures("centroids_once")
def test_rendered_images_shine_through_no_air(stars, tmp_path):
    sc.simulation.render_frames(
        stars, CAMERA, tmp_path, n_frames=6, seed=3, times_utc=["2026-11-25T00:00:00"] * 6
    )
    obs, _, _ = observations_from_images([tmp_path], NOMINAL, max_mag=6.5)
    assert obs.meta["observer"] == "rendered"
    assert "refraction" not in _first_paragraph(obs)[0]
    obs, _, _ = observations_from_images([tmp_path], NOMINAL, max_mag=6.5, in_space=True)
    assert obs.meta["observer"] == "space"


def test_images_and_sites_that_do_not_go_together(tmp_path):
    with pytest.raises(SiteError):
        observations_from_images([tmp_path], NOMINAL, max_mag=7.0, site=SITE, in_space=True)
    with pytest.raises(SiteError):
        observations_from_images([tmp_path], NOMINAL, max_mag=7.0, site=SITE, directions="apparent")
    with pytest.raises(sc.errors.CatalogueError):
        observations_from_images([tmp_path], NOMINAL, max_mag=7.0, time_utc="noon")


@pytest.fixture(scope="module")
def esa(real_data):
    return real_data / "esa-tetra3", sc.Camera.load(real_data / "esa_tetra3_camera.toml")


@pytest.mark.usefixtures("centroids_once")
def test_real_frames_with_a_site_agree_with_the_independent_fit(esa, real_data):
    folder, camera = esa
    obs, table, found = observations_from_images([folder], camera, max_mag=7.0, site=NOORDWIJK)
    assert set(table.time_utc) == {TIME}
    assert found.identification.n_identified == 8
    assert obs.n_stars / 8 >= 30
    assert obs.meta["atmosphere"]["altitude_min_deg"] == pytest.approx(37.0, abs=1.0)
    cal = found.calibration
    f = cal.theta[2]
    values = [*cal.theta[:3], cal.theta[3] * f**2, cal.theta[4] * f**4]
    sigmas = [*cal.sigmas[:3], cal.sigmas[3] * f**2, cal.sigmas[4] * f**4]
    independent = [(517.3, 1.0), (389.9, 1.4), (5116.54, 0.28), (0.078, 0.017), (1.5, 1.1)]
    for value, sigma, (other, error) in zip(values, sigmas, independent, strict=True):
        assert abs(value - other) < 3.0 * np.hypot(sigma, error)
    # No wrong identification: every star that the table has at that place is the star of the table.
    seen, n = found.identification.observations, 0
    with (real_data / "esa_tetra3_observations.csv").open() as stream:
        for row in csv.DictReader(stream):
            near = np.hypot(seen.x_px - float(row["x_px"]), seen.y_px - float(row["y_px"])) < 1.0
            here = np.flatnonzero((seen.frame == int(row["frame"])) & near)
            if len(here):
                n += 1
                there = unit_vectors(
                    np.array([float(row["ra_deg"])]), np.array([float(row["dec_deg"])])
                )
                assert np.linalg.norm(seen.directions_icrs[here] - there) * ARCSEC < 20.0
    assert n > 300
    # The controls: without a site f is many sigma off; with the longitude's sign flipped the frames
    # disagree.
    bare, _, plain = observations_from_images([folder], camera, max_mag=7.0)
    assert abs(plain.calibration.theta[2] - 5116.54) > 5.0 * np.hypot(
        plain.calibration.sigmas[2], 0.28
    )
    assert bare.meta["observer"] == "unknown"
    west = replace(NOORDWIJK, longitude_deg=-NOORDWIJK.longitude_deg)
    flipped = sc.calibrate(make_apparent(found.identification.observations, site=west), camera)
    assert (
        flipped.sigma
        > sc.calibrate(
            make_apparent(found.identification.observations, site=NOORDWIJK), camera
        ).sigma
    )


@pytest.mark.usefixtures("centroids_once")
def test_real_frames_of_another_hemisphere_are_refused(esa, tmp_path):
    folder, camera = esa
    with pytest.raises(ObservationError, match="below the horizon"):
        observations_from_images(
            [folder], camera, max_mag=7.0, site=replace(NOORDWIJK, latitude_deg=-52.2)
        )
    for number, image in enumerate(sorted(folder.iterdir())[2:4]):
        shutil.copy(image, tmp_path / f"night{number}.tiff")
    with pytest.raises(
        ObservationError, match=r"night0.tiff \(and 1 other\): .* no time.* in each file's name"
    ):
        observations_from_images([tmp_path], camera, max_mag=7.0, site=NOORDWIJK)
    obs, _, _ = observations_from_images(
        [tmp_path], camera, max_mag=7.0, site=NOORDWIJK, time_utc=TIME
    )
    assert obs.meta["observer"] == "ground"
    obs, _, found = observations_from_images([tmp_path], camera, max_mag=7.0)
    assert obs.meta["directions"] == "undeclared"
    assert found.identification.n_identified == 2
