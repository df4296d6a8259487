"""Wahba's problem: attitudes from directions by QUEST, for many frames and posterior draws at once.

Wahba's loss is L(R) = 1/2 sum_i w_i |b_i - R r_i|^2 with weights of sum one. Sources:

- Shuster & Oh 1981, J. Guidance and Control 4(1), 70-77: the quaternion as the eigenvector of the
  4x4 matrix K that belongs to its largest eigenvalue, found by Newton's method from the sum of
  weights; the covariance [sum_i sigma_i^-2 (I - b_i b_i^T)]^-1.
- Markley 1993, J. Astronautical Sciences 41(2), 261-280 (FOAM): the characteristic quartic of K
  factored as p(l) = (l^2 - |B|^2)^2 - 8 l det B - 4 |adj B|^2. Unlike the expanded polynomial it
  gives the eigenvalue to rounding error in narrow fields, where the two largest eigenvalues nearly
  coincide.
- Shuster's TASTE = sum_i |b_i - R r_i|^2 / sigma_i^2, chi-square with 2m-3 degrees of freedom.

Shuster avoids the singularity at half turns by *sequential rotations*: the references are first
turned by half a turn about one axis, which permutes the quaternion so that another component serves
as divisor. The same four solutions are the four rows of the adjugate of (K - l I), each parallel to
the quaternion. The row with the largest diagonal entry is the one whose divisor is the largest
component: that is how the rotation is chosen here, problem by problem. One Newton step on the
rotation itself then removes what rounding the adjugate has cost.

Arrays inside hold one component each, shaped (d, n) for d draws of n stars or (d, k) for k frames:
NumPy is several times faster on them than on arrays of 3-vectors and 3x3 matrices.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import chain, combinations
from typing import Literal, TypeAlias

import numpy as np

from starcal_uq.attitude.rotations import (
    Matrix,
    axial,
    davenport,
    quaternion_to_rotation,
    rotation_rows,
    symmetric,
)
from starcal_uq.core.errors import StarcalError
from starcal_uq.core.types import BoolArray, FloatArray, IntArray, floats

# Temporaries of this many stars stay in the processor's cache.
_BLOCK = 32_768
# Below this a rotation about one axis is lost in rounding: the stars span less than about 0.3
# arcsec.
DEGENERATE = 1e-12
_NEWTON_STEPS = 60
# Frames whose temporaries stay in the processor's cache.
_PROFILES = 4096
_Vector: TypeAlias = Sequence[FloatArray] | FloatArray
# Each axis with the two others.
_AXES = (0, 1, 2), (1, 0, 2), (2, 0, 1)


class DegenerateFrameError(StarcalError):
    """Frames whose stars do not determine an attitude; `frames` holds their indices."""

    def __init__(self, frames: IntArray) -> None:
        more = f" (and {frames.size - 1} more)" if frames.size > 1 else ""
        super().__init__(
            f"frame number {int(frames[0])}{more} does not determine an attitude, because it has "
            "fewer than two "
            "distinct stars or values that are not finite: remove such frames, or pass "
            "on_degenerate='flag'."
        )
        self.frames = frames


@dataclass(frozen=True)
class QuestResult:
    """Attitudes of K frames, with a leading axis of draws (D, K, ...) where the measurements had
    one.

    Attributes
    ----------
    quaternions : (..., K, 4) array
        Scalar-last unit quaternions of R_cam_icrs; NaN where `ok` is false.
    lambda_max : (..., K) array
        Largest eigenvalue of K, weights of sum one: 1 - loss.
    loss : (..., K) array
        Wahba's loss at the solution, weights of sum one. From the residuals where sigma_rad was
        given, otherwise 1 - lambda_max, whose rounding error is about 1e-15.
    observability : (..., K) array
        Least curvature of the loss, weights of sum one: the smallest eigenvalue of sum_i w_i (I -
        b_i b_i^T) to first order, at worst a factor 3 below it. In a narrow field the mean squared
        angle from the centroid, rad^2.
    ok : (..., K) bool array
        False where the frame does not determine an attitude.
    dof : (K,) array
        2 m - 3.
    covariance : (..., K, 3, 3) array or None
        Covariance of the left rotation error (pitch, yaw, roll) in rad^2. Without sigma_rad it is
        for sigma_i^2 = 1 / w_i rad^2 (1 rad^2 for every star without weights): multiply by the
        noise variance.
    taste : (..., K) array or None
        Chi-square with `dof` degrees of freedom if sigma_rad and the identifications are right;
        None without sigma_rad.
    """

    quaternions: FloatArray
    lambda_max: FloatArray
    loss: FloatArray
    observability: FloatArray
    ok: BoolArray
    dof: IntArray
    covariance: FloatArray | None
    taste: FloatArray | None

    @cached_property
    def rotations(self) -> FloatArray:
        """R_cam_icrs as matrices (..., K, 3, 3), b = R r."""
        return quaternion_to_rotation(self.quaternions)


def quest(
    b: FloatArray,
    r: FloatArray,
    starts: IntArray,
    weights: FloatArray | None = None,
    *,
    sigma_rad: FloatArray | float | None = None,
    covariance: bool = True,
    on_degenerate: Literal["raise", "flag"] = "raise",
) -> QuestResult:
    """Attitude of each frame from its star directions.

    Parameters
    ----------
    b : (N, 3) or (D, N, 3) array
        Measured unit vectors in the camera frame, sorted by frame; D draws of them share everything
        else.
    r : (N, 3) or (D, N, 3) array
        Catalogue unit vectors.
    starts : (K+1,) array
        Frame k holds rows ``starts[k]:starts[k+1]``.
    weights : (N,) array, optional
        Positive weights on any scale; equal by default.
    sigma_rad : float or (N,) array, optional
        Direction noise per axis in rad. Sets the weights to sigma_rad^-2, scales the covariance,
        and asks for TASTE.
    covariance : bool
        False saves the time for the covariances.
    on_degenerate : {"raise", "flag"}
        Treatment of frames that do not determine an attitude; flagged frames have NaN and ``ok``
        false.

    Raises
    ------
    ValueError
        Shapes that do not match, vectors that are not of unit length, weights or sigmas not
        positive.
    DegenerateFrameError
        One star, coinciding stars or values that are not finite, if `on_degenerate` is "raise".
    """
    b = np.asarray(b, dtype=float)
    r = np.asarray(r, dtype=float)
    starts = np.asarray(starts, dtype=np.int64)
    _check_shapes(b, r, starts)
    w = _weights(weights, sigma_rad, b.shape[-2])
    batch = b if b.ndim == 3 else b[None]
    n_draws, n_frames = batch.shape[0], starts.size - 1
    references = r if r.ndim == 3 else r[None]
    shape = (n_draws, n_frames)
    quaternions = np.empty((4, *shape))
    lambda_max, loss, gap = np.empty((3, *shape))
    covariances = np.empty((*shape, 3, 3)) if covariance else None
    chi2 = None if sigma_rad is None else np.empty(shape)

    for rows, frames, draws in _blocks(starts, n_draws):
        b3 = _components(batch[draws, rows])
        r3 = _components(references[draws if references.shape[0] > 1 else slice(None), rows])
        local, part = starts[frames.start : frames.stop] - rows.start, np.s_[draws, frames]
        w_rows = None if w is None else w[rows]
        counts = np.diff(starts[frames.start : frames.stop + 1])
        total = counts if w_rows is None else np.add.reduceat(w_rows, local)
        q, lam, gap[part] = _solve(_profile(b3, r3, w_rows, local, total))
        quaternions[:, draws, frames], lambda_max[part], loss[part] = q, lam, 1.0 - lam
        if covariances is not None:
            covariances[part] = np.moveaxis(
                np.array(_covariance(b3, w_rows, local)), (0, 1), (2, 3)
            )
        if chi2 is not None:
            chi2[part] = _squared_residuals(b3, r3, w_rows, local, counts, q)
            loss[part] = 0.5 * chi2[part] / total

    ok = np.isfinite(lambda_max) & (gap > DEGENERATE)
    if not ok.all():
        if on_degenerate == "raise":
            raise DegenerateFrameError(np.flatnonzero(~ok.all(axis=0)))
        quaternions[:, ~ok] = np.nan
        for array in (covariances, chi2):
            if array is not None:
                array[~ok] = np.nan
    first = slice(None) if b.ndim == 3 else 0
    return QuestResult(
        quaternions=np.ascontiguousarray(np.moveaxis(quaternions, 0, -1))[first],
        lambda_max=lambda_max[first],
        loss=loss[first],
        observability=gap[first],
        ok=ok[first],
        dof=2 * np.diff(starts) - 3,
        covariance=None if covariances is None else covariances[first],
        taste=None if chi2 is None else chi2[first],
    )


def solve_profiles(profiles: FloatArray) -> FloatArray:
    """Rotations (K, 3, 3) of attitude profile matrices (3, 3, K) with weights of sum one; NaN where
    one does not determine an attitude.
    """
    q = np.empty((4, profiles.shape[2]))
    for first in range(0, profiles.shape[2], _PROFILES):
        some = slice(first, first + _PROFILES)
        q[:, some], lam, gap = _solve([list(row) for row in profiles[..., some]])
        q[:, some][:, ~(np.isfinite(lam) & (gap > DEGENERATE))] = np.nan
    return quaternion_to_rotation(q.T)


def _check_shapes(b: FloatArray, r: FloatArray, starts: IntArray) -> None:
    if b.ndim not in (2, 3) or b.shape[-1] != 3:
        raise ValueError(f"b has shape {b.shape}, expected (N, 3) or (D, N, 3).")
    if r.shape not in (b.shape, b.shape[-2:]):
        raise ValueError(f"r has shape {r.shape}, which does not match b of shape {b.shape}.")
    if starts.ndim != 1 or starts.size < 2 or starts[0] != 0 or starts[-1] != b.shape[-2]:
        raise ValueError(
            f"starts must be a list of offsets from 0 to the number of stars, {b.shape[-2]}."
        )
    if np.any(np.diff(starts) <= 0):
        empty = int(np.flatnonzero(np.diff(starts) <= 0)[0])
        raise ValueError(f"frame number {empty} has no stars: starts must increase strictly.")


def _weights(
    weights: FloatArray | None, sigma_rad: FloatArray | float | None, n_stars: int
) -> FloatArray | None:
    if weights is not None and sigma_rad is not None:
        raise ValueError(
            "give weights or sigma_rad, not both: sigma_rad sets the weights to sigma_rad**-2."
        )
    values = weights if sigma_rad is None else sigma_rad
    if values is None:
        return None
    name = "weights" if sigma_rad is None else "sigma_rad"
    array = np.asarray(values, dtype=float)
    if array.shape not in ((), (n_stars,)):
        raise ValueError(f"{name} has shape {array.shape}, expected a number or ({n_stars},).")
    if not np.all(np.isfinite(array) & (array > 0.0)):
        raise ValueError(f"{name} must be finite and positive.")
    if sigma_rad is not None:
        array = array**-2.0
    return np.ascontiguousarray(np.broadcast_to(array, (n_stars,)))


def _blocks(starts: IntArray, n_draws: int) -> list[tuple[slice, slice, slice]]:
    """Cut frames, then draws, into blocks of about `_BLOCK` stars: (rows, frames, draws)."""
    blocks = []
    first, n_frames = 0, starts.size - 1
    while first < n_frames:
        last = int(np.searchsorted(starts, starts[first] + _BLOCK, side="right")) - 1
        last = min(max(last, first + 1), n_frames)
        rows = slice(int(starts[first]), int(starts[last]))
        step = max(1, _BLOCK // (rows.stop - rows.start))
        blocks += [
            (rows, slice(first, last), slice(d, min(d + step, n_draws)))
            for d in range(0, n_draws, step)
        ]
        first = last
    return blocks


def _components(vectors: FloatArray) -> FloatArray:
    """Components first, (3, d, n)."""
    c = np.ascontiguousarray(np.moveaxis(vectors, -1, 0))
    if np.any(np.abs(_dot(c, c) - 1.0) > 1e-6):
        raise ValueError("QUEST needs unit vectors: normalise b and r first.")
    return c


def _profile(
    b: FloatArray,
    r: FloatArray,
    w: FloatArray | None,
    local: IntArray,
    total: FloatArray | IntArray,
) -> Matrix:
    """Attitude profile matrix B_ij = sum w b_i r_j / sum w, each entry (d, k)."""
    weighted = r if w is None else r * w
    scale = 1.0 / total
    return [
        [np.add.reduceat(b[i] * weighted[j], local, axis=-1) * scale for j in range(3)]
        for i in range(3)
    ]


def _solve(B: Matrix) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Quaternions (4, d, k), largest eigenvalue (d, k) and observability (d, k)."""
    cofactors = _cofactors(B)
    norm2, adjoint2 = (_sum_of_squares(chain(*rows)) for rows in (B, cofactors))
    lam = _largest_root(norm2, adjoint2, _dot(B[0], cofactors[0]))
    q, curvature = _polish(_adjugate_quaternion(B, lam), B)
    # |adj B| is about the second singular value of B: it sees coinciding stars, at which the
    # quaternion is arbitrary and the curvature found at it may look sound.
    return q, lam, np.minimum(curvature, np.sqrt(adjoint2 / np.where(norm2 > 0.0, norm2, 1.0)))


