"""File formats of the centroids table: CSV, ECSV and Parquet, in and out.

What belongs to frames and to the whole table is one JSON document, which travels in the metadata of the format; in CSV
it is a comment.
"""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ObservationError
from starcal_uq.core.files import as_plain, atomic_path, ensure_new, table_ending
from starcal_uq.core.types import AnyDict
from starcal_uq.images.centroids import COLUMNS, FRAME_COLUMNS, Centroids

if TYPE_CHECKING:
    from collections.abc import Mapping

_KEY = "starcal_uq_centroids"
_TRUTH = {"True": True, "False": False}
_MARK = f"# {_KEY} "


def write_centroids(centroids: Centroids, path: str | os.PathLike[str], force: bool) -> None:
    """See `Centroids.save`."""
    ending = table_ending(Path(path))
    ensure_new(path, force)
    frames = {
        # JSON has no NaN: null stands for it.
        name: [None if v != v else v for v in getattr(centroids, name).tolist()]
        for name in FRAME_COLUMNS
    }
    document = {"frames": frames, "messages": list(centroids.messages), "meta": centroids.meta}
    text = json.dumps(document, default=as_plain)
    with atomic_path(path) as temporary:
        if ending == ".csv":
            rows = centroids.to_dataframe().to_csv(index=False, lineterminator="\n")
            temporary.write_text(f"{_MARK}{text}\n{rows}", encoding="utf-8", newline="\n")
        elif ending == ".ecsv":
            _table(centroids, text).write(temporary, format="ascii.ecsv", delimiter=",")
        else:
            import pyarrow as pa
            from pyarrow import parquet

            arrow = pa.table({name: getattr(centroids, name) for name in COLUMNS})
            metadata = {_KEY.encode(): text.encode()}
            parquet.write_table(arrow.replace_schema_metadata(metadata), temporary, compression="zstd")


def _table(centroids: Centroids, text: str) -> Any:
    from astropy.table import Table

    table = Table({name: getattr(centroids, name) for name in COLUMNS}, meta={_KEY: text})
    for name, (_, description) in COLUMNS.items():
        table[name].description = description
    return table


def read_centroids(path: str | os.PathLike[str]) -> Centroids:
    """See `Centroids.load`."""
    path = Path(path)
    ending = table_ending(path)
    if not os.path.isfile(path):
        raise ObservationError(f"{path}: the file does not exist; check the path.")
    read = {".csv": _read_csv, ".ecsv": _read_ecsv, ".parquet": _read_parquet}[ending]
    try:
        columns, text = read(path)
    except Exception as error:  # each format's reader raises errors of its own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ObservationError(f"{path}: is no readable table ({reason}); write it again.") from error
    if text is None:
        raise ObservationError(
            f"{path}: the list of frames is missing; give a table that `starcal-uq centroid` or Centroids.save wrote."
        )
    if missing := [name for name in COLUMNS if name not in columns]:
        raise ObservationError(f"{path}: column {missing[0]} is missing; write the table again.", column=missing[0])
    try:
        document: AnyDict = json.loads(text)
        frames: AnyDict = {name: document["frames"][name] for name in FRAME_COLUMNS}
        messages, meta = tuple(document["messages"]), dict(document["meta"])
    except (ValueError, KeyError, TypeError) as error:
        raise ObservationError(f"{path}: the list of frames is damaged ({error!r}); write the table again.") from None
    return Centroids(**{name: columns[name] for name in COLUMNS}, **frames, messages=messages, meta=meta)


def _read_csv(path: Path) -> tuple[Mapping[str, Any], str | None]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
        if not first.startswith(_MARK):
            return {}, None
        names, *rows = [row for row in csv.reader(file, strict=True) if row]
    cells = dict(zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True))
    columns: AnyDict = {
        name: [_TRUTH[cell] for cell in cells[name]] if kind is np.bool_ else np.array(cells[name], str).astype(kind)
        for name, (kind, _) in COLUMNS.items()
        if name in cells
    }
    return columns, first.removeprefix(_MARK)


def _read_ecsv(path: Path) -> tuple[Mapping[str, Any], str | None]:
    from astropy.table import Table

    table = Table.read(path, format="ascii.ecsv")
    return {name: np.asarray(table[name]) for name in table.colnames}, table.meta.get(_KEY)


def _read_parquet(path: Path) -> tuple[Mapping[str, Any], str | None]:
    from pyarrow import parquet

    table = parquet.read_table(path)
    text = (table.schema.metadata or {}).get(_KEY.encode())
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    return columns, None if text is None else text.decode()
