"""The results in a run folder: each is read when it is first asked for, and kept until a step
replaces it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, wraps
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import RunFolderError, StarcalError
from starcal_uq.core.manifest import entry_of
from starcal_uq.core.provenance import installed_versions, provenance
from starcal_uq.core.remedy import RUN, SOME_IMAGES, Remedy
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.weights import weighed
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.presentation.report.results import Missing, Results
from starcal_uq.runs.folder import FILES, REST_ON, RunFolder

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.calibration.screening.result import Screening
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.diagnostics.verdict.remedies import Place
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.pipeline.inspection import Frames
    from starcal_uq.pipeline.record import ImageRecord
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling
    from starcal_uq.propagation.field import FieldMap
    from starcal_uq.propagation.spectrum import ErrorSpectrum

_LOG = logging.getLogger(__name__)
P = ParamSpec("P")
R = TypeVar("R")
# Frames in a report, whose pictures are some hundred kilobytes together.
REPORT_FRAMES = 12


def writing(
    step: Callable[Concatenate[StoredRun, P], R],
) -> Callable[Concatenate[StoredRun, P], R]:
    """A step during which no other process may write into the folder of the run."""

    @wraps(step)
    def alone(run: StoredRun, /, *args: P.args, **kwargs: P.kwargs) -> R:
        make = step.__name__ in ("calibrate", "write")
        with RunFolder(run.path).writing(make=make):
            return step(run, *args, **kwargs)

    return alone


def _of_file(file: str, module: str, record: str) -> Any:
    """A result that is read from its file, as a record of this name."""

    def read(run: StoredRun) -> Any:
        kind = getattr(import_module(f"starcal_uq.{module}"), record)
        return kind.load(run.folder.require(file))

    return cached_property(read)


class StoredRun:
    """A run folder with what it holds; see `Run`, which adds the steps."""

    __dir__ = public_names

    # Result, its file, and the record that the file holds.
    camera: cached_property[Camera] = _of_file("camera", "camera.camera", "Camera")
    posterior: cached_property[Posterior] = _of_file(
        "posterior", "inference.posterior", "Posterior"
    )
    field_map: cached_property[FieldMap] = _of_file("field_map", "propagation.field", "FieldMap")
    spectrum: cached_property[ErrorSpectrum] = _of_file(
        "spectrum", "propagation.spectrum", "ErrorSpectrum"
    )
    error_budget: cached_property[Budget] = _of_file("budget", "budgeting.result", "Budget")

    def __init__(
        self,
        path: PathLike,
        truth: Camera | None = None,
        *,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self.path, self.folder = Path(path), RunFolder(path)
        self._truth, self._tell, self._making = truth, tell or _nobody, False
        self._words: tuple[str, ...] = ()
        self.screening: Screening | None = None

    def __repr__(self) -> str:
        try:
            return f"{self._as_it_is.text}\n{self._name}"
        except StarcalError:
            return self._name

    def _repr_html_(self) -> str:
        try:
            return str(self._as_it_is._repr_html_())
        except StarcalError as error:
            return f"<p><b>{escape(self._name)}</b>: {escape(str(error))}</p>"

    @property
    def _name(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def _as_it_is(self) -> Results:
        """What the folder holds now, without a trace in this object."""
        return StoredRun(self.path, self._truth).results

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.path.resolve().name

    @cached_property
    def attitude(self) -> AttitudeError:
        """The attitude error, over a temperature profile where one was given."""
        from starcal_uq.propagation.attitude_error import AttitudeError
        from starcal_uq.propagation.thermal import read_again, thermal_error

        error = AttitudeError.load(self.folder.require("attitude"))
        if not self.has("thermal"):
            return error
        profile = read_again(self.folder.require("thermal"))
        return replace(error, thermal=thermal_error(error.thermal_response, profile))

    @cached_property
    def calibration(self) -> Calibration:
        """The estimate."""
        self.folder.require("arrays")
        found = Calibration.load(self.folder.require("calibration"))
        if self.camera_changed:
            self._tell(self.camera_changed)
        return found

    @property
    def camera_changed(self) -> str:
        """That the file of the nominal camera was changed after the run was made, in one sentence;
        empty if not.
        """
        path = self.folder.camera
        known = self.folder.manifest.files.get(path.name)
        if known is None or not path.exists() or known == entry_of(path, known.step):
            return ""
        return (
            f"{path}: was changed after the run was made; its results are of the camera as it "
            "was, not of this file."
        )

    @cached_property
    def observations(self) -> Observations:
        """The data that the calibration was made from, with the noise that its noise model gives
        each star.

        The file holds them as they were given.

        Raises
        ------
        RunFolderError
            If the file is missing, or holds other data.
        """
        calibration = self.calibration
        table = load_observations(self.folder.require("observations"))
        if calibration.data_hash_of(table) != calibration.provenance.data_sha256:
            raise RunFolderError(
                f"{self.path}: the calibration was made from other observations than "
                f"{self.folder.observations.name} holds; "
                f"{Remedy('calibrate', purpose='again')}."
            )
        return weighed(table, calibration)

    def arviz(self, **options: Any) -> Any:
        """The posterior with all of ArviZ's groups, as ``InferenceData`` (0.23) or ``DataTree``
        (1.x); made each time.

        Parameters
        ----------
        **options
            Those of `starcal_uq.inference.arviz_data`.
        """
        from starcal_uq.inference.groups import arviz_data

        return arviz_data(self.posterior, self.observations, **options)

    @property
    def best(self) -> Calibration | Posterior:
        """What the run knows of the camera: the posterior, or the calibration where there is no
        posterior yet.
        """
        return self.posterior if self.has("posterior") else self.calibration

    @cached_property
    def coupling(self) -> Coupling:
        """The couplings of the posterior, or of the calibration where there is no posterior yet."""
        from starcal_uq.propagation.coupling import coupling

        return coupling(self.best)

    @cached_property
    def diagnosis(self) -> Diagnosis | None:
        """What questions the model; None if there is none, or it is of another calibration.

        Raises
        ------
        RunFolderError
            If the file cannot be read.
        """
        from starcal_uq.diagnostics.diagnose import Diagnosis

        if not self.has("diagnosis"):
            return None
        stored = Diagnosis.load(self.folder.require("diagnosis"))
        return stored if stored.is_of(self.calibration) else None

    @cached_property
    def images(self) -> ImageRecord | None:
        """What became of the images that the run started from; None where it started from a
        table.
        """
        from starcal_uq.pipeline.record import IMAGES, ImageRecord

        path = self.folder.path / IMAGES
        return ImageRecord.load(path) if path.exists() else None

    @cached_property
    def frames(self) -> Frames:
        """The images that the run started from, with what became of their stars.

        Raises
        ------
        RunFolderError
            If the run started from a table, or a file is missing or damaged.
        """
        from starcal_uq.pipeline.record import IMAGES
        from starcal_uq.runs.frames import calibrated_frames, uncalibrated_frames

        record = self.images
        if record is not None and not record.rounds:
            return uncalibrated_frames(self.folder, record)
        obs = self.observations
        if record is None:
            raise RunFolderError(
                f"{self.path}: has no {IMAGES}, because the run did not start from images; to "
                f"look at some, {Remedy('run', (SOME_IMAGES,), {'out': RUN})}."
            )
        return calibrated_frames(self.path, self.folder, record, obs, self.calibration)

    @property
    def shown_frames(self) -> Frames:
        """The frames that a report shows: those that tell most."""
        return self.frames.telling(REPORT_FRAMES)

    @property
    def truth(self) -> Camera | None:
        """The camera of a simulation: the one given, or that of the observations."""
        simulated = self.observations.origin.truth
        if self._truth is not None or simulated is None:
            return self._truth
        return Camera.from_dict(simulated)

    @property
    def missing(self) -> tuple[Missing, ...]:
        """What the run does not hold, each with the command that makes it."""
        posterior, attitude = self.has("posterior"), self.has("attitude")
        # Before these two there can be no budget.
        budget = self.has("budget") or not (posterior and attitude)
        parts = (
            ("sample", "The posterior", posterior),
            (
                "propagate",
                "The attitude error and the map over the field",
                attitude and self.has("field_map"),
            ),
            (
                "diagnose",
                "The tests for misfit, the jackknife and the comparison of distortion models",
                self.diagnosis is not None,
            ),
            ("budget", "The error budget", budget),
        )
        return tuple(
            Missing(what, Remedy(command, (str(self.path),)))
            for command, what, there in parts
            if not there
        )

    @property
    def place(self) -> Place:
        """What the commands of remedies name."""
        from starcal_uq.diagnostics.verdict.remedies import Place, Tried

        manifest = self.folder.manifest
        return Place(
            str(self.path.resolve()),
            self._words or manifest.words,
            self.has("observations"),
            tuple(Tried.of(one) for one in manifest.tried),
            self.calibration.partitions is not None,
            file=str(self.path.resolve() / self.folder.run_file.name)
            if self.has("run_file")
            else "",
        )

    @property
    def calibrated(self) -> Results:
        """Data and estimate alone, for what is shown while the rest is not there yet."""
        truth = self.truth
        calibration = self.calibration
        if truth is not None and truth.parameter_names != calibration.parameter_names:
            truth = None
        return Results(self.name, self.observations, calibration, truth=truth, place=self.place)

    @cached_property
    def results(self) -> Results:
        """Everything that the run holds, for the report.

        Raises
        ------
        RunFolderError
            If there is no calibration, or its data are not those of the run.
        """
        parts = ("posterior", "attitude", "field_map")
        kept: AnyDict = {name: getattr(self, name) for name in parts if self.has(name)}
        if self.has("budget"):
            kept["budget"] = self.error_budget
        return replace(
            self.calibrated,
            **kept,
            coupling=self.coupling,
            diagnosis=self.diagnosis,
            images=self.images,
            camera_changed=self.camera_changed,
            missing=self.missing,
        )

    @property
    def verdict(self) -> Verdict:
        """The verdict on whatever the run holds, as the report states it."""
        return self.results.verdict

    def has(self, name: str) -> bool:
        """Whether the folder holds a file, such as ``"posterior"``."""
        path: Path = getattr(self.folder, name)
        return path.exists()

    def did(self, step: str) -> bool:
        """Whether a step is done, such as ``"sample"``."""
        return step in self.folder.manifest.steps

    @contextmanager
    def making(
        self, command: Mapping[str, object], *, force: bool = False, words: Sequence[str] = ()
    ) -> Iterator[None]:
        """All steps within the block make one run, which replaces that of before when it is
        complete, and not sooner.

        An interrupted one resumes where it was: steps that are done, `did`, need not be done again.

        Parameters
        ----------
        command : mapping
            All that the run depends on; an unfinished one of something else starts again.
        force : bool
            Whether to replace a run that is complete.
        words : sequence of str
            The command as it was typed, without the program's name: remedies repeat it.
        """
        record = {**command, "versions": installed_versions()}
        here = self.folder
        try:
            with here.making(record, force, words) as self.folder:
                self._making, self._words = True, tuple(words)
                if self.folder == here:
                    self._forget(*LOADED)
                yield
        except BaseException:
            self._forget(*LOADED)
            raise
        finally:
            self.folder, self._making = here, False

    @contextmanager
    def _step(
        self, step: str, seed: int | None, settings: Mapping[str, Any]
    ) -> Iterator[RunFolder]:
        """Yield the folder for the files of a step; the results that rested on them are
        forgotten.
        """
        told = {name: as_setting(value) for name, value in settings.items()}
        with self.folder.step(
            step,
            provenance(seed, told, None),
            making=self._making,
            tell=self._tell,
            words=self._words,
        ) as files:
            _LOG.info("%s: writing to %s", step, self.path)
            yield files
        _LOG.info("%s: done", step)
        if "report" in REST_ON[step]:
            self._forget()
        if "budget" in REST_ON[step]:
            self._forget("error_budget")

    @property
    def _keeps_observations(self) -> bool:
        """Whether it has stars: merged runs may have none, streams have none, and sampling can do
        without them.
        """
        record = self.calibration.provenance
        merged = record.merge.get("has_observations") is False
        return not merged and not record.settings.get("stream", False)

    def _keep(self, name: str, force: bool) -> None:
        """Refuse to do a step again whose result is there."""
        if self.has(name) and not force:
            place = self.path / FILES[name].name
            raise RunFolderError(
                f"{place}: exists already; make it again with --force (force=True in Python)."
            )

    def _forget(self, *names: str) -> None:
        """Load results again when they are next asked for."""
        for name in ("results", *names):
            vars(self).pop(name, None)


def save_results(files: RunFolder, **results: Any) -> None:
    """Save each result in the file of its name; None where there is none."""
    for name, result in results.items():
        if result is not None:
            result.save(getattr(files, name))


# What is read when it is first asked for.
LOADED = tuple(
    name for name, value in vars(StoredRun).items() if isinstance(value, cached_property)
)


def as_setting(value: object) -> object:
    """A setting as a record holds it."""
    plain = isinstance(value, bool | int | float | str | list | dict | None)
    return value if plain else str(value)


def _nobody(sentence: str) -> None:
    """Nobody is there to whom a sentence matters."""
