"""Derivatives by central differences."""

from collections.abc import Callable

import numpy as np

from starcal_uq.core.types import FloatArray


def derivatives(
    function: Callable[[FloatArray], FloatArray], d: int, step: float
) -> tuple[float, FloatArray, FloatArray]:
    """Value, gradient (d,) and Hessian (d, d) at the origin of a function of points (n, d), in one
    call; not finite where it is not.
    """
    unit = step * np.eye(d)
    rows, columns = np.triu_indices(d, 1)
    both, cross = unit[rows] + unit[columns], unit[rows] - unit[columns]
    values = function(np.concatenate([np.zeros((1, d)), unit, -unit, both, -both, cross, -cross]))
    centre, plus, minus = values[0], values[1 : d + 1], values[d + 1 : 2 * d + 1]
    pp, mm, pm, mp = values[2 * d + 1 :].reshape(4, -1)
    with np.errstate(invalid="ignore"):
        hessian = np.diag((plus + minus - 2.0 * centre) / step**2)
        hessian[rows, columns] = hessian[columns, rows] = (pp + mm - pm - mp) / (4.0 * step**2)
        return float(centre), (plus - minus) / (2.0 * step), hessian
