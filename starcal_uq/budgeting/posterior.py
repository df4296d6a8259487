"""The rows of a budget that a calibration fills: with the misfit found, as far as its model was
tested.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.budgeting.rows import (
    ALIGNMENT,
    COMMON,
    FROM_FILE,
    FROM_POSTERIOR,
    GAUSSIAN_997,
    INTERACTING,
    NEA,
    REST,
    Contributor,
    not_assessed,
)
from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import join_words, plural
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.types import FloatArray
from starcal_uq.propagation.attitude_error import (
    CONTRIBUTORS,
    IF_MODEL_HOLDS,
    WITH_MISFIT_FOUND,
    choice,
)

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.attitude_error import AttitudeError


def posterior_rows(attitude: AttitudeError, post: Posterior) -> tuple[Contributor, ...]:
    """Common rotation, rest, centroid noise, and their interaction where it was propagated; each on
    three axes.
    """
    hash_text = (post.provenance.data_sha256 or "")[:12]
    provenance = f"posterior of {plural(len(post.draws), 'draw')}" + (
        f", data {hash_text}" if hash_text else ""
    )
    conditions = f"star geometry of {plural(attitude.n_frames, 'frame')} ({attitude.frames}), "
    conditions += f"{post.camera.distortion} distortion"
    expected = list(FROM_POSTERIOR)
    if np.all(np.isfinite(attitude.interaction_arcsec)):
        expected.append(INTERACTING)
    found = attitude.misfit
    reasons = {} if found is None else {COMMON: found.common_reasons, REST: found.rest_reasons}
    factors = {} if found is None else dict.fromkeys(reasons, found.factor)
    tails = _tails(attitude)
    rows = []
    for entry in expected:
        place = CONTRIBUTORS.index(entry.name)
        held, with_misfit = (
            attitude.if_model_holds_arcsec[place],
            attitude.with_misfit_found_arcsec[place],
        )
        counted = attitude.headline_arcsec[place]
        factor = factors.get(entry.name, 1.0)
        scale = np.divide(factor * held[:3], counted[:3], out=np.zeros(3), where=counted[:3] > 0.0)
        correlation = axis_correlations(attitude.covariance_arcsec2[place], scale)
        alignment = f"; alignment on {attitude.alignment}" if entry.name == COMMON else ""
        for index, axis in enumerate(AXES):
            # What the misfit adds has no frame-by-frame sigma: the excess of the tail shrinks with
            # its share.
            share = (factor * held[index] / counted[index]) ** 2 if counted[index] > 0.0 else 1.0
            excess = tails.get((entry.name, axis), GAUSSIAN_997) - GAUSSIAN_997
            why = "; ".join(reasons.get(entry.name, ())) if counted[index] > held[index] else ""
            rows.append(
                Contributor(
                    name=entry.name,
                    ecss_class=entry.ecss_class,
                    axis=axis,
                    mean_arcsec=0.0,
                    sigma_arcsec=float(counted[index]),
                    distribution=entry.distribution,
                    # Frames that all see the same field: a bias that no moment changes.
                    interpretation="ensemble"
                    if entry.name == REST and attitude.stays[index]
                    else entry.interpretation,
                    absorbed_by_alignment=entry.absorbed_by_alignment,
                    axis_correlation=correlation[index],
                    tail_997=GAUSSIAN_997 + float(share) * excess,
                    conditions=conditions + (f"; inflated: {why}" if why else "") + alignment,
                    provenance=provenance,
                    source="posterior",
                    if_model_holds_arcsec=float(held[index]),
                    with_misfit_found_arcsec=float(with_misfit[index]),
                )
            )
    return tuple(rows)


def misfit_notes(attitude: AttitudeError) -> tuple[str, ...]:
    """What the tests of the model did to the rows, in sentences."""
    found = attitude.misfit
    if found is None:
        return (
            f"The model was not tested: the calibration rows hold {IF_MODEL_HOLDS}, and what "
            "they are "
            f"{WITH_MISFIT_FOUND} is not assessed ({Remedy('diagnose', (RUN,))}).",
        )
    rows = [
        name for name, why in ((COMMON, found.common_reasons), (REST, found.rest_reasons)) if why
    ]
    note = (
        "Inflated by what the tests of the model found: "
        f"{join_words([repr(name) for name in rows])}."
    )
    none = (
        "The tests of the model found nothing that inflates the calibration rows; what they "
        "cannot see is not in them."
    )
    other = (one.sentence for one in choice(attitude))
    return (note if rows else none, *other, *filter(None, found.notes))


def axis_correlations(covariance: FloatArray, scale: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Lines of the correlation matrix, off-diagonal elements scaled down by what is added
    independently; or nothing.
    """
    sigma = np.sqrt(np.diag(covariance))
    if not (np.isfinite(covariance).all() and (sigma > 0.0).all()):
        return ((),) * len(AXES)
    matrix = covariance / np.outer(sigma, sigma) * np.outer(scale, scale)
    np.fill_diagonal(matrix, 1.0)
    return tuple(tuple(float(value) for value in line) for line in matrix)


def alignment_rows(attitude: AttitudeError) -> tuple[Contributor, ...]:
    """The error of the alignment from the noise of its frames, where it was propagated; a file may
    state another.
    """
    expected = next(entry for entry in FROM_FILE if entry.name == ALIGNMENT)
    correlations = axis_correlations(attitude.alignment_covariance_arcsec2, np.ones(3))
    rows = (
        replace(
            not_assessed(expected, axis),
            mean_arcsec=0.0,
            sigma_arcsec=float(sigma),
            axis_correlation=correlation,
            conditions=f"noise of {attitude.alignment}, reference attitude without error",
            provenance="propagated with the posterior",
            source="posterior",
        )
        for axis, sigma, correlation in zip(
            AXES, attitude.alignment_arcsec, correlations, strict=True
        )
    )
    return tuple(row for row in rows if math.isfinite(row.sigma_arcsec))


def _tails(attitude: AttitudeError) -> dict[tuple[str, str], float]:
    """99.7 % half-widths over sigmas as propagated: sigmas that differ from frame to frame make
    them larger.

    Of centroid noise and rest only: common rotations are one Gaussian, and what differs from it in
    their sampled quantile is chance.
    """
    table = attitude.to_dataframe()
    rows = table[table["contributor"].isin((NEA, REST))]
    ratios = (rows["p997_if_model_holds_arcsec"] / rows["if_model_holds_arcsec"]).tolist()
    keys = zip(rows["contributor"].tolist(), rows["axis"].tolist(), strict=True)
    return {
        key: max(ratio, GAUSSIAN_997)
        for key, ratio in zip(keys, ratios, strict=True)
        if math.isfinite(ratio)
    }
