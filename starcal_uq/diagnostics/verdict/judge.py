"""The verdict on a run: did it converge, can it be trusted, and what limits it; every check with its number and bound.

Pure functions of result objects. A check that fails means that the numbers must not be used; a warning means that they
may be used by someone who has read it.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from starcal_uq.core.display import Shown
from starcal_uq.core.formatting import join_words
from starcal_uq.core.status import CALIBRATE, Check, Level, Question, worst
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict import draws, estimate, observed
from starcal_uq.diagnostics.verdict.observed import FROM_IMAGES
from starcal_uq.estimation.noise_model import weighed

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.estimation.calibration import Calibration
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
    headline : str
        The verdict in one sentence.
    """

    DOCUMENTED: ClassVar = ("level",)

    checks: tuple[Check, ...]
    headline: str

    @property
    def level(self) -> Level:
        """The worst outcome of the checks."""
        return worst(self.checks)

    def to_dict(self) -> AnyDict:
        """The verdict as ``verdict.json`` holds it; `VERSION` rises when a key goes or changes its meaning."""
        from starcal_uq.core.documents import document, part_of

        return document("verdict", VERSION, part_of(Verdict), self, self.level.exit_status)

    def of(self, question: Question) -> tuple[Check, ...]:
        """The checks that answer one question."""
        return tuple(check for check in self.checks if check.question is question)

    @property
    def doubts(self) -> tuple[Check, ...]:
        """The checks that did not pass, failures first."""
        return (*self.at(Level.FAIL), *self.at(Level.WARN))

    def at(self, level: Level) -> tuple[Check, ...]:
        """The checks with this outcome."""
        return tuple(check for check in self.checks if check.level is level)


_STARTS = (CALIBRATE, FROM_IMAGES)


@dataclass(frozen=True)
class Place:
    """Where a run is and what made it, so that remedies can be commands to copy."""

    run: str  # The folder
    # Command line that made all of it, without the program and the folder; empty where it was made step by step.
    words: tuple[str, ...] = ()
    observations: bool = True  # Whether the folder holds observations

    def exact(self, check: Check) -> Check:
        """A check whose commands name the files of this run, without those that made it."""
        kept, done = [], ""
        for one in check.remedies:
            done = self._given(one) or (done if one.startswith("sc.") else "")
            kept += [] if done else [self.command(one)]
        advice = check.advice
        if check.remedy and not kept and not advice:
            advice = f"Look for the cause in the instrument or the data: the run was made with {done} already."
        remedy = " or ".join(kept)
        return check if remedy == check.remedy else replace(check, remedy=remedy, advice=advice)

    def _given(self, text: str) -> str:
        """The options of a command for a calibration if this run was made with them; a call follows its command."""
        options = next((text.removeprefix(words).split() for words in _STARTS if text.startswith(words)), [])
        places = range(len(self.words) - len(options) + 1)
        return " ".join(options) if any([*self.words[i : i + len(options)]] == options for i in places) else ""

    def command(self, text: str) -> str:
        """A command with the files of this run in place of OBS, CAMERA, SITE and RUN; a call in Python as it is."""
        if not text.startswith("starcal-uq"):
            return text
        start = next((words for words in _STARTS if text.startswith(words)), "")
        if start and self.words[:1] == ("run",):
            if " --site " in text and "apparent" in self.words:
                # Directions are made apparent at a site, and must not be declared so.
                text += " --directions catalogue"
            # Everything that was asked for then, and this; of an option that is given twice the last one holds.
            made = shlex.join([*self.words, "-o", self.run])
            text = f"starcal-uq {made}{text.removeprefix(start)} --force"
        elif start == CALIBRATE and self.observations:
            given = [f"{self.run}/observations.parquet", f"{self.run}/camera.toml", "-o", f"{self.run}-2"]
            text = f"starcal-uq run {shlex.join(given)}{text.removeprefix(start)}"
        words, files = text.split(" "), {"RUN": shlex.quote(self.run), "SITE": "site.toml"}
        if not {"OBS", "IMAGES..."} & set(words):
            files["CAMERA"] = shlex.quote(f"{self.run}/camera.toml")
        return " ".join(files.get(word, word) for word in words)


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

    With its place, remedies are commands that name its files. The requirements of its budget are checks like the
    others.
    """
    checks: list[Check | None] = [estimate.estimation(cal, post), estimate.determined(cal)]
    checks += [estimate.estimators_agree(cal)]
    if diagnosis is not None and diagnosis.starts is not None:
        checks += [estimate.starts(diagnosis.starts)]
    if post is not None:
        checks += [draws.same_data(post, cal.data_hash_of(obs)), *post.diagnostics.checks]
    used = weighed(obs, cal)
    asked = (None, None) if diagnosis is None else (diagnosis.air, diagnosis.times)
    unseen = None if diagnosis is None or diagnosis.times is not None else diagnosis.aberration
    rests = observed.rests_on_aberration(used, unseen)
    checks += [observed.directions(used, cal, *asked, rests)]
    checks += [observed.residual_pattern(used, cal), observed.outliers(used, cal), observed.screening(obs)]
    checks += [observed.noise(used, cal), observed.partitions(cal), observed.terms(cal), observed.coverage(used, cal)]
    if diagnosis is not None:
        checks += estimate.model_checks(diagnosis, cal, post, attitude)
    if attitude is not None:
        checks += [draws.propagation(attitude)]
    if truth is not None and truth.parameter_names == cal.parameter_names:
        checks += [estimate.against_truth(cal, truth, post)]
    checks += requirements
    found = tuple(check if place is None else place.exact(check) for check in checks if check is not None)
    return Verdict(found, _headline(found, post is not None, rests))


def _headline(checks: tuple[Check, ...], sampled: bool, rests: str) -> str:
    """What becomes of the requirements, whether the numbers can be used, and what f then rests on."""
    required = [check for check in checks if check.question is Question.REQUIRED]
    violated = [check.phrase for check in required if check.level is Level.FAIL]
    still_open = [check.phrase for check in required if check.level is Level.WARN]
    sentences = [f"Violated: {join_words(violated)}."] if violated else []
    sentences += [_usable([check for check in checks if check not in required], sampled)]
    if rests and not any(check.level is Level.FAIL for check in checks):
        sentences += [rests]
    sentences += [f"Open: {join_words(still_open)}."] if still_open else []
    return " ".join(sentences)


def _usable(checks: Sequence[Check], sampled: bool) -> str:
    failed = [c.phrase for c in checks if c.level is Level.FAIL]
    warned = [c.phrase for c in checks if c.level is Level.WARN]
    if failed:
        return f"Do not use these numbers: {join_words(failed)} failed."
    if warned:
        start = "Converged; usable once " + ("this warning is" if len(warned) == 1 else "these warnings are")
        return f"{start} resolved or accepted: {join_words(warned)}."
    if not sampled:
        return "The estimate converged and passed every check; the posterior has not been sampled yet."
    return "Converged, and every check passed: the stated uncertainties can be used."
