"""The steps of a run, each from files of the run folder to files of the run folder.

The command line is a thin layer over these functions. Outputs that a later step derives (couplings, attitude error,
report) are removed when a step they depend on is done again, so that a folder never mixes two runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.budgeting.budget import budget
from starcal_uq.budgeting.file import BudgetFile, load_budget_file
from starcal_uq.budgeting.result import Budget
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import sigma_parameter
from starcal_uq.core.errors import CalibrationError, ObservationError, RunFolderError
from starcal_uq.core.files import check_new_folder, ensure_new, write_csv
from starcal_uq.core.tasks import Progress
from starcal_uq.diagnostics.diagnose import FILE, TABLES, Diagnosis, diagnose
from starcal_uq.diagnostics.models import MODELS
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.pipeline.images import CENTROIDS, IDENTIFICATION
from starcal_uq.pipeline.record import IMAGES, record_images
from starcal_uq.presentation.report.page import render
from starcal_uq.runs.folder import RunFolder
from starcal_uq.runs.run import load_results
from starcal_uq.sky.site import check_sky

if TYPE_CHECKING:
    from starcal_uq.attitude.profile import Scalar, Sense
    from starcal_uq.diagnostics.verdict.judge import Verdict
    from starcal_uq.estimation.screening.result import Screening
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.inference.priors import Priors
    from starcal_uq.pipeline.refine import ImageCalibration
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling
    from starcal_uq.propagation.field import FieldMap
    from starcal_uq.propagation.spectrum import ErrorSpectrum
    from starcal_uq.sky.site import Site

DIRECTIONS = ("undeclared", "catalogue", "apparent")


REJECTED = "rejected.csv"


DIAGNOSIS_FILES = ("diagnosis.json", "misfit.csv", "jackknife.csv", "comparison.csv", "predictive.csv")


_AFTER_SAMPLING = ("coupling", "attitude", "field_map", "spectrum", "budget", "report")


_AFTER_CALIBRATION = ("posterior", *_AFTER_SAMPLING)


_ALL = ("observations", "camera", "calibration", "arrays", *_AFTER_CALIBRATION)


def read_observations(
    path: Path,
    camera: Camera,
    *,
    columns: Mapping[str, str] | None = None,
    directions: str | None = None,
    observer_velocity_km_s: Sequence[float] | None = None,
    site: Site | None = None,
    in_space: bool = False,
) -> Observations:
    """Read a table and make its directions apparent as far as the user has declared how.

    Parameters
    ----------
    path : Path
        CSV, ECSV or Parquet.
    camera : Camera
        Its detector bounds the pixels.
    columns : mapping, optional
        Names in the file of columns that are called otherwise.
    directions : {"undeclared", "catalogue", "apparent"}, optional
        What the directions in the file are; the file's own metadata by default. With ``catalogue``, or with an observer
        velocity, annual aberration is applied at each row's ``time_utc``.
    observer_velocity_km_s : (3,) sequence, optional
        Velocity relative to the Earth's centre, ICRS axes.
    site : Site, optional
        Where on the ground the camera stood: refraction and daily aberration are applied too, and stars lower than ten
        degrees left out.
    in_space : bool
        Whether the camera was above the air, so that nothing need be said of refraction.

    Raises
    ------
    ObservationError
        For bad rows, or when aberration is asked for without times.
    SiteError
        For a site together with directions that need none.
    """
    obs = load_observations(path, camera=camera, columns=columns)
    if directions is not None:
        obs = obs.with_meta(directions=directions)
    # A table that says nothing of its directions is taken to hold a catalogue's.
    declared = obs.meta.get("directions")
    check_sky(directions if declared == "undeclared" else declared, site, in_space)
    if in_space:
        obs = obs.with_meta(observer="space")
    if obs.meta.get("directions") == "apparent":
        if observer_velocity_km_s is not None:
            raise ObservationError(
                f"{path}: the directions are declared apparent already, so that an observer velocity would be applied "
                "twice: leave out --observer-velocity, or declare --directions catalogue."
            )
        return obs
    if obs.meta.get("directions") == "catalogue" or observer_velocity_km_s is not None or site is not None:
        from starcal_uq.sky.apparent import make_apparent, without_low_stars

        try:
            return make_apparent(
                obs if site is None else without_low_stars(obs, site), observer_velocity_km_s, site=site
            )
        except ObservationError as error:
            raise ObservationError(f"{path}: {error}", row=error.row, column=error.column) from error
    return obs


def _remove(run: RunFolder, names: Sequence[str]) -> None:
    for name in names:
        path: Path = getattr(run, name)
        path.unlink(missing_ok=True)
    if "calibration" in names:
        for name in (REJECTED, *DIAGNOSIS_FILES):
            (run.path / name).unlink(missing_ok=True)


def calibrate_step(
    run: RunFolder,
    obs: Observations,
    nominal: Camera,
    *,
    force: bool,
    screening: bool = False,
    **options: Any,
) -> tuple[Calibration, Screening | None]:
    """Calibrate and write observations, camera and calibration; nothing is written when the estimate fails.

    With `screening`, wrong identifications are left out first; the run then holds the kept rows, and
    ``rejected.csv`` the others with their reasons. `options` go to `calibrate`.
    """
    found: Screening | None = None
    if screening:
        from starcal_uq.estimation.screening.screening import screen

        found = screen(obs, nominal, **options)
        obs, calibration = found.observations, found.calibration
    else:
        from starcal_uq.estimation.calibrate import calibrate

        calibration = calibrate(obs, nominal, **options)
    check_new_folder(run.path, force)
    _remove(run, _ALL)
    run.create()
    obs.save(run.observations, force=True)
    nominal.save(run.camera, force=True)
    calibration.save(run.calibration)
    if found is not None:
        found.save_rejected(run.path / REJECTED, force=True)
    return calibration, found


def load_run(run: RunFolder) -> tuple[Observations, Calibration]:
    """Observations and calibration of a run.

    Raises
    ------
    CalibrationError
        When the two files do not belong together.
    """
    calibration = Calibration.load(run.require("calibration"))
    obs = load_observations(run.require("observations"))
    if obs.data_hash != calibration.provenance["data_sha256"]:
        raise CalibrationError(
            f"{run.path}: the calibration was made from other observations than {run.observations.name} holds: "
            "run `starcal-uq calibrate` again."
        )
    return obs, calibration


def sample_step(run: RunFolder, *, force: bool, progress: Progress | None = None, **options: Any) -> Posterior:
    """Sample the posterior of a calibrated run and write it; an interrupted run goes on from its checkpoint."""
    calibration = Calibration.load(run.require("calibration"))
    obs = load_run(run)[0] if _has_observations(calibration) else None
    ensure_new(run.posterior, force)
    from starcal_uq.inference.sample import sample

    if options.get("likelihood") is None:
        # A calibration knows which likelihood its estimate maximises.
        options["likelihood"] = calibration.provenance.get("settings", {}).get("likelihood", "marginal")
    checkpoint = run.path / "sampling.checkpoint.npz"
    posterior = sample(obs, calibration, progress=progress, checkpoint=checkpoint, **options)
    posterior.save(run.posterior, force=True)
    checkpoint.unlink(missing_ok=True)
    _remove(run, _AFTER_SAMPLING)
    return posterior


def _has_observations(calibration: Calibration) -> bool:
    """Merged runs may have no stars of their own, streams have none; sampling needs only the compressed likelihood."""
    record = calibration.provenance
    return record.get("merge", {}).get("has_observations") is not False and not record["settings"].get("stream", False)


def load_posterior(run: RunFolder) -> Posterior:
    """Posterior of a sampled run."""
    from starcal_uq.inference.posterior import Posterior

    return Posterior.load(run.require("posterior"))


def coupling_step(run: RunFolder) -> Coupling:
    """Analyse the couplings of the posterior, or of the calibration where there is no posterior yet."""
    from starcal_uq.propagation.coupling import coupling

    found = coupling(best_calibration(run))
    write_csv(found.to_dataframe(), run.coupling)
    return found


def read_priors(run: RunFolder, path: Path) -> Priors:
    """Priors of a TOML file for a run: physical terms, or the posterior of an earlier run."""
    from starcal_uq.core.provenance import data_hashes
    from starcal_uq.runs.priors import load_priors

    calibration = Calibration.load(run.require("calibration"))
    per_star = calibration.sigma_name == sigma_parameter(True).name
    return load_priors(path, calibration.nominal, per_star, data_hashes(calibration.provenance))


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
        Frames with fewer stars give no attitude; 5 at random attitudes and 3 along a profile by default.
    rate_hz : float or None
        Frames per second along the profile; its own instants where it is None.
    scalar, sense
        Of the profile's quaternions, as for `starcal_uq.attitude.load_attitude_profile`.
    """

    profile: Path | None = None
    max_mag: float = 6.0
    epoch: float = 2026.9
    n_frames: int = 1000
    min_stars: int | None = None
    rate_hz: float | None = None
    scalar: Scalar | None = None
    sense: Sense = "icrs_to_camera"

    def frames(self, posterior: Posterior, obs: Observations, seed: int) -> Observations:
        """Noise-free frames, with the noise of the observed ones by magnitude where it is stated."""
        from starcal_uq.attitude.profile import load_attitude_profile
        from starcal_uq.simulation.mission import mission_frames, profile_frames
        from starcal_uq.sky.catalogue import load_catalogue

        stars = load_catalogue(max_mag=self.max_mag, epoch=self.epoch)
        camera = posterior.camera.with_theta(posterior.mean)
        like = obs if posterior.sigma_name == sigma_parameter(True).name else None
        if self.profile is None:
            return mission_frames(
                stars, camera, n_frames=self.n_frames, min_stars=self.min_stars or 5, seed=seed, noise_like=like
            )
        profile = load_attitude_profile(self.profile, scalar=self.scalar, sense=self.sense)
        frames = profile_frames(stars, camera, profile, self.rate_hz, min_stars=self.min_stars or 3, noise_like=like)
        return frames.with_meta(messages=[*profile.messages])


