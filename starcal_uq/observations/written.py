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
from starcal_uq.core.tables import write_parquet
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
            # Pixels repeat nowhere: looking for repeats in them takes as long as all the rest.
            repeating = [name for name in columns if name not in ("x_px", "y_px")]
            write_parquet(columns, temporary, json.dumps(plain), use_dictionary=repeating)


def _csv_text(columns: AnyMapping) -> str:
    texts = []
    for name, values in columns.items():
        cells = (values.map(cell_text) if COLUMNS[name].kind == "text" else values).tolist()
        # An empty cell is how every spreadsheet writes a gap.
        texts.append(["" if v != v else v for v in cells] if COLUMNS[name].gaps else cells)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")  # writes floats by repr, which keeps every digit
    writer.writerow(columns)
    writer.writerows(zip(*texts, strict=True))
    return text.getvalue()
