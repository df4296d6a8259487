"""Everything at once: demo and run."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

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
from starcal_uq.cli.images import watching
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
    typed_words,
)
from starcal_uq.core.conflicts import asked, parsed, with_effects
from starcal_uq.core.formatting import plural
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.runs.run import Run


def demo_command(
    out: Path = Path("starcal-demo"),
    frames: int = 1000,
    seed: int = 2017,
    force: bool = False,
) -> Answer:
    """The experiment of Ye & Yang 2017, end to end, ending in DIR/report.html."""
    from starcal_uq.presentation.report.drawing import Ahead
    from starcal_uq.runs.whole import finish, load_libraries

    run = sc.Run(out, tell=note)
    command = {"command": "demo", "frames": frames, "seed": seed}
    with run.making(command, force=force, words=typed_words(sys.argv[1:])), Ahead() as ahead:
        ahead.begin(load_libraries)
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
        finish(run, ahead, {}, seed=seed, watch=watching())
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
    # Loading what calibrates takes longer than a user should see nothing.
    with progress_bar("loading"):
        from starcal_uq.pipeline.images import are_images
        from starcal_uq.presentation.report.drawing import Ahead
        from starcal_uq.runs.whole import (
            calibrate_source,
            check_files,
            finish,
            kind_of,
            load_libraries,
            refuse_no_camera,
        )

    run = sc.Run(out, tell=note)
    typed: AnyDict = {"budget": budget}
    for record in (estimation, sky, images, sampling, propagation):
        typed |= vars(record)
    check_files(typed)
    *given, last = inputs
    from starcal_uq.observations.files import READ

    table = last.suffix.lower() in READ
    other = bool(given) and last.is_file() and not table and not are_images([last])
    inputs, camera = (given, last) if last.suffix.lower() == ".toml" or other else (inputs, None)
    if not inputs:
        raise typer.BadParameter(f"{last} is a camera: give images or a table of stars before it.")
    from_images, folder = kind_of(inputs)
    refuse_others(from_images, sky, images)
    if cameras := [path for path in given if path.suffix.lower() == ".toml"]:
        raise typer.BadParameter(f"{cameras[0]} is a camera: give it last.")
    if len(inputs) > 1 and not from_images and not all(path.suffix == ".corr" for path in inputs):
        raise typer.BadParameter(
            f"{inputs[1]} is no image: give one table, .corr files only, or images only."
        )
    refuse_no_camera(camera, from_images)
    refuse_conflicts(asked({**typed, **estimation.options()}, folder))
    options = {
        **estimation.options(),
        **sky.options(),
        **images.options(),
        **sampling.options(),
        **vars(propagation),
        "budget": budget,
    }
    options = with_effects(options, folder)
    files = {f"input {number}": path for number, path in enumerate(inputs)}
    files |= {} if camera is None else {"camera": camera}
    command = command_of("run", typed, files)
    if from_images:
        # As many processes as there are processors.
        options["workers"] = None
    watch = watching(images.epoch)
    with run.making(command, force=force, words=typed_words(sys.argv[1:])), Ahead() as ahead:
        if not from_images:
            ahead.begin(load_libraries)
        if not (run.did("calibrate") and (run.did("images") or not from_images)):
            calibrate_source(
                run,
                inputs,
                None if camera is None else sc.Camera.load(camera),
                options,
                started=estimation.started,
                watch=watch,
                images=from_images,
            )
            if from_images:
                _tell_other_cameras(run)
            if run.screening is not None:
                show_screening(run.screening)
        show_calibration(run.calibration, run.truth)
        warn_air(run.observations, run.calibration)
        finish(run, ahead, options, seed=sampling.seed, watch=watch)
    return _conclude(run)


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
