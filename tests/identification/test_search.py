"""Star identification: rates on random frames, controls that must find nothing, and real frames."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import quaternion_to_rotation, random_rotations
from starcal_uq.camera.projection import unproject
from starcal_uq.core.errors import IdentificationError, SettingError
from starcal_uq.identification import match as matching
from starcal_uq.identification import proposers, search
from starcal_uq.identification.brightness import instrumental_mag, unlike_brightness
from starcal_uq.identification.engine import identify
from starcal_uq.identification.pairs import (
    angle_between,
    cached_star_pairs,
    find_star_pairs,
)
from starcal_uq.identification.pyramid import (
    CameraTolerance,
    first_order,
    mortari_order,
    remaining_order,
)
from starcal_uq.identification.sheet import calibrated_tolerance
from starcal_uq.images.extract import extract_centroids
from starcal_uq.simulation.frames import Sky
from starcal_uq.sky.positions import ra_dec_deg

SIGMA = 0.3
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def square_camera(
    fov_deg: float, focal: float = 1.0, shift_px: float = 0.0, **changes: Any
) -> sc.Camera:
    focal_px = focal * 512.0 / np.tan(np.radians(fov_deg / 2.0))
    return sc.Camera(
        1024, 1024, 10.0, focal_px / 100.0, 511.5 + shift_px, 511.5 + shift_px, **changes
    )


def centroid_table(frames: list[tuple[Any, Any]], sigma_px: float = SIGMA) -> Any:
    """Frames of (xy, flux) as what `identify` reads."""
    n = [len(xy) for xy, _ in frames]
    xy = np.concatenate([np.reshape(xy, (-1, 2)) for xy, _ in frames])
    return SimpleNamespace(
        frame=np.repeat(np.arange(len(frames)), n),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        flux=np.concatenate([np.reshape(flux, -1) for _, flux in frames]),
        sigma_px=np.full(len(xy), sigma_px),
        frame_ids=np.arange(len(frames)),
        image=np.array([f"image {k}" for k in range(len(frames))]),
        time_utc=np.array([""] * len(frames)),
    )


def random_frames(
    stars: Any, camera: sc.Camera, n: int, seed: int, false: int = 0, missing: float = 0.0
) -> tuple[Any, Any, Any]:
    """A table, the name of the star of each row (empty for a false one), and the rotations."""
    rng = np.random.default_rng(seed)
    rotations = random_rotations(n, rng)
    frames, names = [], []
    for star, xy in Sky(stars, camera, 2.0).views(rotations):
        seen = rng.random(len(star)) >= missing
        star, xy = star[seen], xy[seen]
        xy = np.vstack(
            [xy + SIGMA * rng.standard_normal(xy.shape), rng.random((false, 2)) * 1023.0]
        )
        mag = stars.mag[star] + 0.2 * rng.standard_normal(len(star))
        frames.append((xy, 10.0 ** (-0.4 * np.concatenate([mag, rng.choice(stars.mag, false)]))))
        names += [*stars.star_id[star], *[""] * false]
    return centroid_table(frames), np.array(names), rotations


def wrong_rows(found: Any, table: Any, names: Any) -> int:
    """Identified stars that are not what they should be."""
    truth = dict(zip(zip(table.frame, table.x_px, strict=True), names, strict=True))
    o = found.observations
    if not len(o):
        return 0
    return sum(truth[f, x] != name for f, x, name in zip(o.frame, o.x_px, o.star_id, strict=True))


@pytest.fixture(scope="module")
def stars() -> Any:
    return sc.load_catalogue(6.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("fov_deg", [12.0, 20.0])
@pytest.mark.parametrize(("focal", "shift_px"), [(1.0, 0.0), (0.97, 20.0)])
def test_random_frames_are_identified(
    stars: Any, folder: Path, fov_deg: float, focal: float, shift_px: float
) -> None:
    table, names, rotations = random_frames(stars, square_camera(fov_deg, focal, shift_px), 60, 1)
    found = identify(table, square_camera(fov_deg), stars, share_camera=False, cache_dir=folder)
    assert found.n_identified == 60, found.text
    assert wrong_rows(found, table, names) == 0
    assert len(found.observations) > 0.95 * len(names)
    # The largest accepted expectation of a wrong attitude is far below one.
    assert all(frame.log10_expected_false < -4.0 for frame in found.frames)
    # Where the middle of the detector points; the attitude by itself is only known together with
    # the principal point.
    middle = np.array([[511.5, 511.5]])
    seen = unproject(found.camera, middle)[0]
    true = unproject(square_camera(fov_deg, focal, shift_px), middle)[0]
    for frame, rotation in zip(found.frames, rotations, strict=True):
        assert (
            angle_between(seen @ quaternion_to_rotation(frame.quaternion), true @ rotation) < 2e-4
        )
    assert abs(found.camera.focal_px / square_camera(fov_deg, focal).focal_px - 1.0) < 2e-4


@pytest.mark.parametrize(("fov_deg", "max_mag"), [(5.0, 7.5), (30.0, 5.5)])
def test_narrow_and_wide_fields(folder: Path, fov_deg: float, max_mag: float) -> None:
    stars = sc.load_catalogue(max_mag)
    table, names, _ = random_frames(stars, square_camera(fov_deg, 1.03, -20.0), 15, 13)
    found = identify(table, square_camera(fov_deg), stars, cache_dir=folder)
    assert found.n_identified == 15
    assert wrong_rows(found, table, names) == 0


def test_stops_at_the_first_good_match_and_looks_before_it_matches(
    stars: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counts of work: attitudes matched, and the fits that they took."""
    calls: Counter[str] = Counter()

    def counted(name: str, original: Any) -> Any:
        def call(*values: Any, **options: Any) -> Any:
            calls[name] += 1
            return original(*values, **options)

        return call

    for module, name in ((search, "match_frame"), (matching, "_fit")):
        monkeypatch.setattr(module, name, counted(name, getattr(module, name)))
    # Half of the centroids are too faint for the catalogue, which is no reason to look on.
    bright = stars.select(stars.mag < 5.2)
    table, _, _ = random_frames(stars, square_camera(20.0, 0.98, 10.0), 10, 6)
    assert (
        identify(
            table, square_camera(20.0), bright, share_camera=False, cache_dir=folder
        ).n_identified
        == 10
    )
    assert calls["match_frame"] < 3 * 10
    calls.clear()
    table, _, _ = random_frames(stars, square_camera(12.0), 2, 7)
    table.x_px = np.random.default_rng(8).random(len(table.x_px)) * 1023.0
    assert (
        identify(
            table, square_camera(12.0), stars, share_camera=False, cache_dir=folder
        ).n_identified
        == 0
    )
    # Four fits each where every one is matched; most are seen to be wrong before the first.
    assert calls["match_frame"] > 100 and calls["_fit"] < calls["match_frame"]


