"""The command line: the only place where the steps are wired together and printed.

Exit status 0 when all is well, 1 when a result is there but should not be trusted or the work was interrupted, 2 for
bad input, always with one sentence that says what to do.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from starcal_uq.cli_filter import register as register_filter
from starcal_uq.cli_images import load_images
from starcal_uq.cli_images import register as register_images
from starcal_uq.cli_options import (
    CameraFile,
    Columns,
    Directions,
    Draws,
    Engine,
    Ensembles,
    Evaluation,
    Force,
    InSpace,
    Json,
    Likelihood,
    Method,
    NewRun,
    ObsFile,
    PriorFile,
    Robust,
    RunPath,
    Screen,
    Seed,
    Sigma,
    SiteFile,
    Solver,
    Steps,
    TimeUtc,
    Velocity,
    Walkers,
    parse_columns,
    parse_velocity,
)
from starcal_uq.cli_paper import register as register_paper
from starcal_uq.cli_statistics import register as register_statistics
from starcal_uq.errors import StarcalError
from starcal_uq.progress import progress_bar

app = typer.Typer(
    name="starcal-uq",
    help="Probabilistic calibration of star sensors: from identified stars to a posterior and its attitude error.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    epilog="Start with `starcal-uq demo`: the experiment of Ye & Yang 2017, from a star catalogue to a report.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from starcal_uq import __version__

        print(f"starcal-uq {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Probabilistic calibration of star sensors: from identified stars to a posterior and its attitude error."""


def _estimator(method: str, solver: str, robust: bool) -> dict[str, Any]:
    """Options of `calibrate`."""
    options: dict[str, Any] = {"method": method, "solver": solver}
    return options | {"likelihood": "student_t"} if robust else options


def _load(
    obs_path: Path,
    camera_path: Path,
    columns: Any,
    directions: str | None,
    velocity: str | None,
    site: Path | None,
    in_space: bool,
) -> Any:
    from starcal_uq.camera import Camera
    from starcal_uq.console import warn_undeclared
    from starcal_uq.site import Site
    from starcal_uq.steps import DIRECTIONS, read_observations

    if directions is not None and directions not in DIRECTIONS:
        raise typer.BadParameter(f"--directions {directions!r} is unknown: use one of {', '.join(DIRECTIONS)}.")
    camera = Camera.load(camera_path)
    obs = read_observations(
        obs_path,
        camera,
        columns=parse_columns(columns),
        directions=directions,
        observer_velocity_km_s=parse_velocity(velocity),
        site=None if site is None else Site.load(site),
        in_space=in_space,
    )
    warn_undeclared(obs)
    return obs, camera


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results.")] = Path(
        "starcal-demo"
    ),
    frames: Annotated[int, typer.Option(min=20, help="Number of frames.")] = 1000,
    seed: Seed = 2017,
    force: Force = False,
) -> None:
    """The experiment of Ye & Yang 2017, end to end, ending in DIR/report.html."""
    from starcal_uq.catalogue import load_catalogue
    from starcal_uq.console import err, show_calibration
    from starcal_uq.runfolder import RunFolder, check_new_run
    from starcal_uq.simulation import paper_camera, paper_start, simulate
    from starcal_uq.steps import calibrate_step

    run = RunFolder(out)
    check_new_run(run, force)
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


def _after_calibration(run: Any, seed: int, draws: int, *, show: bool = False, **sampling: Any) -> None:
    """Sample, couple, propagate, question the model, report; status 1 when a check failed."""
    from starcal_uq.console import show_attitude, show_posterior
    from starcal_uq.diagnosis import diagnose_run
    from starcal_uq.steps import coupling_step, propagate_step, report_step

    posterior = _sample(run, seed, force=True, **sampling)
    coupling_step(run)
    error, _ = propagate_step(run, n_draws=draws, seed=seed)
    if show:
        show_posterior(posterior)
        show_attitude(error)
    with progress_bar("diagnosis") as progress:
        diagnose_run(run.path, seed=seed, progress=progress)
    _finish(run, report_step(run))


def _finish(run: Any, report: Path) -> None:
    """Verdict, then the path of the report; status 1 when a check failed."""
    from starcal_uq.console import show_verdict
    from starcal_uq.steps import verdict_step
    from starcal_uq.verdict import Level

    verdict = verdict_step(run)
    show_verdict(verdict)
    print(f"Report: {report.resolve()}")
    if verdict.level is Level.FAIL:
        raise typer.Exit(1)


