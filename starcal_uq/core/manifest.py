"""The record of a run, ``run.json``: which files belong together, and how a step replaces some of
them at once.

A step writes its files into a folder within the run, and the record of what the run then holds is
the one file whose renaming makes them count: before it the run is the old one, after it the new
one, whatever comes between. Whoever opens the run next moves the files to their places, if the
process that should have done it is gone.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import (
    STEP,
    TEMPORARY,
    UNFINISHED,
    check_new_folder,
    flush_folder,
    new_folder,
    sweep_temporary,
)
from starcal_uq.core.provenance import Provenance, provenance
from starcal_uq.core.records import read_json, write_json
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.store import finished
from starcal_uq.core.types import AnyDict, PathLike

MANIFEST, NEW = "run.json", ".new"
_FORMAT = "starcal_uq run 1"
# By it a run is known whose version wrote no record.
_OF_A_RUN = "calibration.json"
_WHAT = ("the record of a run", "delete it, and the folder is read without it")
# Larger files are known by their size and time.
_MAX_HASHED = 2**26
# Device, number, size and time of a file -> its hash; each is read once in a process.
_digests: dict[tuple[int, int, int, int], str] = {}


@dataclass(frozen=True)
class Entry:
    """One file of a run: its size in bytes, the hash of its content, and the step that it belongs
    to.
    """

    bytes: int
    sha256: str
    step: str


@dataclass(frozen=True)
class Manifest:
    """What a run holds.

    `files` are those that the run has written, by their names within the folder; others are the
    user's. `steps` have the provenance of each step that is done. Of a run that a single command
    makes, `command` holds settings and hashes of the inputs, `words` the command as it was typed,
    without the program's name, and `tried` the options and outcomes of the runs of the same data
    that it has replaced; it is not `complete` while the command is under way, or was interrupted.
    In the folder `stage`, files of the last step wait to be moved to their places; those that are
    `gone` rested on what it replaced, and are to be removed.
    """

    files: dict[str, Entry] = field(default_factory=dict)
    steps: dict[str, Provenance] = field(default_factory=dict)
    command: AnyDict | None = None
    words: tuple[str, ...] = ()
    tried: tuple[AnyDict, ...] = ()
    complete: bool = True
    stage: str = ""
    gone: tuple[str, ...] = ()
    format: str = _FORMAT

    def __post_init__(self) -> None:
        # What is named here is moved and removed.
        for name in (*self.files, *self.gone, self.stage):
            place = PurePath(name)
            if place.is_absolute() or ".." in place.parts or not name.isprintable():
                raise ValueError("the record of the run names a file elsewhere")


def read_manifest(folder: Path) -> Manifest | None:
    """The record of a run, its files at their places; None for a folder that has none."""
    path = folder / MANIFEST
    if not os.path.exists(path):
        return None
    found = read_json(Manifest, path, *_WHAT)
    return _settle(folder, found) if found.stage else found


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the record of a run."""
    write_json(manifest, folder / MANIFEST)


def commit(folder: Path, manifest: Manifest, old: Collection[str]) -> Manifest:
    """Let the files in ``manifest.stage`` count, and remove those of `old` that are no more; all or
    nothing.

    Refused if a file is in the way that the run has not written.
    """
    for name in manifest.files:
        if name not in old and os.path.lexists(folder / name):
            raise RunFolderError(
                f"{folder / name}: is in the way of a result, and not of this run: move it "
                "elsewhere, and start again."
            )
    for place in _folders(folder / manifest.stage, manifest.files):
        flush_folder(place)
    manifest = replace(manifest, gone=tuple(sorted(set(old) - set(manifest.files))))
    write_manifest(folder, manifest)
    flush_folder(folder)
    return _settle(folder, manifest)


def _folders(folder: Path, names: Collection[str]) -> list[Path]:
    """A folder and those within it in which files of these names stand."""
    inside = dict.fromkeys((folder / name).parent for name in names)
    return [folder, *(place for place in inside if place != folder and place.is_dir())]


def _settle(folder: Path, manifest: Manifest) -> Manifest:
    """Move what waits to its place; may be done twice, or by two processes."""
    stage = folder / manifest.stage
    try:
        for name in manifest.files:
            if os.path.lexists(stage / name):
                (folder / name).parent.mkdir(exist_ok=True)
                # Another process that settles the same may have been faster.
                with suppress(FileNotFoundError):
                    os.replace(stage / name, folder / name)
        for name in manifest.gone:
            (folder / name).unlink(missing_ok=True)
        for place in _folders(folder, (*manifest.files, *manifest.gone)):
            flush_folder(place)
        settled = replace(manifest, stage="", gone=())
        write_manifest(folder, settled)
    except OSError as error:
        raise RunFolderError(
            f"{folder}: its last step cannot be completed ({error.strerror}); check the "
            "permissions of the folder and "
            "the space on the disk, and start again."
        ) from error
    shutil.rmtree(stage, ignore_errors=True)
    return settled


def entry_of(path: Path, step: str) -> Entry:
    """A file as it is, as a file of a step."""
    return Entry(path.stat().st_size, digest(path), step)


def digest(path: Path) -> str:
    """Hash of a file; read once in a process as long as size and time stay."""
    state = path.stat()
    key = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns)
    if key not in _digests:
        with path.open("rb") as file:
            _digests[key] = hashlib.file_digest(file, "sha256").hexdigest()
    return _digests[key]


def check_file(path: Path, entry: Entry | None, remedy: str | Remedy) -> None:
    """Refuse a file that is not the one that the run has written; the remedy is an order."""
    if entry is None:
        raise RunFolderError(
            f"{path}: is not a file of this run ({MANIFEST} does not list it); {remedy}."
        )
    size = path.stat().st_size
    if size != entry.bytes:
        reason = f"it has {size} bytes and had {entry.bytes}"
    elif digest(path) != entry.sha256:
        reason = f"its content is not that which {MANIFEST} states"
    else:
        return
    raise RunFolderError(f"{path}: is not the file that this run has written ({reason}); {remedy}.")


