"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.identification.proposers import Engine as EngineName

# Gaia G; where the embedded catalogue ends.
FAINTEST = 10.0

ChoiceT = TypeVar("ChoiceT", bound=str)

ObsFile = Annotated[
    Path,
    typer.Argument(
        metavar="OBS",
        help="Stars in pixels: CSV, ECSV or Parquet with columns frame, x_px, y_px, ra_deg, dec_deg and optionally "
        "sigma_px, star_id, mag, direction_mas, time_utc, temperature_c; or a folder of Parquet files of whole frames, "
        "which may exceed memory.",
    ),
]
CameraFile = Annotated[
    Path,
    typer.Argument(
        metavar="CAMERA", help="Nominal camera (TOML with a [camera] table): the start, and the prior's centre."
    ),
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder made by `starcal-uq calibrate`.")]
NewRun = Annotated[Path, typer.Option("-o", "--out", metavar="RUN", help="Folder for the results.")]
Force = Annotated[bool, typer.Option("--force", help="Replace results that exist.")]
Json = Annotated[bool, typer.Option("--json", help="Print the table as JSON.")]
Seed = Annotated[int, typer.Option(help="Seed; the same seed repeats the result bit for bit.")]
Columns = Annotated[
    list[str] | None,
    typer.Option("--column", metavar="NAME=IN_FILE", help="A column that is called otherwise in the file; repeatable."),
]
TimeUtc = Annotated[
    str | None,
    typer.Option(
        "--time",
        metavar="UTC",
        help="Images: middle of the exposure of files that do not say it; goes before a time in the file's name.",
    ),
]
Engine = Annotated[str, typer.Option(help="What finds attitudes: pyramid, or tetra3rs (extra of that name).")]
SchedulerAddress = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Dask scheduler whose workers do it; local processes otherwise.",
    ),
]
FileWorkers = Annotated[
    int | None,
    typer.Option(
        "--workers", min=0, help="Local processes for a folder of partitions; one for each processor by default."
    ),
]
Duplicates = Annotated[
    str,
    typer.Option(
        help="Frames that hold the same measurement as an earlier one: refuse, drop (leave them out), or keep (they "
        "are exposures of their own)."
    ),
]
Alignment = Annotated[
    str,
    typer.Option(
        metavar="random|observed|FILE",
        help="Frames on which alignment is calibrated in flight: random sky, those of the calibration, or a table.",
    ),
]
AlignmentFrames = Annotated[
    int | None, typer.Option(min=1, metavar="N", help="Number of alignment frames of random sky; 100 by default.")
]
Draws = Annotated[int, typer.Option(min=50, help="Posterior draws that go through QUEST.")]


def parse_choice(option: str, given: str | None, choices: Sequence[ChoiceT]) -> ChoiceT | None:
    """The choice of that name; None where none was made."""
    if given is None:
        return None
    for choice in choices:
        if choice == given:
            return choice
    raise typer.BadParameter(f"{option} {given!r} is unknown: use one of {', '.join(choices)}.")


def parse_engine(name: str | None) -> EngineName:
    """The engine of that name, or the usual one."""
    from starcal_uq.identification.proposers import ENGINES

    return parse_choice("--engine", name, ENGINES) or "pyramid"


def parse_columns(pairs: list[str] | None) -> dict[str, str]:
    """``NAME=IN_FILE`` pairs as a mapping."""
    found = {}
    for pair in pairs or []:
        name, separator, in_file = pair.partition("=")
        if not (name and separator and in_file):
            raise typer.BadParameter(f"{pair!r} is not NAME=IN_FILE, such as ra_deg=ra_apparent_deg.")
        found[name] = in_file
    return found


def parse_velocity(text: str | None) -> tuple[float, float, float] | None:
    """``VX,VY,VZ`` as numbers."""
    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not three numbers in km/s, such as 7.5,0.0,0.0.") from None
    return x, y, z


def check_same_sensor(calibrated: Camera, run: Path, sheet: Camera, path: Path) -> None:
    """Refuse a run whose camera cannot be that of the file: another detector, or a focal length 10 % off."""
    same = (calibrated.width_px, calibrated.height_px) == (sheet.width_px, sheet.height_px)
    pixels = abs(calibrated.pixel_um / sheet.pixel_um - 1.0)
    focal = abs(calibrated.focal_px / sheet.focal_px - 1.0)
    if not same or pixels > 1e-6 or focal > 0.1:
        raise typer.BadParameter(
            f"{run}: its camera ({calibrated.width_px} x {calibrated.height_px} px, f = {calibrated.focal_mm:.4g} mm) "
            f"is not that of {path} ({sheet.width_px} x {sheet.height_px} px, f = {sheet.focal_mm:.4g} mm): give the "
            "file and the run of one sensor."
        )