def propagate_step(
    run: RunFolder,
    *,
    n_draws: int,
    seed: int,
    sky: MissionSky | None = None,
    tell: Callable[[str], None] | None = None,
) -> tuple[AttitudeError, FieldMap, ErrorSpectrum | None]:
    """Carry the posterior through QUEST on the observed frames or a mission's, and over the field; write all of it.

    Along an attitude profile the spectrum of the frame-dependent part is written as well. `tell` gets what a user
    should know, one sentence each.
    """
    posterior = load_posterior(run)
    if not _has_observations(Calibration.load(run.require("calibration"))) and not run.observations.exists():
        raise RunFolderError(
            f"{run.path}: holds no observations, so that there are no frames to propagate to: calibrate a table that "
            "fits into memory with `starcal-uq calibrate`."
        )
    obs, _ = load_run(run)
    from starcal_uq.propagation.field import field_map
    from starcal_uq.propagation.propagate import propagate

    frames = obs if sky is None else sky.frames(posterior, obs, seed)
    error = propagate(posterior, frames, n_draws=n_draws, seed=seed)
    fields = field_map(posterior, obs)
    spectrum = None
    told = [str(message) for message in frames.meta.get("messages", ())]
    if sky is not None and sky.profile is not None:
        from starcal_uq.propagation.spectrum import MIN_SPECTRUM_FRAMES, error_spectrum

        if frames.n_frames >= MIN_SPECTRUM_FRAMES:
            spectrum = error_spectrum(posterior, frames, n_draws=min(n_draws, 100), seed=seed)
        else:
            told.append(f"the profile has {frames.n_frames} frames, too few for a spectrum ({MIN_SPECTRUM_FRAMES}).")
    if run.budget.exists():
        told.append(f"the budget rested on the numbers of before and was removed: run `starcal-uq budget {run.path}`.")
    # What rests on the attitude error of before goes with it.
    _remove(run, ("spectrum", "budget"))
    error.save(run.attitude)
    fields.save(run.field_map)
    if spectrum is not None:
        spectrum.save(run.spectrum)
    if tell is not None:
        for message in told:
            tell(message)
    return error, fields, spectrum


