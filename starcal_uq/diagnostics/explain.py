"""What the residuals of a fit that failed show about the observations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starcal_uq.core.errors import CalibrationError

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations


def explain(error: CalibrationError, obs: Observations) -> CalibrationError:
    """Error of a failed calibration, with its explanation where that is known.

    Parameters
    ----------
    error : CalibrationError
        As `calibrate` raised it.
    obs : Observations
        The stars that it was raised for.

    Returns
    -------
    CalibrationError
        With a wrong time of the directions and its remedy, where the residuals of the estimate show
        one; otherwise `error` itself.
    """
    from starcal_uq.diagnostics.verdict.observed import wrong_time

    cal = error.calibration
    if cal is None or not cal.has_residuals:
        return error
    sentence = wrong_time(obs, cal)
    if sentence is None:
        return error
    return CalibrationError(f"{error} First, {sentence}", error.status, error.undetermined)
