"""What each frame, or each star, says about the parameters: normal equations with the attitudes
eliminated.

Everything that leaves one of them out, or adds one, follows from these small matrices to first
order, without another fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.estimation.residual_map import FrameScatter
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import star_term
from starcal_uq.likelihood.terms import add_by_group
from starcal_uq.maths.linear import unit_diagonal, without_first
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

_STARS_AT_ONCE = 20_000
# Condition of normal equations that determine nothing any more.
_WORST = 1e14


@dataclass(frozen=True)
class FrameNormals:
    """Normal equations of every frame in scaled parameters ``z = (theta - theta_hat) / scale``.

    At a small step z the sum of squares of frame k is ``squares - 2 slopes . z + z . matrices z``.
    """

    theta: FloatArray  # (p,): point of expansion, px units
    # (p,): unit of each parameter: its standard deviation with the others known, per unit of noise
    scale: FloatArray
    matrices: FloatArray  # (K, p, p): Gauss-Newton matrix
    slopes: FloatArray  # (K, p): minus half the gradient
    squares: FloatArray  # (K,): sum of squared whitened residuals
    log_determinant: FloatArray  # (K,): log |A^T A| of the attitude columns
    rotations: FloatArray  # (K, 3, 3): best attitudes
    dof: IntArray  # (K,): independent numbers ``2 m_k - 3``

    @property
    def matrix(self) -> FloatArray:
        """Sum of `matrices` (p, p)."""
        return np.asarray(self.matrices.sum(axis=0))

    @property
    def variance(self) -> float:
        """Noise variance after the fit."""
        return float(np.sum(self.squares) / (np.sum(self.dof) - len(self.theta)))

    @classmethod
    def at(cls, obs: Observations, cal: Calibration) -> FrameNormals:
        """Normal equations at the estimate of a calibration."""
        return cls.around(obs, cal.camera.distortion, cal.theta, cal.rotations)

    @classmethod
    def around(
        cls,
        obs: Observations | StarFrames,
        model: str,
        theta: FloatArray,
        start: FloatArray | None = None,
        scale: FloatArray | None = None,
    ) -> FrameNormals:
        """Normal equations of a distortion model at theta (p,), attitudes searched from `start` (K,
        3, 3) or QUEST's.
        """
        likelihood = MarginalLikelihood(obs, model)
        found = likelihood.frame_normals(theta, start)
        return cls.of(theta, *found, 2 * likelihood.frames.sizes - 3, scale)

    @classmethod
    def beside(
        cls,
        exact: EffectLikelihood,
        theta: FloatArray,
        scale: FloatArray | None = None,
    ) -> FrameNormals:
        """Normal equations at theta (p,) beside effects.

        Those of frames are marginalised in each; those of the run and of stars, which frames share,
        are at their best.
        """
        state, _ = exact.profile(theta, exact.rotations)
        _, found = exact.conditioned(state, state.e[None])
        shared = exact.shifts(state, replace(found, frame=0.0 * found.frame))
        e = exact.project_out(state, state.e[None]) - shared
        columns = np.concatenate([exact.slopes(state), e])
        gram = products_by_frame(exact.frames, columns, columns)
        cross = products_by_frame(exact.frames, exact.columns.frame, columns)
        solved = exact.solved
        left = solved.frame_root[:, :, None] * (np.swapaxes(solved.frame_vectors, 1, 2) @ cross)
        gram -= np.swapaxes(left, 1, 2) @ left
        dof = 2 * exact.frames.sizes - 3
        return cls.of(theta, gram, state.log_determinant, state.rotations, dof, scale)

    @classmethod
    def of(
        cls,
        theta: FloatArray,
        gram: FloatArray,
        log_determinant: FloatArray,
        rotations: FloatArray,
        dof: IntArray,
        scale: FloatArray | None = None,
    ) -> FrameNormals:
        """Normal equations from the products (K, p + 1, p + 1) of parameters and residuals."""
        matrix = gram[:, :-1, :-1]
        scale = 1.0 / np.sqrt(np.einsum("kaa->a", matrix)) if scale is None else scale
        return cls(
            theta=theta,
            scale=scale,
            matrices=matrix * np.outer(scale, scale),
            slopes=gram[:, -1, :-1] * scale,
            squares=gram[:, -1, -1],
            log_determinant=log_determinant,
            rotations=rotations,
            dof=dof,
        )

    def scatter(self, whole: tuple[FloatArray, FloatArray] | None = None) -> FrameScatter:
        """How these frames scatter about the estimate; `whole` are matrix and slope of all, where
        they are a part.

        All of it needs only H_k, H and the slopes. Not finite where a frame alone determines a
        parameter.
        """
        matrix, slope = (self.matrix, self.slopes.sum(axis=0)) if whole is None else whole
        root = np.linalg.inv(np.linalg.cholesky(matrix))
        shares = root @ self.matrices @ root.T
        values, vectors = np.linalg.eigh(shares)
        free = 1.0 - values
        free = np.where(free > 1e-10, free, np.nan)
        adjust = np.einsum("kab,kb,kcb->kac", vectors, free**-0.5, vectors)
        left = (self.slopes - self.matrices @ np.linalg.solve(matrix, slope)) @ root.T
        # Columns of `root` are the whitened parameters; their pull on frame k, adjusted, before and
        # after its share.
        pull = np.einsum("kab,bj->kja", adjust, root)
        own = np.einsum("kab,kjb->kja", shares, pull)
        scores = np.einsum("kja,ka->kj", pull, left)
        # Covariance of the scores between frames: a diagonal less `own own^T`, for each parameter.
        diagonal, size = np.sum(pull * own, axis=2), np.sum(own**2, axis=2)
        # Steps to the estimates without a frame, and ones.
        steps = (
            np.einsum(
                "kab,kb,kcb,kc->ka", vectors, 1.0 / free, vectors, (slope - self.slopes) @ root.T
            )
            @ root
        )
        steps = np.concatenate([np.ones((len(steps), 1)), steps], axis=1)
        return FrameScatter(
            theta=self.theta,
            scale=self.scale,
            matrix=self.matrix,
            squares=float(np.sum(self.squares)),
            n_frames=len(self.dof),
            dof=int(np.sum(self.dof)),
            steps=steps.T @ steps,
            scores=scores.T @ scores,
            powers=np.array(
                [np.sum(diagonal**n - n * diagonal ** (n - 1) * size, axis=0) for n in (1, 2, 3)]
            ),
            inner=np.einsum("kja,kjb->jab", own, own),
            middle=np.einsum("kj,kja,kjb->jab", diagonal, own, own),
        )

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Estimates z (K, p) without each frame, and the matrices (K, p, p) of the remaining ones.

        A frame without which the parameters are not determined gives rows that are not finite.
        """
        return _steps(self.matrix, self.matrices, self.slopes.sum(axis=0) - self.slopes)


