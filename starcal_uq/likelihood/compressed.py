"""The compressed likelihood: all stars of all frames in one small Gram matrix.

In whitened parameters ``theta = theta_hat + L z`` the residuals, with each frame's attitude
following its best value, are quadratic in z to high accuracy: ``e(z) = M [1, z, z z^T]``. After the
attitudes are projected out, the sum of squares of the whole data set is ``m(z)^T G m(z)`` with one
Gram matrix G = M^T M (21 x 21 for five parameters), which adds up over frames. An evaluation then
costs the same for any number of stars.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import ClassVar

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood import arrays
from starcal_uq.likelihood.marginal import TURN_RAD, MarginalLikelihood, Profile
from starcal_uq.likelihood.paths import sums_for
from starcal_uq.likelihood.sums import Attitudes, NormalSums, settled_sums, together
from starcal_uq.maths.linear import root_diagonal, scaled_cholesky, symmetric_inverse
from starcal_uq.observations.frames import StarFrames

_pairs = cache(np.triu_indices)


@dataclass(frozen=True)
class CompressedLikelihood:
    """Attitude-marginalised log likelihood around an estimate, at a cost independent of the number
    of stars.
    """

    theta_hat: FloatArray  # (p,): point of expansion, px units
    # (p, p): L in ``theta = theta_hat + L z``; lower triangular, ``L L^T`` is the covariance at the
    # estimate.
    whitening: FloatArray
    # (q, q): G over the monomials 1, z_a, z_a z_b (a <= b, row-major), q = (p + 1)(p + 2) / 2
    gram: FloatArray
    log_determinant: float  # ``sum_k log |A_k^T A_k|`` at theta_hat
    log_determinant_slope: FloatArray  # (p,): derivative of `log_determinant` with respect to z
    dof: int  # ``sum_k (2 m_k - 3)``
    # `n_stars`, `n_frames`: size of the data.
    n_stars: int
    n_frames: int

    SHAPES: ClassVar = """
        p: theta_hat log_determinant_slope
        p p: whitening
        q q: gram
    """
    FINITE: ClassVar = ("theta_hat", "whitening", "gram", "log_determinant_slope")

    def whiten(self, theta: FloatArray) -> FloatArray:
        """Whitened parameters z (n, p) of theta (n, p)."""
        shift = np.atleast_2d(np.asarray(theta, dtype=np.float64)) - self.theta_hat
        diagonal, inverse = self._unwhitening
        return (shift / diagonal) @ inverse

    @cached_property
    def _unwhitening(self) -> tuple[FloatArray, FloatArray]:
        diagonal = np.diag(self.whitening)
        return diagonal, np.asarray(np.linalg.inv(self.whitening / diagonal[:, None]).T)

    def sum_of_squares(self, z: FloatArray) -> FloatArray:
        """Sum of squared residuals (n,) at whitened parameters z (n, p)."""
        return squares_by(self.gram, z)

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
            With the same additive constant as `starcal_uq.likelihood.marginal.MarginalLikelihood`.
        """
        z = self.whiten(theta)
        sigma = np.asarray(sigma, dtype=np.float64)
        value: FloatArray = (
            -0.5 * self.sum_of_squares(z) / sigma**2
            - self.dof * np.log(sigma)
            - 0.5 * (self.log_determinant + z @ self.log_determinant_slope)
        )
        return value


def squares_by(gram: FloatArray, z: FloatArray) -> FloatArray:
    """Sums of squares ``m(z)^T G m(z)`` (..., n) by Gram matrices (..., q, q) at z (n, p)."""
    rows, columns = _pairs(z.shape[1])
    m = np.concatenate([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]], axis=1)
    return np.asarray(np.sum((m @ gram) * m, axis=-1))


@dataclass(frozen=True)
class GramSums:
    """What a part of the frames adds to a compressed likelihood around a given point; they add
    up.
    """

    gram: FloatArray  # (q, q): as in `CompressedLikelihood`
    log_determinant: float  # ``sum_k log |A_k^T A_k|``
    log_determinant_slope: FloatArray  # (p,): its derivative with respect to z
    # `n_stars`, `n_frames`: what was summed.
    n_stars: int
    n_frames: int

    def __add__(self, other: GramSums) -> GramSums:
        return together(self, other)

    def likelihood(self, theta_hat: FloatArray, whitening: FloatArray) -> CompressedLikelihood:
        """The compressed likelihood of all that was summed around theta_hat (p,) with the whitening
        (p, p).
        """
        return CompressedLikelihood(
            theta_hat=np.array(theta_hat),
            whitening=whitening,
            gram=0.5 * (self.gram + self.gram.T),
            log_determinant=self.log_determinant,
            log_determinant_slope=self.log_determinant_slope,
            dof=2 * self.n_stars - 3 * self.n_frames,
            n_stars=self.n_stars,
            n_frames=self.n_frames,
        )


