"""What the steps of a run are told: every option declared once, for all commands that have it."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, astuple, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer, deliver
from starcal_uq.cli.console import quiet
from starcal_uq.cli.options import (
    LEAST_SIGMA_PX,
    BayerMosaic,
    Columns,
    Duplicates,
    FileWorkers,
    Json,
    SchedulerAddress,
    Seed,
    TimeUtc,
    checked,
    number,
    parse_dof,
    parse_frames,
    parse_start,
    parse_velocity,
    read_file,
)
from starcal_uq.core import settings
from starcal_uq.core.conflicts import conflict, typed
from starcal_uq.core.settings import EPOCH, KEYS, MAGNITUDES
from starcal_uq.core.types import AnyDict

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.runs.run import Run


@dataclass(frozen=True)
class EstimationSettings:
    """How a camera is estimated."""

    model: Annotated[
        settings.ModelName | None,
        typer.Option(
            help="Distortion model, fitted or refused; by default that of CAMERA, or the richest "
            "simpler one that the "
            "data determine."
        ),
    ] = None
    method: Annotated[
        settings.Method,
        typer.Option(
            help="efficient (three stages, then the attitude-marginalised likelihood), "
            "three_stage (Ye & Yang 2017), "
            "or a baseline: least_squares, samaan (Kalman filter), griffith (recursive least "
            "squares)."
        ),
    ] = "efficient"
    solver: Annotated[
        settings.Solver,
        typer.Option(help="lm, minpack, or ipopt (keeps the optics within physical bounds)."),
    ] = "lm"
    screen: Annotated[
        bool,
        typer.Option("--screen", help="Leave out wrong identifications first; they are listed."),
    ] = False
    robust: Annotated[
        bool,
        typer.Option(
            "--robust", help="Refine with Student-t tails, which wrong identifications hardly move."
        ),
    ] = False

    star_errors: Annotated[
        bool,
        typer.Option(
            "--star-errors",
            help="Estimate and marginalise errors that a star brings into every frame.",
        ),
    ] = False
    noise: Annotated[
        settings.NoiseKind,
        typer.Option(
            help="common (one noise for all stars), or model (fitted against radius, magnitude, "
            "frame and axis, as far "
            "as the residuals ask for it)."
        ),
    ] = "common"
    start: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=VALUE,...",
            help="Start from these in place of CAMERA's: focal_mm (or focal_px), x0_px, y0_px.",
            callback=checked(parse_start),
        ),
    ] = None
    pixel_um: Annotated[
        float | None,
        number(KEYS["pixel_um"], "Pixel pitch, um, where neither CAMERA nor the images state it."),
    ] = None
    max_iterations: Annotated[
        int | None, number("max_iterations", "Limit for each stage; 200 by default.")
    ] = None
    accept_inflation: Annotated[
        bool,
        typer.Option(
            "--accept-inflation",
            help="Multiply sigma by how much more the frames scatter than their noise says.",
        ),
    ] = False
    duplicates: Duplicates = "refuse"
    scheduler: SchedulerAddress = None
    workers: FileWorkers = None

    def options(self) -> AnyDict:
        """Keyword arguments of `Run.calibrate`."""
        options: AnyDict = {
            "model": self.model,
            "method": self.method,
            "solver": self.solver,
            "screening": self.screen,
            "noise": self.noise,
            "duplicates": self.duplicates,
        }
        options |= {"star_errors": True} if self.star_errors else {}
        options |= {"accept_inflation": True} if self.accept_inflation else {}
        given = {
            "max_iterations": self.max_iterations,
            "scheduler": self.scheduler,
            "workers": self.workers,
        }
        options |= {name: value for name, value in given.items() if value is not None}
        return options | {"likelihood": "student_t"} if self.robust else options

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

    directions: Annotated[
        settings.Directions | None,
        typer.Option(
            help="What ra_deg and dec_deg are: apparent (as seen by the moving sensor), catalogue "
            "(aberration is then "
            "applied at time_utc), or undeclared.",
        ),
    ] = None
    site: Annotated[
        Path | None,
        typer.Option(
            "--site",
            metavar="SITE",
            help="Where on the ground the camera stood (TOML with a [site] table): refraction and "
            "daily aberration are "
            "applied.",
            parser=read_file,
        ),
    ] = None
    in_space: Annotated[
        bool,
        typer.Option(
            "--in-space", help="The camera was above the air; refraction does not matter."
        ),
    ] = False

    def options(self) -> AnyDict:
        """Keyword arguments that tables and images share: `observations_from_table`,
        `observations_from_images`.
        """
        return {
            "directions": self.directions,
            "site": None if self.site is None else sc.sky.Site.load(self.site),
            "in_space": self.in_space,
        }


@dataclass(frozen=True)
class SkySettings(PlaceSettings):
    """The table, its directions, and how the observer moved."""

    time: TimeUtc = None
    column: Columns = None
    frames: Annotated[
        str | None,
        typer.Option(
            "--only-frames",
            metavar="LIST",
            help="Frames of the table to take, such as 0-4,7.",
            callback=checked(parse_frames),
        ),
    ] = None
    observer_velocity: Annotated[
        str | None,
        typer.Option(
            "--observer-velocity",
            metavar="VX,VY,VZ",
            help="Velocity relative to the Earth's centre, km/s, ICRS axes.",
            callback=checked(parse_velocity),
        ),
    ] = None


@dataclass(frozen=True)
class ImageSettings:
    """What belongs to images alone. None where nothing was said."""

    max_mag: Annotated[
        float | None,
        number(MAGNITUDES, "Magnitude limit, Gaia G; as the frames need it by default."),
    ] = None
    epoch: Annotated[
        float | None,
        number(EPOCH, "Julian year of the star positions; the images' own by default."),
    ] = None
    focal_tolerance: Annotated[
        float | None,
        number("focal_tolerance", "Relative error of the nominal focal length; 0.03 by default."),
    ] = None
    gain: Annotated[
        float | None, number("gain_e_per_count", "Electrons per count, where they do not say it.")
    ] = None
    bayer: BayerMosaic = None
    engine: Annotated[
        settings.Engine | None,
        typer.Option(help="What finds attitudes: pyramid, or tetra3rs (extra of that name)."),
    ] = None


@dataclass(frozen=True)
class SamplingSettings:
    """How a posterior is sampled."""

    seed: Seed = 0
    sigma: Annotated[
        float | None,
        number(
            "sigma_px",
            "Centroid noise in px per axis, if it is known; sampled otherwise.",
            least=LEAST_SIGMA_PX,
        ),
    ] = None
    priors: Annotated[
        Path | None,
        typer.Option(
            "--priors",
            help="TOML file with a [priors] table; wide defaults otherwise.",
            parser=read_file,
        ),
    ] = None
    ensembles: Annotated[
        int, number("n_ensembles", "Separately seeded ensembles of walkers.", least=2)
    ] = 4
    walkers: Annotated[int, number("n_walkers", "Walkers in each ensemble.", least=14)] = 64
    steps: Annotated[int, number("n_steps", "Steps kept of each walker.", least=20)] = 200
    likelihood: Annotated[
        settings.LikelihoodName | None,
        typer.Option(
            help="marginal (Gaussian, attitudes marginalised), pairs (interstar angles, Godambe's "
            "curvature), "
            "student_t (heavy tails, for wrong identifications), or pairs_naive (to see what "
            "goes wrong); by default "
            "that of the calibration."
        ),
    ] = None
    evaluation: Annotated[
        settings.Evaluation,
        typer.Option(help="auto (compressed, checked against exact), compressed, or exact."),
    ] = "auto"
    moves: Annotated[
        settings.Moves,
        typer.Option(
            help="mixture, or stretch (emcee's own, for a posterior far from a Gaussian one)."
        ),
    ] = "mixture"
    dof: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER|free",
            help=(
                "Degrees of freedom of student_t: free samples them; by default those of the "
                "calibration, or 4."
            ),
            callback=checked(parse_dof),
        ),
    ] = None

    def options(self, run: Run) -> AnyDict:
        """Keyword arguments of `Run.sample`."""
        from starcal_uq.runs.priors import read_priors

        options: AnyDict = {
            "seed": self.seed,
            "sigma": "sampled" if self.sigma is None else self.sigma,
            "n_ensembles": self.ensembles,
            "n_walkers": self.walkers,
            "n_steps": self.steps,
            "likelihood": self.likelihood,
            "evaluation": self.evaluation,
            "moves": self.moves,
            "dof": parse_dof(self.dof),
        }
        return (
            options if self.priors is None else options | {"priors": read_priors(run, self.priors)}
        )


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
        given = {
            field.name: value
            for field, value in zip(fields(of_images), astuple(of_images), strict=True)
        }
        kind = "images, not to a table of stars"
    for name, value in given.items():
        if value not in (None, []):
            raise typer.BadParameter(f"--{name.replace('_', '-')} belongs to {kind}: leave it out.")


def settings_of(
    estimation: EstimationSettings,
    sky: SkySettings,
    sampling: SamplingSettings | None = None,
    *,
    partitioned: bool = False,
    **aligning: Any,
) -> AnyDict:
    """Options of one call by the names that `starcal_uq.core.conflicts` has for them."""
    settings = {
        **vars(estimation),
        **vars(sky),
        **estimation.options(),
        **aligning,
        "partitioned": partitioned,
    }
    if sampling is not None:
        settings["sampled"] = sampling.likelihood or settings.get("likelihood")
        settings["sampled_dof"] = sampling.dof
    return settings


def refuse_conflicts(settings: AnyDict) -> None:
    """Refuse options that cannot be given together, before anything is done, in the words of the
    command line.
    """
    rule = conflict(settings)
    if rule is None:
        return
    given, other = typed(rule.name, settings[rule.name]), settings.get(rule.other)
    if rule.other == "partitioned":
        words = f"needs a folder of partitions: leave {given} out." if True in rule.allowed else ""
        raise typer.BadParameter(
            f"{given} {words or f'needs one table, and no folder: leave {given} out.'}"
        )
    if other in (None, False):
        raise typer.BadParameter(
            f"{given} needs {typed(rule.other, rule.allowed[0])}: give both, or leave {given} out."
        )
    raise typer.BadParameter(
        f"{given} and {typed(rule.other, other)} exclude each other: leave one of them out."
    )


def typed_words(arguments: Sequence[str]) -> list[str]:
    """A command line that can be given anywhere: files by their whole path, without where and how
    it wrote.
    """
    words: list[str] = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        if (
            before in ("-o", "--out")
            or word in ("-o", "--out", "--force", "--json")
            or word.startswith(("--out=", "-o"))
        ):
            continue
        # The value of an option may be the name of a folder that lies about.
        file = (
            words and not word.startswith("-") and (not before.startswith("-") or Path(word).suffix)
        )
        words.append(str(Path(word).resolve()) if file and os.path.exists(word) else word)
    return words


def command_of(name: str, settings: Mapping[str, Any], files: Mapping[str, Path]) -> AnyDict:
    """All that the result of a command depends on: what it was told, and hashes of the files that
    it reads.
    """
    from starcal_uq.core.manifest import identity

    told: AnyDict = {}
    for key, value in settings.items():
        given = (
            asdict(value) if is_dataclass(value) and not isinstance(value, type) else {key: value}
        )
        told |= {
            key: str(content) if isinstance(content, Path) else content
            for key, content in given.items()
        }
        files = {
            **files,
            **{name: content for name, content in given.items() if isinstance(content, Path)},
        }
    aligned = Path(str(settings.get("alignment")))
    files = {**files, "alignment": aligned} if aligned.is_file() else files
    return {"command": name, "settings": told, "inputs": identity(files)}


def _under(record: Any, hint: Any) -> Any:
    """The type of an option that stands in the help under the words of its record."""
    option = copy(hint.__metadata__[0])
    option.rich_help_panel = str(record.__doc__).partition(".")[0]
    return Annotated[hint.__origin__, option]


def unfolded(name: str, command: Callable[..., Answer]) -> Callable[..., None]:
    """What is called by the name of a command: one option for each field of its records, and
    --json.
    """
    parameters: list[inspect.Parameter] = []
    records: dict[str, Any] = {}
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        record = parameter.annotation
        if not is_dataclass(record):
            parameters.append(parameter.replace(kind=parameter.KEYWORD_ONLY))
            continue
        hints = get_type_hints(record, include_extras=True)
        records[parameter.name] = record
        parameters += [
            inspect.Parameter(
                f.name,
                parameter.KEYWORD_ONLY,
                default=f.default,
                annotation=_under(record, hints[f.name]),
            )
            for f in fields(record)
        ]
    parameters.append(
        inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Json)
    )

    @wraps(command)
    def run(json: bool, **given: Any) -> None:
        settings = {
            name: record(**{field.name: given.pop(field.name) for field in fields(record)})
            for name, record in records.items()
        }
        with quiet(json):
            answer = command(**given, **settings)
        deliver(name, answer, json)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run
