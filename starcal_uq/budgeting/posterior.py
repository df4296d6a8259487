"""The rows of a budget that a calibration fills: with the misfit found, as far as its model was
tested.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.budgeting.rows import (
    ALIGNMENT,
    COMMON,
    FROM_FILE,
    FROM_POSTERIOR,
    GAUSSIAN_997,
    INTERACTING,
    NEA,
    OF_EFFECTS,
    REST,
    Contributor,
    Expected,
    Remark,
    not_assessed,
)
from starcal_uq.core.constants import AXES
from starcal_uq.core.findings import clause
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.propagation.attitude_error import CONTRIBUTORS
from starcal_uq.propagation.onboard_error import OnboardError, with_cross
from starcal_uq.propagation.thermal import TEMPERATURE

if TYPE_CHECKING:
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.onboard_error import EffectError

# What alignment takes up of an effect is a row of its own.
_IN_COMMON = ", common rotation"
# What is below this is rounding, arcsec.
_NOTHING_ARCSEC = 1e-9
_ZERO = np.zeros(3)


def posterior_rows(attitude: AttitudeError, post: Posterior) -> tuple[Contributor, ...]:
    """Common rotation, rest, centroid noise, and their interaction where it was propagated; each on
    three axes.

    Where the calibration holds effects, these are the shares of the camera's parameters and of the
    noise alone: effects have rows of their own.
    """
    attitude = without_effects(attitude)
    provenance = clause(
        Remark.OF_DRAWS, draws=len(post.draws), sha256=post.provenance.data_sha256 or ""
    )
    expected = list(FROM_POSTERIOR)
    if np.all(np.isfinite(attitude.interaction_arcsec)):
        expected.append(INTERACTING)
    tails = _tails(attitude)
    names = _effects(attitude)
    rows = []
    for entry in expected:
        place = CONTRIBUTORS.index(entry.name)
        held = attitude.if_model_holds_arcsec[place]
        with_misfit = attitude.with_misfit_found_arcsec[place]
        counted = attitude.headline_arcsec[place]
        scale = np.divide(held[:3], counted[:3], out=np.zeros(3), where=counted[:3] > 0.0)
        scale = np.minimum(scale, 1.0)
        correlation = axis_correlations(attitude.covariance_arcsec2[place], scale)
        conditions = clause(
            Remark.OF_FRAMES,
            attitude=attitude,
            distortion=post.camera.distortion,
            effects=names if entry.name in (COMMON, REST) else [],
            aligned=entry.name == COMMON,
        )
        for index, axis in enumerate(AXES):
            # What effects add has no frame-by-frame sigma: the excess of the tail shrinks with its
            # share.
            share = scale[index] ** 2 if counted[index] > 0.0 else 1.0
            excess = tails.get((entry.name, axis), GAUSSIAN_997) - GAUSSIAN_997
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
                    conditions=conditions,
                    provenance=provenance,
                    source="posterior",
                    if_model_holds_arcsec=float(held[index]),
                    with_misfit_found_arcsec=float(with_misfit[index]),
                )
            )
    return tuple(rows)


def without_effects(attitude: AttitudeError) -> AttitudeError:
    """The attitude error less the shares of effects."""
    own = None if attitude.aboard is None else attitude.aboard.parameters
    if own is None:
        return attitude
    star = next((each for each in attitude.effects if each.name == "star"), None)
    noise = attitude.nea_arcsec
    if star is not None:
        noise = np.sqrt(np.maximum(noise**2 - star.rest_arcsec**2, 0.0))
    sigmas = np.stack([noise, own.common_arcsec, own.rest_arcsec])
    before = attitude.if_model_holds_arcsec[:3, :3]
    scale = np.divide(sigmas, before, out=np.zeros((3, 3)), where=before > 0.0)
    covariance = attitude.covariance_arcsec2.copy()
    covariance[0] *= np.outer(scale[0], scale[0])
    covariance[1], covariance[2] = own.common_covariance_arcsec2, own.rest_covariance_arcsec2
    scale = np.stack([with_cross(line) for line in scale])
    widths = attitude.p95_arcsec.copy(), attitude.p997_arcsec.copy()
    for width in widths:
        width[:3] *= scale
    both = np.hypot(own.common_arcsec, own.rest_arcsec)
    parts = OnboardError(attitude.onboard, own.common_arcsec, own.rest_arcsec, both, ())
    return replace(
        attitude,
        misfit=None if attitude.misfit is None else parts,
        nea_arcsec=noise,
        common_arcsec=own.common_arcsec,
        rest_arcsec=own.rest_arcsec,
        p95_arcsec=widths[0],
        p997_arcsec=widths[1],
        total_arcsec=both,
        rest_constant_arcsec=own.rest_constant_arcsec,
        covariance_arcsec2=covariance,
        variants=(),
    )


def effect_rows(attitude: AttitudeError, post: Posterior) -> tuple[Contributor, ...]:
    """What the software aboard leaves of each effect, on three axes; its common rotation by
    itself.
    """
    if attitude.aboard is None or attitude.aboard.parameters is None:
        return ()
    thermal = attitude.thermal
    rows = []
    for share in attitude.effects:
        if share.name == TEMPERATURE and thermal is not None:
            share = thermal.share(attitude.onboard)
        rows += _rows_of(share, attitude)
    if post.effects is not None and "zenith" in post.effects.names:
        expected = OF_EFFECTS["zenith"]
        rows += [
            replace(
                not_assessed(expected, axis),
                mean_arcsec=0.0,
                sigma_arcsec=0.0,
                applies=False,
                conditions="the calibration saw stars through air; a mission above it sees none",
                provenance="effect 'zenith' of the calibration",
                source="posterior",
            )
            for axis in AXES
        ]
    return tuple(rows)


def _rows_of(share: EffectError, attitude: AttitudeError) -> list[Contributor]:
    """The rest of an effect, and what is in common; of frames by themselves nothing is."""
    expected = OF_EFFECTS[share.name]
    thermal = attitude.thermal if share.name == TEMPERATURE else None
    facts = {"attitude": attitude, "thermal": thermal}
    constant = share.rest_constant_arcsec**2 > 0.5 * np.diag(share.rest_covariance_arcsec2)
    entries = {
        "conditions": clause(Remark.OF_EFFECT, **facts),
        "provenance": "effect of the calibration, propagated with the posterior",
        "source": "posterior",
    }
    rest = of_axes(expected, share.rest_covariance_arcsec2, share.rest_mean_arcsec, **entries)
    for index, row in enumerate(rest):
        if constant[index]:
            rest[index] = replace(row, interpretation="ensemble")
        elif thermal is not None and row.sigma_arcsec > _NOTHING_ARCSEC:
            # A short peak of the temperature is beyond what the root mean square says.
            peak = float(thermal.peak_arcsec(attitude.onboard)[index])
            tail = (peak - abs(row.mean_arcsec)) / row.sigma_arcsec
            words = clause(Remark.OF_EFFECT, **facts, peak_arcsec=peak)
            rest[index] = replace(row, conditions=words, tail_997=max(GAUSSIAN_997, tail))
    common = []
    if share.name != "frame" and share.common_arcsec.max() > _NOTHING_ARCSEC:
        shared = replace(
            expected,
            name=expected.name + _IN_COMMON,
            ecss_class="bias",
            interpretation="ensemble",
            # Alignment and mission may have different nights.
            absorbed_by_alignment="in part" if share.name == "epoch" else "yes",
        )
        matrix, mean = share.common_covariance_arcsec2, share.common_mean_arcsec
        common = of_axes(shared, matrix, mean, **entries)
    tested = attitude.misfit is not None
    return [
        replace(
            row,
            if_model_holds_arcsec=row.sigma_arcsec,
            with_misfit_found_arcsec=row.sigma_arcsec if tested else math.nan,
        )
        for row in common + rest
    ]


def of_axes(
    expected: Expected, covariance: FloatArray, mean: FloatArray = _ZERO, **entries: Any
) -> list[Contributor]:
    """A row on three axes from covariance (3, 3) and means (3,), arcsec, with other entries."""
    sigma = root_diagonal(covariance)
    correlations = axis_correlations(covariance, np.ones(3))
    return [
        replace(
            not_assessed(expected, axis),
            mean_arcsec=float(mean[index]),
            sigma_arcsec=float(sigma[index]),
            axis_correlation=correlations[index],
            **entries,
        )
        for index, axis in enumerate(AXES)
    ]


def stated_instead(
    rows: Sequence[Contributor], stated: Sequence[Contributor]
) -> tuple[tuple[Contributor, ...], tuple[Contributor, ...]]:
    """Rows of effects that count, and those in whose place a file states its own on that axis.

    A statement is of the whole effect: the row of its common rotation then counts as none.
    """
    given = {(row.name, row.axis) for row in stated}
    kept, replaced = [], []
    for row in rows:
        whole = row.name.removesuffix(_IN_COMMON)
        if (whole, row.axis) not in given and (row.name, row.axis) not in given:
            kept.append(row)
            continue
        replaced.append(row)
        if row.name != whole and (row.name, row.axis) not in given:
            kept.append(
                replace(
                    row,
                    mean_arcsec=0.0,
                    sigma_arcsec=0.0,
                    applies=False,
                    conditions=f"in the row {whole!r}, which the file states",
                )
            )
    return tuple(kept), tuple(replaced)


def misfit_notes(attitude: AttitudeError) -> tuple[str, ...]:
    """What the tests of the model did to the rows, in sentences."""
    if attitude.misfit is None:
        return (clause(Remark.UNTESTED),)
    return (clause(Remark.SUPPORTED, effects=_effects(attitude), common=COMMON, rest=REST),)


def _effects(attitude: AttitudeError) -> list[str]:
    """The effects that the calibration lacks and its data support."""
    if attitude.misfit is None or attitude.variants:
        return []
    return [effect.name for effect in attitude.misfit.effects]


def axis_correlations(covariance: FloatArray, scale: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Lines of the correlation matrix, off-diagonal elements scaled down by what is added
    independently; or nothing.
    """
    variances = np.diag(covariance)
    if not (np.isfinite(covariance).all() and (variances > 0.0).any()):
        return ((),) * len(AXES)
    # What is zero about an axis leans on no other.
    sigma = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    matrix = covariance / np.outer(sigma, sigma) * np.outer(scale, scale)
    np.fill_diagonal(matrix, 1.0)
    return tuple(tuple(float(value) for value in line) for line in matrix)


def alignment_rows(attitude: AttitudeError) -> tuple[Contributor, ...]:
    """The error of the alignment from the noise of its frames, where it was propagated; a file may
    state another.
    """
    expected = next(entry for entry in FROM_FILE if entry.name == ALIGNMENT)
    rows = of_axes(
        expected,
        attitude.alignment_covariance_arcsec2,
        conditions=f"noise of {attitude.alignment}, reference attitude without error",
        provenance="propagated with the posterior",
        source="posterior",
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
