"""Least-squares solvers: Levenberg-Marquardt on normal equations and MINPACK; IPOPT stands in
`ipopt`.

The Levenberg-Marquardt iteration is that of More (1978), "The Levenberg-Marquardt algorithm:
implementation and theory", which MINPACK implements on the full Jacobian; here the trust-region
step is found from the p x p normal equations, so that an objective over any number of residuals
costs what one evaluation of its sums costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray

_INITIAL_BOUND = 100.0
_SINGULAR = 1e-13
# Relative change of a cost that is rounding and nothing else.
_ROUNDING = 1e-10
# A step this small against the parameters is none, whatever the cost does: data without noise end
# here.
_NEGLIGIBLE = 1e-10
# A trust region this small against the scaled parameters ends the search.
_LEAST_BOUND = 1e-13
_EPS, _TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)


class Normal(NamedTuple):
    """A least-squares cost at one point."""

    cost: float  # Sum of squared residuals ``r^T r``; infinite where the model is not defined
    gradient: FloatArray  # (p,): ``J^T r``, half the gradient of the cost
    matrix: FloatArray  # (p, p): ``J^T J``


Evaluate = Callable[[FloatArray], Normal]
Residuals = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Solution:
    """How a solver ended."""

    theta: FloatArray  # (p,): final parameters
    normal: Normal  # Cost, gradient and Gauss-Newton matrix there, or one unseen step before
    trajectory: FloatArray  # (n, p): accepted points, the start first
    costs: FloatArray  # (n,): costs of the points; that of an unseen one as its step promised
    status: Status  # Converged, or why not
    evaluations: int  # Number of evaluations of the model


@dataclass(frozen=True)
class Constraints:
    """What IPOPT keeps true."""

    # `lower`, `upper`, (p,): bounds.
    lower: FloatArray
    upper: FloatArray
    # From a CasADi vector of parameters to a CasADi vector that must stay positive (monotonic
    # distortion).
    positive: Callable[[Any], Any] | None = None


def _scaled_step(normal: Normal, scale: FloatArray, bound: float) -> tuple[FloatArray, float]:
    """Minimise the Gauss-Newton model within ``|D p| <= bound``; returns the step and More's
    parameter.
    """
    matrix = normal.matrix / (scale[:, None] * scale)
    values, vectors = np.linalg.eigh(matrix)
    # Rounding can leave a singular direction slightly negative.
    values = np.maximum(values, _EPS * values[-1])
    slope = vectors.T @ (normal.gradient / scale)

    def length(damping: float) -> float:
        return float(np.sqrt(np.sum((slope / (values + damping)) ** 2)))

    damping = 0.0
    if values[0] <= _SINGULAR * values[-1] or length(0.0) > 1.1 * bound:
        upper = float(np.linalg.norm(slope)) / bound
        lower = 0.0
        damping = max(1e-3 * upper, _TINY)
        for _ in range(50):
            size = length(damping)
            if abs(size - bound) <= 0.1 * bound or (damping <= _SINGULAR * upper and size < bound):
                break
            if size > bound:
                lower = damping
            else:
                upper = damping
            # Newton's method on 1 / length, which is nearly linear in the damping (More 1978, eq.
            # 5.5).
            slope_of_length = -float(np.sum(slope**2 / (values + damping) ** 3)) / size
            damping -= (size / bound) * (size - bound) / slope_of_length
            if not lower < damping < upper:
                damping = max(1e-3 * upper, np.sqrt(lower * upper))
    return -(vectors @ (slope / (values + damping))) / scale, damping


def levenberg_marquardt(
    evaluate: Evaluate,
    start: FloatArray,
    *,
    max_iterations: int = 200,
    tolerance: float = 1e-15,
    seen: bool = True,
) -> Solution:
    """Minimise a sum of squares from its normal equations.

    `max_iterations`: most accepted and refused steps.
    `tolerance`: converged when the predicted relative reduction of the cost is below this.
    `seen`: whether the model is evaluated after a full step that promises no more than `tolerance`.
    It ends CONVERGED, MAX_ITERATIONS, SINGULAR, STALLED or NOT_FINITE.
    """
    theta = np.array(start, dtype=np.float64)
    normal = evaluate(theta)
    trajectory, costs, evaluations = [theta], [normal.cost], 1

    def finish(status: Status) -> Solution:
        if status is Status.CONVERGED and is_singular(normal.matrix):
            status = Status.SINGULAR
        return Solution(theta, normal, np.array(trajectory), np.array(costs), status, evaluations)

    if not (np.isfinite(normal.cost) and np.isfinite(normal.matrix).all()):
        return finish(Status.NOT_FINITE)
    scale = _lengths(normal.matrix)
    if np.any(scale == 0.0):
        return finish(Status.SINGULAR)
    size = float(np.linalg.norm(scale * theta))
    bound = _INITIAL_BOUND * size if size > 0.0 else _INITIAL_BOUND

    for iteration in range(max_iterations):
        if normal.cost == 0.0:
            return finish(Status.CONVERGED)
        step, damping = _scaled_step(normal, scale, bound)
        length = float(np.linalg.norm(scale * step))
        if iteration == 0:
            bound = min(bound, length)
        trial_theta = theta + step
        curvature = float(step @ normal.matrix @ step) / normal.cost
        penalty = damping * length**2 / normal.cost
        predicted = curvature + 2.0 * penalty
        if not seen and damping == 0.0 and predicted <= tolerance:
            theta = trial_theta
            trajectory.append(theta)
            costs.append(normal.cost * (1.0 - predicted))
            return finish(Status.CONVERGED)
        trial = evaluate(trial_theta)
        evaluations += 1
        actual = 1.0 - trial.cost / normal.cost if np.isfinite(trial.cost) else -np.inf
        ratio = actual / predicted if predicted > 0.0 else 0.0
        if predicted <= _ROUNDING and abs(actual) <= _ROUNDING:
            # The cost can no longer tell the step from rounding, but the gradient still can.
            ratio = 1.0
        if ratio <= 0.25:
            if actual >= 0.0:
                factor = 0.5
            elif np.isfinite(actual):
                direction = -(curvature + penalty)
                factor = max(0.1, 0.5 * direction / (direction + 0.5 * actual))
            else:
                factor = 0.1
            bound = factor * min(bound, 10.0 * length)
        elif damping == 0.0 or ratio >= 0.75:
            bound = 2.0 * length
        if ratio > 1e-4:
            theta, normal = trial_theta, trial
            trajectory.append(theta)
            costs.append(normal.cost)
            scale = np.maximum(scale, _lengths(normal.matrix))
        if predicted <= tolerance and ratio > 1e-4:
            return finish(Status.CONVERGED)
        if bound <= _LEAST_BOUND * float(np.linalg.norm(scale * theta)):
            settled = predicted <= 1e-8 or _newton_length(normal, scale) <= _NEGLIGIBLE * float(
                np.linalg.norm(scale * theta)
            )
            return finish(Status.CONVERGED if settled else Status.STALLED)
    return finish(Status.MAX_ITERATIONS)


def _lengths(matrix: FloatArray) -> FloatArray:
    """Lengths (p,) of the Jacobian's columns; zero where attitudes take one up, but for
    rounding.
    """
    return np.sqrt(np.maximum(matrix.diagonal(), 0.0))


def _newton_length(normal: Normal, scale: FloatArray) -> float:
    """Length of the undamped step in scaled parameters: what separates the point from its
    optimum.
    """
    return float(np.linalg.norm(scale * _scaled_step(normal, scale, np.inf)[0]))


def is_singular(matrix: FloatArray) -> bool:
    """True when the scaled Gauss-Newton matrix has lost all digits in some direction."""
    diagonal = np.diag(matrix)
    if not np.isfinite(matrix).all() or np.any(diagonal <= 0.0):
        return True
    values = np.linalg.eigvalsh(matrix / np.sqrt(np.outer(diagonal, diagonal)))
    return bool(values[0] < 1e-12 * values[-1])


def reason_of(status: Status, cost: float) -> Status:
    """Why there is no estimate where a solver ended with this status and a model of this cost."""
    if not status.ok:
        return status
    return Status.SINGULAR if np.isfinite(cost) else Status.NOT_FINITE


def minpack(
    residuals: Residuals, evaluate: Evaluate, start: FloatArray, *, max_iterations: int = 200
) -> Solution:
    """Minimise a sum of squares with MINPACK's ``lmder`` on explicit residuals.

    `residuals`: ``theta -> (r (n,), J (n, p))``.
    `evaluate`: function that gives the same cost as normal equations, for the final state and the
    trajectory. `max_iterations`: most evaluations of the residuals.
    """
    from scipy.optimize import leastsq

    # MINPACK scales by the Jacobian's columns itself; only the trajectory needs recording.
    points: list[FloatArray] = []

    def value(theta: FloatArray) -> FloatArray:
        return residuals(theta)[0]

    def jacobian(theta: FloatArray) -> FloatArray:
        points.append(np.array(theta))
        return residuals(theta)[1]

    theta, _, info, _, code = leastsq(
        value,
        np.array(start, dtype=np.float64),
        Dfun=jacobian,
        full_output=True,
        ftol=1e-14,
        xtol=1e-14,
        gtol=0.0,
        maxfev=max_iterations,
    )
    trajectory = np.array([*points, theta])
    final = evaluate(theta)
    status = Status.MAX_ITERATIONS if code == 5 else Status.CONVERGED
    if not np.isfinite(final.cost):
        status = Status.NOT_FINITE
    elif is_singular(final.matrix):
        status = Status.SINGULAR
    costs = np.array([float(np.sum(value(point) ** 2)) for point in trajectory])
    return Solution(theta, final, trajectory, costs, status, int(info["nfev"]))
