"""Checks of the estimate and of its model in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from starcal_uq.core.formatting import count, fixed, join_words, p_words, plural, significant
from starcal_uq.core.status import Code, Level, Status
from starcal_uq.diagnostics.models import ModelComparison
from starcal_uq.diagnostics.stars import StarTest
from starcal_uq.diagnostics.verdict.effect import Effect
from starcal_uq.diagnostics.verdict.estimate import model_facts, star_facts
from starcal_uq.estimation.undetermined import what_is_open
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.presentation.sentences.table import Told, entry

# Tests that a sentence names; of more it says how many there are.
_NAMED = 3


def effect_sentence(effect_on: str, effect_sigma: float) -> str:
    """The largest thing that a misfit does."""
    size = significant(effect_sigma)
    if Effect(effect_on, effect_sigma).level is Level.FAIL:
        return f"It moves {effect_on} by {size} times the stated standard deviation."
    if not effect_sigma > 0.0:
        return "As far as the data tell, it moves no parameter, direction or attitude."
    return (
        f"It moves nothing by as much as is stated: {effect_on} by {size} of the standard "
        "deviation, others by less."
    )


@entry(Code.ESTIMATION)
def _estimation(
    good: bool, status: Status, n_stages: int, n_iterations: int, by_priors: Sequence[str]
) -> Told:
    if by_priors:
        said = what_is_open(tuple(by_priors))
        sentence = f"{said[0].upper()}{said[1:]}: there the posterior is that of the priors."
    elif status.ok:
        sentence = (
            f"All {plural(n_stages, 'stage')} ended at an optimum, after "
            f"{plural(n_iterations, 'iteration')}."
        )
    else:
        sentence = "The estimate is not an optimum."
    return status.name.lower().replace("_", " "), "converged", sentence


def fallback_sentence(
    used: str = "",
    model: str = "",
    because: str = "",
    left_out: Sequence[str] = (),
    x0_px: float = 0.0,
    y0_px: float = 0.0,
    times: float = 0.0,
) -> str:
    """What the data do not determine of the camera's model, and what the sigmas rest on; empty
    where they do.
    """
    if used:
        verb = "is" if len(left_out) == 1 else "are"
        return (
            f"Distortion model {used!r} in place of {model!r}: {because}. The sigmas hold if "
            f"{join_words(left_out)} {verb} zero."
        )
    if not times:
        return ""
    return (
        "The distortion may be none, and without its coma the stars tell the principal point to "
        f"{significant(x0_px)} and {significant(y0_px)} px only: sigmas hold that, and are up to "
        f"{significant(times)} times as large as with it."
    )


@entry(Code.MODEL_THAT_THE_DATA_DETERMINE)
def _determined(good: bool, used: str = "", model: str = "", **found: Any) -> Told:
    sentence = fallback_sentence(used, model, **found)
    if not used:
        return "principal point from coma alone", "without", sentence
    return used, model, sentence


@entry(Code.TWO_ESTIMATORS)
def _estimators(good: bool, difference_sigma: float, parameter: str, below_sigma: float) -> Told:
    sentence = (
        "Interstar angles alone, which do not involve the attitude, give the same camera."
        if good
        else f"Interstar angles alone give another {parameter}: the data do not fit the model, or "
        "a wrong optimum was found."
    )
    value = f"{fixed(difference_sigma, 1)} sigma ({parameter})"
    return value, f"< {fixed(below_sigma, 1)} sigma", sentence


@entry(Code.KNOWN_ROTATIONS)
def _rotations(
    good: bool, chi2: float, dof: int, p_value: float, p_least: float, error_factor: float = 1.0
) -> Told:
    value = f"chi-square {fixed(chi2, 1)} for {dof}, {p_words(p_value)}"
    sentence = "The known rotations between frames agree with the stars within their errors."
    if not good:
        sentence = (
            "The known rotations between frames contradict the stars: their errors would have to "
            f"be {significant(error_factor)} times the stated ones."
        )
    return value, f"p ≥ {p_least:g}", sentence


@entry(Code.KNOWN_TRUTH)
def _truth(good: bool, error_sigma: float, parameter: str, below_sigma: float) -> Told:
    sentence = (
        "The truth of the simulation lies where the uncertainties say."
        if good
        else f"{parameter} is further from the truth than its sigma allows: the uncertainties are "
        "wrong."
    )
    value = f"largest |z| {fixed(error_sigma, 1)} ({parameter})"
    return value, f"< {fixed(below_sigma, 1)}", sentence


@entry(Code.ONE_CAMERA)
def _one_camera(good: bool, n_cameras: int, clause: str) -> Told:
    return f"{n_cameras} cameras", "1", f"{clause[0].upper()}{clause[1:]}."


@entry(Code.UNEXPLAINED_STRUCTURE)
def _misfit(
    good: bool,
    p_value: float,
    n_tests: int,
    p_least: float,
    tests: Sequence[tuple[str, float, float]] = (),
    moved: str = "",
    error_times: float = 1.0,
    effects: Sequence[str] = (),
    **effect: Any,
) -> Told:
    value = f"{p_words(p_value)}, corrected for {plural(n_tests, 'test')}"
    bound = f"p ≥ {p_least:g}"
    if not tests:
        sentence = (
            "The residuals show no structure beyond noise, in any of the ways that were looked for."
        )
        return value, bound, sentence
    words = []
    for name, p_holm, size_px in tests[:_NAMED]:
        size = "" if np.isnan(size_px) else f", {significant(size_px)} px"
        words.append(f"{name} ({p_words(p_holm)}{size})")
    further = len(tests) - _NAMED
    more = f" and {plural(further, 'other test')}" if further > 0 else ""
    sentence = (
        f"The residuals hold more than noise: {join_words(words)}{more}. "
        f"{effect_sentence(**effect)}"
    )
    if moved:
        sentence += (
            f" These data hardly tell {tests[0][0]} from {moved}: with both fitted, the error of "
            f"{moved} would be {significant(error_times)} times as large."
        )
    if effects:
        called = "effect" if len(effects) == 1 else "effects"
        sentence += f" The data would take up the {called} {join_words(list(effects))}."
    return value, bound, sentence


@entry(Code.EVENNESS_OF_THE_NOISE)
def _even_noise(
    _: bool,
    p_value: float,
    tests: Sequence[str],
    p_least: float,
    noise: NoiseModel | None = None,
    parameter: str = "",
    ratio: float = 1.0,
) -> Told:
    changes = f"The residuals hold {join_words(tests)}"
    if not tests:
        sentence = (
            "The noise does not change with radius, magnitude, time, frame or axis beyond what "
            "the weights know of it."
        )
    elif noise is None:
        sentence = f"{changes}, which the weights of the stars do not know: the stated sigmas may be wrong."
    elif not noise.varies:
        sentence = f"{changes}, too little of it to change a stated sigma."
    else:
        of_attitude = (
            "" if noise.axes is None else " and the attitude noise of each axis is another"
        )
        sentence = (
            f"{changes}: {noise}. The stated sigmas do not know it: that of {parameter} should be "
            f"{significant(ratio)} times as large{of_attitude}; with fitted weights the estimate "
            "itself would be more precise."
        )
    return p_words(p_value), f"p ≥ {p_least:g}", sentence


@entry(Code.JACKKNIFE_OVER_FRAMES)
def _jackknife(
    _: bool,
    least: float,
    most: float,
    parameter: str,
    disagreeing: Sequence[str],
    ratio_most: float,
) -> Told:
    sentence = "Frames scatter as the formal errors say."
    if disagreeing:
        sentence = (
            f"Frames disagree more than their formal errors allow, in {join_words(disagreeing)}: "
            "something makes stars of a frame err together, and sigma is too small by a factor of "
            f"up to {fixed(most, 2)}."
        )
    value = f"ratios {fixed(least, 2)} to {fixed(most, 2)} ({parameter})"
    return value, f"≤ {fixed(ratio_most, 2)}", sentence


def _star_sentence(
    included_px: float,
    included_std_px: float,
    seen: bool | None = None,
    error_px: float = 0.0,
    error_std_px: float = 0.0,
    visible_px: float = 0.0,
    arcsec_per_px: float = 0.0,
    parameter: str = "",
    widening: float = 1.0,
    **_: float,
) -> str:
    def sized(px: float) -> str:
        return f"{significant(px)} px ({significant(px * arcsec_per_px)} arcsec)"

    if seen is None:
        return (
            "Too few stars are seen in several frames to test whether a star errs alike in all "
            "of them; where none is, such errors act as noise."
        )
    if not seen:
        return (
            "Residuals of one star in different frames are as independent as noise; a direction "
            f"error of {sized(visible_px)} would have been seen nine times in ten."
        )
    if included_px > 0.0:
        return (
            f"Each star brings a direction error of {sized(included_px)} ± "
            f"{significant(included_std_px)} px per axis along into every frame; estimate and "
            "intervals hold that."
        )
    return (
        f"Each star brings a direction error of {sized(error_px)} ± {significant(error_std_px)} px "
        "per axis along into every frame: more frames of the same stars do not average it out, "
        f"and sigma of {parameter} is {fixed(widening, 2)} times what is stated."
    )


def star_sentence(found: StarTest) -> str:
    """Size of the stars' own errors, and what they do to sigma."""
    return _star_sentence(**star_facts(found))


