"""What limits the result, in sentences: the largest term of the attitude error, the coupling, the systematics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.formatting import significant
from starcal_uq.residuals import bin_residuals
from starcal_uq.verdict.observed import ARCSEC_PER_RAD, PATTERN_P

if TYPE_CHECKING:
    from starcal_uq.calibration import Calibration
    from starcal_uq.couplings import Coupling
    from starcal_uq.observations import Observations
    from starcal_uq.propagation import AttitudeError

_STRONG = 0.7
_CROSS = slice(0, 2)


def limits(
    obs: Observations, cal: Calibration, coupling: Coupling | None = None, attitude: AttitudeError | None = None
) -> tuple[str, ...]:
    """What limits the result, the most important first; one sentence each.

    Parameters
    ----------
    obs, cal
        The data and the estimate.
    coupling, attitude
        Results of `starcal_uq.coupling` and `starcal_uq.propagate`, where they exist.
    """
    found = [_systematic(obs, cal)]
    found += [_attitude(attitude)] if attitude is not None else []
    found += [_coupled(coupling)] if coupling is not None else []
    return tuple(sentence for sentence in found if sentence)


def _systematic(obs: Observations, cal: Calibration) -> str:
    binned = bin_residuals(cal, obs)
    if binned.p_value < PATTERN_P:
        arcsec = binned.pattern_px / cal.camera.focal_px * ARCSEC_PER_RAD
        return (
            f"The model: residuals keep a pattern of {significant(arcsec)} arcsec, which more frames will not remove."
        )
    if obs.meta.get("directions") != "apparent":
        return "Knowledge of the directions: until they are known to be apparent, f is conditional on that."
    return ""


def _attitude(error: AttitudeError) -> str:
    """Compare the terms across the boresight, where missions state their requirement."""
    names = ("centroid noise of a single frame", "the calibration's common rotation", "the calibration's rest")
    values = [
        float(np.sqrt(np.mean(np.asarray(v)[_CROSS] ** 2)))
        for v in (error.nea_arcsec, error.common_arcsec, error.rest_arcsec)
    ]
    noise, common, rest = (f"{significant(v)} arcsec" for v in values)
    largest = names[int(np.argmax(values))]
    if values[1] == max(values):
        return (
            f"Attitude across the boresight: {largest} ({common}, one constant) exceeds centroid noise ({noise}, per "
            f"frame). Alignment calibration with these parameters absorbs it; {rest} remains."
        )
    return f"Attitude across the boresight: {largest} dominates (noise {noise}, common rotation {common}, rest {rest})."


def _coupled(coupling: Coupling) -> str:
    pairs = coupling.pairs(_STRONG)
    if not pairs:
        return "Coupling: no two parameters are strongly coupled; every sigma falls as one over the root of the frames."
    first, second, value = pairs[0]
    ratio = coupling.sigma_marginal / coupling.sigma_conditional
    worst = int(np.argmax(ratio))
    return (
        f"Coupling: {first} trades against {second} (correlation {value:.2f}); with the other parameters known, "
        f"{coupling.parameter_names[worst]} would be {significant(float(ratio[worst]))} times better determined."
    ).replace("-", "−")
