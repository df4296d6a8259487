"""Nothing is lost and nothing is mixed: at every moment a folder holds the old run or the new
one.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib
import os
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.manifest import read_manifest
from tests.helpers.crashes import snapshots
from tests.helpers.scenes import observations

SAMPLING = {"n_ensembles": 2, "n_walkers": 14, "n_steps": 30, "n_burn": 10}
STEPS = ("calibrate", "sample", "couple", "propagate", "budget", "report")
FIRST, SECOND = 3, 5
NOTES = "mine"


# What takes the time, and is of no concern here: how results are written is.
HEAVY = {
    "calibration.calibrate": "calibrate",
    "inference.sample": "sample",
    "propagation.propagate": "propagate",
    "propagation.field": "field_map",
    "budgeting.budget": "budget",
}
_results: dict[tuple[object, ...], Any] = {}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    _quick(monkeypatch)


def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same results again where the same was asked before, and reports of one line and one
    figure.
    """
    for place, name in HEAVY.items():
        module = importlib.import_module(f"starcal_uq.{place}")
        monkeypatch.setattr(module, name, _remembering(getattr(module, name)))
    monkeypatch.setattr(
        "starcal_uq.presentation.report.drawing.draw_figures", lambda *_: {"figure": b"png"}
    )
    monkeypatch.setattr(
        "starcal_uq.presentation.report.page.prepared",
        lambda results: lambda *_: f"report of {results.name}",
    )


def _remembering(function: Callable[..., Any]) -> Callable[..., Any]:
    def mark(value: object) -> object:
        if isinstance(value, sc.Observations):
            return value.data_hash
        numbers = getattr(value, "draws", getattr(value, "theta", None))
        return (
            value
            if isinstance(value, int | str | None)
            else b""
            if numbers is None
            else numbers.tobytes()
        )

    def remembered(*given: Any, **options: Any) -> Any:
        key = (
            function.__name__,
            *map(mark, given),
            *((name, mark(value)) for name, value in sorted(options.items())),
        )
        if key not in _results:
            _results[key] = function(*given, **options)
        elif "checkpoint" in options:
            # What sampling leaves on its way.
            options["checkpoint"].write_bytes(b"checkpoint")
        return _results[key]

    return remembered


def make(folder: Path, seed: int, *, force: bool = False, stop: str | None = None) -> None:
    """A small run, by all steps in one; interrupted before one of them."""
    run = sc.Run(folder)
    # Versions before had nothing for all steps together.
    making = run.making({"seed": seed}, force=force) if hasattr(run, "making") else nullcontext()
    options: dict[str, dict[str, Any]] = {
        "sample": SAMPLING | {"seed": seed},
        "propagate": {"n_draws": 50, "seed": seed},
        "budget": {"seed": seed},
    }
    with making:
        for step in STEPS:
            if step == stop:
                raise KeyboardInterrupt
            if hasattr(run, "did") and run.did("coupling" if step == "couple" else step):
                continue
            if step == "calibrate":
                obs = observations(n_frames=12, seed=seed)
                run.calibrate(
                    obs, sc.paper.paper_start(), **({} if hasattr(run, "did") else {"force": force})
                )
            else:
                more = (
                    {"force": True}
                    if force and step == "sample" and not hasattr(run, "did")
                    else {}
                )
                getattr(run, step)(**options.get(step, {}), **more)


def content(folder: Path) -> str:
    """What a run holds, as its readers get it; a folder that holds none, or a mix, raises."""
    run = sc.Run(folder)
    posterior = run.posterior
    assert posterior.provenance["data_sha256"] == run.observations.data_hash
    tables = [
        run.attitude.to_written().to_csv(),
        run.error_budget.to_dataframe().to_csv(),
        str(run.field_map),
    ]
    if not run.folder.report.exists() or not run.folder.coupling.exists():
        raise RunFolderError(f"{folder}: not whole")
    whole = run.calibration.theta.tobytes() + posterior.draws.tobytes() + "".join(tables).encode()
    return hashlib.sha256(whole).hexdigest()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        _quick(patch)
        for seed in (FIRST, SECOND):
            make(folder / str(seed), seed)
    return {seed: folder / str(seed) for seed in (FIRST, SECOND)}


@pytest.fixture
def run(whole: dict[int, Path], tmp_path: Path) -> Path:
    """The first run, with files of the user."""
    folder = Path(shutil.copytree(whole[FIRST], tmp_path / "work" / "run"))
    (folder / "notes.txt").write_text(NOTES)
    (folder / "mine").mkdir()
    (folder / "mine" / "data.csv").write_text(NOTES)
    return folder


