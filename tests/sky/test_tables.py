"""Readers of a user's catalogue: named columns, and the byte layouts of the CDS with real stars in
them.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from starcal_uq.core.errors import CatalogueError
from starcal_uq.sky.positions import unit_vectors
from starcal_uq.sky.tables import read_catalogue

EPOCH = {"file_epoch": 2000.0}
CSV = """name,ra,dec,Vmag,pmRA,pmDE
Sirius,101.28854105,-16.71314306,-1.44,-546.01,-1223.08
Vega,279.23410832,38.78299311,0.03,,
"""


def at_bytes(length: int, **fields: tuple[int, str]) -> str:
    """A line with each text at its first byte, counted from 1 as a ReadMe does."""
    line = [" "] * length
    for start, text in fields.values():
        line[start - 1 : start - 1 + len(text)] = text
    return "".join(line)


def hipparcos_line(hip: int, v: str, ra: str, dec: str, pm_ra: str, pm_dec: str) -> str:
    """Bytes 1 to 104 of a line of hip_main.dat: fields between bars, right-justified."""
    plx = " " * 7
    fields = ["H", f"{hip:>12d}"[:12], " ", " " * 11, " " * 11, f"{v:>5}", " ", "H"]
    fields += [f"{ra:>12}", f"{dec:>12}", " ", plx, f"{pm_ra:>8}", f"{pm_dec:>8}"]
    line = "|".join(fields)
    assert len(line) == 104
    assert line[8:14].strip() == str(hip)
    return line.ljust(450)


HIPPARCOS = [
    hipparcos_line(32349, "-1.44", "101.28854105", "-16.71314306", "-546.01", "-1223.08"),
    hipparcos_line(91262, "0.03", "279.23410832", "+38.78299311", "201.02", "287.46"),
    # One of the 263 entries without an astrometric solution.
    hipparcos_line(55203, "3.79", "", "", "", ""),
]
HIPPARCOS_README = """I/239               The Hipparcos and Tycho Catalogues         (ESA 1997)
================================================================================

Byte-by-byte Description of file: hip_main.dat
--------------------------------------------------------------------------------
   Bytes Format Units   Label     Explanations
--------------------------------------------------------------------------------
       1  A1    ---     Catalog   [H] Catalogue (H=Hipparcos)               (H0)
   9- 14  I6    ---     HIP       Identifier (HIP number)                   (H1)
      16  A1    ---     Proxy    *[HT] Proximity flag                       (H2)
  18- 28  A11   ---     RAhms     Right ascension in h m s, ICRS (J1991.25) (H3)
  30- 40  A11   ---     DEdms     Declination in deg ' ", ICRS (J1991.25)   (H4)
  42- 46  F5.2  mag     Vmag      ? Magnitude in Johnson V                  (H5)
      48  I1    ---     VarFlag  *[1,3]? Coarse variability flag            (H6)
      50  A1    ---   r_Vmag     *[GHT] Source of magnitude                 (H7)
  52- 63  F12.8 deg     RAdeg    *? alpha, degrees (ICRS, Epoch=J1991.25)   (H8)
  65- 76  F12.8 deg     DEdeg    *? delta, degrees (ICRS, Epoch=J1991.25)   (H9)
      78  A1    ---     AstroRef *[*+A-Z] Reference flag for astrometry    (H10)
  80- 86  F7.2  mas     Plx       ? Trigonometric parallax                 (H11)
  88- 95  F8.2 mas/yr   pmRA     *? Proper motion mu_alpha.cos(delta), ICRS(H12)
  97-104  F8.2 mas/yr   pmDE     *? Proper motion mu_delta, ICRS           (H13)
--------------------------------------------------------------------------------
Note on RAdeg, DEdeg: right ascension and declination are
     expressed in degrees for epoch J1991.25 (JD2448349.0625 (TT)) in the
     ICRS reference system.
--------------------------------------------------------------------------------

Byte-by-byte Description of file: h_dm_com.dat
--------------------------------------------------------------------------------
   Bytes Format Units    Label    Explanations
