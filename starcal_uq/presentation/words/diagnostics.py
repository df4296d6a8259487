"""What a validation found, in plain words."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import count, fixed, join_words, percent, plural, significant
from starcal_uq.diagnostics.validation.replicates import LOG_LIKELIHOOD
from starcal_uq.inference.checks import COMPRESSED_BOUND

if TYPE_CHECKING:
    from starcal_uq.diagnostics.validation.result import Validation

NBSP = "\N{NO-BREAK SPACE}"
# Errors this far from one posterior standard deviation are said to be too narrow or too wide; a mean error this far
# from zero is said to be a bias.
_SCALE_NOTED = 0.03
_BIAS_NOTED = 0.1


def verdict(found: Validation) -> str:
    """One paragraph: is all well, on what evidence, what does not hold, and what else to know."""
    from starcal_uq.diagnostics.validation.result import ENOUGH_REPLICATES

    rejected = [f for f in found.findings if f.rejected]
    if rejected:
        opening = "The uncertainties are not right"
    elif found.n_replicates < ENOUGH_REPLICATES:
        opening = f"Too few replicates to judge (give at least {ENOUGH_REPLICATES}); nothing objects so far"
    else:
        opening = "The uncertainties are right as far as this validation can tell"
    frames = found.provenance["settings"].get("n_frames")
    data = "" if frames is None else f" of {plural(int(frames), 'frame')}"
    sentences = [f"{opening}: over {plural(found.n_replicates, 'replicate')}{data}, {_evidence(found)}."]
    if rejected:
        sentences.append(_objections(found))
    else:
        first = found.findings[0]
        sentences.append(
            f"None of {len(found.findings)} tests objects at an overall level of 1{NBSP}% (smallest p-value: "
            f"{significant(first.p_value)}, {first.test} of {spoken(first.quantity)})."
        )
    return " ".join([*sentences, *_notes(found)])


def spoken(quantity: str) -> str:
    """A quantity's name within a sentence."""
    return quantity.replace("_", " ")


def _evidence(found: Validation) -> str:
    coverage = found.coverage
    low, high = int(np.argmin(coverage)), int(np.argmax(coverage))
    half = 1.96 * np.sqrt(0.95 * 0.05 / found.n_replicates)
    return (
        f"95{NBSP}% intervals hold the truth in {percent(coverage[low], 3)} ({spoken(found.quantities[low])}) to "
        f"{percent(coverage[high], 3)} ({spoken(found.quantities[high])}) of the cases, where chance alone moves each "
        f"by ±{fixed(100.0 * half, 1)}{NBSP}%, and the squared errors of the camera parameters are "
        f"{fixed(found.nees_ratio, 3)} times what the posterior covariance says, where chance alone moves that by "
        f"±{fixed(1.96 * found.nees_ratio_se, 3)}"
    )


def _objections(found: Validation) -> str:
    """What the tests object to, and how the errors of these quantities compare with their posteriors."""
    rejected = [f for f in found.findings if f.rejected]
    parts = []
    for test, words in (("ranks", "the ranks of {}"), ("coverage", "the coverage of {}")):
        some = [f for f in rejected if f.test == test]
        if some:
            names = join_words([spoken(q) for q in found.quantities if any(f.quantity == q for f in some)])
            parts.append(f"{words.format(names)} (p{NBSP}{_p(max(f.p_value for f in some))})")
    if any(f.test == "NEES" for f in rejected):
        parts.append(f"the squared errors of the camera parameters (p{NBSP}{_p(found.nees_p_value)})")
    wrong = {f.quantity for f in rejected}
    return f"What does not hold: {join_words(parts)}.{_how(found, [q for q in found.quantities if q in wrong])}"


def _p(value: float) -> str:
    return f"<{NBSP}0.0001" if value < 1e-4 else f"={NBSP}{significant(value)}"


def _how(found: Validation, names: list[str]) -> str:
    """Too narrow, too wide or off-centre, where the errors show it; the log likelihood has no symmetric error."""
    sentences = []
    # All of the camera parameters where they are rejected together.
    names = [n for n in names if n != LOG_LIKELIHOOD] or list(found.quantities[: found.n_parameters])
    z = {name: found.z[:, found.quantities.index(name)] for name in names}
    spread = {name: float(np.std(values)) for name, values in z.items()}
    for word, factors in (
        ("narrow", {n: s for n, s in spread.items() if s > 1.0 + _SCALE_NOTED}),
        ("wide", {n: 1.0 / s for n, s in spread.items() if s < 1.0 - _SCALE_NOTED}),
    ):
        if factors:
            low, high = (fixed(v, 2) for v in (min(factors.values()), max(factors.values())))
            by = f"a factor of {low}" if low == high else f"factors of {low} to {high}"
            sentences.append(f" Intervals are too {word} for {join_words([*map(spoken, factors)])}, by {by}.")
    for name, values in z.items():
        mean = float(np.mean(values))
        if abs(mean) > max(_BIAS_NOTED, 3.0 * spread[name] / np.sqrt(len(values))):
            side = "high" if mean > 0 else "low"
            sentences.append(
                f" Estimates of {spoken(name)} are too {side} by {fixed(abs(mean), 2)} posterior standard deviations."
            )
    return "".join(sentences)


def _notes(found: Validation) -> list[str]:
    notes = []
    if found.failures:
        reason, number = Counter(found.failures).most_common(1)[0]
        total = found.n_replicates + len(found.failures)
        notes.append(
            f"{count(len(found.failures))} of {plural(total, 'replicate')} gave no result, {count(number)} of them "
            f"because {reason}"
        )
    far = int(np.sum(np.abs(found.compression_error) > COMPRESSED_BOUND))
    if far:
        notes.append(
            f"In {plural(far, 'replicate')} the compressed likelihood was more than {COMPRESSED_BOUND:g} nat from the "
            "exact one at the truth; `sample` would have taken the exact one there."
        )
    if found.interrupted:
        notes.append(f"The run was interrupted after {count(found.n_replicates)} of {count(found.n_requested)}.")
    return notes