def test_false_and_missing_stars(stars: Any, folder: Path) -> None:
    table, names, _ = random_frames(stars, square_camera(12.0), 60, 2, false=10, missing=0.3)
    found = identify(table, square_camera(12.0), stars, cache_dir=folder)
    assert found.n_identified >= 58
    assert wrong_rows(found, table, names) <= 1


@pytest.fixture(scope="module")
def disturbed(stars: Any) -> tuple[Any, Any]:
    """Frames in which a false star lies beside the place of a missing one, at 2.5 sigma, and the
    rows of these.
    """
    table, *_ = random_frames(stars, square_camera(12.0), 40, 14)
    rows = np.array([np.flatnonzero(table.frame == k)[7] for k in range(40)])
    angle = np.random.default_rng(15).random(40) * 2.0 * np.pi
    table.x_px[rows] += 2.5 * SIGMA * np.cos(angle)
    table.y_px[rows] += 2.5 * SIGMA * np.sin(angle)
    return table, rows


def refused_stars(table: Any, rows: Any, found: Any) -> tuple[int, int]:
    """Planted rows that are identified, and how many matches were given up for their brightness."""
    o = found.observations
    used = set(zip(o.frame.tolist(), o.x_px.tolist(), strict=True))
    kept = sum(
        (f, x) in used
        for f, x in zip(table.frame[rows].tolist(), table.x_px[rows].tolist(), strict=True)
    )
    return kept, sum(frame.n_unlike_brightness for frame in found.frames)