def gram_sums(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    whitening: FloatArray,
    known: tuple[NormalSums, Attitudes],
    look: Callable[[slice, FloatArray], None] | None = None,
) -> GramSums:
    """What a part of the frames adds to the compressed likelihood around theta (p,).

    `theta` (p,): point of expansion, px units; the same for all parts. `whitening` (p, p): L in
    ``theta = theta_hat + L z``, lower triangular; the same for all parts. `known`: sums at theta
    with settled attitudes, as `starcal_uq.likelihood.sums.settled_sums` gives them. `look` is shown
    what `starcal_uq.likelihood.arrays.gram` shows.
    """
    theta, (sums, at) = np.asarray(theta, dtype=np.float64), known
    # A nanoradian that is left would move the estimate by some 1e-8 sigma.
    given = (frames, model_name, theta, whitening, at.at(theta), at.response, at.inverse)
    with np.errstate(all="ignore"):
        gram, slope = sums_for(frames).gram(*given) if look is None else arrays.gram(*given, look)
    return GramSums(gram, sums.log_determinant, slope, frames.n_stars, frames.n_frames)


def compress(
    likelihood: MarginalLikelihood,
    theta_hat: FloatArray,
    covariance: FloatArray,
    rotations: FloatArray | None = None,
) -> CompressedLikelihood:
    """Compress a likelihood around an estimate.

    `likelihood`: exact likelihood of the data.
    `theta_hat` (p,): point of expansion, px units.
    `covariance` (p, p): covariance there; sets the whitened coordinates. `rotations` (K, 3, 3):
    attitudes to start from; otherwise those where the likelihood's own searches start, or
        QUEST's.
    """
    whitening, theta = scaled_cholesky(covariance), np.asarray(theta_hat, dtype=np.float64)
    frames, model_name = likelihood.frames, likelihood.model_name
    if rotations is None:
        known = likelihood.sums(theta, tolerance=TURN_RAD)
    else:
        known = settled_sums(frames, model_name, theta, rotations)
    return gram_sums(frames, model_name, theta, whitening, known).likelihood(theta, whitening)


def expanded(
    likelihood: MarginalLikelihood,
    theta: FloatArray,
    whitening: FloatArray,
    known: tuple[NormalSums, Attitudes],
    add: Callable[[MarginalLikelihood, Profile, FloatArray, slice], object],
) -> GramSums:
    """As `gram_sums`, with what else is summed over the columns of the expansion: `add` takes some
    frames, the model there, the columns (q, 2, n), and the rows of the stars.
    """
    best = known[1].at(theta)

    def look(which: slice, columns: FloatArray) -> None:
        own, state, rows = likelihood.piece(theta, best, which.start, which.stop)
        add(own, state, columns, rows)

    frames, model_name = likelihood.frames, likelihood.model_name
    return gram_sums(frames, model_name, theta, whitening, known, look)


_STEPS = 50
_HALVINGS = 20
# A further Newton step would gain less than this, nat: the optimum is then known to a millionth of
# a sigma.
_GAIN = 1e-12


def monomial_map(offset: FloatArray, matrix: FloatArray) -> FloatArray:
    """T (q, q) with ``m(c + A z) = T m(z)`` for the monomials 1, z_a, z_a z_b (a <= b); `offset` is
    c, `matrix` A.
    """
    p = len(offset)
    rows, columns = _pairs(p)
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


def moved(
    compressed: CompressedLikelihood, theta_hat: FloatArray, whitening: FloatArray
) -> CompressedLikelihood:
    """The same function of theta, expanded around another point in other whitened coordinates.

    `theta_hat` (p,): new point of expansion, px units.
    `whitening` (p, p): new L in ``theta = theta_hat + L z``.
    """
    offset = compressed.whiten(theta_hat)[0]
    # Rows of the factors differ by twenty powers of ten.
    scale = np.diag(compressed.whitening)[:, None]
    matrix: FloatArray = np.asarray(
        np.linalg.solve(compressed.whitening / scale, whitening / scale), dtype=np.float64
    )
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
    """The likelihood of the same stars if each had stated the noise `unit` (px, or a factor on what
    it states).

    Sigma is then a common factor on it; the value at ``sigma / unit`` differs from the one at
    `sigma` before by ``dof log unit`` and by the frames' volumes, as it does for
    `starcal_uq.likelihood.marginal.MarginalLikelihood`.
    """
    return dataclasses.replace(
        compressed,
        gram=compressed.gram / unit**2,
        log_determinant=compressed.log_determinant
        - 6.0 * compressed.n_frames * float(np.log(unit)),
    )


def total(parts: Sequence[CompressedLikelihood]) -> CompressedLikelihood:
    """Sum of likelihoods of different frames, expanded around their precision-weighted mean."""
    theta, covariance = combined(
        [part.theta_hat for part in parts], [_covariance(part) for part in parts]
    )
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


