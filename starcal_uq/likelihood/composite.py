"""The paper's objective over pairs as a composite likelihood: with the right curvature, and without
it.

Pairs of one frame share stars: the ``m (m - 1) / 2`` differences of interstar cosines of m stars
hold ``2 m - 3`` independent numbers. ``-S / (2 tau^2)``, their log likelihood if they were
independent, has its maximum in the right place and is far too narrow. Ribatet, Cooley & Davison
(2012, "Bayesian inference from composite likelihoods") evaluate it at

    theta* = theta_hat + C (theta - theta_hat),    C^T H C = H V^-1 H,

so that its curvature becomes Godambe's information, with H the sensitivity (Gauss-Newton matrix)
and V the variability (covariance of the score). C is not unique; ours is ``L_H L_G^-1``, from the
lower Cholesky factors of the naive and of Godambe's covariance.

**The noise.** Pairs say nothing about it that is not distorted by their dependence. The adjusted
likelihood therefore takes sigma from the pixel residuals at the best attitudes, with their ``sum_k
(2 m_k - 3)`` degrees of freedom: ``-chi2 / (2 sigma^2) - dof log sigma``. The naive one takes all
pairs at their word, for sigma as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from starcal_uq.camera.projection import backward_root, backward_second_kernel, second_index
from starcal_uq.core.errors import SamplingError
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.compressed import squares_by
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.likelihood.solvers import Normal, is_singular
from starcal_uq.maths.linear import (
    root_diagonal,
    scaled_cholesky,
    scaled_inverse,
    unit_inverse,
    whitened,
)
from starcal_uq.observations.frames import StarFrames

Variability = Literal["auto", "expected", "empirical"]
_Piece: TypeAlias = tuple[StarFrames, FloatArray, FloatArray, FloatArray, FloatArray]

# Explicit pairs formed at once; with two dozen columns and their temporaries about 30 MB.
_PAIRS_AT_ONCE = 20_000
_STARS_AT_ONCE = 4096
# V from K frames has p-dimensional scatter of order sqrt(p / K), more where a few frames hold most
# stars: with fewer frames than this per parameter that would cost more than half a percent of
# coverage, and the model's own V is used.
_FRAMES_PER_PARAMETER = 50
# Largest distance of the given estimate from the minimum, in its own standard deviations.
_OFF_MINIMUM = 0.1


@dataclass(frozen=True)
class PairLikelihood:
    """Composite log likelihood over all pairs of a data set, at a cost independent of the number of
    stars.
    """

    theta_hat: FloatArray  # (p,): estimate that minimises the objective, px units
    # (p, p): covariance of `theta_hat`: Godambe's where `adjusted`, else that of independent pairs.
    covariance: FloatArray
    # (p, p): L_H: from whitened parameters to the point where the objective is evaluated
    shrink: FloatArray
    whitening: FloatArray  # (p, p): L_G where `adjusted`, else L_H
    # (q, q): sum of products of the columns (value, derivatives, half second derivatives) of all
    # pairs over tau^2.
    gram: FloatArray
    tau: float  # Root mean square difference of interstar cosines at the estimate, rad
    # kappa: root mean square standard deviation of a pair's difference for sigma = 1, rad
    pair_noise: float
    sigma: float  # Estimated noise, px, or factor on the stated noise
    chi2: float  # Sum of squared (whitened) pixel residuals at the best attitudes
    dof: int  # Degrees of freedom that sigma is estimated with
    n_pairs: int  # Number of pairs
    adjusted: bool  # False for the naive likelihood
    # Godambe's standard deviations over those of independent pairs, root mean square over the
    # parameters.
    narrowness: float
    # "expected" or "empirical": V from the model (centroid noise through every star), or from the
    # scatter of the frames' scores. The expected one follows sigma; the empirical one knows the
    # scatter already.
    variability: str
    objective: PairObjective = field(repr=False)

    def whiten(self, theta: FloatArray) -> FloatArray:
        """Whitened parameters (n, p): of unit covariance under `covariance`."""
        return whitened(np.atleast_2d(theta) - self.theta_hat, self.whitening)

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray | float) -> FloatArray:
        """Log likelihood (n,) at theta (n, p) and sigma (n,), from the Gram matrix."""
        return self._value(squares_by(self.gram, self.whiten(theta)), sigma)

    def exact_log_likelihood(self, theta: FloatArray, sigma: FloatArray | float) -> FloatArray:
        """The same (n,) from all stars, point by point."""
        points = self.theta_hat + self.whiten(theta) @ self.shrink.T
        return self._value(
            np.array([self.objective.cost(point) for point in points]) / self.tau**2, sigma
        )

    def _value(self, cost: FloatArray, sigma: FloatArray | float) -> FloatArray:
        sigma = np.asarray(sigma, dtype=np.float64)
        if not self.adjusted:
            ratio = self.tau / (self.pair_noise * sigma)
            return np.asarray(-0.5 * cost * ratio**2 - self.n_pairs * np.log(sigma))
        excess = cost - self.gram[0, 0]
        if self.variability == "expected":
            excess = excess * (self.sigma / sigma) ** 2
        return np.asarray(-0.5 * excess - 0.5 * self.chi2 / sigma**2 - self.dof * np.log(sigma))


def pair_likelihood(
    frames: StarFrames,
    model_name: str,
    theta_hat: FloatArray,
    *,
    chi2: float,
    residual_dof: int,
    adjusted: bool = True,
    variability: Variability = "auto",
) -> PairLikelihood:
    """Expand the pair objective around its minimum, the pair estimate `theta_hat` (p,) of a
    calibration, px units.

    `chi2` is the sum of squared (whitened) pixel residuals at an estimate with its best attitudes,
    and `residual_dof` its ``sum_k (2 m_k - 3) - p``. Without `adjusted`, pairs are treated as
    independent, which is wrong. V is found as `variability` says; ``auto`` takes the scatter of the
    frames from 50 frames per parameter on. SamplingError when theta_hat is not a minimum of the
    objective.
    """
    objective = PairObjective(frames, model_name)
    theta_hat = np.array(theta_hat, dtype=np.float64)
    p = len(theta_hat)
    normal = objective.evaluate(theta_hat)
    if not np.isfinite(normal.cost) or is_singular(normal.matrix):
        raise SamplingError(
            "the interstar angles do not determine every parameter at the pair estimate of the "
            "calibration: add "
            "frames, or choose a distortion model with fewer coefficients."
        )
    tau = float(np.sqrt(normal.cost / objective.n_pairs))
    sigma = float(np.sqrt(chi2 / residual_dof))
    naive = scaled_inverse(normal.matrix) * tau**2
    if variability == "auto":
        variability = "empirical" if enough_frames(objective) else "expected"
    godambe = (
        expected_godambe(objective, theta_hat, sigma)
        if variability == "expected"
        else objective.godambe(theta_hat)
    )
    _check_minimum(normal, godambe)
    shrink = scaled_cholesky(naive)
    return PairLikelihood(
        theta_hat=theta_hat,
        covariance=godambe if adjusted else naive,
        shrink=shrink,
        whitening=scaled_cholesky(godambe) if adjusted else shrink,
        gram=_gram(objective, theta_hat, shrink) / tau**2,
        tau=tau,
        pair_noise=_pair_noise(objective, theta_hat),
        sigma=sigma,
        chi2=chi2,
        # A noise that scales the parameters' part as well loses p degrees of freedom to them when
        # they are integrated.
        dof=residual_dof + (p if variability == "expected" else 0),
        n_pairs=objective.n_pairs,
        adjusted=adjusted,
        narrowness=float(np.sqrt(np.mean(np.diag(godambe) / np.diag(naive)))),
        variability=variability,
        objective=objective,
    )


def enough_frames(objective: PairObjective) -> bool:
    """True if the scatter of the frames' scores says enough of its own variability: 50 frames per
    parameter.
    """
    return objective.frames.n_frames >= _FRAMES_PER_PARAMETER * objective.n_parameters


def pair_covariance(
    objective: PairObjective, theta: FloatArray, chi2: float, residual_dof: int, tolerance: float
) -> FloatArray:
    """Covariance (p, p) of the pair estimate: empirical where there are `enough_frames`, else that
    of Gaussian noise.

    With fewer frames than parameters the empirical one is not defined, and with few its intervals
    are too short. `chi2` and `residual_dof` are those of `pair_likelihood`, `tolerance` that of
    `PairObjective.godambe`. Not finite where the pairs do not determine every parameter.
    """
    if enough_frames(objective):
        return objective.godambe(theta, tolerance)
    if not np.isfinite(chi2) or is_singular(objective.evaluate(theta).matrix):
        return np.full((len(theta), len(theta)), np.nan)
    return expected_godambe(objective, theta, float(np.sqrt(chi2 / max(residual_dof, 1))))


def _pieces(objective: PairObjective, theta: FloatArray) -> Iterator[_Piece]:
    """Some frames at a time, directions (3, n) of their stars and derivatives (p, 3, n), noise (n,)
    relative to sigma, and the frame's sum of ``b b^T`` (3, 3, n).
    """
    for first, last in objective.frames.parts(_STARS_AT_ONCE):
        part = objective.frames.part(first, last)
        b, db = objective.directions(theta, part)
        yield part, b, db, part.noise, part.spread(part.sum(b[:, None] * b[None]))


def expected_godambe(objective: PairObjective, theta: FloatArray, sigma: float) -> FloatArray:
    """Sandwich covariance (p, p) with the variability that centroid noise gives the score.

    With ``P_i`` the derivative of a direction with respect to its pixel, the score of a frame
    changes by ``Gamma_i = [(sum_j b_j b_j^T) d b_i + (sum_j b_j d b_j^T) b_i]^T P_i`` per pixel of
    star i, so that ``V = sigma^2 sum_i Gamma_i Gamma_i^T``, with sigma in px or the factor on the
    stated noise. Unlike `PairObjective.godambe` it has no scatter of its own, and it trusts the
    stated noise.
    """
    normal = objective.evaluate(theta)
    h, scale = unit_inverse(normal.matrix)
    v = np.zeros_like(normal.matrix)
    for part, b, db, noise, bb in _pieces(objective, theta):
        cross = part.spread(part.sum(b[None, :, None] * db[:, None]))
        turned = np.einsum("xyn,ayn->axn", bb, db) + np.einsum("axyn,yn->axn", cross, b)
        # A pixel moves b as the principal point does, the other way round.
        gamma = np.einsum("axn,ixn->ain", turned * scale[:, None, None], db[:2]) * (noise * sigma)
        if part.axes is not None:
            gamma = np.einsum("ain,ij->ajn", gamma, np.linalg.cholesky(part.axes))
        flat = gamma.reshape(len(gamma), -1)
        v += flat @ flat.T
    return (h @ v @ h) * np.outer(scale, scale)


def _pair_noise(objective: PairObjective, theta: FloatArray) -> float:
    """Root mean square standard deviation of a pair's difference of cosines at sigma = 1, rad."""
    total = 0.0
    for _, _, db, noise, bb in _pieces(objective, theta):
        # Sum over partners j of |P_i^T b_j|^2; a star with itself adds nothing, because b is a unit
        # vector.
        total += float(
            np.sum(np.einsum("ixn,xyn,iyn->n", db[:2], bb, db[:2], optimize=True) * noise**2)
        )
    return float(np.sqrt(total / objective.n_pairs))


