"""The verdict on a run: did it converge, can it be trusted, and what limits it; every check with
its number and bound.

Pure functions of result objects. A check that fails means that the numbers must not be used; a
warning means that they may be used by someone who has read it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
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
_WHOLE = re.compile(r"(?<![\w.])\d+(?![\w.])")


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
    """

    DOCUMENTED: ClassVar = ("level",)
    WRITTEN_AS: ClassVar = {
        "summary": ("headline",),
        "to_try": ("commands", "ended"),
    }

    checks: tuple[Check, ...]
    summary: Finding
    to_try: Remedies = ()

    @property
    def headline(self) -> str:
        """The verdict in one statement: usable, usable with these effects, or not usable, because
        of these checks, and which data would tell.
        """
        return self.summary.sentence

    @property
    def ended(self) -> str:
        """The headline where no model here explains the data; empty where something is left to
        try.
        """
        return "" if self.summary.values.get("tried") is None else self.headline

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
    used = weighed(obs, cal)
    known = [getattr(diagnosis, name, None) for name in ("air", "times", "aberration", "better")]
    air, times, aberration, better = known
    rests = observed.rests_on_aberration(used, aberration if times is None else None)
    checks: list[Check | None] = [
        estimate.estimation(cal, post),
        estimate.determined(cal),
        estimate.estimators_agree(cal),
        estimate.rotations_agree(cal),
    ]
    if diagnosis is not None and diagnosis.starts is not None:
        checks += [estimate.starts(diagnosis.starts)]
    if post is not None:
        checks += [draws.same_data(post, cal.data_hash_of(obs)), *post.diagnostics.checks]
    checks += [
        observed.directions(used, cal, air, times, rests),
        observed.residual_pattern(used, cal, better, getattr(diagnosis, "effects", ())),
        observed.outliers(used, cal),
        observed.screening(obs),
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
    held = cal.known_effects.names
    place = place if place is None else replace(place, held=held)
    made = [check for check in checks if check is not None]
    found = tuple(check if place is None else place.exact(check) for check in made)
    required = [check for check in found if check.question is Question.REQUIRED]
    others = [check for check in found if check.question is not Question.REQUIRED]
    violated, failed = _phrases(required, Level.FAIL), _phrases(others, Level.FAIL)
    facts: AnyDict = {"violated": violated, "unmet": _phrases(required, Level.WARN)}
    facts["doubts"] = failed or _phrases(others, Level.WARN)
    to_try, tried = _way_on(others, place)
    if failed:
        facts |= {"tried": tried, "data": _telling(made, obs)}
        return Verdict(found, Finding(Note.NOT_USABLE, facts), to_try)
    facts |= {"sampled": post is not None, "effects": held, "rests": None if violated else rests}
    return Verdict(found, Finding(Note.HEADLINE, facts), to_try)


def _way_on(
    doubts: Sequence[Check], place: Place | None
) -> tuple[Remedies, tuple[str, ...] | None]:
    """The remedies to try, those of the first cause first; or what was tried, where none is left
    against a failure.
    """
    every: list[Remedy] = []
    for cause, some in by_cause(doubts).items():
        every += [one for check in some for one in check.remedies if one.form != "call"]
        if some[0].level is Level.FAIL and (every or cause == INPUT):
            # What comes after it in the order may be its consequence.
            break
    to_try = _largest(every)[:MOST_COMMANDS]
    left = to_try and not (place is not None and place.exhausted(doubts))
    if left or worst(doubts) is not Level.FAIL:
        return to_try, None
    return (), () if place is None else tuple(one.text for one in place.tried)


def _largest(remedies: Sequence[Remedy]) -> Remedies:
    """Remedies without repeats; of those that differ in whole numbers alone, such as steps, that
    with the largest.
    """
    found: dict[str, tuple[list[int], Remedy]] = {}
    for remedy in remedies:
        steps = remedy.steps or (remedy,)
        text = repr([(step.action, step.files, step.arguments) for step in steps])
        here = [int(number) for number in _WHOLE.findall(text)], remedy
        form = _WHOLE.sub("N", text)
        found[form] = max(found.get(form, here), here, key=itemgetter(0))
    return tuple(remedy for _, remedy in found.values())


def _telling(checks: Iterable[Check], obs: Observations) -> tuple[str, ...]:
    """Effects, options and advice that failed checks ask for, but for what the table was given.

    The checks have all the remedies that they were made with, also those that were tried.
    """
    asked: set[str] = set()
    for check in checks:
        if check.level is Level.FAIL:
            asked.update(check.values.get("effects", ()))
            asked.update(order.code.name.lower() for order in check.orders)
            asked.update(*((one.action, *one.arguments) for one in check.remedies))
    if obs.timed:
        asked.discard("time")
    if obs.origin.site is not None:
        asked -= {"site", "zenith", "give_the_directions"}
    return tuple(sorted(asked))


def _phrases(checks: Iterable[Check], level: Level) -> tuple[str, ...]:
    return tuple(check.phrase for check in checks if check.level is level)
