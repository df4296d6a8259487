"""Matched stars out and in: FITS tables, astrometry.net's files, matches of tetra3 and tetra3rs."""

import json

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import ObservationError, RunFolderError
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.pipeline.images import are_images

ASTROPY = [
    pytest.importorskip(f"astropy.{name}", reason="the extra images is not installed")
    for name in ("coordinates", "io.fits", "table", "wcs")
]
SkyCoord, fits, Table, WCS = ASTROPY[0].SkyCoord, ASTROPY[1], ASTROPY[2].Table, ASTROPY[3].WCS

CAMERA = sc.Camera(1000, 800, 10.0, 50.0, 499.5, 399.5, "none")
# The same camera and its attitude as astropy has them: y down and x to the west, as in a picture of
# the sky.
SKY = WCS(naxis=2)
SKY.wcs.ctype, SKY.wcs.crval = ["RA---TAN", "DEC--TAN"], [83.0, -5.0]
SKY.wcs.crpix, SKY.wcs.cdelt = [500.5, 400.5], [-np.degrees(1.0 / 5000.0)] * 2


@pytest.fixture(scope="module")
def obs():
    rng = np.random.default_rng(1)
    xy = rng.uniform([0.0, 0.0], [999.0, 799.0], (24, 2))
    sky = SKY.pixel_to_world(*xy.T)
    return Observations(
        frame=np.repeat([3, 7], 12),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        ra_deg=sky.ra.deg,
        dec_deg=sky.dec.deg,
        sigma_px=rng.uniform(0.01, 0.1, 24),
        star_id=np.array([f"Gaia DR3 {k}" for k in range(24)]),
        mag=rng.uniform(2, 7, 24),
        time_utc=np.array(["2026-11-21T01:02:03.5"] * 24),
        temperature_c=np.where(np.arange(24) == 5, np.nan, 20.0),
        meta={"directions": "apparent", "seed": 4},
    )


def same(one, other, tolerance=0.0):
    assert list(one.columns) == list(other.columns)
    for name, values in one.columns.items():
        if values.dtype.kind == "f":
            np.testing.assert_allclose(other.columns[name], values, rtol=0, atol=tolerance)
        else:
            np.testing.assert_array_equal(other.columns[name], values)


@pytest.mark.parametrize("ending", [".csv", ".ecsv", ".parquet", ".fits"])
def test_tables_come_back_to_the_last_bit(tmp_path, obs, ending):
    obs.save(tmp_path / f"obs{ending}")
    back = load_observations(tmp_path / f"obs{ending}", CAMERA)
    same(obs, back)
    assert ending == ".csv" or (back.meta["directions"], back.meta["seed"]) == ("apparent", 4)
    assert not are_images([tmp_path / f"obs{ending}"])
    with pytest.raises(RunFolderError):
        obs.save(tmp_path / f"obs{ending}")


def test_astropy_finds_columns_units_and_comments_in_a_fits_table(tmp_path, obs):
    obs.save(tmp_path / "obs.fits")
    table = Table.read(tmp_path / "obs.fits")
    assert (str(table["x_px"].unit), str(table["ra_deg"].unit)) == ("pix", "deg")
    np.testing.assert_array_equal(table["ra_deg"], obs.ra_deg)
    assert fits.getheader(tmp_path / "obs.fits", 1)["EXTNAME"] == "OBSERVATIONS"


UNITS = {
    # Column, unit, what one of it is in the unit of the column's name; None where that is nothing.
    "pixels": ("x_px", "pixels", 1.0),
    "arcsec": ("ra_deg", "arcsec", 1.0 / 3600.0),
    "hours": ("ra_deg", "hourangle", 15.0),
    "degrees": ("dec_deg", "degrees", 1.0),
    "arcsec of a star": ("direction_mas", "arcsec", 1000.0),
    "kelvin": ("temperature_c", "K", 1.0),
    "micrometres": ("sigma_px", "um", None),
    "millimetres": ("x_px", "mm", None),
    "seconds": ("dec_deg", "s", None),
    "nonsense": ("y_px", "furlongs", None),
}


