"""Readers for a user's own star catalogue: tables with named columns, and three catalogues in the
format of the CDS.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import check_fits, listed, reading, unpack
from starcal_uq.core.types import AnyDict, FloatArray, IntArray, StrArray, floats
from starcal_uq.sky.catalogue import StarCatalogue, check_epoch, prepare
from starcal_uq.sky.cds import CdsFormat, read_cds
from starcal_uq.sky.positions import propagate_proper_motion

Format = Literal["csv", "ecsv", "fits", "hipparcos", "sao", "bsc"]

# Barnard's star, the fastest, moves 10,400 mas/yr.
MAX_PROPER_MOTION_MAS_YR = 11000.0

# Names under which columns are found without being told, first hit wins; compared without regard to
# case. Columns of equinox B1950 are left out on purpose: their names must not be mistaken.
_GUESSES: dict[str, tuple[str, ...]] = {
    "star_id": (
        "star_id",
        "source_id",
        "designation",
        "hip",
        "hr",
        "sao",
        "hd",
        "tyc",
        "name",
        "id",
    ),
    "ra_deg": (
        "ra_deg",
        "ra",
        "raicrs",
        "ra_icrs",
        "radeg",
        "raj2000",
        "_raj2000",
        "ra_j2000",
        "alpha",
    ),
    "dec_deg": (
        "dec_deg",
        "dec",
        "deicrs",
        "de_icrs",
        "dedeg",
        "dej2000",
        "_dej2000",
        "dec_j2000",
        "de",
        "delta",
    ),
    "mag": ("mag", "phot_g_mean_mag", "gmag", "g_mag", "vmag", "v_mag", "hpmag", "vtmag", "vt_mag"),
    "pm_ra_mas_yr": ("pm_ra_mas_yr", "pmra", "pm_ra", "pmra_masyr", "pm_ra_cosdec"),
    "pm_dec_mas_yr": ("pm_dec_mas_yr", "pmdec", "pm_dec", "pmde", "pm_de", "pmdec_masyr"),
    "epoch": ("epoch", "ref_epoch", "epoch_yr"),
}
_UNITS = {
    "ra_deg": "deg",
    "dec_deg": "deg",
    "pm_ra_mas_yr": "mas/yr",
    "pm_dec_mas_yr": "mas/yr",
    "epoch": "yr",
}
_BANDS = {
    "phot_g_mean_mag": "Gaia G",
    "gmag": "Gaia G",
    "g_mag": "Gaia G",
    "vmag": "Johnson V",
    "v_mag": "Johnson V",
    "hpmag": "Hipparcos Hp",
    "vtmag": "Tycho VT",
    "vt_mag": "Tycho VT",
}
_CDS_NAMES: dict[str, Format] = {
    "hip_main.dat": "hipparcos",
    "sao.dat": "sao",
    "catalog": "bsc",
    "catalog.dat": "bsc",
    "bsc5.dat": "bsc",
}
_ENDINGS: dict[str, Format] = {".csv": "csv", ".ecsv": "ecsv", ".fits": "fits", ".fit": "fits"}


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
    if path.is_dir():
        raise CatalogueError(f"{path}: is a folder; give the catalogue's file.")
    if not path.exists():
        raise CatalogueError(f"{path}: does not exist; check the path.")
    kind = _format_of(path) if format is None else format
    with reading(path, f"readable as {kind.upper()}", "check the file", CatalogueError):
        if kind in ("hipparcos", "sao", "bsc"):
            if columns is not None or file_epoch is not None:
                raise CatalogueError(
                    f"{path}: the columns and the epoch of format {kind!r} are fixed; leave them "
                    "out."
                )
            stars = _checked_cds(path, kind, None if readme is None else Path(readme), band)
        elif kind in ("csv", "ecsv", "fits"):
            stars = _read_table(path, kind, dict(columns or {}), file_epoch, epoch, band)
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
    """A table with what error messages need: file, format, and the line of the file that each row
    comes from.
    """

    path: Path
    kind: Format
    table: Any
    names: dict[str, str]

    def fail(self, name: str, row: int, what: str, remedy: str) -> CatalogueError:
        column = self.names[name]
        return CatalogueError(
            f"{self.path}, {self.place(row)}, column {column!r}: {what}; {remedy}."
        )

    def place(self, row: int) -> str:
        return f"row {row + 1}" if self.kind == "fits" else f"line {_text_line(self.path, row)}"

    def numbers(self, name: str) -> FloatArray:
        """A column as floats in this package's unit; NaN where the file has no value."""
        column = self.table[self.names[name]]
        values = np.ma.filled(
            np.ma.asarray(_as_floats(self, name, column), dtype=np.float64), np.nan
        )
        unit, wanted = getattr(column, "unit", None), _UNITS.get(name)
        if unit is None or wanted is None or name == "epoch":
            return values
        with extra("images", "catalogue files"):
            from astropy.units import Unit, UnitsError

        try:
            return floats(Unit(unit).to(Unit(wanted), values))
        except (UnitsError, TypeError, ValueError) as error:
            raise CatalogueError(
                f"{self.path}, column {self.names[name]!r}: the unit {str(unit)!r} cannot be "
                f"converted to {wanted}; "
                "correct the unit or name another column."
            ) from error


