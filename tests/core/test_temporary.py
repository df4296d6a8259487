"""Temporary folders: gone with their process, or with the next one where it was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from starcal_uq.core.temporary import TemporaryFolder, lock

PROGRAM = """
import sys, time
from pathlib import Path
from starcal_uq.core.temporary import TemporaryFolder
folder = TemporaryFolder()
Path(folder.name, "task.pickle").write_text("work")
print(folder.name, flush=True)
time.sleep(60)
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where this process and its children have temporary folders."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_what_a_killed_process_left_goes_with_the_next_one(place: Path) -> None:
    started = subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True)
    assert started.stdout is not None
    left = Path(started.stdout.readline().strip())
    # Control: as long as the process lives, its folder stays.
    with TemporaryFolder() as own:
        assert (left / "task.pickle").exists() and Path(own) != left
    assert not Path(own).exists()
    started.send_signal(signal.SIGKILL)
    started.wait()
    started.stdout.close()
    assert (left / "task.pickle").exists()
    with TemporaryFolder():
        assert not left.exists()
    assert list(place.iterdir()) == []


def test_folders_of_users_stay_whatever_their_names(place: Path) -> None:
    elsewhere = place / "elsewhere"
    for folder in (place / "starcal-uq-results1", place / "starcal-uq-1", elsewhere):
        folder.mkdir()
        (folder / "notes.txt").write_text("mine")
    (elsewhere / ".starcal-uq-lock").touch()
    (place / "starcal-uq-abcdefgh").symlink_to(elsewhere)
    before = sorted(path.relative_to(place) for path in place.rglob("*"))
    with TemporaryFolder():
        pass
    assert sorted(path.relative_to(place) for path in place.rglob("*")) == before


def test_a_lock_is_had_once_and_only_of_what_is_there(tmp_path: Path) -> None:
    handle = lock(tmp_path)
    assert handle is not None and handle >= 0 and lock(tmp_path) is None
    os.close(handle)
    again = lock(tmp_path)
    assert again is not None
    os.close(again)
    assert lock(tmp_path / "gone") is None
