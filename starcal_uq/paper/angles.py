"""Optics, or all parameters, from the angles between stars themselves instead of their cosines.

The paper's objective (its eqs. 5 and 13) compares cosines, whose errors are those of the angles times their sine: wide
pairs count most. An implementation that compares angles weighs all pairs alike, and, where distortion is ignored, ends
at another focal length. It is a reading of the paper, and not a method of this package.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.projection import unproject_jacobian
from starcal_uq.core.types import FloatArray, IntArray

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

_MAX_STEPS = 20
_TOLERANCE_PX = 1e-7


def fit_angles(obs: Observations, model: str, start: FloatArray) -> FloatArray:
    """Gauss-Newton on the differences of all angles between stars of a frame, all pairs alike.

    Parameters
    ----------
    obs : Observations
        The stars; explicit pairs are formed.
    model : str
        Distortion model.
    start : (p,) array
        Where to start, px units; near enough for full steps, such as the solution for the cosines.

    Returns
    -------
    (p,) array
        The estimate, px units.
    """
    i, j = _pairs(obs.frame_starts)
    r = obs.directions_icrs
    given = _angle(r[i], r[j])[0]
    theta = np.asarray(start, dtype=np.float64)
    for _ in range(_MAX_STEPS):
        b, db = unproject_jacobian(model, theta, obs.xy)
        angle, sine = _angle(b[i], b[j])
        slope = -(np.einsum("ni,nip->np", b[j], db[i]) + np.einsum("ni,nip->np", b[i], db[j])) / sine[:, None]
        scale = np.linalg.norm(slope, axis=0)
        slope /= scale
        step = np.linalg.solve(slope.T @ slope, slope.T @ (given - angle)) / scale
        theta = theta + step
        if float(np.max(np.abs(step[:3]))) < _TOLERANCE_PX:
            break
    return theta


def _pairs(starts: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of the two stars of every pair within a frame."""
    blocks = [np.stack(np.triu_indices(b - a, 1)) + a for a, b in pairwise(starts.tolist())]
    i, j = np.concatenate(blocks, axis=1)
    return i, j


def _angle(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles between unit vectors (n, 3), rad, and their sines; both good for small angles."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.arctan2(sine, np.einsum("ni,ni->n", a, b)), sine
