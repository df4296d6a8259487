"""Is a star where its frame and the camera say it is? Deleted residuals of stars, and TASTE of
frames.

For every star, in use or not, the prediction is that of the *other* stars in use. With e the
residual of a star in use (whitened, 2 numbers) and H its 2 x 2 block of the hat matrix of attitudes
and camera, its deleted residual is (I - H)^-1 e with covariance sigma^2 (I - H)^-1; for a star that
is not in use, e has covariance sigma^2 (I + H). In both cases

    t = e^T (I -/+ H)^-1 e

is the amount by which the sum of squares changes with that star, and t / sigma^2 is chi-square with
two degrees of freedom. With the noise estimated from all other stars (n degrees of freedom), t / (2
sigma^2) follows F(2, n), whose tail is elementary: P = (1 + t / S)^(-n / 2) with S the sum of
squares of the others (external studentisation; Cook & Weisberg 1982, *Residuals and Influence in
Regression*, chapter 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.projection import unproject_theta
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import BoolArray, FloatArray, IntArray, floats
from starcal_uq.estimation.consensus import MIN_STARS
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import scaled_inverse
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.likelihood.marginal import Profile

# Beyond this distance from its prediction (rad) a star is not compared through the lens model,
# which is only made for the field of view.
_ELSEWHERE_RAD = 0.05
# Noise below a millionth of a pixel is rounding, of which no test holds.
_LEAST_VARIANCE = 1e-12


@dataclass(frozen=True)
class StarResiduals:
    """Every star against the prediction of the others in use; N stars, K frames."""

    # (N,): change of the sum of squares with the star: px^2, or in units of the stated noise.
    # Infinite for a star whose direction is far from where it was measured, NaN in a frame without
    # three stars in use.
    t: FloatArray
    # (N,): distance between measurement and prediction, px (focal length times angle for a
    # direction far away).
    residual_px: FloatArray
    offset_rad: FloatArray  # (N,): angle between them
    frame_cost: FloatArray  # (K,): sum of squares of the stars in use; 0 in a frame without three
    frame_count: IntArray  # (K,): stars in use; 0 in a frame without three
    in_use: BoolArray  # (N,): stars in use in frames with at least three
    dof: int  # Degrees of freedom: ``sum_k (2 m_k - 3) - p``

    @property
    def cost(self) -> float:
        """Sum of squares of all stars in use."""
        return float(np.sum(self.frame_cost))

    def variance(self, shrinkage: float = 1.0) -> float:
        """Noise variance estimated from all stars in use."""
        return float(max(self.cost / max(self.dof, 1), _LEAST_VARIANCE) / shrinkage)

    def studentised(self, shrinkage: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """t over the noise variance estimated from the other stars (N,), and that estimate's
        degrees of freedom (N,).

        Screening has shrunk the variance of the stars in use by `shrinkage` (see
        `truncated_variance`).
        """
        rest = self.cost - np.where(self.in_use, self.t, 0.0)
        dof = np.maximum(self.dof - 2.0 * self.in_use, 1.0)
        statistic: FloatArray = self.t * shrinkage / np.maximum(rest / dof, _LEAST_VARIANCE)
        return statistic, dof

    def robust_variance(self) -> float:
        """Noise variance from the median of t, of which half may be spoilt."""
        return max(float(np.median(self.t[self.in_use]) / (2.0 * np.log(2.0))), _LEAST_VARIANCE)

    def taste(self, shrinkage: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """TASTE of each frame (K,), chi-square with 2m - 3 degrees of freedom, and its p-value
        (K,).

        The noise is estimated from the other frames, so that the p-value is that of an F
        distribution; it is 1 where there is nothing to compare with.
        """
        from scipy.special import fdtrc

        own = np.maximum(2 * self.frame_count - 3, 1)
        rest_dof = self.dof - own
        known = (self.frame_count >= MIN_STARS) & (rest_dof > 0)
        rest = np.where(known, self.cost - self.frame_cost, 1.0)
        variance = np.maximum(rest / np.where(known, rest_dof, 1.0), _LEAST_VARIANCE) / shrinkage
        statistic = self.frame_cost / variance
        p_value = np.where(known, fdtrc(own, np.where(known, rest_dof, 1), statistic / own), 1.0)
        return np.where(known, statistic, np.nan), p_value


def star_threshold(p_value: float, dof: FloatArray | float) -> FloatArray:
    """Value of the studentised statistic that a right star exceeds with probability `p_value`."""
    dof = floats(dof)
    threshold: FloatArray = dof * np.expm1(-2.0 * np.log(p_value) / dof)
    return threshold


def truncated_variance(p_value: float) -> float:
    """Variance per axis of Gaussian noise whose farthest `p_value` share was cut off, as a share of
    the whole.

    The squared distance is chi-square with two degrees of freedom; cut at c = -2 log p its mean is
    2 - c p / (1 - p) in place of 2.
    """
    c = -2.0 * np.log(p_value)
    return float(1.0 - 0.5 * c * p_value / (1.0 - p_value))


def star_residuals(
    frames: StarFrames, model_name: str, theta: FloatArray, in_use: BoolArray
) -> StarResiduals:
    """Compare every star with the prediction of the other stars in use, at the estimate theta (p,)
    from those.

    CalibrationError when no frame has three stars in use, or the stars in use fit no attitude.
    """
    counts: IntArray = np.add.reduceat(in_use.astype(np.int64), frames.starts[:-1])
    active = counts >= MIN_STARS
    rows: BoolArray = np.repeat(active, frames.sizes)
    in_use = in_use & rows
    if not active.any():
        raise CalibrationError(
            "no frame is left with three stars that agree", reason=Status.INCONSISTENT.remedy
        )
    likelihood = MarginalLikelihood(frames.select(in_use), model_name)
    state, cost = likelihood.profile(theta)
    if not np.isfinite(cost):
        raise CalibrationError(
            "the stars in use fit no attitude",
            Status.INCONSISTENT,
            reason=Status.INCONSISTENT.remedy,
        )
    seen = frames.select(rows)
    t, residual, offset = _compare(likelihood, state, seen, theta, in_use[rows])
    n = frames.n_stars
    result = np.full((3, n), np.nan)
    result[:, rows] = t, residual, offset
    frame_cost, frame_count = np.zeros(frames.n_frames), np.where(active, counts, 0)
    frame_cost[active] = likelihood.frames.sum(np.sum(state.e**2, axis=0))
    return StarResiduals(
        result[0],
        result[1],
        result[2],
        frame_cost,
        frame_count,
        in_use,
        likelihood.dof - len(theta),
    )


def _compare(
    likelihood: MarginalLikelihood,
    state: Profile,
    seen: StarFrames,
    theta: FloatArray,
    in_use: BoolArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """t, residual (px) and offset (rad) of every star seen, (n,) each."""
    own, b = MarginalLikelihood(seen, likelihood.model_name), seen.rotated(state.rotations)
    with np.errstate(all="ignore"):
        chord = np.linalg.norm(unproject_theta(own.model_name, theta, seen.pixel.T).T - b, axis=0)
        offset = 2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))
        xy, d_theta, d_phi = own.first(theta, b)
        e = seen.pixel - xy
        seen.whiten(e)
    near = in_use | ((offset < _ELSEWHERE_RAD) & np.isfinite(e).all(axis=0))
    # The values of stars elsewhere are replaced below; here they must only not disturb.
    e, d_theta, d_phi = (np.where(near, value, 0.0) for value in (e, d_theta, d_phi))
    inverse = seen.spread(state.inverse)
    response = seen.spread(likelihood.attitude_response(state, state.slopes))
    g = d_theta - np.einsum("pcn,cxn->pxn", response, d_phi)
    used = g[:, :, in_use].reshape(len(theta), -1)
    normal = used @ used.T
    covariance = scaled_inverse(normal)
    hat = np.einsum("axn,abn,byn->xyn", d_phi, inverse, d_phi, optimize=True)
    hat += np.einsum("pxn,pyn->xyn", np.tensordot(covariance, g, axes=1), g)
    sign = np.where(in_use, -1.0, 1.0)
    xx, yy, xy_ = 1.0 + sign * hat[0, 0], 1.0 + sign * hat[1, 1], sign * hat[0, 1]
    det = xx * yy - xy_ * xy_
    # Without any redundancy the residual is zero as well.
    det = np.where(det > 1e-12, det, np.inf)
    deleted = np.stack([yy * e[0] - xy_ * e[1], xx * e[1] - xy_ * e[0]]) / det
    t = np.sum(e * deleted, axis=0)
    residual = np.hypot(*seen.in_pixels(np.where(in_use, deleted, e)))
    return np.where(near, t, np.inf), np.where(near, residual, offset * theta[2]), offset
