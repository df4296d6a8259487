"""The magnitude limit that frames ask for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.identification.engine import identify
from starcal_uq.pipeline.depth import COUNTS, depth_for, identify_to_depth, stars_in_field
from tests.identification.test_identification import random_frames, square_camera, wrong_rows


def test_counts_are_the_catalogue_s() -> None:
    mag = sc.load_catalogue(8.0).mag
    for limit in (7.0, 7.5, 8.0):
        assert COUNTS[limit] == np.count_nonzero(mag <= limit)
    # A hemisphere seen by a pinhole of 90 x 90 degrees is a sixth of the sky.
    assert stars_in_field(square_camera(90.0), 7.0) == pytest.approx(COUNTS[7.0] / 6.0)


@pytest.mark.parametrize(("fov_deg", "limit"), [(20.0, 7.0), (12.0, 7.0), (3.0, 8.5), (2.0, 9.5), (1.0, 10.0)])
def test_narrow_fields_ask_for_fainter_stars(fov_deg: float, limit: float) -> None:
    table: Any = SimpleNamespace(stars_per_frame=np.array([12, 2, 11, 13]))
    assert depth_for(table, square_camera(fov_deg)) == limit


@pytest.mark.slow
def test_a_field_of_three_degrees() -> None:
    """At the limit of 7 most frames have too few stars; as deep as the frames see all are found, sheet or none."""
    stars, camera = sc.load_catalogue(8.5), square_camera(3.0)
    table, names, _ = random_frames(stars, camera, 12, 3)
    table.stars_per_frame = np.bincount(table.frame, minlength=12)
    shallow = identify(table, camera, sc.load_catalogue(7.0), search_focal=False)
    assert shallow.n_identified < 9
    deep, found = identify_to_depth(table, camera, 2016.0)
    assert found.n_identified == 12
    assert wrong_rows(found, table, names) == 0
    assert deep.mag.max() > 8.4
    table.meta = {"optics": {"width_px": 1024, "height_px": 1024}}
    _, alone = identify_to_depth(table, None, 2016.0)
    assert alone.n_identified == 12
    assert wrong_rows(alone, table, names) == 0
