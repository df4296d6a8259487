"""One more process, which does what is handed to it while this one goes on."""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starcal_uq.core.tasks import processors
from starcal_uq.core.temporary import TemporaryFolder

_WAIT_S = 0.005
_PROGRAM = (
    "import sys; sys.path[:] = {path!r}; from starcal_uq.core.beside import serve; "
    "serve({folder!r}, {parent})"
)


class Beside:
    """Calls of functions in another process, one after the other; a context, at whose end the
    process is gone.

    It never is the only way to a result: where it could not be started, failed or was killed,
    `results` has None, and the caller does the work itself. With a single processor nothing is
    started.

    Calls and results go through files, because a pipe that is full would make this process wait.
    The other one is a program of its own: those of multiprocessing begin with the caller's main
    module, which may not expect it.
    """

    def __init__(self) -> None:
        self._folder = TemporaryFolder()
        self._process: subprocess.Popen[str] | None = None
        self._n_calls = 0

    def __enter__(self) -> Beside:
        if processors() > 1:
            program = _PROGRAM.format(path=sys.path, folder=self._folder.name, parent=os.getpid())
            with contextlib.suppress(OSError):
                self._process = subprocess.Popen(
                    [sys.executable, "-c", program],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    # Ctrl-C reaches every process of a terminal; the first one decides what to do
                    # about it.
                    start_new_session=True,
                    text=True,
                )
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._folder.cleanup()

    def call(self, function: Callable[..., Any], *arguments: Any) -> int:
        """Hand a call over, to a function that a module defines at its top level; its number."""
        number, self._n_calls = self._n_calls, self._n_calls + 1
        if self._process is not None:
            _path(self._folder.name, number, "call").write_bytes(
                pickle.dumps((function, arguments))
            )
            # The process may have died.
            with contextlib.suppress(OSError):
                print(number, file=self._process.stdin, flush=True)
        return number

    def result(self, number: int) -> Any:
        """Wait for the call of this number; its result, None if it failed."""
        path = _path(self._folder.name, number, "result")
        while self._process is not None and not path.exists() and self._process.poll() is None:
            time.sleep(_WAIT_S)
        return pickle.loads(path.read_bytes()) if path.exists() else None

    def results(self) -> list[Any]:
        """Wait for all calls; their results, None for those that failed."""
        return [self.result(number) for number in range(self._n_calls)]


def serve(folder: str, parent: int) -> None:
    """Do the calls of a `Beside` in the process `parent`, until it closes the pipe or is gone."""
    for line in sys.stdin:
        function, arguments = pickle.loads(_path(folder, int(line), "call").read_bytes())
        content = pickle.dumps(None)
        # Whoever asked tries again, where the error is seen.
        with contextlib.suppress(Exception):
            content = pickle.dumps(function(*arguments))
        part = _path(folder, int(line), "part")
        part.write_bytes(content)
        part.replace(_path(folder, int(line), "result"))
    if os.name == "posix" and os.getppid() != parent:
        # It was killed, and nobody else removes what it left.
        shutil.rmtree(folder, ignore_errors=True)


def _path(folder: str, number: int, kind: str) -> Path:
    return Path(folder) / f"{number}.{kind}"
