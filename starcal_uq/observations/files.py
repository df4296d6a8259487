"""File formats of the observations table, as plain columns and metadata, in and out.

CSV and ECSV are read cell by cell with the line each row stands on, so that an error can name it.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import (
    ENDINGS,
    as_plain,
    cell_content,
    check_parquet,
    check_size,
    listed,
    reading,
    shown,
    table_ending,
)
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
    from pyarrow.parquet import ParquetFile

    from starcal_uq.camera.camera import Camera

META_KEY = b"starcal_uq"
# What is written, and what is read.
WRITTEN = (*ENDINGS, ".fits", ".corr")
READ = (*WRITTEN, ".json")


@dataclass(frozen=True)
class RawTable:
    """A table as it stands in a file: texts, or numbers where the format has types.

    Of `columns`, by name in the file, Parquet gives only the wanted ones; `names` are those of all.
    `numbers` (N,) are lines (CSV, ECSV) or rows from 1 (Parquet), as `word` says. `problems` are
    rows that do not fit the header. Texts of a `spreadsheet` are those of
    `starcal_uq.core.files.cell_text`; with `decimal_comma`, numbers are written as 0,5.
    """

    columns: AnyDict
    names: list[str]
    numbers: IntArray
    word: str
    meta: AnyDict = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    spreadsheet: bool = False
    decimal_comma: bool = False


WHAT, REMEDY = "a readable table", "write it again"


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ObservationError(f"{path}: the file does not exist; check the path.") from None
    except OSError as error:
        reason = error.strerror
        raise ObservationError(
            f"{path}: cannot be read ({reason}); check its permissions."
        ) from error
    if not data.strip():
        raise ObservationError(f"{path}: the file is empty; give a table of observations.")
    return data


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
    check_mapping(mapping)
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
    data = _read_bytes(path)
    with reading(path, WHAT, REMEDY, ObservationError):
        raw = (
            _read(path, data, ending, wanted)
            if frames is None
            else _read_frames(path, data, wanted, names, frames)
        )
        check_names(path, raw, names, mapping)
        if not len(raw.numbers):
            raise ObservationError(
                f"{path}: the table has a header but no rows; give a table with observations."
            )
        if frames is None and check:
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
    if isinstance(cells, np.ndarray) and cells.dtype.kind == "U":
        cells = cells.tolist()
    if isinstance(cells, list) and not any(
        re.match(r"\s*([-+.]?\d[\d.e+-]*)?\s*$", cell) for cell in cells
    ):
        found = {cell: number for number, cell in enumerate(dict.fromkeys(cells))}
        raw.columns[own] = np.array([found[cell] for cell in cells], dtype=np.int64)
        names = list(found)
        raw.meta["frame_names"] = f"0 is {shown(names[0])}, {len(names) - 1} is {shown(names[-1])}"


def _read(path: Path, data: bytes, ending: str, wanted: set[str]) -> RawTable:
    if ending == ".parquet":
        return _read_parquet(path, data, wanted)
    if ending in (".fits", ".corr", ".json"):
        columns, meta, units = (
            (*read_json(path, data), {}) if ending == ".json" else read_fits(path, data)
        )
        n = len(next(iter(columns.values()), ()))
        return RawTable(columns, list(columns), np.arange(1, n + 1), "row", meta, units)
    return _read_text(path, data, ecsv=ending == ".ecsv")


def check_names(
    path: Path, raw: RawTable, names: Mapping[str, str], mapping: Mapping[str, str]
) -> None:
    """Raise `ObservationError` where a column is missing that is required or was named."""
    there = {c: column_behind(own, raw.names) in raw.names for c, own in names.items()}
    missing = [c for c in names if not there[c] and (COLUMNS[c].required or c in mapping)]
    if missing:
        wanted = names[missing[0]]
        others = f" (so are {', '.join(names[c] for c in missing[1:])})" if missing[1:] else ""
        raise ObservationError(
            f"{path}: column {wanted} is missing{others}; {say_column(missing[0], raw.names)}.",
            column=wanted,
            problems=[f"{path}: column {names[c]} is missing." for c in missing],
        )
    for name in names.values():
        if raw.names.count(name) > 1:
            raise ObservationError(
                f"{path}: column {name} occurs twice; remove or rename one.", column=name
            )


def say_column(name: str, names: Sequence[str]) -> str:
    """How to say which of the `names` in a file is a column."""
    return (
        f'say which it is, as by --column "{name}=NAME" or columns={{...}}, of those in the file '
        f"({listed(names)})"
    )


def convert_columns(
    path: Path, raw: RawTable, names: Mapping[str, str]
) -> tuple[AnyDict, list[Problem], BoolArray]:
    """Typed columns, what was wrong with their cells, and the rows whose frame is unknown."""
    columns: AnyDict = {}
    converted: dict[str, tuple[float, float]] = {}
    problems = list(raw.problems)
    unknown_frame = np.zeros(len(raw.numbers), dtype=np.bool_)
    for name, own in names.items():
        own, factor, shift = _linear(own, raw.names)
        cells = raw.columns.get(own)
        if cells is None:
            continue
        kind = COLUMNS[name].kind
        if (factor, shift) != (1.0, 0.0):
            if kind != "number":
                raise ObservationError(
                    f"{path}: column {name} holds no quantities; give the name of a column alone."
                )
            converted[name] = factor, shift
        # Whoever states a factor has left the unit of the file behind.
        unit = raw.units.get(own, "") if factor == 1.0 else ""
        if isinstance(cells, np.ndarray):
            if kind == "number":
                columns[name] = _to_unit(path, name, cells, unit)
                continue
            if kind == "whole" and cells.dtype.kind in "iu":
                columns[name] = cells
                continue
            cells = [str(value) for value in cells.tolist()]
        if not COLUMNS[name].required and not any(map(str.strip, cells)):
            continue  # an optional column without a single value is as good as absent
        bad: list[Problem] = []
        if kind == "whole":
            columns[name], bad = parse_whole(name, cells)
            unknown_frame[[p.row for p in bad]] = True
        elif kind == "number":
            if raw.decimal_comma:
                cells = [cell.replace(",", ".") for cell in cells]
            values, bad = parse_numbers(name, cells)
            columns[name] = _to_unit(path, name, values, unit)
        elif kind == "time":
            columns[name], bad = parse_times(name, cells)
        else:
            texts = [cell.strip() for cell in cells]
            columns[name] = np.array(
                list(map(cell_content, texts)) if raw.spreadsheet else texts, dtype=np.str_
            )
        problems += bad
    for name in converted.keys() & columns.keys():
        factor, shift = converted[name]
        columns[name] = columns[name] * factor + shift
    return columns, problems, unknown_frame


def _to_unit(path: Path, name: str, values: FloatArray, unit: str) -> FloatArray:
    """`values` of a column that states its unit, as in ECSV and FITS, in the unit that its name
    stands for.
    """
    wanted = COLUMNS[name].unit
    if unit in ("", wanted) or name == "mag":
        return values
    with extra("images", f"{path}: columns in other units", f"give {name} in {wanted}"):
        from astropy import units as u

    try:
        try:
            stated = u.Unit(unit)
        except ValueError:
            # Written out, as astrometry.net has its pixels and degrees.
            stated = u.Unit(unit.lower().removesuffix("s"))
        converted: FloatArray = stated.to(u.Unit(wanted), values, equivalencies=u.temperature())
    except (u.UnitConversionError, ValueError, TypeError):
        raise ObservationError(
            f"{path}: column {name} has the unit {unit!r}; give it in {wanted}.", column=name
        ) from None
    return converted


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


def _read_text(path: Path, data: bytes, ecsv: bool) -> RawTable:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ObservationError(
            f"{path}, line {line}: the text is not UTF-8; save the file in the encoding UTF-8.",
            row=line,
        ) from None
    header = _ecsv_header(path, text) if ecsv else {}
    delimiter = header.get("delimiter", " ") if ecsv else delimiter_of(io.StringIO(text))
    rows, numbers = _rows(path, text, delimiter)
    if not rows:
        raise ObservationError(
            f"{path}: the file holds comments only; give a table of observations."
        )
    names = [name.strip() for name in rows.pop(0)]
    width = len(names)
    problems = []
    for i, row in enumerate(rows):
        if len(row) != width:
            reason = (
                f"{len(row)} value{'s' if len(row) != 1 else ''} under a header of {width} columns"
            )
            problems.append(Problem(i, None, reason))
            rows[i] = [""] * width
    return RawTable(
        columns={name: [row[i] for row in rows] for i, name in enumerate(names)},
        names=names,
        numbers=np.array(numbers[1:], dtype=np.int64),
        word="line",
        meta=_ecsv_meta(header),
        units={
            column["name"]: column["unit"]
            for column in header.get("datatype", [])
            if column.get("unit")
        },
        problems=problems,
        spreadsheet=not ecsv,
        decimal_comma=delimiter == ";",
    )


def delimiter_of(lines: Iterable[str]) -> str:
    """What stands between the columns: a comma, or, if the header has none, what else spreadsheets
    write.
    """
    header = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return next((other for other in (";", "\t") if other in header and "," not in header), ",")


def _rows(path: Path, text: str, delimiter: str) -> tuple[list[list[str]], list[int]]:
    """Rows that are neither blank nor comments, header first, and the line of each."""
    # Comments become blank lines before the parser sees them: a quote in one would swallow the
    # lines after it, and dropping the line would shift the count.
    lines = ("\n" if line.startswith("#") else line for line in io.StringIO(text, newline=""))
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True)
    rows, numbers = [], []
    try:
        for row in reader:
            if any(map(str.strip, row)):
                rows.append(row)
                numbers.append(reader.line_num)
    except csv.Error as error:
        raise ObservationError(
            (
                f"{path}, line {reader.line_num}: the row cannot be read ({error}); check its "
                "quotation marks."
            ),
            row=reader.line_num,
        ) from None
    return rows, numbers


def _ecsv_header(path: Path, text: str) -> AnyDict:
    """The YAML header of an ECSV file (Astropy Proposal for Enhancement 6)."""
    if not text.startswith("# %ECSV"):
        raise ObservationError(
            (
                f"{path}, line 1: '# %ECSV 1.0' is missing; name a plain table .csv, or write it "
                "with astropy."
            ),
            row=1,
        )
    import yaml

    class Header(yaml.SafeLoader):  # type: ignore[misc]
        """Astropy's own kinds of values, of which none is used here, are None."""

    for kind in ("!", "tag:yaml.org,2002:python/"):
        Header.add_multi_constructor(kind, lambda *_: None)
    lines = []
    for line in text.splitlines()[1:]:
        if not line.startswith("#"):
            break
        if not line.startswith("##"):
            lines.append(line[2:])
    try:
        header: Any = yaml.load("\n".join(lines), Loader=Header)
    except (yaml.YAMLError, ValueError, RecursionError):
        header = None
    columns = header.get("datatype") if isinstance(header, dict) else None
    if not isinstance(columns, list) or not all(
        isinstance(column, dict) and "name" in column for column in columns
    ):
        raise ObservationError(
            f"{path}: the ECSV header is not valid YAML; write the file with astropy."
        ) from None
    return dict(header)


