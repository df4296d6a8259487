"""Frames of a run from images: every detection and every star is what it is said to be, and the
page shows them.
"""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import starcal_uq as sc
from starcal_uq.attitude.rotations import (
    exp_rotation,
    quaternion_to_rotation,
    rotation_to_quaternion,
)
from starcal_uq.camera.projection import project
from starcal_uq.images.centroids import COLUMNS, Centroids
from starcal_uq.pipeline.inspection import IDENTIFIED, LEFT_OUT, NOT_MATCHED, Frames
from starcal_uq.pipeline.record import ImageRecord, ImageRow, RoundRecord
from starcal_uq.presentation.pages.gallery import gallery, labelled, picture, write_frames
from starcal_uq.sky.names import proper_name, short_name
from starcal_uq.sky.positions import unit_vectors

N = 20
DARK, STRANGE = N, N + 1
STRANGE_NAME = '<script>alert("1")</script>.fits'


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """Twenty simulated frames with a false detection each, from the second of which the brightest
    star is missing.

    The last star of the first frame was left out; two more frames failed.
    """
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    every = sc.simulate(stars, sc.paper.paper_camera(), n_frames=N, seed=1)
    assert every.mag is not None
    last = np.flatnonzero(every.frame == 0)[-1]
    second = np.flatnonzero(every.frame == 1)
    missing = second[np.argmin(every.mag[second])]
    kept = np.arange(len(every)) != missing
    matched = every.select(kept).with_meta(epoch=2026.9, max_mag=6.0)
    obs = every.select(kept & (np.arange(len(every)) != last)).with_meta(epoch=2026.9)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    rng = np.random.default_rng(1)
    false = [(k, *rng.uniform(100.0, 900.0, 2)) for k in [*range(N), DARK, *[STRANGE] * 12]]
    rows = np.concatenate([np.column_stack([matched.frame, matched.xy]), false])
    plain = {name: np.full(len(rows), kind(0)) for name, (kind, _) in COLUMNS.items()}
    plain |= {"frame": rows[:, 0].astype(int), "x_px": rows[:, 1], "y_px": rows[:, 2]}
    names = [f"{k}.png" for k in range(N)] + ["dark.png", STRANGE_NAME]
    centroids = Centroids(
        **plain,
        frame_ids=np.arange(N + 2),
        image=names,
        time_utc=[""] * (N + 2),
        background=np.zeros(N + 2),
        noise=np.ones(N + 2),
        psf_sigma_px=np.full(N + 2, 0.8),
        problem=[""] * (N + 2),
    )
    outcomes = ["identified"] * N + ["too few stars", "not identified"]
    found = np.bincount(matched.frame, minlength=N + 2).tolist()
    record = ImageRecord(
        (RoundRecord(N, len(obs), 0, 0, {}, "sigma", 0.05),),
        tuple(
            ImageRow(k, names[k], "", int(n), outcomes[k], found[k], found[k])
            for k, n in enumerate(centroids.stars_per_frame)
        ),
        0,
        "normal",
    )
    folder = tmp_path_factory.mktemp("images")
    camera = cal.camera
    pixels = (
        np.random.default_rng(2)
        .normal(100.0, 3.0, (camera.height_px, camera.width_px))
        .clip(0, 255)
    )
    Image.fromarray(pixels.astype(np.uint8)).save(folder / "0.png")
    return Frames(
        "run",
        record,
        centroids,
        matched,
        obs,
        cal.residuals_px,
        camera,
        dict(zip(cal.frame_ids.tolist(), cal.quaternions, strict=True)),
        seconds={0: 0.0123},
        images=(folder,),
    )


def test_every_detection_and_every_star_is_what_it_was_made(frames: Frames) -> None:
    first, second = frames[0], frames["1.png"]
    assert (first.n(LEFT_OUT), first.n(NOT_MATCHED), first.n("missed")) == (1, 1, 0)
    assert first.n(IDENTIFIED) + first.n(LEFT_OUT) == first.row.n_last
    for row, frame in zip(frames.record.rows, frames, strict=True):
        assert len(frame.detections) == row.n_centroids
        assert frame.n(IDENTIFIED) + frame.n(LEFT_OUT) == row.n_last
        assert set(frame.detections.loc[frame.detections["kind"] == NOT_MATCHED, "reason"]) <= {
            "at no star of the catalogue",
            "fainter than the stars searched for",
            "",
        }
    # The star that was taken away, where the camera would have it.
    assert second.n("missed") == 1
    missed = second.stars[second.stars["missed"]].iloc[0]
    assert missed["mag"] == pytest.approx(second.stars["mag"].min())
    # To the limit of the simulation, and not beyond.
    assert 5.0 < first.limit_mag <= 6.0
    assert first.rms_px == pytest.approx(0.05, abs=0.03)
    both = first.detections[first.detections["kind"] == IDENTIFIED]
    x, y = first.stars["x_px"].to_numpy(), first.stars["y_px"].to_numpy()
    nearest = [np.hypot(x - row.x_px, y - row.y_px).min() for row in both.itertuples()]
    assert max(nearest) < 0.5


