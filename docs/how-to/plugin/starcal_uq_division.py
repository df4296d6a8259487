"""The division model (Fitzgibbon 2001): ideal offset = distorted offset / (1 + d1 r^2)."""

from collections.abc import Sequence
from typing import Any

from starcal_uq.camera import Coefficient, DistortionModel

D1 = Coefficient("d1", "px^-2", 1e-10, "1e-10 px^-2", "term of the division model", order=3)


def division(u: Any, v: Any, k: Sequence[Any]) -> tuple[Any, Any]:
    """Displacement from distorted to ideal points, px; u, v and k may be symbols of CasADi."""
    factor = 1.0 / (1.0 + k[0] * (u * u + v * v)) - 1.0
    return u * factor, v * factor


DIVISION = DistortionModel("division", (D1,), "inverse", division, "Fitzgibbon 2001, CVPR")
