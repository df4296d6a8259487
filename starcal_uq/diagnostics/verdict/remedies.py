"""Commands to try: the options that a check requests, among those that the run was made with, as a
command to copy.

A remedy changes options. They take the place of those of the same name, the whole has to pass what
the command line asks of it (`starcal_uq.core.conflicts`), and what the run or one before it in the
same folder was made with already is no remedy.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from starcal_uq.core.conflicts import conflict, named, takes_value
from starcal_uq.core.formatting import join_words
from starcal_uq.core.status import CALIBRATE, Check, Level
from starcal_uq.diagnostics.verdict.observed import FROM_IMAGES

_STARTS = (CALIBRATE, FROM_IMAGES)
MOST_COMMANDS = 3
# Runs after which a chain that did not get better ends.
_PATIENCE = 2
# Options by name, each with its values in the order given; None where it stands alone.
Options = dict[str, tuple[str | None, ...]]
# What a cause of doubt is called, in the order in which to look for them, and which data tell it
# from the others.
INPUT, LENS, NOISE, NUMERICS = "the input", "the lens", "the noise", "the computation"
_ORDER = (INPUT, LENS, NOISE, NUMERICS)
_TELLING = {
    INPUT: (
        "times in UTC and the site, or the statement that the camera was in space, for every frame"
    ),
    LENS: (
        "frames of the same stars at other places of the detector, shifted and turned by 90 degrees"
    ),
    NOISE: (
        "repeated exposures of one field, whose scatter is noise alone, with times and temperatures"
    ),
    NUMERICS: "more frames, spread over the sky",
}
_CAUSES = {
    "catalogue_directions": INPUT,
    "one_camera": INPUT,
    "screening": INPUT,
    "outliers": INPUT,
    "data_of_the_posterior": INPUT,
    "noise_of_the_files": INPUT,
    "pattern_in_the_residuals": LENS,
    "unexplained_structure": LENS,
    "distortion_model": LENS,
    "terms_of_the_distortion": LENS,
    "model_that_the_data_determine": LENS,
    "two_estimators": NUMERICS,
    "evenness_of_the_noise": NOISE,
    "jackknife_over_frames": NOISE,
    "errors_of_the_stars": NOISE,
    "posterior_predictive_check": NOISE,
    "centroid_noise_per_axis": NOISE,
    "factor_on_the_stated_noise": NOISE,
    "factor_on_the_fitted_noise": NOISE,
}
_OF_OPTIONS = {
    INPUT: {"--site", "--in-space", "--directions", "--time", "--only-frames", "--screen"},
    LENS: {"--model"},
    NOISE: {"--noise", "--robust", "--star-errors", "--accept-inflation"},
}
# Options that a new one makes meaningless: a place on the ground and one in space, directions made
# and declared.
_ENDS = {
    "--site": ("--in-space", "--observer-velocity"),
    "--in-space": ("--site",),
}


@dataclass(frozen=True)
class Tried:
    """An earlier run in the same folder and of the same data: its options, and how many checks did
    not pass.
    """

    options: Options
    failed: int
    warned: int

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Tried:
        """From the record of a run."""
        options = {name: tuple(values) for name, values in record["options"].items()}
        return cls(options, int(record["failed"]), int(record["warned"]))

    @property
    def text(self) -> str:
        """The options as they are typed."""
        return shlex.join(written(self.options)) or "no option"


def cause_of(check: Check) -> str:
    """What a check that did not pass points to: the input, the lens, the noise, or the
    computation.
    """
    if check.key in _CAUSES:
        return _CAUSES[check.key]
    asked = set(check.remedy.split())
    return next((cause for cause, options in _OF_OPTIONS.items() if options & asked), NUMERICS)


def by_cause(checks: Sequence[Check]) -> dict[str, list[Check]]:
    """Checks that did not pass by what they point to, in the order in which to look for it;
    failures first.
    """
    ranked = sorted((c for c in checks if c.level is not Level.PASS), key=lambda c: -c.level.rank)
    found = {cause: [check for check in ranked if cause_of(check) == cause] for cause in _ORDER}
    present = sorted(
        (cause for cause in _ORDER if found[cause]), key=lambda cause: -found[cause][0].level.rank
    )
    return {cause: found[cause] for cause in present}


def parsed(words: Sequence[str]) -> tuple[list[str], Options]:
    """Command and files of a command line, and its options."""
    places: list[str] = []
    options: Options = {}
    rest = iter(words)
    for word in rest:
        if not word.startswith("--"):
            places.append(word)
            continue
        name, equals, value = word.partition("=")
        given = value if equals else next(rest, None) if takes_value(name) else None
        options[name] = (*options.get(name, ()), given)
    return places, options


def written(options: Options) -> list[str]:
    """Options as words."""
    return [
        word
        for name, values in options.items()
        for value in values
        for word in (name, value)
        if word is not None
    ]


def changed(given: Options, asked: Options) -> Options:
    """The options that are given, with those that are asked for in the place of what they
    replace.
    """
    left = {
        name: values
        for name, values in given.items()
        if not any(name in _ENDS.get(one, ()) for one in asked)
    }
    if "--site" in asked and left.get("--directions", ("catalogue",))[-1] != "catalogue":
        # Directions are made apparent at a site, and must not be declared so.
        left = left | {"--directions": ("catalogue",)}
    return left | asked


@dataclass(frozen=True)
class Place:
    """Where a run is and what made it, so that remedies can be commands to copy."""

    run: str  # The folder
    # Command line that made all of it, without the program and the folder; empty where it was made
    # step by step.
    words: tuple[str, ...] = ()
    observations: bool = True  # Whether the folder holds observations
    tried: tuple[Tried, ...] = ()  # Runs that this one has replaced, the latest last
    partitioned: bool = False  # Whether the data are a folder of files

    @property
    def made(self) -> tuple[list[str], Options]:
        """Files and options of the command that made the run."""
        places, options = parsed(self.words)
        return places[1:], options

    def exact(self, check: Check) -> Check:
        """A check whose commands name the files of this run; those that cannot help it are left
        out.
        """
        kept: list[str] = []
        reasons: list[str] = []
        followed = True
        for one in check.remedies:
            if one.startswith("sc."):
                kept += [one] if followed else []
                continue
            refused = self.refused(one)
            followed = not refused
            kept += [self.command(one)] if followed else []
            reasons += [refused] if refused else []
        advice = check.advice
        if check.remedy and not kept and not advice:
            advice = (
                "Look for the cause in the instrument or the data: "
                f"{join_words(list(dict.fromkeys(reasons)))}."
            )
        remedy = " or ".join(kept)
        return check if remedy == check.remedy else replace(check, remedy=remedy, advice=advice)

    def refused(self, text: str) -> str:
        """Why a command for a calibration is of no use here: it was given, tried, or is against
        options of this run.
        """
        asked = self._asked(text)
        if not asked:
            return ""
        words = shlex.join(written(asked))
        if "UTC" in written(asked):
            return "the times are not known"
        if asked.get("--site") == ("SITE",):
            return "the site is not known"
        _, given = self.made
        if all(given.get(name) == values for name, values in asked.items()):
            return f"the run was made with {words} already"
        options = changed(given, asked)
        if any(options == one.options for one in self.tried):
            return f"{words} was tried already"
        if rule := conflict(named(options) | {"partitioned": self.partitioned}):
            return (
                f"the run was made with options that {words} excludes ({rule.name}, {rule.other})"
            )
        return ""

    def _asked(self, text: str) -> Options:
        start = next((words for words in _STARTS if text.startswith(words)), "")
        return parsed(shlex.split(text.removeprefix(start)))[1] if start else {}

    def _near(self, asked: Options) -> tuple[Options, str]:
        """Options with a file for a site that the residuals point to, and the command that writes
        it, before them.
        """
        place = re.fullmatch(r"SITE:(.+),(.+)", str(asked.get("--site", ("",))[-1]))
        if place is None:
            return asked, ""
        file = f"{self.run}-site.toml"
        new = shlex.join(
            ["starcal-uq", "new", "site", "--near", place[1], place[2], "-o", file, "--force"]
        )
        return asked | {"--site": (file,)}, f"{new} && "

    def command(self, text: str) -> str:
        """A command with the files of this run in place of OBS, CAMERA, SITE and RUN; a call in
        Python as it is.
        """
        if not text.startswith("starcal-uq"):
            return text
        start = next((words for words in _STARTS if text.startswith(words)), "")
        if start and self.words[:1] in (("run",), ("calibrate",)):
            # Everything that was asked for then, and this. What was calibrated alone is kept beside
            # the run.
            files, given = self.made
            asked, first = self._near(self._asked(text))
            options = written(changed(given, asked))
            folder = [self.run] if self.words[0] == "run" else [f"{self.run}-2"]
            text = (
                f"{first}starcal-uq {shlex.join(['run', *files, *options, '-o', *folder])} --force"
            )
        elif start == CALIBRATE and self.observations:
            files = [
                f"{self.run}/observations.parquet",
                f"{self.run}/camera.toml",
                "-o",
                f"{self.run}-2",
            ]
            asked, first = self._near(self._asked(text))
            text = f"{first}starcal-uq run {shlex.join([*files, *written(asked)])} --force"
        words, known = text.split(" "), {"RUN": shlex.quote(self.run)}
        if not {"OBS", "IMAGES..."} & set(words):
            known["CAMERA"] = shlex.quote(f"{self.run}/camera.toml")
        return " ".join(known.get(word, word) for word in words)

    def exhausted(self, checks: Sequence[Check]) -> bool:
        """Whether the last runs of this folder did not get better, so that the next would not
        either.
        """
        counts = [(one.failed, one.warned) for one in self.tried] + [counted(checks)]
        return len(counts) > _PATIENCE and min(counts[-_PATIENCE:]) >= counts[-1 - _PATIENCE]


def counted(checks: Sequence[Check]) -> tuple[int, int]:
    """How many checks failed, and how many gave a warning."""
    levels = [check.level for check in checks]
    return levels.count(Level.FAIL), levels.count(Level.WARN)


def telling(checks: Sequence[Check]) -> str:
    """Which data would tell what is behind checks that did not pass."""
    causes = by_cause(checks)
    return _TELLING[next(iter(causes), NUMERICS)]
