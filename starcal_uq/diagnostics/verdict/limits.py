"""What limits the result: the largest term of the attitude error, the coupling, the systematics."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.findings import Finding
from starcal_uq.diagnostics.residuals import bin_residuals
from starcal_uq.diagnostics.verdict.estimate import MISFIT_P
from starcal_uq.diagnostics.verdict.observed import PATTERN_P

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling

_STRONG = 0.7


# What limits a result.
Limit = Enum(
    "Limit",
    """
    PATTERN DIRECTIONS AIR STRUCTURE ATTITUDE COUPLED FRAMES
    """,
)


def limits(
    obs: Observations,
    cal: Calibration,
    coupling: Coupling | None = None,
    attitude: AttitudeError | None = None,
    diagnosis: Diagnosis | None = None,
) -> tuple[Finding, ...]:
    """What limits the result, the most important first."""
    found = [_systematic(obs, cal)]
    found += [_structure(cal, diagnosis)] if diagnosis is not None else []
    found += [_attitude(attitude)] if attitude is not None else []
    found += [_coupled(coupling)] if coupling is not None else []
    return tuple(one for one in found if one is not None)


def _systematic(obs: Observations, cal: Calibration) -> Finding | None:
    binned = bin_residuals(cal, obs)
    if binned.p_value < PATTERN_P:
        arcsec = binned.pattern_px / cal.camera.focal_px * ARCSEC
        return Finding(Limit.PATTERN, {"pattern_arcsec": arcsec})
    if not obs.origin.apparent:
        return Finding(Limit.DIRECTIONS)
    estimated = cal.known_effects.air is not None
    return Finding(Limit.AIR) if obs.origin.air == "unknown" and not estimated else None


def _structure(cal: Calibration, diagnosis: Diagnosis) -> Finding | None:
    """The largest pattern among those that the tests found."""
    sized = [test for test in diagnosis.misfit.found(MISFIT_P) if test.size_px > 0.0]
    if not sized:
        return None
    worst = max(sized, key=lambda test: test.size_px)
    arcsec = worst.size_px / cal.camera.focal_px * ARCSEC
    facts = {"name": worst.name, "size_px": worst.size_px, "size_arcsec": arcsec}
    return Finding(Limit.STRUCTURE, facts)


def _attitude(error: AttitudeError) -> Finding:
    """Compare the terms across the boresight, where missions state their requirement."""
    names = ("noise", "common", "rest")
    values = error.headline_arcsec[:3, 3]
    largest = "common" if values[1] == max(values) else names[int(np.argmax(values))]
    return Finding(Limit.ATTITUDE, {"largest": largest, "alignment": error.alignment})


def _coupled(coupling: Coupling) -> Finding:
    pairs = coupling.pairs(_STRONG)
    if not pairs:
        return Finding(Limit.FRAMES)
    first, second, value = pairs[0]
    ratio = coupling.sigma_marginal / coupling.sigma_conditional
    worst = int(np.argmax(ratio))
    return Finding(
        Limit.COUPLED,
        {
            "pair": (first, second),
            "correlation": value,
            "parameter": coupling.parameter_names[worst],
            "times": float(ratio[worst]),
        },
    )
