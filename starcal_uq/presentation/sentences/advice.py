"""Orders of what to do with the instrument or the data."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial

from starcal_uq.core.conflicts import words_of
from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import join_words
from starcal_uq.core.status import Advice, Status
from starcal_uq.core.types import AnyMapping
from starcal_uq.diagnostics.verdict.remedies import Refusal
from starcal_uq.estimation.undetermined import remedy_of
from starcal_uq.presentation.sentences.table import SENTENCES, entry

# Orders as they are, with places for their values.
_ORDERS = {
    Advice.FRAMES_THAT_HELP: "Take more frames: the command names those that help most.",
    Advice.ANOTHER_PRIOR: (
        "Correct the nominal camera, or state a wider prior in a TOML file (--priors)."
    ),
    Advice.SAMPLE_WITH_OBSERVATIONS: "Sample where the observations are at hand.",
    Advice.NEARER_START: (
        "Calibrate again from there, or from a camera file that is nearer to the lens."
    ),
    Advice.ACCEPT_THE_FOCAL_LENGTH: (
        "Accept it if the focal length of the camera file is surely good to 5 %."
    ),
    Advice.FRAMES_APART: (
        "Calibrate stretches of frames apart (--only-frames), and compare the runs."
    ),
    Advice.ACCEPT_THE_PHASE: (
        "Accept it as noise, or point between frames by parts of a pixel more or less."
    ),
    Advice.LEAVE_OUT_MAGNITUDES: (
        "Leave out the brightest or the faintest stars, and compare the runs."
    ),
    Advice.CHECK_THE_DIRECTIONS: ("Check the times, and what the directions were declared to be."),
    Advice.WITHOUT_STAR_ERRORS: (
        "Leave star out of the list of effects, and see which checks then fail."
    ),
    Advice.WITHOUT_ROTATIONS: (
        "Leave the known rotations out, or correct them: numbers of the frames, sense of the "
        "quaternions, axes of the instrument. If only their errors are too small, state them that "
        "much larger."
    ),
    Advice.COUNT_THE_PATTERN: (
        "Count the pattern as an error of the directions, as the attitude error with the misfit "
        "found does: no distortion model here follows it."
    ),
    Advice.STATE_THE_SITE: (
        "State the site (--site) and the times, or that the camera was in space (--in-space)."
    ),
    Advice.GIVE_THE_DIRECTIONS: (
        "Give the directions of a catalogue, or apparent ones that hold refraction."
    ),
    Advice.CORRECT_THE_EPOCH: ("Correct the times, or give directions of the epoch of the images."),
    Advice.CORRECT_THE_TIMES: "Correct the times, which are UTC (column time_utc).",
    Advice.GIVE_MEASURED_CENTROIDS: (
        "Give centroids as they were measured, not positions that were computed or smoothed."
    ),
    Advice.STATE_NOISE_IN_PX: "Give the noise in px, or leave the column out.",
    Advice.DIVIDE_THE_NOISE: "Divide it by that.",
    Advice.ACCEPT_THE_FACTOR: "Accept it: the factor is in every interval.",
    Advice.LOOK_AT_THE_FILE: (
        "Look for what changed in that file, or calibrate each by itself and compare the runs."
    ),
    Advice.LET_THE_RULE_JUDGE: (
        "Let the rule judge it alone, or state a confidence that the samples resolve."
    ),
}
# Why a calibration is of no use to a run; `asked` are the options that it is to have.
_REFUSALS = {
    Refusal.TIMES_UNKNOWN: "the times are not known",
    Refusal.SITE_UNKNOWN: "the site is not known",
    Refusal.MADE_WITH: "the run was made with {asked} already",
    Refusal.TRIED: "{asked} was tried already",
    Refusal.EXCLUDED: "the run was made with options that {asked} excludes ({name}, {other})",
}
SENTENCES |= {code: order.format for code, order in _ORDERS.items()}


def _refused(template: str, asked: AnyMapping | None = None, **values: str) -> str:
    return template.format(asked=shlex.join(words_of(asked or {})), **values)


SENTENCES |= {code: partial(_refused, template) for code, template in _REFUSALS.items()}


@entry(Advice.LOOK_FOR_THE_CAUSE)
def _look_for_the_cause(reasons: Sequence[Finding]) -> str:
    said = join_words(list(dict.fromkeys(reason.sentence for reason in reasons)))
    return f"Look for the cause in the instrument or the data: {said}."


@entry(Advice.MEND_THE_ESTIMATE)
def _mend_the_estimate(status: Status, undetermined: tuple[str, ...], solver: str) -> str:
    remedy = remedy_of(status, undetermined, solver)
    return f"{remedy[0].upper()}{remedy[1:]}."


@entry(Advice.STATE_WHAT_IS_MISSING)
def _state_what_is_missing(missing: Sequence[str]) -> str:
    return f"State in the budget file what is missing: {join_words(missing)}."


@entry(Advice.REDUCE_OR_RELAX)
def _reduce_or_relax(row: str) -> str:
    largest = repr(row) if row else "the largest contributors"
    return f"Reduce {largest}, or relax the limit in the budget file."