@entry(Code.ERRORS_OF_THE_STARS)
def _stars(
    good: bool,
    included_px: float,
    included_std_px: float,
    seen: bool | None = None,
    p_value: float = 1.0,
    parameter: str = "",
    widening: float = 1.0,
    p_least: float | None = None,
    error_most_px: float | None = None,
    **sizes: float,
) -> Told:
    sentence = _star_sentence(
        included_px, included_std_px, seen, parameter=parameter, widening=widening, **sizes
    )
    included = f"{significant(included_px)} ± {significant(included_std_px)} px"
    if error_most_px is not None:
        return (
            included,
            f"≤ {error_most_px:g} px",
            f"{sentence} No catalogue errs by that: something else is wrong, and is hidden by it.",
        )
    bound = f"p ≥ {p_least:g}"
    if seen is None:
        return "too few stars recur", bound, sentence
    if seen and included_px > 0.0:
        return included, "in the intervals", sentence
    value = f"p = {significant(p_value)}, sigma × {fixed(widening, 2)} ({parameter})"
    return value, bound, sentence


def _models_sentence(
    fitted: str,
    best: str,
    better: str | None = None,
    simplest: str = "",
    not_needed: Sequence[str] = (),
    others: Sequence[str] = (),
    **size: float,
) -> str:
    if better is not None:
        first = (
            f"The model {fitted!r} predicts left-out frames worse than {best!r} by "
            f"{fixed(-size['difference_nat'], 1)} ± {fixed(size['difference_se_nat'], 1)} nat: use {better!r}."
        )
    elif simplest:
        verb = "is" if len(not_needed) == 1 else "are"
        first = (
            f"{join_words(not_needed)} {verb} not needed: {simplest!r} predicts left-out frames "
            f"no worse than {fitted!r}."
        )
    else:
        first = f"No other model predicts left-out frames better than {fitted!r} beyond doubt."
    if not others:
        return f"{first} All other models are rejected."
    return (
        f"{first} Under the other models that the data do not reject ({join_words(others)}), "
        f"attitudes across the boresight would move by up to {significant(size['common_arcsec'])} "
        f"arcsec in common and {significant(size['rest_arcsec'])} arcsec (rms) frame by frame."
    )


