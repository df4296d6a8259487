"""One more process, which does what is handed to it while this one goes on."""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

from starcal_uq.core.tasks import processors

_WAIT_S = 0.005
# Numbers of a call and of the first of those that were handed over with it; what is written and read at once.
_RECORD = struct.Struct("=II")
_MOST = 4
_PROGRAM = "import sys; sys.path[:] = {path!r}; from starcal_uq.core.beside import serve; serve({folder!r}, {gate})"
_PREPARE, _END = "prepare", "end"
# Where a process that has no other threads and no windows may be doubled.
_FORKS = sys.platform == "linux"
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class Beside:
    """Calls of functions in another process; a context, at whose end the process is gone.

    It never is the only way to a result: where it could not be started, failed or was killed, `results` has None, and
    the caller does the work itself. With a single processor nothing is started.

    Calls and results go through files, because a pipe that is full would make this process wait. The other one is a
    program of its own: those of multiprocessing begin with the caller's main module, which may not expect it. It does
    calls in turn; on Linux it doubles itself when it is prepared, and calls run beside each other: on one processor
    less than there are, and on all of them, at most four, when `results` waits.

    Parameters
    ----------
    prepare : callable, optional
        What to do there before the first call, such as to load what calls need.
    """

    def __init__(self, prepare: Callable[[], None] | None = None) -> None:
        self._folder = TemporaryDirectory(prefix="starcal-uq-", ignore_cleanup_errors=True)
        self._process: subprocess.Popen[bytes] | None = None
        self._prepare = prepare
        self._n_calls = 0
        # A pipe into which nothing is written: who reads from it waits until it is closed, or this process is gone.
        self._gate: IO[bytes] | None = None

    def __enter__(self) -> Beside:
        if processors() > 1:
            (Path(self._folder.name) / _PREPARE).write_bytes(pickle.dumps(self._prepare))
            wait, gate = os.pipe()
            self._gate = os.fdopen(gate, "wb")
            program = _PROGRAM.format(path=sys.path, folder=self._folder.name, gate=wait)
            with contextlib.suppress(OSError), os.fdopen(wait, "rb"):
                self._process = subprocess.Popen(
                    [sys.executable, "-c", program],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env=os.environ | _ONE_THREAD,
                    pass_fds=(wait,) if _FORKS else (),
                    # Ctrl-C reaches every process of a terminal; the first one decides what to do about it.
                    start_new_session=True,
                )
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            # As long as nobody has asked how it ended, the number is that of its group.
            if _FORKS and self._process.returncode is None:
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.kill()
            self._process.communicate()
        if self._gate is not None:
            self._gate.close()
        self._folder.cleanup()

    @property
    def spreads(self) -> bool:
        """Whether calls run beside each other."""
        return _FORKS and self._process is not None

    def call(self, function: Callable[..., Any], *arguments: Any) -> int:
        """Hand a call over, to a function that a module defines at its top level; its number."""
        return self.each(function, [arguments])[0]

    def each(self, function: Callable[..., Any], several: Sequence[tuple[Any, ...]]) -> range:
        """Hand over a call for each of several arguments; what they share is written once. Their numbers."""
        numbers = range(self._n_calls, self._n_calls + len(several))
        self._n_calls = numbers.stop
        if self._process is not None:
            _path(self._folder.name, numbers.start, "call").write_bytes(pickle.dumps((function, several)))
            # The process may have died.
            with contextlib.suppress(OSError):
                for number in numbers:
                    _pipe(self._process).write(_RECORD.pack(number, numbers.start))
                    _pipe(self._process).flush()
        return numbers

    def result(self, number: int) -> Any:
        """Wait for the call of this number; its result, None if it failed."""
        path = _path(self._folder.name, number, "result")
        failed = _path(self._folder.name, number, "failed")
        while self._process is not None and not (path.exists() or failed.exists()) and self._lives(number):
            time.sleep(_WAIT_S)
        return pickle.loads(path.read_bytes()) if path.exists() else None

    def _lives(self, number: int) -> bool:
        """Whether the process that does this call, or will do it, is there."""
        assert self._process is not None
        taken = _path(self._folder.name, number, "taken")
        process = taken.read_text() if taken.exists() else ""
        if _FORKS and process and int(process) != self._process.pid:
            return Path(f"/proc/{process}").exists()
        return self._process.poll() is None

    def results(self) -> list[Any]:
        """Wait for all calls; their results, None for those that failed. Nothing can be handed over afterwards."""
        if self._process is not None:
            (Path(self._folder.name) / _END).touch()
            with contextlib.suppress(OSError):
                _pipe(self._process).close()
            if self._gate is not None:
                self._gate.close()
            self._process.wait()
        found = (_path(self._folder.name, number, "result") for number in range(self._n_calls))
        return [pickle.loads(path.read_bytes()) if path.exists() else None for path in found]


def serve(folder: str, gate: int) -> None:
    """Do the calls of a `Beside` until there are no more, or it is gone."""
    end = Path(folder) / _END
    # Whatever cannot be prepared is seen again by the calls.
    with contextlib.suppress(Exception):
        prepare = pickle.loads((Path(folder) / _PREPARE).read_bytes())
        if prepare is not None:
            prepare()
    if _FORKS:
        # Those that have ended are gone at once, for whoever asks.
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    for place in range(min(processors(), _MOST) - 1 if _FORKS else 0):
        if os.fork() == 0:
            try:
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                if place == 0:
                    # There is a processor for this one when the caller waits for the others.
                    os.read(gate, 1)
                _do_calls(folder)
            finally:
                os._exit(0)
    _do_calls(folder)
    # Of a caller that was killed nobody else removes what it left.
    killed = not end.exists()
    if killed:
        shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(ChildProcessError):
        while _FORKS:
            os.wait()
    if killed:
        shutil.rmtree(folder, ignore_errors=True)


def _do_calls(folder: str) -> None:
    """Take calls from the pipe, which several processes read, until it is closed."""
    first, function, several = -1, print, ()
    while record := os.read(sys.stdin.fileno(), _RECORD.size):
        number, handed = _RECORD.unpack(record)
        try:
            _path(folder, number, "taken").write_text(str(os.getpid()))
            if handed != first:
                function, several = pickle.loads(_path(folder, handed, "call").read_bytes())
                first = handed
            part = _path(folder, number, "part")
            part.write_bytes(pickle.dumps(function(*several[number - first])))
            part.replace(_path(folder, number, "result"))
        except Exception:
            # Whoever asked tries again, where the error is seen.
            _path(folder, number, "failed").touch()


def _path(folder: str, number: int, kind: str) -> Path:
    return Path(folder) / f"{number}.{kind}"


def _pipe(process: subprocess.Popen[bytes]) -> IO[bytes]:
    assert process.stdin is not None
    return process.stdin
