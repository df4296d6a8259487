"""The paper's three stages on explicit pairs: SciPy's Levenberg-Marquardt (MINPACK), analytic
derivatives, NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

Result = dict[str, Any]


def three_stages(folder: Path) -> Callable[[], Result]:
    """Optics without distortion, distortion linearly, both; covariance by the scatter of frames
    (Godambe).
    """
    with np.load(folder / "stars.npz") as data:
        starts, xy, r, start = data["starts"], data["xy"].T.copy(), data["r"], data["start"]
    inside = [np.triu_indices(m, 1) for m in np.diff(starts)]
    i = np.concatenate([a + s for (a, _), s in zip(inside, starts[:-1], strict=True)])
    j = np.concatenate([b + s for (_, b), s in zip(inside, starts[:-1], strict=True)])
    first = np.concatenate([[0], np.cumsum([len(a) for a, _ in inside])])[:-1]
    cosines = np.einsum("nc,nc->n", r[i], r[j])

    def directions(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors (3, n) and their derivatives (p, 3, n) by x0, y0, f and the distortion."""
        x0, y0, f = theta[:3]
        k1, k2 = theta[3:] if len(theta) == 5 else (0.0, 0.0)
        du, dv = xy[0] - x0, xy[1] - y0
        u, v = du, dv
        for _ in range(50 if len(theta) == 5 else 0):
            # Newton's method for the ideal point.
            r2 = u * u + v * v
            scale, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * k1 + 4.0 * k2 * r2
            a, b, d = scale + slope * u * u, slope * u * v, scale + slope * v * v
            eu, ev, det = du - u * scale, dv - v * scale, a * d - b * b
            move = (d * eu - b * ev) / det, (a * ev - b * eu) / det
            u, v = u + move[0], v + move[1]
            if max(np.max(np.abs(m)) for m in move) < 1e-9:
                break
        r2 = u * u + v * v
        scale, slope = 1.0 + r2 * (k1 + k2 * r2), 2.0 * k1 + 4.0 * k2 * r2
        a, b, d = scale + slope * u * u, slope * u * v, scale + slope * v * v
        det = a * d - b * b
        # d(u, v)/d(theta) = -(d(pixel)/d(u, v))^-1 d(pixel)/d(theta).
        by = np.zeros((len(theta), 2, len(u)))
        by[0] = -d / det, b / det
        by[1] = b / det, -a / det
        for k, power in zip(range(3, len(theta)), (r2, r2 * r2), strict=False):
            by[k] = -(d * u - b * v) * power / det, -(a * v - b * u) * power / det
        norm = 1.0 / np.sqrt(r2 + f * f)
        unit = np.stack([u, v, np.full_like(u, f)]) * norm
        slopes = np.zeros((len(theta), 3, len(u)))
        slopes[:, :2] = by * norm
        slopes[2, 2] = norm
        slopes -= unit * np.einsum("cn,pcn->pn", unit, slopes)[:, None]
        return unit, slopes

    def residuals(theta: np.ndarray) -> np.ndarray:
        unit, _ = directions(theta)
        return np.einsum("cn,cn->n", unit[:, i], unit[:, j]) - cosines

    def jacobian(theta: np.ndarray) -> np.ndarray:
        unit, slopes = directions(theta)
        at_i, at_j = unit[:, i], unit[:, j]
        return np.stack(
            [
                np.einsum("cn,cn->n", s[:, i], at_j) + np.einsum("cn,cn->n", s[:, j], at_i)
                for s in slopes
            ],
            1,
        )

    def minimum(theta: np.ndarray) -> np.ndarray:
        return least_squares(
            residuals, theta, jacobian, method="lm", x_scale="jac", xtol=1e-10, ftol=1e-10
        ).x

    def run() -> Result:
        optics = minimum(start[:3])
        unit, _ = directions(optics)
        left, _, right = np.linalg.svd(
            np.add.reduceat(unit.T[:, :, None] * r[:, None, :], starts[:-1], axis=0)
        )
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        b = np.einsum("nij,nj->ni", np.repeat(left @ right, np.diff(starts), axis=0), r)
        u, v = optics[2] * b[:, 0] / b[:, 2], optics[2] * b[:, 1] / b[:, 2]
        r2 = u * u + v * v
        rows = np.concatenate(
            [np.column_stack([u * r2, u * r2 * r2]), np.column_stack([v * r2, v * r2 * r2])]
        )
        size = np.linalg.norm(rows, axis=0)
        distortion = (
            np.linalg.lstsq(
                rows / size, np.concatenate([xy[0] - optics[0] - u, xy[1] - optics[1] - v])
            )[0]
            / size
        )
        theta = minimum(np.concatenate([optics, distortion]))
        e, j_all = residuals(theta), jacobian(theta)
        scale = np.linalg.norm(j_all, axis=0)
        scores = np.add.reduceat(j_all / scale * e[:, None], first, axis=0)
        bread = np.linalg.inv((j_all / scale).T @ (j_all / scale))
        return {
            "theta": theta,
            "covariance": bread @ (scores.T @ scores) @ bread / np.outer(scale, scale),
        }

    return run