def _cofactors(m: Matrix) -> Matrix:
    """Cofactors of 3x3 matrices, which need no signs in cyclic order."""
    cycle = (1, 2, 0)
    return [
        [m[i][k] * m[cycle[i]][cycle[k]] - m[i][cycle[k]] * m[cycle[i]][k] for k in cycle]
        for i in cycle
    ]


def _dot(a: _Vector, b: _Vector) -> FloatArray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sum_of_squares(parts: Iterable[FloatArray]) -> FloatArray:
    return floats(reduce(np.add, (part * part for part in parts)))


def _largest_root(norm2: FloatArray, adjoint2: FloatArray, det: FloatArray) -> FloatArray:
    """Newton's method from the sum of weights, 1, an upper bound from which it descends
    monotonically.
    """
    lam, step = np.ones_like(norm2), np.ones_like(norm2)
    for _ in range(_NEWTON_STEPS):
        a = lam * lam - norm2
        slope = 4.0 * lam * a - 8.0 * det
        value = np.maximum(a * a - 8.0 * lam * det - 4.0 * adjoint2, 0.0)
        # All roots are real, so that steps from above only shrink: a longer one is rounding at a
        # double root, where value and slope vanish together.
        step = np.minimum(value / np.where(slope > 0.0, slope, 1.0), step)
        lam = lam - step
        # Written so that a problem with NaN does not stop the others.
        if not np.any(step > 4e-16):
            break
    return lam