@pytest.mark.parametrize("ending", [".fits", ".ecsv"])
@pytest.mark.parametrize("case", UNITS)
def test_units_are_converted_or_refused_by_one_rule_in_all_formats(tmp_path, obs, ending, case):
    name, unit, one = UNITS[case]
    columns = obs.columns | {"sigma_px": np.full(24, 0.1), "direction_mas": np.full(24, 7.0)}
    columns = {key: columns[key] for key in ("frame", "x_px", "y_px", "ra_deg", "dec_deg", name)}
    wanted = columns[name]
    table = Table(columns)
    shift = 273.15 if unit == "K" else 0.0
    table[name] = (wanted + shift) / (one or 1.0)
    path = tmp_path / f"obs{ending}"
    if ending == ".fits":
        hdu = fits.BinTableHDU(table)
        hdu.header[f"TUNIT{table.colnames.index(name) + 1}"] = unit
        hdu.writeto(path)
    else:
        table.write(path, format="ascii.ecsv", delimiter=",")
        path.write_text(
            path.read_text().replace(f"name: {name},", f"name: {name}, unit: {unit},", 1)
        )
        assert f"unit: {unit}" in path.read_text()
    if one is None:
        with pytest.raises(
            ObservationError, match=rf"column {name} has the unit '{unit}'; give it in "
        ):
            load_observations(path)
        return
    np.testing.assert_allclose(
        load_observations(path).columns[name], wanted, rtol=1e-12, atol=1e-11
    )
    # Control: as plain numbers, without a unit, the values are others.
    if one != 1.0 or shift:
        table.write(tmp_path / "plain.fits", format="fits")
        with pytest.raises((AssertionError, ObservationError)):
            np.testing.assert_allclose(
                load_observations(tmp_path / "plain.fits").columns[name], wanted, rtol=1e-9
            )


def test_a_stated_factor_goes_before_the_unit_of_the_file(tmp_path, obs):
    table = Table({name: obs.columns[name] for name in ("frame", "x_px", "y_px", "dec_deg")})
    table["RA"] = obs.ra_deg / 15.0
    hdu = fits.BinTableHDU(table)
    hdu.header["TUNIT5"] = "h"
    hdu.writeto(tmp_path / "hours.fits")
    back = load_observations(tmp_path / "hours.fits", columns={"ra_deg": "ra * 15"})
    np.testing.assert_allclose(back.ra_deg, obs.ra_deg, rtol=1e-14)
    with pytest.raises(ObservationError, match="column ra_deg has the unit 'h'; give it in deg"):
        load_observations(tmp_path / "hours.fits", columns={"ra_deg": "ra"})


def test_a_fits_table_of_another_program_is_no_image(tmp_path, obs):
    """By what the headers say: tables of any name, with long headers."""
    table = Table(
        {name: values for name, values in obs.columns.items() if values.dtype.kind != "U"}
    )
    table.write(tmp_path / "table.fits")
    hdu = fits.BinTableHDU(table, name="STARS")
    for number in range(500):
        hdu.header[f"HIERARCH NOTE {number}"] = "x" * 30
    long_one = fits.PrimaryHDU()
    for number in range(500):
        long_one.header["HISTORY"] = f"step {number}"
    fits.HDUList([long_one, hdu]).writeto(tmp_path / "long.fits")
    for name in ("table.fits", "long.fits"):
        assert load_observations(tmp_path / name).n_stars == 24
        assert not are_images([tmp_path / name])
    pixels = np.zeros((32, 32), dtype=np.int16)
    fits.PrimaryHDU(pixels).writeto(tmp_path / "plain.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(pixels)]).writeto(tmp_path / "second.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(pixels)]).writeto(tmp_path / "packed.fits")
    (tmp_path / "cut.fits").write_bytes((tmp_path / "table.fits").read_bytes()[:2000])
    for name in ("plain.fits", "second.fits", "packed.fits", "cut.fits"):
        assert are_images([tmp_path / name])