@dataclass(frozen=True)
class StarNormals:
    """What each of S stars says about the parameters through all of its images, in scaled
    parameters z.
    """

    scale: FloatArray  # (p,): unit of each parameter, as in `FrameNormals`
    matrix: FloatArray  # (p, p): Gauss-Newton matrix of all stars
    squares: float  # Sum of squared whitened residuals after the fit
    scores: FloatArray  # (S, p): share of the slope at the estimate; they sum to nothing
    # `matrices`, `slopes`, (S, p, p) and (S, p): what the normal equations lose without a star, the
    # attitudes of its frames fitted again.
    matrices: FloatArray
    slopes: FloatArray
    # (S, 2, p): change of the slope by one px of offset of the star along each of its axes
    response: FloatArray
    of_images: FloatArray  # (p, p): products of the same of every image, summed up
    dof: int  # Degrees of freedom after the fit

    @classmethod
    def at(cls, obs: Observations, cal: Calibration, numbers: IntArray) -> StarNormals:
        """Sums over the stars that `numbers` (N,) tells apart, at the estimate of a calibration."""
        likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        frames, p = likelihood.frames, len(cal.theta)
        term = star_term(numbers, frames.r, float(cal.theta[2]))
        start, gram = cal.rotations, np.zeros((p + 1, p + 1))
        s = term.n_groups
        scores, slopes, matrices = np.zeros((s, p)), np.zeros((s, p)), np.zeros((s, p, p))
        response, of_images = np.zeros((s, 2, p)), np.zeros((p, p))
        for part, state, columns, rows in likelihood.linearised(
            cal.theta, cal.sigmas, start, _STARS_AT_ONCE
        ):
            h, flat, stars = columns[:p], columns.reshape(p + 1, -1), numbers[rows]
            gram += flat @ flat.T
            z = term.columns(part, state, rows)
            add_by_group(scores, np.sum(h * state.e, axis=1), stars)
            own = np.einsum("ixn,pxn->ipn", z, h)
            add_by_group(response, own, stars)
            of_images += np.tensordot(own, own, axes=((0, 2), (0, 2)))
            # I - a (A^T A)^-1 a^T of every image, inverted: what its own pull on the attitude has
            # hidden.
            a = part.attitudes(state).orthonormal
            (xx, xy), (yx, yy) = np.eye(2)[:, :, None] - np.einsum("axn,ayn->xyn", a, a)
            raised = np.stack([yy * h[:, 0] - xy * h[:, 1], xx * h[:, 1] - yx * h[:, 0]], axis=1)
            raised /= xx * yy - xy * yx
            add_by_group(slopes, np.sum(raised * state.e, axis=1), stars)
            add_by_group(matrices, np.einsum("axn,bxn->abn", raised, h), stars)
        matrix, unit = unit_diagonal(gram[:p, :p])
        return cls(
            scale=cal.sigmas * unit,
            matrix=matrix,
            squares=float(without_first(gram, p, 0.0, unit)[0][0, 0]),
            scores=scores * unit,
            matrices=matrices * np.outer(unit, unit),
            slopes=slopes * unit,
            response=response * unit,
            of_images=of_images * np.outer(unit, unit),
            dof=likelihood.dof - p,
        )

    def left_out(self) -> FloatArray:
        """Changes z (S, p) of the estimate without each star, not finite where the parameters hang
        on it.
        """
        return _steps(self.matrix, self.matrices, -self.slopes)[0]


def _steps(
    matrix: FloatArray, parts: FloatArray, slopes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solutions (n, p) of normal equations less one of the parts (n, p, p) of their matrix (p, p),
    NaN where these determine none, and the matrices (n, p, p).
    """
    rest = matrix - parts
    # Whitened by the matrix, a part has no eigenvalue above its trace.
    share = np.einsum("kab,ba->k", parts, np.linalg.inv(matrix))
    determined = np.linalg.cond(matrix) < _WORST * (1.0 - share)
    determined[~determined] = np.linalg.cond(rest[~determined]) < _WORST
    steps = np.full(slopes.shape, np.nan)
    steps[determined] = np.linalg.solve(rest[determined], slopes[determined, :, None])[..., 0]
    return steps, rest
