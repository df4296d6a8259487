"""Sample the posterior of a calibration with emcee."""

from __future__ import annotations

import hashlib
import os
import secrets
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from starcal_uq.camera.distortion import parameters, sigma_parameter
from starcal_uq.core.errors import SamplingError, check_known, require
from starcal_uq.core.formatting import join_words
from starcal_uq.core.provenance import Provenance, data_hashes, provenance
from starcal_uq.core.records import to_json
from starcal_uq.core.settings import (
    Evaluation,
    LikelihoodName,
    Moves,
    Seed,
    bounded,
    check_memory,
    seed_of,
)
from starcal_uq.core.status import Status
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, FloatArray, PathLike, Progress, floats
from starcal_uq.estimation.undetermined import open_parameters
from starcal_uq.estimation.weights import weighed
from starcal_uq.inference.checks import (
    CompressionCheck,
    chain_order,
    check_compression,
    check_draws,
    measure,
)
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.inference.ensemble import PROPOSAL_DF, Chains, EnsembleSettings, run_ensembles
from starcal_uq.inference.named import Source, check_names, find_source, label_of, resolved_dof
from starcal_uq.inference.posterior import Laplace, Posterior
from starcal_uq.inference.priors import SIGMA_NAMES, Priors
from starcal_uq.inference.surrogate import fit_polynomial
from starcal_uq.inference.target import (
    Likelihood,
    LogLikelihood,
    Target,
    importance_check,
    laplace_approximation,
)
from starcal_uq.inference.update import check_chain
from starcal_uq.likelihood.fitted_effects import Effects

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.partitions import PartitionedObservations
    from starcal_uq.observations.table import Observations

# Starts are draws of the Laplace approximation, so the mixture, which forgets in two or three
# steps, needs a short burn-in; the stretch move needs some autocorrelation times of about 60.
_BURN = {"mixture": 20, "stretch": 300}
_N_CHECKED = 300
# An exact evaluation costs thousands of compressed ones.
_N_IMPORTANCE = {"compressed": 20_000}
_N_IMPORTANCE_SLOW = 2_000
# Degrees of the polynomial that stands for a likelihood without a compressed form; the second is
# tried where the first is not good enough, and where a compressed form is not.
_DEGREES = (3, 4)


