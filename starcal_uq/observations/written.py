"""The observations table as it is written: plain columns and metadata into files."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.extras import extra
from starcal_uq.core.files import (
    as_plain,
    atomic_path,
    atomic_write_bytes,
    atomic_write_text,
    cell_text,
    ensure_new,
    table_ending,
)
from starcal_uq.core.tables import coded, write_parquet
from starcal_uq.core.texts import Texts
from starcal_uq.core.types import AnyDict, AnyMapping, PathLike
from starcal_uq.observations.columns import COLUMNS
from starcal_uq.observations.files import WRITTEN
from starcal_uq.observations.matches import corr_content, fits_content

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera


def astropy_table(columns: AnyMapping, meta: AnyDict) -> Any:
    """The columns as an astropy Table with units and descriptions."""
    with extra("images", "ECSV tables"):
        from astropy.table import Table

    table = Table(dict(columns), meta=dict(meta))
    for name in columns:
        table[name].unit = COLUMNS[name].unit or None
        table[name].description = COLUMNS[name].description
    return table


def write_table(
    columns: AnyMapping,
    meta: AnyDict,
    path: PathLike,
    force: bool,
    camera: Camera | None = None,
) -> None:
    """Write columns and metadata; see `starcal_uq.observations.table.Observations.save`."""
    ending = table_ending(Path(path), WRITTEN)
    files = {Path(path): columns}
    if ending == ".corr" and len(frames := np.unique(columns["frame"])) > 1:
        # That format knows one frame.
        rows = {int(frame): columns["frame"] == frame for frame in frames}
        files = {
            Path(path).with_name(f"{Path(path).stem}_{frame}.corr"): {
                name: v[own] for name, v in columns.items()
            }
            for frame, own in rows.items()
        }
    for name in files:
        ensure_new(name, force)
    if ending == ".csv":
        atomic_write_text(path, _csv_text(columns))
        return
    plain = json.loads(json.dumps(meta, default=as_plain))
    if ending in (".fits", ".corr"):
        for name, part in files.items():
            content = (
                fits_content(part, plain)
                if ending == ".fits"
                else corr_content(part, plain, camera)
            )
            atomic_write_bytes(name, content)
        return
    with atomic_path(path) as temporary:
        if ending == ".ecsv":
            astropy_table(columns, plain).write(temporary, format="ascii.ecsv", delimiter=",")
        else:
            write_parquet(columns, temporary, json.dumps(plain))


def _csv_text(columns: AnyMapping) -> str:
    texts = []
    for name, values in columns.items():
        cells = values.tolist()
        if COLUMNS[name].kind == "text":
            cells = list(map(cell_text, cells))
        # An empty cell is how every spreadsheet writes a gap.
        texts.append(["" if v != v else v for v in cells] if COLUMNS[name].gaps else cells)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")  # writes floats by repr, which keeps every digit
    writer.writerow(columns)
    writer.writerows(zip(*texts, strict=True))
    return text.getvalue()


def write_partition(
    columns: AnyMapping,
    meta: AnyDict,
    path: Path,
) -> None:
    """Write one Parquet file of a folder of partitions, atomically and quickly; overwritten."""
    arrays = {name: columns[name] for name in COLUMNS if name in columns}
    arrays |= {name: coded(text) for name, text in arrays.items() if isinstance(text, Texts)}
    # Pixels repeat nowhere: looking for repeats in them, or compressing them, would take longer
    # than all the rest.
    pixels = {"x_px", "y_px"}
    with atomic_path(path) as temporary:
        write_parquet(
            arrays,
            temporary,
            json.dumps(meta, default=as_plain),
            compression={name: "none" if name in pixels else "zstd" for name in arrays},
            use_dictionary=[name for name in arrays if name not in pixels],
        )
