"""Ctrl-C, SIGTERM and SIGKILL of real commands: one sentence, one status, and the same command goes
on.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.cli.app import main
from starcal_uq.core import tasks
from starcal_uq.core.files import TEMPORARY
from tests.conftest import ROOT
from tests.helpers.scenes import observations

PROGRAM = (sys.executable, "-c", "from starcal_uq.cli.app import program; program()")
SENTENCE = "error: interrupted; what was complete is kept: give the same command again to resume."


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
    # The name at the top first: it is looked up when it is first asked for, and would be kept as
    # what stands in for it.
    monkeypatch.setattr("starcal_uq.simulate", work)
    monkeypatch.setattr("starcal_uq.simulation.frames.simulate", work)
    monkeypatch.setattr(sys, "argv", ["starcal-uq", "demo", "-o", str(tmp_path / "demo")])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == status
    assert capsys.readouterr().err.strip().endswith(SENTENCE)
    assert reached == ["held back"] * held
    assert not (tmp_path / "demo").exists()
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before


TINY = "--walkers 14 --steps 40 --ensembles 2"
CLOCK = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")
# The column between p-value and quaternion.
MILLISECONDS = re.compile(rb",[^,\n]*((?:,[^,\n]*){4})$", re.M)
# Command -> what it is called with, the signals that stop it, and files that are compared with those
# of a call that was left alone.
TABLES = (
    "coupling.csv",
    "attitude.csv",
    "budget.csv",
    "misfit.csv",
    "jackknife.csv",
    "comparison.csv",
    "field_map.npz",
)
LONG = {
    "run from images": (
        f"run img camera.toml {TINY} --draws 50 --directions apparent --max-mag 6 -o out",
        (signal.SIGKILL, signal.SIGINT),
        (*TABLES, "identification.csv", "images.json"),
    ),
    "sample": ("sample out --walkers 32 --steps 1000", (signal.SIGTERM, signal.SIGKILL), ()),
    "calibrate": (
        "calibrate parts camera.toml --workers 0 -o out",
        (signal.SIGINT, signal.SIGTERM),
        (),
    ),
}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("given")
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    observations().save(folder / "obs.parquet")
    sc.paper.paper_start().save(folder / "camera.toml")
    truth = sc.paper.paper_camera()
    sc.simulation.simulate_partitions(
        stars, truth, folder / "parts", n_frames=40, partition_frames=10, seed=1, workers=0
    )
    sc.simulation.render_frames(
        stars, truth, folder / "img", n_frames=8, seed=3, times_utc=["2026-11-25T00:00:00"] * 8
    )
    sc.Run(folder / "calibrated").calibrate(observations(), sc.paper.paper_start())
    return folder


def stopped(folder: Path, words: str, number: signal.Signals, n_names: int) -> tuple[int, str]:
    """Signal all processes of a command once it has made so many names in its folder; status and
    last words.
    """
    before = {path.name for path in (folder / "out").rglob("*")}
    process, seen = start(folder, *words.split()), set()
    while process.poll() is None and len(seen) < n_names:
        with suppress(OSError):
            seen |= {path.name for path in (folder / "out").rglob("*")} - before
        time.sleep(0.002)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)
    _, err = process.communicate(timeout=120)
    # Those that nobody has waited for are gone but in name.
    end = time.monotonic() + 20.0
    while _group(process.pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not _group(process.pid)
    return process.returncode, err.strip().rpartition("\n")[2]


def _group(number: int) -> list[str]:
    """Processes of a group that are alive, as Linux lists them."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, group = path.read_text().rpartition(")")[2].split()[:3]
            if int(group) == number and state not in "ZX":
                found.append(path.parent.name)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("command", LONG)
def test_a_command_that_is_stopped_goes_on_to_the_same_result(
    command: str, given: Path, tmp_path: Path
) -> None:
    words, signals, compared = LONG[command]
    for name in ("whole", "stopped"):
        shutil.copytree(given, tmp_path / name)
        if command == "sample":
            shutil.copytree(given / "calibrated", tmp_path / name / "out")
    whole, folder = tmp_path / "whole", tmp_path / "stopped"
    process = start(whole, *words.split())
    assert process.communicate(timeout=120) and process.returncode in (0, 1)
    rng = np.random.default_rng(len(command))
    names = len(
        {path.name for path in (whole / "out").rglob("*")}
        - {path.name for path in (folder / "out").rglob("*")}
    )
    statuses = []
    for number in signals:
        left = {path.name for path in folder.rglob(".*")}
        status, last = stopped(folder, words, number, int(rng.integers(1, max(names, 2))))
        statuses.append(status)
        # One that was stopped after its last file is complete, and what is complete is kept.
        if status in (0, 1) or "is not empty" in last:
            break
        assert status == (-number if number == signal.SIGKILL else 128 + number)
        assert number == signal.SIGKILL or last == SENTENCE
        temporary = [
            path.name
            for path in folder.rglob(".*")
            if TEMPORARY.match(path.name) and path.name not in left
        ]
        assert number == signal.SIGKILL or not temporary
    assert statuses[0] not in (0, 1)
    if statuses[-1] not in (0, 1):
        process = start(folder, *words.split())
        _, err = process.communicate(timeout=120)
        assert process.returncode in (0, 1) or "is not empty" in err, err
    for name in compared:
        # But for where the images lie, the time of day in a provenance, and the time that
        # identification took.
        contents = (
            (place / "out" / name).read_bytes().replace(bytes(place), b"")
            for place in (folder, whole)
        )
        one, other = (CLOCK.sub(b"", content) for content in contents)
        if name == "identification.csv":
            one, other = (MILLISECONDS.sub(rb"\1", content) for content in (one, other))
        assert one == other, name
    assert {path.name for path in (folder / "out").iterdir()} == {
        path.name for path in (whole / "out").iterdir()
    }
    found, wanted = sc.Run(folder / "out"), sc.Run(whole / "out")
    assert found.calibration.theta.tobytes() == wanted.calibration.theta.tobytes()
    if wanted.has("posterior"):
        assert found.posterior.draws.tobytes() == wanted.posterior.draws.tobytes()
