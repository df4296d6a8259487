"""A verdict in words."""

from __future__ import annotations

from collections.abc import Sequence

from starcal_uq.core.findings import Finding
from starcal_uq.core.formatting import join_words, plural
from starcal_uq.core.status import Level, Note
from starcal_uq.diagnostics.verdict.remedies import INPUT, LENS, NOISE, NUMERICS
from starcal_uq.presentation.sentences.table import entry

# Checks that the headline names; of more it says how many there are.
_NAMED = 2
# Which data tell a cause from the others.
_TELLING = {
    INPUT: (
        "times in UTC and the site, or the statement that the camera was in space, for every frame"
    ),
    LENS: (
        "frames of the same stars at other places of the detector, shifted and turned by 90 degrees"
    ),
    NOISE: (
        "repeated exposures of one field, whose scatter is noise alone, with times and temperatures"
    ),
    NUMERICS: "more frames, spread over the sky",
}


@entry(Note.HEADLINE)
def _headline(
    violated: Sequence[str],
    unmet: Sequence[str],
    level: Level,
    doubts: Sequence[str],
    causes: Sequence[tuple[str, int]],
    sampled: bool,
    rests: Finding | None,
    effects: Sequence[str] = (),
) -> str:
    named = doubts
    held = f" with {'this effect' if len(effects) == 1 else 'these effects'}: {join_words(effects)}"
    if len(doubts) > _NAMED:
        named = [f"{plural(number, 'check')} of {cause}" for cause, number in causes]
    sentences = [f"Violated: {join_words(violated)}."] if violated else []
    if level is Level.FAIL:
        sentences.append(f"Do not use these numbers: {join_words(named)} failed.")
    elif level is Level.WARN:
        these = "this warning is" if len(doubts) == 1 else "these warnings are"
        sentences.append(
            f"Converged; usable once {these} resolved or accepted: {join_words(named)}."
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
    sentences += [f"Open: {join_words(unmet)}."] if unmet else []
    return " ".join(sentences)


@entry(Note.NO_MODEL_EXPLAINS)
def _no_model_explains(tried: Sequence[str], cause: str) -> str:
    steps = f" (tried: {'; '.join(tried)})" if tried else ""
    return f"No model here explains this{steps}. What would tell: {_TELLING[cause]}."
