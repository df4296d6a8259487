"""How a solver ended, what a check found, and what the user can do about either."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

from starcal_uq.core.remedy import Remedies


class Status(Enum):
    """How an estimation ended; the value is the remedy, in words."""

    CONVERGED = "converged"
    MAX_ITERATIONS = (
        "the iteration limit was reached first: start closer to the optimum (--start) or raise "
        "max_iterations "
        "(--max-iterations)"
    )
    SINGULAR = (
        "the data do not determine every parameter: add frames or stars spread over the field, "
        "or choose a distortion model with fewer coefficients"
    )
    STALLED = (
        "no step lowers the cost although the gradient is not zero: check the scale of the start "
        "values"
    )
    OUTSIDE_DETECTOR = (
        "the principal point left the detector: check the identifications and the nominal camera, "
        "or use solver='ipopt', which keeps it inside"
    )
    FOLDED = (
        "the distortion folds over inside the field: choose a model with fewer coefficients or "
        "use solver='ipopt', "
        "which keeps the distortion monotonic"
    )
    NOT_FINITE = (
        "the model is not finite at the start: check the nominal camera against the observations"
    )
    INCONSISTENT = (
        "the fit is far worse than centroid noise can explain: check the star identifications, "
        "the parity of the axes and the nominal focal length"
    )

    @property
    def ok(self) -> bool:
        """True for a converged estimate."""
        return self is Status.CONVERGED

    @property
    def remedy(self) -> str:
        """What the user can do, in one clause."""
        return self.value


class Level(Enum):
    """Outcome of a check, worst last."""

    PASS = "pass"
    WARN = "warning"
    FAIL = "fail"

    @property
    def rank(self) -> int:
        """0, 1 or 2."""
        return list(Level).index(self)

    @property
    def exit_status(self) -> int:
        """Exit status of a command that ends with this outcome: 1 for a failed check, 0
        otherwise.
        """
        return int(self is Level.FAIL)


class Question(Enum):
    """What a check helps to answer: did it converge, can it be trusted, and is it enough for the
    mission?
    """

    CONVERGED = "converged"
    TRUSTWORTHY = "trustworthy"
    REQUIRED = "required"


@dataclass(frozen=True)
class Check:
    """One check: what was measured, what was asked for, and what follows.

    Attributes
    ----------
    name : str
        Short name.
    question : Question
        Question that it helps to answer.
    level : Level
        Outcome.
    value : str
        What was found, with its unit.
    bound : str
        What was asked for, with its unit.
    sentence : str
        Meaning, in plain words.
    remedies : tuple of Remedy
        What may mend it; empty where it passed or nothing of the kind helps.
    advice : str
        What to do with the instrument or the data, an order: before the command, or where none
        helps; else empty. Of a check that did not pass, remedy and advice are never both empty.
    """

    DOCUMENTED: ClassVar = ("key",)
    WRITTEN_AS: ClassVar = {"remedies": "remedy"}

    name: str
    question: Question
    level: Level
    value: str
    bound: str
    sentence: str
    remedies: Remedies = ()
    advice: str = ""

    @property
    def ways(self) -> tuple[tuple[str, bool], ...]:
        """The commands and calls of the remedies, and whether each is a call in Python."""
        both = [way for one in self.remedies for way in ((one.command, False), (one.call, True))]
        return tuple(way for way in both if way[0])

    @property
    def remedy(self) -> str:
        """Command or Python call that may mend it, several joined by " or "; empty where it passed
        or nothing of the kind helps. OBS, CAMERA, SITE and RUN stand for the user's files, ``obs``,
        ``camera`` and ``cal`` for results.
        """
        return " or ".join(text for text, _ in self.ways)

    @property
    def key(self) -> str:
        """The name as files have it: small letters, digits and underscores."""
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_")

    @property
    def phrase(self) -> str:
        """The name for use within a sentence: no capital, unless it starts with a symbol such as
        R-hat.
        """
        return self.name if self.name[1:2] == "-" else self.name[0].lower() + self.name[1:]

    def __str__(self) -> str:
        remedy = f"Remedy: {self.remedy}" if self.remedy else ""
        said = " ".join(filter(None, (self.sentence, self.advice, remedy)))
        return f"{self.level.value}: {self.name}, {self.value} (asked for: {self.bound}). {said}"


def worst(checks: Iterable[Check]) -> Level:
    """The worst outcome among checks."""
    return max((check.level for check in checks), key=lambda level: level.rank, default=Level.PASS)


def pass_or_fail(good: bool) -> Level:
    """For checks that decide whether the numbers may be used at all."""
    return Level.PASS if good else Level.FAIL


def pass_or_warn(good: bool) -> Level:
    """For checks whose outcome a reader may accept."""
    return Level.PASS if good else Level.WARN
