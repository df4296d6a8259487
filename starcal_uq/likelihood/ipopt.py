"""Least squares under constraints by IPOPT: CasADi callbacks around normal equations."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.solvers import Constraints, Evaluate, Normal, Solution, is_singular


class _Cache:
    """The model at the last point, shared by value, gradient and Hessian callbacks."""

    def __init__(
        self, evaluate: Evaluate, origin: FloatArray, scale: FloatArray, unit: float
    ) -> None:
        self.evaluate, self.origin, self.scale, self.unit = evaluate, origin, scale, unit
        self.point: FloatArray | None = None
        self.normal: Normal | None = None
        self.count = 0

    def at(self, z: Any) -> Normal:
        point = np.array(z, dtype=np.float64).ravel()
        if self.normal is None or self.point is None or not np.array_equal(point, self.point):
            self.point, self.normal = point, self.evaluate(self.origin + self.scale * point)
            self.count += 1
        return self.normal


class _Objective(ca.Callback):
    """Half the scaled cost."""

    def __init__(self, cache: _Cache, p: int) -> None:
        ca.Callback.__init__(self)
        self.model, self.p = cache, p
        self.gradient = _Gradient(cache, p)
        self.construct("objective", {})

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.p, 1)

    def eval(self, arg: Any) -> list[Any]:
        cost = self.model.at(arg[0]).cost
        return [0.5 * cost / self.model.unit if np.isfinite(cost) else np.nan]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inames: Any, onames: Any, opts: Any) -> Any:
        z, f = ca.MX.sym("z", self.p), ca.MX.sym("f", 1)
        return ca.Function(name, [z, f], [self.gradient(z).T], inames, onames)


class _Gradient(ca.Callback):
    """Gradient of half the scaled cost."""

    def __init__(self, cache: _Cache, p: int) -> None:
        ca.Callback.__init__(self)
        self.model, self.p = cache, p
        self.construct("gradient", {})

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.p, 1)

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(self.p, 1)

    def eval(self, arg: Any) -> list[Any]:
        return [self.model.at(arg[0]).gradient * self.model.scale / self.model.unit]


class _Hessian(ca.Callback):
    """Gauss-Newton Hessian of the Lagrangian (the constraints' curvature is left out)."""

    def __init__(self, cache: _Cache, p: int, n_constraints: int) -> None:
        ca.Callback.__init__(self)
        self.model, self.p, self.n_constraints = cache, p, n_constraints
        self.construct("hessian", {})

    def get_n_in(self) -> int:
        return 4

    def get_sparsity_in(self, i: int) -> Any:
        # Order of IPOPT's Hessian: x, parameters, multiplier of the objective, multipliers of the
        # constraints.
        return [
            ca.Sparsity.dense(self.p, 1),
            ca.Sparsity(0, 0),
            ca.Sparsity.dense(1, 1),
            ca.Sparsity.dense(self.n_constraints, 1),
        ][i]

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.upper(self.p)

    def eval(self, arg: Any) -> list[Any]:
        matrix = (
            self.model.at(arg[0]).matrix
            * np.outer(self.model.scale, self.model.scale)
            / self.model.unit
        )
        return [ca.triu(ca.DM(float(arg[2]) * matrix))]


class _Recorder(ca.Callback):
    """Keeps IPOPT's iterates."""

    def __init__(self, p: int, n_constraints: int) -> None:
        ca.Callback.__init__(self)
        self.p, self.n_constraints = p, n_constraints
        self.points: list[FloatArray] = []
        self.construct("recorder", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> Any:
        size = {
            "f": 1,
            "x": self.p,
            "lam_x": self.p,
            "g": self.n_constraints,
            "lam_g": self.n_constraints,
        }
        return ca.Sparsity.dense(size.get(str(ca.nlpsol_out(i)), 0), 1)

    def eval(self, arg: Any) -> list[Any]:
        self.points.append(np.array(arg[0], dtype=np.float64).ravel())
        return [0]


def ipopt(
    evaluate: Evaluate, start: FloatArray, constraints: Constraints, *, max_iterations: int = 200
) -> Solution:
    """Minimise a sum of squares under constraints with IPOPT, through CasADi; the start is moved
    inside the bounds.

    The objective enters as callbacks (value, gradient, Gauss-Newton Hessian), in variables scaled
    by the curvature at the start so that IPOPT sees numbers of order one.
    """
    theta = np.clip(np.array(start, dtype=np.float64), constraints.lower, constraints.upper)
    normal = evaluate(theta)
    if not (np.isfinite(normal.cost) and np.isfinite(normal.matrix).all()):
        return Solution(theta, normal, theta[None], np.array([normal.cost]), Status.NOT_FINITE, 1)
    return _solve(evaluate, theta, normal, constraints, max_iterations)


def _solve(
    evaluate: Evaluate,
    start: FloatArray,
    normal: Normal,
    constraints: Constraints,
    max_iterations: int,
) -> Solution:
    """Run IPOPT from a point at which the model is finite."""
    p = len(start)
    # One unit of a scaled variable raises the cost by about its own size.
    unit = max(normal.cost, np.finfo(float).tiny)
    scale = np.sqrt(unit / np.diag(normal.matrix))
    cache = _Cache(evaluate, start, scale, unit)
    objective = _Objective(cache, p)
    z = ca.MX.sym("z", p)
    theta = start + scale * z
    symbol = ca.SX.sym("t", p)
    positive = ca.SX.zeros(0, 1) if constraints.positive is None else constraints.positive(symbol)
    n_constraints = int(positive.numel())
    g = ca.Function("g", [symbol], [positive])(theta)
    recorder, hessian = _Recorder(p, n_constraints), _Hessian(cache, p, n_constraints)
    solver = ca.nlpsol(
        "solver",
        "ipopt",
        {"x": z, "f": objective(z), "g": g},
        {
            "hess_lag": hessian,
            "iteration_callback": recorder,
            "print_time": False,
            "show_eval_warnings": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.max_iter": max_iterations,
            "ipopt.tol": 1e-10,
            "ipopt.acceptable_iter": 0,
            "ipopt.mu_strategy": "adaptive",
            "ipopt.bound_relax_factor": 0.0,
        },
    )
    result = solver(
        x0=np.zeros(p),
        lbx=(constraints.lower - start) / scale,
        ubx=(constraints.upper - start) / scale,
        lbg=1e-6,
        ubg=np.inf,
    )
    theta_final = start + scale * np.array(result["x"], dtype=np.float64).ravel()
    final = evaluate(theta_final)
    outcome = solver.stats()["return_status"]
    if outcome in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
        status = Status.SINGULAR if is_singular(final.matrix) else Status.CONVERGED
    elif outcome == "Maximum_Iterations_Exceeded":
        status = Status.MAX_ITERATIONS
    elif not np.isfinite(final.matrix).all():
        status = Status.NOT_FINITE
    else:
        # IPOPT also stops with a search direction too small once rounding is reached; the gradient
        # decides.
        gain = float(final.gradient @ np.linalg.pinv(final.matrix) @ final.gradient) / max(
            final.cost, 1e-300
        )
        status = Status.CONVERGED if gain < 1e-10 else Status.STALLED
    trajectory = np.array([start + scale * point for point in recorder.points] or [start])
    costs = np.array([evaluate(point).cost for point in trajectory])
    return Solution(theta_final, final, trajectory, costs, status, cache.count)
