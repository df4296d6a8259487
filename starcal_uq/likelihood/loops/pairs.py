"""Interstar angles, and attitudes by QUEST."""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.attitude.wahba import DEGENERATE
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.loops.common import (
    CHUNK,
    ORDERED,
    backward_root,
    columns_of,
    compiled,
    derivatives_kernel,
    direction_kernel,
    given,
    literal_of,
    numbers_of,
    packed,
    symmetric,
)
from starcal_uq.likelihood.loops.frames import fill_rotation
from starcal_uq.likelihood.loops.unrolled import STRIDE, Stars, Sums, added, over_stars, row_sums
from starcal_uq.observations.frames import StarFrames


@compiled()
def _last_of_chunk(starts: Any, first: int) -> int:
    last = first + 1
    while last < len(starts) - 1 and starts[last + 1] - starts[first] <= CHUNK:
        last += 1
    return last


@compiled()
def _fill_backward(model: Any, theta: Any, stars: Any, s0: int, m: int, work: FloatArray) -> None:
    """Pixels of a chunk into rows 0 and 1 of `work`, roots into 3 and 4."""
    x0, y0 = stars[0], stars[1]
    for i in range(m):
        x, y = x0[s0 + i], y0[s0 + i]
        work[i] = x
        work[STRIDE + i] = y
        work[6 * STRIDE + i] = x - theta[0]
        work[7 * STRIDE + i] = y - theta[1]
    backward_root(model, theta, work, m)


@compiled(fastmath=ORDERED)
def _solve_attitude(profile: FloatArray, n: int, f: int, rotations: FloatArray) -> int:
    """QUEST for one frame, as `starcal_uq.attitude.wahba` has it, from its sums of b r^T; 1 if it
    is determined.
    """
    xx, xy, xz = profile[0, 0] / n, profile[0, 1] / n, profile[0, 2] / n
    yx, yy, yz = profile[1, 0] / n, profile[1, 1] / n, profile[1, 2] / n
    zx, zy, zz = profile[2, 0] / n, profile[2, 1] / n, profile[2, 2] / n
    c0, c1, c2 = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    c3, c4, c5 = xz * zy - xy * zz, xx * zz - xz * zx, xy * zx - xx * zy
    c6, c7, c8 = xy * yz - xz * yy, xz * yx - xx * yz, xx * yy - xy * yx
    norm2 = xx * xx + xy * xy + xz * xz + yx * yx + yy * yy + yz * yz + zx * zx + zy * zy + zz * zz
    adjoint2 = (
        c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3 + c4 * c4 + c5 * c5 + c6 * c6 + c7 * c7 + c8 * c8
    )
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
    a00, a11, a22, a33 = (
        xx - yy - zz - lam,
        yy - xx - zz - lam,
        zz - xx - yy - lam,
        xx + yy + zz - lam,
    )
    a01, a02, a12, a03, a13, a23 = xy + yx, xz + zx, yz + zy, zy - yz, xz - zx, yx - xy
    s0, s1, s2 = a00 * a11 - a01 * a01, a00 * a12 - a01 * a02, a00 * a13 - a01 * a03
    s3, s4, s5 = a01 * a12 - a11 * a02, a01 * a13 - a11 * a03, a02 * a13 - a12 * a03
    c5, c4, c3 = a22 * a33 - a23 * a23, a12 * a33 - a13 * a23, a12 * a23 - a13 * a22
    c2, c1 = a02 * a33 - a03 * a23, a02 * a23 - a03 * a22
    d00, d11 = a11 * c5 - a12 * c4 + a13 * c3, a00 * c5 - a02 * c2 + a03 * c1
    d22, d33 = a03 * s4 - a13 * s2 + a33 * s0, a02 * s3 - a12 * s1 + a22 * s0
    d01, d02, d03 = (
        a02 * c4 - a01 * c5 - a03 * c3,
        a13 * s5 - a23 * s4 + a33 * s3,
        a22 * s4 - a12 * s5 - a23 * s3,
    )
    d12, d13, d23 = (
        a23 * s2 - a03 * s5 - a33 * s1,
        a02 * s5 - a22 * s2 + a23 * s1,
        a12 * s2 - a02 * s4 - a23 * s0,
    )
    if min(d00, d11) < min(d22, d33):
        x, y, z, w = (d00, d01, d02, d03) if d00 < d11 else (d01, d11, d12, d13)
    else:
        x, y, z, w = (d02, d12, d22, d23) if d22 < d33 else (d03, d13, d23, d33)
    # One Newton step of Wahba's loss on the rotation vector.
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    fill_rotation(x, y, z, w, rotations, f)
    r = rotations[f]
    m00, m11 = (
        xx * r[0, 0] + xy * r[0, 1] + xz * r[0, 2],
        yx * r[1, 0] + yy * r[1, 1] + yz * r[1, 2],
    )
    m01, m10 = (
        xx * r[1, 0] + xy * r[1, 1] + xz * r[1, 2],
        yx * r[0, 0] + yy * r[0, 1] + yz * r[0, 2],
    )
    m02, m20 = (
        xx * r[2, 0] + xy * r[2, 1] + xz * r[2, 2],
        zx * r[0, 0] + zy * r[0, 1] + zz * r[0, 2],
    )
    m12, m21 = (
        yx * r[2, 0] + yy * r[2, 1] + yz * r[2, 2],
        zx * r[1, 0] + zy * r[1, 1] + zz * r[1, 2],
    )
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
    if (
        np.isfinite(norm2)
        and np.isfinite(lam)
        and min(curvature, np.sqrt(adjoint2 / norm2)) > DEGENERATE
    ):
        return 1
    rotations[f] = np.nan
    return 0