def test_corr_files_are_as_astrometry_net_writes_them(tmp_path, obs):
    """By astropy's world coordinates with pixels counted from one."""
    moved = obs.x_px.copy()
    moved[[2, 14]] += 0.5
    Observations(**{**obs.columns, "x_px": moved}, meta=obs.meta).save(
        tmp_path / "night.corr", camera=CAMERA
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["night_3.corr", "night_7.corr"]
    for frame, part in ((3, slice(0, 12)), (7, slice(12, 24))):
        with fits.open(tmp_path / f"night_{frame}.corr") as hdus:
            table, header = hdus[1].data, hdus[1].header
        names = (
            "field_x field_y field_ra field_dec index_x index_y index_ra index_dec index_id "
            "field_id match_weight"
        )
        assert (
            table.names[:11] == names.split()
            and header["FRAME"] == frame
            and "(1, 1)" in str(header["COMMENT"])
        )
        np.testing.assert_allclose(table["field_x"], moved[part] + 1.0, rtol=0, atol=1e-12)
        index = SkyCoord(table["index_ra"], table["index_dec"], unit="deg")
        # The shift of one star turns the frame by a twelfth of it.
        expected = np.column_stack(SKY.wcs_world2pix(index.ra.deg, index.dec.deg, 1))
        assert np.abs(np.column_stack([table["index_x"], table["index_y"]]) - expected).max() < 0.15
        apart = (
            index.separation(SkyCoord(table["field_ra"], table["field_dec"], unit="deg")).rad
            * 5000.0
        )
        missed = np.hypot(table["index_x"] - table["field_x"], table["index_y"] - table["field_y"])
        np.testing.assert_allclose(apart, missed, atol=0.02)
        assert missed.argmax() == 2 and 0.35 < missed[2] < 0.5 and np.delete(missed, 2).max() < 0.15


def test_corr_files_come_back(tmp_path, obs):
    obs.save(tmp_path / "night.corr", camera=CAMERA)
    paths = [tmp_path / "night_3.corr", tmp_path / "night_7.corr"]
    back = load_observations(paths, CAMERA)
    assert back.frame_ids.tolist() == [0, 1] and back.meta["directions"] == "apparent"
    same(Observations(**{**obs.columns, "frame": np.repeat([0, 1], 12)}), back, 1e-12)
    assert (
        load_observations(paths[1]).frame_ids.tolist() == [7] and back.meta["ignored_columns"] == []
    )
    # One of another program: its own columns alone, in capital letters or not.
    columns = {
        "FIELD_X": [1.0, 2.5, 3.0],
        "FIELD_Y": [1.0, 4.0, 9.0],
        "index_ra": [10.0, 10.1, 10.2],
    }
    Table(columns | {"index_dec": [1.0, 1.1, 1.0], "index_id": [5, 6, 7]}).write(
        tmp_path / "a.corr", format="fits"
    )
    other = load_observations(tmp_path / "a.corr")
    assert (other.x_px.tolist(), other.y_px.tolist()) == ([0.0, 1.5, 2.0], [0.0, 3.0, 8.0])
    assert other.star_id is None and other.meta["directions"] == "undeclared"
    (tmp_path / "b.corr").write_bytes((tmp_path / "a.corr").read_bytes()[:3000])
    with pytest.raises(ObservationError, match=r"b\.corr: is not a readable table"):
        load_observations(tmp_path / "b.corr")


def solution(obs, frame):
    """As tetra3 returns it: rows before columns, from the corner of the image."""
    part = obs.select_frames([frame])
    return {
        "RA": 83.0,
        "Dec": -5.0,
        "matched_centroids": np.column_stack([part.y_px, part.x_px]) + 0.5,
        "matched_stars": np.column_stack([part.ra_deg, part.dec_deg, part.mag]),
        "matched_catID": np.arange(36).reshape(12, 3),
    }


def test_matches_of_tetra3_come_in(tmp_path, obs):
    solutions = [solution(obs, 3), {"RA": None, "matched_stars": None}, solution(obs, 7)]
    plain = [{key: np.asarray(value).tolist() for key, value in item.items()} for item in solutions]
    (tmp_path / "tetra3.json").write_text(json.dumps({"frames": plain}))
    (tmp_path / "one.json").write_text(json.dumps(plain[0]))
    for found in (
        Observations.from_matches(solutions, camera=CAMERA),
        load_observations(tmp_path / "tetra3.json"),
    ):
        assert found.frame.tolist() == [0] * 12 + [2] * 12 and found.meta[
            "frames_without_matches"
        ] == [1]
        for name in ("x_px", "y_px", "ra_deg", "dec_deg", "mag"):
            np.testing.assert_allclose(getattr(found, name), getattr(obs, name), rtol=0, atol=1e-12)
        assert found.star_id[1] == "3-4-5"
        # The places that astropy has for these stars.
        x, y = SKY.world_to_pixel(SkyCoord(found.ra_deg, found.dec_deg, unit="deg"))
        np.testing.assert_allclose(np.column_stack([x, y]), found.xy, atol=1e-6)
    assert len(load_observations(tmp_path / "one.json")) == 12
    timed = Observations.from_matches(solutions, times=["2026-11-21T01:02:03"] * 3)
    assert set(timed.time_utc) == {"2026-11-21T01:02:03"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"matched_stars": None}, "solution 0 has no matched_stars; call .* return_matches=True"),
        ({"matched_centroids": [[1.0, 2.0]]}, "solution 0 pairs 1 centroids with 12 stars"),
        ({"matched_stars": [["a", "b", "c"]]}, "solution 0 has matches of another form"),
        ({"centroids": [[0.0, 0.0]]}, "solution 0 has no image_width; give centroids"),
    ],
)
def test_what_are_no_matches_is_refused_with_the_way_to_get_them(tmp_path, obs, change, words):
    bad = {key: np.asarray(value).tolist() for key, value in solution(obs, 3).items()} | change
    with pytest.raises(ObservationError, match=f"^matches: {words}"):
        Observations.from_matches(bad)
    (tmp_path / "bad.json").write_text(json.dumps(bad))
    with pytest.raises(ObservationError, match=rf"bad\.json: {words}"):
        load_observations(tmp_path / "bad.json")
    with pytest.raises(ObservationError, match="no solution has matched stars"):
        Observations.from_matches([{"RA": None}])


