"""Results as one ``.npz`` file: arrays to the last bit, all else as JSON beside them."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from starcal_uq.core.errors import RunFolderError, StarcalError
from starcal_uq.core.types import AnyDict
from starcal_uq.runs.folder import atomic_path

# A file that was cut off, or is something else, shows itself by any of these, depending on where it was cut.
_UNREADABLE = (KeyError, ValueError, TypeError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error, StarcalError)


def write_archive(path: str | os.PathLike[str], kind: str, document: AnyDict, arrays: Mapping[str, Any]) -> None:
    """Write an archive of a kind, atomically; overwritten."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, format=np.array(kind), document=np.array(json.dumps(document)), **arrays
        )


@contextmanager
def reading_archive(
    path: str | os.PathLike[str], kind: str, *, missing: str, wrong: str
) -> Iterator[tuple[AnyDict, dict[str, Any]]]:
    """Document and arrays of an archive, for a block that makes a result of them.

    Parameters
    ----------
    path : path
        File.
    kind : str
        What `write_archive` was told.
    missing, wrong : str
        How the sentence goes on for a file that cannot be read, and for one that is not such a result, also where the
        block finds that out.

    Raises
    ------
    RunFolderError
        In one sentence.
    """
    try:
        # Opened here: NumPy leaves a file open that turns out not to be what it seems.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        if str(arrays.pop("format")) != kind:
            raise ValueError("another format")
        yield json.loads(str(arrays.pop("document"))), arrays
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be read ({error.strerror or error}); {missing}.") from error
    except _UNREADABLE as error:
        raise RunFolderError(f"{path}: {wrong}.") from error
