"""Hipparcos, SAO and the Bright Star Catalogue as the CDS distributes them, read through astropy's
reader of its ReadMe.

The layout of a file is given by the "Byte-by-byte Description" of the ReadMe that comes with it.
Where that is not at hand, the description of the few needed columns below is used in its place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import reading, unpack
from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.sky.catalogue import StarCatalogue

CdsFormat = Literal["hipparcos", "sao", "bsc"]

_MARK = "Byte-by-byte Description of file:"
_RULE = "-" * 80
_MAS_PER_RAD = 180.0 * 3600.0 * 1000.0 / np.pi


@dataclass(frozen=True)
class _Layout:
    """What is needed of one catalogue: labels of the columns, then the published places of them.

    `ra` and `dec` hold one label (deg), or those of hours, minutes, seconds and of sign, degrees,
    minutes, seconds.
    """

    prefix: str
    title: str
    number: str
    ra: tuple[str, ...]
    dec: tuple[str, ...]
    pm: tuple[str, str]
    mag: str
    band: str
    epoch: float
    description: str
    deleted: str | None = None
    pm_ra_in_seconds: bool = False

    @property
    def labels(self) -> tuple[str, ...]:
        deleted = () if self.deleted is None else (self.deleted,)
        return (self.number, *self.ra, *self.dec, *self.pm, self.mag, *deleted)


_LAYOUTS: dict[str, _Layout] = {
    "hipparcos": _Layout(
        prefix="HIP",
        title="The Hipparcos Catalogue (ESA 1997, I/239)",
        number="HIP",
        ra=("RAICRS",),
        dec=("DEICRS",),
        pm=("pmRA", "pmDE"),
        mag="Vmag",
        band="Johnson V",
        epoch=1991.25,
        description="""\
   9- 14  I6    ---     HIP       Identifier
  42- 46  F5.2  mag     Vmag      ? Magnitude in Johnson V
  52- 63  F12.8 deg     RAICRS    ? alpha, ICRS, epoch J1991.25
  65- 76  F12.8 deg     DEICRS    ? delta, ICRS, epoch J1991.25
  88- 95  F8.2  mas/yr  pmRA      ? Proper motion mu_alpha.cos(delta)
  97-104  F8.2  mas/yr  pmDE      ? Proper motion mu_delta
""",
    ),
    "sao": _Layout(
        prefix="SAO",
        title="SAO Star Catalog J2000 (I/131A)",
        number="SAO",
        ra=("RA2000h", "RA2000m", "RA2000s"),
        dec=("DE2000-", "DE2000d", "DE2000m", "DE2000s"),
        pm=("pmRA2000", "pmDE2000"),
        mag="Vmag",
        band="visual magnitude of SAO",
        epoch=2000.0,
        deleted="delFlag",
        pm_ra_in_seconds=True,
        description="""\
   1-  6  I6    ---      SAO      Catalog number
       7  A1    ---      delFlag  [D] D if the star is deleted
  81- 84  F4.1  mag      Vmag     Visual magnitude, 99.9 if unknown
 151-152  I2    h        RA2000h  ? Hours RA, equinox and epoch J2000
 153-154  I2    min      RA2000m  ? Minutes RA
 155-160  F6.3  s        RA2000s  ? Seconds RA
 161-167  F7.4  s/a      pmRA2000 ? Proper motion in RA, FK5
     168  A1    ---      DE2000-  Sign Dec
 169-170  I2    deg      DE2000d  ? Degrees Dec
 171-172  I2    arcmin   DE2000m  ? Minutes Dec
 173-177  F5.2  arcsec   DE2000s  ? Seconds Dec
 178-183  F6.3  arcsec/a pmDE2000 ? Proper motion in Dec, FK5
""",
    ),
    "bsc": _Layout(
        prefix="HR",
        title="Bright Star Catalogue, 5th revised edition (V/50)",
        number="HR",
        ra=("RAh", "RAm", "RAs"),
        dec=("DE-", "DEd", "DEm", "DEs"),
        pm=("pmRA", "pmDE"),
        mag="Vmag",
        band="Johnson V",
        epoch=2000.0,
        description="""\
   1-  4  I4     ---     HR       Bright Star number
  76- 77  I2     h       RAh      ? Hours RA, equinox and epoch J2000
  78- 79  I2     min     RAm      ? Minutes RA
  80- 83  F4.1   s       RAs      ? Seconds RA
      84  A1     ---     DE-      Sign Dec
  85- 86  I2     deg     DEd      ? Degrees Dec
  87- 88  I2     arcmin  DEm      ? Minutes Dec
  89- 90  I2     arcsec  DEs      ? Seconds Dec
 103-107  F5.2   mag     Vmag     ? Visual magnitude
 149-154  F6.3 arcsec/yr pmRA     ? Proper motion in RA times cos(Dec), FK5
 155-160  F6.3 arcsec/yr pmDE     ? Proper motion in Dec, FK5
