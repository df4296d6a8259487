"""Sentences of the report on the reproduction; every number and every verdict in them is computed."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import MINUS, count, fixed, join_words, percent, plural, significant, with_sigma
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.paper.checks import NO, PaperCheck
from starcal_uq.paper.errors import MAXIMUM, REPROJECTION
from starcal_uq.paper.judgement import MAX_CHANCE, MAX_Z, Judged, Outcome, Trial
from starcal_uq.paper.published import (
    CLAIMED_RATIO,
    LEAST_SQUARES,
    N_FRAMES,
    PAPER_METHODS,
    PROPOSED,
    SAMAAN,
    printed,
)
from starcal_uq.paper.readings import AS_PRINTED, OTHER_EQUATION
from starcal_uq.paper.statistics import ENOUGH_REPLICATES

if TYPE_CHECKING:
    from starcal_uq.paper.result import Reproduction

EQUATIONS = {"eq14": "eq. 14", "eq6": "eq. 6"}
NAMES = {
    "f_mm": "f",
    "x0_px": "x₀",
    "y0_px": "y₀",
    "k1": "k₁",
    "k2": "k₂",
    "reprojection_px": "the reprojection error",
    "max_residual_px": "the largest residual",
    "y0_error_px": "the error of y₀",
}
METHOD_NAMES = {LEAST_SQUARES: "least squares", SAMAAN: "Samaan’s method", PROPOSED: "the proposed method"}
# A row whose parameters are less probable than this together is said to be so.
ROW_P = 0.01
NBSP = "\N{NO-BREAK SPACE}"
_AGREE = (Outcome.REPRODUCED, Outcome.WITHIN_NOISE)


def headline(found: Reproduction) -> str:
    """How many printed numbers come out, in one sentence."""
    n = {kind: len(found.outcome(kind)) for kind in Outcome}
    agree = sum(n[kind] for kind in _AGREE)
    parts = [f"{agree} agree with the experiment done again"]
    if n[Outcome.AGAINST_TEXT]:
        parts.append(f"{n[Outcome.AGAINST_TEXT]} only if the text is not followed")
    if n[Outcome.BY_CHOICE]:
        parts.append(f"{n[Outcome.BY_CHOICE]} only under some reading that would fit almost any number")
    parts.append(f"{n[Outcome.NOT_REPRODUCED]} under none of the readings tried")
    return f"Of {len(found.judged)} printed numbers, {join_words(parts)}."


def verdict(found: Reproduction) -> str:
    """Method by method, in plain words."""
    return " ".join(f"{name[:1].upper()}{name[1:]}: {text}" for name, text in method_verdicts(found))


def method_verdicts(found: Reproduction) -> list[tuple[str, str]]:
    """Each of the paper's methods, and what comes out of its numbers."""
    return [(METHOD_NAMES[method], _method_sentence(found, method)) for method in (PROPOSED, LEAST_SQUARES, SAMAAN)]


def _method_sentence(found: Reproduction, method: str) -> str:
    mine = [one for one in found.judged if one.printed.method == method]
    agree = [one for one in mine if one.outcome in _AGREE]
    parts = []
    if agree:
        all_of_them = len(agree) == len(mine)
        who = f"all {len(mine)} numbers" if all_of_them else f"of {len(mine)} numbers, {_listed(agree)}"
        verb = "agree" if all_of_them or len(agree) > 1 else "agrees"
        largest = max(abs(one.best.z) for one in agree)
        noise = sum(one.noise_digits for one in agree)
        digits = f"; {plural(noise, 'of the last digits is', 'of the last digits are')} noise" if noise else ""
        parts.append(f"{who} {verb} within {fixed(largest, 1)} standard deviations{digits}")
    for kind, words in (
        (Outcome.AGAINST_TEXT, "only against the text"),
        (Outcome.BY_CHOICE, "only under some reading that would fit almost any number"),
        (Outcome.NOT_REPRODUCED, "under no reading"),
    ):
        some = [one for one in mine if one.outcome is kind]
        if some:
            verb = "comes out" if len(some) == 1 else "come out"
            detail = f" ({some[0].best.reading})" if kind is Outcome.AGAINST_TEXT and len(some) == 1 else ""
            parts.append(f"{_listed(some)} {verb} {words}{detail}")
    together = next((row for row in found.rows if row.method == method), None)
    if together is not None and together.p_value < ROW_P and len(agree) == len(mine):
        parts.append(
            f"yet the {together.p} parameters of {together.place} together are improbable as one draw "
            f"(p{NBSP}{_p(together.p_value)})"
        )
    return f"{'; '.join(parts)}."


