"""Errors that a star brings along: its direction is off by the same in every frame that shows it.

A star s whose tabulated direction errs by u_s (px at the boresight, along two axes on the sky) shifts its images by
``Z u`` with Z the pixels per direction, turned with every frame. With u_s of variance ``tau^2`` per axis, and what the
catalogue states on top, the data have the covariance

    V = sigma^2 (I + Z Lambda Z^T),   Lambda = (tau^2 + stated^2) / sigma^2.

After the attitudes are projected out (P), products with W = V^-1 - V^-1 A (A^T V^-1 A)^-1 A^T V^-1 need one system:

    sigma^2 x^T W y = x^T (I-P) y - c_x^T G^-1 c_y,   c_x = Z^T (I-P) x,   G = Lambda^-1 + Z^T (I-P) Z.

G couples stars that were seen together. Z^T Z is block-diagonal over stars and P over frames, so that either side can
be eliminated; the smaller one is left over, and is solved densely.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.estimation.marginal import MarginalLikelihood, Profile

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

# Images of one direction to this fraction of a pixel, from one to the next, are of one star where no name says so.
_SAME_PX = 0.3
# Stars of one name are one star within this: aberration and proper motion move a direction from frame to frame.
_SAME_NAME_PX, _SAME_NAME_RAD = 5.0, 6e-4
# A star variance, in units of the noise, that is none.
_NO_RATIO = 1e-10


def star_numbers(obs: Observations, focal_px: float) -> IntArray:
    """Number the stars of a table by direction, or by name where all stars have one.

    Returns
    -------
    (N,) array of int
        The same number for images of the same star, from 0.
    """
    names = obs.star_id
    named = names is not None and bool(np.all(names != ""))
    tolerance = max(_SAME_NAME_PX / focal_px, _SAME_NAME_RAD) if named else _SAME_PX / focal_px
    place = _linked(obs.directions_icrs, tolerance)
    if named and names is not None:
        # A name alone is not trusted: numbers that start again with every frame are no names of stars.
        code = np.unique(names, return_inverse=True)[1]
        place = np.unique(code * (int(place.max()) + 1) + place, return_inverse=True)[1]
    return np.asarray(place, dtype=np.int64)


def _linked(directions: FloatArray, tolerance: float) -> IntArray:
    """Number groups of directions (N, 3) in which each is nearer to another one than the tolerance, rad."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    # Cells first: a star that is seen ten thousand times would have ten million pairs.
    cells, member = np.unique(np.round(directions / (0.3 * tolerance)).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0 / 0.3, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2)
    labels = connected_components(links, directed=False)[1]
    return np.asarray(labels[member.ravel()], dtype=np.int64)


def sky_axes(directions: FloatArray, numbers: IntArray) -> FloatArray:
    """Two axes across each star's direction, the same for all of its images: (2, 3, N) for directions (3, N)."""
    first = np.unique(numbers, return_index=True)[1]
    r = directions[:, first]
    helper = np.eye(3)[np.argmin(np.abs(r), axis=0)].T
    u = np.cross(helper, r, axis=0)
    u /= np.linalg.norm(u, axis=0)
    return np.stack([u, np.cross(r, u, axis=0)])[:, :, numbers]


def offset_columns(part: MarginalLikelihood, state: Profile, axes: FloatArray, focal_px: float) -> FloatArray:
    """Whitened shift (2, 2, n) of every image for one px (at the boresight) of offset of its star along `axes`.

    A small change d of a direction b is the rotation ``b x d``, so that the attitude columns hold it already.
    """
    turned = np.cross(part.frames.r[None], axes, axis=1)
    rotation = [part.frames.spread(np.ascontiguousarray(state.rotations[:, i].T)) for i in range(3)]
    angles = np.stack([np.sum(row * turned, axis=1) for row in rotation], axis=1)
    shift: FloatArray = np.einsum("jin,ixn->jxn", angles, state.attitude, optimize=True) / focal_px
    return shift


def _turn(z: FloatArray) -> FloatArray:
    """The orthogonal matrices nearest to z (2, 2, n)."""
    side = np.sign(z[0, 0] * z[1, 1] - z[0, 1] * z[1, 0])
    angle = np.arctan2(z[0, 1] - side * z[1, 0], z[0, 0] + side * z[1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-side * s, side * c]])


def add_by_star(total: FloatArray, values: FloatArray, stars: IntArray) -> None:
    """Add values (..., n) of images to the sums (S, ...) of their stars."""
    present, member = np.unique(stars, return_inverse=True)
    rows = [np.bincount(member, row, len(present)) for row in values.reshape(-1, values.shape[-1])]
    total[present] += np.stack(rows, axis=1).reshape(len(present), *values.shape[:-1])


def _blocks(blocks: FloatArray) -> Any:
    """A block-diagonal matrix of blocks (S, 2, 2), sparse."""
    from scipy.sparse import bsr_array

    s = len(blocks)
    return bsr_array((blocks, np.arange(s), np.arange(s + 1)), shape=(2 * s, 2 * s)).tocsr()