def test_with_another_attitude_nothing_is_where_it_is_expected(frames: Frames) -> None:
    turn = exp_rotation(np.array([0.01, 0.0, 0.0]))
    wrong = rotation_to_quaternion(turn @ quaternion_to_rotation(frames.quaternions[1]))
    frame = replace(frames, quaternions={**frames.quaternions, 1: wrong})[1]
    assert not np.isfinite(frame.limit_mag) or frame.n("missed") > 0.3 * frame.n("expected")


def test_centre_roll_and_north_are_those_of_the_image(frames: Frames) -> None:
    for flipped in (False, True):
        record = replace(frames.record, parity="mirrored" if flipped else "normal")
        frame, camera = replace(frames, record=record)[0], frames.camera
        rotation = quaternion_to_rotation(frames.quaternions[0])
        ra, dec = np.array([0.0, 0.0, 0.01]), np.array([0.0, 0.01, 0.0])
        places = project(
            camera,
            unit_vectors(frame.ra_deg + ra / np.cos(np.radians(frame.dec_deg)), frame.dec_deg + dec)
            @ rotation.T,
        )
        np.testing.assert_allclose(
            places[0], [0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1)], atol=1e-6
        )
        north, east = places[1] - places[0], places[2] - places[0]
        if flipped:
            north[0], east[0] = -north[0], -east[0]
        angle = np.degrees(np.arctan2(north[0], -north[1]))
        assert (frame.north - angle + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.01)
        # East is left of north, or right of it in a mirror image.
        assert (
            (north[0] * east[1] - north[1] * east[0] < 0.0) == frame.east_is_left == (not flipped)
        )
        # On the sky, the position angle of the image's up.
        roll = np.radians(-frame.roll_deg if flipped else frame.roll_deg)
        assert np.cos(np.radians(frame.north) - roll) > 1.0 - 1e-9


def test_those_that_tell_most_are_chosen(frames: Frames) -> None:
    few = frames.telling(6)
    chosen = [row.frame for row in few.record.rows]
    worst = sorted(frames.rms_px, key=lambda k: -frames.rms_px[k])[:2]
    assert len(chosen) == 6
    assert {DARK, STRANGE, *worst} <= set(chosen)
    assert chosen == sorted(chosen)
    assert frames.telling(100) is frames
    assert few.text.startswith("6 frames of 22: some that failed")
    assert len(few.centroids) < len(frames.centroids)
    with pytest.raises(
        sc.errors.ImageError, match=r"no frame of this number or name; the last one is 21"
    ):
        frames["other.fits"]


