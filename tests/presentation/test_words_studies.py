"""Coupling studies: sentences against studies whose answer is known, figures that draw, a page that
holds together.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from starcal_uq.core.display import view_of
from starcal_uq.presentation.figures.style import figure_of, png_bytes
from starcal_uq.presentation.pages.studies import render_study
from starcal_uq.presentation.pages.write import write_page
from starcal_uq.presentation.words.studies import (
    study_advice,
    study_answer,
    study_limits,
    study_tables,
    study_text,
)
from starcal_uq.studies.result import Study
from tests.helpers.studies import NAMES, made_study

FIELDS = (5.0, 10.0, 20.0)
FRAMES = (10, 100, 1000)
COUPLING = dict(zip(FIELDS, (-0.97, -0.8, -0.3), strict=True))


@pytest.fixture(scope="module")
def decoupled() -> Study:
    """The field decouples f and k1, frames do not; the error falls as one over the root of
    frames.
    """
    return made_study(
        {"fov_deg": FIELDS, "frames": FRAMES},
        lambda cell: {("f", "k1"): COUPLING[cell["fov_deg"]]},
        size=lambda cell: (8.0 if cell["fov_deg"] == 20.0 else 10.0) / np.sqrt(cell["frames"]),
        failing=lambda cell: (
            "too few stars." if cell["fov_deg"] == 5.0 and cell["frames"] == 10 else "ok"
        ),
    )


def test_the_axis_that_decouples_is_named_with_its_numbers(decoupled: Study) -> None:
    text = study_text(decoupled)
    assert "f–k1: −0.97 to −0.30. Correlations change with field of view." in text
    pairs, changes, medians = study_tables(decoupled)
    assert pairs.rows[0][0] == "f–k1" and "field of view 5°" in pairs.rows[0][2]
    assert changes.rows[0][:6] == ("f–k1", "field of view [°]", "0.97", "5", "0.30", "20")
    assert ("number of frames", "−0.50") in {(row[1], row[-1]) for row in changes.rows}
    assert len(medians.rows) == 6 and "1000" in [row[1] for row in medians.rows]
    answer = " ".join(study_answer(decoupled))
    # A hundred times as many frames; the error falls as their root.
    assert "most valuable axis is number of frames: 1000 instead of 10 divides" in answer
    assert "by 10 (median)" in answer
    assert "one of f and k1 in 100" in answer and "with 1.8 times the variance" in answer
    assert "The target of 0.5 arcsec is met in 3 of 8 places" in answer
    assert "The target of 0.050 px for f is met in 3 of 8 places" in answer
    advice = " ".join(study_advice(decoupled))
    assert "To tell f–k1 apart, choose field of view 20°." in advice
    assert (
        "fewest frames that keep 0.5 arcsec: field of view 20° and number of frames 1000" in advice
    )
    limits = " ".join(study_limits(decoupled))
    assert "3 of 27 cells have no numbers (3: too few stars)" in limits and "Coverage" in limits


def test_nothing_is_claimed_where_nothing_couples() -> None:
    """Small correlations that chance gives, and an axis without any effect."""
    rng = np.random.default_rng(3)
    study = made_study(
        {"fov_deg": FIELDS, "frames": FRAMES},
        lambda cell: {
            (a, b): 0.1 * rng.normal() for i, a in enumerate(NAMES) for b in NAMES[i + 1 :]
        },
        bias_arcsec=lambda cell: 9.0,
    )
    assert study_text(study).startswith("0 of 10 pairs of parameters are coupled")
    answer = " ".join(study_answer(study))
    assert "with 1.3 times the variance" in answer and "would do in 0 of 9" in answer
    assert "most valuable" not in answer
    assert [table.title for table in study_tables(study)] == [
        "Medians over seeds and all other axes"
    ]
    assert study_advice(study) == ["No place of this sweep keeps 0.5 arcsec: take more frames."]


def test_a_coupling_that_only_seeds_change_has_no_remedy() -> None:
    """Other seeds move the correlation as much as the axis seems to: no axis may be named."""
    study = made_study(
        {"fov_deg": FIELDS, "frames": FRAMES}, lambda cell: {("f", "k1"): -0.9}, jitter=0.03
    )
    assert "Nothing that was varied changes them by much." in study_text(study)
    assert "No choice in this sweep tells f–k1 apart" in " ".join(study_advice(study))


def test_coverage_is_judged_with_its_bounds() -> None:
    honest, wrong = (
        made_study({"fov_deg": FIELDS}, lambda cell: {("f", "k1"): -0.9}, seeds=60, covered=rate)
        for rate in (0.95, 0.7)
    )
    assert "chance explains the differences from 95 %" in " ".join(study_answer(honest))
    assert "do not use these intervals" in " ".join(study_answer(wrong))


def test_figures_draw(decoupled: Study) -> None:
    simulated = made_study(
        {"pointing": ("random", "stare")}, lambda cell: {("f", "k1"): -0.9}, covered=0.95
    )
    # The page draws the others, each once.
    for study, names in (
        (decoupled, {"map", "matrices", "inflation"}),
        (simulated, {"correlation", "coverage", "simpler"}),
    ):
        assert names < set(view_of(Study).figures)
        for name in sorted(names):
            drawn = getattr(study.plot, name)()
            figure = drawn if isinstance(drawn, Figure) else figure_of(drawn)
            assert png_bytes(figure, dpi=30).startswith(b"\x89PNG")
    many = {"fov_deg": tuple(range(5, 15)), "frames": tuple(range(100, 1000, 100))}
    wide = made_study(
        many, lambda cell: {}, size=lambda cell: 1.0 / np.sqrt(cell["frames"]), seeds=1
    )
    drawn = wide.plot.map()
    assert drawn.images[0].colorbar is not None and not drawn.texts
    few = made_study({"fov_deg": FIELDS, "frames": FRAMES}, lambda cell: {}, seeds=1)
    assert (
        "0.00" in few.plot.map("correlation", parameter="f", parameter_2="k1").texts[0].get_text()
    )
    lines = decoupled.plot.correlation([("f", "k1")]).axes[0].get_lines()
    np.testing.assert_allclose(lines[1].get_ydata(), [0.97, 0.8, 0.3], atol=0.003)
    # Where lines coincide, the first are wider.
    widths = [line.get_linewidth() for line in decoupled.plot.correlation().axes[0].get_lines()]
    assert widths == sorted(widths, reverse=True) and len(set(widths)) == len(widths) > 1
    error = decoupled.plot.needed().axes[0]
    assert "target 0.5" in error.get_title(loc="left")
    assert 0.5 in {line.get_ydata()[0] for line in error.get_lines()}
    with pytest.raises(ValueError, match='mode = "simulate"'):
        decoupled.plot.coverage()
    with pytest.raises(ValueError, match="'stars' was not swept: use one of fov_deg, frames"):
        decoupled.plot.needed(along="stars")


def test_page_holds_answer_advice_and_provenance(decoupled: Study, tmp_path: Path) -> None:
    page = write_page(decoupled, tmp_path / "study").read_text("utf-8")
    assert (
        len(page) < 2_000_000
        and "A study &lt;made&gt; by hand" in page
        and "<script src" not in page
    )
    for words in (
        study_text(decoupled),
        "choose field of view 20°",
        "too few stars",
        "study: seeds",
    ):
        assert words in page
    assert (
        len(list((tmp_path / "study" / "figures").glob("*.svg")))
        == page.count("data:image/svg")
        == 7
    )


def test_study_without_any_number_says_so() -> None:
    study = made_study({"fov_deg": FIELDS}, lambda cell: {}, failing=lambda cell: "too few stars.")
    assert study_text(study) == "No cell of the study has numbers."
    assert "too few stars" in render_study(study, {}) and study._repr_html_()
