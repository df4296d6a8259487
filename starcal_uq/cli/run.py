"""Everything at once: demo and run."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import (
    note,
    progress_bar,
    show_calibration,
    show_screening,
    show_summary,
    tell,
    warn_air,
)
from starcal_uq.cli.images import load_images
from starcal_uq.cli.mission import tell_violations
from starcal_uq.cli.settings import (
    EstimationSettings,
    ImageSettings,
    PropagationSettings,
    SamplingSettings,
    SkySettings,
    command_of,
    refuse_conflicts,
    refuse_others,
    settings_of,
    typed_words,
)
from starcal_uq.cli.steps import load_table, sample_run
from starcal_uq.core.conflicts import conflict, parsed
from starcal_uq.core.errors import CalibrationError, IdentificationError, PriorError
from starcal_uq.core.formatting import plural
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.toml import read_section

if TYPE_CHECKING:
    from starcal_uq.identification.result import Identification
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations
    from starcal_uq.presentation.report.drawing import Ahead
    from starcal_uq.runs.run import Run

# From so many stars on, half of the diagnosis is worth another process.
_APART_STARS = 50_000
# Frames on the page of a run that has failed.
_FAILED_FRAMES = 24


def demo(
    out: Path = Path("starcal-demo"),
    frames: int = 1000,
    seed: int = 2017,
    force: bool = False,
) -> Answer:
    """The experiment of Ye & Yang 2017, end to end, ending in DIR/report.html."""
    from starcal_uq.presentation.report.drawing import Ahead

    run = sc.Run(out, tell=note)
    command = {"command": "demo", "frames": frames, "seed": seed}
    with run.making(command, force=force, words=typed_words(sys.argv[1:])), Ahead() as ahead:
        truth = sc.paper.paper_camera()
        if not run.did("calibrate"):
            tell(
                f"Simulating {frames} frames of the paper's sensor (Gaia G <= 6, 0.05 px noise, "
                f"seed {seed}) ..."
            )
            stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
            obs = sc.simulate(stars, truth, n_frames=frames, min_stars=10, sigma_px=0.05, seed=seed)
            tell("Calibrating from f = 72 mm and the detector's centre ...")
            run.calibrate(obs, sc.paper.paper_start())
        show_calibration(run.calibration, truth)
        _after_calibration(run, ahead, SamplingSettings(seed=seed), PropagationSettings())
    return _conclude(run)


def run_command(
    inputs: list[Path],
    out: Path,
    estimation: EstimationSettings,
    sky: SkySettings,
    images: ImageSettings,
    sampling: SamplingSettings,
    propagation: PropagationSettings,
    budget: Path | None = None,
    force: bool = False,
) -> Answer:
    """Calibrate, sample, couple, propagate, budget and report: all from stars or images to
    RUN/report.html.
    """
    from starcal_uq.pipeline.images import are_images
    from starcal_uq.presentation.report.drawing import Ahead

    run = sc.Run(out, tell=note)
    if budget is not None:
        # A mistake in it should not show after the work.
        sc.budgeting.load_budget_file(budget)
    if (profile := propagation.temperature_profile) is not None:
        sc.propagation.load_temperature_profile(profile)
        _refuse_profile(estimation.effects)
    if sampling.priors is not None:
        read_section(sampling.priors, "priors", PriorError, alone=False)
    *given, last = inputs
    from starcal_uq.observations.files import READ

    table = last.suffix.lower() in READ
    other = bool(given) and last.is_file() and not table and not are_images([last])
    inputs, camera = (given, last) if last.suffix.lower() == ".toml" or other else (inputs, None)
    if not inputs:
        raise typer.BadParameter(f"{last} is a camera: give images or a table of stars before it.")
    folder = len(inputs) == 1 and inputs[0].is_dir() and any(inputs[0].glob("*.parquet"))
    from_images = not folder and are_images(inputs)
    refuse_others(from_images, sky, images)
    if cameras := [path for path in given if path.suffix.lower() == ".toml"]:
        raise typer.BadParameter(f"{cameras[0]} is a camera: give it last.")
    if len(inputs) > 1 and not from_images and not all(path.suffix == ".corr" for path in inputs):
        raise typer.BadParameter(
            f"{inputs[1]} is no image: give one table, .corr files only, or images only."
        )
    if camera is None and not from_images:
        raise typer.BadParameter(
            "a table of stars needs the nominal camera (TOML) after it; only images do without."
        )
    asked = settings_of(estimation, sky, sampling, propagation, partitioned=folder)
    refuse_conflicts(asked)
    if estimation.effects is None:
        selecting = replace(estimation, effects="auto")
        asked = settings_of(selecting, sky, sampling, propagation, partitioned=folder)
        estimation = selecting if conflict(asked) is None else estimation
    settings = {
        "estimation": estimation,
        "sky": sky,
        "images": images,
        "sampling": sampling,
        "propagation": propagation,
        "budget": budget,
    }
    files = {f"input {number}": path for number, path in enumerate(inputs)}
    files |= {} if camera is None else {"camera": camera}
    command = command_of("run", settings, files)
    with run.making(command, force=force, words=typed_words(sys.argv[1:])), Ahead() as ahead:
        if not (run.did("calibrate") and (run.did("images") or not from_images)):
            # Priors may determine what the data leave open.
            undetermined = sampling.priors is not None
            _calibrate(run, inputs, camera, from_images, estimation, undetermined, sky, images)
        show_calibration(run.calibration, run.truth)
        warn_air(run.observations, run.calibration)
        if profile is not None and not _follows_temperature(run):
            note(f"The data ask for no effect of the temperature: {profile} is left out.")
            propagation = replace(propagation, temperature_profile=None)
        _after_calibration(run, ahead, sampling, propagation, budget)
    return _conclude(run)


def _refuse_profile(effects: str | None) -> None:
    """Refuse a temperature profile where the effects that are asked for follow no temperature."""
    if effects is not None and not {"auto", "temperature"} & set(effects.split(",")):
        raise typer.BadParameter(
            f"--temperature-profile needs the effect temperature, which --effects {effects} leaves "
            "out: add it, or leave the profile out."
        )


def _follows_temperature(run: Run) -> bool:
    effects = run.calibration.effects
    return effects is not None and "temperature" in effects.names


def _calibrate(
    run: Run,
    inputs: list[Path],
    camera: Path | None,
    from_images: bool,
    estimation: EstimationSettings,
    undetermined: bool,
    sky: SkySettings,
    images: ImageSettings,
) -> None:
    """From the inputs to a calibration, with a bar."""
    obs: Observations | PartitionedObservations
    seen: list[Any] = []
    try:
        if from_images:
            obs, nominal, centroids, identified = load_images(
                inputs,
                camera,
                images,
                sky,
                estimation.model,
                run.folder.path,
                lambda *known: seen.append(known),
            )
        elif camera is not None:
            obs, nominal = load_table(inputs[0] if len(inputs) == 1 else inputs, camera, sky)
        with progress_bar("passes over the files") as progress:
            nominal = estimation.started(nominal)
            run.calibrate(
                obs, nominal, undetermined=undetermined, progress=progress, **estimation.options()
            )
    except (IdentificationError, CalibrationError) as error:
        # Where no image could be measured there is nothing to be looked at.
        if seen and seen[-1][0].origin.optics:
            page = _keep_failed(run, inputs, camera, *seen[-1])
            error.args = (f"{error} Every frame, with its detections and its reason: {page}",)
        raise
    if from_images:
        run.keep_images(centroids, identified, inputs)
        _tell_other_cameras(run)
        from starcal_uq.core.store import finished

        finished(run.folder.path)
    if run.screening is not None:
        show_screening(run.screening)


# Options that hold for the images of another camera as well.
_OF_ANY_CAMERA = ("--time", "--epoch", "--site", "--directions", "--max-mag", "--in-space")


def _tell_other_cameras(run: Run) -> None:
    """Images of other cameras, and the command that calibrates each of these."""
    frames, (_, options) = run.frames, parsed(typed_words(sys.argv[1:]))
    kept: list[str] = []
    for name in filter(options.__contains__, _OF_ANY_CAMERA):
        kept += [name, *(value for value in options[name] if value is not None)]
    for place, other in enumerate(frames.record.others, 2):
        paths = [str(frames.paths[frame]) for frame in other.frames if frame in frames.paths]
        command = shlex.join(["starcal-uq", "run", *paths, *kept, "-o", f"{run.path}-{place}"])
        images = plural(len(other.frames), "image")
        note(
            f"{images} of another camera ({other.words}) left out; to calibrate that one: {command}"
        )


def _keep_failed(
    run: Run,
    inputs: list[Path],
    camera: Path | None,
    centroids: Centroids,
    identification: Identification | None,
) -> Path:
    """What there is to be looked at of images that could not be calibrated: their table and a page
    of their frames.
    """
    sheet = None if camera is None else sc.Camera.load(camera)
    if sheet is None and identification is not None and identification.optics is not None:
        sheet = identification.nominal
    run.keep_images(centroids, identification, inputs, sheet)
    return run.keep_frames(run.frames.telling(_FAILED_FRAMES), force=True)


@one_thread()
def _after_calibration(
    run: Run,
    ahead: Ahead,
    sampling: SamplingSettings,
    propagation: PropagationSettings,
    budget: Path | None = None,
) -> None:
    """Sample, couple, propagate, question the model, budget, report: what is not done yet."""
    from starcal_uq.diagnostics.diagnose import diagnose_apart
    from starcal_uq.presentation.report.drawing import (
        AFTER_BUDGET,
        AFTER_CALIBRATION,
        AFTER_DIAGNOSIS,
        AFTER_PROPAGATION,
        AFTER_SAMPLING,
    )

    apart = None
    # With fewer stars the other process would take longer to load what it needs than this one takes
    # for all of it.
    many = run.calibration.partitions is None and len(run.observations) >= _APART_STARS
    if many and not run.did("diagnose"):
        apart = ahead.begin(
            partial(diagnose_apart, seed=sampling.seed), run.observations, run.calibration
        )
    tell("Sampling the posterior, couplings, attitude error, then questioning the model ...")
    ahead.draw(run.calibrated, AFTER_CALIBRATION)
    if run.images is not None:
        ahead.draw_frames(run.shown_frames)
    if not run.did("sample"):
        sample_run(run, sampling, force=False)
    ahead.draw(run.results, AFTER_SAMPLING)
    if not run.did("coupling"):
        run.couple()
    if not run.did("propagate"):
        run.propagate(seed=sampling.seed, **vars(propagation))
    ahead.draw(run.results, AFTER_PROPAGATION)
    if not run.did("diagnose"):
        with progress_bar("diagnosis") as progress:
            run.diagnose(seed=sampling.seed, progress=progress, apart=apart)
    ahead.draw(run.results, AFTER_DIAGNOSIS)
    if not run.did("budget"):
        run.budget(file=budget, seed=sampling.seed)
    ahead.draw(run.results, AFTER_BUDGET)
    run.report(ahead.figures)


def _conclude(run: Run) -> Answer:
    """The summary; status 1 when a check or a requirement failed."""
    page = run.report()
    show_summary(run, page)
    results = {
        "run": run.path,
        "report": page,
        "verdict": run.verdict,
        "calibration": (run.calibration, run.truth),
        "screening": run.screening,
        "posterior": run.posterior,
        "coupling": run.coupling,
        "attitude": run.attitude,
        "budget": run.error_budget,
    }
    tell_violations(run.error_budget)
    return Answer(results, run.verdict.level.exit_status)
