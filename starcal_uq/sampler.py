"""Sample the posterior of a calibration with emcee."""

from __future__ import annotations

import hashlib
import os
import secrets
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from starcal_uq._types import AnyDict, FloatArray
from starcal_uq.distortion import parameters, sigma_parameter
from starcal_uq.ensemble import PROPOSAL_DF, Chains, EnsembleSettings, Moves, Progress, run_ensembles
from starcal_uq.errors import SamplingError
from starcal_uq.importance import (
    Likelihood,
    LogLikelihood,
    Target,
    importance_check,
    laplace_approximation,
    start_target,
)
from starcal_uq.posterior import Laplace, Posterior
from starcal_uq.posterior_checks import CompressionCheck, chain_order, check_compression, diagnose
from starcal_uq.posterior_files import to_json
from starcal_uq.priors import SIGMA_NAMES, Priors
from starcal_uq.runfolder import provenance

if TYPE_CHECKING:
    from starcal_uq.calibration import Calibration
    from starcal_uq.observations import Observations

LIKELIHOODS = ("auto", "compressed", "exact")
# Starts are draws of the Laplace approximation, so the mixture, which forgets in two or three steps, needs a short
# burn-in; the stretch move needs some autocorrelation times of about 60.
_BURN = {"mixture": 20, "stretch": 300}
_N_CHECKED = 300
# An exact evaluation costs thousands of compressed ones.
_N_IMPORTANCE = {"compressed": 20_000}
_N_IMPORTANCE_SLOW = 2_000


