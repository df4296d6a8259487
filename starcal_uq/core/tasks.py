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
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar, cast

from starcal_uq.core.errors import ClusterError
from starcal_uq.core.types import Progress

if TYPE_CHECKING:
    from starcal_uq.core.store import Kept

Item = TypeVar("Item")
T = TypeVar("T")
# Places of items, or numbers of tasks, and their results.
Numbered = list[tuple[int, T]]
_WAIT_S = 0.2
_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
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
    kept: Kept | None = None,
    whole: bool = False,
) -> tuple[list[T], bool]:
    """Run task 0 .. n_tasks - 1; the results in order, and whether Ctrl-C was pressed before all
    were complete, which is a KeyboardInterrupt where they are to be `whole`.

    `task`: from the number of a task to its result, which depends on the number alone. `caller`:
    function that users call, for messages.
    `chunk`: tasks sent to a process at once: about a second's work, which is also what Ctrl-C waits
    for. `workers` as for `worth_starting`. `kept`: results of an
    earlier call, which are not computed again, and to which each new one is added.
    """
    results: dict[int, T] = {} if kept is None else kept.results(n_tasks)
    todo = [number for number in range(n_tasks) if number not in results]

    def take(some: Numbered[T]) -> None:
        found = [(todo[place], result) for place, result in some]
        results.update(found)
        if kept is not None:
            kept.keep(found)
        if progress is not None:
            progress(len(results), n_tasks)

    try:
        with processes(worth_starting(workers, -(-len(todo) // chunk)), caller) as executor:
            spread(task, todo, take, executor, chunk)
    except KeyboardInterrupt:
        if whole or not results:
            raise
        return [results[number] for number in sorted(results)], True
    return [results[number] for number in sorted(results)], False


def processors() -> int:
    """What this process may use, which in a container is less than what the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def worth_starting(workers: int | None = None, pieces: int = sys.maxsize) -> int:
    """Processes to start for some pieces of work: `workers`, by default as many as processors.

    0, which is this process alone, where there would be one: this one would only wait for it.
    """
    several = min(processors() if workers is None else workers, pieces)
    return several if several > 1 else 0


@contextmanager
def processes(workers: int, caller: str, *, alike: bool = False) -> Iterator[Executor | None]:
    """An executor of processes of this machine, which end with the block; None for 0 of them.

    With `alike` they have what this process has loaded, where that can be done. ClusterError if
    they end before; `caller` is the function that users call.
    """
    if workers < 1:
        yield None
        return
    # Forked processes would inherit the locks of threads that they do not have; those of libraries
    # are only sure to be free on Linux.
    forked = alike and sys.platform == "linux" and threading.active_count() == 1
    context = get_context("fork" if forked else "spawn")
    pool = ProcessPoolExecutor(workers, context, initializer=_start)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise ClusterError(
            f"the worker processes ended unexpectedly: in a script, call {caller} below "
            '`if __name__ == "__main__":`; if memory ran out, use fewer workers, or workers=0.'
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def spread(
    function: Callable[[Item], T],
    items: Sequence[Item],
    take: Callable[[Numbered[T]], None],
    executor: Executor | None = None,
    chunk: int = 1,
) -> None:
    """Call a function with each item, `chunk` of them at a time, in this process or by an executor,
    whose processes get the function once.

    `take` gets places of items with their results, as they come. After Ctrl-C what waits is
    dropped, and what was under way is taken.
    """
    if executor is None:
        with interrupt_between_steps() as check, one_thread():
            for place, item in enumerate(items):
                take([(place, function(item))])
                check()
        return
    with (
        interrupt_between_steps() as check,
        TemporaryDirectory(ignore_cleanup_errors=True) as folder,
    ):
        content, path = _pickled(function), Path(folder, "function.pickle")
        # A file, because a process that dies while it starts would leave this one waiting at a pipe
        # that is full.
        path.write_bytes(content)
        carried = path if isinstance(executor, ProcessPoolExecutor) else content
        numbered = list(enumerate(items))
        pending = {
            submit(executor, _run, carried, numbered[first : first + chunk])
            for first in range(0, len(numbered), chunk)
        }
        try:
            while pending:
                check()
                for future in wait(pending, _WAIT_S, FIRST_COMPLETED).done:
                    pending.discard(future)
                    take(future.result())
        except BrokenProcessPool:
            # SIGTERM may have gone to all processes, and have come to this one last.
            time.sleep(_WAIT_S)
            check()
            raise
        except KeyboardInterrupt:
            for future in [future for future in pending if not future.cancel()]:
                if future.exception() is None:
                    take(future.result())
            raise


def submit(executor: Executor, function: Callable[..., T], *arguments: Any) -> Future[T]:
    """Hand a call to an executor, whose processes start then: with one BLAS thread, deaf to Ctrl-C."""
    with one_thread(), _blocked(), warnings.catch_warnings():
        # Python 3.12 warns of a fork beside the threads of BLAS, which is prepared for it.
        warnings.simplefilter("ignore", DeprecationWarning)
        return executor.submit(function, *arguments)


def _pickled(function: Callable[..., Any]) -> bytes:
    try:
        return pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ClusterError(
            f"the settings cannot be sent to other processes ({error}): give functions that a "
            "module defines at its top level, or use workers=0."
        ) from error


@lru_cache(maxsize=1)
def _function(carried: bytes | Path) -> Callable[[Any], Any]:
    return cast(
        Callable[[Any], Any],
        pickle.loads(carried.read_bytes() if isinstance(carried, Path) else carried),
    )


def _run(carried: bytes | Path, numbered: Numbered[Any]) -> Numbered[Any]:
    function = _function(carried)
    return [(place, function(item)) for place, item in numbered]


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


def _start() -> None:
    # A forked process has the handlers of this one.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if not hasattr(signal, "pthread_sigmask"):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


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
