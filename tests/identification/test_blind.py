"""Cameras that nothing is known of, or something wrong: the stars alone tell the focal length."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import IdentificationError
from starcal_uq.identification import blind
from starcal_uq.identification.blind import codes_of, level_of, make_level, quads_of
from starcal_uq.identification.engine import _Attempt, identify
from starcal_uq.identification.match import Match
from starcal_uq.identification.pairs import angle_between, cached
from starcal_uq.identification.search import NOT_SEARCHED, Search
from starcal_uq.identification.sheet import sheet_of
from starcal_uq.images.centroids import Centroids
from starcal_uq.images.extract import extract_centroids
from starcal_uq.images.image import Image
from starcal_uq.images.optics import optics_of
from starcal_uq.sky.catalogue import StarCatalogue
from starcal_uq.sky.positions import unit_vectors
from tests.identification.test_search import (
    centroid_table,
    random_frames,
    square_camera,
    wrong_rows,
)

# Fields of view in degrees, as plate solvers found them: width over two tangents of half of it.
OPENSTARTRACKER_PX = 1392 / 2 / np.tan(np.radians(6.08 / 2))


@pytest.fixture(scope="module")
def stars() -> StarCatalogue:
    return sc.load_catalogue(7.0, epoch=2019.57)


@pytest.fixture(scope="module")
def esa(real_data: Path) -> Centroids:
    return extract_centroids(real_data / "esa-tetra3")


def check_esa(found: sc.identification.Identification, table: Path) -> None:
    """Every frame, and no star elsewhere than an independent match put it."""
    assert found.n_identified == 8
    with table.open() as file:
        rows = np.array(
            [
                [float(row[c]) for c in ("frame", "x_px", "y_px", "ra_deg", "dec_deg")]
                for row in csv.DictReader(file)
            ]
        )
    o, n = found.observations, 0
    for frame in range(8):
        theirs, mine = rows[rows[:, 0] == frame], np.flatnonzero(o.frame == frame)
        apart = np.hypot(theirs[:, 1, None] - o.x_px[mine], theirs[:, 2, None] - o.y_px[mine])
        near, which = apart.min(axis=1) < 1.0, mine[apart.argmin(axis=1)]
        off = angle_between(
            o.directions_icrs[which[near]], unit_vectors(theirs[near, 3], theirs[near, 4])
        )
        assert np.degrees(off.max()) * 3600.0 < 20.0
        n += int(near.sum())
    assert n > 300
    assert abs(found.camera.focal_px / 5114.3 - 1.0) < 1e-3


def test_real_frames_of_an_unknown_camera(
    esa: Centroids, stars: StarCatalogue, real_data: Path
) -> None:
    found = identify(esa, None, stars)
    check_esa(found, real_data / "esa_tetra3_observations.csv")
    assert found.optics is not None
    assert found.optics.n_frames > 1
    assert found.nominal.focal_px == pytest.approx(found.optics.focal_px)
    assert "The stars alone tell the camera: a field of 11.4 x 8.59 degrees" in found.text
    # The pictures do not state the pitch.
    assert found.nominal.pixel_um is None
    assert "mm" not in found.text


@pytest.mark.parametrize(
    "factor",
    [0.8, pytest.param(1.2, marks=pytest.mark.slow), pytest.param(1.5, marks=pytest.mark.slow)],
)
def test_real_frames_with_a_wrong_sheet(
    esa: Centroids, stars: StarCatalogue, real_data: Path, factor: float
) -> None:
    sheet = sc.Camera.load(real_data / "esa_tetra3_camera.toml")
    found = identify(esa, sheet.replace(focal_mm=factor * sheet.focal_mm), stars)
    check_esa(found, real_data / "esa_tetra3_observations.csv")
    # Pitch and principal point are the sheet's.
    assert found.nominal.pixel_um == sheet.pixel_um
    assert found.nominal.x0_px == sheet.x0_px


@pytest.mark.parametrize(
    "factor",
    [None, pytest.param(0.8, marks=pytest.mark.slow), pytest.param(1.2, marks=pytest.mark.slow)],
)
def test_short_exposures_of_an_unknown_camera(
    stars: StarCatalogue, real_data: Path, factor: float | None
) -> None:
    """All but the frame of five stars, which is named with its reason."""
    table = extract_centroids(real_data / "openstartracker")
    sheet = None
    if factor is not None:
        sheet = sc.Camera(1392, 1040, 6.45, factor * OPENSTARTRACKER_PX * 6.45e-3, 695.5, 519.5)
    found = identify(table, sheet, stars)
    status = {f.image: f.status for f in found.frames}
    assert [name for name, word in status.items() if word != "identified"] == ["img1.png"]
    assert status["img1.png"] == "not identified"
    assert abs(found.camera.focal_px / OPENSTARTRACKER_PX - 1.0) < 2e-3


def test_noise_is_no_camera(esa: Centroids, stars: StarCatalogue) -> None:
    """Stars at random places: nothing is found, whatever the focal length."""
    rng = np.random.default_rng(7)
    few = esa.select(
        np.concatenate([np.arange(n) < 40 for n in esa.stars_per_frame])
    ).select_frames([0, 1, 2])
    n = few.n_stars
    table = replace(few, x_px=1023.0 * rng.random(n), y_px=767.0 * rng.random(n))
    found = identify(table, None, stars)
    assert found.n_identified == 0
    assert found.optics is None


def test_a_code_knows_neither_scale_nor_roll() -> None:
    rng = np.random.default_rng(1)
    xy = rng.normal(size=(8, 2))
    quads = quads_of(np.array([np.roll(np.arange(8), -k) for k in range(8)]))
    assert len(quads) == 70
    codes = []
    for scale, roll in ((1e-4, 0.0), (3e-4, 2.0)):
        turned = (
            scale * xy @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
        )
        rays = np.column_stack([turned, np.ones(8)])
        found, _, size = codes_of(rays / np.linalg.norm(rays, axis=1)[:, None], quads)
        codes.append(found)
        longest = max(np.hypot(*(xy[i] - xy[j])) for i in range(8) for j in range(8))
        assert size.max() == pytest.approx(scale * longest, rel=1e-3)
    np.testing.assert_allclose(codes[0], codes[1], atol=1e-4)
    # A mirror image has another code.
    rays = np.column_stack([-1e-4 * xy[:, 0], 1e-4 * xy[:, 1], np.ones(8)])
    mirrored, _, _ = codes_of(rays / np.linalg.norm(rays, axis=1)[:, None], quads)
    assert np.abs(mirrored - codes[0]).max() > 0.1


def test_what_files_say_of_the_lens(esa: Centroids) -> None:
    assert optics_of({}, 10, 20) == {"width_px": 10, "height_px": 20}
    said = optics_of({"XPIXSZ": 6.9, "FOCALLEN": "35.0"}, 1024, 768)
    assert (said["pixel_um"], said["focal_mm"]) == (6.9, 35.0)
    assert optics_of({"PIXSCALE": 40.0}, 10, 10)["focal_px"] == pytest.approx(5156.6, abs=0.1)
    assert optics_of({"CTYPE1": "RA---TAN", "CDELT1": -0.01}, 10, 10)["focal_px"] == pytest.approx(
        5729.58, abs=0.01
    )
    # 6000 pixels over 36 mm.
    exif = {
        "FocalLength": 50.0,
        "FocalPlaneXResolution": 6000 / 3.6,
        "FocalPlaneResolutionUnit": 3.0,
    }
    assert optics_of(exif, 6000, 4000)["pixel_um"] == pytest.approx(6.0)
    assert optics_of({"FocalLengthIn35mmFilm": 50.0}, 6000, 4000)["focal_px"] == pytest.approx(
        8333, rel=2e-3
    )
    assert "focal_mm" not in optics_of({"FOCALLEN": 0.0, "XPIXSZ": "unknown"}, 10, 10)
    sheet, told = sheet_of(esa.with_meta(optics=said))
    assert told
    assert sheet.focal_mm == pytest.approx(35.0)
    assert not sheet_of(esa)[1]
    with pytest.raises(IdentificationError):
        sheet_of(esa.with_meta(optics={}))


def test_same_stars_at_another_principal_point_are_no_rival(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it is hardly known, attitudes of the same stars differ by degrees; other stars are
    rivals.
    """
    bright = sc.load_catalogue(6.0)
    table, names, _ = random_frames(bright, square_camera(12.0, 1.0, 60.0), 25, 5, 3, 0.1)
    kept = np.isin(table.frame, [6, 20])
    names = names[kept]
    for column in ("frame", "x_px", "y_px", "flux"):
        setattr(table, column, getattr(table, column)[kept])
    # Less than the noise, so that no match is beyond doubt.
    table.sigma_px, table.frame_ids = np.full(kept.sum(), 0.1), np.array([6, 20])
    options: dict[str, Any] = {
        "centre_tolerance_px": 100.0,
        "distortion_tolerance_px": 10.0,
        "share_camera": False,
    }
    found = identify(table, square_camera(12.0), bright, cache_dir=tmp_path, **options)
    assert [f.status for f in found.frames] == ["identified", "identified"]
    assert wrong_rows(found, table, names) == 0
    accepted = Search._accepted

    def with_rival(*arguments: Any) -> Iterator[Match]:
        for match in accepted(*arguments):
            yield match
            yield replace(match, star=match.star + 1)

    monkeypatch.setattr(Search, "_accepted", with_rival)
    # Without further tries of what fails.
    monkeypatch.setattr(_Attempt, "finish", lambda *_, **__: None)
    found = identify(
        table, square_camera(12.0), bright, cache_dir=tmp_path, search_focal=False, **options
    )
    assert [f.status for f in found.frames] == ["ambiguous", "ambiguous"]


