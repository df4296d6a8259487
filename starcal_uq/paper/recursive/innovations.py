"""What the interstar angles of single frames say about the camera: normal equations of many frames
at once.

A frame of m stars has the innovations ``z_ij = r_i . r_j - b_i . b_j`` over its pairs. To first
order ``z = H dtheta - G e`` with e the centroid errors of the 2 m coordinates, ``H`` the derivative
of the cosines with respect to the parameters and ``G`` that with respect to the pixels. The
covariance of the pairs, ``sigma^2 G G^T``, has rank 2 m - 3 only, because turning the frame changes
no angle, and cannot be inverted. The smallest centroid errors that explain z,

    d = G^+ z,    G^+ = (G^T G + c A A^T)^-1 G^T,

can: A spans the pixel displacements of the frame's three rotations, the null space of G, and any c
> 0 will do. Then ``d = J dtheta - (noise of covariance sigma^2 (I - projector on A))`` with ``J =
G^+ H``, the derivative of the pixels themselves after the best rotation is taken out, and least
squares on d is generalised least squares over the pairs with their full covariance. `G` and `H`
have m (m - 1) / 2 rows and are never formed: all that is needed of them are products with G^T,
which follow from the matrix ``z_ij`` and the 3 x 3 matrix ``sum_j b_j b_j^T``.

The historical filters took pairs as independent, with the diagonal of ``sigma^2 G G^T`` for
covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np

from starcal_uq.camera.projection import backward_kernel, backward_root
from starcal_uq.core.settings import PairCovariance
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.observations.frames import StarFrames

PAIR_COVARIANCES: tuple[PairCovariance, ...] = get_args(PairCovariance)

# Share of the mean eigenvalue that is added to all: displacements that no angle sees to first
# order, such as that of the middle one of three stars in line, then count for nothing instead of
# raising an error.
_RIDGE = 1e-13
# Up to so many stars a frame's system is solved as it is.
_DENSE_STARS = 200


@dataclass(frozen=True)
class PairNormals:
    """Normal equations of K frames at one point, for p parameters."""

    # (K, 1 + p, 1 + p): ``[d, J]^T [d, J]`` of every frame: sum of squares, gradient and
    # information at unit noise (whitened by the stated noise where there is one).
    grams: FloatArray
    # (K, 1 + p, 1 + p): sums under the covariance that the filter assumes: `grams` itself for
    # ``full``; for ``diagonal`` the sums over pairs, each divided by its variance.
    weighted: FloatArray
    # (K,): number of independent numbers that the filter counts in a frame: 2 m - 3, or m (m - 1) /
    # 2 for ``diagonal``.
    pairs: FloatArray
    # (K, 3, p): rotation of the frame that makes up for a change of the parameters, rad
    response: FloatArray
    noise: FloatArray  # (K, 3, 3): covariance of the frame's attitude at unit noise, rad^2


def frame_normals(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    scale: FloatArray,
    covariance: PairCovariance = "full",
) -> PairNormals:
    """Linearise the interstar angles of every frame at theta (p,), px units.

    Frames of equal size are treated together; the numbers of a frame do not depend on the others,
    to the last bit. `scale` (p,) are the units of the parameters in the result; those of the
    principal point must be 1 px. The numbers are not finite where the model is not defined at
    theta, such as at a focal length that is not positive.
    """
    try:
        if theta[2] > 0.0:
            with np.errstate(all="ignore"):
                return _frame_normals(frames, model_name, theta, scale, covariance)
    except np.linalg.LinAlgError:
        # Where all stars coincide, as at a focal length without bounds.
        pass
    k, p = frames.n_frames, len(theta)
    grams = np.full((k, 1 + p, 1 + p), np.nan)
    return PairNormals(
        grams, grams, np.full(k, np.nan), np.full((k, 3, p), np.nan), np.full((k, 3, 3), np.nan)
    )


def _frame_normals(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    scale: FloatArray,
    covariance: PairCovariance,
) -> PairNormals:
    """As `frame_normals`, at a positive focal length."""
    k, p = frames.n_frames, len(theta)
    root = backward_root(model_name, theta, frames.pixel)
    b, db = backward_kernel(model_name, True)(frames.n_stars, theta, frames.pixel, root)
    # A pixel moves b as the principal point does, the other way round; over its weight, a unit of
    # its noise.
    by_pixel = -db[:2] if frames.weight is None else -db[:2] / frames.weight
    db *= scale[:, None, None]
    displaced = _left_inverse(by_pixel)
    rotated = np.stack([_cross(b, axis) for axis in displaced])
    response, noise = _attitudes(frames, displaced, rotated, db)
    # One array of all columns, star first, so that the stars of equal frames are gathered once.
    columns = (b, frames.r, by_pixel.reshape(6, -1), rotated.reshape(6, -1), db.reshape(3 * p, -1))
    table = np.ascontiguousarray(np.concatenate(columns).T)
    grams = np.empty((k, 1 + p, 1 + p))
    weighted = grams if covariance == "full" else np.empty_like(grams)
    sizes = frames.sizes
    for m in np.unique(sizes).tolist():
        index = np.flatnonzero(sizes == m)
        group = _Group(table[frames.starts[index][:, None] + np.arange(m)], p)
        grams[index] = group.full()
        if covariance == "diagonal":
            weighted[index] = group.diagonal()
    counts = sizes.astype(np.float64)
    pairs = 2.0 * counts - 3.0 if covariance == "full" else 0.5 * counts * (counts - 1.0)
    return PairNormals(grams, weighted, pairs, response, noise)


def _left_inverse(by_pixel: FloatArray) -> FloatArray:
    """Pixels per direction (2, 3, N) for directions per pixel of the same shape."""
    first, second = by_pixel
    a, b, c = (
        np.sum(u * v, axis=0) for u, v in ((first, first), (first, second), (second, second))
    )
    inverse: FloatArray = np.stack([c * first - b * second, a * second - b * first]) / (
        a * c - b * b
    )
    return inverse


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Cross products (3, N)."""
    return np.stack(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


def _attitudes(
    frames: StarFrames, displaced: FloatArray, rotated: FloatArray, db: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Response and noise of the attitudes, as in `PairNormals`, from pixels per direction and per
    rotation.
    """
    slopes = np.sum(displaced[:, None] * db, axis=2)
    information, shifts = (
        frames.sum(np.sum(rotated[:, :, None] * other[:, None], axis=0)).transpose(2, 0, 1)
        for other in (rotated, slopes)
    )
    if not np.isfinite(information).all():
        return np.full(shifts.shape, np.nan), np.full(information.shape, np.nan)
    noise = floats(np.linalg.inv(information))
    return noise @ shifts, noise


class _Group:
    """n frames of m stars each, from a table (n, m, 18 + 3 p).

    It holds of every star: measured and catalogue direction, directions per pixel (x, then y),
    pixels per rotation (x, then y), and derivatives of the direction with respect to the
    parameters.
    """

    def __init__(self, table: FloatArray, p: int) -> None:
        n, m = table.shape[:2]
        # Copies: products of strided views take another path for one frame than for many, and end
        # in other bits.
        self.b, r = table[..., :3].copy(), table[..., 3:6].copy()
        self.by_pixel = table[..., 6:12].reshape(n, m, 2, 3)
        self.rotated = table[..., 12:18].reshape(n, 2 * m, 3)
        self.db = table[..., 18:].reshape(n, m, p, 3)
        self.r, self.transposed = r, self.b.transpose(0, 2, 1)

    @cached_property
    def innovations(self) -> FloatArray:
        """Differences of cosines (n, m, m)."""
        return self.r @ self.r.transpose(0, 2, 1) - self.b @ self.transposed

    @cached_property
    def by_pair(self) -> FloatArray:
        """Of star i, axis a: change of its cosine with star j, (n, m, 2, m)."""
        n, m = self.b.shape[:2]
        return (self.by_pixel.reshape(n, 2 * m, 3) @ self.transposed).reshape(n, m, 2, m)

    def full(self) -> FloatArray:
        """Gram matrices (n, 1 + p, 1 + p) of d and J."""
        b, db, by_pixel = self.b, self.db, self.by_pixel
        n, m, p = db.shape[:3]
        moment = (self.transposed @ b)[:, None]
        # G^T of the columns z and H, whose entries are dot products with the partners' directions.
        partners = self.transposed @ db.reshape(n, m, p * 3)
        turned = b @ partners.reshape(n, 3, p, 3).transpose(0, 3, 2, 1).reshape(n, 3, p * 3)
        if m <= _DENSE_STARS:
            first = self.innovations @ b
        else:
            rows = [slice(i, i + _DENSE_STARS) for i in range(0, m, _DENSE_STARS)]
            r_transposed = self.r.transpose(0, 2, 1)
            chunks = [
                (self.r[:, at] @ r_transposed - b[:, at] @ self.transposed) @ b for at in rows
            ]
            first = np.concatenate(chunks, axis=1)
        columns = np.concatenate(
            [first[:, :, None], db @ moment + turned.reshape(n, m, p, 3)], axis=2
        )
        right = (by_pixel @ columns.transpose(0, 1, 3, 2)).reshape(n, 2 * m, 1 + p)
        # G^T G: star i with itself through all its partners.
        own = by_pixel @ moment @ by_pixel.transpose(0, 1, 3, 2)
        solved = (
            self._solved(own, right) if m <= _DENSE_STARS else self._solved_by_parts(own, right)
        )
        return solved.transpose(0, 2, 1) @ solved

    def _solved(self, own: FloatArray, right: FloatArray) -> FloatArray:
        """(G^T G + c A A^T)^-1 of columns (n, 2 m, q), from the blocks (n, m, 2, 2) of single
        stars.
        """
        n, m = own.shape[:2]
        stars, every, rotated = np.arange(m), np.arange(2 * m), self.rotated
        # Star i with star j through their one pair.
        normal = self.by_pair[..., None] * self.by_pair.transpose(0, 3, 1, 2)[:, :, None]
        normal[:, stars, :, stars] += own.transpose(1, 0, 2, 3)
        normal = normal.reshape(n, 2 * m, 2 * m)
        # A copy in this order, again for the sake of the last bit.
        trace = np.sum(np.ascontiguousarray(np.diagonal(normal, axis1=1, axis2=2)), axis=1)
        share = trace / np.sum(rotated * rotated, axis=(1, 2))
        normal += share[:, None, None] * (rotated @ rotated.transpose(0, 2, 1))
        normal[:, every, every] += (_RIDGE / m) * trace[:, None]
        return np.asarray(np.linalg.solve(normal, right))

    def _solved_by_parts(self, own: FloatArray, right: FloatArray) -> FloatArray:
        """As `_solved`, in a time proportional to the stars.

        What stars have in common through their pairs is of rank nine: with directions per pixel P
        and u = P b^T, entry (i, j) is the sum over x and y of u_i,xy u_j,yx. The rest is a 2 x 2
        block for every star (Woodbury's formula).
        """
        n, m = own.shape[:2]
        rotated = self.rotated
        trace = np.trace(own, axis1=2, axis2=3).sum(axis=1)
        share = trace / np.sum(rotated * rotated, axis=(1, 2))
        common = (self.by_pixel[..., None] * self.b[:, :, None, None, :]).reshape(n, 2 * m, 9)
        common = np.concatenate([common, np.sqrt(share)[:, None, None] * rotated], axis=2)
        core = np.eye(12)
        core[:9, :9] = core[:9, :9][np.arange(9).reshape(3, 3).T.ravel()]
        blocks = np.linalg.inv(own + (_RIDGE / m) * trace[:, None, None, None] * np.eye(2))

        def apart(columns: FloatArray) -> FloatArray:
            return (blocks @ columns.reshape(n, m, 2, -1)).reshape(columns.shape)

        alone, spread = apart(right), apart(common)
        joint = np.linalg.solve(
            core + common.transpose(0, 2, 1) @ spread, common.transpose(0, 2, 1) @ alone
        )
        return alone - spread @ joint

    def diagonal(self) -> FloatArray:
        """Gram matrices (n, 1 + p, 1 + p) of z and H over pairs taken as independent."""
        n, m, p = self.db.shape[:3]
        one_sided = (
            (self.db.reshape(n, m * p, 3) @ self.transposed)
            .reshape(n, m, p, m)
            .transpose(0, 2, 1, 3)
        )
        slopes = one_sided + one_sided.transpose(0, 1, 3, 2)
        first, second = np.triu_indices(m, 1)
        columns = np.concatenate([self.innovations[:, None], slopes], axis=1)[:, :, first, second]
        spread = np.sum(self.by_pair * self.by_pair, axis=2)
        variance = (spread + spread.transpose(0, 2, 1))[:, first, second]
        gram: FloatArray = (columns / variance[:, None]) @ columns.transpose(0, 2, 1)
        return gram
