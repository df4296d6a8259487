"""Centroids where the catalogue has their stars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.pipeline.displacement import as_measured, undisplaced
from starcal_uq.sky.apparent import (
    catalogue_directions,
    make_apparent,
)
from tests.helpers.ground_scenes import CAMERA, SITE, as_centroids, ground_frames
from tests.sky.test_refraction import rotated_onto


@pytest.fixture(scope="module")
def stars():
    return sc.load_catalogue(max_mag=6.5, epoch=2026.9)


def test_moved_centroids_are_where_the_catalogue_has_them(stars):
    obs = ground_frames(stars, np.array([25.0, 60.0, 40.0]), sigma_px=0.0)
    table = as_centroids(obs)
    seen = make_apparent(obs, site=SITE).select_frames([0, 1])
    moved = undisplaced(table, seen, CAMERA, lambda u, t: catalogue_directions(u, t, site=SITE))
    # The pixels of the catalogue's directions through the true camera, at the best attitude.
    for number in (0, 1):
        rows = table.frame == number
        b = sc.camera.unproject(CAMERA, np.column_stack([moved.x_px[rows], moved.y_px[rows]]))
        r = obs.directions_icrs[obs.frame == number]
        left = np.linalg.norm(rotated_onto(r, b) - b, axis=1) * CAMERA.focal_px
        assert np.median(left) < 1e-5
        shift = np.hypot(moved.x_px[rows] - table.x_px[rows], moved.y_px[rows] - table.y_px[rows])
        assert 0.03 < shift.max() < 1.0
    untouched = table.frame == 2
    assert np.array_equal(moved.x_px[untouched], table.x_px[untouched])
    back = as_measured(replace(obs, x_px=moved.x_px, y_px=moved.y_px), moved, table)
    assert np.array_equal(back.x_px, obs.x_px)
