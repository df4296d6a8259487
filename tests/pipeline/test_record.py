"""The record of images: kept without loss, and told in the report."""

from __future__ import annotations

from dataclasses import replace

import pytest

import starcal_uq as sc
from starcal_uq.pipeline.record import ImageRecord, ImageRow, RoundRecord
from starcal_uq.pipeline.refine import identified_pairs
from starcal_uq.presentation.report.tables import image_context


@pytest.fixture(scope="module")
def paper_calibration() -> sc.Calibration:
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    return sc.calibrate(
        sc.simulate(stars, sc.paper.paper_camera(), n_frames=20, seed=1), sc.paper.paper_start()
    )


NAMES = ("x0", "y0", "f", "k1", "k2")


def record(n: int, left_out: int = 1) -> ImageRecord:
    """`n` images, the last ones of which are too dark."""
    rounds = tuple(
        RoundRecord(
            n - left_out,
            stars,
            new,
            0,
            {name: (value, 0.1) for name, value in zip(NAMES, v, strict=True)},
            s,
            1.1,
        )
        for stars, new, v, s in (
            (80, 0, (500.0, 530.0, 5850.0, 2e-10, 0.0), "sigma_scale"),
            (96, 16, (500.1, 530.0, 5850.2, 2e-10, 0.0), "sigma_scale"),
        )
    )
    used = [
        ImageRow(k, f"{k}.fits", "2026-11-21T00:00:00", 12, "identified", 8, 10)
        for k in range(n - left_out)
    ]
    dark = [
        ImageRow(k, f"{k}.fits", "", 0, "no star is bright enough.", 0, 0)
        for k in range(n - left_out, n)
    ]
    return ImageRecord(rounds, (*used, *dark), 3, "mirrored")


def test_summary_counts_what_was_used_and_what_was_not() -> None:
    words = record(5).text
    assert words.startswith(
        "4 of 5 images used; 48 star images were found in them, and 40 of these were identified."
    )
    assert "3 stars left out" in words
    assert "mirror images" in words
    plain = replace(record(5, 0), n_disturbed=0, parity="normal").text
    assert "left out" not in plain
    assert "mirror" not in plain


def test_report_says_what_changed(paper_calibration: sc.Calibration) -> None:
    shown = image_context(record(5), paper_calibration)
    rows = {row[0]: row for row in shown["round_table"].rows}
    assert rows["Stars calibrated"][1:4] == ("80", "96", "16 identified again, 0 given up")
    assert rows["f"][3] == "2.0 σ"
    assert shown["image_reasons"] == ["1 image: no star is bright enough."]
    assert len(shown["image_rows"]) == 5


def test_of_many_images_only_those_left_out_are_listed(paper_calibration: sc.Calibration) -> None:
    assert len(image_context(record(100, 7), paper_calibration)["image_rows"]) == 7
    shown = image_context(record(100, 60), paper_calibration)
    assert len(shown["image_rows"]) == 40
    assert "first 40 of 60" in shown["image_listing"]
    assert image_context(None, paper_calibration) == {"image_record": None}


def test_pairs_need_names() -> None:
    obs = sc.simulate(
        sc.load_catalogue(max_mag=6.0, epoch=2026.9), sc.paper.paper_camera(), n_frames=2, seed=1
    )
    assert len(identified_pairs(obs)) == obs.n_stars
    assert identified_pairs(replace(obs, star_id=None)) == set()
