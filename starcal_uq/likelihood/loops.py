"""The sums over frames as loops for Numba: the same numbers as the NumPy path, several times
faster.

The source is generated for one distortion model: its kernels come from the instructions of CasADi,
and what has a fixed number of terms is written out, so that accumulators stay in registers. Stars
are visited in chunks whose columns stay in the first cache; a column is a row of `STRIDE` numbers
in one buffer, at a distance that the compiler knows.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from starcal_uq.attitude.wahba import DEGENERATE
from starcal_uq.camera import compiled
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.kernels import Kernel, emit_source
from starcal_uq.camera.projection import backward_kernel, bent_index, forward_kernel, newton_kernel
from starcal_uq.core.types import FloatArray
from starcal_uq.observations.frames import StarFrames

# Columns of a buffer: more than a chunk, and no multiple of what makes rows compete for places in
# the cache.
_STRIDE, _CHUNK = 136, 128
_NONE = np.empty(0)

_HEAD = """
import numpy as np
from numba import float64, int64, njit, types

P, STRIDE, CHUNK, GRAM_CHUNK, ROWS, EXPLICIT = {p}, {stride}, {chunk}, 64, {rows}, {explicit}
DEGENERATE = {degenerate}
# Sums in another order, fused products, shared reciprocals: nothing that changes what becomes of NaN and infinity.
HELPER = dict(no_cpython_wrapper=True, no_cfunc_wrapper=True)
ORDERED = dict(nogil=True, cache=True, error_model="numpy", fastmath={{"contract"}})
FAST = dict(nogil=True, cache=True, error_model="numpy", fastmath={{"contract", "reassoc", "nsz", "arcp"}})
INLINE = dict(nogil=True, inline="always", error_model="numpy", fastmath={{"contract", "reassoc", "nsz", "arcp"}})

ONE, TWO, THREE = float64[::1], float64[:, ::1], float64[:, :, ::1]
GIVEN, TABLE, BLOCKS = (types.Array(float64, n, "C", readonly=True) for n in (1, 2, 3))
THETA = types.UniTuple(float64, P)
STARS = (*[GIVEN] * 6, types.Array(int64, 1, "C", readonly=True), BLOCKS)
FRAME_SUMS = types.void(THETA, *STARS, TWO, TWO, TWO, THREE, THREE, ONE)
FRAMED = (*[GIVEN] * 5, types.Array(int64, 1, "C", readonly=True))
TURNED = types.void(TABLE, BLOCKS, THREE)
ATTITUDES = types.int64(THETA, *FRAMED, THREE)
PAIR_SUMS = types.float64(THETA, *FRAMED, BLOCKS, TWO, TWO)
GRAM_SUMS = types.void(THETA, types.UniTuple(float64, P * P), *STARS, TABLE, BLOCKS, BLOCKS, TWO, ONE)
"""

_LOOPS = '''
@njit(**FAST, **HELPER)
def fill_root(theta, buf, row, target, m):
    """Newton's method for the points that a model displaces to the targets; as `solve_displacement` does it."""
    flat = True
    for q in range(3, P):
        flat = flat and theta[q] == 0.0
    for i in range(m):
        buf[row * STRIDE + i], buf[(row + 1) * STRIDE + i] = buf[target * STRIDE + i], buf[(target + 1) * STRIDE + i]
    if flat:
        return
    for step in range(60):
        moving = 0.0
        for i in range(m):
            u, v = buf[row * STRIDE + i], buf[(row + 1) * STRIDE + i]
            newton(theta, buf[target * STRIDE + i], buf[(target + 1) * STRIDE + i], u, v, buf, row, i)
            du, dv = buf[row * STRIDE + i] - u, buf[(row + 1) * STRIDE + i] - v
            far = max(abs(du), abs(dv)) >= 1e-5
            # Past a fold the determinant changes sign: that branch is not an image of the field.
            lost = not buf[(row + 2) * STRIDE + i] > 0.0 or (far and step == 59)
            moving += 1.0 if far and not lost else 0.0
            if lost:
                buf[row * STRIDE + i], buf[(row + 1) * STRIDE + i] = np.nan, np.nan
        if moving == 0.0:
            return


@njit(**FAST, **HELPER)
def fill_directions(theta, r0, r1, r2, starts, rotations, s0, m, first, work):
    """Directions of a chunk in the camera frame into rows 0 to 2 of `work`, roots into rows 3 and 4."""
    f, j = first, starts[0]
    while j < m:
        while starts[f + 1] <= s0 + j:
            f += 1
        end = min(starts[f + 1] - s0, m)
        a00, a01, a02 = rotations[f, 0, 0], rotations[f, 0, 1], rotations[f, 0, 2]
        a10, a11, a12 = rotations[f, 1, 0], rotations[f, 1, 1], rotations[f, 1, 2]
        a20, a21, a22 = rotations[f, 2, 0], rotations[f, 2, 1], rotations[f, 2, 2]
        for i in range(j, end):
            x, y, z = r0[s0 + i], r1[s0 + i], r2[s0 + i]
            work[i] = a00 * x + a01 * y + a02 * z
            work[STRIDE + i] = a10 * x + a11 * y + a12 * z
            work[2 * STRIDE + i] = a20 * x + a21 * y + a22 * z
        j = end
    if EXPLICIT:
        return
    for i in range(m):
        scale = theta[2] / work[2 * STRIDE + i]
        work[6 * STRIDE + i] = scale * work[i]
        work[7 * STRIDE + i] = scale * work[STRIDE + i]
    fill_root(theta, work, 3, 6, m)


