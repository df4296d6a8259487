"""Folders of a process that are gone when it ends, or when the next one starts if it was killed."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

from starcal_uq.core.provenance import NAME
from starcal_uq.core.types import PathLike

_PREFIX, _LOCK = f"{NAME}-", f".{NAME}-lock"
_NAME = re.compile(rf"{_PREFIX}[a-z0-9_]{{8}}")


class TemporaryFolder(TemporaryDirectory[str]):
    """A folder for files of this process; those that killed processes have left are removed
    first.
    """

    def __init__(self) -> None:
        _sweep()
        self._handle: int | None = None
        while self._handle is None:
            super().__init__(prefix=_PREFIX, ignore_cleanup_errors=True)
            # Another process may take the folder for one that was left, until it is locked.
            self._handle = lock(Path(self.name) / _LOCK, os.O_CREAT | os.O_RDWR)

    def cleanup(self) -> None:
        """Remove the folder."""
        super().cleanup()
        if self._handle is not None and self._handle >= 0:
            os.close(self._handle)
        self._handle = -1


def lock(path: PathLike, flags: int = os.O_RDONLY) -> int | None:
    """Lock a file or a folder as long as the handle is open and the process lives.

    Returns the handle, None where another process has the lock or the path is gone, and -1 where
    there are no locks.
    """
    try:
        import fcntl
    except ImportError:
        return -1
    try:
        handle = os.open(path, flags, 0o600)
    except FileNotFoundError:
        return None
    except OSError:
        # Whoever writes there says what is wrong.
        return -1
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    except OSError:
        # A file system without locks.
        os.close(handle)
        return -1
    if os.path.exists(path):
        return handle
    os.close(handle)
    return None


def _sweep() -> None:
    """Remove folders of this user whose process is gone; others have no lock of this kind in
    them.
    """
    for path in Path(gettempdir()).glob(f"{_PREFIX}*/{_LOCK}"):
        if not _NAME.fullmatch(path.parent.name) or path.parent.is_symlink() or path.is_symlink():
            continue
        handle = lock(path)
        if handle is not None and handle >= 0:
            shutil.rmtree(path.parent, ignore_errors=True)
            os.close(handle)
