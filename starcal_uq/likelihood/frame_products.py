"""What coefficients of frames take of products among other columns, at any scale, as a sum over
frames.

Coefficients of frames have one scale. Along the eigenvectors of the products of a frame's own
columns they are independent whatever that scale is: one with eigenvalue l, whose products with other
columns are a, takes ``rho / (1 + rho l) a a^T`` of the products among these, and adds ``log(1 + rho
l)`` to the log determinant. Both are smooth in log l: their nearest singularity is pi away. So the
many of a large table are summed up at a few nodes of log l, with the weights of Lagrange's
interpolation, and no frame is kept by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starcal_uq.core.types import FloatArray

# Nodes in each interval of log l of length one: what they leave out is 2e-12 of what frames take.
_NODES = 10
_PLACES = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
_TO_NODES = np.linalg.inv(np.polynomial.chebyshev.chebvander(_PLACES, _NODES - 1))
# An eigenvalue below this is none at any scale.
_LEAST = 1e-13


@dataclass(frozen=True, eq=False)
class FrameProducts:
    """Sums over coefficients of frames from which what they take follows, for w other columns.

    Coefficients are kept one by one in `values` and `rows`; of intervals of log l that hold more
    than their nodes do, at the nodes.
    """

    values: FloatArray  # (r,): eigenvalues
    rows: FloatArray  # (r, w): products with the other columns
    nodes: dict[int, tuple[FloatArray, FloatArray]]  # Numbers (d,) and products (d, w, w)

    @classmethod
    def of(cls, own: FloatArray, others: FloatArray) -> FrameProducts:
        """Those of frames with products (K, c, c) of their columns and (K, c, w) with others."""
        values, vectors = np.linalg.eigh(own)
        rows = np.swapaxes(vectors, 1, 2) @ others
        return cls(values.ravel(), rows.reshape(values.size, others.shape[2]), {})

    @classmethod
    def joined(cls, parts: Sequence[FrameProducts]) -> FrameProducts:
        """Those of all frames, from some frames each."""
        values = np.maximum(np.concatenate([part.values for part in parts]), _LEAST)
        rows = np.concatenate([part.rows for part in parts])
        nodes: dict[int, tuple[FloatArray, FloatArray]] = {}
        for part in parts:
            for place, own in part.nodes.items():
                known = nodes.get(place, (0.0, 0.0))
                nodes[place] = (known[0] + own[0], known[1] + own[1])
        places = np.floor(np.log(values)).astype(np.int64)
        kept = np.ones(len(values), dtype=bool)
        for place, count in zip(*np.unique(places, return_counts=True), strict=True):
            if count <= _NODES * rows.shape[1] and place not in nodes:
                continue
            chosen = places == place
            kept &= ~chosen
            own = _at_nodes(int(place), values[chosen], rows[chosen])
            known = nodes.get(int(place), (0.0, 0.0))
            nodes[int(place)] = (known[0] + own[0], known[1] + own[1])
        return cls(values[kept], rows[kept], nodes)

    def taken(self, ratio: float) -> tuple[FloatArray, float]:
        """What coefficients of this variance take of the products (w, w), and their part of the log
        determinant.
        """
        left = self.rows * np.sqrt(ratio / (1.0 + ratio * self.values))[:, None]
        total, volume = left.T @ left, float(np.sum(np.log1p(ratio * self.values)))
        for place, (numbers, products) in self.nodes.items():
            values = _eigenvalues(place)
            total = total + np.tensordot(ratio / (1.0 + ratio * values), products, axes=1)
            volume += float(numbers @ np.log1p(ratio * values))
        return total, volume


def _eigenvalues(place: int) -> FloatArray:
    """Eigenvalues (d,) at the nodes of an interval."""
    return np.exp(place + 0.5 * (1.0 + _PLACES))


def _at_nodes(place: int, values: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Numbers (d,) and products (d, w, w) of coefficients of one interval at its nodes."""
    at = 2.0 * (np.log(values) - place) - 1.0
    weights = np.polynomial.chebyshev.chebvander(at, _NODES - 1) @ _TO_NODES
    products = np.stack([(rows * weight[:, None]).T @ rows for weight in weights.T])
    return weights.sum(axis=0), products
