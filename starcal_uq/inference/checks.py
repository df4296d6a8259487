"""The only judge of draws: convergence, an independent estimate, the compressed likelihood, bounds,
the priors' part.

`measure` computes the numbers and `check_draws` holds them against their bounds, once, while
sampling. Everything that shows or collects checks takes them from `Diagnostics.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import Parameter, next_simpler, scales_of
from starcal_uq.core.formatting import decimals_for
from starcal_uq.core.remedy import PLAN, RUN, Remedies, Remedy, with_model
from starcal_uq.core.status import (
    MORE,
    Advice,
    Check,
    Code,
    Level,
    Order,
    judged,
)
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.inference.ensemble import Chains, autocorrelation
from starcal_uq.inference.named import LIKELIHOODS
from starcal_uq.inference.posterior import Derived, Diagnostics, Laplace, Posterior
from starcal_uq.inference.target import ImportanceCheck, LogLikelihood, Target
from starcal_uq.likelihood.student import DEFAULT_DOF
from starcal_uq.maths.linear import whitened

if TYPE_CHECKING:
    from starcal_uq.inference.exact import FrameSample

# Vehtari et al. 2021 for R-hat and ESS, Vehtari et al. 2024 for k-hat.
RHAT_BOUND = 1.01
ESS_BOUND = 400.0
KHAT_BOUND = 0.7
ACCEPTANCE_RANGE = (0.1, 0.98)
# Differences that would matter, in standard deviations; four Monte Carlo errors of the comparison
# are allowed on top.
AGREEMENT_BOUND = 0.05
AGREEMENT_ERRORS = 4.0
# Largest tolerated difference between compressed and exact log likelihood within three standard
# deviations, nat.
COMPRESSED_BOUND = 0.5
# Weights between exp(-0.1) and exp(0.1) cannot distort anything. k-hat does not know that: it is
# blind to scale, and the cubic remainder of a good expansion has a heavy tail at 1e-5 nat.
_HARMLESS = 0.1
# A difference on the surface of so many standard deviations at which the likelihoods are the same:
# a hundredth of what would matter inside of it, and draws outside are a few times further off at
# most.
_REACH_SD, _EQUAL = 3.0, 0.005
# Standard errors, from ten batches, that are counted to a difference which a sample of frames
# tells.
_SAMPLE_ERRORS = 5.0
# Tolerated share of draws that no camera can have, and number of draws tried for distortions that
# fold.
_BOUNDS_SHARE = 1e-3
_FOLD_DRAWS = 40
_PRIOR_SHARE = 0.5
_PRIOR_PULL = 3.0
# Arguments of `starcal_uq.sample` that a remedy repeats, and their defaults.
_DEFAULTS: AnyDict = {
    "sigma": "sampled",
    "n_ensembles": 4,
    "n_walkers": 64,
    "n_steps": 200,
    "moves": "mixture",
    "likelihood": "marginal",
    "evaluation": "auto",
    "dof": DEFAULT_DOF,
}


@dataclass(frozen=True)
class CompressionCheck:
    """Compressed against exact log likelihood around the mode; NaN where they were not compared."""

    # Largest difference within three standard deviations of the mode, relative to the mode, nat.
    max_difference: float = float("nan")
    # Pareto shape of the weights exact over compressed at the checked draws; 0 where all of them
    # lie within 0.1 nat.
    khat: float = float("nan")
    # `n_frames`, `of_frames`: frames of the sample that was compared, its uncertainty being part of
    # `max_difference`, and those that it stands for; 0 where all were compared.
    n_frames: int = 0
    of_frames: int = 0

    @property
    def good(self) -> bool:
        """True unless the compressed likelihood was seen not to stand for the exact one."""
        return not (self.max_difference > COMPRESSED_BOUND or self.khat > KHAT_BOUND)


def check_compression(
    compressed: LogLikelihood,
    exact: LogLikelihood,
    target: Target,
    draws: FloatArray,
    laplace: Laplace,
    sample: FrameSample | None = None,
) -> CompressionCheck:
    """Compare two log likelihoods three standard deviations from the mode, and at posterior draws
    if they differ there.

    What is left out of the expansion grows with the third power of the distance from the mode, so
    that a few points on the surface see as much of it as hundreds of draws. Below `_EQUAL` there,
    no draw can come near a bound.

    With a sample of frames the expansion is compared on these, and stated is what they tell for
    all, with `_SAMPLE_ERRORS` standard errors on top. That the compressed likelihood holds all
    frames is seen by the sum of squares that the calibration knows of its own table; of other data,
    `exact` is compared at two points on the surface that no direction is missing in.

    `target`: its origin is the mode.
    `draws` (n, p+1): posterior draws, (n, p+2) where one parameter is added.
    `laplace`: measure of the distance from the mode.
    `sample`: where there are too many frames for `exact`.
    """
    from starcal_uq.inference.arviz import psis

    mode = target.natural(np.zeros((1, target.dim)))
    frames = (0, 0) if sample is None else (sample.n_frames, sample.of_frames)

    def differences(points: FloatArray) -> FloatArray:
        arguments = target.arguments(np.concatenate([mode, points]))
        found = exact(*arguments) - compressed(*arguments)
        # Of other stars than those of the calibration the exact one may be nothing.
        return found[1:] - found[0] if np.isfinite(found).all() else np.full(len(points), np.inf)

    def known(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Differences (n,) and what they may be larger by."""
        if sample is None:
            found = differences(points)
            return found, np.zeros(len(found))
        by_batch = sample.left_out(*target.arguments(np.concatenate([mode, points])))
        by_batch = by_batch[:, 1:] - by_batch[:, :1]
        # A single frame says nothing of others.
        scatter = (
            by_batch.std(axis=0, ddof=1) if len(by_batch) > 1 else np.full(len(points), np.inf)
        )
        return by_batch.mean(axis=0), _SAMPLE_ERRORS * scatter / np.sqrt(len(by_batch))

    found, slack = known(target.natural(_surface(target.dim)))
    on_surface = float(np.max(np.abs(found) + slack))
    whole = 0.0
    if sample is not None and sample.whole is not None:
        whole = sample.whole
    elif sample is not None:
        diagonal = np.full((1, target.dim), _REACH_SD / np.sqrt(target.dim))
        whole = float(
            np.max(np.abs(differences(target.natural(np.concatenate([diagonal, -diagonal])))))
        )
    if not np.isfinite([on_surface, whole]).all():
        return CompressionCheck(np.inf, np.inf, *frames)
    if max(on_surface, whole) <= _EQUAL:
        return CompressionCheck(max(on_surface, whole), 0.0, *frames)
    theta = target.arguments(draws)[0]
    p = theta.shape[1]
    difference, slack = known(draws)
    # The factor is lower triangular, so its leading block is the factor of theta's covariance.
    z = whitened(theta - laplace.mode[:p], laplace.transform[:p, :p])
    near = np.sum(z * z, axis=1) <= _REACH_SD**2
    size = np.abs(difference) + slack
    max_difference = max(float(np.max(size[near])) if np.any(near) else float(np.max(size)), whole)
    khat = 0.0 if float(np.max(size)) <= _HARMLESS else float(psis(difference)[1])
    return CompressionCheck(max_difference, khat, *frames)