class StarSums:
    """Sums over all images from which products with the covariance of star errors follow.

    Parameters
    ----------
    numbers : (N,) array of int
        Star of every image, from 0.
    directions : (3, N) array
        Catalogue directions.
    focal_px : float
        Focal length, px.
    rigid : bool
        Take the turn of the columns alone, of size one: shifts are then in units of the noise.
    """

    def __init__(self, numbers: IntArray, directions: FloatArray, focal_px: float, rigid: bool = False) -> None:
        self.numbers, self.focal_px, self.rigid = numbers, focal_px, rigid
        self.axes = sky_axes(directions, numbers)
        self.n_stars = int(numbers.max()) + 1
        self.own = np.zeros((self.n_stars, 2, 2))
        self._cross: FloatArray | None = None
        self._blocks: list[tuple[FloatArray, IntArray, IntArray]] = []
        self._frames = 0

    @property
    def cross(self) -> FloatArray:
        """``Z^T (I-P) X`` (2 S, q) of the columns that were added."""
        if self._cross is None:
            return np.zeros((2 * self.n_stars, 0))
        return self._cross.reshape(2 * self.n_stars, -1)

    def columns(self, part: MarginalLikelihood, state: Profile, rows: slice) -> FloatArray:
        """`offset_columns` of the images of some rows."""
        z = offset_columns(part, state, self.axes[:, :, rows], self.focal_px)
        return _turn(z) if self.rigid else z

    def add(self, part: MarginalLikelihood, state: Profile, projected: FloatArray, rows: slice) -> FloatArray:
        """Add frames with columns (q, 2, n), attitudes projected out; their `columns` come back."""
        stars, z = self.numbers[rows], self.columns(part, state, rows)
        if self._cross is None:
            self._cross = np.zeros((self.n_stars, 2, len(projected)))
        add_by_star(self.own, np.einsum("ixn,jxn->ijn", z, z), stars)
        add_by_star(self._cross, np.einsum("ixn,qxn->iqn", z, projected), stars)
        # Z^T A times the root of (A^T A)^-1: P in the coordinates of the stars is the square of this.
        root = np.linalg.cholesky(np.moveaxis(state.inverse, 2, 0))
        block = np.einsum(
            "ixn,axn,nab->nib", z, state.attitude, np.repeat(root, part.frames.sizes, axis=0), optimize=True
        )
        frame = self._frames + np.repeat(np.arange(part.frames.n_frames), part.frames.sizes)
        self._blocks.append((block, stars, frame))
        self._frames += part.frames.n_frames
        return z

    @cached_property
    def coupling(self) -> Any:
        """``Z^T A (A^T A)^(-1/2)`` (2 S, 3 K), sparse."""
        from scipy.sparse import csr_array

        block, stars, frames = (np.concatenate(parts) for parts in zip(*self._blocks, strict=True))
        rows = (2 * stars[:, None, None] + np.arange(2)[:, None]) + np.zeros(3, dtype=np.int64)
        columns = (3 * frames[:, None, None] + np.arange(3)) + np.zeros((2, 1), dtype=np.int64)
        shape = (2 * self.n_stars, 3 * self._frames)
        return csr_array((block.ravel(), (rows.ravel(), columns.ravel())), shape=shape)

    @cached_property
    def matrix(self) -> Any:
        """``Z^T (I-P) Z`` (2 S, 2 S), sparse."""
        b = self.coupling
        return (_blocks(self.own) - b @ b.T).tocsr()

    def solved(self, ratio: FloatArray) -> SolvedStars:
        """Solve for star variances `ratio` (2 S,), px^2, in units of sigma^2."""
        return SolvedStars(self, ratio)


class SolvedStars:
    """``G = Lambda^-1 + Z^T (I-P) Z`` with a factor of its smaller side."""

    def __init__(self, sums: StarSums, ratio: FloatArray) -> None:
        from scipy.linalg import cho_factor

        self._sums, self.ratio = sums, np.maximum(ratio, _NO_RATIO)
        precision = 1.0 / self.ratio
        b = sums.coupling
        self._by_star = b.shape[0] <= b.shape[1]
        log_own = 0.0
        if self._by_star:
            left = sums.matrix.toarray()
            left[np.diag_indices_from(left)] += precision
        else:
            own = sums.own.copy()
            own[:, 0, 0] += precision[0::2]
            own[:, 1, 1] += precision[1::2]
            self._inverse: FloatArray = np.asarray(np.linalg.inv(own), dtype=np.float64)
            log_own = float(np.sum(np.log(np.linalg.det(own))))
            left = np.eye(b.shape[1]) - (b.T @ self._own_solve(b)).toarray()
        self._factor = cho_factor(left, lower=True, overwrite_a=True, check_finite=False)
        log_factor = 2.0 * float(np.sum(np.log(np.diag(self._factor[0]))))
        # log |I + Lambda Z^T (I-P) Z|
        self.log_determinant = log_factor + log_own + float(np.sum(np.log(self.ratio)))

    def _own_solve(self, values: Any) -> Any:
        return _blocks(self._inverse) @ values

    def offsets(self, cross: FloatArray) -> FloatArray:
        """``G^-1 c`` (2 S, q): best offsets, px, for ``c = Z^T (I-P) X``."""
        from scipy.linalg import cho_solve

        if self._by_star:
            return np.asarray(cho_solve(self._factor, cross, check_finite=False))
        b, first = self._sums.coupling, self._own_solve(cross)
        inner = cho_solve(self._factor, b.T @ first, check_finite=False)
        return np.asarray(first + self._own_solve(b @ inner))

    def correction(self) -> FloatArray:
        """What star errors take off the Gram matrix (q, q) of the columns that were added."""
        cross = self._sums.cross
        taken = cross.T @ self.offsets(cross)
        return np.asarray(0.5 * (taken + taken.T))