WIDTH, HEIGHT, FOCAL = 720, 540, 1624.0


def virgo(
    stars: StarCatalogue, faintest: float, decentring_px: float, seed: int
) -> tuple[Image, Any, Any]:
    """A picture of Virgo, 25 degrees wide, by NumPy alone; the places of its stars and their rows
    of the catalogue.

    A gnomonic projection about a place in the sky, the lens bent by 6 px in the corner and
    decentred, its axis 9 px off the middle; the faintest stars have a signal-to-noise ratio of
    about 12.
    """
    rng = np.random.default_rng(seed)
    ra, dec = np.radians(stars.ra_deg - 195.0), np.radians(stars.dec_deg)
    dec0, roll, corner = np.radians(2.0), np.radians(23.0), 0.5 * np.hypot(WIDTH, HEIGHT)
    depth = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra)
    rows = np.flatnonzero((depth > 0.9) & (stars.mag < faintest))
    ra, dec, depth = ra[rows], dec[rows], depth[rows]
    east = FOCAL / depth * np.cos(dec) * np.sin(ra)
    north = FOCAL / depth * (np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(ra))
    # North is up and east to the left.
    u, v = -(east * np.cos(roll) + north * np.sin(roll)), east * np.sin(roll) - north * np.cos(roll)
    u, v = (w * (1.0 + 6.0 * (u * u + v * v) / corner**3) for w in (u, v))
    u, v = (
        u + decentring_px * (3.0 * u * u + v * v) / corner**2,
        v + decentring_px * 2.0 * u * v / corner**2,
    )
    x, y = 0.5 * (WIDTH - 1) + u, 0.5 * (HEIGHT - 1) - 9.0 + v
    expected = np.full((HEIGHT, WIDTH), 100.0)
    # Light in the middle of nine parts of a pixel along each axis.
    parts = (np.arange(9) - 4.0) / 9.0
    for at_x, at_y, flux in zip(
        x, y, 500.0 * 10.0 ** (-0.4 * (stars.mag[rows] - faintest)), strict=True
    ):
        along, down = (
            np.exp(-0.5 * (np.arange(n)[:, None] + parts - at) ** 2).mean(axis=1)
            for n, at in ((WIDTH, at_x), (HEIGHT, at_y))
        )
        expected += flux / (2.0 * np.pi) * np.outer(down, along)
    counts = rng.poisson(expected) + rng.normal(0.0, 3.0, expected.shape)
    return (
        Image(counts.clip(0.0, 65535.0).astype(np.uint16), "Virgo"),
        np.column_stack([x, y]),
        rows,
    )


