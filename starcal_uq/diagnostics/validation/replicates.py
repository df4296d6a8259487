"""One replicate of a validation: simulate, calibrate, sample, and ask where the truth lies among
the draws.

Likelihood, target, Laplace approximation, moves and ensembles are those of `starcal_uq.sample`;
what is left out is the number of ensembles, and diagnostics that a single run needs and a thousand
replicates do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.distortion import parameters, sigma_parameter
from starcal_uq.core.constants import ARCSEC, AXES
from starcal_uq.core.errors import PriorError
from starcal_uq.core.settings import Truth
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.inference.ensemble import EnsembleSettings, ensemble_draws
from starcal_uq.inference.named import quick_target
from starcal_uq.inference.target import Likelihood, LogLikelihood
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import symmetric_inverse
from starcal_uq.simulation.frames import Campaign

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.priors import Priors
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

LikelihoodMaker = Callable[["Observations", "Calibration"], Likelihood]

MARGINAL = "marginal"
LOG_LIKELIHOOD = "log_likelihood"
INTERVAL = 0.95
_MAX_TRUTHS = 1000


@dataclass(frozen=True)
class Replication:
    """What all replicates share; sent once to every process."""

    camera: Camera  # The truth, or the centre of what it is drawn around
    nominal: Camera  # Start of every calibration
    priors: Priors  # Sampled with; with ``truth="prior"`` the truth is drawn from them as well
    truth: Truth  # "fixed" or "prior": whether every replicate has one truth or a new one
    campaign: Campaign  # Data of one calibration; the noise may be drawn from the prior instead
    seed: int  # Replicate i depends on the seed and on i alone
    assumed_sigma_px: float | None = (
        None  # Noise that the sampler is told; None lets it sample the noise
    )
    likelihood: str | LikelihoodMaker = (
        MARGINAL  # Name of a likelihood, or ``(obs, cal) -> Likelihood``
    )
    # ``() -> list of (emcee move, weight)`` to sample with instead of the usual ones.
    moves: Callable[[], list[tuple[Any, float]]] | None = None
    # `n_walkers`, `n_steps`, `n_burn`: one ensemble.
    n_walkers: int = 64
    n_steps: int = 200
    n_burn: int = 20
    # Every `thin`-th step is ranked: walkers of one step are independent of each other, steps
    # nearly so after ten.
    thin: int = 10

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of what is ranked: parameters, noise if sampled, log likelihood, attitude
        errors.
        """
        noise = self.priors.names[-1:] if self.assumed_sigma_px is None else ()
        return (*self.priors.names[:-1], *noise, LOG_LIKELIHOOD, *AXES)

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        noise = (sigma_parameter(False).unit,) if self.assumed_sigma_px is None else ()
        return (
            *(p.unit for p in parameters(self.priors.distortion)),
            *noise,
            "nat",
            *("arcsec",) * 3,
        )

    @property
    def n_ranked(self) -> int:
        """Draws that the truth is ranked among; one is left out, so that the number of ranks has
        many divisors.
        """
        return self.n_walkers * (self.n_steps // self.thin) - 1


class TrialOutcome(NamedTuple):
    """One replicate, over Q quantities and p parameters."""

    replicate: int  # Number of the replicate
    truth: FloatArray  # (p+1,): camera parameters and noise
    ranks: IntArray  # (Q,): draws below the truth, of `Replication.n_ranked`
    covered: BoolArray  # (Q,): the truth lies between the 2.5 % and 97.5 % quantiles of all draws
    error: FloatArray  # (Q,): mean of the draws minus truth
    sd: FloatArray  # (Q,): standard deviation of the draws
    nees: float  # Normalised squared error of the parameters with mean and covariance of the draws
    nees_calibration: (
        float  # Normalised squared error with the estimate and covariance of the calibration
    )
    compression_error: float  # Compressed minus exact log likelihood at the truth, nat
    dof: int  # Degrees of freedom of the calibration


def run_replicate(
    study: Replication, stars: StarCatalogue, index: int, seeds: np.random.SeedSequence
) -> TrialOutcome:
    """Replicate number `index`."""
    truths, noise, sampler = seeds.spawn(3)
    camera, sigma_px = _truth(study, np.random.default_rng(truths))
    truth = np.append(camera.theta, sigma_px)
    campaign = replace(study.campaign, sigma_px=sigma_px)
    obs = campaign.simulate(stars, camera, noise.generate_state(1, np.uint64)[0])
    cal = calibrate(obs, study.nominal, model=study.nominal.model)
    draws, likelihood = _sample(study, obs, cal, sampler)
    return _compare(study, obs, cal, draws, likelihood, truth, index)


def _truth(study: Replication, rng: np.random.Generator) -> tuple[Camera, float]:
    """A camera and its noise; draws that are not cameras are drawn again.

    The prior is then cut off where no camera is; so is the posterior in effect, because stars that
    were seen leave no probability there.
    """
    if study.truth == "fixed":
        return study.camera, study.campaign.sigma_px
    for _ in range(_MAX_TRUTHS):
        draw = study.priors.draw(1, rng)[0]
        theta, sigma_px = draw[:-1], float(draw[-1])
        if not theta[2] > 0.0:
            continue
        camera = study.camera.with_theta(theta)
        if camera.contains(theta[:2]) and not camera.folds:
            return camera, sigma_px
    raise PriorError(
        f"none of {_MAX_TRUTHS} draws of the prior is a camera whose principal point is on the "
        "detector and whose "
        "distortion does not fold over: narrow the prior."
    )


def _sample(
    study: Replication, obs: Observations, cal: Calibration, seed: np.random.SeedSequence
) -> tuple[FloatArray, LogLikelihood]:
    """Draws (n_steps, n_walkers, p+1) and the likelihood that they are of."""
    made = study.likelihood if isinstance(study.likelihood, str) else study.likelihood(obs, cal)
    target, _ = quick_target(made, obs, cal, study.priors, study.assumed_sigma_px)
    settings = EnsembleSettings(study.n_walkers, study.n_steps, study.n_burn, "mixture")
    moves = None if study.moves is None else study.moves()
    draws = ensemble_draws(target, seed, settings, moves)
    return draws.reshape(study.n_steps, study.n_walkers, -1), target.log_likelihood


def _compare(
    study: Replication,
    obs: Observations,
    cal: Calibration,
    draws: FloatArray,
    log_likelihood: LogLikelihood,
    truth: FloatArray,
    index: int,
) -> TrialOutcome:
    p = len(truth) - 1
    flat = draws.reshape(-1, p + 1)
    believed = (
        truth if study.assumed_sigma_px is None else np.append(truth[:-1], study.assumed_sigma_px)
    )
    points = np.vstack([flat, believed])
    level = log_likelihood(points[:, :-1], points[:, -1])
    noise = flat[:, -1:] - truth[-1] if study.assumed_sigma_px is None else np.empty((len(flat), 0))
    # The attitude error of a draw: the common rotation that its parameters cause, to first order.
    shift = flat[:, :-1] - truth[:-1]
    rotation = ARCSEC * shift @ cal.rotation_per_theta.T
    above = np.column_stack([shift, noise, level[:-1] - level[-1], rotation])
    low, high = np.quantile(above, [0.5 - 0.5 * INTERVAL, 0.5 + 0.5 * INTERVAL], axis=0)
    ranked = above.reshape(study.n_steps, study.n_walkers, -1)[
        study.thin - 1 :: study.thin
    ].reshape(-1, above.shape[1])
    exact = np.nan
    if study.likelihood == MARGINAL:
        exact = MarginalLikelihood(obs, cal.camera.distortion).log_likelihood(
            believed[:-1], float(believed[-1])
        )
    return TrialOutcome(
        replicate=index,
        truth=truth,
        ranks=np.sum(ranked[: study.n_ranked] < 0.0, axis=0),
        covered=(low <= 0.0) & (high >= 0.0),
        error=above.mean(axis=0),
        sd=above.std(axis=0, ddof=1),
        nees=_nees(shift.mean(axis=0), np.cov(shift, rowvar=False)),
        nees_calibration=_nees(cal.theta - truth[:-1], cal.covariance),
        compression_error=float(level[-1]) - exact,
        dof=cal.dof,
    )


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ symmetric_inverse(covariance) @ error)
