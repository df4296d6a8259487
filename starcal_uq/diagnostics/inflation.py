"""What the tests of a model say about its attitude error: the second of the two figures that every error has."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import join_words, significant
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.pattern import Response, response
from starcal_uq.diagnostics.verdict.estimate import disagreeing
from starcal_uq.propagation.attitude_error import CONTRIBUTORS, MisfitFound

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError

# Factors that differ by less are the same.
_ROUNDING = 1e-6


def with_misfit(error: AttitudeError, diagnosis: Diagnosis, post: Posterior, obs: Observations) -> AttitudeError:
    """The attitude error with what the tests of the model found.

    - The pattern that the misfit tests found goes through the geometry of the frames: what it does to their attitudes
      counts, as common rotation and rest, the noise of its amplitudes taken off.
    - A distortion model that predicts as well, but moves the attitudes by more than the standard deviation within the
      fitted one, counts with that difference; every one does if the fitted model is rejected.
      Pattern and model are two views of one error, of which the larger counts.
    - Frames that disagree more than their formal errors allow multiply common rotation and rest by the jackknife ratio,
      over what of it the draws hold already.

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
    if diagnosis.misfit.pattern is None:
        # Of an earlier version: what was found has no shape there.
        return error
    pattern, pattern_reasons = _pattern(error, diagnosis, post, obs)
    common_shift, rest_shift, common_models, rest_models = _models(error, diagnosis)
    factor, frames = _frames(diagnosis, post)
    phase = [name for name in diagnosis.misfit.pattern.families if "pixel phase" in name]
    notes: tuple[str, ...] = ()
    if phase:
        notes = (
            f"Part of the estimated noise is {join_words(phase)}: it counts as a pattern, and in the {CONTRIBUTORS[0]} "
            "as well.",
        )
    found = MisfitFound(
        factor=factor,
        common_arcsec=np.maximum(pattern.common_arcsec, common_shift),
        rest_arcsec=np.maximum(pattern.rest_arcsec, rest_shift),
        common_reasons=(*pattern_reasons[0], *frames, *common_models),
        rest_reasons=(*pattern_reasons[1], *frames, *rest_models),
        notes=notes,
    )
    return replace(error, misfit=found)


def _pattern(
    error: AttitudeError, diagnosis: Diagnosis, post: Posterior, obs: Observations
) -> tuple[Response, tuple[tuple[str, ...], tuple[str, ...]]]:
    """What the pattern that was found does to the attitudes of the frames, and how to say it of each part."""
    pattern = diagnosis.misfit.pattern
    if pattern is None or not pattern.families:
        nothing = np.zeros(3)
        return Response(nothing, nothing, nothing, nothing), ((), ())
    seen = obs if error.seen is None else error.seen
    found = response(pattern, diagnosis.theta, post, obs, seen, error.aligned)
    names = join_words(list(pattern.families))

    def said(value: FloatArray, upper: FloatArray) -> tuple[str, ...]:
        if not upper.any():
            return ()
        pairs = zip(value, upper, strict=True)
        values = ", ".join(f"{significant(float(v))} (at most {significant(float(u))})" for v, u in pairs)
        return (f"misfit, {names}, through the attitudes of these frames: {values} arcsec of {join_words(list(AXES))}",)

    reasons = said(found.common_arcsec, found.common_upper_arcsec), said(found.rest_arcsec, found.rest_upper_arcsec)
    return found, reasons


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
        # A sample of the frames sees no shift below the sigma that it would give by itself.
        sigmas = [sigma / np.sqrt(found.share) for sigma in (attitude.common_arcsec, attitude.rest_arcsec)]
        for total, shift, sigma, which in zip((common, rest), shifts, sigmas, names, strict=True):
            counted = (shift > sigma) | rejected
            if counted.any():
                total[:] = np.maximum(total, np.where(counted, shift, 0.0))
                which.add(score.model)
    how = "better than the fitted one, and moves it" if rejected else "as well, and moves it by more than its sigma"
    reasons = [(f"distortion model {' or '.join(map(repr, sorted(w)))} predicts {how}",) if w else () for w in names]
    return common, rest, reasons[0], reasons[1]


def _frames(diagnosis: Diagnosis, post: Posterior) -> tuple[float, tuple[str, ...]]:
    """Factor by which frames disagree more than their formal errors allow."""
    found = diagnosis.jackknife
    if found is None:
        return 1.0, ()
    flagged = disagreeing(found)
    if not flagged.any():
        return 1.0, ()
    held = 1.0 if post.inflation is None else post.inflation[flagged]
    factor = float(np.max(found.ratio[flagged] / held))
    if factor <= 1.0 + _ROUNDING:
        return 1.0, ()
    return factor, (f"frames disagree {significant(factor, 3)} times as much as their formal errors allow (jackknife)",)
