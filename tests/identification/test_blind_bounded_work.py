"""Work of identification, in counts: what fails costs no more than a few times what succeeds."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.identification import match, pyramid
from starcal_uq.identification.engine import identify
from starcal_uq.identification.pairs import StarPairs, angle_between, find_star_pairs
from starcal_uq.sky.catalogue import StarCatalogue
from tests.identification.test_search_wide_fields import measured, noise_frames, wrong_and_right
from tests.identification.wide import Lens


@pytest.fixture(scope="module")
def stars() -> StarCatalogue:
    return sc.load_catalogue(7.0, epoch=2016.0)


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Triangles that are looked up, pairs that are tried as their bases, and fits of matched
    stars.
    """
    counts: Counter[str] = Counter()
    look_up, fit = pyramid._look_up, match._fit

    def looked_up(triangle: Any, *arguments: Any) -> Any:
        found = look_up(triangle, *arguments)
        i, j, _ = triangle
        counts["triangles"] += 1
        counts["pairs"] += len(arguments[-1][min(i, j), max(i, j)][0])
        return found

    def fitted(*arguments: Any) -> Any:
        counts["fits"] += 1
        return fit(*arguments)

    monkeypatch.setattr(pyramid, "_look_up", looked_up)
    monkeypatch.setattr(match, "_fit", fitted)
    return counts


def test_few_stars_of_a_lens_that_bends(stars: StarCatalogue, work: Counter[str]) -> None:
    """Three frames of 30 stars and as many false ones take fewer triangles than one frame that
    fails by itself.
    """
    lens = Lens(1600, 1200, 60.0, 0.05)
    table, truth = measured(stars, lens, [30, 30, 30], 30, 0.2, 3)
    found = identify(table, None, stars, cache=False)
    assert found.n_identified == 3
    assert sum(wrong_and_right(found, *frame, k)[0] for k, frame in enumerate(truth)) <= 1
    assert work["triangles"] <= 3 * 60
    assert work["fits"] <= 3 * 60


def test_random_detections_of_a_narrow_field_are_given_up(
    monkeypatch: pytest.MonkeyPatch, work: Counter[str]
) -> None:
    """Where each triangle has thousands of pairs for its base, the search of a frame ends after so
    many pairs.
    """
    lens = Lens(1024, 1024, 3.0)
    sheet = sc.Camera(lens.width, lens.height, 5.0, 5e-3 * lens.focal, 511.5, 511.5)
    table = noise_frames(lens, [40], 2)
    deep = sc.load_catalogue(8.0, epoch=2016.0)
    monkeypatch.setattr("starcal_uq.identification.engine.find_optics", lambda *_: None)
    searches = (
        3 * 2
    )  # Two numbers of centroids: the camera as it is, and with a worse lens; and once more.
    most = 20_000
    monkeypatch.setattr(pyramid, "_MOST_PAIRS", most)
    largest = 0

    def each(*arguments: Any) -> Any:
        nonlocal largest
        before = work["pairs"]
        found = looked_up(*arguments)
        largest = max(largest, work["pairs"] - before)
        return found

    looked_up = pyramid._look_up
    monkeypatch.setattr(pyramid, "_look_up", each)
    assert identify(table, sheet, deep, cache=False).n_identified == 0
    # The last triangle of a search may go beyond.
    assert most < work["pairs"] <= searches * (most + largest)


def test_pairs_of_a_narrow_field_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """With many stars the pairs at larger angles are left out, and every question below them has
    the same answer.
    """
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    mag = rng.random(4000)

    def pairs() -> StarPairs:
        return find_star_pairs(directions, mag, 0.01, 0.3)

    every = pairs()
    monkeypatch.setattr("starcal_uq.identification.pairs._MOST_PAIRS", 20_000)
    fewer = pairs()
    assert len(every.angle) > 60_000
    assert 15_000 < len(fewer.angle) < 25_000
    np.testing.assert_array_equal(fewer.star, every.star)
    reach = float(fewer.angle[-1])
    asked, tolerance = np.full(500, 0.8 * reach), 0.1 * reach
    star = np.arange(500)
    for one, other in zip(
        every.near_angle(star, asked, tolerance),
        fewer.near_angle(star, asked, tolerance),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    question, hit = fewer.near_angle(star, asked, tolerance)
    angle = angle_between(fewer.directions[star[question]], fewer.directions[hit])
    assert len(hit) and np.abs(angle - 0.8 * reach).max() <= tolerance
    # A smaller table of steps says the same.
    monkeypatch.setattr("starcal_uq.identification.pairs._ALL_STEPS", 20_000)
    for one, other in zip(
        fewer.near_angle(star, asked, tolerance),
        pairs().near_angle(star, asked, tolerance),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_field_of_one_degree_that_fails(
    monkeypatch: pytest.MonkeyPatch, work: Counter[str]
) -> None:
    """With half a million stars: as many listed pairs, and tried ones, as a field of some degrees
    takes.
    """
    lens = Lens(1024, 1024, 1.0)
    sheet = sc.Camera(lens.width, lens.height, 5.0, 5e-3 * lens.focal, 511.5, 511.5)
    deep = sc.load_catalogue(10.0, epoch=2016.0)
    listed = []

    def find(*arguments: Any) -> StarPairs:
        pairs = find_star_pairs(*arguments)
        listed.append(len(pairs.angle))
        return pairs

    monkeypatch.setattr("starcal_uq.identification.pairs.find_star_pairs", find)
    monkeypatch.setattr("starcal_uq.identification.engine.find_optics", lambda *_: None)
    assert identify(noise_frames(lens, [40], 2), sheet, deep, cache=False).n_identified == 0
    assert max(listed) < 6_000_000
    assert work["pairs"] < 40_000_000
