"""The steps of a run, one command each: simulate, calibrate, sample, coupling, propagate, report,
export.
"""

from __future__ import annotations

import shlex
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    tell,
    warn_air,
    warn_undeclared,
)
from starcal_uq.cli.options import (
    Alignment,
    AlignmentFrames,
    CameraFile,
    Draws,
    Epoch,
    FileWorkers,
    Force,
    MaxMag,
    NewRun,
    ObsFile,
    RunPath,
    SchedulerAddress,
    Seed,
    check_word_or_file,
    checked,
    number,
    parse_columns,
    parse_frames,
    parse_velocity,
    read_file,
    read_path,
    write_file,
    write_path,
)
from starcal_uq.cli.settings import (
    EstimationSettings,
    SamplingSettings,
    SkySettings,
    refuse_conflicts,
    settings_of,
    typed_words,
)
from starcal_uq.core import settings
from starcal_uq.core.files import check_new_folder, ensure_new, table_ending
from starcal_uq.core.settings import EPOCH, MAGNITUDES

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations
    from starcal_uq.runs.run import Run


def load_table(
    path: Path | list[Path], camera_path: Path, sky: SkySettings
) -> tuple[Observations | PartitionedObservations, Camera]:
    """Observations of a table, several, or a folder of them, with the nominal camera; and what is
    worth telling.
    """
    from starcal_uq.pipeline.tables import observations_from_table, partitions_from_folder

    known, camera = sky.options(), sc.Camera.load(camera_path)
    known |= {
        "columns": parse_columns(sky.column),
        "observer_velocity_km_s": parse_velocity(sky.observer_velocity),
        "time_utc": sky.time,
    }
    obs: Observations | PartitionedObservations
    chosen = parse_frames(sky.frames)
    if isinstance(path, Path) and path.is_dir():
        obs = partitions_from_folder(path, camera, **known)
    else:
        obs = observations_from_table(path, camera, **known)
        if chosen is not None:
            obs = obs.in_ranges(chosen)
    warn_undeclared(obs, camera)
    return obs, camera


def simulate_command(
    camera: CameraFile,
    out: Annotated[
        Path,
        typer.Option(
            "-o",
            "--out",
            metavar="OBS",
            help="Table to write (.csv, .ecsv, .parquet, .fits), or folder of partitions.",
            parser=write_path,
        ),
    ],
    frames: Annotated[int, number("n_frames", "Number of frames, at random attitudes.")] = 1000,
    sigma: Annotated[float, number("sigma_px", "Centroid noise, px per axis.")] = 0.05,
    max_mag: MaxMag = 6.0,
    min_stars: Annotated[
        int, number("min_stars", "Attitudes with fewer stars are drawn again.", least=3)
    ] = 10,
    epoch: Epoch = 2026.9,
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Also render the frames as FITS images into this folder.",
            parser=write_path,
        ),
    ] = None,
    sensor: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Detector of the images (TOML with a [sensor] table); a small tracker's by default."
            ),
            parser=read_file,
        ),
    ] = None,
    partition_frames: Annotated[
        int | None,
        number(
            "partition_frames",
            "Write OBS as a folder of Parquet files of N frames each (10000 is a good size), "
            "which may exceed "
            "memory; an interrupted command goes on.",
            metavar="N",
        ),
    ] = None,
    scheduler: SchedulerAddress = None,
    workers: FileWorkers = None,
    seed: Seed = 0,
    force: Force = False,
) -> Answer:
    """Simulate identified stars with the embedded catalogue; directions are written as the sensor
    saw them.
    """
    if partition_frames is None:
        if not (scheduler is None and workers is None):
            raise typer.BadParameter(
                "--scheduler and --workers make a folder: give --partition-frames as well."
            )
        table_ending(out)
        ensure_new(out, force)
    elif images is not None:
        raise typer.BadParameter("--images belongs to one table: leave out --partition-frames.")
    if sensor is not None and images is None:
        raise typer.BadParameter(
            "--sensor describes the detector of images: give --images DIR as well."
        )
    stars, truth = sc.load_catalogue(max_mag=max_mag, epoch=epoch), sc.Camera.load(camera)
    if partition_frames is not None:
        with progress_bar("files") as progress:
            made = sc.simulation.simulate_partitions(
                stars,
                truth,
                out,
                n_frames=frames,
                partition_frames=partition_frames,
                min_stars=min_stars,
                sigma_px=sigma,
                seed=seed,
                force=force,
                scheduler=scheduler,
                workers=workers,
                progress=progress,
            )
        say(f"{made.n_stars} stars in {frames} frames, {len(made.parts)} files: {out}")
        sizes = {"n_stars": made.n_stars, "n_frames": frames, "n_files": len(made.parts)}
        return Answer({"table": out, **sizes, "images": None, "n_images": 0})
    obs = sc.simulate(stars, truth, n_frames=frames, min_stars=min_stars, sigma_px=sigma, seed=seed)
    paths: list[Path] = []
    if images is not None:
        with progress_bar("images") as progress:
            paths = sc.simulation.render_frames(
                stars,
                truth,
                images,
                n_frames=frames,
                min_stars=min_stars,
                sensor=sc.simulation.Sensor()
                if sensor is None
                else sc.simulation.Sensor.load(sensor),
                seed=seed,
                sigma_px=sigma,
                force=force,
                progress=progress,
            )
        say(f"{len(paths)} images: {images}")
    obs.save(out, force=force)
    say(f"{obs.n_stars} stars in {obs.n_frames} frames: {out}")
    if out.suffix.lower() == ".csv":
        say(
            "CSV holds no metadata: say --directions apparent when you calibrate it (.ecsv and "
            ".parquet know)."
        )
    sizes = {"n_stars": obs.n_stars, "n_frames": obs.n_frames, "n_files": 1}
    return Answer({"table": out, **sizes, "images": images, "n_images": len(paths)})


