"""The steps of a run, one command each: simulate, calibrate, sample, coupling, propagate, report,
export.
"""

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
    say,
    show_attitude,
    show_calibration,
    show_coupling,
    show_posterior,
    show_screening,
    show_summary,
    warn_air,
    warn_undeclared,
    working,
)
from starcal_uq.cli.settings import (
    EstimationSettings,
    MissionSettings,
    PartitionSettings,
    PropagationSettings,
    SamplingSettings,
    SimulationSettings,
    SkySettings,
    TrackerSettings,
    refuse_conflicts,
    typed_words,
)
from starcal_uq.core import settings
from starcal_uq.core.conflicts import asked
from starcal_uq.core.files import check_new_folder, ensure_new, table_ending
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations


def load_table(
    path: Path, camera_path: Path, sky: SkySettings
) -> tuple[Observations | PartitionedObservations, Camera]:
    """Observations of a table, or a folder of them, with the nominal camera; and what is worth
    telling.
    """
    from starcal_uq.runs.whole import read_stars

    camera = sc.Camera.load(camera_path)
    obs = read_stars(path, camera, **sky.options())
    warn_undeclared(obs, camera)
    return obs, camera


def simulate_command(
    camera: Path,
    out: Path,
    simulation: SimulationSettings,
    tracker: TrackerSettings,
    partitions: PartitionSettings,
    max_mag: float = 6.0,
    epoch: float = 2026.9,
    images: Path | None = None,
    force: bool = False,
) -> Answer:
    """Simulate identified stars with the embedded catalogue; directions are written as the sensor
    saw them.
    """
    if partitions.partition_frames is None:
        if not (partitions.scheduler is None and partitions.workers is None):
            raise typer.BadParameter(
                "--scheduler and --workers make a folder: give --partition-frames as well."
            )
        table_ending(out)
        ensure_new(out, force)
    elif images is not None:
        raise typer.BadParameter("--images belongs to one table: leave out --partition-frames.")
    stars, truth = sc.load_catalogue(max_mag=max_mag, epoch=epoch), sc.Camera.load(camera)
    wanted: AnyDict = vars(simulation) | tracker.options(truth, simulation.sigma_px)
    paths: list[Path] = []
    if partitions.partition_frames is not None:
        with progress_bar("files") as progress:
            made = sc.simulation.simulate_partitions(
                stars, truth, out, **wanted, **vars(partitions), force=force, progress=progress
            )
        sizes = {
            "n_stars": made.n_stars,
            "n_frames": simulation.n_frames,
            "n_files": len(made.parts),
        }
        say(f"{made.n_stars} stars in {simulation.n_frames} frames, {len(made.parts)} files: {out}")
    else:
        obs = sc.simulate(stars, truth, **wanted)
        if images is not None:
            sensor = tracker.sensor
            detector = None if sensor is None else sc.simulation.Sensor.load(sensor)
            with progress_bar("images") as progress:
                paths = sc.simulation.render_frames(
                    *(stars, truth, images),
                    **wanted,
                    sensor=detector,
                    force=force,
                    progress=progress,
                )
            say(f"{len(paths)} images: {images}")
        obs.save(out, force=force)
        sizes = {"n_stars": obs.n_stars, "n_frames": obs.n_frames, "n_files": 1}
        say(f"{obs.n_stars} stars in {obs.n_frames} frames: {out}")
    if out.suffix.lower() == ".csv":
        say(
            "CSV holds no metadata: say --directions apparent when you calibrate it (.ecsv and "
            ".parquet know)."
        )
    return Answer({"table": out, **sizes, "images": images, "n_images": len(paths)})


