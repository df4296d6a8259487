"""Attitudes of different frames tied by known rotations between them.

A tie says ``R_b R_a^T = exp([w]x) D`` with a measured D and ``w ~ N(0, S)``; of a fixed mount
``R_k = exp([w]x) M E_k`` with the Earth's axes E_k and an unknown M. Around attitudes of the frames

    w = w0 + J phi + U c,

with small turns phi of the frames, and c of what is common to all ties: the mount, which is free, or
the axes of the instrument that measured D, which turn with the camera and are known to ``c ~ N(0,
C)``. Each frame alone leaves
``phi ~ N(phi*(theta), sigma^2 (A^T A)^-1)``. With both eliminated the ties add to the sum of
squares of the frames

    w*^T W w*,   w* = w0 + J phi*(theta),   Omega = S / sigma^2 + J (A^T A)^-1 J^T,
    W = Omega^-1 - Omega^-1 U (sigma^2 C^-1 + U^T Omega^-1 U)^-1 U^T Omega^-1.

Omega is sparse: block tridiagonal where every frame is tied to the next one, block diagonal for a
mount. The cost grows with the number of frames, and sums over stars stay what they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from starcal_uq.attitude.relative import RelativeAttitudes
from starcal_uq.attitude.rotations import quaternion_to_rotation, rotation_vector
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.compressed import CompressedLikelihood, gram_sums
from starcal_uq.likelihood.marginal import TURN_RAD, MarginalLikelihood
from starcal_uq.likelihood.sums import ATTITUDE_TOLERANCE_RAD, Attitudes, NormalSums
from starcal_uq.likelihood.terms import block_diagonal, factor
from starcal_uq.maths.linear import scaled_cholesky

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True)
class FixedMount:
    """A camera that the Earth turns, and nothing else.

    Attributes
    ----------
    sigma_arcsec : float
        How far the mount moves from frame to frame about each axis, standard deviation, arcsec.
    """

    sigma_arcsec: float

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma_arcsec < float("inf"):
            raise CalibrationError(
                f"mount_sigma_arcsec is {self.sigma_arcsec!r}: state how far the mount moves from "
                "frame to frame, such as 1.0."
            )


@dataclass(frozen=True, eq=False)
class FittedTies:
    """Known rotations between frames that a calibration holds.

    Attributes
    ----------
    known : RelativeAttitudes
        The rotations, with their stated errors.
    chi2 : float
        How far they contradict the stars: what they add to the sum of squares at the best
        parameters, in units of the noise without them.
    dof : int
        Independent numbers among them, the expectation of `chi2`.
    p_value : float
        Probability of a larger `chi2` where the stated errors are right, by Fisher's distribution.
    error_factor : float
        Factor on the stated errors with which `chi2` would be as expected.
    sigma : float
        Noise without the rotations, which their errors are relative to.
    sigmas_without : (p,) array
        Standard deviations of the parameters without the rotations, px units.
    """

    known: RelativeAttitudes
    chi2: float
    dof: int
    p_value: float
    error_factor: float
    sigma: float
    sigmas_without: FloatArray

    SHAPES: ClassVar = "p: sigmas_without"


@dataclass(frozen=True, eq=False)
class Ties:
    """Known rotations between the frames of a table."""

    known: RelativeAttitudes
    # (T,): places of the frames in the table; `first` is empty for a fixed mount
    first: IntArray
    second: IntArray

    @classmethod
    def of(cls, frame_ids: IntArray, known: RelativeAttitudes) -> Ties:
        """Ties of the frames with these numbers, (K,); CalibrationError for other frames."""
        for ids in (known.frame_a, known.frame_b):
            missing = ~np.isin(ids, frame_ids)
            if missing.any():
                raise CalibrationError(
                    f"the relative attitudes name frame {ids[missing][0]}, which the table does "
                    "not hold: remove its rows, or add the stars of the frame."
                )
        first, second = (np.searchsorted(frame_ids, ids) for ids in (known.frame_a, known.frame_b))
        return cls(known, first, second)

    @property
    def dof(self) -> int:
        """Independent numbers that the ties add."""
        return 3 * len(self.second) - (3 if self.known.of_mount else 0)

    def around(self, rotations: FloatArray, inverse: FloatArray, sigma: float) -> TiedFrames:
        """The linear system around attitudes (K, 3, 3); `inverse` (3, 3, K) is that of ``A^T A`` in
        units of the noise `sigma`.
        """
        from scipy.sparse import bsr_array

        measured, of_b = quaternion_to_rotation(self.known.quaternions), rotations[self.second]
        t, k = len(self.second), len(rotations)
        blocks, places = [np.broadcast_to(np.eye(3), (t, 3, 3))], [self.second]
        common, precision = None, 0.0
        if self.known.of_mount:
            seen = of_b @ np.swapaxes(measured, 1, 2)
            u, _, vt = np.linalg.svd(seen.sum(axis=0))
            mount = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
            rest = rotation_vector(seen @ mount.T)
            common = np.tile(-np.eye(3), (t, 1))
        else:
            turn = of_b @ np.swapaxes(rotations[self.first], 1, 2)
            rest = rotation_vector(turn @ np.swapaxes(measured, 1, 2))
            blocks.append(-turn)
            places.append(self.first)
            if self.known.alignment_arcsec > 0.0:
                common = (np.eye(3) - turn).reshape(-1, 3)
                precision = (sigma * ARCSEC / self.known.alignment_arcsec) ** 2
        own, place = np.stack(blocks, axis=1).reshape(-1, 3, 3), np.stack(places, axis=1).ravel()
        ends = len(blocks) * np.arange(t + 1)
        jacobian = bsr_array((own, place, ends), shape=(3 * t, 3 * k)).tocsr()
        response = block_diagonal(np.ascontiguousarray(np.moveaxis(inverse, 2, 0))) @ jacobian.T
        error = (self.known.sigma_arcsec / ARCSEC / sigma) ** 2
        omega = jacobian @ response + block_diagonal(error[:, :, None] * np.eye(3))
        solve, volume = factor(omega, "relative attitudes", "them")
        return TiedFrames(rest.ravel(), jacobian, response, solve, volume, common, precision)


class TiedFrames:
    """Ties around attitudes: errors ``w0 + J phi`` and products with their inverse covariance."""

    def __init__(
        self,
        rest: FloatArray,
        jacobian: Any,
        response: Any,
        solve: Callable[[FloatArray], FloatArray],
        volume: float,
        common: FloatArray | None,
        precision: float,
    ) -> None:
        self.rest = rest  # (3 T,): w0, rad
        self._jacobian, self._response = jacobian, response
        self._solve, self._common, self._free = solve, common, precision == 0.0
        self.log_determinant = volume
        if common is not None:
            self._solved = solve(common)
            self._inner = common.T @ self._solved + precision * np.eye(3)
            self.log_determinant += float(np.linalg.slogdet(self._inner)[1])

    def columns(self, turns: FloatArray) -> FloatArray:
        """Changes (3 T, q) of the ties' errors by turns (3, q, K) of the frames."""
        if self._common is not None and self._free:
            # What all frames do is the mount's, and far larger than the rest.
            turns = turns - turns.mean(axis=2, keepdims=True)
        flat = np.moveaxis(turns, 2, 0).reshape(-1, turns.shape[1])
        return np.asarray(self._jacobian @ flat)

    def solve(self, columns: FloatArray) -> FloatArray:
        """``W x`` (3 T, q)."""
        found = self._solve(columns)
        if self._common is None:
            return found
        return found - self._solved @ np.linalg.solve(self._inner, self._solved.T @ columns)

    def turns(self) -> FloatArray:
        """Rotation vectors (3, K) from the attitudes of each frame alone to those that the ties
        leave.
        """
        pulled = -(self._response @ self.solve(self.rest[:, None]))
        return np.ascontiguousarray(pulled.reshape(-1, 3).T)


