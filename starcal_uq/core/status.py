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


class Code(Enum):
    """What a check asks: its title, and the question that it helps to answer."""

    ESTIMATION = "Estimation", Question.CONVERGED
    MODEL_THAT_THE_DATA_DETERMINE = "Model that the data determine", Question.TRUSTWORTHY
    TWO_ESTIMATORS = "Two estimators", Question.CONVERGED
    OTHER_STARTS = "Other starts", Question.CONVERGED
    DATA_OF_THE_POSTERIOR = "Data of the posterior", Question.CONVERGED
    R_HAT = "R-hat", Question.CONVERGED
    EFFECTIVE_DRAWS = "Effective draws", Question.CONVERGED
    ACCEPTANCE = "Acceptance", Question.CONVERGED
    DERIVED_QUANTITIES = "Derived quantities", Question.CONVERGED
    DIGITS = "Digits", Question.CONVERGED
    DEGREES_OF_FREEDOM = "Degrees of freedom", Question.CONVERGED
    BOUNDS = "Bounds", Question.CONVERGED
    INDEPENDENT_POSTERIOR = "Independent posterior", Question.TRUSTWORTHY
    LIKELIHOOD = "Likelihood", Question.TRUSTWORTHY
    KIND_OF_LIKELIHOOD = "Kind of likelihood", Question.TRUSTWORTHY
    METHOD_OF_THE_CALIBRATION = "Method of the calibration", Question.TRUSTWORTHY
    INFLUENCE_OF_THE_PRIORS = "Influence of the priors", Question.TRUSTWORTHY
    CATALOGUE_DIRECTIONS = "Catalogue directions", Question.TRUSTWORTHY
    PATTERN_IN_THE_RESIDUALS = "Pattern in the residuals", Question.TRUSTWORTHY
    OUTLIERS = "Outliers", Question.TRUSTWORTHY
    SCREENING = "Screening", Question.TRUSTWORTHY
    FACTOR_ON_THE_STATED_NOISE = "Factor on the stated noise", Question.TRUSTWORTHY
    FACTOR_ON_THE_FITTED_NOISE = "Factor on the fitted noise", Question.TRUSTWORTHY
    CENTROID_NOISE_PER_AXIS = "Centroid noise per axis", Question.TRUSTWORTHY
    NOISE_OF_THE_FILES = "Noise of the files", Question.TRUSTWORTHY
    TERMS_OF_THE_DISTORTION = "Terms of the distortion", Question.TRUSTWORTHY
    COVERAGE_OF_THE_FIELD = "Coverage of the field", Question.TRUSTWORTHY
    UNEXPLAINED_STRUCTURE = "Unexplained structure", Question.TRUSTWORTHY
    EVENNESS_OF_THE_NOISE = "Evenness of the noise", Question.TRUSTWORTHY
    ONE_CAMERA = "One camera", Question.TRUSTWORTHY
    JACKKNIFE_OVER_FRAMES = "Jackknife over frames", Question.TRUSTWORTHY
    ERRORS_OF_THE_STARS = "Errors of the stars", Question.TRUSTWORTHY
    DISTORTION_MODEL = "Distortion model", Question.TRUSTWORTHY
    POSTERIOR_PREDICTIVE_CHECK = "Posterior predictive check", Question.TRUSTWORTHY
    PROPAGATION_TO_ATTITUDE = "Propagation to attitude", Question.TRUSTWORTHY
    KNOWN_TRUTH = "Known truth", Question.TRUSTWORTHY
    REQUIREMENT = "Requirement", Question.REQUIRED  # Of a budget, by its name


# Codes by their titles.
CODES = {code.value[0]: code for code in Code}


@dataclass(frozen=True)
class Check:
    """One check: what was measured, what was asked for, and what follows.

    Attributes
    ----------
    code : Code
        What it asks.
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
    title : str
        Name of what has one of its own, such as a requirement; else empty.
    """

    DOCUMENTED: ClassVar = ("key",)
    WRITTEN_AS: ClassVar = {"code": ("name", "question"), "remedies": ("remedy",), "title": ()}

    code: Code
    level: Level
    value: str
    bound: str
    sentence: str
    remedies: Remedies = ()
    advice: str = ""
    title: str = ""

    @property
    def name(self) -> str:
        """Short name."""
        return self.title or self.code.value[0]

    @property
    def question(self) -> Question:
        """Question that it helps to answer."""
        return self.code.value[1]

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
