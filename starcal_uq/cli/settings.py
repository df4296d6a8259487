"""Settings of the steps of a run: every option declared once, for all commands that have it."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer, deliver
from starcal_uq.cli.console import talking
from starcal_uq.cli.options import (
    COMMON,
    declared,
    parse_columns,
    parse_dof,
    parse_frames,
    parse_position,
    parse_start,
    parse_velocity,
)
from starcal_uq.core import settings
from starcal_uq.core.conflicts import refusal
from starcal_uq.core.errors import SensorError
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.simulation.noise import Noise


# Centroid noise of a small tracker, px per axis, where nothing states another.
SIGMA_PX = 0.05
# Settings of an estimation that change the nominal camera.
_OF_CAMERA = ("start", "pixel_um")


@dataclass(frozen=True)
class EstimationSettings:
    """How a camera is estimated."""

    model: str | None = None
    method: settings.Method = "efficient"
    solver: settings.Solver = "lm"
    screening: bool = False
    effects: str | None = None
    relative_attitudes: Path | None = None
    relative_alignment_arcsec: float | None = None
    mount: settings.MountKind = "none"
    mount_sigma_arcsec: float | None = None
    start: str | None = None
    pixel_um: float | None = None
    max_iterations: int | None = None
    duplicates: settings.Duplicates = "refuse"
    scheduler: str | None = None
    workers: int | None = None

    def options(self) -> AnyDict:
        """Keyword arguments of `Run.calibrate`."""
        if self.mount == "fixed" and self.mount_sigma_arcsec is None:
            raise typer.BadParameter(
                "--mount fixed needs --mount-sigma-arcsec: state how far the mount moves from "
                "frame to frame, such as 1."
            )
        if self.relative_alignment_arcsec is not None and self.relative_attitudes is None:
            raise typer.BadParameter(
                "--relative-alignment-arcsec needs --relative-attitudes: give both, or leave it "
                "out."
            )
        # No workers (0) are a choice, and no absence of one.
        return {
            name: value
            for name, value in vars(self).items()
            if name not in _OF_CAMERA and value is not None and value is not False
        }

    def started(self, camera: Camera) -> Camera:
        """The nominal camera with the pitch and the start that were asked for."""
        if self.pixel_um is not None:
            if camera.pixel_um not in (None, self.pixel_um):
                raise typer.BadParameter(
                    f"--pixel-um is {self.pixel_um:g}, but the pixel pitch is stated as "
                    f"{camera.pixel_um:g} um: leave "
                    "the option out, or correct the camera file."
                )
            camera = camera.replace(pixel_um=self.pixel_um)
        start = parse_start(self.start)
        if camera.pixel_um is None and "focal_mm" in start:
            raise typer.BadParameter(
                "--start focal_mm needs the pixel pitch: add --pixel-um UM, or give focal_px."
            )
        if "focal_mm" in start and "focal_px" in start:
            raise typer.BadParameter("--start has focal_mm and focal_px: give one of them.")
        return camera.replace(**start)


@dataclass(frozen=True)
class PlaceSettings:
    """What the directions are, and where the observer was."""

    directions: settings.Directions | None = None
    site: Path | None = None
    in_space: bool = False

    def options(self) -> AnyDict:
        """Keyword arguments that tables and images share: `observations_from_table`,
        `observations_from_images`.
        """
        return {
            "directions": self.directions,
            "site": sc.sky.Site.of(self.site),
            "in_space": self.in_space,
        }


@dataclass(frozen=True)
class SkySettings(PlaceSettings):
    """The table, its directions, and how the observer moved."""

    time: str | None = None
    column: list[str] | None = None
    frames: str | None = None
    observer_velocity: str | None = None

    def options(self) -> AnyDict:
        """Settings of `sc.run` that say how stars are read."""
        return {
            **super().options(),
            "time": self.time,
            "columns": parse_columns(self.column),
            "frames": parse_frames(self.frames),
            "observer_velocity_km_s": parse_velocity(self.observer_velocity),
        }


@dataclass(frozen=True)
class ImageSettings:
    """What belongs to images alone. None where nothing was said."""

    max_mag: float | None = None
    epoch: float | None = None
    focal_tolerance: float | None = None
    gain: float | None = None
    bayer: settings.Bayer | None = None
    engine: str | None = None

    def options(self) -> AnyDict:
        """Those that are given, as settings of `sc.run`."""
        given = {"gain_e_per_count" if k == "gain" else k: v for k, v in vars(self).items()}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class SamplingSettings:
    """How a posterior is sampled."""

    seed: int = 0
    sigma: float | None = None
    priors: Path | None = None
    n_ensembles: int = 4
    n_walkers: int = 64
    n_steps: int = 200
    likelihood: settings.LikelihoodName | None = None
    evaluation: settings.Evaluation = "auto"
    moves: settings.Moves = "mixture"
    dof: str | None = None

    def options(self) -> AnyDict:
        """Keyword arguments of `Run.sample` but the seed; priors as a file."""
        given = {name: value for name, value in vars(self).items() if name != "seed"}
        sigma = "sampled" if self.sigma is None else self.sigma
        return {**given, "sigma": sigma, "dof": parse_dof(self.dof)}


@dataclass(frozen=True)
class PropagationSettings:
    """How draws are carried to attitudes."""

    n_draws: int = 300
    alignment: str = "random"
    alignment_frames: int | None = None
    onboard: settings.OnboardModel = "model"
    temperature_profile: Path | None = None


@dataclass(frozen=True)
class MissionSettings:
    """Frames that the mission will see."""

    max_mag: float = 6.0
    epoch: float = 2026.9
    n_frames: int = 1000
    min_stars: int | None = None
    max_stars: int | None = None
    rate_hz: float | None = None
    scalar: settings.Scalar | None = None
    sense: settings.Sense = "icrs_to_camera"


@dataclass(frozen=True)
class DetectionSettings:
    """How stars are found in images."""

    gain_e_per_count: float | None = None
    read_noise_e: float | None = None
    saturation: float | None = None
    threshold_sigma: float = 5.0
    psf_sigma_px: float | None = None
    max_stars: int | None = None
    correct_pixel_phase: bool = True


@dataclass(frozen=True)
class IdentificationSettings:
    """How stars are identified."""

    focal_tolerance: float = 0.03
    centre_tolerance_px: float | None = None
    engine: str = "pyramid"


@dataclass(frozen=True)
class SimulationSettings:
    """What is simulated."""

    n_frames: int = 1000
    sigma_px: float | None = None
    min_stars: int = 10
    max_stars: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class PartitionSettings:
    """A folder in place of one table."""

    partition_frames: int | None = None
    scheduler: str | None = None
    workers: int | None = None


@dataclass(frozen=True)
class ValidationSettings:
    """What is simulated and calibrated."""

    n_replicates: int = 1000
    n_frames: int = 50
    min_stars: int = 10
    sigma_px: float = SIGMA_PX
    max_mag: float = 6.0
    truth: settings.Truth = "fixed"
    workers: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class RecursionSettings:
    """What is estimated, and how."""

    parameters: settings.Filtered = "all"
    pair_covariance: settings.PairCovariance = "full"
    forgetting: float = 1.0
    process_noise: float | None = None
    sigma_px: float | None = None


@dataclass(frozen=True)
class ForecastSettings:
    """What is asked of the calibration."""

    target_arcsec: float | None = None
    confidence: float = 0.997
    scope: settings.Scope = "common"
    max_mag: float = 6.0
    min_stars: int = 10
    max_stars: int | None = None
    distortion_percent: tuple[float, float] | None = None
    seed: int = 0


@dataclass(frozen=True)
class TrackerSettings:
    """The tracker, and when and where it looks."""

    sensor: Path | None = None
    time: str | None = None
    position_km: str | None = None

    def options(
        self, camera: Camera, stated_px: float | None, otherwise: Noise = SIGMA_PX
    ) -> AnyDict:
        """Keyword arguments of `simulate` and `plan`: noise as stated, of the sensor, or otherwise;
        and exclusion.
        """
        if self.sensor is None:
            if self.time is not None or self.position_km is not None:
                raise typer.BadParameter(
                    "--time and --position-km belong to the exclusion angles of a sensor: add "
                    "--sensor, or leave them out."
                )
            return {"sigma_px": otherwise if stated_px is None else stated_px}
        sensor = sc.simulation.Sensor.load(self.sensor)
        position_km = parse_position(self.position_km)
        try:
            exclusion = sc.simulation.Exclusion.of(sensor, self.time, position_km)
            noise = sensor.noise(camera) if stated_px is None else stated_px
        except SensorError as error:
            words = str(error).partition(": ")[2]
            words = words.replace("time_utc", "--time").replace("position_km", "--position-km")
            raise typer.BadParameter(f"{self.sensor}: {words}") from None
        return {"sigma_px": noise, "exclusion": exclusion}


@dataclass(frozen=True)
class CampaignSettings:
    """What the campaign will be."""

    sigma: float | None = None
    frames: list[int] | None = None
    after: Path | None = None
    epoch: float = 2026.9


@dataclass(frozen=True)
class TieSettings:
    """Rotations between frames that will be known."""

    relative_attitudes_arcsec: float | None = None
    relative_alignment_arcsec: float = 0.0
    mount_sigma_arcsec: float | None = None


@dataclass(frozen=True)
class EffectSettings:
    """Effects that the calibration will hold."""

    effects: str | None = None
    temperature_range: float = 20.0
    nights: int = 3


@dataclass(frozen=True)
class ChoiceSettings:
    """What is made beside the forecast."""

    choose: int | None = None
    criterion: settings.Criterion = "A"
    check: int | None = None
    heads: Path | None = None


@dataclass(frozen=True)
class BudgetFiles:
    """Files of the budget beside that of the run."""

    out: list[Path] | None = None
    format: settings.BudgetFormat | None = None
    template: Path | None = None

    def named(self, run: Path | None) -> list[Path]:
        """All files to write but the starter's."""
        if self.format is None:
            return self.out or []
        if run is None:
            raise typer.BadParameter("--format writes into RUN: name the file with -o.")
        return [*(self.out or []), run / f"budget.{self.format}"]


