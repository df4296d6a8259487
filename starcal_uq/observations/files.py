"""File formats of the observations table, as plain columns and metadata."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.files import (
    ENDINGS,
    cell_content,
    listed,
    read_bytes,
    reading,
    shown,
    table_ending,
)
from starcal_uq.core.tables import (
    REMEDY,
    WHAT,
    RawTable,
    arrow_columns,
    in_unit,
    opened,
    own_meta,
    read_cells,
)
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import (
    AnyDict,
    BoolArray,
    FloatArray,
    IntArray,
    PathLike,
)
from starcal_uq.observations.checks import (
    Problem,
    check_columns,
    check_mapping,
    parse_numbers,
    parse_times,
    parse_whole,
    raise_problems,
)
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.matches import read_fits, read_json

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# Formats of other programs, what is written, and what is read.
_OTHERS = (".fits", ".corr", ".json")
WRITTEN = (*ENDINGS, *_OTHERS[:2])
READ = (*ENDINGS, *_OTHERS)


def read_table(
    path: PathLike,
    camera: Camera | None,
    mapping: Mapping[str, str],
    only: Sequence[str] = tuple(COLUMNS),
    check: bool = True,
    frames: IntArray | None = None,
) -> tuple[AnyDict, AnyDict]:
    """Checked columns and metadata of a file; see
    `starcal_uq.observations.table.load_observations`.

    The columns are those of `only`; without `check`, rows are taken to have been checked before. Of
    a Parquet file, the rows can be those of some `frames` alone.
    """
    path = Path(path)
    if os.path.isdir(path):
        raise ObservationError(
            f"{path}: is a directory; name a file of observations, or open a folder of "
            "partitions with "
            "sc.observations.open_partitions."
        )
    ending = table_ending(path, READ)
    names = {name: mapping.get(name, name) for name in COLUMNS}
    wanted = columns_for(names[name] for name in only)
    data = read_bytes(path, "a table of observations", ObservationError)
    chosen = None if frames is None else (names["frame"], frames)
    read = _read if ending in _OTHERS else read_cells
    return checked_table(
        *(path, partial(read, path, data, ending, wanted, chosen), camera, mapping, only),
        check=check,
        whole=frames is None,
    )


def checked_table(
    path: Path,
    read: Callable[[], RawTable],
    camera: Camera | None,
    mapping: Mapping[str, str],
    only: Sequence[str] = tuple(COLUMNS),
    *,
    check: bool = True,
    whole: bool = True,
) -> tuple[AnyDict, AnyDict]:
    """Checked columns and metadata of a table, all rows of it or some, as `read_table` gives those
    of a file.
    """
    check_mapping(mapping)
    names = {name: mapping.get(name, name) for name in COLUMNS}
    with reading(path, WHAT, REMEDY, ObservationError):
        raw = read()
        check_names(path, raw, names, mapping)
        if not len(raw.numbers):
            raise ObservationError(
                f"{path}: the table has a header but no rows; give a table with observations."
            )
        if whole and check:
            _number_frames(raw, names["frame"])
        columns, problems, unknown_frame = convert_columns(
            path, raw, {name: names[name] for name in only}
        )
        if check:
            problems += check_columns(columns, camera, unknown_frame)
        # A message names the column as it is called in this file.
        named = [replace(p, column=names[p.column] if p.column else None) for p in problems]
        raise_problems(str(path), raw.word, raw.numbers, named)
        return columns, table_meta(path, raw, names, mapping)


_LINEAR = re.compile(
    r"(?P<own>.+?)\s*(?:(?P<times>[*/])\s*(?P<factor>[0-9.]+(?:e-?[0-9]+)?)\s*)?(?P<shift>[+-]\s*[0-9.]+(?:e-?[0-9]+)?)?"
)


def _linear(text: str, names: Sequence[str] = ()) -> tuple[str, float, float]:
    """Column, factor and shift of a text such as ``RA [h] * 15`` or ``X - 1``; a column of that
    name goes before.
    """
    found = _LINEAR.fullmatch(text)
    if text in names or found is None:
        return text, 1.0, 0.0
    try:
        factor = float(found["factor"] or 1.0)
        shift = float((found["shift"] or "0").replace(" ", ""))
        return found["own"], factor if found["times"] != "/" else 1.0 / factor, shift
    except (ValueError, ZeroDivisionError):
        return text, 1.0, 0.0


def columns_for(texts: Iterable[str]) -> set[str]:
    """The columns of a file that may be behind these texts, whichever of its names they hold."""
    return {own for text in texts for own in (text, _linear(text)[0])}


def column_behind(text: str, names: Sequence[str]) -> str:
    """The column of a file that a text such as ``RA [h] * 15`` is made of."""
    return _linear(text, names)[0]


def _number_frames(raw: RawTable, own: str) -> None:
    """Number frames that have names, such as those of images, as they come."""
    cells = raw.columns.get(own)
    if not isinstance(cells, list | Texts):
        return
    texts = Texts.of(cells)
    if not any(re.match(r"\s*([-+.]?\d[\d.e+-]*)?\s*$", cell) for cell in texts.names):
        found = {cell: number for number, cell in enumerate(dict.fromkeys(texts))}
        raw.columns[own] = np.array([found[cell] for cell in texts.names])[texts.codes]
        names = list(found)
        raw.meta["frame_names"] = f"0 is {shown(names[0])}, {len(names) - 1} is {shown(names[-1])}"


def _read(path: Path, data: bytes, ending: str, *_: object) -> RawTable:
    """A table in a format of other programs."""
    columns, meta, units = (
        (*read_json(path, data), {}) if ending == ".json" else read_fits(path, data)
    )
    n = len(next(iter(columns.values()), ()))
    return RawTable(columns, list(columns), np.arange(1, n + 1), "row", meta, units)


def check_names(
    path: Path, raw: RawTable, names: Mapping[str, str], mapping: Mapping[str, str]
) -> None:
    """Raise `ObservationError` where a column is missing that is required or was named."""
    there = {c: column_behind(own, raw.names) in raw.names for c, own in names.items()}
    missing = [c for c in names if not there[c] and (COLUMNS[c].required or c in mapping)]
    if missing:
        wanted = ", ".join(names[c] for c in missing)
        lacking = f"columns {wanted} are" if missing[1:] else f"column {wanted} is"
        raise ObservationError(
            f"{path}: {lacking} missing; {say_column(missing, raw.names)}.",
            column=names[missing[0]],
            problems=[f"{path}: column {names[c]} is missing." for c in missing],
        )
    for name in names.values():
        if raw.names.count(name) > 1:
            raise ObservationError(
                f"{path}: column {name} occurs twice; remove or rename one.", column=name
            )


# Degrees in the unit that the name of a column ends with.
_ANGLE_UNIT = re.compile(r".*[ _\[(](?P<unit>h|hours?|rad|radians?)[\])]?", re.IGNORECASE)
_DEGREES = {"h": "15", "r": "57.29577951308232"}


def say_column(missing: Sequence[str], names: Sequence[str]) -> str:
    """How to map `missing` columns to the `names` in a file, with a guess where one begins alike."""
    options = []
    for name in missing:
        quantity, _, unit = name.partition("_")
        near = [own for own in names if own.lower().startswith(quantity)]
        own = near[0] if len(near) == 1 else "NAME"
        if unit == "deg" and (other := _ANGLE_UNIT.fullmatch(own)):
            own += f" * {_DEGREES[other['unit'][0].lower()]}"
        options.append(f'--column "{name}={own}"')
    return (
        f"the file has {listed(names)}: give {' '.join(options)}, or columns={{...}} in Python, "
        "with names from the file"
    )


def convert_columns(
    path: Path, raw: RawTable, names: Mapping[str, str]
) -> tuple[AnyDict, list[Problem], BoolArray]:
    """Typed columns, what was wrong with their cells, and the rows whose frame is unknown."""
    columns: AnyDict = {}
    problems = [Problem(row, None, why) for row, why in raw.uneven.items()]
    unknown_frame = np.zeros(len(raw.numbers), dtype=np.bool_)
    for name, own in names.items():
        own, factor, shift = _linear(own, raw.names)
        cells: Any = raw.columns.get(own)
        if cells is None:
            continue
        kind, as_it_is = COLUMNS[name].kind, (factor, shift) == (1.0, 0.0)
        if kind != "number" and not as_it_is:
            raise ObservationError(
                f"{path}: column {name} holds no quantities; give the name of a column alone."
            )
        typed = isinstance(cells, np.ndarray)
        if not (typed or COLUMNS[name].required or any(map(str.strip, cells))):
            continue  # an optional column without a single value is as good as absent
        bad: list[Problem] = []
        if kind == "number":
            if raw.decimal_comma:
                cells = [cell.replace(",", ".") for cell in cells]
            if not typed:
                cells, bad = parse_numbers(name, cells)
            # Whoever states a factor has left the unit of the file behind.
            unit = raw.units.get(own, "") if factor == 1.0 else ""
            values = _to_unit(path, name, cells, unit)
            columns[name] = values if as_it_is else values * factor + shift
        elif kind == "whole" and typed and cells.dtype.kind in "iu":
            columns[name] = cells
        elif kind == "whole":
            columns[name], bad = parse_whole(name, list(map(str, cells)))
            unknown_frame[[p.row for p in bad]] = True
        elif kind == "time":
            columns[name], bad = parse_times(name, cells)
        else:
            texts = Texts.of(cells).map(str.strip)
            columns[name] = texts.map(cell_content) if raw.spreadsheet else texts
        problems += bad
    return columns, problems, unknown_frame


def _to_unit(path: Path, name: str, values: FloatArray, unit: str) -> FloatArray:
    """`values` of a column that states its unit, as in ECSV and FITS, in the unit that its name
    stands for.
    """
    wanted = COLUMNS[name].unit
    found = values if name == "mag" else in_unit(path, values, unit, wanted)
    if found is None:
        raise ObservationError(
            f"{path}: column {name} has the unit {unit!r}; give it in {wanted}.", column=name
        )
    return found


def table_meta(
    path: Path, raw: RawTable, names: Mapping[str, str], mapping: Mapping[str, str]
) -> AnyDict:
    """The metadata of a table: what the file carries, where it came from, and which columns were
    ignored.
    """
    meta = {"source": str(path), **raw.meta}
    used = {column_behind(own, raw.names) for own in names.values()}
    ignored = [name for name in raw.names if name not in used]
    meta["ignored_columns"] = ignored or list(meta.get("ignored_columns", []))
    if mapping:
        meta["columns"] = dict(mapping)
    if "ra_deg" in mapping or "dec_deg" in mapping:
        # What the file says of its own ra_deg and dec_deg need not hold for other columns.
        meta["directions"] = "undeclared"
    if meta.get("directions", "undeclared") not in ("apparent", "catalogue", "undeclared"):
        raise ObservationError(
            f"{path}: its metadata say directions = {meta['directions']!r}; use apparent, "
            "catalogue or undeclared."
        )
    return meta


@dataclass(frozen=True)
class ParquetSummary:
    """What a Parquet file says of itself without being read.

    `first` and `last` are the smallest and largest value of the column asked for, where the file
    states them.
    """

    n_rows: int
    names: tuple[str, ...]
    meta: AnyDict
    first: int | None
    last: int | None


def parquet_summary(path: Path, column: str) -> ParquetSummary:
    """Rows, columns, metadata and the range of one column of whole numbers, from the end of the
    file.
    """
    with opened(path) as file:
        schema, rows = file.schema_arrow, file.metadata
        names = tuple(schema.names)
        ranges = []
        if column in names:
            place = rows.schema.names.index(column)
            groups = [
                rows.row_group(i).column(place).statistics for i in range(rows.num_row_groups)
            ]
            ranges = [(s.min, s.max) for s in groups if s is not None and s.has_min_max]
        whole = len(ranges) == rows.num_row_groups > 0 and all(
            isinstance(value, int) for r in ranges for value in r
        )
        ends = (min(r[0] for r in ranges), max(r[1] for r in ranges)) if whole else (None, None)
        return ParquetSummary(rows.num_rows, names, own_meta(schema), *ends)


def parquet_column(path: Path, column: str) -> IntArray:
    """One column of whole numbers of a Parquet file, (N,)."""
    with opened(path) as file:
        table = file.read(columns=[column], use_threads=False)
        values = np.asarray(arrow_columns(table)[column])
    if values.dtype.kind not in "iu":
        raise ObservationError(
            f"{path}: column {column} holds no whole numbers; write it again.", column=column
        )
    return np.asarray(values, dtype=np.int64)