@app.command("simulate")
def simulate_command(
    camera: CameraFile,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OBS", help="Table to write (.csv, .ecsv, .parquet).")],
    frames: Annotated[int, typer.Option(min=1, help="Number of frames, at random attitudes.")] = 1000,
    sigma: Annotated[float, typer.Option(min=0.0, help="Centroid noise, px per axis.")] = 0.05,
    max_mag: Annotated[float, typer.Option(help="Magnitude limit, Gaia G.")] = 6.0,
    min_stars: Annotated[int, typer.Option(min=3, help="Attitudes with fewer stars are drawn again.")] = 10,
    epoch: Annotated[float, typer.Option(help="Julian year of the star positions.")] = 2026.9,
    images: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Also render the frames as FITS images into this folder.")
    ] = None,
    sensor: Annotated[
        Path | None,
        typer.Option(help="Detector of the images (TOML with a [sensor] table); a small tracker's by default."),
    ] = None,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Simulate identified stars with the embedded catalogue; directions are written as the sensor saw them."""
    from starcal_uq.camera import Camera
    from starcal_uq.catalogue import load_catalogue
    from starcal_uq.runfolder import ensure_new
    from starcal_uq.simulation import simulate

    ensure_new(out, force)
    if sensor is not None and images is None:
        raise typer.BadParameter("--sensor describes the detector of images: give --images DIR as well.")
    stars, truth = load_catalogue(max_mag=max_mag, epoch=epoch), Camera.load(camera)
    obs = simulate(stars, truth, n_frames=frames, min_stars=min_stars, sigma_px=sigma, seed=seed)
    if images is not None:
        from starcal_uq.rendering_runs import render_frames
        from starcal_uq.sensor import Sensor

        with progress_bar("images") as progress:
            paths = render_frames(
                stars,
                truth,
                images,
                n_frames=frames,
                min_stars=min_stars,
                sensor=Sensor() if sensor is None else Sensor.load(sensor),
                seed=seed,
                sigma_px=sigma,
                force=force,
                progress=progress,
            )
        print(f"{len(paths)} images: {images}")
    obs.save(out, force=force)
    print(f"{obs.n_stars} stars in {obs.n_frames} frames: {out}")


@app.command("calibrate")
def calibrate_command(
    observations: ObsFile,
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
    force: Force = False,
    json: Json = False,
) -> None:
    """Estimate optics and distortion: three stages and refinement, with covariance."""
    from starcal_uq.console import print_json, records, show_calibration, show_screening, warn_air
    from starcal_uq.runfolder import RunFolder, check_new_run
    from starcal_uq.steps import calibrate_step, truth_of

    check_new_run(RunFolder(out), force)
    obs, nominal = _load(observations, camera, column, directions, observer_velocity, site, in_space)
    calibration, screening = calibrate_step(
        RunFolder(out), obs, nominal, force=force, screening=screen, **_estimator(method, solver, robust)
    )
    if screening is not None:
        show_screening(screening)
    warn_air(obs, calibration)
    if json:
        print_json({"status": calibration.status.name, "parameters": records(calibration.to_dataframe())})
    else:
        show_calibration(calibration, truth_of(obs))
        print(f"Run folder: {out}. Next: starcal-uq sample {out}")


@app.command("sample")
def sample_command(
    run: RunPath,
    seed: Seed = 0,
    sigma: Sigma = None,
    priors: PriorFile = None,
    ensembles: Ensembles = 4,
    walkers: Walkers = 64,
    steps: Steps = 200,
    likelihood: Likelihood = None,
    evaluation: Evaluation = "auto",
    force: Force = False,
    json: Json = False,
) -> None:
    """Sample the posterior with emcee from the calibration; an interrupted command goes on where it stopped."""
    from starcal_uq.console import print_json, records, show_posterior
    from starcal_uq.runfolder import RunFolder

    posterior = _sample(
        RunFolder(run),
        seed,
        sigma=sigma,
        priors=priors,
        ensembles=ensembles,
        walkers=walkers,
        steps=steps,
        likelihood=likelihood,
        evaluation=evaluation,
        force=force,
    )
    if json:
        print_json({"ok": posterior.diagnostics.ok, "parameters": records(posterior.summary())})
    else:
        show_posterior(posterior)
    if not posterior.diagnostics.ok:
        raise typer.Exit(1)


def _sample(
    run: Any,
    seed: int,
    *,
    sigma: float | None = None,
    priors: Path | None = None,
    ensembles: int = 4,
    walkers: int = 64,
    steps: int = 200,
    likelihood: str | None = None,
    evaluation: str = "auto",
    force: bool = False,
) -> Any:
    import warnings

    from starcal_uq.console import err
    from starcal_uq.likelihoods import NaivePairsWarning
    from starcal_uq.steps import read_priors, sample_step

    options: dict[str, Any] = {
        "seed": seed,
        "sigma": "sampled" if sigma is None else sigma,
        "n_ensembles": ensembles,
        "n_walkers": walkers,
        "n_steps": steps,
        "likelihood": likelihood,
        "evaluation": evaluation,
    }
    if priors is not None:
        options["priors"] = read_priors(run, priors)
    with progress_bar("sampling") as progress, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NaivePairsWarning)
        posterior = sample_step(run, force=force, progress=progress, **options)
    for warning in caught:
        err.print(f"warning: {warning.message}", style="yellow", highlight=False, soft_wrap=True)
    return posterior


@app.command("coupling")
def coupling_command(run: RunPath, json: Json = False) -> None:
    """Correlations, variance inflation, weak directions and the principal point's near-gauge with the boresight."""
    from starcal_uq.console import print_json, records, show_coupling
    from starcal_uq.runfolder import RunFolder
    from starcal_uq.steps import coupling_step

    found = coupling_step(RunFolder(run))
    if json:
        words = [direction.words for direction in found.weak_directions]
        print_json({"parameters": records(found.to_dataframe()), "directions": words})
    else:
        show_coupling(found)


