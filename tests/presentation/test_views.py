"""Results of the lower wings draw, tell and lay themselves out through the door."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import starcal_uq as sc
from starcal_uq.attitude.profile import AttitudeProfile
from starcal_uq.core.display import Shown, View, view_of
from starcal_uq.inference.power_scaling import FINE, PriorSensitivity
from starcal_uq.inference.prior_draws import PriorPredictive
from starcal_uq.inference.update import ShiftTest
from starcal_uq.pipeline.record import ImageRecord
from starcal_uq.presentation.views import VIEWS
from starcal_uq.presentation.words.estimation import calibration_table


@pytest.fixture(scope="module")
def paper_calibration() -> sc.Calibration:
    stars = sc.load_catalogue(max_mag=6.0)
    return sc.calibrate(
        sc.simulate(stars, sc.paper.paper_camera(), n_frames=20, seed=1), sc.paper.paper_start()
    )


def results(cal: sc.Calibration) -> list[Shown]:
    """What costs little to make."""
    one, two = np.ones(1), np.eye(1)
    stars = sc.load_catalogue(max_mag=3.0)
    return [
        cal,
        cal.camera,
        stars,
        sc.Observations([1, 1, 1], [1.0, 2, 3], [4.0, 5, 6], [7.0, 8, 9], [1.0, 2, 3]),
        sc.Priors.default(cal.camera),
        AttitudeProfile(np.arange(2.0), np.array([[0.0, 0, 0, 1], [0, 0, 1, 0]]), "<turn>"),
        PriorPredictive(("scale",), two, one, one, two, two, 0.0, 0.0),
        PriorSensitivity(("f",), one, one, one, one, one, one, 0.1, 0.1, (FINE,)),
        ShiftTest(("f",), ("px",), one, two, one, 1.0, np.inf, 0.3),
        ImageRecord((), (), 0, "normal"),
    ]


def test_results_tell_and_lay_themselves_out(paper_calibration: sc.Calibration) -> None:
    for result in results(paper_calibration):
        assert len(result.text) > 10, result
        if view_of(type(result)).html is not None:
            page = result._repr_html_()
            assert page is not None
            assert page.startswith(("<p><b>", "<table>"))
            assert page.count("<table>") == page.count("</table>") and "<turn>" not in page


@pytest.mark.parametrize("cls", VIEWS, ids=lambda cls: cls.__name__)
def test_every_view_is_of_a_result(cls: type) -> None:
    assert issubclass(cls, Shown)
    view = VIEWS[cls]
    assert view.text or view.html or view.figures
    assert all(callable(figure) and figure.__doc__ for figure in view.figures.values())


def test_figures_are_found_by_name(paper_calibration: sc.Calibration) -> None:
    assert dir(paper_calibration.plot) == ["convergence", "effects", "residuals"]
    assert "convergence, effects, residuals" in repr(paper_calibration.plot)
    assert isinstance(paper_calibration.plot.convergence(), Figure)
    assert "iteration" in (paper_calibration.plot.convergence.__doc__ or "")
    with pytest.raises(
        AttributeError, match="no figure 'nonsense'; it has convergence, effects, residuals"
    ):
        paper_calibration.plot.nonsense()
    with pytest.raises(AttributeError, match="it has none"):
        paper_calibration.camera.plot.anything()


def test_what_nobody_shows_says_so() -> None:
    class Unknown(Shown):
        pass

    with pytest.raises(LookupError, match="nothing says how"):
        _ = Unknown().text
    assert View().figures == {}


def test_no_module_below_writes_html() -> None:
    """Pages and tables are composed above the results."""
    wings = (
        "attitude",
        "camera",
        "observations",
        "sky",
        "images",
        "identification",
        "pipeline",
        "estimation",
    )
    root = Path(sc.__file__).parent
    for path in (path for wing in (*wings, "inference") for path in (root / wing).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert not any(mark in text for mark in ("<table", "<p>", "_repr_html_", "presentation")), (
            path
        )


def test_at_the_prompt_a_result_fits_the_screen(paper_calibration: sc.Calibration) -> None:
    couplings = sc.coupling(paper_calibration)
    for result in (*results(paper_calibration), couplings):
        assert len(repr(result)) < 1000
    assert repr(couplings) == f"Coupling: {couplings.text}"
    # What has few fields is printed as it is.
    assert repr(paper_calibration.camera).startswith("Camera(width_px=1024, ")


def test_a_truth_of_another_model_has_no_column(paper_calibration):
    truth = sc.paper.paper_camera()
    assert "truth" in calibration_table(paper_calibration, truth).heads
    other = truth.replace(distortion="brown_tangential", coefficients=(*truth.coefficients, 0, 0))
    assert "truth" not in calibration_table(paper_calibration, other).heads
