"""Plans in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import fixed
from starcal_uq.planning.check import ForecastCheck
from starcal_uq.planning.costs import EffectCosts
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.numbers import frames
from starcal_uq.presentation.words.sentences import told


def check_text(check: ForecastCheck) -> str:
    """Whether forecast and simulation agree."""
    table = check.to_dataframe()
    worst = table.loc[(table["ratio"] - 1.0).abs().idxmax()]
    outside = [int(n) for n in np.array(check.forecast.n_frames)[check.nees_rejected]]
    return told("forecast_check", check, worst=worst, outside=outside)


def costs_table(costs: EffectCosts) -> TextTable:
    """What effects cost: the growth of what is known of the camera, and attitude errors."""
    import pandas as pd

    grown = {
        "x₀": ("x0_px", "y0_px"),
        "f": ("f_px",),
        "corner": ("distortion_corner_px",),
        "common": ("common_pitch_arcsec", "common_yaw_arcsec"),
    }
    known = {head: names for head, names in grown.items() if set(names) <= set(costs.names)}
    rest = [costs.names.index(f"rest_{axis}_arcsec") for axis in AXES[:2]]
    table = pd.DataFrame({"effects": costs.models})
    table["scale [px]"] = table["effects"].map(costs.planned.scales)
    for head, names in known.items():
        table[head] = [costs.growth(model, *names) for model in costs.models]
    table["rest [arcsec]"], table["camera alone aboard"] = (
        np.sqrt(np.mean(sigma[:, rest] ** 2, axis=1)) for sigma in (costs.sigma, costs.camera_alone)
    )
    title = f"What effects cost after {frames(costs.n_frames)}: growth of sigmas, and the rest"
    forms = dict.fromkeys(known, lambda factor: f"× {fixed(factor, 2)}")
    return TextTable.of(table, title, formats=forms, missing="")
