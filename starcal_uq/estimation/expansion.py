"""Compressed likelihoods around another point: exact, because a quadratic stays one under an affine map.

With ``theta = theta_a + L_a z_a = theta_b + L_b z_b`` the old coordinates are ``z_a = c + A z_b``. Then the monomials
map by one matrix, ``m(z_a) = T m(z_b)``, and ``G_b = T^T G_a T``; the linear term of the log determinant follows
likewise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.compressed import CompressedLikelihood

_STEPS = 50
_HALVINGS = 20
# A further Newton step would gain less than this, nat: the optimum is then known to a millionth of a sigma.
_GAIN = 1e-12


def monomial_map(offset: FloatArray, matrix: FloatArray) -> FloatArray:
    """T (q, q) with ``m(c + A z) = T m(z)`` for the monomials 1, z_a, z_a z_b (a <= b).

    Parameters
    ----------
    offset : (p,) array
        c.
    matrix : (p, p) array
        A.
    """
    p = len(offset)
    rows, columns = np.triu_indices(p)
    q = 1 + p + len(rows)
    t = np.zeros((q, q))
    t[0, 0] = 1.0
    t[1 : p + 1, 0], t[1 : p + 1, 1 : p + 1] = offset, matrix
    a, b = matrix[rows], matrix[columns]
    t[p + 1 :, 0] = offset[rows] * offset[columns]
    t[p + 1 :, 1 : p + 1] = offset[rows, None] * b + offset[columns, None] * a
    both = a[:, rows] * b[:, columns]
    t[p + 1 :, p + 1 :] = np.where(rows == columns, both, both + a[:, columns] * b[:, rows])
    return t


def moved(compressed: CompressedLikelihood, theta_hat: FloatArray, whitening: FloatArray) -> CompressedLikelihood:
    """The same function of theta, expanded around another point in other whitened coordinates.

    Parameters
    ----------
    compressed : CompressedLikelihood
        Any expansion.
    theta_hat : (p,) array
        New point of expansion, px units.
    whitening : (p, p) array
        New L in ``theta = theta_hat + L z``.
    """
    offset = compressed.whiten(theta_hat)[0]
    # Rows of the factors differ by twenty powers of ten.
    scale = np.diag(compressed.whitening)[:, None]
    matrix: FloatArray = np.asarray(np.linalg.solve(compressed.whitening / scale, whitening / scale), dtype=np.float64)
    t = monomial_map(offset, matrix)
    gram = t.T @ compressed.gram @ t
    slope = compressed.log_determinant_slope
    return dataclasses.replace(
        compressed,
        theta_hat=np.array(theta_hat, dtype=np.float64),
        whitening=np.array(whitening, dtype=np.float64),
        gram=0.5 * (gram + gram.T),
        log_determinant=float(compressed.log_determinant + slope @ offset),
        log_determinant_slope=slope @ matrix,
    )


def scaled(compressed: CompressedLikelihood, unit: float) -> CompressedLikelihood:
    """The likelihood of the same stars if each had stated the noise `unit` (px, or a factor on what it states).

    Sigma is then a common factor on it; the value at ``sigma / unit`` differs from the one at `sigma` before by
    ``dof log unit`` and by the frames' volumes, as it does for `starcal_uq.estimation.marginal.MarginalLikelihood`.
    """
    return dataclasses.replace(
        compressed,
        gram=compressed.gram / unit**2,
        log_determinant=compressed.log_determinant - 6.0 * compressed.n_frames * float(np.log(unit)),
    )


def total(parts: Sequence[CompressedLikelihood]) -> CompressedLikelihood:
    """Sum of likelihoods of different frames, expanded around their precision-weighted mean."""
    theta, covariance = combined([part.theta_hat for part in parts], [_covariance(part) for part in parts])
    whitening = scaled_factor(covariance)
    at = [moved(part, theta, whitening) for part in parts]
    return CompressedLikelihood(
        theta_hat=theta,
        whitening=whitening,
        gram=np.sum([part.gram for part in at], axis=0),
        log_determinant=float(sum(part.log_determinant for part in at)),
        log_determinant_slope=np.sum([part.log_determinant_slope for part in at], axis=0),
        dof=sum(part.dof for part in at),
        n_stars=sum(part.n_stars for part in at),
        n_frames=sum(part.n_frames for part in at),
    )


def combined(theta: Sequence[FloatArray], covariance: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Precision-weighted mean (p,) of independent estimates, and its covariance (p, p)."""
    scale = np.sqrt(np.diag(covariance[0]))
    outer = np.outer(scale, scale)
    precision = [np.linalg.inv(c / outer) for c in covariance]
    reduced = np.linalg.inv(np.sum(precision, axis=0))
    # Differences from the first: 5852 px with a sigma of 0.01 px would lose digits.
    shift = np.sum([w @ ((t - theta[0]) / scale) for w, t in zip(precision, theta, strict=True)], axis=0)
    mean = theta[0] + scale * (reduced @ shift)
    return np.asarray(mean), np.asarray(0.5 * (reduced + reduced.T) * outer)