@pytest.mark.parametrize("gain", [1.0, 3e4])
def test_false_stars_are_known_by_their_brightness(
    stars: Any, folder: Path, disturbed: tuple[Any, Any], gain: float
) -> None:
    """Faint false stars beside the places of brighter ones are refused; those of the right
    brightness cannot be.
    """
    table, rows = disturbed
    like = SimpleNamespace(**vars(table) | {"flux": gain * table.flux})
    kept, unlike = refused_stars(
        like, rows, identify(like, square_camera(12.0), stars, cache_dir=folder)
    )
    assert kept >= 20
    assert unlike <= 4
    flux = gain * table.flux
    flux[rows] *= 10.0 ** (-0.4 * 1.5)
    faint = SimpleNamespace(**vars(table) | {"flux": flux})
    found = identify(faint, square_camera(12.0), stars, cache_dir=folder)
    assert refused_stars(faint, rows, found)[0] <= kept // 3
    assert refused_stars(faint, rows, found)[1] >= 12
    assert found.n_identified == 40
    assert "brightness is unlike" in found.text
    # Where all fluxes are equal they say nothing.
    flat = SimpleNamespace(**vars(table) | {"flux": np.ones(len(flux))})
    assert (
        refused_stars(flat, rows, identify(flat, square_camera(12.0), stars, cache_dir=folder))[1]
        == 0
    )


def test_brightness_is_only_a_second_opinion() -> None:
    """Variable, saturated and few stars stay; what is far from its place or much too bright does
    not.
    """
    rng = np.random.default_rng(16)
    difference, misfit = 7.0 + 0.2 * rng.standard_normal(30), np.full(30, 1.0)
    difference[0], difference[1], misfit[1], difference[2], misfit[2] = 8.5, 8.5, 10.0, 3.5, 0.0
    assert np.flatnonzero(unlike_brightness(difference, misfit)).tolist() == [1, 2]
    saturated = np.where(difference > 8.0, np.nan, difference)
    assert np.flatnonzero(unlike_brightness(saturated, misfit)).tolist() == [2]
    # A gain, and a frame whose brightness is only known to half a magnitude.
    assert np.array_equal(
        unlike_brightness(difference + 4.0, misfit), unlike_brightness(difference, misfit)
    )
    assert not unlike_brightness(7.0 + 0.6 * rng.standard_normal(30), np.full(30, 3.0)).any()
    assert not unlike_brightness(difference[:5], misfit[:5]).any()
    assert instrumental_mag(np.full(9, 3.0)) is None
    assert instrumental_mag(np.empty(0)) is None
    found = instrumental_mag(np.array([100.0, 1.0, 0.0, -2.0, np.nan]))
    assert found is not None
    assert found[:2].tolist() == [-5.0, 0.0] and np.isnan(found[2:]).all()


def test_taste_follows_chi_square(stars: Any, folder: Path) -> None:
    """With the stated noise the p-values are uniform; with half of it they are not."""
    table, *_ = random_frames(stars, square_camera(12.0, 1.01), 40, 3)
    p = [
        f.taste_p_value
        for f in identify(table, square_camera(12.0), stars, cache_dir=folder).frames
    ]
    assert 0.35 < np.mean(p) < 0.7
    assert np.mean(np.array(p) < 0.01) < 0.06
    table.sigma_px = table.sigma_px / 2.0
    low = [
        f.taste_p_value
        for f in identify(table, square_camera(12.0), stars, cache_dir=folder).frames
    ]
    assert np.nanmedian(low) < 1e-3


def test_frames_without_a_solution(stars: Any, folder: Path) -> None:
    """Random points, empty frames and frames of three stars get a word, and nothing is
    identified.
    """
    rng = np.random.default_rng(4)
    frames = [(rng.random((n, 2)) * 1023.0, rng.random(n)) for n in (0, 3, 4, 6, 9, 14, 25)]
    found = identify(centroid_table(frames), square_camera(12.0), stars, cache_dir=folder)
    assert [f.status for f in found.frames] == ["too few stars"] * 2 + ["not identified"] * 5
    assert len(found.observations) == 0
    assert found.n_identified == 0
    assert "0 of 7 frames" in found.text and "fewer than four" in found.text
    assert found.camera == square_camera(12.0)
    assert len(found.to_dataframe()) == 7