--------------------------------------------------------------------------------
   1- 10  A10    ---     CCDM     CCDM number                              (DC1)
--------------------------------------------------------------------------------
"""


def bsc_line(hr: int, ra: str, dec: str, v: str, pm: str) -> str:
    """A line of V/50 with the fields that matter: RA hhmmss.s at byte 76, Dec at 84, V at 103,
    motions at 149.
    """
    return at_bytes(197, hr=(1, f"{hr:>4d}"), ra=(76, ra), dec=(84, dec), v=(103, v), pm=(149, pm))


BSC = [
    # Two lines of the catalogue, byte for byte.
    "2491  9Alp CMaBD-16 1591  48915151881 257I   5423           "
    "064044.6-163444064508.9-164258227.22-08.88-1.46"
    "   0.00 -0.05 -0.03   A1Vm               -0.553-1.205 +.375-008SBO    13 10.3  11.2AB   4*",
    "2061 58Alp OriBD+07 1055  39801113271 224I   4506  Alp Ori  "
    "054945.4+072319055510.3+072425199.79-08.96 0.50"
    "  +1.85 +2.06 +1.28   M1-2Ia-Iab        e+0.026+0.009 +.005+021SB         9.9 174.4AE   6*",
    # One of the fourteen numbers that turned out not to be stars.
    "  92 NOVA 1572                                     B Cas",
    bsc_line(1852, "053200.4", "-001757", " 2.23", "+0.003+0.002"),
    bsc_line(7001, "183656.3", "+384701", " 0.03", "+0.202+0.286"),
]
BSC_README = """V/50           Bright Star Catalogue, 5th Revised Ed.     (Hoffleit+, 1991)
================================================================================

Byte-by-byte Description of file: catalog
--------------------------------------------------------------------------------
   Bytes Format  Units   Label    Explanations
--------------------------------------------------------------------------------
   1-  4  I4     ---     HR       [1/9110]+ Harvard Revised Number
                                    = Bright Star Number
   5- 14  A10    ---     Name     Name, generally Bayer and/or Flamsteed name
  61- 62  I2     h       RAh1900  ?Hours RA, equinox B1900, epoch 1900.0 (1)
  76- 77  I2     h       RAh      ?Hours RA, equinox J2000, epoch 2000.0 (1)
  78- 79  I2     min     RAm      ?Minutes RA, equinox J2000, epoch 2000.0 (1)
  80- 83  F4.1   s       RAs      ?Seconds RA, equinox J2000, epoch 2000.0 (1)
      84  A1     ---     DE-      ?Sign Dec, equinox J2000, epoch 2000.0 (1)
  85- 86  I2     deg     DEd      ?Degrees Dec, equinox J2000, epoch 2000.0 (1)
  87- 88  I2     arcmin  DEm      ?Minutes Dec, equinox J2000, epoch 2000.0 (1)
  89- 90  I2     arcsec  DEs      ?Seconds Dec, equinox J2000, epoch 2000.0 (1)
 103-107  F5.2   mag     Vmag     ?Visual magnitude (1)
 149-154  F6.3 arcsec/yr pmRA    *?Annual proper motion in RA J2000, FK5 system
 155-160  F6.3 arcsec/yr pmDE     ?Annual proper motion in Dec J2000, FK5 system
--------------------------------------------------------------------------------
Note (1): These fields are all blanks for stars removed from
    the Bright Star Catalogue (see notes).
