"""Inverse and determinant of many symmetric 3 x 3 matrices at once."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.types import FloatArray

# Order of the six unique entries: rows and columns.
ROWS = (0, 0, 0, 1, 1, 2)
COLUMNS = (0, 1, 2, 1, 2, 2)


def inverse_symmetric(packed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Invert symmetric 3 x 3 matrices given by their six unique entries.

    Parameters
    ----------
    packed : (6, K) array
        Entries xx, xy, xz, yy, yz, zz.

    Returns
    -------
    inverse : (3, 3, K) array
        Inverses; not finite where the matrix is singular.
    determinant : (K,) array
        Determinants.
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
