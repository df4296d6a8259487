"""The parameters with which a lens comes nearest to what another one does."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from starcal_uq.camera.distortion import get_model, parameter_names
from starcal_uq.core.types import FloatArray


def nearest_theta(
    distortion: str,
    theta: FloatArray,
    slopes: FloatArray,
    pixels: FloatArray,
    fixed: Collection[str] = (),
) -> tuple[FloatArray, float]:
    """Parameters (p,) of a forward model of a pinhole that carry slopes x / z and y / z (n, 2) to
    pixels (n, 2) with the least squares, and the largest difference along an axis, px.

    Those that are `fixed`, by name, stay as at the start `theta` (p,).
    """
    from scipy.optimize import least_squares

    model = get_model(distortion)
    # Parameters of like size: pixels, and displacements at the corner.
    radius = float(np.max(np.hypot(*(pixels - theta[:2]).T)))
    scale = np.array([1.0, 1.0, 1.0, *(radius**-c.order for c in model.coefficients)])
    scale *= [name not in fixed for name in parameter_names(distortion)]

    def off(step: FloatArray) -> FloatArray:
        moved = theta + scale * step
        u, v = moved[2] * slopes.T
        du, dv = model.displacement(u, v, moved[3:].tolist())
        seen = np.stack(model.stretched(u + du, v + dv, moved), axis=1)
        return np.asarray(seen + moved[:2] - pixels).ravel()

    found = least_squares(
        off, np.zeros(len(scale)), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    return theta + scale * found.x, float(np.max(np.abs(found.fun)))
