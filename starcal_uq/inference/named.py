"""The likelihoods by name, each ready to be sampled.

- ``marginal``: Gaussian centroids, attitudes marginalised. The default, and efficient.
- ``pairs``: the paper's objective over interstar angles as a composite likelihood, with Godambe's
  curvature.
- ``pairs_naive``: the same with all pairs taken as independent. It claims far too much, and is here
  to show that.
- ``student_t``: heavy tails per star, attitudes marginalised, for tables with wrong
  identifications.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from starcal_uq.core.errors import SamplingError, check_known
from starcal_uq.core.findings import Finding
from starcal_uq.core.remedy import calibrated
from starcal_uq.core.settings import Evaluation, LikelihoodName
from starcal_uq.core.status import Check, Code, Level, Note
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.inference.target import (
    Extra,
    Likelihood,
    LogLikelihood,
    Target,
    laplace_approximation,
    start_target,
)
from starcal_uq.likelihood.student import DOF_RANGE, log_excess_prior, parse_dof
from starcal_uq.maths.linear import scaled_cholesky, symmetric_inverse, whitened
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.exact import FrameSample
    from starcal_uq.inference.priors import Priors
    from starcal_uq.observations.table import Observations

LIKELIHOODS = get_args(LikelihoodName)
EVALUATIONS = get_args(Evaluation)
_MAX_REFINEMENT = 200
# Times the frames of a sample above which a sample checks the compressed likelihood.
_MANY = 1.5


class NaivePairsWarning(UserWarning):
    """Pairs of stars are treated as independent, so that the intervals are far too narrow."""


@dataclass(frozen=True)
class Source:
    """A likelihood, and where its maximum is."""

    name: str  # One of `LIKELIHOODS`, or the name of an object that was passed
    theta: FloatArray  # (p,): estimate, px units
    information: FloatArray  # (p, p): information about theta there
    sigma: float  # Noise there
    dof: float  # Half of the curvature in log sigma
    exact: LogLikelihood | None  # From all stars; None without observations
    # At a cost independent of the number of stars; None where a polynomial has to be fitted first.
    fast: LogLikelihood | None
    extra: Extra | None = None  # A further parameter
    about: AnyDict = field(default_factory=dict)  # Facts for the check of its kind
    checks: tuple[Check, ...] = ()  # Checks that need no draws
    # What `fast` leaves out, told by some of the frames; None where `exact` itself is compared.
    sample: FrameSample | None = None

    def target(
        self, log_likelihood: LogLikelihood, priors: Priors, given: float | None = None
    ) -> Target:
        """The posterior by `log_likelihood`, around the maximum; `given` is a noise that is
        known.
        """
        sigma = self.sigma if given is None else given
        information = self.information * (self.sigma / sigma) ** 2
        about = self.theta, information, sigma, self.dof, given is not None, self.extra
        return start_target(log_likelihood, priors, *about)


def check_names(likelihood: Any, evaluation: Any, dof: Any, has_observations: bool) -> None:
    """Refuse settings that mean nothing, with the names that exist."""
    if not isinstance(likelihood, str):
        if not callable(getattr(likelihood, "log_likelihood", None)):
            raise SamplingError(
                f"likelihood is a {type(likelihood).__name__}: give one of "
                f"{', '.join(LIKELIHOODS)}, or an object with "
                "a method log_likelihood(theta, sigma)."
            )
    elif likelihood in EVALUATIONS:
        raise SamplingError(
            f"likelihood={likelihood!r} says how a likelihood is evaluated, not which: use "
            f"evaluation={likelihood!r}."
        )
    else:
        check_known("likelihood", likelihood, LIKELIHOODS, SamplingError)
    check_known("evaluation", evaluation, EVALUATIONS, SamplingError)
    if dof is not None and likelihood != "student_t":
        raise SamplingError(
            "degrees of freedom (dof) belong to likelihood='student_t': leave dof out, or use that."
        )
    if has_observations or not isinstance(likelihood, str):
        return
    if likelihood != "marginal":
        raise SamplingError(f"the likelihood {likelihood!r} needs the observations: give obs.")
    if evaluation == "exact":
        raise SamplingError(
            "the exact likelihood needs the observations: give them, or evaluate the compressed "
            "form."
        )


def label_of(likelihood: str | Likelihood) -> str:
    """The name of a likelihood, for records."""
    if isinstance(likelihood, str):
        return likelihood
    return str(getattr(likelihood, "name", type(likelihood).__name__))


def find_source(
    likelihood: str | Likelihood,
    obs: Observations | None,
    cal: Calibration,
    dof: float | str | None,
) -> Source:
    """The likelihood of a name (see `LIKELIHOODS`), or the object that was passed, around a
    calibration.
    """
    if not isinstance(likelihood, str):
        at = (cal.theta, cal.information, cal.sigma, float(cal.dof))
        return Source(label_of(likelihood), *at, exact=likelihood.log_likelihood, fast=None)
    source = _named_source(likelihood, obs, cal, dof)
    if np.any(cal.width_factors != 1.0):
        source = _widened(source, cal.width_factors)
    if (ignored := cal.provenance.settings.get("ignored_distortion")) is None:
        return source
    check = Check(
        Code.METHOD_OF_THE_CALIBRATION,
        {"method": cal.method, "ignored": ignored},
        Level.FAIL,
        remedies=calibrated(),
    )
    return replace(source, checks=(check,))


def quick_target(
    likelihood: str | Likelihood,
    obs: Observations,
    cal: Calibration,
    priors: Priors,
    sigma: float | None = None,
) -> tuple[Target, bool]:
    """Target of one of many simulated tables, centred at its mode, and whether it is fast; `sigma`
    is a noise that is given.
    """
    with warnings.catch_warnings():
        # That pairs are not independent is what a simulation of them shows.
        warnings.simplefilter("ignore", NaivePairsWarning)
        source = find_source(likelihood, obs, cal, None)
    evaluate = source.exact if source.fast is None else source.fast
    if evaluate is None:
        raise SamplingError(f"the likelihood {source.name!r} cannot be evaluated: give another.")
    start = source.target(evaluate, priors, sigma)
    return laplace_approximation(start)[0], source.fast is not None


def _widened(source: Source, factors: FloatArray) -> Source:
    """The likelihood that is wider by `factors` (p,) on each sigma, its maximum and correlations
    the same.

    It is evaluated at ``theta_hat + D^-1 (theta - theta_hat)``, as composite ones are (Ribatet,
    Cooley & Davison 2012). Tempering would take one factor for all parameters, and would widen
    sigma, too.
    """

    def at(theta: FloatArray) -> FloatArray:
        return source.theta + (theta - source.theta) / factors

    def wider(log_likelihood: LogLikelihood) -> LogLikelihood:
        return lambda theta, *rest: log_likelihood(at(theta), *rest)

    return replace(
        source,
        information=source.information / np.outer(factors, factors),
        exact=None if source.exact is None else wider(source.exact),
        fast=None if source.fast is None else wider(source.fast),
        sample=None if source.sample is None else source.sample.evaluated(at),
    )


def _named_source(
    likelihood: str, obs: Observations | None, cal: Calibration, dof: float | str | None
) -> Source:
    settings = cal.provenance.settings
    if obs is None and settings.get("stream") and settings.get("method") == "samaan":
        raise SamplingError(
            "a stream leaves only the quadratic likelihood around the estimate, and samaan's is "
            "far from its maximum: "
            "give the observations, or calibrate by griffith with all parameters."
        )
    if likelihood == "marginal":
        return _marginal(obs, cal)
    if cal.known_effects.fitted:
        raise SamplingError(
            f"the calibration holds effects, which the likelihood {likelihood!r} does not know: "
            "sample with likelihood='marginal', or calibrate with effects='none'."
        )
    if cal.ties is not None:
        raise SamplingError(
            "the calibration holds known rotations between frames, which the likelihood "
            f"{likelihood!r} does not know: sample with likelihood='marginal', or calibrate "
            "without relative_attitudes and mount."
        )
    assert obs is not None, "names were checked before"
    if cal.partitions is not None:
        raise SamplingError(
            f"the likelihood {likelihood!r} needs all stars at once, which partitioned "
            "observations do not give: use "
            "likelihood='marginal'."
        )
    if not cal.has_residuals:
        raise SamplingError(
            f"the likelihood {likelihood!r} needs the attitudes and residuals of every frame, "
            "which a stream does not "
            "keep: calibrate the table with method='efficient', or use likelihood='marginal'."
        )
    if likelihood != "student_t" and settings.get("method") in ("samaan", "griffith"):
        raise SamplingError(
            f"the likelihood {likelihood!r} has its maximum at the least-squares estimate over "
            "pairs, which method "
            f"{settings['method']!r} does not find: calibrate with method='three_stage'."
        )
    if likelihood == "student_t":
        return _student(obs, cal, dof)
    return _pairs(obs, cal, adjusted=likelihood == "pairs")


def resolved_dof(cal: Calibration, dof: float | str | None) -> float | Literal["free"]:
    """Degrees of freedom, "free" or a number in range: as given, else the calibration's, else the
    default.
    """
    if dof is None and cal.has_tails:
        dof = cal.provenance.settings["dof"]
    nu = parse_dof(dof, SamplingError)
    return "free" if nu is None else nu


def _marginal(obs: Observations | None, cal: Calibration) -> Source:
    if cal.sampled_likelihood == "student_t":
        raise SamplingError(
            "the calibration was made with likelihood='student_t': sample with the same, or "
            "calibrate again with "
            "likelihood='marginal'."
        )
    exact, sample = None, None
    if obs is not None:
        from starcal_uq.inference.exact import SAMPLED_FRAMES, ExactMarginal, FrameSample

        if cal.partitions is not None:
            sample = FrameSample(obs, cal, cal.n_frames)
            exact = sample.log_likelihood
        else:
            exact = _scales_integrated(cal, ExactMarginal(obs, cal).log_likelihood)
            of_stars = cal.known_effects.star_px > 0.0
            # Stars that bring errors along make frames depend on each other.
            if obs.n_frames > _MANY * SAMPLED_FRAMES and not of_stars:
                sample = FrameSample(obs, cal)
    at = (cal.theta, cal.information, cal.sigma, float(cal.dof))
    return Source("marginal", *at, exact=exact, fast=cal.log_likelihood, sample=sample)


def _scales_integrated(cal: Calibration, exact: LogLikelihood) -> LogLikelihood:
    """An exact likelihood at the best scales of effects with what integrating over the scales
    changes.
    """
    if not cal.known_effects.fitted:
        return exact

    def integrated(theta: FloatArray, sigma: FloatArray) -> FloatArray:
        best = cal.compressed.log_likelihood(theta, sigma)
        return exact(theta, sigma) + cal.log_likelihood(theta, sigma) - best

    return integrated


def _pairs(obs: Observations, cal: Calibration, adjusted: bool) -> Source:
    from starcal_uq.likelihood.composite import pair_likelihood

    expanded = pair_likelihood(
        StarFrames.from_observations(obs),
        cal.camera.distortion,
        cal.pair_theta,
        chi2=cal.chi2,
        residual_dof=cal.dof,
        adjusted=adjusted,
    )
    about: AnyDict = {"variability": expanded.variability}
    sigma, dof = expanded.sigma, float(expanded.dof)
    if not adjusted:
        sigma, dof = expanded.tau / expanded.pair_noise, float(expanded.n_pairs)
        about = {"n_pairs": expanded.n_pairs, "narrowness": float(expanded.narrowness)}
        warning = Finding(Note.PAIRS_AS_INDEPENDENT, about).sentence
        warnings.warn(warning, NaivePairsWarning, stacklevel=5)
    return Source(
        name="pairs" if adjusted else "pairs_naive",
        theta=expanded.theta_hat,
        information=symmetric_inverse(expanded.covariance),
        sigma=sigma,
        dof=dof,
        exact=expanded.exact_log_likelihood,
        fast=expanded.log_likelihood,
        about=about,
    )


class _AdjustedStudent:
    """Student-t log likelihood with the curvature that the stars' scores show.

    Stars are a mixture of right and wrong ones and no t distribution, so that the curvature of its
    likelihood is not the precision of its estimate. It is evaluated at ``theta_hat + C (theta -
    theta_hat)``, as composite ones are.
    """

    def __init__(self, fit: Any, nu: float | None) -> None:
        self._fit, self._nu = fit, nu
        self._theta = fit.stage.theta
        self._narrow = scaled_cholesky(symmetric_inverse(fit.information.matrix))
        self._wide = scaled_cholesky(fit.covariance)

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray, *nu: FloatArray) -> FloatArray:
        points = self._theta + (self._narrow @ whitened(theta - self._theta, self._wide).T).T
        dof = nu[0] if nu else np.full(len(points), self._nu)
        value: FloatArray = self._fit.likelihood.many(points, sigma, dof)
        return value


def _student(obs: Observations, cal: Calibration, dof: float | str | None) -> Source:
    from starcal_uq.estimation.robust import refine

    nu = parse_dof(dof, SamplingError)
    frames = StarFrames.from_observations(obs)
    rotations = cal.rotations
    fit = refine(frames, cal.camera.distortion, cal.theta, rotations, nu, _MAX_REFINEMENT)
    if not fit.stage.status.ok:
        raise SamplingError(
            f"the maximum of the Student-t likelihood was not found ({fit.stage.status.name}): "
            "calibrate with "
            "likelihood='student_t' first."
        )
    extra = None
    if nu is None:
        low = DOF_RANGE[0]
        log_sd = (
            fit.nu_std / (fit.nu - low) if np.isfinite(fit.nu_std) and fit.nu_std > 0.0 else 1.0
        )
        extra = Extra("dof", log_excess_prior, fit.nu, min(log_sd, 1.0), low)
    return Source(
        name="student_t",
        theta=fit.stage.theta,
        information=symmetric_inverse(fit.covariance),
        sigma=fit.sigma,
        dof=0.5 * (fit.sigma / fit.sigma_std) ** 2,
        exact=_AdjustedStudent(fit, nu).log_likelihood,
        fast=None,
        extra=extra,
    )
