"""A verdict in words."""

from __future__ import annotations

from collections.abc import Sequence

from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import join_words
from starcal_uq.core.status import Note
from starcal_uq.presentation.sentences.table import entry

# Data that the headline names.
_TOLD = 3
# Data that tell a cause from the others: effects that would be taken up, and options and advice of
# checks, that ask for these.
_TELLING = {
    "the time of every frame in UTC": "time",
    "times from another clock": "correct_the_times",
    "the site": "site zenith give_the_directions",
    "directions from another catalogue": (
        "star check_the_directions correct_the_epoch without_star_errors"
    ),
    "a record of which camera took which frame": "frames",
    "identifications that were checked in the images": "screening",
    "another measurement of the rotations between frames": "without_rotations",
    "the same stars at other places of the detector": "model axes field count_the_pattern",
    "frames that are shifted by parts of a pixel": "phase accept_the_phase",
    "the same stars with other exposure times": "magnitude leave_out_magnitudes",
    "frames at more temperatures": "temperature",
    "frames from more nights": "epoch",
    "repeated exposures of one field": "frame frames_apart",
    "more frames, spread over the sky": "plan",
}


def _with_requirements(
    violated: Sequence[str], sentences: Sequence[str], unmet: Sequence[str]
) -> str:
    first = [f"Violated: {join_words(violated)}."] if violated else []
    last = [f"Open: {join_words(unmet)}."] if unmet else []
    return " ".join([*first, *sentences, *last])


@entry(Note.NOT_USABLE)
def _not_usable(
    violated: Sequence[str],
    unmet: Sequence[str],
    doubts: Sequence[str],
    tried: Sequence[str] | None,
    data: Sequence[str],
) -> str:
    """`tried` is None where something is left to try."""
    told = [words for words, asked in _TELLING.items() if {*asked.split()} & {*data}]
    nothing, condition = "", "if nothing to try helps, "
    if tried is not None:
        steps = f" (tried: {'; '.join(tried)})" if tried else ""
        nothing, condition = f" and no model here explains this{steps}", ""
        told = told or list(_TELLING)[-1:]
    would = f"; {condition}these data would tell: {join_words(told[:_TOLD])}" if told else ""
    sentence = f"Not usable, because {join_words(doubts)} failed{nothing}{would}."
    return _with_requirements(violated, [sentence], unmet)


@entry(Note.HEADLINE)
def _headline(
    violated: Sequence[str],
    unmet: Sequence[str],
    doubts: Sequence[str],
    sampled: bool,
    rests: Finding | None,
    effects: Sequence[str] = (),
) -> str:
    held = f" with {'this effect' if len(effects) == 1 else 'these effects'}: {join_words(effects)}"
    sentences = []
    if doubts:
        these = "this warning is" if len(doubts) == 1 else "these warnings are"
        sentences.append(
            f"Converged; usable once {these} resolved or accepted: {join_words(doubts)}."
        )
        sentences += [f"The numbers are to be used{held}."] if effects else []
    elif not sampled:
        sentences.append(
            f"The estimate converged{held if effects else ''} and passed every check; the posterior "
            "has not been sampled yet."
        )
    elif effects:
        sentences.append(f"Converged, and every check passed: usable{held}.")
    else:
        sentences.append("Converged, and every check passed: the stated uncertainties can be used.")
    sentences += [rests.sentence] if rests is not None else []
    return _with_requirements(violated, sentences, unmet)
