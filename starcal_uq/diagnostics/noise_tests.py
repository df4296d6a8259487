"""Tests for unequal noise: weighted against unweighted sums of squares, with their exact moments."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.misfit_test import LEAST_DOF
from starcal_uq.estimation.noise_model import AxisSums
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.shapes import Covariates

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.diagnostics.beside import Freed
    from starcal_uq.observations.table import Observations


# Frames with less than one degree of freedom have no noise of their own to compare.
_LEAST_FRAMES, _LEAST_FRAME_DOF = 3, 1.0


def noise_weights(obs: Observations, camera: Camera) -> dict[str, FloatArray]:
    """What the noise could change with: values (N,) by name."""
    known = Covariates.of(obs)
    radius = np.hypot(obs.x_px - camera.x0_px, obs.y_px - camera.y0_px) / camera.corner_radius_px
    found = {"radius": radius**2, "magnitude": known.magnitude, known.called: known.clock}
    return {name: values for name, values in found.items() if values is not None}


class NoiseSums:
    """Sums over residuals of which all that is fitted is free, from which the tests follow.

    `pieces`: of all frames. `weights`: what the noise could change with (N,), by name. `shared`:
    whether frames have coefficients of effects in common.
    """

    def __init__(
        self, pieces: Iterable[Freed], weights: dict[str, FloatArray], shared: bool
    ) -> None:
        self.axes = AxisSums()
        self._numbers = {name: np.zeros(6) for name in weights}
        self._held: dict[str, FloatArray | float] = dict.fromkeys(weights, 0.0)
        by_frame, matrices, rank = [], [], 0
        for piece in pieces:
            frames, a, h = piece.frames, piece.a, piece.h
            self.axes.add(frames, a, h, piece.e)
            square, of_all = np.sum(piece.e**2, axis=0), np.sum(h**2, axis=(0, 1))
            taken, columns, rank = of_all + np.sum(a**2, axis=(0, 1)), [*a, *h], len(h)
            own = np.einsum("ixn,bxn->ibn", a, np.reshape(columns, (-1, *piece.e.shape)))
            for name, every in weights.items():
                w = every[piece.rows]
                left = frames.sum(own * w) ** 2
                size = np.sum(left[:, : len(a)]) + 2.0 * np.sum(left[:, len(a) :])
                self._numbers[name] += [w.sum(), w @ w, w @ taken, w**2 @ taken, w @ square, size]
                self._held[name] += np.einsum("pxn,qxn->pq", h * w, h)
            by_frame.append([piece.frame_dof, frames.sum(square), frames.sum(of_all)])
            if shared:
                matrices.append(products_by_frame(frames, h, h))
        dof, self._squares, taken = np.concatenate(by_frame, axis=1)
        self._frame_dof, self.dof = dof - taken, int(dof.sum()) - rank
        self._matrices = np.concatenate(matrices) if shared else None

    def tests(self) -> list[tuple[str, float, float]]:
        """Name, z and two-sided p-value of every weight."""
        from scipy.special import erfc

        found: list[tuple[str, float, float]] = []
        dof, total = self.dof, float(self._squares.sum())
        # Effects with as many coefficients as there are pixels leave nothing to compare.
        if dof < 1 or total <= 0.0:
            return found
        for name, (w, w2, taken, taken2, weighted, size) in self._numbers.items():
            trace = 2.0 * w - taken
            # tr(W W) - 2 tr(P W W) + tr(P W P W), P being of frames and of what they share.
            trace2 = 2.0 * w2 - 2.0 * taken2 + size + np.sum(self._held[name] ** 2)
            variance = 2.0 * (trace2 - trace**2 / dof) / (dof * (dof + 2.0))
            if variance > 0.0:
                z = float((weighted / total - trace / dof) / np.sqrt(variance))
                found.append((name, z, float(erfc(abs(z) / np.sqrt(2.0)))))
        return found

    def by_frame(self) -> tuple[float, float] | None:
        """Normal z and p-value of Bartlett's test that all frames have one noise; None for too few
        frames.

        With d_k degrees of freedom of the frames' sums of squares S_k, nu in all, the statistic is
        T = nu log(S / nu) - sum d_k log(S_k / d_k). Shares of S are independent of S, so that mean
        and variance of T follow exactly from those of logarithms of chi-squares; T is then taken as
        gamma-distributed. Effects whose coefficients frames have in common couple their sums: mean
        and variance are then those of independent sums times the change to first order.
        """
        from scipy.special import digamma, gammaincc, ndtri, polygamma

        squares, dof = self._squares, self._frame_dof
        nu = float(dof.sum())
        if (
            len(dof) < _LEAST_FRAMES
            or nu < LEAST_DOF
            or dof.min() < _LEAST_FRAME_DOF
            or squares.min() <= 0.0
        ):
            return None
        found = nu * np.log(squares.sum() / nu) - np.sum(dof * np.log(squares / dof))
        mean = nu * (digamma(nu / 2) - np.log(nu / 2)) - np.sum(
            dof * (digamma(dof / 2) - np.log(dof / 2))
        )
        variance = np.sum(dof**2 * polygamma(1, dof / 2)) - nu**2 * float(polygamma(1, nu / 2))
        if self._matrices is not None:
            by_mean, by_variance = _coupled(self._matrices, dof)
            mean, variance = mean * by_mean, variance * by_variance
        p = float(gammaincc(mean**2 / variance, found * mean / variance))
        return float(-ndtri(np.clip(p, 1e-300, 1.0 - 1e-16))), p


def _coupled(matrices: FloatArray, dof: FloatArray) -> tuple[float, float]:
    """Factors on mean and variance of Bartlett's statistic where frames share what is fitted.

    `matrices` (K, r, r): products over each frame of what is orthonormal over all. `dof` (K,):
    degrees of freedom of the frames' sums of squares, whose covariance is twice G: T is near
    ``s^T K s / 2`` with s their departures from `dof` and ``K = diag(1 / d) - 1 1^T / nu``.
    """
    among = np.einsum("kab,lab->kl", matrices, matrices)
    among += np.diag(dof - np.einsum("kaa->k", matrices))
    by = among / dof[:, None] - among.sum(axis=0) / dof.sum()
    free = len(dof) - 1.0
    return float(np.trace(by)) / free, float(np.sum(by * by.T)) / free
