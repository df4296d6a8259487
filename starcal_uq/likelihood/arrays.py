"""The sums over stars with NumPy: the reference, and what needs no compiler.

Stars are visited in blocks of whole frames whose temporaries stay in the processor's cache.
`starcal_uq.likelihood.paths.Sums` says what each function gives; the columns of a block are of use
beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import (
    backward_kernel,
    backward_root,
    bent_index,
    forward_kernel,
    forward_root,
    unproject_theta,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.linear import COLUMNS, ROWS, inverse_symmetric
from starcal_uq.observations.frames import StarFrames

# Stars whose arrays stay in the second-level cache, and are enough to hide the interpreter.
BLOCK_STARS, PAIR_STARS, _EXPANSION_STARS = 3072, 4096, 2048
# Enough for the turn of all frames together.
_FEW_STARS = 128


class Buffers:
    """Arrays of one block, used again for the next one."""

    def __init__(self, p: int, n: int) -> None:
        self._columns = np.empty((4 + p) * 2 * n)
        self._products = np.empty(3 * (3 + p) * n)
        self._one, self._two = np.empty((4 + p) * n), np.empty((4 + p) * n)
        self.p = p

    def columns(self, n: int) -> FloatArray:
        """A, e and H: (3 + 1 + p, 2, n)."""
        return self._columns[: (4 + self.p) * 2 * n].reshape(4 + self.p, 2, n)

    def products(self, columns: FloatArray) -> FloatArray:
        """Products of the three rows of A with themselves and the ones that follow, over both axes:
        (.., n).
        """
        rows, _, n = columns.shape
        out = self._products[: 3 * (rows - 1) * n].reshape(3 * (rows - 1), n)
        first = 0
        for i in range(3):
            count = rows - i
            one, two = (buffer[: count * n].reshape(count, n) for buffer in (self._one, self._two))
            np.multiply(columns[i:, 0], columns[i, 0], out=one)
            np.multiply(columns[i:, 1], columns[i, 1], out=two)
            np.add(one, two, out=out[first : first + count])
            first += count
        return out


def unpacked(sums: FloatArray, rows: int) -> tuple[FloatArray, FloatArray]:
    """From the sums of `Buffers.products`: packed A^T A (6, K), and A^T [e, H] (3, p + 1, K)."""
    starts = (0, rows, 2 * rows - 1)
    packed = np.concatenate([sums[first : first + 3 - i] for i, first in enumerate(starts)])
    rest = np.stack([sums[first + 3 - i : first + rows - i] for i, first in enumerate(starts)])
    return packed, rest


def _common_turn(columns: FloatArray) -> FloatArray:
    """C (3, p): the turn of all frames of a block together that follows theta best."""
    flat = columns.reshape(len(columns), -1)
    a, h = flat[:3], flat[4:]
    none = np.zeros((3, len(h)))
    try:
        with np.errstate(all="ignore"):
            turn = np.linalg.solve(a @ a.T, a @ h.T)
    except np.linalg.LinAlgError:
        return none
    return np.asarray(turn) if np.isfinite(turn).all() else none


def common_turn(
    frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray
) -> FloatArray:
    """C (3, p) of `starcal_uq.likelihood.sums`, of the first frames."""
    few = min(1 + int(np.searchsorted(frames.starts, _FEW_STARS)), frames.n_frames)
    return next(blocks(frames.part(0, few), model_name, theta, rotations[:few])).turn


def normals(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    residuals: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.normals`."""
    p, k = len(theta), frames.n_frames
    gram, turn = np.zeros((p + 1, p + 1)), np.zeros((3, p))
    packed, mixed = np.empty((6, k)), np.empty((3, p + 1, k))
    for block in blocks(frames, model_name, theta, rotations, residuals):
        flat, turn = block.columns.reshape(p + 4, -1), block.turn
        gram += flat[3:] @ flat[3:].T
        packed[:, block.place], mixed[:, :, block.place] = unpacked(block.products(), p + 4)
    inverse, determinant = inverse_symmetric(packed)
    solved = np.einsum("ijk,jqk->iqk", inverse, mixed)
    gram -= np.tensordot(mixed, solved, axes=([0, 2], [0, 2]))
    return gram, solved[:, 0], -solved[:, 1:] - turn[:, :, None], inverse, np.log(determinant)