def calibrate_command(
    observations: Path,
    camera: Path,
    out: Path,
    estimation: EstimationSettings,
    sky: SkySettings,
    force: bool = False,
) -> Answer:
    """Estimate optics and distortion: three stages and refinement, with covariance."""
    run = sc.Run(out, tell=note)
    refuse_conflicts(asked({**estimation.options(), **vars(sky)}, observations.is_dir()))
    check_new_folder(out, force)
    obs, nominal = load_table(observations, camera, sky)
    nominal = estimation.started(nominal)
    words = typed_words(sys.argv[1:])
    with progress_bar("passes over the files") as progress:
        calibration = run.calibrate(
            obs, nominal, force=force, words=words, progress=progress, **estimation.options()
        )
    if run.screening is not None:
        show_screening(run.screening)
    warn_air(obs, calibration)
    show_calibration(calibration, run.truth)
    everything = shlex.join(["starcal-uq", "run", *words[1:], "-o", f"{out}-2"])
    say(
        "No verdict has been made: an optimum was found, and nothing has asked whether the model "
        "holds. What asks: "
        f"{everything}"
    )
    say(
        f"Run folder: {out}. Step by step: starcal-uq sample {out}, then propagate, diagnose and "
        "report."
    )
    return Answer({"run": out, "calibration": (calibration, run.truth), "screening": run.screening})


def sample_command(run: Path, sampling: SamplingSettings, force: bool = False) -> Answer:
    """Sample the posterior with emcee from the calibration; an interrupted command resumes where it
    stopped.
    """
    from starcal_uq.runs.whole import sample_run

    with working("sampling") as progress:
        posterior = sample_run(
            sc.Run(run, tell=note),
            sampling.options(),
            seed=sampling.seed,
            force=force,
            progress=progress,
        )
    show_posterior(posterior)
    return Answer({"run": run, "posterior": posterior}, posterior.diagnostics.level.exit_status)


def coupling_command(run: Path, force: bool = False) -> Answer:
    """Correlations, variance inflation, weak directions and the principal point's near-gauge with
    the boresight.
    """
    coupling = sc.Run(run, tell=note).couple(force=force)
    show_coupling(coupling)
    return Answer({"run": run, "coupling": coupling})


def propagate_command(
    run: Path,
    mission: MissionSettings,
    propagation: PropagationSettings,
    attitudes: str = "observed",
    seed: int = 0,
    force: bool = False,
) -> Answer:
    """Attitude error that the calibration contributes, through QUEST: common rotation, the rest,
    and centroid noise.
    """
    sky = None
    if attitudes != "observed":
        profile = None if attitudes == "random" else Path(attitudes)
        sky = sc.runs.MissionSky(profile, **vars(mission))
    elif mission.rate_hz is not None or mission.scalar is not None:
        raise typer.BadParameter(
            "--rate and --scalar belong to an attitude profile: give --attitudes FILE."
        )
    error, _, spectrum = sc.Run(run, tell=note).propagate(
        sky=sky, **vars(propagation), seed=seed, force=force
    )
    show_attitude(error)
    say(error.text)
    words = None if spectrum is None else spectrum.text
    if words is not None:
        say(words)
    return Answer({"run": run, "attitude": error, "spectrum": words})


def report_command(
    run: Path,
    notebook: bool = False,
    out: Path | None = None,
    format: settings.ReportFormat = "html",
    force: bool = False,
) -> Answer:
    """Write RUN/report.html, one self-contained file, from whatever the run holds; as PDF too, or a
    notebook.

    Status 1 when a check failed or a requirement is violated.
    """
    held = sc.Run(run, tell=note)
    if out is not None and not notebook:
        raise typer.BadParameter(
            "--out names a notebook: add --notebook; the report has its place in RUN."
        )
    if notebook and format != "html":
        raise typer.BadParameter("--format is of the report: leave it or --notebook out.")
    if notebook:
        with progress_bar("notebook") as bar:
            page = held.notebook(out, force=force, progress=bar)
        say(f"Notebook: {page.resolve()}")
    else:
        with progress_bar("figures") as bar:
            page = (
                held.pdf(force=force) if format == "pdf" else held.report(force=force, progress=bar)
            )
        show_summary(held, page)
    return Answer({"run": run, "report": page}, held.verdict.level.exit_status)


def export_command(
    source: Path,
    to: settings.ExportFormat,
    out: Path | None = None,
    instrument: int | None = None,
    force: bool = False,
) -> Answer:
    """Write the calibrated camera, or what is known of it, for another program; say how near that
    comes.
    """
    with progress_bar("log likelihood") as progress:
        made = sc.export(source, to, out, instrument=instrument, force=force, progress=progress)
    say(made.note)
    say(f"File: {made.path}")
    return Answer({"file": made.path, "to": to, "error_px": made.error_px, "text": made.note})