def scaled_factor(covariance: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a covariance whose units span many powers of ten."""
    scale = np.sqrt(np.diag(covariance))
    return np.asarray(np.linalg.cholesky(covariance / np.outer(scale, scale)) * scale[:, None])


def _covariance(compressed: CompressedLikelihood) -> FloatArray:
    return np.asarray(compressed.whitening @ compressed.whitening.T)


@dataclasses.dataclass(frozen=True)
class Optimum:
    """Least squares of a compressed likelihood.

    Attributes
    ----------
    compressed : CompressedLikelihood
        Expanded around the optimum, whitened by the covariance there.
    information : (p, p) array
        Gauss-Newton information at the estimated noise, px units.
    covariance : (p, p) array
        Its inverse.
    sigma : float
        ``sqrt(S / (dof - p))``.
    sum_of_squares : float
        S at the optimum.
    trajectory : (n, p) array
        Estimates after each step, the start first.
    cost : (n,) array
        S along them.
    """

    compressed: CompressedLikelihood
    information: FloatArray
    covariance: FloatArray
    sigma: float
    sum_of_squares: float
    trajectory: FloatArray
    cost: FloatArray

    @property
    def theta(self) -> FloatArray:
        """The optimum, (p,)."""
        return self.compressed.theta_hat

    @property
    def dof(self) -> int:
        """Degrees of freedom left after the parameters."""
        return self.compressed.dof - len(self.theta)


def optimum(compressed: CompressedLikelihood) -> Optimum:
    """Minimise the sum of squares by Newton's method, expanding anew at every step.

    Raises
    ------
    CalibrationError
        When there is no minimum near the point of expansion.
    """
    here, p = compressed, len(compressed.theta_hat)
    dof = compressed.dof - p
    trajectory, cost = [here.theta_hat], [float(here.gram[0, 0])]
    for _ in range(_STEPS):
        slope, hessian = _derivatives(here)
        try:
            factor = np.linalg.cholesky(hessian)
        except np.linalg.LinAlgError:
            # Far from the optimum the full Hessian may not be positive definite; Gauss and Newton's is.
            factor = np.linalg.cholesky(2.0 * here.gram[1 : p + 1, 1 : p + 1])
        step = -np.linalg.solve(factor.T, np.linalg.solve(factor, slope))
        gain = -0.5 * float(slope @ step) * dof / max(2.0 * here.gram[0, 0], np.finfo(np.float64).tiny)
        if gain < _GAIN:
            break
        here = _shorter(here, step)
        trajectory.append(here.theta_hat)
        cost.append(float(here.gram[0, 0]))
    else:
        raise CalibrationError(
            "the merged likelihood has no optimum near the runs' own: they do not describe one camera; calibrate "
            "their observations together.",
            Status.STALLED,
        )
    sigma2 = cost[-1] / dof
    unit = np.linalg.inv(here.gram[1 : p + 1, 1 : p + 1])
    root = here.whitening @ np.linalg.cholesky(0.5 * (unit + unit.T))
    covariance = root @ root.T * sigma2
    scale = np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    return Optimum(
        compressed=moved(here, here.theta_hat, scaled_factor(covariance)),
        information=np.asarray(0.5 * (information + information.T)),
        covariance=np.asarray(covariance),
        sigma=float(np.sqrt(sigma2)),
        sum_of_squares=cost[-1],
        trajectory=np.array(trajectory),
        cost=np.array(cost),
    )


def _derivatives(compressed: CompressedLikelihood) -> tuple[FloatArray, FloatArray]:
    """Gradient (p,) and Hessian (p, p) of the sum of squares with respect to z, at z = 0."""
    p = len(compressed.theta_hat)
    rows, columns = np.triu_indices(p)
    bend = np.zeros((p, p))
    bend[rows, columns] = compressed.gram[0, p + 1 :]
    hessian = 2.0 * compressed.gram[1 : p + 1, 1 : p + 1] + 2.0 * (bend + bend.T)
    return 2.0 * compressed.gram[0, 1 : p + 1], hessian


def _shorter(compressed: CompressedLikelihood, step: FloatArray) -> CompressedLikelihood:
    """Move along a step, halved until the sum of squares does not grow."""
    trials = 0.5 ** np.arange(_HALVINGS)[:, None] * step
    good = np.flatnonzero(compressed.sum_of_squares(trials) <= compressed.gram[0, 0])
    step = trials[good[0] if len(good) else -1]
    return moved(compressed, compressed.theta_hat + compressed.whitening @ step, compressed.whitening)