@njit(**FAST, **HELPER)
def fill_columns(theta, turn, x0, y0, r0, r1, r2, weight, starts, rotations, s0, m, first, work, buf):
    """A, e and H' of a chunk."""
    fill_directions(theta, r0, r1, r2, starts, rotations, s0, m, first, work)
    for i in range(m):
        x, y, z, u, v = work[i], work[STRIDE + i], work[2 * STRIDE + i], work[3 * STRIDE + i], work[4 * STRIDE + i]
        first_kernel(theta, x, y, z, u, v, buf, i)
    for i in range(m):
        buf[6 * STRIDE + i] = x0[s0 + i] - buf[6 * STRIDE + i]
        buf[7 * STRIDE + i] = y0[s0 + i] - buf[7 * STRIDE + i]
    if len(weight) > 0:
        for q in range(2 * ROWS):
            for i in range(m):
                buf[q * STRIDE + i] *= weight[s0 + i]
    for q in range(P):
        t0, t1, t2 = turn[0, q], turn[1, q], turn[2, q]
        for x in range(2):
            o = (8 + 2 * q + x) * STRIDE
            for i in range(m):
                buf[o + i] -= (
                    t0 * buf[x * STRIDE + i] + t1 * buf[(2 + x) * STRIDE + i] + t2 * buf[(4 + x) * STRIDE + i]
                )


@njit(**FAST, **HELPER)
def inverse3(acc, out):
    """Inverse of the symmetric 3 x 3 matrix in the upper corner of `acc`: six entries; its determinant comes back."""
    xx, xy, xz, yy, yz, zz = acc[0, 0], acc[0, 1], acc[0, 2], acc[1, 1], acc[1, 2], acc[2, 2]
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * a + xy * b + xz * c
    out[0], out[1], out[2] = a / determinant, b / determinant, c / determinant
    out[3], out[4] = (xx * zz - xz * xz) / determinant, (xy * xz - xx * yz) / determinant
    out[5] = (xx * yy - xy * xy) / determinant
    return determinant


@njit(FRAME_SUMS, **FAST)
def frame_sums(theta, x0, y0, r0, r1, r2, weight, starts, rotations, residuals, gram, shift, response, inverse, volume):
    work, buf = np.zeros(8 * STRIDE), np.empty(2 * ROWS * STRIDE)
    acc, inv, turn = np.zeros((3, ROWS)), np.empty(6), np.zeros((3, P))
    # Offsets begin at zero; a literal one would have every function compiled for its type.
    zero = starts[0]
    n, first, s0 = starts[len(starts) - 1], zero, zero
    m = min(zero + CHUNK, n)
    fill_columns(theta, turn, x0, y0, r0, r1, r2, weight, starts, rotations, zero, m, zero, work, buf)
    frame_products(buf, zero, m, acc)
    inverse3(acc, inv)
    for q in range(P):
        a, b, c = acc[0, 4 + q], acc[1, 4 + q], acc[2, 4 + q]
        turn[0, q] = inv[0] * a + inv[1] * b + inv[2] * c
        turn[1, q] = inv[1] * a + inv[3] * b + inv[4] * c
        turn[2, q] = inv[2] * a + inv[4] * b + inv[5] * c
    if not np.all(np.isfinite(turn)):
        turn[:] = 0.0
    acc[:] = 0.0
    while s0 < n:
        m = min(zero + CHUNK, n - s0)
        fill_columns(theta, turn, x0, y0, r0, r1, r2, weight, starts, rotations, s0, m, first, work, buf)
        if residuals.shape[1] > 0:
            for x in range(2):
                for i in range(m):
                    residuals[x, s0 + i] = buf[(6 + x) * STRIDE + i]
        chunk_products(buf, m, gram)
        f, j = first, zero
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            frame_products(buf, j, end, acc)
            j = end
            if s0 + j == starts[f + 1]:
                volume[f] = np.log(inverse3(acc, inv))
                inverse[0, 0, f], inverse[0, 1, f], inverse[0, 2, f] = inv[0], inv[1], inv[2]
                inverse[1, 0, f], inverse[1, 1, f], inverse[1, 2, f] = inv[1], inv[3], inv[4]
                inverse[2, 0, f], inverse[2, 1, f], inverse[2, 2, f] = inv[2], inv[4], inv[5]
                for q in range(P + 1):
                    s, t, u = acc[0, 3 + q], acc[1, 3 + q], acc[2, 3 + q]
                    g0 = inv[0] * s + inv[1] * t + inv[2] * u
                    g1 = inv[1] * s + inv[3] * t + inv[4] * u
                    g2 = inv[2] * s + inv[4] * t + inv[5] * u
                    for p in range(q + 1):
                        gram[p, q] -= acc[0, 3 + p] * g0 + acc[1, 3 + p] * g1 + acc[2, 3 + p] * g2
                    if q == 0:
                        shift[0, f], shift[1, f], shift[2, f] = g0, g1, g2
                    else:
                        response[0, q - 1, f] = -g0 - turn[0, q - 1]
                        response[1, q - 1, f] = -g1 - turn[1, q - 1]
                        response[2, q - 1, f] = -g2 - turn[2, q - 1]
                acc[:] = 0.0
        first = f
        s0 += m
'''

_PAIRS = '''
@njit(**FAST, **HELPER)
def last_of_chunk(starts, first):
    last = first + 1
    while last < len(starts) - 1 and starts[last + 1] - starts[first] <= CHUNK:
        last += 1
    return last


