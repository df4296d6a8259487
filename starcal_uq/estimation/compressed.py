"""The compressed likelihood: all stars of all frames in one small Gram matrix.

In whitened parameters ``theta = theta_hat + L z`` the residuals, with each frame's attitude following its best value,
are quadratic in z to high accuracy: ``e(z) = M [1, z, z z^T]``. After the attitudes are projected out, the sum of
squares of the whole data set is ``m(z)^T G m(z)`` with one Gram matrix G = M^T M (21 x 21 for five parameters), which
adds up over frames. An evaluation then costs the same for any number of stars.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from starcal_uq.camera.projection import forward_kernel, forward_root, second_index
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.marginal import MarginalLikelihood, Profile
from starcal_uq.estimation.star_errors import StarSums
from starcal_uq.maths.linear import scaled_cholesky, symmetric_inverse

_pairs = cache(np.triu_indices)


@dataclass(frozen=True)
class CompressedLikelihood:
    """Attitude-marginalised log likelihood around an estimate, at a cost independent of the number of stars.

    Attributes
    ----------
    theta_hat : (p,) array
        Point of expansion, px units.
    whitening : (p, p) array
        L in ``theta = theta_hat + L z``; lower triangular, ``L L^T`` is the covariance at the estimate.
    gram : (q, q) array
        G over the monomials 1, z_a, z_a z_b (a <= b, row-major), q = (p + 1)(p + 2) / 2.
    log_determinant : float
        ``sum_k log |A_k^T A_k|`` at theta_hat.
    log_determinant_slope : (p,) array
        Derivative of `log_determinant` with respect to z.
    dof : int
        ``sum_k (2 m_k - 3)``.
    n_stars, n_frames : int
        Size of the data.
    """

    theta_hat: FloatArray
    whitening: FloatArray
    gram: FloatArray
    log_determinant: float
    log_determinant_slope: FloatArray
    dof: int
    n_stars: int
    n_frames: int

    def whiten(self, theta: FloatArray) -> FloatArray:
        """Whitened parameters z (n, p) of theta (n, p)."""
        shift = np.atleast_2d(np.asarray(theta, dtype=np.float64)) - self.theta_hat
        diagonal, inverse = self._unwhitening
        z: FloatArray = (shift / diagonal) @ inverse
        return z

    @cached_property
    def _unwhitening(self) -> tuple[FloatArray, FloatArray]:
        diagonal = np.diag(self.whitening)
        return diagonal, np.asarray(np.linalg.inv(self.whitening / diagonal[:, None]).T)

    def sum_of_squares(self, z: FloatArray) -> FloatArray:
        """Sum of squared residuals (n,) at whitened parameters z (n, p)."""
        rows, columns = _pairs(z.shape[1])
        m = np.concatenate([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]], axis=1)
        s: FloatArray = np.sum((m @ self.gram) * m, axis=1)
        return s

    def log_likelihood(self, theta: FloatArray, sigma: FloatArray | float) -> FloatArray:
        """Log likelihood at many points.

        Parameters
        ----------
        theta : (n, p) array
            Parameters, px units.
        sigma : (n,) array or float
            Centroid noise, px per axis, or the common factor where the stars state their own noise.

        Returns
        -------
        (n,) array
            With the same additive constant as `starcal_uq.estimation.marginal.MarginalLikelihood`.
        """
        z = self.whiten(theta)
        sigma = np.asarray(sigma, dtype=np.float64)
        value: FloatArray = (
            -0.5 * self.sum_of_squares(z) / sigma**2
            - self.dof * np.log(sigma)
            - 0.5 * (self.log_determinant + z @ self.log_determinant_slope)
        )
        return value


@dataclass(frozen=True)
class _Columns:
    """Whitened-parameter derivatives of the residuals of some frames, attitudes projected out."""

    columns: FloatArray
    log_determinant_slope: FloatArray


def _columns(part: MarginalLikelihood, state: Profile, theta: FloatArray, whitening: FloatArray) -> _Columns:
    frames, p = part.frames, len(theta)
    _, d_theta, d_phi, second = forward_kernel(part.model_name, "second")(
        frames.n_stars, theta, state.b, forward_root(part.model_name, theta, state.b)
    )
    rows, columns = second_index(p + 3)
    full = np.empty((p + 3, p + 3, 2, frames.n_stars))
    full[rows, columns] = second
    full[columns, rows] = second
    if frames.weight is not None:
        d_theta, d_phi, full = d_theta * frames.weight, d_phi * frames.weight, full * frames.weight
    d_z = np.tensordot(whitening, d_theta, axes=([0], [0]))
    # First-order path of the best attitude: phi(z) = K z.
    path = -frames.spread(part.attitude_response(state, d_z))
    # Mixed derivatives of the attitude columns along z: Q_(theta phi) L + Q_(phi phi) K.
    q_z_phi = np.tensordot(whitening, full[:p, p:], axes=([0], [0]))
    phi_part = np.einsum("bcxn,abn->acxn", full[p:, p:], path, optimize=True)
    d_attitude = q_z_phi + phi_part
    q_zz = np.tensordot(whitening, np.tensordot(whitening, full[:p, :p], axes=([0], [0])), axes=([0], [1]))
    mixed = np.einsum("acxn,bcn->abxn", q_z_phi, path, optimize=True)
    curved = np.einsum("bcn,acxn->abxn", path, phi_part, optimize=True)
    total = q_zz + mixed + mixed.transpose(1, 0, 2, 3) + curved
    i, j = np.triu_indices(p)
    weight = np.where(i == j, 0.5, 1.0)[:, None, None]
    stacked = np.concatenate([state.e[None], -d_z, -weight * total[i, j]])
    inverse = frames.spread(state.inverse)
    pseudo = np.einsum("abn,bxn->axn", inverse, state.attitude, optimize=True)
    slope = 2.0 * np.einsum("cxn,acxn->a", pseudo, d_attitude, optimize=True)
    return _Columns(part.project_out(state, stacked).reshape(len(stacked), -1), slope)


def compress(
    likelihood: MarginalLikelihood,
    theta_hat: FloatArray,
    covariance: FloatArray,
    rotations: FloatArray | None = None,
    stars: StarSums | None = None,
    ratio: FloatArray | None = None,
) -> CompressedLikelihood:
    """Compress a likelihood around an estimate.

    Parameters
    ----------
    likelihood : MarginalLikelihood
        Exact likelihood of the data.
    theta_hat : (p,) array
        Point of expansion, px units.
    covariance : (p, p) array
        Covariance there; sets the whitened coordinates.
    rotations : (K, 3, 3) array, optional
        Attitudes to start from.
    stars : StarSums, optional
        Stars that bring errors along, nothing added yet.
    ratio : (2 S,) array, optional
        Variances of their errors, in units of sigma^2.
    """
    whitening = scaled_cholesky(covariance)
    frames, p = likelihood.frames, len(theta_hat)
    q = (p + 1) * (p + 2) // 2
    gram, slope, log_determinant = np.zeros((q, q)), np.zeros(p), 0.0
    for first, last in frames.parts(20_000):
        part = MarginalLikelihood(frames.part(first, last), likelihood.model_name)
        state, _ = part.profile(theta_hat, None if rotations is None else rotations[first:last])
        piece = _columns(part, state, theta_hat, whitening)
        gram += piece.columns @ piece.columns.T
        if stars is not None:
            rows = slice(int(frames.starts[first]), int(frames.starts[last]))
            stars.add(part, state, piece.columns.reshape(q, 2, -1), rows)
        slope += piece.log_determinant_slope
        log_determinant += float(np.sum(state.log_determinant))
    if stars is not None and ratio is not None:
        gram -= stars.solved(ratio).correction()
    return CompressedLikelihood(
        theta_hat=np.array(theta_hat),
        whitening=whitening,
        gram=0.5 * (gram + gram.T),
        log_determinant=log_determinant,
        log_determinant_slope=slope,
        dof=likelihood.dof,
        n_stars=frames.n_stars,
        n_frames=frames.n_frames,
    )


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
    whitening = scaled_cholesky(covariance)
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
        Inverse of the information.
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
    return Optimum(
        compressed=moved(here, here.theta_hat, scaled_cholesky(covariance)),
        information=symmetric_inverse(covariance),
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