def _read_table(
    path: Path,
    kind: Format,
    columns: dict[str, str],
    file_epoch: float | None,
    epoch: float | None,
    band: str | None,
) -> StarCatalogue:
    table = _load_table(path, kind)
    source = _Source(path, kind, table, _find_columns(path, list(table.colnames), columns))
    n = len(table)
    if n == 0:
        raise CatalogueError(f"{path}: holds no stars.")
    ra, dec = source.numbers("ra_deg"), source.numbers("dec_deg")
    _check_positions(source, ra, dec)
    pm_ra, pm_dec = (_motion(source, name) for name in ("pm_ra_mas_yr", "pm_dec_mas_yr"))
    known = np.isfinite(pm_ra) & np.isfinite(pm_dec)
    pm_ra, pm_dec = np.where(known, pm_ra, 0.0), np.where(known, pm_dec, 0.0)
    epochs = _epochs(source, file_epoch)
    common = check_epoch(float(epochs.max()) if epoch is None else epoch)
    ra, dec, pm_ra, pm_dec = propagate_proper_motion(ra, dec, pm_ra, pm_dec, common - epochs)
    return StarCatalogue(
        star_id=_star_ids(source),
        ra_deg=ra,
        dec_deg=dec,
        mag=source.numbers("mag") if "mag" in source.names else np.full(n, np.nan),
        pm_ra_mas_yr=pm_ra,
        pm_dec_mas_yr=pm_dec,
        has_proper_motion=known,
        epoch=common,
        band=band or _band_of(source.names.get("mag")),
        apparent=False,
        source=str(path),
    )


def _checked_cds(
    path: Path, kind: CdsFormat, readme: Path | None, band: str | None
) -> StarCatalogue:
    stars = read_cds(path, kind, readme)
    return stars if band is None else StarCatalogue(**{**vars(stars), "band": band})


def _load_table(path: Path, kind: Format) -> Any:
    with extra("images", "catalogue files"):
        from astropy.table import Table
        from astropy.utils.exceptions import AstropyWarning

    options: AnyDict = {
        "csv": {"format": "ascii.csv", "comment": "#"},
        "ecsv": {"format": "ascii.ecsv"},
        "fits": {"format": "fits"},
    }[kind]
    content = b"".join(unpack(path.read_bytes()))
    if kind == "fits":
        check_fits(content)
    with warnings.catch_warnings():
        # What is odd matters only in a column that is used, whose conversion complains about it;
        # but a cut-off file is no catalogue.
        warnings.simplefilter("ignore", AstropyWarning)
        warnings.filterwarnings("error", "File may have been truncated", AstropyWarning)
        return Table.read(path, **options)


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
        hit = next((lower[guess] for guess in guesses if guess in lower), None)
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