def notes(folder: Path) -> bool:
    return (folder / "notes.txt").read_text() == (folder / "mine" / "data.csv").read_text() == NOTES


def test_at_every_moment_there_is_the_old_run_or_the_new_one(
    whole: dict[int, Path], run: Path, tmp_path: Path
) -> None:
    old, new = content(run), content(whole[SECOND])
    assert old != new
    with snapshots(run.parent, tmp_path / "states") as states:
        make(run, SECOND, force=True)
    assert content(run) == new
    assert notes(run)
    assert not [path for path in run.iterdir() if path.name.startswith(".")]
    found, known = [], {}
    for state in states:
        assert notes(state / "run")
        # Files whose writer was stopped are put into their places; the same files are the same run.
        read_manifest(state / "run")
        files = sorted(
            path
            for path in (state / "run").rglob("*")
            if path.is_file() and path.parent.name[0] != "."
        )
        mark = hash(tuple((path.name, path.read_bytes()) for path in files))
        try:
            known[mark] = known.get(mark) or content(state / "run")
            found.append(known[mark] in (old, new))
        except (RunFolderError, OSError):
            found.append(False)
    assert len(found) > 20
    assert sum(found) == len(found), (
        f"{len(found) - sum(found)} of {len(found)} states hold no whole run"
    )


def test_a_new_sample_is_never_believed_with_what_rested_on_the_old(
    run: Path, tmp_path: Path
) -> None:
    old = sc.Run(run).posterior.draws
    told: list[str] = []
    with snapshots(run.parent, tmp_path / "states") as states:
        sc.Run(run, tell=told.append).sample(seed=9, force=True, **SAMPLING)
    new = sc.Run(run).posterior.draws
    for state in states:
        found = sc.Run(state / "run")
        is_old, is_new = (np.array_equal(found.posterior.draws, draws) for draws in (old, new))
        assert is_old != is_new
        assert all(
            found.has(name) == is_old
            for name in ("coupling", "attitude", "field_map", "budget", "report")
        )
        assert found.verdict.headline
    (sentence,) = told
    assert "report.html, verdict.json: removed, because it rested on what is replaced" in sentence
    assert f"`starcal-uq propagate {run}`" in sentence


@pytest.mark.parametrize(
    "stop", ["sample", *(pytest.param(s, marks=pytest.mark.slow) for s in ("calibrate", "report"))]
)
def test_an_interrupted_run_goes_on_to_the_same_result(
    stop: str, whole: dict[int, Path], run: Path, tmp_path: Path
) -> None:
    for folder, force in ((tmp_path / "new", False), (run, True)):
        with pytest.raises(KeyboardInterrupt):
            make(folder, SECOND, force=force, stop=stop)
        if force:
            assert content(run) == content(whole[FIRST])
        # The folder of a run that has come to nothing is not left behind.
        assert folder.exists() == (force or stop != "calibrate")
        make(folder, SECOND, force=force)
        assert content(folder) == content(whole[SECOND])
        assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_an_unfinished_run_of_other_settings_starts_again_and_the_first_one_stays(
    whole: dict[int, Path], tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "run", FIRST, stop="propagate")
    kept = sc.Run(tmp_path / "run").posterior.draws
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "run", SECOND, stop="couple")
    assert np.array_equal(sc.Run(tmp_path / "run").posterior.draws, kept)
    make(tmp_path / "run", SECOND)
    assert content(tmp_path / "run") == content(whole[SECOND])
    with pytest.raises(RunFolderError):
        make(tmp_path / "run", FIRST)


