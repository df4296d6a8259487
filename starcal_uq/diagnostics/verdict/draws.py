"""Checks of the draws: convergence, independent evidence, the part of the priors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import count, decimals_for, fixed, join_words, percent, significant
from starcal_uq.core.status import Check, Level, Question, pass_or_fail, pass_or_warn
from starcal_uq.inference.checks import (
    ACCEPTANCE_RANGE,
    AGREEMENT_BOUND,
    COMPRESSED_BOUND,
    ESS_BOUND,
    KHAT_BOUND,
    RHAT_BOUND,
)

if TYPE_CHECKING:
    from starcal_uq.inference.derived import Derived
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError

_FOLD_DRAWS = 40
BOUNDS_SHARE = 1e-3
PRIOR_SHARE, PRIOR_PULL = 0.5, 3.0
# What first order leaves out, and how many Monte Carlo errors of a sampled sigma are tolerated beyond it.
PROPAGATION_SLACK, PROPAGATION_ERRORS = 0.03, 4.0


def chains_agree(post: Posterior) -> Check:
    """R-hat over separately seeded ensembles."""
    worst_rhat = float(np.nanmax(post.diagnostics.rhat))
    good = worst_rhat < RHAT_BOUND
    sentence = (
        f"The {post.n_ensembles} separately seeded ensembles sampled the same distribution."
        if good
        else "The ensembles disagree: raise n_steps before using any interval."
    )
    return _sampling("R-hat", good, fixed(worst_rhat, 4), f"< {RHAT_BOUND}", sentence)


def effective_draws(post: Posterior) -> Check:
    """Smallest effective number of draws, bulk and tail."""
    d = post.diagnostics
    bulk, tail = float(np.nanmin(d.ess_bulk)), float(np.nanmin(d.ess_tail))
    good = min(bulk, tail) > ESS_BOUND
    sentence = (
        "Enough effective draws for stable means and interval ends."
        if good
        else "Too few effective draws for stable interval ends: raise n_steps."
    )
    value = f"{count(int(bulk))} bulk, {count(int(tail))} tail"
    return _sampling("Effective draws", good, value, f"> {ESS_BOUND:g} each", sentence)


def acceptance(post: Posterior) -> Check:
    """Share of accepted proposals."""
    low, high = ACCEPTANCE_RANGE
    rates = post.diagnostics.acceptance
    good = bool(np.all((rates > low) & (rates < high)))
    sentence = (
        "The sampler moves freely."
        if good
        else "The sampler hardly moves, or moves in tiny steps: the posterior is far from its Gaussian approximation."
    )
    value = f"{fixed(float(np.min(rates)), 2)} to {fixed(float(np.max(rates)), 2)}"
    return _sampling("Acceptance", good, value, f"{low:g} to {high:g}", sentence)


def independent_posterior(post: Posterior) -> Check:
    """Importance sampling around the Laplace approximation, which uses no Markov chain."""
    d = post.diagnostics
    good = d.psis_khat < KHAT_BOUND and max(d.agreement_mean, d.agreement_sd) <= AGREEMENT_BOUND
    if good:
        sentence = "Importance sampling, which uses no Markov chain, gives the same means and sigmas."
    elif d.psis_khat >= KHAT_BOUND:
        sentence = "The posterior is far from Gaussian, so the independent check by importance sampling says nothing."
    else:
        sentence = "Importance sampling gives other means or sigmas: at least one of the two is wrong."
    value = f"means {fixed(d.agreement_mean, 3)} sigma, sigmas {percent(d.agreement_sd)}, k-hat {fixed(d.psis_khat, 2)}"
    threshold = f"{AGREEMENT_BOUND:g} sigma, {percent(AGREEMENT_BOUND, 1)}, {KHAT_BOUND:g}"
    return Check("Independent posterior", Question.TRUSTWORTHY, pass_or_fail(good), value, threshold, sentence)


def likelihood_exact(post: Posterior) -> Check | None:
    """Was the compressed likelihood good enough, where it was used?"""
    d = post.diagnostics
    if d.likelihood_used != "compressed":
        return None
    threshold = f"≤ {COMPRESSED_BOUND:g} nat"
    if not np.isfinite(d.compressed_max_difference):
        sentence = "The compressed likelihood was not compared with the exact one: the observations were not at hand."
        return Check("Likelihood", Question.TRUSTWORTHY, Level.WARN, "not checked", threshold, sentence)
    good = d.compressed_max_difference <= COMPRESSED_BOUND
    sentence = (
        "The fast likelihood equals the exact one at posterior draws."
        if good
        else "The fast likelihood departs from the exact one: sample with likelihood='exact'."
    )
    value = f"{significant(d.compressed_max_difference)} nat"
    return Check("Likelihood", Question.TRUSTWORTHY, pass_or_fail(good), value, threshold, sentence)


def likelihood_kind(post: Posterior) -> Check | None:
    """Was a likelihood sampled whose intervals are known to be wrong?"""
    kind = post.diagnostics.likelihood
    if kind == "marginal":
        return None
    good = kind != "pairs_naive"
    sentence = (
        f"The posterior is that of the likelihood {kind!r}."
        if good
        else "Pairs of stars were taken as independent: the intervals are several times too narrow."
    )
    threshold = "not 'pairs_naive'"
    return Check("Kind of likelihood", Question.TRUSTWORTHY, pass_or_fail(good), kind, threshold, sentence)


def same_data(post: Posterior, obs: Observations) -> Check:
    """Was the posterior sampled from these observations?"""
    good = post.provenance.get("data_sha256") == obs.data_hash
    sentence = (
        "The posterior was sampled from the observations at hand."
        if good
        else "The posterior was sampled from other observations than those at hand: sample again."
    )
    value = f"SHA-256 {str(post.provenance.get('data_sha256'))[:12]}…"
    threshold = f"{obs.data_hash[:12]}…"
    return Check("Data of the posterior", Question.CONVERGED, pass_or_fail(good), value, threshold, sentence)


def derived_converged(found: tuple[Derived, ...]) -> Check:
    """R-hat and effective draws of what follows from the parameters."""
    rhat = max(found, key=lambda d: d.rhat)
    fewest = min(found, key=lambda d: min(d.ess_bulk, d.ess_tail))
    ess = min(fewest.ess_bulk, fewest.ess_tail)
    good = rhat.rhat < RHAT_BOUND and ess > ESS_BOUND
    sentence = (
        "Focal length in mm, displacement at the corner and common rotation have converged too."
        if good
        else f"{(rhat if rhat.rhat >= RHAT_BOUND else fewest).name.capitalize()} has not converged: raise n_steps."
    )
    value = f"R-hat {fixed(rhat.rhat, 4)}, {count(int(ess))} draws"
    return _sampling("Derived quantities", good, value, f"< {RHAT_BOUND}, > {ESS_BOUND:g}", sentence)


def digits(post: Posterior) -> Check:
    """Does Monte Carlo error leave the printed digits alone?"""
    names, d = post.parameter_names, post.diagnostics
    # Digits are printed to the second one of sigma; the unit of the last is what the error must not exceed.
    worst, largest = names[0], 0.0
    for i in post.sampled:
        scale = post.parameters[i].scale
        unit = 10.0 ** -decimals_for(float(post.sd[i]) / scale)
        share = float(d.mcse[i]) / scale / unit
        if share > largest:
            worst, largest = names[i], share
    good = largest <= 1.0
    sentence = (
        "Monte Carlo error does not reach the last printed digit of any mean."
        if good
        else f"Monte Carlo error reaches the last printed digit of {worst}: raise n_steps before quoting it."
    )
    value = f"{fixed(largest, 2)} units of the last digit ({worst})"
    return Check("Digits", Question.CONVERGED, pass_or_warn(good), value, "≤ 1", sentence)


def bounds(post: Posterior) -> Check:
    """Do draws touch the edges of what a camera can be?"""
    from starcal_uq.camera.projection import fold_radius_px

    camera, theta = post.camera, post.theta_draws
    outside = float(np.mean(~camera.contains(theta[:, :2]) | (theta[:, 2] <= 0.0)))
    few = theta[np.linspace(0, len(theta) - 1, _FOLD_DRAWS).astype(int)]
    radius = camera.corner_radius_px
    folded = float(np.mean([fold_radius_px(camera.distortion, draw, radius) <= radius for draw in few]))
    sd = post.sd[:3]
    edges = np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    room = np.concatenate([(post.mean[:2] + 0.5) / sd[:2], (edges - post.mean[:2]) / sd[:2], post.mean[2:3] / sd[2:3]])
    good = outside <= BOUNDS_SHARE and folded == 0.0
    if good:
        sentence = "No draw has its principal point off the detector, f below zero or a distortion that folds."
    elif folded > 0.0:
        sentence = "The distortion of some draws folds over within the field: the data do not determine it."
    else:
        sentence = "Draws have their principal point off the detector or f below zero: add frames."
    value = f"nearest bound {significant(float(np.min(room)))} sigma away"
    share = f"≤ {percent(BOUNDS_SHARE, 1)} of draws outside"
    return Check("Bounds", Question.CONVERGED, pass_or_fail(good), value, share, sentence)


def prior_influence(post: Posterior) -> Check:
    """Did the data decide, or the prior?"""
    names = post.camera_names
    prior_mean, prior_sd = post.priors.mean(names), post.priors.sd(names)
    share = post.sd[: len(names)] / prior_sd
    pull = np.abs(post.mean - prior_mean) / prior_sd
    limited = [name for name, value in zip(names, share, strict=True) if value > PRIOR_SHARE]
    pulled = [name for name, value in zip(names, pull, strict=True) if value > PRIOR_PULL]
    largest = int(np.argmax(share))
    if limited:
        sentence = f"The prior, not the data, decides {join_words(limited)}."
    elif pulled:
        sentence = f"The data put {join_words(pulled)} far from the prior's mean: check the nominal camera."
    else:
        sentence = "The data decide every parameter; the priors hardly matter."
    value = f"sigma {percent(float(share[largest]))} of the prior's ({names[largest]})"
    level = pass_or_warn(not limited and not pulled)
    return Check("Influence of the priors", Question.TRUSTWORTHY, level, value, f"≤ {percent(PRIOR_SHARE)}", sentence)


def propagation(error: AttitudeError) -> Check:
    """Do draws through QUEST and first-order propagation give the same attitude error?"""
    largest = propagation_difference(error)
    # A standard deviation from n draws has a relative error of at most 1 / sqrt(2 n).
    bound = PROPAGATION_SLACK + PROPAGATION_ERRORS / float(np.sqrt(2.0 * error.n_draws))
    good = largest <= bound
    sentence = (
        "Draws through QUEST and first-order propagation give the same attitude error."
        if good
        else "Draws through QUEST and first-order propagation differ: prefer the draws, and raise their number."
    )
    value = f"sigmas within {percent(largest)}"
    threshold = f"≤ {percent(bound)}"
    return Check("Propagation to attitude", Question.TRUSTWORTHY, pass_or_warn(good), value, threshold, sentence)


def propagation_difference(error: AttitudeError) -> float:
    """Largest relative difference between sampled and first-order sigmas of the calibration's parts."""
    sampled = np.concatenate([error.common_arcsec, error.rest_arcsec])
    first_order = np.concatenate([error.analytic_common_arcsec, error.analytic_rest_arcsec])
    # Parts without an effect worth the name (below a microarcsecond) have no ratio.
    real = np.maximum(sampled, first_order) > 1e-6
    return float(np.max(np.abs(sampled[real] / np.maximum(first_order[real], 1e-12) - 1.0), initial=0.0))


def _sampling(name: str, good: bool, value: str, threshold: str, sentence: str) -> Check:
    return Check(name, Question.CONVERGED, pass_or_fail(good), value, threshold, sentence)
