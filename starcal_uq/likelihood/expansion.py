"""Columns of the compressed likelihood, written out for a model.

The formula is one for both paths: its numbers are arrays of stars, with both axes at once, or the
`starcal_uq.likelihood.loops.unrolled.Number` of one axis that is being compiled.

Second derivatives Q over (theta, phi) are contracted with the directions (L z, phi(z)), in which the
attitudes phi(z) = K z follow the parameters; most entries of Q that belong to theta alone vanish and
are not formed. Columns are derivatives of the residuals along the attitudes' first-order path: value
and first derivatives are free of what attitudes can reproduce, second derivatives are not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any, Protocol

import numpy as np

from starcal_uq.camera.projection import bent_index
from starcal_uq.core.types import FloatArray


class Stars(Protocol):
    """Numbers that all stars share, and rows of two buffers at each star."""

    def numbers(self, n: int) -> list[Any]:
        """The first numbers."""

    def each(self) -> AbstractContextManager[tuple[Any, Any]]:
        """The rows of both buffers, ``rows[n]``, at each star or at all of them."""


def added(terms: Sequence[Any]) -> Any:
    """The sum of some numbers; 0.0 of none."""
    return reduce(add, terms) if terms else 0.0


@dataclass(frozen=True)
class GramRows:
    """First rows of the two buffers of the Gram matrix.

    The first buffer holds of each star's frame the path (3, p) and the inverse (6), and what one
    axis needs meanwhile. The second holds e, H, A and the second derivatives that do
    not vanish, then the slopes and the columns, two axes each; and two columns of zeros, which fill
    up a group of three.
    """

    inverse: int
    turned: int
    pseudo: int
    common: int
    attitude: int
    bent: int
    slope: int
    columns: int
    own: int

    @classmethod
    def of(cls, model: str, p: int) -> GramRows:
        attitude = 2 + 2 * p
        slope = attitude + 6 + 2 * len(bent_index(model)[0])
        columns = slope + 2 * p
        return cls(
            inverse=3 * p,
            turned=3 * p + 6,
            pseudo=6 * p + 6,
            common=6 * p + 9,
            attitude=attitude,
            bent=attitude + 6,
            slope=slope,
            columns=columns,
            own=columns + (p + 1) * (p + 2) + 4,
        )


def frame_rows(whitening: FloatArray, response: FloatArray, inverse: FloatArray) -> FloatArray:
    """Rows of the first buffer that stars of a frame share, (3 p + 6, K)."""
    path = np.einsum("ipk,pa->iak", response, whitening)
    return np.concatenate([path.reshape(-1, path.shape[2]), inverse[np.triu_indices(3)]])


def packed(i: int, j: int) -> int:
    """Place of an entry of a symmetric matrix among its six unique ones."""
    return 3 * min(i, j) - min(i, j) * (min(i, j) + 1) // 2 + max(i, j)


Entries = list[tuple[int, int, int]]


def expand(stars: Stars, model: str, p: int) -> None:
    """Columns from e, H, A and second derivatives: along the parameters, and the slope of the log
    determinant.

    The numbers are the whitening l, lower triangular. A loop holds no more values than there are
    registers for.
    """
    whitening, at = stars.numbers(p * p), GramRows.of(model, p)
    index = zip(*(one.tolist() for one in bent_index(model)), strict=True)
    entries = [(n, t, d) for n, (t, d) in enumerate(index)]
    with stars.each() as (common, own):
        a = [own[at.attitude + 2 * c] for c in range(3)]
        h = [own[2 + 2 * t] for t in range(p)]
        own[at.columns] = own[0]
        for c in range(3):
            common[at.pseudo + c] = added(
                [common[at.inverse + packed(c, d)] * a[d] for d in range(3)]
            )
        for z in range(p):
            moved = [whitening[t * p + z] * h[t] for t in range(z, p)]
            turned = [common[p * c + z] * a[c] for c in range(3)]
            own[at.columns + 2 + 2 * z] = -added(moved + turned)
    for z in range(p):
        _turn(stars, at, whitening, z, [entry for entry in entries if entry[2] >= p])
    column = at.columns + 2 + 2 * p
    for z in range(p):
        _curve(stars, at, whitening, z, column, [entry for entry in entries if entry[2] < p])
        column += 2 * (p - z)


def follow(stars: Stars, model: str, p: int, by_frame: bool = False) -> None:
    """H where the attitudes follow theta, from H and A: the numbers are the turn (3, p) of all
    frames together, or, `by_frame`, the first buffer begins with that of the star's frame.
    """
    shared = stars.numbers(3 * p)
    with stars.each() as (common, own):
        turn = common if by_frame else shared
        a = [own[2 + 2 * p + 2 * c] for c in range(3)]
        for t in range(p):
            turned = added([turn[c * p + t] * a[c] for c in range(3)])
            own[2 + 2 * t] = own[2 + 2 * t] + turned


def _turn(stars: Stars, at: GramRows, whitening: list[Any], z: int, entries: Entries) -> None:
    """The derivatives of A along z, and half of what the path itself bends; the slope."""
    p = math.isqrt(len(whitening))
    with stars.each() as (common, own):
        bent = {n: own[at.bent + 2 * n] for n, _, _ in entries}
        path = [common[p * d + z] for d in range(3)]
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
            slope.append(common[at.pseudo + c] * (mixed + along))
        own[at.slope + 2 * z] = 2.0 * added(slope)


def _curve(
    stars: Stars, at: GramRows, whitening: list[Any], z: int, column: int, entries: Entries
) -> None:
    """Second derivatives along z and each of the parameters from z on."""
    p = math.isqrt(len(whitening))
    # A diagonal entry of z z^T stands once in the expansion, halved; the others stand for both
    # orders.
    weights: dict[tuple[int, int], Any] = {}
    for y in range(z, p):
        for n, t, d in entries:
            orders = [(i, j) for i, j in {(t, d), (d, t)} if z <= i and y <= j]
            if orders:
                both = added([whitening[i * p + z] * whitening[j * p + y] for i, j in orders])
                weights[y, n] = both * (-0.5 if z == y else -1.0)
    with stars.each() as (common, own):
        bent = {n: own[at.bent + 2 * n] for n, _, _ in entries}
        u = [common[at.turned + 3 * z + c] for c in range(3)]
        k = [common[p * c + z] for c in range(3)]
        for y in range(z, p):
            plain = added([weights[y, n] * bent[n] for n in bent if (y, n) in weights])
            bends = added(
                [
                    u[c] * k[c]
                    if z == y
                    else u[c] * common[p * c + y] + k[c] * common[at.turned + 3 * y + c]
                    for c in range(3)
                ]
            )
            own[column + 2 * (y - z)] = plain - bends
