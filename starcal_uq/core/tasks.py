"""Independent tasks over processes: the same results for any number of them, and Ctrl-C keeps what
is done.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from starcal_uq.core.errors import SamplingError
from starcal_uq.core.temporary import TemporaryFolder
from starcal_uq.core.types import Progress

if TYPE_CHECKING:
    from starcal_uq.core.store import Kept

T = TypeVar("T")
# Numbers of the tasks and their results.
Numbered = list[tuple[int, T]]
Keep = Callable[[Numbered[T]], None]
_WAIT_S = 0.2
_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_shared: list[Callable[[int], Any]] = []
# Signals that have ended the work.
_caught: list[int] = []
# How many `one_thread` are under way.
_limited = [0]


def run_tasks(
    task: Callable[[int], T],
    n_tasks: int,
    *,
    caller: str,
    chunk: int,
    workers: int | None = None,
    progress: Progress | None = None,
    each: Callable[[T], None] | None = None,
    kept: Kept | None = None,
) -> tuple[list[T], bool]:
    """Run task 0 .. n_tasks - 1; the results in order, and whether Ctrl-C was pressed before all
    were complete.

    `task`: from the number of a task to its result, which depends on the number alone; sent once to
    every process. `caller`: function that users call, for messages.
    `chunk`: tasks sent to a process at once: about a second's work, which is also what Ctrl-C waits
    for. `workers`: processes; 0 stays in this one, None takes as many as there are processors.
    `each`: called with every result as it arrives, in this process; what it keeps survives whatever
    comes later. `kept`: results of an earlier call, which are not computed again, and to which each
    new one is added.
    """
    results: dict[int, T] = {} if kept is None else kept.results(n_tasks)
    todo = [number for number in range(n_tasks) if number not in results]
    chunks = [todo[first : first + chunk] for first in range(0, len(todo), chunk)]
    workers = min(processors() if workers is None else workers, len(chunks))
    interrupted = False

    def keep(some: Numbered[T]) -> None:
        results.update(some)
        if kept is not None:
            kept.keep(some)
        if each is not None:
            for _, result in some:
                each(result)
        if progress is not None:
            progress(len(results), n_tasks)

    try:
        if workers == 0:
            with interrupt_between_steps() as check:
                for number in todo:
                    keep([(number, task(number))])
                    check()
        else:
            _spread(task, chunks, workers, caller, keep)
    except KeyboardInterrupt:
        if not results:
            raise
        interrupted = True
    return [results[number] for number in sorted(results)], interrupted


def processors() -> int:
    """What this process may use, which in a container is less than what the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _spread(
    task: Callable[[int], T],
    chunks: list[list[int]],
    workers: int,
    caller: str,
    keep: Keep[T],
) -> None:
    try:
        content = pickle.dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise SamplingError(
            f"the settings cannot be sent to other processes ({error}): give functions that a "
            "module defines at its top level, or use workers=0."
        ) from error
    with TemporaryFolder() as folder:
        # A file, because a process that dies while it starts would leave this one waiting at a pipe
        # that is full.
        path = Path(folder) / "task.pickle"
        path.write_bytes(content)
        # Forked processes would inherit the locks of threads that they do not have.
        pool = ProcessPoolExecutor(
            workers, get_context("spawn"), initializer=_start, initargs=(path,)
        )
        try:
            _follow(pool, chunks, keep)
        except BrokenProcessPool as error:
            raise SamplingError(
                f"the worker processes ended unexpectedly: in a script, call {caller} below "
                '`if __name__ == "__main__":`; if memory ran out, use fewer workers, or workers=0.'
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _follow(pool: ProcessPoolExecutor, chunks: list[list[int]], keep: Keep[T]) -> None:
    """Keep results as they come; after Ctrl-C what waits is dropped, and what was under way is
    kept.
    """
    with interrupt_between_steps() as check, one_thread():
        # Processes start while they are given work, and take along what is blocked.
        with _blocked():
            pending: set[Future[Numbered[T]]] = {pool.submit(_run, numbers) for numbers in chunks}
        try:
            while pending:
                check()
                for future in wait(pending, _WAIT_S, FIRST_COMPLETED).done:
                    pending.discard(future)
                    keep(future.result())
        except BrokenProcessPool:
            # SIGTERM may have gone to all processes, and have come to this one last.
            time.sleep(_WAIT_S)
            check()
            raise
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            for future in pending:
                if not future.cancelled() and future.exception() is None:
                    keep(future.result())
            raise


@lru_cache(maxsize=1)
def _pools(_n_loaded: int) -> Any:
    """The libraries' pools of threads; looked up again when other modules were loaded, which may
    have brought one.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """One BLAS thread in this process and in those that it starts; also a decorator,
    ``@one_thread()``.

    Our matrices are small or thin: more threads take half as much processor time again and save
    none, fight for the cores with other processes, and sum in another order.
    """
    if _limited[0] > 0:
        # A caller has done it.
        yield
        return
    before = {name: os.environ.get(name) for name in _THREAD_COUNTS}
    os.environ.update(dict.fromkeys(_THREAD_COUNTS, "1"))
    _limited[0] += 1
    try:
        with _pools(len(sys.modules)).limit(limits=1, user_api="blas"):
            yield
    finally:
        _limited[0] -= 1
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start(path: Path) -> None:
    if not hasattr(signal, "pthread_sigmask"):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _shared[:] = [pickle.loads(path.read_bytes())]


def _end_with_parent() -> None:
    """A process whose parent was killed has nobody left to work for."""
    parent = parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(1)


@contextmanager
def _blocked() -> Iterator[None]:
    """Hold Ctrl-C back in this thread and in the processes that it starts.

    It reaches every process of a terminal, and the first one decides what to do about it.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run(numbers: list[int]) -> Numbered[Any]:
    return [(number, _shared[0](number)) for number in numbers]


def interrupt(number: int, _frame: Any) -> None:
    """Handler of a signal that ends a command: KeyboardInterrupt, and `caught_signal` knows which
    it was.
    """
    _caught.append(number)
    raise KeyboardInterrupt


def caught_signal() -> int | None:
    """Number of the signal that has ended the work, which is then forgotten; None where there was
    none.
    """
    number = _caught[-1] if _caught else None
    _caught.clear()
    return number


@contextmanager
def interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function that this yields is called, which raises
    KeyboardInterrupt if it was pressed.

    SIGTERM is held back as well where `interrupt` takes it. In a thread other than the main one,
    which receives no signals, it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pressed: list[int] = []

    def note(number: int, _frame: Any) -> None:
        pressed.append(number)

    note.of_steps = True  # type: ignore[attr-defined]

    def check() -> None:
        if pressed:
            _caught.append(pressed[-1])
            pressed.clear()
            raise KeyboardInterrupt

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    ours = {
        n for n, handler in handlers.items() if handler is interrupt or hasattr(handler, "of_steps")
    }
    taken = ours if handlers[signal.SIGINT] is signal.SIG_IGN else ours | {signal.SIGINT}
    previous = {number: signal.signal(number, note) for number in taken}
    try:
        yield check
        # Ctrl-C after the last step must not be lost.
        check()
    finally:
        for number, before in previous.items():
            signal.signal(number, before)