def report_step(run: RunFolder) -> Path:
    """Write the report of whatever the run holds; the truth of a simulation is shown beside the estimate."""

    return report(run.path)


def verdict_step(run: RunFolder) -> Verdict:
    """The verdict on whatever the run holds, as the report states it."""
    from starcal_uq.diagnostics.verdict.judge import judge
    from starcal_uq.runs.run import load_results

    found = load_results(run)
    return judge(
        found.observations,
        found.calibration,
        found.posterior,
        found.truth,
        found.attitude,
        diagnosis=found.diagnosis,
    )


def truth_of(obs: Observations) -> Camera | None:
    """The camera that observations were simulated with, if they were."""
    truth = obs.meta.get("truth")
    return None if truth is None else Camera.from_dict(truth)


def best_calibration(run: RunFolder) -> Calibration | Posterior:
    """What a run knows of the camera: its posterior, or its calibration where there is no posterior yet."""
    return load_posterior(run) if run.posterior.exists() else Calibration.load(run.require("calibration"))


def report(run_path: str | os.PathLike[str], truth: Camera | None = None) -> Path:
    """Write ``RUN/report.html`` and the figures in ``RUN/figures``.

    Parameters
    ----------
    run_path : path
        Folder of a run that holds a calibration at least. What is missing beyond that is named in the report together
        with the command that makes it.
    truth : Camera, optional
        The camera of a simulation, shown beside the estimate. Observations made by `starcal_uq.simulate` carry it, and
        it is then taken from them.

    Returns
    -------
    Path
        The report. It needs no network, no script and no other file.

    Raises
    ------
    RunFolderError
        If there is no calibration, a file cannot be read, or files of different runs are mixed.
    """
    from starcal_uq.core.files import atomic_write_bytes, atomic_write_text
    from starcal_uq.presentation.report.page import draw_figures
    from starcal_uq.runs.folder import RunFolder

    run = RunFolder(run_path)
    results = load_results(run, truth)
    figures = draw_figures(results)
    page = render(results, figures)
    run.figures.mkdir(exist_ok=True)
    for name, png in figures.items():
        atomic_write_bytes(run.figures / f"{name}.png", png)
    atomic_write_text(run.report, page)
    return run.report