def _listed(numbers: list[Judged]) -> str:
    """Quantities, with the place of those that are printed twice."""
    twice = {q for q in NAMES if sum(one.printed.quantity == q for one in numbers) > 1}
    seen: list[str] = []
    for one in numbers:
        name = NAMES[one.printed.quantity]
        text = f"both {name}" if one.printed.quantity in twice else name
        if text not in seen:
            seen.append(text)
    return join_words(seen)


def focal_sentence(found: Reproduction) -> str:
    """What the focal length of least squares says about the equation of the distortion."""
    truth, number = found.run.truth, printed(LEAST_SQUARES, "f_mm")
    main = EQUATIONS[found.run.convention]
    other = next(words for key, words in EQUATIONS.items() if key != found.run.convention)
    judged = next(one for one in found.judged if one.printed is number)
    values = {
        main: (judged.main.mean, judged.main.spread),
        other: _mean_spread(found.readings.of(OTHER_EQUATION, LEAST_SQUARES, "f_mm")),
    }
    parts = [f"{with_sigma(*values[e])} ± {significant(values[e][1])} mm under {e}" for e in EQUATIONS.values()]
    nearer = min(values, key=lambda e: abs(values[e][0] - number.value))
    text = (
        f"Least squares that ignores the distortion gives f = {parts[0]} and {parts[1]} (mean and spread over seeds); "
        f"the truth is {truth.focal_mm:g} mm, and the paper prints {number.text}. Its simulation therefore follows "
        f"{nearer}."
    )
    close = judged.best
    if not judged.main.accepted and close.accepted:
        text += (
            f" The last {significant(abs(number.value - values[nearer][0]) * 1e3)} µm are the weights: {close.reading} "
            f"gives {with_sigma(close.mean, close.spread)} ± {significant(close.spread)} mm."
        )
    return text


def _mean_spread(draws: FloatArray) -> tuple[float, float]:
    return float(np.mean(draws)), float(np.std(draws, ddof=1))


def ratio_sentence(found: Reproduction) -> str:
    """What is left of “two orders of magnitude”."""
    parts = []
    for quantity, name, reading in (
        ("reprojection_px", "reprojection error", REPROJECTION[0].key),
        ("max_residual_px", "largest residual", MAXIMUM[0].key),
    ):
        draws = {m: found.readings.of(AS_PRINTED, m, quantity, reading) for m in PAPER_METHODS}
        ours = {m: _geometric(draws[m]) / _geometric(draws[PROPOSED]) for m in PAPER_METHODS}
        own = {m: printed(m, quantity).value / printed(PROPOSED, quantity).value for m in PAPER_METHODS}
        parts.append(
            f"by {name} {fixed(own[LEAST_SQUARES], 0)} and {fixed(own[SAMAAN], 0)} times in its own numbers, and "
            f"{_times(ours[LEAST_SQUARES])} and {_times(ours[SAMAAN])} times in ours"
        )
    return (
        f"The paper claims two orders of magnitude ({CLAIMED_RATIO:g} times) over least squares and Samaan’s method: "
        f"{parts[0]}; {parts[1]}. These are noise-free errors for one size of distortion and "
        f"{count(found.run.observations.n_frames)} frames. Methods that ignore or decouple the distortion keep their "
        "bias however many frames there are, while the error of those that couple it falls with the root of their "
        "number: the ratio is a property of the experiment, not of the method."
    )


def _times(ratio: float) -> str:
    return significant(ratio, 2)


def _geometric(draws: FloatArray) -> float:
    return float(np.exp(np.mean(np.log(draws))))


def rows_sentence(found: Reproduction) -> str:
    """Whether each row of the paper's Table 2 can be one draw, its parameters taken together."""
    if not found.rows:
        return ""
    parts = [f"row {PAPER_METHODS.index(row.method) + 1}: p {_p(row.p_value)}" for row in found.rows]
    return (
        "The parameters of a row belong together, and some are strongly correlated. Each row as one draw of our "
        f"experiment (Hotelling’s T², with rounding; main reading): {'; '.join(parts)}."
    )


def _p(value: float) -> str:
    return "< 10⁻⁶" if value < 1e-6 else f"= {significant(value)}"


