"""What each frame says about the parameters: its normal equations with its attitude eliminated.

Everything that leaves one frame out, or adds one, follows from these small matrices to first order, without another
fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.estimation.marginal import MarginalLikelihood

if TYPE_CHECKING:
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.table import Observations

_STARS_AT_ONCE = 20_000


@dataclass(frozen=True)
class FrameNormals:
    """Normal equations of every frame in scaled parameters ``z = (theta - theta_hat) / scale``.

    At a small step z the sum of squares of frame k is ``squares - 2 slopes . z + z . matrices z``.

    Attributes
    ----------
    theta : (p,) array
        Point of expansion, px units.
    scale : (p,) array
        Unit of each parameter: its standard deviation with the others known, per unit of noise.
    matrices : (K, p, p) array
        Gauss-Newton matrix.
    slopes : (K, p) array
        Minus half the gradient.
    squares : (K,) array
        Sum of squared whitened residuals.
    log_determinant : (K,) array
        log |A^T A| of the attitude columns.
    rotations : (K, 3, 3) array
        Best attitudes.
    dof : (K,) array of int
        Independent numbers ``2 m_k - 3``.
    """

    theta: FloatArray
    scale: FloatArray
    matrices: FloatArray
    slopes: FloatArray
    squares: FloatArray
    log_determinant: FloatArray
    rotations: FloatArray
    dof: IntArray

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
        likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        start = quaternion_to_rotation(cal.quaternions)
        matrices, slopes, squares, volumes, rotations = [], [], [], [], []
        for first, last in likelihood.frames.parts(_STARS_AT_ONCE):
            part = MarginalLikelihood(likelihood.frames.part(first, last), likelihood.model_name)
            state, _ = part.profile(cal.theta, start[first:last])
            h = part.project_out(state, part.derivatives(cal.theta, state))
            matrices.append(np.moveaxis(part.frames.sum(np.einsum("axn,bxn->abn", h, h)), 2, 0))
            slopes.append(part.frames.sum(np.sum(h * state.e, axis=1)).T)
            squares.append(part.frames.sum(np.sum(state.e**2, axis=0)))
            volumes.append(state.log_determinant)
            rotations.append(state.rotations)
        matrix = np.concatenate(matrices)
        scale = 1.0 / np.sqrt(np.einsum("kaa->a", matrix))
        return cls(
            theta=cal.theta,
            scale=scale,
            matrices=matrix * np.outer(scale, scale),
            slopes=np.concatenate(slopes) * scale,
            squares=np.concatenate(squares),
            log_determinant=np.concatenate(volumes),
            rotations=np.concatenate(rotations),
            dof=2 * likelihood.frames.sizes - 3,
        )

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Estimates z (K, p) without each frame, and the matrices (K, p, p) of the remaining ones.

        A frame without which the parameters are not determined gives rows that are not finite.
        """
        rest = self.matrix - self.matrices
        slope = self.slopes.sum(axis=0) - self.slopes
        determined = np.linalg.cond(rest) < 1e14
        steps = np.full(self.slopes.shape, np.nan)
        steps[determined] = np.linalg.solve(rest[determined], slope[determined][..., None])[..., 0]
        return steps, rest
