"""What proposes attitudes to be verified: our own pattern search, or another solver."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from typing import Literal, Protocol, TypeAlias

import numpy as np

from starcal_uq.core.errors import IdentificationError
from starcal_uq.core.types import FloatArray
from starcal_uq.identification.identification_tetra3rs import PlateSolver
from starcal_uq.identification.pairs import StarPairs, cached_star_pairs, find_star_pairs
from starcal_uq.identification.pyramid import CameraTolerance, FieldGeometry, Hypothesis, hypotheses
from starcal_uq.sky.catalogue import StarCatalogue

Engine: TypeAlias = Literal["pyramid", "tetra3rs"]
ENGINES: tuple[Engine, ...] = ("pyramid", "tetra3rs")


class Proposer(Protocol):
    """A catalogue prepared for a field of view, and a way to find attitudes in it."""

    def hypotheses(
        self,
        points: FloatArray,
        sigma_px: FloatArray,
        geometry: FieldGeometry,
        tolerance: CameraTolerance,
        max_centroids: int,
        searched: int,
    ) -> Iterator[list[Hypothesis]]:
        """Batches of hypotheses, as `pyramid.hypotheses` gives them."""
        ...


class PyramidProposer:
    """Our own pattern search."""

    def __init__(self, pairs: StarPairs) -> None:
        from scipy.spatial import cKDTree

        self.pairs, self._tree = pairs, cKDTree(pairs.directions)

    def hypotheses(
        self,
        points: FloatArray,
        sigma_px: FloatArray,
        geometry: FieldGeometry,
        tolerance: CameraTolerance,
        max_centroids: int,
        searched: int,
    ) -> Iterator[list[Hypothesis]]:
        """See `pyramid.hypotheses`."""
        return hypotheses(points, sigma_px, self.pairs, self._tree, geometry, tolerance, max_centroids, searched)


def prepare_engine(
    engine: Engine,
    stars: StarCatalogue,
    geometry: FieldGeometry,
    tolerance: CameraTolerance,
    cache: bool,
    cache_dir: str | PathLike[str] | None,
) -> Proposer:
    """The catalogue prepared for one of `ENGINES`.

    Raises
    ------
    IdentificationError
        No such engine, or its package is not installed.
    """
    if engine == "tetra3rs":
        return PlateSolver(stars, geometry, tolerance)
    if engine != "pyramid":
        raise IdentificationError(f"there is no engine {engine!r}: choose {' or '.join(ENGINES)}.")
    return PyramidProposer(prepare_pairs(stars, geometry, tolerance, cache, cache_dir))


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
    directions = stars.directions_icrs
    if cache:
        return cached_star_pairs(directions, stars.mag, field_sr, largest, cache_dir)
    return find_star_pairs(directions, stars.mag, field_sr, largest)
