"""The paper's interstar-angle objective in a time proportional to the number of stars.

``S(theta) = sum_k sum_{i<j} (b_i . b_j - r_i . r_j)^2`` (Ye & Yang 2017, eqs. 5 and 13) is
evaluated per frame from 3 x 3 Gram matrices. With B the measured and R' the catalogue unit vectors
rotated to the camera frame, E = B - R' is small, and every term below is formed from E, so that
nothing cancels:

    B B^T - R' R'^T = R' E^T + E R'^T + E E^T.
"""

from __future__ import annotations

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood import arrays
from starcal_uq.likelihood.paths import sums_for
from starcal_uq.likelihood.solvers import Normal, is_singular
from starcal_uq.maths.linear import unit_inverse
from starcal_uq.observations.frames import StarFrames

# The objective does not depend on how the catalogue is turned; a turn that is right to within this
# many pixels keeps E small enough for eleven digits of the cost.
_TURN_AGAIN_PX = 30.0


class PairObjective:
    """Sum of squared differences of interstar cosines over all pairs of a frame and all frames.

    `model_name`: distortion model; ``none`` for the paper's first stage. Per-star weights are not
    used: the paper's objective has none.
    """

    def __init__(self, frames: StarFrames, model_name: str) -> None:
        self.frames = frames
        self.model_name = model_name
        self.n_parameters = 3 + len(get_model(model_name).coefficients)
        self._turned_at: FloatArray | None = None
        self._rotations = np.empty((0, 3, 3))
        self._last: tuple[FloatArray, Normal, FloatArray] | None = None

    @property
    def n_pairs(self) -> int:
        """Number of star pairs."""
        m = self.frames.sizes
        return int(np.sum(m * (m - 1) // 2))

    @property
    def rotations(self) -> FloatArray | None:
        """Attitudes (K, 3, 3) by QUEST near to the last point, if that was finite."""
        return None if self._turned_at is None else self._rotations

    def rotations_at(self, theta: FloatArray) -> FloatArray | None:
        """As `rotations`, near enough to theta for a refinement to begin: all of them follow the
        principal point.
        """
        with np.errstate(all="ignore"):
            self._turn(theta)
        if self._turned_at is None:
            return None
        x, y = (theta[:2] - self._turned_at[:2]) / theta[2]
        return exp_rotation(np.array([y, -x, 0.0])) @ self._rotations

    def directions(self, theta: FloatArray, frames: StarFrames) -> tuple[FloatArray, FloatArray]:
        """Measured unit vectors (3, N) and their derivatives (p, 3, N)."""
        return arrays.directions(frames, self.model_name, theta)

    def _turn(self, theta: FloatArray) -> FloatArray:
        """Attitudes (K, 3, 3) that turn the catalogue nearly into the camera frame; new ones if
        these are too far.
        """
        if (
            self._turned_at is not None
            and np.max(np.abs(theta[:3] - self._turned_at)) <= _TURN_AGAIN_PX
        ):
            return self._rotations
        self._rotations = sums_for(self.frames).attitudes(self.frames, self.model_name, theta)
        # Where the model is not finite there is no reference to keep.
        self._turned_at = theta[:3].copy() if np.isfinite(self._rotations).all() else None
        return self._rotations

    def cost(self, theta: FloatArray) -> float:
        """The objective S(theta)."""
        return self.evaluate(theta).cost

    def evaluate(self, theta: FloatArray) -> Normal:
        """Cost, gradient ``J^T r`` and Gauss-Newton matrix ``J^T J`` over all pairs."""
        return self._evaluate(theta)[0]

    def _evaluate(self, theta: FloatArray, tolerance: float = 0.0) -> tuple[Normal, FloatArray]:
        """As `evaluate`, with the gradient of every frame (p, K).

        The last point is remembered; it serves where a step from there changes the cost by a share
        of `tolerance`.
        """
        theta = np.array(theta, dtype=np.float64)
        if not np.isfinite(theta).all():
            p = self.n_parameters
            return Normal(float("inf"), np.full(p, np.nan), np.full((p, p), np.nan)), np.full(
                (p, 1), np.nan
            )
        if self._last is not None:
            at, normal, _ = self._last
            step = theta - at
            near = tolerance > 0.0 and float(step @ normal.matrix @ step) <= tolerance * normal.cost
            if near or np.array_equal(theta, at):
                return self._last[1:]
        self._last = (theta, *self._sums(theta))
        return self._last[1:]

    def _sums(self, theta: FloatArray) -> tuple[Normal, FloatArray]:
        with np.errstate(all="ignore"):
            cost, matrix, scores = sums_for(self.frames).pairs(
                self.frames, self.model_name, theta, self._turn(theta)
            )
        return Normal(cost, np.sum(scores, axis=1), 0.5 * (matrix + matrix.T)), scores

    def godambe(self, theta: FloatArray, tolerance: float = 0.0) -> FloatArray:
        """Sandwich covariance ``H^-1 V H^-1`` of the estimator that minimises the objective, (p,
        p).

        H is the Gauss-Newton matrix and V the sum over frames of the outer products of their
        gradients (Godambe information): the pairs of a frame are dependent, so that ``H^-1`` alone
        would claim far too little. Not finite where H is singular. The last point that was
        evaluated serves for theta where the cost differs by a share of `tolerance`.
        """
        normal, scores = self._evaluate(theta, tolerance)
        p, k = self.n_parameters, self.frames.n_frames
        if is_singular(normal.matrix):
            return np.full((p, p), np.nan)
        # Scaling first: the entries span thirty orders of magnitude.
        h, scale = unit_inverse(normal.matrix)
        scaled = scores * scale[:, None]
        small_sample = k / max(k - p, 1)
        return small_sample * (h @ scaled @ scaled.T @ h) * np.outer(scale, scale)

    def residuals(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Explicit residuals ``b_i . b_j - r_i . r_j`` (n_pairs,) and their Jacobian (n_pairs, p).

        Meant for small data sets, for MINPACK and for tests: memory grows with the number of pairs.
        """
        b, db = self.directions(theta, self.frames)
        i, j = self.pair_indices()
        r = self.frames.r
        value = np.sum(b[:, i] * b[:, j], axis=0) - np.sum(r[:, i] * r[:, j], axis=0)
        jacobian = np.sum(db[:, :, i] * b[None, :, j] + db[:, :, j] * b[None, :, i], axis=1)
        return value, jacobian.T

    def pair_indices(self) -> tuple[IntArray, IntArray]:
        """Star indices (i, j), i < j, of every pair within a frame."""
        first, second = [], []
        for start, size in zip(self.frames.starts[:-1], self.frames.sizes, strict=True):
            i, j = np.triu_indices(int(size), 1)
            first.append(i + start)
            second.append(j + start)
        return np.concatenate(first), np.concatenate(second)