@njit(**FAST, **HELPER)
def fill_backward(theta, x0, y0, s0, m, work, buf):
    for i in range(m):
        work[i], work[STRIDE + i] = x0[s0 + i] - theta[0], y0[s0 + i] - theta[1]
    if EXPLICIT:
        fill_root(theta, work, 3, 0, m)


@njit(**ORDERED, **HELPER)
def solve_attitude(profile, n, f, rotations):
    """QUEST for one frame, as `starcal_uq.attitude.wahba` has it, from its sums of b r^T; 1 if it is determined."""
    xx, xy, xz = profile[0, 0] / n, profile[0, 1] / n, profile[0, 2] / n
    yx, yy, yz = profile[1, 0] / n, profile[1, 1] / n, profile[1, 2] / n
    zx, zy, zz = profile[2, 0] / n, profile[2, 1] / n, profile[2, 2] / n
    c0, c1, c2 = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    c3, c4, c5 = xz * zy - xy * zz, xx * zz - xz * zx, xy * zx - xx * zy
    c6, c7, c8 = xy * yz - xz * yy, xz * yx - xx * yz, xx * yy - xy * yx
    norm2 = xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz + zx * zx + zy * zy + zz * zz
    adjoint2 = c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3 + c4 * c4 + c5 * c5 + c6 * c6 + c7 * c7 + c8 * c8
    det = xx * c0 + xy * c1 + xz * c2
    lam, step = 1.0, 1.0
    for _ in range(60):
        a = lam * lam - norm2
        slope = 4.0 * lam * a - 8.0 * det
        value = max(a * a - 8.0 * lam * det - 4.0 * adjoint2, 0.0)
        step = min(value / (slope if slope > 0.0 else 1.0), step)
        lam -= step
        if not step > 4e-16:
            break
    # The largest row of the adjugate of K - lambda I.
    a00, a11, a22, a33 = xx - yy - zz - lam, yy - xx - zz - lam, zz - xx - yy - lam, xx + yy + zz - lam
    a01, a02, a12, a03, a13, a23 = xy + yx, xz + zx, yz + zy, zy - yz, xz - zx, yx - xy
    s0, s1, s2 = a00 * a11 - a01 * a01, a00 * a12 - a01 * a02, a00 * a13 - a01 * a03
    s3, s4, s5 = a01 * a12 - a11 * a02, a01 * a13 - a11 * a03, a02 * a13 - a12 * a03
    c5, c4, c3 = a22 * a33 - a23 * a23, a12 * a33 - a13 * a23, a12 * a23 - a13 * a22
    c2, c1 = a02 * a33 - a03 * a23, a02 * a23 - a03 * a22
    d00, d11 = a11 * c5 - a12 * c4 + a13 * c3, a00 * c5 - a02 * c2 + a03 * c1
    d22, d33 = a03 * s4 - a13 * s2 + a33 * s0, a02 * s3 - a12 * s1 + a22 * s0
    d01, d02, d03 = a02 * c4 - a01 * c5 - a03 * c3, a13 * s5 - a23 * s4 + a33 * s3, a22 * s4 - a12 * s5 - a23 * s3
    d12, d13, d23 = a23 * s2 - a03 * s5 - a33 * s1, a02 * s5 - a22 * s2 + a23 * s1, a12 * s2 - a02 * s4 - a23 * s0
    if min(d00, d11) < min(d22, d33):
        x, y, z, w = (d00, d01, d02, d03) if d00 < d11 else (d01, d11, d12, d13)
    else:
        x, y, z, w = (d02, d12, d22, d23) if d22 < d33 else (d03, d13, d23, d33)
    # One Newton step of Wahba's loss on the rotation vector.
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    fill_rotation(x, y, z, w, rotations, f)
    r = rotations[f]
    m00, m11 = xx * r[0, 0] + xy * r[0, 1] + xz * r[0, 2], yx * r[1, 0] + yy * r[1, 1] + yz * r[1, 2]
    m01, m10 = xx * r[1, 0] + xy * r[1, 1] + xz * r[1, 2], yx * r[0, 0] + yy * r[0, 1] + yz * r[0, 2]
    m02, m20 = xx * r[2, 0] + xy * r[2, 1] + xz * r[2, 2], zx * r[0, 0] + zy * r[0, 1] + zz * r[0, 2]
    m12, m21 = yx * r[2, 0] + yy * r[2, 1] + yz * r[2, 2], zx * r[1, 0] + zy * r[1, 1] + zz * r[1, 2]
    m22 = zx * r[2, 0] + zy * r[2, 1] + zz * r[2, 2]
    gx, gy, gz = m21 - m12, m02 - m20, m10 - m01
    hxx, hyy, hzz = m11 + m22, m00 + m22, m00 + m11
    hxy, hxz, hyz = -0.5 * (m01 + m10), -0.5 * (m02 + m20), -0.5 * (m12 + m21)
    ixx, iyy, izz = hyy * hzz - hyz * hyz, hxx * hzz - hxz * hxz, hxx * hyy - hxy * hxy
    ixy, ixz, iyz = hxz * hyz - hxy * hzz, hxy * hyz - hxz * hyy, hxy * hxz - hxx * hyz
    det = hxx * ixx + hxy * ixy + hxz * ixz
    curvature, minors = 0.0, ixx + iyy + izz
    if det > 0.0:
        px = 0.5 * (ixx * gx + ixy * gy + ixz * gz) / det
        py = 0.5 * (ixy * gx + iyy * gy + iyz * gz) / det
        pz = 0.5 * (ixz * gx + iyz * gy + izz * gz) / det
        x, y, z, w = (
            x + px * w + py * z - pz * y,
            y - px * z + py * w + pz * x,
            z + px * y - py * x + pz * w,
            w - px * x - py * y - pz * z,
        )
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        fill_rotation(x / norm, y / norm, z / norm, w / norm, rotations, f)
        curvature = det / minors if minors > 0.0 else 0.0
    if np.isfinite(norm2) and np.isfinite(lam) and min(curvature, np.sqrt(adjoint2 / norm2)) > DEGENERATE:
        return 1
    rotations[f] = np.nan
    return 0


