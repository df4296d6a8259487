"""Remedies: an action of this package and its arguments, as data.

The command line writes one as a command, Python as a call, and a run fills in its own files; no
other code knows how either is spelt.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeAlias

# What stands for the user's files, and for times and a site that are not known.
OBS, CAMERA, RUN, SOME_IMAGES, SITE, UTC = "OBS", "CAMERA", "RUN", "IMAGES...", "SITE", "UTC"
# Arguments that say where results go.
PLACES = ("out", "force")
_CALLS = {"calibrate": "sc.calibrate(obs, camera", "sample": "sc.sample(obs, cal"}
# Arguments whose call is that of another function.
_OTHER_CALLS = {
    "screening": "sc.calibration.screen(obs, camera)",
}


class Near(NamedTuple):
    """A site of which residuals tell the place alone, deg."""

    latitude_deg: float
    longitude_deg: float

    def __str__(self) -> str:
        return f"{SITE}:{self.latitude_deg:.1f},{self.longitude_deg:.1f}"


@dataclass(frozen=True)
class Remedy:
    """Something to do with this package.

    Attributes
    ----------
    action : str
        The command's name, such as "calibrate" or "new site".
    files : tuple of str
        Its files, in order; OBS, CAMERA, IMAGES... and RUN stand for the user's.
    arguments : dict
        Value by name, as in Python: text, number, True for a switch, a tuple for what is given
        several times, a table for values with names. None is the object that the user gave.
    purpose : str
        End of the order to run it, such as "again"; may be empty.
    form : {"both", "command", "call"}
        Whether it is to be given in the command line, in Python, or in either.
    steps : tuple of Remedy
        Commands that do it for one run, in order; empty where no run is known.
    """

    action: str
    files: tuple[str, ...] = ()
    arguments: dict[str, Any] = field(default_factory=dict)
    purpose: str = ""
    form: Literal["both", "command", "call"] = "both"
    steps: tuple[Remedy, ...] = ()

    def __hash__(self) -> int:
        return hash((self.action, self.files))

    @property
    def options(self) -> dict[str, Any]:
        """The arguments but where results go."""
        return {name: value for name, value in self.arguments.items() if name not in PLACES}

    @property
    def command(self) -> str:
        """The command, as it is typed; empty where there is none."""
        return "" if self.form == "call" else _commands[-1]()(self)

    @property
    def call(self) -> str:
        """The call in Python; empty where there is none."""
        if self.form == "command" or self.action not in _CALLS:
            return ""
        options = self.options
        if start := options.get("start"):
            values = ", ".join(f"{name}={value:.6g}" for name, value in start.items())
            return f"sc.calibrate(obs, camera.replace({values}))"
        for name, call in _OTHER_CALLS.items():
            if name in options:
                return call
        given = "".join(
            f", {name}={name if value is None else repr(value)}" for name, value in options.items()
        )
        return f"{_CALLS[self.action]}{given})"

    def at(self, known: Mapping[str, str]) -> Remedy:
        """The remedy with files in the place of what stands for them."""
        files = tuple(known.get(file, file) for file in self.files)
        arguments = {
            name: known.get(value, value) if isinstance(value, str) else value
            for name, value in self.arguments.items()
        }
        return replace(self, files=files, arguments=arguments)

    def having(self, **arguments: Any) -> Remedy:
        """The remedy with further arguments."""
        return replace(self, arguments=self.arguments | arguments)

    @property
    def words(self) -> str:
        """What to type or to call, in a sentence of its own: as the command line has it while it
        runs, and a call of a calibration with other options, whose stars may be in memory alone.
        """
        if _speakers:
            return _speakers[-1](self)
        return (OBS in self.files and self.options and self.call) or self.command or self.call

    def __str__(self) -> str:
        return f"run `{self.words}` {self.purpose}".rstrip()


Remedies: TypeAlias = tuple[Remedy, ...]
# How a remedy is typed is known to the command line, which stands above: a function that gives the
# function, called when a command is first shown.
_commands: list[Callable[[], Callable[[Remedy], str]]] = []


def register_commands(load: Callable[[], Callable[[Remedy], str]]) -> None:
    """Let a function write commands; `load` gives it when one is first shown."""
    _commands.append(load)


# What words a remedy in errors and notes; that of the command line, while it runs.
_speakers: list[Callable[[Remedy], str]] = []


@contextmanager
def spoken(speak: Callable[[Remedy], str]) -> Iterator[None]:
    """Let a function word the remedies of errors and notes."""
    _speakers.append(speak)
    try:
        yield
    finally:
        _speakers.pop()


def calibrated(form: Literal["both", "command"] = "both", **options: Any) -> Remedies:
    """Another calibration, with options."""
    return (Remedy("calibrate", (OBS, CAMERA), {"out": RUN, "force": True, **options}, "", form),)


def with_model(name: str) -> Remedies:
    """A calibration with a distortion model."""
    return calibrated(model=name)


def identified(**options: Any) -> Remedies:
    """Another run from images, with options."""
    arguments = {"out": RUN, "force": True, **options}
    return (Remedy("run", (SOME_IMAGES, CAMERA), arguments, form="command"),)


def read_remedies(text: str) -> Remedies:
    """The remedies of a check of the draws as earlier versions wrote them: commands and calls."""
    found: Remedies = ()
    for call in re.findall(r"sc\.(?:sample|calibrate)\(.*?\)(?= or |$)", text):
        body = ast.parse(call, mode="eval").body
        assert isinstance(body, ast.Call)
        given: dict[str, Any] = {
            str(word.arg): getattr(word.value, "value", None)  # None for the object of the user's
            for word in body.keywords
        }
        if call.startswith("sc.calibrate"):
            found += calibrated(**given)
        elif text.startswith(call):
            found += (Remedy("sample", (RUN,), given, form="call"),)
        else:
            found += (Remedy("sample", (RUN,), {"force": True, **given}),)
    return found + (PLAN if " plan " in text else ())


PLAN: Remedies = (Remedy("plan", (CAMERA,), {"after": RUN, "choose": 10}, form="command"),)
