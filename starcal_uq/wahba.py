"""Wahba's problem for many frames at once, in explicit components: the arithmetic behind `starcal_uq.quest`.

Arrays hold one component each, shaped (d, n) for d draws of n stars or (d, k) for k frames. That keeps every
operation contiguous, which is worth a factor of several over arrays of 3-vectors and 3x3 matrices in NumPy.
"""

from __future__ import annotations

import numpy as np

from starcal_uq._types import FloatArray, IntArray

_NEWTON_STEPS = 60


def profile(
    b: FloatArray, r: FloatArray, w: FloatArray | None, local: IntArray, total: FloatArray
) -> list[list[FloatArray]]:
    """Attitude profile matrix B_ij = sum w b_i r_j / sum w, each entry (d, k)."""
    weighted = r if w is None else r * w
    scale = 1.0 / total
    return [[np.add.reduceat(b[i] * weighted[j], local, axis=-1) * scale for j in range(3)] for i in range(3)]


def solve(B: list[list[FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Quaternions (4, d, k), largest eigenvalue (d, k) and observability (d, k)."""
    (bxx, bxy, bxz), (byx, byy, byz), (bzx, bzy, bzz) = B
    cofactors = (
        byy * bzz - byz * bzy, byz * bzx - byx * bzz, byx * bzy - byy * bzx,
        bxz * bzy - bxy * bzz, bxx * bzz - bxz * bzx, bxy * bzx - bxx * bzy,
        bxy * byz - bxz * byy, bxz * byx - bxx * byz, bxx * byy - bxy * byx,
    )  # fmt: skip
    norm2 = _sum_of_squares((bxx, bxy, bxz, byx, byy, byz, bzx, bzy, bzz))
    adjoint2 = _sum_of_squares(cofactors)
    det = bxx * cofactors[0] + bxy * cofactors[1] + bxz * cofactors[2]
    lam = _largest_root(norm2, adjoint2, det)
    q = _adjugate_quaternion(B, lam)
    q, curvature = _polish(q, B)
    # |adj B| is about the second singular value of B: it sees coinciding stars, at which the quaternion is
    # arbitrary and the curvature found at it may look sound.
    return q, lam, np.minimum(curvature, np.sqrt(adjoint2 / np.where(norm2 > 0.0, norm2, 1.0)))


def _sum_of_squares(parts: tuple[FloatArray, ...]) -> FloatArray:
    total = parts[0] * parts[0]
    for part in parts[1:]:
        total += part * part
    return total


def _largest_root(norm2: FloatArray, adjoint2: FloatArray, det: FloatArray) -> FloatArray:
    """Newton's method from the sum of weights, 1, an upper bound from which it descends monotonically."""
    lam = np.ones_like(norm2)
    for _ in range(_NEWTON_STEPS):
        a = lam * lam - norm2
        slope = 4.0 * lam * a - 8.0 * det
        value = a * a - 8.0 * lam * det - 4.0 * adjoint2
        # At a double root the slope vanishes with the value; a step that rounding makes negative has arrived.
        step = np.maximum(value, 0.0) / np.where(slope > 0.0, slope, 1.0)
        lam = lam - step
        # Written so that a problem with NaN does not stop the others.
        if not np.any(step > 4e-16):
            break
    return lam


def _adjugate_quaternion(B: list[list[FloatArray]], lam: FloatArray) -> FloatArray:
    """Largest row of adj(K - lambda I), normalised: (4, d, k)."""
    (bxx, bxy, bxz), (byx, byy, byz), (bzx, bzy, bzz) = B
    a00, a11 = bxx - byy - bzz - lam, byy - bxx - bzz - lam
    a22, a33 = bzz - bxx - byy - lam, bxx + byy + bzz - lam
    a01, a02, a12 = bxy + byx, bxz + bzx, byz + bzy
    a03, a13, a23 = bzy - byz, bxz - bzx, byx - bxy
    # 2x2 minors of the upper and of the lower two rows.
    s0, s1, s2 = a00 * a11 - a01 * a01, a00 * a12 - a01 * a02, a00 * a13 - a01 * a03
    s3, s4, s5 = a01 * a12 - a11 * a02, a01 * a13 - a11 * a03, a02 * a13 - a12 * a03
    c5, c4, c3 = a22 * a33 - a23 * a23, a12 * a33 - a13 * a23, a12 * a23 - a13 * a22
    c2, c1 = a02 * a33 - a03 * a23, a02 * a23 - a03 * a22
    d00, d11 = a11 * c5 - a12 * c4 + a13 * c3, a00 * c5 - a02 * c2 + a03 * c1
    d22, d33 = a03 * s4 - a13 * s2 + a33 * s0, a02 * s3 - a12 * s1 + a22 * s0
    d01, d02 = a02 * c4 - a01 * c5 - a03 * c3, a13 * s5 - a23 * s4 + a33 * s3
    d03, d12 = a22 * s4 - a12 * s5 - a23 * s3, a23 * s2 - a03 * s5 - a33 * s1
    d13, d23 = a02 * s5 - a22 * s2 + a23 * s1, a12 * s2 - a02 * s4 - a23 * s0
    # All diagonal entries are <= 0 (three negative factors): the largest in magnitude is the smallest.
    xy, zw = d00 < d11, d22 < d33
    first = np.minimum(d00, d11) < np.minimum(d22, d33)
    rows = ((d00, d01, d02, d03), (d01, d11, d12, d13), (d02, d12, d22, d23), (d03, d13, d23, d33))
    q = np.empty((4, *lam.shape))
    for i in range(4):
        q[i] = np.where(first, np.where(xy, rows[0][i], rows[1][i]), np.where(zw, rows[2][i], rows[3][i]))
    return _normalise(q)


def _normalise(q: FloatArray) -> FloatArray:
    norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    q /= np.where(norm > 0.0, norm, 1.0)
    return q


def _matrix(q: FloatArray) -> list[list[FloatArray]]:
    x, y, z, w = q
    xx, yy, zz, xy, xz, yz, xw, yw, zw = x * x, y * y, z * z, x * y, x * z, y * z, x * w, y * w, z * w
    return [
        [1.0 - 2.0 * (yy + zz), 2.0 * (xy - zw), 2.0 * (xz + yw)],
        [2.0 * (xy + zw), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - xw)],
        [2.0 * (xz - yw), 2.0 * (yz + xw), 1.0 - 2.0 * (xx + yy)],
    ]


def _polish(q: FloatArray, B: list[list[FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """One Newton step of Wahba's loss on the left rotation vector, and the least curvature of the loss.

    With M = B R^T the gradient is minus the axial vector of M, and the Hessian tr(M) I - (M + M^T)/2 has the
    eigenvalues s_i + s_j (sums of two signed singular values of B).
    """
    R = _matrix(q)
    M = [[B[i][0] * R[j][0] + B[i][1] * R[j][1] + B[i][2] * R[j][2] for j in range(3)] for i in range(3)]
    gx, gy, gz = M[2][1] - M[1][2], M[0][2] - M[2][0], M[1][0] - M[0][1]
    hxx, hyy, hzz = M[1][1] + M[2][2], M[0][0] + M[2][2], M[0][0] + M[1][1]
    hxy, hxz, hyz = -0.5 * (M[0][1] + M[1][0]), -0.5 * (M[0][2] + M[2][0]), -0.5 * (M[1][2] + M[2][1])
    ixx, iyy, izz = hyy * hzz - hyz * hyz, hxx * hzz - hxz * hxz, hxx * hyy - hxy * hxy
    ixy, ixz, iyz = hxz * hyz - hxy * hzz, hxy * hyz - hxz * hyy, hxy * hxz - hxx * hyz
    det = hxx * ixx + hxy * ixy + hxz * ixz
    sound = det > 0.0
    half = 0.5 / np.where(sound, det, np.inf)
    px, py, pz = (
        half * (ixx * gx + ixy * gy + ixz * gz),
        half * (ixy * gx + iyy * gy + iyz * gz),
        half * (ixz * gx + iyz * gy + izz * gz),
    )
    x, y, z, w = q
    better = np.empty_like(q)
    better[0] = x + px * w + py * z - pz * y
    better[1] = y - px * z + py * w + pz * x
    better[2] = z + px * y - py * x + pz * w
    better[3] = w - px * x - py * y - pz * z
    # For one small eigenvalue, det / (sum of principal minors) is that eigenvalue, and never 3 times less.
    minors = ixx + iyy + izz
    curvature = np.where(sound, det, 0.0) / np.where(minors > 0.0, minors, np.inf)
    return _normalise(better), curvature


def information(b: FloatArray, w: FloatArray | None, local: IntArray) -> FloatArray:
    """Sum of w (I - b b^T), as (xx, yy, zz, xy, xz, yz): (6, d, k)."""
    weighted = b if w is None else b * w
    xx, yy, zz, xy, xz, yz = (
        np.add.reduceat(weighted[i] * b[j], local, axis=-1)
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    return np.stack((yy + zz, xx + zz, xx + yy, -xy, -xz, -yz))


def inverse(h: FloatArray) -> FloatArray:
    """Inverse of symmetric 3x3 matrices given as (xx, yy, zz, xy, xz, yz); NaN where singular."""
    xx, yy, zz, xy, xz, yz = h
    inverse = np.stack(
        (
            yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy,
            xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz,
        )
    )  # fmt: skip
    det = xx * inverse[0] + xy * inverse[3] + xz * inverse[4]
    inverse /= np.where(det > 0.0, det, np.nan)
    return inverse


def full(h: FloatArray) -> FloatArray:
    """Symmetric matrices in full, (6, d, k) to (d, k, 3, 3)."""
    rows = np.moveaxis(h[[0, 3, 4, 3, 1, 5, 4, 5, 2]], 0, -1)
    return np.ascontiguousarray(rows).reshape(*h.shape[1:], 3, 3)


def squared_residuals(
    b: FloatArray, r: FloatArray, w: FloatArray | None, local: IntArray, counts: IntArray, q: FloatArray
) -> FloatArray:
    """Sum of w |b - R r|^2 per frame, (d, k): from the residuals, as 1 - lambda would lose the digits."""
    total = np.zeros(b.shape[1:])
    for i, row in enumerate(_matrix(q)):
        x, y, z = (np.repeat(entry, counts, axis=-1) for entry in row)
        residual = b[i] - x * r[0] - y * r[1] - z * r[2]
        total += residual * residual
    if w is not None:
        total *= w
    result: FloatArray = np.add.reduceat(total, local, axis=-1)
    return result
