"""The sums over stars with NumPy: the reference, and what needs no compiler.

Stars are visited in blocks of whole frames whose temporaries stay in the processor's cache.
`starcal_uq.likelihood.paths.Sums` says what each function gives; the columns of a block are of use
beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import (
    backward_kernel,
    backward_root,
    forward_kernel,
    forward_root,
    slope_kernel,
    unproject_theta,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.expansion import GramRows, expand, frame_rows
from starcal_uq.maths.linear import COLUMNS, ROWS, inverse_symmetric
from starcal_uq.observations.frames import StarFrames

# Stars whose arrays stay in the second-level cache, and are enough to hide the interpreter.
BLOCK_STARS, PAIR_STARS, _EXPANSION_STARS = 6144, 4096, 6144
# Enough for the turn of all frames together.
_FEW_STARS = 128


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
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.normals`."""
    p, k = len(theta), frames.n_frames
    gram, turn = np.zeros((p + 1, p + 1)), np.zeros((3, p))
    packed, mixed = np.empty((6, k)), np.empty((3, p + 1, k))
    for block in blocks(frames, model_name, theta, rotations):
        columns, turn = block.columns, block.turn
        flat = columns[3:].reshape(p + 1, -1)
        gram += flat @ flat.T
        products = block.part.sum(np.einsum("ixn,cxn->icn", columns[:3], columns))
        packed[:, block.place] = products[ROWS, COLUMNS]
        mixed[:, :, block.place] = products[:, 3:]
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


def blocks(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
) -> Iterator[Block]:
    """All frames in blocks, whitened; the common turn C is that of the first."""
    p, starts = len(theta), frames.starts
    pieces = frames.parts(BLOCK_STARS)
    largest = max((int(starts[last] - starts[first]) for first, last in pieces), default=0)
    buffer, kernel = np.empty((4 + p) * 2 * largest), forward_kernel(model_name, "first")
    turn = np.zeros((3, p))
    for first, last in pieces:
        part = frames.part(first, last)
        columns = buffer[: (4 + p) * 2 * part.n_stars].reshape(4 + p, 2, part.n_stars)
        b = part.rotated(rotations[first:last])
        flat = columns.reshape(2 * (p + 4), -1)
        kernel.into((theta, b, forward_root(model_name, theta, b)), (flat[6:8], flat[8:], flat[:6]))
        np.subtract(part.pixel, columns[3], out=columns[3])
        part.whiten(columns)
        if first == 0:
            turn = _common_turn(columns[..., :_FEW_STARS])
        flat = columns.reshape(p + 4, -1)
        flat[4:] -= turn.T @ flat[:3]
        yield Block(slice(first, last), part, columns, turn)


@dataclass
class _Block:
    """Stars of some frames, for `starcal_uq.likelihood.expansion`."""

    whitening: list[float]
    of_frames: dict[int, FloatArray]  # Rows (n,) that stars of a frame share, or (2, n)
    own: dict[int, FloatArray]  # Rows (2, n), two numbers each

    def numbers(self, n: int) -> list[float]:
        return self.whitening

    @contextmanager
    def each(self) -> Iterator[tuple[dict[int, FloatArray], dict[int, FloatArray]]]:
        yield self.of_frames, self.own


def gram(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    whitening: FloatArray,
    rotations: FloatArray,
    response: FloatArray,
    inverse: FloatArray,
    look: Callable[[slice, FloatArray], None] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """As `starcal_uq.likelihood.paths.Sums.gram`; `look` is shown which frames are in a block, and
    the columns (q, 2, n) of its stars.
    """
    p, at, kernel = (
        len(theta),
        GramRows.of(model_name, len(theta)),
        forward_kernel(model_name, "bent"),
    )
    q = (p + 1) * (p + 2) // 2
    total, slope, by_frame = np.zeros((q, q)), np.zeros(p), frame_rows(whitening, response, inverse)
    for first, last in frames.parts(_EXPANSION_STARS):
        part = frames.part(first, last)
        b, n = part.rotated(rotations[first:last]), part.n_stars
        rows = np.empty((at.slope // 2, 2, n))
        outputs = rows[:1], rows[1 : p + 1], rows[p + 1 : p + 4], rows[p + 4 :]
        root = forward_root(model_name, theta, b)
        kernel.into((theta, b, root), [output.reshape(-1, n) for output in outputs])
        np.subtract(part.pixel, rows[0], out=rows[0])
        part.whiten(rows)
        shared = dict(enumerate(part.spread(by_frame[:, first:last])))
        block = _Block(
            whitening.ravel().tolist(), shared, {2 * k: row for k, row in enumerate(rows)}
        )
        expand(block, model_name, p)
        columns = np.stack([block.own[at.columns + 2 * k] for k in range(q)])
        flat, second = columns.reshape(q, -1), columns[p + 1 :]
        total += flat @ flat.T
        slopes = products_by_frame(part, outputs[2], second)
        total[p + 1 :, p + 1 :] -= np.einsum(
            "kiq,ijk,kjr->qr", slopes, inverse[..., first:last], slopes, optimize=True
        )
        slope += [np.sum(block.own[at.slope + 2 * z]) for z in range(p)]
        if look is not None:
            look(slice(first, last), columns)
    return total, slope


def slope(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    response: FloatArray,
    inverse: FloatArray,
) -> FloatArray:
    """As `starcal_uq.likelihood.paths.Sums.slope`."""
    weight = np.linalg.inv(np.eye(2) if frames.axes is None else frames.axes).ravel()
    kernel = slope_kernel(model_name, frames.axes is None)
    total = np.zeros_like(theta)
    for first, last in frames.parts(BLOCK_STARS):
        part, own = frames.part(first, last), slice(first, last)
        b = part.rotated(rotations[own])
        root = forward_root(model_name, theta, b)
        spread = part.spread(inverse[..., own].reshape(9, -1))
        (found,) = kernel(part.n_stars, theta, b, root, part.pixel, weight, spread)
        if part.weight is not None:
            found *= part.weight**2
        turned = np.einsum("ik,ipk->p", part.sum(found[-3:]), response[..., own])
        total += found[:-3].sum(axis=1) + turned
    return total


def attitudes(
    frames: StarFrames, model_name: str, theta: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """As `starcal_uq.likelihood.paths.Sums.attitudes`."""
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


def _gram(frames: StarFrames, a: FloatArray, b: FloatArray) -> FloatArray:
    """Per-frame 3 x 3 matrices ``A^T B`` of two stacks of vectors (3, N): (3, 3, K)."""
    return frames.sum(a[:, None, :] * b[None, :, :])


def _apply(stars: FloatArray, matrix: FloatArray) -> FloatArray:
    """Every star's vectors (..., 3, N) times its frame's matrix (3, 3, N): the rows of ``A M``."""
    return np.asarray(np.einsum("...in,ijn->...jn", stars, matrix))


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
    scores = frames.sum(np.einsum("pin,in->pn", db, d_b))
    weighted = _apply(db, frames.spread(_gram(frames, b, b)))
    matrix = weighted.reshape(p, -1) @ db.reshape(p, -1).T
    cross = frames.sum(b[:, None] * db[:, None])
    matrix += cross.reshape(p, -1) @ cross.transpose(0, 2, 1, 3).reshape(p, -1).T
    return cost, matrix, scores
