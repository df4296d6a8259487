"""What proposes attitudes to be verified: our own pattern search, or another solver."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias, get_args

import numpy as np

from starcal_uq.core.errors import IdentificationError
from starcal_uq.core.extras import extra
from starcal_uq.core.settings import Engine
from starcal_uq.core.temporary import TemporaryFolder
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.identification.pairs import StarPairs, prepared_star_pairs
from starcal_uq.identification.pyramid import CameraTolerance, FieldGeometry, Hypothesis, hypotheses
from starcal_uq.sky.catalogue import StarCatalogue
from starcal_uq.sky.gaia import write_gaia_records

ENGINES: tuple[Engine, ...] = get_args(Engine)

# Batches of hypotheses from points, their noise, the camera, its tolerances, the number of
# centroids to look at, and the number of those that were searched before: `pyramid.hypotheses` with
# its catalogue, or another solver's.
Proposer: TypeAlias = Callable[
    [FloatArray, FloatArray, FieldGeometry, CameraTolerance, int, int], Iterator[list[Hypothesis]]
]


def prepare_engine(
    engine: Engine,
    stars: StarCatalogue,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
    cache: bool,
    cache_dir: str | PathLike[str] | None,
) -> Proposer:
    """The catalogue prepared for one of `ENGINES`; `MissingExtraError` where its package is not
    installed.
    """
    if engine == "tetra3rs":
        return PlateSolver(stars, geometry, tolerance).hypotheses
    if engine != "pyramid":
        raise IdentificationError(f"there is no engine {engine!r}: choose {' or '.join(ENGINES)}.")
    return partial(hypotheses, prepare_pairs(stars, geometry, tolerance, cache, cache_dir).ready())


def prepare_pairs(
    stars: StarCatalogue,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
    cache: bool,
    cache_dir: str | PathLike[str] | None,
) -> StarPairs:
    """Pattern stars and their pairs for a field of view."""
    f, w, h = geometry.focal_px, geometry.width_px, geometry.height_px
    largest = 2.0 * float(np.arctan(0.5 * np.hypot(w, h) / f)) * (1.0 + tolerance.focal) + 0.002
    # Rounded, so that cameras of nearly the same field share a file.
    largest = float(np.ceil(largest * 200.0) / 200.0)
    field_sr = float(f"{w * h / f**2:.2g}")
    return prepared_star_pairs(
        stars.directions_icrs, stars.mag, field_sr, largest, cache, cache_dir
    )


# The table of patterns is made for fields this much smaller and larger than the tolerance of the
# focal length asks for.
_FIELD_MARGIN = 0.02


class PlateSolver:
    """A pattern table of tetra3rs for one catalogue and field of view."""

    def __init__(
        self, stars: StarCatalogue, geometry: FieldGeometry, tolerance: CameraTolerance
    ) -> None:
        solver = _package()
        fov_deg = _field_deg(geometry)
        margin = tolerance.focal + _FIELD_MARGIN
        with TemporaryFolder() as folder:
            path = Path(folder) / "stars.bin"
            write_gaia_records(path, stars.ra_deg, stars.dec_deg, stars.mag)
            try:
                self._database = solver.SolverDatabase.generate_from_gaia(
                    catalog_path=str(path),
                    min_fov_deg=fov_deg * (1.0 - margin),
                    max_fov_deg=fov_deg * (1.0 + margin),
                    epoch_proper_motion_year=None,
                )
            except (ValueError, RuntimeError) as error:
                raise IdentificationError(
                    f'tetra3rs makes no patterns of this catalogue ({error}); use engine="pyramid".'
                ) from error

    def hypotheses(
        self,
        points: FloatArray,
        sigma_px: FloatArray,
        geometry: FieldGeometry,
        tolerance: CameraTolerance,
        max_centroids: int,
        searched: int,
    ) -> Iterator[list[Hypothesis]]:
        """At most one hypothesis, from all centroids; none on a second call for the same frame."""
        if searched or len(points) < 4:
            return
        solver = _package()
        width, height = int(geometry.width_px), int(geometry.height_px)
        # Points are brightest first, which is all that is used of the third column.
        centroids = np.column_stack([points, np.arange(len(points), 0.0, -1.0)])
        result = self._database.solve_from_centroids(
            centroids,
            camera_model=solver.CameraModel(geometry.focal_px, width, height),
            fov_max_error_deg=_field_deg(geometry)
            * (tolerance.focal + geometry.relative_bias(tolerance)),
            # No limit in time, only in patterns: the same result on every machine.
            solve_timeout_ms=None,
        )
        # A mirrored sky is another search's, as it is for our own patterns.
        if not result or result.parity_flip:
            return
        # In single precision, so that it is no rotation to ours.
        u, _, v = np.linalg.svd(floats(result.rotation_matrix_icrs_to_camera))
        focal_px = 0.5 * geometry.width_px / np.tan(np.radians(0.5 * float(result.fov_deg)))
        yield [Hypothesis(u @ v, float(focal_px / geometry.focal_px))]


def _field_deg(geometry: FieldGeometry) -> float:
    """Horizontal field of view."""
    return float(np.degrees(2.0 * np.arctan(0.5 * geometry.width_px / geometry.focal_px)))


def _package() -> Any:
    with extra("tetra3rs", "attitudes by the engine tetra3rs", 'use engine="pyramid"'):
        import tetra3rs
    return tetra3rs