def models_sentence(models: ModelComparison) -> str:
    """Whether another model predicts left-out frames better, and what attitudes would do under the
    others.
    """
    return _models_sentence(**model_facts(models))


@entry(Code.DISTORTION_MODEL)
def _comparison(
    good: bool,
    fitted: str,
    best: str,
    difference_nat: float = 0.0,
    difference_se_nat: float = 0.0,
    effect_on: str = "",
    effect_sigma: float = 0.0,
    **others: Any,
) -> Told:
    size: dict[str, Any] = {
        "difference_nat": difference_nat,
        "difference_se_nat": difference_se_nat,
    }
    sentence = _models_sentence(fitted, best, **size, **others)
    value = (
        f"{fixed(difference_nat, 1)} ± {fixed(difference_se_nat, 1)} nat from {best!r}"
        if difference_nat
        else f"{fitted!r} predicts best"
    )
    if effect_on:
        sentence = f"{sentence} {effect_sentence(effect_on, effect_sigma)}"
    return value, "not rejected", sentence


@entry(Code.POSTERIOR_PREDICTIVE_CHECK)
def _predictive(
    good: bool, p_value: float, n_draws: int, extreme: Sequence[str], p_least: float, p_most: float
) -> Told:
    sentence = (
        "Data made by the model have the same spread, tails and patterns as the measured ones."
        if good
        else f"Data made by the model differ from the measured ones in: {join_words(extreme)}."
    )
    value = f"most extreme {p_words(p_value, 1.0 / n_draws)}"
    return value, f"{p_least:g} to {p_most:g}", sentence


@entry(Code.OTHER_STARTS)
def _starts(
    good: bool, n_starts: int, same: int, better: int, n_frames: int, of_frames: int
) -> Told:
    value = f"{same} of {n_starts} starts"
    if n_frames < of_frames:
        value += f", {count(n_frames)} of {plural(of_frames, 'frame')}"
    if good:
        sentence = "Starts scattered around the nominal camera all lead to this optimum."
    elif better:
        sentence = "A start elsewhere reached a better optimum."
    else:
        sentence = (
            f"{plural(n_starts - same, 'start')} did not reach this optimum, and no start reached "
            "a better one."
        )
    return value, "all at the same optimum", sentence
