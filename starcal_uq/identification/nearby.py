"""The catalogue's stars around a direction, to the depth that suits a frame."""

from __future__ import annotations

from copy import copy
from math import pi
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.identification.pyramid import FieldGeometry
from starcal_uq.sky.catalogue import StarCatalogue

# Centroids are compared with the catalogue down to where a field holds this many stars for each,
# and some more.
_STARS_PER_CENTROID, _STARS_MORE = 2.0, 20
# All stars are looked at sooner than a tree gives its list, where they are so few; where they are
# more, making the tree takes as long as so many looks at all of them.
_FEW, _LOOKS = 20_000, 300


class NearbyStars:
    """A catalogue, searched to the depth that suits a frame."""

    def __init__(self, stars: StarCatalogue, geometry: FieldGeometry) -> None:
        self.rows, self.directions, self.mag = stars.brightest_first
        self.geometry = geometry
        self._trees: dict[int, Any] = {}
        self._looks: dict[int, int] = {}

    def depth(self, n_centroids: int) -> int:
        """Number of stars on the whole sky that a frame with so many centroids is compared with."""
        g = self.geometry
        field_sr = g.width_px * g.height_px / g.focal_px**2
        wanted = (_STARS_PER_CENTROID * n_centroids + _STARS_MORE) * 4.0 * pi / field_sr
        return min(len(self.rows), _step(wanted))

    def seen_by(self, geometry: FieldGeometry) -> NearbyStars:
        """The same catalogue for another camera."""
        other = copy(self)
        other.geometry = geometry
        return other

    def around(self, boresight: FloatArray, radius_rad: float, depth: int) -> IntArray:
        """Stars, by brightness rank, within an angle of a direction."""
        from scipy.spatial import cKDTree

        looks = self._looks[depth] = self._looks.get(depth, 0) + 1
        if depth < _FEW or looks < _LOOKS:
            return np.flatnonzero(self.directions[:depth] @ boresight > np.cos(radius_rad))
        if depth not in self._trees:
            self._trees[depth] = cKDTree(self.directions[:depth])
        chord = 2.0 * np.sin(0.5 * min(radius_rad, pi))
        ranks = self._trees[depth].query_ball_point(boresight, chord, return_sorted=True)
        return np.asarray(ranks, dtype=np.int64)


def _step(wanted: float) -> int:
    """The next power of the square root of two: few different depths, because each has its own
    tree.
    """
    return int(np.ceil(2.0 ** (np.ceil(2.0 * np.log2(wanted)) / 2.0)))