@bounded
@one_thread()
def sample(
    obs: Observations | PartitionedObservations | None,
    cal: Calibration,
    priors: Priors | None = None,
    *,
    sigma: Literal["sampled"] | float = "sampled",
    n_ensembles: int = 4,
    n_walkers: int = 64,
    n_steps: int = 200,
    n_burn: int | None = None,
    moves: Moves = "mixture",
    seed: Seed | None = None,
    likelihood: LikelihoodName | Likelihood = "marginal",
    evaluation: Evaluation = "auto",
    dof: float | Literal["free"] | None = None,
    progress: Progress | None = None,
    checkpoint: PathLike | None = None,
) -> Posterior:
    """Draw from the posterior of camera parameters and noise.

    Parameters
    ----------
    obs : Observations, PartitionedObservations or None
        The stars of the calibration. None leaves the compressed likelihood unchecked; of
        partitioned ones, the sample of frames that the calibration has kept checks it, its error
        counted for all frames.
    cal : Calibration
        Start, Fisher information and compressed likelihood.
    priors : Priors, optional
        ``Priors.default`` of the nominal camera otherwise.
    sigma : "sampled" or float
        Sample the noise, or take it as given: px, or a factor where the stars state their own
        noise.
    n_ensembles : int
        Separately seeded ensembles, at least 2.
    n_walkers, n_steps : int
        Walkers of one ensemble and kept steps; `n_steps` is even.
    n_burn : int, optional
        Steps before the kept ones; 20 for ``mixture`` and 300 for ``stretch``.
    moves : {"mixture", "stretch"}
        ``mixture``: independence proposals (multivariate t at the Laplace approximation) with
        weight 0.7, differential evolution with 0.3. ``stretch``: emcee's own default, about twenty
        times slower here.
    seed : int or Generator, optional
        The same seed gives the same draws; without one, a new one is taken and recorded in the
        provenance.
    likelihood : {"marginal", "pairs", "pairs_naive", "student_t"} or object
        ``marginal``: Gaussian noise per pixel, attitudes marginalised. ``pairs``: the paper's
        interstar angles as a composite likelihood with Godambe's curvature, around the pair
        estimate of the calibration; sigma comes from the pixel residuals. ``pairs_naive`` takes
        pairs as independent, which is wrong: it warns, and its diagnostics are never ok.
        ``student_t``: heavy tails, for wrong identifications. An object with a method
        ``log_likelihood(theta (n, p), sigma (n,)) -> (n,)`` is used as it is.
    evaluation : {"auto", "compressed", "exact"}
        ``auto`` samples the compressed form (for ``student_t``, a polynomial fitted to a few
        hundred exact values), compares it with the exact one three standard deviations from the
        mode, and at 300 draws where they differ by more than 0.005 nat there. It samples the exact
        one if they differ by more than 0.5 nat within three standard deviations, or if the
        importance weights between them are not all within 0.1 nat and have k-hat above 0.7.
    dof : float or "free", optional
        Degrees of freedom of ``student_t``: by default those of a calibration with that likelihood,
        otherwise 4; "free" samples them, with the gamma prior of Juarez & Steel (2010) on what
        exceeds 2.
    progress : callable, optional
        Called as ``progress(steps_done, steps_total)``; starts again if the exact likelihood takes
        over.
    checkpoint : path, optional
        Written while sampling, read if it exists and is of the same data and settings, removed at
        the end. A resumed run gives the draws of an uninterrupted one, bit for bit.

    Returns
    -------
    Posterior

    Raises
    ------
    SamplingError
        For settings that cannot work, or a calibration that is not sound.
    """
    settings = _settings(n_ensembles, n_walkers, n_steps, n_burn, moves, sigma, cal)
    obs = None if obs is None else weighed(obs, cal)
    check_names(likelihood, evaluation, dof, obs is not None)
    label = label_of(likelihood)
    dof = resolved_dof(cal, dof) if likelihood == "student_t" else None
    per_star = cal.sigma_name == SIGMA_NAMES[1]
    stated = priors is not None
    priors = Priors.default(cal.nominal, per_star) if priors is None else priors
    if not isinstance(priors, Priors):
        raise SamplingError(
            f"priors are a {type(priors).__name__}: make them with Priors.default(camera), and change "
            "some with its method replace."
        )
    if priors.names != (*cal.parameter_names, cal.sigma_name):
        raise SamplingError(
            f"the priors are on {', '.join(priors.names)}, but the calibration has "
            f"{', '.join(cal.parameter_names)} "
            f"and {cal.sigma_name}: make the priors with Priors.default of the calibrated camera."
        )
    _check_determined(cal, priors if stated else None)
    check_chain(priors, cal.nominal, data_hashes(cal.provenance))
    seed = secrets.randbits(63) if seed is None else seed_of(seed)
    chosen: AnyDict = {
        "sigma": sigma,
        "n_ensembles": n_ensembles,
        **asdict(settings),
        "proposal_df": PROPOSAL_DF,
        "likelihood": label,
        "evaluation": evaluation if isinstance(likelihood, str) else "exact",
        **({"dof": dof} if dof is not None else {}),
    }
    data_hash = cal.provenance.data_sha256 if obs is None else cal.data_hash_of(obs)
    source = find_source(likelihood, obs, cal, dof)
    record = provenance(seed, chosen, data_hash)
    if cal.provenance.partitions:
        record = record.adding(partitions=cal.provenance.partitions)
    if cal.noise_model is not None:
        record = record.adding(noise_model=cal.noise_model.record(frames=False))
    if cal.provenance.inflation is not None:
        record = record.adding(inflation=cal.provenance.inflation)
    given = None if sigma == "sampled" else float(sigma)
    run = _Run(cal, source, priors, settings, n_ensembles, seed, given, progress, record)
    if isinstance(likelihood, str):
        outcome, compression = _with_fallback(run, evaluation, checkpoint)
    else:
        outcome = run.sample(label, likelihood.log_likelihood, checkpoint)
        compression = CompressionCheck()
    return _assemble(run, outcome, compression)


