"""Arguments and options that several commands share."""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.resources import files
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from starcal_uq.core import settings
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.files import shown, split_part
from starcal_uq.core.settings import KEYS, LIMITS, Limit

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

_VELOCITY = Limit(-1e5, 1e5, whole=False)
_POSITION = Limit(-1e9, 1e9, whole=False)
_LONGEST_LABELS, _LONGEST_ADDRESS = 200, 500


def _refuse(value: object, problem: str) -> typer.BadParameter:
    return typer.BadParameter(f"{shown(str(value))}: {problem}.")


def _mode(path: Path) -> int | None:
    """What stands at a path; None if nothing does."""
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise _refuse(
            path, f"cannot be looked at ({getattr(error, 'strerror', None) or error}); check it"
        ) from None
    if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) or stat.S_ISSOCK(mode):
        raise _refuse(path, "is a device; name a file or a folder")
    return mode


def _path(value: str | Path) -> Path:
    if not str(value):
        raise typer.BadParameter("'': is empty; name a file or a folder.")
    return Path(value)


def read_path(value: str | Path) -> Path:
    """Path of a file or a folder that can be read."""
    path = _path(value)
    file = Path(split_part(path)[0])
    if _mode(file) is None:
        # Files of these names are what `new` writes.
        new = path.stem in get_args(settings.Starter) and path.suffix == ".toml"
        raise _refuse(
            path,
            f"does not exist; check the path{f', or starcal-uq new {path.stem}' if new else ''}",
        )
    if not os.access(file, os.R_OK):
        raise _refuse(file, "cannot be read; check its permissions")
    return path


def read_file(value: str | Path) -> Path:
    """Path of a file that can be read."""
    path = read_path(value)
    if path.is_dir():
        raise _refuse(path, "is a directory; name a file")
    return path


def write_path(value: str | Path) -> Path:
    """Path that is neither a device nor below a file."""
    path = _path(value)
    if _mode(path) is None:
        for parent in path.parents:
            mode = _mode(parent)
            if mode is not None:
                if not stat.S_ISDIR(mode):
                    raise _refuse(path, f"cannot be made, because {shown(str(parent))} is a file")
                break
    return path


def write_file(value: str | Path) -> Path:
    """Path that is not a directory either."""
    path = write_path(value)
    if path.is_dir():
        raise _refuse(path, "is a directory; name a file to write to")
    return path


def parse_columns(pairs: list[str] | None) -> dict[str, str]:
    """``NAME=IN_FILE`` pairs as a mapping."""
    found = {}
    for pair in pairs or []:
        name, separator, in_file = pair.partition("=")
        if not (name and separator and in_file):
            raise typer.BadParameter(
                f"{shown(pair)} is not NAME=IN_FILE, such as ra_deg=ra_apparent_deg."
            )
        found[name] = in_file
    return found


def _parse_vector(
    text: str | None, what: str, unit: str, example: str, limit: Limit
) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"{shown(text)} is not three numbers in {unit}, such as {example}."
        ) from None
    if not limit.holds([x, y, z]):
        raise typer.BadParameter(f"{shown(text)} is no {what} in {unit}: {limit.wanted()}.")
    return x, y, z


def parse_velocity(text: str | None) -> tuple[float, float, float] | None:
    """``VX,VY,VZ`` as numbers."""
    return _parse_vector(text, "velocity", "km/s", "7.5,0.0,0.0", _VELOCITY)


def parse_position(text: str | None) -> tuple[float, float, float] | None:
    """``X,Y,Z`` as numbers."""
    return _parse_vector(text, "position", "km", "6878,0,0", _POSITION)


def parse_start(text: str | None) -> dict[str, float]:
    """``NAME=VALUE,...`` as values of a camera to start from."""
    found = {}
    for pair in [] if text is None else text.split(","):
        name, _, value = (part.strip() for part in pair.partition("="))
        try:
            found[name] = float(value)
        except ValueError:
            name = ""
        if name not in ("focal_mm", "focal_px", "x0_px", "y0_px"):
            raise typer.BadParameter(
                f"{shown(pair)} is no start, such as focal_mm=50.2 or x0_px=511.5,y0_px=511.5."
            )
    return found


