"""Why the bound by the rule and the sampled one differ, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from starcal_uq.budgeting.rows import GAUSSIAN_997, Contributor
from starcal_uq.budgeting.shapes import half_width
from starcal_uq.core.constants import CROSS_BORESIGHT
from starcal_uq.core.formatting import join_words, percent, significant

if TYPE_CHECKING:
    from starcal_uq.budgeting.totals import Total

_AGREE = 0.02
_BOUNDED = ("uniform", "arcsine")
# A mean of this many sigmas moves the bounds apart.
_MEAN_COUNTS = 0.05
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
    reasons = (_below if difference < 0.0 else _above)(total, counted, random, dominant)
    return f"{head}: {'; '.join(reasons) or 'the rows together are not Gaussian, as the rule takes them to be'}."


def _below(
    total: Total, counted: Sequence[Contributor], random: Sequence[Contributor], dominant: Contributor
) -> list[str]:
    """Why the rule says less."""
    tailed = dominant if dominant.tail_997 > _TAILED else _heaviest(counted)
    if tailed is not None:
        return [
            f"the sigma of {tailed.name!r} changes from frame to frame, so that 99.7 % of its errors reach "
            f"{significant(tailed.tail_997, 3)} sigma where a Gaussian error reaches 2.97"
        ]
    if dominant.distribution == "rayleigh":
        return [f"{_share(total, dominant)} and is one-sided (Rayleigh), with a longer tail than a Gaussian error"]
    if _grouped(random):
        return ["rows of a correlation group that are not Gaussian add to a longer tail than their sigmas say"]
    if dominant.distribution in _BOUNDED and dominant in random:
        return [
            f"{_share(total, dominant)}; its distribution is {dominant.distribution}, and at this confidence reaches "
            "further than a Gaussian error of the same sigma"
        ]
    return []


def _above(
    total: Total, counted: Sequence[Contributor], random: Sequence[Contributor], dominant: Contributor
) -> list[str]:
    """Why the rule says more; the first reason weighs most."""
    shape = dominant.distribution
    if shape in _BOUNDED and dominant in random:
        return [
            f"{_share(total, dominant)}; its distribution is {shape} and ends at "
            f"{significant(half_width(shape, total.confidence), 3)} sigma, where the rule takes "
            f"{significant(total.factor, 3)}"
        ]
    reasons = []
    if abs(total.mean_arcsec) > _MEAN_COUNTS * total.sigma_arcsec:
        reasons.append(
            "the rule adds the whole mean to the spread, as if both always pointed the same way"
            if total.axis == CROSS_BORESIGHT
            else "a mean shifts the errors to one side, where fewer sigmas hold the same share than on both sides"
        )
        if abs(total.mean_arcsec) > total.sigma_arcsec:
            return reasons
    # Small bounded rows explain nothing.
    bounded = [row for row in random if row.distribution in _BOUNDED]
    bounded = [row for row in bounded if row.sigma_arcsec >= _WORTH_NAMING * max(r.sigma_arcsec for r in bounded)]
    if math.hypot(*(row.sigma_arcsec for row in bounded)) >= _WORTH_NAMING * total.sigma_arcsec > 0.0:
        if total.axis == CROSS_BORESIGHT:
            reasons.append("bounded distributions on two axes leave less in the corners than Gaussian errors do")
        else:
            names = list(dict.fromkeys(repr(row.name) for row in bounded))
            each = "" if len(names) == 1 else " of each"
            factor = significant(total.factor, 3)
            reasons.append(f"{join_words(names)} cannot exceed a fixed size, while the rule takes {factor} sigma{each}")
    tailed = _heaviest(random)
    if not reasons and tailed is not None:
        reasons.append(
            f"the sigma of {tailed.name!r} changes from frame to frame, so that at this confidence more of its errors "
            "are small than of a Gaussian error"
        )
    return reasons


def _share(total: Total, dominant: Contributor) -> str:
    return f"{dominant.name!r} has {percent(total.dominant_share, 2)} of the squared half-widths"


def _heaviest(rows: Sequence[Contributor]) -> Contributor | None:
    tailed = [row for row in rows if row.tail_997 > _TAILED]
    return max(tailed, key=lambda row: row.sigma_arcsec * (row.tail_997 - GAUSSIAN_997)) if tailed else None


def _grouped(rows: Sequence[Contributor]) -> bool:
    groups = [row.correlation_group for row in rows if row.correlation_group]
    return len(set(groups)) < len(groups)
