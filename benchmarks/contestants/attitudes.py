"""Attitudes from star directions, by SciPy and NumPy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

Result = dict[str, Any]


def directions(frames: int, stars: int) -> tuple[np.ndarray, np.ndarray]:
    """Measured and catalogued directions (frames, stars, 3): 12 degrees across, noise of 10
    arcsec.
    """
    rng = np.random.default_rng(0)
    b = rng.normal(0.0, 0.07, (frames, stars, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    b /= np.linalg.norm(b, axis=2, keepdims=True)
    r = np.einsum("kji,kmj->kmi", Rotation.random(frames, rng=rng).as_matrix(), b)
    b += 5e-5 * rng.standard_normal(b.shape)
    return b / np.linalg.norm(b, axis=2, keepdims=True), r


def align_vectors(folder: Path, *, frames: int, stars: int) -> Callable[[], Result]:
    """SciPy, a call for each frame."""
    b, r = directions(frames, stars)

    def run() -> Result:
        found = [Rotation.align_vectors(b[k], r[k])[0] for k in range(frames)]
        return {"quaternions": np.array([q.as_quat() for q in found[:1000]])}

    return run


def kabsch(folder: Path, *, frames: int, stars: int) -> Callable[[], Result]:
    """NumPy, singular values of all frames together."""
    b, r = directions(frames, stars)

    def run() -> Result:
        left, _, right = np.linalg.svd(np.swapaxes(b, 1, 2) @ r)
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        return {"quaternions": Rotation.from_matrix(left @ right).as_quat()[:1000]}

    return run


def davenport(folder: Path, *, frames: int, stars: int) -> Callable[[], Result]:
    """NumPy, eigenvectors of all frames' matrices together."""
    b, r = directions(frames, stars)

    def run() -> Result:
        gram = np.swapaxes(b, 1, 2) @ r
        matrix = np.empty((frames, 4, 4))
        trace = np.trace(gram, axis1=1, axis2=2)
        matrix[:, :3, :3] = gram + np.swapaxes(gram, 1, 2) - trace[:, None, None] * np.eye(3)
        for i, (p, q) in enumerate(((2, 1), (0, 2), (1, 0))):
            matrix[:, i, 3] = matrix[:, 3, i] = gram[:, p, q] - gram[:, q, p]
        matrix[:, 3, 3] = trace
        return {"quaternions": np.linalg.eigh(matrix)[1][:1000, :, 3]}

    return run