def _ecsv_meta(header: AnyDict) -> AnyDict:
    stored = dict(header.get("meta") or {})
    values = {key: value for key, value in stored.items() if not str(key).startswith("__")}
    # Piece by piece: a few lines of YAML that name each other can stand for gigabytes.
    pieces, size = [], 0
    for piece in json.JSONEncoder(default=as_plain).iterencode(values):
        size += len(piece)
        check_size(16 * size, 0)
        pieces.append(piece)
    plain: AnyDict = json.loads("".join(pieces))
    return plain


def _read_parquet(path: Path, data: bytes, wanted: set[str]) -> RawTable:
    table, names, meta = _arrow_table(path, data, wanted)
    columns = {name: arrow_values(table.column(name)) for name in table.column_names}
    return RawTable(columns, names, np.arange(1, table.num_rows + 1), "row", meta)


def _read_frames(
    path: Path, data: bytes, wanted: set[str], own: Mapping[str, str], frames: IntArray
) -> RawTable:
    table, names, meta = _arrow_table(path, data, wanted)
    # Before anything becomes Python's: texts of all rows would take longer than the rest.
    rows = np.flatnonzero(np.isin(table.column(own["frame"]).to_numpy(), frames))
    table = table.take(rows)
    columns = {name: arrow_values(table.column(name)) for name in table.column_names}
    return RawTable(columns, names, rows + 1, "row", meta)


