"""Results on disk while they are made: appended in parts, each written whole, found again by what
they depend on.
"""

from __future__ import annotations

import os
import pickle
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import (
    UNFINISHED,
    atomic_path,
    new_folder,
    read_parquet,
    reading,
    sweep_temporary,
)
from starcal_uq.core.provenance import installed_versions
from starcal_uq.core.records import hash_of
from starcal_uq.core.types import AnyDict, PathLike

if TYPE_CHECKING:
    import pyarrow as pa

_PATTERN, _WHOLE = "[!.]*.parquet", "all-{}.parquet"


class Store:
    """Rows with a key, of a folder, which is made, or of memory alone where there is none.

    The `schema` has a column ``key``; `read` makes rows of the path of a part.
    """

    def __init__(
        self, folder: PathLike | None, schema: pa.Schema, read: Callable[[Path], pa.Table]
    ) -> None:
        self.folder, self.schema = None if folder is None else new_folder(folder), schema
        self._tables = (
            [read(path) for path in sorted(self.folder.glob(_PATTERN))]
            if self.folder is not None
            else []
        )

    def keys(self) -> set[str]:
        """Keys of the rows that are there."""
        return {key for table in self._tables for key in table["key"].to_pylist()}

    def append(self, rows: Sequence[AnyDict]) -> None:
        """Add rows; a part of the folder is there as a whole or not at all."""
        import pyarrow as pa

        table = pa.Table.from_pylist(list(rows), schema=self.schema)
        self._tables.append(table)
        if self.folder is not None:
            write_part(table, self.folder / f"part-{secrets.token_hex(8)}.parquet")

    def table(self) -> pa.Table:
        """All rows, each once."""
        import pyarrow as pa

        whole = (
            pa.concat_tables(self._tables)
            if self._tables
            else pa.Table.from_pylist([], schema=self.schema)
        )
        _, first = np.unique(
            np.array(whole["key"].to_pylist(), dtype=object).astype(str), return_index=True
        )
        return whole if len(first) == len(whole) else whole.take(np.sort(first))

    def consolidate(self) -> None:
        """One file instead of many parts; until they are gone, rows that stand in both count
        once.
        """
        if self.folder is None or len(self._tables) < 2:
            return
        parts = held(self.folder)
        whole = self.table()
        write_part(whole, self.folder / _WHOLE.format(secrets.token_hex(8)))
        for path in parts:
            path.unlink(missing_ok=True)
        self._tables = [whole]


def held(folder: PathLike) -> list[Path]:
    """The parts that a folder holds."""
    return list(Path(folder).glob(_PATTERN))


def take_over(old: PathLike, new: PathLike) -> None:
    """Put the rows of a folder in the place of another's; stopped anywhere, the first has them
    still, or the other.
    """
    for path in held(old):
        path.unlink()
    for path in held(new):
        os.replace(path, Path(old) / path.name)


def write_part(table: pa.Table, path: Path) -> None:
    """Write rows, all or nothing."""
    import pyarrow.parquet as pq

    with atomic_path(path) as temporary:
        pq.write_table(table, temporary)


class Kept:
    """Results of numbered tasks in the folder of a command that is not finished.

    Those that depend on something else than is wanted now are not found, and what cannot be read is
    passed over. `identity` is all that the tasks depend on but their number: a record, or what a
    record may hold; `kinds` are the named tuples and dataclasses that results are, or hold.
    """

    def __init__(self, folder: PathLike, identity: object, kinds: Sequence[type] = ()) -> None:
        import pyarrow as pa

        self._identity = hash_of([identity, installed_versions()])
        self._kinds = {(kind.__module__, kind.__name__): kind for kind in kinds}
        schema = pa.schema([("key", pa.string()), ("result", pa.binary())])

        def read(path: Path) -> pa.Table:
            try:
                with reading(path, "a part of the results", "delete it"):
                    table = read_parquet(path)
                    return table if table.schema == schema else schema.empty_table()
            except RunFolderError:
                return schema.empty_table()

        self._store = Store(Path(folder) / UNFINISHED, schema, read)

    def _key(self, number: int) -> str:
        return f"{self._identity}-{number}"

    def results(self, n_tasks: int) -> dict[int, Any]:
        """Results that are there, by the numbers of their tasks."""
        table = self._store.table()
        stored = dict(zip(table["key"].to_pylist(), table["result"].to_pylist(), strict=True))
        found = {}
        for number in range(n_tasks):
            with suppress(KeyError, pickle.UnpicklingError):
                found[number] = _Reader(stored[self._key(number)], self._kinds).load()
        return found

    def keep(self, results: Sequence[tuple[int, Any]]) -> None:
        """Add results."""
        self._store.append(
            [{"key": self._key(n), "result": pickle.dumps(value)} for n, value in results]
        )


class _Reader(pickle.Unpickler):
    """Reads plain values, arrays, and records of some kinds: whoever wrote the file, it can name
    nothing else.
    """

    _ARRAYS = ("_frombuffer", "_reconstruct", "dtype", "ndarray", "scalar")

    def __init__(self, content: bytes, kinds: Mapping[tuple[str, str], type]) -> None:
        super().__init__(BytesIO(content))
        self._kinds = kinds

    def find_class(self, module: str, name: str) -> Any:
        """A kind of record, or what NumPy makes arrays by; UnpicklingError for all else."""
        if module.partition(".")[0] == "numpy" and name in self._ARRAYS:
            return super().find_class(module, name)
        try:
            return self._kinds[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"{module}.{name} is no result") from None


def finished(folder: PathLike) -> None:
    """Remove what a command has kept, now that its results are written, and what killed ones have
    left.
    """
    sweep_temporary(folder)
    shutil.rmtree(Path(folder) / UNFINISHED, ignore_errors=True)
