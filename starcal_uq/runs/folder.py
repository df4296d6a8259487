"""The run folder: its file names, the rule by which steps replace results, and the check that a
file is of this run.

The rule. What a run holds is kept unless it is forced to go. A step that is done again removes what
rests on its result, and names it first; a budget is a further result, and makes a report older. All
files of a step are replaced at once; files that the run has not written are left alone.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from starcal_uq.core.conflicts import parsed
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import STEP, as_plain, check_new_folder, new_folder
from starcal_uq.core.manifest import (
    MANIFEST,
    NEW,
    Manifest,
    alone,
    check_file,
    check_hidden,
    commit,
    entry_of,
    files_in,
    read_manifest,
    refuse_others,
    staged,
    sweep,
    write_manifest,
)
from starcal_uq.core.provenance import Provenance
from starcal_uq.core.remedy import CAMERA, OBS, RUN, Remedy
from starcal_uq.core.runfile import NAME as RUN_FILE
from starcal_uq.core.status import Level, Question
from starcal_uq.core.types import AnyDict, PathLike


class _File:
    """A file of a run folder: its name, the step that it belongs to, and what makes it."""

    def __init__(self, name: str, step: str, **arguments: Any) -> None:
        self.name, self.step = name, step
        self.remedy = Remedy(step, (RUN,), arguments)
        if step == "calibrate":
            self.remedy = Remedy(step, (OBS, CAMERA), {"out": RUN, **arguments})

    def __get__(self, folder: RunFolder | None, _: type) -> Path:
        return Path(self.name) if folder is None else folder.path / self.name


# Part of a diagnosis -> its table.
DIAGNOSIS_TABLES = {
    "misfit": "misfit.csv",
    "jackknife": "jackknife.csv",
    "stars": "stars.csv",
    "comparison": "comparison.csv",
    "predictive": "predictive.csv",
}
HISTORY = "history.csv"
CHECKPOINT = "sampling.checkpoint.npz"
_PAGES = ("report", "pdf", "notebook")
# Step -> steps that rest on its result.
REST_ON: dict[str, tuple[str, ...]] = {
    "calibrate": (
        "images",
        "inspect",
        "sample",
        "coupling",
        "propagate",
        "diagnose",
        "budget",
        *_PAGES,
    ),
    "images": ("inspect", *_PAGES),
    "inspect": (),
    "sample": ("coupling", "propagate", "budget", *_PAGES),
    "coupling": _PAGES,
    "propagate": ("budget", *_PAGES),
    "diagnose": ("budget", *_PAGES),
    "budget": _PAGES,
    "report": ("pdf",),
    "pdf": (),
    "notebook": (),
}
# A further result of the run replaces nothing but a file of its name: what rests on it stays, and
# is older.
_ADDED = ("budget",)
# Files that have no name of their own in a run.
_OTHERS = {
    **dict.fromkeys(DIAGNOSIS_TABLES.values(), "diagnose"),
    **dict.fromkeys(
        ("centroids.parquet", "identification.csv", "images.json", "matched.parquet"), "images"
    ),
    HISTORY: "calibrate",
}


@dataclass(frozen=True)
class RunFolder:
    """A folder that holds one run; its files are paths, which need not exist yet.

    Attributes
    ----------
    path : Path
        The folder; a string is accepted.
    observations : Path
        The table that was calibrated on (Parquet).
    camera : Path
        The nominal camera, as it was given (TOML).
    calibrated : Path
        The calibrated camera: at the posterior mean, or the estimate where there is no posterior
        (TOML).
    calibration : Path
        Estimate, covariance, stages, status and provenance (JSON).
    arrays : Path
        The long arrays of the calibration: residuals, quaternions (NPZ).
    posterior : Path
        Draws and diagnostics (netCDF).
    coupling : Path
        Table of couplings (CSV).
    attitude : Path
        Table of attitude errors (CSV).
    mission : Path
        Frames that the attitude errors are of, where they are not the observed ones (Parquet).
    alignment : Path
        Frames on which alignment is calibrated, where they are not the observed ones (Parquet).
    field_map : Path
        Direction uncertainty over the field (NPZ).
    spectrum : Path
        Spectrum of the frame-dependent error along an attitude profile (NPZ).
    thermal : Path
        Attitude error over a temperature profile (CSV).
    budget : Path
        Error budget (CSV).
    diagnosis : Path
        Tests for misfit, jackknife, comparison of models (JSON).
    rejected : Path
        Rows that screening left out, with their reasons (CSV).
    run_file : Path
        The options with which the command `run` repeats the run (TOML).
    verdict : Path
        Every check with value, bound, level and remedy (JSON).
    figures : Path
        Folder of the figures.
    report : Path
        The report (HTML, self-contained).
    inspection : Path
        The images with their stars (HTML, self-contained).
    pdf : Path
        The report for printing (PDF).
    notebook : Path
        The results as an executed notebook.
    """

    __dir__ = public_names

    path: Path

    observations = _File("observations.parquet", "calibrate")
    camera = _File("camera.toml", "calibrate")
    calibrated = _File("calibrated.toml", "calibrate")
    calibration = _File("calibration.json", "calibrate")
    arrays = _File("calibration.npz", "calibrate")
    posterior = _File("posterior.nc", "sample")
    coupling = _File("coupling.csv", "coupling")
    attitude = _File("attitude.csv", "propagate")
    mission = _File("mission_frames.parquet", "propagate", attitudes="random")
    alignment = _File("alignment_frames.parquet", "propagate")
    field_map = _File("field_map.npz", "propagate")
    spectrum = _File("error_spectrum.npz", "propagate", attitudes="PROFILE")
    thermal = _File("thermal.csv", "propagate", temperature_profile="FILE")
    budget = _File("budget.csv", "budget")
    diagnosis = _File("diagnosis.json", "diagnose")
    rejected = _File("rejected.csv", "calibrate", screening=True)
    run_file = _File(RUN_FILE, "calibrate")
    verdict = _File("verdict.json", "report")
    figures = _File("figures", "report")
    report = _File("report.html", "report")
    inspection = _File("frames.html", "inspect")
    pdf = _File("report.pdf", "report", format="pdf")
    notebook = _File("report.ipynb", "report", notebook=True)

    def __init__(self, path: PathLike) -> None:
        object.__setattr__(self, "path", Path(path))

    def create(self) -> RunFolder:
        """Make the folder, with its parents, if it does not exist.

        Raises
        ------
        RunFolderError
            If a file is in the way or the operating system refuses.
        """
        new_folder(self.path)
        return self

    def require(self, name: str) -> Path:
        """Path of a file that must exist and be of this run, such as ``"calibration"``.

        Raises
        ------
        RunFolderError
            If the folder or the file is missing, or the file is not the one that the run has
            written; the message names the command that makes it.
        ValueError
            If a run folder has no file of that name.
        """
        if name not in FILES:
            raise ValueError(f"a run folder has no {name!r}: use one of {', '.join(FILES)}")
        file = FILES[name]
        if os.path.exists(self.path) and not os.path.isdir(self.path):
            raise RunFolderError(
                f"{self.path}: is not a run folder but a file; name the folder given to -o."
            )
        if not os.path.isdir(self.path):
            raise RunFolderError(
                f"{self.path}: the run folder does not exist; check the path, or "
                f"{replace(file.remedy, purpose='first')}."
            )
        # Read first: it may have files to put in their places.
        manifest = read_manifest(self.path)
        path = self.path / file.name
        if not os.path.exists(path):
            first = replace(file.remedy, purpose="first")
            raise RunFolderError(f"{self.path}: the run folder has no {file.name}; {first}.")
        # Folders of versions before this one have no record.
        if manifest is not None:
            again = replace(file.remedy.having(force=True), purpose="to make it again")
            check_file(path, manifest.files.get(file.name), again)
        return path

    @property
    def manifest(self) -> Manifest:
        """Contents of the run; for a folder made by a version without records, the files by their
        names.
        """
        found = read_manifest(self.path)
        if found is not None:
            return found
        if not (os.path.exists(self.calibration) or os.path.exists(self.posterior)):
            return Manifest()
        steps = {file.name: file.step for file in FILES.values()} | _OTHERS
        steps |= {
            path.relative_to(self.path).as_posix(): "report"
            for path in self.figures.glob("*.[ps][nv]g")
        }
        files = {
            name: entry_of(self.path / name, steps[name])
            for name in steps
            if (self.path / name).is_file()
        }
        return Manifest(files, {entry.step: Provenance() for entry in files.values()})

    def resting_on(self, step: str) -> list[str]:
        """Files deleted when a step is repeated, because they depend on its result."""
        gone = () if step in _ADDED else REST_ON[step]
        return [name for name, entry in self.manifest.files.items() if entry.step in gone]

    def is_older(self, step: str) -> bool:
        """True if a step is done, and a step on which it depends was done after it."""
        steps = list(self.manifest.steps)
        return step in steps and any(
            step in REST_ON[later] for later in steps[steps.index(step) + 1 :]
        )

    @contextmanager
    def writing(self, *, make: bool = False) -> Iterator[None]:
        """No other process may write into the folder meanwhile, which `make` makes."""
        with alone(self.path, make=make):
            refuse_others(self.path, REST_ON)
            yield

    @contextmanager
    def step(
        self,
        step: str,
        record: Provenance,
        *,
        making: bool = False,
        tell: Callable[[str], None] | None = None,
        words: Sequence[str] = (),
    ) -> Iterator[RunFolder]:
        """Yield a folder for the files of a step, which appear in the run all at once if the block
        succeeds.

        Parameters
        ----------
        step : str
            Name of the step.
        record : dict
            Its provenance.
        making : bool
            Whether it belongs to the command that makes the whole run; a step of its own ends what
            that had begun.
        tell : callable, optional
            Function that gets the sentence on what goes.
        words : sequence of str
            Of a calibration by itself, the command as it was typed.
        """
        old = self.create().manifest
        if step == "calibrate":
            self._check_new()
        with self.writing(), staged(self.path) as stage:
            yield RunFolder(stage)
            # A file of another step that this one has changed stays a file of that step.
            made = {
                name: entry_of(path, old.files[name].step if name in old.files else step)
                for name, path in files_in(stage).items()
            }
            stale = () if step in _ADDED else (step, *REST_ON[step])
            kept = {name: entry for name, entry in old.files.items() if entry.step not in stale}
            gone = [name for name in self.resting_on(step) if name not in made]
            if gone and tell is not None:
                tell(_gone(gone, self.path))
            if step == "calibrate":
                remove_checkpoints(self.path)
                shutil.rmtree(self.path / NEW, ignore_errors=True)
            steps = {
                name: content for name, content in old.steps.items() if name not in (step, *stale)
            }
            steps[step] = record
            new = replace(old, files=kept | made, steps=steps, stage=STEP)
            if step == "calibrate" and not making:
                new = replace(new, words=tuple(words), tried=())
            if not making:
                new = replace(new, command=None, complete=True)
            commit(self.path, new, old.files)

    @contextmanager
    def making(
        self, command: Mapping[str, object], force: bool, words: Sequence[str] = ()
    ) -> Iterator[RunFolder]:
        """Yield the folder in which one command makes a whole run; an interrupted one is continued.

        That is this folder. Where it holds another run, it is a hidden one inside, whose files take
        their places all at once when the run is complete; an error, a kill or a full disk leaves
        the earlier run.

        Parameters
        ----------
        command : mapping
            All that the run depends on; an unfinished one of something else is not resumed.
        force : bool
            Whether to replace a run that is complete.
        words : sequence of str
            The command as it was typed, which remedies repeat.
        """
        wanted = json.loads(json.dumps(command, default=as_plain, sort_keys=True))
        with self.writing(make=True):
            old = self.manifest
            if old.complete:
                check_new_folder(self.path, force)
            place = self
            if not old.complete and old.command != wanted and "calibrate" not in old.steps:
                # One that has come to no calibration has nothing to be kept.
                for name in old.files:
                    (self.path / name).unlink(missing_ok=True)
                old = replace(old, files={}, steps={}, command=None)
                write_manifest(self.path, old)
            if old.files and (old.complete or old.command != wanted):
                self._check_new()
                place = RunFolder(self.path / NEW).create()
            present = place.manifest
            if present.complete or present.command != wanted:
                if place != self:
                    shutil.rmtree(place.path)
                    place.create()
                tried = self._tried(old, wanted, words)
                write_manifest(place.path, Manifest(command=wanted, tried=tried, complete=False))
            sweep(place.path)
            try:
                yield place
            except BaseException:
                if not place.manifest.steps:
                    _unmake(place.path)
                raise
            done = replace(place.manifest, words=tuple(words), complete=True)
            if place == self:
                write_manifest(self.path, done)
            else:
                self._check_new()
                commit(self.path, replace(done, stage=NEW), old.files)

    def _check_new(self) -> None:
        """Refuse a hidden folder for a new run that holds what is not of a run."""
        check_hidden(self.path, NEW, (CHECKPOINT,))

    def _tried(self, old: Manifest, command: AnyDict, words: Sequence[str]) -> tuple[AnyDict, ...]:
        """Options and outcomes of the runs of the same data that stood here, up to one with the
        options of this one.
        """
        if not old.complete or not old.words or _data_of(old.command) != _data_of(command):
            return ()
        levels = []
        with suppress(OSError, ValueError, KeyError, TypeError):
            checks = json.loads(self.verdict.read_text(encoding="utf-8"))["checks"]
            levels = [
                check["level"] for check in checks if check["question"] != Question.REQUIRED.value
            ]
        if not levels:
            return ()
        failed, warned = (levels.count(level.value) for level in (Level.FAIL, Level.WARN))
        _, options = parsed(old.words)
        replaced = {"options": options, "failed": failed, "warned": warned}
        chain = [*old.tried, json.loads(json.dumps(replaced))]
        now = json.loads(json.dumps(parsed(words)[1]))
        again = [place for place, one in enumerate(chain) if one["options"] == now]
        return tuple(chain[: again[0]] if again else chain)


def _data_of(command: AnyDict | None) -> AnyDict:
    """Hashes of the stars or images that a command was made from."""
    inputs = {} if command is None else command.get("inputs", {})
    return {name: content for name, content in inputs.items() if name.startswith("input ")}


FILES = {key: value for key, value in vars(RunFolder).items() if isinstance(value, _File)}


def remove_checkpoints(folder: Path) -> None:
    """Remove what sampling has kept on its way."""
    for path in folder.glob(f"{CHECKPOINT}*"):
        path.unlink(missing_ok=True)


def _unmake(folder: Path) -> None:
    """Leave nothing of a run that has not come to its first result."""
    remove_checkpoints(folder)
    (folder / MANIFEST).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _gone(names: list[str], folder: Path) -> str:
    """What goes, and how to make it again."""
    shown = [name for name in names if not name.startswith("figures/")]
    remedies = [file.remedy.at({RUN: str(folder)}) for file in FILES.values() if file.name in shown]
    again = ", ".join(dict.fromkeys(f"`{remedy.words}`" for remedy in remedies))
    return (
        f"{', '.join(shown)}: removed, because it rested on what is replaced; run {again} to "
        "make it again."
    )