def _adjugate_quaternion(B: Matrix, lam: FloatArray) -> FloatArray:
    """Largest row of adj(K - lambda I), normalised: (4, d, k)."""
    diagonal = [B[i][i] - B[j][j] - B[k][k] - lam for i, j, k in _AXES]
    a = davenport(B, [*diagonal, B[0][0] + B[1][1] + B[2][2] - lam])
    # 2x2 minors of the upper and of the lower two rows.
    upper, lower = (
        {(i, j): p[i] * q[j] - p[j] * q[i] for i, j in combinations(range(4), 2)}
        for p, q in (a[:2], a[2:])
    )

    def cofactor(i: int, j: int) -> FloatArray:
        other, minors = a[i ^ 1], lower if i < 2 else upper
        x, y, z = (column for column in range(4) if column != j)
        value: FloatArray = (
            other[x] * minors[y, z] - other[y] * minors[x, z] + other[z] * minors[x, y]
        )
        return -value if (i + j) % 2 else value

    d = {(i, j): cofactor(i, j) for i in range(4) for j in range(i + 1)}
    # All diagonal entries are <= 0 (three negative factors): the largest in magnitude is the
    # smallest.
    first = np.minimum(d[0, 0], d[1, 1]) < np.minimum(d[2, 2], d[3, 3])
    halves = [(k, d[k, k] < d[k + 1, k + 1]) for k in (0, 2)]
    q = np.empty((4, *lam.shape))
    for i in range(4):
        pair = [
            np.where(is_first, d[max(i, k), min(i, k)], d[max(i, k + 1), min(i, k + 1)])
            for k, is_first in halves
        ]
        q[i] = np.where(first, *pair)
    return _normalise(q)