def diagnose_run(
    run_path: str | os.PathLike[str],
    *,
    models: Sequence[str] = MODELS,
    n_starts: int = 5,
    seed: int = 0,
    progress: Progress | None = None,
) -> Diagnosis:
    """Diagnose a run and write ``diagnosis.json`` into its folder, with the tables as CSV beside it.

    Parameters
    ----------
    run_path : path
        Folder of a run that holds a calibration at least.
    models, n_starts, seed, progress
        As for `diagnose`.

    Raises
    ------
    RunFolderError
        If there is no calibration, or its data are not those of the run.
    """
    run = RunFolder(run_path)
    cal = Calibration.load(run.require("calibration"))
    obs = load_observations(run.require("observations"))
    if obs.data_hash != cal.provenance.get("data_sha256"):
        raise RunFolderError(
            f"{run.path}: the calibration was made from other observations than {run.observations.name} holds; run "
            "`starcal-uq calibrate` again."
        )
    post = None
    if run.posterior.exists():
        from starcal_uq.inference.posterior import Posterior

        post = Posterior.load(run.posterior)
    found = diagnose(obs, cal, post, models=models, n_starts=n_starts, seed=seed, progress=progress)
    for name, file_name in TABLES.items():
        part = getattr(found, name)
        if part is not None:
            write_csv(part.to_dataframe(), run.path / file_name)
    found.save(run.path / FILE)
    return found


def load_diagnosis(run: RunFolder, cal: Calibration) -> Diagnosis | None:
    """The stored diagnosis of a calibration; None if there is none, or it is of another calibration.

    Raises
    ------
    RunFolderError
        If the file cannot be read.
    """
    path = run.path / FILE
    if not path.exists():
        return None
    found = Diagnosis.load(path)
    return found if found.is_of(cal) else None


def budget_run(
    run_path: str | os.PathLike[str],
    *,
    file: BudgetFile | str | os.PathLike[str] | None = None,
    confidence: float | None = None,
    seed: int = 0,
) -> Budget:
    """The budget of a run folder, written to its ``budget.csv``.

    The attitude errors are those of ``attitude.csv``, and the tests of the model those of ``diagnosis.json`` if the run
    was diagnosed.

    Parameters
    ----------
    run_path : path
        Folder of a run that holds a posterior and its attitude errors.
    file, confidence, seed
        As for `budget`.

    Raises
    ------
    RunFolderError
        If a part is missing, or the data are not those of the run.
    BudgetError
        If the file is wrong.
    """
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import load_observations
    from starcal_uq.propagation.attitude_error import AttitudeError

    run = RunFolder(run_path)
    stated = file if isinstance(file, BudgetFile) or file is None else load_budget_file(file)
    cal = Calibration.load(run.require("calibration"))
    post = Posterior.load(run.require("posterior"))
    attitude = AttitudeError.load(run.require("attitude"))
    obs = load_observations(run.require("observations"))
    if obs.data_hash != cal.provenance.get("data_sha256"):
        raise RunFolderError(
            f"{run.path}: the calibration was made from other observations than {run.observations.name} holds; run "
            "`starcal-uq calibrate` again."
        )
    found = budget(post, obs, attitude, file=stated, confidence=confidence, misfit=load_diagnosis(run, cal), seed=seed)
    found.save(run.budget)
    return found


def save_image_results(run: RunFolder, centroids: Centroids, found: ImageCalibration) -> None:
    """Keep the centroids and the record of every frame in the run folder."""
    centroids.save(run.path / CENTROIDS, force=True)
    record_images(centroids, found).save(run.path / IMAGES)
    write_csv(found.identification.to_dataframe(), run.path / IDENTIFICATION)
