"""Sums over frames whose attitudes are eliminated: normal equations, and the Gram matrix of the
compressed likelihood.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.arrays import common_turn
from starcal_uq.likelihood.expansion import GramRows, frame_rows
from starcal_uq.likelihood.loops.common import (
    CHUNK,
    VERSION,
    WORK,
    columns_of,
    compiled,
    fill_directions,
    given,
    root_of,
    rows,
    star_function,
    symmetric,
)
from starcal_uq.likelihood.loops.unrolled import STRIDE, block_products, call, data, row
from starcal_uq.observations.frames import StarFrames

_GRAM_CHUNK = 64
products = block_products(3, 3, axes=2)


@compiled(entry=True)
def _eliminated(
    version: Any,
    functions: Any,
    numbers: Any,
    stars: Any,
    frame_rows: FloatArray,
    at: Any,
    buffers: Any,
    sums: Any,
    of_frames: Any,
) -> None:
    """Products of the columns of all stars without what three columns of every frame reproduce.

    The function `kernel` makes rows of a chunk, e first, and `change` makes others of them, axis by
    axis; both see `frame_rows` at every star. Columns are counted from row `columns` on; the first
    `free` are known to be without what is eliminated, the columns from row `attitude` on. Sums over
    all stars are taken of rows from `slopes` on. Stars weigh on the first `n_rows`.
    """
    columns_of_stars, weight, starts, rotations = stars
    x, y, r0, r1, r2 = columns_of_stars
    x0, y0, w, start = data(x), data(y), data(weight), data(starts)
    sky = (data(r0), data(r1), data(r2)), start, data(rotations)
    theta, shared = data(numbers[0]), data(numbers[1])
    root, kernel, change = functions
    chunk, attitude, columns, slopes, n_columns, free, n_slopes, n_rows = at
    work, own = data(buffers[0]), data(buffers[1])
    gram, acc, inverse, slope = sums
    solved, inverses, volume = of_frames
    common, a = row(work, WORK), row(own, attitude)
    n, first, s0 = start[len(starts) - 1], start[0], start[0]
    while s0 < n:
        m = min(chunk, n - s0)
        fill_directions(root, theta, sky, s0, m, first, work, own)
        for i in range(m):
            work[6 * STRIDE + i] = x0[s0 + i]
            work[7 * STRIDE + i] = y0[s0 + i]
        f, j = first, start[0]
        while j < m and len(frame_rows) > 0:
            while start[f + 1] <= s0 + j:
                f += 1
            end = min(start[f + 1] - s0, m)
            for k in range(len(frame_rows)):
                value, of = frame_rows[k, f], row(common, k)
                for i in range(j, end):
                    of[i] = value
            j = end
        call(kernel, theta, work, own, m)
        for i in range(m):
            own[i] = work[6 * STRIDE + i] - own[i]
            own[STRIDE + i] = work[7 * STRIDE + i] - own[STRIDE + i]
        if len(weight) > 0:
            for k in range(n_rows):
                of = row(own, k)
                for i in range(m):
                    of[i] *= w[s0 + i]
        for axis in range(2):
            call(change, shared, common, row(own, axis), m)
        for k in range(n_slopes):
            of, total = row(own, slopes + k), 0.0
            for i in range(m):
                total += of[i]
            slope[k // 2] += total
        # By threes: what stands below the diagonal and beyond the last column is of no use.
        for k in range(0, n_columns, 3):
            for c in range(k, n_columns, 3):
                one, two = row(own, columns + 2 * k), row(own, columns + 2 * c)
                products(one, two, 0, m, gram, k, c)
        f, j = first, start[0]
        while j < m:
            while start[f + 1] <= s0 + j:
                f += 1
            end = min(start[f + 1] - s0, m)
            # The three columns with themselves, and with the others.
            for c in range(free - 3, n_columns, 3):
                products(
                    a, a if c < free else row(own, columns + 2 * c), j, end, acc, 0, c + 3 - free
                )
            j = end
            if n_columns > 0 and s0 + j == start[f + 1]:
                xx, xy, xz = acc[0, 0], acc[0, 1], acc[0, 2]
                yy, yz, zz = acc[1, 1], acc[1, 2], acc[2, 2]
                inverse[0], inverse[1] = yy * zz - yz * yz, xz * yz - xy * zz
                inverse[2], inverse[3] = xy * yz - xz * yy, xx * zz - xz * xz
                inverse[4], inverse[5] = xy * xz - xx * yz, xx * yy - xy * xy
                determinant = xx * inverse[0] + xy * inverse[1] + xz * inverse[2]
                volume[f] = np.log(determinant)
                for k in range(6):
                    inverse[k] /= determinant
                    inverses[k, f] = inverse[k]
                for k in range(n_columns - free):
                    s, t, u = acc[0, 3 + k], acc[1, 3 + k], acc[2, 3 + k]
                    g0 = inverse[0] * s + inverse[1] * t + inverse[2] * u
                    g1 = inverse[1] * s + inverse[3] * t + inverse[4] * u
                    g2 = inverse[2] * s + inverse[4] * t + inverse[5] * u
                    for d in range(k + 1):
                        gram[free + d, free + k] -= (
                            acc[0, 3 + d] * g0 + acc[1, 3 + d] * g1 + acc[2, 3 + d] * g2
                        )
                    if k < solved.shape[1]:
                        solved[0, k, f], solved[1, k, f], solved[2, k, f] = g0, g1, g2
                acc[:] = 0.0
        first = f
        s0 += m


def _sums(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    functions: tuple[str, str],
    shared: tuple[FloatArray, FloatArray],
    at: tuple[int, ...],
    solved: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Products and slopes of `_eliminated`, and the packed inverse and the determinant's logarithm of
    every frame.
    """
    k, (numbers, by_frame), (kernel, change) = frames.n_frames, shared, functions
    *_, n_columns, free, n_slopes, n_rows = at
    weight = np.empty(0) if frames.weight is None else frames.weight
    if kernel == "slope":
        weight = weight**2
    # Groups of three fill up the last one.
    gram, acc = np.zeros((n_columns + 2, n_columns + 2)), np.zeros((3, n_columns + 5 - free))
    slope, inverse, volume = np.zeros(n_slopes // 2), np.empty((6, k)), np.empty(k)
    _eliminated(
        VERSION,
        (
            root_of(model_name, "forward"),
            star_function(kernel, model_name),
            star_function(change, model_name),
        ),
        (given(theta), given(numbers.ravel())),
        (columns_of(frames), given(weight), given(frames.starts), given(rotations)),
        given(by_frame),
        at,
        (rows(WORK + 2 * len(by_frame)), rows(n_rows + n_slopes + 2 * n_columns + 4)),
        (gram, acc, np.empty(6), slope),
        (solved, inverse, volume),
    )
    return symmetric(gram[:n_columns, :n_columns]), slope, inverse, volume


def normals(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.normals`."""
    p, k = len(theta), frames.n_frames
    turn, solved = common_turn(frames, model_name, theta, rotations), np.empty((3, p + 1, k))
    total, _, inverse, volume = _sums(
        frames,
        model_name,
        theta,
        rotations,
        ("first", "follow"),
        (-turn, np.empty((0, k))),
        (CHUNK, 2 * p + 2, 0, 0, p + 1, 0, 0, 2 * p + 8),
        solved,
    )
    whole = inverse[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3, k)
    response = np.negative(solved[:, 1:])
    response -= turn[:, :, None]
    return total, solved[:, 0], response, whole, volume


def gram(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    whitening: FloatArray,
    rotations: FloatArray,
    response: FloatArray,
    inverse: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.gram`."""
    p, at = len(theta), GramRows.of(model_name, len(theta))
    q = (p + 1) * (p + 2) // 2
    return _sums(
        frames,
        model_name,
        theta,
        rotations,
        ("bent", "expand"),
        (whitening, frame_rows(whitening, response, inverse)),
        (_GRAM_CHUNK, at.attitude, at.columns, at.slope, q, p + 1, 2 * p, at.slope),
        np.empty((3, 0, frames.n_frames)),
    )[:2]


def slope(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    response: FloatArray,
    inverse: FloatArray,
) -> FloatArray:
    """As `starcal_uq.likelihood.paths.Sums.slope`."""
    p = len(theta)
    return _sums(
        frames,
        model_name,
        theta,
        rotations,
        ("slope", "gather"),
        (np.eye(p), frame_rows(np.eye(p), response, inverse)),
        (CHUNK, 0, 0, 2, 0, 0, 2 * p, 2 * p + 8),
        np.empty((3, 0, frames.n_frames)),
    )[1]
