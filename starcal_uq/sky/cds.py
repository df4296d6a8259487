"""Hipparcos, SAO and the Bright Star Catalogue as the CDS distributes them, read through astropy.

The layout of a file is given by the "Byte-by-byte Description" of the ReadMe that comes with it.
Where that is not at hand, the published places of the few needed columns are used (`layouts.toml`).
"""

from __future__ import annotations

import re
import tomllib
from importlib.resources import files
from pathlib import Path

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import unpack
from starcal_uq.core.tables import RawTable
from starcal_uq.core.types import AnyDict, FloatArray, PathLike, StrArray

LAYOUTS: dict[str, AnyDict] = tomllib.loads(
    (files(__package__) / "layouts.toml").read_text("utf-8")
)
# Labels that other editions of a ReadMe use.
_OTHER_LABELS = {"RAdeg": "RAICRS", "DEdeg": "DEICRS"}
# First and last byte, and label of a column.
_COLUMN = re.compile(
    r"^\s*(?:(\d+)\s*-)?\s*(\d+)\s+[AIFED]\d+\S*\s+\S+\s+(\S+)(?=\s|$)", re.MULTILINE
)


def read_cds(
    path: Path, content: bytes, kind: str, readme: PathLike | None
) -> tuple[RawTable, int]:
    """The needed columns of all stars that have a position, as texts by their labels, and how many
    have none.

    Without a `readme`, the file "ReadMe" beside the catalogue is taken if it describes the needed
    columns, else the published layout.
    """
    layout = LAYOUTS[kind]
    places = layout["places"]
    beside = path.parent / "ReadMe"
    source = beside if readme is None and beside.is_file() else readme
    if source is not None:
        described = map(_described, _text(Path(source).read_bytes()).split("Byte-by-byte")[1:])
        found = next((one for one in described if places.keys() <= one.keys()), None)
        if found is None and readme is not None:
            raise CatalogueError(
                f"{readme}: does not describe {layout['title']}; leave it out or give its own."
            )
        places = {label: (found or places)[label] for label in places}
    lines = [(n, line) for n, line in enumerate(_text(content).split("\n"), 1) if line.strip()]
    cells = _cells(places, [line for _, line in lines])
    needed = [label for label in (*layout["ra"], *layout["dec"]) if not label.endswith("-")]
    present = np.all([cells[label] != "" for label in needed], axis=0)
    if "deleted" in layout:
        present &= cells[layout["deleted"]] != "D"
    if not present.any():
        raise CatalogueError(
            f"{path}: no line holds a position where {layout['title']} has it; check the format."
        )
    numbers = np.array([number for number, _ in lines])
    columns = {label: texts[present].tolist() for label, texts in cells.items()}
    table = RawTable(columns, list(columns), numbers[present], "line")
    return table, int((~present).sum())


def _cells(places: AnyDict, lines: list[str]) -> dict[str, StrArray]:
    """The needed columns as texts, through astropy's reader of the CDS format.

    Every column is described as text, because a ReadMe may say of a number that it is blank in ways
    that the reader takes for numbers which are never blank.
    """
    with extra("images", "catalogue files"):
        from astropy.io import ascii

    rule = "-" * 80
    described = [
        f"{first:>5}-{last:>5}  A{last - first + 1}  ---  {label}  -"
        for label, (first, last) in places.items()
    ]
    head = ["Byte-by-byte Description of file: data", rule]
    head += ["   Bytes Format Units   Label    Explanations", rule, *described, rule]
    table = ascii.get_reader(ascii.Cds).read([*head, *lines])
    return {
        label: np.char.strip(np.ma.filled(np.ma.asarray(table[label]).astype(str), ""))
        for label in table.colnames
    }


def _described(section: str) -> dict[str, tuple[int, int]]:
    """First and last byte of each column of a byte-by-byte description."""
    places: dict[str, tuple[int, int]] = {}
    for first, last, label in _COLUMN.findall(section):
        places.setdefault(_OTHER_LABELS.get(label, label), (int(first or last), int(last)))
    return places


def _text(content: bytes) -> str:
    """A text, unpacked if it is compressed; every byte is one character."""
    return b"".join(unpack(content)).decode("latin-1").replace("\r\n", "\n")


def fk5_to_icrs(
    ra_deg: FloatArray, dec_deg: FloatArray, pm_ra: FloatArray, pm_dec: FloatArray, in_seconds: bool
) -> tuple[FloatArray, ...]:
    """FK5 at epoch and equinox J2000 to ICRS (the Hipparcos frame), through `erfa.fk52h`.

    Proper motions come in s/yr or arcsec/yr times cos(dec) for right ascension and arcsec/yr for
    declination, and leave in mas/yr.
    """
    import erfa

    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    rate_ra = pm_ra * 15.0 / ARCSEC if in_seconds else pm_ra / ARCSEC / np.cos(dec)
    # A parallax of 1 arcsec: with none, erfa would find the star faster than light and drop its
    # motion. It cancels.
    ra, dec, rate_ra, rate_dec, _, _ = erfa.fk52h(ra, dec, rate_ra, pm_dec / ARCSEC, 1.0, 0.0)
    rates = rate_ra * np.cos(dec), rate_dec
    return np.degrees(ra) % 360.0, np.degrees(dec), *(rate * 1e3 * ARCSEC for rate in rates)
