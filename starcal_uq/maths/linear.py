"""Linear algebra of covariances and information matrices, whose entries span thirty orders of
magnitude.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcal_uq.core.types import BoolArray, FloatArray

# Order of the six unique entries: rows and columns.
ROWS = (0, 0, 0, 1, 1, 2)
COLUMNS = (0, 1, 2, 1, 2, 2)
# Worse than this, digits are lost in the inverse.
_WORST_CONDITION = 1e13
# What rounding may make of an entry of a matrix with a unit diagonal.
_ROUNDING = 1e-9


def root_diagonal(matrix: NDArray[np.floating[Any]]) -> FloatArray:
    """Roots (p,) of the diagonal of a matrix: the standard deviations of a covariance."""
    return np.sqrt(np.diag(matrix))


def symmetric(matrix: FloatArray) -> FloatArray:
    """Symmetric part (p, p) of a matrix, which is one but for rounding."""
    return np.asarray(0.5 * (matrix + matrix.T))


def inverse_symmetric(packed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverses (3, 3, K) and determinants (K,) of symmetric matrices given by xx, xy, xz, yy, yz,
    zz (6, K).

    Not finite where the matrix is singular.
    """
    xx, xy, xz, yy, yz, zz = packed
    a = yy * zz - yz * yz
    b = xz * yz - xy * zz
    c = xy * yz - xz * yy
    determinant = xx * a + xy * b + xz * c
    d = xx * zz - xz * xz
    e = xy * xz - xx * yz
    f = xx * yy - xy * xy
    with np.errstate(divide="ignore", invalid="ignore"):
        unique = np.stack([a, b, c, d, e, f]) / determinant
    inverse = np.empty((3, 3, packed.shape[1]))
    for value, i, j in zip(unique, ROWS, COLUMNS, strict=True):
        inverse[i, j] = value
        inverse[j, i] = value
    return inverse, determinant


def principal(
    matrix: FloatArray, least: float, relative: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (r,) of a symmetric matrix (p, p) above `least`, or that share of the largest
    one, and their vectors (p, r).
    """
    values, vectors = np.linalg.eigh(symmetric(matrix))
    kept = values > (least * values[-1] if relative else least)
    return values[kept], vectors[:, kept]


def without_first(
    gram: FloatArray, p: int, least: float, unit: FloatArray
) -> tuple[FloatArray, int]:
    """Products (q - p, q - p) of columns without what the first p of them reproduce, and how many
    of these are determined.

    `gram` (q, q): products of all columns.
    `least`: square of a combination of the first columns, in units of `unit` (p,), up to which it
    counts as none.
    """
    values, vectors = principal(gram[:p, :p] * np.outer(unit, unit), least)
    explained = (unit[:, None] * vectors / np.sqrt(values)).T @ gram[:p, p:]
    left: FloatArray = gram[p:, p:] - explained.T @ explained
    return left, len(values)


def unit_diagonal(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A symmetric matrix scaled to a unit diagonal, (p, p), and the scale (p,) of its rows and
    columns.
    """
    scale = 1.0 / root_diagonal(matrix)
    return matrix * np.outer(scale, scale), scale


def unit_inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse (p, p) of a symmetric matrix scaled to a unit diagonal, and the scale (p,) of its
    rows and columns.

    The inverse of the matrix itself is ``inverse * np.outer(scale, scale)``.
    """
    scaled, scale = unit_diagonal(matrix)
    return np.asarray(np.linalg.inv(scaled)), scale


def scaled_inverse(matrix: FloatArray) -> FloatArray:
    """Inverse (p, p) of a symmetric matrix whose entries span many orders of magnitude."""
    inverse, scale = unit_inverse(matrix)
    return inverse * np.outer(scale, scale)


def inverse_diagonal(matrix: FloatArray) -> FloatArray:
    """Diagonal (p,) of the inverse of such a matrix."""
    inverse, scale = unit_inverse(matrix)
    return np.diag(inverse) * scale**2


def correlation_of(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Correlations (p, p) and standard deviations (p,) of a covariance."""
    sd = root_diagonal(covariance)
    return np.asarray(covariance / np.outer(sd, sd)), sd


def symmetric_inverse(matrix: FloatArray) -> FloatArray:
    """Exactly symmetric inverse (p, p) of a covariance or a precision matrix; LinAlgError for a
    singular one.
    """
    if not np.all(np.diag(matrix) > 0.0):
        raise np.linalg.LinAlgError("the diagonal is not positive")
    correlation, sd = correlation_of(matrix)
    inverse = np.linalg.inv(correlation) / np.outer(sd, sd)
    return symmetric(inverse)


def scaled_cholesky(covariance: FloatArray) -> FloatArray:
    """Lower Cholesky factor (p, p) of a covariance whose units span many powers of ten."""
    correlation, sd = correlation_of(covariance)
    return np.asarray(sd[:, None] * np.linalg.cholesky(correlation))


def whitened(shifts: FloatArray, factor: FloatArray) -> FloatArray:
    """Coordinates z (n, p) of shifts ``factor @ z`` (n, p), by a triangular factor (p, p) whose rows
    differ by many powers of ten.
    """
    scale = np.diag(factor)
    return np.asarray(np.linalg.solve(factor / scale[:, None], (shifts / scale).T).T)


def is_positive(matrix: FloatArray, *, strictly: bool = True) -> bool:
    """Whether a matrix (p, p) is symmetric to rounding, and positive definite, or else
    semidefinite.
    """
    scale = np.sqrt(np.abs(np.diag(matrix)))
    unit = matrix / np.where(np.outer(scale, scale) > 0.0, np.outer(scale, scale), 1.0)
    least = float(np.linalg.eigvalsh(unit)[0])
    return np.allclose(unit, unit.T, atol=_ROUNDING) and (
        least > 0.0 if strictly else least > -_ROUNDING
    )


def inverses(information: FloatArray) -> FloatArray:
    """Inverses (..., p, p) of matrices whose entries span many orders of magnitude; infinite where
    singular.
    """
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.sqrt(diagonal)
        scaled = information * scale[..., :, None] * scale[..., None, :]
    good: BoolArray = np.asarray(np.isfinite(scaled).all(axis=(-2, -1)))
    p = information.shape[-1]
    scaled = np.where(good[..., None, None], scaled, np.eye(p))
    good = np.asarray(good & (np.asarray(np.linalg.cond(scaled)) < _WORST_CONDITION))
    inverse = np.linalg.inv(np.where(good[..., None, None], scaled, np.eye(p)))
    with np.errstate(invalid="ignore"):
        inverse = inverse * scale[..., :, None] * scale[..., None, :]
    return np.where(good[..., None, None], inverse, np.inf)


def mean_weights(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (..., n, k, k) of n estimates, whose sum is the identity, and the covariance (..., k,
    k) of their mean.

    An estimate whose covariance is NaN has no weight.
    """
    information = np.linalg.inv(covariances)
    information = np.where(np.isnan(information), 0.0, information)
    covariance: FloatArray = np.linalg.inv(information.sum(axis=-3))
    return covariance[..., None, :, :] @ information, covariance