""",
    ),
}
# Labels that other editions of a ReadMe use.
_OTHER_LABELS = {"RAdeg": "RAICRS", "DEdeg": "DEICRS"}
# Place, width and label of a column.
_COLUMN = re.compile(
    r"^\s*((?:\d+\s*-)?\s*\d+)\s+[AIFED](\d+)\S*\s+\S+\s+(\S+)(?=\s|$)", re.MULTILINE
)
_FAINTEST_BELIEVABLE = 90.0


def read_cds(path: Path, kind: CdsFormat, readme: Path | None) -> StarCatalogue:
    """All stars of a catalogue that have a position, ICRS at the catalogue's own epoch; the file
    may be gzipped.

    Without a `readme`, the file "ReadMe" beside it is taken if it describes the needed columns,
    else the published layout.
    """
    layout = _LAYOUTS[kind]
    kept = [(n, line) for n, line in enumerate(_text(path).split("\n"), 1) if line.strip()]
    if not kept:
        raise CatalogueError(f"{path}: is empty; give the data file of {layout.title}.")
    line_numbers, lines = zip(*kept, strict=True)
    rows = _Rows(path, layout, line_numbers, _cells(_description(path, layout, readme), lines))

    ra, dec = rows.angle(layout.ra) * 15.0 ** (len(layout.ra) > 1), rows.angle(layout.dec)
    number, mag, pm_ra, pm_dec = map(rows.numbers, (layout.number, layout.mag, *layout.pm))
    present = np.isfinite(ra) & np.isfinite(dec)
    if layout.deleted is not None:
        present &= rows.cells[layout.deleted] != "D"
    rows.refuse(layout.number, present & ~np.isfinite(number), lambda row: "has no value")
    if not present.any():
        raise CatalogueError(
            f"{path}: no line holds a position where {layout.title} has it; check the format."
        )
    for label in (*layout.ra[1:], *layout.dec[2:]):
        rows.check_range(label, rows.numbers(label), 0.0, 60.0, present)
    rows.check_range(layout.ra[0], ra, 0.0, 360.0, present)
    rows.check_range(layout.dec[-min(3, len(layout.dec))], dec, -90.0, 90.0, present)
    ra, dec, pm_ra, pm_dec = ra[present], dec[present], pm_ra[present], pm_dec[present]
    known = np.isfinite(pm_ra) & np.isfinite(pm_dec)
    pm_ra, pm_dec = np.where(known, pm_ra, 0.0), np.where(known, pm_dec, 0.0)
    if kind != "hipparcos":
        ra, dec, pm_ra, pm_dec = _fk5_to_icrs(ra, dec, pm_ra, pm_dec, layout.pm_ra_in_seconds)
    left_out = int((~present).sum())
    return StarCatalogue(
        star_id=np.array([f"{layout.prefix} {n:.0f}" for n in number[present]], dtype=np.str_),
        ra_deg=ra,
        dec_deg=dec,
        mag=np.where(mag > _FAINTEST_BELIEVABLE, np.nan, mag)[present],
        pm_ra_mas_yr=np.where(known, pm_ra, 0.0),
        pm_dec_mas_yr=np.where(known, pm_dec, 0.0),
        has_proper_motion=known,
        epoch=layout.epoch,
        band=layout.band,
        apparent=False,
        source=f"{layout.title}, {path}"
        + (f" ({left_out} entries without a position left out)" if left_out else ""),
    )


@dataclass(frozen=True)
class _Rows:
    """Cells by the labels of the layout, with what error messages need."""

    path: Path
    layout: _Layout
    line_numbers: Sequence[int]
    cells: dict[str, Any]

    def numbers(self, label: str) -> FloatArray:
        """A column as numbers, NaN where it is blank."""
        values = np.full(len(self.line_numbers), np.nan)
        for row in np.flatnonzero(self.cells[label] != ""):
            cell = str(self.cells[label][row])
            try:
                values[row] = float(cell)
            except ValueError:
                raise self.fail(int(row), label, f"{cell!r} is not a number") from None
        return values

    def angle(self, labels: tuple[str, ...]) -> FloatArray:
        """Hours or degrees from one label, or from sexagesimal parts with an optional sign, shape
        (n,).
        """
        sign = np.ones(len(self.line_numbers))
        if labels[0].endswith("-"):
            # The sign stands in a column of its own, which keeps it for declinations of -00.
            sign, labels = np.where(self.cells[labels[0]] == "-", -1.0, 1.0), labels[1:]
        total = np.zeros(len(sign))
        for place, label in enumerate(labels):
            total += self.numbers(label) / 60.0**place
        return sign * total

    def check_range(
        self, label: str, values: FloatArray, low: float, high: float, present: BoolArray
    ) -> None:
        bad = present & ~((values >= low) & (values <= high))
        self.refuse(label, bad, lambda row: f"{values[row]:g} is outside [{low:g}, {high:g}]")

    def refuse(self, label: str, bad: BoolArray, what: Callable[[int], str]) -> None:
        """Refuse the first of the rows that are bad, where there is one."""
        if bad.any():
            raise self.fail(int(bad.argmax()), label, what(int(bad.argmax())))

    def fail(self, row: int, label: str, what: str) -> CatalogueError:
        return CatalogueError(
            f"{self.path}, line {self.line_numbers[row]}, column {label!r}: {what}; correct or "
            f"remove the line, or check that the file is {self.layout.title}."
        )


def _cells(description: list[str], lines: Sequence[str]) -> dict[str, Any]:
    """The needed columns as text, through astropy's reader, named by the labels of the layout."""
    with extra("images", "catalogue files"):
        from astropy.io import ascii

    # A list is read with the description at its head, whatever the file is called and however it is
    # compressed.
    table = ascii.get_reader(ascii.Cds).read([*description, *lines])
    return {
        name: np.char.strip(np.ma.filled(np.ma.asarray(table[name]).astype(str), ""))
        for name in table.colnames
    }


