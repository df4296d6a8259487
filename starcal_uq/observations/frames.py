"""Stars of many frames as arrays with the star axis last, and sums over the stars of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.core.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations


_NOTHING = 1e-8


def ranges_of_frames(starts: IntArray, max_stars: int) -> list[tuple[int, int]]:
    """Ranges of frames with about `max_stars` stars each; frame k has the stars ``starts[k]:starts[k + 1]``."""
    n_stars = int(starts[-1])
    n_parts = max(1, -(-n_stars // max_stars))
    targets = np.linspace(0, n_stars, n_parts + 1)
    edges = np.unique(np.searchsorted(starts, targets))
    return [(int(a), int(b)) for a, b in pairwise(edges)]


@dataclass(frozen=True)
class StarFrames:
    """Measured pixels (2, N), px, and unit vectors `r` (3, N), ICRS, contiguous by frame.

    `weight` (N,) is the inverse of the stated noise of each star, 1/px; None when all stars are
    alike. Frame k holds the stars ``starts[k]:starts[k + 1]``. `axes` (2, 2) is the covariance of
    the noise of x and y in units of the stated variance, of determinant one; None where the axes
    are alike.
    """

    pixel: FloatArray
    r: FloatArray
    weight: FloatArray | None
    starts: IntArray
    axes: FloatArray | None = None

    SHAPES: ClassVar = """
        2 n: pixel
        3 n: r
        n: weight
        k+1: starts
    """

    @classmethod
    def from_observations(cls, obs: Observations) -> StarFrames:
        """Take the arrays that estimators need."""
        return cls(
            pixel=np.stack([obs.x_px, obs.y_px]),
            r=obs.direction_rows,
            weight=None if obs.sigma_px is None else 1.0 / obs.sigma_px,
            starts=obs.frame_starts,
            axes=obs.noise_axes,
        )

    @classmethod
    def joined(cls, pieces: Sequence[StarFrames]) -> StarFrames:
        """The frames of several pieces, one after the other; all or none of them have weights."""
        if len(pieces) == 1:
            return pieces[0]
        offsets = np.cumsum([0, *(piece.n_stars for piece in pieces)])
        weights = [piece.weight for piece in pieces if piece.weight is not None]
        starts = [
            piece.starts[:-1] + offset for piece, offset in zip(pieces, offsets[:-1], strict=True)
        ]
        return cls(
            pixel=np.concatenate([piece.pixel for piece in pieces], axis=1),
            r=np.concatenate([piece.r for piece in pieces], axis=1),
            weight=np.concatenate(weights) if len(weights) == len(pieces) else None,
            starts=np.concatenate([*starts, offsets[-1:]]),
            axes=pieces[0].axes,
        )

    @property
    def n_stars(self) -> int:
        """Number of stars over all frames."""
        return int(self.pixel.shape[1])

    @property
    def noise(self) -> FloatArray:
        """Stated noise of each star (N,); ones where they state none."""
        return np.ones(self.n_stars) if self.weight is None else 1.0 / self.weight

    @cached_property
    def informed(self) -> IntArray:
        """Number of stars of each frame (K,) that have a say: a weight is nothing beside one 1e8
        times as large.
        """
        if self.weight is None:
            return self.sizes
        return np.add.reduceat(self.weight > _NOTHING * np.max(self.weight), self.starts[:-1])

    @property
    def n_informed(self) -> int:
        """Number of stars that have a say."""
        return int(self.informed.sum())

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.starts) - 1

    @cached_property
    def sizes(self) -> IntArray:
        """Stars per frame, (K,)."""
        return np.diff(self.starts)

    def sum(self, values: FloatArray) -> FloatArray:
        """Sum (..., N) over the stars of each frame: (..., K)."""
        return np.add.reduceat(values, self.starts[:-1], axis=-1)

    def spread(self, values: FloatArray) -> FloatArray:
        """Give every star the value of its frame: (..., K) to (..., N)."""
        return np.repeat(values, self.sizes, axis=-1)

    def in_threes(self, kept: BoolArray) -> BoolArray:
        """Stars (N,), kept or not, of frames that keep three or more."""
        return self.spread(self.sum(kept.astype(np.int64))) >= 3

    def in_pixels(self, whitened: FloatArray) -> FloatArray:
        """Residuals (2, N) in px that were whitened."""
        if self.axes is not None:
            whitened = np.linalg.cholesky(self.axes) @ whitened
        return whitened if self.weight is None else whitened / self.weight

    @cached_property
    def whitening(self) -> FloatArray | None:
        """Matrix (2, 2) that makes the noise of x and y alike and independent; None where it is."""
        return None if self.axes is None else np.linalg.inv(np.linalg.cholesky(self.axes))

    def whiten(self, columns: FloatArray) -> None:
        """Whiten columns (..., 2, N) of pixels in place: over the stated noise, its axes alike and
        apart.
        """
        w = self.whitening
        if w is not None:
            x, y = columns[..., 0, :], columns[..., 1, :]
            y *= w[1, 1]
            y += w[1, 0] * x
            x *= w[0, 0]
        if self.weight is not None:
            columns *= self.weight

    def part(self, first: int, last: int) -> StarFrames:
        """Frames `first` up to, not including, `last`."""
        stars = slice(int(self.starts[first]), int(self.starts[last]))
        return StarFrames(
            pixel=self.pixel[:, stars],
            r=self.r[:, stars],
            weight=None if self.weight is None else self.weight[stars],
            starts=self.starts[first : last + 1] - self.starts[first],
            axes=self.axes,
        )

    def select(self, mask: BoolArray) -> StarFrames:
        """The stars of a mask (N,); frames that keep none are left out."""
        rows = np.flatnonzero(mask)
        sizes = np.diff(np.searchsorted(rows, self.starts))
        return StarFrames(
            pixel=np.take(self.pixel, rows, axis=1),
            r=np.take(self.r, rows, axis=1),
            weight=None if self.weight is None else self.weight[rows],
            starts=np.concatenate([[0], np.cumsum(sizes[sizes > 0])]).astype(np.int64),
            axes=self.axes,
        )

    def parts(self, max_stars: int = 100_000) -> list[tuple[int, int]]:
        """Ranges of frames with about `max_stars` stars each, so that memory stays bounded."""
        return ranges_of_frames(self.starts, max_stars)

    def rotated(self, rotations: FloatArray) -> FloatArray:
        """Catalogue directions in the camera frame: ``b = R r`` with R_cam_icrs (K, 3, 3); (3,
        N).
        """
        columns = self.spread(rotations.reshape(-1, 9).T).reshape(3, 3, -1)
        return np.asarray(np.einsum("ijn,jn->in", columns, self.r))
