"""Remedies as commands: the one place where they are spelt."""

from __future__ import annotations

import shlex
import sys

from starcal_uq.cli.runfiles import typed
from starcal_uq.core.conflicts import arguments_of, parsed, without, words_of
from starcal_uq.core.provenance import NAME
from starcal_uq.core.remedy import CAMERA, OBS, RUN, Near, Remedy
from starcal_uq.core.runfile import edited
from starcal_uq.core.settings import joined_effects
from starcal_uq.diagnostics.verdict.remedies import changed

# Commands whose options have the names of the settings of a calibration.
_CALIBRATING = ("calibrate", "run")


def command(remedy: Remedy) -> str:
    """What to type, all of it in one line."""
    steps = remedy.steps or (remedy,)
    return " && ".join(shlex.join([NAME, *_words(step)]) for step in steps)


def as_given(remedy: Remedy) -> str:
    """What to type; for a calibration of the table that was given, the command that was given, and
    what it asks for.
    """
    made = sys.argv[1:2] in (["calibrate"], ["run"])
    if not made or remedy.files != (OBS, CAMERA) or remedy.arguments.get("out") != RUN:
        return remedy.command or remedy.call
    asked = {name: value for name, value in remedy.arguments.items() if name != "out"}
    words = sys.argv[1:]
    if file := typed():
        here = arguments_of(parsed(words)[1])
        wanted = changed(here, arguments_of(parsed(words_of(remedy.options))[1]))
        edits = edited(here, wanted)
        keys = {edit.partition("=")[0] for edit in edits}
        kept, earlier = without(without(file, "--force")[0], "--set")
        edits = (*(edit for edit in earlier if edit and edit.partition("=")[0] not in keys), *edits)
        return shlex.join([NAME, *kept, *words_of({"set": edits, "force": True})])
    if "effects" in asked:
        # An option that is given twice would hold the last list alone.
        words, given = without(words, "--effects")
        asked["effects"] = joined_effects(*given, asked["effects"])
    return shlex.join([NAME, *words, *words_of(asked)])


def _words(remedy: Remedy) -> list[str]:
    words = [*remedy.action.split(), *remedy.files]
    for name, value in remedy.arguments.items():
        if name == "out":
            words += ["-o", value]
        elif name == "near" and isinstance(value, Near):
            words += ["--near", *(f"{angle:.1f}" for angle in value)]
        elif remedy.action in _CALIBRATING:
            words += words_of({name: value})
        else:
            words.append(f"--{name.removeprefix('n_').replace('_', '-')}")
            words += [] if value is True else [str(value)]
    return words
