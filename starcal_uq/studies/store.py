"""Cells on disk: appended in parts, each written whole, found again by the hash of what they depend on."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import StudyError
from starcal_uq.core.files import PathLike, atomic_path, new_folder, read_parquet, reading
from starcal_uq.core.types import AnyDict
from starcal_uq.studies.result import TEXTS, VARIABLES

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER = "cells"
_PATTERN, _WHOLE = "[!.]*.parquet", "all-{}.parquet"


def _schema() -> pa.Schema:
    import pyarrow as pa

    fields = [(name, pa.string()) for name in ("key", "model", "status", *TEXTS)]
    fields += [(name, pa.list_(pa.float64()) if dims else pa.float64()) for name, (dims, _, _) in VARIABLES.items()]
    return pa.schema(fields)


def rows_table(rows: Sequence[AnyDict]) -> pa.Table:
    """Rows of cells, `row` each, as a table."""
    import pyarrow as pa

    return pa.Table.from_pylist(list(rows), schema=_schema())


def row(key: str, model: str, numbers: AnyDict) -> AnyDict:
    """The numbers of a cell as plain values; arrays are flat, in the order of its own model."""
    plain: AnyDict = {"key": key, "model": model}
    for name, value in numbers.items():
        if isinstance(value, dict):
            value = np.concatenate([np.atleast_1d(v) for v in value.values()]) if value else []
        plain[name] = value.ravel().tolist() if isinstance(value, np.ndarray) else value
    return plain


class Store:
    """Cells of a folder, or of memory alone where there is none."""

    def __init__(self, folder: PathLike | None) -> None:
        self.folder = None if folder is None else new_folder(Path(folder) / FOLDER)
        self._tables: list[pa.Table] = []
        for path in sorted(self.folder.glob(_PATTERN)) if self.folder is not None else []:
            self._tables.append(_read(path))

    def clear(self) -> None:
        """Forget all cells."""
        self._tables = []
        for path in self.folder.glob(_PATTERN) if self.folder is not None else []:
            path.unlink()

    def keys(self) -> set[str]:
        """Hashes of the cells that are there."""
        return {key for table in self._tables for key in table["key"].to_pylist()}

    def append(self, rows: Sequence[AnyDict]) -> None:
        """Add cells; a part of the folder is there as a whole or not at all."""
        table = rows_table(rows)
        self._tables.append(table)
        if self.folder is not None:
            _write(table, self.folder / f"part-{secrets.token_hex(8)}.parquet")

    def table(self) -> pa.Table:
        """All cells, each once."""
        import pyarrow as pa

        whole = pa.concat_tables(self._tables) if self._tables else rows_table([])
        _, first = np.unique(np.array(whole["key"].to_pylist(), dtype=object).astype(str), return_index=True)
        return whole if len(first) == len(whole) else whole.take(np.sort(first))

    def consolidate(self) -> None:
        """One file instead of many parts; until they are gone, cells that stand in both count once."""
        if self.folder is None or len(self._tables) < 2:
            return
        parts = list(self.folder.glob(_PATTERN))
        whole = self.table()
        _write(whole, self.folder / _WHOLE.format(secrets.token_hex(8)))
        for path in parts:
            path.unlink(missing_ok=True)
        self._tables = [whole]


def _write(table: pa.Table, path: Path) -> None:
    import pyarrow.parquet as pq

    with atomic_path(path) as temporary:
        pq.write_table(table, temporary)


def _read(path: Path) -> pa.Table:
    with reading(path, "a part of a study", "delete it, and its cells are computed again"):
        table = read_parquet(path)
        if table.schema != _schema():
            raise StudyError("it has other columns")
        return table
