"""The exact Gaussian likelihood of all stars, and what a compressed one leaves out of it on a
sample of frames.

What an expansion leaves out adds up over frames. So its sum over all of them is told by some: their
mean times the number of frames, with the standard error that batches of them show. The cost is then
the same for any number of stars.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.compressed import compress
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
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

    def __init__(
        self, obs: Observations | StarFrames, cal: Calibration, rotations: FloatArray | None = None
    ) -> None:
        model, theta = cal.camera.distortion, cal.theta
        if cal.ties is not None and not isinstance(obs, StarFrames):
            ties = Ties.of(obs.frame_ids, cal.ties.known)
            self._one: MarginalLikelihood = TiedLikelihood(obs, model, ties, cal.ties.sigma)
            self._one.use_rotations(quaternion_to_rotation(cal.quaternions))
            return
        if cal.effects and cal.effects.fitted and not isinstance(obs, StarFrames):
            effects = cal.effects.of(obs, cal.camera)
            frames = StarFrames.from_observations(obs, axes=True)
            at = (theta, quaternion_to_rotation(cal.quaternions), cal.sigma)
            self._one = EffectLikelihood(frames, model, effects, cal.effects.ratio(cal.sigma), *at)
            return
        self._one = MarginalLikelihood(obs, model, axes=True)
        if rotations is None and len(cal.quaternions) == self._one.frames.n_frames:
            rotations = quaternion_to_rotation(cal.quaternions)
        if rotations is not None:
            self._one.use_rotations(rotations)
        self._one.use_sums(*self._one.sums(theta))

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
        rotations = (
            quaternion_to_rotation(cal.quaternions)[places]
            if len(cal.quaternions) == obs.n_frames
            else None
        )
        frames = StarFrames.from_observations(some, axes=True)
        frame = np.repeat(np.arange(some.n_frames), frames.sizes)
        plain = replace(cal, effects=None, ties=None)
        self._batches = []
        for first in range(min(BATCHES, some.n_frames)):
            batch = frames.select(frame % BATCHES == first)
            start = None if rotations is None else rotations[first::BATCHES]
            exact = ExactMarginal(batch, plain, start)
            likelihood = MarginalLikelihood(batch, cal.camera.distortion)
            expanded = compress(likelihood, whole.theta_hat, covariance, start)
            self._batches.append((exact, expanded, self.of_frames / batch.n_frames))
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
        return np.array(
            [
                (exact.log_likelihood(theta, sigma) - expanded.log_likelihood(theta, sigma))
                * stands_for
                for exact, expanded, stands_for in self._batches
            ]
        )

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """The compressed log likelihood of all frames, and what it leaves out (n,)."""
        left_out: FloatArray = self.left_out(theta, sigma).mean(axis=0)
        return self._summed(self._at(theta), sigma) + left_out
