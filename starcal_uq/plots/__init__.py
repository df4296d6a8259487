"""Results to figures: the only modules that import matplotlib.

Every function takes a result object and returns the ``Axes`` it drew on, or a ``Figure`` where one panel is not enough.
Nothing here calls ``show``, opens a window or changes ``rcParams``; importing this package does not import matplotlib.
"""

from __future__ import annotations

from starcal_uq.plots.attitude import plot_attitude
from starcal_uq.plots.budget import plot_budget
from starcal_uq.plots.camera_comparison import plot_camera_comparison
from starcal_uq.plots.convergence import plot_convergence
from starcal_uq.plots.corner import plot_corner
from starcal_uq.plots.distortion import plot_distortion_curve
from starcal_uq.plots.field_map import plot_field_map
from starcal_uq.plots.interaction import plot_interaction
from starcal_uq.plots.matrix import plot_correlation, plot_correlations, plot_couplings
from starcal_uq.plots.misfit import (
    plot_comparison,
    plot_diagnosis,
    plot_jackknife,
    plot_misfit,
    plot_residual_profiles,
)
from starcal_uq.plots.paper import plot_error_fields, plot_printed_numbers, plot_trajectories
from starcal_uq.plots.prior import plot_prior_posterior
from starcal_uq.plots.replicates import plot_replicates
from starcal_uq.plots.residuals import plot_residual_histogram, plot_residual_map, plot_residual_radius, plot_residuals
from starcal_uq.plots.spectrum import plot_error_series, plot_spectrum
from starcal_uq.plots.style import figure_of, png_bytes
from starcal_uq.plots.validation import plot_validation

__all__ = [
    "figure_of",
    "plot_attitude",
    "plot_budget",
    "plot_camera_comparison",
    "plot_comparison",
    "plot_convergence",
    "plot_corner",
    "plot_correlation",
    "plot_correlations",
    "plot_couplings",
    "plot_diagnosis",
    "plot_distortion_curve",
    "plot_error_fields",
    "plot_error_series",
    "plot_field_map",
    "plot_interaction",
    "plot_jackknife",
    "plot_misfit",
    "plot_printed_numbers",
    "plot_prior_posterior",
    "plot_replicates",
    "plot_residual_histogram",
    "plot_residual_map",
    "plot_residual_profiles",
    "plot_residual_radius",
    "plot_residuals",
    "plot_spectrum",
    "plot_trajectories",
    "plot_validation",
    "png_bytes",
]
