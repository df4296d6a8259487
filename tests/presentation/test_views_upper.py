"""Every result of propagation, diagnostics, comparison, planning and budgeting can draw, tell and
lay itself out.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.budgeting.file import Requirement
from starcal_uq.budgeting.result import Budget, Outcome
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.provenance import Provenance
from starcal_uq.diagnostics.diagnose import Diagnosis
from starcal_uq.diagnostics.jackknife import Jackknife
from starcal_uq.diagnostics.misfit import Misfit
from starcal_uq.diagnostics.models import ModelComparison
from starcal_uq.diagnostics.predictive import PredictiveCheck
from starcal_uq.diagnostics.stars import StarTest
from starcal_uq.diagnostics.validation.result import Validation
from starcal_uq.diagnostics.verdict.judge import Verdict, judge
from starcal_uq.planning.check import ForecastCheck
from starcal_uq.planning.design import FrameChoice
from starcal_uq.planning.planned import Need, Plan
from starcal_uq.presentation.pages.write import write_page
from starcal_uq.presentation.views import VIEWS
from starcal_uq.propagation.attitude_error import Agreement, AttitudeError
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.propagation.distortion import DistortionCurve
from starcal_uq.propagation.field import FieldMap
from starcal_uq.propagation.spectrum import ErrorSpectrum
from starcal_uq.propagation.thermal import ThermalError
from tests.helpers.gaussian_camera import gaussian_posterior
from tests.helpers.profiles import slew
from tests.helpers.scenes import camera, nominal, observations
from tests.propagation.test_thermal import orbit, response

WINGS = ("propagation", "diagnostics", "comparison", "planning", "budgeting")
FIGURES = {
    Agreement: [],
    AttitudeError: ["contributors"],
    Coupling: ["correlation", "correlations", "couplings"],
    FieldMap: ["maps"],
    DistortionCurve: ["curve"],
    ErrorSpectrum: ["spectrum", "time_series"],
    ThermalError: ["profile"],
    Misfit: ["p_values"],
    Jackknife: ["ratios"],
    StarTest: [],
    Verdict: [],
    ModelComparison: ["models"],
    PredictiveCheck: [],
    Diagnosis: ["diagnosis"],
    Validation: ["ranks"],
    CameraComparison: ["difference"],
    Need: [],
    Plan: ["forecast", "sweeps"],
    FrameChoice: ["choice"],
    ForecastCheck: ["check"],
    Outcome: [],
    Budget: ["contributors"],
}
# They are shown as part of others.
WITHOUT_PAGE = (Need, Outcome)


def validation(n: int = 100) -> Validation:
    """All well, without a single fit."""
    rng = np.random.default_rng(1)
    names = (*camera().parameter_names, "sigma", "log_likelihood", "pitch", "yaw", "roll")
    size = (n, len(names))
    return Validation(
        quantities=names,
        units=("px",) * len(names),
        camera=camera(),
        nominal=nominal(camera()),
        priors=sc.Priors.default(nominal(camera())),
        replicate=np.arange(n),
        truth=np.ones((n, 6)),
        ranks=rng.integers(0, 128, size),
        n_ranked=127,
        covered=rng.random(size) < 0.95,
        error=rng.standard_normal(size),
        sd=np.ones(size),
        nees=rng.chisquare(5, n),
        nees_calibration=rng.chisquare(5, n),
        compression_error=np.zeros(n),
        dof=np.full(n, 1000),
        failures=(),
        n_requested=n,
        interrupted=False,
        provenance=Provenance(settings={"n_frames": 20}),
    )


@pytest.fixture(scope="module")
def results() -> dict[type, Any]:
    """One result of every class."""
    obs = observations(n_frames=30)
    cal = sc.calibrate(obs, nominal(camera()))
    post = gaussian_posterior(cal, n=200)
    post.provenance = cal.provenance
    stars = sc.load_catalogue(max_mag=6.0)
    error = sc.propagate(post, obs, n_draws=50)
    slewing = sc.simulation.profile_frames(stars, camera(), slew(60, 1.0, rate_deg_s=0.5))
    asked = Requirement("R-1", "cross-boresight", 1.0, 0.997)
    budget = sc.budget(
        post, obs, error, file=sc.budgeting.BudgetFile(requirements=(asked,)), n_samples=20_000
    )
    plan = sc.plan(
        camera(), stars, n_frames=(10, 30), target_arcsec=20.0, n_geometries=100, n_campaigns=20
    )
    diagnosis = sc.diagnose(obs, cal, models=("k1", "brown"), n_starts=0)
    made = [
        *(error, error.agreement, sc.coupling(cal), sc.propagation.field_map(post, obs, 9)),
        *(
            sc.propagation.distortion_curve(post, obs, n=11, n_draws=50),
            validation(),
            plan,
            plan.needs[0],
        ),
        sc.propagation.error_spectrum(post, slewing, n_draws=5),
        *(diagnosis, diagnosis.misfit, diagnosis.jackknife, diagnosis.stars, judge(obs, cal)),
        *(diagnosis.comparison, diagnosis.predictive),
        sc.comparison.compare_halves(obs, nominal(camera())),
        sc.planning.choose_frames(camera(), stars, n_frames=5, candidates=100, n_geometries=100),
        sc.planning.check_forecast(
            camera(), stars, n_frames=(5, 10), n_campaigns=2, n_geometries=100, workers=0
        ),
        *(budget, budget.outcomes[0]),
        response()[0].over(orbit()),
    ]
    return {type(result): result for result in made}


def test_every_class_is_listed() -> None:
    upper = {cls for cls in VIEWS if cls.__module__.split(".")[1] in WINGS}
    assert upper == set(FIGURES)


@pytest.mark.parametrize("cls", FIGURES, ids=lambda cls: cls.__name__)
def test_result_draws_tells_and_lays_itself_out(results: dict[type, Any], cls: type) -> None:
    result = results[cls]
    assert dir(result.plot) == FIGURES[cls]
    for name in FIGURES[cls]:
        assert getattr(result.plot, name)() is not None
    assert result.text.strip() and "nan" not in result.text
    html = result._repr_html_()
    assert html is None if cls in WITHOUT_PAGE else "<p>" in html


def test_pages_are_written_by_one_function(results: dict[type, Any], tmp_path: Any) -> None:
    for cls, ending in ((Plan, ""), (CameraComparison, ""), (Budget, ".html")):
        page = write_page(results[cls], tmp_path / f"{cls.__name__}{ending}")
        assert "</html>" in page.read_text(encoding="utf-8")
    with pytest.raises(TypeError, match="no page for"):
        write_page(SimpleNamespace(), tmp_path)  # type: ignore[arg-type]