--------------------------------------------------------------------------------
"""


def sao_line(number: int, flag: str, v: str, ra: str, pm_ra: str, dec: str, pm_dec: str) -> str:
    """A line of sao.dat: the B1950 fields that must not be taken (all nines here), and the J2000
    ones.
    """
    line = at_bytes(
        204,
        number=(1, f"{number:>6d}{flag}"),
        old_ra=(8, "235959.999 0.9999"),
        old_dec=(42, "-895959.99-9.999"),
        v=(81, v),
        ra=(151, ra),
        pm_ra=(161, pm_ra),
        dec=(168, dec),
        pm_dec=(178, pm_dec),
    )
    assert len(line) == 204
    return line


# Positions and proper motions of FK5, whose Sirius and Vega are those of SAO to its precision.
SAO = [
    sao_line(151881, " ", "-1.6", "064508.871", "-0.0385", "-164257.99", "-1.205"),
    sao_line(67174, " ", " 0.1", "183656.332", " 0.0173", "+384701.17", " 0.286"),
    sao_line(132220, " ", "99.9", "053200.400", " 0.0002", "-001756.73", " 0.002"),
    sao_line(1000, "D", " 5.0", "010000.000", " 0.0000", "+100000.00", " 0.000"),
]


def write(folder: Path, name: str, lines: list[str]) -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    return path


def separation_arcsec(ra: float, dec: float, other_ra: float, other_dec: float) -> float:
    a, b = unit_vectors(np.array([ra, other_ra]), np.array([dec, other_dec]))
    return float(np.degrees(np.linalg.norm(a - b)) * 3600.0)


# ICRS at J2000 from Hipparcos 2, hence independent of what is read here; the two editions differ by
# 10 mas for Vega.
SIRIUS_J2000 = (101.28715533, -16.71611586)
VEGA_J2000 = (279.23473479, 38.78368896)


@pytest.mark.parametrize("with_readme", [False, True])
def test_hipparcos(tmp_path: Path, with_readme: bool) -> None:
    path = write(tmp_path, "hip_main.dat", HIPPARCOS)
    if with_readme:
        (tmp_path / "ReadMe").write_text(HIPPARCOS_README)
    stars = read_catalogue(path)
    assert stars.star_id.tolist() == ["HIP 32349", "HIP 91262"]
    assert stars.epoch == 1991.25
    assert stars.band == "Johnson V"
    assert stars.mag.tolist() == [-1.44, 0.03]
    assert stars.ra_deg.tolist() == [101.28854105, 279.23410832]
    assert stars.dec_deg.tolist() == [-16.71314306, 38.78299311]
    assert stars.pm_ra_mas_yr.tolist() == [-546.01, 201.02]
    assert stars.pm_dec_mas_yr.tolist() == [-1223.08, 287.46]
    assert stars.has_proper_motion.all()
    assert "1 entries without a position" in stars.source
    moved = read_catalogue(path, epoch=2000.0)
    assert separation_arcsec(moved.ra_deg[0], moved.dec_deg[0], *SIRIUS_J2000) < 0.002
    assert separation_arcsec(moved.ra_deg[1], moved.dec_deg[1], *VEGA_J2000) < 0.015


@pytest.mark.parametrize("with_readme", [False, True])
def test_bright_star_catalogue(tmp_path: Path, with_readme: bool) -> None:
    path = tmp_path / "catalog.gz"
    path.write_bytes(gzip.compress(("\n".join(BSC) + "\n").encode("latin-1")))
    readme = tmp_path / "V50.txt"
    readme.write_text(BSC_README)
    stars = read_catalogue(path, readme=readme if with_readme else None)
    assert stars.star_id.tolist() == ["HR 2491", "HR 2061", "HR 1852", "HR 7001"]
    assert stars.epoch == 2000.0
    assert stars.mag.tolist() == [-1.46, 0.50, 2.23, 0.03]
    # Positions are rounded to 0.1 s and 1 arcsec.
    assert separation_arcsec(stars.ra_deg[0], stars.dec_deg[0], *SIRIUS_J2000) < 1.0
    assert separation_arcsec(stars.ra_deg[3], stars.dec_deg[3], *VEGA_J2000) < 1.0
    # A declination of -00 keeps its sign: Delta Orionis, 17 arcmin south of the equator.
    assert stars.dec_deg[2] == pytest.approx(-(17 + 57 / 60) / 60.0, abs=1e-4)
    # pmRA already includes cos(dec); the change from FK5 to ICRS is below 2 mas/yr.
    assert stars.pm_ra_mas_yr[0] == pytest.approx(-553.0, abs=2.0)
    assert stars.pm_dec_mas_yr[0] == pytest.approx(-1205.0, abs=2.0)


def test_sao(tmp_path: Path) -> None:
    stars = read_catalogue(write(tmp_path, "sao.dat", SAO))
    assert stars.star_id.tolist() == ["SAO 151881", "SAO 67174", "SAO 132220"]
    assert stars.epoch == 2000.0
    assert separation_arcsec(stars.ra_deg[0], stars.dec_deg[0], *SIRIUS_J2000) < 1.0
    assert separation_arcsec(stars.ra_deg[1], stars.dec_deg[1], *VEGA_J2000) < 0.3
    # Seconds of time a year without cos(dec) become mas a year with it.
    assert stars.pm_ra_mas_yr[0] == pytest.approx(
        -0.0385 * 15e3 * np.cos(np.radians(16.716)), abs=2.0
    )
    assert stars.pm_dec_mas_yr[1] == pytest.approx(286.0, abs=2.0)
    # 99.9 stands for no magnitude.
    assert np.isnan(stars.mag[2])
    assert len(read_catalogue(tmp_path / "sao.dat", max_mag=6.0)) == 2
    assert "without a position" in stars.source


def test_fk5_becomes_icrs_as_in_astropy(tmp_path: Path) -> None:
    from astropy import units as u
    from astropy.coordinates import FK5, SkyCoord

    stars = read_catalogue(write(tmp_path, "sao.dat", SAO[:2]))
    fk5 = SkyCoord(
        ["06h45m08.871s", "18h36m56.332s"],
        ["-16d42m57.99s", "38d47m01.17s"],
        frame=FK5(equinox="J2000"),
    )
    for row, expected in enumerate(fk5.icrs):
        # Astropy's rotation leaves out the frame's epoch-dependent spin, which is zero at J2000.
        assert (
            separation_arcsec(
                stars.ra_deg[row], stars.dec_deg[row], expected.ra.deg, expected.dec.deg
            )
            < 0.002
        )
    assert u.deg is fk5.ra.unit


def test_readme_that_moved_a_column_is_followed(tmp_path: Path) -> None:
    lines = [line[:41] + " " + line[41:] for line in HIPPARCOS]
    moved = []
    for line in HIPPARCOS_README.split("\n"):
        start, dash, rest = line[:4].strip(), line[4:5], line[5:8]
        if dash == "-" and start.isdigit() and int(start) > 41:
            line = f"{int(start) + 1:>4}-{int(rest) + 1:>3}" + line[8:]
        moved.append(line)
    readme = tmp_path / "layout.txt"
    readme.write_text("\n".join(moved))
    stars = read_catalogue(write(tmp_path, "hip_main.dat", lines), readme=readme)
    assert stars.dec_deg.tolist() == [-16.71314306, 38.78299311]


def test_cds_errors_name_line_and_column(tmp_path: Path) -> None:
    first, second = HIPPARCOS[:2]
    letter, far = (second.replace("+38.78299311", dec) for dec in ("+38.7829x311", "+98.78299311"))
    minute = bsc_line(7001, "186656.3", "+384701", " 0.03", "+0.202+0.286")
    wrong = write(tmp_path, "ReadMe.bsc", [BSC_README])
    for name, lines, options, said in (
        ("hip_main.dat", ["", first, letter], {}, r"main.dat, line 3, column 'DEICRS': '.38.7829x"),
        ("hip_main.dat", [first, far], {}, r"line 2, column 'DEICRS': 98\.783 deg is outside"),
        ("catalog", [minute], {}, "line 1, column 'RAm': 66 is outside"),
        ("catalog", ["  92 NOVA 1572"], {}, "no line holds a position"),
        ("sao.dat", [""], {}, "is empty"),
        ("hip_main.dat", HIPPARCOS, {"readme": wrong}, r"ReadMe\.bsc: does not describe The Hipp"),
        ("hip_main.dat", HIPPARCOS, {"file_epoch": 2000.0}, "are fixed"),
    ):
        with pytest.raises(CatalogueError, match=said):
            read_catalogue(write(tmp_path, name, lines), **options)
    bad = tmp_path / "hip_main.dat.gz"
    bad.write_bytes(b"\x1f\x8b broken")
    with pytest.raises(CatalogueError, match="is not readable as HIPPARCOS"):
        read_catalogue(bad)


def test_csv_with_guessed_columns(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("# a comment\n" + CSV)
    stars = read_catalogue(path, file_epoch=1991.25)
    assert stars.star_id.tolist() == ["Sirius", "Vega"]
    assert stars.band == "Johnson V"
    assert stars.has_proper_motion.tolist() == [True, False]
    assert stars.pm_ra_mas_yr.tolist() == pytest.approx([-546.01, 0.0])
    moved = read_catalogue(path, file_epoch=1991.25, epoch=2000.0, max_mag=0.0)
    assert len(moved) == 1
    assert separation_arcsec(moved.ra_deg[0], moved.dec_deg[0], *SIRIUS_J2000) < 0.002
    apparent = read_catalogue(path, file_epoch=1991.25, observer_velocity_km_s=(30.0, 0.0, 0.0))
    assert apparent.apparent
    assert len(read_catalogue(path, file_epoch=1991.25, require_proper_motion=True)) == 1
    assert read_catalogue(path, file_epoch=1991.25, band="my V").band == "my V"


def test_explicit_columns_come_before_guesses(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("hip,ra,dec,better_ra,better_dec,imag\n7,1,2,3,4,5.5\n8,1,2,13,14,6.5\n")
    stars = read_catalogue(
        path, {"ra_deg": "better_ra", "dec_deg": "better_dec", "mag": "imag"}, file_epoch=2020.0
    )
    assert stars.ra_deg == pytest.approx([3.0, 13.0])
    assert stars.star_id.tolist() == ["HIP 7", "HIP 8"]
    assert stars.band == "the file's own band (column 'imag')"
    assert not stars.has_proper_motion.any()


@pytest.mark.parametrize("name", ["mine.ecsv", "mine.fits", "mine.fits.gz"])
def test_units_of_the_table_are_honoured(tmp_path: Path, name: str) -> None:
    from astropy import units as u
    from astropy.table import Table

    table = Table(
        {
            "source_id": np.array([1, 4472832130942575872]),
            "ra": np.array([101.28854105, 279.23410832]) / 15.0 * u.hourangle,
            "dec": np.array([-16.71314306, 38.78299311]) * 60.0 * u.arcmin,
            "phot_g_mean_mag": np.array([-1.1, np.nan]) * u.mag,
            "pmra": np.array([-0.54601, np.nan]) * u.arcsec / u.yr,
            "pmdec": np.array([-1.22308, 0.28746]) * u.arcsec / u.yr,
            "ref_epoch": np.array([1991.25, 2000.0]) * u.yr,
            "comment": ["a", "b"],
        }
    )
    if name.endswith("fits") or name.endswith("gz"):
        # FITS has no hour angle.
        table["ra"] = (table["ra"].to(u.deg)).astype(float)
    path = tmp_path / name
    table.write(path)
    stars = read_catalogue(path, epoch=2000.0)
    assert stars.band == "Gaia G"
    assert stars.star_id.tolist() == ["1", "4472832130942575872"]
    assert separation_arcsec(stars.ra_deg[0], stars.dec_deg[0], *SIRIUS_J2000) < 0.002
    assert stars.pm_dec_mas_yr[0] == pytest.approx(-1223.08, abs=0.05)
    assert stars.has_proper_motion.tolist() == [True, False]
    assert stars.ra_deg[1] == pytest.approx(279.23410832, abs=1e-10)
    # Rows of different epochs are brought to the latest if no other is asked for.
    assert read_catalogue(path).epoch == 2000.0


def test_epoch_of_the_metadata_is_used(tmp_path: Path) -> None:
    from astropy.table import Table

    path = tmp_path / "mine.ecsv"
    Table({"ra": [1.0], "dec": [2.0]}, meta={"EPOCH": "J2015.5"}).write(path)
    stars = read_catalogue(path)
    assert stars.epoch == 2015.5
    assert stars.star_id.tolist() == ["row 1"]
    with pytest.raises(CatalogueError):
        read_catalogue(path, max_mag=6.0)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (CSV, {}, r"does not say the epoch .* file_epoch=2016\.0"),
        (
            CSV.replace("38.78299311", "138.7"),
            EPOCH,
            r"line 3, column 'dec': 138\.7 deg is outside",
        ),
        (
            CSV.replace("279.23410832", "-9"),
            EPOCH,
            r"line 3, column 'ra': -9 deg is outside \[0, 360\]",
        ),
        (CSV.replace("279.23410832", ""), EPOCH, r"line 3, column 'ra': has no value"),
        (
            CSV.replace("101.28854105", "06:45:09"),
            EPOCH,
            r"line 2, column 'ra': '06:45:09' is not a number",
        ),
        (
            "# note\n\n" + CSV.replace("0.03", "dim"),
            EPOCH,
            r"line 5, column 'Vmag': 'dim' is not a number",
        ),
        (
            CSV.replace("-546.01", "-54601"),
            EPOCH,
            r"line 2, column 'pmRA': .* faster than any star",
        ),
        (CSV.replace("pmDE", "other"), EPOCH, r"no pm_dec_mas_yr; name it, among name, ra, dec"),
        (
            CSV.replace(",ra,", ",RAB1950,"),
            EPOCH,
            r"no column is known as ra_deg.* among name, RAB1950",
        ),
        (CSV, {"columns": {"ra_deg": "RA_x"}}, r"has no column 'RA_x' for ra_deg; it has name, ra"),
        (CSV, {"columns": {"alpha": "ra"}}, r"columns names 'alpha', which is none of star_id"),
        (CSV, {"file_epoch": 2451545.0}, r"not a Julian year"),
        (CSV, {"file_epoch": 2000.0, "max_mag": -3.0}, r"No star is left in .*mine\.csv"),
        (CSV, {"format": "xml"}, r"unknown format 'xml'"),
        ("name,ra,dec\n", EPOCH, r"holds no stars"),
        ("", {}, r"mine\.csv: the file is empty"),
        ("ra,dec\n1,2\n3,4,5\n", {}, r"mine\.csv: is not readable as CSV"),
        (
            "ra,dec,epoch\n1,2,2000\n3,4,2451545\n",
            {},
            r"line 3, column 'epoch': 2\.45154e\+06 is not a Julian year",
        ),
    ],
)
def test_bad_tables_are_refused_in_one_sentence(
    tmp_path: Path, text: str, options: dict[str, object], message: str
) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(text)
    with pytest.raises(CatalogueError, match=message) as caught:
        read_catalogue(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    if "epoch" not in message and "Julian" not in message:
        assert "mine.csv" in str(caught.value)


def test_unknown_units_and_places_are_refused(tmp_path: Path) -> None:
    from astropy import units as u
    from astropy.table import Table

    path = tmp_path / "mine.fits"
    Table({"ra": [1.0] * u.m, "dec": [2.0] * u.deg}).write(path)
    with pytest.raises(
        CatalogueError, match=r"column 'ra': the unit 'm' cannot be converted to deg"
    ):
        read_catalogue(path, file_epoch=2000.0)
    Table({"ra": [1.0, 2.0], "dec": [2.0, 95.0]}).write(path, overwrite=True)
    with pytest.raises(CatalogueError, match=r"mine\.fits, row 2, column 'dec': 95 deg is outside"):
        read_catalogue(path, file_epoch=2000.0)
    odd = tmp_path / "stars.txt"
    odd.write_text(CSV)
    with pytest.raises(CatalogueError):
        read_catalogue(odd)
    assert len(read_catalogue(odd, format="csv", file_epoch=2000.0)) == 2
