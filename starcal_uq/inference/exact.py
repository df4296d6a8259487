"""The exact Gaussian likelihood of all stars, and what a compressed one leaves out of it on a
sample of frames.

What an expansion leaves out adds up over frames. So its sum over all of them is told by some: their
mean times the number of frames, with the standard error that batches of them show. The cost is then
the same for any number of stars.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.effects import beside_effects
from starcal_uq.likelihood.compressed import compress
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.ties import TiedLikelihood, Ties
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.splits import frame_sample

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Frames of a sample, and the batches that tell its standard error.
SAMPLED_FRAMES, BATCHES = 1000, 10


class ExactMarginal:
    """The exact Gaussian likelihood around a calibration, point by point, effects at their best
    scales.

    Attitudes are those that follow from the ones at the estimate to first order, so that a pass
    over the stars is enough for a point.
    """

    def __init__(self, obs: Observations, cal: Calibration) -> None:
        self._obs, self._cal = obs, cal

    @cached_property
    def _one(self) -> MarginalLikelihood:
        """The likelihood of all stars, which is made when it is first evaluated."""
        obs, cal = self._obs, self._cal
        model, theta = cal.camera.distortion, cal.theta
        if cal.ties is not None:
            ties = Ties.of(obs.frame_ids, cal.ties.known)
            return TiedLikelihood(obs, model, ties, cal.ties.sigma, cal.rotations)
        if cal.known_effects.fitted:
            return beside_effects(obs, cal, cal.rotations)
        same = len(cal.quaternions) == obs.n_frames
        one = MarginalLikelihood(obs, model, cal.rotations if same else None)
        one.use_sums(*one.sums(theta))
        return one

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Log likelihood (n,) at theta (n, p) and sigma (n,)."""
        return self._one.log_likelihoods(theta, sigma)


class FrameSample:
    """What the compressed likelihood of a calibration leaves out, told by a sample of its frames.

    A sample of `n_frames` is taken of `obs` where its frames are many; they stand for `of_frames`,
    by default those of `obs`.
    """

    def __init__(self, obs: Observations, cal: Calibration, of_frames: int | None = None) -> None:
        some, places = frame_sample(obs, SAMPLED_FRAMES)
        self.n_frames, self.of_frames = (
            some.n_frames,
            obs.n_frames if of_frames is None else of_frames,
        )
        self._summed, whole = cal.log_likelihood, cal.compressed
        covariance = whole.whitening @ whole.whitening.T
        rotations = cal.rotations[places] if len(cal.quaternions) == obs.n_frames else None
        frames = StarFrames.from_observations(some)
        self._exact = MarginalLikelihood(frames, cal.camera.distortion, rotations)
        self._exact.use_sums(*self._exact.sums(whole.theta_hat))
        n_batches = min(BATCHES, some.n_frames)
        self._batch = np.arange(some.n_frames) % BATCHES
        of_stars = np.repeat(self._batch, frames.sizes)
        self._stand_for = self.of_frames / np.bincount(self._batch)
        self.whole = _off_at_the_estimate(obs, cal)
        self._expanded = [
            compress(
                MarginalLikelihood(frames.select(of_stars == batch), cal.camera.distortion),
                whole.theta_hat,
                covariance,
                None if rotations is None else rotations[batch::BATCHES],
            )
            for batch in range(n_batches)
        ]
        self._at: Callable[[FloatArray], FloatArray] = np.asarray

    def evaluated(self, at: Callable[[FloatArray], FloatArray]) -> FrameSample:
        """The same of a likelihood that is evaluated at ``at(theta)``."""
        other = copy(self)
        other._at = at
        return other

    def left_out(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Exact less compressed log likelihood of all frames, as every batch by itself has it, (B,
        n).
        """
        theta = self._at(theta)
        expanded = [batch.log_likelihood(theta, sigma) for batch in self._expanded]
        # All batches in one pass for each point
        exact = [
            np.bincount(self._batch, self._exact.by_frame(point, float(noise)))
            for point, noise in zip(theta, sigma, strict=True)
        ]
        return (np.transpose(exact) - expanded) * self._stand_for[:, None]

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """The compressed log likelihood of all frames, and what it leaves out (n,)."""
        left_out: FloatArray = self.left_out(theta, sigma).mean(axis=0)
        return self._summed(self._at(theta), sigma) + left_out


def _off_at_the_estimate(obs: Observations, cal: Calibration) -> float | None:
    """Difference of the compressed likelihood from the sum of squares that another pass over all
    stars has found at the estimate, nat; None where the calibration does not know it.
    """
    beside = (cal.known_effects.names, cal.ties, cal.noise_model, cal.partitions)
    if any(beside) or obs.data_hash != cal.provenance.data_sha256:
        return None
    whole = cal.compressed
    squares = float(whole.sum_of_squares(whole.whiten(cal.theta))[0])
    return abs(squares - cal.chi2) / (2.0 * cal.sigma**2)