def data_sentence(found: Reproduction) -> str:
    """What was simulated."""
    run = found.run
    obs = run.observations
    per_frame = obs.n_stars / obs.n_frames
    return (
        f"The sensor of the paper’s Table 1, distortion by its {EQUATIONS[run.convention]}; "
        f"{plural(obs.n_frames, 'frame')} at random attitudes with {fixed(per_frame, 1)} stars each on average "
        f"(embedded catalogue, Gaia G ≤ 6), {obs.meta['sigma_px']:g} px of Gaussian noise per axis; all methods start "
        f"at f = {run.start.focal_mm:g} mm and ({run.start.x0_px:g}, {run.start.y0_px:g}) px. One run with seed "
        f"{found.provenance['seed']}, {plural(found.replicates.n_replicates, 'replicate')} of all methods, and "
        f"{plural(found.readings.n_draws, 'replicate')} of every reading."
    )


def frames_warning(found: Reproduction) -> str:
    """What to keep in mind where the experiment is not of the paper's size."""
    n = found.run.observations.n_frames
    if n == N_FRAMES:
        return ""
    return (
        f"This reproduction has {plural(n, 'frame')} where the paper has {count(N_FRAMES)}: our draws spread "
        f"{fixed(float(np.sqrt(N_FRAMES / n)), 1)} times as far as they would, and z-values are that much smaller."
    )


def method_sentences(found: Reproduction) -> list[str]:
    """How numbers are compared."""
    tried = [len(one.trials) for one in found.judged]
    return [
        f"A printed number is one draw. z is its distance from our mean in standard deviations of a new draw (spread "
        f"over seeds, error of the mean and rounding of the print together); up to {MAX_Z:g} it agrees. Error sizes "
        "are compared on a logarithmic scale.",
        "A printed digit is noise (grey) when 95 % of our draws cover all ten values that it can have.",
        f"{min(tried)} to {max(tried)} readings of each number were tried. Of so many, some may fit by chance: a "
        "reading other than the main one counts only if it, and all others as sharp and as faithful to the text, would "
        f"refuse at least {percent(1.0 - MAX_CHANCE)} of the numbers that are as far from the main reading.",
    ]


def reading_text(trial: Trial) -> str:
    """A reading as shown in the table, with a mark where it contradicts the text."""
    return trial.reading if trial.faithful else f"{trial.reading} (against the text)"


def checks_sentence(checks: tuple[PaperCheck, ...]) -> str:
    """How often the paper agrees with itself."""
    wrong = sum(check.agrees == NO for check in checks)
    return (
        "Hardly an experiment is needed for this table: it puts the paper’s printed parameters into its own formulas. "
        f"{wrong} of {len(checks)} statements do not follow from them. Where a parameter is printed twice, the two may "
        "differ by the noise of two runs."
    )


def provenance_rows(found: Reproduction) -> list[tuple[str, str]]:
    """What is needed to repeat the reproduction."""
    record = found.provenance
    settings = ", ".join(f"{k} = {v if isinstance(v, str) else json.dumps(v)}" for k, v in record["settings"].items())
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items() if version)
    return [
        ("Data of the one run, SHA-256", str(record["data_sha256"])),
        ("Seed", str(record["seed"])),
        ("Settings", settings),
        ("Time", str(record["created_utc"])),
        ("Versions", versions),
    ]


def one_reading_sentence(rows: list[AnyDict]) -> str:
    """Whether one reading of an error size fits all three methods; rows as in the report's table."""
    fits = [row["words"] for row in rows if row["all"]]
    most = max(sum(cell["accepted"] for cell in row["cells"]) for row in rows)
    if fits:
        return f"All three come out under {join_words(fits)}."
    words = {0: "none of them", 1: "one", 2: "two"}[most]
    return f"No reading fits all three methods; the best ones fit {words}."


def replicate_sentences(found: Reproduction) -> list[str]:
    """What each method does over seeds, in words."""
    replicates = found.replicates
    if replicates.n_replicates < ENOUGH_REPLICATES:
        return [replicates.verdict]
    return [text[:1].upper() + text[1:] for text in map(replicates.verdict_of, replicates.labels)]


def signed(z: float) -> str:
    """A z-value with its sign."""
    if not np.isfinite(z):
        return ""
    decimals = 1 if abs(z) < 100.0 else 0
    text = fixed(z, decimals)
    return f"+{text}" if z > 0 and float(text) > 0 else text


def minus(text: str) -> str:
    """A printed number with a true minus sign."""
    return text.replace("-", MINUS)


def printed_errors() -> dict[str, list[str]]:
    """What the paper prints as reprojection errors and largest residuals, method by method."""
    return {q: [printed(m, q).text for m in PAPER_METHODS] for q in ("reprojection_px", "max_residual_px")}
