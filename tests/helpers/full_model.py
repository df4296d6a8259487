"""The posterior of a camera whose frames breathe, by emcee on the whole model, NumPy alone.

Camera parameters, the noise and the scale of the frames' effect are sampled; attitudes, whose prior
is flat, and the coefficients of every frame are Gaussian given these, and integrated exactly. Images
are linear around the truth over the width of the posterior.
"""

from __future__ import annotations

import emcee
import numpy as np

from tests.helpers.effects import CORNER_PX, projected
from tests.helpers.outside import Campaign, star_directions

# Standard deviation of the half-normal prior of the scale, px at the corner.
_PRIOR_PX = 10.0
# Steps of the differences: parameters, px at the corner as far as they are distortion; rad.
_STEPS = np.array([1e-2, 1e-2, 1e-2, 1e-2 / CORNER_PX**3, 1e-2 / CORNER_PX**5])
_TURN = 1e-6


def _columns(c: Campaign, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one frame: residuals and derivatives (6, 2 n) by the parameters, in units of `_STEPS`;
    shifts (3, 2 n) by turns, and (3, 2 n) by scale and two shears.
    """
    rows = c.columns["frame"] == frame
    b = c.attitudes[frame] @ star_directions(c)[rows].T
    seen = np.array([c.columns[name][rows] for name in ("x_px", "y_px")])
    predicted = projected(c.theta, b)

    def slope(ahead: np.ndarray, back: np.ndarray) -> np.ndarray:
        return (ahead - back).ravel() / 2.0

    by_theta = [
        slope(projected(c.theta + step, b), projected(c.theta - step, b))
        for step in np.diag(_STEPS)
    ]
    by_turn = [
        slope(projected(c.theta, b + turn), projected(c.theta, b - turn)) / _TURN
        for turn in (_TURN * np.cross(axis, b.T).T for axis in np.eye(3))
    ]
    u, v = (predicted - c.theta[:2, None]) / CORNER_PX
    own = [np.array([u, v]).ravel(), np.array([u, -v]).ravel(), np.array([v, u]).ravel()]
    return np.array([(seen - predicted).ravel(), *by_theta]), np.array(by_turn), np.array(own)


class Breathing:
    """Log posterior of steps of the parameters, log noise and log scale."""

    def __init__(self, c: Campaign, scale_px: float | None = None) -> None:
        self.scale_px, self.squares, self.values, self.along, self.dof = scale_px, 0.0, [], [], 0
        for frame in range(len(c.attitudes)):
            x, turns, own = _columns(c, frame)
            basis = np.linalg.qr(turns.T)[0]
            x, own = (rows - (rows @ basis) @ basis.T for rows in (x, own))
            values, vectors = np.linalg.eigh(own @ own.T)
            self.squares = self.squares + x @ x.T
            self.values.append(values)
            self.along.append(vectors.T @ own @ x.T)
            self.dof += x.shape[1] - 3

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """At points (w, 7), or (w, 6) at a given scale."""
        step, sigma = points[:, :5], np.exp(points[:, 5])
        tau = np.exp(points[:, 6]) if self.scale_px is None else np.full(len(step), self.scale_px)
        m = np.column_stack([np.ones(len(step)), -step])
        cost = np.einsum("wi,ij,wj->w", m, self.squares, m)
        ratio = ((tau / sigma) ** 2)[:, None]
        value = -self.dof * np.log(sigma)
        for values, along in zip(self.values, self.along, strict=True):
            cost -= np.sum(ratio / (1.0 + ratio * values) * (m @ along.T) ** 2, axis=1)
            value -= 0.5 * np.sum(np.log1p(ratio * values), axis=1)
        value -= 0.5 * cost / sigma**2
        # A half-normal scale has this density of its logarithm.
        return value if self.scale_px else value - 0.5 * (tau / _PRIOR_PX) ** 2 + np.log(tau)


def drawn(c: Campaign, sigma_px: float, scale_px: float, sampled: bool, seed: int) -> np.ndarray:
    """Draws (n, 5) of the camera parameters, the scale sampled or held."""
    posterior = Breathing(c, None if sampled else scale_px)
    rng, n, walkers = np.random.default_rng(seed), 7 if sampled else 6, 64
    curvature = posterior.squares[1:, 1:] / sigma_px**2
    root = np.linalg.inv(np.linalg.cholesky(curvature)).T
    start = np.zeros((walkers, n))
    start[:, :5] = rng.standard_normal((walkers, 5)) @ root.T
    start[:, 5:] = np.log([sigma_px, scale_px])[: n - 5] + 0.05 * rng.standard_normal(
        (walkers, n - 5)
    )
    moves = [(emcee.moves.DEMove(), 0.9), (emcee.moves.DEMove(gamma0=1.0), 0.1)]
    ensemble = emcee.EnsembleSampler(walkers, n, posterior, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    ensemble.run_mcmc(state, 8_000)
    draws = ensemble.get_chain(discard=1_000, flat=True)[:, :5]
    return c.theta + draws * _STEPS
