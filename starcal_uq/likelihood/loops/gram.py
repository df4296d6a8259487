"""The Gram matrix of the compressed likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba.extending import overload

from starcal_uq.camera.projection import bent_index
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.loops.common import (
    bent_kernel,
    compiled,
    fill_directions,
    given,
    literal_of,
    numbers_of,
    packed,
    symmetric,
    weighted,
)
from starcal_uq.likelihood.loops.unrolled import (
    STRIDE,
    Stars,
    Sums,
    added,
    name_of,
    over_stars,
    row_sums,
)
from starcal_uq.observations.frames import StarFrames

_GRAM_CHUNK = 64


@dataclass(frozen=True)
class _GramRows:
    """Rows of the buffer of the Gram matrix.

    First e, H, A and the second derivatives that do not vanish, two axes each; of each star's frame
    the path (3, p), the shift (3) and the inverse (6); then the columns, two axes each and those
    that fill up a group of four; and what one axis needs meanwhile.
    """

    bent: int
    path: int
    columns: int
    turned: int
    end: int

    @classmethod
    def of(cls, model: Any, p: int) -> _GramRows:
        bent = 8 + 2 * p
        path = bent + 2 * len(bent_index(model)[0])
        columns = path + 3 * p + 9
        turned = columns + (p + 1) * (p + 2) + 8
        return cls(bent, path, columns, turned, turned + 3 * p + 3)


def _gram_rows(model: Any, theta: Any) -> Any:
    """First rows of the path and of the columns, number of rows."""


@overload(_gram_rows, prefer_literal=True)
def _(model: Any, theta: Any) -> Callable[..., Any]:
    at = _GramRows.of(name_of(model), theta.count)
    rows = (at.path, at.columns, at.end)

    def constant(model: Any, theta: Any) -> Any:
        return rows

    return constant


def _write_expansion(stars: Stars, axis: int) -> None:
    """Columns of the compressed likelihood along one axis, as `compressed._Expansion` forms them.

    The numbers are the whitening l, lower triangular. A loop holds no more values than there are
    registers for.
    """
    whitening, p = stars.numbers, math.isqrt(len(stars.numbers))
    at = _GramRows.of(stars.model, p)
    entries = list(
        enumerate(zip(*(index.tolist() for index in bent_index(stars.model)), strict=True))
    )
    shift, inverse, pseudo = at.path + 3 * p, at.path + 3 * p + 3, at.turned + 3 * p
    with stars.each(axis) as (common, own):
        a = [own[2 + 2 * p + 2 * c] for c in range(3)]
        h = [own[2 + 2 * t] for t in range(p)]
        own[at.columns] = own[0] - added([common[shift + c] * a[c] for c in range(3)])
        for c in range(3):
            common[pseudo + c] = added([common[inverse + packed(c, d)] * a[d] for d in range(3)])
        for z in range(p):
            moved = [whitening[t * p + z] * h[t] for t in range(z, p)]
            turned = [common[at.path + p * c + z] * a[c] for c in range(3)]
            own[at.columns + 2 + 2 * z] = -added(moved + turned)
    for z in range(p):
        _write_turned(stars, axis, at, z, [(n, t, d) for n, (t, d) in entries if d >= p])
    column = at.columns + 2 + 2 * p
    for z in range(p):
        _write_curves(stars, axis, at, z, column, [(n, t, d) for n, (t, d) in entries if d < p])
        column += 2 * (p - z)


def _write_turned(
    stars: Stars, axis: int, at: _GramRows, z: int, entries: list[tuple[int, int, int]]
) -> None:
    """The derivatives of A along z, and half of what the path itself bends; the slope."""
    whitening, p = stars.numbers, math.isqrt(len(stars.numbers))
    total = stars.total()
    with stars.each(axis) as (common, own):
        bent = {n: own[at.bent + 2 * n] for n, _, _ in entries}
        path = [common[at.path + p * d + z] for d in range(3)]
        slope = []
        for c in range(3):
            mixed = added(
                [whitening[t * p + z] * bent[n] for n, t, d in entries if z <= t < p and d == p + c]
            )
            along = added(
                [
                    path[d] * bent[n]
                    for n, one, two in entries
                    for b, d in {(one - p, two - p), (two - p, one - p)}
                    if one >= p and b == c
                ]
            )
            common[at.turned + 3 * z + c] = mixed + 0.5 * along
            slope.append(common[at.turned + 3 * p + c] * (mixed + along))
        total.add(added(slope))
    stars.add(2.0 * total.value, z)


def _write_curves(
    stars: Stars, axis: int, at: _GramRows, z: int, column: int, entries: list[tuple[int, int, int]]
) -> None:
    """Second derivatives along z and each of the parameters from z on."""
    whitening, p = stars.numbers, math.isqrt(len(stars.numbers))
    # A diagonal entry of z z^T stands once in the expansion, halved; the others stand for both
    # orders.
    weights = {}
    for y in range(z, p):
        for n, t, d in entries:
            orders = [(i, j) for i, j in {(t, d), (d, t)} if z <= i and y <= j]
            if orders:
                both = added([whitening[i * p + z] * whitening[j * p + y] for i, j in orders])
                weights[y, n] = both * (-0.5 if z == y else -1.0)
    with stars.each(axis) as (common, own):
        bent = {n: own[at.bent + 2 * n] for n, _, _ in entries}
        u = [common[at.turned + 3 * z + c] for c in range(3)]
        k = [common[at.path + p * c + z] for c in range(3)]
        for y in range(z, p):
            plain = added([weights[y, n] * bent[n] for n in bent if (y, n) in weights])
            bends = added(
                [
                    u[c] * k[c]
                    if z == y
                    else u[c] * common[at.path + p * c + y] + k[c] * common[at.turned + 3 * y + c]
                    for c in range(3)
                ]
            )
            own[column + 2 * (y - z)] = plain - bends


_expand_x = over_stars(lambda stars: _write_expansion(stars, 0))
_expand_y = over_stars(lambda stars: _write_expansion(stars, 1))


def _write_block_products(stars: Stars) -> None:
    """Products of two columns with four, both axes."""
    totals = {(k, c): stars.total() for k in range(2) for c in range(4)}
    with stars.each() as (rows, others):
        for x in range(2):
            one = [rows[2 * k + x] for k in range(2)]
            two = [others[2 * c + x] for c in range(4)]
            for (k, c), total in totals.items():
                total.add(one[k] * two[c])
    for (k, c), total in totals.items():
        stars.add(total.value, k, c)


_block_products = over_stars(_write_block_products)


def _with_second(model: str, p: int, part: int) -> Sums:
    """Products of A with a third of the second derivatives."""
    at = _GramRows.of(model, p)
    first = at.columns + 2 + 2 * p
    return {
        (c, n): [(2 + 2 * p + 2 * c + x, first + 2 * n + x) for x in range(2)]
        for n in range(part, p * (p + 1) // 2, 3)
        for c in range(3)
    }


_second_0 = row_sums(lambda model, p: _with_second(model, p, 0))
_second_1 = row_sums(lambda model, p: _with_second(model, p, 1))
_second_2 = row_sums(lambda model, p: _with_second(model, p, 2))


@compiled(entry=True)
def _gram_sums(
    model: Any,
    theta: Any,
    whitening: Any,
    stars: Any,
    weight: FloatArray,
    starts: Any,
    rotations: FloatArray,
    moved: Any,
    sums: Any,
) -> None:
    p = moved[1].shape[1]
    q, n_second = (p + 1) * (p + 2) // 2, len(theta) * (len(theta) + 1) // 2
    x0, y0 = stars[0], stars[1]
    shift, path, inverse = moved
    gram, slope = sums
    path_row, columns, n_rows = _gram_rows(model, theta)
    work, buf = np.zeros(8 * STRIDE), np.zeros(n_rows * STRIDE)
    acc = np.zeros((3, n_second))
    zero = starts[0]
    n, first, s0 = starts[len(starts) - 1], zero, zero
    while s0 < n:
        m = min(zero + _GRAM_CHUNK, n - s0)
        fill_directions(model, theta, stars, starts, rotations, s0, m, first, work)
        for i in range(m):
            bent_kernel(model, theta, work, buf, i)
        for i in range(m):
            buf[i] = x0[s0 + i] - buf[i]
            buf[STRIDE + i] = y0[s0 + i] - buf[STRIDE + i]
        if len(weight) > 0:
            for k in range(path_row):
                for i in range(m):
                    buf[k * STRIDE + i] *= weight[s0 + i]
        f, j = first, zero
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            row = path_row + 3 * p + 3
            for c in range(3):
                for a in range(p):
                    value = path[c, a, f]
                    for i in range(j, end):
                        buf[(path_row + p * c + a) * STRIDE + i] = value
                value = shift[c, f]
                for i in range(j, end):
                    buf[(path_row + 3 * p + c) * STRIDE + i] = value
                for d in range(c, 3):
                    value = inverse[c, d, f]
                    for i in range(j, end):
                        buf[row * STRIDE + i] = value
                    row += 1
            j = end
        _expand_x(model, whitening, buf, 0, m, 0, slope)
        _expand_y(model, whitening, buf, 0, m, 0, slope)
        # By twos and fours: what stands below the diagonal and beyond the last column is of no use.
        for k in range(0, q, 2):
            own = buf[(columns + 2 * k) * STRIDE :]
            for c in range(k, q, 4):
                _block_products(model, theta, own, 0, m, 2 * (c - k), gram[k:, c:])
        f, j = first, zero
        while j < m:
            while starts[f + 1] <= s0 + j:
                f += 1
            end = min(starts[f + 1] - s0, m)
            _second_0(model, theta, buf, j, end, zero, acc)
            _second_1(model, theta, buf, j, end, zero, acc)
            _second_2(model, theta, buf, j, end, zero, acc)
            j = end
            if s0 + j == starts[f + 1]:
                for k in range(n_second):
                    a, b, c = acc[0, k], acc[1, k], acc[2, k]
                    g0 = inverse[0, 0, f] * a + inverse[0, 1, f] * b + inverse[0, 2, f] * c
                    g1 = inverse[1, 0, f] * a + inverse[1, 1, f] * b + inverse[1, 2, f] * c
                    g2 = inverse[2, 0, f] * a + inverse[2, 1, f] * b + inverse[2, 2, f] * c
                    for d in range(k, n_second):
                        gram[1 + p + k, 1 + p + d] -= (
                            acc[0, d] * g0 + acc[1, d] * g1 + acc[2, d] * g2
                        )
                acc[:] = 0.0
        first = f
        s0 += m


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
    gram, slope = np.zeros((q + 1, q + 3)), np.zeros(p)
    path = np.einsum("ipk,pa->iak", moved[1], whitening)
    data = weighted(frames, rotations)
    at = (literal_of(model_name), numbers_of(theta), tuple(whitening.ravel().tolist()))
    _gram_sums(*at, *data, tuple(map(given, (moved[0], path, moved[2]))), (gram, slope))
    return symmetric(np.triu(gram[:q, :q])), slope
