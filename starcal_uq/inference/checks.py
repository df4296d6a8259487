"""Whether draws can be trusted: convergence, an independent estimate, the compressed likelihood, the priors' part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import Parameter
from starcal_uq.core.formatting import join_words
from starcal_uq.core.types import FloatArray
from starcal_uq.inference.ensemble import Chains, autocorrelation
from starcal_uq.inference.posterior import Diagnostics, Laplace
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.target import ImportanceCheck, LogLikelihood, Target

# Vehtari et al. 2021 for R-hat and ESS, Vehtari et al. 2024 for k-hat.
RHAT_BOUND = 1.01
ESS_BOUND = 400.0
KHAT_BOUND = 0.7
ACCEPTANCE_RANGE = (0.1, 0.98)
# Differences that would matter, in standard deviations; four Monte Carlo errors of the comparison are allowed on top.
AGREEMENT_BOUND = 0.05
# Largest tolerated difference between compressed and exact log likelihood within three standard deviations, nat.
COMPRESSED_BOUND = 0.5
# Weights between exp(-0.1) and exp(0.1) cannot distort anything. k-hat does not know that: it is blind to scale, and
# the cubic remainder of a good expansion has a heavy tail at 1e-5 nat.
_HARMLESS = 0.1
_OFF_DETECTOR_SHARE = 1e-3
_PRIOR_LIMITS = 0.5
_PRIOR_CONFLICT = 3.0


@dataclass(frozen=True)
class CompressionCheck:
    """Compressed against exact log likelihood at posterior draws.

    Attributes
    ----------
    max_difference : float
        Largest difference within three standard deviations of the mode, relative to the mode, nat.
    khat : float
        Pareto shape of the weights exact over compressed at all checked draws; 0 where all of them lie within 0.1 nat.
    n_draws : int
        Number of checked draws; 0 if there was no check.
    good : bool
        True if the compressed likelihood can stand for the exact one.
    """

    max_difference: float = float("nan")
    khat: float = float("nan")
    n_draws: int = 0
    good: bool = True

    @property
    def words(self) -> str:
        """The result as a clause."""
        return (
            f"compressed and exact log likelihood differ by up to {self.max_difference:.2g} nat within three standard "
            f"deviations of the mode{f', k-hat {self.khat:.2f}' if self.khat else ''} ({self.n_draws} posterior draws)"
        )


def check_compression(
    compressed: LogLikelihood,
    exact: LogLikelihood,
    target: Target,
    draws: FloatArray,
    laplace: Laplace,
) -> CompressionCheck:
    """Compare two likelihoods at posterior draws.

    Parameters
    ----------
    compressed, exact : callable
        As `Target.log_likelihood`.
    target : Target
        Its origin is the mode.
    draws : array (n, p+1)
        Posterior draws, px units; with a further column where the likelihood has a further parameter.
    laplace : Laplace
        Measures the distance from the mode.
    """
    from starcal_uq.inference.arviz import psis

    points = target.arguments(np.concatenate([target.natural(np.zeros((1, target.dim))), draws]))
    theta = points[0]
    p = theta.shape[1]
    difference = exact(*points) - compressed(*points)
    difference = difference[1:] - difference[0]
    # The factor is lower triangular, so its leading block is the factor of theta's covariance.
    scale = np.diag(laplace.transform)[:p]
    z = np.linalg.solve(laplace.transform[:p, :p] / scale[:, None], ((theta[1:] - laplace.mode[:p]) / scale).T)
    near = np.sum(z * z, axis=0) <= 9.0
    size = np.abs(difference)
    max_difference = float(np.max(size[near])) if np.any(near) else float(np.max(size))
    khat = 0.0 if float(np.max(size)) <= _HARMLESS else psis(difference)[1]
    good = max_difference <= COMPRESSED_BOUND and khat <= KHAT_BOUND
    return CompressionCheck(max_difference, khat, len(draws), good)


def chain_order(values: FloatArray) -> FloatArray:
    """Arrange (ensemble, step, walker, ...) as (ensemble, draw, ...) in the order of `posterior.DRAW_ORDER`."""
    e, s, w = values.shape[:3]
    halves = values.reshape(e, 2, s // 2, w, *values.shape[3:])
    return np.moveaxis(halves, 3, 2).reshape(e, s * w, *values.shape[3:])


def step_order(values: FloatArray, n_steps: int, n_walkers: int) -> FloatArray:
    """Undo `chain_order`: (ensemble, draw, ...) to (ensemble, step, walker, ...)."""
    e, rest = values.shape[0], values.shape[2:]
    halves = values.reshape(e, 2, n_walkers, n_steps // 2, *rest)
    return np.moveaxis(halves, 2, 3).reshape(e, n_steps, n_walkers, *rest)


def diagnose(
    chains: Chains,
    draws: FloatArray,
    shown: Sequence[Parameter],
    laplace: Laplace,
    importance: ImportanceCheck,
    compression: CompressionCheck,
    priors: Priors,
    camera: Camera,
    likelihood_used: str,
    n_evaluations: int,
    notes: Sequence[str] = (),
) -> Diagnostics:
    """Compute every criterion and say which are missed.

    Parameters
    ----------
    chains : Chains
        As sampled.
    draws : array (n_ensembles, n_draws, p+1)
        In px units, in chain order.
    shown : sequence of Parameter
        Names and scales of the columns.
    laplace, importance, compression
        The independent estimates.
    priors, camera
        For the parts of prior and detector.
    likelihood_used : str
        What was evaluated.
    n_evaluations : int
        How often.
    notes : sequence of str
        Further messages.
    """
    from starcal_uq.inference import arviz as arviz_compat

    n_sampled = chains.u.shape[-1]
    n_steps, n_walkers = chains.u.shape[1:3]
    names = [parameter.name for parameter in shown]
    scale = np.array([parameter.scale for parameter in shown])
    scaled = draws[..., :n_sampled] / scale[:n_sampled]
    columns = [np.ascontiguousarray(scaled[..., i]) for i in range(n_sampled)]

    def padded(values: Sequence[float] | FloatArray) -> FloatArray:
        return np.concatenate([values, np.full(len(shown) - n_sampled, np.nan)])

    rhat = padded([arviz_compat.rhat(c) for c in columns])
    ess_bulk = padded([arviz_compat.ess_bulk(c) for c in columns])
    ess_tail = padded([arviz_compat.ess_tail(c) for c in columns])
    mcse = padded([arviz_compat.mcse_mean(c) for c in columns]) * scale
    acceptance = chains.accepted / (n_steps * n_walkers)
    flat = draws.reshape(-1, draws.shape[-1])
    mean, sd = flat.mean(axis=0), flat.std(axis=0, ddof=1)
    psis_mean, psis_sd = padded(importance.mean[:n_sampled]), padded(importance.sd[:n_sampled])
    agreement_mean = float(np.max(np.abs(mean - psis_mean)[:n_sampled] / sd[:n_sampled]))
    agreement_sd = float(np.max(np.abs(psis_sd[:n_sampled] / sd[:n_sampled] - 1.0)))
    bound = AGREEMENT_BOUND + 4.0 * np.sqrt(1.0 / np.min(ess_bulk[:n_sampled]) + 1.0 / importance.ess)
    agree = max(agreement_mean, agreement_sd) <= bound
    agreement = (
        f"emcee and importance sampling around the Laplace approximation {'agree' if agree else 'disagree'}: means "
        f"within {agreement_mean:.3f} standard deviations, standard deviations within {100 * agreement_sd:.1f} %, "
        f"k-hat {importance.khat:.2f}"
    )
    failures = [
        *_convergence_failures(names[:n_sampled], rhat, ess_bulk, ess_tail, acceptance),
        *_check_failures(importance, agree, agreement, compression, likelihood_used),
        *_detector_failures(flat, camera),
    ]
    messages = [f"{agreement}."] if agree else []
    if compression.n_draws and compression.good:
        messages.append(f"The {compression.words}.")
    if not laplace.converged:
        messages.append("Newton's method did not settle on the mode; importance sampling starts from its last step.")
    messages += [*notes, *_prior_messages(names[:n_sampled], mean, sd, priors)]
    return Diagnostics(
        rhat=rhat,
        ess_bulk=ess_bulk,
        ess_tail=ess_tail,
        mcse=mcse,
        acceptance=acceptance,
        autocorrelation=padded(autocorrelation(step_order(scaled, n_steps, n_walkers))),
        n_evaluations=n_evaluations,
        psis_khat=importance.khat,
        psis_mean=psis_mean,
        psis_sd=psis_sd,
        laplace_mean=padded(laplace.mean),
        laplace_sd=padded(laplace.sd),
        agreement_mean=agreement_mean,
        agreement_sd=agreement_sd,
        agreement=agreement,
        compressed_max_difference=compression.max_difference,
        compressed_khat=compression.khat,
        likelihood_used=likelihood_used,
        failures=tuple(failures),
        messages=(*failures, *(m[0].upper() + m[1:] for m in messages)),
    )


def _convergence_failures(
    names: Sequence[str], rhat: FloatArray, ess_bulk: FloatArray, ess_tail: FloatArray, acceptance: FloatArray
) -> list[str]:
    failures = []
    for values, good, text in (
        (rhat, rhat < RHAT_BOUND, f"R-hat is not below {RHAT_BOUND}"),
        (ess_bulk, ess_bulk > ESS_BOUND, f"the bulk effective sample size is not above {ESS_BOUND:g}"),
        (ess_tail, ess_tail > ESS_BOUND, f"the tail effective sample size is not above {ESS_BOUND:g}"),
    ):
        bad = [f"{name} ({values[i]:.4g})" for i, name in enumerate(names) if not good[i]]
        if bad:
            failures.append(f"{text[0].upper()}{text[1:]} for {join_words(bad)}: raise n_steps.")
    low, high = ACCEPTANCE_RANGE
    if not np.all((acceptance > low) & (acceptance < high)):
        failures.append(
            f"The acceptance lies between {acceptance.min():.2f} and {acceptance.max():.2f}, outside {low} to {high}: "
            "the posterior is far from its Laplace approximation; try moves='stretch' with more steps."
        )
    return failures


def _check_failures(
    importance: ImportanceCheck, agree: bool, agreement: str, compression: CompressionCheck, likelihood_used: str
) -> list[str]:
    failures = []
    if not importance.khat < KHAT_BOUND:
        failures.append(
            f"The importance weights have a heavy tail (k-hat {importance.khat:.2f}, bound {KHAT_BOUND}): the "
            "posterior is far from normal, and emcee's draws have no independent check."
        )
    elif not agree:
        failures.append(f"{agreement[0].upper()}{agreement[1:]}.")
    if compression.n_draws and not compression.good and likelihood_used == "compressed":
        failures.append(f"The {compression.words}: use evaluation='auto' or 'exact'.")
    return failures


def _detector_failures(flat: FloatArray, camera: Camera) -> list[str]:
    outside = ~camera.contains(flat[:, :2]) | (flat[:, 2] <= 0.0)
    share = float(np.mean(outside))
    if share <= _OFF_DETECTOR_SHARE:
        return []
    return [
        f"{100 * share:.1f} % of the draws have their principal point off the detector or a focal length below zero: "
        "the data do not determine the optics; add frames."
    ]


def _prior_messages(names: Sequence[str], mean: FloatArray, sd: FloatArray, priors: Priors) -> list[str]:
    prior_mean, prior_sd = priors.mean(names), priors.sd(names)
    messages = []
    for i, name in enumerate(names):
        ratio = sd[i] / prior_sd[i]
        if ratio > _PRIOR_LIMITS:
            messages.append(
                f"the prior, not the data, limits {name}: its posterior standard deviation is {100 * ratio:.0f} % of "
                "the prior's."
            )
        pull = abs(mean[i] - prior_mean[i]) / prior_sd[i]
        if pull > _PRIOR_CONFLICT:
            messages.append(
                f"the data put {name} {pull:.1f} prior standard deviations away from the prior's mean: check the "
                "nominal camera, or widen the prior."
            )
    return messages
