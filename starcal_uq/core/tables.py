"""Tables in files of any subject, as they stand there: CSV, ECSV and Parquet.

CSV and ECSV are read cell by cell with the line each row stands on, so that an error can name it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import as_plain, check_size, open_parquet, reading
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import AnyDict, AnyMapping, FloatArray, IntArray, floats

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow.parquet import ParquetFile

# Metadata of a Parquet file.
META_KEY = b"starcal_uq"
WHAT, REMEDY = "a readable table", "write it again"


@dataclass(frozen=True)
class RawTable:
    """A table as it stands in a file: texts, or numbers where the format has types.

    Of `columns`, by name in the file, Parquet gives only the wanted ones; `names` are those of all.
    `numbers` (N,) are lines (CSV, ECSV) or rows from 1 (Parquet), as `word` says. `uneven` says of
    rows that do not fit the header, by their place, what they hold. Texts of a `spreadsheet` are
    those of `starcal_uq.core.files.cell_text`; with `decimal_comma`, numbers are written as 0,5.
    """

    columns: AnyDict
    names: list[str]
    numbers: IntArray
    word: str
    meta: AnyDict = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    uneven: dict[int, str] = field(default_factory=dict)
    spreadsheet: bool = False
    decimal_comma: bool = False


def read_cells(
    path: Path,
    data: bytes,
    ending: str,
    wanted: Collection[str] | None = None,
    chosen: tuple[str, IntArray] | None = None,
    key: bytes = META_KEY,
) -> RawTable:
    """A table by the `ending` of its file; of Parquet the `wanted` columns, and of its rows those
    that have `chosen` values in a column.

    ObservationError for a text that is no table; the caller's `reading` makes a sentence of
    anything else.
    """
    if ending != ".parquet":
        return _read_text(path, data, ecsv=ending == ".ecsv")
    import pyarrow as pa
    from pyarrow.parquet import ParquetFile

    with opened(path, data) as file:
        schema = file.schema_arrow
        names = list(schema.names)
        own = [name for name in names if wanted is None or name in wanted]
        # Texts are codes in the file, and stay so.
        texts = [name for name in own if schema.field(name).type == pa.string()]
        with ParquetFile(pa.BufferReader(data), read_dictionary=texts, pre_buffer=False) as again:
            table = again.read(columns=own, use_threads=False)
        meta = own_meta(schema, key)
    rows = np.arange(table.num_rows)
    if chosen is not None:
        # Before anything becomes Python's: texts of all rows would take longer than the rest.
        rows = np.flatnonzero(np.isin(table.column(chosen[0]).to_numpy(), chosen[1]))
        table = table.take(rows)
    found = RawTable(arrow_columns(table), names, rows + 1, "row", meta)
    del table
    # Arrow would keep what the table took for a next one.
    pa.default_memory_pool().release_unused()
    return found


@contextmanager
def opened(path: Path, data: bytes | None = None) -> Iterator[ParquetFile]:
    """A Parquet file, or its content; whatever is wrong with it is said in an `ObservationError`."""
    with (
        reading(path, WHAT, REMEDY, ObservationError),
        open_parquet(path if data is None else data) as file,
    ):
        yield file


def write_parquet(
    columns: AnyMapping, path: Path, meta: str, key: bytes = META_KEY, **options: Any
) -> None:
    """Write columns, arrays or arrow's, with metadata as JSON under a key."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table(
        {
            name: pa.array(values.names).take(values.codes) if isinstance(values, Texts) else values
            for name, values in columns.items()
        }
    )
    options = {"compression": "zstd", **options}
    parquet.write_table(table.replace_schema_metadata({key: meta}), path, **options)


def own_meta(schema: pa.Schema, key: bytes = META_KEY) -> AnyDict:
    """Our metadata of a Parquet file."""
    stored = (schema.metadata or {}).get(key)
    meta = json.loads(stored) if stored else {}
    if not isinstance(meta, dict):
        raise ValueError("its metadata are no table")
    return meta


def arrow_columns(table: pa.Table) -> AnyDict:
    """Columns of an arrow table: arrays if they hold numbers without nulls, else `Texts`."""
    return {name: _arrow_values(table.column(name)) for name in table.column_names}