_pair_profile = row_sums(
    lambda model, p: {(i, k): [(i, 3 + k)] for i in range(3) for k in range(3)}
)


@compiled(entry=True)
def _attitudes(model: Any, theta: Any, stars: Any, starts: Any, rotations: FloatArray) -> int:
    work, buf, profile = np.zeros(8 * STRIDE), np.empty(6 * STRIDE), np.zeros((3, 3))
    r0, r1, r2 = stars[2:]
    n_frames, first, sound = len(starts) - 1, 0, 0
    while first < n_frames:
        s0, last = starts[first], _last_of_chunk(starts, first)
        m = starts[last] - s0
        _fill_backward(model, theta, stars, s0, m, work)
        for i in range(m):
            direction_kernel(model, theta, work, buf, i)
        for i in range(m):
            buf[3 * STRIDE + i] = r0[s0 + i]
            buf[4 * STRIDE + i] = r1[s0 + i]
            buf[5 * STRIDE + i] = r2[s0 + i]
        for f in range(first, last):
            profile[:] = 0.0
            _pair_profile(model, theta, buf, starts[f] - s0, starts[f + 1] - s0, 0, profile)
            sound += _solve_attitude(profile, starts[f + 1] - starts[f], f, rotations)
        first = last
    return sound


def _with_pairs(p: int, x: int) -> Sums:
    """A row x of B^T [dB], R'^T [R' E] and E^T [E] of a frame, of the symmetric ones half."""
    db, r, e = 3, 3 + 3 * p, 6 + 3 * p
    return {
        **{(x, q): [(x, db + q)] for q in range(3 * p)},
        **{(x, 3 * p + c): [(r + x, r + c)] for c in range(x, 3)},
        **{(x, 3 * p + 3 + c): [(r + x, e + c)] for c in range(3)},
        **{(x, 3 * p + 6 + c): [(e + x, e + c)] for c in range(x, 3)},
    }


# In three, since one sum more than there are registers for costs what it adds.
_pair_products_0 = row_sums(lambda model, p: _with_pairs(p, 0))
_pair_products_1 = row_sums(lambda model, p: _with_pairs(p, 1))
_pair_products_2 = row_sums(lambda model, p: _with_pairs(p, 2))
_pair_scores = row_sums(
    lambda model, p: {(a,): [(3 + 3 * a + i, 9 + 3 * p + i) for i in range(3)] for a in range(p)}
)


def _write_pair_matrix(stars: Stars) -> None:
    """D B of a chunk, and the part of the Gauss-Newton matrix that is a sum over stars."""
    p = len(stars.numbers)
    db, r, e, d, bb, eb = 3, 3 + 3 * p, 6 + 3 * p, 9 + 3 * p, 12 + 3 * p, 18 + 3 * p
    totals = {(a, c): stars.total() for a in range(p) for c in range(a, p)}
    with stars.each() as (rows, _):
        v = {row: rows[row] for row in (*range(db, d), *range(bb, eb + 9))}
        for c in range(3):
            rows[d + c] = added(
                [v[eb + 3 * a + c] * v[r + a] + v[bb + packed(a, c)] * v[e + a] for a in range(3)]
            )
        weighed = [
            [added([v[bb + packed(c, x)] * v[db + 3 * a + x] for x in range(3)]) for c in range(3)]
            for a in range(p)
        ]
        for (a, c), total in totals.items():
            total.add(added([weighed[a][x] * v[db + 3 * c + x] for x in range(3)]))
    for (a, c), total in totals.items():
        stars.add(total.value, a, c)


