"""Centroids where they would be if aberration and refraction did not displace the stars.

A catalogue knows neither, and while the attitude takes up what is common to a frame, the rest
stretches it: by some tenths of a pixel near the edge of a wide field, differently at every
altitude. Stars are identified by their places, so that once attitude and camera are known roughly,
the centroids are moved by what the sky did to each frame, and compared with the catalogue like with
like. What is calibrated afterwards are the centroids as they were measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.projection import project, unproject
from starcal_uq.core.types import FloatArray, IntArray, StrArray

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.images.centroids import Centroids
    from starcal_uq.observations.table import Observations

ToCatalogue: TypeAlias = Callable[[FloatArray, StrArray], FloatArray]


def undisplaced(
    centroids: Centroids, obs: Observations, camera: Camera, to_catalogue: ToCatalogue
) -> Centroids:
    """The same table with the centroids of identified frames moved to where the catalogue would
    have them.

    `obs` are identified stars with apparent directions and times, counted as the centroids are, and
    `to_catalogue` makes catalogue directions (n, 3) of apparent ones (n, 3) and their times (n,). A
    frame's mean displacement stays in its attitude; frames that are not in `obs` are as they were.
    """
    if obs.time_utc is None or not obs.n_stars:
        return centroids
    b = unproject(camera, np.column_stack([obs.x_px, obs.y_px]))
    first = np.searchsorted(obs.frame, obs.frame_ids)
    attitudes = quest(b, obs.directions_icrs, _starts(obs.frame), covariance=False).rotations
    rows = np.flatnonzero(np.isin(centroids.frame, obs.frame_ids))
    place = np.searchsorted(obs.frame_ids, centroids.frame[rows])
    b = unproject(camera, np.column_stack([centroids.x_px[rows], centroids.y_px[rows]]))
    # Rows times a rotation are columns times its transpose: from the camera to the stars.
    seen = np.einsum("ni,nij->nj", b, attitudes[place])
    r = to_catalogue(seen, obs.time_utc[first][place])
    turned = quest(b, r, _starts(centroids.frame[rows]), covariance=False).rotations[place]
    x, y = centroids.x_px.copy(), centroids.y_px.copy()
    moved = project(camera, np.einsum("nij,nj->ni", turned, r))
    # A star near the edge may be moved beyond it, by less than its tolerance.
    x[rows] = np.clip(moved[:, 0], -0.5, camera.width_px - 0.5)
    y[rows] = np.clip(moved[:, 1], -0.5, camera.height_px - 0.5)
    return replace(centroids, x_px=x, y_px=y)


def as_measured(obs: Observations, moved: Centroids, measured: Centroids) -> Observations:
    """Observations that were identified among moved centroids, with the places that were measured,
    row by row.
    """
    from scipy.spatial import cKDTree

    far = 10.0 * float(np.abs(np.concatenate([moved.x_px, moved.y_px, [1.0]])).max())
    tree = cKDTree(np.column_stack([far * moved.frame, moved.x_px, moved.y_px]))
    _, rows = tree.query(np.column_stack([far * obs.frame, obs.x_px, obs.y_px]))
    return replace(obs, x_px=measured.x_px[rows], y_px=measured.y_px[rows])


def mirrored(centroids: Centroids, width_px: int) -> Centroids:
    """The same table with x counted from the right edge."""
    return replace(centroids, x_px=width_px - 1 - centroids.x_px)


def _starts(frame: IntArray) -> IntArray:
    first = np.flatnonzero(np.concatenate([[True], frame[1:] != frame[:-1]]))
    return np.append(first, len(frame)).astype(np.int64)
