"""Replicates over processes: the same results for any number of them, and Ctrl-C keeps what is done."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from starcal_uq.errors import SamplingError
from starcal_uq.interrupts import interrupt_between_steps
from starcal_uq.validation_replicates import Outcome, Study, run_replicate

if TYPE_CHECKING:
    from starcal_uq.catalogue import StarCatalogue

Progress = Callable[[int, int], None]

# Replicates sent to a process at once: about a second's work, which is also what Ctrl-C waits for.
_CHUNK = 8
_WAIT_S = 0.2
_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_shared: list[tuple[Study, StarCatalogue]] = []


def run_replicates(
    study: Study, stars: StarCatalogue, n_replicates: int, workers: int | None, progress: Progress | None
) -> tuple[list[Outcome], bool]:
    """Run replicates 0 .. n_replicates - 1.

    Parameters
    ----------
    study : Study
        What to do.
    stars : StarCatalogue
        Sky.
    n_replicates : int
        How often.
    workers : int or None
        Processes; 0 stays in this one, None takes as many as there are processors.
    progress : callable or None
        Called as ``progress(done, total)``.

    Returns
    -------
    list of Outcome
        In order; all that were complete when Ctrl-C was pressed.
    bool
        True if it was.

    Raises
    ------
    SamplingError
        If processes cannot be used.
    """
    n_chunks = -(-n_replicates // _CHUNK)
    workers = min(_processors() if workers is None else workers, n_chunks)
    results: list[Outcome] = []
    interrupted = False

    def keep(outcomes: list[Outcome]) -> None:
        results.extend(outcomes)
        if progress is not None:
            progress(len(results), n_replicates)

    try:
        if workers == 0:
            with interrupt_between_steps() as check:
                for index in range(n_replicates):
                    keep([run_replicate(study, stars, index)])
                    check()
        else:
            _spread(study, stars, n_replicates, workers, keep)
    except KeyboardInterrupt:
        if not results:
            raise
        interrupted = True
    return sorted(results, key=lambda outcome: outcome.replicate), interrupted


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        # What this process may use, which in a container is less than what the machine has.
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _spread(
    study: Study, stars: StarCatalogue, n_replicates: int, workers: int, keep: Callable[[list[Outcome]], None]
) -> None:
    try:
        content = pickle.dumps((study, stars))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise SamplingError(
            f"the settings cannot be sent to other processes ({error}): give functions that a module defines at its "
            "top level, or use workers=0."
        ) from error
    with TemporaryDirectory(prefix="starcal-uq-") as folder:
        # A file, because a process that dies while it starts would leave this one waiting at a pipe that is full.
        path = Path(folder) / "study.pickle"
        path.write_bytes(content)
        _submit(path, n_replicates, workers, keep)


def _submit(path: Path, n_replicates: int, workers: int, keep: Callable[[list[Outcome]], None]) -> None:
    # Forked processes would inherit the locks of threads that they do not have.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_start, initargs=(path,))
    try:
        with interrupt_between_steps() as check, _one_thread_each():
            pending = {
                pool.submit(_run, range(first, min(first + _CHUNK, n_replicates)))
                for first in range(0, n_replicates, _CHUNK)
            }
            try:
                while pending:
                    check()
                    for future in wait(pending, _WAIT_S, FIRST_COMPLETED).done:
                        pending.discard(future)
                        keep(future.result())
            except KeyboardInterrupt:
                _keep_running(pool, pending, keep)
                raise
    except BrokenProcessPool as error:
        raise SamplingError(
            "the worker processes ended unexpectedly: in a script, call validate below "
            '`if __name__ == "__main__":`; if memory ran out, use fewer workers, or workers=0.'
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _keep_running(
    pool: ProcessPoolExecutor, pending: set[Future[list[Outcome]]], keep: Callable[[list[Outcome]], None]
) -> None:
    """Drop what waits, and keep what was under way."""
    pool.shutdown(cancel_futures=True)
    for future in pending:
        if not future.cancelled() and future.exception() is None:
            keep(future.result())


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started here use one BLAS thread: many would fight for the cores, and could sum in another order."""
    before = {name: os.environ.get(name) for name in _THREAD_COUNTS}
    os.environ.update(dict.fromkeys(_THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start(path: Path) -> None:
    # Ctrl-C reaches every process of a terminal; the first one decides what to do about it.
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    else:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    _shared[:] = [pickle.loads(path.read_bytes())]


def _run(indices: range) -> list[Outcome]:
    study, stars = _shared[0]
    return [run_replicate(study, stars, index) for index in indices]
