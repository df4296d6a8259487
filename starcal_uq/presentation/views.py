"""How every result is drawn, told and laid out: one table, by class."""

from __future__ import annotations

from collections.abc import Mapping

from starcal_uq.core.display import View
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.presentation.figures.estimation import plot_convergence, plot_residuals

VIEWS: Mapping[type, View] = {
    Calibration: View(figures={"convergence": plot_convergence, "residuals": plot_residuals}),
}
