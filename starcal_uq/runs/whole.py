"""Everything at once: from stars or images to a run with its verdict, for Python and the command
line.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, Unpack

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.conflicts import asked, refuse_conflicts, with_effects, words_of
from starcal_uq.core.errors import (
    CalibrationError,
    IdentificationError,
    PriorError,
    SettingError,
    StarcalError,
)
from starcal_uq.core.manifest import identity
from starcal_uq.core.remedy import OBS, Remedy, spoken
from starcal_uq.core.settings import (
    Bayer,
    Directions,
    Evaluation,
    LikelihoodName,
    Moves,
    OnboardModel,
    Seed,
    bounded,
    joined_effects,
    seed_of,
)
from starcal_uq.core.store import finished
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.toml import read_section, unknown_key
from starcal_uq.core.types import AnyDict, AnyMapping, PathLike, Progress
from starcal_uq.estimation.settings import EstimationOptions
from starcal_uq.observations.partitions import PartitionedObservations
from starcal_uq.observations.table import Observations
from starcal_uq.runs.priors import read_priors
from starcal_uq.runs.run import Run
from starcal_uq.runs.steps.mission import MissionSky
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    from starcal_uq.budgeting.file import BudgetFile
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.inference.priors import Priors
    from starcal_uq.pipeline.refine import ImageCalibration
    from starcal_uq.presentation.report.drawing import Ahead
    from starcal_uq.propagation.thermal import TemperatureProfile

Stars: TypeAlias = Observations | PartitionedObservations
# Frames on the page of a run that has failed.
_FAILED_FRAMES = 24


class TableOptions(TypedDict, total=False):
    """What belongs to a table of stars alone."""

    columns: Mapping[str, str]
    frames: Sequence[tuple[int, int]] | None
    observer_velocity_km_s: Sequence[float] | None


class ImageOptions(TypedDict, total=False):
    """What belongs to images alone."""

    max_mag: float | None
    epoch: float | None
    focal_tolerance: float
    gain_e_per_count: float | None
    bayer: Bayer | None
    engine: str


class PlaceOptions(TypedDict, total=False):
    """What the directions are, and where and when the camera saw them."""

    directions: Directions | None
    site: Any
    in_space: bool
    time: Any


class SamplingOptions(TypedDict, total=False):
    """Options of `Run.sample`."""

    sigma: Literal["sampled"] | float
    priors: Priors | PathLike | None
    n_ensembles: int
    n_walkers: int
    n_steps: int
    likelihood: LikelihoodName | None
    evaluation: Evaluation
    moves: Moves


class PropagationOptions(TypedDict, total=False):
    """Options of `Run.propagate`."""

    n_draws: int
    sky: MissionSky | None
    alignment: str | PathLike
    alignment_frames: int | None
    onboard: OnboardModel
    temperature_profile: TemperatureProfile | PathLike | None


class RunOptions(
    TableOptions,
    ImageOptions,
    PlaceOptions,
    EstimationOptions,
    SamplingOptions,
    PropagationOptions,
    total=False,
):
    """Settings of `run`, by the names that its steps have for them."""

    start: Mapping[str, float]
    screening: bool
    scheduler: str | None
    workers: int | None
    budget: BudgetFile | PathLike | None


def _of(kind: Any, options: AnyMapping) -> AnyDict:
    """The options that one step takes."""
    return {name: value for name, value in options.items() if name in kind.__annotations__}


def _nothing(*_: Any) -> None:
    """Nobody looks on."""


@dataclass(frozen=True)
class Watch:
    """Who looks on while a run is made: functions that are called meanwhile.

    Attributes
    ----------
    tell : callable
        Gets what a user should know of images, one sentence each.
    bar : callable
        Gets the name of some work; a context that yields what its progress is reported to.
    identified : callable
        Gets the centroids of images, their calibration and the stars.
    read : callable
        Gets the stars and the nominal camera.
    """

    tell: Callable[[str], None] = _nothing
    bar: Callable[[str], AbstractContextManager[Progress | None]] = lambda _: nullcontext()
    identified: Callable[[Centroids, ImageCalibration, Observations], None] = _nothing
    read: Callable[[Stars, Camera], None] = _nothing


def files_of(source: Any) -> list[Path]:
    """The paths that stars or images are read from; none for what is in memory."""
    several = isinstance(source, list | tuple)
    paths = list(source) if several else [source]
    return [Path(one) for one in paths if isinstance(one, str | os.PathLike)]


def read_stars(
    source: Any,
    camera: Camera,
    *,
    frames: Sequence[tuple[int, int]] | None = None,
    time: Any = None,
    site: Any = None,
    **known: Any,
) -> Stars:
    """Stars of a table, several, a folder of partitions, or of what is in memory, with directions
    that are apparent as far as it is known how.
    """
    from starcal_uq.pipeline.tables import observations_from_table, partitions_from_folder

    known |= {"time_utc": time, "site": Site.of(site)}
    files = files_of(source)
    what = files[0] if len(files) == 1 else files or source
    if isinstance(what, PartitionedObservations) or (isinstance(what, Path) and what.is_dir()):
        return partitions_from_folder(what, camera, **known)
    obs = observations_from_table(what, camera, **known)
    return obs if frames is None else obs.in_ranges(frames)


def calibrate_source(
    run: Run,
    source: Any,
    camera: Camera | None,
    options: AnyMapping,
    *,
    started: Callable[[Camera], Camera],
    watch: Watch,
    images: bool = False,
    keep_failed: bool = True,
) -> None:
    """Read stars, or measure and identify those of images, and calibrate.

    `started` makes of the nominal camera the one to start from. With `keep_failed` the frames of
    images that cannot be calibrated are kept, with a page.
    """
    seen: list[tuple[Centroids, Identification | None]] = []
    calibrating = _of(EstimationOptions, options) | {
        name: options[name] for name in ("screening", "scheduler", "workers") if name in options
    }
    # Those of a run are of its draws.
    calibrating.pop("dof", None)
    place = _of(PlaceOptions, options)
    obs: Stars
    try:
        if images:
            from starcal_uq.pipeline.images import observations_from_images

            place |= {"time_utc": place.pop("time", None), "site": Site.of(place.get("site"))}
            with watch.bar("images") as progress:
                obs, centroids, found = observations_from_images(
                    files_of(source),
                    camera,
                    model=options.get("model"),
                    workers=calibrating.pop("workers", 0),
                    tell=watch.tell,
                    seen=lambda *known: seen.append(known),
                    progress=progress,
                    keep=run.folder.path,
                    **place,
                    **_of(ImageOptions, options),
                )
            watch.identified(centroids, found, obs)
            # Of mirrored images x is counted from the right edge, and so is this camera's.
            nominal = found.rounds[0][0].nominal
        else:
            assert camera is not None
            obs = read_stars(source, camera, **place, **_of(TableOptions, options))
            nominal = camera
        watch.read(obs, nominal)
        with watch.bar("passes over the files") as progress:
            # Priors may determine what the data leave open.
            undetermined = options.get("priors") is not None
            nominal = started(nominal)
            run.calibrate(obs, nominal, undetermined=undetermined, progress=progress, **calibrating)
    except (IdentificationError, CalibrationError) as error:
        # Where no image could be measured there is nothing to be looked at.
        if keep_failed and seen and seen[-1][0].origin.optics:
            page = _keep_failed(run, files_of(source), camera, *seen[-1])
            error.args = (f"{error} Every frame, with its detections and its reason: {page}",)
        raise
    if images:
        run.keep_images(centroids, found, files_of(source))
        finished(run.folder.path)


def _keep_failed(
    run: Run,
    inputs: list[Path],
    camera: Camera | None,
    centroids: Centroids,
    identification: Identification | None,
) -> Path:
    """What there is to be looked at of images that could not be calibrated: their table and a page
    of their frames.
    """
    if camera is None and identification is not None and identification.optics is not None:
        camera = identification.nominal
    run.keep_images(centroids, identification, inputs, camera)
    return run.keep_frames(run.frames.telling(_FAILED_FRAMES), force=True)


def sample_run(run: Run, options: AnyMapping, **others: Any) -> Posterior:
    """Sample a run with priors that may stand in a file."""
    priors = options.get("priors")
    if isinstance(priors, str | os.PathLike):
        options = {**options, "priors": read_priors(run, Path(priors))}
    return run.sample(**options, **others)


def load_libraries() -> None:
    """Load what sampling and diagnosis need: for a process that has nothing else to do yet."""
    import starcal_uq.diagnostics.diagnose  # noqa: F401
    from starcal_uq.inference.arviz import rhat
    from starcal_uq.inference.ensemble import make_moves

    make_moves("mixture")
    rhat(np.eye(2, 8))


@one_thread()
def finish(
    run: Run, ahead: Ahead, options: AnyMapping, *, seed: int, watch: Watch, report: bool = True
) -> None:
    """Sample, couple, propagate, question the model, budget, report: what is not done yet."""
    from starcal_uq.diagnostics.diagnose import diagnose_apart, leave_frames_out
    from starcal_uq.presentation.report.drawing import AFTER
    from starcal_uq.runs.steps.posterior import is_quick, sampling_of

    propagation = _of(PropagationOptions, options)
    profile = propagation.get("temperature_profile")
    effects = run.calibration.effects
    if profile is not None and (effects is None or "temperature" not in effects.names):
        run._tell(f"The data support no effect of the temperature: {profile} is left out.")
        del propagation["temperature_profile"]
    drawn, questions = None, AnyDict()
    sampling = _of(SamplingOptions, options) | {"dof": options.get("dof")}
    # The other process draws the frames of images, which takes as long as all this.
    if run.images is None and run.calibration.partitions is None:
        known: AnyDict = {"obs": run.observations, "cal": run.calibration, "seed": seed}
        first, second = partial(diagnose_apart, **known), partial(leave_frames_out, **known)
        if not run.did("sample") and is_quick(run, sampling):
            drawn = ahead.begin(sampling_of(run, seed=seed, **sampling))
        if not run.did("diagnose"):
            questions["apart"] = ahead.begin(first) if drawn is None else cache(first)
            questions["left_out"] = ahead.begin(second)
    watch.tell("Sampling the posterior, couplings, attitude error, then questioning the model ...")
    ahead.draw(run.calibrated, AFTER["calibration"])
    if run.images is not None:
        ahead.draw_frames(run.shown_frames)
    if drawn is not None and questions:
        # While the other process samples; an error comes again where it belongs.
        with suppress(StarcalError):
            questions["apart"]()
    if not run.did("sample"):
        with watch.bar("sampling") as progress:
            sample_run(run, sampling, seed=seed, progress=progress, apart=drawn)
    ahead.draw(run.results, AFTER["sampling"])
    if not run.did("coupling"):
        run.couple()
    if not run.did("propagate"):
        run.propagate(seed=seed, **propagation)
    ahead.draw(run.results, AFTER["propagation"])
    if not run.did("diagnose"):
        with watch.bar("diagnosis") as progress:
            run.diagnose(seed=seed, progress=progress, **questions)
    ahead.draw(run.results, AFTER["diagnosis"])
    if not run.did("budget"):
        run.budget(file=options.get("budget"), seed=seed)
    ahead.draw(run.results, AFTER["budget"])
    if report:
        run.report(ahead.figures)


@bounded
def run(
    source: Any,
    camera: Camera | PathLike | None = None,
    *,
    out: PathLike | None = None,
    seed: Seed = 0,
    force: bool = False,
    tell: Callable[[str], None] | None = None,
    **settings: Unpack[RunOptions],
) -> Run:
    """Calibrate, sample, couple, propagate, diagnose and budget: what the command ``run`` does, with
    the same numbers for the same seed.

    Parameters
    ----------
    source : Observations, PartitionedObservations, table or path
        Identified stars: in memory (for a table, see `Observations.from_table`), in a file, several
        ``.corr`` files, or a folder of partitions; or images, files and folders of them.
    camera : Camera or path, optional
        The nominal camera; only images do without.
    out : path, optional
        Folder of the run, where a report is written too. By default the run is kept in a temporary
        folder, which goes with the `Run`.
    seed : int or Generator
        Seed of everything that is random.
    force : bool
        Whether to replace a run in `out`.
    tell : callable, optional
        Gets what a user should know, one sentence each.

    Returns
    -------
    Run
        Its display is the verdict with the attitude error.

    Raises
    ------
    SettingError
        If a setting is unknown, is out of its limits or does not belong to such a source.
    StarcalError
        If a step fails, as in `Run`.

    Other Parameters
    ----------------
    columns, frames, observer_velocity_km_s
        Of a table: names of columns as in `load_observations`; ranges of frames as in
        `Observations.in_ranges`; velocity of the observer relative to the Earth's centre, km/s,
        ICRS axes.
    max_mag, epoch, focal_tolerance, gain_e_per_count, bayer, engine
        Of images; see `starcal_uq.pipeline.observations_from_images`.
    directions : {"undeclared", "catalogue", "apparent"}, optional
        What the directions are; by default what the table says.
    site : Site, path or astropy EarthLocation, optional
        Where on the ground the camera stood.
    in_space : bool
        Whether the camera was above the air.
    time : str, datetime or astropy Time, optional
        Middle of the exposure of all rows or images without a time, UTC.
    start : mapping, optional
        Values of the nominal camera to start from instead, such as ``{"focal_px": 2500}``.
    screening, scheduler, workers, model, method, effects, ...
        Of `Run.calibrate`. Effects are ``auto`` by default, where nothing excludes them. Of images,
        `workers` are processes that measure them; 0, this one alone, by default.
    sigma, priors, n_ensembles, n_walkers, n_steps, likelihood, evaluation, moves, dof
        Of `Run.sample`; priors may be a file.
    n_draws, sky, alignment, alignment_frames, onboard, temperature_profile
        Of `Run.propagate`.
    budget : BudgetFile or path, optional
        Of `Run.budget`.
    """
    seed = seed_of(seed)
    from starcal_uq.presentation.report.drawing import Ahead

    if hasattr(settings.get("site"), "geodetic"):
        settings["site"] = Site.of(settings["site"])
    files = files_of(source)
    images, partitioned = kind_of(source)
    _check(settings, images, camera)
    given = asked(settings, partitioned)
    if images:
        given.pop("workers", None)
    refuse_conflicts(**given)
    check_files(settings)
    options = with_effects({**settings}, partitioned)
    nominal = Camera.load(camera) if isinstance(camera, str | os.PathLike) else camera
    words = _words(files, camera, {**settings, "seed": seed}) if files else ()
    place = Path(tempfile.mkdtemp(prefix="starcal-"), "run") if out is None else Path(out)
    record = {} if out is None else _record(source, camera, seed, settings)
    made = Run(place, tell=tell)
    if out is None:
        weakref.finalize(made, shutil.rmtree, place.parent, ignore_errors=True)
    watch = Watch(made._tell)
    start = options.pop("start", {})
    with spoken(partial(_as_call, settings)), made.making(record, force=force, words=words):
        if not (made.did("calibrate") and (made.did("images") or not images)):
            calibrate_source(
                made,
                source,
                nominal,
                options,
                started=lambda sheet: sheet.replace(**start),
                watch=watch,
                images=images,
                keep_failed=out is not None,
            )
        # Other processes would start the script of the user once more.
        finish(made, Ahead(), options, seed=seed, watch=watch, report=out is not None)
    return made


def _as_call(settings: AnyMapping, remedy: Remedy) -> str:
    """What to call; of another calibration, this run with what it needs besides."""
    if remedy.action != "calibrate" or OBS not in remedy.files:
        return remedy.command or remedy.call
    needed = remedy.options
    if "effects" in needed:
        needed["effects"] = joined_effects(settings.get("effects"), needed["effects"])
    given = ", ".join(f"{name}={value!r}" for name, value in needed.items())
    return f"sc.run(source, camera, ..., {given})"


def kind_of(source: Any) -> tuple[bool, bool]:
    """Whether a source is images, and whether it is a folder of partitions."""
    from starcal_uq.pipeline.images import are_images

    files = files_of(source)
    folder = len(files) == 1 and files[0].is_dir() and any(files[0].glob("*.parquet"))
    partitioned = folder or isinstance(source, PartitionedObservations)
    return not partitioned and are_images(files), partitioned


def _check(options: AnyMapping, images: bool, camera: Camera | PathLike | None) -> None:
    """Refuse, before anything is done, what would be ignored."""
    known = RunOptions.__annotations__
    others, kind = (TableOptions, "a table") if images else (ImageOptions, "images")
    for name in options:
        if name not in known:
            raise SettingError(unknown_key(name, known, "setting"))
        if name in others.__annotations__:
            raise SettingError(f"setting {name} belongs to {kind}: leave it out.")
    refuse_no_camera(camera, images)


def refuse_no_camera(camera: Camera | PathLike | None, images: bool) -> None:
    """Refuse a table of stars without its camera."""
    if camera is None and not images:
        raise SettingError(
            "a table of stars needs the nominal camera (TOML) after it; only images do without."
        )


def check_files(options: AnyMapping) -> None:
    """Read the files of which a mistake should not show after the work."""
    from starcal_uq.budgeting.file import load_budget_file
    from starcal_uq.propagation.thermal import load_temperature_profile

    for name, read in (
        ("budget", load_budget_file),
        ("temperature_profile", load_temperature_profile),
        ("priors", partial(read_section, name="priors", error=PriorError, alone=False)),
    ):
        if isinstance(path := options.get(name), str | os.PathLike):
            read(path)


def _record(source: Any, camera: Any, seed: int, settings: AnyMapping) -> AnyDict:
    """What tells a call from others: an unfinished run of the same one is completed."""
    inputs = {f"input {number}": path for number, path in enumerate(files_of(source))}
    given = {**inputs, "camera": camera, **settings}
    paths = {name: Path(one) for name, one in given.items() if isinstance(one, str | os.PathLike)}
    told = hashlib.sha256(pickle.dumps((source, camera, seed, settings))).hexdigest()
    return {"command": "run", "settings": told, "inputs": identity(paths)}


# Settings that have another name on the command line.
_TYPED = {"gain_e_per_count": "gain", "observer_velocity_km_s": "observer_velocity"}


def _words(files: list[Path], camera: Any, options: AnyMapping) -> tuple[str, ...]:
    """The command that makes the same run, without the program's name; empty where a setting is no
    file, number or word.
    """
    given = dict(options)
    if "effects" in given:
        given["effects"] = joined_effects(given["effects"])
    if not isinstance(camera, str | os.PathLike | None):
        return ()
    places = [str(path.resolve()) for path in (*files, *([] if camera is None else [Path(camera)]))]
    typed: AnyDict = {}
    for name, value in given.items():
        if isinstance(value, os.PathLike) or (isinstance(value, str) and Path(value).is_file()):
            value = str(Path(value).resolve())
        if name == "columns":
            typed["column"] = tuple(f"{key}={in_file}" for key, in_file in (value or {}).items())
            continue
        if name == "start":
            value = ",".join(f"{key}={float(own)!r}" for key, own in value.items())
        elif name == "frames" and value is not None:
            value = ",".join(f"{first}-{last}" for first, last in value)
        elif name == "observer_velocity_km_s" and value is not None:
            value = ",".join(repr(float(part)) for part in value)
        if not isinstance(value, bool | int | float | str | None):
            return ()
        if value not in (None, False, 0):
            typed[_TYPED.get(name, name.removeprefix("n_"))] = value
    return ("run", *places, *words_of(typed))
