"""A run: the results in a folder, each loaded once, and the steps that add to them.

A step takes results and gives one, and writes it. `RunFolder` has the rule by which it replaces
what was there.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import sigma_parameter
from starcal_uq.core.conflicts import refuse_conflicts
from starcal_uq.core.errors import CalibrationError, RunFolderError, StarcalError
from starcal_uq.core.files import (
    atomic_write_bytes,
    atomic_write_text,
    check_new_folder,
    ensure_new,
    new_folder,
    read_parquet,
    reading,
    write_csv,
)
from starcal_uq.core.manifest import entry_of
from starcal_uq.core.provenance import provenance
from starcal_uq.core.records import write_json
from starcal_uq.core.settings import bounded
from starcal_uq.core.types import PathLike, Progress
from starcal_uq.estimation.noise_model import weighed
from starcal_uq.estimation.result import Calibration
from starcal_uq.observations.files import arrow_values
from starcal_uq.observations.partitions import PartitionedObservations
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.presentation.report.results import Missing, Results
from starcal_uq.runs.folder import (
    CHECKPOINT,
    DIAGNOSIS_TABLES,
    FILES,
    HISTORY,
    REST_ON,
    RunFolder,
    remove_checkpoints,
)

# Frames in a report, whose pictures are some hundred kilobytes together.
REPORT_FRAMES = 12

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.budgeting.file import BudgetFile
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.calibration.screening.result import Screening
    from starcal_uq.core.settings import Scalar, Sense
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.diagnostics.verdict.remedies import Place
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.pipeline.inspection import Frames
    from starcal_uq.pipeline.record import ImageRecord
    from starcal_uq.pipeline.refine import ImageCalibration
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling
    from starcal_uq.propagation.field import FieldMap
    from starcal_uq.propagation.spectrum import ErrorSpectrum


P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class MissionSky:
    """Frames that a mission will see, in place of the observed ones.

    Attributes
    ----------
    profile : Path or None
        Attitudes over time; random ones where it is None.
    max_mag : float
        Magnitude limit of the sensor in flight, Gaia G.
    epoch : float
        Julian year of the star positions.
    n_frames : int
        Number of random attitudes.
    min_stars : int or None
        Least stars of a frame that gives an attitude; 5 at random attitudes and 3 along a profile
        by default.
    rate_hz : float or None
        Frames per second along the profile; its own instants where it is None.
    scalar, sense
        Conventions of the profile's quaternions, as for
        `starcal_uq.attitude.load_attitude_profile`.
    """

    profile: Path | None = None
    max_mag: float = 6.0
    epoch: float = 2026.9
    n_frames: int = 1000
    min_stars: int | None = None
    rate_hz: float | None = None
    scalar: Scalar | None = None
    sense: Sense = "icrs_to_camera"

    @bounded
    def frames(self, posterior: Posterior, obs: Observations, seed: int) -> Observations:
        """Noise-free frames, with the noise of the observed ones by magnitude where it is
        stated.
        """
        from starcal_uq.attitude.profile import load_attitude_profile
        from starcal_uq.simulation.mission import mission_frames, profile_frames
        from starcal_uq.sky.catalogue import load_catalogue

        stars = load_catalogue(max_mag=self.max_mag, epoch=self.epoch)
        camera = posterior.calibrated_camera
        like = obs if posterior.sigma_name == sigma_parameter(True).name else None
        if self.profile is None:
            return mission_frames(
                stars,
                camera,
                n_frames=self.n_frames,
                min_stars=self.min_stars or 5,
                seed=seed,
                noise_like=like,
            )
        profile = load_attitude_profile(self.profile, scalar=self.scalar, sense=self.sense)
        frames = profile_frames(
            stars, camera, profile, self.rate_hz, min_stars=self.min_stars or 3, noise_like=like
        )
        return frames.with_meta(messages=[*profile.messages])


def _writing(method: Callable[P, R]) -> Callable[P, R]:
    """A step during which no other process may write into the folder of the run."""

    @wraps(method)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        folder = RunFolder(cast(Run, args[0]).path)
        with folder.writing(make=method.__name__ in ("calibrate", "write")):
            return method(*args, **kwargs)

    return alone


class Run:
    """A run folder with what it holds; a result is loaded when it is first asked for.

    A result that is not there raises `RunFolderError`, whose message names the command that makes
    it.

    Parameters
    ----------
    path : path
        The folder, which need not exist before the first step.
    truth : Camera, optional
        The camera of a simulation, shown beside the estimate; that of the observations by default.
    tell : callable, optional
        Function that gets what a user should know, one sentence each, such as which results go.

    Attributes
    ----------
    path : Path
        The folder.
    folder : RunFolder
        The folder and the paths of its files; a hidden one inside, while a command makes a run to
        replace this one.
    screening : Screening or None
        What the last `calibrate` of this object left out, if it screened.
    """

    def __init__(
        self,
        path: PathLike,
        truth: Camera | None = None,
        *,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self.path, self.folder = Path(path), RunFolder(path)
        self._truth, self._tell, self._making = truth, tell, False
        self._words: tuple[str, ...] = ()
        self.screening: Screening | None = None

    def __repr__(self) -> str:
        try:
            return f"{self._name}: {self._as_it_is.text}"
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
        return Run(self.path, self._truth).results

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.path.resolve().name

    @cached_property
    def camera(self) -> Camera:
        """The nominal camera, as it was given."""
        return Camera.load(self.folder.require("camera"))

    @cached_property
    def calibration(self) -> Calibration:
        """The estimate."""
        self.folder.require("arrays")
        found = Calibration.load(self.folder.require("calibration"))
        if self.camera_changed and self._tell is not None:
            self._tell(self.camera_changed)
        return found

    @property
    def camera_changed(self) -> str:
        """That the file of the nominal camera was changed after the run was made, in one sentence;
        empty if not.
        """
        known = self.folder.manifest.files.get(RunFolder.camera.name)
        if (
            known is None
            or not self.has("camera")
            or known == entry_of(self.folder.camera, known.step)
        ):
            return ""
        return (
            f"{self.folder.camera}: was changed after the run was made; its results are of the "
            "camera as it was, not "
            "of this file."
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
        if calibration.data_hash_of(table) != calibration.provenance.get("data_sha256"):
            raise RunFolderError(
                f"{self.path}: the calibration was made from other observations than "
                f"{self.folder.observations.name} "
                "holds; run `starcal-uq calibrate` again."
            )
        return weighed(table, calibration)

    @cached_property
    def posterior(self) -> Posterior:
        """The draws."""
        from starcal_uq.inference.posterior import Posterior

        return Posterior.load(self.folder.require("posterior"))

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
    def attitude(self) -> AttitudeError:
        """The attitude error, without its single draws."""
        from starcal_uq.propagation.attitude_error import AttitudeError

        return AttitudeError.load(self.folder.require("attitude"))

    @cached_property
    def field_map(self) -> FieldMap:
        """The direction uncertainty over the field."""
        from starcal_uq.propagation.field import FieldMap

        return FieldMap.load(self.folder.require("field_map"))

    @cached_property
    def spectrum(self) -> ErrorSpectrum:
        """The spectrum of the frame-dependent error along an attitude profile."""
        from starcal_uq.propagation.spectrum import ErrorSpectrum

        return ErrorSpectrum.load(self.folder.require("spectrum"))

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
    def error_budget(self) -> Budget:
        """The attitude error budget."""
        from starcal_uq.budgeting.result import Budget

        return Budget.load(self.folder.require("budget"))

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
        import pandas as pd

        from starcal_uq.images.centroids import Centroids
        from starcal_uq.pipeline.images import CENTROIDS, IDENTIFICATION, MATCHED
        from starcal_uq.pipeline.inspection import Frames
        from starcal_uq.pipeline.record import IMAGES

        record = self.images
        if record is not None and not record.rounds:
            return self._uncalibrated(record)
        obs = self.observations
        if record is None:
            raise RunFolderError(
                f"{self.path}: has no {IMAGES}, because the run did not start from images; to "
                "look at some, run "
                "`starcal-uq run IMAGES... -o RUN`."
            )
        path = self.folder.path / IDENTIFICATION
        with reading(
            path, "a table of identified frames", "run `starcal-uq run IMAGES... -o RUN` again"
        ):
            table = pd.read_csv(path)
            seconds = dict(
                zip(table["frame"].tolist(), (1e-3 * table["milliseconds"]).tolist(), strict=True)
            )
        reasons = {}
        if self.has("rejected"):
            path = self.folder.rejected
            with reading(path, "a table of rejected stars", "run `starcal-uq calibrate` again"):
                table = pd.read_csv(path)
                reasons = dict(
                    zip(
                        zip(table["frame"], table["star_id"], strict=True),
                        table["reason"],
                        strict=True,
                    )
                )
        matched, cal = self.folder.path / MATCHED, self.calibration
        return Frames(
            str(self.path),
            record,
            Centroids.load(self.folder.path / CENTROIDS),
            # Runs of versions before this one have calibrated stars only.
            load_observations(matched) if matched.exists() else obs,
            obs,
            cal.residuals_px,
            cal.camera,
            dict(zip(cal.frame_ids.tolist(), cal.quaternions, strict=True)),
            reasons,
            seconds,
            tuple(Path(source) for source in record.sources),
        )

    def _uncalibrated(self, record: ImageRecord) -> Frames:
        """The images where nothing could be calibrated: detections, and stars where some were
        identified.
        """
        import numpy as np

        from starcal_uq.identification.engine import sheet_of
        from starcal_uq.images.centroids import Centroids
        from starcal_uq.pipeline.images import CENTROIDS, MATCHED
        from starcal_uq.pipeline.inspection import Frames

        folder = self.folder.path
        centroids, none = Centroids.load(folder / CENTROIDS), np.empty(0)
        nothing = Observations(
            frame=none.astype(int), x_px=none, y_px=none, ra_deg=none, dec_deg=none
        )
        matched = load_observations(folder / MATCHED) if (folder / MATCHED).exists() else nothing
        known = self.has("camera")
        return Frames(
            str(folder),
            record,
            centroids,
            matched,
            nothing,
            np.empty((0, 2)),
            self.camera if known else sheet_of(centroids)[0],
            {},
            images=tuple(Path(source) for source in record.sources),
            known=known,
        )

    def inspect(
        self, *which: int | str, most: int = 24, images: Sequence[PathLike] | None = None
    ) -> Frames:
        """Frames to be looked at: they show themselves in a notebook, and `starcal_uq.report`
        writes them as a page.

        Parameters
        ----------
        *which : int or str
            Numbers or names of frames; by default those that tell most (`Frames.telling`).
        most : int
            How many these are at most.
        images : sequence of path, optional
            Files or folders in which the images are, where they have moved.

        Raises
        ------
        RunFolderError
            If the run did not start from images.
        ImageError
            If there is no such frame.
        """
        frames = (
            self.frames if images is None else replace(self.frames, images=tuple(map(Path, images)))
        )
        return frames.select(*which, large=True) if which else frames.telling(most)

    @_writing
    def keep_frames(self, frames: Frames, *, force: bool = False) -> Path:
        """Write frames as ``RUN/frames.html``, which goes when the run changes.

        Parameters
        ----------
        frames : Frames
            What `inspect` gave.
        force : bool
            Whether to replace the page of before.
        """
        from starcal_uq.presentation.pages.gallery import write_frames

        self._keep("inspection", force)
        with self._step("inspect", None, {}) as files:
            write_frames(frames, files.inspection)
        return self.folder.inspection

    @property
    def shown_frames(self) -> Frames:
        """The frames that a report shows: those that tell most."""
        return self.frames.telling(REPORT_FRAMES)

    @property
    def truth(self) -> Camera | None:
        """The camera of a simulation: the one given, or that of the observations."""
        simulated = self.observations.meta.get("truth")
        return (
            self._truth
            if self._truth is not None or simulated is None
            else Camera.from_dict(simulated)
        )

    @property
    def missing(self) -> tuple[Missing, ...]:
        """What the run does not hold, each with the command that makes it."""
        parts = (
            ("sample", "The posterior", self.has("posterior")),
            (
                "propagate",
                "The attitude error and the map over the field",
                self.has("attitude") and self.has("field_map"),
            ),
            (
                "diagnose",
                "The tests for misfit, the jackknife and the comparison of distortion models",
                self.diagnosis is not None,
            ),
            # Before these two there can be no budget.
            (
                "budget",
                "The error budget",
                self.has("budget") or not (self.has("posterior") and self.has("attitude")),
            ),
        )
        return tuple(
            Missing(what, f"starcal-uq {command} {self.path}")
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
        )

    @property
    def calibrated(self) -> Results:
        """Data and estimate alone, for what is shown while the rest is not there yet."""
        truth, calibration = self.truth, self.calibration
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
        return replace(
            self.calibrated,
            posterior=self.posterior if self.has("posterior") else None,
            coupling=self.coupling,
            attitude=self.attitude if self.has("attitude") else None,
            field_map=self.field_map if self.has("field_map") else None,
            diagnosis=self.diagnosis,
            images=self.images,
            camera_changed=self.camera_changed,
            budget=self.error_budget if self.has("budget") else None,
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

        An interrupted one goes on where it was: steps that are done, `did`, need not be done again.

        Parameters
        ----------
        command : mapping
            All that the run depends on; an unfinished one of something else starts again.
        force : bool
            Whether to replace a run that is complete.
        words : sequence of str
            The command as it was typed, without the program's name: remedies repeat it.
        """
        record = {**command, "versions": provenance(None, {}, None)["versions"]}
        here = self.folder
        try:
            with here.making(record, force, words) as self.folder:
                self._making, self._words = True, tuple(words)
                if self.folder == here:
                    self._forget(*_LOADED)
                yield
        except BaseException:
            self._forget(*_LOADED)
            raise
        finally:
            self.folder, self._making = here, False

    @contextmanager
    def _step(
        self, step: str, seed: int | None, settings: Mapping[str, Any]
    ) -> Iterator[RunFolder]:
        record = provenance(
            seed, {name: as_setting(value) for name, value in settings.items()}, None
        )
        with self.folder.step(
            step, record, making=self._making, tell=self._tell, words=self._words
        ) as files:
            yield files
        if "report" in REST_ON[step]:
            self._forget(*(["error_budget"] if "budget" in REST_ON[step] else []))

    @_writing
    def calibrate(
        self,
        obs: Observations | PartitionedObservations,
        camera: Camera,
        *,
        screening: bool = False,
        undetermined: bool = False,
        accept_inflation: bool = False,
        force: bool = False,
        words: Sequence[str] = (),
        progress: Progress | None = None,
        **options: Any,
    ) -> Calibration:
        """Calibrate and write observations, camera and calibration; nothing is written when the
        estimate fails.

        Parameters
        ----------
        obs : Observations or PartitionedObservations
            Identified stars. Of partitioned ones the run keeps the sample of frames that its
            results are shown by.
        camera : Camera
            The nominal camera.
        screening : bool
            Whether to leave out wrong identifications first. The run then holds the kept rows,
            ``rejected.csv`` the others with their reasons, and `screening` of this object all about
            it.
        undetermined : bool
            Whether to write an estimate that leaves parameters open, to be sampled with priors that
            determine them.
        accept_inflation : bool
            Whether to multiply sigma by how much more the frames scatter than their noise says
            (`starcal_uq.diagnostics.accept_inflation`); draws are as wide.
        force : bool
            Whether to replace what the folder holds.
        words : sequence of str
            The command as it was typed, without the program's name: remedies repeat it.
        progress, **options
            Further options of `starcal_uq.calibrate`.

        Raises
        ------
        RunFolderError
            If the folder is not empty.
        CalibrationError
            If the data do not determine the camera.
        """
        screened: Screening | None = None
        options |= {"throw": False} if undetermined else {}
        refuse_conflicts(
            screening=screening,
            accept_inflation=accept_inflation,
            method=options.get("method"),
            partitioned=isinstance(obs, PartitionedObservations),
        )
        if screening:
            from starcal_uq.calibration.screening.screening import screen

            assert isinstance(obs, Observations)
            screened = screen(obs, camera, **options)
            obs, calibration = screened.observations, screened.calibration
        else:
            from starcal_uq.calibration.calibrate import calibrate
            from starcal_uq.diagnostics.explain import explain

            try:
                calibration = calibrate(obs, camera, progress=progress, **options)
            except CalibrationError as error:
                known = explain(error, obs) if isinstance(obs, Observations) else error
                if known is error:
                    raise
                raise known from error
            if isinstance(obs, PartitionedObservations):
                # The stars stay where they are; the run holds the sample of frames that its results
                # are shown by.
                obs = obs.sample()
            elif calibration.n_frames < obs.n_frames:
                obs = obs.select_frames(calibration.frame_ids)
        if undetermined and not calibration.status.ok and not calibration.undetermined:
            status = calibration.status
            raise CalibrationError(
                f"the calibration did not end well ({status.name}): {calibration.remedy}.", status
            )
        if accept_inflation:
            from starcal_uq.diagnostics import jackknife

            found = jackknife.jackknife_of_all(calibration) or jackknife.jackknife_frames(
                obs, calibration
            )
            calibration = jackknife.accept_inflation(calibration, found)
        if not self._making:
            check_new_folder(self.path, force)
            self._words = tuple(words)
        self.write(calibration, obs, screened)
        return calibration

    @_writing
    def write(
        self,
        calibration: Calibration,
        obs: Observations | None,
        screened: Screening | None = None,
        history: pd.DataFrame | None = None,
    ) -> None:
        """Write a calibration with its nominal camera, and with observations and more where there
        are any.

        Whatever the run has written before goes.
        """
        with self._step("calibrate", None, calibration.provenance.get("settings", {})) as files:
            if obs is not None:
                obs = weighed(obs, calibration)
                obs.unweighted.save(files.observations)
            calibration.nominal.save(files.camera)
            calibration.camera.save(files.calibrated)
            calibration.save(files.calibration)
            if screened is not None:
                screened.save_rejected(files.rejected)
            if history is not None:
                write_csv(history, files.path / HISTORY)
        self._forget(*_LOADED)
        if obs is not None:
            self.observations = obs
        self.camera, self.calibration, self.screening = calibration.nominal, calibration, screened

    @_writing
    def keep_images(
        self,
        centroids: Centroids,
        images: ImageCalibration | Identification | None,
        sources: Sequence[PathLike] = (),
        camera: Camera | None = None,
    ) -> None:
        """Keep centroids, matches and the record of every image that the run started from, and
        where these are.

        Where nothing is calibrated, `images` is the identification, if there is one, and the
        `camera` is kept too.
        """
        from starcal_uq.pipeline.images import CENTROIDS, IDENTIFICATION, MATCHED
        from starcal_uq.pipeline.record import IMAGES, record_images
        from starcal_uq.pipeline.refine import ImageCalibration

        with self._step("images", None, {}) as files:
            centroids.save(files.path / CENTROIDS)
            record_images(centroids, images, sources).save(files.path / IMAGES)
            identification = (
                images.identification if isinstance(images, ImageCalibration) else images
            )
            if identification is not None:
                write_csv(identification.to_dataframe(), files.path / IDENTIFICATION)
            if identification is not None and identification.n_identified:
                identification.observations.save(files.path / MATCHED)
            if camera is not None:
                camera.save(files.camera)
        self._forget("images", "frames")

    @_writing
    def sample(
        self, *, force: bool = False, progress: Progress | None = None, **options: Any
    ) -> Posterior:
        """Sample the posterior and write it; an interrupted call goes on from its checkpoint.

        Parameters
        ----------
        force : bool
            Whether to replace the posterior of before.
        progress, **options
            As for `starcal_uq.sample`.
        """
        from starcal_uq.inference.sample import sample

        self._keep("posterior", force)
        obs = self.observations if self._keeps_observations else None
        if options.get("likelihood") is None:
            # A calibration knows which likelihood its estimate maximises.
            options["likelihood"] = self.calibration.provenance.get("settings", {}).get(
                "likelihood", "marginal"
            )
        checkpoint = self.folder.path / CHECKPOINT
        posterior = sample(
            obs, self.calibration, progress=progress, checkpoint=checkpoint, **options
        )
        with self._step(
            "sample", posterior.provenance["seed"], posterior.provenance["settings"]
        ) as files:
            posterior.save(files.posterior)
            posterior.calibrated_camera.save(files.calibrated)
        remove_checkpoints(self.folder.path)
        self._forget("coupling", "attitude", "field_map", "spectrum")
        self.posterior = posterior
        return posterior

    def couple(self, *, force: bool = False) -> Coupling:
        """Write the table of the couplings, which follow from the rest of the run: one that is
        there is left as it is.

        Parameters
        ----------
        force : bool
            Whether to write it again.
        """
        if force or not self.has("coupling"):
            with self._step("coupling", None, {}) as files:
                write_csv(self.coupling.to_dataframe(), files.coupling)
        return self.coupling

    @bounded
    @_writing
    def propagate(
        self,
        *,
        n_draws: int = 300,
        seed: int = 0,
        sky: MissionSky | None = None,
        alignment: str | PathLike = "random",
        alignment_frames: int | None = None,
        force: bool = False,
    ) -> tuple[AttitudeError, FieldMap, ErrorSpectrum | None]:
        """Carry the posterior through QUEST on the observed frames or a mission's, and over the
        field; write all of it.

        Along an attitude profile the spectrum of the frame-dependent part is written as well.

        Parameters
        ----------
        n_draws, seed
            As for `starcal_uq.propagate`.
        sky : MissionSky, optional
            Frames in place of the observed ones.
        alignment : str or path
            Frames on which alignment is calibrated: ``random`` sky, those ``observed`` for this
            run, or a table.
        alignment_frames : int, optional
            Number of frames of the random sky; 100 by default.
        force : bool
            Whether to replace the attitude error of before.
        """
        self._keep("attitude", force)
        posterior = self.posterior
        if not self._keeps_observations and not self.has("observations"):
            raise RunFolderError(
                f"{self.path}: holds no observations, so that there are no frames to propagate "
                "to: calibrate a table "
                "that fits into memory with `starcal-uq calibrate`."
            )
        from starcal_uq.propagation import attitude_error
        from starcal_uq.propagation.alignment import OBSERVED, RANDOM
        from starcal_uq.propagation.field import field_map
        from starcal_uq.propagation.propagate import propagate

        frames = (
            self.observations if sky is None else sky.frames(posterior, self.observations, seed)
        )
        aligning: Observations | str = str(alignment)
        if aligning == OBSERVED:
            aligning = self.observations.with_meta(frames=attitude_error.OBSERVED)
        elif aligning != RANDOM:
            aligning = load_observations(alignment).with_meta(frames=str(alignment))
        error = propagate(
            posterior,
            frames,
            n_draws=n_draws,
            seed=seed,
            alignment=aligning,
            alignment_frames=alignment_frames,
        )
        fields = field_map(posterior, self.observations)
        spectrum = None
        told = [str(message) for message in frames.meta.get("messages", ())]
        if sky is not None and sky.profile is not None:
            from starcal_uq.propagation.spectrum import MIN_SPECTRUM_FRAMES, error_spectrum

            if frames.n_frames >= MIN_SPECTRUM_FRAMES:
                spectrum = error_spectrum(posterior, frames, n_draws=min(n_draws, 100), seed=seed)
            else:
                told.append(
                    f"the profile has {frames.n_frames} frames, too few for a spectrum "
                    f"({MIN_SPECTRUM_FRAMES})."
                )
        error = self._with_misfit(error)
        settings = {
            "n_draws": n_draws,
            "sky": sky,
            "alignment": alignment,
            "alignment_frames": alignment_frames,
        }
        with self._step("propagate", seed, settings) as files:
            # A diagnosis of later is carried to the same frames.
            if sky is not None:
                frames.save(files.mission)
            if error.aligned is not None:
                error.aligned.save(files.alignment)
            error.save(files.attitude)
            fields.save(files.field_map)
            if spectrum is not None:
                spectrum.save(files.spectrum)
        # The file of the attitude error holds less than the result, and a report shows what is in
        # the file.
        self._forget("attitude", "spectrum")
        self.field_map = fields
        if self._tell is not None:
            for message in told:
                self._tell(message)
        return error, fields, spectrum

    @_writing
    def diagnose(self, *, force: bool = False, **options: Any) -> Diagnosis:
        """Question the model; writes ``diagnosis.json``, with the tables as CSV beside it.

        The attitude error is written again with what was found, and a budget that rested on it is
        removed.

        Parameters
        ----------
        force : bool
            Whether to replace the diagnosis of before.
        **options
            Those of `starcal_uq.diagnose`.
        """
        from starcal_uq.diagnostics.diagnose import diagnose

        self._keep("diagnosis", force)

        posterior = self.posterior if self.has("posterior") else None
        diagnosis = diagnose(self.observations, self.calibration, posterior, **options)
        found = None
        if posterior is not None and self.has("attitude"):
            self.diagnosis = diagnosis if diagnosis.is_of(self.calibration) else None
            found = self._with_misfit(self.attitude)
        settings = {
            name: value for name, value in options.items() if name not in ("progress", "apart")
        }
        with self._step("diagnose", settings.pop("seed", None), settings) as files:
            for name, file_name in DIAGNOSIS_TABLES.items():
                part = getattr(diagnosis, name)
                if part is not None:
                    write_csv(part.to_dataframe(), files.path / file_name)
            diagnosis.save(files.diagnosis)
            if found is not None:
                found.save(files.attitude)
        self._forget("diagnosis")
        if found is not None:
            # As the file holds it, without its frames.
            self.attitude = replace(found, seen=None, aligned=None)
        return diagnosis

    def _with_misfit(self, error: AttitudeError) -> AttitudeError:
        """The attitude error with what the diagnosis of this run found, if there is one."""
        diagnosis = self.diagnosis
        if diagnosis is None:
            return error
        from starcal_uq.diagnostics.inflation import with_misfit

        if error.seen is None:
            mission = _frames_of(self.folder.mission) if self.has("mission") else self.observations
            aligned = _frames_of(self.folder.alignment) if self.has("alignment") else None
            error = replace(error, seen=mission, aligned=aligned)
        return with_misfit(error, diagnosis, self.posterior, self.observations)

    @bounded
    @_writing
    def budget(
        self,
        *,
        file: BudgetFile | PathLike | None = None,
        confidence: float | None = None,
        seed: int = 0,
        force: bool = False,
    ) -> Budget:
        """Make the attitude error budget and write it.

        The attitude errors are those of ``attitude.csv``, with the misfit found if the run was
        diagnosed. A report stays, and is older than the budget until it is made again; the verdict
        has the new requirements at once.

        Parameters
        ----------
        file, confidence, seed
            As for `starcal_uq.budget`.
        force : bool
            Whether a budget that was made with another file goes. It is kept as ``budget-1.csv``,
            or the next free number, otherwise.

        Raises
        ------
        RunFolderError
            If a part is missing, or the data are not those of the run.
        BudgetError
            If the file is wrong.
        """
        from starcal_uq.budgeting.budget import budget
        from starcal_uq.budgeting.file import BudgetFile, load_budget_file

        stated = file if isinstance(file, BudgetFile) or file is None else load_budget_file(file)
        posterior, attitude = self.posterior, self.attitude
        made = budget(
            posterior,
            self.observations,
            attitude,
            file=stated,
            confidence=confidence,
            seed=seed,
        )
        with self._step("budget", seed, {"file": file, "confidence": confidence}) as files:
            made.save(files.budget)
            if not force and self.has("budget") and not _of_one_file(made, self.error_budget):
                shutil.copyfile(self.folder.budget, files.path / self._free_name("budget-{}.csv"))
            if self.has("verdict"):
                write_json(replace(self.results, budget=made).verdict.to_dict(), files.verdict)
        self.error_budget = made
        if self.folder.is_older("report") and self._tell is not None:
            self._tell(
                f"report.html is older than the budget; run `starcal-uq report {self.path}` to "
                "make it again."
            )
        return made

    def report(
        self,
        drawn: Callable[[], Mapping[str, bytes]] | None = None,
        *,
        force: bool = False,
        progress: Progress | None = None,
    ) -> Path:
        """Write ``RUN/report.html`` of whatever the run holds, and the figures in ``RUN/figures``.

        A report follows from the rest of the run, and goes when that changes: one that is there is
        left as it is, if no budget was made after it.

        Parameters
        ----------
        drawn : callable, optional
            Figures of these results that are drawn elsewhere, as SVG by name, asked for when all
            else is ready; the others are drawn now.
        force : bool
            Whether to write it again.
        progress : callable, optional
            Called with the figures drawn and all.

        Raises
        ------
        RunFolderError
            If there is no calibration, or a file cannot be read or is not of this run.
        """
        if force or not self.has("report") or self.folder.is_older("report"):
            from starcal_uq.presentation.report.drawing import (
                FIGURES,
                GALLERY,
                draw_figures,
                draw_gallery,
            )
            from starcal_uq.presentation.report.page import prepared

            page = prepared(self.results)
            figures = {} if drawn is None else dict(drawn())
            figures |= draw_figures(
                self.results, [name for name in FIGURES if name not in figures], progress
            )
            if GALLERY not in figures and self.images is not None:
                figures |= draw_gallery(self.shown_frames)
            html = page(figures, figures.pop(GALLERY, b"").decode())
            with self._step("report", None, {}) as files:
                new_folder(files.figures)
                for name, svg in figures.items():
                    atomic_write_bytes(files.figures / f"{name}.svg", svg)
                write_json(self.verdict.to_dict(), files.verdict)
                atomic_write_text(files.report, html)
        return self.path / RunFolder.report

    @_writing
    def pdf(self, *, force: bool = False) -> Path:
        """Write the report as ``RUN/report.pdf``, by a browser that is installed or by WeasyPrint.

        Parameters
        ----------
        force : bool
            Whether to write report and PDF again.

        Raises
        ------
        MissingExtraError
            If nothing is installed that makes a PDF.
        RunFolderError
            If there is no calibration, a file cannot be read, or no PDF came of it.
        """
        page = self.report(force=force)
        if force or not self.has("pdf"):
            from starcal_uq.presentation.pages.printing import pdf_bytes

            content = pdf_bytes(page)
            with self._step("pdf", None, {}) as files:
                atomic_write_bytes(files.pdf, content)
        return self.path / RunFolder.pdf

    def notebook(
        self, to: PathLike | None = None, *, force: bool = False, progress: Progress | None = None
    ) -> Path:
        """Write an executed notebook of whatever the run holds, ``RUN/report.ipynb``, to go on
        from.

        It is of the run as it is now, and goes when that changes, if it is in the folder.

        Parameters
        ----------
        to : path, optional
            Another file.
        force : bool
            Whether to replace a file.
        progress : callable, optional
            Called as ``progress(cells_done, cells_total)``.

        Raises
        ------
        RunFolderError
            If there is no calibration, a file cannot be read or is in the way, or a cell fails.
        MissingExtraError
            If nbformat, nbclient or ipykernel is not installed.
        """
        from starcal_uq.presentation.pages.notebook import executed, write_cells

        place = self.path / RunFolder.notebook if to is None else Path(to)
        ensure_new(place, force or (to is None and self.folder.is_older("notebook")))
        # What is wrong with the run is told here, and not by a cell.
        _ = self.results
        parts = [name for name in FILES if self.has(name)] + ["images"] * (self.images is not None)
        # A folder that moves takes its notebook along.
        folder = "." if to is None else str(self.path.resolve())
        content = executed(write_cells(self.name, parts, folder), place.resolve().parent, progress)
        if to is not None:
            atomic_write_text(place, content)
            return place
        with self._step("notebook", None, {}) as files:
            atomic_write_text(files.notebook, content)
        return place

    @property
    def _keeps_observations(self) -> bool:
        """Whether it has stars: merged runs may have none, streams have none, and sampling can do
        without them.
        """
        record = self.calibration.provenance
        merged = record.get("merge", {}).get("has_observations") is False
        return not merged and not record["settings"].get("stream", False)

    def _free_name(self, name: str) -> str:
        """The first name of numbered ones that no file of the folder has."""
        numbered = (name.format(number) for number in itertools.count(1))
        return next(one for one in numbered if not (self.folder.path / one).exists())

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


# What is loaded when it is first asked for.
_LOADED = tuple(name for name, value in vars(Run).items() if isinstance(value, cached_property))


def _of_one_file(one: Budget, other: Budget) -> bool:
    """Whether the second of two budgets holds no file of the user's that the first does not
    hold.
    """
    first, second = (made.provenance["settings"].get("file", "") for made in (one, other))
    return not second or Path(first).resolve() == Path(second).resolve()


def as_setting(value: object) -> object:
    """A setting as a record holds it."""
    return (
        value
        if value is None or isinstance(value, bool | int | float | str | list | dict)
        else str(value)
    )


def _frames_of(path: Path) -> Observations:
    """Frames that a run keeps for itself; random places of a drawn sky may coincide, which no
    measured table may.
    """
    with reading(
        path, "a table of frames", "run `starcal-uq propagate RUN --force` to write it again"
    ):
        table = read_parquet(path)
        return Observations(
            **{name: arrow_values(table.column(name)) for name in table.column_names}
        )
