"""The rows of a budget that a calibration fills, inflated where the tests of its model demand it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.rows import COMMON, FROM_POSTERIOR, GAUSSIAN_997, INTERACTING, NEA, REST, Contributor
from starcal_uq.core.constants import ARCSEC, AXES
from starcal_uq.core.formatting import join_words, plural, significant
from starcal_uq.core.types import FloatArray

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations
    from starcal_uq.propagation.attitude_error import AttitudeError

# The same limits as the verdict of the report.
_MISFIT_P, _JACKKNIFE_P, _JACKKNIFE_RATIO = 0.05, 0.01, 1.1
_PIXEL_PHASE = ("pixel phase in x", "pixel phase in y")


@dataclass(frozen=True)
class Inflation:
    """What the tests of the model add to the posterior's own uncertainty.

    Attributes
    ----------
    factor : float
        On the standard deviations of both calibration rows, from the jackknife; 1 if frames agree.
    common_arcsec, rest_arcsec : (3,) array
        Added in squares to the common rotation and to the rest.
    common_reasons, rest_reasons : tuple of str
        Why, for each row; empty if nothing was found.
    notes : tuple of str
        Sentences for the reader of the budget.
    """

    factor: float
    common_arcsec: FloatArray
    rest_arcsec: FloatArray
    common_reasons: tuple[str, ...]
    rest_reasons: tuple[str, ...]
    notes: tuple[str, ...]


def inflation(attitude: AttitudeError, diagnosis: Diagnosis | None, post: Posterior, obs: Observations) -> Inflation:
    """What the diagnosis of a run adds to its calibration rows.

    - A pattern over the field that a misfit test finds counts with its whole size, as if all stars of a frame shared
      it; about the boresight it is divided by the root mean square distance of the stars from the principal point.
    - A distortion model that predicts as well, but moves the attitudes by more than the standard deviation within the
      fitted one, counts with that difference; every one does if the fitted model is rejected.
    - Frames that disagree more than their formal errors allow multiply both rows by the jackknife ratio.
    """
    zero = np.zeros(3)
    if diagnosis is None:
        note = (
            "The model was not tested: without a diagnosis the calibration rows hold no model error "
            "(run `starcal-uq diagnose RUN`)."
        )
        return Inflation(1.0, zero, zero, (), (), (note,))
    pattern, rest_reasons = _pattern(diagnosis, post, obs)
    common_shift, rest_shift, common_models, rest_models = _models(attitude, diagnosis)
    factor, frames = _frames(diagnosis)
    common_reasons = (*frames, *common_models)
    rest_reasons = (*rest_reasons, *frames, *rest_models)
    notes: tuple[str, ...] = (
        "The tests of the model found nothing that inflates the calibration rows; what they cannot see is not in them.",
    )
    if common_reasons or rest_reasons:
        notes = tuple(
            f"The row {name!r} is inflated: {'; '.join(reasons)}."
            for name, reasons in ((COMMON, common_reasons), (REST, rest_reasons))
            if reasons
        )
    phase = [t for t in diagnosis.misfit.found(_MISFIT_P) if t.against in _PIXEL_PHASE]
    if phase:
        sizes = join_words([f"{significant(t.size_px)} px with the {t.against}" for t in phase])
        notes += (
            f"Residuals follow the pixel phase ({sizes}): this pixel spatial error is in the estimated noise, and so "
            f"in the row {NEA!r}; on stars that rest on their pixels it is a bias and not noise.",
        )
    return Inflation(factor, common_shift, np.hypot(pattern, rest_shift), common_reasons, rest_reasons, notes)


def _pattern(diagnosis: Diagnosis, post: Posterior, obs: Observations) -> tuple[FloatArray, tuple[str, ...]]:
    """The largest pattern over the field that a misfit test found, arcsec per axis."""
    found = [
        test
        for test in diagnosis.misfit.found(_MISFIT_P)
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
    flagged = (found.p_values * len(found.p_values) < _JACKKNIFE_P) & (found.ratio > _JACKKNIFE_RATIO)
    if not flagged.any():
        return 1.0, ()
    factor = float(found.ratio[flagged].max())
    return factor, (f"frames disagree {significant(factor, 3)} times as much as their formal errors allow (jackknife)",)


def posterior_rows(
    attitude: AttitudeError, post: Posterior, obs: Observations, added: Inflation
) -> tuple[Contributor, ...]:
    """Common rotation, rest, centroid noise, and their interaction where it was propagated; each on three axes."""
    hash_text = str(post.provenance.get("data_sha256") or "")[:12]
    provenance = f"posterior of {plural(len(post.draws), 'draw')}" + (f", data {hash_text}" if hash_text else "")
    frames = getattr(attitude, "frames", "")
    conditions = f"star geometry of {plural(attitude.n_frames, 'frame')}" + (f" ({frames})" if frames else "")
    conditions += f", {post.camera.distortion} distortion"
    values = {
        COMMON: (attitude.common_arcsec, added.common_arcsec, added.factor, added.common_reasons),
        REST: (attitude.rest_arcsec, added.rest_arcsec, added.factor, added.rest_reasons),
        NEA: (attitude.nea_arcsec, np.zeros(3), 1.0, ()),
    }
    expected = list(FROM_POSTERIOR)
    interaction = getattr(attitude, "interaction_arcsec", None)
    if interaction is not None and np.all(np.isfinite(interaction)):
        expected.append(INTERACTING)
        values[INTERACTING.name] = (np.asarray(interaction, dtype=np.float64), np.zeros(3), 1.0, ())
    tails = _tails(attitude)
    rows = []
    for entry in expected:
        sigma, extra, factor, reasons = values[entry.name]
        inflated = np.hypot(factor * np.asarray(sigma, dtype=np.float64), extra)
        for index, axis in enumerate(AXES):
            larger = bool(inflated[index] > sigma[index])
            # What an inflation adds has no frame-by-frame sigma: the excess of the tail shrinks with its share.
            share = (factor * sigma[index] / inflated[index]) ** 2 if inflated[index] > 0.0 else 1.0
            excess = tails.get((entry.name, axis), GAUSSIAN_997) - GAUSSIAN_997
            rows.append(
                Contributor(
                    name=entry.name,
                    ecss_class=entry.ecss_class,
                    axis=axis,
                    mean_arcsec=0.0,
                    sigma_arcsec=float(inflated[index]),
                    distribution=entry.distribution,
                    interpretation=entry.interpretation,
                    absorbed_by_alignment=entry.absorbed_by_alignment,
                    tail_997=GAUSSIAN_997 + float(share) * excess,
                    conditions=conditions + (f"; inflated: {'; '.join(reasons)}" if larger and reasons else ""),
                    provenance=provenance,
                    source="posterior",
                    raw_sigma_arcsec=float(sigma[index]) if larger else float("nan"),
                )
            )
    return tuple(rows)


def _tails(attitude: AttitudeError) -> dict[tuple[str, str], float]:
    """99.7 % half-widths over sigmas as propagated: sigmas that differ from frame to frame make them larger.

    Of centroid noise and rest only: common rotations are one Gaussian, and what differs from it in their sampled
    quantile is chance.
    """
    table = attitude.to_dataframe()
    rows = table[table["contributor"].isin((NEA, REST)) & (table["sigma_arcsec"] > 0.0)]
    ratios = (rows["p997_arcsec"] / rows["sigma_arcsec"]).tolist()
    keys = zip(rows["contributor"].tolist(), rows["axis"].tolist(), strict=True)
    return {key: max(ratio, GAUSSIAN_997) for key, ratio in zip(keys, ratios, strict=True) if math.isfinite(ratio)}
