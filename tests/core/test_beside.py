"""Another process does what is handed to it, and is never the only way to a result."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time

import pytest

import starcal_uq
from starcal_uq.core import beside
from starcal_uq.core.beside import Beside


@pytest.fixture(autouse=True)
def two_processors(monkeypatch):
    monkeypatch.setattr(beside, "processors", lambda: 2)


def test_calls_are_done_in_turn_and_elsewhere():
    with Beside() as other:
        assert [other.call(math.factorial, n) for n in (3, 200)] == [0, 1]
        other.call(os.getpid)
        first, second, process = other.results()
        assert (first, second) == (6, math.factorial(200)) and process != os.getpid()
        folder = other._folder.name
    assert not os.path.exists(folder)
    with pytest.raises(OSError, match="No such process"):
        os.kill(process, 0)


def test_what_fails_leaves_the_next_call_alone():
    with Beside() as other:
        for n in (-1, 4):
            other.call(math.factorial, n)
        assert other.result(0) is None
        assert other.result(1) == 24
        assert other.results() == [None, 24]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills a process as Unix does")
def test_a_process_that_is_killed_is_no_obstacle():
    with Beside() as other:
        other.call(os.kill, 0, 0)
        os.kill(other._process.pid, signal.SIGKILL)
        other._process.wait()
        # More than a pipe holds, to nobody.
        for _ in range(20):
            other.call(math.factorial, 3)
        assert other.result(3) is None
        assert set(other.results()) == {None}


def test_one_processor_starts_nothing(monkeypatch):
    monkeypatch.setattr(beside, "processors", lambda: 1)
    with Beside() as other:
        other.call(math.factorial, 3)
        assert other._process is None and other.result(0) is None and other.results() == [None]


def test_an_error_here_ends_the_process_there():
    with pytest.raises(ZeroDivisionError), Beside() as other:
        other.call(os.getpid)
        process = other._process
        1 / 0  # noqa: B018
    assert process.poll() is not None


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills a process as Unix does")
def test_nothing_is_left_of_a_caller_that_is_killed(tmp_path):
    program = (
        "import os, signal, starcal_uq.core.beside as b; b.processors = lambda: 2; other = "
        "b.Beside().__enter__(); "
        "other.call(os.getpid); os.kill(os.getpid(), signal.SIGKILL)"
    )
    root = os.path.dirname(os.path.dirname(starcal_uq.__file__))
    subprocess.run(
        [sys.executable, "-c", program],
        cwd=root,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        check=False,
    )
    until = time.monotonic() + 60.0
    while list(tmp_path.iterdir()) and time.monotonic() < until:
        time.sleep(0.05)
    assert list(tmp_path.iterdir()) == []
