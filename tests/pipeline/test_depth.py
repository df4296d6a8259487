"""The magnitude limit that frames ask for."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.identification import pyramid
from starcal_uq.identification.blind import LEVELS, BlindSearch
from starcal_uq.identification.engine import identify
from starcal_uq.pipeline.depth import COUNTS, depth_for, identify_to_depth, stars_in_field
from tests.identification.test_search import random_frames, square_camera, wrong_rows


def test_counts_are_the_catalogue_s() -> None:
    mag = sc.load_catalogue(8.0).mag
    for limit in (7.0, 7.5, 8.0):
        assert COUNTS[limit] == np.count_nonzero(mag <= limit)
    # A hemisphere seen by a pinhole of 90 x 90 degrees is a sixth of the sky.
    assert stars_in_field(square_camera(90.0), 7.0) == pytest.approx(COUNTS[7.0] / 6.0)


@pytest.mark.parametrize(
    ("fov_deg", "limit"), [(20.0, 7.0), (12.0, 7.0), (3.0, 8.5), (2.0, 9.5), (1.0, 10.0)]
)
def test_narrow_fields_ask_for_fainter_stars(fov_deg: float, limit: float) -> None:
    table: Any = SimpleNamespace(stars_per_frame=np.array([12, 2, 11, 13]))
    assert depth_for(table, square_camera(fov_deg)) == limit


def small_wide(n: int) -> tuple[Any, Any]:
    """Frames of a camera of 256 px and 60 degrees, whose principal point is off by 1 % of the
    width.
    """
    focal, off = 128.0 / np.tan(np.radians(30.0)), np.array([2.5, -2.0])
    camera = sc.Camera(256, 256, 5.0, focal * 5e-3, 127.5 + off[0], 127.5 + off[1])
    table, names, _ = random_frames(sc.load_catalogue(3.8), camera, n, 5, missing=0.6)
    table.stars_per_frame = np.bincount(table.frame, minlength=n)
    table.meta = {"optics": {"width_px": 256, "height_px": 256}}
    return table, names


@pytest.mark.parametrize("sheet", [False, True])
def test_a_wide_field_on_a_small_detector(sheet: bool) -> None:
    """20 px is 5 degrees there: what is allowed for the principal point is a part of the width."""
    table, names = small_wide(3)
    camera = sc.Camera(256, 256, 5.0, 128.0 / np.tan(np.radians(30.0)) * 5e-3, 127.5, 127.5)
    _, found = identify_to_depth(table, camera if sheet else None, 2016.0, cache=False)
    assert found.n_identified == 3
    assert wrong_rows(found, table, names) == 0


def test_a_failed_search_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stars at random places: however deep the catalogue, each level is compared with a frame and
    its mirror once.
    """
    n, rng = 2, np.random.default_rng(3)
    table, _ = small_wide(n)
    table.x_px, table.y_px = rng.uniform(1.0, 254.0, (2, len(table.frame)))
    searched: list[tuple[Any, ...]] = []
    matches = []

    def solve(
        self: BlindSearch, u: Any, sigma: Any, sizes: list[int], focal_px: tuple[float, float]
    ) -> None:
        searched.extend((u.tobytes(), size, focal_px) for size in sizes)

    monkeypatch.setattr(BlindSearch, "solve", solve)
    # Loaded sooner than what deep levels ask for.
    monkeypatch.setattr("starcal_uq.pipeline.depth._SEARCHED", {20_000: 7.0, 500_000: 7.5})
    monkeypatch.setattr(
        "starcal_uq.identification.search.match_frame", lambda *_, **__: matches.append(1)
    )
    _, found = identify_to_depth(table, None, 2016.0, cache=False)
    assert found.n_identified == 0
    assert (
        len(searched) == len(set(searched)) == 2 * n * sum(size <= COUNTS[7.5] for size in LEVELS)
    )
    assert not matches
    # With a sheet the range near its focal length comes first, and is left out of the rest.
    camera = sc.Camera(256, 256, 5.0, 400 * 5e-3, 127.5, 127.5)
    searched.clear()
    identify_to_depth(table, camera, 2016.0, cache=False)
    assert len(searched) == len(set(searched))
    ranges = sorted({focal for _, _, focal in searched})
    assert len(ranges) == 3
    assert all(a[1] == b[0] for a, b in pairwise(ranges))
    # Every triangle gives six matches at most, of 200 at first and 60 with a worse lens.
    assert 0 < len(matches) <= n * 6 * (200 + 60)


def test_a_search_ends_where_too_many_triangles_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stars at random places, a camera of which next to nothing is known: the work is bounded,
    whatever fits.
    """
    table, _ = small_wide(1)
    table.x_px, table.y_px = np.random.default_rng(3).uniform(1.0, 254.0, (2, len(table.frame)))
    camera = sc.Camera(256, 256, 5.0, 400 * 5e-3, 127.5, 127.5)
    fitted: list[int] = []

    def looked_up(*arguments: Any) -> Any:
        found = look_up(*arguments)
        fitted.append(len(found))
        return found

    look_up = pyramid._look_up
    monkeypatch.setattr(pyramid, "_look_up", looked_up)
    options = {"search_focal": False, "cache": False, "centre_tolerance_px": 20.0}
    assert identify(table, camera, sc.load_catalogue(4.0), **options).n_identified == 0
    every = sum(fitted)
    fitted.clear()
    monkeypatch.setattr(pyramid, "_MOST_CANDIDATES", every // 20)
    assert identify(table, camera, sc.load_catalogue(4.0), **options).n_identified == 0
    assert max(fitted) < sum(fitted) < every // 2


@pytest.mark.slow
def test_a_field_of_three_degrees() -> None:
    """At the limit of 7 most frames have too few stars; as deep as the frames see all are found,
    sheet or none.
    """
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
