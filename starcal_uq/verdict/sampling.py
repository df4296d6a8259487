"""Checks of the draws: convergence, independent evidence, the part of the priors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.formatting import count, fixed, join_words, percent, significant
from starcal_uq.posterior_checks import (
    ACCEPTANCE_RANGE,
    AGREEMENT_BOUND,
    COMPRESSED_BOUND,
    ESS_BOUND,
    KHAT_BOUND,
    RHAT_BOUND,
)
from starcal_uq.verdict.levels import Check, Level, Question, pass_or_fail, pass_or_warn

if TYPE_CHECKING:
    from starcal_uq.posterior import Posterior
    from starcal_uq.propagation import AttitudeError

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
