"""Checks of draws in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from starcal_uq.core.formatting import (
    count,
    fixed,
    join_words,
    percent,
    plural,
    significant,
)
from starcal_uq.core.status import Code, Note
from starcal_uq.presentation.sentences.table import Told, entry


@entry(Code.R_HAT)
def _rhat(
    good: bool, rhat: float, disagreeing: Sequence[str], n_ensembles: int, rhat_below: float
) -> Told:
    sentence = (
        f"The {n_ensembles} separately seeded ensembles sampled the same distribution."
        if good
        else f"The ensembles disagree in {join_words(disagreeing)}: raise n_steps before using "
        "any interval."
    )
    return fixed(rhat, 4), f"< {rhat_below}", sentence


@entry(Code.EFFECTIVE_DRAWS)
def _effective_draws(
    good: bool, bulk: float, tail: float, too_few: Sequence[str], draws_above: float
) -> Told:
    sentence = (
        "Enough effective draws for stable means and interval ends."
        if good
        else f"Too few effective draws of {join_words(too_few)} for stable interval ends: raise "
        "n_steps."
    )
    value = f"{count(int(bulk))} bulk, {count(int(tail))} tail"
    return value, f"> {draws_above:g} each", sentence


@entry(Code.ACCEPTANCE)
def _acceptance(good: bool, least: float, most: float, above: float, below: float) -> Told:
    sentence = (
        "The sampler moves freely."
        if good
        else "The sampler hardly moves, or moves in tiny steps: the posterior is far from its "
        "Gaussian approximation."
    )
    return f"{fixed(least, 2)} to {fixed(most, 2)}", f"{above:g} to {below:g}", sentence


def _converged(rhat: float, draws: float, rhat_below: float, draws_above: float) -> tuple[str, str]:
    value = f"R-hat {fixed(rhat, 4)}, {count(int(draws))} draws"
    return value, f"< {rhat_below}, > {draws_above:g}"


@entry(Code.DERIVED_QUANTITIES)
def _derived(good: bool, late: Sequence[str], **found: float) -> Told:
    sentence = (
        "Focal length, displacement at the corner and common rotation have converged too."
        if good
        else f"{late[0].capitalize()} has not converged: raise n_steps."
    )
    return *_converged(**found), sentence


@entry(Code.DEGREES_OF_FREEDOM)
def _degrees_of_freedom(good: bool, low: float, median: float, high: float, **found: float) -> Told:
    sentence = f"dof has the median {median:.3g} and the 95 % interval {low:.3g} to {high:.3g}."
    return *_converged(**found), sentence


@entry(Code.DIGITS)
def _digits(good: bool, last_digits: float, parameter: str, last_digits_most: float) -> Told:
    sentence = (
        "Monte Carlo error does not reach the last printed digit of any mean."
        if good
        else f"Monte Carlo error reaches the last printed digit of {parameter}: raise n_steps "
        "before quoting it."
    )
    value = f"{fixed(last_digits, 2)} units of the last digit ({parameter})"
    return value, f"≤ {last_digits_most:g}", sentence


@entry(Code.BOUNDS)
def _bounds(
    good: bool, outside: float, folded: float, nearest_sigma: float, outside_most: float
) -> Told:
    if good:
        sentence = (
            "No draw has its principal point off the detector, f below zero or a distortion that "
            "folds."
        )
    elif folded > 0.0:
        sentence = (
            "The distortion of some draws folds over within the field: the data do not determine "
            "it."
        )
    else:
        sentence = (
            f"{percent(outside)} of the draws have their principal point off the detector or f "
            "below zero."
        )
    value = f"nearest bound {significant(nearest_sigma)} sigma away"
    return value, f"≤ {percent(outside_most, 1)} of draws outside", sentence


@entry(Code.INDEPENDENT_POSTERIOR)
def _independent(
    good: bool,
    means_sigma: float,
    sigmas: float,
    khat: float,
    mode_found: bool,
    means_sigma_most: float,
    sigmas_most: float,
    khat_below: float,
) -> Told:
    if good:
        sentence = (
            "Importance sampling, which uses no Markov chain, gives the same means and sigmas."
        )
    elif khat < khat_below:
        sentence = (
            "Importance sampling gives other means or sigmas: at least one of the two is wrong."
        )
    else:
        sentence = (
            "The posterior is far from Gaussian, so the independent check by importance sampling "
            "says nothing."
        )
    if not mode_found:
        sentence += (
            " Newton's method did not settle on the mode; importance sampling starts from its "
            "last step."
        )
    value = f"means {fixed(means_sigma, 3)} sigma, sigmas {percent(sigmas)}, k-hat {fixed(khat, 2)}"
    bound = f"{fixed(means_sigma_most, 3)} sigma, {percent(sigmas_most)}, {khat_below:g}"
    return value, bound, sentence


@entry(Code.LIKELIHOOD)
def _evaluation(
    good: bool,
    used: Literal["exact", "compressed"],
    difference_nat: float | None,
    khat: float,
    n_frames: int,
    of_frames: int,
    standard_errors: float,
    difference_most_nat: float,
    khat_most: float,
) -> Told:
    bound = f"≤ {difference_most_nat:g} nat, ≤ {khat_most:g}"
    if difference_nat is None:
        sentence = (
            "The compressed likelihood was not compared with the exact one: the observations "
            "were not at hand."
        )
        return "not checked", bound, sentence
    value = f"{significant(difference_nat)} nat, k-hat {fixed(khat, 2)}"
    if used == "exact":
        sentence = (
            f"The exact likelihood was sampled, because the fast one departs from it by {value}."
        )
        return "exact", bound, sentence
    if not good:
        sentence = "The fast likelihood departs from the exact one: sample the exact one."
        return value, bound, sentence
    sentence = "The fast likelihood equals the exact one wherever the posterior is"
    if n_frames:
        sentence += (
            f", as {count(n_frames)} of {plural(of_frames, 'frame')} tell with "
            f"{standard_errors:g} standard errors counted in"
        )
    return value, bound, f"{sentence}."


@entry(Note.PAIRS_AS_INDEPENDENT)
def _independent_pairs(n_pairs: int, narrowness: float) -> str:
    return (
        f"The {n_pairs} pairs of stars are treated as independent (pairs_naive): the intervals "
        f"are about {narrowness:.1f} times too narrow and must not be used; use "
        "likelihood='pairs' or 'marginal'."
    )


_STUDENT = (
    "It is a bivariate Student t per star, with the curvature that the scatter of the stars' "
    "scores shows. sigma is the scale of the Student t, which is below the standard deviation of "
    "its residuals."
)
# Where the variability of a composite likelihood comes from.
_VARIABILITY = {
    "expected": "the noise of every star",
    "empirical": "the scatter between frames",
}


@entry(Code.KIND_OF_LIKELIHOOD)
def _kind(
    good: bool,
    likelihood: str,
    refused: str,
    variability: str = "",
    n_pairs: int = 0,
    narrowness: float = 1.0,
) -> Told:
    sentences = [
        f"The posterior is that of the likelihood {likelihood!r}."
        if good
        else "Pairs of stars were taken as independent, which they are not."
    ]
    if likelihood == "student_t":
        sentences.append(_STUDENT)
    if variability:
        sentences.append(
            "It is the composite one over pairs of stars, with Godambe's curvature; its "
            f"variability comes from {_VARIABILITY[variability]}. sigma is estimated from the "
            "pixel residuals at the best attitudes; pairs have no say in it."
        )
    if n_pairs:
        sentences.append(_independent_pairs(n_pairs, narrowness))
    return likelihood, f"not {refused!r}", " ".join(sentences)


@entry(Code.INFLUENCE_OF_THE_PRIORS)
def _priors(
    good: bool,
    share: float,
    parameter: str,
    limited: Sequence[str],
    pulled: Sequence[str],
    furthest_sd: float,
    share_most: float,
) -> Told:
    if limited:
        sentence = f"The prior, not the data, decides {join_words(limited)}."
    elif pulled:
        sentence = (
            f"The data put {join_words(pulled)} {fixed(furthest_sd, 1)} prior standard deviations "
            "away from the prior's mean."
        )
    else:
        sentence = "The data decide every parameter; the priors hardly matter."
    value = f"sigma {percent(share)} of the prior's ({parameter})"
    return value, f"≤ {percent(share_most)}", sentence


@entry(Code.METHOD_OF_THE_CALIBRATION)
def _method(good: bool, method: str, ignored: str) -> Told:
    sentence = (
        f"The method {method!r} ignores the distortion (model {ignored!r} was given): this "
        "posterior is that of a camera without any, and neither its centre nor its width holds "
        "otherwise; use method='efficient'."
    )
    return method, "one that fits the distortion", sentence


@entry(Code.DATA_OF_THE_POSTERIOR)
def _same_data(good: bool, sampled_sha256: str, at_hand_sha256: str) -> Told:
    sentence = (
        "The posterior was sampled from the observations at hand."
        if good
        else "The posterior was sampled from other observations than those at hand: sample again."
    )
    return f"SHA-256 {sampled_sha256[:12]}…", f"{at_hand_sha256[:12]}…", sentence


@entry(Code.PROPAGATION_TO_ATTITUDE)
def _propagation(good: bool, difference: float, difference_most: float) -> Told:
    sentence = (
        "Draws through QUEST and first-order propagation give the same attitude error."
        if good
        else "Draws through QUEST and first-order propagation differ: prefer the draws, and raise "
        "their number."
    )
    return f"sigmas within {percent(difference)}", f"≤ {percent(difference_most)}", sentence
