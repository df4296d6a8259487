"""The exact likelihood of x0, y0, f, k1, k2 and log sigma by NumPy, the frames' attitudes profiled.

For other optics an attitude moves by arc seconds, so that it is profiled in one linear step from
its best value: projected out with derivatives at the estimate. Flat in the optics and in log sigma:
what priors change is below the noise of sampling. Coordinates are standard deviations from the
estimate.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bundles import Bundle, schur


class Likelihood:
    """Whitened coordinates z (6,) to log density; `theta` gives back the parameters."""

    def __init__(self, folder: Path) -> None:
        bundle = Bundle(folder)
        fitted = schur(folder)()
        self.theta_hat, self.log_sigma = fitted["theta"], float(np.log(fitted["sigma"]))
        self.root = np.linalg.cholesky(fitted["covariance"])
        self.count = bundle.dof + 5
        self.log_sigma_sd = 1.0 / np.sqrt(2.0 * self.count)
        rotations = fitted["rotations"]
        at = np.einsum("nij,jn->in", np.repeat(rotations, bundle.counts, axis=0), bundle.r)
        self.p, self.q = at[0] / at[2], at[1] / at[2]
        self.x, self.y = bundle.xy
        self.first = bundle.starts[:-1]
        self.counts = bundle.counts
        _, jacobian = bundle.linear(self.theta_hat, rotations)
        # An orthonormal basis of each frame's angles: triangular factors of the frames' 3 x 3
        # matrices.
        angles = jacobian[:, 5:]
        gram = np.add.reduceat(np.einsum("can,cbn->nab", angles, angles), self.first, axis=0)
        inverse = np.repeat(np.linalg.inv(np.linalg.cholesky(gram)), self.counts, axis=0)
        self.basis = np.einsum("nab,cbn->acn", inverse, angles)

    def parameters(self, z: np.ndarray) -> np.ndarray:
        """Draws (..., 6) of theta and sigma."""
        theta = self.theta_hat + z[..., :5] @ self.root.T
        return np.concatenate(
            [theta, np.exp(self.log_sigma + self.log_sigma_sd * z[..., 5:])], axis=-1
        )

    def squares(self, theta: np.ndarray) -> float:
        """Sum of squared residuals after the attitudes."""
        x0, y0, f, k1, k2 = theta
        u, v = f * self.p, f * self.q
        r2 = u * u + v * v
        scale = 1.0 + r2 * (k1 + k2 * r2)
        ex, ey = self.x - x0 - u * scale, self.y - y0 - v * scale
        along = np.add.reduceat(self.basis[:, 0] * ex + self.basis[:, 1] * ey, self.first, axis=1)
        return float(ex @ ex + ey @ ey - np.vdot(along, along))

    def __call__(self, z: np.ndarray) -> float:
        """Log density up to a constant."""
        log_sigma = self.log_sigma + self.log_sigma_sd * z[5]
        s = self.squares(self.theta_hat + self.root @ z[:5])
        return float(-0.5 * s * np.exp(-2.0 * log_sigma) - self.count * log_sigma)
