"""The lens nearest to another one, whose formula is written out here in NumPy alone."""

import numpy as np
import pytest

from starcal_uq.camera.nearest import nearest_theta

SIDE = np.linspace(-0.1, 0.1, 15)
SLOPES = np.stack(np.meshgrid(SIDE, SIDE), axis=-1).reshape(-1, 2)
X0, Y0, F, K1, P1, P2 = 520.0, 500.0, 5000.0, 2e-9, 3e-7, -2e-7


def pixels() -> np.ndarray:
    u, v = F * SLOPES.T
    r2 = u**2 + v**2
    x = u * (1.0 + K1 * r2) + 2.0 * P1 * u * v + P2 * (r2 + 2.0 * u**2)
    y = v * (1.0 + K1 * r2) + 2.0 * P2 * u * v + P1 * (r2 + 2.0 * v**2)
    return np.stack([X0 + x, Y0 + y], axis=1)


def test_a_lens_that_a_model_holds_is_found():
    start = np.array([511.5, 511.5, 5100.0, 0.0, 0.0, 0.0, 0.0])
    theta, error = nearest_theta("brown_tangential", start, SLOPES, pixels())
    assert error < 1e-7
    assert theta == pytest.approx([X0, Y0, F, K1, 0.0, P1, P2], rel=1e-6, abs=1e-17)


def test_what_is_fixed_stays_and_what_a_model_lacks_is_told():
    start = np.array([X0, Y0, F, 0.0])
    theta, error = nearest_theta("k1", start, SLOPES, pixels(), fixed=("x0", "y0", "f"))
    assert (theta[:3] == start[:3]).all() and theta[3] == pytest.approx(K1, rel=0.1)
    u, v = F * SLOPES.T
    ours = theta[:2] + F * SLOPES * (1.0 + theta[3] * (u**2 + v**2))[:, None]
    assert error == pytest.approx(np.abs(ours - pixels()).max(), rel=1e-9)
    assert error > 0.1
