"""Work spread over processes."""

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from starcal_uq.core.cluster import Cluster, cluster
from starcal_uq.core.errors import ClusterError


def share(number: int) -> float:
    return 1.0 / (3.0 + number)


def total(parts: Sequence[float]) -> float:
    return float(np.sum(parts))


def dying(path: str) -> int:
    """Kills its process the first time that it is called with a path."""
    if path and not Path(path).exists():
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def always_dying(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def failing(number: int) -> int:
    if number == 2:
        raise ClusterError("number 2 fails.")
    return number


def test_results_come_in_order_and_are_kept_one_by_one() -> None:
    seen: list[float] = []
    steps: list[tuple[int, int]] = []
    with cluster(workers=0) as one:
        found = one.map(
            share,
            range(5),
            keep=seen.append,
            progress=lambda *n: steps.append(n),
        )
    assert found == [share(n) for n in range(5)] == seen
    assert steps == [(n + 1, 5) for n in range(5)]


def test_sums_are_those_of_one_fixed_tree() -> None:
    numbers = list(range(40))
    shares = [share(n) for n in numbers]
    tree = total([total(shares[:16]), total(shares[16:32]), total(shares[32:])])
    assert Cluster().reduce(share, numbers, total) == tree
    assert Cluster().reduce(share, [7], total) == share(7)


@pytest.mark.extra("cluster")
def test_no_scheduler_is_said_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("starcal_uq.core.cluster._CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:9", "nonsense://here"):
        with (
            pytest.raises(ClusterError, match="no Dask scheduler answers there; start one"),
            cluster(address),
        ):
            pass


@contextmanager
def of_dask(level: int) -> Iterator[Any]:
    """A client of two workers on this machine, which log from this level on."""
    distributed = pytest.importorskip("distributed")
    workers = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with (
        distributed.LocalCluster(**workers, silence_logs=level) as local,
        distributed.Client(local) as client,
    ):
        yield client


@pytest.fixture(scope="module", params=["processes", "Dask"])
def several(request: pytest.FixtureRequest) -> Iterator[Cluster]:
    if request.param == "processes":
        with cluster(workers=2, caller="a test") as processes:
            yield processes
        return
    with of_dask(logging.ERROR) as client, cluster(client) as processes:
        yield processes


@pytest.mark.slow
def test_processes_give_the_bits_of_one(several: Cluster) -> None:
    numbers = list(range(40))
    steps: list[tuple[int, int]] = []
    assert several.reduce(
        share, numbers, total, progress=lambda *n: steps.append(n)
    ) == Cluster().reduce(share, numbers, total)
    assert steps[-1] == (40, 40)
    assert several.map(share, numbers) == [share(n) for n in numbers]
    for call in (several.map, lambda *given: several.reduce(*given, sum)):
        with pytest.raises(ClusterError, match=r"^number 2 fails.$"):
            call(failing, numbers)


@pytest.mark.slow
@pytest.mark.parametrize("several", ["Dask"], indirect=True)
def test_a_worker_that_dies_costs_time_only(several: Cluster, tmp_path: Path) -> None:
    items = ["", str(tmp_path / "died"), "", ""]
    found = several.map(dying, items)
    assert (tmp_path / "died").exists() and len(found) == 4


@pytest.mark.slow
def test_workers_that_die_again_are_said_in_one_sentence() -> None:
    with (
        pytest.raises(ClusterError, match="use fewer workers, or workers=0"),
        cluster(workers=2, caller="a test") as processes,
    ):
        processes.map(always_dying, [0])
    with (
        of_dask(logging.CRITICAL) as client,
        pytest.raises(ClusterError, match="more memory, or smaller partitions"),
        cluster(client) as workers,
    ):
        workers.map(always_dying, [0])
