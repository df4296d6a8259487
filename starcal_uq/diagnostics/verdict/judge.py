"""The verdict on a run: did it converge, can it be trusted, and what limits it; every check with
its number and bound.

Pure functions of result objects. A check that fails means that the numbers must not be used; a
warning means that they may be used by someone who has read it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from starcal_uq.core.display import Shown
from starcal_uq.core.findings import Finding
from starcal_uq.core.remedy import Remedies, Remedy
from starcal_uq.core.status import Check, Level, Note, Question, worst
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict import draws, estimate, observed
from starcal_uq.diagnostics.verdict.remedies import (
    INPUT,
    MOST_COMMANDS,
    Place,
    by_cause,
    first_cause,
)
from starcal_uq.estimation.weights import weighed

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError

VERSION = 1


@dataclass(frozen=True)
class Verdict(Shown):
    """All checks and what follows from them.

    Attributes
    ----------
    checks : tuple of Check
        In reading order.
    summary : Finding
        What follows from them.
    to_try : tuple of Remedy
        What to try, in this order; at most three.
    end : Finding, optional
        That no model here explains the data; None where something is left to try.
    """

    DOCUMENTED: ClassVar = ("level",)
    WRITTEN_AS: ClassVar = {
        "summary": ("headline",),
        "to_try": ("commands",),
        "end": ("ended",),
    }

    checks: tuple[Check, ...]
    summary: Finding
    to_try: Remedies = ()
    end: Finding | None = None

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        return self.summary.sentence

    @property
    def ended(self) -> str:
        """That no model here explains the data, and which data would tell; empty where something is
        left to try.
        """
        return "" if self.end is None else self.end.sentence

    @property
    def level(self) -> Level:
        """The worst outcome of the checks."""
        return worst(self.checks)

    @property
    def commands(self) -> tuple[str, ...]:
        """What to try, in this order, each a command; at most three. Empty where no command
        helps.
        """
        return tuple(remedy.command for remedy in self.to_try)

    def to_dict(self) -> AnyDict:
        """The verdict as ``verdict.json`` holds it; `VERSION` rises when a key goes or changes its
        meaning.
        """
        from starcal_uq.core.documents import document, part_of

        return document("verdict", VERSION, part_of(Verdict), self, self.level.exit_status)

    def of(self, question: Question) -> tuple[Check, ...]:
        """The checks that answer one question."""
        return tuple(check for check in self.checks if check.question is question)

    @property
    def causes(self) -> dict[str, list[Check]]:
        """The checks that did not pass by what they point to: the input, the lens, the noise, the
        computation.
        """
        return by_cause([check for check in self.checks if check.question is not Question.REQUIRED])

    @property
    def doubts(self) -> tuple[Check, ...]:
        """The checks that did not pass, failures first."""
        return (*self.at(Level.FAIL), *self.at(Level.WARN))

    def at(self, level: Level) -> tuple[Check, ...]:
        """The checks with this outcome."""
        return tuple(check for check in self.checks if check.level is level)


def judge(
    obs: Observations,
    cal: Calibration,
    post: Posterior | None = None,
    truth: Camera | None = None,
    attitude: AttitudeError | None = None,
    diagnosis: Diagnosis | None = None,
    place: Place | None = None,
    requirements: Sequence[Check] = (),
) -> Verdict:
    """Check a run: everything that is known of it; `truth` is the camera of a simulation.

    With its place, remedies are commands that name its files. The requirements of its budget are
    checks like the others.
    """
    checks: list[Check | None] = [estimate.estimation(cal, post), estimate.determined(cal)]
    checks += [estimate.estimators_agree(cal), estimate.rotations_agree(cal)]
    if diagnosis is not None and diagnosis.starts is not None:
        checks += [estimate.starts(diagnosis.starts)]
    if post is not None:
        checks += [draws.same_data(post, cal.data_hash_of(obs)), *post.diagnostics.checks]
    used = weighed(obs, cal)
    asked = (None, None) if diagnosis is None else (diagnosis.air, diagnosis.times)
    better = (
        None if diagnosis is None or diagnosis.comparison is None else diagnosis.comparison.better
    )
    unseen = None if diagnosis is None or diagnosis.times is not None else diagnosis.aberration
    rests = observed.rests_on_aberration(used, unseen)
    checks += [observed.directions(used, cal, *asked, rests)]
    checks += [
        observed.residual_pattern(
            used, cal, better, () if diagnosis is None else diagnosis.effects
        ),
        observed.outliers(used, cal),
        observed.screening(obs),
    ]
    checks += [
        observed.noise(used, cal),
        observed.partitions(cal),
        observed.terms(cal),
        observed.coverage(used, cal),
    ]
    if diagnosis is not None:
        checks += estimate.model_checks(diagnosis, cal, attitude)
    if attitude is not None:
        checks += [draws.propagation(attitude)]
    if truth is not None and truth.parameter_names == cal.parameter_names:
        checks += [estimate.against_truth(cal, truth, post)]
    checks += requirements
    held = () if cal.effects is None else cal.effects.names
    place = place if place is None else replace(place, held=held)
    found = tuple(
        check if place is None else place.exact(check) for check in checks if check is not None
    )
    to_try, end = _way_on(found, place)
    return Verdict(found, _summary(found, post is not None, rests, held), to_try, end)


def _way_on(checks: tuple[Check, ...], place: Place | None) -> tuple[Remedies, Finding | None]:
    """The remedies to try, those of the first cause first, or that there is none that helps."""
    doubts = [check for check in checks if check.question is not Question.REQUIRED]
    every: list[Remedy] = []
    for cause, some in by_cause(doubts).items():
        every += [one for check in some for one in check.remedies if one.form != "call"]
        if some[0].level is Level.FAIL and (every or cause == INPUT):
            # What comes after it in the order may be its consequence.
            break
    to_try = _largest(every)[:MOST_COMMANDS]
    tried = () if place is None else place.tried
    if worst(doubts) is not Level.FAIL or (
        to_try and not (place is not None and place.exhausted(doubts))
    ):
        return to_try, None
    facts = {"tried": tuple(one.text for one in tried), "cause": first_cause(doubts)}
    return (), Finding(Note.NO_MODEL_EXPLAINS, facts)


def _largest(remedies: Sequence[Remedy]) -> Remedies:
    """Remedies without repeats; of those that differ in whole numbers alone, such as steps, that
    with the largest.
    """
    found: dict[str, Remedy] = {}
    for remedy in remedies:
        steps = remedy.steps or (remedy,)
        form = repr([(step.action, step.files, _texts(step.arguments)) for step in steps])
        found[form] = max(found.get(form, remedy), remedy, key=_whole_numbers)
    return tuple(found.values())


def _texts(arguments: AnyDict) -> AnyDict:
    """The arguments with their whole numbers left open."""
    return {name: "N" if str(value).isdigit() else value for name, value in arguments.items()}


def _whole_numbers(remedy: Remedy) -> list[int]:
    steps = remedy.steps or (remedy,)
    values = [str(value) for step in steps for value in step.arguments.values()]
    return [int(value) for value in values if value.isdigit()]


def _summary(
    checks: tuple[Check, ...], sampled: bool, rests: Finding | None, effects: tuple[str, ...]
) -> Finding:
    """What becomes of the requirements, whether the numbers can be used, with which effects, and
    what f then rests on.
    """
    required = [check for check in checks if check.question is Question.REQUIRED]
    others = [check for check in checks if check not in required]
    level = worst(others)
    doubts = [check for check in others if check.level is level and level is not Level.PASS]
    facts = {
        "violated": _phrases(check for check in required if check.level is Level.FAIL),
        "unmet": _phrases(check for check in required if check.level is Level.WARN),
        "level": level,
        "doubts": _phrases(doubts),
        "causes": tuple((cause, len(some)) for cause, some in by_cause(doubts).items()),
        "sampled": sampled,
        "effects": effects,
        "rests": None if worst(checks) is Level.FAIL else rests,
    }
    return Finding(Note.HEADLINE, facts)


def _phrases(checks: Iterable[Check]) -> tuple[str, ...]:
    return tuple(check.phrase for check in checks)
