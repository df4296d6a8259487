"""Tail probability of a weighted sum of squared normal variables, to relative accuracy even where
it is tiny.

For Q = sum_j w_j z_j^2 with independent standard normal z_j, the moment generating function is
M(s) = prod_j (1 - 2 w_j s)^(-1/2), and

    P(Q > x) = 1/(2 pi i) int M(s) exp(-s x) / s ds

along any path that crosses the real axis between the pole at 0 and the first branch point 1 / (2
max w). Along the imaginary axis this is the inversion of Imhof (1961, Biometrika 48, 419-426),
whose error is absolute. A parabola through the saddle point, open to the right, makes the integrand
fall like a Gaussian, so that the trapezoidal rule converges to a relative error near that of
rounding. Left of the pole the same integral gives 1 - P.
"""

from __future__ import annotations

import numpy as np

from starcal_uq.core.types import FloatArray, floats

# Nodes of the trapezoidal rule on one side, and the standard widths that it spans: the rest is
# below exp(-72).
_NODES = 300
_WIDTHS = 8.5
# Nodes over the distribution of an estimated noise, and the standard deviations of its logarithm
# that they span.
_SCALES = 48
_SPAN = 9.0


def weighted_chi_square_tail(weights: FloatArray, x: float, dof: float = np.inf) -> float:
    """P(sum_j w_j z_j^2 > x), or P(... > x s) with s an independent chi-square over its `dof`
    degrees of freedom.

    ValueError for weights (r,) that are negative, or none that is positive.
    """
    w = floats(weights)
    if np.any(w < 0.0) or not np.any(w > 0.0):
        raise ValueError(
            "weights of squared normal variables must not be negative, and one must be positive."
        )
    if x <= 0.0:
        return 1.0
    # Weights that cannot move the sum only slow the search for the saddle.
    w = w[w > 1e-14 * w.max()] / w.max()
    threshold = x / float(np.max(weights))
    if not np.isfinite(dof):
        return _tail(w, threshold)
    scale, probability = _scales(dof)
    return float(
        sum(p * _tail(w, threshold * float(s)) for s, p in zip(scale, probability, strict=True))
    )


def _scales(dof: float) -> tuple[FloatArray, FloatArray]:
    """Nodes of chi-square / dof and their probabilities: Gauss-Legendre in its logarithm."""
    from scipy.special import gammaln

    node, weight = np.polynomial.legendre.leggauss(_SCALES)
    width = _SPAN * np.sqrt(2.0 / dof) + 4.0 / dof
    log_scale = width * node
    half = 0.5 * dof
    # Density of the logarithm of a gamma variable of shape half and mean one.
    density = half * np.log(half) - gammaln(half) + half * (log_scale - np.exp(log_scale))
    probability = width * weight * np.exp(density)
    return np.exp(log_scale), probability / probability.sum()


def _tail(w: FloatArray, x: float) -> float:
    """The integral, for weights (r,) whose largest is 1."""
    branch = 0.5
    c = _saddle(w, x)
    distance = branch - c
    # Nearly flat at the saddle, and at twice the distance when it passes the branch point.
    bend = 0.25 / distance
    curvature = float(np.sum(2.0 * (w / (1.0 - 2.0 * w * c)) ** 2)) + 1.0 / c**2
    fall = curvature + 2.0 * bend * x
    # y = width sinh(t): nodes dense at the saddle, and smooth, so that the rule keeps its fast
    # convergence.
    width, reach = 1.0 / np.sqrt(fall), _WIDTHS * np.sqrt(1.0 / (bend * x))
    t = np.linspace(0.0, float(np.arcsinh(reach / width)), _NODES + 1)
    y = width * np.sinh(t)
    s = c + 1j * y + bend * y * y
    log_value = -0.5 * np.sum(np.log1p(-2.0 * w * s[:, None]), axis=1) - s * x
    value = np.exp(log_value) / s * (1.0 - 2.0j * bend * y) * width * np.cosh(t)
    integral = float(np.trapezoid(value.real, t)) / np.pi
    return min(max(integral if c > 0.0 else 1.0 + integral, 0.0), 1.0)


def _saddle(w: FloatArray, x: float) -> float:
    """Root of K'(s) = x right or left of the pole at 0, kept clear of it."""
    low, high = -0.5 * len(w) / x - 1.0, 0.5 * (1.0 - 1e-12)
    for _ in range(200):
        middle = 0.5 * (low + high)
        if float(np.sum(w / (1.0 - 2.0 * w * middle))) < x:
            low = middle
        else:
            high = middle
    c = 0.5 * (low + high)
    # Clear of the pole by a share of the natural width, which for sums near their mean is all that
    # is left.
    clear = min(0.1, 0.5 / np.sqrt(float(np.sum(2.0 * w * w))))
    if abs(c) < clear:
        c = clear if c >= 0.0 else -clear
    return float(c)
