"""What the tests of a model say about its attitude error: the second of the two figures that every
error has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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


def with_misfit(
    error: AttitudeError, diagnosis: Diagnosis, post: Posterior, obs: Observations
) -> AttitudeError:
    """The attitude error with what the tests of the model found.

    - The pattern that the misfit tests found goes through the geometry of the frames: what it does
      to their attitudes counts, as common rotation and rest, the noise of its amplitudes taken off.
    - A distortion model that the data prefer to the fitted one counts by how far it moves the
      attitudes, in squares as far as they prefer it (`ModelScore.preferred`); every one that is not
      rejected does in full if the fitted model is. Pattern and model are two views of one error, of
      which the larger counts. What is left of a move that exceeds the standard deviation within the
      fitted model is the choice of the model: stated beside the error.
    - Frames that disagree more than their formal errors allow multiply common rotation and rest by
      the jackknife ratio.

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
    try:
        pattern, pattern_reasons = _pattern(error, diagnosis, post, obs)
    except LookupError:
        # Of an earlier version, which had other shapes.
        return error
    models = _Models.of(error, diagnosis)
    factor, frames = _frames(diagnosis)
    phase = [name for name in diagnosis.misfit.pattern.families if "pixel phase" in name]
    notes: tuple[str, ...] = ()
    if phase:
        notes = (
            f"Part of the estimated noise is {join_words(phase)}: it counts as a pattern, and in "
            f"the {CONTRIBUTORS[0]} "
            "as well.",
        )
    found = MisfitFound(
        factor=factor,
        common_arcsec=np.maximum(pattern.common_arcsec, models.booked[0]),
        rest_arcsec=np.maximum(pattern.rest_arcsec, models.booked[1]),
        common_reasons=(*pattern_reasons[0], *frames, *models.reasons),
        rest_reasons=(*pattern_reasons[1], *frames, *models.reasons),
        notes=notes,
        choice_models=tuple(sorted(models.choice_names)),
        choice_common_arcsec=models.choice[0],
        choice_rest_arcsec=models.choice[1],
    )
    return replace(error, misfit=found)


def _pattern(
    error: AttitudeError, diagnosis: Diagnosis, post: Posterior, obs: Observations
) -> tuple[Response, tuple[tuple[str, ...], tuple[str, ...]]]:
    """What the pattern that was found does to the attitudes of the frames, and how to say it of
    each part.
    """
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
        values = ", ".join(f"{significant(v)} (at most {significant(u)})" for v, u in pairs)
        return (
            (
                f"misfit, {names}, through the attitudes of these frames: {values} arcsec of "
                f"{join_words(list(AXES))}"
            ),
        )

    reasons = (
        said(found.common_arcsec, found.common_upper_arcsec),
        said(found.rest_arcsec, found.rest_upper_arcsec),
    )
    return found, reasons


@dataclass(frozen=True, eq=False)
class _Models:
    """How other distortion models move the common rotation and the rest (2, 3), arcsec per axis."""

    booked: FloatArray  # What the data prefer of it
    choice: FloatArray  # What they do not
    # Models behind each.
    booked_names: set[str]
    choice_names: set[str]

    @classmethod
    def of(cls, attitude: AttitudeError, diagnosis: Diagnosis) -> _Models:
        """The largest moves by any model that is not rejected."""
        made = cls(np.zeros((2, 3)), np.zeros((2, 3)), set(), set())
        found = diagnosis.comparison
        if found is None:
            return made
        mine = found.of(found.fitted)
        rejected = mine is not None and mine.rejected
        # A sample of the frames sees no shift below the sigma that it would give by itself.
        sigma = np.stack((attitude.common_arcsec, attitude.rest_arcsec)) / np.sqrt(found.share)
        for score in found.scores:
            if score.rejected or score.model == found.fitted:
                continue
            weight = 1.0 if rejected else score.preferred
            shift = np.abs((score.common_arcsec, score.rest_arcsec))
            choice = np.where(shift > sigma, shift * np.sqrt(1.0 - weight), 0.0)
            if choice.any():
                np.maximum(made.choice, choice, out=made.choice)
                made.choice_names.add(score.model)
            if weight > 0.0:
                np.maximum(made.booked, shift * np.sqrt(weight), out=made.booked)
                made.booked_names.add(score.model)
        return made

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why `booked` counts."""
        if not self.booked_names:
            return ()
        names = " or ".join(map(repr, sorted(self.booked_names)))
        return (f"distortion model {names} predicts better than the fitted one, and moves it",)


def _frames(diagnosis: Diagnosis) -> tuple[float, tuple[str, ...]]:
    """Factor by which frames disagree more than their formal errors allow."""
    found = diagnosis.jackknife
    if found is None:
        return 1.0, ()
    flagged = disagreeing(found)
    if not flagged.any():
        return 1.0, ()
    factor = float(np.max(found.ratio[flagged]))
    if factor <= 1.0 + _ROUNDING:
        return 1.0, ()
    return factor, (
        (
            f"frames disagree {significant(factor, 3)} times as much as their formal errors allow "
            "(jackknife)"
        ),
    )
