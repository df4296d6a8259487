"""The compressed likelihood: all stars of all frames in one small Gram matrix.

In whitened parameters ``theta = theta_hat + L z`` the residuals, with each frame's attitude following its best value,
are quadratic in z to high accuracy: ``e(z) = M [1, z, z z^T]``. After the attitudes are projected out, the sum of
squares of the whole data set is ``m(z)^T G m(z)`` with one Gram matrix G = M^T M (21 x 21 for five parameters), which
adds up over frames. An evaluation then costs the same for any number of stars.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.camera.projection import forward_kernel, forward_root, second_index
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.marginal import MarginalLikelihood, Profile


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
        Its derivative with respect to z.
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
        inverse = np.linalg.inv(self.whitening / np.diag(self.whitening)[:, None])
        z: FloatArray = (shift / np.diag(self.whitening)) @ inverse.T
        return z

    def sum_of_squares(self, z: FloatArray) -> FloatArray:
        """Sum of squared residuals (n,) at whitened parameters z (n, p)."""
        rows, columns = np.triu_indices(z.shape[1])
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

    def to_dict(self) -> AnyDict:
        """Plain lists and numbers, lossless."""
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> CompressedLikelihood:
        """Inverse of `to_dict`."""
        arrays = ("theta_hat", "whitening", "gram", "log_determinant_slope")
        values: AnyDict = {k: np.asarray(v, dtype=np.float64) if k in arrays else v for k, v in data.items()}
        return cls(**values)


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
    likelihood: MarginalLikelihood, theta_hat: FloatArray, covariance: FloatArray, rotations: FloatArray | None = None
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
    """
    scale = np.sqrt(np.diag(covariance))
    whitening = np.linalg.cholesky(covariance / np.outer(scale, scale)) * scale[:, None]
    frames, p = likelihood.frames, len(theta_hat)
    q = (p + 1) * (p + 2) // 2
    gram, slope, log_determinant = np.zeros((q, q)), np.zeros(p), 0.0
    for first, last in frames.parts(20_000):
        part = MarginalLikelihood(frames.part(first, last), likelihood.model_name)
        state, _ = part.profile(theta_hat, None if rotations is None else rotations[first:last])
        piece = _columns(part, state, theta_hat, whitening)
        gram += piece.columns @ piece.columns.T
        slope += piece.log_determinant_slope
        log_determinant += float(np.sum(state.log_determinant))
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