def parse_dof(text: str | None) -> float | Literal["free"] | None:
    """``free`` or a number of degrees of freedom."""
    if text is None or text == "free":
        return None if text is None else "free"
    from starcal_uq.likelihood import student

    try:
        value = float(text)
    except ValueError:
        raise typer.BadParameter(f"{shown(text)} is neither a number nor free.") from None
    return student.parse_dof(value, typer.BadParameter)


def _known_to(reader: str) -> Callable[[str], None]:
    """A check that a text is one which a function of the package ("module:name") reads."""

    def check(text: str) -> None:
        module, _, name = reader.partition(":")
        try:
            attrgetter(name)(import_module(f"starcal_uq.{module}"))(text)
        except StarcalError as error:
            # The option says what it is of.
            words = str(error).removeprefix("The time ").removeprefix("distortion model ")
            raise typer.BadParameter(words) from None

    return check


def check_effects(text: str | None) -> None:
    """Refuse what is neither ``auto`` nor ``none`` nor names of effects with commas."""
    if text is not None and not _is_name(text):
        raise typer.BadParameter(f"{shown(text)} is no list of effects, such as field,frame.")
    if text is not None:
        _known_to("core.settings:effect_names")(text)


def parse_frames(text: str | None) -> list[tuple[int, int]] | None:
    """``0-4,7`` as first and last number of each stretch of frames."""
    if text is None:
        return None
    found = [re.fullmatch(r"(\d{1,15})(?:-(\d{1,15}))?", part.strip()) for part in text.split(",")]
    ends = [(int(match[1]), int(match[2] or match[1])) for match in found if match is not None]
    if len(ends) < len(found) or any(last < first for first, last in ends):
        raise typer.BadParameter(f"{shown(text)} is no list of frame numbers, such as 0-4,7.")
    return ends


def parse_labels(text: str | None) -> tuple[str, str] | None:
    """``A,B`` as two different names."""
    if text is None:
        return None
    first, comma, second = (part.strip() for part in text.partition(","))
    if (
        not (first and comma and second)
        or first == second
        or not text.isprintable()
        or len(text) > _LONGEST_LABELS
    ):
        raise typer.BadParameter(
            f"{shown(text)} is not two different short names such as cold,hot."
        )
    return first, second


def _is_name(text: str) -> bool:
    """Whether a text may name something: not empty, printable, and of a length that names have."""
    return bool(text.strip()) and text.isprintable() and len(text) <= _LONGEST_ADDRESS


def _check_text(text: str) -> None:
    if not _is_name(text):
        raise typer.BadParameter(f"{shown(text)} is no address, such as tcp://10.0.0.1:8786.")


def check_names(texts: list[str] | None) -> None:
    """Refuse what is no name of a file."""
    for text in texts or ():
        if not _is_name(text):
            raise typer.BadParameter(
                f"{shown(text)} is no frame's number or name, such as 3 or night-003.fits."
            )


def _refuse_edits(texts: list[str] | None) -> None:
    """Refuse changes of a run file: where one is given, they are made before options are read."""
    if texts:
        raise typer.BadParameter(
            f"{shown(texts[0])} changes a key of a run file: give the file first, as in "
            "`run run.toml --set seed=7`."
        )


def check_word_or_file(text: str) -> None:
    if text not in ("random", "observed"):
        read_file(Path(text))


def _check_schema(name: str) -> None:
    from starcal_uq.cli.schemas import SCHEMAS

    if name not in SCHEMAS:
        raise typer.BadParameter(f"{shown(name)} is unknown: use one of {', '.join(SCHEMAS)}.")


def checked(parse: Callable[[Any], object]) -> Callable[[Any], Any]:
    """Callback that lets a value pass which can be parsed; the command parses it."""

    def check(value: Any) -> Any:
        if value is not None:
            parse(value)
        return value

    return check


