"""Results of a command replace those of before all at once."""

import fcntl
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from starcal_uq.core import manifest
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_write_text, flush_folder, new_folder
from starcal_uq.core.manifest import alone, making, read_manifest
from starcal_uq.core.store import UNFINISHED, Kept
from tests.helpers.crashes import losses_of_power, small_files, snapshots

OLD = {
    "page.html": "old",
    "table.csv": "old, 1",
    "figures/one.png": "old, 2",
    "figures/gone.png": "old, 3",
}
NEW = {"page.html": "new", "table.csv": "new, 1", "figures/one.png": "new, 2", "more.csv": "new, 4"}
MINE = {"notes.txt": "mine", "figures/mine.png": "mine"}


def write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        new_folder((folder / name).parent)
        atomic_write_text(folder / name, text)


def make(
    folder: Path, files: Mapping[str, str], *, force: bool = False, stop: bool = False
) -> None:
    with making(folder, "command", "page.html", force=force) as stage:
        Kept(folder, {"seed": 1}).keep([(0, "done")])
        write(stage, files)
        if stop:
            raise KeyboardInterrupt


def content(folder: Path) -> dict[str, str]:
    """All files but those that are hidden and the record, which puts the others in their places
    when it is read.
    """
    read_manifest(folder)
    files = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return {
        name.as_posix(): path.read_text()
        for name, path in files.items()
        if not name.parts[0].startswith(".") and path.name != "run.json"
    }


def test_at_every_moment_there_are_the_old_results_or_the_new_ones(tmp_path: Path) -> None:
    folder = tmp_path / "work" / "out"
    make(folder, OLD)
    write(folder, MINE)
    with snapshots(folder.parent, tmp_path / "states") as states:
        make(folder, NEW, force=True)
    assert content(folder) == NEW | MINE
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    found = [content(state / "out") for state in states]
    assert all(one in (OLD | MINE, NEW | MINE) for one in found)
    assert found.index(NEW | MINE) > 5
    # Control: files that are replaced one by one show a mix.
    with snapshots(folder.parent, tmp_path / "control") as states:
        write(folder, OLD)
    assert not all(content(state / "out") in (OLD | MINE, NEW | MINE) for state in states[1:-1])


def after_losses_of_power(
    folder: Path, kept: Path, flush: Callable[[int, Path], bool]
) -> list[bool]:
    """Whether each state that a loss of power may leave while results are replaced holds the old
    ones or the new ones.

    `flush` says of each call that flushes a folder, by its number, whether it is made.
    """
    make(folder, OLD)
    write(folder, MINE)
    calls: list[Path] = []

    def flushes(path: Path) -> None:
        calls.append(path)
        if flush(len(calls) - 1, path):
            flush_folder(path)

    with losses_of_power(folder) as states, pytest.MonkeyPatch.context() as patch:
        patch.setattr(manifest, "flush_folder", flushes)
        make(folder, NEW, force=True)
    with pytest.MonkeyPatch.context() as patch:
        # Whoever reads on needs no disk.
        patch.setattr(os, "fsync", lambda _: None)
        return [is_whole(state, kept / str(number)) for number, state in enumerate(states)]


def is_whole(state: Mapping[str, bytes], place: Path) -> bool:
    for name, text in state.items():
        new_folder((place / name).parent)
        (place / name).write_bytes(text)
    try:
        return content(place) in (OLD | MINE, NEW | MINE)
    except RunFolderError:
        return False


def test_after_a_loss_of_power_there_are_the_old_results_or_the_new_ones(tmp_path: Path) -> None:
    made: list[Path] = []
    good = after_losses_of_power(
        tmp_path / "out", tmp_path / "states", lambda _, path: not made.append(path)
    )
    assert len(good) > 20 and all(good)
    # Control: each call that flushes a folder is needed. The second one of the folder itself is for
    # disks that change the order of names within one folder, which these states do not do.
    named = [path.relative_to(tmp_path / "out").as_posix() for path in made]
    assert named == [".step", ".step/figures", ".", ".", "figures"]
    for left_out in (0, 1, 2, 4):
        place = tmp_path / str(left_out)
        good = after_losses_of_power(
            place / "out", place / "states", lambda number, _, out=left_out: number != out
        )
        assert not all(good), f"{named[left_out]} need not be flushed"


def test_an_interrupt_keeps_what_is_done_and_the_results_of_before(tmp_path: Path) -> None:
    make(tmp_path / "out", OLD)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "out", NEW, force=True, stop=True)
    assert content(tmp_path / "out") == OLD
    assert Kept(tmp_path / "out", {"seed": 1}).results(1) == {0: "done"}
    # The same command goes on without being forced.
    make(tmp_path / "out", NEW)
    assert content(tmp_path / "out") == NEW
    assert not (tmp_path / "out" / UNFINISHED).exists()
    with pytest.raises(RunFolderError, match=r"not empty; .* --force"):
        make(tmp_path / "out", NEW)


def test_a_full_disk_leaves_the_results_of_before(tmp_path: Path) -> None:
    make(tmp_path / "out", OLD)
    with (
        small_files(20_000),
        pytest.raises(RunFolderError, match=r"cannot be written .*free space"),
    ):
        make(tmp_path / "out", NEW | {"table.csv": "1" * 30_000}, force=True)
    assert content(tmp_path / "out") == OLD


def test_files_of_others_are_neither_replaced_nor_mixed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    write(folder, {"table.csv": "mine"})
    with pytest.raises(RunFolderError):
        make(folder, NEW)
    with pytest.raises(RunFolderError, match=r"table\.csv: is in the way of a result"):
        make(folder, NEW, force=True)
    assert content(folder) == {"table.csv": "mine"}
    # A version without records wrote the page, and so the table.
    write(folder, {"page.html": "of before"})
    make(folder, NEW, force=True)
    assert content(folder) == NEW
    with (
        pytest.raises(
            RunFolderError,
            match=r"out: holds the results of another command, with which .* name another",
        ),
        making(folder, "other", "page.html", force=True),
    ):
        pass
    write(tmp_path / "run", {"calibration.json": "{}"})
    with pytest.raises(RunFolderError):
        make(tmp_path / "run", NEW, force=True)


def test_one_writes_and_others_are_refused(tmp_path: Path) -> None:
    folder, refused = tmp_path / "out", []

    def other() -> None:
        with pytest.raises(RunFolderError, match="out: another process is writing there; wait"):
            make(folder, NEW)
        refused.append(True)

    with alone(folder), alone(folder):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        handle = os.open(folder, os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert refused == [True]
    # Nothing was made there.
    assert not folder.exists()
    make(folder, OLD)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(handle)
    handle = os.open(folder, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with pytest.raises(RunFolderError):
        make(folder, NEW, force=True)
    # As when a process ends, however it ends.
    os.close(handle)
    make(folder, NEW, force=True)
    assert content(folder) == NEW