@app.command("propagate")
def propagate_command(run: RunPath, draws: Draws = 300, seed: Seed = 0, json: Json = False) -> None:
    """Attitude error that the calibration contributes, through QUEST: common rotation, the rest, and centroid noise."""
    from starcal_uq.console import print_json, records, show_attitude
    from starcal_uq.runfolder import RunFolder
    from starcal_uq.steps import propagate_step

    error, _ = propagate_step(RunFolder(run), n_draws=draws, seed=seed)
    if json:
        print_json({"attitude_error": records(error.to_dataframe())})
    else:
        show_attitude(error)


@app.command("report")
def report_command(run: RunPath) -> None:
    """Write RUN/report.html, one self-contained file, from whatever the run holds."""
    from starcal_uq.runfolder import RunFolder
    from starcal_uq.steps import report_step

    print(f"Report: {report_step(RunFolder(run)).resolve()}")


@app.command("run")
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
    max_mag: Annotated[float, typer.Option(help="Images: magnitude limit of the catalogue, Gaia G.")] = 7.0,
    epoch: Annotated[
        float | None, typer.Option(help="Images: Julian year of the star positions; the images' own by default.")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Images: electrons per count, where they do not say it.")] = None,
    time: TimeUtc = None,
    engine: Engine = "pyramid",
    seed: Seed = 0,
    sigma: Sigma = None,
    priors: PriorFile = None,
    ensembles: Ensembles = 4,
    walkers: Walkers = 64,
    steps: Steps = 200,
    likelihood: Likelihood = None,
    evaluation: Evaluation = "auto",
    draws: Draws = 300,
    force: Force = False,
) -> None:
    """Calibrate, sample, couple, propagate and report: everything from stars or images to RUN/report.html."""
    from starcal_uq.console import show_calibration, show_screening, warn_air
    from starcal_uq.image_steps import are_images, save_image_results
    from starcal_uq.runfolder import RunFolder, check_new_run
    from starcal_uq.steps import calibrate_step, truth_of

    folder = RunFolder(out)
    check_new_run(folder, force)
    images = are_images(inputs)
    if images:
        obs, nominal, centroids, found = load_images(
            inputs,
            camera,
            max_mag=max_mag,
            epoch=epoch,
            gain=gain,
            directions=directions,
            site=site,
            in_space=in_space,
            time_utc=time,
            engine=engine,
        )
    elif len(inputs) == 1:
        obs, nominal = _load(inputs[0], camera, column, directions, observer_velocity, site, in_space)
    else:
        raise typer.BadParameter(f"{inputs[1]} is no image: give one table of observations, or images only.")
    calibration, screening = calibrate_step(
        folder, obs, nominal, force=force, screening=screen, **_estimator(method, solver, robust)
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
        sigma=sigma,
        priors=priors,
        ensembles=ensembles,
        walkers=walkers,
        steps=steps,
        likelihood=likelihood,
        evaluation=evaluation,
    )


register_images(app)
register_filter(app)
register_statistics(app)
register_paper(app)


def main() -> None:
    """Entry point: every error a user can make is one sentence on standard error, never a traceback."""
    from typer.exceptions import TyperException

    try:
        code = app(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except typer.Exit as stop:
        sys.exit(stop.exit_code)
    except TyperException as error:
        _fail(_usage_sentence(error), 2)
    except StarcalError as error:
        _fail(str(error), 2)
    except (typer.Abort, KeyboardInterrupt):
        _fail("interrupted; what was complete is kept, and `sample` and `filter` go on where they stopped.", 1)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}; check the path, its permissions and the space on the disk.", 2)


def _usage_sentence(error: Exception) -> str:
    """What is wrong with a call, and where to look."""
    words = getattr(error, "format_message", None)
    message = words() if callable(words) else str(error)
    return f"{message.strip().rstrip('.')}; see `starcal-uq --help`."


def _fail(message: str, status: int) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(status)
