"""Readers for a user's own star catalogue: tables with named columns, and three catalogues in the
format of the CDS.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import check_fits, listed, read_bytes, reading, unpack
from starcal_uq.core.settings import bounded
from starcal_uq.core.tables import RawTable, in_unit, read_cells
from starcal_uq.core.types import BoolArray, FloatArray, StrArray, floats
from starcal_uq.sky.catalogue import StarCatalogue, check_epoch, prepare
from starcal_uq.sky.cds import LAYOUTS, fk5_to_icrs, read_cds
from starcal_uq.sky.positions import propagate_proper_motion

Format = Literal["csv", "ecsv", "fits", "hipparcos", "sao", "bsc"]

# Barnard's star, the fastest, moves 10,400 mas/yr.
MAX_PROPER_MOTION_MAS_YR = 11000.0
_FAINTEST_BELIEVABLE = 90.0

# Names under which columns are found without being told, first hit wins; compared without regard to
# case. Columns of equinox B1950 are left out on purpose: their names must not be mistaken.
_GUESSES = {
    "star_id": "star_id source_id designation hip hr sao hd tyc name id",
    "ra_deg": "ra_deg ra raicrs ra_icrs radeg raj2000 _raj2000 ra_j2000 alpha",
    "dec_deg": "dec_deg dec deicrs de_icrs dedeg dej2000 _dej2000 dec_j2000 de delta",
    "mag": "mag phot_g_mean_mag gmag g_mag vmag v_mag hpmag vtmag vt_mag",
    "pm_ra_mas_yr": "pm_ra_mas_yr pmra pm_ra pmra_masyr pm_ra_cosdec",
    "pm_dec_mas_yr": "pm_dec_mas_yr pmdec pm_dec pmde pm_de pmdec_masyr",
    "epoch": "epoch ref_epoch epoch_yr",
}
_UNITS = {"ra_deg": "deg", "dec_deg": "deg", "pm_ra_mas_yr": "mas/yr", "pm_dec_mas_yr": "mas/yr"}
_BANDS = {
    "Gaia G": "phot_g_mean_mag gmag g_mag",
    "Johnson V": "vmag v_mag",
    "Hipparcos Hp": "hpmag",
    "Tycho VT": "vtmag vt_mag",
}
# Formats by the names of files, or else by their endings.
_NAMES = {name: kind for kind, layout in LAYOUTS.items() for name in layout["files"]}
_ENDINGS = {".csv": "csv", ".ecsv": "ecsv", ".fits": "fits", ".fit": "fits"}


@bounded
def read_catalogue(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    *,
    format: Format | None = None,
    file_epoch: float | None = None,
    max_mag: float | None = None,
    epoch: float | None = None,
    observer_velocity_km_s: FloatArray | Sequence[float] | None = None,
    require_proper_motion: bool = False,
    band: str | None = None,
    readme: str | Path | None = None,
) -> StarCatalogue:
    """Stars of a user's own catalogue, in the file's order.

    Tables (CSV, ECSV, FITS; also compressed with gzip) have named columns: directions in ICRS, and
    optionally a magnitude, a name, proper motions (in right ascension *times cos(dec)*) and an
    epoch. Units stated in the table are converted; without them, angles are deg and proper motions
    mas/yr.

    Three catalogues of the CDS are read as they are distributed, their units, equinox and epoch
    being known:

    - "hipparcos": The Hipparcos Catalogue, I/239, `hip_main.dat`. ICRS at J1991.25.
    - "sao": the SAO catalogue, I/131A, `sao.dat`. FK5 J2000 columns, turned to ICRS; 0.1 to 1
      arcsec at J2000.
    - "bsc": the Bright Star Catalogue, V/50, `catalog`. FK5 J2000, turned to ICRS; rounded to 0.1 s
      and 1 arcsec.

    Their entries without a position (and those that SAO marks as deleted) are left out; `source`
    says how many.

    Parameters
    ----------
    path
        The file.
    columns
        For tables: names of this package to names in the file, such as ``{"ra_deg": "RA_corr",
        "mag": "imag"}``. The names of this package are star_id, ra_deg, dec_deg, mag, pm_ra_mas_yr,
        pm_dec_mas_yr and epoch (Julian year of each position). Those not given are looked for under
        their usual names (ra, RAICRS, pmRA, Vmag, ...).
    format
        "csv", "ecsv", "fits", "hipparcos", "sao" or "bsc"; by default from the file's name.
    file_epoch
        Julian year of the positions. Tables that hold no epoch (a column, or the key "epoch" of
        their metadata) need it: "J2000" in a column's name is an equinox. Not for the catalogues of
        the CDS.
    max_mag
        Faintest magnitude, in the band of the file's magnitude column (`band` of the result:
        Johnson V for the three catalogues of the CDS, photographic-visual in parts of SAO). Stars
        without a magnitude are then left out.
    epoch
        Julian year to move the stars to; by default that of the file (the latest, if rows differ).
    observer_velocity_km_s
        Makes the directions apparent, as in `load_catalogue`.
    require_proper_motion
        Leave out stars without a proper motion.
    band
        Name of the photometric band, if the column's name does not tell.
    readme
        For the CDS: the ReadMe to take the columns' places from. By default, the file "ReadMe"
        beside the catalogue if it describes the needed columns, and else the published layout.

    Raises
    ------
    CatalogueError
        One sentence that names the file and, where there is one, the row (the line of a text file),
        the column and the remedy.
    """
    path = Path(path)
    data = read_bytes(path, "the file of a catalogue", CatalogueError)
    kind = _format_of(path) if format is None else format
    with reading(path, f"readable as {kind.upper()}", "check the file", CatalogueError):
        if kind in LAYOUTS:
            if columns is not None or file_epoch is not None:
                raise CatalogueError(
                    f"{path}: the columns and the epoch of format {kind!r} are fixed; leave them "
                    "out."
                )
            stars = _read_cds(path, data, kind, readme, band)
        elif kind in _ENDINGS.values():
            stars = _read_table(path, data, kind, dict(columns or {}), file_epoch, epoch, band)
        else:
            raise CatalogueError(
                f"{path}: unknown format {kind!r}; use csv, ecsv, fits, hipparcos, sao or bsc."
            )
    if max_mag is not None and not np.isfinite(stars.mag).any():
        raise CatalogueError(
            f"{path}: has no magnitudes to cut at {max_mag:g}; leave out max_mag or name the "
            "column."
        )
    return prepare(stars, max_mag, epoch, observer_velocity_km_s, require_proper_motion)


@dataclass(frozen=True)
class _Source:
    """A table, and names of this package to names in the file."""

    path: Path
    table: RawTable
    names: Mapping[str, str]

    def fail(self, name: str, row: int, what: str, remedy: str) -> CatalogueError:
        return CatalogueError(
            f"{self.path}, {self.table.word} {self.table.numbers[row]}, column "
            f"{self.names.get(name, name)!r}: {what}; {remedy}."
        )

    def numbers(self, name: str) -> FloatArray:
        """A column as floats in this package's unit; NaN where the file has no value."""
        own = self.names.get(name, name)
        cells = self.table.columns.get(own)
        if cells is None:
            return np.full(len(self.table.numbers), np.nan)
        if isinstance(cells, list):
            values = np.full(len(cells), np.nan)
            for row, cell in enumerate(map(str.strip, cells)):
                try:
                    values[row] = float(cell) if cell else np.nan
                except ValueError:
                    what = f"{cell!r} is not a number"
                    raise self.fail(name, row, what, "write decimal numbers") from None
            cells = values
        unit, wanted = self.table.units.get(own, ""), _UNITS.get(name, "")
        found = in_unit(self.path, floats(cells), unit, wanted) if wanted else floats(cells)
        if found is None:
            raise CatalogueError(
                f"{self.path}, column {own!r}: the unit {unit!r} cannot be converted to {wanted}; "
                "correct the unit or name another column."
            )
        return found

    def within(self, name: str, values: FloatArray, low: float, high: float, unit: str) -> None:
        """Refuse values out of range, and those that are missing."""
        bad = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(bad):
            value = values[bad[0]]
            what = f"{value:g}{unit} is outside [{low:g}, {high:g}]"
            more = f" ({len(bad) - 1} more such rows)" if len(bad) > 1 else ""
            what = ("has no value" if np.isnan(value) else what) + more
            raise self.fail(name, int(bad[0]), what, "correct or remove the row")

    def motions(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Both components of the proper motion, zero where it is not known, and where it is."""
        ra, dec = self.numbers("pm_ra_mas_yr"), self.numbers("pm_dec_mas_yr")
        known = np.isfinite(ra) & np.isfinite(dec)
        return np.where(known, ra, 0.0), np.where(known, dec, 0.0), known


def _read_cds(
    path: Path, data: bytes, kind: str, readme: str | Path | None, band: str | None
) -> StarCatalogue:
    layout, (table, left_out) = LAYOUTS[kind], read_cds(path, data, kind, readme)
    names = {
        "mag": "Vmag",
        **dict(zip(("pm_ra_mas_yr", "pm_dec_mas_yr"), layout["pm"], strict=True)),
    }
    source = _Source(path, table, names)

    def angle(labels: Sequence[str], low: float, high: float, unit: float = 1.0) -> FloatArray:
        """Degrees from one label, or from sexagesimal parts with an optional sign."""
        sign = np.ones(len(table.numbers))
        if labels[0].endswith("-"):
            # The sign stands in a column of its own, which keeps it for declinations of -00.
            sign = np.where(np.array(table.columns[labels[0]]) == "-", -1.0, 1.0)
            labels = labels[1:]
        parts = [source.numbers(label) for label in labels]
        for label, part in zip(labels[1:], parts[1:], strict=True):
            source.within(label, part, 0.0, 60.0, "")
        total = sign * unit * sum(part / 60.0**place for place, part in enumerate(parts))
        source.within(labels[0], total, low, high, " deg")
        return floats(total)

    ra = angle(layout["ra"], 0.0, 360.0, 15.0 if len(layout["ra"]) > 1 else 1.0)
    dec = angle(layout["dec"], -90.0, 90.0)
    number = source.numbers(layout["prefix"])
    source.within(layout["prefix"], number, 0.0, np.inf, "")
    mag = source.numbers("mag")
    pm_ra, pm_dec, known = source.motions()
    if kind != "hipparcos":
        in_seconds = layout.get("pm_ra_in_seconds", False)
        ra, dec, pm_ra, pm_dec = fk5_to_icrs(ra, dec, pm_ra, pm_dec, in_seconds)
    return StarCatalogue(
        star_id=np.array([f"{layout['prefix']} {n:.0f}" for n in number], dtype=np.str_),
        ra_deg=ra,
        dec_deg=dec,
        mag=np.where(mag > _FAINTEST_BELIEVABLE, np.nan, mag),
        pm_ra_mas_yr=np.where(known, pm_ra, 0.0),
        pm_dec_mas_yr=np.where(known, pm_dec, 0.0),
        has_proper_motion=known,
        epoch=layout["epoch"],
        band=band or layout["band"],
        apparent=False,
        source=f"{layout['title']}, {path}"
        + (f" ({left_out} entries without a position left out)" if left_out else ""),
    )


def _read_table(
    path: Path,
    data: bytes,
    kind: str,
    columns: dict[str, str],
    file_epoch: float | None,
    epoch: float | None,
    band: str | None,
) -> StarCatalogue:
    content = b"".join(unpack(data))
    table = _fits_table(content) if kind == "fits" else read_cells(path, content, f".{kind}")
    if table.uneven:
        raise ValueError(next(iter(table.uneven.values())))
    source = _Source(path, table, _find_columns(path, table.names, columns))
    if not len(table.numbers):
        raise CatalogueError(f"{path}: holds no stars.")
    ra, dec = source.numbers("ra_deg"), source.numbers("dec_deg")
    source.within("ra_deg", ra, 0.0, 360.0, " deg")
    source.within("dec_deg", dec, -90.0, 90.0, " deg")
    pm_ra, pm_dec, known = source.motions()
    for name, motion in (("pm_ra_mas_yr", pm_ra), ("pm_dec_mas_yr", pm_dec)):
        bad = np.flatnonzero(np.abs(motion) > MAX_PROPER_MOTION_MAS_YR)
        if len(bad):
            what = f"a proper motion of {motion[bad[0]]:g} mas/yr is faster than any star's"
            remedy = "convert it to mas/yr, or state its unit in the table"
            raise source.fail(name, int(bad[0]), what, remedy)
    epochs = _epochs(source, file_epoch)
    common = check_epoch(float(epochs.max()) if epoch is None else epoch)
    ra, dec, pm_ra, pm_dec = propagate_proper_motion(ra, dec, pm_ra, pm_dec, common - epochs)
    return StarCatalogue(
        star_id=_star_ids(source),
        ra_deg=ra,
        dec_deg=dec,
        mag=source.numbers("mag"),
        pm_ra_mas_yr=pm_ra,
        pm_dec_mas_yr=pm_dec,
        has_proper_motion=known,
        epoch=common,
        band=band or _band_of(source.names.get("mag")),
        apparent=False,
        source=str(path),
    )


def _fits_table(content: bytes) -> RawTable:
    with extra("images", "catalogue files"):
        from astropy.table import Table
        from astropy.utils.exceptions import AstropyWarning

    check_fits(content)
    with warnings.catch_warnings():
        # What is odd matters only in a column that is used, whose conversion complains about it;
        # but a cut-off file is no catalogue.
        warnings.simplefilter("ignore", AstropyWarning)
        warnings.filterwarnings("error", "File may have been truncated", AstropyWarning)
        table = Table.read(io.BytesIO(content), format="fits")
    columns: dict[str, Any] = {}
    for name in table.colnames:
        cells = np.ma.asarray(table[name])
        plain = cells.dtype.kind in "iuf" and not np.any(cells.mask)
        columns[name] = cells.data if plain else np.ma.filled(cells.astype(str), "").tolist()
    units = {name: str(table[name].unit or "") for name in table.colnames}
    rows = np.arange(1, len(table) + 1)
    return RawTable(columns, list(table.colnames), rows, "row", dict(table.meta), units)


def _find_columns(path: Path, present: list[str], given: dict[str, str]) -> dict[str, str]:
    """Names of this package to names in the file."""
    listing = listed(present) or "none"
    for name, column in given.items():
        if name not in _GUESSES:
            raise CatalogueError(
                f"{path}: columns names {name!r}, which is none of {', '.join(_GUESSES)}."
            )
        if column not in present:
            raise CatalogueError(f"{path}: has no column {column!r} for {name}; it has {listing}.")
    lower = {column.lower(): column for column in reversed(present)}
    columns = dict(given)
    for name, guesses in _GUESSES.items():
        hit = next((lower[guess] for guess in guesses.split() if guess in lower), None)
        if name not in columns and hit is not None:
            columns[name] = hit
    for name in ("ra_deg", "dec_deg"):
        if name not in columns:
            raise CatalogueError(
                f'{path}: no column is known as {name}; name it with columns={{"{name}": ...}}, '
                f"among {listing}."
            )
    if ("pm_ra_mas_yr" in columns) != ("pm_dec_mas_yr" in columns):
        missing = "pm_dec_mas_yr" if "pm_ra_mas_yr" in columns else "pm_ra_mas_yr"
        raise CatalogueError(
            f"{path}: has half of a proper motion but no {missing}; name it, among {listing}."
        )
    return columns


def _epochs(source: _Source, file_epoch: float | None) -> FloatArray:
    """Julian year of every position."""
    n = len(source.table.numbers)
    if file_epoch is not None:
        return np.full(n, check_epoch(file_epoch))
    if "epoch" in source.names:
        epochs = source.numbers("epoch")
        bad = np.flatnonzero(~((epochs >= 1800.0) & (epochs <= 2200.0)))
        if len(bad):
            what = f"{epochs[bad[0]]:g} is not a Julian year between 1800 and 2200"
            raise source.fail("epoch", int(bad[0]), what, "write years, or give file_epoch")
        return epochs
    for key, value in source.table.meta.items():
        text = str(value).strip().lstrip("Jj")
        if key.lower() == "epoch" and re.fullmatch(r"\d{4}(\.\d*)?", text):
            return np.full(n, check_epoch(float(text)))
    raise CatalogueError(
        f"{source.path}: does not say the epoch of its positions; give it as a Julian year, such "
        "as file_epoch=2016.0."
    )


def _star_ids(source: _Source) -> StrArray:
    column = source.names.get("star_id")
    if column is None:
        return np.array([f"row {n + 1}" for n in range(len(source.table.numbers))], dtype=np.str_)
    texts = [str(cell).strip() for cell in source.table.columns[column]]
    numbered = column.lower() in ("hip", "hr", "sao", "hd") and "".join(texts).isdigit()
    prefix = f"{column.upper()} " if numbered else ""
    return np.array([prefix + text if text else "" for text in texts], dtype=np.str_)


def _band_of(column: str | None) -> str:
    if column is None:
        return "no band (the file has no magnitudes)"
    known = (band for band, names in _BANDS.items() if column.lower() in names.split())
    return next(known, f"the file's own band (column {column!r})")


def _format_of(path: Path) -> str:
    name = path.name.lower().removesuffix(".gz")
    kind = _NAMES.get(name) or _ENDINGS.get(Path(name).suffix)
    if kind is None:
        raise CatalogueError(
            f"{path}: the name does not tell the format; give format='csv', 'ecsv', 'fits', "
            "'hipparcos' (I/239), 'sao' (I/131A) or 'bsc' (V/50)."
        )
    return kind
