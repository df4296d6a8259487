"""Offsets of stars, linear in the pixels, and their elimination.

A term shifts the images of every star by ``Z u`` with the same two coefficients u, which have a
variance. In units of the noise the data then have the covariance ``V = I + Z Lambda Z^T``. After the
attitudes are projected out (P), products with W = V^-1 - V^-1 A (A^T V^-1 A)^-1 A^T V^-1 need one
system:

    x^T W y = x^T (I-P) y - c_x^T G^-1 c_y,   c_x = Z^T (I-P) x,   G = Lambda^-1 + Z^T (I-P) Z.

G couples stars that were seen together. Z^T Z is block-diagonal over stars and P over frames, so
that either side can be eliminated; the smaller one is left over, and is solved as a sparse or a
dense matrix. Residuals and columns are whitened: any weights and axes of the noise are in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile

# Coefficients of a star.
_SIZE = 2
# A variance, in units of the noise, that is none.
_NO_RATIO = 1e-10
# Rows of a dense matrix, 400 MB; a larger one must have few entries, as frames all over the sky
# give.
_LARGEST, _THIN = 7000, 0.01
# Share of entries from which a matrix is solved as a dense one.
_FULL = 0.2


@dataclass(frozen=True, eq=False)
class Term:
    """Shifts of the images of stars by two coefficients of each."""

    groups: IntArray  # (N,): star of every image, from 0
    n_groups: int
    # Whitened shifts (2, 2, n) of the images of some rows by coefficients of one, of the model of
    # their frames.
    columns: Callable[[MarginalLikelihood, Profile, slice | IntArray], FloatArray]


def add_by_group(total: FloatArray, values: FloatArray, groups: IntArray) -> None:
    """Add values (..., n) of images to the sums (G, ...) of their groups."""
    if not values.size:
        return
    if len(total) <= 4 * len(groups):
        present, member = np.arange(len(total)), groups
    else:
        present, member = np.unique(groups, return_inverse=True)
    rows = [np.bincount(member, row, len(present)) for row in values.reshape(-1, values.shape[-1])]
    total[present] += np.stack(rows, axis=1).reshape(len(present), *values.shape[:-1])


class TermSums:
    """Sums over all images from which products with the covariance of a term follow."""

    def __init__(self, term: Term) -> None:
        self.term, self.n_groups = term, term.n_groups
        self.own = np.zeros((self.n_groups, _SIZE, _SIZE))
        self._cross: FloatArray | None = None
        self._blocks: list[tuple[FloatArray, IntArray, IntArray]] = []
        self._frames = 0

    @property
    def cross(self) -> FloatArray:
        """``Z^T (I-P) X`` (G c, q) of the columns that were added."""
        rows = self.n_groups * _SIZE
        return np.zeros((rows, 0)) if self._cross is None else self._cross.reshape(rows, -1)

    def add(
        self,
        part: MarginalLikelihood,
        state: Profile,
        projected: FloatArray,
        rows: slice | IntArray,
        of_frames: FloatArray | None = None,
    ) -> None:
        """Add frames, with columns (q, 2, n) whose attitudes are projected out.

        `of_frames` (c, 2, n): such columns that every frame has coefficients of, beside its
        attitude.
        """
        groups, z = self.term.groups[rows], self.term.columns(part, state, rows)
        if self._cross is None:
            self._cross = np.zeros((self.n_groups, _SIZE, len(projected)))
        add_by_group(self.own, np.einsum("ixn,jxn->ijn", z, z), groups)
        add_by_group(self._cross, np.einsum("ixn,qxn->iqn", z, projected), groups)
        # P in the coordinates of the groups is the square of this.
        own = part.attitudes(state).orthonormal
        if of_frames is not None:
            own = np.concatenate([own, of_frames])
        block = np.einsum("ixn,bxn->nbi", z, own)
        frame = self._frames + np.repeat(np.arange(part.frames.n_frames), part.frames.sizes)
        self._blocks.append((block, groups, frame))
        self._frames += part.frames.n_frames

    @cached_property
    def coupling(self) -> Any:
        """``Z^T A (A^T A)^(-1/2)`` (G c, 3 K), sparse."""
        return self._by_frame(lambda block, frames: block[:, :3])

    def coupling_of(self, turn: FloatArray) -> Any:
        """Products (G c, d K) with the columns of frames turned by (K, c, d), sparse."""
        return self._by_frame(lambda block, frames: np.swapaxes(turn, 1, 2)[frames] @ block[:, 3:])

    def _by_frame(self, columns: Callable[[FloatArray, IntArray], FloatArray]) -> Any:
        from scipy.sparse import bsr_array, csr_array

        block, groups, frames = (np.concatenate(parts) for parts in zip(*self._blocks, strict=True))
        block = columns(block, frames)
        width = block.shape[1]
        shape = (width * self._frames, self.n_groups * _SIZE)
        if not width:
            return csr_array(shape[::-1])
        starts = np.searchsorted(frames, np.arange(self._frames + 1))
        # A product of whole blocks takes a tenth of the time of one of their entries.
        return bsr_array((block, groups, starts), shape=shape).T

    @cached_property
    def matrix(self) -> Any:
        """``Z^T (I-P) Z`` (G c, G c), sparse."""
        return self.matrix_without(self.coupling)

    def matrix_without(self, coupling: Any) -> Any:
        """The same less the square of a coupling, sparse."""
        return (block_diagonal(self.own) - coupling @ coupling.T).tocsr()


def block_diagonal(blocks: FloatArray) -> Any:
    """A block-diagonal matrix of blocks (G, c, c), sparse."""
    from scipy.sparse import bsr_array

    n, size, _ = blocks.shape
    return bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(size * n, size * n)).tocsr()


def factor(matrix: Any, name: str, option: str) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """What solves with a sparse positive definite matrix, and the log of its determinant.

    CalibrationError for a matrix that is too large, of what `name` says and `option` asks for.
    """
    from scipy.linalg import cho_factor, cho_solve
    from scipy.sparse.linalg import splu

    n = matrix.shape[0]
    density = matrix.nnz / n**2
    if n > _LARGEST and density > _THIN:
        raise CalibrationError(
            f"the {name} need a full matrix of {n} rows, and {_LARGEST} are possible: "
            f"calibrate fewer frames, or leave {option} out."
        )
    if density > _FULL:
        dense = cho_factor(matrix.toarray(), lower=True, overwrite_a=True, check_finite=False)
        volume = 2.0 * float(np.sum(np.log(np.diag(dense[0]))))
        return lambda columns: cho_solve(dense, columns, check_finite=False), volume
    sparse = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    volume = float(np.sum(np.log(np.abs(sparse.U.diagonal()))))
    return lambda columns: sparse.solve(np.asfortranarray(columns)), volume


class Eliminated:
    """``G = Lambda^-1 + Z^T (I-P) Z`` with a factor of its smaller side, or of the groups' or the
    frames'; `also` is a coupling beside the attitudes'.
    """

    def __init__(
        self,
        sums: TermSums,
        ratio: FloatArray,
        also: Any,
        by_group: bool | None = None,
    ) -> None:
        from scipy.sparse import diags_array, eye_array, hstack

        self._sums, self.ratio = sums, np.maximum(ratio, _NO_RATIO)
        precision = 1.0 / self.ratio
        b = hstack([sums.coupling, also]).tocsr()
        self._coupling = b
        self._by_group = b.shape[0] <= b.shape[1] if by_group is None else by_group
        log_own = 0.0
        if self._by_group:
            left = sums.matrix_without(b) + diags_array(precision)
        else:
            own = sums.own + precision.reshape(-1, _SIZE, 1) * np.eye(_SIZE)
            self._inverse: FloatArray = np.asarray(np.linalg.inv(own), dtype=np.float64)
            log_own = float(np.sum(np.log(np.linalg.det(own))))
            left = eye_array(b.shape[1]) - b.T @ self._own_solve(b)
        self._solve, log_factor = factor(left, "errors of the stars", "the effect 'star'")
        # log |I + Lambda Z^T (I-P) Z|
        self.log_determinant = log_factor + log_own + float(np.sum(np.log(self.ratio)))

    def _own_solve(self, values: Any) -> Any:
        return block_diagonal(self._inverse) @ values

    def coefficients(self, cross: FloatArray) -> FloatArray:
        """``G^-1 c`` (G c, q): best coefficients for ``c = Z^T (I-P) X``."""
        if self._by_group:
            return self._solve(cross)
        b, first = self._coupling, self._own_solve(cross)
        return np.asarray(first + self._own_solve(b @ self._solve(b.T @ first)))

    @property
    def variances(self) -> FloatArray:
        """Variances (G c,) of the coefficients in units of sigma^2, attitudes known."""
        sums = self._sums
        precision = (1.0 / self.ratio).reshape(-1, _SIZE, 1) * np.eye(_SIZE)
        inverse = np.linalg.inv(sums.own + precision)
        return np.diagonal(inverse, axis1=1, axis2=2).ravel()
