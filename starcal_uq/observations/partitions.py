"""A folder of Parquet files of whole frames: a table of observations that need not fit into memory.

Nothing but the files' metadata is read until a partition is asked for; whoever works on the table
reads the partitions one by one, where he is, and keeps sums of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.manifest import read_manifest
from starcal_uq.core.settings import bounded
from starcal_uq.core.types import AnyDict, IntArray, PathLike
from starcal_uq.observations.checks import check_mapping
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.files import (
    ParquetSummary,
    column_behind,
    parquet_column,
    parquet_summary,
    read_table,
    say_column,
)
from starcal_uq.observations.origin import Sourced
from starcal_uq.observations.table import Observations, joined_columns

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

# What estimates are made of; the other columns are for diagnoses, and read for the sample of frames
# alone.
STREAMED = ("frame", "x_px", "y_px", "ra_deg", "dec_deg", "sigma_px")
# Frames that stand for all of them where stars are looked at one by one, and files that they are
# taken from.
SAMPLE_FRAMES, _SAMPLE_PARTS = 2000, 16


@dataclass(frozen=True)
class Partition:
    """One file, by its absolute path, so that other processes find it: rows, range of frame
    numbers, columns.
    """

    path: Path
    n_stars: int
    first_frame: int
    last_frame: int
    names: tuple[str, ...]


@dataclass(frozen=True)
class PartitionReader:
    """How a partition becomes observations; small, and sent to the processes that read.

    Every centroid must lie on the detector of the camera. `columns` are names in the files of
    columns that are called otherwise, `meta` entries that are declared for all partitions, and
    every table goes through the picklable function `prepare`, such as one that makes directions
    apparent. `also` are columns that are read beyond those that every estimate is made of.
    """

    camera: Camera | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    meta: AnyDict = field(default_factory=dict)
    prepare: Callable[[Observations], Observations] | None = None
    also: tuple[str, ...] = ()

    def load(
        self, part: Partition, *, check: bool = False, frames: IntArray | None = None
    ) -> Observations:
        """The table of a partition with the columns that estimates are made of; of some `frames`,
        with all columns.
        """
        only = (*STREAMED, *self.also)
        if self.prepare is not None and "time_utc" not in only:
            only = (*only, "time_utc")
        columns, meta = read_table(
            part.path,
            self.camera,
            self.columns,
            only if frames is None else tuple(COLUMNS),
            check,
            frames,
        )
        obs = Observations(**columns, meta={**meta, **self.meta})
        try:
            return obs if self.prepare is None else self.prepare(obs)
        except ObservationError as error:
            raise ObservationError(
                f"{part.path}: {error}", row=error.row, column=error.column
            ) from error


@dataclass(frozen=True)
class PartitionedObservations(Sourced):
    """Observations in a folder of files, which are read when they are needed; see
    `open_partitions`.

    Iterated over, it gives the partitions one after the other.

    Attributes
    ----------
    folder : Path
        Folder.
    parts : tuple of Partition
        Files, by their smallest frame number.
    reader : PartitionReader
        How they are read.
    meta : dict
        What the files say of themselves, alike in all: ``directions``, ``truth`` and more.
    """

    folder: Path
    parts: tuple[Partition, ...]
    reader: PartitionReader
    meta: AnyDict

    def __iter__(self) -> Iterator[Observations]:
        return (self.reader.load(part, check=True) for part in self.parts)

    def __len__(self) -> int:
        return self.n_stars

    def __repr__(self) -> str:
        return (
            f"PartitionedObservations({self.n_stars} stars in {len(self.parts)} files of "
            f"{str(self.folder)!r})"
        )

    @property
    def n_stars(self) -> int:
        """Number of stars over all frames."""
        return sum(part.n_stars for part in self.parts)

    @cached_property
    def n_frames(self) -> int:
        """Number of frames; the column of their numbers is read for it."""
        return sum(len(frame_numbers(part, self.reader)) for part in self.parts)

    @cached_property
    def data_hash(self) -> str:
        """SHA-256 (hex) of the data, whatever the files are called; all of them are read for it.

        It is that of the sorted `Observations.data_hash` of the partitions' columns that estimates
        are made of.
        """
        return joined_hash([observations.data_hash for observations in self])

    def prepared(
        self, function: Callable[[Observations], Observations], **entries: Any
    ) -> PartitionedObservations:
        """The same table, each partition of which goes through a picklable function when it is
        read.

        The entries are those of `meta` that the function changes, for whoever asks the whole.
        """
        return replace(
            self, reader=replace(self.reader, prepare=function), meta={**self.meta, **entries}
        )

    def with_meta(self, **entries: Any) -> PartitionedObservations:
        """The same table with entries of `meta` added or changed, such as
        ``directions="apparent"``.
        """
        reader = replace(self.reader, meta={**self.reader.meta, **entries})
        return replace(self, reader=reader, meta={**self.meta, **entries})

    @bounded
    def sample(self, n_frames: int = SAMPLE_FRAMES) -> Observations:
        """About `n_frames` frames with all of their columns: evenly spaced ones of at most 16
        files, evenly spaced too.

        The same files give the same frames. All of a smaller table is taken. The sample of the
        usual size is kept.
        """
        return self._usual_sample if n_frames == SAMPLE_FRAMES else self._sampled(n_frames)

    @cached_property
    def _usual_sample(self) -> Observations:
        return self._sampled(SAMPLE_FRAMES)

    def _sampled(self, n_frames: int) -> Observations:
        last = len(self.parts) - 1
        places = np.linspace(0, last, min(last + 1, _SAMPLE_PARTS)).round().astype(int)
        chosen = [self.parts[place] for place in places]
        numbers = [frame_numbers(part, self.reader) for part in chosen]
        n = sum(map(len, numbers))
        tables = []
        for part, own in zip(chosen, numbers, strict=True):
            share = min(max(1, round(n_frames * len(own) / n)), len(own))
            kept = own[((np.arange(share) + 0.5) * len(own) / share).astype(int)]
            tables.append(self.reader.load(part, check=True, frames=kept))
        return Observations(**joined_columns(tables), meta=tables[0].meta)


def open_partitions(
    folder: PathLike, camera: Camera | None = None, columns: Mapping[str, str] | None = None
) -> PartitionedObservations:
    """Open a folder of Parquet files as one table, however large; only their metadata are read.

    Parameters
    ----------
    folder
        Folder of ``.parquet`` files with the columns of `load_observations`. All rows of a frame
        stand in one file, and no two files hold frames of the same number.
    camera
        If given, every centroid must lie on its detector.
    columns
        Names in the files of columns that are called otherwise.

    Raises
    ------
    ObservationError
        If a file is damaged, does not fit to the others, or repeats a frame number of another. Rows
        are checked when they are first worked on.
    """
    check_mapping(columns or {})
    folder = Path(folder)
    if not folder.is_dir():
        raise ObservationError(f"{folder}: is no directory; name one that holds .parquet files.")
    # Files of a simulation that was stopped while they took their places do so now.
    manifest = read_manifest(folder)
    if manifest is not None and "calibrate" in manifest.steps:
        raise ObservationError(
            f"{folder}: is the folder of a run; name its table, {folder / 'observations.parquet'}."
        )
    paths = sorted(path.resolve() for path in folder.iterdir() if path.suffix.lower() == ".parquet")
    if not paths:
        raise ObservationError(
            f"{folder}: is a directory that holds no .parquet file; name a table of "
            "observations, or a folder of them."
        )
    reader = PartitionReader(camera, dict(columns or {}))
    frame = reader.columns.get("frame", "frame")
    summaries = [parquet_summary(path, frame) for path in paths]
    parts = []
    for path, summary in zip(paths, summaries, strict=True):
        _check_alike(path, summary, paths[0], summaries[0], reader)
        parts.append(_partition(path, summary, frame))
    parts.sort(key=lambda part: (part.first_frame, part.path))
    _check_frames(parts, reader)
    meta = {"directions": "undeclared", **summaries[0].meta, "source": str(folder)}
    return PartitionedObservations(folder, tuple(parts), reader, meta)


def frame_numbers(part: Partition, reader: PartitionReader) -> IntArray:
    """Frame numbers of a partition, ascending; no other column is read."""
    return np.unique(parquet_column(part.path, reader.columns.get("frame", "frame")))


def joined_hash(hashes: Sequence[str]) -> str:
    """SHA-256 (hex) of the data of several partitions, from their own, whatever their order."""
    return hashlib.sha256("".join(sorted(hashes)).encode()).hexdigest()


def _partition(path: Path, summary: ParquetSummary, frame: str) -> Partition:
    first, last = summary.first, summary.last
    if first is None or last is None:
        numbers = parquet_column(path, frame)
        first, last = int(numbers.min()), int(numbers.max())
    return Partition(path, summary.n_rows, first, last, summary.names)


def _check_alike(
    path: Path,
    summary: ParquetSummary,
    first_path: Path,
    first: ParquetSummary,
    reader: PartitionReader,
) -> None:
    """Columns that estimates are made of must be in all files or in none, and directions of one
    kind.
    """
    for name in STREAMED:
        own = reader.columns.get(name, name)
        # Frame numbers are read as they are.
        own = own if name == "frame" else column_behind(own, summary.names)
        if own not in summary.names and (COLUMNS[name].required or name in reader.columns):
            raise ObservationError(
                f"{path}: column {own} is missing; {say_column([name], summary.names)}.",
                column=own,
            )
        if (own in summary.names) != (own in first.names):
            there, missing = (path, first_path) if own in summary.names else (first_path, path)
            raise ObservationError(
                f"{missing}: column {own} is missing, and {there} has it; write it to all files, "
                "or to none.",
                column=own,
            )
    if not summary.n_rows:
        raise ObservationError(f"{path}: the table has no rows; remove the file.")
    kinds = [s.meta.get("directions", "undeclared") for s in (first, summary)]
    if kinds[0] != kinds[1]:
        raise ObservationError(
            f"{path}: its directions are {kinds[1]}, those of {first_path} {kinds[0]}; keep them "
            "in folders of their "
            "own."
        )


def _check_frames(parts: Sequence[Partition], reader: PartitionReader) -> None:
    """No frame number in two files; only of files whose ranges overlap are the numbers read."""
    seen: dict[Path, IntArray] = {}

    def numbers(part: Partition) -> IntArray:
        if part.path not in seen:
            seen[part.path] = frame_numbers(part, reader)
        return seen[part.path]

    open_: list[Partition] = []
    for part in parts:
        open_ = [earlier for earlier in open_ if earlier.last_frame >= part.first_frame]
        for earlier in open_:
            shared = np.intersect1d(numbers(earlier), numbers(part), assume_unique=True)
            if len(shared):
                raise ObservationError(
                    f"{part.path}: frame {shared[0]} is in {earlier.path.name} too; keep all "
                    "rows of a frame in one "
                    "file, and give every frame its own number.",
                    column="frame",
                )
        for path in set(seen) - {earlier.path for earlier in open_} - {part.path}:
            del seen[path]
        open_.append(part)
