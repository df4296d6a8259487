"""Draws of the camera through QUEST on some of the frames, and their difference from first order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import left_error
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.maths.linear import mean_weights
from starcal_uq.observations.splits import frame_sample
from starcal_uq.propagation.geometry import FrameGeometry

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

# Draws that are given noise as well: the interaction is averaged over frames, and its size is what
# counts.
_NOISY_DRAWS = 40
# Frames that go through QUEST, of more: so many, or fewer that hold so many stars, but not fewer
# than the last.
_SAMPLED_FRAMES, _SAMPLED_STARS, _FEWEST_FRAMES = 300, 20_000, 30


@dataclass(frozen=True, eq=False)
class Sampled:
    """Draws through QUEST on k of the frames (`places`), and their difference from first order.

    Variances beyond first order, rad^2, are those of the draws less those that the responses give
    for the same draws: of the common rotation and of the mean of the rest (3,), of the rest and of
    the whole rotation in each frame (k, 3), and of noise (3,). `common` (D, 3) is the common
    rotation of every draw, rad, `together` (3, p) its first-order response on these frames, and
    `interaction` (d, k, 3) that of noise and camera, rad.
    """

    places: IntArray
    common: FloatArray
    together: FloatArray
    beyond_common: FloatArray
    beyond_constant: FloatArray
    beyond_rest: FloatArray
    beyond_whole: FloatArray
    noise_excess: FloatArray
    interaction: FloatArray

    def over(self, n_frames: int, values: FloatArray) -> FloatArray:
        """Values (n_frames, 3) of all frames: those of the sample (k, 3), and their mean
        elsewhere.
        """
        every = np.tile(values.mean(axis=0), (n_frames, 1))
        every[self.places] = values
        return every


def _few(obs: Observations, seed: int) -> tuple[Observations, IntArray]:
    """Frames that draws are taken through, and their places: fewer of those with very many stars,
    which are alike.
    """
    limit = int(
        np.clip(_SAMPLED_STARS * obs.n_frames // obs.n_stars, _FEWEST_FRAMES, _SAMPLED_FRAMES)
    )
    return frame_sample(obs, limit, seed)


def through_quest(
    post: Posterior,
    every: FrameGeometry,
    every_aligned: FrameGeometry,
    draws: FloatArray,
    seed: int,
) -> Sampled:
    """Take draws (D, p) through QUEST on some of the frames and of those of the alignment."""
    some, places = _few(every.obs, seed)
    frames = every if some is every.obs else FrameGeometry.of(post, some)
    if every_aligned is every:
        aligned = frames
    else:
        aligning, _ = _few(every_aligned.obs, seed)
        aligned = (
            every_aligned if aligning is every_aligned.obs else FrameGeometry.of(post, aligning)
        )
    weights, _ = mean_weights(aligned.noise_covariance)
    common, constant = np.empty((len(draws), 3)), np.empty((len(draws), 3))
    # Where the same frames align and are propagated to, their attitudes are found once.
    if aligned is not frames:
        for part, phi in aligned.rotations(draws):
            common[part] = np.einsum("nij,dnj->di", weights, phi)
    rest, whole = _Moments(some.n_frames), _Moments(some.n_frames)
    quiet: list[FloatArray] = []
    for part, phi in frames.rotations(draws):
        if aligned is frames:
            common[part] = np.einsum("nij,dnj->di", weights, phi)
        if part.start < _NOISY_DRAWS:
            quiet.append(phi[: _NOISY_DRAWS - part.start])
        whole.add(phi)
        rest.add(phi - common[part, None])
        constant[part] = phi.mean(axis=1) - common[part]
    together = np.einsum("nij,njp->ip", weights, aligned.response)
    apart = frames.response - together
    own = np.cov(draws, rowvar=False).reshape(draws.shape[1], -1)
    noise_excess, interaction = _with_noise(
        frames, draws[:_NOISY_DRAWS], np.concatenate(quiet), seed
    )
    return Sampled(
        places=places,
        common=common,
        together=together,
        beyond_common=common.var(axis=0, ddof=1) - spread(together, own),
        beyond_constant=constant.var(axis=0, ddof=1) - spread(apart.mean(axis=0), own),
        beyond_rest=rest.variance - spread(apart, own),
        beyond_whole=whole.variance - spread(frames.response, own),
        noise_excess=noise_excess,
        interaction=interaction,
    )


class _Moments:
    """Variance (K, 3) over draws that come in parts (d, K, 3)."""

    def __init__(self, n_frames: int) -> None:
        self._count = 0
        self._total, self._squares = np.zeros((n_frames, 3)), np.zeros((n_frames, 3))

    def add(self, values: FloatArray) -> None:
        self._count += len(values)
        self._total += values.sum(axis=0)
        self._squares += np.sum(values * values, axis=0)

    @property
    def variance(self) -> FloatArray:
        return (self._squares - self._total**2 / self._count) / (self._count - 1)


def _with_noise(
    frames: FrameGeometry, draws: FloatArray, quiet: FloatArray, seed: int
) -> tuple[FloatArray, FloatArray]:
    """What noise does beyond first order: excess variance (3,) of noise alone, and the interaction
    (d, K, 3), rad.

    `quiet` (d, K, 3) are the rotations at the draws without noise.
    """
    rng = np.random.default_rng(seed)
    xy, starts, mean = frames.obs.xy, frames.obs.frame_starts, frames.post.mean[None]
    reference = frames.attitudes(mean, xy)
    excess, interactions = np.zeros(3), []
    for part in frames.batches(len(draws)):
        thetas = draws[part]
        e = rng.standard_normal((len(thetas), len(xy), 2))
        errors = (
            e if frames.obs.noise_axes is None else e @ np.linalg.cholesky(frames.obs.noise_axes).T
        )
        noisy = xy + frames.noise_px[:, None] * errors
        noise = left_error(frames.attitudes(np.repeat(mean, len(thetas), axis=0), noisy), reference)
        both = left_error(frames.attitudes(thetas, noisy), reference)
        linear = np.add.reduceat(
            np.einsum("dna,ani->dni", e, frames.noise_response), starts[:-1], axis=1
        )
        excess += np.sum(noise * noise - linear * linear, axis=(0, 1))
        interactions.append(both - quiet[part] - noise)
    return excess / (len(draws) * frames.obs.n_frames), np.concatenate(interactions)


def spread(response: FloatArray, covariance: FloatArray) -> FloatArray:
    """Diagonal (..., 3) of ``response @ covariance @ response^T`` for responses (..., 3, p)."""
    diagonal: FloatArray = np.sum((response @ covariance) * response, axis=-1)
    return diagonal