def _arrow_values(column: Any) -> Any:
    """An arrow column as an array if it holds numbers without nulls, else as texts."""
    import pyarrow as pa

    kind = column.type
    if pa.types.is_nested(kind):
        return ["" if value is None else str(value) for value in column.to_pylist()]
    if not column.null_count and (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        # Arrow's own `to_numpy` would load pandas.
        return np.from_dlpack(column.combine_chunks())
    if pa.types.is_timestamp(kind):
        column = column.cast(pa.timestamp("ns")).cast(pa.string())
    if column.null_count and pa.types.is_dictionary(kind):
        column = column.cast(kind.value_type)
    coded = column.combine_chunks()
    if not pa.types.is_dictionary(coded.type):
        coded = coded.dictionary_encode("encode")
    texts = ["" if value is None else str(value) for value in coded.dictionary.to_pylist()]
    return Texts.placed(np.from_dlpack(coded.indices), texts)


def delimiter_of(lines: Iterable[str]) -> str:
    """What stands between the columns: a comma, or, if the header has none, what else spreadsheets
    write.
    """
    header = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return next((other for other in (";", "\t") if other in header and "," not in header), ",")


def text_rows(path: Path, lines: Iterable[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Rows that are neither blank nor comments, header first, each after its line."""
    # Comments become blank lines before the parser sees them: a quote in one would swallow the
    # lines after it, and dropping the line would shift the count.
    bare = ("\n" if line.startswith("#") else line for line in lines)
    reader = csv.reader(bare, delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        for row in reader:
            if any(map(str.strip, row)):
                yield reader.line_num, row
    except csv.Error as error:
        raise ObservationError(
            f"{path}, line {reader.line_num}: the row cannot be read ({error}); check its "
            "quotation marks.",
            row=reader.line_num,
        ) from None


def uneven(row: list[str], names: list[str]) -> str | None:
    """What is wrong with a row that does not fit the header."""
    n = len(row)
    if n == len(names):
        return None
    return f"{n} value{'s' if n != 1 else ''} under a header of {len(names)} columns"


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
    numbered = list(text_rows(path, io.StringIO(text, newline=""), delimiter))
    if not numbered:
        raise ObservationError(f"{path}: the file holds comments only; give a table.")
    numbers, (first, *rows) = zip(*numbered, strict=True)
    names = [name.strip() for name in first]
    bad = {i: why for i, row in enumerate(rows) if (why := uneven(row, names))}
    for i in bad:
        rows[i] = [""] * len(names)
    units = {column["name"]: column.get("unit") for column in header.get("datatype", [])}
    return RawTable(
        columns={name: [row[i] for row in rows] for i, name in enumerate(names)},
        names=names,
        numbers=np.array(numbers[1:], dtype=np.int64),
        word="line",
        meta=_ecsv_meta(header),
        units={name: unit for name, unit in units.items() if unit},
        uneven=bad,
        spreadsheet=not ecsv,
        decimal_comma=delimiter == ";",
    )


def _ecsv_header(path: Path, text: str) -> AnyDict:
    """The YAML header of an ECSV file (Astropy Proposal for Enhancement 6)."""
    if not text.startswith("# %ECSV"):
        raise ObservationError(
            f"{path}, line 1: '# %ECSV 1.0' is missing; name a plain table .csv, or write it "
            "with astropy.",
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


def in_unit(path: Path, values: FloatArray, unit: str, wanted: str) -> FloatArray | None:
    """Values of a column that states its unit in another one; None where that cannot be."""
    if unit in ("", wanted):
        return values
    with extra("images", f"{path}: columns in other units", f"give them in {wanted}"):
        from astropy import units as u

    try:
        try:
            stated = u.Unit(unit)
        except ValueError:
            # Written out, as astrometry.net has its pixels and degrees.
            stated = u.Unit(unit.lower().removesuffix("s"))
        return floats(stated.to(u.Unit(wanted), values, equivalencies=u.temperature()))
    except (u.UnitConversionError, ValueError, TypeError):
        return None
