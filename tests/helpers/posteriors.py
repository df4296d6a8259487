"""The normal approximation of a calibration in the place of a posterior."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

import starcal_uq as sc


def normal_posterior(cal: sc.Calibration) -> Any:
    """What propagation and diagnosis read of a posterior, without draws."""
    return SimpleNamespace(
        camera=cal.camera,
        mean=cal.theta,
        covariance=cal.covariance,
        sigma_draws=np.array([cal.sigma]),
        sigma_name=cal.sigma_name,
        provenance=cal.provenance,
        star_error_px=0.0,
        effects=None,
    )
