"""The attitude-marginalised Gaussian likelihood of star positions.

Each frame's attitude has a flat prior on rotations and is integrated out by Laplace's method around
its best value:

    log L(theta, sigma) = sum_k [ -S_k(theta) / (2 sigma^2) - (2 m_k - 3) log sigma - 1/2 log |A_k^T
    A_k| ],

where S_k is the sum of squared (whitened) residuals at the frame's best attitude and A_k the
derivative of its pixels with respect to that attitude. The information on theta is the Schur
complement of the attitudes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera.projection import forward_kernel, forward_root
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.arrays import BLOCK_STARS
from starcal_uq.likelihood.elimination import ByFrame, products_by_frame
from starcal_uq.likelihood.paths import path_of, sums_for
from starcal_uq.likelihood.solvers import Normal
from starcal_uq.likelihood.sums import (
    ATTITUDE_STEPS,
    ATTITUDE_TOLERANCE_RAD,
    Attitudes,
    NormalSums,
    settled_sums,
)
from starcal_uq.maths.linear import COLUMNS, ROWS, inverse_symmetric
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Attitudes that are wrong by this much cost a likelihood nothing that is left after their
# elimination to first order.
TURN_RAD = 1e-8
# The same of a table of a few hundred stars, whose likelihood is then known to 1e-5.
_NEAR_RAD = 1e-6


@dataclass(frozen=True)
class Profile:
    """The model at the best attitude of every frame."""

    rotations: FloatArray  # (K, 3, 3): R_cam_icrs
    b: FloatArray  # (3, N): catalogue directions in the camera frame
    # (2, N): residuals, observed minus predicted, divided by the stated noise where there is one;
    # what little the attitudes could still explain is taken off
    e: FloatArray
    # (3, 2, N): derivative of the (whitened) prediction with respect to the frame's rotation
    # vector.
    attitude: FloatArray
    # (p, 2, N): derivatives of the (whitened) prediction with respect to theta at fixed attitudes
    slopes: FloatArray
    inverse: FloatArray  # (3, 3, K): inverse of A^T A per frame
    log_determinant: FloatArray  # (K,): log |A^T A|

    def shifts(self, moves: FloatArray) -> FloatArray:
        """Whitened shifts (..., 2, N) of images by small moves (..., 3, N) of the stars, camera
        frame, rad: a move d of a direction b is the rotation ``b x d``.
        """
        turns = np.cross(self.b, moves, axis=-2)
        return np.asarray(np.einsum("ixn,...in->...xn", self.attitude, turns))


class MarginalLikelihood:
    """Exact attitude-marginalised likelihood of a table of observations.

    `rotations` (K, 3, 3): where attitude searches start; QUEST's by default.
    """

    def __init__(
        self,
        obs: Observations | StarFrames,
        model_name: str,
        rotations: FloatArray | None = None,
    ) -> None:
        self.frames = obs if isinstance(obs, StarFrames) else StarFrames.from_observations(obs)
        self.model_name, self._rotations = model_name, rotations
        self._last: tuple[NormalSums, Attitudes] | None = None

    @property
    def dof(self) -> int:
        """Independent numbers in the data after the attitudes: ``sum_k (2 m_k - 3)``."""
        return 2 * self.frames.n_informed - 3 * self.frames.n_frames

    @property
    def kernels(self) -> str:
        """``numpy`` or ``numba``: what sums over all frames are made with."""
        return path_of(self.frames)

    def start_rotations(self, theta: FloatArray) -> FloatArray:
        """Attitudes (K, 3, 3) by QUEST at theta."""
        weight = self.frames.weight
        weight = None if weight is None else weight**2
        return sums_for(self.frames).attitudes(self.frames, self.model_name, theta, weight)

    def profile(
        self,
        theta: FloatArray,
        rotations: FloatArray | None = None,
        tolerance: float = ATTITUDE_TOLERANCE_RAD,
    ) -> tuple[Profile, float]:
        """The model at the best attitudes for theta (p,), px units, searched from `rotations` (K,
        3, 3) or QUEST's.

        With `rotations`, theta may be that of every star, (p, N). Attitudes are the best ones to
        `tolerance`, rad. The second value is the sum of squared whitened residuals S(theta);
        infinite when the model is not finite, or stars fit no attitude.
        """
        theta, frames = np.asarray(theta, dtype=np.float64), self.frames
        with np.errstate(all="ignore"):
            if rotations is None:
                rotations = self.start_rotations(theta)
            for _ in range(ATTITUDE_STEPS):
                b = frames.rotated(rotations)
                xy, h, a = self.first(theta, b)
                e = frames.pixel - xy
                frames.whiten(e)
                inverse, determinant = _inverse(frames, a)
                slope = frames.sum(np.einsum("ixn,xn->in", a, e))
                turn = np.einsum("ijk,jk->ik", inverse, slope)
                e -= np.einsum("ixn,in->xn", a, frames.spread(turn))
                state = Profile(rotations, b, e, a, h, inverse, np.log(determinant))
                cost = float(np.sum(e * e))
                if not np.isfinite(cost):
                    break
                if np.max(np.abs(turn), initial=0.0) < tolerance:
                    return state, cost
                rotations = exp_rotation(turn.T) @ rotations
        return state, float("inf")

    @property
    def rotations(self) -> FloatArray | None:
        """Where attitude searches start, (K, 3, 3), if that was said."""
        if self._rotations is None and self._last is not None:
            attitudes = self._last[1]
            self._rotations = attitudes.at(attitudes.theta)
        return self._rotations

    def use_rotations(self, rotations: FloatArray) -> None:
        """Start later attitude searches here, which saves QUEST when theta moves little."""
        self._rotations, self._last = rotations, None

    @property
    def last_sums(self) -> tuple[NormalSums, Attitudes] | None:
        """What `use_sums` was told."""
        return self._last

    def use_sums(self, sums: NormalSums, attitudes: Attitudes) -> None:
        """Start later attitude searches from those that follow from these sums, and take them for
        settled if they are.

        `sums` and `attitudes` are those of all frames at one point, as
        `starcal_uq.likelihood.sums.frame_sums` gives them.
        """
        self._rotations, self._last = None, (sums, attitudes)

    def log_likelihood(self, theta: FloatArray, sigma: float) -> float:
        """Log likelihood at theta (p,) and sigma (px, or the common factor on stated noise)."""
        sums, _ = self.sums(theta, tolerance=TURN_RAD)
        if not np.isfinite(sums.cost):
            return -np.inf
        return float(
            -0.5 * sums.cost / sigma**2 - self.dof * np.log(sigma) - 0.5 * sums.log_determinant
        )

    def by_frame(self, theta: FloatArray, sigma: float) -> FloatArray:
        """Log likelihood (K,) of each frame at theta (p,)."""
        frames = self.frames
        sums, attitudes = self.sums(theta)
        if not np.isfinite(sums.cost):
            return np.full(frames.n_frames, -np.inf)
        squares = frames.sum(np.sum(self.residuals(theta, attitudes.rotations) ** 2, axis=0))
        dof = 2.0 * frames.informed - 3.0
        volume = attitudes.log_determinant
        return np.asarray(-0.5 * squares / sigma**2 - dof * np.log(sigma) - 0.5 * volume)

    def log_likelihoods(self, theta: FloatArray, sigma: FloatArray) -> FloatArray:
        """Log likelihood (n,) at theta (n, p) and sigma (n,), many points of a small table at a
        time.

        A pass over a few hundred stars spends its time between the arrays: the table is repeated
        for as many points as fill a block, and attitudes start from those that follow from the last
        sums.
        """
        frames, last = self.frames, self._last
        together = BLOCK_STARS // frames.n_stars
        if last is None or together < 2:
            return np.array(
                [self.log_likelihood(t, float(s)) for t, s in zip(theta, sigma, strict=True)]
            )
        values = np.empty(len(theta))
        for first in range(0, len(theta), together):
            some = slice(first, min(first + together, len(theta)))
            points = theta[some]
            n = len(points)
            rotations = np.concatenate([last[1].at(point) for point in points])
            copies = MarginalLikelihood(StarFrames.joined([frames] * n), self.model_name)
            own = np.repeat(points.T, frames.n_stars, axis=1)
            state, cost = copies.profile(own, rotations, _NEAR_RAD)
            if not np.isfinite(cost):
                # One point without attitudes leaves those of the others unsettled.
                values[some] = [
                    self.log_likelihood(t, float(s))
                    for t, s in zip(points, sigma[some], strict=True)
                ]
                continue
            left = copies.project_out(state, state.e[None])[0]
            squares = np.sum(left**2, axis=0).reshape(n, -1).sum(axis=1)
            volume = state.log_determinant.reshape(n, -1).sum(axis=1)
            values[some] = (
                -0.5 * squares / sigma[some] ** 2 - self.dof * np.log(sigma[some]) - 0.5 * volume
            )
        return values

    def first(self, theta: FloatArray, b: FloatArray) -> list[FloatArray]:
        """Pixels (2, N) and their whitened derivatives by theta (p, 2, N) and by the frame's rotation
        (3, 2, N).
        """
        kernel, root = forward_kernel(self.model_name, "first"), forward_root
        xy, h, a = kernel(self.frames.n_stars, theta, b, root(self.model_name, theta, b))
        self.frames.whiten(h)
        self.frames.whiten(a)
        return [xy, h, a]

    def residuals(self, theta: FloatArray, rotations: FloatArray) -> FloatArray:
        """Whitened residuals (2, N), observed minus predicted, at theta (p,) and attitudes (K, 3,
        3).
        """
        frames, kernel, e = self.frames, forward_kernel(self.model_name, "value"), []
        for first, last in frames.parts(BLOCK_STARS):
            part = frames.part(first, last)
            b = part.rotated(rotations[first:last])
            (xy,) = kernel(part.n_stars, theta, b, forward_root(self.model_name, theta, b))
            e.append(part.pixel - xy)
        found = np.concatenate(e, axis=1)
        frames.whiten(found)
        return found

    def attitudes(self, state: Profile) -> ByFrame:
        """The frames' rotations, which are eliminated."""
        return ByFrame(self.frames, state.attitude, state.inverse)

    def attitude_response(self, state: Profile, columns: FloatArray) -> FloatArray:
        """Least-squares rotation vectors (q, 3, K) that reproduce columns (q, 2, N) of pixel
        shifts.
        """
        return self.attitudes(state).coefficients(columns)

    def project_out(self, state: Profile, columns: FloatArray) -> FloatArray:
        """Remove from columns (q, 2, N) what a rotation of each frame can reproduce."""
        return self.attitudes(state).removed_from(columns)

    def slopes(self, state: Profile) -> FloatArray:
        """Slopes of a state, (p, 2, N), without what a rotation of each frame can reproduce."""
        return self.project_out(state, state.slopes)

    def linearised(
        self,
        theta: FloatArray,
        scale: FloatArray,
        rotations: FloatArray | None,
        max_stars: int,
    ) -> Iterator[tuple[MarginalLikelihood, Profile, FloatArray, slice]]:
        """As `pieces`, with the columns (p + 1, 2, n) of the parameters in units of `scale` (p,) and
        of the residuals, attitudes projected out.
        """
        for part, state, rows in self.pieces(theta, rotations, max_stars):
            h = part.slopes(state) * scale[:, None, None]
            yield part, state, np.concatenate([h, state.e[None]]), rows

    def pieces(
        self, theta: FloatArray, rotations: FloatArray | None, max_stars: int
    ) -> Iterator[tuple[MarginalLikelihood, Profile, slice]]:
        """Some frames at a time: their likelihood, the model at theta (p,), and the rows of their
        stars.

        Attitudes are searched from `rotations` (K, 3, 3), or as those of `sums`.
        """
        if rotations is None:
            rotations = self.sums(theta)[1].at(theta)
        for first, last in self.frames.parts(max_stars):
            yield self.piece(theta, rotations, first, last)

    def piece(
        self, theta: FloatArray, rotations: FloatArray, first: int, last: int
    ) -> tuple[MarginalLikelihood, Profile, slice]:
        """Frames from `first` up to `last`, as `pieces` gives them; attitudes are searched from
        `rotations` (K, 3, 3) of all.
        """
        part = MarginalLikelihood(self.frames.part(first, last), self.model_name)
        state, _ = part.profile(theta, rotations[first:last])
        return part, state, slice(int(self.frames.starts[first]), int(self.frames.starts[last]))

    def frame_normals(
        self, theta: FloatArray, rotations: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations of every single frame at its best attitude, searched from `rotations` (K,
        3, 3) or as those of `sums`.

        Returns products (K, p + 1, p + 1) of H and e without what the frame's attitude can
        reproduce, log |A^T A| (K,) and the attitudes (K, 3, 3).
        """
        found = [
            (products_by_frame(part.frames, own, own), state.log_determinant, state.rotations)
            for part, state, own, _ in self.linearised(
                theta, np.ones(len(theta)), rotations, BLOCK_STARS
            )
        ]
        gram, volume, rotations = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return gram, volume, rotations

    def whitened(self, state: Profile, columns: FloatArray) -> FloatArray:
        """Turn columns (q, 2, N) into (q, m) with products by the covariance of the data, attitudes
        eliminated.
        """
        return self.project_out(state, columns).reshape(len(columns), -1)

    def slope(self, theta: FloatArray, sigma: float, near: Attitudes) -> FloatArray:
        """Slope (p,) of minus the log likelihood at theta (p,), times ``sigma**2``; attitudes follow
        from `near`.
        """
        inverse = sigma**2 * near.inverse
        return sums_for(self.frames).slope(
            self.frames, self.model_name, theta, near.at(theta), near.response, inverse
        )

    def evaluate(self, theta: FloatArray) -> Normal:
        """Cost S, gradient and Gauss-Newton matrix with the attitudes eliminated (variable
        projection).
        """
        return self.sums(theta)[0].normal

    def sums(
        self, theta: FloatArray, tolerance: float = ATTITUDE_TOLERANCE_RAD
    ) -> tuple[NormalSums, Attitudes]:
        """Normal equations and attitudes at theta, searched from where they were last, from
        `rotations` or by QUEST.

        Attitudes are the best ones to `tolerance` (rad), and the sums those of the best ones to
        first order.
        """
        theta = np.asarray(theta, dtype=np.float64)
        if self._last is not None:
            sums, attitudes = self._last
            if sums.turn < tolerance and np.array_equal(theta, attitudes.theta):
                return self._last
            rotations = attitudes.at(theta)
        else:
            rotations = self.start_rotations(theta) if self._rotations is None else self._rotations
        return settled_sums(self.frames, self.model_name, theta, rotations, tolerance)


def _inverse(frames: StarFrames, a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse (3, 3, K) of A^T A of each frame for A (3, 2, N), and its determinant (K,)."""
    return inverse_symmetric(frames.sum(np.einsum("ixn,jxn->ijn", a, a))[ROWS, COLUMNS])
