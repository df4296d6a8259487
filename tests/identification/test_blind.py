"""Cameras that nothing is known of, or something wrong: the stars alone tell the focal length."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import IdentificationError
from starcal_uq.identification.blind import codes_of, quads_of
from starcal_uq.identification.engine import _Attempt, identify, sheet_of
from starcal_uq.identification.match import Match
from starcal_uq.identification.pairs import angle_between
from starcal_uq.identification.search import NOT_SEARCHED, Search
from starcal_uq.images.centroids import Centroids
from starcal_uq.images.extract import extract_centroids
from starcal_uq.images.optics import optics_of
from starcal_uq.sky.catalogue import StarCatalogue
from starcal_uq.sky.positions import unit_vectors
from tests.identification.test_identification import centroid_table, random_frames, square_camera, wrong_rows

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
            [[float(row[c]) for c in ("frame", "x_px", "y_px", "ra_deg", "dec_deg")] for row in csv.DictReader(file)]
        )
    o, n = found.observations, 0
    for frame in range(8):
        theirs, mine = rows[rows[:, 0] == frame], np.flatnonzero(o.frame == frame)
        apart = np.hypot(theirs[:, 1, None] - o.x_px[mine], theirs[:, 2, None] - o.y_px[mine])
        near, which = apart.min(axis=1) < 1.0, mine[apart.argmin(axis=1)]
        off = angle_between(o.directions_icrs[which[near]], unit_vectors(theirs[near, 3], theirs[near, 4]))
        assert np.degrees(off.max()) * 3600.0 < 20.0
        n += int(near.sum())
    assert n > 300
    assert abs(found.camera.focal_px / 5114.3 - 1.0) < 1e-3


def test_real_frames_of_an_unknown_camera(esa: Centroids, stars: StarCatalogue, real_data: Path) -> None:
    found = identify(esa, None, stars)
    check_esa(found, real_data / "esa_tetra3_observations.csv")
    assert found.optics is not None
    assert found.optics.n_frames > 1
    assert found.nominal.focal_px == pytest.approx(found.optics.focal_px)
    assert "The stars alone tell the camera: a field of 11.4 x 8.59 degrees" in found.text
    assert "pixel pitch assumed" in found.nominal.name


@pytest.mark.parametrize(
    "factor", [0.8, pytest.param(1.2, marks=pytest.mark.slow), pytest.param(1.5, marks=pytest.mark.slow)]
)
def test_real_frames_with_a_wrong_sheet(esa: Centroids, stars: StarCatalogue, real_data: Path, factor: float) -> None:
    sheet = sc.Camera.load(real_data / "esa_tetra3_camera.toml")
    found = identify(esa, sheet.replace(focal_mm=factor * sheet.focal_mm), stars)
    check_esa(found, real_data / "esa_tetra3_observations.csv")
    # Pitch and principal point are the sheet's.
    assert found.nominal.pixel_um == sheet.pixel_um
    assert found.nominal.x0_px == sheet.x0_px


@pytest.mark.parametrize(
    "factor", [None, pytest.param(0.8, marks=pytest.mark.slow), pytest.param(1.2, marks=pytest.mark.slow)]
)
def test_short_exposures_of_an_unknown_camera(stars: StarCatalogue, real_data: Path, factor: float | None) -> None:
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
    few = esa.select(np.concatenate([np.arange(n) < 40 for n in esa.stars_per_frame])).select_frames([0, 1, 2])
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
        turned = scale * xy @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
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
    assert optics_of({"CTYPE1": "RA---TAN", "CDELT1": -0.01}, 10, 10)["focal_px"] == pytest.approx(5729.58, abs=0.01)
    # 6000 pixels over 36 mm.
    exif = {"FocalLength": 50.0, "FocalPlaneXResolution": 6000 / 3.6, "FocalPlaneResolutionUnit": 3.0}
    assert optics_of(exif, 6000, 4000)["pixel_um"] == pytest.approx(6.0)
    assert optics_of({"FocalLengthIn35mmFilm": 50.0}, 6000, 4000)["focal_px"] == pytest.approx(8333, rel=2e-3)
    assert "focal_mm" not in optics_of({"FOCALLEN": 0.0, "XPIXSZ": "unknown"}, 10, 10)
    sheet, told = sheet_of(esa.with_meta(optics=said))
    assert told
    assert sheet.focal_mm == pytest.approx(35.0)
    assert not sheet_of(esa)[1]
    with pytest.raises(IdentificationError, match="do not say the size"):
        sheet_of(esa.with_meta(optics={}))


def test_same_stars_at_another_principal_point_are_no_rival(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is hardly known, attitudes of the same stars differ by degrees; other stars are rivals."""
    bright = sc.load_catalogue(6.0)
    table, names, _ = random_frames(bright, square_camera(12.0, 1.0, 60.0), 25, 5, 3, 0.1)
    kept = np.isin(table.frame, [6, 20])
    names = names[kept]
    for column in ("frame", "x_px", "y_px", "flux"):
        setattr(table, column, getattr(table, column)[kept])
    # Less than the noise, so that no match is beyond doubt.
    table.sigma_px, table.frame_ids = np.full(kept.sum(), 0.1), np.array([6, 20])
    options: dict[str, Any] = {"centre_tolerance_px": 100.0, "distortion_tolerance_px": 10.0, "share_camera": False}
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
    found = identify(table, square_camera(12.0), bright, cache_dir=tmp_path, search_focal=False, **options)
    assert [f.status for f in found.frames] == ["ambiguous", "ambiguous"]


def test_failure_is_bounded_in_count(stars: StarCatalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that nothing explains: all triangles of ten frames, few of the others, and no further round for all."""
    n, looks = 40, []
    table = centroid_table([(np.random.default_rng(k).random((12, 2)) * 700.0, np.ones(12)) for k in range(n)])

    def look(self: Search, field: Any, k: int) -> Any:
        looks.append((k, self.triangles))
        return NOT_SEARCHED

    monkeypatch.setattr(Search, "frame", look)
    monkeypatch.setattr("starcal_uq.identification.engine.find_optics", lambda *_: None)
    found = identify(table, square_camera(20.0), stars, cache=False)
    assert found.n_identified == 0
    # The last ten are with a worse lens.
    assert [triangles for _, triangles in looks] == [200] * 3 + [40] * 37 + [60] * 10
    assert {k for k, _ in looks} == set(range(n))
