"""Bundles of a second make: NumPy and SciPy, none of the package's code.

Unknown are x0, y0, f, k1, k2 and three angles for each frame; the noise is the same for all stars,
so that the estimate needs no weights. All derivatives are analytic. The attitudes at the start are
a gift: they are not timed. Iterations end when a step is below a thousandth of a standard
deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Result = dict[str, Any]
Solve = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
_STEP_SIGMA = 1e-3


class Bundle:
    """Stars of all frames, structures of arrays: coordinates along the first axis."""

    def __init__(self, folder: Path) -> None:
        with np.load(folder / "stars.npz") as data:
            self.starts, self.start = data["starts"], data["start"]
            self.xy, self.r = np.ascontiguousarray(data["xy"].T), np.ascontiguousarray(data["r"].T)
            self.rotations = data["rotations"]
        self.counts = np.diff(self.starts)
        self.frame = np.repeat(np.arange(len(self.counts)), self.counts)
        self.dof = 2 * len(self.frame) - 3 * len(self.counts) - 5

    def linear(self, theta: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (2, n), observed minus predicted, and derivatives (2, 8, n) by optics and
        angles.
        """
        at = np.repeat(rotations.reshape(-1, 9), self.counts, axis=0).T
        z = at[6] * self.r[0] + at[7] * self.r[1] + at[8] * self.r[2]
        p = (at[0] * self.r[0] + at[1] * self.r[1] + at[2] * self.r[2]) / z
        q = (at[3] * self.r[0] + at[4] * self.r[1] + at[5] * self.r[2]) / z
        x0, y0, f, k1, k2 = theta
        u, v = f * p, f * q
        r2 = u * u + v * v
        scale, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * k1 + 4.0 * k2 * r2
        residuals = np.stack([self.xy[0] - x0 - u * scale, self.xy[1] - y0 - v * scale])
        duu, duv, dvv = scale + slope * u * u, slope * u * v, scale + slope * v * v
        jacobian = np.empty((2, 8, len(z)))
        jacobian[0, 0] = jacobian[1, 1] = 1.0
        jacobian[0, 1] = jacobian[1, 0] = 0.0
        jacobian[0, 2], jacobian[1, 2] = duu * p + duv * q, duv * p + dvv * q
        jacobian[0, 3], jacobian[1, 3] = u * r2, v * r2
        jacobian[:, 4] = jacobian[:, 3] * r2
        du = (-f * p * q, f + u * p, -v)
        dv = (-f - v * q, f * p * q, u)
        for i in range(3):
            jacobian[0, 5 + i] = duu * du[i] + duv * dv[i]
            jacobian[1, 5 + i] = duv * du[i] + dvv * dv[i]
        return residuals, jacobian

    def cross(self, angles: np.ndarray) -> np.ndarray:
        """Matrices (K, 3, 3) of the cross product with vectors (K, 3)."""
        cross = np.zeros((len(angles), 3, 3))
        cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0] = angles.T
        return cross - np.transpose(cross, (0, 2, 1))

    def turned(self, rotations: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Rotations after small ones (K, 3) in the camera frame, by Rodrigues' formula."""
        turns = np.linalg.norm(angles, axis=1)[:, None, None] / np.pi
        cross = self.cross(angles)
        turn = (
            np.eye(3) + np.sinc(turns) * cross + 0.5 * np.sinc(0.5 * turns) ** 2 * (cross @ cross)
        )
        return turn @ rotations

    def gauss_newton(self, solve: Solve) -> Result:
        """Iterate ``solve(residuals, jacobian) -> (step, angles, covariance for unit noise)``."""
        theta, rotations = self.start.copy(), self.rotations
        for _ in range(50):
            residuals, jacobian = self.linear(theta, rotations)
            step, angles, covariance = solve(residuals, jacobian)
            theta, rotations = theta + step, self.turned(rotations, angles)
            variance = float(np.vdot(residuals, residuals)) / self.dof
            covariance = covariance * variance
            if np.all(np.abs(step) < _STEP_SIGMA * np.sqrt(np.diag(covariance))):
                break
        return {
            "theta": theta,
            "covariance": covariance,
            "sigma": np.sqrt(variance),
            "rotations": rotations,
        }


def schur(folder: Path) -> Callable[[], Result]:
    """Gauss-Newton by NumPy: the frames' angles are eliminated one frame at a time, all frames
    together.
    """
    bundle = Bundle(folder)
    rows, columns = np.triu_indices(3)

    def solve(e: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        optics, angles = j[:, :5].reshape(2, 5, -1), j[:, 5:]
        flat = optics.transpose(1, 0, 2).reshape(5, -1)
        hessian, gradient = flat @ flat.T, flat @ e.reshape(-1)
        first = bundle.starts[:-1]

        def summed(products: np.ndarray) -> np.ndarray:
            return np.add.reduceat(products, first, axis=-1)

        block = np.empty((len(first), 3, 3))
        for a, b in zip(rows, columns, strict=True):
            block[:, a, b] = block[:, b, a] = summed(
                angles[0, a] * angles[0, b] + angles[1, a] * angles[1, b]
            )
        right = np.empty((len(first), 3, 6))
        for a in range(3):
            right[:, a, 5] = summed(angles[0, a] * e[0] + angles[1, a] * e[1])
            for b in range(5):
                right[:, a, b] = summed(angles[0, a] * optics[0, b] + angles[1, a] * optics[1, b])
        eliminated = np.linalg.solve(block, right)
        coupled = np.tensordot(right[:, :, :5], eliminated, axes=((0, 1), (0, 1)))
        covariance = scaled_inverse(hessian - coupled[:, :5])
        step = covariance @ (gradient - coupled[:, 5])
        return step, eliminated[:, :, 5] - eliminated[:, :, :5] @ step, covariance

    return lambda: bundle.gauss_newton(solve)


def sparse(folder: Path) -> Callable[[], Result]:
    """Gauss-Newton by SciPy: sparse normal equations, factored by SuperLU; rows and columns are
    laid out once.
    """
    from scipy import sparse as sp
    from scipy.sparse.linalg import splu

    bundle = Bundle(folder)
    layout, pattern = _layout(bundle)
    n_angles = 3 * len(bundle.counts)

    def solve(e: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # The optics are last: an arrow, whose factor has no fill.
        matrix = sp.csr_array((j.transpose(2, 0, 1).reshape(-1)[layout], *pattern))
        scale = np.sqrt(matrix.power(2).sum(axis=0))
        matrix.data /= scale[matrix.indices]
        factor = splu(
            (matrix.T @ matrix).tocsc(), permc_spec="NATURAL", options={"SymmetricMode": True}
        )
        units = np.zeros((n_angles + 5, 6))
        units[n_angles + np.arange(5), np.arange(5)] = 1.0
        units[:, 5] = matrix.T @ e.T.reshape(-1)
        solved = factor.solve(units) / scale[:, None]
        covariance = solved[n_angles:, :5] / scale[n_angles:]
        return solved[n_angles:, 5], solved[:n_angles, 5].reshape(-1, 3), covariance

    return lambda: bundle.gauss_newton(solve)


def least_squares(folder: Path) -> Callable[[], Result]:
    """`scipy.optimize.least_squares` with a sparse analytic Jacobian, LSMR inside a trust
    region.
    """
    from scipy import optimize
    from scipy import sparse as sp
    from scipy.sparse.linalg import splu

    bundle = Bundle(folder)
    layout, pattern = _layout(bundle)
    n_angles = 3 * len(bundle.counts)

    def run() -> Result:
        def jacobian(x: np.ndarray) -> Any:
            w = x[:n_angles].reshape(-1, 3)
            _, j = bundle.linear(x[n_angles:], bundle.turned(bundle.rotations, w))
            # From angles of the turned camera to the unknowns: the left Jacobian of the rotations,
            # to second order.
            cross = bundle.cross(w)
            left = np.eye(3) + 0.5 * cross + cross @ cross / 6.0
            j[:, 5:] = np.einsum("can,nab->cbn", j[:, 5:], np.repeat(left, bundle.counts, axis=0))
            return sp.csr_array((-j.transpose(2, 0, 1).reshape(-1)[layout], *pattern))

        def residuals(x: np.ndarray) -> np.ndarray:
            e, _ = bundle.linear(
                x[n_angles:], bundle.turned(bundle.rotations, x[:n_angles].reshape(-1, 3))
            )
            return e.T.reshape(-1)

        start = np.concatenate([np.zeros(n_angles), bundle.start])
        found = optimize.least_squares(
            residuals,
            start,
            jac=jacobian,
            method="trf",
            x_scale="jac",
            tr_solver="lsmr",
            # Of several settings the fastest that ends within a hundredth of a standard deviation.
            tr_options={"regularize": False, "atol": 1e-8, "btol": 1e-8, "maxiter": 1000},
            ftol=1e-9,
        )
        scale = np.sqrt(found.jac.power(2).sum(axis=0))
        matrix = found.jac.copy()
        matrix.data /= scale[matrix.indices]
        factor = splu(
            (matrix.T @ matrix).tocsc(), permc_spec="NATURAL", options={"SymmetricMode": True}
        )
        units = np.zeros((n_angles + 5, 5))
        units[n_angles + np.arange(5), np.arange(5)] = 1.0
        variance = 2.0 * found.cost / bundle.dof
        covariance = (
            factor.solve(units)[n_angles:] / np.outer(scale[n_angles:], scale[n_angles:]) * variance
        )
        theta = found.x[n_angles:]
        return {"theta": theta, "covariance": covariance, "sigma": np.sqrt(variance)}

    return run


def _layout(bundle: Bundle) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Order of (n, 2, 8) derivatives in the rows of a sparse matrix, with its column numbers and
    row starts.
    """
    n = len(bundle.frame)
    order = (8 * np.arange(2 * n)[:, None] + np.array([5, 6, 7, 0, 1, 2, 3, 4])).reshape(-1)
    angles = np.repeat(3 * bundle.frame, 2)[:, None] + np.arange(3)
    optics = np.broadcast_to(3 * len(bundle.counts) + np.arange(5), (2 * n, 5))
    columns = np.concatenate([angles, optics], axis=1).reshape(-1).astype(np.int32)
    return order, (columns, (8 * np.arange(2 * n + 1)).astype(np.int32))


def scaled_inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric matrix of very different scales."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
