"""Files are written whole or not at all, and what is wrong with one that is read is said in a
sentence.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import json
import os
import re
import reprlib
import secrets
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.core.errors import MissingExtraError, ObservationError, RunFolderError, StarcalError
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.types import PathLike

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from pyarrow.parquet import ParquetFile

# Names of files that are being written; a killed process leaves them.
TEMPORARY = re.compile(r"\.[0-9a-f]{16}\.tmp")
# Where a command keeps what it has not finished, and a step of a run its files; gone at their end.
UNFINISHED, STEP = ".unfinished", ".step"


def ensure_new(path: PathLike, force: bool = False) -> None:
    """Refuse to write over an existing file unless ``force`` is set, and over what is no regular
    file.
    """
    path = Path(path)
    # os.path, because Path.exists raises in a folder that may not be searched; the write itself
    # reports that.
    if not os.path.exists(path):
        return
    if path.is_dir():
        raise RunFolderError(f"{path}: is a directory; name a file to write to.")
    if not path.is_file():
        raise RunFolderError(f"{path}: is not a regular file; name a file to write to.")
    if not force:
        raise RunFolderError(
            f"{path}: the file exists already; choose another name or use --force (force=True in "
            "Python)."
        )


def check_new_folder(path: PathLike, force: bool = False) -> None:
    """Refuse a folder that holds anything, unless forced, or a file in its place; called before any
    work is done.
    """
    path = Path(path)
    _refuse_file(path)
    names = [inside.name for inside in path.iterdir()] if path.is_dir() else []
    # What a command has not finished, it goes on with, whatever it had written by then.
    if force or UNFINISHED in names:
        return
    if any(name != STEP and not TEMPORARY.match(name) for name in names):
        raise RunFolderError(
            f"{path}: the folder exists and is not empty; name another, or replace its results "
            "with --force."
        )


def _refuse_file(path: Path) -> None:
    # os.path, because Path.exists raises in a folder that may not be searched.
    if os.path.exists(path) and not os.path.isdir(path):
        raise RunFolderError(f"{path}: is a file, not a folder; name a folder.")


def sweep_temporary(folder: PathLike) -> None:
    """Remove files that a killed process was writing in a folder."""
    for path in Path(folder).glob(".*"):
        if TEMPORARY.match(path.name):
            path.unlink(missing_ok=True)


def new_folder(path: PathLike) -> Path:
    """Make a folder, with its parents, if it does not exist."""
    path = Path(path)
    _refuse_file(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"{path}: the folder cannot be made ({error.strerror}); choose another place."
        ) from error
    return path


def default_cache_dir() -> Path:
    """The platform's folder for files that can be made again, with this package's name."""
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "starcal_uq"
    if sys.platform == "win32":  # pragma: no cover
        return (
            Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
            / "starcal_uq"
            / "Cache"
        )
    if sys.platform == "darwin":  # pragma: no cover
        return Path.home() / "Library" / "Caches" / "starcal_uq"
    return Path.home() / ".cache" / "starcal_uq"


@contextmanager
def atomic_path(path: PathLike, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` if the block succeeds; if not,
    `path` is as it was.

    The temporary name keeps the ending, because many writers choose the format by it. What is
    `durable` is on the disk before it is renamed, so that a loss of power, too, leaves the old file
    or the new one. RunFolderError if the folder is missing, `path` is a directory or a device, or
    the system refuses the write.
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
        if durable:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise RunFolderError(
            f"{path}: cannot be written ({error.strerror or error}); check the permissions of the "
            "folder and the free space."
        ) from error
    finally:
        # Asked first: in a folder that may not be searched, unlink would raise and hide the reason.
        if os.path.lexists(temporary):
            temporary.unlink()


def flush_folder(path: PathLike) -> None:
    """Have the names in a folder on the disk, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def atomic_write_bytes(path: PathLike, data: bytes) -> None:
    """Write `data` to `path`, all or nothing."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def atomic_write_text(path: PathLike, text: str) -> None:
    """Write `text` to `path` in UTF-8 with line feeds as they are, all or nothing."""
    atomic_write_bytes(path, text.encode("utf-8"))


def write_csv(table: pd.DataFrame, path: PathLike) -> None:
    """Write a table as CSV without its index, to the last digit, all or nothing; texts as
    `cell_text` has them.
    """
    texts = {
        name: [cell_text(value) if isinstance(value, str) else value for value in column]
        for name, column in table.items()
        if column.dtype.kind not in "biufcmM"
    }
    with atomic_path(path) as temporary:
        table.assign(**texts).to_csv(temporary, index=False, lineterminator="\n")


# What spreadsheets take for a formula, whoever wrote the file; the apostrophe is their own mark of
# a text.
_FORMULA = re.compile(r"'*[=+\-@\t\n].", re.DOTALL)


def cell_text(text: str) -> str:
    """A text for a cell of a table that may be opened as a spreadsheet.

    One that would be run as a formula gets an apostrophe before it, which `cell_content` takes away
    again; numbers stay as they are. A carriage return, which would end the row unless it is quoted,
    becomes a line feed, which is.
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if not _FORMULA.match(text):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def cell_content(cell: str) -> str:
    """Inverse of `cell_text`."""
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