def test_another_sky_is_not_identified(stars: Any, folder: Path) -> None:
    """With the stars of the catalogue shuffled nothing fits; a turned catalogue gives a turned
    attitude.
    """
    table, *_ = random_frames(stars, square_camera(12.0), 3, 5)
    rng = np.random.default_rng(6)
    directions = rng.standard_normal((len(stars), 3))
    ra, dec = ra_dec_deg(directions)
    shuffled = replace(stars, ra_deg=ra, dec_deg=dec)
    assert identify(table, square_camera(12.0), shuffled, cache_dir=folder).n_identified == 0
    straight = identify(table, square_camera(12.0), stars, cache_dir=folder)
    turned = identify(
        table,
        square_camera(12.0),
        replace(stars, ra_deg=(stars.ra_deg + 90.0) % 360.0),
        cache_dir=folder,
    )
    assert straight.n_identified == turned.n_identified == 3
    assert np.array_equal(straight.observations.star_id, turned.observations.star_id)


def test_good_frames_go_on_among_bad_ones(stars: Any, folder: Path) -> None:
    """Results do not depend on the order of the rows or on frames that hold nothing."""
    table, names, _ = random_frames(stars, square_camera(12.0), 3, 7)
    rng = np.random.default_rng(8)
    order = rng.permutation(len(table.frame))
    mixed = SimpleNamespace(**vars(table))
    for name in ("frame", "x_px", "y_px", "flux", "sigma_px"):
        setattr(mixed, name, getattr(table, name)[order])
    mixed.frame = mixed.frame * 2
    mixed.frame_ids = np.arange(6)
    mixed.image, mixed.time_utc = np.repeat(table.image, 2), np.repeat(table.time_utc, 2)
    found = identify(mixed, square_camera(12.0), stars, cache_dir=folder)
    assert [f.status for f in found.frames] == ["identified", "too few stars"] * 3
    plain = identify(table, square_camera(12.0), stars, cache_dir=folder)
    assert np.array_equal(found.observations.star_id, plain.observations.star_id)
    assert np.array_equal(found.observations.frame, 2 * plain.observations.frame)
    assert wrong_rows(plain, table, names) == 0


def test_frames_of_two_cameras_are_all_found(stars: Any, folder: Path) -> None:
    """The first frames narrow the search for the others, which may be of another camera."""
    frames = []
    for seed, focal in enumerate((1.0, 1.02)):
        table, *_ = random_frames(stars, square_camera(12.0, focal), 6, seed)
        xy = np.column_stack([table.x_px, table.y_px])
        frames += [(xy[table.frame == k], table.flux[table.frame == k]) for k in range(6)]
    found = identify(centroid_table(frames), square_camera(12.0), stars, cache_dir=folder)
    assert found.n_identified == 12


def test_mirrored_images(stars: Any, folder: Path) -> None:
    camera = square_camera(12.0, shift_px=8.0)
    table, *_ = random_frames(stars, camera, 3, 9)
    plain = identify(table, camera, stars, cache_dir=folder)
    table.x_px = 1023.0 - table.x_px
    mirrored = identify(table, camera.replace(x0_px=1023.0 - camera.x0_px), stars, cache_dir=folder)
    assert (plain.parity, mirrored.parity) == ("normal", "mirrored")
    assert np.array_equal(plain.observations.star_id, mirrored.observations.star_id)
    assert np.allclose(plain.observations.x_px, mirrored.observations.x_px)
    assert "mirror" in mirrored.text and "mirror" not in plain.text


def test_deep_catalogue_and_distortion(folder: Path) -> None:
    """A catalogue of many more stars than the sensor sees, and 3 px of distortion at the corner."""
    sensor, deep = sc.load_catalogue(6.5), sc.load_catalogue(8.0)
    camera = square_camera(12.0, 1.02, 10.0, coefficients=(3.0 / 724.0**3, 0.0))
    table, names, _ = random_frames(sensor, camera, 12, 10)
    found = identify(table, square_camera(12.0), deep, cache_dir=folder)
    assert found.n_identified == 12
    assert wrong_rows(found, table, names) == 0
    corner_px = found.camera.coefficients[0] * 724.0**3
    assert abs(corner_px - 3.0) < 0.5


