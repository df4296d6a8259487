"""Work spread over processes of this machine or of a Dask cluster: the same results in the same
order for any of them.

Whatever is added up is added in one fixed tree, so that neither the number of processes nor the
order in which they finish moves a bit. A process that dies takes its work with it, which Dask gives
to another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from starcal_uq.core.errors import ClusterError
from starcal_uq.core.extras import extra
from starcal_uq.core.tasks import interrupt_between_steps, processors
from starcal_uq.core.types import Progress

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
T = TypeVar("T")
# Address of a Dask scheduler (``tcp://host:8786``), a client of one, or None for processes of this
# machine.
Scheduler: TypeAlias = "str | Client | None"

# Results that are added up at once; a worker holds so many.
_FAN_IN = 16
_CONNECT_S = 20
# A file system that fails for a moment is asked again.
_RETRIES = 2


class Cluster:
    """Processes that work; without a client, this one alone."""

    def __init__(self, client: Client | None = None) -> None:
        self._client = client

    def map(
        self,
        function: Callable[[Item], T],
        items: Sequence[Item],
        *,
        progress: Progress | None = None,
        keep: Callable[[int, T], None] | None = None,
    ) -> list[T]:
        """Results of a picklable function, in the order of the items.

        `keep` is called with the place of each item and its result as soon as it is there, in any
        order.
        """
        results: dict[int, T] = {}

        def take(place: int, result: T) -> None:
            results[place] = result
            if keep is not None:
                keep(place, result)
            if progress is not None:
                progress(len(results), len(items))

        if self._client is None:
            with interrupt_between_steps() as check:
                for place, item in enumerate(items):
                    take(place, function(item))
                    check()
        else:
            from distributed import as_completed

            with _explained():
                futures = self._client.map(function, items, pure=False, retries=_RETRIES)
                places = {future.key: place for place, future in enumerate(futures)}
                try:
                    for future, result in as_completed(futures, with_results=True):
                        take(places[future.key], result)
                except KeyboardInterrupt:
                    for future in futures:
                        future.cancel()
                    raise
        return [results[place] for place in range(len(items))]

    def reduce(
        self,
        function: Callable[[Item], T],
        items: Sequence[Item],
        add: Callable[[Sequence[T]], T],
        *,
        progress: Progress | None = None,
    ) -> T:
        """Sum of the results of a picklable function; `add` sums some of them, in their order."""
        if self._client is None:
            level = self.map(function, items, progress=progress)
            while len(level) > 1:
                level = [add(level[i : i + _FAN_IN]) for i in range(0, len(level), _FAN_IN)]
            return level[0]
        with _explained():
            futures = first = self._client.map(function, items, pure=False, retries=_RETRIES)
            while len(futures) > 1:
                futures = [
                    self._client.submit(add, futures[i : i + _FAN_IN], pure=False)
                    for i in range(0, len(futures), _FAN_IN)
                ]
            if progress is not None:
                from distributed import as_completed

                for done, _ in enumerate(as_completed(first), 1):
                    progress(done, len(items))
            del first
            total: T = futures[0].result()
            return total


@contextmanager
def cluster(
    scheduler: Scheduler = None, *, workers: int | None = None, caller: str = ""
) -> Iterator[Cluster]:
    """Processes to work with, which end with the block unless they are somebody else's.

    Those of a Dask scheduler (its address, or a client of one), or `workers` of this machine: as
    many as processors by default (one without Dask); 0 or 1 stays in this one. `caller` is the
    function that users call, for messages.
    """
    if scheduler is None:
        if workers is None:  # the results are the same, and one process needs no Dask
            workers = processors() if find_spec("distributed") else 1
        if workers <= 1:
            yield Cluster()
            return
        import logging

        with extra("cluster", "several processes over one set of files", "use workers=0"):
            from distributed import Client, LocalCluster

        # What its log warns of, such as a slow end, is Dask's to mend. Its page of numbers takes
        # whatever port is free.
        try:
            local = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.ERROR,
            )
        except RuntimeError as error:
            raise ClusterError(
                f"processes cannot be started ({str(error).splitlines()[0]}): in a script, call "
                f"{caller or 'this'} "
                'below `if __name__ == "__main__":`, or use workers=0.'
            ) from error
        with local, Client(local) as client:
            yield Cluster(client)
    elif isinstance(scheduler, str):
        with extra("cluster", "Dask schedulers", "leave the scheduler out"):
            from distributed import Client

        try:
            client = Client(scheduler, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"{scheduler}: no Dask scheduler answers there; start one with `dask scheduler` "
                "and workers with "
                f"`dask worker {scheduler}`, or leave the scheduler out."
            ) from error
        with client:
            yield Cluster(client)
    else:
        yield Cluster(scheduler)


@contextmanager
def _explained() -> Iterator[None]:
    """Say what a user can do where Dask gives up."""
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    try:
        yield
    except KilledWorker as error:
        raise ClusterError(
            "several Dask workers died over the same part of the work: give them more memory, or "
            "smaller partitions."
        ) from error
    except FutureCancelledError as error:
        raise ClusterError(
            "the Dask scheduler lost the work: look at its log, and start the command again."
        ) from error
