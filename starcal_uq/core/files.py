"""Files are written whole or not at all, and what is wrong with one that is read is said in a sentence."""

from __future__ import annotations

import csv
import os
import secrets
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ObservationError, RunFolderError, StarcalError

if TYPE_CHECKING:
    import pandas as pd

PathLike = str | os.PathLike[str]


def ensure_new(path: PathLike, force: bool = False) -> None:
    """Refuse to write over an existing file unless ``force`` is set, and over what is no regular file."""
    path = Path(path)
    # os.path, because Path.exists raises in a folder that may not be searched; the write itself reports that.
    if not os.path.exists(path):
        return
    if path.is_dir():
        raise RunFolderError(f"{path}: is a directory; name a file to write to.")
    if not path.is_file():
        raise RunFolderError(f"{path}: is not a regular file; name a file to write to.")
    if not force:
        raise RunFolderError(
            f"{path}: the file exists already; choose another name or use --force (force=True in Python)."
        )


def check_new_folder(path: PathLike, force: bool = False) -> None:
    """Refuse a folder that holds anything, unless forced, or a file in its place; called before any work is done."""
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise RunFolderError(f"{path}: is a file, not a folder for results; name another folder.")
    if path.is_dir() and any(path.iterdir()) and not force:
        raise RunFolderError(
            f"{path}: the folder exists and is not empty; name another, or replace its results with --force."
        )


def new_folder(path: PathLike) -> Path:
    """Make a folder, with its parents, if it does not exist."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{path}: the folder cannot be made ({error.strerror}); choose another place.") from error
    return path


@contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` if the block succeeds; if not, `path` is as it was.

    The temporary name keeps the ending, because many writers choose the format by it.

    Raises
    ------
    RunFolderError
        If the folder is missing, `path` is a directory or a device, or the system refuses the write.
    """
    # A link is followed: replacing it by a file would silently detach the place it points to.
    target = Path(os.path.realpath(path))
    ensure_new(target, force=True)
    if not os.path.isdir(target.parent):
        raise RunFolderError(f"{path}: the folder {target.parent} does not exist; create it first.")
    # No tempfile.mkstemp: its files are private to the user, and would stay so after the rename.
    temporary = target.parent / f".{secrets.token_hex(8)}.tmp{target.suffix}"
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunFolderError(
            f"{path}: cannot be written ({reason}); check the permissions of the folder and the free space."
        ) from error
    finally:
        # Asked first: in a folder that may not be searched, unlink would raise and hide the reason.
        if os.path.lexists(temporary):
            temporary.unlink()


def atomic_write_bytes(path: PathLike, data: bytes) -> None:
    """Write `data` to `path`, all or nothing."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def atomic_write_text(path: PathLike, text: str) -> None:
    """Write `text` to `path` in UTF-8 with line feeds as they are, all or nothing."""
    atomic_write_bytes(path, text.encode("utf-8"))


def write_csv(table: pd.DataFrame, path: PathLike) -> None:
    """Write a table as CSV without its index, to the last digit, all or nothing."""
    with atomic_path(path) as temporary:
        table.to_csv(temporary, index=False, lineterminator="\n")


# A file that was cut off, or is something else, shows itself by any of these, depending on where it was cut.
_UNREADABLE = (
    KeyError, ValueError, TypeError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error, csv.Error, StarcalError,
)  # fmt: skip


@contextmanager
def reading(path: PathLike, what: str, remedy: str) -> Iterator[None]:
    """For a block that makes a result of a file: what goes wrong there becomes one `RunFolderError`.

    It says what the file should hold, such as "a field map", and by the remedy, an order, how to get such a file.
    """
    try:
        yield
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be read ({error.strerror or error}); {remedy}.") from error
    except _UNREADABLE as error:
        reason = f"{type(error).__name__}: {error}".removesuffix(".")
        raise RunFolderError(f"{path}: is not {what} ({reason}); {remedy}.") from error


ENDINGS = (".csv", ".ecsv", ".parquet")


def table_ending(path: Path) -> str:
    """The ending of a table's file name, which decides on its format."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ObservationError(f"{path}: the ending {ending or '(none)'} is unknown; use {', '.join(ENDINGS)}.")
    return ending


def as_plain(value: Any) -> Any:
    """For json.dumps: numpy values as Python's, anything else in words."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
