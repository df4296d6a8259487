"""Normal equations with the attitudes eliminated, and small turns of attitudes."""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.loops.common import (
    CHUNK,
    ORDERED,
    compiled,
    fill_directions,
    first_kernel,
    given,
    literal_of,
    numbers_of,
    symmetric,
    weighted,
)
from starcal_uq.likelihood.loops.unrolled import STRIDE, Sums, row_sums
from starcal_uq.observations.frames import StarFrames


@compiled()
def _inverse3(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> Any:
    """Inverse of a symmetric 3 x 3 matrix, six entries, and its determinant."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * a + xy * b + xz * c
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return (
        a / determinant,
        b / determinant,
        c / determinant,
        d / determinant,
        e / determinant,
        f / determinant,
        determinant,
    )


def _with_attitude(model: str, p: int) -> Sums:
    """Products of A with A, e and H, of a frame."""
    return {
        (c, q): [(2 * c + x, 2 * q + x) for x in range(2)]
        for c in range(3)
        for q in range(c, p + 4)
    }


def _among(model: str, p: int) -> Sums:
    """Products of e and H among themselves, of a chunk."""
    return {
        (a, b): [(6 + 2 * a + x, 6 + 2 * b + x) for x in range(2)]
        for a in range(p + 1)
        for b in range(a, p + 1)
    }


_frame_products = row_sums(_with_attitude)
_chunk_products = row_sums(_among, ordered=False)


@compiled(entry=True)
def _frame_sums(
    model: Any,
    theta: Any,
    stars: Any,
    weight: FloatArray,
    starts: Any,
    rotations: FloatArray,
    residuals: FloatArray,
    gram: FloatArray,
    attitudes: Any,
) -> None:
    p, rows = attitudes[1].shape[1], attitudes[1].shape[1] + 4
    x0, y0 = stars[0], stars[1]
    shift, response, inverse, volume = attitudes
    work, buf = np.zeros(8 * STRIDE), np.empty(2 * rows * STRIDE)
    acc, turn = np.zeros((3, rows)), np.zeros((3, p))
    # Offsets begin at zero; a literal one would have functions compiled for its type.
    zero = starts[0]
    n, first, s0 = starts[len(starts) - 1], zero, zero
    turning = True
    while s0 < n:
        m = min(zero + CHUNK, n - s0)
        # A, e and H' of a chunk.
        fill_directions(model, theta, stars, starts, rotations, s0, m, first, work)
        for i in range(m):
            first_kernel(model, theta, work, buf, i)
        for i in range(m):
            buf[6 * STRIDE + i] = x0[s0 + i] - buf[6 * STRIDE + i]
            buf[7 * STRIDE + i] = y0[s0 + i] - buf[7 * STRIDE + i]
        if len(weight) > 0:
            for q in range(2 * rows):
                for i in range(m):
                    buf[q * STRIDE + i] *= weight[s0 + i]
        if turning:
            # The turn of all frames together that follows theta best, of the first chunk.
            turning = False
            _frame_products(model, theta, buf, zero, m, zero, acc)
            a, b, c, d, e, f_, _ = _inverse3(
                acc[0, 0], acc[0, 1], acc[0, 2], acc[1, 1], acc[1, 2], acc[2, 2]
            )
            finite = True
            for q in range(p):
                s, t, u = acc[0, 4 + q], acc[1, 4 + q], acc[2, 4 + q]
                turn[0, q] = a * s + b * t + c * u
                turn[1, q] = b * s + d * t + e * u
                turn[2, q] = c * s + e * t + f_ * u
                finite = finite and np.isfinite(turn[0, q] + turn[1, q] + turn[2, q])
            if not finite:
                turn[:] = 0.0
            acc[:] = 0.0
        for q in range(p):
            t0, t1, t2 = turn[0, q], turn[1, q], turn[2, q]
            for x in range(2):
                for i in range(m):
                    buf[(8 + 2 * q + x) * STRIDE + i] -= (
                        t0 * buf[x * STRIDE + i]
                        + t1 * buf[(2 + x) * STRIDE + i]
                        + t2 * buf[(4 + x) * STRIDE + i]
                    )
        if residuals.shape[1] > 0:
            for x in range(2):
                for i in range(m):
                    residuals[x, s0 + i] = buf[(6 + x) * STRIDE + i]
        _chunk_products(model, theta, buf, zero, m, zero, gram)
        f, j = first, zero
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            _frame_products(model, theta, buf, j, end, zero, acc)
            j = end
            if s0 + j == starts[f + 1]:
                xx, xy, xz, yy, yz, zz, determinant = _inverse3(
                    acc[0, 0], acc[0, 1], acc[0, 2], acc[1, 1], acc[1, 2], acc[2, 2]
                )
                volume[f] = np.log(determinant)
                inverse[0, 0, f], inverse[0, 1, f], inverse[0, 2, f] = xx, xy, xz
                inverse[1, 0, f], inverse[1, 1, f], inverse[1, 2, f] = xy, yy, yz
                inverse[2, 0, f], inverse[2, 1, f], inverse[2, 2, f] = xz, yz, zz
                for q in range(len(theta) + 1):
                    s, t, u = acc[0, 3 + q], acc[1, 3 + q], acc[2, 3 + q]
                    g0 = xx * s + xy * t + xz * u
                    g1 = xy * s + yy * t + yz * u
                    g2 = xz * s + yz * t + zz * u
                    for k in range(q + 1):
                        gram[k, q] -= acc[0, 3 + k] * g0 + acc[1, 3 + k] * g1 + acc[2, 3 + k] * g2
                    if q == 0:
                        shift[0, f], shift[1, f], shift[2, f] = g0, g1, g2
                    else:
                        response[0, q - 1, f] = -g0 - turn[0, q - 1]
                        response[1, q - 1, f] = -g1 - turn[1, q - 1]
                        response[2, q - 1, f] = -g2 - turn[2, q - 1]
                acc[:] = 0.0
        first = f
        s0 += m


@compiled(fastmath=ORDERED)
def fill_rotation(x: float, y: float, z: float, w: float, rotations: FloatArray, f: int) -> None:
    rotations[f, 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    rotations[f, 0, 1] = 2.0 * (x * y - z * w)
    rotations[f, 0, 2] = 2.0 * (x * z + y * w)
    rotations[f, 1, 0] = 2.0 * (x * y + z * w)
    rotations[f, 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    rotations[f, 1, 2] = 2.0 * (y * z - x * w)
    rotations[f, 2, 0] = 2.0 * (x * z - y * w)
    rotations[f, 2, 1] = 2.0 * (y * z + x * w)
    rotations[f, 2, 2] = 1.0 - 2.0 * (x * x + y * y)


@compiled(entry=True, fastmath=ORDERED)
def _turned(steps: FloatArray, rotations: FloatArray, out: FloatArray) -> None:
    turn = np.empty((1, 3, 3))
    for f in range(len(rotations)):
        x, y, z = 0.5 * steps[0, f], 0.5 * steps[1, f], 0.5 * steps[2, f]
        half = np.sqrt(x * x + y * y + z * z)
        along = np.sin(half) / half if half > 0.0 else 1.0
        fill_rotation(x * along, y * along, z * along, np.cos(half), turn, 0)
        for i in range(3):
            a, b, c = turn[0, i, 0], turn[0, i, 1], turn[0, i, 2]
            for k in range(3):
                out[f, i, k] = (
                    a * rotations[f, 0, k] + b * rotations[f, 1, k] + c * rotations[f, 2, k]
                )


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
    gram = np.zeros((p + 1, p + 1))
    attitudes = np.empty((3, k)), np.empty((3, p, k)), np.empty((3, 3, k)), np.empty(k)
    into = np.empty((2, 0)) if residuals is None else residuals
    data = weighted(frames, rotations)
    _frame_sums(literal_of(model_name), numbers_of(theta), *data, into, gram, attitudes)
    return symmetric(gram), *attitudes


def turned_loop(steps: FloatArray, rotations: FloatArray) -> FloatArray:
    """Rotations (K, 3, 3) after small ones, of vectors (3, K) in the camera frame."""
    out = np.empty(rotations.shape)
    _turned(given(steps), given(rotations), out)
    return out
