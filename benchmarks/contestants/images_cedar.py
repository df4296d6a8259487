"""Centroids and identification by cedar-solve (a fork of ESA's tetra3), with its own database."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import tetra3
from PIL import Image
from worker import Missing

Result = dict[str, Any]


def _images(folder: str) -> list[Any]:
    loaded = [
        Image.open(path)
        for ending in ("tif*", "png")
        for path in sorted(Path(folder).glob(f"*.{ending}"))
    ]
    if not loaded:
        raise Missing(f"{folder} is not on this machine")
    # What it reads is grey or of three colours; a fourth channel, which says what is transparent,
    # is no light.
    return [
        image.convert("L") if image.mode in ("RGB", "RGBA", "LA", "P") else image.copy()
        for image in loaded
    ]


def centroids(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """`get_centroids_from_image` with its defaults; no covariances."""
    loaded = _images(images)

    def run() -> Result:
        found = [tetra3.get_centroids_from_image(image) for image in loaded]
        return {"frames": len(loaded), "found": sum(len(f) for f in found)}

    return run


def identify(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """`solve_from_centroids`, of its own centroids; the field is known to 3 %."""
    loaded, field = _images(images), 11.42
    points = [
        (tetra3.get_centroids_from_image(image), (image.height, image.width)) for image in loaded
    ]
    solver = tetra3.Tetra3("default_database")

    def run() -> Result:
        found = [
            solver.solve_from_centroids(p, size, fov_estimate=field, fov_max_error=0.03 * field)
            for p, size in points
        ]
        return {"frames": len(loaded), "found": sum(f["RA"] is not None for f in found)}

    return run


def frames(folder: Path, *, images: str, camera: str) -> Callable[[], Result]:
    """Images to attitudes, one by one; places are counted from the middle of the first pixel."""
    loaded, field = _images(images), 11.42
    solver = tetra3.Tetra3("default_database")

    def run() -> Result:
        done = []
        for image in loaded:
            clock = [process_time()]
            points = tetra3.get_centroids_from_image(image)
            clock.append(process_time())
            size = image.height, image.width
            found = solver.solve_from_centroids(
                points, size, fov_estimate=field, fov_max_error=0.03 * field, return_matches=True
            )
            clock.append(process_time())
            middle, named = None, []
            if found["RA"] is not None:
                ra, dec = np.radians([found["RA"], found["Dec"]])
                middle = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
                at = np.array(found["matched_centroids"])[:, ::-1] - 0.5
                named = np.hstack([at, np.array(found["matched_stars"])[:, :2]]).tolist()
            done.append(
                {
                    "clock": clock,
                    "middle": middle,
                    "points": (points[:, ::-1] - 0.5).tolist(),
                    "stars": named,
                }
            )
        return {"frames": done}

    return run


def identify_unknown(folder: Path, *, images: str, field: float) -> Callable[[], Result]:
    """`solve_from_centroids` of its own centroids with its own database, for fields of 10 to 30
    degrees.
    """
    loaded = _images(images)
    points = [
        (tetra3.get_centroids_from_image(image), (image.height, image.width)) for image in loaded
    ]
    solver = tetra3.Tetra3("default_database")

    def run() -> Result:
        done = [solver.solve_from_centroids(p, size) for p, size in points]
        fields = [f["FOV"] for f in done if f["FOV"] is not None]
        return {
            "frames": len(loaded),
            "found": len(fields),
            "wrong": sum(abs(f / field - 1.0) > 0.02 for f in fields),
        }

    return run
