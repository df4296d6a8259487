"""Cells on disk: appended in parts, each written whole, found again by the hash of what they depend
on.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core import store
from starcal_uq.core.errors import StudyError
from starcal_uq.core.files import read_parquet, reading
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.studies.result import TEXTS, VARIABLES

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER = "cells"


def _schema() -> pa.Schema:
    import pyarrow as pa

    fields = [(name, pa.string()) for name in ("key", "model", "status", *TEXTS)]
    fields += [
        (name, pa.list_(pa.float64()) if dims else pa.float64())
        for name, (dims, _, _) in VARIABLES.items()
    ]
    return pa.schema(fields)


def row(key: str, model: str, numbers: AnyDict) -> AnyDict:
    """The numbers of a cell as plain values; arrays are flat, in the order of its own model."""
    plain: AnyDict = {"key": key, "model": model}
    for name, value in numbers.items():
        if isinstance(value, dict):
            value = np.concatenate([np.atleast_1d(v) for v in value.values()]) if value else []
        plain[name] = value.ravel().tolist() if isinstance(value, np.ndarray) else value
    return plain


class Store(store.Store):
    """Cells of a folder, or of memory alone where there is none."""

    def __init__(self, folder: PathLike | None) -> None:
        super().__init__(None if folder is None else Path(folder) / FOLDER, _schema(), _read)


def _read(path: Path) -> pa.Table:
    import pyarrow as pa

    with reading(path, "a part of a study", "delete it, and its cells are computed again"):
        table = read_parquet(path)
        # Cells of earlier versions have no slopes.
        for place, each in enumerate(_schema()):
            if each.name.startswith("slope_") and each.name not in table.column_names:
                table = table.add_column(place, each, pa.nulls(len(table), each.type))
        if table.schema != _schema():
            raise StudyError("it has other columns")
        return table
