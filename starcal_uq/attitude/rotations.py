"""Rotations as arrays: matrices, scalar-last quaternions and small left rotation vectors.

Conventions: ``R_cam_icrs`` maps ICRS vectors to the camera frame, b = R r. Quaternions are (x, y,
z, w) with the sense of ``scipy.spatial.transform.Rotation``. An attitude error is the *left*
(camera-frame) rotation vector phi in R' = exp([phi]x) R: phi_x is pitch, phi_y yaw and phi_z roll
about the boresight. Every function takes any number of leading axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from starcal_uq.core.types import FloatArray

# Entries of matrices by rows, each an array over many of them.
Matrix: TypeAlias = list[list[FloatArray]]


def rotation_to_quaternion(rotation: FloatArray) -> FloatArray:
    """Scalar-last unit quaternions (..., 4), scalar part not negative, of proper rotation matrices
    (..., 3, 3).

    Of the four algebraically equal formulas the one with the largest divisor is used, matrix by
    matrix (Shepperd 1978), so that half turns lose no digits.
    """
    m = np.asarray(rotation, dtype=float)
    if m.shape[-2:] != (3, 3):
        raise ValueError(f"rotation matrices have shape (..., 3, 3), not {m.shape}.")
    rows = [[m[..., i, j] for j in range(3)] for i in range(3)]
    xx, yy, zz = (rows[i][i] for i in range(3))
    # Four times q q^T: each row is parallel to the quaternion.
    square = (1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz, 1.0 + xx + yy + zz)
    best = np.argmax(square, axis=0)
    x, y, z, w = (np.choose(best, column) for column in davenport(rows, square))
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    norm = np.where(w < 0.0, -norm, norm)
    return np.stack((x / norm, y / norm, z / norm, w / norm), axis=-1)


def axial(m: Matrix) -> list[FloatArray]:
    """Axial vectors of the antisymmetric parts of 3x3 matrices."""
    return [m[k][j] - m[j][k] for j, k in ((1, 2), (2, 0), (0, 1))]


def symmetric(m: Matrix, scale: float = 1.0) -> Matrix:
    """Scaled sums of 3x3 matrices and their transposes."""
    return [[scale * (m[i][j] + m[j][i]) for j in range(3)] for i in range(3)]


def davenport(m: Matrix, diagonal: Sequence[FloatArray]) -> Matrix:
    """Rows of the symmetric 4x4 matrices, with this diagonal, whose eigenvectors are quaternions."""
    turn = axial(m)
    rows = [[*row, own] for row, own in zip([*symmetric(m), turn], [*turn, turn[0]], strict=True)]
    for i, value in enumerate(diagonal):
        rows[i][i] = value
    return rows


def quaternion_to_rotation(quaternion: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of scalar-last quaternions (..., 4) of any norm; ValueError for
    a norm of zero.
    """
    q = np.asarray(quaternion, dtype=float)
    if q.shape[-1:] != (4,):
        raise ValueError(f"quaternions have shape (..., 4), not {q.shape}.")
    return _of_quaternion(*np.moveaxis(q, -1, 0))


def _of_quaternion(x: FloatArray, y: FloatArray, z: FloatArray, w: FloatArray) -> FloatArray:
    norm2 = x * x + y * y + z * z + w * w
    if np.any(norm2 == 0.0):
        raise ValueError("a quaternion of norm zero is not a rotation.")
    matrix = np.empty((*np.shape(norm2), 3, 3))
    for i, row in enumerate(rotation_rows(x, y, z, w, 2.0 / norm2)):
        for j, entry in enumerate(row):
            matrix[..., i, j] = entry
    return matrix


def rotation_rows(
    x: FloatArray, y: FloatArray, z: FloatArray, w: FloatArray, s: FloatArray | float = 2.0
) -> Matrix:
    """Entries of rotation matrices of quaternions, with s twice the inverse of their norm squared."""
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    xw, yw, zw = x * w, y * w, z * w
    return [
        [1.0 - s * (yy + zz), s * (xy - zw), s * (xz + yw)],
        [s * (xy + zw), 1.0 - s * (xx + zz), s * (yz - xw)],
        [s * (xz - yw), s * (yz + xw), 1.0 - s * (xx + yy)],
    ]


def quaternion_multiply(left: FloatArray, right: FloatArray) -> FloatArray:
    """Hamilton product: the rotation `right` followed by the rotation `left`; both (..., 4), scalar
    last.
    """
    x1, y1, z1, w1 = np.moveaxis(np.asarray(left, dtype=float), -1, 0)
    x2, y2, z2, w2 = np.moveaxis(np.asarray(right, dtype=float), -1, 0)
    return np.stack(
        (
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ),
        axis=-1,
    )


def quaternion_vector(quaternion: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) in rad, of length at most pi, of unit quaternions (..., 4)."""
    q = np.asarray(quaternion, dtype=float)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1)
    # angle / sin(angle / 2) tends to 2: written through sinc, it needs no special case at zero.
    half = np.arctan2(sine, q[..., 3])
    vector: FloatArray = q[..., :3] * (2.0 / np.sinc(half / np.pi))[..., None]
    return vector


def left_error(quaternion: FloatArray, reference: FloatArray) -> FloatArray:
    """Camera-frame rotation vectors phi (..., 3) rad, R(quaternion) = exp([phi]x) R(reference)."""
    conjugate = np.asarray(reference, dtype=float) * np.array([-1.0, -1.0, -1.0, 1.0])
    return quaternion_vector(quaternion_multiply(quaternion, conjugate))


def rotation_vector(rotation: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) in rad, of length at most pi, of matrices (..., 3, 3)."""
    return quaternion_vector(rotation_to_quaternion(rotation))


def exp_rotation(phi: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad (Rodrigues' formula)."""
    v = np.asarray(phi, dtype=float)
    if v.shape[-1:] != (3,):
        raise ValueError(f"rotation vectors have shape (..., 3), not {v.shape}.")
    x, y, z = v.tolist() if v.ndim == 1 else np.moveaxis(v, -1, 0)
    half = 0.5 * np.sqrt(x * x + y * y + z * z)
    along = np.sinc(half / np.pi)
    return _of_quaternion(0.5 * x * along, 0.5 * y * along, 0.5 * z * along, np.cos(half))


def random_rotations(n: int, rng: np.random.Generator) -> FloatArray:
    """Draw `n` rotation matrices (n, 3, 3) uniformly on SO(3): normalised Gaussian quaternions."""
    return quaternion_to_rotation(rng.standard_normal((n, 4)))


def unit_vectors(ra_deg: FloatArray | float, dec_deg: FloatArray | float) -> FloatArray:
    """Unit vectors (n, 3) of directions, deg: x towards (0, 0), y towards (90, 0), z towards
    declination 90.
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    cos_dec = np.cos(dec)
    return np.stack([cos_dec * np.cos(ra), cos_dec * np.sin(ra), np.sin(dec)], axis=-1)


def ra_dec_deg(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right ascension in [0, 360) and declination, deg, of vectors (n, 3) of any length.

    The declination comes from the arc tangent, which keeps its digits at the poles where the arc
    sine loses half.
    """
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    ra = np.degrees(np.arctan2(y, x)) % 360.0
    # A right ascension of -1e-17 becomes exactly 360 under the modulo.
    return np.where(ra >= 360.0, 0.0, ra), np.degrees(np.arctan2(z, np.hypot(x, y)))
