"""Frames as QUEST sees them: what displacements of their stars do to their attitudes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import left_error
from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import unproject_jacobian, unproject_theta
from starcal_uq.core.errors import DistortionError, ObservationError
from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import View
from starcal_uq.observations.frames import ranges_of_frames

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

_STARS_AT_ONCE = 1_000_000
# Stars whose columns are held at once.
_COLUMNS_AT_ONCE = 40_000


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """Frames as QUEST sees them at the posterior mean, with its first-order responses.

    Displacements db of the directions turn the attitude by phi = [sum w (I - b b^T)]^-1 sum w b x
    db; weights (N,) are None where all stars count alike. `noise_px` (N,) is the centroid noise per
    axis; `response` (K, 3, p) is d phi / d theta, rad per px unit, `noise_response` (2, N, 3) the
    turns of a star's frame by one standard deviation of its x and of its y, or of two independent
    parts where a noise model has its axes correlate, rad, and `noise_covariance` (K, 3, 3) the
    covariance of phi from centroid noise, rad^2.
    """

    post: Posterior
    obs: Observations
    weights: FloatArray | None
    noise_px: FloatArray
    response: FloatArray
    noise_response: FloatArray
    noise_covariance: FloatArray

    @classmethod
    def of(cls, post: Posterior, obs: Observations) -> FrameGeometry:
        """Linearise QUEST on these frames."""
        obs = weighed(obs, post)
        noise_px, weights = _noise(post, obs)
        xy, starts = obs.xy, obs.frame_starts
        w = np.ones(obs.n_stars) if weights is None else weights
        root = np.eye(2) if obs.noise_axes is None else np.linalg.cholesky(obs.noise_axes)
        response = np.empty((obs.n_frames, 3, len(post.mean)))
        turns, covariance = np.empty((2, obs.n_stars, 3)), np.empty((obs.n_frames, 3, 3))
        for first, last in ranges_of_frames(starts, _COLUMNS_AT_ONCE):
            stars, edges = slice(starts[first], starts[last]), starts[first : last + 1]
            at = post.camera.distortion, post.mean, xy[stars], edges - starts[first]
            b, per_theta, inverse, response[first:last] = responses(*at, w[stars])
            # A shift of the pixel is one of the principal point the other way.
            per_pixel = np.einsum("nja,ab->bnj", -per_theta[:, :, :2], root)
            torque = (w * noise_px)[stars, None] * np.cross(b, per_pixel)
            own = np.einsum("nij,anj->ani", np.repeat(inverse, np.diff(edges), axis=0), torque)
            turns[:, stars] = own
            squares = np.einsum("ani,anj->nij", own, own)
            covariance[first:last] = _frame_sums(squares, edges - starts[first])
        return cls(post, obs, weights, noise_px, response, turns, covariance)

    @property
    def of_stars(self) -> FloatArray | None:
        """The part (3, 3) of the mean noise covariance that is the stars' own direction errors,
        rad^2; None where the posterior holds none.
        """
        if not self.post.star_error_px > 0.0:
            return None
        turns = self.noise_response * (self.post.star_error_px / self.noise_px)[:, None]
        return np.asarray(np.einsum("ani,anj->ij", turns, turns) / self.obs.n_frames)

    def attitudes(self, thetas: FloatArray, xy: FloatArray) -> FloatArray:
        """Quaternions (d, K, 4) by QUEST for parameters (d, p) and pixels (N, 2), or (d, N, 2)."""
        model = self.post.camera.distortion
        pixels = np.broadcast_to(xy, (len(thetas), *xy.shape[-2:]))
        b = np.stack(
            [unproject_theta(model, theta, own) for theta, own in zip(thetas, pixels, strict=True)]
        )
        folded = ~np.isfinite(b).all(axis=(1, 2))
        if folded.any():
            raise DistortionError(
                f"at {int(folded.sum())} of {len(b)} posterior draws the distortion {model!r} "
                "folds over within the "
                "observed field: use more frames, a tighter prior or a model with fewer "
                "coefficients."
            )
        obs = self.obs
        return quest(
            b, obs.directions_icrs, obs.frame_starts, self.weights, covariance=False
        ).quaternions

    def rotations(self, draws: FloatArray) -> Iterator[tuple[slice, FloatArray]]:
        """Left rotations (d, K, 3) rad of the attitudes at some draws from those at the posterior
        mean.
        """
        xy = self.obs.xy
        reference = self.attitudes(self.post.mean[None], xy)
        for part in self.batches(len(draws)):
            yield part, left_error(self.attitudes(draws[part], xy), reference)

    def batches(self, count: int) -> Iterator[slice]:
        """Ranges of draws whose stars fit into memory."""
        step = max(1, _STARS_AT_ONCE // self.obs.n_stars)
        return (slice(first, min(first + step, count)) for first in range(0, count, step))

    def turned(
        self, frames: Observations, camera: Camera, columns: Callable[[View], FloatArray]
    ) -> FloatArray:
        """Turns (K, 3, c), rad, of the frames by columns (c, 2, n) of shifts of their stars, px.

        `frames` are those of the geometry, as they are stated; `camera` is what the columns are
        around.
        """
        turns = self.noise_response / self.noise_px[:, None]
        if self.obs.noise_axes is not None:
            # Parts of the noise are combinations of both axes.
            root = np.linalg.inv(np.linalg.cholesky(self.obs.noise_axes).T)
            turns = np.einsum("ab,bni->ani", root, turns)
        turned = []
        likelihood = MarginalLikelihood(frames, camera.distortion)
        for part, state, rows in likelihood.pieces(camera.theta, None, _COLUMNS_AT_ONCE):
            found = columns(View.of(part, state, camera.theta, rows))
            products = np.einsum("jan,ani->nij", found, turns[:, rows])
            turned.append(np.add.reduceat(products, part.frames.starts[:-1], axis=0))
        return np.concatenate(turned)


def responses(
    model: str, theta: FloatArray, xy: FloatArray, starts: IntArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Directions (N, 3) of stars at pixels (N, 2), their derivatives (N, 3, p), the inverse
    information (K, 3, 3) of each attitude, and its turn (K, 3, p) by one unit of each parameter,
    rad per px unit.
    """
    b, per_theta = unproject_jacobian(model, theta, xy)
    w = weights[:, None, None]
    information = _frame_sums(w * (np.eye(3) - b[:, :, None] * b[:, None, :]), starts)
    inverse = floats(np.linalg.inv(information))
    by_theta = _frame_sums(w * np.cross(b[:, None], np.swapaxes(per_theta, 1, 2)), starts)
    return b, per_theta, inverse, inverse @ np.swapaxes(by_theta, 1, 2)


def _noise(post: Posterior, obs: Observations) -> tuple[FloatArray, FloatArray | None]:
    """Noise of every star (N,) in px at the posterior mean, its own direction error included, and
    QUEST's weights.
    """
    sigma = float(np.mean(post.sigma_draws))
    if post.sigma_name != "sigma_scale":
        return np.full(obs.n_stars, np.hypot(sigma, post.star_error_px)), None
    if obs.sigma_px is None:
        raise ObservationError(
            "the posterior scales the stated noise of the stars, but these observations have no "
            "sigma_px: "
            "pass the observations that it was sampled from, or mission_frames(..., "
            "noise_like=observations).",
            column="sigma_px",
        )
    return np.hypot(sigma * obs.sigma_px, post.star_error_px), obs.sigma_px**-2.0


def _frame_sums(values: Any, starts: IntArray) -> FloatArray:
    return np.add.reduceat(values, starts[:-1], axis=0)
