"""Everything at once: demo and run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcal_uq.cli.console import progress_bar
from starcal_uq.cli.images import load_images
from starcal_uq.cli.mission import fail_if_violated, show_budget
from starcal_uq.cli.options import (
    CameraFile,
    Columns,
    Directions,
    Draws,
    EngineChoice,
    Ensembles,
    Evaluation,
    Force,
    InSpace,
    Likelihood,
    Method,
    NewRun,
    PriorFile,
    Robust,
    Screen,
    Seed,
    Sigma,
    SiteFile,
    Solver,
    Steps,
    TimeUtc,
    Velocity,
    Walkers,
)
from starcal_uq.cli.steps import estimator, load_table, sample_run
from starcal_uq.core.files import check_new_folder

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("demo")(demo)
    app.command("run")(run_command)


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results.")] = Path(
        "starcal-demo"
    ),
    frames: Annotated[int, typer.Option(min=20, help="Number of frames.")] = 1000,
    seed: Seed = 2017,
    force: Force = False,
) -> None:
    """The experiment of Ye & Yang 2017, end to end, ending in DIR/report.html."""
    from starcal_uq.cli.console import err, show_calibration
    from starcal_uq.paper.camera import paper_camera, paper_start
    from starcal_uq.runs.folder import RunFolder
    from starcal_uq.runs.steps import calibrate_step
    from starcal_uq.simulation.frames import simulate
    from starcal_uq.sky.catalogue import load_catalogue

    run = RunFolder(out)
    check_new_folder(run.path, force)
    err.print(f"Simulating {frames} frames of the paper's sensor (Gaia G <= 6, 0.05 px noise, seed {seed}) ...")
    truth = paper_camera()
    obs = simulate(
        load_catalogue(max_mag=6.0, epoch=2026.9), truth, n_frames=frames, min_stars=10, sigma_px=0.05, seed=seed
    )
    err.print("Calibrating from f = 72 mm and the detector's centre ...")
    calibration, _ = calibrate_step(run, obs, paper_start(), force=force)
    show_calibration(calibration, truth)
    err.print("Sampling the posterior, couplings, attitude error, then questioning the model ...")
    _after_calibration(run, seed, 300)


def run_command(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="OBS|IMAGES...",
            help="A table of identified stars (see `calibrate`), or images (FITS, TIFF, PNG, JPEG) or folders of them, "
            "whose stars are then found and identified.",
        ),
    ],
    camera: CameraFile,
    out: NewRun,
    method: Method = "efficient",
    solver: Solver = "lm",
    screen: Screen = False,
    robust: Robust = False,
    column: Columns = None,
    directions: Directions = None,
    observer_velocity: Velocity = None,
    site: SiteFile = None,
    in_space: InSpace = False,
    max_mag: Annotated[
        float | None, typer.Option(help="Images: magnitude limit of the catalogue, Gaia G; 7 by default.")
    ] = None,
    epoch: Annotated[
        float | None, typer.Option(help="Images: Julian year of the star positions; the images' own by default.")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Images: electrons per count, where they do not say it.")] = None,
    time: TimeUtc = None,
    engine: EngineChoice = None,
    seed: Seed = 0,
    sigma: Sigma = None,
    priors: PriorFile = None,
    ensembles: Ensembles = 4,
    walkers: Walkers = 64,
    steps: Steps = 200,
    likelihood: Likelihood = None,
    evaluation: Evaluation = "auto",
    draws: Draws = 300,
    budget: Annotated[
        Path | None,
        typer.Option(metavar="TOML", help="Contributors that the data cannot know, and requirements: see `budget`."),
    ] = None,
    force: Force = False,
) -> None:
    """Calibrate, sample, couple, propagate, budget and report: all from stars or images to RUN/report.html."""
    from starcal_uq.budgeting.file import load_budget_file
    from starcal_uq.cli.console import show_calibration, show_screening, warn_air
    from starcal_uq.pipeline.images import are_images
    from starcal_uq.runs.folder import RunFolder
    from starcal_uq.runs.steps import calibrate_step, save_image_results, truth_of

    folder = RunFolder(out)
    check_new_folder(folder.path, force)
    if budget is not None:
        # A mistake in it should not show after the work.
        load_budget_file(budget)
    images = are_images(inputs)
    _refuse_others(
        images,
        {"--column": column, "--observer-velocity": observer_velocity},
        {"--max-mag": max_mag, "--epoch": epoch, "--gain": gain, "--time": time, "--engine": engine},
    )
    if images:
        obs, nominal, centroids, found = load_images(
            inputs,
            camera,
            max_mag=7.0 if max_mag is None else max_mag,
            epoch=epoch,
            gain=gain,
            directions=directions,
            site=site,
            in_space=in_space,
            time_utc=time,
            engine=engine or "pyramid",
        )
    elif len(inputs) == 1:
        obs, nominal = load_table(inputs[0], camera, column, directions, observer_velocity, site, in_space)
    else:
        raise typer.BadParameter(f"{inputs[1]} is no image: give one table of observations, or images only.")
    calibration, screening = calibrate_step(
        folder, obs, nominal, force=force, screening=screen, **estimator(method, solver, robust)
    )
    if images:
        save_image_results(folder, centroids, found)
    if screening is not None:
        show_screening(screening)
    show_calibration(calibration, truth_of(obs))
    warn_air(obs, calibration)
    _after_calibration(
        folder,
        seed,
        draws,
        show=True,
        budget=budget,
        sigma=sigma,
        priors=priors,
        ensembles=ensembles,
        walkers=walkers,
        steps=steps,
        likelihood=likelihood,
        evaluation=evaluation,
    )


def _refuse_others(images: bool, of_tables: dict[str, Any], of_images: dict[str, Any]) -> None:
    """An option that would be ignored is a mistake of the user's that should show."""
    for option, value in (of_tables if images else of_images).items():
        if value not in (None, []):
            kind = "tables of stars, not to images" if images else "images, not to a table of stars"
            raise typer.BadParameter(f"{option} belongs to {kind}: leave it out.")


def _after_calibration(
    run: Any, seed: int, draws: int, *, show: bool = False, budget: Path | None = None, **sampling: Any
) -> None:
    """Sample, couple, propagate, question the model, budget, report; status 1 when a check or a requirement failed."""
    from starcal_uq.cli.console import show_attitude, show_posterior
    from starcal_uq.runs.steps import budget_run, coupling_step, diagnose_run, propagate_step, report_step

    posterior = sample_run(run, seed, force=True, **sampling)
    coupling_step(run)
    error, _, _ = propagate_step(run, n_draws=draws, seed=seed)
    if show:
        show_posterior(posterior)
        show_attitude(error)
    with progress_bar("diagnosis") as progress:
        diagnose_run(run.path, seed=seed, progress=progress)
    found = budget_run(run.path, file=budget, seed=seed)
    if show:
        show_budget(found)
    _finish(run, report_step(run), found)


def _finish(run: Any, report: Path, found: Budget) -> None:
    """Verdict, then the path of the report; status 1 when a check failed or a requirement is violated."""
    from starcal_uq.cli.console import end_with, show_verdict
    from starcal_uq.runs.steps import verdict_step

    verdict = verdict_step(run)
    show_verdict(verdict)
    print(f"Report: {report.resolve()}")
    fail_if_violated(found)
    end_with(verdict.level)