def _gram(objective: PairObjective, theta: FloatArray, whitening: FloatArray) -> FloatArray:
    """Gram matrix (q, q) over the pairs' value, whitened derivatives and halved second derivatives,
    rad^2.
    """
    p = len(theta)
    rows, columns = second_index(p)
    q = 1 + p + len(rows)
    gram = np.zeros((q, q))
    for first, last in objective.frames.parts(_STARS_AT_ONCE):
        part = objective.frames.part(first, last)
        root = backward_root(objective.model_name, theta, part.pixel)
        b, db, second = backward_second_kernel(objective.model_name)(
            part.n_stars, theta, part.pixel, root
        )
        full = np.empty((p, p, 3, part.n_stars))
        full[rows, columns] = full[columns, rows] = second
        d1 = np.tensordot(whitening, db, axes=([0], [0]))
        d2 = np.tensordot(
            whitening, np.tensordot(whitening, full, axes=([0], [0])), axes=([0], [1])
        )[rows, columns]
        i, j = PairObjective(part, objective.model_name).pair_indices()
        for start in range(0, len(i), _PAIRS_AT_ONCE):
            s, t = i[start : start + _PAIRS_AT_ONCE], j[start : start + _PAIRS_AT_ONCE]
            bs, bt, ds, dt = b[:, s], b[:, t], d1[..., s], d1[..., t]
            value = np.sum(bs * bt, axis=0) - np.sum(part.r[:, s] * part.r[:, t], axis=0)
            slope = np.sum(ds * bt + dt * bs, axis=1)
            curve = np.sum(d2[..., s] * bt + d2[..., t] * bs, axis=1)
            curve += np.sum(ds[rows] * dt[columns] + dt[rows] * ds[columns], axis=1)
            # z_a z_b stands for both orders, so that only the diagonal is halved.
            curve[rows == columns] *= 0.5
            stacked = np.concatenate([value[None], slope, curve])
            gram += stacked @ stacked.T
    return 0.5 * (gram + gram.T)


def _check_minimum(normal: Normal, covariance: FloatArray) -> None:
    step = scaled_inverse(normal.matrix) @ normal.gradient
    off = float(np.max(np.abs(step) / root_diagonal(covariance)))
    if not off <= _OFF_MINIMUM:
        raise SamplingError(
            f"the pair estimate of the calibration lies {off:.1f} standard deviations from the "
            "minimum of the pair "
            "objective of these observations: calibrate them again with likelihood='marginal', "
            "without screening."
        )
