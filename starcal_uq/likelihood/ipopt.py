"""Least squares under constraints by IPOPT: CasADi callbacks around normal equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.solvers import Constraints, Evaluate, Normal, Solution, is_singular


class _Cache:
    """The model at the last point, shared by value, gradient and Hessian callbacks."""

    def __init__(self, evaluate: Evaluate, origin: FloatArray, scale: FloatArray) -> None:
        self.evaluate, self.origin, self.scale = evaluate, origin, scale
        self.point: FloatArray | None = None
        self.normal: Normal | None = None
        self.count = 0

    def at(self, z: Any) -> Normal:
        point = np.array(z, dtype=np.float64).ravel()
        if self.normal is None or self.point is None or not np.array_equal(point, self.point):
            self.point, self.normal = point, self.evaluate(self.origin + self.scale * point)
            self.count += 1
        return self.normal


class _Callback(ca.Callback):
    """A function of NumPy as one of CasADi, by the sparsities of its inputs and of its output.

    `gradient` is that of a scalar.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        inputs: Sequence[Any],
        output: Any,
        gradient: _Callback | None = None,
        names: Sequence[str] = (),
    ) -> None:
        ca.Callback.__init__(self)
        self.function, self.inputs, self.output = function, inputs, output
        self.gradient, self.names = gradient, names
        self.construct("callback", {})

    def get_n_in(self) -> int:
        return len(self.inputs)

    def get_name_in(self, i: int) -> str:
        return self.names[i] if self.names else f"i{i}"

    def get_sparsity_in(self, i: int) -> Any:
        return self.inputs[i]

    def get_sparsity_out(self, i: int) -> Any:
        return self.output

    def eval(self, arg: Any) -> list[Any]:
        return [self.function(*arg)]

    def has_jacobian(self) -> bool:
        return self.gradient is not None

    def get_jacobian(self, name: str, inames: Any, onames: Any, opts: Any) -> Any:
        assert self.gradient is not None
        z, f = ca.MX.sym("z", self.inputs[0]), ca.MX.sym("f", 1)
        return ca.Function(name, [z, f], [self.gradient(z).T], inames, onames)


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
    cache, dense = _Cache(evaluate, start, scale), ca.Sparsity.dense

    def value(z: Any) -> float:
        cost = cache.at(z).cost
        return 0.5 * cost / unit if np.isfinite(cost) else np.nan

    def curvature(z: Any, _: Any, factor: Any, *others: Any) -> Any:
        """Gauss-Newton Hessian of the Lagrangian; the constraints' curvature is left out."""
        return ca.triu(ca.DM(float(factor) * (cache.at(z).matrix * np.outer(scale, scale) / unit)))

    gradient = _Callback(lambda z: cache.at(z).gradient * scale / unit, [dense(p)], dense(p))
    objective = _Callback(value, [dense(p)], dense(1), gradient)
    z = ca.MX.sym("z", p)
    theta = start + scale * z
    symbol = ca.SX.sym("t", p)
    positive = ca.SX.zeros(0, 1) if constraints.positive is None else constraints.positive(symbol)
    n_constraints = int(positive.numel())
    g = ca.Function("g", [symbol], [positive])(theta)
    # Order of IPOPT's Hessian: x, parameters, multiplier of the objective, multipliers of the
    # constraints.
    shapes = [dense(p), ca.Sparsity(0, 0), dense(1), dense(n_constraints)]
    hessian = _Callback(curvature, shapes, ca.Sparsity.upper(p))
    points: list[FloatArray] = []
    names = [str(ca.nlpsol_out(i)) for i in range(ca.nlpsol_n_out())]
    sizes = {"f": 1, "x": p, "lam_x": p, "g": n_constraints, "lam_g": n_constraints}

    def record(*arg: Any) -> int:
        points.append(np.array(arg[names.index("x")], dtype=np.float64).ravel())
        return 0

    recorder = _Callback(record, [dense(sizes.get(n, 0)) for n in names], dense(1), None, names)
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
    trajectory = np.array([start + scale * point for point in points] or [start])
    costs = np.array([evaluate(point).cost for point in trajectory])
    return Solution(theta_final, final, trajectory, costs, status, cache.count)