def identity(paths: Mapping[str, Path]) -> AnyDict:
    """What tells inputs from others: hashes of the files, or of those in a folder; size and time of
    large ones.
    """
    found: AnyDict = {}
    for label, path in paths.items():
        if not path.exists():
            # Whoever reads it says so.
            continue
        files = (
            sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
        )
        for file in files:
            state = file.stat()
            large = state.st_size > _MAX_HASHED
            place = file.relative_to(path).as_posix() if path.is_dir() else file.name
            found[f"{label}: {place}"] = (
                [state.st_size, state.st_mtime_ns] if large else digest(file)
            )
    return found


def check_hidden(folder: Path, name: str, ours: Collection[str] = ()) -> None:
    """Refuse a hidden folder within a run that is a link or a file, or holds what no run has
    written; nothing goes.

    `ours` are starts of names of files that are the run's without being recorded.
    """
    place = folder / name
    if os.path.islink(place) or (os.path.lexists(place) and not place.is_dir()):
        raise RunFolderError(
            f"{place}: is not a folder that a run has made; move it elsewhere, and start again."
        )
    if name == STEP or not place.is_dir():
        return
    found = read_manifest(place) or Manifest()
    hidden = (MANIFEST, STEP, UNFINISHED, *ours)
    for inside, path in files_in(place).items():
        if not (inside in found.files or inside.startswith(hidden) or TEMPORARY.match(path.name)):
            raise RunFolderError(
                f"{path}: is not of a run, and would go with its hidden folder; move it "
                "elsewhere, and start again."
            )


def discard(folder: Path, stage: str) -> None:
    """Remove the files of a step, unless the record says that they count."""
    path = folder / MANIFEST
    counts = os.path.exists(path) and read_json(Manifest, path, *_WHAT).stage == stage
    if not counts:
        shutil.rmtree(folder / stage, ignore_errors=True)


def sweep(folder: Path) -> None:
    """Remove what a killed process has left: temporary files, and a step that does not count."""
    discard(folder, STEP)
    sweep_temporary(folder)


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield a folder for files that wait for `commit`; gone at the end, unless they count."""
    check_hidden(folder, STEP)
    sweep(folder)
    try:
        yield new_folder(folder / STEP)
    finally:
        discard(folder, STEP)


def files_in(folder: Path) -> dict[str, Path]:
    """All files in a folder and those within it, by their names in it."""
    return {
        path.relative_to(folder).as_posix(): path
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@contextmanager
def making(
    folder: PathLike, command: str, main: str, *, force: bool = False, also: Sequence[str] = ()
) -> Iterator[Path]:
    """Yield a folder for all results of a command; they take their places at once, if the block
    succeeds.

    Until then `folder`, in which no other process can make results, holds the earlier results.
    What the command has kept there on its way (`core.store.Kept`) goes when the results are there.
    `main` is the result that versions without records always wrote; `also` are patterns of results
    that may be replaced without being recorded, because functions write them one by one.
    """
    place = Path(folder)
    with alone(place):
        old = read_manifest(place)
        refuse_others(place, (command,))
        check_new_folder(place, force)
        try:
            with staged(place) as stage:
                yield stage
                made = {name: entry_of(path, command) for name, path in files_in(stage).items()}
                known = ("*",) if old is None and os.path.exists(place / main) else also
                before = {
                    name for name in made for pattern in known if PurePath(name).match(pattern)
                }
                before |= set() if old is None else set(old.files)
                if made:
                    record = provenance(None, {}, None)
                    commit(place, Manifest(made, {command: record}, stage=STEP), before)
            finished(place)
        finally:
            with suppress(OSError):
                # Nothing was kept.
                (place / UNFINISHED).rmdir()


def refuse_others(folder: Path, steps: Collection[str]) -> None:
    """Refuse a folder with results of other commands than these."""
    found = read_manifest(folder)
    of_a_run = os.path.exists(folder / _OF_A_RUN) and "calibrate" not in steps
    if of_a_run if found is None else not set(found.steps) <= set(steps):
        raise RunFolderError(
            f"{folder}: holds the results of another command, with which these would be mixed; "
            "name another folder."
        )


# Device and number of a folder -> the thread that writes there, and may do so in parts.
_writing: dict[tuple[int, int], int] = {}


@contextmanager
def alone(folder: PathLike, *, make: bool = True) -> Iterator[None]:
    """Refuse a folder into which another process writes; one that is killed leaves nothing locked.

    A missing folder is made, and removed again if it stays empty; without `make` nothing is locked
    then.
    """
    if not (make or os.path.isdir(folder)):
        yield
        return
    missing = not os.path.isdir(folder)
    place = new_folder(folder)
    try:
        with _locked(place):
            yield
    finally:
        if missing:
            with suppress(OSError):
                place.rmdir()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    state = os.stat(folder)
    place, thread = (state.st_dev, state.st_ino), threading.get_ident()
    if _writing.get(place) == thread:
        yield
        return
    handle = None
    try:
        import fcntl

        handle = os.open(folder, os.O_RDONLY)
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, FileNotFoundError):
        if handle is not None:
            os.close(handle)
        raise RunFolderError(
            f"{folder}: another process is writing there; wait for it, or end it."
        ) from None
    except (ImportError, OSError):
        # There are no locks; or whoever writes there says what is wrong.
        pass
    _writing[place] = thread
    try:
        yield
    finally:
        del _writing[place]
        if handle is not None:
            os.close(handle)