_pair_matrix = over_stars(_write_pair_matrix)


@compiled(entry=True)
def _pair_sums(
    model: Any,
    theta: Any,
    stars: Any,
    starts: Any,
    rotations: FloatArray,
    scores: FloatArray,
    matrix: FloatArray,
) -> float:
    # Rows of the buffer: b, its derivatives, R', E, D B, and of each star's frame B^T B and E^T B.
    p = len(matrix)
    r, e, bb, eb = 3 + 3 * p, 6 + 3 * p, 12 + 3 * p, 18 + 3 * p
    work, buf = np.zeros(8 * STRIDE), np.empty((27 + 3 * p) * STRIDE)
    acc, score = np.empty((3, 3 * p + 9)), np.empty(p)
    r0, r1, r2 = stars[2:]
    n_frames = len(starts) - 1
    cost, first = 0.0, 0
    while first < n_frames:
        s0, last = starts[first], _last_of_chunk(starts, first)
        m = starts[last] - s0
        _fill_backward(model, theta, stars, s0, m, work)
        for i in range(m):
            derivatives_kernel(model, theta, work, buf, i)
        for f in range(first, last):
            j, end = starts[f] - s0, starts[f + 1] - s0
            for q in range(3):
                a, b, c = rotations[f, q, 0], rotations[f, q, 1], rotations[f, q, 2]
                for i in range(j, end):
                    along = a * r0[s0 + i] + b * r1[s0 + i] + c * r2[s0 + i]
                    buf[(r + q) * STRIDE + i] = along
                    buf[(e + q) * STRIDE + i] = buf[q * STRIDE + i] - along
        for f in range(first, last):
            j, end = starts[f] - s0, starts[f + 1] - s0
            acc[:] = 0.0
            _pair_products_0(model, theta, buf, j, end, 0, acc)
            _pair_products_1(model, theta, buf, j, end, 0, acc)
            _pair_products_2(model, theta, buf, j, end, 0, acc)
            for a in range(3):
                for c in range(3):
                    low, high = min(a, c), 3 * p + max(a, c)
                    rr, ee = acc[low, high], acc[low, high + 6]
                    re, er = acc[a, 3 * p + 3 + c], acc[c, 3 * p + 3 + a]
                    cost += ee * rr + re * er + ee * (2.0 * re + 0.5 * ee)
                    for i in range(j, end):
                        buf[(eb + 3 * a + c) * STRIDE + i] = er + ee
                    if c >= a:
                        for i in range(j, end):
                            buf[(bb + 3 * a - a * (a + 1) // 2 + c) * STRIDE + i] = (
                                rr + re + er + ee
                            )
            for a in range(p):
                for c in range(a, p):
                    total = 0.0
                    for x in range(3):
                        for y in range(3):
                            total += acc[x, 3 * a + y] * acc[y, 3 * c + x]
                    matrix[a, c] += total
        _pair_matrix(model, theta, buf, 0, m, 0, matrix)
        for f in range(first, last):
            score[:] = 0.0
            _pair_scores(model, theta, buf, starts[f] - s0, starts[f + 1] - s0, 0, score)
            for a in range(p):
                scores[a, f] = score[a]
        first = last
    return cost


def attitude_loop(
    frames: StarFrames, model_name: str, theta: FloatArray
) -> tuple[FloatArray, bool] | None:
    """Attitudes (K, 3, 3) by QUEST at theta, without weights, NaN where stars determine none;
    whether they all do.

    None where a frame has more stars than the loops take.
    """
    if int(frames.sizes.max()) > CHUNK:
        return None
    rotations = np.empty((frames.n_frames, 3, 3))
    stars, starts = columns_of(frames), given(frames.starts)
    sound = _attitudes(literal_of(model_name), numbers_of(theta), stars, starts, rotations)
    return rotations, sound == frames.n_frames


def pair_loop(
    frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """Cost, Gauss-Newton matrix (p, p) and gradients (p, K) of frames over interstar angles.

    `rotations` (K, 3, 3) turn the catalogue nearly into the camera frame. None as in
    `attitude_loop`.
    """
    if int(frames.sizes.max()) > CHUNK:
        return None
    p = len(theta)
    scores, matrix = np.empty((p, frames.n_frames)), np.zeros((p, p))
    data = columns_of(frames), given(frames.starts), given(rotations)
    cost = _pair_sums(literal_of(model_name), numbers_of(theta), *data, scores, matrix)
    return cost, symmetric(matrix), scores
