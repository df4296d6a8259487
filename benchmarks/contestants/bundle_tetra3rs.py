"""`calibrate_camera` of tetra3rs, on frames that its own solver identified before (not timed).

Its catalogue differs from ours by a hundredth of a pixel, and by more for blends: every star is
moved by what that is on the detector, so that its residuals are the same noise as ours.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tetra3rs
from bundles import Bundle, schur
from worker import Missing

Result = dict[str, Any]


def calibrate(folder: Path) -> Callable[[], Result]:
    """Its radial model, k1 to k3 about a centre of their own. It gives no covariance."""
    bundle, fitted = Bundle(folder), schur(folder)()
    with np.load(folder / "stars.npz") as data:
        size, start = data["size"], data["start"]
    width, height = (int(n) for n in size)
    centre = 0.5 * (size - 1.0)
    field = float(np.degrees(2.0 * np.arctan(0.5 * width / start[2])))
    database = tetra3rs.SolverDatabase.generate_from_gaia(
        max_fov_deg=1.1 * field,
        min_fov_deg=0.9 * field,
        star_max_magnitude=6.0,
        epoch_proper_motion_year=2026.9,
    )
    model = tetra3rs.CameraModel(float(start[2]), width, height)

    def solved(points: Any) -> Any:
        return database.solve_from_centroids(
            points, camera_model=model, fov_max_error_deg=0.05 * field
        )

    ours, _ = bundle.linear(fitted["theta"], fitted["rotations"])
    theirs = bundle.r.copy()
    known = np.zeros(len(bundle.frame), dtype=bool)
    for k, first in enumerate(bundle.starts[:-1]):
        found = solved(np.ascontiguousarray(bundle.xy[:, first : bundle.starts[k + 1]].T - centre))
        if not found:
            continue
        rows = first + np.asarray(found.matched_centroids, dtype=int)
        stars = [database.get_star_by_id(int(i)) for i in found.matched_catalog_ids]
        ra, dec = np.radians([s.ra_deg for s in stars]), np.radians([s.dec_deg for s in stars])
        theirs[:, rows] = np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)
        known[rows] = True
    bundle.r = theirs
    moved, _ = bundle.linear(fitted["theta"], fitted["rotations"])
    shift = ours - moved
    # A match further away than a blend can be is a wrong identification of its solver.
    known &= np.linalg.norm(shift, axis=0) < 3.0
    xy = (bundle.xy + shift).T - centre
    results, centroids = [], []
    for k, first in enumerate(bundle.starts[:-1]):
        rows = first + np.flatnonzero(known[first : bundle.starts[k + 1]])
        points = [tetra3rs.Centroid(float(x), float(y)) for x, y in xy[rows]]
        found = solved(points) if len(rows) > 3 else None
        if found:
            results.append(found)
            centroids.append(points)
    if 2 * len(results) < len(bundle.counts):
        raise Missing(f"its solver identified {len(results)} of {len(bundle.counts)} frames")

    def run() -> Result:
        done = database.calibrate_camera(
            results, centroids, width, height, model="radial", max_iterations=100
        )
        camera, d = done.camera_model, done.camera_model.distortion
        x0, y0 = np.asarray(camera.crpix) + d.center + centre
        said = (
            f"{done.n_inliers} stars, rms {done.rmse_after_px:.3f} px, principal point at the "
            "centre"
        )
        return {"theta": [x0, y0, camera.focal_length_px, d.k1, d.k2], "said": said}

    return run
