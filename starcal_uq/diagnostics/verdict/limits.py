"""What limits the result, in sentences: the largest term of the attitude error, the coupling, the
systematics.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.formatting import significant
from starcal_uq.diagnostics.residuals import bin_residuals
from starcal_uq.diagnostics.verdict.estimate import MISFIT_P
from starcal_uq.diagnostics.verdict.observed import PATTERN_P, air
from starcal_uq.propagation.attitude_error import choice_words, two_figures

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling

_STRONG = 0.7


def limits(
    obs: Observations,
    cal: Calibration,
    coupling: Coupling | None = None,
    attitude: AttitudeError | None = None,
    diagnosis: Diagnosis | None = None,
) -> tuple[str, ...]:
    """What limits the result, the most important first; one sentence each."""
    found = [_systematic(obs, cal)]
    found += [_structure(cal, diagnosis)] if diagnosis is not None else []
    found += [choice_words(attitude), _attitude(attitude)] if attitude is not None else []
    found += [_coupled(coupling)] if coupling is not None else []
    return tuple(sentence for sentence in found if sentence)


def _systematic(obs: Observations, cal: Calibration) -> str:
    binned = bin_residuals(cal, obs)
    if binned.p_value < PATTERN_P:
        arcsec = binned.pattern_px / cal.camera.focal_px * ARCSEC
        return (
            f"The model: residuals keep a pattern of {significant(arcsec)} arcsec, which more "
            "frames will not remove."
        )
    if not obs.origin.apparent:
        return (
            "Knowledge of the directions: until they are known to be apparent, f is conditional "
            "on that."
        )
    if air(obs) == "unknown":
        return (
            "Refraction: until the site is stated, or that the camera was in space, f is "
            "conditional on it."
        )
    return ""


def _structure(cal: Calibration, diagnosis: Diagnosis) -> str:
    """The largest pattern among those that the tests found."""
    sized = [test for test in diagnosis.misfit.found(MISFIT_P) if test.size_px > 0.0]
    if not sized:
        return ""
    worst = max(sized, key=lambda test: test.size_px)
    arcsec = worst.size_px / cal.camera.focal_px * ARCSEC
    return (
        f"The model: the largest structure that it leaves in the residuals is {worst.name}, "
        f"{significant(worst.size_px)} px ({significant(arcsec)} arcsec) per star."
    )


def _attitude(error: AttitudeError) -> str:
    """Compare the terms across the boresight, where missions state their requirement."""
    names = (
        "centroid noise of a single frame",
        "the calibration's common rotation",
        "the calibration's rest",
    )
    values = error.headline_arcsec[:3, 3]
    pairs = zip(
        error.with_misfit_found_arcsec[:3, 3], error.if_model_holds_arcsec[:3, 3], strict=True
    )
    noise, common, rest = (two_figures(*pair) for pair in pairs)
    largest = names[int(np.argmax(values))]
    if values[1] == max(values):
        return (
            f"Attitude across the boresight: {largest}, one constant, exceeds centroid noise: "
            f"{common} against "
            f"{noise} per frame. Alignment calibration with these parameters, on "
            f"{error.alignment}, absorbs it; what "
            f"remains is {rest}."
        )
    return (
        f"Attitude across the boresight: {largest} dominates. Noise: {noise}; common rotation: "
        f"{common}; rest: {rest}."
    )


def _coupled(coupling: Coupling) -> str:
    pairs = coupling.pairs(_STRONG)
    if not pairs:
        return (
            "Coupling: no two parameters are strongly coupled; every sigma falls as one over the "
            "root of the frames."
        )
    first, second, value = pairs[0]
    ratio = coupling.sigma_marginal / coupling.sigma_conditional
    worst = int(np.argmax(ratio))
    return (
        f"Coupling: {first} trades against {second} (correlation {value:.2f}); with the other "
        "parameters known, "
        f"{coupling.parameter_names[worst]} would be {significant(float(ratio[worst]))} times "
        "better determined."
    ).replace("-", "−")
