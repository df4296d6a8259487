"""Frames from a file larger than memory, one after the other, with the checks of
`load_observations`.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.files import reading
from starcal_uq.core.tables import (
    REMEDY,
    WHAT,
    RawTable,
    arrow_columns,
    delimiter_of,
    opened,
    own_meta,
    text_rows,
    uneven,
)
from starcal_uq.core.types import AnyDict, IntArray, PathLike
from starcal_uq.observations.checks import check_columns, check_mapping, raise_problems
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.files import (
    check_names,
    columns_for,
    convert_columns,
    table_meta,
)
from starcal_uq.observations.partitions import STREAMED
from starcal_uq.observations.table import Observations

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

_BATCH_ROWS = 16_384


@dataclass(frozen=True)
class FrameStream:
    """The frames of a file or of a folder of files; can be iterated over again and again.

    Every centroid must lie on the detector of the camera. `columns` are names in the files of
    columns that are called otherwise. Of `batch_rows` in memory at a time, a frame that is cut by
    the end of a batch is put together again.
    """

    paths: tuple[Path, ...]
    camera: Camera | None
    columns: Mapping[str, str]
    batch_rows: int

    def __iter__(self) -> Iterator[Observations]:
        seen = _Seen()
        for path in self.paths:
            with reading(path, WHAT, REMEDY, ObservationError):
                yield from _frames_of(path, self, seen)


def stream_frames(
    path: PathLike,
    camera: Camera | None = None,
    columns: Mapping[str, str] | None = None,
    *,
    batch_rows: int = _BATCH_ROWS,
) -> FrameStream:
    """Read a table of observations frame by frame, without ever holding all of it.

    Parameters
    ----------
    path
        A ``.parquet`` or ``.csv`` file, or a folder of them, which are read in the order of their
        names. The rows of a frame must follow each other, in one file.
    camera
        If given, every centroid must lie on its detector.
    columns
        Names in the file of columns that are called otherwise, as in `load_observations`.
    batch_rows
        Rows to hold at a time.

    Returns
    -------
    FrameStream
        An iterable of Observations of one frame each, with the columns frame, x_px, y_px, ra_deg,
        dec_deg and, where the file has it, sigma_px. Each iteration reads from the start.

    Raises
    ------
    ObservationError
        Here, if there is no such file or its ending cannot be streamed; during iteration, as
        `load_observations`, and when the rows of a frame do not follow each other. The frames
        before have been given out by then.
    """
    check_mapping(columns or {})
    if batch_rows < 1:
        raise ObservationError(f"batch_rows is {batch_rows}; use 1 or more.")
    path = Path(path)
    if not path.exists():
        raise ObservationError(f"{path}: the file does not exist; check the path.")
    paths: tuple[Path, ...] = (path,)
    if path.is_dir():
        paths = tuple(sorted(p for p in path.iterdir() if p.suffix.lower() in (".parquet", ".csv")))
        if not paths:
            raise ObservationError(
                f"{path}: the folder holds no .parquet or .csv file; name another."
            )
    elif path.suffix.lower() not in (".parquet", ".csv"):
        raise ObservationError(
            f"{path}: the ending {path.suffix or '(none)'} cannot be streamed; save the table as "
            ".parquet or .csv."
        )
    return FrameStream(paths, camera, dict(columns or {}), batch_rows)


@dataclass
class _Seen:
    """Frame numbers that went by, as disjoint intervals, so that consecutive numbers take no
    memory.
    """

    first: list[int] = field(default_factory=list)
    last: list[int] = field(default_factory=list)

    def add(self, number: int) -> bool:
        """Take a number in; False if it was there before."""
        at = bisect_right(self.first, number)
        if at and number <= self.last[at - 1]:
            return False
        after_previous = at > 0 and self.last[at - 1] == number - 1
        before_next = at < len(self.first) and self.first[at] == number + 1
        if after_previous and before_next:
            self.last[at - 1] = self.last[at]
            del self.first[at], self.last[at]
        elif after_previous:
            self.last[at - 1] = number
        elif before_next:
            self.first[at] = number
        else:
            self.first.insert(at, number)
            self.last.insert(at, number)
        return True


@dataclass(frozen=True)
class _Rows:
    """Rows of a file: columns, and the number of each row in it."""

    columns: AnyDict
    numbers: IntArray

    def part(self, start: int, stop: int | None) -> _Rows:
        rows = slice(start, stop)
        return _Rows(
            {name: values[rows].copy() for name, values in self.columns.items()},
            self.numbers[rows].copy(),
        )

    def followed_by(self, other: _Rows) -> _Rows:
        columns = {
            name: np.concatenate([values, other.columns[name]])
            for name, values in self.columns.items()
        }
        return _Rows(columns, np.concatenate([self.numbers, other.numbers]))


def _frames_of(path: Path, stream: FrameStream, seen: _Seen) -> Iterator[Observations]:
    """The frames of one file."""
    names = {name: stream.columns.get(name, name) for name in COLUMNS}
    wanted = {name: names[name] for name in STREAMED}
    batches = _parquet_batches if path.suffix.lower() == ".parquet" else _csv_batches
    held: _Rows | None = None
    meta: AnyDict = {}
    word = "row"
    for raw in batches(path, columns_for(wanted.values()), stream.batch_rows):
        word = raw.word
        if held is None:
            check_names(path, raw, names, stream.columns)
            meta = table_meta(path, raw, names, stream.columns)
        rows = _typed(path, raw, wanted, None if held is None else set(held.columns))
        rows = rows if held is None else held.followed_by(rows)
        frame = rows.columns["frame"]
        starts = np.flatnonzero(np.concatenate([[True], frame[1:] != frame[:-1]]))
        # The last frame may go on in the next batch.
        yield from _given_out(path, word, rows, starts, stream.camera, seen, meta)
        held = rows.part(int(starts[-1]), None)
    if held is None:
        raise ObservationError(f"{path}: the table has no rows; give a table with observations.")
    ends = np.array([0, len(held.numbers)])
    yield from _given_out(path, word, held, ends, stream.camera, seen, meta)


def _typed(path: Path, raw: RawTable, wanted: Mapping[str, str], known: set[str] | None) -> _Rows:
    """The wanted columns of a batch in their types."""
    columns, problems, _ = convert_columns(path, raw, wanted)
    raise_problems(str(path), raw.word, raw.numbers, problems)
    if known is not None and set(columns) != known:
        raise ObservationError(
            f"{path}, {raw.word} {raw.numbers[0]}: column {wanted['sigma_px']} has values in "
            "some rows only; "
            "fill it in everywhere or remove it.",
            row=int(raw.numbers[0]),
            column=wanted["sigma_px"],
        )
    return _Rows({name: np.asarray(values) for name, values in columns.items()}, raw.numbers)


def _given_out(
    path: Path,
    word: str,
    rows: _Rows,
    starts: IntArray,
    camera: Camera | None,
    seen: _Seen,
    meta: AnyDict,
) -> Iterator[Observations]:
    """Check the frames between `starts`, all together because that is faster, and give them out one
    by one.
    """
    frame = rows.columns["frame"]
    for start in starts[:-1].tolist():
        if not seen.add(int(frame[start])):
            raise ObservationError(
                f"{path}, {word} {rows.numbers[start]}: frame {frame[start]} comes back after "
                "other frames; "
                "sort the table by frame, and give every frame of a folder its own number.",
                row=int(rows.numbers[start]),
                column="frame",
            )
    whole = rows.part(0, int(starts[-1]))
    raise_problems(str(path), word, whole.numbers, check_columns(whole.columns, camera))
    for start, stop in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        yield Observations(**whole.part(start, stop).columns, meta=meta)


def _parquet_batches(path: Path, wanted: set[str], batch_rows: int) -> Iterator[RawTable]:
    import pyarrow as pa

    with opened(path) as file:
        names = list(file.schema_arrow.names)
        meta = own_meta(file.schema_arrow)
        columns = [name for name in names if name in wanted]
        first = 1
        for batch in file.iter_batches(batch_rows, columns=columns, use_threads=False):
            numbers = np.arange(first, first + batch.num_rows)
            first += batch.num_rows
            if batch.num_rows:
                cells = arrow_columns(pa.Table.from_batches([batch]))
                yield RawTable(cells, names, numbers, "row", meta)


def _csv_batches(path: Path, wanted: set[str], batch_rows: int) -> Iterator[RawTable]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:
            delimiter = delimiter_of(text)
            text.seek(0)
            rows = text_rows(path, text, delimiter)
            header = next(rows, None)
            if header is None:
                raise ObservationError(f"{path}: the file is empty; give a table of observations.")
            names = [name.strip() for name in header[1]]
            while batch := list(islice(rows, batch_rows)):
                for number, row in batch:
                    if why := uneven(row, names):
                        raise ObservationError(
                            f"{path}, line {number}: {why}; correct or remove the row.", row=number
                        )
                columns = {
                    name: [row[i] for _, row in batch]
                    for i, name in enumerate(names)
                    if name in wanted
                }
                numbers = np.array([number for number, _ in batch])
                yield RawTable(columns, names, numbers, "line", decimal_comma=delimiter == ";")
    except UnicodeDecodeError:
        raise ObservationError(
            f"{path}: the text is not UTF-8; save the file in the encoding UTF-8."
        ) from None