def test_the_page_shows_every_frame_with_its_reason_and_what_to_do(
    frames: Frames, tmp_path: Path
) -> None:
    page = write_frames(
        frames.select(0, 1, DARK, STRANGE_NAME, large=True), tmp_path / "frames.html"
    ).read_text("utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    for name in ("0.png", "1.png", "dark.png"):
        assert f"<b>{name}</b>" in page
    for frame in (frames[0], frames[1]):
        shown = page.partition(f"<b>{frame.row.image}</b>")[2].partition("</figure>")[0]
        counts = [int(n) for n in re.findall(r"<span>(\d+) ", shown)]
        kinds = (IDENTIFIED, LEFT_OUT, NOT_MATCHED, "expected", "missed")
        assert counts == [frame.n(kind) for kind in kinds]
        assert f"{frame.ra_deg:.4f}°" in shown
    assert "starcal-uq centroid dark.png --camera run/camera.toml -o stars.csv --threshold" in page
    assert (
        "starcal-uq identify run/centroids.parquet run/camera.toml -o found.csv --calibration "
        "run --max-mag 7<"
    ) in page
    # A star's name, and a mark of each kind with a shape of its own.
    star = frames[0].detections["star_id"].iloc[0]
    assert f"<title>{star}, G " in page
    legend = page.partition('<ul class="marks">')[2].partition("</ul>")[0]
    assert len(set(re.findall(r'<path class="[iluem]" d="([^"]+)"/></svg>', legend))) == 5
    # One of the images is there; the others are said not to be.
    assert page.count("data:image/jpeg") == 1
    assert "3 of these images are not where the run found them" in page
    assert "in 0.012 s" in page.replace("</dt><dd>", " ")


def test_pictures_are_small_and_of_this_image_only(frames: Frames, tmp_path: Path) -> None:
    camera, path = frames.camera, frames.paths[0]
    for flat in (True, False):
        shown = Image.open(io.BytesIO(picture(path, 320, camera, flat)))
        assert (shown.format, shown.width) == ("JPEG", 320)
    with pytest.raises(sc.errors.ImageError):
        picture(path, 320, camera.replace(width_px=10, height_px=10))
    # An image that is not what it was is named, and the marks are drawn.
    (tmp_path / "0.png").write_bytes(b"nothing")
    page = gallery(replace(frames, images=(tmp_path,)).select(0))
    assert "truncated or damaged" in page or "cannot be read" in page or "not an image" in page
    assert 'class="i"' in page


def test_a_frame_of_which_nothing_is_calibrated_says_so(frames: Frames) -> None:
    used = frames.used.select(frames.used.frame != 0)
    frame = replace(frames, used=used, residuals_px=frames.residuals_px[frames.used.frame != 0])[0]
    assert frame.solved and frame.n(IDENTIFIED) == 0 and frame.n(LEFT_OUT) == frame.row.n_last
    assert "identified, not calibrated" in frame.text
    assert "nan" not in frame.text
    # The attitude is then that of its stars.
    assert frame.ra_deg == pytest.approx(frames[0].ra_deg, abs=1e-3)


def test_bright_stars_have_names() -> None:
    stars = sc.load_catalogue(max_mag=1.0)
    named = dict(zip(map(proper_name, stars.star_id.tolist()), stars.ra_deg.tolist(), strict=True))
    assert named["Vega"] == pytest.approx(279.2, abs=0.1)
    assert named["Sirius"] == pytest.approx(101.3, abs=0.1)
    assert "" not in named
    assert short_name("HIP 39953", 1.7) == "HIP 39953"
    assert short_name("Gaia DR3 5", 4.26) == "G 4.3"
    # Stars of Gaia have names, too: right ascensions of the Nautical Almanac.
    stars = sc.load_catalogue(max_mag=4.0)
    named = dict(zip(map(proper_name, stars.star_id.tolist()), stars.ra_deg.tolist(), strict=True))
    assert named["Merak"] == pytest.approx(165.5, abs=0.1)
    assert named["Alderamin"] == pytest.approx(319.6, abs=0.1)


def test_labels_do_not_collide_and_zoom_shows_more(frames: Frames) -> None:
    """In a frame of 400 stars, by the boxes of the text of nine letters."""
    frame = frames[0]
    width, height = frame.width_px, frame.height_px
    rng = np.random.default_rng(1)
    stars = pd.DataFrame({"x_px": width * rng.random(400), "y_px": height * rng.random(400)})
    numbers = []
    for (zoom, kept), size in zip(labelled(stars, frame).items(), (2.5, 1.3, 0.65), strict=True):
        letters, tall = 9 * 0.62 * size * width / 100.0, size * width / 100.0
        lefts = [row.x_px - letters if x < row.x_px else row.x_px for (x, _), row in kept.items()]
        boxes = [(left, row.y_px) for left, row in zip(lefts, kept.values(), strict=True)]
        assert all(left >= 0.0 and left + letters <= width for left, _ in boxes)
        for k, (left, y) in enumerate(boxes):
            assert all(abs(left - a) > letters or abs(y - b) > tall for a, b in boxes[:k]), zoom
        numbers.append(len(kept))
    assert numbers == [12, 30, 80]
    # The brightest has a label always, unless the compass is there.
    assert stars["x_px"][0] == next(iter(labelled(stars, frame)[1].values())).x_px


def test_a_frame_that_is_not_identified_shows_what_was_found(frames: Frames) -> None:
    page = gallery(frames.select(0, STRANGE))
    first, strange = (part.partition("</svg>")[0] for part in page.split('<div class="view"')[1:])
    assert strange.count("<title>detection at x ") == len(frames[STRANGE].detections)
    assert ">SNR " in strange and ">G " not in strange
    assert ">G " in first and ">SNR " not in first
    assert "Vega" not in gallery(frames.select(STRANGE))