def refuse_others(images: bool, sky: SkySettings, of_images: ImageSettings) -> None:
    """An option that would be ignored is a mistake of the user's that should show."""
    if images:
        given: AnyDict = {
            "column": sky.column,
            "frames": sky.frames,
            "observer_velocity": sky.observer_velocity,
        }
        kind = "tables of stars, not to images"
    else:
        given = vars(of_images)
        kind = "images, not to a table of stars"
    for name, value in given.items():
        if value not in (None, []):
            raise typer.BadParameter(f"--{name.replace('_', '-')} belongs to {kind}: leave it out.")


def refuse_conflicts(settings: AnyDict) -> None:
    """Refuse options that cannot be given together, before anything is done, in the words of the
    command line.
    """
    words = refusal(settings)
    if words is not None:
        raise typer.BadParameter(words)


# Words of a call that its results do not depend on.
_OF_THE_CALL = ("-o", "--out", "--force", "--json", "-q", "--quiet", "-v", "--verbose")


def typed_words(arguments: Sequence[str]) -> list[str]:
    """A command line that can be given anywhere: files by their whole path, without where and how
    it wrote.
    """
    words: list[str] = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        if before in ("-o", "--out") or word in _OF_THE_CALL or word.startswith(("--out=", "-o")):
            continue
        # The value of an option may be the name of a folder that lies about.
        file = (
            words and not word.startswith("-") and (not before.startswith("-") or Path(word).suffix)
        )
        words.append(str(Path(word).resolve()) if file and os.path.exists(word) else word)
    return words


