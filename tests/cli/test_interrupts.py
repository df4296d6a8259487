"""Ctrl-C, SIGTERM and SIGKILL of real commands: one sentence, one status, and the same command goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from starcal_uq.cli.app import main
from starcal_uq.core import tasks
from tests.conftest import ROOT

PROGRAM = (sys.executable, "-c", "from starcal_uq.cli.app import program; program()")
SENTENCE = "error: interrupted; what was complete is kept: give the same command again, and it goes on."


def start(folder: Path, *words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*PROGRAM, *map(str, words)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_an_interrupt_while_loading_is_one_sentence(tmp_path: Path) -> None:
    process = start(tmp_path, "demo", "-o", "demo")
    # Until NumPy is being loaded, which is well after the start and long before the end.
    maps = Path(f"/proc/{process.pid}/maps")
    if maps.exists():
        while "_multiarray_umath" not in maps.read_text() and process.poll() is None:
            time.sleep(0.005)
    else:
        time.sleep(0.5)
    os.kill(process.pid, signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 143
    assert err.strip() in (SENTENCE, "error: interrupted before anything was begun.")
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("held", [False, True])
def test_a_signal_ends_a_command_with_its_status(
    number: signal.Signals,
    status: int,
    held: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    reached = []

    def work(*_: object, **__: object) -> None:
        if not held:
            signal.raise_signal(number)
        with tasks.interrupt_between_steps() as outer, tasks.interrupt_between_steps() as check:
            signal.raise_signal(number)
            reached.append("held back")
            check()
            outer()
        reached.append("never")

    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    monkeypatch.setattr("starcal_uq.simulation.frames.simulate", work)
    monkeypatch.setattr("starcal_uq.simulate", work, raising=False)
    monkeypatch.setattr(sys, "argv", ["starcal-uq", "demo", "-o", str(tmp_path / "demo")])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == status
    assert capsys.readouterr().err.strip().endswith(SENTENCE)
    assert reached == ["held back"] * held
    assert not (tmp_path / "demo").exists()
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before
