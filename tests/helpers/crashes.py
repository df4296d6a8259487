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
    """Copy a folder before each change of a name anywhere, as a kill then would leave it; those that differ."""
    found: list[Path] = []
    seen: set[int] = set()

    def keep() -> None:
        state = {p.relative_to(folder): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}
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
    """No file grows beyond a number of bytes: the system refuses to write on, as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