def sheet(focal_error: float) -> sc.Camera:
    return sc.Camera(
        WIDTH, HEIGHT, 5.0, 0.005 * FOCAL * focal_error, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)
    )


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(None, id="no sheet"),
        pytest.param(sheet(1.1), id="10 % off", marks=pytest.mark.slow),
    ],
)
def test_virgo_has_a_rival_with_the_same_stars(
    stars: StarCatalogue, camera: sc.Camera | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lens that no model fits: attitudes half a degree apart, with other principal points, name
    the same stars.

    Told apart by their attitudes, they refuse the picture. A lens that is learnt from the middle
    outwards leaves no such freedom, so that the search is done without it.
    """
    for module in ("blind", "engine"):
        monkeypatch.setattr(f"starcal_uq.identification.{module}.grow", lambda *_: None)
    image, places, rows = virgo(stars, 5.6, 5.0, 0)
    met: list[Match] = []
    accepted = Search._accepted

    def seen(*arguments: Any) -> Iterator[Match]:
        for match in accepted(*arguments):
            met.append(match)
            yield match

    monkeypatch.setattr(Search, "_accepted", seen)
    found = identify(extract_centroids(image), camera, stars, cache=False)
    assert [f.status for f in found.frames] == ["identified"]
    apart = [
        np.degrees(angle_between(one.state.rotation[2], other.state.rotation[2]))
        for one, other in combinations(met, 2)
        if len(
            {*zip(one.centroid, one.star, strict=True)}
            & {*zip(other.centroid, other.star, strict=True)}
        )
        == min(len(one), len(other))
    ]
    assert max(apart) > 0.3
    o = found.observations
    distance = np.hypot(o.x_px[:, None] - places[:, 0], o.y_px[:, None] - places[:, 1])
    assert distance.min(axis=1).max() < 1.0
    assert o.star_id.tolist() == stars.star_id[rows[distance.argmin(axis=1)]].tolist()
    assert len(o) > 0.7 * np.count_nonzero(
        np.all((places > 0.0) & (places < (WIDTH, HEIGHT)), axis=1)
    )

    def by_attitude(one: Match, other: Match) -> bool:
        return bool(np.degrees(angle_between(one.state.rotation[2], other.state.rotation[2])) > 0.3)

    monkeypatch.setattr("starcal_uq.identification.search._other_stars", by_attitude)
    refused = identify(extract_centroids(image), camera, stars, cache=False)
    assert refused.n_identified == 0


@pytest.mark.parametrize("faintest", [4.0, 4.3])
def test_a_field_that_two_places_of_the_sky_explain_is_ambiguous(
    stars: StarCatalogue, faintest: float
) -> None:
    """Six stars of Virgo are identified; with the same stars a second time, 120 degrees further on,
    they are not.
    """
    image, *_ = virgo(stars, faintest, 0.0, 1)
    table, camera = extract_centroids(image), sheet(1.02)
    assert [f.status for f in identify(table, camera, stars, cache=False).frames] == ["identified"]
    near = np.abs(stars.dec_deg - 2.0) < 25.0
    here, there = (near & (np.abs(stars.ra_deg - ra) < 25.0) for ra in (195.0, 315.0))
    rows = np.concatenate([np.flatnonzero(~there), np.flatnonzero(here)])
    rows = rows[np.argsort(stars.mag[rows], kind="stable")]
    # The second of each star is the copy.
    copy = np.zeros(len(rows), dtype=np.bool_)
    copy[np.setdiff1d(np.arange(len(rows)), np.unique(rows, return_index=True)[1])] = True
    columns = {
        name: getattr(stars, name)[rows]
        for name in (
            "star_id",
            "ra_deg",
            "dec_deg",
            "mag",
            "pm_ra_mas_yr",
            "pm_dec_mas_yr",
            "has_proper_motion",
        )
    }
    columns["ra_deg"] = columns["ra_deg"] + 120.0 * copy
    columns["star_id"] = np.where(
        copy, np.char.add("copy of ", columns["star_id"]), columns["star_id"]
    )
    found = identify(table, camera, replace(stars, **columns), cache=False)
    assert [f.status for f in found.frames] == ["ambiguous"]
    assert len(found.observations) == 0


def test_failure_is_bounded_in_count(stars: StarCatalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that nothing explains: all triangles of ten frames, few of the others, and no further
    round for all.
    """
    n, looks = 40, []
    table = centroid_table(
        [(np.random.default_rng(k).random((12, 2)) * 700.0, np.ones(12)) for k in range(n)]
    )

    def look(self: Search, field: Any, k: int) -> Any:
        looks.append((k, self.triangles))
        return NOT_SEARCHED

    monkeypatch.setattr(Search, "frame", look)
    monkeypatch.setattr("starcal_uq.identification.engine.find_optics", lambda *_: None)
    found = identify(table, square_camera(20.0), stars, cache=False)
    assert found.n_identified == 0
    # What shows no lens, however it bends, is not looked at once more with a worse one.
    assert [triangles for _, triangles in looks] == [200] * 3 + [40] * 37
    assert {k for k, _ in looks} == set(range(n))


def test_like_patterns_are_those_of_a_comparison_with_all() -> None:
    level = make_level(sc.load_catalogue(4.5).directions_icrs[:150])
    rng = np.random.default_rng(8)
    codes = level.codes[::7] + rng.normal(0.0, 0.004, (len(level.codes[::7]), 4))
    mine, theirs = level.alike(codes, *blind._cells_near(codes))
    apart = np.linalg.norm(codes[:, None] - level.codes[None], axis=2)
    assert np.array_equal(
        np.argwhere(apart < blind._CODE_TOLERANCE), np.column_stack([mine, theirs])
    )
    # Codes without a like one are among them, and codes with several.
    found = np.bincount(mine, minlength=len(codes))
    assert found.min() == 0
    assert found.max() > 1


def test_patterns_are_kept_on_disk_and_damaged_files_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stars, folder = sc.load_catalogue(5.0), tmp_path / "new" / "cache"
    made: list[int] = []

    def counted(directions: Any) -> blind.Level:
        made.append(len(directions))
        return make_level(directions)

    monkeypatch.setattr(blind, "make_level", counted)

    def level(stars: sc.StarCatalogue, folder: Path | None) -> blind.Level:
        blind._made.clear()
        return level_of(stars, 256, folder)

    first = level(stars, folder)
    (path,) = folder.iterdir()
    stored = path.read_bytes()
    again = level(stars, folder)
    assert made == [256]
    assert np.array_equal(first.codes, again.codes) and np.array_equal(first.quads, again.quads)
    # Whole archives, too, whose arrays do not fit together.
    np.savez(tmp_path / "other.npz", **{**vars(first), "size_rad": first.size_rad[1:]})
    other = (tmp_path / "other.npz").read_bytes()
    for number, damage in enumerate((b"", b"no archive", stored[: len(stored) // 2], other)):
        path.write_bytes(damage)
        assert np.array_equal(level(stars, folder).start, first.start)
        assert len(made) == number + 2
        assert path.read_bytes() == stored
    # A file is in the way of the folder: no cache, no error.
    assert np.array_equal(level(stars, path / "below").codes, first.codes)
    # Stars at other places have another file.
    level(replace(stars, ra_deg=stars.ra_deg + 1e-9), folder)
    assert len(list(folder.iterdir())) == 2


def test_several_writers_leave_one_whole_file(tmp_path: Path) -> None:
    level = make_level(sc.load_catalogue(5.0).directions_icrs[:256])
    with ThreadPoolExecutor(6) as pool:
        ends = [
            pool.submit(cached, blind.Level, "patterns", lambda: level, tmp_path) for _ in range(24)
        ]
        assert all(np.array_equal(end.result().codes, level.codes) for end in ends)
    assert [path.name for path in tmp_path.iterdir()] == ["patterns.npz"]