def test_calibrated_camera_identifies_more(stars: Any, folder: Path) -> None:
    """Frames of four or five stars are only certain when the focal length is."""
    camera = square_camera(8.0)
    table, names, _ = random_frames(stars, camera, 250, 11)
    counts = np.bincount(table.frame, minlength=250)
    few = np.isin(table.frame, np.flatnonzero((counts == 4) | (counts == 5)))
    for name in ("frame", "x_px", "y_px", "flux", "sigma_px"):
        setattr(table, name, getattr(table, name)[few])
    sd = np.array([0.5, 0.5, 0.2, 1e-11, 1e-17])
    known: Any = SimpleNamespace(camera=camera, covariance=np.diag(sd**2))
    tolerance = calibrated_tolerance(known, CameraTolerance(0.03, 20.0, 1.0))
    assert tolerance.focal == pytest.approx(0.8 / camera.focal_px)
    assert tolerance.centre_px == pytest.approx(2.0)
    assert tolerance.distortion_px < 0.1
    wide = identify(table, camera, stars, share_camera=False, cache_dir=folder)
    narrow = identify(table, camera, stars, share_camera=False, calibration=known, cache_dir=folder)
    assert narrow.n_identified >= wide.n_identified > 0
    assert wrong_rows(narrow, table, names[few]) == 0
    assert wrong_rows(wide, table, names[few]) == 0
    gain = [
        w.log10_expected_false - n.log10_expected_false
        for w, n in zip(wide.frames, narrow.frames, strict=True)
        if w.status == n.status == "identified"
    ]
    assert np.median(gain) > 0.5


