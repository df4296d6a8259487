"""Hipparcos, SAO and the Bright Star Catalogue as the CDS distributes them, read through astropy's
reader of its ReadMe.

The layout of a file is given by the "Byte-by-byte Description" of the ReadMe that comes with it.
Where that is not at hand, the description of the few needed columns below is used in its place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from starcal_uq.core.errors import CatalogueError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import reading, unpack
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
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
_COLUMN = re.compile(
    r"\s*(?P<bytes>(\d+\s*-)?\s*\d+)\s+(?P<kind>[AIFED])(?P<width>\d+)\S*\s+(?P<unit>\S+)\s+(?P<label>\S+)(\s|$)"
)
_FAINTEST_BELIEVABLE = 90.0


def read_cds(path: Path, kind: CdsFormat, readme: Path | None) -> StarCatalogue:
    """All stars of a catalogue that have a position, ICRS at the catalogue's own epoch; the file
    may be gzipped.

    Without a `readme`, the file "ReadMe" beside it is taken if it describes the needed columns,
    else the published layout.
    """
    layout = _LAYOUTS[kind]
    lines = _text(path).split("\n")
    kept = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    if not kept:
        raise CatalogueError(f"{path}: is empty; give the data file of {layout.title}.")
    rows = _Rows(path, layout, np.array([number for number, _ in kept]), {})
    description = _description(path, layout, readme)
    rows.columns.update(_parse(rows, description, [line for _, line in kept]))

    present = rows.present(layout.ra) & rows.present(layout.dec)
    if layout.deleted is not None:
        present &= rows.columns[layout.deleted] != "D"
    nameless = np.flatnonzero(present & ~np.isfinite(rows.columns[layout.number]))
    if len(nameless):
        raise rows.fail(int(nameless[0]), layout.number, "has no value")
    if not present.any():
        raise CatalogueError(
            f"{path}: no line holds a position where {layout.title} has it; check the format."
        )
    ra, dec = (
        rows.angle(layout.ra, present) * (15.0 if len(layout.ra) > 1 else 1.0),
        rows.angle(layout.dec, present),
    )
    rows.check_range(layout.ra[0], ra, 0.0, 360.0, present)
    rows.check_range(layout.dec[-min(3, len(layout.dec))], dec, -90.0, 90.0, present)
    ra, dec = ra[present], dec[present]
    pm_ra, pm_dec = (rows.columns[label][present] for label in layout.pm)
    known = np.isfinite(pm_ra) & np.isfinite(pm_dec)
    pm_ra, pm_dec = np.where(known, pm_ra, 0.0), np.where(known, pm_dec, 0.0)
    if kind != "hipparcos":
        ra, dec, pm_ra, pm_dec = _fk5_to_icrs(ra, dec, pm_ra, pm_dec, layout.pm_ra_in_seconds)
    left_out = int((~present).sum())
    return StarCatalogue(
        star_id=np.array(
            [f"{layout.prefix} {n:.0f}" for n in rows.columns[layout.number][present]],
            dtype=np.str_,
        ),
        ra_deg=ra,
        dec_deg=dec,
        mag=rows.columns[layout.mag][present],
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
    """Columns by the labels of the layout: floats with NaN for blanks, or text; with what error
    messages need.
    """

    path: Path
    layout: _Layout
    line_numbers: IntArray
    columns: dict[str, Any]

    def fail(self, row: int, label: str, what: str) -> CatalogueError:
        return CatalogueError(
            f"{self.path}, line {self.line_numbers[row]}, column {label!r}: {what}; correct or "
            "remove the line, or "
            f"check that the file is {self.layout.title}."
        )

    def present(self, labels: tuple[str, ...]) -> BoolArray:
        """Whether every number of an angle is there."""
        numbers = [self.columns[label] for label in labels if not label.endswith("-")]
        finite: BoolArray = np.isfinite(np.array(numbers)).all(axis=0)
        return finite

    def angle(self, labels: tuple[str, ...], present: BoolArray) -> FloatArray:
        """Hours or degrees from one label, or from sexagesimal parts with an optional sign, shape
        (n,).
        """
        sign = np.ones(len(self.line_numbers))
        if labels[0].endswith("-"):
            # The sign stands in a column of its own, which keeps it for declinations of -00.
            sign = np.where(self.columns[labels[0]] == "-", -1.0, 1.0)
            labels = labels[1:]
        total = np.zeros(len(sign))
        for place, label in enumerate(labels):
            part: FloatArray = self.columns[label]
            if place:
                self.check_range(label, part, 0.0, 60.0, present)
            total += part / 60.0**place
        return sign * total

    def check_range(
        self, label: str, values: FloatArray, low: float, high: float, present: BoolArray
    ) -> None:
        bad = np.flatnonzero(present & ~((values >= low) & (values <= high)))
        if len(bad):
            raise self.fail(
                int(bad[0]), label, f"{values[bad[0]]:g} is outside [{low:g}, {high:g}]"
            )


def _parse(rows: _Rows, description: list[str], lines: list[str]) -> dict[str, Any]:
    """The needed columns through astropy's reader, named by the labels of the layout."""
    with extra("images", "catalogue files"):
        from astropy.io import ascii

    # A list is read with the description at its head, whatever the file is called and however it is
    # compressed.
    reader = ascii.get_reader(ascii.Cds)
    try:
        table = reader.read([*description, *lines])
    except Exception as error:  # of whatever kind: the cell is looked for
        raise _locate(rows, reader, error) from error
    columns = {label: _plain(table[label]) for label in rows.layout.labels}
    magnitudes = columns[rows.layout.mag]
    magnitudes[magnitudes > _FAINTEST_BELIEVABLE] = np.nan
    return columns


