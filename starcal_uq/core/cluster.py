"""Work spread over processes of this machine or of a Dask cluster: the same results in the same
order for any of them.

Whatever is added up is added in one fixed tree, so that neither the number of processes nor the
order in which they finish moves a bit. Where a worker of a cluster dies, Dask gives its work to
another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias, TypedDict, TypeVar

from starcal_uq.core.errors import ClusterError
from starcal_uq.core.extras import extra
from starcal_uq.core.tasks import Numbered, processes, spread, worth_starting
from starcal_uq.core.types import Progress

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
T = TypeVar("T")
# Address of a Dask scheduler (``tcp://host:8786``), a client of one, or None for processes of this
# machine.
Scheduler: TypeAlias = "str | Client | None"


class ClusterOptions(TypedDict, total=False):
    """Where work is done, and who is told of it; keywords of functions that spread it.

    `scheduler` and `workers` are those of `cluster`; `progress` is called with what is done and
    what there is.
    """

    scheduler: Scheduler
    workers: int | None
    progress: Progress | None


# Results that are added up at once.
_FAN_IN = 16
_CONNECT_S = 20
# A file system that fails for a moment is asked again.
_RETRIES = 2


class Cluster:
    """Processes that work, behind an executor; without one, this process alone."""

    def __init__(self, executor: Executor | None = None) -> None:
        self._executor = executor

    def map(
        self,
        function: Callable[[Item], T],
        items: Sequence[Item],
        *,
        progress: Progress | None = None,
        keep: Callable[[T], None] | None = None,
    ) -> list[T]:
        """Results of a picklable function, in the order of the items.

        `keep` is called with each result as soon as it is there, in any order.
        """
        results: dict[int, T] = {}

        def take(some: Numbered[T]) -> None:
            results.update(some)
            for _, result in some:
                if keep is not None:
                    keep(result)
            if progress is not None:
                progress(len(results), len(items))

        spread(function, items, take, self._executor)
        return [results[place] for place in range(len(items))]

    def reduce(
        self,
        function: Callable[[Item], T],
        items: Sequence[Item],
        add: Callable[[Sequence[T]], T],
        *,
        progress: Progress | None = None,
    ) -> T:
        """Sum of the results of a picklable function; `add` sums some of them, in their order.

        Sums move up the tree as soon as they are whole, so that few are held at a time.
        """
        held: dict[tuple[int, int], dict[int, T]] = {}
        total: list[T] = []
        done = 0

        def put(result: T, place: int, size: int) -> None:
            if size == 1:
                total.append(result)
                return
            group, within = divmod(place, _FAN_IN)
            some = held.setdefault((size, group), {})
            some[within] = result
            if len(some) == min(_FAN_IN, size - group * _FAN_IN):
                del held[size, group]
                put(add([some[i] for i in sorted(some)]), group, -(-size // _FAN_IN))

        def take(some: Numbered[T]) -> None:
            nonlocal done
            for place, result in some:
                put(result, place, len(items))
            done += len(some)
            if progress is not None:
                progress(done, len(items))

        spread(function, items, take, self._executor)
        return total[0]


@contextmanager
def cluster(
    scheduler: Scheduler = None, *, workers: int | None = None, caller: str = ""
) -> Iterator[Cluster]:
    """Processes to work with, which end with the block unless they are somebody else's.

    Those of a Dask scheduler (its address, or a client of one), or those of this machine that are
    `worth_starting`. `caller` is the function that users call, for messages.
    """
    if scheduler is None:
        with processes(worth_starting(workers), caller) as executor:
            yield Cluster(executor)
        return
    with extra("cluster", "Dask schedulers", "leave the scheduler out"):
        from distributed import Client

    if not isinstance(scheduler, str):
        with _explained():
            yield Cluster(_executor(scheduler))
        return
    try:
        client = Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"{scheduler}: no Dask scheduler answers there; start one with `dask scheduler` "
            "and workers with "
            f"`dask worker {scheduler}`, or leave the scheduler out."
        ) from error
    with client, _explained():
        yield Cluster(_executor(client))


def _executor(client: Client) -> Executor:
    executor: Executor = client.get_executor(pure=False, retries=_RETRIES)
    return executor


@contextmanager
def _explained() -> Iterator[None]:
    """Say what a user can do where Dask gives up."""
    from distributed import KilledWorker

    try:
        yield
    except KilledWorker as error:
        raise ClusterError(
            "several Dask workers died over the same part of the work: give them more memory, or "
            "smaller partitions."
        ) from error
    except CancelledError as error:
        raise ClusterError(
            "the Dask scheduler lost the work: look at its log, and start the command again."
        ) from error
