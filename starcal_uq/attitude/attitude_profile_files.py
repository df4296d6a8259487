"""File formats of attitude profiles: CSV, ECSV and Parquet."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.errors import AttitudeProfileError, CatalogueError, ObservationError
from starcal_uq.core.files import table_ending
from starcal_uq.core.times import julian_days
from starcal_uq.core.types import FloatArray, IntArray

NAMED = ("qx", "qy", "qz", "qw")
_NUMBERED = (("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4"))
_DAY_S = 86_400.0


@dataclass(frozen=True)
class ProfileTable:
    """What a file says.

    Attributes
    ----------
    time_s : (K,) array
        Times, s; of UTC times the seconds since the first.
    quaternions : (K, 4) array
        Scalar last, as they stand.
    numbers : (K,) array
        Line (CSV, ECSV), or row from 1 (Parquet).
    word : str
        ``"line"`` or ``"row"``.
    """

    time_s: FloatArray
    quaternions: FloatArray
    numbers: IntArray
    word: str


def read_profile(path: str | os.PathLike[str], scalar: str | None) -> ProfileTable:
    """Read times and quaternions; see `starcal_uq.attitude.profile.load_attitude_profile`."""
    path = Path(path)
    try:
        ending = table_ending(path)
        if ending == ".parquet":
            columns, numbers, word = _parquet(path)
        else:
            columns, numbers, word = _text(path, ecsv=ending == ".ecsv")
    except ObservationError as error:
        raise AttitudeProfileError(str(error)) from None
    except OSError as error:
        raise AttitudeProfileError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    if not len(numbers):
        raise AttitudeProfileError(f"{path}: holds no attitudes; give a table with a time and a quaternion per row.")
    names = _components(path, columns, scalar)
    q = np.column_stack([_numbers(path, word, numbers, name, columns[name]) for name in names])
    return ProfileTable(_times(path, word, numbers, columns), q, numbers, word)


def _components(path: Path, columns: dict[str, Any], scalar: str | None) -> tuple[str, ...]:
    """Names of the columns in the order x, y, z, w."""
    if all(name in columns for name in NAMED):
        return NAMED
    for names in _NUMBERED:
        if all(name in columns for name in names):
            if scalar is None:
                raise AttitudeProfileError(
                    f"{path}: the columns {', '.join(names)} do not say which is the scalar part; name them "
                    f"{', '.join(NAMED)} (qw is the scalar), or state scalar='first' or scalar='last'."
                )
            return names if scalar == "last" else (*names[1:], names[0])
    missing = [name for name in NAMED if name not in columns]
    raise AttitudeProfileError(
        f"{path}: column {missing[0]} is missing; give {', '.join(NAMED)} beside time_s or time_utc (the file has "
        f"{', '.join(columns) or 'no columns'})."
    )


def _times(path: Path, word: str, numbers: IntArray, columns: dict[str, Any]) -> FloatArray:
    if "time_s" in columns:
        return _numbers(path, word, numbers, "time_s", columns["time_s"])
    if "time_utc" not in columns:
        raise AttitudeProfileError(f"{path}: column time_s or time_utc is missing; add one of them.")
    try:
        tt, _, inverse = julian_days([str(text) for text in columns["time_utc"]])
    except CatalogueError as error:
        raise AttitudeProfileError(f"{path}: {error}") from None
    days = tt[inverse] - tt[inverse[0]]
    seconds: FloatArray = days.sum(axis=1) * _DAY_S
    # Two-part Julian dates are good to 1e-11 s; the text states at most nanoseconds.
    return np.round(seconds, 9)


def _numbers(path: Path, word: str, numbers: IntArray, name: str, cells: Iterable[Any]) -> FloatArray:
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "fiu":
        return np.asarray(cells, dtype=float)
    values = []
    for number, cell in zip(numbers, cells, strict=True):
        try:
            values.append(float(cell))
        except (TypeError, ValueError):
            raise AttitudeProfileError(
                f"{path}, {word} {number}: {name} is {cell!r}, not a number; repair it."
            ) from None
    return np.array(values, dtype=float)


def _text(path: Path, *, ecsv: bool) -> tuple[dict[str, Any], IntArray, str]:
    """Cells by column, and the line of each row; an ECSV file's header stands in comments."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise AttitudeProfileError(f"{path}: the text is not UTF-8; save the file in the encoding UTF-8.") from None
    delimiter = "," if not ecsv or "# delimiter: ','" in text else " "
    lines = ("\n" if line.startswith("#") else line for line in text.splitlines(keepends=True))
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    if not rows:
        return {}, np.empty(0, dtype=np.int64), "line"
    names = [name.strip() for name in rows[0][1]]
    for number, row in rows[1:]:
        if len(row) != len(names):
            raise AttitudeProfileError(
                f"{path}, line {number}: holds {len(row)} values under a header of {len(names)} columns; repair it."
            )
    cells = {name: [row[i].strip() for _, row in rows[1:]] for i, name in enumerate(names)}
    return cells, np.array([number for number, _ in rows[1:]], dtype=np.int64), "line"


def _parquet(path: Path) -> tuple[dict[str, Any], IntArray, str]:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with path.open("rb") as file:
            table = parquet.read_table(file)
    except pa.ArrowException as error:
        reason = str(error).splitlines()[0]
        raise AttitudeProfileError(f"{path}: is no readable Parquet file ({reason}); write it again.") from None
    columns: dict[str, Any] = {}
    for name in table.column_names:
        column = table.column(name)
        if pa.types.is_timestamp(column.type):
            columns[name] = np.datetime_as_string(column.to_numpy().astype("datetime64[ns]"))
        elif pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
            columns[name] = column.to_numpy()
        else:
            columns[name] = column.to_pylist()
    return columns, np.arange(1, table.num_rows + 1), "row"