@dataclass(eq=False)
class _Run:
    """What stays the same when another likelihood takes over."""

    cal: Calibration
    source: Source
    priors: Priors
    settings: EnsembleSettings
    n_ensembles: int
    seed: int
    given: float | None
    progress: Progress | None
    provenance: Provenance
    mode: Target | None = None

    @cached_property
    def streams(self) -> list[np.random.SeedSequence]:
        """Of the importance weights, of the checks, and of each ensemble.

        The ensembles come last, so that their number changes neither the checks nor the ensembles
        before.
        """
        return np.random.SeedSequence(self.seed).spawn(2 + self.n_ensembles)

    @cached_property
    def design_seed(self) -> np.random.SeedSequence:
        return self.streams[1].spawn(1)[0]

    def start(self, log_likelihood: LogLikelihood) -> Target:
        return self.source.target(log_likelihood, self.priors, self.given)

    def polynomial(self, exact: LogLikelihood, degree: int) -> LogLikelihood | None:
        if self.mode is None:
            self.mode, _ = laplace_approximation(self.start(exact))
        try:
            fitted = fit_polynomial(self.mode, degree, np.random.default_rng(self.design_seed))
        except SamplingError:
            if self.source.fast is None:
                raise
            return None
        return None if fitted is None else fitted.log_likelihood

    def fingerprint(self, target: Target, name: str) -> str:
        identity = {k: v for k, v in self.provenance.items() if k != "created_utc"}
        text = to_json([identity, self.priors, name, target.centre, target.transform])
        return hashlib.sha256(text.encode()).hexdigest()

    def sample(
        self, name: str, log_likelihood: LogLikelihood, checkpoint: PathLike | None
    ) -> _Outcome:
        target, laplace = laplace_approximation(self.start(log_likelihood))
        chains = run_ensembles(
            target.log_density,
            target.dim,
            self.streams[2:],
            self.settings,
            progress=self.progress,
            checkpoint=checkpoint,
            fingerprint=self.fingerprint(target, name),
        )
        return _Outcome(name, target, laplace, chains, checkpoint)


@dataclass(eq=False)
class _Outcome:
    """Chains of one likelihood."""

    name: str
    target: Target
    laplace: Laplace
    chains: Chains
    checkpoint: PathLike | None

    @cached_property
    def draws(self) -> FloatArray:
        ordered = chain_order(self.chains.u)
        natural = self.target.natural(ordered.reshape(-1, self.target.dim))
        return natural.reshape(*ordered.shape[:2], natural.shape[1])


def _with_fallback(
    run: _Run, evaluation: Evaluation, checkpoint: PathLike | None
) -> tuple[_Outcome, CompressionCheck]:
    exact, fast = run.source.exact, run.source.fast
    if exact is None:
        # Without observations there is a compressed likelihood: names were checked before.
        assert fast is not None
        return run.sample("compressed", fast, checkpoint), CompressionCheck()
    if evaluation == "exact":
        return run.sample("exact", exact, checkpoint), CompressionCheck()
    files: list[str] = []
    outcome, compression = None, CompressionCheck()
    for degree in _degrees(run, evaluation):
        compressed = fast if degree == 0 else run.polynomial(exact, degree)
        if compressed is None:
            continue
        # Each attempt has its own file: on resuming, the finished ones must still be found
        # complete.
        outcome = run.sample("compressed", compressed, _attempt(checkpoint, files))
        compression = _compare(run, outcome, compressed, exact)
        if compression.good:
            break
    if evaluation == "auto" and (outcome is None or not compression.good):
        outcome = run.sample("exact", exact, _attempt(checkpoint, files))
    if outcome is None:
        raise SamplingError(
            "no polynomial stands for this likelihood: choose the evaluation 'exact'."
        )
    for path in files[:-1]:
        Path(path).unlink(missing_ok=True)
    return outcome, compression


def _degrees(run: _Run, evaluation: Evaluation) -> tuple[int, ...]:
    """Degrees of the polynomials to try one after the other; 0 is the compressed likelihood."""
    if run.source.fast is None:
        return _DEGREES
    if evaluation == "auto" and run.source.sample is None:
        # Of few stars with much noise the expansion misses little, and chains of the exact one take
        # minutes.
        return (0, _DEGREES[-1])
    return (0,)


def _attempt(checkpoint: PathLike | None, files: list[str]) -> str | None:
    """The checkpoint of the next attempt."""
    if checkpoint is None:
        return None
    files.append(os.fspath(checkpoint) + (f".{len(files) + 1}" if files else ""))
    return files[-1]


def _compare(
    run: _Run, outcome: _Outcome, compressed: LogLikelihood, exact: LogLikelihood
) -> CompressionCheck:
    rng = np.random.default_rng(run.streams[1])
    flat = outcome.draws.reshape(-1, outcome.draws.shape[-1])
    picks = flat[rng.choice(len(flat), min(_N_CHECKED, len(flat)), replace=False)]
    return check_compression(
        compressed, exact, outcome.target, picks, outcome.laplace, run.source.sample
    )


