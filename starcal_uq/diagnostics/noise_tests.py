"""Tests for unequal noise: weighted against unweighted sums of squares, with their exact moments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.elimination import ByFrame, products_by_frame
from starcal_uq.likelihood.shapes import run_clock

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations


def noise_weights(obs: Observations, camera: Camera) -> dict[str, FloatArray]:
    """What the noise could change with: standardised values (N,) by name."""
    radius2 = (obs.x_px - camera.x0_px) ** 2 + (obs.y_px - camera.y0_px) ** 2
    candidates: dict[str, FloatArray] = {"radius": radius2}
    if obs.mag is not None:
        candidates["magnitude"] = obs.mag
    clock, called = run_clock(obs)
    if clock is not None:
        candidates[called] = clock
    found = {}
    for name, values in candidates.items():
        spread = float(np.nanstd(values))
        if spread > 1e-9:
            found[name] = np.nan_to_num((values - np.nanmean(values)) / spread)
    return found


class NoiseSums:
    """Sums over stars that the moments need, for several weights (N,) by name, with p
    parameters.
    """

    def __init__(self, weights: dict[str, FloatArray], p: int) -> None:
        self.weights = weights
        n = len(weights)
        self.squares = np.zeros(n)
        self.trace = np.zeros(n)
        self.trace2 = np.zeros(n)
        self.parameters1 = np.zeros((n, p, p))
        self.parameters2 = np.zeros((n, p, p))
        self.crossed = np.zeros((n, p, p))

    def add(self, own: ByFrame, h: FloatArray, e: FloatArray, rows: slice) -> None:
        """Add some frames: h (p, 2, n) and e (2, n) with what is of the frames removed."""
        frames, a = own.frames, own.orthonormal
        flat = h.reshape(len(h), -1)
        for i, values in enumerate(self.weights.values()):
            w = values[rows]
            self.squares[i] += float(np.sum(w * e**2))
            self.parameters1[i] += (h * w).reshape(len(h), -1) @ flat.T
            self.parameters2[i] += (h * w**2).reshape(len(h), -1) @ flat.T
            awa, awh = products_by_frame(frames, a * w, a), products_by_frame(frames, a * w, h)
            self.trace[i] += 2.0 * np.sum(w) - np.einsum("kaa->", awa)
            # tr(W W) - 2 tr(P W W) + tr(P W P W) for the attitudes' part of P.
            self.trace2[i] += 2.0 * np.sum(w**2) - 2.0 * np.sum((a * w) ** 2) + np.sum(awa**2)
            self.crossed[i] += np.tensordot(awh, awh, ((0, 1), (0, 1)))

    def tests(
        self, matrix: FloatArray, inverse: FloatArray, rss: float, dof: int
    ) -> list[tuple[str, float, float]]:
        """Name, z and two-sided p-value of every weight."""
        from scipy.special import erfc

        found: list[tuple[str, float, float]] = []
        # Effects with as many coefficients as there are pixels leave nothing to compare.
        if dof < 1 or not rss > 0.0:
            return found
        for i, name in enumerate(self.weights):
            by_h = inverse @ self.parameters1[i]
            trace = self.trace[i] - np.trace(by_h)
            trace2 = self.trace2[i] - 2.0 * np.trace(inverse @ self.parameters2[i])
            trace2 += 2.0 * np.trace(inverse @ self.crossed[i]) + np.sum(by_h * by_h.T)
            variance = 2.0 * (trace2 - trace**2 / dof) / (dof * (dof + 2.0))
            if not variance > 0.0:
                continue
            z = float((self.squares[i] / rss - trace / dof) / np.sqrt(variance))
            found.append((name, z, float(erfc(abs(z) / np.sqrt(2.0)))))
        return found