class Block(NamedTuple):
    """A (3, 2, n), e (2, n) and H' (p, 2, n) of some frames, in a buffer that the next block uses
    again.
    """

    place: slice
    part: StarFrames
    columns: FloatArray
    turn: FloatArray
    buffers: Buffers

    def products(self) -> FloatArray:
        """Sums over the stars of each frame of `Buffers.products`."""
        return self.part.sum(self.buffers.products(self.columns))


def blocks(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    residuals: FloatArray | None = None,
) -> Iterator[Block]:
    """All frames in blocks, whitened; the common turn C is that of the first."""
    p, starts = len(theta), frames.starts
    pieces = frames.parts(BLOCK_STARS)
    largest = max((int(starts[last] - starts[first]) for first, last in pieces), default=0)
    buffers, kernel, turn = (
        Buffers(p, largest),
        forward_kernel(model_name, "first"),
        np.zeros((3, p)),
    )
    for first, last in pieces:
        part = frames.part(first, last)
        columns = buffers.columns(part.n_stars)
        b = part.rotated(rotations[first:last])
        flat = columns.reshape(2 * (p + 4), -1)
        kernel.into((theta, b, forward_root(model_name, theta, b)), (flat[6:8], flat[8:], flat[:6]))
        np.subtract(part.pixel, columns[3], out=columns[3])
        part.whiten(columns)
        if residuals is not None:
            residuals[:, int(starts[first]) : int(starts[last])] = columns[3]
        if first == 0:
            turn = _common_turn(columns)
        flat = columns.reshape(p + 4, -1)
        flat[4:] -= turn.T @ flat[:3]
        yield Block(slice(first, last), part, columns, turn, buffers)