def _as_floats(source: _Source, name: str, column: Any) -> Any:
    if getattr(column, "dtype", np.dtype(object)).kind in "iuf":
        return column
    text = np.ma.filled(np.ma.asarray(column).astype(str), "")
    values = np.full(len(text), np.nan)
    for row, cell in enumerate(text):
        stripped = str(cell).strip()
        try:
            values[row] = float(stripped) if stripped else np.nan
        except ValueError as error:
            raise source.fail(
                name, row, f"{stripped!r} is not a number", "write decimal numbers"
            ) from error
    return values


def _check_positions(source: _Source, ra: FloatArray, dec: FloatArray) -> None:
    for name, values, low, high in (("ra_deg", ra, 0.0, 360.0), ("dec_deg", dec, -90.0, 90.0)):
        bad = np.flatnonzero(~((values >= low) & (values <= high)))
        if len(bad):
            value = values[bad[0]]
            what = (
                "has no value"
                if np.isnan(value)
                else f"{value:g} deg is outside [{low:g}, {high:g}]"
            )
            more = f" ({len(bad) - 1} more such rows)" if len(bad) > 1 else ""
            raise source.fail(name, int(bad[0]), what + more, "correct or remove the row")


def _motion(source: _Source, name: str) -> FloatArray:
    """One component of the proper motion, NaN where it is not known."""
    if name not in source.names:
        return np.full(len(source.table), np.nan)
    values = source.numbers(name)
    bad = np.flatnonzero(np.abs(values) > MAX_PROPER_MOTION_MAS_YR)
    if len(bad):
        what = f"a proper motion of {values[bad[0]]:g} mas/yr is faster than any star's"
        raise source.fail(
            name, int(bad[0]), what, "convert it to mas/yr, or state its unit in the table"
        )
    return values


def _epochs(source: _Source, file_epoch: float | None) -> FloatArray:
    """Julian year of every position."""
    n = len(source.table)
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
        if key.lower() == "epoch":
            text = str(value).strip().lstrip("Jj")
            if re.fullmatch(r"\d{4}(\.\d*)?", text):
                return np.full(n, check_epoch(float(text)))
    raise CatalogueError(
        f"{source.path}: does not say the epoch of its positions; give it as a Julian year, such "
        "as file_epoch=2016.0."
    )


def _star_ids(source: _Source) -> StrArray:
    if "star_id" not in source.names:
        return np.array([f"row {row + 1}" for row in range(len(source.table))], dtype=np.str_)
    column = source.names["star_id"]
    values = source.table[column]
    prefix = (
        f"{column.upper()} "
        if column.lower() in ("hip", "hr", "sao", "hd") and values.dtype.kind in "iu"
        else ""
    )
    text: StrArray = np.ma.filled(np.ma.asarray(values).astype(str), "")
    return np.array([prefix + str(value).strip() if value else "" for value in text], dtype=np.str_)


def _band_of(column: str | None) -> str:
    if column is None:
        return "no band (the file has no magnitudes)"
    return _BANDS.get(column.lower(), f"the file's own band (column {column!r})")


def _format_of(path: Path) -> Format:
    name = path.name.lower().removesuffix(".gz")
    kind = _CDS_NAMES.get(name) or _ENDINGS.get(Path(name).suffix)
    if kind is None:
        raise CatalogueError(
            f"{path}: the name does not tell the format; give format='csv', 'ecsv', 'fits', "
            "'hipparcos' (I/239), "
            "'sao' (I/131A) or 'bsc' (V/50)."
        )
    return kind


def _text_line(path: Path, row: int) -> int:
    """Line, from 1, of a data row of a CSV or ECSV file: comments and empty lines count, the header
    is one line.
    """
    with extra("images", "catalogue files"):
        from astropy.utils.data import get_readable_fileobj

    with get_readable_fileobj(path) as file:
        lines: IntArray = np.array(
            [
                number
                for number, line in enumerate(file, 1)
                if line.strip() and not line.startswith("#")
            ],
            dtype=np.int64,
        )
    return int(lines[min(row + 1, len(lines) - 1)])