@njit(**ORDERED, **HELPER)
def fill_rotation(x, y, z, w, rotations, f):
    rotations[f, 0, 0], rotations[f, 0, 1] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w)
    rotations[f, 1, 1], rotations[f, 1, 0] = 1.0 - 2.0 * (x * x + z * z), 2.0 * (x * y + z * w)
    rotations[f, 2, 2], rotations[f, 2, 1] = 1.0 - 2.0 * (x * x + y * y), 2.0 * (y * z + x * w)
    rotations[f, 0, 2], rotations[f, 1, 2] = 2.0 * (x * z + y * w), 2.0 * (y * z - x * w)
    rotations[f, 2, 0] = 2.0 * (x * z - y * w)


@njit(TURNED, **ORDERED)
def turned(steps, rotations, out):
    turn = np.empty((1, 3, 3))
    for f in range(len(rotations)):
        x, y, z = 0.5 * steps[0, f], 0.5 * steps[1, f], 0.5 * steps[2, f]
        half = np.sqrt(x * x + y * y + z * z)
        along = np.sin(half) / half if half > 0.0 else 1.0
        fill_rotation(x * along, y * along, z * along, np.cos(half), turn, 0)
        for i in range(3):
            a, b, c = turn[0, i, 0], turn[0, i, 1], turn[0, i, 2]
            for k in range(3):
                out[f, i, k] = a * rotations[f, 0, k] + b * rotations[f, 1, k] + c * rotations[f, 2, k]


@njit(ATTITUDES, **FAST)
def attitudes(theta, x0, y0, r0, r1, r2, starts, rotations):
    work, buf, profile = np.zeros(8 * STRIDE), np.empty(6 * STRIDE), np.zeros((3, 3))
    n_frames, first, sound = len(starts) - 1, 0, 0
    while first < n_frames:
        s0, last = starts[first], last_of_chunk(starts, first)
        m = starts[last] - s0
        fill_backward(theta, x0, y0, s0, m, work, buf)
        for i in range(m):
            direction_kernel(theta, x0[s0 + i], y0[s0 + i], work[3 * STRIDE + i], work[4 * STRIDE + i], buf, i)
        for i in range(m):
            buf[3 * STRIDE + i], buf[4 * STRIDE + i], buf[5 * STRIDE + i] = r0[s0 + i], r1[s0 + i], r2[s0 + i]
        for f in range(first, last):
            profile[:] = 0.0
            pair_profile(buf, starts[f] - s0, starts[f + 1] - s0, profile)
            sound += solve_attitude(profile, starts[f + 1] - starts[f], f, rotations)
        first = last
    return sound


