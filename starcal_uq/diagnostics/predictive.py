"""Posterior predictive check: would data that the model makes look like those that were measured?

Each draw of camera and noise makes replicated residuals on the observed frames, with their
attitudes fitted again. The same statistics of the measured residuals at the same draw are set
against them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.display import Shown
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.estimation.effects import beside_effects
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import scaled_cholesky
from starcal_uq.observations.splits import frame_sample

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

_RINGS = 10
_MAX_STARS = 20_000


# Probabilities beyond which a statistic is not that of replicated data.
EXTREME_P = (0.001, 0.999)


@dataclass(frozen=True)
class PredictiveStatistic:
    """One statistic of measured and replicated residuals.

    Attributes
    ----------
    name : str
        Name of the statistic.
    observed : float
        Mean over draws for the data.
    replicated_low, replicated_median, replicated_high : float
        Quantiles (2.5 %, 50 %, 97.5 %) for replicated data.
    p_value : float
        Share of draws whose replicate is at least as large as the data's.
    """

    name: str
    observed: float
    replicated_low: float
    replicated_median: float
    replicated_high: float
    p_value: float

    @property
    def extreme(self) -> bool:
        """True if hardly a replicate is as large, or as small."""
        return not EXTREME_P[0] <= self.p_value <= EXTREME_P[1]


@dataclass(frozen=True)
class PredictiveCheck(Shown):
    """Statistics of measured residuals against replicated ones.

    Attributes
    ----------
    statistics : tuple of PredictiveStatistic
        In reading order.
    n_draws : int
        Draws of the posterior.
    n_frames : int
        Frames that were used: all, unless there are very many stars.
    of_frames : int
        Frames that there are; 0 in a check of a version that did not say.
    """

    statistics: tuple[PredictiveStatistic, ...]
    n_draws: int
    n_frames: int
    of_frames: int = 0

    def to_dataframe(self) -> pd.DataFrame:
        """One row per statistic."""
        import pandas as pd

        return pd.DataFrame([asdict(s) for s in self.statistics])


@bounded
@one_thread()
def predictive_check(
    obs: Observations,
    cal: Calibration,
    post: Posterior | None = None,
    *,
    n_draws: int = 500,
    seed: Seed = 0,
) -> PredictiveCheck:
    """Compare statistics of the residuals with those of data that the posterior predicts.

    Parameters
    ----------
    obs, cal
        The data and the estimate.
    post : Posterior, optional
        The posterior; the normal approximation of the calibration otherwise.
    n_draws : int
        Draws, and replicates.
    seed : int or Generator
        Seed of the draws and the replicates.
    """
    seed = seed_of(seed)
    rng = np.random.default_rng(seed)
    # The statistics settle long before: of very many stars, those of some frames do.
    limit = max(1, min(obs.n_frames, _MAX_STARS * obs.n_frames // obs.n_stars))
    used = weighed(obs, cal)
    some, places = frame_sample(used, limit, seed)
    part = MarginalLikelihood(some, cal.camera.distortion)
    state, _ = part.profile(cal.theta, cal.rotations[places])
    e, h = state.e, state.slopes
    exact: EffectLikelihood | None = None
    if cal.known_effects.fitted:
        exact = beside_effects(some, cal, state.rotations, used)
        # Its images are less what effects are expected to do.
        state, _ = exact.profile(cal.theta, exact.rotations)

    def left(columns: FloatArray) -> FloatArray:
        """Residuals after attitudes and effects; replicates go the same way."""
        if exact is None:
            return part.project_out(state, columns)
        return exact.conditioned(state, columns)[0]

    columns = left(np.concatenate([h, e[None]]))
    theta, sigma = _draws(cal, post, n_draws, rng)
    summary = _Summary(part, cal)
    measured, replicated = [], []
    for shift, noise in zip(theta - cal.theta, sigma, strict=True):
        measured.append(summary(np.tensordot(np.append(-shift, 1.0), columns, 1) / noise))
        fresh = _noise(cal, e.shape, rng)
        if exact is not None:
            fresh += exact.random_shifts(state, rng)
        replicated.append(summary(left(fresh)[0]))
    data, fake = np.array(measured), np.array(replicated)
    low, middle, high = np.quantile(fake, (0.025, 0.5, 0.975), axis=0)
    p = np.mean(fake >= data, axis=0)
    rows = zip(_NAMES, data.mean(axis=0), low, middle, high, p, strict=True)
    statistics = tuple(
        PredictiveStatistic(name, *(float(v) for v in values)) for name, *values in rows
    )
    if cal.noise_model is not None and cal.noise_model.frame_dof is not None:
        # Every frame's sum of squares went into the factor of its own noise.
        statistics = tuple(s for s in statistics if not s.name.startswith("worst frame"))
    return PredictiveCheck(statistics, len(sigma), some.n_frames, obs.n_frames)


def _noise(cal: Calibration, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    """Noise (1, 2, N) of stars in units of sigma, with the tails and the weights of an estimate."""
    noise = rng.standard_normal((1, *shape))
    if not cal.has_tails:
        return noise
    # The bivariate t of `likelihood.student`: r^2 / (nu + r^2) is Beta(1, nu / 2), in any direction.
    nu = cal.nu
    share = rng.beta(1.0, nu / 2.0, shape[-1])
    # Weights (nu + 2) / (nu + r^2) bound what is left.
    weights = "tail_weights" in cal.provenance
    square = (nu + 2.0) * share if weights else nu * share / (1.0 - share)
    return floats(noise * np.sqrt(square / np.sum(noise[0] ** 2, axis=0)))


def _draws(
    cal: Calibration, post: Posterior | None, n_draws: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    if post is not None:
        chosen = post.thin(n_draws, rng)
        return chosen[:, :-1], chosen[:, -1]
    noise = np.sqrt(cal.chi2 / rng.chisquare(cal.dof, n_draws))
    factor = scaled_cholesky(cal.covariance)
    steps = rng.standard_normal((n_draws, len(factor))) @ factor.T
    return cal.theta + steps * (noise / cal.sigma)[:, None], noise


_NAMES = (
    "sum of squares per degree of freedom",
    "largest residual [σ]",
    "excess kurtosis",
    "radial pattern: mean square of ring means",
    "tangential pattern: mean square of ring means",
    "worst frame: standardised sum of squares",
)


class _Summary:
    """The statistics of residuals (2, N) in units of the noise."""

    def __init__(self, part: MarginalLikelihood, cal: Calibration) -> None:
        self.frames = part.frames
        offset = part.frames.pixel - cal.theta[:2, None]
        radius = np.maximum(np.hypot(*offset), 1e-9)
        self.out = offset / radius
        edges = np.quantile(radius, np.linspace(0.0, 1.0, _RINGS + 1)[1:-1])
        self.ring = np.searchsorted(edges, radius)
        self.counts = np.maximum(np.bincount(self.ring, minlength=_RINGS), 1)
        self.dof = 2.0 * part.frames.sizes - 3.0

    def __call__(self, z: FloatArray) -> list[float]:
        # Products rather than powers and full-length temporaries: this runs a thousand times.
        square = z * z
        squares = self.frames.sum(square[0] + square[1])
        radial = z[0] * self.out[0] + z[1] * self.out[1]
        across = self.out[0] * z[1] - self.out[1] * z[0]
        patterns = [
            float(np.mean(np.bincount(self.ring, values, _RINGS) ** 2 / self.counts))
            for values in (radial, across)
        ]
        total = float(squares.sum())
        return [
            total / float(self.dof.sum()),
            float(np.sqrt(square.max())),
            float(np.vdot(square, square)) * z.size / total**2 - 3.0,
            *patterns,
            float(np.max((squares - self.dof) / np.sqrt(2.0 * self.dof))),
        ]
