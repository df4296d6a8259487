"""Calibrations, screenings and the agreement of merged runs in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.calibration.screening.result import REASONS, Screening
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters, scales_of
from starcal_uq.core.formatting import (
    decimals_for,
    pretty_unit,
)
from starcal_uq.estimation.result import Calibration
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.effects import effects_table
from starcal_uq.presentation.words.sentences import rows, table, told


def noise_kind(cal: Calibration) -> str:
    """Which noise of each star a common factor multiplies."""
    return "stated" if cal.fitted_noise is None else "fitted"


def calibration_tables(cal: Calibration) -> list[TextTable | None]:
    """Its parameters, and the effects that it holds."""
    return [calibration_table(cal), None if cal.effects is None else effects_table(cal.effects)]


def calibration_table(cal: Calibration, truth: Camera | None = None) -> TextTable:
    """Start, estimate and sigma of every parameter; with a truth of the same parameters, also truth
    and z.
    """
    if truth is not None and truth.parameter_names != cal.parameter_names:
        truth = None
    specs = parameters(cal.camera.distortion)
    scale = np.append(scales_of(specs), 1.0)
    start, value, sd = cal.with_noise / scale
    true = np.full(len(specs), np.nan) if truth is None else truth.theta
    unit = "px per axis" if cal.sigma_name == "sigma" else f"times the {noise_kind(cal)} noise"
    return table(
        "calibration",
        {"it": cal},
        ("truth", "z") if truth is None else (),
        name=[*(spec.name for spec in specs), cal.sigma_name],
        start=start,
        value=value,
        sd=sd,
        n=[*map(decimals_for, sd)],
        known=np.append(true, np.nan) / scale,
        z=np.append((cal.theta - true) / cal.sigmas, np.nan),
        unit=[*(pretty_unit(spec.scaled_unit) for spec in specs), unit],
    )


def screening_text(screening: Screening) -> str:
    """What was rejected and why, at which risk, in a few lines."""
    return told("screening", screening, reasons=REASONS)


def screening_table(screening: Screening) -> TextTable | None:
    """The first rejected rows, each with its reason; None where none is rejected."""
    return rows("screening", screening) if screening.n_rejected else None