def sample(
    obs: Observations | None,
    cal: Calibration,
    priors: Priors | None = None,
    *,
    sigma: Literal["sampled"] | float = "sampled",
    n_ensembles: int = 4,
    n_walkers: int = 64,
    n_steps: int = 200,
    n_burn: int | None = None,
    moves: Moves = "mixture",
    seed: int | None = None,
    likelihood: Literal["auto", "compressed", "exact"] | Likelihood = "auto",
    progress: Progress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Posterior:
    """Draw from the posterior of camera parameters and noise.

    Parameters
    ----------
    obs : Observations or None
        The stars of the calibration. None leaves the compressed likelihood unchecked.
    cal : Calibration
        Start, Fisher information and compressed likelihood.
    priors : Priors, optional
        ``Priors.default`` of the nominal camera otherwise.
    sigma : "sampled" or float
        Sample the noise, or take it as given: px, or a factor where the stars state their own noise.
    n_ensembles : int
        Separately seeded ensembles, at least 2.
    n_walkers, n_steps : int
        Walkers of one ensemble and kept steps; `n_steps` is even.
    n_burn : int, optional
        Steps before the kept ones; 20 for ``mixture`` and 300 for ``stretch``.
    moves : {"mixture", "stretch"}
        ``mixture``: independence proposals (multivariate t at the Laplace approximation) with weight 0.7, differential
        evolution with 0.3. ``stretch``: emcee's own default, about twenty times slower here.
    seed : int, optional
        The same seed gives the same draws; without one, a new one is taken and recorded in the provenance.
    likelihood : {"auto", "compressed", "exact"} or object
        ``auto`` samples the compressed likelihood, compares it with the exact one at 300 draws and samples the exact
        one if they differ by more than 0.5 nat within three standard deviations, or if the importance weights
        between them are not all within 0.1 nat and have k-hat above 0.7. An object with a method
        ``log_likelihood(theta (n, p), sigma (n,)) -> (n,)`` is used as it is.
    progress : callable, optional
        Called as ``progress(steps_done, steps_total)``; starts again if the exact likelihood takes over.
    checkpoint : path, optional
        Written while sampling, read if it exists, removed at the end. A resumed run gives the draws of an uninterrupted
        one, bit for bit.

    Returns
    -------
    Posterior

    Raises
    ------
    SamplingError
        For settings that cannot work, a calibration that is not sound, or a checkpoint of another run.
    """
    settings = _settings(n_ensembles, n_walkers, n_steps, n_burn, moves, sigma, cal)
    label = _label(likelihood, obs)
    per_star = cal.sigma_name == SIGMA_NAMES[1]
    priors = Priors.default(cal.nominal, per_star) if priors is None else priors
    if priors.names != (*cal.parameter_names, cal.sigma_name):
        raise SamplingError(
            f"the priors are on {', '.join(priors.names)}, but the calibration has {', '.join(cal.parameter_names)} "
            f"and {cal.sigma_name}: make the priors with Priors.default of the calibrated camera."
        )
    seed = secrets.randbits(63) if seed is None else seed
    chosen: AnyDict = {
        "sigma": sigma,
        "n_ensembles": n_ensembles,
        **asdict(settings),
        "proposal_df": PROPOSAL_DF,
        "likelihood": label,
    }
    data_hash = cal.provenance.get("data_sha256") if obs is None else obs.data_hash
    run = _Run(cal, priors, settings, n_ensembles, seed, sigma, progress, provenance(seed, chosen, data_hash))
    outcome, compression = _with_fallback(run, obs, likelihood, label, checkpoint)
    return _assemble(run, outcome, compression, label, checked=obs is not None)


class _Run:
    """What stays the same when another likelihood takes over."""

    def __init__(
        self,
        cal: Calibration,
        priors: Priors,
        settings: EnsembleSettings,
        n_ensembles: int,
        seed: int,
        sigma: Literal["sampled"] | float,
        progress: Progress | None,
        provenance: AnyDict,
    ) -> None:
        self.cal, self.priors, self.settings, self.progress = cal, priors, settings, progress
        self.n_ensembles, self.provenance = n_ensembles, provenance
        self.given = None if sigma == "sampled" else float(sigma)
        # The ensembles come last, so that their number changes neither the checks nor the ensembles before.
        self.importance_seed, self.check_seed, *self.seeds = np.random.SeedSequence(seed).spawn(2 + n_ensembles)

    def start(self, log_likelihood: LogLikelihood) -> Target:
        cal = self.cal
        sigma = cal.sigma if self.given is None else self.given
        information = cal.information * (cal.sigma / sigma) ** 2
        given = self.given is not None
        return start_target(log_likelihood, self.priors, cal.theta, information, sigma, float(cal.dof), given)

    def fingerprint(self, target: Target, name: str) -> str:
        identity = {k: v for k, v in self.provenance.items() if k != "created_utc"}
        text = to_json([identity, self.priors.to_dict(), name, target.centre, target.transform])
        return hashlib.sha256(text.encode()).hexdigest()

    def sample(self, name: str, log_likelihood: LogLikelihood, checkpoint: str | os.PathLike[str] | None) -> _Outcome:
        target, laplace = laplace_approximation(self.start(log_likelihood))
        chains = run_ensembles(
            target.log_density,
            target.dim,
            self.seeds,
            self.settings,
            progress=self.progress,
            checkpoint=checkpoint,
            fingerprint=self.fingerprint(target, name),
        )
        return _Outcome(name, target, laplace, chains, checkpoint)


class _Outcome:
    """Chains of one likelihood."""

    def __init__(
        self,
        name: str,
        target: Target,
        laplace: Laplace,
        chains: Chains,
        checkpoint: str | os.PathLike[str] | None,
    ) -> None:
        self.name, self.target, self.laplace, self.chains, self.checkpoint = name, target, laplace, chains, checkpoint
        ordered = chain_order(chains.u)
        natural = target.natural(ordered.reshape(-1, target.dim))
        self.draws = natural.reshape(*ordered.shape[:2], natural.shape[1])


class _Exact:
    """The exact likelihood, point by point."""

    def __init__(self, obs: Observations, cal: Calibration) -> None:
        from starcal_uq.likelihood import MarginalLikelihood

        self._one = MarginalLikelihood(obs, cal.camera.distortion)
        self._one.use_rotations(self._one.rotations_at(cal.theta))

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        return np.array([self._one.log_likelihood(t, float(s)) for t, s in zip(theta, sigma, strict=True)])


def _with_fallback(
    run: _Run,
    obs: Observations | None,
    likelihood: str | Likelihood,
    label: str,
    checkpoint: str | os.PathLike[str] | None,
) -> tuple[_Outcome, CompressionCheck]:
    if not isinstance(likelihood, str):
        return run.sample(label, likelihood.log_likelihood, checkpoint), CompressionCheck()
    exact = None if obs is None else _Exact(obs, run.cal).log_likelihood
    if likelihood == "exact" and exact is not None:
        return run.sample("exact", exact, checkpoint), CompressionCheck()
    compressed = run.cal.compressed.log_likelihood
    outcome = run.sample("compressed", compressed, checkpoint)
    if exact is None:
        return outcome, CompressionCheck()
    rng = np.random.default_rng(run.check_seed)
    flat = outcome.draws.reshape(-1, outcome.draws.shape[-1])
    picks = flat[rng.choice(len(flat), min(_N_CHECKED, len(flat)), replace=False)]
    compression = check_compression(compressed, exact, outcome.target, picks, outcome.laplace)
    if likelihood == "auto" and not compression.good:
        # Its own file: on resuming, the finished compressed run must still be found complete.
        second = None if checkpoint is None else f"{os.fspath(checkpoint)}.exact"
        outcome = run.sample("exact", exact, second)
        if checkpoint is not None:
            Path(checkpoint).unlink(missing_ok=True)
    return outcome, compression


def _assemble(run: _Run, outcome: _Outcome, compression: CompressionCheck, label: str, checked: bool) -> Posterior:
    cal, settings, target = run.cal, run.settings, outcome.target
    n = _N_IMPORTANCE.get(outcome.name, _N_IMPORTANCE_SLOW)
    importance = importance_check(target, n, PROPOSAL_DF, np.random.default_rng(run.importance_seed))
    shown = (*parameters(cal.camera.distortion), sigma_parameter(cal.sigma_name == SIGMA_NAMES[1]))
    notes = []
    if label == "auto" and outcome.name == "exact":
        notes.append(f"the exact likelihood was sampled, because {compression.words}.")
    if outcome.name == "compressed" and not checked:
        notes.append("the compressed likelihood was not compared with the exact one: the observations were not given.")
    diagnostics = diagnose(
        outcome.chains,
        outcome.draws,
        shown,
        outcome.laplace,
        importance,
        compression,
        run.priors,
        cal.camera,
        outcome.name,
        run.n_ensembles * settings.n_walkers * (settings.n_burn + settings.n_steps),
        notes,
    )
    posterior = Posterior(
        parameter_names=tuple(p.name for p in shown),
        draws=outcome.draws.reshape(-1, len(shown)),
        log_posterior=chain_order(outcome.chains.log_density).reshape(-1),
        n_ensembles=run.n_ensembles,
        n_walkers=settings.n_walkers,
        n_steps=settings.n_steps,
        sigma_sampled=run.given is None,
        priors=run.priors,
        laplace=outcome.laplace,
        diagnostics=diagnostics,
        information=np.asarray(cal.information, dtype=np.float64),
        rotation_per_theta=np.asarray(cal.rotation_per_theta, dtype=np.float64),
        attitude_noise=np.asarray(cal.attitude_noise, dtype=np.float64),
        camera=cal.camera,
        provenance=run.provenance,
    )
    if outcome.checkpoint is not None:
        Path(outcome.checkpoint).unlink(missing_ok=True)
    return posterior


def _label(likelihood: Any, obs: Observations | None) -> str:
    if not isinstance(likelihood, str):
        if not callable(getattr(likelihood, "log_likelihood", None)):
            raise SamplingError(
                f"likelihood is a {type(likelihood).__name__}: give one of {', '.join(LIKELIHOODS)}, or an object with "
                "a method log_likelihood(theta, sigma)."
            )
        return str(getattr(likelihood, "name", type(likelihood).__name__))
    if likelihood not in LIKELIHOODS:
        raise SamplingError(f"likelihood {likelihood!r} is unknown: use one of {', '.join(LIKELIHOODS)}.")
    if likelihood == "exact" and obs is None:
        raise SamplingError("the exact likelihood needs the observations: give obs, or use likelihood='compressed'.")
    return likelihood


def _settings(
    n_ensembles: int,
    n_walkers: int,
    n_steps: int,
    n_burn: int | None,
    moves: Moves,
    sigma: Any,
    cal: Calibration,
) -> EnsembleSettings:
    if moves not in _BURN:
        raise SamplingError(f"moves {moves!r} is unknown: use one of {', '.join(_BURN)}.")
    if sigma != "sampled" and not (isinstance(sigma, int | float) and np.isfinite(sigma) and sigma > 0.0):
        raise SamplingError(f"sigma is {sigma!r}: use 'sampled' or a number above zero.")
    n_burn = _BURN[moves] if n_burn is None else n_burn
    dim = len(cal.theta) + 1
    for good, text in (
        (n_ensembles >= 2, f"n_ensembles is {n_ensembles}: at least 2 are needed, because R-hat compares ensembles."),
        (n_walkers >= 2 * dim, f"n_walkers is {n_walkers}: {dim} parameters need at least {2 * dim}."),
        (n_steps >= 8 and n_steps % 2 == 0, f"n_steps is {n_steps}: give an even number of at least 8."),
        (n_burn >= 0, f"n_burn is {n_burn}: give zero or more steps."),
    ):
        if not good:
            raise SamplingError(text)
    if not cal.status.ok:
        raise SamplingError(f"the calibration did not converge ({cal.status.name}): {cal.status.remedy}.")
    return EnsembleSettings(n_walkers, n_steps, n_burn, moves)