def command_of(name: str, settings: Mapping[str, Any], files: Mapping[str, Path]) -> AnyDict:
    """All that the result of a command depends on: its settings, and hashes of the files that
    it reads.
    """
    from starcal_uq.core.manifest import identity

    paths = {key: value for key, value in settings.items() if isinstance(value, Path)}
    plain = {**settings, **{key: str(path) for key, path in paths.items()}}
    aligned = Path(str(plain.get("alignment")))
    files = {**files, **paths} | ({"alignment": aligned} if aligned.is_file() else {})
    return {"command": name, "settings": plain, "inputs": identity(files)}


def _option(
    owner: str, name: str, kind: Any, default: Any, panel: str | None = None, **shown: Any
) -> inspect.Parameter:
    annotation = declared(owner, name, kind, panel, **shown)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


def _print_all(context: typer.Context, wanted: bool) -> None:
    """Print the help of a command with the options that are rarely used."""
    if not wanted:
        return
    rare = [one for one in context.command.params if getattr(one, "hidden", False)]
    for one in rare:
        one.hidden = False  # type: ignore[attr-defined]
    try:
        print(context.get_help())
    finally:
        for one in rare:
            one.hidden = True  # type: ignore[attr-defined]
    raise typer.Exit


def unfolded(name: str, command: Callable[..., Answer]) -> Callable[..., None]:
    """The function that Typer calls for a command: one option for each field of its records, and
    the options that every command has.
    """
    parameters: list[inspect.Parameter] = []
    records: dict[str, Any] = {}
    common = COMMON.get(name)
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        record = parameter.annotation
        if not (isinstance(record, type) and is_dataclass(record)):
            parameters.append(_option(name, parameter.name, record, parameter.default))
            continue
        hints, panel = get_type_hints(record), str(record.__doc__).partition(".")[0]
        records[parameter.name] = record
        parameters += [
            _option(
                *(record.__name__, f.name, hints[f.name], f.default, panel),
                hidden=common is not None and f.name not in common,
            )
            for f in fields(record)
        ]
    for every in ("json", "quiet", "verbose"):
        parameters.append(_option(name, every, bool, False, hidden=common is not None))
    if name == "run":
        # Is taken out with the run file before options are read.
        parameters.append(_option(name, "edits", list[str] | None, None, hidden=True))
    if common is not None:
        whole = typer.Option(
            "--help-all",
            is_eager=True,
            callback=_print_all,
            help="Show every option and exit.",
        )
        parameters.append(
            inspect.Parameter(
                "help_all",
                inspect.Parameter.KEYWORD_ONLY,
                default=False,
                annotation=Annotated[bool, whole],
            )
        )

    @wraps(command)
    def run(json: bool, quiet: bool, verbose: bool, **given: Any) -> None:
        settings = {
            name: record(**{field.name: given.pop(field.name) for field in fields(record)})
            for name, record in records.items()
        }
        for of_the_call in ("help_all", "edits"):
            given.pop(of_the_call, None)
        with talking(tables=not json, notes=not quiet, steps=verbose):
            answer = command(**given, **settings)
        deliver(name, answer, json)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run