def test_matches_of_tetra3rs_come_in(tmp_path):
    solver = pytest.importorskip("tetra3rs")
    y, x = np.mgrid[:200, :301]
    places = np.array([[40.3, 50.7], [200.0, 120.0], [260.5, 30.25], [100.1, 170.9]])
    light = sum(3000.0 * np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 1.5**2) for a, b in places)
    painted = np.random.default_rng(0).normal(100.0, 2.0, light.shape) + light
    centroids = [(c.x, c.y) for c in solver.extract_centroids(painted.astype(np.float32)).centroids]
    document = {
        "centroids": centroids,
        "matched_centroids": [2, 0, 3],
        "matched_catalog_ids": [11, 12, 13],
    }
    document |= {
        "matched_stars": [[1.0, 2.0], [1.5, 2.5], [2.0, 2.0]],
        "image_width": 301,
        "image_height": 200,
    }
    (tmp_path / "tetra3rs.json").write_text(json.dumps(document))
    found = load_observations(tmp_path / "tetra3rs.json")
    apart = np.linalg.norm(found.xy[:, None] - places, axis=2)
    assert (
        len(found) == 3
        and apart.min(axis=1).max() < 0.01
        and found.star_id.tolist() == ["11", "12", "13"]
    )
    assert found.mag is None
