"""Draw the figures of a report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starcal_uq import plots
from starcal_uq.plots.style import png_bytes

if TYPE_CHECKING:
    from starcal_uq.reporting.loading import Results


def draw_figures(results: Results) -> dict[str, bytes]:
    """Every figure that the results allow, as PNG, by name."""
    cal, obs, truth = results.calibration, results.observations, results.truth
    drawn = {
        "residuals": plots.plot_residuals(cal, obs),
        "residual_profiles": plots.plot_residual_profiles(cal, obs),
        "convergence": plots.plot_convergence(cal, truth),
    }
    if results.diagnosis is not None:
        drawn["misfit"] = plots.plot_diagnosis(results.diagnosis)
    if results.posterior is not None:
        drawn["corner"] = plots.plot_corner(results.posterior, cal, truth)
        drawn["prior_posterior"] = plots.plot_prior_posterior(results.posterior, truth)
    if results.coupling is not None:
        drawn["correlation"] = plots.plot_correlations(results.coupling)
        drawn["price_of_coupling"] = plots.figure_of(plots.plot_couplings(results.coupling))
    if results.attitude is not None:
        drawn["attitude"] = plots.figure_of(plots.plot_attitude(results.attitude))
    if results.field_map is not None:
        drawn["field_map"] = plots.plot_field_map(results.field_map)
    if results.distortion_curve is not None:
        drawn["distortion_curve"] = plots.plot_distortion_curve(results.distortion_curve)
    return {name: png_bytes(figure) for name, figure in drawn.items()}