def calibrate_command(
    observations: ObsFile,
    camera: CameraFile,
    out: NewRun,
    estimation: EstimationSettings,
    sky: SkySettings,
    force: Force = False,
) -> Answer:
    """Estimate optics and distortion: three stages and refinement, with covariance."""
    run = sc.Run(out, tell=note)
    refuse_conflicts(settings_of(estimation, sky, partitioned=observations.is_dir()))
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


def sample_command(run: RunPath, sampling: SamplingSettings, force: Force = False) -> Answer:
    """Sample the posterior with emcee from the calibration; an interrupted command goes on where it
    stopped.
    """
    posterior = sample_run(sc.Run(run, tell=note), sampling, force=force)
    show_posterior(posterior)
    return Answer({"run": run, "posterior": posterior}, posterior.diagnostics.level.exit_status)


def sample_run(run: Run, sampling: SamplingSettings, *, force: bool) -> Posterior:
    """Sample with a bar, and print what the likelihood warns of."""
    options = sampling.options(run)
    with progress_bar("sampling") as progress, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", sc.inference.NaivePairsWarning)
        posterior = run.sample(force=force, progress=progress, **options)
    for warning in caught:
        tell(f"warning: {warning.message}")
    return posterior


def coupling_command(run: RunPath, force: Force = False) -> Answer:
    """Correlations, variance inflation, weak directions and the principal point's near-gauge with
    the boresight.
    """
    coupling = sc.Run(run, tell=note).couple(force=force)
    show_coupling(coupling)
    return Answer({"run": run, "coupling": coupling})


def propagate_command(
    run: RunPath,
    attitudes: Annotated[
        str,
        typer.Option(
            metavar="observed|random|FILE",
            help="Frames: those of the calibration, random ones of the mission, or an attitude "
            "profile "
            "(time_s or time_utc, and qx, qy, qz, qw).",
            callback=checked(check_word_or_file),
        ),
    ] = "observed",
    max_mag: Annotated[
        float, number(MAGNITUDES, "Mission: magnitude limit in flight, Gaia G.")
    ] = 6.0,
    epoch: Annotated[float, number(EPOCH, "Mission: Julian year of the star positions.")] = 2026.9,
    frames: Annotated[
        int, number("n_frames", "Mission: number of random attitudes.", least=10)
    ] = 1000,
    min_stars: Annotated[
        int | None,
        number("min_stars", "Mission: frames with fewer stars give no attitude (5; profile: 3)."),
    ] = None,
    rate: Annotated[
        float | None, number("rate_hz", "Profile: frames per second; its own instants by default.")
    ] = None,
    scalar: Annotated[
        settings.Scalar | None,
        typer.Option(help="Profile: first or last, where its columns are numbered (q0 to q3)."),
    ] = None,
    sense: Annotated[
        settings.Sense, typer.Option(help="Profile: icrs_to_camera (b = R r) or camera_to_icrs.")
    ] = "icrs_to_camera",
    alignment: Alignment = "random",
    alignment_frames: AlignmentFrames = None,
    draws: Draws = 300,
    seed: Seed = 0,
    force: Force = False,
) -> Answer:
    """Attitude error that the calibration contributes, through QUEST: common rotation, the rest,
    and centroid noise.
    """
    sky = None
    if attitudes != "observed":
        sky = sc.runs.MissionSky(
            profile=None if attitudes == "random" else Path(attitudes),
            max_mag=max_mag,
            epoch=epoch,
            n_frames=frames,
            min_stars=min_stars,
            rate_hz=rate,
            scalar=scalar,
            sense=sense,
        )
    if sky is None and (rate is not None or scalar is not None):
        raise typer.BadParameter(
            "--rate and --scalar belong to an attitude profile: give --attitudes FILE."
        )

    error, _, spectrum = sc.Run(run, tell=note).propagate(
        n_draws=draws,
        seed=seed,
        sky=sky,
        alignment=alignment,
        alignment_frames=alignment_frames,
        force=force,
    )
    show_attitude(error)
    say(error.text)
    if spectrum is not None:
        say(spectrum.text)
    return Answer(
        {"run": run, "attitude": error, "spectrum": None if spectrum is None else spectrum.text}
    )


def report_command(
    run: RunPath,
    notebook: Annotated[
        bool,
        typer.Option(
            "--notebook", help="Write an executed Jupyter notebook, RUN/report.ipynb, in its place."
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", metavar="FILE", help="Another notebook to write.", parser=write_file
        ),
    ] = None,
    format: Annotated[
        settings.ReportFormat,
        typer.Option(
            help="pdf writes RUN/report.pdf as well, by an installed browser or WeasyPrint."
        ),
    ] = "html",
    force: Force = False,
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
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|CAMERA", help="Run folder, or a camera file.", parser=read_path
        ),
    ],
    to: Annotated[
        settings.ExportFormat,
        typer.Option(
            "--to",
            help="The camera for opencv, ros, kalibr, mrcal, tetra3rs, tetra3, as a sip FITS "
            "header or asdf; "
            "covariance (JSON); draws as csv or netcdf, or with all of ArviZ's groups as arviz; "
            "the table of "
            "parameters in latex or markdown.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="FILE",
            help="File to write; named by default.",
            parser=write_file,
        ),
    ] = None,
    force: Force = False,
) -> Answer:
    """Write the calibrated camera, or what is known of it, for another program; say how near that
    comes.
    """
    with progress_bar("log likelihood") as progress:
        made = sc.export(source, to, out, force=force, progress=progress)
    say(made.note)
    say(f"File: {made.path}")
    return Answer({"file": made.path, "to": to, "error_px": made.error_px, "text": made.note})
