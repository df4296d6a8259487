"""Draw the figures of a report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starcal_uq.presentation.figures.coupling import plot_correlations, plot_couplings
from starcal_uq.presentation.figures.diagnostics import plot_diagnosis, plot_residual_profiles
from starcal_uq.presentation.figures.distortion import plot_distortion_curve
from starcal_uq.presentation.figures.estimation import plot_convergence
from starcal_uq.presentation.figures.field_map import plot_field_map
from starcal_uq.presentation.figures.inference import plot_corner
from starcal_uq.presentation.figures.prior import plot_prior_posterior
from starcal_uq.presentation.figures.propagation import plot_attitude
from starcal_uq.presentation.figures.residuals import plot_residuals
from starcal_uq.presentation.figures.style import figure_of, png_bytes

if TYPE_CHECKING:
    from starcal_uq.presentation.report.results import Results


def draw_figures(results: Results) -> dict[str, bytes]:
    """Every figure that the results allow, as PNG, by name."""
    cal, obs, truth = results.calibration, results.observations, results.truth
    drawn = {
        "residuals": plot_residuals(cal, obs),
        "residual_profiles": plot_residual_profiles(cal, obs),
        "convergence": plot_convergence(cal, truth),
    }
    if results.diagnosis is not None:
        drawn["misfit"] = plot_diagnosis(results.diagnosis)
    if results.posterior is not None:
        drawn["corner"] = plot_corner(results.posterior, cal, truth)
        drawn["prior_posterior"] = plot_prior_posterior(results.posterior, truth)
    if results.coupling is not None:
        drawn["correlation"] = plot_correlations(results.coupling)
        drawn["price_of_coupling"] = figure_of(plot_couplings(results.coupling))
    if results.attitude is not None:
        drawn["attitude"] = figure_of(plot_attitude(results.attitude))
    if results.field_map is not None:
        drawn["field_map"] = plot_field_map(results.field_map)
    if results.distortion_curve is not None:
        drawn["distortion_curve"] = plot_distortion_curve(results.distortion_curve)
    return {name: png_bytes(figure) for name, figure in drawn.items()}
