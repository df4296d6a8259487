"""What a process that is killed, or whose disk is full, leaves behind."""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

# What changes names on a disk.
_CALLS = ("replace", "rename", "unlink", "remove", "rmdir", "mkdir", "symlink", "link")


@contextmanager
def snapshots(folder: Path, kept: Path) -> Iterator[list[Path]]:
    """Copy a folder before each change of a name anywhere, as a kill then would leave it; those
    that differ.
    """
    found: list[Path] = []
    seen: set[int] = set()

    def keep() -> None:
        state = {
            p.relative_to(folder): p.read_bytes() if p.is_file() else b""
            for p in sorted(folder.rglob("*"))
        }
        mark = hash(tuple(state.items()))
        if mark not in seen:
            seen.add(mark)
            found.append(kept / str(len(found)))
            # Without os, whose functions are watched.
            with pytest.MonkeyPatch.context() as unwatched:
                for name, call in originals.items():
                    unwatched.setattr(os, name, call)
                shutil.copytree(folder, found[-1], symlinks=True)

    originals = {name: getattr(os, name) for name in _CALLS}
    with pytest.MonkeyPatch.context() as patch:
        for name, call in originals.items():

            def watched(*given: Any, _call: Any = call, **options: Any) -> Any:
                keep()
                return _call(*given, **options)

            patch.setattr(os, name, watched)
        yield found
        keep()


@contextmanager
def small_files(largest: int) -> Iterator[None]:
    """No file grows beyond a number of bytes: the system refuses to write on, as it does on a full
    disk.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Disk:
    """What of a folder a loss of power leaves, at its worst and at its best.

    A file has the content that it had when it was last flushed, and is empty before; a folder has
    the names that it had when it was last flushed, or those that it has now, each folder on its
    own. A file that was moved from one folder to another is in one of them at least.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._open = folder, list[int]()
        self._content: dict[int, bytes] = {}
        self._names: dict[int, dict[str, int]] = {}
        for path in (folder, *folder.rglob("*")):
            self._flush(os.open(path, os.O_RDONLY))

    def _flush(self, handle: int) -> None:
        """Now on the disk; the handle stays open, so that no other file gets its number."""
        self._open.append(handle)
        number = os.fstat(handle).st_ino
        if os.path.isdir(handle_path := f"/proc/self/fd/{handle}"):
            self._names[number] = _numbers(handle_path)
        else:
            self._content[number] = Path(handle_path).read_bytes()

    def flushed(self, handle: int) -> None:
        """The system has flushed this file or folder."""
        self._flush(os.dup(handle))

    def close(self) -> None:
        for handle in self._open:
            os.close(handle)

    def left(self) -> list[dict[str, bytes]]:
        """All that may be left now: files by their names, for every choice of folders that are as
        they were flushed.
        """
        now = {
            os.stat(path).st_ino: _numbers(path)
            for path in (self.folder, *self.folder.rglob("*"))
            if path.is_dir()
        }
        changed = [number for number, names in now.items() if names != self._names.get(number, {})]
        found = []
        for bits in range(2 ** len(changed)):
            lost = {number for place, number in enumerate(changed) if bits >> place & 1}
            names = {
                number: self._names.get(number, {}) if number in lost else now[number]
                for number in now
            }
            names = self._names | names
            there = {inside for number in now for inside in names[number].values()}
            moved = {inside for held in now.values() for inside in held.values()} - there
            for number in now.keys() & self._names.keys():
                back = {
                    name: inside for name, inside in self._names[number].items() if inside in moved
                }
                names[number] = names[number] | back
            found.append(dict(self._files(os.stat(self.folder).st_ino, names, "")))
        return found

    def _files(
        self, number: int, names: dict[int, dict[str, int]], start: str
    ) -> Iterator[tuple[str, bytes]]:
        for name, inside in names[number].items():
            if inside in names:
                yield from self._files(inside, names, f"{start}{name}/")
            else:
                yield start + name, self._content.get(inside, b"")


def _numbers(folder: Path | str) -> dict[str, int]:
    return {entry.name: entry.inode() for entry in os.scandir(folder)}


@contextmanager
def losses_of_power(folder: Path) -> Iterator[list[dict[str, bytes]]]:
    """All different states that a loss of power may leave of a folder before each change of a name
    within the block.
    """
    disk, found, seen = Disk(folder), list[dict[str, bytes]](), set[int]()
    originals = {name: getattr(os, name) for name in _CALLS}

    def keep() -> None:
        for state in disk.left():
            mark = hash(tuple(sorted(state.items())))
            if mark not in seen:
                seen.add(mark)
                found.append(state)

    with pytest.MonkeyPatch.context() as patch:
        for name in _CALLS:

            def watched(*given: Any, _call: Any = originals[name], **options: Any) -> Any:
                keep()
                return _call(*given, **options)

            patch.setattr(os, name, watched)

        # What the real disk does takes long, and no part in this.
        patch.setattr(os, "fsync", disk.flushed)
        yield found
        keep()
    disk.close()
