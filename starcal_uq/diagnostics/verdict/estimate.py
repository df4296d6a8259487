"""Checks of the estimate itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.formatting import fixed, plural
from starcal_uq.diagnostics.verdict.levels import Check, Question, pass_or_fail

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.types import FloatArray
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.inference.posterior import Posterior

ESTIMATORS_Z = 4.0
TRUTH_Z = 4.0


def estimation(cal: Calibration) -> Check:
    """Did the optimiser reach an optimum in every stage?"""
    steps = sum(len(stage.trajectory) - 1 for stage in cal.stages)
    words = cal.status.name.lower().replace("_", " ")
    if cal.status.ok:
        sentence = f"All {plural(len(cal.stages), 'stage')} ended at an optimum, after {plural(steps, 'iteration')}."
    else:
        sentence = f"The estimate is not an optimum: {cal.status.remedy}."
    level = pass_or_fail(cal.status.ok)
    return Check("Estimation", Question.CONVERGED, level, words, "converged", sentence)


def estimators_agree(cal: Calibration) -> Check | None:
    """Do the interstar angles alone (the paper's estimator) lead to the same camera?"""
    difference = np.abs(cal.pair_theta - cal.theta)
    if not np.any(difference > 0.0):
        return None
    # The pair estimator is the less efficient one, so its own covariance bounds that of the difference.
    z = difference / np.sqrt(np.diag(cal.pair_covariance))
    name, largest = cal.parameter_names[int(np.argmax(z))], float(np.max(z))
    good = largest < ESTIMATORS_Z
    sentence = (
        "Interstar angles alone, which do not involve the attitude, give the same camera."
        if good
        else f"Interstar angles alone give another {name}: the data do not fit the model, or a wrong optimum was found."
    )
    level = pass_or_fail(good)
    value = f"{fixed(largest, 1)} sigma ({name})"
    return Check("Two estimators", Question.CONVERGED, level, value, f"< {ESTIMATORS_Z:g} sigma", sentence)


def against_truth(cal: Calibration, truth: Camera, post: Posterior | None = None) -> Check:
    """Errors in units of sigma, where the truth is known."""
    z = truth_z(cal, truth, post)
    name, largest = cal.parameter_names[int(np.argmax(np.abs(z)))], float(np.max(np.abs(z)))
    good = largest < TRUTH_Z
    sentence = (
        "The truth of the simulation lies where the uncertainties say."
        if good
        else f"{name} is further from the truth than its sigma allows: the uncertainties are wrong."
    )
    value = f"largest |z| {fixed(largest, 1)} ({name})"
    return Check("Known truth", Question.TRUSTWORTHY, pass_or_fail(good), value, f"< {TRUTH_Z:g}", sentence)


def truth_z(cal: Calibration, truth: Camera, post: Posterior | None = None) -> FloatArray:
    """(estimate - truth) / sigma of every camera parameter, from the posterior if there is one; shape (p,)."""
    if post is not None:
        return np.asarray((post.mean - truth.theta) / post.sd[: len(post.mean)], dtype=np.float64)
    return np.asarray((cal.theta - truth.theta) / cal.sigmas, dtype=np.float64)