def _normalise(q: FloatArray) -> FloatArray:
    norm = np.sqrt(_sum_of_squares(q))
    q /= np.where(norm > 0.0, norm, 1.0)
    return q


def _polish(q: FloatArray, B: Matrix) -> tuple[FloatArray, FloatArray]:
    """One Newton step of Wahba's loss on the left rotation vector, and the least curvature of the
    loss.

    With M = B R^T the gradient is minus the axial vector of M, and the Hessian tr(M) I - (M +
    M^T)/2 has the eigenvalues s_i + s_j (sums of two signed singular values of B).
    """
    M = [[_dot(row, turned) for turned in rotation_rows(*q)] for row in B]
    gradient, h = axial(M), symmetric(M, -0.5)
    for i, j, k in _AXES:
        h[i][i] = M[j][j] + M[k][k]
    inverse = _cofactors(h)
    det = _dot(h[0], inverse[0])
    sound = det > 0.0
    half = 0.5 / np.where(sound, det, np.inf)
    px, py, pz = (half * _dot(row, gradient) for row in inverse)
    x, y, z, w = q
    better = np.empty_like(q)
    better[0] = x + px * w + py * z - pz * y
    better[1] = y - px * z + py * w + pz * x
    better[2] = z + px * y - py * x + pz * w
    better[3] = w - px * x - py * y - pz * z
    # For one small eigenvalue, det / (sum of principal minors) is that eigenvalue, and never 3
    # times less.
    minors = inverse[0][0] + inverse[1][1] + inverse[2][2]
    curvature = np.where(sound, det, 0.0) / np.where(minors > 0.0, minors, np.inf)
    return _normalise(better), curvature