_PATHS: Mapping[str, Callable[[str | Path], Path]] = {
    "read": read_path,
    "read file": read_file,
    "write": write_path,
    "write file": write_file,
}
_CHECKS: Mapping[str, Callable[[Any], object]] = {
    "address": _check_text,
    "columns": parse_columns,
    "degrees of freedom": parse_dof,
    "edits": _refuse_edits,
    "effects": check_effects,
    "engine": _known_to("identification.proposers:offered_engine"),
    "frames": parse_frames,
    "labels": parse_labels,
    "model": _known_to("camera.distortion:get_model"),
    "names": check_names,
    "position": parse_position,
    "planned effects": _known_to("planning.effects:PlannedEffects.parsed"),
    "schema": _check_schema,
    "start": parse_start,
    "time": _known_to("core.times:utc_text"),
    "velocity": parse_velocity,
    "word or file": check_word_or_file,
}
_DECLARED = tomllib.loads((files("starcal_uq.cli") / "options.toml").read_text("utf-8"))
# Commands with many options -> parameters that `--help` shows; `--help-all` shows the others too.
COMMON: Mapping[str, list[str]] = _DECLARED.pop("common")
# Parameters that are files or folders, or may be.
PATHS = {
    name
    for table in _DECLARED.values()
    for name, entry in table.items()
    if "path" in entry or entry.get("check") == "word or file"
}


_VALUES = {Path: "FILE", float: "NUMBER", int: "N", str: "TEXT"}


def _metavar_and_choices(kind: Any) -> tuple[str | None, str]:
    """The word for a value in the help, and the sentence that lists the choices."""
    kinds = [one for one in (get_args(kind) or (kind,)) if one is not type(None)]
    if get_origin(kind) is Literal:
        return "WORD", f" One of: {', '.join(map(str, kinds))}."
    if len(kinds) == 1 and get_origin(kinds[0]) is Literal:
        return _metavar_and_choices(kinds[0])
    return (_VALUES.get(kinds[0]) if len(kinds) == 1 else None), ""


def declared(
    owner: str, name: str, kind: Any, panel: str | None = None, *, hidden: bool = False
) -> Any:
    """The type of a parameter of a command, or of a record, as Typer takes it; `panel` is where it
    stands in the help.
    """
    entry = _DECLARED.get(owner, {}).get(name) or _DECLARED["shared"][name]
    low, high = entry.get("range", (None, None))
    if "limit" in entry:
        limit = (KEYS | LIMITS)[entry["limit"]]
        low, high = entry.get("least", limit.low), limit.high
    metavar, choices = _metavar_and_choices(kind)
    words = str(entry.get("help") or "").strip()
    named = all(word.strip(" .") in words for word in choices.partition(":")[2].split(","))
    settings = {
        "help": words if named else words + choices,
        "metavar": entry.get("metavar", metavar),
        "hidden": hidden,
        "min": low,
        "max": high,
        "parser": _PATHS.get(entry.get("path")),
        "callback": checked(_CHECKS[entry["check"]]) if "check" in entry else None,
        "rich_help_panel": panel,
    }
    if entry.get("argument"):
        return Annotated[kind, typer.Argument(**settings)]
    names = entry.get("names", [f"--{name.replace('_', '-')}"])
    return Annotated[kind, typer.Option(*names, **settings)]


def check_same_sensor(calibrated: Camera, run: Path, sheet: Camera, path: Path) -> None:
    """Refuse a run whose camera cannot be that of the file: another detector, or a focal length 10
    % off.
    """
    same = (calibrated.width_px, calibrated.height_px) == (sheet.width_px, sheet.height_px)
    pixels = 0.0
    if calibrated.pixel_um is not None and sheet.pixel_um is not None:
        pixels = abs(calibrated.pixel_um / sheet.pixel_um - 1.0)
    focal = abs(calibrated.focal_px / sheet.focal_px - 1.0)
    if not same or pixels > 1e-6 or focal > 0.1:
        own, its = (_size_words(camera) for camera in (calibrated, sheet))
        raise typer.BadParameter(
            f"{run}: its camera ({own}) is not that of {path} ({its}): give the file and the run "
            "of one sensor."
        )


def _size_words(camera: Camera) -> str:
    focal = camera.length_text(camera.focal_px, 4)
    return f"{camera.width_px} x {camera.height_px} px, f = {focal}"
