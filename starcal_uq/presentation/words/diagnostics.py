"""What questions a result, in sentences and tables: misfit, jackknife, models, predictive checks,
validation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starcal_uq.camera.distortion import Parameter
from starcal_uq.core.formatting import (
    count,
    decimals_for,
    fixed,
    join_words,
    p_value,
    p_words,
    percent,
    plural,
    significant,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.diagnose import Diagnosis
from starcal_uq.diagnostics.jackknife import Jackknife
from starcal_uq.diagnostics.misfit import Misfit
from starcal_uq.diagnostics.models import ModelComparison
from starcal_uq.diagnostics.predictive import PredictiveCheck
from starcal_uq.diagnostics.stars import StarTest
from starcal_uq.diagnostics.validation.replicates import LOG_LIKELIHOOD
from starcal_uq.diagnostics.validation.result import ENOUGH_REPLICATES, Validation
from starcal_uq.diagnostics.verdict.estimate import JACKKNIFE_P, MISFIT_P
from starcal_uq.diagnostics.verdict.judge import Verdict
from starcal_uq.inference.checks import COMPRESSED_BOUND
from starcal_uq.presentation.tables import TextTable, with_units

NBSP = "\N{NO-BREAK SPACE}"
# Errors this far from one posterior standard deviation are said to be too narrow or too wide; a
# mean error this far from zero is said to be a bias.
_SCALE_NOTED = 0.03
_BIAS_NOTED = 0.1


def verdict_text(verdict: Verdict) -> str:
    """The outcome and the headline."""
    return f"{verdict.level.value}. {verdict.headline}"


def verdict_notes(verdict: Verdict) -> list[str]:
    """Every check that did not pass; files of remedies as they are called from the current
    folder.
    """
    here = f"{Path.cwd()}/"
    return [str(check).replace(here, "") for check in verdict.doubts]


def misfit_text(found: Misfit) -> str:
    """How many tests there are, and what they found."""
    tests = f"{plural(len(found.tests), 'test')}, overall {p_words(found.p_value)}"
    rejected = [test.name for test in found.found()]
    return (
        f"{tests}: {join_words(rejected)}." if rejected else f"{tests}: no unexplained structure."
    )


def misfit_table(found: Misfit, *, found_only: bool = False) -> TextTable:
    """One row per test; what found something is marked, and alone has amplitudes where so asked."""
    rows = tuple(
        (
            test.name[0].upper() + test.name[1:],
            test.against,
            f"F({count(test.dof)}, {count(test.dof_residual)}) = {fixed(test.statistic, 2)}"
            if test.dof
            else f"z = {fixed(test.statistic, 2)}",
            p_value(test.p_value),
            p_value(test.p_holm),
            "" if np.isnan(test.size_px) else significant(test.size_px),
            "" if np.isnan(test.visible) else percent(test.visible),
            "" if found_only and test.p_holm >= MISFIT_P else "; ".join(map(str, test.amplitudes)),
        )
        for test in found.tests
    )
    heads = (
        "Looks for",
        "Against",
        "Statistic",
        "p",
        "p, corrected",
        "Size [px]",
        "Visible",
        "Amplitudes",
    )
    marks = tuple("warning" if test.p_holm < MISFIT_P else "" for test in found.tests)
    return TextTable(heads, rows, "Misfit", "llrrrrrl", marks)


def jackknife_text(found: Jackknife) -> str:
    """By how much frames scatter more than the formal errors say."""
    low, high = found.ratio.min(), found.ratio.max()
    frames = plural(found.n_frames, "frame")
    return (
        f"Sigmas from the scatter of {frames} are {fixed(low, 2)} to {fixed(high, 2)} times the "
        "formal ones."
    )


def _sigmas(covariance: FloatArray, specs: Sequence[Parameter]) -> list[str]:
    """Sigmas in the units of `specs`, or in px units."""
    scales = [spec.scale for spec in specs] or 1.0
    return [significant(v) for v in np.sqrt(np.diag(covariance)) / scales]


def jackknife_table(found: Jackknife, specs: Sequence[Parameter] = ()) -> TextTable:
    """One row per parameter; sigmas in the units of `specs`, or in px units."""
    low, high = found.expected()
    columns = (
        _sigmas(found.formal_covariance, specs),
        _sigmas(found.sandwich_covariance, specs),
        [fixed(v, 2) for v in found.ratio],
        [f"{fixed(a, 2)} to {fixed(b, 2)}" for a, b in zip(low, high, strict=True)],
        [fixed(v, 2) for v in found.jackknife_ratio],
        [significant(v) for v in found.p_values],
    )
    heads = (
        "Formal σ",
        "Over frames σ",
        "Ratio",
        "By chance (95 %)",
        "Jackknife ratio",
        "p",
    )
    rows = tuple(zip(found.parameter_names, *columns, strict=True))
    table = TextTable(("", *heads), rows, "Jackknife over frames")
    return with_units(table, specs) if specs else table


def star_table(found: StarTest, specs: Sequence[Parameter] = ()) -> TextTable:
    """One row per parameter: sigmas with the star as the unit of what is independent."""
    covariances = (
        found.formal_covariance,
        found.model_covariance,
        found.sandwich_covariance,
        found.jackknife_covariance,
    )
    columns = [_sigmas(c, specs) for c in covariances]
    heads = ("Formal σ", "With star errors", "Ratio", "Cluster-robust σ", "Jackknife σ")
    ratio = [fixed(v, 2) for v in found.widening]
    rows = tuple(zip(found.parameter_names, *columns[:2], ratio, *columns[2:], strict=True))
    table = TextTable(("", *heads), rows, "Errors of the stars")
    return with_units(table, specs) if specs else table


def models_table(found: ModelComparison, sigma_unit: str = "", fitted: str = "fitted") -> TextTable:
    """One row per model, the best first; common and rest are the attitudes' move across the
    boresight / in roll.
    """

    def moved(part: tuple[float, float, float]) -> str:
        return f"{significant(np.hypot(*part[:2]))} / {significant(abs(part[2]))}"

    rows = []
    for score in found.scores:
        mine, best = score.model == found.fitted, score.difference == 0.0
        replaced = f" ({score.n_replaced} in closed form)" if score.n_replaced else ""
        rows.append(
            (
                f"{score.model} ({fitted})" if mine else score.model,
                str(score.n_parameters),
                significant(score.sigma, 4) + sigma_unit,
                "best"
                if best
                else f"{fixed(score.difference, 1)} ± {fixed(score.difference_se, 1)}",
                "rejected" if score.rejected else "not rejected",
                *(("–", "–") if mine else (moved(score.common_arcsec), moved(score.rest_arcsec))),
                fixed(score.max_khat, 2) + replaced,
            )
        )
    heads = (
        "Model",
        "Parameters",
        "Noise",
        "Difference [nat]",
        "Outcome",
        "Common [arcsec]",
        "Rest [arcsec]",
        "k-hat",
    )
    some = found.n_sampled_frames < found.n_frames
    of = (
        f" (k-hat of {count(found.n_sampled_frames)} of {plural(found.n_frames, 'frame')})"
        if some
        else ""
    )
    return TextTable(heads, tuple(rows), f"Distortion models{of}", "lrrrlrrr")


def predictive_text(found: PredictiveCheck) -> str:
    """How many statistics of the residuals lie outside what the posterior predicts."""
    extreme = [s.name for s in found.statistics if s.extreme]
    asked = (
        f"{len(found.statistics)} statistics of the residuals against "
        f"{plural(found.n_draws, 'draw')}"
    )
    if found.n_frames < found.of_frames:
        asked += f" on {count(found.n_frames)} of {plural(found.of_frames, 'frame')}"
    return f"{asked}: {'nothing extreme' if not extreme else 'extreme are ' + join_words(extreme)}."


def predictive_table(found: PredictiveCheck) -> TextTable:
    """One row per statistic: the data, and the range of 95 % of the replicates."""
    rows = []
    for s in found.statistics:
        decimals = decimals_for(s.replicated_high - s.replicated_low)
        low, high = fixed(s.replicated_low, decimals), fixed(s.replicated_high, decimals)
        p = p_value(s.p_value, 1.0 / found.n_draws)
        rows.append((s.name, fixed(s.observed, decimals), f"{low} to {high}", p))
    return TextTable(
        ("Statistic", "Data", "Replicates (95 %)", "p"), tuple(rows), "Predictive checks"
    )


def sensitivity(diagnosis: Diagnosis) -> str:
    """The smallest effects that the checks find nine times in ten, with as many data as there
    were.
    """
    found, frames = diagnosis.misfit, diagnosis.jackknife
    smooth = [test for test in found.tests if test.against == "radius" and test.detectable_px > 0.0]
    seen = []
    if smooth:
        test = smooth[-1]
        seen.append(
            f"a {test.name} of {significant(test.detectable_px)} px (rms per axis, beyond what "
            "the fit absorbs)"
        )
    if frames is not None:
        ratio = float(frames.detectable(JACKKNIFE_P / len(frames.ratio)).min())
        seen.append(f"frames that make sigma {significant(ratio)} times as large as stated")
    if not seen:
        return ""
    data = f"{plural(found.n_frames, 'frame')} and {plural(found.n_stars, 'star')}"
    return (
        f"What {data} let these checks see nine times in ten: {join_words(seen)}; less may be "
        "there."
    )


def diagnosis_text(found: Diagnosis) -> str:
    """Every part in its own words."""
    parts = (found.misfit, found.jackknife, found.stars, found.comparison, found.predictive)
    return "\n".join(
        [*(part.text for part in parts if part is not None), sensitivity(found)]
    ).strip()


def diagnosis_html(found: Diagnosis) -> str:
    """Every part, one after the other."""
    parts = (found.misfit, found.jackknife, found.stars, found.comparison, found.predictive)
    return "".join(part._repr_html_() or "" for part in parts if part is not None)


def validation_table(found: Validation) -> TextTable:
    """Coverage and ranks, one row per quantity."""
    columns = (
        "quantity",
        "unit",
        "coverage_95",
        "coverage_low",
        "coverage_high",
        "coverage_p",
        "rank_p",
    )
    return TextTable.of(found.to_dataframe(), "Validation", columns)


def validation_text(found: Validation) -> str:
    """One paragraph: is all well, on what evidence, what does not hold, and what else to know."""
    rejected = [f for f in found.findings if f.rejected]
    if rejected:
        opening = "The uncertainties are not right"
    elif found.n_replicates < ENOUGH_REPLICATES:
        opening = (
            f"Too few replicates to judge (give at least {ENOUGH_REPLICATES}); nothing objects "
            "so far"
        )
    else:
        opening = "The uncertainties are right as far as this validation can tell"
    frames = found.provenance.settings.get("n_frames")
    data = "" if frames is None else f" of {plural(int(frames), 'frame')}"
    sentences = [
        f"{opening}: over {plural(found.n_replicates, 'replicate')}{data}, {_evidence(found)}."
    ]
    if rejected:
        sentences.append(_objections(found))
    else:
        first = found.findings[0]
        sentences.append(
            f"None of {len(found.findings)} tests objects at an overall level of 1{NBSP}% "
            "(smallest p-value: "
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
        f"95{NBSP}% intervals hold the truth in {percent(coverage[low], 3)} "
        f"({spoken(found.quantities[low])}) to "
        f"{percent(coverage[high], 3)} ({spoken(found.quantities[high])}) of the cases, where "
        "chance alone moves each "
        f"by ±{fixed(100.0 * half, 1)}{NBSP}%, and the squared errors of the camera parameters are "
        f"{fixed(found.nees_ratio, 3)} times what the posterior covariance says, where chance "
        "alone moves that by "
        f"±{fixed(1.96 * found.nees_ratio_se, 3)}"
    )


def _objections(found: Validation) -> str:
    """What the tests object to, and how the errors of these quantities compare with their
    posteriors.
    """
    rejected = [f for f in found.findings if f.rejected]
    parts = []
    for test, words in (("ranks", "the ranks of {}"), ("coverage", "the coverage of {}")):
        some = [f for f in rejected if f.test == test]
        if some:
            names = join_words(
                [spoken(q) for q in found.quantities if any(f.quantity == q for f in some)]
            )
            parts.append(f"{words.format(names)} (p{NBSP}{_p(max(f.p_value for f in some))})")
    if any(f.test == "NEES" for f in rejected):
        parts.append(
            f"the squared errors of the camera parameters (p{NBSP}{_p(found.nees_p_value)})"
        )
    wrong = {f.quantity for f in rejected}
    return (
        "What does not hold: "
        f"{join_words(parts)}.{_how(found, [q for q in found.quantities if q in wrong])}"
    )


def _p(value: float) -> str:
    return f"<{NBSP}0.0001" if value < 1e-4 else f"={NBSP}{significant(value)}"


def _how(found: Validation, names: list[str]) -> str:
    """Too narrow, too wide or off-centre, where the errors show it; the log likelihood has no
    symmetric error.
    """
    sentences = []
    # All of the camera parameters where they are rejected together.
    names = [n for n in names if n != LOG_LIKELIHOOD] or list(
        found.quantities[: found.n_parameters]
    )
    z = {name: found.z[:, found.quantities.index(name)] for name in names}
    spread = {name: float(np.std(values)) for name, values in z.items()}
    for word, factors in (
        ("narrow", {n: s for n, s in spread.items() if s > 1.0 + _SCALE_NOTED}),
        ("wide", {n: 1.0 / s for n, s in spread.items() if s < 1.0 - _SCALE_NOTED}),
    ):
        if factors:
            low, high = (fixed(v, 2) for v in (min(factors.values()), max(factors.values())))
            by = f"a factor of {low}" if low == high else f"factors of {low} to {high}"
            sentences.append(
                f" Intervals are too {word} for {join_words([*map(spoken, factors)])}, by {by}."
            )
    for name, values in z.items():
        mean = float(np.mean(values))
        if abs(mean) > max(_BIAS_NOTED, 3.0 * spread[name] / np.sqrt(len(values))):
            side = "high" if mean > 0 else "low"
            sentences.append(
                f" Estimates of {spoken(name)} are too {side} by {fixed(abs(mean), 2)} posterior "
                "standard deviations."
            )
    return "".join(sentences)


def _notes(found: Validation) -> list[str]:
    notes = []
    if found.failures:
        reason, number = Counter(found.failures).most_common(1)[0]
        total = found.n_replicates + len(found.failures)
        notes.append(
            f"{count(len(found.failures))} of {plural(total, 'replicate')} gave no result, "
            f"{count(number)} of them "
            f"because {reason}"
        )
    far = int(np.sum(np.abs(found.compression_error) > COMPRESSED_BOUND))
    if far:
        notes.append(
            f"In {plural(far, 'replicate')} the compressed likelihood was more than "
            f"{COMPRESSED_BOUND:g} nat from the "
            "exact one at the truth; `sample` would have taken the exact one there."
        )
    if found.interrupted:
        notes.append(
            f"The run was interrupted after {count(found.n_replicates)} of "
            f"{count(found.n_requested)}."
        )
    return notes
