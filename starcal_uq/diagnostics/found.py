"""The attitude error with the misfit found: the second of the two figures that every error has."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from starcal_uq.propagation.onboard_error import OnboardError
from starcal_uq.propagation.propagate import extended_error

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError


def with_misfit(
    error: AttitudeError, diagnosis: Diagnosis, post: Posterior, obs: Observations
) -> AttitudeError:
    """Attitude error including the misfit found by the tests of the model.

    Where they find structure and the data would take up effects, it is the error of the camera that
    was calibrated without them, if the camera with these effects is right: through the geometry of
    the frames, with the posterior of the effects. Where the data support none, and where the
    calibration holds effects already, it is the error if the model holds.

    Parameters
    ----------
    error : AttitudeError
        The propagated posterior.
    diagnosis : Diagnosis
        The tests of the calibration's model (`starcal_uq.diagnose`).
    post, obs : Posterior, Observations
        What the posterior is, and the data that it and the tests rest on.

    Returns
    -------
    AttitudeError
        The same, with its `misfit`; None where tests find structure and effects could not be
        fitted, and by a diagnosis of an earlier version.
    """
    if not diagnosis.assessed:
        return replace(error, misfit=None)
    if diagnosis.extended is not None:
        found = extended_error(error, diagnosis.extended, post, obs)
        return replace(error, misfit=found)
    parts = (error.common_arcsec, error.rest_arcsec, error.calibration_total_arcsec)
    return replace(error, misfit=OnboardError(error.onboard, *parts, error.effects))
