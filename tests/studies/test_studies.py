"""Studies: cells against analytic scalings, the paper's set-up, plan and simulation."""

from __future__ import annotations

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.paper import paper_camera
from starcal_uq.studies import Study, StudyDefinition


def definition(**changes: object) -> StudyDefinition:
    """Fisher cells of the paper's camera."""
    usual: dict[str, object] = {
        "camera": paper_camera(),
        "sweep": {"frames": (250, 1000), "sigma_px": (0.05, 0.1, 0.2)},
        "observation": {"min_stars": 10},
        "seed": 1,
    }
    return StudyDefinition(**{**usual, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def small() -> Study:
    """Six cells."""
    return sc.study(definition(), workers=0)


def test_sigma_follows_noise_exactly_and_frames_by_the_root(small: Study) -> None:
    sigma = small.data["sigma"].values
    assert sigma.shape == (6, 5)
    np.testing.assert_allclose(sigma[1], 2.0 * sigma[0], rtol=1e-9)
    # Stars near the edge are left out, and more of them where the noise is larger; with them go some frames.
    np.testing.assert_allclose(sigma[2], 4.0 * sigma[0], rtol=0.1)
    # Another campaign of four times the frames: the root but for the choice of frames.
    np.testing.assert_allclose(sigma[0] / sigma[3], 2.0, rtol=0.15)
    assert small.ok.all() and small.axes == ("frames", "sigma_px")


def test_cells_of_the_papers_set_up(small: Study) -> None:
    """DESIGN's figures for 1000 frames at 0.05 px."""
    cell = small.data.isel(cell=3)
    correlation = cell["correlation"]
    assert float(correlation.sel(parameter="f", parameter_2="k1")) == pytest.approx(-0.94, abs=0.01)
    assert float(correlation.sel(parameter="k1", parameter_2="k2")) == pytest.approx(-0.97, abs=0.01)
    assert float(cell["sigma"].sel(parameter="f")) == pytest.approx(0.028, rel=0.15)
    assert str(cell["weak_words"].values).startswith(("k1 against", "k2 and f against", "f and k2 against"))
    assert float(cell["variance_inflation"].sel(parameter="k1")) > 20.0