def _covariance(b: FloatArray, w: FloatArray | None, local: IntArray) -> Matrix:
    """Inverse of the sum of w (I - b b^T), its entries (d, k); NaN where it is singular."""
    weighted = b if w is None else b * w
    s = {
        (i, j): np.add.reduceat(weighted[i] * b[j], local, axis=-1)
        for i in range(3)
        for j in range(i, 3)
    }
    h = [[-s[min(i, j), max(i, j)] for j in range(3)] for i in range(3)]
    for i, j, k in _AXES:
        h[i][i] = s[j, j] + s[k, k]
    inverse = _cofactors(h)
    det = _dot(h[0], inverse[0])
    return [[entry / np.where(det > 0.0, det, np.nan) for entry in row] for row in inverse]


def _squared_residuals(
    b: FloatArray,
    r: FloatArray,
    w: FloatArray | None,
    local: IntArray,
    counts: IntArray,
    q: FloatArray,
) -> FloatArray:
    """Sum of w |b - R r|^2 per frame, (d, k): from the residuals, as 1 - lambda would lose the
    digits.
    """
    total = np.zeros(b.shape[1:])
    for i, row in enumerate(rotation_rows(*q)):
        x, y, z = (np.repeat(entry, counts, axis=-1) for entry in row)
        residual = b[i] - x * r[0] - y * r[1] - z * r[2]
        total += residual * residual
    if w is not None:
        total *= w
    return np.add.reduceat(total, local, axis=-1)


def aligned(
    estimated: FloatArray, true: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Turn directions (N, 3) by the rotation that brings them closest to others, in weighted least
    squares.

    Returns the turned directions, and the rotation (3, 3) taken off.
    """
    rotation = quest(estimated, true, np.array([0, len(true)]), weight, covariance=False).rotations[
        0
    ]
    return estimated @ rotation, rotation