def test_pairs_are_complete_and_cached(tmp_path: Path) -> None:
    stars = sc.load_catalogue(4.5)
    directions, mag = stars.directions_icrs, stars.mag
    pairs = find_star_pairs(directions, mag, 0.04, 0.2)
    a = pairs.directions
    angles = angle_between(a[:, None], a[None])
    expected = np.argwhere(np.triu(angles < 0.2, 1))
    assert len(pairs.angle) == len(expected)
    assert np.all(np.diff(pairs.angle) >= 0.0)
    stars_asked = np.repeat(np.arange(len(pairs)), 3)
    asked = np.tile([0.0005, 0.1, 0.1999], len(pairs))
    question, partner = pairs.near_angle(stars_asked, asked, 1e-3)
    hits = np.abs(angles[stars_asked] - asked[:, None]) <= 1e-3
    hits[np.arange(len(stars_asked)), stars_asked] = False
    hits &= angles[stars_asked] < 0.2
    assert sorted(zip(question.tolist(), partner.tolist(), strict=True)) == [
        tuple(x) for x in np.argwhere(hits)
    ]

    folder = tmp_path / "new" / "cache"
    first = cached_star_pairs(directions, mag, 0.04, 0.2, folder)
    (path,) = folder.iterdir()
    stored = path.read_bytes()
    again = cached_star_pairs(directions, mag, 0.04, 0.2, folder)
    assert np.array_equal(first.neighbour, again.neighbour)
    for damage in (b"", b"no archive", stored[: len(stored) // 2]):
        path.write_bytes(damage)
        mended = cached_star_pairs(directions, mag, 0.04, 0.2, folder)
        assert np.array_equal(first.neighbour_angle, mended.neighbour_angle)
        assert path.read_bytes()[:2] == b"PK"
    # A file is in the way of the folder: no cache, no error.
    assert len(cached_star_pairs(directions, mag, 0.04, 0.2, path / "below")) == len(first)
    # Another catalogue has another file.
    cached_star_pairs(directions, mag + 1e-9, 0.04, 0.2, folder)
    assert len(list(folder.iterdir())) == 2


def test_triangles_do_not_stay_with_one_star() -> None:
    order = mortari_order(8)
    assert len({tuple(t) for t in order.tolist()}) == 56
    assert np.all(np.diff(order, axis=1) > 0)
    # Six triangles in, no star has been in all of them, so that one false star cannot stall the
    # search.
    assert np.bincount(order[:6].ravel()).max() <= 3


def test_triangles_left_after_a_first_search() -> None:
    """Every five stars hold a triangle of the first or of the second search, and none is in
    both.
    """
    first, left = (
        {tuple(t) for t in order.tolist()}
        for order in (first_order(10, True), remaining_order(16, 10))
    )
    assert len(first) + len(left) < 170
    assert not first & left
    for five in combinations(range(16), 5):
        assert any(three in left or three in first for three in combinations(five, 3))
    assert len(first_order(10, False)) == 120


def offer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a package installed that offers the engine tetra3rs."""
    offered = EntryPoint("tetra3rs", "tests.helpers.plate_solver:PlateSolver", proposers.GROUP)
    monkeypatch.setattr("importlib.metadata.entry_points", EntryPoints([offered]).select)


@pytest.mark.parametrize(("fov_deg", "focal", "shift_px"), [(20.0, 0.97, -20.0)])
def test_engines_agree(
    stars: Any,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    fov_deg: float,
    focal: float,
    shift_px: float,
) -> None:
    """tetra3rs, offered by an entry point, finds other patterns, and the same stars come out."""
    pytest.importorskip("tetra3rs", reason="the extra `tetra3rs` is not installed")
    offer(monkeypatch)
    table, names, _ = random_frames(stars, square_camera(fov_deg, focal, shift_px), 12, 17)
    ours, theirs = (
        identify(table, square_camera(fov_deg), stars, engine=engine, cache_dir=folder)
        for engine in ("pyramid", "tetra3rs")
    )
    assert ours.n_identified == theirs.n_identified == 12
    assert np.array_equal(ours.observations.frame, theirs.observations.frame)
    assert np.array_equal(ours.observations.star_id, theirs.observations.star_id)
    assert np.array_equal(ours.observations.x_px, theirs.observations.x_px)
    assert wrong_rows(theirs, table, names) == 0
    for a, b in zip(ours.frames, theirs.frames, strict=True):
        assert np.allclose(a.quaternion, b.quaternion, atol=1e-7)
    assert abs(ours.camera.focal_px / theirs.camera.focal_px - 1.0) < 1e-7
    table.x_px = 1023.0 - table.x_px
    assert identify(table, square_camera(fov_deg), stars, engine="tetra3rs").parity == "mirrored"
    rng = np.random.default_rng(18)
    nothing = centroid_table([(rng.random((12, 2)) * 1023.0, rng.random(12)) for _ in range(3)])
    assert identify(nothing, square_camera(fov_deg), stars, engine="tetra3rs").n_identified == 0


def test_engine_that_is_not_there(stars: Any) -> None:
    table, *_ = random_frames(stars, square_camera(12.0), 1, 12)
    with pytest.raises(IdentificationError):
        identify(table, square_camera(12.0), stars, engine="astrometry")


def test_bad_input(stars: Any, folder: Path) -> None:
    table, *_ = random_frames(stars, square_camera(12.0), 1, 12)
    with pytest.raises(SettingError):
        identify(table, square_camera(12.0), stars, focal_tolerance=0.0)
    with pytest.raises(IdentificationError):
        identify(table, square_camera(12.0), stars.select(np.arange(10)))
    small = sc.Camera(512, 512, 10.0, 50.0, 255.5, 255.5)
    with pytest.raises(IdentificationError):
        identify(table, small, stars)
    table.sigma_px = np.full(len(table.frame), np.nan)
    with pytest.raises(IdentificationError):
        identify(table, square_camera(12.0), stars)


def test_brightness_of_real_frames(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another band, saturated and variable stars: no star of the table is refused, and two of a
    thousand at most.
    """
    images = sorted((DATA / "esa-tetra3").glob("*.tiff"))
    if not images:
        pytest.skip("the real frames are not there (../shared/data)")
    nominal = sc.Camera.load(DATA / "esa_tetra3_camera.toml")
    table = extract_centroids(images, camera=nominal)
    stars = sc.load_catalogue(8.0, epoch=2019.57)
    found = identify(table, nominal, stars, cache_dir=folder)
    assert found.n_identified == 8
    assert sum(f.n_unlike_brightness for f in found.frames) <= 0.002 * len(found.observations)
    monkeypatch.setattr(
        matching, "unlike_brightness", lambda difference, misfit: np.zeros(len(misfit), dtype=bool)
    )
    every = identify(table, nominal, stars, cache_dir=folder).observations
    o = found.observations
    kept = set(zip(o.frame.tolist(), o.star_id.tolist(), strict=True))
    refused = [
        i
        for i, key in enumerate(zip(every.frame.tolist(), every.star_id.tolist(), strict=True))
        if key not in kept
    ]
    with (DATA / "esa_tetra3_observations.csv").open() as file:
        rows = [
            (int(row["frame"]), float(row["x_px"]), float(row["y_px"]))
            for row in csv.DictReader(file)
        ]
    frame, x, y = np.array(rows).T
    for i in refused:
        assert np.hypot(x - every.x_px[i], y - every.y_px[i])[frame == every.frame[i]].min() > 3.0
