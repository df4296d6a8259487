"""What the tests of a model say about its attitude error: the second of the two figures that every error has."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.formatting import join_words, plural, significant
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.verdict.estimate import JACKKNIFE_P, JACKKNIFE_RATIO, MISFIT_P
from starcal_uq.propagation.attitude_error import CONTRIBUTORS, MisfitFound

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError

_PIXEL_PHASE = ("pixel phase in x", "pixel phase in y")


def with_misfit(error: AttitudeError, diagnosis: Diagnosis, post: Posterior, obs: Observations) -> AttitudeError:
    """The attitude error with what the tests of the model found.

    - A pattern over the field that a misfit test finds counts with its whole size, as if all stars of a frame shared
      it; about the boresight it is divided by the root mean square distance of the stars from the principal point.
    - A distortion model that predicts as well, but moves the attitudes by more than the standard deviation within the
      fitted one, counts with that difference; every one does if the fitted model is rejected.
    - Frames that disagree more than their formal errors allow multiply common rotation and rest by the jackknife ratio.

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
        The same, with its `misfit`.
    """
    pattern, pattern_reasons = _pattern(diagnosis, post, obs)
    common_shift, rest_shift, common_models, rest_models = _models(error, diagnosis)
    factor, frames = _frames(diagnosis)
    phase = [t for t in diagnosis.misfit.found(MISFIT_P) if t.against in _PIXEL_PHASE]
    notes: tuple[str, ...] = ()
    if phase:
        sizes = join_words([f"{significant(t.size_px)} px with the {t.against}" for t in phase])
        notes = (
            f"Residuals follow the pixel phase ({sizes}): this pixel spatial error is in the estimated noise, and so "
            f"in the {CONTRIBUTORS[0]}; on stars that rest on their pixels it is a bias and not noise.",
        )
    found = MisfitFound(
        factor=factor,
        common_arcsec=common_shift,
        rest_arcsec=np.hypot(pattern, rest_shift),
        common_reasons=(*frames, *common_models),
        rest_reasons=(*pattern_reasons, *frames, *rest_models),
        notes=notes,
    )
    return replace(error, misfit=found)


def _pattern(diagnosis: Diagnosis, post: Posterior, obs: Observations) -> tuple[FloatArray, tuple[str, ...]]:
    """The largest pattern over the field that a misfit test found, arcsec per axis."""
    found = [
        test
        for test in diagnosis.misfit.found(MISFIT_P)
        if test.dof > 0 and test.against not in _PIXEL_PHASE and test.size_px > 0.0
    ]
    if not found:
        return np.zeros(3), ()
    # The tests overlap: they may well see one and the same pattern, so the largest stands for all.
    worst = max(found, key=lambda test: test.size_px)
    x0, y0, focal_px = post.mean[:3]
    radius_px = float(np.sqrt(np.mean((obs.x_px - x0) ** 2 + (obs.y_px - y0) ** 2)))
    cross, roll = worst.size_px / focal_px * ARCSEC, worst.size_px / radius_px * ARCSEC
    others = len(found) - 1
    more = f" (the largest of {plural(others + 1, 'rejected test')})" if others else ""
    reason = (
        f"misfit, {worst.name}{more}: {significant(worst.size_px)} px rms (p = {significant(worst.p_holm)}), counted "
        "whole, not averaged over the stars of a frame"
    )
    return np.array([cross, cross, roll]), (reason,)


def _models(
    attitude: AttitudeError, diagnosis: Diagnosis
) -> tuple[FloatArray, FloatArray, tuple[str, ...], tuple[str, ...]]:
    """Largest shift by models that predict as well: of the common rotation and of the rest, arcsec per axis."""
    common, rest = np.zeros(3), np.zeros(3)
    names: tuple[set[str], set[str]] = (set(), set())
    found = diagnosis.comparison
    if found is None:
        return common, rest, (), ()
    mine = found.of(found.fitted)
    rejected = mine is not None and mine.rejected
    for score in found.scores:
        if score.rejected or score.model == found.fitted:
            continue
        shifts = (np.abs(score.common_arcsec), np.abs(score.rest_arcsec))
        for total, shift, sigma, which in zip(
            (common, rest), shifts, (attitude.common_arcsec, attitude.rest_arcsec), names, strict=True
        ):
            counted = (shift > sigma) | rejected
            if counted.any():
                total[:] = np.maximum(total, np.where(counted, shift, 0.0))
                which.add(score.model)
    how = "is the better model, and moves it" if rejected else "predicts as well, and moves it by more than its sigma"
    reasons = [(f"distortion model {join_words(sorted(which))!r} {how}",) if which else () for which in names]
    return common, rest, reasons[0], reasons[1]


def _frames(diagnosis: Diagnosis) -> tuple[float, tuple[str, ...]]:
    """Factor by which frames disagree more than their formal errors allow."""
    found = diagnosis.jackknife
    if found is None:
        return 1.0, ()
    flagged = (found.p_values * len(found.p_values) < JACKKNIFE_P) & (found.ratio > JACKKNIFE_RATIO)
    if not flagged.any():
        return 1.0, ()
    factor = float(found.ratio[flagged].max())
    return factor, (f"frames disagree {significant(factor, 3)} times as much as their formal errors allow (jackknife)",)