def _description(path: Path, layout: _Layout, readme: Path | None) -> list[str]:
    """Lines of a byte-by-byte description that holds the needed columns."""
    beside = path.parent / "ReadMe"
    source = beside if readme is None and beside.is_file() else readme
    sections = [] if source is None else _text(source).split(_MARK)[1:]
    found = next(filter(None, (_needed(section, layout) for section in sections)), None)
    if found is None and readme is not None:
        raise CatalogueError(
            f"{readme}: does not describe {layout.title}; leave it out or give its own."
        )
    return found or _needed(layout.description, layout) or []


def _needed(section: str, layout: _Layout) -> list[str] | None:
    """A description of the needed columns only, under the labels of the layout; None if the section
    lacks one.

    In it, every column is text, because the ReadMe files say that a number may be blank as "*?" or
    "?Hours", which astropy's reader takes for a number that is never blank, or for one whose blank
    is written "Hours". Fewer columns are also read faster.
    """
    lines: dict[str, str] = {}
    for place, width, found in _COLUMN.findall(section):
        label = _OTHER_LABELS.get(found, found)
        if label in layout.labels:
            lines.setdefault(label, f"{place:>8}  A{width}  ---  {label}  -")
    if len(lines) < len(layout.labels):
        return None
    head = "   Bytes Format Units   Label    Explanations"
    return [f"{_MARK} data", _RULE, head, _RULE, *lines.values(), _RULE]


def _text(path: Path) -> str:
    """A text file, unpacked if it is compressed; every byte is one character."""
    with reading(path, "a readable text", "check the path and its permissions", CatalogueError):
        data = b"".join(unpack(path.read_bytes()))
    return data.decode("latin-1").replace("\r\n", "\n")


def _fk5_to_icrs(
    ra_deg: FloatArray,
    dec_deg: FloatArray,
    pm_ra: FloatArray,
    pm_dec: FloatArray,
    pm_ra_in_seconds: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """FK5 at epoch and equinox J2000 to ICRS (the Hipparcos frame), through `erfa.fk52h`.

    Proper motions come in s/yr or arcsec/yr times cos(dec) for right ascension and arcsec/yr for
    declination, and leave in mas/yr.
    """
    import erfa

    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    arcsec = np.pi / (180.0 * 3600.0)
    rate_ra = pm_ra * 15.0 * arcsec if pm_ra_in_seconds else pm_ra * arcsec / np.cos(dec)
    # A parallax of 1 arcsec: with none, erfa would find the star faster than light and drop its
    # motion. It cancels.
    new_ra, new_dec, rate_ra, rate_dec, _, _ = erfa.fk52h(
        ra, dec, rate_ra, pm_dec * arcsec, 1.0, 0.0
    )
    return (
        np.degrees(new_ra) % 360.0,
        np.degrees(new_dec),
        rate_ra * np.cos(new_dec) * _MAS_PER_RAD,
        rate_dec * _MAS_PER_RAD,
    )