def _locate(rows: _Rows, reader: Any, error: Exception) -> CatalogueError:
    """The error for the first cell that is not the number which its column should hold."""
    for column in reader.header.cols:
        if column.name.endswith("-") or column.name == rows.layout.deleted:
            continue
        for row, cell in enumerate(getattr(column, "str_vals", [])):
            text = str(cell).strip()
            if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([EeDd][+-]?\d+)?|nan|", text):
                return rows.fail(row, column.name, f"{text!r} is not a number")
    reason = " ".join(str(error).split()).rstrip(".")
    return CatalogueError(
        f"{rows.path}: cannot be read as {rows.layout.title} ({reason}); check the format."
    )


def _plain(column: Any) -> Any:
    """Text as stripped str, numbers as floats with NaN for masked cells."""
    if column.dtype.kind in "iuf":
        return np.ma.filled(np.ma.asarray(column, dtype=np.float64), np.nan)
    return np.char.strip(np.ma.filled(np.ma.asarray(column).astype(str), ""))


def _description(path: Path, layout: _Layout, readme: Path | None) -> list[str]:
    """Lines of a byte-by-byte description that holds the needed columns."""
    beside = path.parent / "ReadMe"
    source = readme if readme is not None else beside if beside.is_file() else None
    if source is not None:
        for section in _text(source).split(_MARK)[1:]:
            needed = _needed(section, layout)
            if needed is not None:
                return needed
        if readme is not None:
            raise CatalogueError(
                f"{readme}: does not describe {layout.title}; leave it out or give its own."
            )
    published = _needed(layout.description, layout)
    if published is None:
        raise CatalogueError(f"{path}: the layout of {layout.title} is not known; give its ReadMe.")
    return published


def _needed(section: str, layout: _Layout) -> list[str] | None:
    """A description of the needed columns only, under the labels of the layout; None if the section
    lacks one.

    In it, every number may be blank. The ReadMe files say so as "*?" or "?Hours", which astropy's
    reader takes for a number that is never blank, or for one whose blank is written "Hours". Fewer
    columns are also read faster.
    """
    lines: dict[str, str] = {}
    for line in section.split("\n"):
        match = _COLUMN.match(line)
        if match is None:
            continue
        label = _OTHER_LABELS.get(match["label"], match["label"])
        if label in layout.labels and label not in lines:
            is_text = match["kind"] == "A"
            kind, note = ("A", "-") if is_text else ("F", "? -")
            lines[label] = (
                f"{match['bytes']:>8}  {kind}{match['width']}  {match['unit']}  {label}  {note}"
            )
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
