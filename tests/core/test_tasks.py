"""Tasks over processes: the same results for any number of them, Ctrl-C."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from starcal_uq.core.errors import ClusterError
from starcal_uq.core.tasks import run_tasks, worth_starting
from tests.helpers.tasks import numbered

EXPECTED = [(index**2, "1") for index in range(30)]


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_results_come_in_order_whoever_computes_them(workers: int) -> None:
    calls: list[tuple[int, int]] = []
    found = run_tasks(
        numbered,
        30,
        caller="f",
        chunk=4,
        workers=workers,
        progress=lambda *numbers: calls.append(numbers),
    )
    assert found == (EXPECTED, False)
    assert calls[-1] == (30, 30)
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)


@pytest.mark.parametrize(
    ("processors", "workers", "pieces", "started"),
    [
        (1, None, 9, 0),
        (4, None, 9, 4),
        (4, None, 3, 3),
        (4, None, 1, 0),
        (1, 2, 9, 2),
        (4, 1, 9, 0),
        (4, 0, 9, 0),
    ],
)
def test_processes_are_started_beside_one_that_only_waits(
    processors: int, workers: int | None, pieces: int, started: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("starcal_uq.core.tasks.processors", lambda: processors)
    assert worth_starting(workers, pieces) == started


@pytest.mark.parametrize("workers", [0, 2])
def test_interrupt_keeps_what_is_done(workers: int) -> None:
    def press(done: int, total: int) -> None:
        if done >= 8:
            signal.raise_signal(signal.SIGINT)

    found, interrupted = run_tasks(
        numbered, 2000, caller="f", chunk=2, workers=workers, progress=press
    )
    assert interrupted
    assert 8 <= len(found) < 2000
    assert found[:8] == EXPECTED[:8]


def test_an_interrupt_before_the_first_result_is_an_interrupt() -> None:
    def stop(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_tasks(stop, 3, caller="f", chunk=1, workers=0)


def test_a_script_without_a_guard_ends_with_the_remedy(tmp_path: Path, root: Path) -> None:
    """The processes import the script, which starts processes."""
    script = tmp_path / "script.py"
    script.write_text(
        "from starcal_uq.core.tasks import run_tasks\n"
        "from tests.helpers.tasks import numbered\n"
        "run_tasks(numbered, 20, caller='validate', chunk=2, workers=2)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, script],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=environment,
    )
    assert done.returncode == 1
    assert 'call validate below `if __name__ == "__main__":`' in done.stderr


_ALIKE = """\
import math, signal, sys
from starcal_uq.core.tasks import interrupt, processes, submit
if __name__ == "__main__":
    signal.signal(signal.SIGTERM, interrupt)
    math.mark = 7
    with processes(1, "f", alike=sys.argv[1] == "True") as pool:
        there = submit(pool, eval, "getattr(__import__('math'), 'mark', 0)").result()
        print(there, submit(pool, signal.getsignal, signal.SIGTERM).result() is signal.SIG_DFL)
"""


@pytest.mark.parametrize("alike", [False, True])
def test_a_process_alike_has_what_is_loaded_and_not_the_handlers(
    alike: bool, tmp_path: Path, root: Path
) -> None:
    script = tmp_path / "alike.py"
    script.write_text(_ALIKE)
    done = subprocess.run(
        [sys.executable, "-W", "error", str(script), str(alike)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    there = 7 if alike and sys.platform == "linux" else 0
    assert (done.stdout.split(), done.stderr) == ([str(there), "True"], "")


def test_a_local_function_cannot_go_to_workers() -> None:
    with pytest.raises(ClusterError, match="top level, or use workers=0"):
        run_tasks(lambda index: index, 20, caller="f", chunk=2, workers=2)


def test_long_calls_use_one_blas_thread_and_give_the_others_back() -> None:
    import numpy as np
    from threadpoolctl import threadpool_info, threadpool_limits

    from starcal_uq.core.tasks import one_thread

    assert np.linalg.norm(np.eye(2) @ np.eye(2)) > 1.0

    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    @one_thread()
    def inside() -> set[int]:
        with one_thread():
            return threads()

    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        assert inside() == {1}
        assert inside() == {1}
        assert run_tasks(lambda _: threads(), 1, caller="f", chunk=1, workers=0) == ([{1}], False)
        assert threads() == before
