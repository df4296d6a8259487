"""Plans in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.planning.check import ForecastCheck
from starcal_uq.planning.costs import EffectCosts
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table, told


def check_text(check: ForecastCheck) -> str:
    """Whether forecast and simulation agree."""
    rows = check.to_dataframe()
    worst = rows.loc[(rows["ratio"] - 1.0).abs().idxmax()]
    outside = [int(n) for n in np.array(check.forecast.n_frames)[check.nees_rejected]]
    return told("forecast_check", check, worst=worst, outside=outside)


# Heads of what only some cameras have.
_GROWN = {
    "x₀": "x0_px",
    "f": "f_px",
    "corner": "distortion_corner_px",
    "common": "common_pitch_arcsec",
}


def costs_table(costs: EffectCosts) -> TextTable:
    """What effects cost: the growth of what is known of the camera, and attitude errors."""
    rest = [costs.names.index(f"rest_{axis}_arcsec") for axis in AXES[:2]]
    sigmas = {"known": costs.sigma, "alone": costs.camera_alone}
    columns = {name: np.sqrt(np.mean(of[:, rest] ** 2, axis=1)) for name, of in sigmas.items()}
    without = [head for head, name in _GROWN.items() if name not in costs.names]
    return table("costs", {"costs": costs}, without, model=costs.models, **columns)
