"""Interstar angles, and attitudes by QUEST."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from starcal_uq.attitude.wahba import solve_profiles
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood import arrays
from starcal_uq.likelihood.loops.common import (
    CHUNK,
    VERSION,
    WORK,
    columns_of,
    compiled,
    given,
    root_of,
    rows,
    star_function,
    symmetric,
)
from starcal_uq.likelihood.loops.unrolled import (
    STRIDE,
    block_products,
    call,
    data,
    row,
    turned_rows,
)
from starcal_uq.observations.frames import StarFrames

vector_products = block_products(3, 3, axes=1)
score_products = block_products(3, 1, axes=3)
matrix_products = block_products(3, 3, axes=3)
turned, added_turned = turned_rows(more=False), turned_rows(more=True)


@compiled()
def _fill_backward(
    functions: Any,
    theta: Any,
    pixel: Any,
    start: Any,
    n_frames: int,
    first: int,
    work: Any,
    buf: Any,
) -> int:
    """Pixels of a chunk of frames into rows 0 and 1 of `work`, roots into 3 and 4, directions into
    `buf`; the first frame that is left.
    """
    root, kernel = functions
    x0, y0 = pixel
    last = first + 1
    while last < n_frames and start[last + 1] - start[first] <= CHUNK:
        last += 1
    s0, m = start[first], start[last] - start[first]
    for i in range(m):
        x, y = x0[s0 + i], y0[s0 + i]
        work[i] = x
        work[STRIDE + i] = y
        work[3 * STRIDE + i] = work[6 * STRIDE + i] = x - theta[0]
        work[4 * STRIDE + i] = work[7 * STRIDE + i] = y - theta[1]
    if root != 0:
        call(root, theta, work, buf, m)
    call(kernel, theta, work, buf, m)
    return last


@compiled(entry=True)
def _pair_sums(
    version: Any,
    functions: Any,
    theta: FloatArray,
    stars: Any,
    starts: Any,
    rotations: FloatArray,
    of_frames: Any,
    buffers: Any,
    sums: Any,
) -> float:
    """Sums over interstar angles; where `profiles` are asked for, these alone, of b and what the
    rotations make of r.
    """
    # Rows of the buffer: b, its derivatives, E, R', and the derivatives and E times B^T B; what E
    # then becomes is D B.
    p, n_frames = len(theta), len(starts) - 1
    work, buf, numbers, start = data(buffers[0]), data(buffers[1]), data(theta), data(starts)
    pixel = data(stars[0]), data(stars[1])
    r0, r1, r2 = data(stars[2]), data(stars[3]), data(stars[4])
    e, r, weighed, d = (
        row(buf, 3 + 3 * p), row(buf, 6 + 3 * p), row(buf, 9 + 3 * p), row(buf, 9 + 6 * p),
    )  # fmt: skip
    matrix, acc, score, bb, eb = sums
    scores, profiles = of_frames
    cost, first = 0.0, start[0]
    while first < n_frames:
        last = _fill_backward(functions, numbers, pixel, start, n_frames, first, work, buf)
        s0 = start[first]
        for f in range(first, last):
            j, end = start[f] - s0, start[f + 1] - s0
            for q in range(3):
                a, b, c = rotations[f, q, 0], rotations[f, q, 1], rotations[f, q, 2]
                one, two, three = row(buf, q), row(e, q), row(r, q)
                for i in range(j, end):
                    along = a * r0[s0 + i] + b * r1[s0 + i] + c * r2[s0 + i]
                    three[i] = along
                    two[i] = one[i] - along
            acc[:] = 0.0
            if profiles.shape[2] > 0:
                vector_products(buf, r, j, end, acc, 0, 0)
                for a in range(3):
                    for c in range(3):
                        profiles[a, c, f] = acc[a, c] / (end - j)
                continue
            # B^T [dB], E^T [E R'] and R'^T [R'] of a frame.
            for a in range(p + 3):
                left = buf if a < p else (e if a < p + 2 else r)
                right = row(buf, 3 + 3 * min(a, p + 1))
                vector_products(left, right, j, end, acc, 0, 3 * a)
            for a in range(3):
                for c in range(3):
                    ee, er = acc[a, 3 * p + c], acc[a, 3 * p + 3 + c]
                    re, rr = acc[c, 3 * p + 3 + a], acc[a, 3 * p + 6 + c]
                    cost += ee * rr + re * er + ee * (2.0 * re + 0.5 * ee)
                    eb[a, c], bb[a, c] = er + ee, rr + re + er + ee
            for a in range(p):
                for c in range(a, p):
                    total = 0.0
                    for x in range(3):
                        for y in range(3):
                            total += acc[x, 3 * a + y] * acc[y, 3 * c + x]
                    matrix[a, c] += total
            for a in range(p + 1):
                turned(row(buf, 3 + 3 * a), data(bb), j, end, row(weighed, 3 * a))
            added_turned(r, data(eb), j, end, d)
            score[:] = 0.0
            for a in range(0, p, 3):
                score_products(row(buf, 3 + 3 * a), d, j, end, score, a, 0)
            for a in range(p):
                scores[a, f] = score[a, 0]
        m = start[last] - s0 if profiles.shape[2] == 0 else 0
        for a in range(0, p, 3):
            for c in range(a, p, 3):
                matrix_products(row(weighed, 3 * a), row(buf, 3 + 3 * c), 0, m, matrix, a, c)
        first = last
    return cost


def _sums(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    kernel: str,
    n_scores: int,
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    p, k = len(theta), frames.n_frames
    of_frames = np.empty((p, n_scores)), np.empty((3, 3, k - n_scores))
    # Groups of three fill up the last one.
    matrix, acc, score = np.zeros((p + 2, p + 2)), np.empty((3, 3 * p + 9)), np.empty((p + 2, 1))
    cost = _pair_sums(
        VERSION,
        (root_of(model_name, "inverse"), star_function(kernel, model_name)),
        given(theta),
        columns_of(frames),
        given(frames.starts),
        given(rotations),
        of_frames,
        (rows(WORK), rows(18 + 6 * p)),
        (matrix, acc, score, *np.empty((2, 3, 3))),
    )
    return cost, symmetric(matrix[:p, :p]), *of_frames


def attitudes(
    frames: StarFrames, model_name: str, theta: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """As `starcal_uq.likelihood.paths.Sums.attitudes`."""
    if int(frames.sizes.max()) > CHUNK:
        return arrays.attitudes(frames, model_name, theta, weights)
    if weights is not None:
        share = weights / frames.spread(frames.sum(weights) / frames.sizes)
        frames = replace(frames, r=frames.r * share)
    unturned = np.broadcast_to(np.eye(3), (frames.n_frames, 3, 3))
    profiles = _sums(frames, model_name, theta, unturned, "direction", 0)[3]
    with np.errstate(all="ignore"):
        return solve_profiles(profiles)


def pairs(
    frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.pairs`."""
    if int(frames.sizes.max()) > CHUNK:
        return arrays.pairs(frames, model_name, theta, rotations)
    return _sums(frames, model_name, theta, rotations, "derivatives", frames.n_frames)[:3]