class _Expansion:
    """The residuals of frames expanded around one point, block by block.

    Second derivatives Q over (theta, phi) are contracted with the directions (L z, phi(z)), in
    which the attitudes phi(z) = K z follow the parameters; most entries of Q that belong to theta
    alone vanish and are not formed.
    """

    def __init__(self, model_name: str, theta: FloatArray, whitening: FloatArray) -> None:
        self.model_name, self.theta, self.whitening = model_name, theta, whitening
        p = self.p = len(theta)
        self.q = (p + 1) * (p + 2) // 2
        self._kernel = forward_kernel(model_name, "bent")
        rows, columns = bent_index(model_name)
        own, mixed, turned = columns < p, (rows < p) & (columns >= p), rows >= p
        self._own, self._mixed = np.flatnonzero(own), np.flatnonzero(mixed)
        self._turned = {
            (int(rows[n]) - p, int(columns[n]) - p): int(n) for n in np.flatnonzero(turned)
        }
        i, j = np.triu_indices(p)
        # A diagonal entry of z z^T stands once in the expansion, halved; the others stand for both
        # orders.
        self._halved = np.where(i == j, 0.5, 1.0)
        r, c = rows[own], columns[own]
        both = whitening[r][:, i] * whitening[c][:, j] + np.where(r == c, 0.0, 1.0)[:, None] * (
            whitening[c][:, i] * whitening[r][:, j]
        )
        self._to_square = (both * self._halved).T
        # From the entries (theta_t, phi_c) to (z_a, phi_c), rows a, c.
        self._to_mixed = np.zeros((p, 3, len(self._mixed)))
        for n, entry in enumerate(self._mixed):
            self._to_mixed[:, columns[entry] - p, n] = whitening[rows[entry]]

    def block(
        self,
        part: StarFrames,
        rotations: FloatArray,
        moved: tuple[FloatArray, FloatArray, FloatArray],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Columns (q, 2, n) of frames that fit into the cache, those of the attitudes (3, 2, n), and
        the slope of the log determinant.

        Columns are derivatives of the residuals along the attitudes' first-order path: value and
        first derivatives are free of what attitudes can reproduce, second derivatives are not.
        """
        p, n = self.p, part.n_stars
        xy, h, a = np.empty((2, n)), np.empty((p, 2, n)), np.empty((3, 2, n))
        bent = np.empty((self._kernel.shapes[3][0], 2, n))
        b, (shift, response, inverse) = part.rotated(rotations), moved
        outputs = (xy, h.reshape(-1, n), a.reshape(-1, n), bent.reshape(-1, n))
        self._kernel.into((self.theta, b, forward_root(self.model_name, self.theta, b)), outputs)
        e = part.pixel - xy
        for array in (e, h, a, bent):
            part.whiten(array)
        d = (self.whitening.T @ h.reshape(p, -1)).reshape(p, 2, n)
        path = part.spread(np.einsum("ipk,pa->iak", response, self.whitening))
        columns = np.empty((self.q, 2, n))
        columns[0] = e - np.sum(part.spread(shift)[:, None] * a, axis=0)
        first, second = columns[1 : p + 1], columns[p + 1 :]
        np.copyto(first, d)
        for c in range(3):
            first += path[c][:, None] * a[c]
        np.negative(first, out=first)
        bend = self._curves(bent, path, second)
        pseudo = np.einsum("ijn,jxn->ixn", part.spread(inverse), a)
        return columns, a, 2.0 * (bend.reshape(p, -1) @ pseudo.ravel())

    def _curves(self, bent: FloatArray, path: FloatArray, second: FloatArray) -> FloatArray:
        """Second derivatives along z into `second`; the derivatives (p, 3, 2, n) of the attitude
        columns come back.
        """
        p, n = self.p, bent.shape[2]
        flat = bent.reshape(len(bent), -1)
        bend = (self._to_mixed.reshape(3 * p, -1) @ flat[self._mixed]).reshape(p, 3, 2, n)
        turned = np.zeros((p, 3, 2, n))
        for (c, d), entry in self._turned.items():
            turned[:, c] += path[d][:, None] * bent[entry]
            if c != d:
                turned[:, d] += path[c][:, None] * bent[entry]
        half = bend + 0.5 * turned
        np.matmul(self._to_square, flat[self._own], out=second.reshape(len(second), -1))
        start = 0
        for i in range(p):
            rows = second[start : start + p - i]
            for c in range(3):
                rows[0] += half[i, c] * path[c, i]
                rows[1:] += half[i, c] * path[c, i + 1 :, None]
                rows[1:] += half[i + 1 :, c] * path[c, i]
            start += p - i
        np.negative(second, out=second)
        bend += turned
        return bend


def gram(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    whitening: FloatArray,
    rotations: FloatArray,
    moved: tuple[FloatArray, FloatArray, FloatArray],
    look: Callable[[slice, FloatArray], None] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.gram`; `look` is shown which frames are in a block, and
    the columns (q, 2, n) of its stars.
    """
    expansion, p = _Expansion(model_name, theta, whitening), len(theta)
    total, slope = np.zeros((expansion.q, expansion.q)), np.zeros(p)
    for first, last in frames.parts(_EXPANSION_STARS):
        part = frames.part(first, last)
        own = (moved[0][..., first:last], moved[1][..., first:last], moved[2][..., first:last])
        columns, attitude, log_slope = expansion.block(part, rotations[first:last], own)
        flat, second = columns.reshape(len(columns), -1), columns[p + 1 :]
        total += flat @ flat.T
        slopes = np.stack([part.sum(np.sum(column * second, axis=1)) for column in attitude])
        solved = np.einsum("ijk,jqk->iqk", own[2], slopes)
        total[p + 1 :, p + 1 :] -= np.tensordot(slopes, solved, axes=([0, 2], [0, 2]))
        slope += log_slope
        if look is not None:
            look(slice(first, last), columns)
    return total, slope


def attitudes(
    frames: StarFrames, model_name: str, theta: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """As `starcal_uq.likelihood.paths.Sums.attitudes`, with weights (N,) of the stars."""
    b = unproject_theta(model_name, theta, frames.pixel.T)
    found = quest(b, frames.r.T, frames.starts, weights, covariance=False, on_degenerate="flag")
    return found.rotations


def directions(
    frames: StarFrames, model_name: str, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured unit vectors (3, N) and their derivatives (p, 3, N)."""
    root = backward_root(model_name, theta, frames.pixel)
    b, db = backward_kernel(model_name, True)(frames.n_stars, theta, frames.pixel, root)
    return b, db


def pairs(
    frames: StarFrames, model_name: str, theta: FloatArray, rotations: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.pairs`."""
    p = len(theta)
    cost, matrix, scores = 0.0, np.zeros((p, p)), []
    for first, last in frames.parts(PAIR_STARS):
        part = frames.part(first, last)
        own = _block_pairs(
            part, part.rotated(rotations[first:last]), *directions(part, model_name, theta)
        )
        cost += own[0]
        matrix += own[1]
        scores.append(own[2])
    return cost, matrix, np.concatenate(scores, axis=1)


# Where the entries of a symmetric matrix stand among its six unique ones.
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def _gram(frames: StarFrames, a: FloatArray, b: FloatArray) -> FloatArray:
    """Per-frame 3 x 3 matrices ``A^T B`` of two stacks of vectors (3, N): (3, 3, K)."""
    return frames.sum(a[:, None, :] * b[None, :, :])


def _apply(stars: FloatArray, matrix: FloatArray) -> FloatArray:
    """Every star's vectors (..., 3, N) times its frame's matrix (3, 3, N): the rows of ``A M``."""
    x, y, z = (stars[..., i, None, :] for i in range(3))
    product: FloatArray = x * matrix[0]
    product += y * matrix[1]
    product += z * matrix[2]
    return product


def _dot(stars: FloatArray, vector: FloatArray) -> FloatArray:
    """Products of vectors (..., 3, N) with one (3, N)."""
    product: FloatArray = stars[..., 0, :] * vector[0]
    product += stars[..., 1, :] * vector[1]
    product += stars[..., 2, :] * vector[2]
    return product


def _block_terms(
    frames: StarFrames, catalogue: FloatArray, b: FloatArray
) -> tuple[float, FloatArray]:
    """Cost and D B (3, N) of one block; `catalogue` are the directions (3, N), turned nearly into
    the camera frame.
    """
    e = b - catalogue
    ee, rr, re = (
        _gram(frames, e, e),
        _gram(frames, catalogue, catalogue),
        _gram(frames, catalogue, e),
    )
    er = re.transpose(1, 0, 2)
    cost = float(np.sum(ee * rr + re * er + 2.0 * ee * re + 0.5 * ee * ee))
    # D B = R' (E^T B) + E (R'^T B) + E (E^T B), with B = R' + E.
    return cost, _apply(catalogue, frames.spread(er + ee)) + _apply(
        e, frames.spread(rr + re + er + ee)
    )


def _block_pairs(
    frames: StarFrames, turned: FloatArray, b: FloatArray, db: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Cost, Gauss-Newton matrix (p, p) and gradients (p, K) of one block."""
    p = len(db)
    cost, d_b = _block_terms(frames, turned, b)
    scores = frames.sum(_dot(db, d_b))
    bb = frames.sum(np.stack([b[i] * b[j] for i, j in zip(ROWS, COLUMNS, strict=True)]))
    weighted = _apply(db, frames.spread(bb)[_SYMMETRIC])
    matrix = weighted.reshape(p, -1) @ db.reshape(p, -1).T
    cross = np.empty((3, p, 3, frames.n_frames))
    for i in range(3):
        cross[i] = frames.sum((b[i] * db).reshape(3 * p, -1)).reshape(p, 3, -1)
    cross = cross.transpose(1, 0, 2, 3)
    matrix += cross.reshape(p, -1) @ cross.transpose(0, 2, 1, 3).reshape(p, -1).T
    return cost, matrix, scores
