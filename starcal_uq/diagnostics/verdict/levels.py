"""What a check is, and how it can end."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """Outcome of a check, worst last."""

    PASS = "pass"
    WARN = "warning"
    FAIL = "fail"

    @property
    def rank(self) -> int:
        """0, 1 or 2."""
        return list(Level).index(self)


class Question(Enum):
    """What a check helps to answer."""

    CONVERGED = "Did it converge?"
    TRUSTWORTHY = "Can it be trusted?"


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes
    ----------
    name : str
        Short name.
    question : Question
        What it helps to answer.
    level : Level
        Outcome.
    value, threshold : str
        What was measured and what was asked for, with units.
    sentence : str
        What it means, in plain words.
    """

    name: str
    question: Question
    level: Level
    value: str
    threshold: str
    sentence: str

    @property
    def phrase(self) -> str:
        """The name for use within a sentence: no capital, unless it starts with a symbol such as R-hat."""
        return self.name if self.name[1:2] == "-" else self.name[0].lower() + self.name[1:]


def pass_or_fail(good: bool) -> Level:
    """For checks that decide whether the numbers may be used at all."""
    return Level.PASS if good else Level.FAIL


def pass_or_warn(good: bool) -> Level:
    """For checks whose outcome a reader may accept."""
    return Level.PASS if good else Level.WARN