def combined(
    theta: Sequence[FloatArray], covariance: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Precision-weighted mean (p,) of independent estimates, and its covariance (p, p)."""
    scale = root_diagonal(covariance[0])
    outer = np.outer(scale, scale)
    precision = [np.linalg.inv(c / outer) for c in covariance]
    reduced = np.linalg.inv(np.sum(precision, axis=0))
    # Differences from the first: 5852 px with a sigma of 0.01 px would lose digits.
    shift = np.sum(
        [w @ ((t - theta[0]) / scale) for w, t in zip(precision, theta, strict=True)], axis=0
    )
    mean = theta[0] + scale * (reduced @ shift)
    return mean, 0.5 * (reduced + reduced.T) * outer


def _covariance(compressed: CompressedLikelihood) -> FloatArray:
    return compressed.whitening @ compressed.whitening.T


@dataclasses.dataclass(frozen=True)
class Optimum:
    """Least squares of a compressed likelihood."""

    compressed: (
        CompressedLikelihood  # Expanded around the optimum, whitened by the covariance there
    )
    information: FloatArray  # (p, p): Gauss-Newton information at the estimated noise, px units
    covariance: FloatArray  # (p, p): inverse of the information
    sigma: float  # ``sqrt(S / (dof - p))``
    sum_of_squares: float  # S at the optimum
    trajectory: FloatArray  # (n, p): estimates after each step, the start first
    cost: FloatArray  # (n,): S along them

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

    CalibrationError when there is no minimum near the point of expansion.
    """
    here, p = compressed, len(compressed.theta_hat)
    dof = compressed.dof - p
    trajectory, cost = [here.theta_hat], [float(here.gram[0, 0])]
    for _ in range(_STEPS):
        slope, hessian = _derivatives(here)
        try:
            factor = np.linalg.cholesky(hessian)
        except np.linalg.LinAlgError:
            # Far from the optimum the full Hessian may not be positive definite; Gauss and Newton's
            # is.
            factor = np.linalg.cholesky(2.0 * here.gram[1 : p + 1, 1 : p + 1])
        step = -np.linalg.solve(factor.T, np.linalg.solve(factor, slope))
        gain = (
            -0.5 * float(slope @ step) * dof / max(2.0 * here.gram[0, 0], np.finfo(np.float64).tiny)
        )
        if gain < _GAIN:
            break
        here = _shorter(here, step)
        trajectory.append(here.theta_hat)
        cost.append(float(here.gram[0, 0]))
    else:
        raise CalibrationError(
            "the merged likelihood has no optimum near the runs' own: they do not describe one "
            "camera; calibrate "
            "their observations together.",
            Status.STALLED,
        )
    sigma2 = cost[-1] / dof
    covariance = unit_covariance(here) * sigma2
    return Optimum(
        compressed=moved(here, here.theta_hat, scaled_cholesky(covariance)),
        information=symmetric_inverse(covariance),
        covariance=covariance,
        sigma=float(np.sqrt(sigma2)),
        sum_of_squares=cost[-1],
        trajectory=np.array(trajectory),
        cost=np.array(cost),
    )


def unit_covariance(compressed: CompressedLikelihood) -> FloatArray:
    """Covariance (p, p) at the point of expansion for a noise of one: the inverse of the
    Gauss-Newton matrix.
    """
    p = len(compressed.theta_hat)
    unit = np.linalg.inv(compressed.gram[1 : p + 1, 1 : p + 1])
    root = compressed.whitening @ np.linalg.cholesky(0.5 * (unit + unit.T))
    return root @ root.T


def settled(compressed: CompressedLikelihood) -> CompressedLikelihood:
    """The same expanded around its optimum to rounding, from less than a tenth of a sigma away."""
    for _ in range(2):
        slope, hessian = _derivatives(compressed)
        step = compressed.whitening @ np.linalg.solve(hessian, -slope)
        compressed = moved(compressed, compressed.theta_hat + step, compressed.whitening)
    return compressed


def _derivatives(compressed: CompressedLikelihood) -> tuple[FloatArray, FloatArray]:
    """Gradient (p,) and Hessian (p, p) of the sum of squares with respect to z, at z = 0."""
    p = len(compressed.theta_hat)
    rows, columns = _pairs(p)
    bend = np.zeros((p, p))
    bend[rows, columns] = compressed.gram[0, p + 1 :]
    hessian = 2.0 * compressed.gram[1 : p + 1, 1 : p + 1] + 2.0 * (bend + bend.T)
    return 2.0 * compressed.gram[0, 1 : p + 1], hessian


def _shorter(compressed: CompressedLikelihood, step: FloatArray) -> CompressedLikelihood:
    """Move along a step, halved until the sum of squares does not grow."""
    trials = 0.5 ** np.arange(_HALVINGS)[:, None] * step
    good = np.flatnonzero(compressed.sum_of_squares(trials) <= compressed.gram[0, 0])
    step = trials[good[0] if len(good) else -1]
    return moved(
        compressed, compressed.theta_hat + compressed.whitening @ step, compressed.whitening
    )
