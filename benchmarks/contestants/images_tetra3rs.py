"""Centroids and identification by tetra3rs, one thread."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import numpy as np
import tetra3rs
from worker import Missing

Result = dict[str, Any]


def _images(folder: Path) -> list[np.ndarray]:
    paths = [
        path for ending in ("tif*", "png") for path in sorted(Path(folder).glob(f"*.{ending}"))
    ]
    if not paths:
        raise Missing(f"{folder} is not on this machine")
    # Grey in the depth of the file: what it reads has one channel.
    return [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) for path in paths]


def centroids(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """`extract_centroids` with its defaults; no covariances, no correction of the pixel phase."""
    loaded = _images(images)

    def run() -> Result:
        found = [tetra3rs.extract_centroids(image, threads=1) for image in loaded]
        return {"frames": len(loaded), "found": sum(len(f.centroids) for f in found)}

    return run


def _database(field: float) -> Any:
    return tetra3rs.SolverDatabase.generate_from_gaia(
        max_fov_deg=1.05 * field,
        min_fov_deg=0.95 * field,
        star_max_magnitude=7.0,
        epoch_proper_motion_year=2019.6,
    )


def frames(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """Images to attitudes, one by one; places are counted from the middle of the first pixel."""
    loaded, field = _images(images), 11.42
    database = _database(field)

    def run() -> Result:
        done = []
        for image in loaded:
            height, width = image.shape
            clock = [process_time()]
            points = tetra3rs.extract_centroids(image, threads=1).centroids
            clock.append(process_time())
            found = database.solve_from_centroids(
                points,
                fov_estimate_deg=field,
                image_width=width,
                image_height=height,
                fov_max_error_deg=0.03 * field,
            )
            clock.append(process_time())
            places = [(p.x + 0.5 * (width - 1), p.y + 0.5 * (height - 1)) for p in points]
            middle, named = None, []
            if found:
                middle = np.asarray(found.rotation_matrix_icrs_to_camera, dtype=float)[2].tolist()
                stars = [database.get_star_by_id(int(i)) for i in found.matched_catalog_ids]
                at = [places[int(i)] for i in found.matched_centroids]
                named = [[*place, s.ra_deg, s.dec_deg] for place, s in zip(at, stars, strict=True)]
            done.append({"clock": clock, "middle": middle, "points": places, "stars": named})
        return {"frames": done}

    return run


def identify(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """`solve_from_centroids`, of its own centroids; the field is known to 3 %."""
    loaded = _images(images)
    field = 11.42
    database = _database(field)
    points = [tetra3rs.extract_centroids(image, threads=1).centroids for image in loaded]
    height, width = loaded[0].shape

    def run() -> Result:
        found = [
            database.solve_from_centroids(
                p,
                fov_estimate_deg=field,
                image_width=width,
                image_height=height,
                fov_max_error_deg=0.03 * field,
            )
            for p in points
        ]
        return {"frames": len(loaded), "found": sum(bool(f) for f in found)}

    return run


def identify_unknown(
    folder: Path, *, images: str, field: float, extraction: dict[str, Any] | None = None
) -> Callable[[], Result]:
    """`solve_from_centroids` of its own centroids with one guess, and patterns for fields of 5 to
    30 degrees.

    With `extraction`, its centroids are those of these settings instead of its defaults.
    """
    grey = _images(images)
    database = tetra3rs.SolverDatabase.generate_from_gaia(
        max_fov_deg=30.0, min_fov_deg=5.0, epoch_proper_motion_year=2019.6
    )
    points = [
        tetra3rs.extract_centroids(image, threads=1, **(extraction or {})).centroids
        for image in grey
    ]
    height, width = grey[0].shape

    def run() -> Result:
        done = [
            database.solve_from_centroids(
                p, fov_estimate_deg=12.0, image_width=width, image_height=height
            )
            for p in points
        ]
        fields = [float(f.fov_deg) for f in done if f]
        return {
            "frames": len(grey),
            "found": len(fields),
            "wrong": sum(abs(f / field - 1.0) > 0.02 for f in fields),
        }

    return run
