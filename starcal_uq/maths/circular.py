"""Quantiles of the size of an error with two axes: how far off, whatever the direction."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.types import FloatArray, floats

# Midpoints of the quarter circle: the integrand is smooth and periodic, so that few points give all
# digits.
_ANGLES = (np.arange(48) + 0.5) * (0.5 * np.pi / 48)


def mixture_radius(covariances: FloatArray, confidence: float) -> float:
    """Radius that holds a two-axis Gaussian error, of mean zero, with a probability (`confidence`).

    With the semi-axes a >= b of the one-sigma ellipse, the error in the direction of the angle u of
    the *whitened* error is rho sqrt(a^2 cos^2 u + b^2 sin^2 u) with rho from the Rayleigh
    distribution and u uniform, so that

        P(error > R) = mean over u of exp(-R^2 / (2 (a^2 cos^2 u + b^2 sin^2 u))).

    For equal axes this is Rayleigh's own quantile: 2.448 sigma at 95 %, 3.409 at 99.7 %, 3.439 at
    99.73 %. Of several covariances (m, 2, 2) each holds in an equal part of the cases.
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(
            f"confidence is {confidence!r}: give a probability between 0 and 1, such as 0.997."
        )
    C = floats(covariances).reshape(-1, 2, 2)
    half_trace = 0.5 * (C[:, 0, 0] + C[:, 1, 1])
    half_gap = np.hypot(0.5 * (C[:, 0, 0] - C[:, 1, 1]), C[:, 0, 1])
    variance = half_trace[:, None] + half_gap[:, None] * np.cos(2.0 * _ANGLES)
    largest = float(np.max(half_trace + half_gap))
    if not np.isfinite(largest):
        return float("inf")
    if largest <= 0.0:
        return 0.0
    half_inverse = 0.5 / np.maximum(variance / largest, 1e-300)
    from scipy.optimize import brentq

    def excess(square: float) -> float:
        return float(np.mean(np.exp(-square * half_inverse))) - (1.0 - confidence)

    high = -2.0 * float(np.log1p(-confidence))
    # For equal axes the upper end is the quantile itself, to rounding.
    square = high if excess(high) >= 0.0 else brentq(excess, 0.0, high, xtol=1e-300, rtol=8.9e-16)
    return float(np.sqrt(square * largest))
