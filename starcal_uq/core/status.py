"""How a solver ended, what a check found, and what the user can do about either."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from operator import ge, gt, le, lt
from typing import Any, ClassVar

from starcal_uq.core.findings import Finding, worded
from starcal_uq.core.remedy import Remedies


class Status(Enum):
    """End of an estimation; the value is the remedy, in words."""

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
        """Remedy, in one clause."""
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


# What a check asks, in the words of its title. A requirement is one of a budget, by its name.
Code = Enum(
    "Code",
    """
    ESTIMATION MODEL_THAT_THE_DATA_DETERMINE TWO_ESTIMATORS OTHER_STARTS KNOWN_ROTATIONS
    DATA_OF_THE_POSTERIOR R_HAT EFFECTIVE_DRAWS ACCEPTANCE DERIVED_QUANTITIES DIGITS
    DEGREES_OF_FREEDOM BOUNDS INDEPENDENT_POSTERIOR LIKELIHOOD KIND_OF_LIKELIHOOD
    METHOD_OF_THE_CALIBRATION INFLUENCE_OF_THE_PRIORS CATALOGUE_DIRECTIONS
    PATTERN_IN_THE_RESIDUALS OUTLIERS SCREENING FACTOR_ON_THE_STATED_NOISE
    FACTOR_ON_THE_FITTED_NOISE CENTROID_NOISE_PER_AXIS NOISE_OF_THE_FILES
    TERMS_OF_THE_DISTORTION COVERAGE_OF_THE_FIELD UNEXPLAINED_STRUCTURE EVENNESS_OF_THE_NOISE
    ONE_CAMERA JACKKNIFE_OVER_FRAMES ERRORS_OF_THE_STARS DISTORTION_MODEL
    POSTERIOR_PREDICTIVE_CHECK PROPAGATION_TO_ATTITUDE KNOWN_TRUTH REQUIREMENT
    """,
)
# The questions that checks help to answer; the others ask whether the result is trustworthy.
_OF_QUESTIONS = {
    Question.CONVERGED: """
        ESTIMATION TWO_ESTIMATORS OTHER_STARTS DATA_OF_THE_POSTERIOR R_HAT EFFECTIVE_DRAWS
        ACCEPTANCE DERIVED_QUANTITIES DIGITS DEGREES_OF_FREEDOM BOUNDS
    """,
    Question.REQUIRED: "REQUIREMENT",
}
_QUESTIONS = {Code[name]: asked for asked, names in _OF_QUESTIONS.items() for name in names.split()}


def title_of(code: Code) -> str:
    """The title of a check."""
    return "R-hat" if code is Code.R_HAT else code.name.capitalize().replace("_", " ")


# Codes by their titles.
CODES = {title_of(code): code for code in Code}


# What to do with the instrument or the data.
Advice = Enum(
    "Advice",
    """
    FRAMES_THAT_HELP ANOTHER_PRIOR SAMPLE_WITH_OBSERVATIONS LOOK_FOR_THE_CAUSE MEND_THE_ESTIMATE
    NEARER_START ACCEPT_THE_FOCAL_LENGTH FRAMES_APART ACCEPT_THE_PHASE LEAVE_OUT_MAGNITUDES
    CHECK_THE_DIRECTIONS WITHOUT_STAR_ERRORS WITHOUT_ROTATIONS COUNT_THE_PATTERN STATE_THE_SITE
    GIVE_THE_DIRECTIONS CORRECT_THE_EPOCH CORRECT_THE_TIMES GIVE_MEASURED_CENTROIDS
    STATE_NOISE_IN_PX DIVIDE_THE_NOISE ACCEPT_THE_FACTOR LOOK_AT_THE_FILE LET_THE_RULE_JUDGE
    STATE_WHAT_IS_MISSING REDUCE_OR_RELAX
    """,
)


# What is worth telling beside checks.
Note = Enum(
    "Note",
    """
    PAIRS_AS_INDEPENDENT WRONG_TIMES REFRACTION_IN_THE_RESIDUALS REFRACTION_CORRECTED
    CONDITIONAL_ON_REFRACTION REFRACTION_ESTIMATED LIKE_REFRACTION WITHOUT_REFRACTION
    APPARENT_DIRECTIONS DIRECTIONS_WITHOUT_ABERRATION RESTS_ON_ABERRATION ABERRATION
    ADDED_NOISE_TOO_LARGE NOISE_IS_THE_MAGNITUDES NOISE_LIKE_MAGNITUDES NOISE_LIKE_ARCSECONDS
    MODEL_IS_WRONG HEADLINE NOT_USABLE
    """,
)


@dataclass(frozen=True)
class Order(Finding):
    """A piece of advice: an order, with its values."""

    code: Advice


# What goes with the command that plans frames.
MORE = (Order(Advice.FRAMES_THAT_HELP),)


@dataclass(frozen=True)
class Words:
    """The words of a check: value, bound, meaning, and what to do with instrument or data."""

    value: str
    bound: str
    sentence: str
    advice: str = ""


@dataclass(frozen=True)
class Check(Finding):
    """One check: the measured value, its bound, and the consequence.

    Attributes
    ----------
    code : Code
        What it asks.
    values : dict
        What was found, by names that end in the unit.
    level : Level
        Outcome.
    bounds : dict
        What was asked for, by such names.
    remedies : tuple of Remedy
        What may mend it; empty where it passed or nothing of the kind helps.
    orders : tuple of Order
        What to do with the instrument or the data: before the command, or where none helps; else
        empty. Of a check that did not pass, remedies and orders are never both empty.
    title : str
        Name of what has one of its own, such as a requirement; else empty.
    told : Words, optional
        Words of a check in a file of an earlier version, which has no values.
    """

    DOCUMENTED: ClassVar = ("key",)
    WRITTEN_AS: ClassVar = {
        "code": ("name", "question"),
        "values": (),
        "bounds": ("value", "bound", "sentence"),
        "remedies": ("remedy",),
        "orders": ("advice",),
        "title": (),
        "told": (),
    }

    code: Code
    level: Level = Level.PASS
    bounds: dict[str, Any] = field(default_factory=dict)
    remedies: Remedies = ()
    orders: tuple[Order, ...] = ()
    title: str = ""
    told: Words | None = None

    __hash__ = Finding.__hash__

    @cached_property
    def words(self) -> Words:
        """The check in words."""
        return self.told or Words(*worded(self))

    @property
    def value(self) -> str:
        """Measured value, with its unit."""
        return self.words.value

    @property
    def bound(self) -> str:
        """Required value, with its unit."""
        return self.words.bound

    @property
    def sentence(self) -> str:
        """Meaning, in plain words."""
        return self.words.sentence

    @property
    def advice(self) -> str:
        """Advice about the instrument or the data: before the command, or if no command helps; else
        empty. A check that did not pass has a remedy, an advice, or both.
        """
        told = "" if self.told is None else self.told.advice
        return " ".join(filter(None, (told, *(order.sentence for order in self.orders))))

    @property
    def name(self) -> str:
        """Short name."""
        return self.title or title_of(self.code)

    @property
    def question(self) -> Question:
        """Question that the check answers."""
        return _QUESTIONS.get(self.code, Question.TRUSTWORTHY)

    @property
    def ways(self) -> tuple[tuple[str, bool], ...]:
        """The commands and calls of the remedies, and whether each is a call in Python."""
        both = [way for one in self.remedies for way in ((one.command, False), (one.call, True))]
        return tuple(way for way in both if way[0])

    @property
    def remedy(self) -> str:
        """Command or Python call that may correct it, several joined by " or "; empty if the check
        passed or none helps. OBS, CAMERA, SITE and RUN are the user's files, ``obs``, ``camera``
        and ``cal`` results.
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


_HOLDS = {"least": ge, "most": le, "above": gt, "below": lt}


def judged(
    code: Code,
    values: dict[str, Any],
    bounds: dict[str, Any],
    remedies: Remedies = (),
    orders: tuple[Order, ...] = (),
    otherwise: Level = Level.WARN,
    good: bool | None = None,
) -> Check:
    """A check that passes where every value lies within the bound of its name, such as
    ``share_least`` for ``share``, or by `good` where that is not the question; remedies, orders and
    the level `otherwise` are for what did not pass.
    """
    if good is None:
        named = [(*name.rpartition("_"), bound) for name, bound in bounds.items()]
        good = all(_HOLDS[how](values[of], bound) for of, _, how, bound in named)
    if good:
        return Check(code, values, bounds=bounds)
    return Check(code, values, otherwise, bounds, remedies, orders)
