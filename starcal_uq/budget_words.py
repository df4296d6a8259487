"""Why the bound by the rule and the sampled one differ, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from starcal_uq.budget_rows import CROSS_BORESIGHT, GAUSSIAN_997, Contributor
from starcal_uq.budget_shapes import HALF_WIDTHS, half_width
from starcal_uq.formatting import join_words, percent, significant

if TYPE_CHECKING:
    from starcal_uq.budget_combination import Total

_AGREE = 0.02
_TAILED = 1.01 * GAUSSIAN_997
# Smaller ones, relative to the largest, are left out of a sentence.
_WORTH_NAMING = 0.25


def explain(total: Total, counted: Sequence[Contributor], random: Sequence[Contributor], dominant: Contributor) -> str:
    """One sentence or two on rule against sampling; empty if no error is random."""
    if not total.rule_arcsec > 0.0:
        return "No error is left: all rows are zero."
    difference = total.rule_arcsec / total.sampled_arcsec - 1.0 if total.sampled_arcsec > 0.0 else math.inf
    within = 3.0 * total.sampled_se_arcsec / max(total.sampled_arcsec, 1e-300)
    if abs(difference) <= max(_AGREE, within):
        return f"Both bounds agree within {percent(max(_AGREE, within), 1)}."
    size = percent(abs(difference), 2)
    head = f"The rule is {size} {'above' if difference > 0 else 'below'} the sampled bound"
    reasons = _reasons(total, counted, random, dominant, difference)
    return f"{head}: {reasons}." if reasons else f"{head}."


def _reasons(
    total: Total,
    counted: Sequence[Contributor],
    random: Sequence[Contributor],
    dominant: Contributor,
    difference: float,
) -> str:
    share = f"{dominant.name!r} has {percent(total.dominant_share, 2)} of the squared half-widths"
    shape = dominant.distribution
    if difference < 0.0:
        tailed = dominant if dominant.tail_997 > _TAILED else _heaviest(counted)
        if tailed is not None:
            return (
                f"the sigma of {tailed.name!r} changes from frame to frame, so that 99.7 % of its errors reach "
                f"{significant(tailed.tail_997, 3)} sigma where a Gaussian error reaches 2.97"
            )
        if shape == "rayleigh":
            return f"{share} and is one-sided (Rayleigh), with a longer tail than a Gaussian error"
        if _grouped(random):
            return "rows of a correlation group that are not Gaussian add to a longer tail than their sigmas say"
        return f"{share}"
    if shape in HALF_WIDTHS and shape != "constant" and dominant in random:
        return (
            f"{share}; its distribution is {shape} and ends at {significant(half_width(shape, total.confidence), 3)} "
            f"sigma, where the rule takes {significant(total.factor, 3)}"
        )
    if abs(total.mean_arcsec) > total.sigma_arcsec:
        return "a mean shifts the errors to one side, where fewer sigmas hold the same share than on both sides"
    if total.axis == CROSS_BORESIGHT and any(row.distribution in HALF_WIDTHS for row in random):
        return "bounded distributions on two axes leave less in the corners than Gaussian errors do"
    bounded = [row for row in random if row.distribution in ("uniform", "arcsine")]
    if bounded:
        least = _WORTH_NAMING * max(row.sigma_arcsec for row in bounded)
        names = list(dict.fromkeys(repr(row.name) for row in bounded if row.sigma_arcsec >= least))
        each = "" if len(names) == 1 else " of each"
        factor = significant(total.factor, 3)
        return f"{join_words(names)} cannot exceed a fixed size, while the rule takes {factor} sigma{each}"
    return share


def _heaviest(rows: Sequence[Contributor]) -> Contributor | None:
    tailed = [row for row in rows if row.tail_997 > _TAILED]
    return max(tailed, key=lambda row: row.sigma_arcsec * (row.tail_997 - GAUSSIAN_997)) if tailed else None


def _grouped(rows: Sequence[Contributor]) -> bool:
    groups = [row.correlation_group for row in rows if row.correlation_group]
    return len(set(groups)) < len(groups)
