"""Solvers against NIST's Statistical Reference Datasets for nonlinear regression."""

import numpy as np
import pytest

from starcal_uq.core.status import Status
from starcal_uq.likelihood.ipopt import ipopt
from starcal_uq.likelihood.solvers import Constraints, Normal, levenberg_marquardt, minpack

# Data, starts and certified values: NIST StRD,
# https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml
MISRA1A = np.loadtxt(
    [
        "77.6 114.9 141.1 190.8 239.9 289.0 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760.0",
        "10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.40 75.47 81.78",
    ]
)
BOXBOD = ([1.0, 2.0, 3.0, 5.0, 7.0, 10.0], [109.0, 149.0, 149.0, 191.0, 213.0, 224.0])
MGH09 = (
    [4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625],
    [0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246],
)


def _saturation(data):
    x, y = map(np.array, data)

    def residuals(b):
        decay = np.exp(-b[1] * x)
        return b[0] * (1 - decay) - y, np.stack([1 - decay, b[0] * x * decay], axis=1)

    return residuals


def _rational(data):
    x, y = map(np.array, data)

    def residuals(b):
        top, bottom = x**2 + x * b[1], x**2 + x * b[2] + b[3]
        ratio = top / bottom
        return b[0] * ratio - y, b[0] * np.stack(
            [ratio / b[0], x / bottom, -ratio * x / bottom, -ratio / bottom], axis=1
        )

    return residuals


PROBLEMS = {
    "Misra1a": (
        _saturation(MISRA1A),
        [(500.0, 0.0001), (250.0, 0.0005)],
        (2.3894212918e02, 5.5015643181e-04),
        1.2455138894e-01,
        (2.7070075241e00, 7.2668688436e-06),
    ),
    "BoxBOD": (
        _saturation(BOXBOD),
        [(100.0, 0.75)],
        (2.1380940889e02, 5.4723748542e-01),
        1.1680088766e03,
        (1.2354515176e01, 1.0455993237e-01),
    ),
    "MGH09": (
        _rational(MGH09),
        [(0.25, 0.39, 0.415, 0.39)],
        (1.9280693458e-01, 1.9128232873e-01, 1.2305650693e-01, 1.3606233068e-01),
        3.0750560385e-04,
        (1.1435312227e-02, 1.9633220911e-01, 8.0842031232e-02, 9.0025542308e-02),
    ),
}
CASES = [(name, start) for name, problem in PROBLEMS.items() for start in problem[1]]


def _normal(residuals):
    def evaluate(b):
        with np.errstate(all="ignore"):
            r, j = residuals(b)
        return Normal(float(r @ r) if np.isfinite(r).all() else np.inf, j.T @ r, j.T @ j)

    return evaluate


@pytest.mark.parametrize(("name", "start"), CASES)
@pytest.mark.parametrize("solver", ["lm", "minpack", "ipopt"])
def test_nist_reference_problems(name, start, solver):
    residuals, _, certified, rss, deviations = PROBLEMS[name]
    evaluate, start = _normal(residuals), np.array(start)
    if solver == "lm":
        solution = levenberg_marquardt(evaluate, start, max_iterations=1000)
    elif solver == "minpack":
        solution = minpack(residuals, evaluate, start, max_iterations=1000)
    else:
        free = Constraints(np.full(len(start), -np.inf), np.full(len(start), np.inf))
        solution = ipopt(evaluate, start, free, max_iterations=3000)
    assert solution.status is Status.CONVERGED
    assert np.allclose(solution.theta, certified, rtol=2e-6)
    assert solution.normal.cost == pytest.approx(rss, rel=1e-9)
    dof = len(residuals(start)[0]) - len(start)
    sigma = np.sqrt(np.diag(np.linalg.inv(solution.normal.matrix)) * rss / dof)
    assert np.allclose(sigma, deviations, rtol=1e-4)
    assert np.array_equal(solution.trajectory[-1], solution.theta)
    assert len(solution.trajectory) == len(solution.costs)


def test_singular_problem_is_named():
    def evaluate(b):
        r, j = np.array([b[0] + b[1] - 3.0, b[0] + b[1] - 3.1]), np.ones((2, 2))
        return Normal(float(r @ r), j.T @ r, j.T @ j)

    assert levenberg_marquardt(evaluate, np.array([1.0, 0.5])).status is Status.SINGULAR


def test_start_that_is_not_finite_is_named():
    def evaluate(b):
        return Normal(float("inf"), np.full(1, np.nan), np.full((1, 1), np.nan))

    assert levenberg_marquardt(evaluate, np.array([1.0])).status is Status.NOT_FINITE


def test_iteration_limit_is_named():
    evaluate = _normal(_saturation(MISRA1A))
    assert (
        levenberg_marquardt(evaluate, np.array([500.0, 1e-4]), max_iterations=2).status
        is Status.MAX_ITERATIONS
    )


def test_last_step_is_taken_unseen():
    evaluate, start = _normal(_saturation(MISRA1A)), np.array([250.0, 5e-4])
    seen, unseen = (
        levenberg_marquardt(evaluate, start, tolerance=1e-8, seen=x) for x in (True, False)
    )
    assert unseen.status is Status.CONVERGED
    assert unseen.evaluations == seen.evaluations - 1
    assert np.array_equal(unseen.theta, seen.theta)
    assert unseen.costs[-1] == pytest.approx(seen.costs[-1], rel=1e-10)


def test_exact_fit_converges():
    x = np.arange(4.0)

    def evaluate(b):
        r, j = b[0] * x - 2.0 * x, x[:, None]
        return Normal(float(r @ r), j.T @ r, j.T @ j)

    solution = levenberg_marquardt(evaluate, np.array([5.0]))
    assert solution.status is Status.CONVERGED
    assert solution.theta[0] == pytest.approx(2.0, abs=1e-12)


def test_ipopt_respects_its_bounds_where_the_others_do_not():
    evaluate = _normal(_saturation(MISRA1A))
    bounds = Constraints(np.array([0.0, 0.0]), np.array([200.0, 1.0]))
    solution = ipopt(evaluate, np.array([150.0, 0.0005]), bounds, max_iterations=500)
    assert solution.theta[0] == pytest.approx(200.0, rel=1e-6)
    assert levenberg_marquardt(evaluate, np.array([150.0, 0.0005])).theta[0] > 230.0
