"""What a part of the frames says at one point of the parameters, in one pass over its stars.

`frame_sums` gives the normal equations of the marginal likelihood with every frame's attitude
eliminated: `NormalSums`, which add up over parts, and `Attitudes`, which stay with the part: where
its attitudes stand, and how they follow the parameters to first order. A solver that moves both
together, as bundle adjusters do, needs one pass for each of its steps:

    sums, attitudes = frame_sums(part, model, theta, rotations)            # on every part, wherever
    it is normal = sum_of(all_sums).normal                                       # cost, gradient,
    Gauss-Newton matrix sums, attitudes = frame_sums(part, model, theta + step, attitudes.at(theta +
    step))

The stars are visited in blocks of whole frames whose temporaries stay in the processor's cache and
are used again. In a block, A (3, 2, n) are the derivatives of the pixels with respect to the
frames' rotation vectors, H (p, 2, n) those with respect to theta, and e the residuals, all
whitened. With C the turn of all frames together that follows theta best, and H' = H - A C, the sums
are

    cost = e^T e - sum_k (A^T e)_k^T (A^T A)_k^-1 (A^T e)_k,
    matrix = H'^T H' - sum_k (A^T H')_k^T (A^T A)_k^-1 (A^T H')_k.

The principal point and the attitudes are nearly one gauge: without C, the difference of H^T H and
what the attitudes take of it would lose five digits in a field of ten degrees, and nine in one of
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from operator import add
from typing import TypeVar

import numpy as np

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.paths import sums_for
from starcal_uq.likelihood.solvers import Normal
from starcal_uq.observations.frames import StarFrames

T = TypeVar("T")
ATTITUDE_STEPS = 12
ATTITUDE_TOLERANCE_RAD = 1e-9


def together(one: T, other: T, *same: str) -> T:
    """Fields of two records added up, but for those that are the `same` in both."""
    names = [each.name for each in fields(one) if each.name not in same]  # type: ignore[arg-type]
    added = {name: getattr(one, name) + getattr(other, name) for name in names}
    return replace(one, **added)  # type: ignore[type-var]


@dataclass(frozen=True)
class NormalSums:
    """Normal equations of some frames; they add up."""

    cost: float  # Sum of squared whitened residuals, each frame's attitude best to first order
    gradient: FloatArray  # (p,): half its derivative with respect to theta
    matrix: FloatArray  # (p, p): Gauss-Newton matrix
    log_determinant: float  # ``sum_k log |A^T A|_k``
    turn: float  # Largest attitude step that is left, rad
    # `n_stars`, `n_frames`: what was summed.
    n_stars: int
    n_frames: int

    def __add__(self, other: NormalSums) -> NormalSums:
        return replace(together(self, other, "turn"), turn=max(self.turn, other.turn))

    @property
    def normal(self) -> Normal:
        """Cost, gradient and matrix for a solver; infinite where the model is not finite."""
        if not (np.isfinite(self.cost) and np.isfinite(self.matrix).all()):
            p = len(self.gradient)
            return Normal(float("inf"), np.full(p, np.nan), np.full((p, p), np.nan))
        # Noise-free data leave rounding, of either sign.
        return Normal(max(self.cost, 0.0), self.gradient, 0.5 * (self.matrix + self.matrix.T))


def sum_of(parts: Sequence[T]) -> T:
    """All parts together, of whatever adds up."""
    return reduce(add, parts)


@dataclass(frozen=True)
class Attitudes:
    """Attitudes of K frames, and how the best ones follow the parameters."""

    theta: FloatArray  # (p,): where the sums were taken, px units
    rotations: FloatArray  # (K, 3, 3): R_cam_icrs there
    shift: FloatArray  # (3, K): rotation vectors from them to the best ones, rad
    response: FloatArray  # (3, p, K): derivative of the best ones with respect to theta
    inverse: FloatArray  # (3, 3, K): inverse of A^T A per frame
    log_determinant: FloatArray  # (K,): log |A^T A|

    def at(self, theta: FloatArray) -> FloatArray:
        """Best attitudes (K, 3, 3) at theta (p,), to first order."""
        step = self.shift + np.einsum("ipk,p->ik", self.response, theta - self.theta)
        return exp_rotation(step.T) @ self.rotations


def frame_sums(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
) -> tuple[NormalSums, Attitudes]:
    """Normal equations of some frames, attitudes eliminated, in one pass.

    `rotations` (K, 3, 3) are R_cam_icrs, the best ones to first order or better, as `Attitudes.at`
    gives them. Returns what adds up over parts, not finite where the model is not, and what stays
    with the part.
    """
    theta = np.asarray(theta, dtype=np.float64)
    with np.errstate(all="ignore"):
        gram, shift, response, inverse, volume = sums_for(frames).normals(
            frames, model_name, theta, rotations
        )
        sums = NormalSums(
            cost=float(gram[0, 0]),
            gradient=-gram[0, 1:],
            matrix=gram[1:, 1:],
            log_determinant=float(np.sum(volume)),
            turn=float(np.max(np.abs(shift), initial=0.0)),
            n_stars=frames.n_stars,
            n_frames=frames.n_frames,
        )
    return sums, Attitudes(theta, rotations, shift, response, inverse, volume)


def settled_sums(
    frames: StarFrames,
    model_name: str,
    theta: FloatArray,
    rotations: FloatArray,
    tolerance: float = ATTITUDE_TOLERANCE_RAD,
) -> tuple[NormalSums, Attitudes]:
    """As `frame_sums`, passes repeated until every attitude is the best one; a cost of infinity
    where there is none.
    """
    theta = np.asarray(theta, dtype=np.float64)
    for _ in range(ATTITUDE_STEPS):
        sums, attitudes = frame_sums(frames, model_name, theta, rotations)
        if sums.turn < tolerance or not np.isfinite(sums.cost):
            return sums, attitudes
        rotations = attitudes.at(theta)
    # Stars that fit no attitude: nothing here is a minimum.
    return replace(sums, cost=float("inf")), attitudes


class Descent:
    """Normal equations for a solver that moves parameters and attitudes together: one pass for each
    point.

    Parameters
    ----------
    frames : StarFrames
        Data.
    model_name : str
        Distortion model.
    rotations : (K, 3, 3) array
        Attitudes to start from.
    best : tuple of NormalSums and Attitudes, optional
        Sums at a first point.

    Attributes
    ----------
    best : tuple of NormalSums and Attitudes, or None
        Those of the best point so far; None before there is one.
    """

    def __init__(
        self,
        frames: StarFrames,
        model_name: str,
        rotations: FloatArray,
        best: tuple[NormalSums, Attitudes] | None = None,
    ) -> None:
        self.frames, self.model_name = frames, model_name
        self._start, self.best = rotations, best

    def evaluate(self, theta: FloatArray) -> Normal:
        """Cost, gradient and matrix at theta (p,), from the attitudes of the best point so far."""
        theta = np.array(theta, dtype=np.float64)
        if self.best is not None and np.array_equal(theta, self.best[1].theta):
            return self.best[0].normal
        rotations = self._start if self.best is None else self.best[1].at(theta)
        found = frame_sums(self.frames, self.model_name, theta, rotations)
        normal = found[0].normal
        if np.isfinite(normal.cost) and (
            self.best is None or _reaches(normal.cost, self.best[0].cost)
        ):
            self.best = found
        return normal


def _reaches(cost: float, best: float) -> bool:
    """Whether a cost is as low as the best one, but for rounding."""
    return cost <= best + 1e-12 * abs(best)