def _assemble(run: _Run, outcome: _Outcome, compression: CompressionCheck) -> Posterior:
    cal, settings, target, source = run.cal, run.settings, outcome.target, run.source
    n = _N_IMPORTANCE.get(outcome.name, _N_IMPORTANCE_SLOW)
    importance = importance_check(target, n, PROPOSAL_DF, np.random.default_rng(run.streams[0]))
    shown = (*parameters(cal.camera.distortion), sigma_parameter(cal.sigma_name == SIGMA_NAMES[1]))
    draws, chains, laplace, extra = outcome.draws, outcome.chains, outcome.laplace, None
    if target.extra is not None:
        draws, chains, laplace, extra = _without_extra(outcome)
    diagnostics = measure(
        chains,
        draws,
        shown,
        laplace,
        importance,
        compression,
        source.name,
        outcome.name,
        run.n_ensembles * settings.n_walkers * (settings.n_burn + settings.n_steps),
    )
    posterior = Posterior(
        parameter_names=tuple(p.name for p in shown),
        draws=draws.reshape(-1, len(shown)),
        log_posterior=chain_order(chains.log_density).reshape(-1),
        n_ensembles=run.n_ensembles,
        n_walkers=settings.n_walkers,
        n_steps=settings.n_steps,
        sigma_sampled=run.given is None,
        priors=run.priors,
        laplace=laplace,
        diagnostics=diagnostics,
        information=floats(cal.information),
        rotation_per_theta=floats(cal.rotation_per_theta),
        attitude_noise=floats(cal.attitude_noise),
        camera=cal.camera,
        provenance=run.provenance,
        dof_draws=None if extra is None else extra.reshape(-1),
        star_error_px=cal.known_effects.star_px,
        effects=_effects(cal, draws.reshape(-1, len(shown))[:, :-1]),
    )
    derived = derived_quantities(posterior)
    checks = (*source.checks, *check_draws(posterior, source.about, derived))
    if outcome.checkpoint is not None:
        Path(outcome.checkpoint).unlink(missing_ok=True)
    return replace(posterior, diagnostics=replace(diagnostics, checks=checks, derived=derived))


def _effects(cal: Calibration, theta: FloatArray) -> Effects | None:
    """The effects of a calibration beside draws (n, p) of the parameters."""
    if not cal.known_effects.fitted:
        return None
    shift, covariance = theta.mean(axis=0) - cal.theta, np.cov(theta, rowvar=False)
    return cal.known_effects.about(cal.compressed, shift, covariance)


def _without_extra(outcome: _Outcome) -> tuple[FloatArray, Chains, Laplace, FloatArray]:
    """Draws, chains and Laplace approximation of camera and noise alone, and the further
    parameter's draws.
    """
    chains, laplace = outcome.chains, outcome.laplace
    # The factor is lower triangular, so that its leading block belongs to the leading coordinates.
    inner = replace(
        laplace,
        names=laplace.names[:-1],
        mode=laplace.mode[:-1],
        covariance=laplace.covariance[:-1, :-1],
        transform=laplace.transform[:-1, :-1],
    )
    return (
        outcome.draws[..., :-1],
        replace(chains, u=chains.u[..., :-1]),
        inner,
        outcome.draws[..., -1],
    )


def _check_determined(cal: Calibration, stated: Priors | None) -> None:
    """Refuse a calibration that did not end well, unless it only leaves open what priors that were
    stated determine.
    """
    if cal.status.ok:
        return
    if cal.status is Status.SINGULAR and cal.undetermined and stated is not None:
        matrix = cal.information + stated.precision(cal.parameter_names)
        if not open_parameters(matrix, 1.0, cal.nominal):
            return
    asked = f", or priors that determine {join_words(cal.undetermined)}" if cal.undetermined else ""
    raise SamplingError(
        f"the calibration did not converge ({cal.status.name}): {cal.remedy}{asked}."
    )


def _settings(
    n_ensembles: int,
    n_walkers: int,
    n_steps: int,
    n_burn: int | None,
    moves: Moves,
    sigma: Any,
    cal: Calibration,
) -> EnsembleSettings:
    check_known("moves", moves, _BURN, SamplingError)
    if sigma != "sampled" and not (
        isinstance(sigma, int | float) and np.isfinite(sigma) and sigma > 0.0
    ):
        raise SamplingError(f"sigma is {sigma!r}: use 'sampled' or a number above zero.")
    n_burn = _BURN[moves] if n_burn is None else n_burn
    dim = len(cal.theta) + 1
    require(
        SamplingError,
        (
            n_ensembles >= 2,
            (
                f"n_ensembles is {n_ensembles}: at least 2 are needed, because R-hat compares "
                "ensembles."
            ),
        ),
        (
            n_walkers >= 2 * dim,
            f"n_walkers is {n_walkers}: {dim} parameters need at least {2 * dim}.",
        ),
        (
            n_steps >= 8 and n_steps % 2 == 0,
            f"n_steps is {n_steps}: give an even number of at least 8.",
        ),
    )
    check_memory(
        f"n_ensembles={n_ensembles}, n_walkers={n_walkers}, n_steps={n_steps}",
        8.0 * dim * n_ensembles * n_walkers * (n_steps + n_burn),
    )
    return EnsembleSettings(n_walkers, n_steps, n_burn, moves)