# What a file unpacks to or declares may take this much memory, or this many times its own size.
_MODEST_BYTES, _MODEST_RATIO = 2**28, 100


def check_size(declared: int, stored: int) -> None:
    """Refuse, with ValueError, content of `declared` bytes that no file of ours with `stored` bytes
    unpacks to.
    """
    if declared > max(_MODEST_BYTES, _MODEST_RATIO * stored):
        raise ValueError(
            f"it declares {float(declared):.3g} bytes of content, far more than it can hold"
        )


def unpack(packed: bytes) -> Iterator[bytes]:
    """Pieces of what gzip has packed, or all of what it has not; ValueError where that is far more
    than tables are.
    """
    if packed[:2] != b"\x1f\x8b":
        yield packed
        return
    size = 0
    with gzip.GzipFile(fileobj=BytesIO(packed)) as content:
        while piece := content.read(2**22):
            size += len(piece)
            check_size(size, len(packed))
            yield piece


@contextmanager
def open_parquet(source: Path | bytes) -> Iterator[ParquetFile]:
    """A Parquet file, or its content; ValueError for two columns of one name, and for more rows than
    it can hold.
    """
    import pyarrow as pa
    from pyarrow import parquet

    opened = source if isinstance(source, Path) else pa.BufferReader(source)
    with parquet.ParquetFile(opened, pre_buffer=False) as file:
        names = file.schema_arrow.names
        if twice := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"column {min(twice)} occurs twice")
        stored = source.stat().st_size if isinstance(source, Path) else len(source)
        check_size(file.metadata.num_rows * len(names) * 8, stored)
        yield file


def read_parquet(source: Path | bytes) -> pa.Table:
    """A Parquet file; the caller's `reading` makes a sentence of whatever is raised."""
    with open_parquet(source) as file:
        return file.read(use_threads=False)


def read_bytes(path: Path, what: str, error: type[StarcalError]) -> bytes:
    """Content of a file that should be `what`, such as "an image"; `error` where it has none."""
    if os.path.exists(path) and not os.path.isfile(path):
        kind = "a directory" if os.path.isdir(path) else "not a regular file"
        raise error(f"{path}: is {kind}; name {what}.")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise error(f"{path}: the file does not exist; check the path.") from None
    except OSError as problem:
        raise error(
            f"{path}: cannot be read ({problem.strerror}); check its permissions."
        ) from problem
    if not data or data.isspace():
        raise error(f"{path}: the file is empty; give {what}.")
    return data


# A card of a header that counts something, up to its comment.
_COUNT = re.compile(rb"([A-Z]+\d{0,3}) *=([^/]{0,70})")
# Of an image, and columns of a table.
_MOST_AXES = 999


def check_fits(content: bytes) -> None:
    """Refuse, with ValueError, FITS headers whose sizes are none, or that count more axes or
    columns than FITS knows.

    Astropy would go through them one by one, or go back by negative sizes, without end.
    """
    for key in (b"NAXIS", b"TFIELDS", b"PCOUNT", b"GCOUNT"):
        place = content.find(key)
        while place >= 0:
            card = _COUNT.match(content, place)
            first = place - (content[place - 1 : place] == b"Z")
            if first % 80 == 0 and card is not None:
                value = card[2].strip()
                most = _MOST_AXES if card[1] in (b"NAXIS", b"TFIELDS") else sys.maxsize
                if not (value.isdigit() and int(value) <= most):
                    raise ValueError(
                        f"its header states {card[1].decode()} as {value[:20].decode('latin-1')}"
                    )
            place = content.find(key, place + 1)


def write_netcdf(path: PathLike, fill: Callable[[Any], None]) -> None:
    """Write a netCDF file with its seal, all or nothing; `fill` gets the open `h5netcdf.File`.

    It is made in memory: on a full disk the HDF5 library ends the process without a word.
    """
    import h5netcdf

    content = BytesIO()
    with h5netcdf.File(content, "w") as file:
        fill(file)
    atomic_write_bytes(path, sealed(content.getvalue()))


_SEAL = re.compile(rb"\nsha256 ([0-9a-f]{64})\n")
_SEAL_BYTES = 73


def sealed(content: bytes) -> bytes:
    """The content of an HDF5 file with its hash behind it, where readers of HDF5 do not look."""
    return content + b"\nsha256 %s\n" % hashlib.sha256(content).hexdigest().encode()


