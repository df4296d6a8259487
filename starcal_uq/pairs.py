"""The paper's interstar-angle objective in a time proportional to the number of stars.

``S(theta) = sum_k sum_{i<j} (b_i . b_j - r_i . r_j)^2`` (Ye & Yang 2017, eqs. 5 and 13) is evaluated per frame from
3 x 3 Gram matrices. With B the measured and R' the catalogue unit vectors rotated to the camera frame, E = B - R' is
small, and every term below is formed from E, so that nothing cancels:

    B B^T - R' R'^T = R' E^T + E R'^T + E E^T.
"""

from __future__ import annotations

import numpy as np

from starcal_uq._types import FloatArray
from starcal_uq.distortion import get_model
from starcal_uq.frames import StarFrames
from starcal_uq.projection import backward_kernel, backward_root
from starcal_uq.quest import quest
from starcal_uq.solvers import Normal


def _gram(frames: StarFrames, a: FloatArray, b: FloatArray) -> FloatArray:
    """Per-frame 3 x 3 matrices ``A^T B`` of two stacks of vectors (3, N): (3, 3, K)."""
    return frames.sum(a[:, None, :] * b[None, :, :])


def _apply(stars: FloatArray, matrix: FloatArray) -> FloatArray:
    """Every star's vector (3, N) times its frame's matrix (3, 3, N): the rows of ``A M``."""
    return np.einsum("in,ijn->jn", stars, matrix)


class PairObjective:
    """Sum of squared differences of interstar cosines over all pairs of a frame and all frames.

    Parameters
    ----------
    frames : StarFrames
        Data.
    model_name : str
        Distortion model. Per-star weights are not used: the paper's objective has none.
    fixed : (q,) array, optional
        Trailing parameters held fixed (the distortion coefficients in stage 1); `evaluate` then takes the rest.
    """

    def __init__(self, frames: StarFrames, model_name: str, fixed: FloatArray | None = None) -> None:
        self.frames = frames
        self.model_name = model_name
        self.fixed = np.zeros(0) if fixed is None else np.asarray(fixed, dtype=np.float64)
        self.n_parameters = 3 + len(get_model(model_name).coefficients) - len(self.fixed)

    @property
    def n_pairs(self) -> int:
        """Number of star pairs."""
        m = self.frames.sizes
        return int(np.sum(m * (m - 1) // 2))

    def directions(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Measured unit vectors (3, N) and their derivatives (p, 3, N)."""
        full = np.concatenate([theta, self.fixed])
        root = backward_root(self.model_name, full, self.frames.pixel)
        b, db = backward_kernel(self.model_name, True)(self.frames.n_stars, full, self.frames.pixel, root)
        return b, db[: self.n_parameters]

    def _parts(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Cost per frame (K,), residual vectors D B (3, N), derivatives db (p, 3, N) and B (3, N)."""
        frames = self.frames
        b, db = self.directions(theta)
        # Any rotation is exact; the best one makes E as small as the noise.
        rotations = quest(b.T, frames.r.T, frames.starts).rotations
        catalogue = frames.rotated(rotations)
        e = b - catalogue
        ee, rr, re = _gram(frames, e, e), _gram(frames, catalogue, catalogue), _gram(frames, catalogue, e)
        cost = (
            np.sum(ee * rr, axis=(0, 1))
            + np.sum(re * re.transpose(1, 0, 2), axis=(0, 1))
            + 2.0 * np.sum(ee * re, axis=(0, 1))
            + 0.5 * np.sum(ee * ee, axis=(0, 1))
        )
        # D B = R' (E^T B) + E (R'^T B) + E (E^T B), with B = R' + E.
        eb = re.transpose(1, 0, 2) + ee
        rb = rr + re
        d_b = _apply(catalogue, frames.spread(eb)) + _apply(e, frames.spread(rb + eb))
        return cost, d_b, db, b

    def cost(self, theta: FloatArray) -> float:
        """The objective S(theta)."""
        return float(np.sum(self._parts(theta)[0]))

    def evaluate(self, theta: FloatArray) -> Normal:
        """Cost, gradient ``J^T r`` and Gauss-Newton matrix ``J^T J`` over all pairs."""
        with np.errstate(all="ignore"):
            cost, d_b, db, b = self._parts(theta)
            frames = self.frames
            p, n = self.n_parameters, frames.n_stars
            gradient = np.tensordot(db, d_b, axes=([1, 2], [0, 1]))
            gram_b = frames.spread(_gram(frames, b, b))
            first = np.einsum("pin,ijn->pjn", db, gram_b)
            matrix = first.reshape(p, 3 * n) @ db.reshape(p, 3 * n).T
            cross = frames.sum(b[:, None, None, :] * db.transpose(1, 0, 2)[None])  # (3, 3, p, K)
            matrix += np.einsum("ijpk,jiqk->pq", cross, cross)
        return Normal(float(np.sum(cost)), gradient, 0.5 * (matrix + matrix.T))

    def godambe(self, theta: FloatArray) -> FloatArray:
        """Sandwich covariance ``H^-1 V H^-1`` of the estimator that minimises the objective, (p, p).

        H is the Gauss-Newton matrix and V the sum over frames of the outer products of their gradients (Godambe
        information): the pairs of a frame are dependent, so that ``H^-1`` alone would claim far too little.
        """
        normal = self.evaluate(theta)
        _, d_b, db, _ = self._parts(theta)
        scores = self.frames.sum(np.sum(db * d_b[None], axis=1))
        # Scaling first: the entries span thirty orders of magnitude.
        scale = 1.0 / np.sqrt(np.diag(normal.matrix))
        h = np.linalg.inv(normal.matrix * np.outer(scale, scale))
        v = (scores * scale[:, None]) @ (scores * scale[:, None]).T
        k = self.frames.n_frames
        small_sample = k / max(k - self.n_parameters, 1)
        return small_sample * (h @ v @ h) * np.outer(scale, scale)

    def residuals(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Explicit residuals ``b_i . b_j - r_i . r_j`` (n_pairs,) and their Jacobian (n_pairs, p).

        Meant for small data sets, for MINPACK and for tests: memory grows with the number of pairs.
        """
        b, db = self.directions(theta)
        i, j = self.pair_indices()
        r = self.frames.r
        value = np.sum(b[:, i] * b[:, j], axis=0) - np.sum(r[:, i] * r[:, j], axis=0)
        jacobian = np.sum(db[:, :, i] * b[None, :, j] + db[:, :, j] * b[None, :, i], axis=1)
        return value, jacobian.T

    def pair_indices(self) -> tuple[FloatArray, FloatArray]:
        """Star indices (i, j), i < j, of every pair within a frame."""
        first, second = [], []
        for start, size in zip(self.frames.starts[:-1], self.frames.sizes, strict=True):
            i, j = np.triu_indices(int(size), 1)
            first.append(i + start)
            second.append(j + start)
        return np.concatenate(first), np.concatenate(second)
