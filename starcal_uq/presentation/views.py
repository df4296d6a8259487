"""How every result is drawn, told and laid out: one table, by class."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from starcal_uq.attitude.profile import AttitudeProfile
from starcal_uq.budgeting.result import Budget, Outcome
from starcal_uq.calibration.screening.result import Screening
from starcal_uq.camera.camera import Camera
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.display import View
from starcal_uq.diagnostics.diagnose import Diagnosis
from starcal_uq.diagnostics.jackknife import Jackknife
from starcal_uq.diagnostics.misfit import Misfit
from starcal_uq.diagnostics.models import ModelComparison
from starcal_uq.diagnostics.predictive import PredictiveCheck
from starcal_uq.diagnostics.stars import StarTest
from starcal_uq.diagnostics.validation.result import Validation
from starcal_uq.diagnostics.verdict.judge import Verdict
from starcal_uq.estimation.merging import Consistency
from starcal_uq.estimation.result import Calibration
from starcal_uq.identification.result import Identification
from starcal_uq.images.centroids import Centroids
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.power_scaling import PriorSensitivity
from starcal_uq.inference.prior_draws import PriorPredictive
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.update import ShiftTest
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.observations.table import Observations
from starcal_uq.pipeline.examples import ExampleData
from starcal_uq.pipeline.inspection import Frames, InspectedFrame
from starcal_uq.pipeline.record import ImageRecord
from starcal_uq.pipeline.refine import ImageCalibration
from starcal_uq.planning.check import ForecastCheck
from starcal_uq.planning.design import FrameChoice
from starcal_uq.planning.planned import Need, Plan
from starcal_uq.presentation.figures.budgeting import plot_budget
from starcal_uq.presentation.figures.comparison import plot_camera_comparison
from starcal_uq.presentation.figures.coupling import (
    plot_correlation,
    plot_correlations,
    plot_couplings,
)
from starcal_uq.presentation.figures.diagnostics import (
    plot_comparison,
    plot_diagnosis,
    plot_jackknife,
    plot_misfit,
    plot_validation,
)
from starcal_uq.presentation.figures.effects import plot_effect_scales, plot_effects
from starcal_uq.presentation.figures.estimation import plot_convergence, plot_residuals
from starcal_uq.presentation.figures.inference import plot_corner, plot_prior_posterior
from starcal_uq.presentation.figures.planning import (
    plot_forecast,
    plot_forecast_check,
    plot_frame_choice,
    plot_plan_sweeps,
)
from starcal_uq.presentation.figures.propagation import (
    plot_attitude,
    plot_distortion_curve,
    plot_error_series,
    plot_field_map,
    plot_spectrum,
    plot_thermal,
)
from starcal_uq.presentation.figures.studies import (
    plot_coverage,
    plot_inflation,
    plot_matrices,
    plot_needed,
    plot_simpler,
    plot_study_correlation,
    plot_study_map,
    plot_study_maps,
    plot_weakest,
)
from starcal_uq.presentation.html import card, listed
from starcal_uq.presentation.pages.budgeting import section_html
from starcal_uq.presentation.pages.explorer import framed
from starcal_uq.presentation.pages.gallery import frames_html
from starcal_uq.presentation.report.results import Results
from starcal_uq.presentation.report.words import run_html
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words import (
    comparison,
    diagnostics,
    effects,
    estimation,
    images,
    inference,
    inputs,
    planning,
    propagation,
    studies,
)
from starcal_uq.presentation.words.sentences import told
from starcal_uq.propagation.attitude_error import Agreement, AttitudeError
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.propagation.distortion import DistortionCurve
from starcal_uq.propagation.field import FieldMap
from starcal_uq.propagation.spectrum import ErrorSpectrum
from starcal_uq.propagation.thermal import ThermalError
from starcal_uq.sky.catalogue import StarCatalogue
from starcal_uq.studies.result import Study


def _view(
    title: str,
    text: str | Callable[[Any], str],
    table: Callable[[Any], TextTable | Sequence[TextTable | None] | None],
    notes: Callable[[Any], Iterable[str]] = lambda result: (),
    frame: Callable[[Any], str] = lambda result: "",
    **figures: Callable[..., Any],
) -> View:
    """A result with its sentences (the name of a text, or what makes them), its table, what is worth
    noting, its interactive figure, and its figures.
    """
    said = partial(told, text) if isinstance(text, str) else text

    def html(result: Any) -> str:
        found = table(result)
        tables = filter(None, [found] if isinstance(found, TextTable | None) else found)
        return card(title, said(result), *tables) + listed(notes(result)) + frame(result)

    return View(said, html, figures)


def _rows(result: Any) -> TextTable:
    return TextTable.of(result.to_dataframe())


def _draws(result: Any) -> Iterable[str]:
    return [f"{result.n_draws} posterior draws."]


def _messages(result: Any) -> Iterable[str]:
    messages: Iterable[str] = result.messages
    return messages


VIEWS: Mapping[type, View] = {
    Camera: _view("Camera", "camera", inputs.camera_table),
    AttitudeProfile: _view("Attitude profile", "profile", lambda profile: None, _messages),
    Observations: _view("Observations", "observations", inputs.observations_table),
    ExampleData: _view("Example data", "example", lambda example: None),
    StarCatalogue: _view("Star catalogue", "catalogue", inputs.catalogue_table),
    Centroids: _view("Centroids", "centroids", images.centroids_table, _messages),
    Identification: _view("Identification", "identification", images.identification_table),
    ImageCalibration: View(images.image_calibration_text),
    ImageRecord: View(partial(told, "image_record")),
    Frames: View(partial(told, "frames"), frames_html),
    InspectedFrame: View(partial(told, "frame")),
    Calibration: _view(
        "Calibration",
        "calibration",
        estimation.calibration_tables,
        convergence=plot_convergence,
        effects=plot_effects,
        residuals=plot_residuals,
    ),
    Effects: _view(
        "Effects beyond the camera",
        "effects",
        effects.effects_table,
        scales=plot_effect_scales,
    ),
    Screening: _view("Screening", estimation.screening_text, estimation.screening_table),
    Consistency: _view("Consistency", "consistency", estimation.consistency_table, _messages),
    Priors: _view("Priors", "priors", _rows),
    PriorPredictive: _view("Prior predictive check", "prior_predictive", _rows),
    PriorSensitivity: _view("Prior sensitivity", "prior_sensitivity", _rows),
    ShiftTest: _view("Shift", "shift", _rows),
    Posterior: _view(
        "Posterior",
        "posterior",
        inference.posterior_table,
        lambda post: map(str, post.diagnostics.checks),
        corner=plot_corner,
        prior_posterior=plot_prior_posterior,
    ),
    Misfit: _view("Misfit", "misfit", diagnostics.misfit_table, p_values=plot_misfit),
    Jackknife: _view("Jackknife", "jackknife", diagnostics.jackknife_table, ratios=plot_jackknife),
    StarTest: _view("Errors of the stars", "stars", diagnostics.star_table),
    ModelComparison: _view("Models", "models", diagnostics.models_table, models=plot_comparison),
    PredictiveCheck: _view(
        "Posterior predictive check", "predictive", diagnostics.predictive_table
    ),
    Diagnosis: View(
        partial(told, "diagnosis"), diagnostics.diagnosis_html, {"diagnosis": plot_diagnosis}
    ),
    Verdict: _view("Verdict", "verdict", lambda verdict: None, diagnostics.verdict_notes),
    Validation: _view(
        "Validation",
        diagnostics.validation_text,
        diagnostics.validation_table,
        ranks=plot_validation,
    ),
    CameraComparison: _view(
        "Comparison",
        "comparison",
        comparison.comparison_table,
        difference=plot_camera_comparison,
    ),
    Need: View(partial(told, "need")),
    Plan: _view(
        "Plan",
        "plan",
        planning.plan_table,
        forecast=plot_forecast,
        sweeps=plot_plan_sweeps,
    ),
    FrameChoice: _view(
        "Frames to take",
        "choice",
        lambda choice: TextTable.of(choice.worth()),
        choice=plot_frame_choice,
    ),
    ForecastCheck: _view(
        "Forecast against simulation", planning.check_text, _rows, check=plot_forecast_check
    ),
    Outcome: View(partial(told, "outcome")),
    Budget: View(partial(told, "budget"), section_html, {"contributors": plot_budget}),
    Agreement: _view(
        "Sampled over first order", propagation.agreement_text, propagation.agreement_table
    ),
    AttitudeError: _view(
        "Attitude error",
        "attitude",
        propagation.attitude_table,
        lambda error: [f"{error.n_draws} posterior draws through QUEST on {error.told_frames}."],
        contributors=plot_attitude,
    ),
    Coupling: _view(
        "Coupling",
        "coupling",
        propagation.coupling_table,
        frame=framed,
        correlation=plot_correlation,
        correlations=plot_correlations,
        couplings=plot_couplings,
    ),
    FieldMap: _view(
        "Direction uncertainty over the detector",
        "field",
        propagation.field_table,
        maps=plot_field_map,
    ),
    DistortionCurve: _view(
        "Distortion",
        "distortion",
        lambda curve: None,
        _draws,
        curve=plot_distortion_curve,
    ),
    ErrorSpectrum: _view(
        "Error spectrum",
        "spectrum",
        propagation.spectrum_table,
        _draws,
        spectrum=plot_spectrum,
        time_series=plot_error_series,
    ),
    ThermalError: _view(
        "Attitude error over a temperature profile",
        "thermal",
        propagation.thermal_table,
        profile=plot_thermal,
    ),
    Results: View(partial(told, "run"), run_html),
    Study: _view(
        "Study",
        studies.study_text,
        studies.study_tables,
        studies.study_notes,
        framed,
        correlation=plot_study_correlation,
        map=plot_study_map,
        maps=plot_study_maps,
        matrices=plot_matrices,
        weakest=plot_weakest,
        inflation=plot_inflation,
        needed=plot_needed,
        simpler=plot_simpler,
        coverage=plot_coverage,
    ),
}