def check_hdf5(path: PathLike) -> None:
    """Refuse, with ValueError, an HDF5 file that is not as `sealed` left it, or declares more than
    it can hold.

    The HDF5 library does not find that its files were damaged: it may give other numbers, or never
    come back.
    """
    import h5py

    content = Path(path).read_bytes()
    seal = _SEAL.fullmatch(content[-_SEAL_BYTES:])
    if seal is None:
        raise ValueError("it is cut off, or not of this version")
    if hashlib.sha256(content[:-_SEAL_BYTES]).hexdigest().encode() != seal[1]:
        raise ValueError("its content was changed after it was written")
    stored = len(content)

    def check(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            check_size(item.nbytes if item.shape is not None else 0, stored)

    with h5py.File(path, "r") as file:
        file.visititems(check)


def shown(value: Any) -> str:
    """What stands in a file or was given, for a message: as Python writes it, cut where it is long
    or deep.
    """
    try:
        return _SHORT.repr(value)
    except ValueError:
        # Python writes no whole number of more than 4300 digits.
        return "a number of thousands of digits"


def listed(names: Sequence[str]) -> str:
    """Columns of a file for a message, where they are not what they should be: the first ones, none
    too long.
    """
    first = [
        name if len(name) <= _LONGEST_NAME else f"{name[:_LONGEST_NAME]}..."
        for name in names[:_MOST_NAMES]
    ]
    rest = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(first) + rest


_MOST_NAMES, _LONGEST_NAME = 10, 20
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 60
_SHORT.maxlevel = 3
_LONGEST_REASON = 160
# Words that only make sense to whoever wrote the program.
_INTERNAL = re.compile(
    r"<class |<\w+\.\w|NoneType|0x[0-9a-f]{6}|\b[A-Z]\w*(Error|Exception)\b|_\w+\(|\(\)"
)
# A file that was cut off, or is something else, shows itself by any of these, depending on where it
# was cut.
_REASONS: tuple[tuple[type[Exception] | tuple[type[Exception], ...], str], ...] = (
    (MemoryError, "it declares more than fits into memory"),
    (RecursionError, "its values are nested too deeply"),
    (UnicodeError, "its text is not UTF-8"),
    ((EOFError, struct.error), "it ends too early"),
    ((zipfile.BadZipFile, zlib.error, tokenize.TokenError), "it is damaged or cut off"),
    (OverflowError, "a number in it is too large"),
    ((TypeError, AttributeError, IndexError), "its content has another form"),
)


def reason_of(error: Exception) -> str:
    """Why a file cannot be what it should be, in a few plain words without an end."""
    for kinds, words in _REASONS:
        if isinstance(error, kinds):
            return words
    if isinstance(error, json.JSONDecodeError):
        return f"line {error.lineno} is no JSON"
    if isinstance(error, KeyError):
        keys = error.args[0] if error.args and isinstance(error.args[0], tuple) else error.args
        name = " ".join(map(str, keys))
        return (
            f"{name} is missing"
            if 0 < len(name) <= 60 and name.isprintable()
            else "a part of it is missing"
        )
    if not isinstance(error, ValueError | StarcalError | csv.Error):
        return "it is damaged or cut off"
    text = " ".join(str(error).split()).removesuffix(".")
    if not text or _INTERNAL.search(text):
        return "its content has another form"
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= _LONGEST_REASON else f"{text[: _LONGEST_REASON - 3]}..."


@contextmanager
def reading(
    path: PathLike, what: str, remedy: str | Remedy, error: type[StarcalError] = RunFolderError
) -> Iterator[None]:
    """For a block that makes a result of a file: whatever goes wrong there becomes one error, of
    one sentence.

    It says what the file should hold, such as "a field map", and by the remedy, an order, how to
    get such a file. An error of this package that names the file already is let through.
    """
    try:
        yield
    except MissingExtraError:
        raise
    except Exception as problem:
        if isinstance(problem, StarcalError) and str(problem).startswith(os.fspath(path)):
            if isinstance(problem, error):
                raise
            raise error(str(problem)) from problem
        if isinstance(problem, OSError) and problem.errno is not None:
            # The path that failed, which may be that of a file beside this one.
            place = path if problem.filename is None else os.fsdecode(problem.filename)
            sentence = f"{place}: cannot be read ({os.strerror(problem.errno)}); {remedy}."
        else:
            empty = os.path.isfile(path) and not os.path.getsize(path)
            sentence = (
                f"{path}: is not {what} "
                f"({'the file is empty' if empty else reason_of(problem)}); {remedy}."
            )
        raise error(sentence) from problem


ENDINGS = (".csv", ".ecsv", ".parquet")


def table_ending(path: Path, endings: tuple[str, ...] = ENDINGS) -> str:
    """The ending of a table's file name, which decides on its format."""
    ending = path.suffix.lower()
    if ending not in endings:
        raise ObservationError(
            f"{path}: the ending {ending or '(none)'} is unknown; use {', '.join(endings)}."
        )
    return ending


def as_plain(value: Any) -> Any:
    """For json.dumps: numpy values as Python's, anything else in words."""
    import numpy as np

    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def split_part(path: PathLike) -> tuple[str, int | None]:
    """Name of a file and the number of a part of it behind a ``#``, as ``kernel.ti#-98301``."""
    match = re.fullmatch(r"(.+\.\w+)#(-?\d+)", os.fspath(path))
    return (match[1], int(match[2])) if match else (os.fspath(path), None)