@njit(PAIR_SUMS, **FAST)
def pair_sums(theta, x0, y0, r0, r1, r2, starts, rotations, scores, matrix):
    # Rows of the buffer: b, its derivatives, R', E, D B, and of each star's frame B^T B and E^T B.
    R, E, BB, EB = 3 + 3 * P, 6 + 3 * P, 12 + 3 * P, 18 + 3 * P
    work, buf = np.zeros(8 * STRIDE), np.empty((27 + 3 * P) * STRIDE)
    acc, eb, bb, score = np.empty((3, 3 * P + 9)), np.empty((3, 3)), np.empty((3, 3)), np.empty(P)
    n_frames = len(starts) - 1
    cost, first = 0.0, 0
    while first < n_frames:
        s0, last = starts[first], last_of_chunk(starts, first)
        m = starts[last] - s0
        fill_backward(theta, x0, y0, s0, m, work, buf)
        for i in range(m):
            backward_kernel(theta, x0[s0 + i], y0[s0 + i], work[3 * STRIDE + i], work[4 * STRIDE + i], buf, i)
        for f in range(first, last):
            a00, a01, a02 = rotations[f, 0, 0], rotations[f, 0, 1], rotations[f, 0, 2]
            a10, a11, a12 = rotations[f, 1, 0], rotations[f, 1, 1], rotations[f, 1, 2]
            a20, a21, a22 = rotations[f, 2, 0], rotations[f, 2, 1], rotations[f, 2, 2]
            for i in range(starts[f] - s0, starts[f + 1] - s0):
                x, y, z = r0[s0 + i], r1[s0 + i], r2[s0 + i]
                buf[R * STRIDE + i] = a00 * x + a01 * y + a02 * z
                buf[(R + 1) * STRIDE + i] = a10 * x + a11 * y + a12 * z
                buf[(R + 2) * STRIDE + i] = a20 * x + a21 * y + a22 * z
        for q in range(3):
            for i in range(m):
                buf[(E + q) * STRIDE + i] = buf[q * STRIDE + i] - buf[(R + q) * STRIDE + i]
        for f in range(first, last):
            j, end = starts[f] - s0, starts[f + 1] - s0
            acc[:] = 0.0
            pair_products_0(buf, j, end, acc)
            pair_products_1(buf, j, end, acc)
            pair_products_2(buf, j, end, acc)
            for a in range(3):
                for c in range(3):
                    rr, ee = acc[min(a, c), 3 * P + max(a, c)], acc[min(a, c), 3 * P + 6 + max(a, c)]
                    re, er = acc[a, 3 * P + 3 + c], acc[c, 3 * P + 3 + a]
                    cost += ee * rr + re * er + ee * (2.0 * re + 0.5 * ee)
                    eb[a, c] = er + ee
                    bb[a, c] = rr + re + er + ee
            for a in range(3):
                for c in range(3):
                    value = eb[a, c]
                    for i in range(j, end):
                        buf[(EB + 3 * a + c) * STRIDE + i] = value
                for c in range(a, 3):
                    value = bb[a, c]
                    for i in range(j, end):
                        buf[(BB + 3 * a - a * (a + 1) // 2 + c) * STRIDE + i] = value
            for a in range(P):
                for c in range(a, P):
                    total = 0.0
                    for x in range(3):
                        for y in range(3):
                            total += acc[x, 3 * a + y] * acc[y, 3 * c + x]
                    matrix[a, c] += total
        pair_matrix(buf, m, matrix)
        for f in range(first, last):
            score[:] = 0.0
            pair_scores(buf, starts[f] - s0, starts[f + 1] - s0, score)
            for a in range(P):
                scores[a, f] = score[a]
        first = last
    return cost
'''


_GRAM = """
@njit(GRAM_SUMS, **FAST)
def gram_sums(theta, l, x0, y0, r0, r1, r2, weight, starts, rotations, shift, path, inverse, gram, slope):
    work, buf = np.zeros(8 * STRIDE), np.zeros(GRAM_ROWS * STRIDE)
    acc = np.zeros((3, SECOND))
    zero = starts[0]
    n, first, s0 = starts[len(starts) - 1], zero, zero
    while s0 < n:
        m = min(zero + GRAM_CHUNK, n - s0)
        fill_directions(theta, r0, r1, r2, starts, rotations, s0, m, first, work)
        for i in range(m):
            x, y, z, u, v = work[i], work[STRIDE + i], work[2 * STRIDE + i], work[3 * STRIDE + i], work[4 * STRIDE + i]
            bent_kernel(theta, x, y, z, u, v, buf, i)
        for i in range(m):
            buf[i], buf[STRIDE + i] = x0[s0 + i] - buf[i], y0[s0 + i] - buf[STRIDE + i]
        if len(weight) > 0:
            for q in range(PATH):
                for i in range(m):
                    buf[q * STRIDE + i] *= weight[s0 + i]
        f, j = first, zero
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            for c in range(3):
                for a in range(P):
                    value = path[c, a, f]
                    for i in range(j, end):
                        buf[(PATH + P * c + a) * STRIDE + i] = value
                value = shift[c, f]
                for i in range(j, end):
                    buf[(PATH + 3 * P + c) * STRIDE + i] = value
                for d in range(c, 3):
                    value = inverse[c, d, f]
                    o = (PATH + 3 * P + 3 + (3 * c - c * (c - 1) // 2 + d - c)) * STRIDE
                    for i in range(j, end):
                        buf[o + i] = value
            j = end
        expand_0(l, buf, m, slope)
        expand_1(l, buf, m, slope)
        for p in range(Q):
            for q in range(p, Q, 4):
                t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
                for x in range(2):
                    o, o2 = (COLUMNS + 2 * p + x) * STRIDE, (COLUMNS + 2 * q + x) * STRIDE
                    for i in range(m):
                        v = buf[o + i]
                        t0 += v * buf[o2 + i]
                        t1 += v * buf[o2 + 2 * STRIDE + i]
                        t2 += v * buf[o2 + 4 * STRIDE + i]
                        t3 += v * buf[o2 + 6 * STRIDE + i]
                gram[p, q] += t0
                gram[p, q + 1] += t1
                gram[p, q + 2] += t2
                gram[p, q + 3] += t3
        f, j = first, zero
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            second_0(buf, j, end, acc)
            second_1(buf, j, end, acc)
            second_2(buf, j, end, acc)
            j = end
            if s0 + j == starts[f + 1]:
                for p in range(SECOND):
                    a, b, c = acc[0, p], acc[1, p], acc[2, p]
                    g0 = inverse[0, 0, f] * a + inverse[0, 1, f] * b + inverse[0, 2, f] * c
                    g1 = inverse[1, 0, f] * a + inverse[1, 1, f] * b + inverse[1, 2, f] * c
                    g2 = inverse[2, 0, f] * a + inverse[2, 1, f] * b + inverse[2, 2, f] * c
                    for q in range(p, SECOND):
                        gram[1 + P + p, 1 + P + q] -= acc[0, q] * g0 + acc[1, q] * g1 + acc[2, q] * g2
                acc[:] = 0.0
        first = f
        s0 += m
"""


def _star_source(
    kernel: Kernel,
    name: str,
    into: Callable[[int, int], object],
    inputs: str = "x, y",
    given: str = "",
) -> str:
    """A kernel for one star: `into` tells the row of the buffer of an element of an output, in
    column i.

    Its inputs are the parameters t, those of the star and the root u, v; `given` are further names
    that `into` uses.
    """

    def read(source: int, element: int) -> str:
        return (
            f"t[{element}]"
            if source == 0
            else (inputs.split(", "), ("u", "v"))[source - 1][element]
        )

    def write(output: int, element: int) -> str:
        return f"out[({into(output, element)}) * STRIDE + i]"

    return emit_source(kernel.function, name, f"t, {inputs}, u, v, out, {given}i", read, write)


# An entry of an array, and the pairs of rows whose products are summed into it.
_Sums = list[tuple[str, list[tuple[int, int]]]]


def _sums_source(name: str, arguments: str, begin: str, end: str, sums: _Sums) -> str:
    """Sums of products of rows from column `begin` to `end`, added to entries of arrays."""
    needed = sorted({row for _, pairs in sums for pair in pairs for row in pair})
    lines = [f"def {name}({arguments}):"]
    lines += [f"    s{n} = 0.0" for n in range(len(sums))]
    lines.append(f"    for i in range({begin}, {end}):")
    lines += [f"        v{row} = buf[{row} * STRIDE + i]" for row in needed]
    for n, (_, pairs) in enumerate(sums):
        lines.append(f"        s{n} += " + " + ".join(f"v{a} * v{b}" for a, b in pairs))
    lines += [f"    {target} += s{n}" for n, (target, _) in enumerate(sums)]
    return "\n".join(lines) + "\n"


def _normal_sources(rows: int) -> list[str]:
    """Products of A with A, e and H of a frame, and those of e and H among themselves of a
    chunk.
    """

    def products(name: str, pairs: list[tuple[int, int]], offset: int) -> _Sums:
        return [
            (f"{name}[{a - offset}, {b - offset}]", [(2 * a + x, 2 * b + x) for x in range(2)])
            for a, b in pairs
        ]

    with_attitude = [(c, q) for c in range(3) for q in range(c, rows)]
    among = [(a, b) for a in range(3, rows) for b in range(a, rows)]
    frame = _sums_source(
        "frame_products", "buf, j, end, acc", "j", "end", products("acc", with_attitude, 0)
    )
    chunk = _sums_source("chunk_products", "buf, m, gram", "0", "m", products("gram", among, 3))
    return ["@njit(**ORDERED, **HELPER)\n" + frame, "@njit(**FAST, **HELPER)\n" + chunk]


def _pair_sources(p: int) -> list[str]:
    """Sums over a frame or a chunk for the interstar angles; rows as `pair_sums` fills them."""
    db, r, e, d, bb, eb = 3, 3 + 3 * p, 6 + 3 * p, 9 + 3 * p, 12 + 3 * p, 18 + 3 * p
    profile: _Sums = [(f"profile[{i}, {k}]", [(i, 3 + k)]) for i in range(3) for k in range(3)]
    sources = [
        "@njit(**ORDERED, **HELPER)\n"
        + _sums_source("pair_profile", "buf, j, end, profile", "j", "end", profile)
    ]
    # B^T [dB], R'^T [R' E] and E^T [E] of a frame, of the symmetric ones half: one sum more costs
    # what it adds.
    for x in range(3):
        sums = [(f"acc[{x}, {q}]", [(x, db + q)]) for q in range(3 * p)]
        sums += [(f"acc[{x}, {3 * p + c}]", [(r + x, r + c)]) for c in range(x, 3)]
        sums += [(f"acc[{x}, {3 * p + 3 + c}]", [(r + x, e + c)]) for c in range(3)]
        sums += [(f"acc[{x}, {3 * p + 6 + c}]", [(e + x, e + c)]) for c in range(x, 3)]
        products = _sums_source(f"pair_products_{x}", "buf, j, end, acc", "j", "end", sums)
        sources.append("@njit(**ORDERED, **HELPER)\n" + products)
    pairs = [(a, c) for a in range(p) for c in range(a, p)]
    lines = [
        "def pair_matrix(buf, m, matrix):",
        *(f"    s{n} = 0.0" for n in range(len(pairs))),
        "    for i in range(m):",
    ]
    lines += [
        f"        v{row} = buf[{row} * STRIDE + i]" for row in (*range(db, d), *range(bb, eb + 9))
    ]
    for c in range(3):
        terms_of = [
            f"v{eb + 3 * a + c} * v{r + a} + v{bb + _packed(a, c)} * v{e + a}" for a in range(3)
        ]
        lines.append(f"        buf[{d + c} * STRIDE + i] = " + " + ".join(terms_of))
    for a in range(p):
        for c in range(3):
            weighed = " + ".join(f"v{bb + _packed(c, x)} * v{db + 3 * a + x}" for x in range(3))
            lines.append(f"        w{a}_{c} = {weighed}")
    for n, (a, c) in enumerate(pairs):
        lines.append(
            f"        s{n} += " + " + ".join(f"w{a}_{x} * v{db + 3 * c + x}" for x in range(3))
        )
    lines += [f"    matrix[{a}, {c}] += s{n}" for n, (a, c) in enumerate(pairs)]
    sources.append("@njit(**FAST, **HELPER)\n" + "\n".join(lines) + "\n")
    scores: _Sums = [(f"score[{a}]", [(db + 3 * a + i, d + i) for i in range(3)]) for a in range(p)]
    sources.append(
        "@njit(**ORDERED, **HELPER)\n"
        + _sums_source("pair_scores", "buf, j, end, score", "j", "end", scores)
    )
    return sources


def _packed(i: int, j: int) -> int:
    """Place of an entry of a symmetric matrix among its six unique ones."""
    return 3 * min(i, j) - min(i, j) * (min(i, j) + 1) // 2 + max(i, j)


def _row(number: int) -> str:
    return f"buf[{number} * STRIDE + i]"


def _sum_of(terms: list[str]) -> str:
    return " + ".join(terms) if terms else "0.0"


def _expansion_sources(model_name: str, p: int) -> list[str]:
    """Columns of the compressed likelihood of a chunk, as `compressed._Expansion` forms them, one
    axis each.

    Rows of the buffer: e, H, A and the second derivatives that do not vanish, two axes each; of
    each star's frame the path (3, p), the shift (3) and the inverse (6); then the columns, two axes
    each, and what one axis needs meanwhile. A loop holds no more values than there are registers
    for. The whitening l is lower triangular.
    """
    rows, columns = (index.tolist() for index in bent_index(model_name))
    h, a, bent = 2, 2 + 2 * p, 8 + 2 * p
    path = bent + 2 * len(rows)
    shift, inverse = path + 3 * p, path + 3 * p + 3
    out = inverse + 6
    q = (p + 1) * (p + 2) // 2
    turned, pseudo = out + 2 * q + 8, out + 2 * q + 8 + 3 * p
    at = {(0, 0): 0, (0, 1): 1, (0, 2): 2, (1, 1): 3, (1, 2): 4, (2, 2): 5}
    own = [(n, t, d) for n, (t, d) in enumerate(zip(rows, columns, strict=True)) if d < p]
    sources = [
        f"PATH, COLUMNS, Q, SECOND, GRAM_ROWS = {path}, {out}, {q}, {q - p - 1}, {pseudo + 3}"
    ]
    for x in range(2):
        lines = [f"def expand_{x}(l, buf, m, slope):"]

        def loop(body: list[str], lines: list[str] = lines) -> None:
            lines += ["    for i in range(m):", *(f"        {line}" for line in body)]

        body = [f"a{c} = {_row(a + 2 * c + x)}" for c in range(3)] + [
            f"h{t} = {_row(h + 2 * t + x)}" for t in range(p)
        ]
        taken = _sum_of([f"{_row(shift + c)} * a{c}" for c in range(3)])
        body.append(f"{_row(out + x)} = {_row(x)} - ({taken})")
        for c in range(3):
            terms = [f"{_row(inverse + at[min(c, d), max(c, d)])} * a{d}" for d in range(3)]
            body.append(f"{_row(pseudo + c)} = {_sum_of(terms)}")
        for z in range(p):
            terms = [f"l[{t * p + z}] * h{t}" for t in range(z, p)]
            terms += [f"{_row(path + p * c + z)} * a{c}" for c in range(3)]
            body.append(f"{_row(out + 2 + 2 * z + x)} = -({_sum_of(terms)})")
        loop(body)
        # The derivatives of A along z, and half of what the path itself bends.
        for z in range(p):
            body = [f"q{n} = {_row(bent + 2 * n + x)}" for n, d in enumerate(columns) if d >= p]
            body += [f"k{d} = {_row(path + p * d + z)}" for d in range(3)]
            for c in range(3):
                mixed = [
                    f"l[{t * p + z}] * q{n}"
                    for n, (t, d) in enumerate(zip(rows, columns, strict=True))
                    if z <= t < p and d == p + c
                ]
                along = [
                    f"k{d} * q{n}"
                    for n, (one, two) in enumerate(zip(rows, columns, strict=True))
                    for b, d in {(one - p, two - p), (two - p, one - p)}
                    if one >= p and b == c
                ]
                body += [f"m{c}, r{c} = {_sum_of(mixed)}, {_sum_of(along)}"]
                body += [f"{_row(turned + 3 * z + c)} = m{c} + 0.5 * r{c}"]
            body.append(
                "t += " + _sum_of([f"{_row(pseudo + c)} * (m{c} + r{c})" for c in range(3)])
            )
            lines.append("    t = 0.0")
            loop(body)
            lines.append(f"    slope[{z}] += 2.0 * t")
        column = 1 + p
        for z in range(p):
            body = [f"q{n} = {_row(bent + 2 * n + x)}" for n, _, _ in own]
            body += [
                f"u{c}, k{c} = {_row(turned + 3 * z + c)}, {_row(path + p * c + z)}"
                for c in range(3)
            ]
            for y in range(z, p):
                # A diagonal entry of z z^T stands once in the expansion, halved; the others stand
                # for both orders.
                weights = {
                    n: [
                        f"l[{one * p + z}] * l[{two * p + y}]"
                        for one, two in {(t, d), (d, t)}
                        if z <= one and y <= two
                    ]
                    for n, t, d in own
                }
                used = [n for n, terms in weights.items() if terms]
                lines += [
                    f"    c{y}_{n} = {-0.5 if z == y else -1.0} * ({_sum_of(weights[n])})"
                    for n in used
                ]
                bends = [
                    f"u{c} * k{c}"
                    if z == y
                    else f"(u{c} * {_row(path + p * c + y)} + k{c} * {_row(turned + 3 * y + c)})"
                    for c in range(3)
                ]
                plain = _sum_of([f"c{y}_{n} * q{n}" for n in used])
                body.append(f"{_row(out + 2 * column + x)} = {plain} - ({_sum_of(bends)})")
                column += 1
            loop(body)
        sources.append("@njit(**FAST, **HELPER)\n" + "\n".join(lines) + "\n")
    for part in range(3):
        sums: _Sums = [
            (f"acc[{c}, {n}]", [(a + 2 * c + x, out + 2 * (1 + p + n) + x) for x in range(2)])
            for n in range(part, q - p - 1, 3)
            for c in range(3)
        ]
        sources.append(
            "@njit(**ORDERED, **HELPER)\n"
            + _sums_source(f"second_{part}", "buf, j, end, acc", "j", "end", sums)
        )
    return sources


@lru_cache(maxsize=16)
def source(model_name: str) -> str:
    """Source of the loops for one distortion model."""
    p = 3 + len(get_model(model_name).coefficients)
    rows = p + 4
    explicit = get_model(model_name).direction == "forward"
    first, bent = (6, 8, 0), (0, 2, 2 + 2 * p, 8 + 2 * p)
    functions = [
        _star_source(
            forward_kernel(model_name, "first"),
            "first_kernel",
            lambda o, n: first[o] + n,
            "x, y, z",
        ),
        _star_source(
            newton_kernel(model_name), "newton", lambda o, n: f"row + {2 * o + n}", given="row, "
        ),
        _star_source(backward_kernel(model_name, False), "direction_kernel", lambda o, n: n),
        # Derivatives come as rows of (p, 3).
        _star_source(backward_kernel(model_name, True), "backward_kernel", lambda o, n: 3 * o + n),
        _star_source(
            forward_kernel(model_name, "bent"), "bent_kernel", lambda o, n: bent[o] + n, "x, y, z"
        ),
    ]
    head = _HEAD.format(
        p=p, stride=_STRIDE, chunk=_CHUNK, rows=rows, explicit=explicit, degenerate=DEGENERATE
    )
    inlined = ["@njit(**INLINE)\n" + kernel for kernel in functions]
    parts = [head, *inlined, *_normal_sources(rows), *_pair_sources(p), _LOOPS, _PAIRS]
    parts += [*_expansion_sources(model_name, p), _GRAM]
    return "\n\n".join(parts)


def kernels(model_name: str, n_stars: int) -> str:
    """Path of the sums over so many stars: ``numba`` for the compiled loops, or ``numpy``."""
    return compiled.chosen(n_stars, lambda: source(model_name))


def _stars(frames: StarFrames, rotations: FloatArray) -> tuple[Any, ...]:
    weight = _NONE if frames.weight is None else np.ascontiguousarray(frames.weight)
    return (*frames.pixel, *frames.r, weight, frames.starts, np.ascontiguousarray(rotations))


def _both(upper: FloatArray) -> FloatArray:
    """A symmetric matrix from its upper triangle, zeros below."""
    whole = upper + upper.T
    whole.flat[:: len(whole) + 1] = upper.diagonal()
    return whole


def frame_loop(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    residuals: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Gram matrix (p + 1, p + 1) of e and H with the attitudes eliminated, and what `Attitudes`
    holds of every frame.

    Shift (3, K), response (3, p, K), inverse (3, 3, K) and log determinant (K,): see
    `starcal_uq.likelihood.sums`.
    """
    p, k = len(theta), frames.n_frames
    gram, shift, response = np.zeros((p + 1, p + 1)), np.empty((3, k)), np.empty((3, p, k))
    inverse, volume = np.empty((3, 3, k)), np.empty(k)
    into = np.empty((2, 0)) if residuals is None else residuals
    loops = compiled.load(model_name, source(model_name))
    loops.frame_sums(
        tuple(theta.tolist()),
        *_stars(frames, rotations),
        into,
        gram,
        shift,
        response,
        inverse,
        volume,
    )
    return _both(gram), shift, response, inverse, volume


def attitude_loop(
    frames: StarFrames, model_name: str, theta: FloatArray
) -> tuple[FloatArray, bool] | None:
    """Attitudes (K, 3, 3) by QUEST at theta, without weights, NaN where stars determine none;
    whether they all do.

    None where a frame has more stars than the loops take.
    """
    if int(frames.sizes.max()) > _CHUNK:
        return None
    rotations = np.empty((frames.n_frames, 3, 3))
    loops = compiled.load(model_name, source(model_name))
    sound = loops.attitudes(
        tuple(theta.tolist()), *frames.pixel, *frames.r, frames.starts, rotations
    )
    return rotations, sound == frames.n_frames


def turned_loop(model_name: str, steps: FloatArray, rotations: FloatArray) -> FloatArray:
    """Rotations (K, 3, 3) after small ones, of vectors (3, K) in the camera frame."""
    out = np.empty(rotations.shape)
    loops = compiled.load(model_name, source(model_name))
    loops.turned(np.ascontiguousarray(steps), np.ascontiguousarray(rotations), out)
    return out


def pair_loop(
    frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """Cost, Gauss-Newton matrix (p, p) and gradients (p, K) of frames over interstar angles.

    `rotations` (K, 3, 3) turn the catalogue nearly into the camera frame. None as in
    `attitude_loop`.
    """
    if int(frames.sizes.max()) > _CHUNK:
        return None
    p = len(theta)
    scores, matrix = np.empty((p, frames.n_frames)), np.zeros((p, p))
    loops = compiled.load(model_name, source(model_name))
    at = np.ascontiguousarray(rotations)
    cost = loops.pair_sums(
        tuple(theta.tolist()), *frames.pixel, *frames.r, frames.starts, at, scores, matrix
    )
    return cost, _both(matrix), scores


def gram_loop(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    whitening: FloatArray,
    rotations: FloatArray,
    moved: tuple[FloatArray, FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Gram matrix (q, q) of `compressed.GramSums` and the slope (p,) of the log determinant.

    `moved` are shift, response and inverse of the frames at `rotations`, as `frame_loop` gives
    them.
    """
    p = len(theta)
    q = (p + 1) * (p + 2) // 2
    gram, slope = np.zeros((q, q + 3)), np.zeros(p)
    path = np.ascontiguousarray(np.einsum("ipk,pa->iak", moved[1], whitening))
    loops = compiled.load(model_name, source(model_name))
    given = (tuple(theta.tolist()), tuple(whitening.ravel().tolist()), *_stars(frames, rotations))
    loops.gram_sums(*given, np.ascontiguousarray(moved[0]), path, moved[2], gram, slope)
    # Rows are summed by fours: what stands below the diagonal and beyond the last column is of no
    # use.
    return _both(np.triu(gram[:, :q])), slope