@pytest.mark.parametrize("hidden", [".new", ".step"])
def test_a_hidden_folder_that_is_a_link_is_refused_and_what_it_names_survives(
    hidden: str, whole: dict[int, Path], run: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text(NOTES)
    (run / hidden).symlink_to(tmp_path / "mine")
    with pytest.raises(
        RunFolderError, match=rf"{hidden}: is not a folder that a run has made; move it elsewhere"
    ):
        if hidden == ".new":
            make(run, SECOND, force=True)
        sc.Run(run).couple(force=True)
    assert (run / hidden).is_symlink() and [
        path.name for path in (tmp_path / "mine").iterdir()
    ] == ["notes.txt"]
    (run / hidden).unlink()
    assert content(run) == content(whole[FIRST])


def test_a_file_of_the_users_in_the_hidden_folder_of_a_new_run_survives(
    whole: dict[int, Path], run: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        make(run, SECOND, force=True, stop="couple")
    mine = run / ".new" / "figures" / "notes.txt"
    mine.parent.mkdir(exist_ok=True)
    mine.write_text(NOTES)
    # The same command, one of other settings, and a step that would remove the unfinished run.
    again = sc.Run(run)
    for call in (
        lambda: make(run, SECOND, force=True),
        lambda: make(run, FIRST, force=True),
        lambda: again.write(again.calibration, again.observations),
    ):
        with pytest.raises(
            RunFolderError,
            match=r"notes\.txt: is not of a run, .*; move it elsewhere, and start again",
        ):
            call()
        assert mine.read_text() == NOTES and content(run) == content(whole[FIRST])
    mine.unlink()
    # Control: without it, the unfinished run goes on.
    make(run, SECOND, force=True)
    assert content(run) == content(whole[SECOND]) and not (run / ".new").exists()


@pytest.mark.slow
def test_links_and_the_current_folder_are_replaced_like_others(
    whole: dict[int, Path], run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(run)
    make(tmp_path / "link", SECOND, force=True)
    assert (tmp_path / "link").is_symlink()
    assert content(run) == content(whole[SECOND])
    monkeypatch.chdir(run)
    make(Path(), FIRST, force=True)
    assert os.path.samefile(run, os.curdir)
    assert content(run) == content(whole[FIRST])


@pytest.mark.parametrize(
    ("name", "step", "remedy"),
    [
        ("posterior.nc", "posterior", "sample RUN --force"),
        ("calibration.npz", "calibration", "calibrate OBS CAMERA -o RUN --force"),
        ("field_map.npz", "field_map", "propagate RUN --force"),
        ("attitude.csv", "attitude", "propagate RUN --force"),
        ("budget.csv", "error_budget", "budget RUN --force"),
        ("camera.toml", "camera", "calibrate OBS CAMERA -o RUN --force"),
    ],
)
def test_a_file_that_is_not_of_this_run_is_refused_by_name(
    name: str, step: str, remedy: str, whole: dict[int, Path], run: Path
) -> None:
    good = (run / name).read_bytes()
    middle = len(good) // 2
    flipped = good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :]
    for content in ((whole[SECOND] / name).read_bytes() + b" ", good[:-20], flipped, b""):
        (run / name).write_bytes(content)
        with pytest.raises(
            RunFolderError, match=rf"{name}: is not the file .* run `starcal-uq {remedy}`"
        ):
            getattr(sc.Run(run), step)
    (run / name).write_bytes(good)
    getattr(sc.Run(run), step)


def test_a_file_of_another_run_where_there_was_none_is_refused(
    whole: dict[int, Path], tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "run", SECOND, stop="sample")
    shutil.copy(whole[FIRST] / "posterior.nc", tmp_path / "run")
    with pytest.raises(RunFolderError, match=r"posterior\.nc: is not a file of this run"):
        sc.Run(tmp_path / "run").report()


def test_a_folder_of_a_version_without_records_is_read_and_gets_one(
    whole: dict[int, Path], run: Path
) -> None:
    (run / "run.json").unlink()
    assert content(run) == content(whole[FIRST])
    sc.Run(run).report(force=True)
    assert content(run) == content(whole[FIRST])
    (run / "posterior.nc").write_bytes((whole[SECOND] / "posterior.nc").read_bytes())
    with pytest.raises(RunFolderError, match=r"posterior\.nc: is not the file"):
        content(run)


def test_one_process_at_a_time_writes_into_a_folder(
    whole: dict[int, Path], run: Path, tmp_path: Path
) -> None:
    """A lock by another handle is what another process holds; it ends with the process."""
    stars, camera = sc.load_catalogue(max_mag=5.0), sc.paper.paper_camera()
    writers = {
        "sample": lambda: sc.Run(run).sample(force=True, seed=1, **SAMPLING),
        "report": lambda: sc.Run(run).report(force=True),
        "run": lambda: make(run, SECOND, force=True),
        "write": lambda: sc.Run(run).write(sc.Run(whole[SECOND]).calibration, None),
        "simulate": lambda: sc.simulation.simulate_partitions(
            stars, camera, run, n_frames=5, force=True
        ),
    }
    before = content(run)
    other = os.open(run, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    try:
        for writer in writers.values():
            with pytest.raises(
                RunFolderError, match=r"run: another process is writing there; wait for"
            ):
                writer()
        assert content(run) == before
        assert sc.Run(run).report().exists()
    finally:
        os.close(other)
    writers["report"]()
