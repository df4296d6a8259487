"""Attitudes over time."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_uq.attitude.profile import AttitudeProfile


def slew(
    n: int = 61, step_s: float = 10.0, rate_deg_s: float = 0.1, seed: int = 1
) -> AttitudeProfile:
    """A constant turn about a fixed axis, from a random attitude."""
    time = step_s * np.arange(n)
    axis = np.array([0.2, 0.97, 0.1])
    turns = Rotation.from_rotvec(
        np.outer(np.radians(rate_deg_s) * time, axis / np.linalg.norm(axis))
    )
    return AttitudeProfile(time, (turns * Rotation.random(random_state=seed)).as_quat(), "slew")
