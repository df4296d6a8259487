"""Commands to try: the options that a check requests, among those that the run was made with, as a
command to copy.

A remedy changes options. They take the place of those of the same name, the whole has to pass what
the command line asks of it (`starcal_uq.core.conflicts`), and what the run or one before it in the
same folder was made with already is no remedy.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, get_args

from starcal_uq.core.conflicts import (
    arguments_of,
    conflict,
    parsed,
    sampled_by_default,
    words_of,
)
from starcal_uq.core.findings import Finding
from starcal_uq.core.remedy import CAMERA, OBS, RUN, SITE, SOME_IMAGES, UTC, Near, Remedies, Remedy
from starcal_uq.core.runfile import edited
from starcal_uq.core.settings import WEIGHING, EffectName, effect_names, joined_effects
from starcal_uq.core.status import Advice, Check, Code, Level, Order
from starcal_uq.core.types import AnyDict

MOST_COMMANDS = 3
# Runs after which a chain that did not get better ends.
_PATIENCE = 2
# What a cause of doubt is called, in the order in which to look for them.
INPUT, LENS, NOISE, NUMERICS = "the input", "the lens", "the noise", "the computation"
_ORDER = (INPUT, LENS, NOISE, NUMERICS)
_OF_CAUSES = {
    INPUT: """
        CATALOGUE_DIRECTIONS ONE_CAMERA KNOWN_ROTATIONS SCREENING OUTLIERS
        DATA_OF_THE_POSTERIOR NOISE_OF_THE_FILES
    """,
    LENS: """
        PATTERN_IN_THE_RESIDUALS UNEXPLAINED_STRUCTURE DISTORTION_MODEL
        TERMS_OF_THE_DISTORTION MODEL_THAT_THE_DATA_DETERMINE
    """,
    NUMERICS: """
        TWO_ESTIMATORS
    """,
    NOISE: """
        EVENNESS_OF_THE_NOISE JACKKNIFE_OVER_FRAMES ERRORS_OF_THE_STARS
        POSTERIOR_PREDICTIVE_CHECK CENTROID_NOISE_PER_AXIS FACTOR_ON_THE_STATED_NOISE
        FACTOR_ON_THE_FITTED_NOISE
    """,
}
_CAUSES = {Code[name]: cause for cause, names in _OF_CAUSES.items() for name in names.split()}
# Actions whose options these are.
_CALIBRATING = ("calibrate", "run")
_OF_NOISE = {"star", *WEIGHING}
_OF_OPTIONS = {
    INPUT: {"site", "in_space", "directions", "time", "frames", "screening"},
    LENS: {"model", "auto"} | set(get_args(EffectName)) - _OF_NOISE,
    NOISE: _OF_NOISE,
}
# Options that a new one makes meaningless: a place on the ground and one in space, directions made
# and declared.
_ENDS = {
    "site": ("in_space", "observer_velocity"),
    "in_space": ("site",),
}


# Why a calibration is of no use to a run.
Refusal = Enum(
    "Refusal",
    """
    TIMES_UNKNOWN SITE_UNKNOWN MADE_WITH TRIED EXCLUDED
    """,
)


@dataclass(frozen=True)
class Tried:
    """An earlier run in the same folder and of the same data: its options, and how many checks did
    not pass.
    """

    options: dict[str, Any]
    failed: int
    warned: int

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Tried:
        """From the record of a run."""
        options = arguments_of(record["options"])
        return cls(options, int(record["failed"]), int(record["warned"]))

    @property
    def text(self) -> str:
        """The options as they are typed."""
        return shlex.join(words_of(self.options)) or "no option"


def cause_of(check: Check) -> str:
    """What a check that did not pass points to: the input, the lens, the noise, or the
    computation.
    """
    if check.code in _CAUSES:
        return _CAUSES[check.code]
    made = [one.arguments for one in check.remedies if one.action in _CALIBRATING]
    asked = {name for given in made for name in (*given, *effect_names(given.get("effects")))}
    return next((cause for cause, options in _OF_OPTIONS.items() if options & asked), NUMERICS)


def by_cause(checks: Sequence[Check]) -> dict[str, list[Check]]:
    """Checks that did not pass by what they point to, in the order in which to look for it;
    failures first.
    """
    ranked = sorted((c for c in checks if c.level is not Level.PASS), key=lambda c: -c.level.rank)
    found = {cause: [check for check in ranked if cause_of(check) == cause] for cause in _ORDER}
    present = sorted(filter(found.get, _ORDER), key=lambda cause: -found[cause][0].level.rank)
    return {cause: found[cause] for cause in present}


def changed(given: AnyDict, asked: AnyDict, effects: str = "none") -> AnyDict:
    """The options that are given, with those that are asked for in the place of what they
    replace; effects are added to those that are given, or else to `effects`.
    """
    ended = {name for one in asked for name in _ENDS.get(one, ())}
    left = {name: value for name, value in given.items() if name not in ended}
    if "site" in asked and "directions" in left:
        # Directions are made apparent at a site, and must not be declared so.
        left["directions"] = "catalogue"
    if "effects" in asked:
        asked = asked | {"effects": joined_effects(given.get("effects", effects), asked["effects"])}
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
    held: tuple[str, ...] = ()  # Effects of its calibration
    file: str = ""  # The run file that repeats it

    @property
    def made(self) -> tuple[tuple[str, ...], dict[str, Any]]:
        """Files and options of the command that made the run."""
        places, options = parsed(self.words)
        return tuple(places[1:]), arguments_of(options)

    @property
    def effects(self) -> str:
        """Effects of a run that none were typed for: `run` looks for them where it may."""
        _, given = self.made
        selecting = {"sampled": None, **given, "effects": "auto", "partitioned": self.partitioned}
        alone = self.words[:1] != ("run",) or conflict(selecting)
        return "none" if alone else "auto"

    def exact(self, check: Check) -> Check:
        """A check whose commands name the files of this run; those that cannot help it are left
        out.
        """
        reasons = {one: self.refused(one) for one in check.remedies}
        kept = tuple(self.of(one) for one, reason in reasons.items() if not reason)
        orders = check.orders
        if check.remedies and not kept and not check.advice:
            why = tuple(reason for reason in reasons.values() if reason)
            orders = (Order(Advice.LOOK_FOR_THE_CAUSE, {"reasons": why}),)
        return replace(check, remedies=kept, orders=orders)

    def refused(self, remedy: Remedy) -> Finding | None:
        """Why a calibration is of no use here: it was given, tried, or is against options of this
        run.
        """
        asked = _asked(remedy)
        if not asked:
            return None
        if UTC in asked.values():
            return Finding(Refusal.TIMES_UNKNOWN)
        if asked.get("site") == SITE:
            return Finding(Refusal.SITE_UNKNOWN)
        _, given = self.made
        here = given | {"effects": joined_effects(given.get("effects", self.effects), self.held)}
        if all(here.get(name) == value for name, value in changed(here, asked).items()):
            return Finding(Refusal.MADE_WITH, {"asked": asked})
        options = changed(given, asked, self.effects)
        if any(options == one.options for one in self.tried):
            return Finding(Refusal.TRIED, {"asked": asked})
        settings = {"sampled": sampled_by_default(options)} | options
        if rule := conflict(settings | {"partitioned": self.partitioned}):
            excluded = {"asked": asked, "name": rule.name, "other": rule.other}
            return Finding(Refusal.EXCLUDED, excluded)
        return None

    def of(self, remedy: Remedy) -> Remedy:
        """A remedy with the files of this run in place of OBS, CAMERA, SITE and RUN."""
        known = {RUN: self.run}
        if not {OBS, SOME_IMAGES} & set(remedy.files):
            known[CAMERA] = f"{self.run}/camera.toml"
        steps: tuple[Remedy, ...] = (remedy.at(known),)
        if OBS not in remedy.files and SOME_IMAGES not in remedy.files:
            return replace(remedy, steps=steps)
        asked = _asked(remedy)
        first: Remedies = ()
        if isinstance(near := remedy.arguments.get("site"), Near):
            # A file for the site that the residuals point to.
            file = f"{self.run}-site.toml"
            first = (Remedy("new site", (), {"near": near, "out": file, "force": True}),)
            asked["site"] = file
        if self.words[:1] in (("run",), ("calibrate",)):
            # Everything that was asked for then, and this. What was calibrated alone is kept beside
            # the run.
            files, given = self.made
            out = self.run if self.words[0] == "run" else f"{self.run}-2"
            options = changed(given, asked, self.effects)
            steps = (
                Remedy("run", (self.file,), {"set": edited(given, options), "force": True})
                if self.file
                else Remedy("run", files, options | {"out": out, "force": True}),
            )
        elif OBS in remedy.files and self.observations:
            files = (f"{self.run}/observations.parquet", f"{self.run}/camera.toml")
            steps = (Remedy("run", files, {"out": f"{self.run}-2", **asked, "force": True}),)
        else:
            first = ()
        return replace(remedy, steps=(*first, *steps))

    def exhausted(self, checks: Sequence[Check]) -> bool:
        """Whether the last runs of this folder did not get better, so that the next would not
        either.
        """
        counts = [(one.failed, one.warned) for one in self.tried] + [counted(checks)]
        return len(counts) > _PATIENCE and min(counts[-_PATIENCE:]) >= counts[-1 - _PATIENCE]


def _asked(remedy: Remedy) -> dict[str, Any]:
    """The options that a calibration is to have, as they are typed."""
    if not {OBS, SOME_IMAGES} & set(remedy.files):
        return {}
    return arguments_of(parsed(words_of(remedy.options))[1])


def counted(checks: Sequence[Check]) -> tuple[int, int]:
    """How many checks failed, and how many gave a warning."""
    levels = [check.level for check in checks]
    return levels.count(Level.FAIL), levels.count(Level.WARN)
