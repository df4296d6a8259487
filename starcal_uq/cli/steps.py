"""The steps of a run, one command each: simulate, calibrate, sample, coupling, propagate, report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from starcal_uq.cli.console import progress_bar
from starcal_uq.cli.options import (
    FAINTEST,
    CameraFile,
    Columns,
    Directions,
    Draws,
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
    Velocity,
    Walkers,
    parse_choice,
    parse_columns,
    parse_velocity,
)
from starcal_uq.core.files import check_new_folder


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("simulate")(simulate_command)
    app.command("calibrate")(calibrate_command)
    app.command("sample")(sample_command)
    app.command("coupling")(coupling_command)
    app.command("propagate")(propagate_command)
    app.command("report")(report_command)


def estimator(method: str, solver: str, robust: bool) -> dict[str, Any]:
    """Options of `calibrate`."""
    options: dict[str, Any] = {"method": method, "solver": solver}
    return options | {"likelihood": "student_t"} if robust else options


def load_table(
    obs_path: Path,
    camera_path: Path,
    columns: Any,
    directions: str | None,
    velocity: str | None,
    site: Path | None,
    in_space: bool,
) -> Any:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.cli.console import warn_undeclared
    from starcal_uq.runs.steps import DIRECTIONS, read_observations
    from starcal_uq.sky.site import Site

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
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.files import ensure_new
    from starcal_uq.simulation.frames import simulate
    from starcal_uq.sky.catalogue import load_catalogue

    ensure_new(out, force)
    if sensor is not None and images is None:
        raise typer.BadParameter("--sensor describes the detector of images: give --images DIR as well.")
    stars, truth = load_catalogue(max_mag=max_mag, epoch=epoch), Camera.load(camera)
    obs = simulate(stars, truth, n_frames=frames, min_stars=min_stars, sigma_px=sigma, seed=seed)
    if images is not None:
        from starcal_uq.simulation.campaign import render_frames
        from starcal_uq.simulation.sensor import Sensor

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
    if out.suffix.lower() == ".csv":
        print("CSV holds no metadata: say --directions apparent when you calibrate it (.ecsv and .parquet know).")


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
    from starcal_uq.cli.console import print_json, records, show_calibration, show_screening, warn_air
    from starcal_uq.runs.folder import RunFolder
    from starcal_uq.runs.steps import calibrate_step, truth_of

    check_new_folder(out, force)
    obs, nominal = load_table(observations, camera, column, directions, observer_velocity, site, in_space)
    calibration, screening = calibrate_step(
        RunFolder(out), obs, nominal, force=force, screening=screen, **estimator(method, solver, robust)
    )
    if screening is not None:
        show_screening(screening)
    warn_air(obs, calibration)
    if json:
        print_json({"status": calibration.status.name, "parameters": records(calibration.to_dataframe())})
    else:
        show_calibration(calibration, truth_of(obs))
        print(f"Run folder: {out}. Next: starcal-uq sample {out}")


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
    from starcal_uq.cli.console import end_with, print_json, records, show_posterior
    from starcal_uq.runs.folder import RunFolder

    posterior = sample_run(
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
    end_with(posterior.diagnostics.level)


def sample_run(
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

    from starcal_uq.cli.console import err
    from starcal_uq.inference.named import NaivePairsWarning
    from starcal_uq.runs.steps import read_priors, sample_step

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


def coupling_command(run: RunPath, json: Json = False) -> None:
    """Correlations, variance inflation, weak directions and the principal point's near-gauge with the boresight."""
    from starcal_uq.cli.console import print_json, records, show_coupling
    from starcal_uq.runs.folder import RunFolder
    from starcal_uq.runs.steps import coupling_step

    found = coupling_step(RunFolder(run))
    if json:
        words = [direction.words for direction in found.weak_directions]
        print_json({"parameters": records(found.to_dataframe()), "directions": words})
    else:
        show_coupling(found)


def propagate_command(
    run: RunPath,
    attitudes: Annotated[
        str,
        typer.Option(
            metavar="observed|random|FILE",
            help="Frames: those of the calibration, random ones of the mission, or an attitude profile "
            "(time_s or time_utc, and qx, qy, qz, qw).",
        ),
    ] = "observed",
    max_mag: Annotated[float, typer.Option(help="Mission: magnitude limit in flight, Gaia G.")] = 6.0,
    epoch: Annotated[float, typer.Option(help="Mission: Julian year of the star positions.")] = 2026.9,
    frames: Annotated[int, typer.Option(min=10, help="Mission: number of random attitudes.")] = 1000,
    min_stars: Annotated[
        int | None,
        typer.Option(min=2, help="Mission: frames with fewer stars give no attitude (5; profile: 3)."),
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Profile: frames per second; its own instants by default.")] = None,
    scalar: Annotated[
        str | None, typer.Option(help="Profile: first or last, where its columns are numbered (q0 to q3).")
    ] = None,
    sense: Annotated[str, typer.Option(help="Profile: icrs_to_camera (b = R r) or camera_to_icrs.")] = "icrs_to_camera",
    draws: Draws = 300,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Attitude error that the calibration contributes, through QUEST: common rotation, the rest, and centroid noise."""
    from starcal_uq.cli.console import err, print_json, records, show_attitude
    from starcal_uq.cli.console import out as console
    from starcal_uq.runs.folder import RunFolder
    from starcal_uq.runs.steps import MissionSky, propagate_step

    sky = None
    if attitudes != "observed":
        sky = MissionSky(
            profile=None if attitudes == "random" else Path(attitudes),
            max_mag=max_mag,
            epoch=epoch,
            n_frames=frames,
            min_stars=min_stars,
            rate_hz=rate,
            scalar=parse_choice("--scalar", scalar, ("first", "last")),
            sense=parse_choice("--sense", sense, ("icrs_to_camera", "camera_to_icrs")) or "icrs_to_camera",
        )
    if sky is not None and max_mag > FAINTEST:
        raise typer.BadParameter(f"--max-mag {max_mag:g}: the embedded catalogue ends at G = {FAINTEST:g}.")
    if sky is None and (rate is not None or scalar is not None):
        raise typer.BadParameter("--rate and --scalar belong to an attitude profile: give --attitudes FILE.")

    def tell(message: str) -> None:
        err.print(f"note: {message}", style="yellow", highlight=False, soft_wrap=True)

    error, _, spectrum = propagate_step(RunFolder(run), n_draws=draws, seed=seed, sky=sky, tell=tell)
    if json:
        document = {"frames": error.frames, "attitude_error": records(error.to_dataframe())}
        print_json(document if spectrum is None else document | {"spectrum": spectrum.text})
        return
    show_attitude(error)
    console.print(error.text, highlight=False, soft_wrap=True)
    if spectrum is not None:
        console.print(spectrum.text, highlight=False, soft_wrap=True)


def report_command(run: RunPath) -> None:
    """Write RUN/report.html, one self-contained file, from whatever the run holds."""
    from starcal_uq.runs.folder import RunFolder
    from starcal_uq.runs.steps import report_step

    print(f"Report: {report_step(RunFolder(run)).resolve()}")