def _surface(dim: int) -> FloatArray:
    """Points (4 dim, dim) three standard deviations from the mode: both ways along the axes of two
    random bases.
    """
    rng = np.random.default_rng(0)
    axes = np.concatenate([np.linalg.qr(rng.standard_normal((dim, dim)))[0] for _ in range(2)])
    return _REACH_SD * np.concatenate([axes, -axes])


def chain_order(values: FloatArray) -> FloatArray:
    """Arrange (ensemble, step, walker, ...) as (ensemble, draw, ...) in the order of
    `posterior.DRAW_ORDER`.
    """
    e, s, w = values.shape[:3]
    halves = values.reshape(e, 2, s // 2, w, *values.shape[3:])
    return np.moveaxis(halves, 3, 2).reshape(e, s * w, *values.shape[3:])


def step_order(values: FloatArray, n_steps: int, n_walkers: int) -> FloatArray:
    """Undo `chain_order`: (ensemble, draw, ...) to (ensemble, step, walker, ...)."""
    e, rest = values.shape[0], values.shape[2:]
    halves = values.reshape(e, 2, n_walkers, n_steps // 2, *rest)
    return np.moveaxis(halves, 2, 3).reshape(e, n_steps, n_walkers, *rest)


def measure(
    chains: Chains,
    draws: FloatArray,
    shown: Sequence[Parameter],
    laplace: Laplace,
    importance: ImportanceCheck,
    compression: CompressionCheck,
    likelihood: str,
    likelihood_used: str,
    n_evaluations: int,
) -> Diagnostics:
    """Compute the numbers that `check_draws` judges of draws (n_ensembles, n_draws, p+1), px units,
    in chain order.
    """
    from starcal_uq.inference import arviz as arviz_compat

    n_sampled = chains.u.shape[-1]
    n_steps, n_walkers = chains.u.shape[1:3]
    scale = scales_of(shown)
    scaled = draws[..., :n_sampled] / scale[:n_sampled]
    columns = [np.ascontiguousarray(scaled[..., i]) for i in range(n_sampled)]

    def padded(values: Sequence[float] | FloatArray) -> FloatArray:
        return np.concatenate([values, np.full(len(shown) - n_sampled, np.nan)])

    flat = draws.reshape(-1, draws.shape[-1])
    mean, sd = flat.mean(axis=0), flat.std(axis=0, ddof=1)
    psis_mean, psis_sd = padded(importance.mean[:n_sampled]), padded(importance.sd[:n_sampled])
    return Diagnostics(
        rhat=padded([arviz_compat.rhat(c) for c in columns]),
        ess_bulk=padded([arviz_compat.ess_bulk(c) for c in columns]),
        ess_tail=padded([arviz_compat.ess_tail(c) for c in columns]),
        mcse=padded([arviz_compat.mcse_mean(c) for c in columns]) * scale,
        acceptance=chains.accepted / (n_steps * n_walkers),
        autocorrelation=padded(autocorrelation(step_order(scaled, n_steps, n_walkers))),
        n_evaluations=n_evaluations,
        psis_khat=importance.khat,
        psis_ess=importance.ess,
        psis_mean=psis_mean,
        psis_sd=psis_sd,
        laplace_mean=padded(laplace.mean),
        laplace_sd=padded(laplace.sd),
        agreement_mean=float(np.max(np.abs(mean - psis_mean)[:n_sampled] / sd[:n_sampled])),
        agreement_sd=float(np.max(np.abs(psis_sd[:n_sampled] / sd[:n_sampled] - 1.0))),
        compressed_max_difference=compression.max_difference,
        compressed_khat=compression.khat,
        likelihood_used=likelihood_used,
        compressed_frames=(compression.n_frames, compression.of_frames),
        likelihood=likelihood,
    )


def check_draws(
    post: Posterior,
    about: AnyDict | None = None,
    derived: tuple[Derived, ...] | None = None,
) -> tuple[Check, ...]:
    """Hold everything that is known of draws against its bound; checks that they have already are
    not looked at. `about` are facts of the likelihood.
    """
    derived = derived_quantities(post) if derived is None else derived
    checks = [_rhat(post), _effective_draws(post), _acceptance(post), _derived(post, derived)]
    checks += [_digits(post), _bounds(post)]
    several = (
        _degrees_of_freedom(post),
        _independent(post),
        _evaluation(post),
        _likelihood(post, about or {}),
    )
    return (*checks, *(check for check in several if check is not None), _priors(post))


def _rhat(post: Posterior) -> Check:
    """Do separately seeded ensembles agree?"""
    values = post.diagnostics.rhat[list(post.sampled)]
    bad = _names(post, ~(values < RHAT_BOUND))
    found = {
        "rhat": float(np.max(values)),
        "disagreeing": bad,
        "n_ensembles": post.n_ensembles,
    }
    bounds = {"rhat_below": RHAT_BOUND}
    return judged(Code.R_HAT, found, bounds, _longer(post), (), Level.FAIL, not bad)


def _effective_draws(post: Posterior) -> Check:
    """Is the effective number of draws large enough, bulk and tail?"""
    bulk, tail = (
        values[list(post.sampled)]
        for values in (post.diagnostics.ess_bulk, post.diagnostics.ess_tail)
    )
    fewest = np.minimum(bulk, tail)
    bad = _names(post, ~(fewest > ESS_BOUND))
    found = {"bulk": float(np.min(bulk)), "tail": float(np.min(tail)), "too_few": bad}
    longer = _longer(post, ESS_BOUND / float(np.min(fewest)))
    bounds = {"draws_above": ESS_BOUND}
    return judged(Code.EFFECTIVE_DRAWS, found, bounds, longer, (), Level.FAIL, not bad)


def _acceptance(post: Posterior) -> Check:
    """Does the sampler move?"""
    low, high = ACCEPTANCE_RANGE
    rates = post.diagnostics.acceptance
    good = bool(np.all((rates > low) & (rates < high)))
    return judged(
        Code.ACCEPTANCE,
        {"least": float(np.min(rates)), "most": float(np.max(rates))},
        {"above": low, "below": high},
        resample(post, moves="stretch", n_steps=10 * post.n_steps),
        otherwise=Level.FAIL,
        good=good,
    )


def _derived(post: Posterior, derived: Sequence[Derived]) -> Check:
    """Did what follows from the parameters converge, too?"""
    derived = sorted(derived, key=lambda d: -d.rhat)
    rhat, ess = max(d.rhat for d in derived), min(min(d.ess_bulk, d.ess_tail) for d in derived)
    late = tuple(
        d.name
        for d in derived
        if not (d.rhat < RHAT_BOUND and min(d.ess_bulk, d.ess_tail) > ESS_BOUND)
    )
    return _converged(post, Code.DERIVED_QUANTITIES, rhat, ess, {"late": late})


def _digits(post: Posterior) -> Check:
    """Does Monte Carlo error leave the printed digits alone?"""
    names, d = post.parameter_names, post.diagnostics
    # Digits are printed to the second one of sigma; the unit of the last is what the error must not
    # exceed.
    worst, largest = names[0], 0.0
    for i in post.sampled:
        scale = post.parameters[i].scale
        unit = 10.0 ** -decimals_for(float(post.sd[i]) / scale)
        share = float(d.mcse[i]) / scale / unit
        if share > largest:
            worst, largest = names[i], share
    found = {"last_digits": largest, "parameter": worst}
    return judged(Code.DIGITS, found, {"last_digits_most": 1.0}, _longer(post, largest**2))


def _degrees_of_freedom(post: Posterior) -> Check | None:
    """Did the degrees of freedom of a Student-t likelihood converge, where they were free?"""
    from starcal_uq.inference import arviz as arviz_compat

    if post.dof_draws is None:
        return None
    values = post.dof_draws.reshape(post.n_ensembles, -1)
    quantiles = map(float, np.quantile(values, (0.025, 0.5, 0.975)))
    found = dict(zip(("low", "median", "high"), quantiles, strict=True))
    rhat, ess = arviz_compat.rhat(values), arviz_compat.ess_bulk(values)
    return _converged(post, Code.DEGREES_OF_FREEDOM, rhat, ess, found)


def _bounds(post: Posterior) -> Check:
    """Do draws touch the edges of what a camera can be?"""
    from starcal_uq.camera.projection import fold_radius_px

    camera, theta = post.camera, post.theta_draws
    outside = float(np.mean(~camera.contains(theta[:, :2]) | (theta[:, 2] <= 0.0)))
    few = theta[np.linspace(0, len(theta) - 1, _FOLD_DRAWS).astype(int)]
    radius = camera.corner_radius_px
    folded = float(
        np.mean([fold_radius_px(camera.distortion, draw, radius) <= radius for draw in few])
    )
    sd = post.sd[:3]
    edges = np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    room = np.concatenate(
        [(post.mean[:2] + 0.5) / sd[:2], (edges - post.mean[:2]) / sd[:2], post.mean[2:3] / sd[2:3]]
    )
    good = outside <= _BOUNDS_SHARE and folded == 0.0
    found = {"outside": outside, "folded": folded, "nearest_sigma": float(np.min(room))}
    bounds = {"outside_most": _BOUNDS_SHARE}
    remedies, orders = (_simpler(post), ()) if folded > 0.0 else (PLAN, MORE)
    return judged(Code.BOUNDS, found, bounds, remedies, orders, Level.FAIL, good)


def _independent(post: Posterior) -> Check:
    """Does importance sampling around the Laplace approximation, which uses no Markov chain, give
    the same?
    """
    d = post.diagnostics
    fewest = float(np.min(d.ess_bulk[list(post.sampled)]))
    tolerance = AGREEMENT_BOUND + AGREEMENT_ERRORS * math.sqrt(1.0 / fewest + 1.0 / d.psis_ess)
    return judged(
        Code.INDEPENDENT_POSTERIOR,
        {
            "means_sigma": d.agreement_mean,
            "sigmas": d.agreement_sd,
            "khat": d.psis_khat,
            "mode_found": post.laplace.converged,
        },
        {"means_sigma_most": tolerance, "sigmas_most": tolerance, "khat_below": KHAT_BOUND},
        _longer(post) if d.psis_khat < KHAT_BOUND else _simpler(post),
        otherwise=Level.FAIL,
    )


def _evaluation(post: Posterior) -> Check | None:
    """Was the compressed likelihood good enough, where it was used or tried?"""
    d = post.diagnostics
    compression = CompressionCheck(d.compressed_max_difference, d.compressed_khat)
    compressed = d.likelihood_used == "compressed"
    compared = not np.isnan(compression.max_difference)
    if not compressed and not compared:
        return None
    level = Level.PASS
    orders: tuple[Order, ...] = ()
    remedies: Remedies = ()
    if not compared:
        level, remedies = Level.WARN, (Remedy("sample", (RUN,), form="call"),)
        orders = (Order(Advice.SAMPLE_WITH_OBSERVATIONS),)
    elif compressed and not compression.good:
        level, remedies = Level.FAIL, resample(post, evaluation="exact")
    n_frames, of_frames = d.compressed_frames
    found = {
        "used": "compressed" if compressed else "exact",
        "difference_nat": compression.max_difference if compared else None,
        "khat": compression.khat if compared else None,
        "n_frames": n_frames,
        "of_frames": of_frames,
        "standard_errors": _SAMPLE_ERRORS,
    }
    bounds = {"difference_most_nat": COMPRESSED_BOUND, "khat_most": KHAT_BOUND}
    return Check(Code.LIKELIHOOD, found, level, bounds, remedies, orders)


def _likelihood(post: Posterior, about: AnyDict) -> Check | None:
    """Was a likelihood sampled whose intervals are known to be wrong?"""
    kind = post.diagnostics.likelihood
    if kind == "marginal":
        return None
    refused = "pairs_naive"
    return judged(
        Code.KIND_OF_LIKELIHOOD,
        {"likelihood": kind, **about},
        {"refused": refused},
        resample(post, likelihood="pairs"),
        otherwise=Level.FAIL,
        good=kind != refused,
    )


def _priors(post: Posterior) -> Check:
    """Did the data decide, or the prior?"""
    names = [post.parameter_names[i] for i in post.sampled]
    prior_mean, prior_sd = post.priors.mean(names), post.priors.sd(names)
    share = post.sd[: len(names)] / prior_sd
    pull = np.abs(post.draws.mean(axis=0)[: len(names)] - prior_mean) / prior_sd
    limited, pulled = _names(post, share > _PRIOR_SHARE), _names(post, pull > _PRIOR_PULL)
    largest = int(np.argmax(share))
    another = (Order(Advice.ANOTHER_PRIOR),)
    remedies, orders = (PLAN, MORE) if limited else ((), another)
    found = {
        "share": float(share[largest]),
        "parameter": names[largest],
        "limited": limited,
        "pulled": pulled,
        "furthest_sd": float(np.max(pull)),
    }
    bounds, good = {"share_most": _PRIOR_SHARE}, not limited and not pulled
    return judged(Code.INFLUENCE_OF_THE_PRIORS, found, bounds, remedies, orders, good=good)


def _simpler(post: Posterior) -> Remedies:
    """Fewer coefficients for the data to determine; frames that determine them where there are
    none.
    """
    name = next_simpler(post.camera.distortion)
    return with_model(name) + PLAN if name else PLAN


def _names(post: Posterior, which: BoolArray) -> tuple[str, ...]:
    return tuple(post.parameter_names[i] for i in compress(post.sampled, which))


def _converged(post: Posterior, code: Code, rhat: float, ess: float, found: AnyDict) -> Check:
    found = {"rhat": rhat, "draws": ess, **found}
    bounds = {"rhat_below": RHAT_BOUND, "draws_above": ESS_BOUND}
    return judged(code, found, bounds, _longer(post, ESS_BOUND / ess), otherwise=Level.FAIL)


def _longer(post: Posterior, factor: float = 1.0) -> Remedies:
    """Sampling again with `factor` times as many steps and some in reserve, but 2 to 20 times as
    many.
    """
    return resample(post, n_steps=post.n_steps * min(max(2, math.ceil(1.2 * factor)), 20))


def resample(post: Posterior, **changes: Any) -> Remedies:
    """Sampling again with some settings changed: a command and a call; of a likelihood of the
    user's, the call.
    """
    settings = _DEFAULTS | post.provenance.settings | changes
    kept = {name: settings[name] for name, usual in _DEFAULTS.items() if settings[name] != usual}
    if settings["likelihood"] in LIKELIHOODS:
        return (Remedy("sample", (RUN,), {"force": True, **kept}),)
    # An object that was passed is evaluated as it is, and no command takes it.
    kept.pop("evaluation", None)
    return (Remedy("sample", (RUN,), kept | {"likelihood": None}, form="call"),)