class TiedLikelihood(MarginalLikelihood):
    """Exact likelihood with the frames' attitudes tied; errors of the ties are in units of `sigma`.

    Sums are those of the frames alone and of the ties together. A profile is that of the frames
    alone.
    """

    def __init__(
        self,
        obs: Observations,
        model_name: str,
        ties: Ties,
        sigma: float,
        rotations: FloatArray | None = None,
    ) -> None:
        super().__init__(obs, model_name, rotations)
        self.ties, self.sigma = ties, sigma

    @property
    def dof(self) -> int:
        """As for frames alone, and the numbers that the ties add."""
        return super().dof + self.ties.dof

    def tied(self, attitudes: Attitudes) -> TiedFrames:
        """The ties around the best attitudes of each frame alone."""
        rotations = attitudes.at(attitudes.theta)
        return self.ties.around(rotations, attitudes.inverse, self.sigma)

    def sums(
        self, theta: FloatArray, tolerance: float = ATTITUDE_TOLERANCE_RAD
    ) -> tuple[NormalSums, Attitudes]:
        """Normal equations with the ties, and the attitudes of each frame alone."""
        sums, attitudes = super().sums(theta, tolerance)
        if not np.isfinite(sums.cost):
            return sums, attitudes
        tied = self.tied(attitudes)
        columns = np.column_stack([tied.rest, tied.columns(attitudes.response)])
        gram = columns.T @ tied.solve(columns)
        together = replace(
            sums,
            cost=sums.cost + float(gram[0, 0]),
            gradient=sums.gradient + gram[0, 1:],
            matrix=sums.matrix + gram[1:, 1:],
            log_determinant=sums.log_determinant + tied.log_determinant,
        )
        return together, attitudes

    def compressed(self, theta: FloatArray, covariance: FloatArray) -> CompressedLikelihood:
        """Compressed around theta (p,) with the whitening of a covariance (p, p).

        Attitudes follow the parameters to first order in the ties.
        """
        known = super().sums(theta, tolerance=TURN_RAD)
        whitening, tied = scaled_cholesky(covariance), self.tied(known[1])
        frames, model, p = self.frames, self.model_name, len(theta)
        found = gram_sums(frames, model, theta, whitening, known)
        turned = np.einsum("ipk,pa->iak", known[1].response, whitening)
        columns = np.column_stack([tied.rest, tied.columns(turned)])
        gram = found.gram.copy()
        gram[: p + 1, : p + 1] += columns.T @ tied.solve(columns)
        volume = found.log_determinant + tied.log_determinant
        plain = replace(found, gram=gram, log_determinant=volume).likelihood(theta, whitening)
        steps = [(self._volume(theta + own), self._volume(theta - own)) for own in whitening.T]
        slope = np.array([0.5 * (ahead - behind) for ahead, behind in steps])
        return replace(plain, dof=self.dof, log_determinant_slope=slope)

    def _volume(self, theta: FloatArray) -> float:
        return self.sums(theta, tolerance=TURN_RAD)[0].log_determinant