def _arrow_table(path: Path, data: bytes, wanted: set[str]) -> tuple[Any, list[str], AnyDict]:
    """The wanted columns of a Parquet file, the names of all, and our metadata."""
    with open_parquet(path, data) as file:
        names = list(file.schema_arrow.names)
        table = file.read(columns=[name for name in names if name in wanted], use_threads=False)
        return table, names, own_meta(file.schema_arrow)


@contextmanager
def open_parquet(path: Path, data: bytes | None = None) -> Iterator[ParquetFile]:
    """A Parquet file that holds no more than it can; whatever is wrong with it is said in an
    `ObservationError`.
    """
    import pyarrow as pa
    from pyarrow import parquet

    with (
        reading(path, WHAT, REMEDY, ObservationError),
        parquet.ParquetFile(
            path if data is None else pa.BufferReader(data), pre_buffer=False
        ) as file,
    ):
        check_parquet(file, path.stat().st_size if data is None else len(data))
        yield file


def own_meta(schema: Any) -> AnyDict:
    """Our metadata of a Parquet file."""
    stored = (schema.metadata or {}).get(META_KEY)
    meta = json.loads(stored) if stored else {}
    if not isinstance(meta, dict):
        raise ValueError("its metadata are no table")
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
    with open_parquet(path) as file:
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
    with open_parquet(path) as file:
        values = file.read(columns=[column], use_threads=False).column(column).to_numpy()
    if values.dtype.kind not in "iu":
        raise ObservationError(
            f"{path}: column {column} holds no whole numbers; write it again.", column=column
        )
    return np.asarray(values, dtype=np.int64)


def arrow_values(column: Any) -> Any:
    """An arrow column as an array if it holds numbers without nulls, else as texts."""
    import pyarrow as pa

    kind = column.type
    if not column.null_count and (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
        return column.to_numpy()
    if pa.types.is_timestamp(kind):
        texts = np.datetime_as_string(column.to_numpy().astype("datetime64[ns]"))
        return ["" if text == "NaT" else text for text in texts.tolist()]
    return ["" if value is None else str(value) for value in column.to_pylist()]
