"""How every result is drawn, told and laid out: one table, by class."""

from __future__ import annotations

from collections.abc import Mapping

from starcal_uq.core.display import View
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.presentation.figures.coupling import plot_correlation, plot_correlations, plot_couplings
from starcal_uq.presentation.figures.estimation import plot_convergence, plot_residuals
from starcal_uq.presentation.figures.propagation import (
    plot_attitude,
    plot_distortion_curve,
    plot_error_series,
    plot_field_map,
    plot_spectrum,
)
from starcal_uq.presentation.words import propagation
from starcal_uq.propagation.attitude_error import Agreement, AttitudeError
from starcal_uq.propagation.coupling import Coupling
from starcal_uq.propagation.distortion import DistortionCurve
from starcal_uq.propagation.field import FieldMap
from starcal_uq.propagation.spectrum import ErrorSpectrum

VIEWS: Mapping[type, View] = {
    Calibration: View(figures={"convergence": plot_convergence, "residuals": plot_residuals}),
    Agreement: View(propagation.agreement_text, propagation.agreement_html),
    AttitudeError: View(
        propagation.attitude_text,
        propagation.attitude_html,
        {"contributors": plot_attitude},
    ),
    Coupling: View(
        propagation.coupling_text,
        propagation.coupling_html,
        {"correlation": plot_correlation, "correlations": plot_correlations, "couplings": plot_couplings},
    ),
    FieldMap: View(propagation.field_text, propagation.field_html, {"maps": plot_field_map}),
    DistortionCurve: View(propagation.distortion_text, propagation.distortion_html, {"curve": plot_distortion_curve}),
    ErrorSpectrum: View(
        propagation.spectrum_text,
        propagation.spectrum_html,
        {"spectrum": plot_spectrum, "time_series": plot_error_series},
    ),
}
