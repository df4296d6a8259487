"""QUEST for many frames and many posterior draws at once, with covariance and the TASTE statistic.

Wahba's loss is L(R) = 1/2 sum_i w_i |b_i - R r_i|^2 with weights of sum one. Sources:

- Shuster & Oh 1981, J. Guidance and Control 4(1), 70-77: the quaternion as the eigenvector of the 4x4 matrix
  K that belongs to its largest eigenvalue, found by Newton's method from the sum of weights; the covariance
  [sum_i sigma_i^-2 (I - b_i b_i^T)]^-1.
- Markley 1993, J. Astronautical Sciences 41(2), 261-280 (FOAM): the characteristic quartic of K factored as
  p(l) = (l^2 - |B|^2)^2 - 8 l det B - 4 |adj B|^2. Unlike the expanded polynomial it gives the eigenvalue to
  rounding error in narrow fields, where the two largest eigenvalues nearly coincide.
- Shuster's TASTE = sum_i |b_i - R r_i|^2 / sigma_i^2, chi-square with 2m-3 degrees of freedom.

Shuster avoids the singularity at half turns by *sequential rotations*: the references are first turned by half a
turn about one axis, which permutes the quaternion so that another component serves as divisor. The same four
solutions are the four rows of the adjugate of (K - l I), each parallel to the quaternion. The row with the
largest diagonal entry is the one whose divisor is the largest component: that is how the rotation is chosen here,
problem by problem. One Newton step on the rotation itself then removes what rounding the adjugate has cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from starcal_uq import wahba
from starcal_uq._types import BoolArray, FloatArray, IntArray
from starcal_uq.attitude import quaternion_to_rotation
from starcal_uq.errors import StarcalError

# Temporaries of this many stars stay in the processor's cache.
_BLOCK = 32_768
# Below this a rotation about one axis is lost in rounding: the stars span less than about 0.3 arcsec.
_DEGENERATE = 1e-12


class DegenerateFrameError(StarcalError):
    """Frames whose stars do not determine an attitude; `frames` holds their indices."""

    def __init__(self, frames: IntArray) -> None:
        more = f" (and {frames.size - 1} more)" if frames.size > 1 else ""
        super().__init__(
            f"frame number {int(frames[0])}{more} does not determine an attitude, because it has fewer than "
            "two distinct stars or values that are not finite: remove such frames, or pass on_degenerate='flag'."
        )
        self.frames = frames


@dataclass(frozen=True)
class QuestResult:
    """Attitudes of K frames, with a leading axis of draws (D, K, ...) where the measurements had one.

    Attributes
    ----------
    quaternions : (..., K, 4) array
        Scalar-last unit quaternions of R_cam_icrs; NaN where `ok` is false.
    lambda_max : (..., K) array
        Largest eigenvalue of K, weights of sum one: 1 - loss.
    loss : (..., K) array
        Wahba's loss at the solution, weights of sum one. From the residuals where sigma_rad was given,
        otherwise 1 - lambda_max, whose rounding error is about 1e-15.
    observability : (..., K) array
        Least curvature of the loss, weights of sum one: the smallest eigenvalue of sum_i w_i (I - b_i b_i^T) to
        first order, at worst a factor 3 below it. In a narrow field it is the mean squared angle from the
        centroid of the stars, in rad^2; zero for one star.
    ok : (..., K) bool array
        False where the frame does not determine an attitude.
    dof : (K,) array
        2 m - 3.
    covariance : (..., K, 3, 3) array or None
        Covariance of the left rotation error (pitch, yaw, roll) in rad^2. Without sigma_rad it is for
        sigma_i^2 = 1 / w_i rad^2 (1 rad^2 for every star without weights): multiply by the noise variance.
    taste : (..., K) array or None
        Chi-square with `dof` degrees of freedom if sigma_rad and the identifications are right; None without
        sigma_rad.
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
        Measured unit vectors in the camera frame, sorted by frame; D draws of them share everything else.
    r : (N, 3) or (D, N, 3) array
        Catalogue unit vectors.
    starts : (K+1,) array
        Frame k holds rows ``starts[k]:starts[k+1]``.
    weights : (N,) array, optional
        Positive weights on any scale; equal by default.
    sigma_rad : float or (N,) array, optional
        Direction noise per axis in rad. Sets the weights to sigma_rad^-2, scales the covariance, and asks for
        TASTE.
    covariance : bool
        False saves the time for the covariances.
    on_degenerate : {"raise", "flag"}
        What to do with frames that do not determine an attitude; flagged frames have NaN and ``ok`` false.

    Raises
    ------
    ValueError
        Shapes that do not match, vectors that are not of unit length, weights or sigmas not positive.
    DegenerateFrameError
        One star, coinciding stars or values that are not finite, if `on_degenerate` is "raise".
    """
    b, r, starts = np.asarray(b, dtype=float), np.asarray(r, dtype=float), np.asarray(starts, dtype=np.int64)
    _check_shapes(b, r, starts)
    taste = sigma_rad is not None
    w = _weights(weights, sigma_rad, b.shape[-2])
    batch = b if b.ndim == 3 else b[None]
    n_draws, n_frames = batch.shape[0], starts.size - 1
    references = r if r.ndim == 3 else r[None]
    shape = (n_draws, n_frames)
    quaternions = np.empty((4, *shape))
    lambda_max, loss, gap = np.empty((3, *shape))
    covariances = np.empty((6, *shape)) if covariance else None
    chi2 = np.empty(shape) if taste else None

    for rows, frames, draws in _blocks(starts, n_draws):
        b3 = _components(batch[draws, rows])
        r3 = _components(references[draws if references.shape[0] > 1 else slice(None), rows])
        local, part = starts[frames.start : frames.stop] - rows.start, np.s_[draws, frames]
        w_rows = None if w is None else w[rows]
        total = np.diff(starts[frames.start : frames.stop + 1]).astype(float)
        if w_rows is not None:
            total = np.add.reduceat(w_rows, local)
        profile = wahba.profile(b3, r3, w_rows, local, total)
        q, lam, gap[part] = wahba.solve(profile)
        quaternions[:, draws, frames], lambda_max[part], loss[part] = q, lam, 1.0 - lam
        if covariances is not None:
            covariances[:, draws, frames] = wahba.inverse(wahba.information(b3, w_rows, local))
        if chi2 is not None:
            counts = np.diff(starts[frames.start : frames.stop + 1])
            chi2[part] = wahba.squared_residuals(b3, r3, w_rows, local, counts, q)
            loss[part] = 0.5 * chi2[part] / total

    ok = np.isfinite(lambda_max) & (gap > _DEGENERATE)
    if not ok.all():
        if on_degenerate == "raise":
            raise DegenerateFrameError(np.flatnonzero(~ok.all(axis=0)))
        quaternions[:, ~ok] = np.nan
        for array in (covariances, chi2):
            if array is not None:
                array[..., ~ok] = np.nan
    first = slice(None) if b.ndim == 3 else 0
    return QuestResult(
        quaternions=np.ascontiguousarray(np.moveaxis(quaternions, 0, -1))[first],
        lambda_max=lambda_max[first],
        loss=loss[first],
        observability=gap[first],
        ok=ok[first],
        dof=2 * np.diff(starts) - 3,
        covariance=None if covariances is None else wahba.full(covariances)[first],
        taste=None if chi2 is None else chi2[first],
    )


def _check_shapes(b: FloatArray, r: FloatArray, starts: IntArray) -> None:
    if b.ndim not in (2, 3) or b.shape[-1] != 3:
        raise ValueError(f"b has shape {b.shape}, expected (N, 3) or (D, N, 3).")
    if r.shape not in (b.shape, b.shape[-2:]):
        raise ValueError(f"r has shape {r.shape}, which does not match b of shape {b.shape}.")
    if starts.ndim != 1 or starts.size < 2 or starts[0] != 0 or starts[-1] != b.shape[-2]:
        raise ValueError(f"starts must be a list of offsets from 0 to the number of stars, {b.shape[-2]}.")
    if np.any(np.diff(starts) <= 0):
        empty = int(np.flatnonzero(np.diff(starts) <= 0)[0])
        raise ValueError(f"frame number {empty} has no stars: starts must increase strictly.")


def _weights(
    weights: FloatArray | None, sigma_rad: FloatArray | float | None, n_stars: int
) -> FloatArray | None:
    if weights is not None and sigma_rad is not None:
        raise ValueError("give weights or sigma_rad, not both: sigma_rad sets the weights to sigma_rad**-2.")
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
            (rows, slice(first, last), slice(d, min(d + step, n_draws))) for d in range(0, n_draws, step)
        ]
        first = last
    return blocks


def _components(vectors: FloatArray) -> FloatArray:
    """Components first, (3, d, n)."""
    c = np.ascontiguousarray(np.moveaxis(vectors, -1, 0))
    norm2 = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
    if np.any(np.abs(norm2 - 1.0) > 1e-6):
        raise ValueError("QUEST needs unit vectors: normalise b and r first.")
    return c
