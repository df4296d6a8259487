"""Wide fields of lenses that bend, without a sheet: pictures and lens by NumPy alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.identification.engine import identify
from starcal_uq.identification.result import Identification
from starcal_uq.images.extract import extract_centroids
from starcal_uq.images.image import Image
from starcal_uq.sky.catalogue import StarCatalogue
from tests.identification.wide import Lens, attitude, picture, view

# Field of view in degrees, and by how much of its distance the corner is drawn in.
FIELDS = [
    *(
        (30, 0.0),
        (30, 0.045),
        (30, 0.08),
        (40, 0.02),
        (40, 0.05),
        (40, 0.08),
        (50, 0.03),
        (50, 0.06),
        (60, 0.0),
    ),
    *(
        (60, 0.04),
        (60, 0.06),
        (60, 0.08),
        (70, 0.04),
        (70, 0.08),
        (80, 0.03),
        (80, 0.06),
        (90, 0.04),
        (90, 0.08),
    ),
    *((100, 0.03), (100, 0.06)),
]
STARS = (60, 120, 200, 400)


@pytest.fixture(scope="module")
def stars() -> StarCatalogue:
    return sc.load_catalogue(7.0, epoch=2016.0)


def lens_of(number: int, rng: np.random.Generator) -> Lens:
    """A lens whose axis is off the middle, every other one with a fifth-order term."""
    field, barrel = FIELDS[number]
    width = (1200, 1600, 3000)[number % 3]
    off = 0.004 * width * rng.standard_normal(2)
    return Lens(
        width, 3 * width // 4, field, barrel, (0.0, 0.2 * barrel)[number % 2], (off[0], off[1])
    )


def rendered(stars: StarCatalogue, number: int, seed: int) -> tuple[Any, Lens, Any, Any]:
    """Centroids of a picture, its lens, and the rows and places of its stars."""
    rng = np.random.default_rng([seed, number])
    lens = lens_of(number, rng)
    rows, places = view(stars, lens, attitude(rng), STARS[number % 4])
    image = Image(picture(lens, places, stars.mag[rows], rng), f"field {number}")
    return extract_centroids(image), lens, rows, places


def wrong_and_right(
    found: Identification, names: Any, places: Any, frame: int = 0
) -> tuple[int, int]:
    """Identified stars of a frame that are not those at their places, and those that are."""
    o = found.observations
    mine = np.flatnonzero(o.frame == frame)
    if not len(mine) or o.star_id is None:
        return 0, 0
    distance = np.hypot(o.x_px[mine, None] - places[:, 0], o.y_px[mine, None] - places[:, 1])
    right = (distance.min(axis=1) < 2.0) & (o.star_id[mine] == names[distance.argmin(axis=1)])
    return int((~right).sum()), int(right.sum())


@pytest.mark.parametrize(
    "number", [1, 11, 19], ids=lambda number: "{} degrees, {:.1%}".format(*FIELDS[number])
)
def test_a_lens_that_bends_needs_no_sheet(stars: StarCatalogue, number: int) -> None:
    """The whole field is identified, and the focal length is that of the middle."""
    table, lens, rows, places = rendered(stars, number, 3)
    found = identify(table, None, stars, cache=False)
    names = stars.star_id[rows]
    wrong, right = wrong_and_right(found, names, places)
    assert wrong == 0
    assert right > 0.9 * table.n_stars
    assert found.camera.focal_px == pytest.approx(lens.focal, rel=1e-3)
    assert found.nominal.focal_px == pytest.approx(lens.focal, rel=1e-3)
    assert found.optics is not None
    assert found.optics.distortion_px == pytest.approx(lens.barrel * lens.corner, rel=0.05)
    # With other names for the same places the count of wrong stars is one of all.
    assert wrong_and_right(found, np.roll(names, 1), places)[0] == right


@pytest.mark.slow
def test_ten_wide_fields(stars: StarCatalogue) -> None:
    """30 to 100 degrees, 0 to 8 % of barrel at the corner: none wrong, one missed at most, and each
    almost filled.
    """
    shares = []
    for number in (0, 1, 4, 5, 8, 9, 12, 13, 16, 19):
        table, _, rows, places = rendered(stars, number, 7)
        found = identify(table, None, stars, cache=False)
        wrong, right = wrong_and_right(found, stars.star_id[rows], places)
        assert wrong == 0, FIELDS[number]
        shares.append(right / table.n_stars)
    assert np.mean(np.array(shares) > 0.8) >= 0.9, shares


def table_of(frames: list[tuple[Any, Any]], lens: Lens, sigma: float) -> Any:
    """Frames of places and magnitudes as what `identify` reads, without a word of the camera but
    its size.
    """
    n = [len(xy) for xy, _ in frames]
    xy = np.concatenate([xy for xy, _ in frames])
    return SimpleNamespace(
        frame=np.repeat(np.arange(len(frames)), n),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        flux=10.0 ** (-0.4 * np.concatenate([mag for _, mag in frames])),
        sigma_px=np.full(len(xy), sigma),
        frame_ids=np.arange(len(frames)),
        image=np.array([f"image {k}" for k in range(len(frames))]),
        time_utc=np.array([""] * len(frames)),
        meta={"optics": {"width_px": lens.width, "height_px": lens.height}},
    )


def measured(
    stars: StarCatalogue, lens: Lens, n: list[int], false: int, sigma: float, seed: int
) -> tuple[Any, Any]:
    """A table of frames with so many stars, and false ones among them, and each frame's names and
    places.
    """
    rng = np.random.default_rng(seed)
    size = np.array([lens.width - 1.0, lens.height - 1.0])
    frames, truth = [], []
    for count in n:
        rows, places = view(stars, lens, attitude(rng), count)
        xy = np.vstack(
            [places + sigma * rng.standard_normal(places.shape), rng.random((false, 2)) * size]
        )
        mag = np.concatenate([stars.mag[rows], rng.choice(stars.mag[rows], false)])
        frames.append((xy, mag + 0.2 * rng.standard_normal(len(mag))))
        truth.append((np.append(stars.star_id[rows], [""] * false), xy))
    return table_of(frames, lens, sigma), truth


@pytest.mark.parametrize("told", [False, True], ids=["no sheet", "a pinhole's sheet"])
def test_what_one_frame_shows_of_the_lens_serves_the_others(
    stars: StarCatalogue, told: bool
) -> None:
    """Nine frames of a webcam of 70 degrees with few stars, and five false ones in each."""
    lens = Lens(1280, 720, 70.0, 0.03, 0.01, (8.0, -5.0))
    table, truth = measured(stars, lens, [11, 24, 9, 13, 14, 21, 22, 8, 15], 5, 0.3, 3)
    sheet = (
        sc.Camera(lens.width, lens.height, 5.0, 5e-3 * lens.focal, 639.5, 359.5) if told else None
    )
    found = identify(table, sheet, stars, cache=False)
    assert found.n_identified >= 8
    counts = [wrong_and_right(found, *frame, k) for k, frame in enumerate(truth)]
    assert sum(wrong for wrong, _ in counts) <= 1
    assert sum(right for _, right in counts) > 0.85 * sum(len(xy) - 5 for _, xy in truth)


@pytest.mark.parametrize("barrel", [0.0, 0.06])
def test_thousands_of_detections(stars: StarCatalogue, barrel: float) -> None:
    """2,600 detections in 60 degrees, a third of them no stars of the catalogue."""
    lens = Lens(3650, 2740, 60.0, barrel)
    table, truth = measured(stars, lens, [1700], 900, 0.2, 5)
    found = identify(table, None, stars, cache=False)
    assert found.n_identified == 1
    wrong, right = wrong_and_right(found, *truth[0])
    assert wrong < 0.002 * right
    assert right > 0.8 * np.count_nonzero(truth[0][0] != "")


@pytest.mark.parametrize("n", [1, 4])
def test_hot_pixels_hide_no_lens_that_was_found(stars: StarCatalogue, n: int) -> None:
    """They are the brightest detections of every frame, so that no triangle of the brightest is one
    of stars.
    """
    lens = Lens(1600, 1200, 60.0, 0.05)
    table, truth = measured(stars, lens, [80] * n, 14, 0.2, 8)
    table.flux[np.concatenate([names for names, _ in truth]) == ""] = table.flux.max()
    found = identify(table, None, stars, cache=False)
    assert found.n_identified == n
    counts = [wrong_and_right(found, *frame, k) for k, frame in enumerate(truth)]
    assert sum(wrong for wrong, _ in counts) == 0
    assert min(right for _, right in counts) > 0.8 * 80


def noise_frames(lens: Lens, n: list[int], seed: int) -> Any:
    rng = np.random.default_rng(seed)
    size = np.array([lens.width - 1.0, lens.height - 1.0])
    return table_of(
        [(rng.random((count, 2)) * size, rng.random(count) * 5.0) for count in n], lens, 0.2
    )


def test_detections_at_random_are_no_wide_field(stars: StarCatalogue) -> None:
    table = noise_frames(Lens(1600, 1200, 60.0), [60, 400], 1)
    found = identify(table, None, stars, cache=False)
    assert found.n_identified == 0
    assert found.optics is None


@pytest.mark.slow
def test_detections_at_random_are_never_a_field(stars: StarCatalogue) -> None:
    """With the focal length of a sheet as without."""
    lens = Lens(1600, 1200, 60.0)
    sheet = sc.Camera(lens.width, lens.height, 5.0, 5e-3 * lens.focal, 799.5, 599.5)
    for n in (30, 1000):
        for camera in (None, sheet):
            found = identify(noise_frames(lens, [n] * 2, n), camera, stars, cache=False)
            assert (found.n_identified, found.optics) == (0, None), (n, camera)
