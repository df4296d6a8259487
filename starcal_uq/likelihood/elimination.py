"""Elimination of coefficients that every frame has for itself, such as its attitude.

Columns a of whitened shifts, with coefficients of frame k that no other frame sees, leave of other
columns x what they cannot reproduce, ``x - a (a^T a)_k^-1 a^T x``: a Schur complement in blocks of
the size of the number of columns. Weights and axes of the noise are in the columns already.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.observations.frames import StarFrames


@dataclass(frozen=True, eq=False)
class ByFrame:
    """Columns (c, 2, N) with coefficients of every frame, and the inverse (c, c, K) of their
    products.
    """

    frames: StarFrames
    columns: FloatArray
    inverse: FloatArray

    def coefficients(self, values: FloatArray) -> FloatArray:
        """Least-squares coefficients (q, c, K) of values (q, 2, N)."""
        products = self.frames.sum(np.einsum("ixn,qxn->qin", self.columns, values))
        return np.asarray(np.einsum("ijk,qik->qjk", self.inverse, products))

    def removed_from(self, values: FloatArray) -> FloatArray:
        """What is left of values (q, 2, N)."""
        spread = self.frames.spread(self.coefficients(values))
        left: FloatArray = values - np.einsum("qin,ixn->qxn", spread, self.columns)
        return left

    @cached_property
    def orthonormal(self) -> FloatArray:
        """Columns (c, 2, N) that span the same, orthonormal in every frame."""
        root: FloatArray = np.asarray(np.linalg.cholesky(np.moveaxis(self.inverse, 2, 0)))
        spread = self.frames.spread(np.moveaxis(root, 0, 2))
        # Not optimised: a product of matrices for each star would take ten times as long.
        return np.asarray(np.einsum("axn,abn->bxn", self.columns, spread))


def products_by_frame(frames: StarFrames, one: FloatArray, other: FloatArray) -> FloatArray:
    """Products (K, a, b) of columns (a, x, N) and (b, x, N) over the stars of each frame, along x
    axes.
    """
    blocks = frame_blocks(frames, one)
    found = blocks @ other.reshape(len(other), blocks.shape[1]).T
    return np.asarray(found.reshape(frames.n_frames, len(one), len(other)))


def frame_blocks(frames: StarFrames, one: FloatArray) -> Any:
    """Columns (a, x, N) as a sparse matrix (a K, x N), each frame with rows of its own."""
    from scipy.sparse import csc_array

    a, axes, n = one.shape
    n *= axes
    place = a * np.repeat(np.arange(frames.n_frames), frames.sizes)[:, None] + np.arange(a)
    entries = one.reshape(a, n).T.ravel(), np.tile(place.ravel(), axes)
    return csc_array((*entries, a * np.arange(n + 1)), shape=(a * frames.n_frames, n))
