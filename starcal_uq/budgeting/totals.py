"""Totals of a budget: by the rule of ECSS-E-ST-60-10C, and by sampling the same rows.

By the rule, means add with their signs, sigmas of rows that err together add, everything else adds
in squares, and the bound at a confidence is |mean| + n sigma, with n the Gaussian quantile of that
confidence: two-sided for one axis, that of a two-axis Gaussian error for the angle across the
boresight.

What counts as random depends on what the confidence is about:

- *mixed*: a sensor and a moment taken at random. All rows spread.
- *ensemble*: a sensor taken at random, at its worst moment. Rows that are random in time alone
  enter with their worst.
- *temporal*: the worst sensor, at a moment taken at random. Rows that are random over the ensemble
  alone enter so.

A row that is random over both differs from sensor to sensor and from moment to moment: it spreads
in all three, with its sigma as that of the worst sensor, or of the worst moment. Worst cases are
half-widths at the confidence, and add linearly, as the standard has it; rows of a correlation group
have one worst case, in which their signs count. That all of them meet in one sensor is an upper
bound. Beside it stands what one sensor (or moment) in 1 / (1 - confidence) reaches, with the worst
cases in squares, or sampled. The smaller of both is what the error reaches at the least: only that
can violate a limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from starcal_uq.budgeting.rows import (
    AFTER_AT_LEAST,
    GAUSSIAN_997,
    INTERPRETATIONS,
    SCOPES,
    Contributor,
)
from starcal_uq.budgeting.sampling import N_SAMPLES, Samples, draw, one_of_many, quantile, size_of
from starcal_uq.budgeting.shapes import deviates, half_width, mixture_spread, two_axis_radius
from starcal_uq.core.constants import AXES, CROSS_BORESIGHT, TOTAL_AXES
from starcal_uq.core.findings import Finding
from starcal_uq.core.types import FloatArray

_DOMINANT = 0.5
# Bounds that differ by less agree.
_AGREE = 0.02
_BOUNDED = ("uniform", "arcsine")
# Gaussian deviates on the way of a group from one end to the other; the ends are those of bounded
# rows to rounding.
_ON_THE_WAY = np.linspace(-8.0, 8.0, 801)
# A mean of this many sigmas moves the bounds apart.
_MEAN_COUNTS = 0.05
# Rounding of a rotation: an axis with less of another's error sees nothing of it.
_PERPENDICULAR = 1e-9
_TAILED = 1.01 * GAUSSIAN_997
# Smaller ones, relative to the largest, are left out of a sentence.
_WORTH_NAMING = 0.25


@dataclass(frozen=True)
class Total:
    """The total of a budget in one scope, on one axis, in one interpretation.

    Attributes
    ----------
    scope, axis, interpretation : str
        One of `SCOPES`, `TOTAL_AXES`, `INTERPRETATIONS`.
    confidence : float
        Probability that the bounds hold.
    mean_arcsec : float
        Sum of the means; for both axes together the length of their vector.
    sigma_arcsec : float
        Standard deviation of what counts as random; for both axes, root mean square of the two.
    factor : float
        n: sigmas that the bound takes, NaN if nothing is random.
    worst_arcsec : float
        Sum of what does not count as random, by its half-width, arcsec.
    rule_arcsec, sampled_arcsec : float
        Bound by the rule, and quantile of the sampled error; NaN if no row is assessed. The sampled
        one is NaN too if fewer than 20 samples lie beyond it.
    sampled_se_arcsec : float
        Standard error of the sampled bound.
    rule_least_arcsec, sampled_least_arcsec : float
        Bounds if worst cases of different rows do not meet, and alignment absorbs all of what it
        absorbs in part: only a limit below is violated. That by the rule is never above the sampled
        one, where there is one.
    not_assessed : tuple of str
        Contributors that are missing: with any, the bounds are "at least".
    dominant : str
        Row with more than half of the squared half-widths, or empty.
    dominant_share : float
        Share of the dominant row; of the largest row if none has more than half.
    difference : Finding, optional
        Why the two bounds differ, or that they agree.
    of_index : str
        Error index with its times, such as ``AKE`` or ``RPE 300 s``.
    at_most : tuple of str
        Contributors whose behaviour in time is not stated: the index takes them at their largest.
    """

    DOCUMENTED: ClassVar = ("at_least",)
    WRITTEN_AS: ClassVar = {"difference": ("explanation",)}

    scope: str
    axis: str
    interpretation: str
    confidence: float
    mean_arcsec: float
    sigma_arcsec: float
    factor: float
    worst_arcsec: float
    rule_arcsec: float
    sampled_arcsec: float
    sampled_se_arcsec: float
    rule_least_arcsec: float = math.nan
    sampled_least_arcsec: float = math.nan
    not_assessed: tuple[str, ...] = field(default=())
    dominant: str = ""
    dominant_share: float = math.nan
    difference: Finding | None = None
    of_index: str = "AKE"
    at_most: tuple[str, ...] = field(default=())

    @property
    def explanation(self) -> str:
        """Why the two bounds differ, or that they agree."""
        return "" if self.difference is None else self.difference.sentence

    @property
    def at_least(self) -> bool:
        """True while contributors are missing."""
        return bool(self.not_assessed)

    @property
    def larger_arcsec(self) -> float:
        """The larger of the two bounds; NaN if one is not known."""
        return (
            math.nan
            if math.isnan(self.sampled_arcsec)
            else max(self.rule_arcsec, self.sampled_arcsec)
        )

    @property
    def unresolved(self) -> bool:
        """True if rows are assessed, but the samples do not reach as far as the confidence."""
        return math.isnan(self.sampled_arcsec) and not math.isnan(self.rule_arcsec)


def covariance(rows: Sequence[Contributor]) -> FloatArray:
    """Covariance (3, 3) of the sum of rows, arcsec^2: groups err as one, axes as their contributor
    says.
    """
    together: dict[str, FloatArray] = {}
    apart: dict[str, list[Contributor]] = {}
    for row in rows:
        group, sign = row.group
        if group:
            together.setdefault(group, np.zeros(3))[AXES.index(row.axis)] += sign * row.sigma_arcsec
        else:
            apart.setdefault(row.name, []).append(row)
    matrix = sum((np.outer(sigma, sigma) for sigma in together.values()), start=np.zeros((3, 3)))
    for members in apart.values():
        for row in members:
            i = AXES.index(row.axis)
            matrix[i, i] += row.sigma_arcsec**2
            for other in members:
                j = AXES.index(other.axis)
                if i != j and row.axis_correlation:
                    matrix[i, j] += row.axis_correlation[j] * row.sigma_arcsec * other.sigma_arcsec
    return matrix


def total(
    rows: Sequence[Contributor],
    samples: Samples,
    *,
    scope: str,
    axis: str,
    interpretation: str,
    confidence: float,
    rotation: FloatArray | None = None,
) -> Total:
    """One total, by the rule and from the samples, with their difference explained.

    The axes are those of the sensor, or of a frame with v_frame = `rotation` @ v_sensor.
    """
    names = AXES[:2] if axis == CROSS_BORESIGHT else (axis,)
    along = (np.eye(3) if rotation is None else rotation)[[AXES.index(name) for name in names]]
    seen = {
        name
        for name, column in zip(AXES, along.T, strict=True)
        if np.abs(column).max() > _PERPENDICULAR
    }
    chosen = [row for row in rows if row.axis in seen and row.counts(scope)]
    missing = tuple(dict.fromkeys(row.name for row in chosen if not row.assessed))
    counted = [row for row in chosen if row.assessed and row.applies]
    if not counted:
        nan = math.nan
        return Total(scope, axis, interpretation, confidence, *(nan,) * 7, not_assessed=missing)
    here = _bounds(counted, samples, scope, along, interpretation, confidence)
    certain, at_least = counted, here
    if scope == SCOPES[1]:
        certain = [row for row in counted if row.counts(AFTER_AT_LEAST)]
    if len(certain) < len(counted):
        at_least = _bounds(certain, samples, AFTER_AT_LEAST, along, interpretation, confidence)
    dominant, share = _dominant(counted, along, confidence)
    sampled_least = min(at_least.sampled_least, here.sampled)
    result = Total(
        scope=scope,
        axis=axis,
        interpretation=interpretation,
        confidence=confidence,
        mean_arcsec=here.mean,
        sigma_arcsec=here.sigma,
        factor=here.radius / here.sigma if here.sigma > 0.0 else math.nan,
        worst_arcsec=here.worst,
        rule_arcsec=here.rule,
        sampled_arcsec=here.sampled,
        sampled_se_arcsec=here.error,
        # Samples that do not resolve the confidence are no bound: `min` keeps what stands before a
        # NaN.
        rule_least_arcsec=min(at_least.rule_least, here.rule, sampled_least),
        sampled_least_arcsec=sampled_least,
        not_assessed=missing,
        dominant=dominant.name if share > _DOMINANT else "",
        dominant_share=share,
    )
    if result.unresolved:
        n = next(iter(samples.sums.values())).shape[1]
        facts = {"n_samples": n, "confidence": confidence}
        return replace(result, difference=Finding(Difference.NOT_RESOLVED, facts))
    return replace(
        result, difference=explain(result, counted, _spread(counted, interpretation), dominant)
    )


@dataclass(frozen=True)
class _Bounds:
    """What some rows reach in one scope; arcsec."""

    mean: float
    sigma: float
    radius: float
    worst: float
    rule: float
    rule_least: float
    sampled: float
    error: float
    sampled_least: float


def _bounds(
    rows: Sequence[Contributor],
    samples: Samples,
    scope: str,
    along: FloatArray,
    interpretation: str,
    confidence: float,
) -> _Bounds:
    random = _spread(rows, interpretation)
    worst = [row for row in rows if row not in random]
    mean = along @ [sum(row.mean_arcsec for row in rows if row.axis == name) for name in AXES]
    spread = along @ covariance(random) @ along.T
    radius = _radius(confidence, spread)
    together, apart = _worst(worst, along, confidence, by_shape=False)
    by_shape, _ = _worst(worst, along, confidence, by_shape=True)
    chance = samples.along(along, scope, _random(interpretation))
    sampled, error = quantile(_meeting(mean, by_shape, chance)[:, None] + chance, confidence)
    least = sampled
    if by_shape > 0.0:
        rest = mean[:, None] + samples.along(along, scope, _worst_kinds(interpretation))
        least = min(one_of_many(rest, chance, confidence), sampled)
    length = float(np.linalg.norm(mean))
    return _Bounds(
        mean=length if len(mean) > 1 else float(mean[0]),
        sigma=math.sqrt(float(np.trace(spread)) / len(along)),
        radius=radius,
        worst=together,
        rule=length + radius + together,
        rule_least=length + radius + apart,
        sampled=sampled,
        error=error,
        sampled_least=least,
    )


def _spread(rows: Sequence[Contributor], interpretation: str) -> list[Contributor]:
    return [row for row in rows if row.interpretation in _random(interpretation)]


# Why the bound by the rule and that from the samples differ; in words in a file of an earlier
# version.
Difference = Enum(
    "Difference",
    """
    NOT_RESOLVED NO_ERROR AGREE DIFFER CHANGING_SIGMA SMALL_MOSTLY ONE_SIDED GROUP
    REACHES_FURTHER ENDS MEAN_ADDED MEAN_SHIFTS WORST_CASE CORNERS BOUNDED IN_WORDS
    """,
)


def read_difference(plain: Any) -> Any:
    """A difference of its plain values, or a value of it."""
    if isinstance(plain, list):
        return tuple(map(read_difference, plain))
    if not isinstance(plain, dict):
        return plain
    values = {name: read_difference(value) for name, value in plain["values"].items()}
    return Finding(Difference[plain["code"]], values)


def explain(
    total: Total,
    counted: Sequence[Contributor],
    random: Sequence[Contributor],
    dominant: Contributor,
) -> Finding:
    """Compare the rule with sampling."""
    if not total.rule_arcsec > 0.0:
        return Finding(Difference.NO_ERROR)
    difference = total.rule_arcsec / total.sampled_arcsec - 1.0
    within = max(_AGREE, 3.0 * total.sampled_se_arcsec / total.sampled_arcsec)
    if abs(difference) <= within:
        return Finding(Difference.AGREE, {"within": within})
    return Finding(
        Difference.DIFFER,
        {
            "size": abs(difference),
            "side": "above" if difference > 0.0 else "below",
            "reasons": tuple(
                (_below if difference < 0.0 else _above)(total, counted, random, dominant)
            ),
        },
    )


def _below(
    total: Total,
    counted: Sequence[Contributor],
    random: Sequence[Contributor],
    dominant: Contributor,
) -> list[Finding]:
    """Why the rule says less."""
    tailed = dominant if dominant.tail_997 > _TAILED else _heaviest(counted)
    if tailed is not None:
        tail = {"row": tailed.name, "tail_sigma": tailed.tail_997}
        return [Finding(Difference.CHANGING_SIGMA, tail)]
    share = {"row": dominant.name, "share": total.dominant_share}
    if dominant.distribution == "rayleigh":
        return [Finding(Difference.ONE_SIDED, share)]
    if _grouped(random):
        return [Finding(Difference.GROUP)]
    if dominant.distribution in _BOUNDED and dominant in random:
        return [Finding(Difference.REACHES_FURTHER, share | {"shape": dominant.distribution})]
    return []


def _above(
    total: Total,
    counted: Sequence[Contributor],
    random: Sequence[Contributor],
    dominant: Contributor,
) -> list[Finding]:
    """Why the rule says more; the first reason weighs most."""
    shape = dominant.distribution
    if shape in _BOUNDED and dominant in random:
        end = half_width(shape, total.confidence)
        share = {"row": dominant.name, "share": total.dominant_share, "shape": shape}
        return [Finding(Difference.ENDS, share | {"end_sigma": end, "factor": total.factor})]
    reasons = []
    if abs(total.mean_arcsec) > _MEAN_COUNTS * total.sigma_arcsec:
        reasons.append(
            Finding(
                Difference.MEAN_ADDED if total.axis == CROSS_BORESIGHT else Difference.MEAN_SHIFTS
            )
        )
        if abs(total.mean_arcsec) > total.sigma_arcsec:
            return reasons
    if total.worst_arcsec > _MEAN_COUNTS * total.sigma_arcsec > 0.0:
        reasons.append(Finding(Difference.WORST_CASE))
    # Small bounded rows explain nothing.
    bounded = [row for row in random if row.distribution in _BOUNDED]
    bounded = [
        row
        for row in bounded
        if row.sigma_arcsec >= _WORTH_NAMING * max(r.sigma_arcsec for r in bounded)
    ]
    if (
        math.hypot(*(row.sigma_arcsec for row in bounded))
        >= _WORTH_NAMING * total.sigma_arcsec
        > 0.0
    ):
        rows = tuple(dict.fromkeys(row.name for row in bounded))
        reasons.append(
            Finding(Difference.CORNERS)
            if total.axis == CROSS_BORESIGHT
            else Finding(Difference.BOUNDED, {"rows": rows, "factor": total.factor})
        )
    tailed = _heaviest(random)
    if not reasons and tailed is not None:
        reasons.append(Finding(Difference.SMALL_MOSTLY, {"row": tailed.name}))
    return reasons


def _heaviest(rows: Sequence[Contributor]) -> Contributor | None:
    tailed = [row for row in rows if row.tail_997 > _TAILED]
    return (
        max(tailed, key=lambda row: row.sigma_arcsec * (row.tail_997 - GAUSSIAN_997))
        if tailed
        else None
    )


def _grouped(rows: Sequence[Contributor]) -> bool:
    groups = [row.group[0] for row in rows if row.correlation_group]
    return len(set(groups)) < len(groups)


def grouped_sigma(rows: Sequence[Contributor]) -> float:
    """Standard deviation of the sum of rows on one axis: linear within groups, in squares
    otherwise.
    """
    return math.sqrt(max(float(np.trace(covariance(rows))), 0.0))


def _radius(confidence: float, spread: FloatArray, tail: float = GAUSSIAN_997) -> float:
    """Half-width that holds a Gaussian error of this covariance (k, k) on one axis or two."""
    if len(spread) == 1:
        return half_width("gaussian", confidence, tail) * math.sqrt(max(float(spread[0, 0]), 0.0))
    # Independent in the axes of its ellipse; rounded, that equal ellipses are found again.
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))
    small, large = (float(f"{value:.12g}") for value in sigma)
    return two_axis_radius(confidence, large, small, mixture_spread(tail))


def _random(interpretation: str) -> tuple[str, ...]:
    """Kinds of rows that spread in this interpretation."""
    return INTERPRETATIONS if interpretation == "mixed" else (interpretation, "mixed")


def _worst_kinds(interpretation: str) -> tuple[str, ...]:
    return tuple(kind for kind in INTERPRETATIONS if kind not in _random(interpretation))


def _worst(
    rows: Sequence[Contributor], along: FloatArray, confidence: float, *, by_shape: bool
) -> tuple[float, float]:
    """Half-widths of what errs alone, added linearly, and in squares; a group reaches as far as the
    sum of its rows.

    Half-widths are those of the distributions themselves, or take the rule's Gaussian factor where
    they are unbounded.
    """
    alone: dict[str, list[Contributor]] = {}
    together: dict[str, list[Contributor]] = {}
    for row in rows:
        group, _ = row.group
        (together if group else alone).setdefault(group or row.name, []).append(row)
    reached = [_reach(members, along, confidence, by_shape=by_shape) for members in alone.values()]
    reached += [
        _reach_together(members, along, confidence, by_shape=by_shape)
        for members in together.values()
    ]
    return sum(reached, start=0.0), math.hypot(*reached)


def _reach(
    rows: Sequence[Contributor], along: FloatArray, confidence: float, *, by_shape: bool
) -> float:
    """Half-width of one contributor on an axis, or on two together."""
    gaussian = [row for row in rows if row.distribution == "gaussian"]
    tail = max([GAUSSIAN_997, *(row.tail_997 for row in gaussian)]) if by_shape else GAUSSIAN_997
    bounded = np.zeros(3)
    for row in rows:
        if row.distribution != "gaussian":
            bounded[AXES.index(row.axis)] += (
                half_width(row.distribution, confidence) * row.sigma_arcsec
            )
    spread = along @ covariance(gaussian) @ along.T
    # Seen from other axes, ends of several axes meet in a corner.
    return _radius(confidence, spread, tail) + float(np.linalg.norm(np.abs(along) @ bounded))


def _reach_together(
    rows: Sequence[Contributor], along: FloatArray, confidence: float, *, by_shape: bool
) -> float:
    """Furthest that the rows of a group reach: one probability moves all, each to its own
    half-width at most.

    Where their signs and shapes differ, that may be on the way and not at an end.
    """
    from scipy.special import ndtr

    uniform = ndtr(_ON_THE_WAY)
    errors = np.zeros((3, len(uniform)))
    for row in rows:
        end = half_width(row.distribution, confidence, row.tail_997 if by_shape else GAUSSIAN_997)
        deviate = deviates(row.distribution, uniform, uniform, GAUSSIAN_997)
        errors[AXES.index(row.axis)] += (
            row.group[1] * row.sigma_arcsec * np.clip(deviate, -end, end)
        )
    return float(size_of(along @ errors).max())


def _meeting(mean: FloatArray, worst: float, chance: FloatArray) -> FloatArray:
    """The mean with a worst case of this length beside it, in the direction that reaches
    furthest.
    """
    if worst == 0.0:
        return mean
    if len(mean) == 1:
        towards = np.array([[1.0], [-1.0]])
    else:
        angle = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
        towards = np.column_stack((np.cos(angle), np.sin(angle)))
    reached = mean + worst * towards
    size = np.linalg.norm(reached, axis=1)
    spread = np.atleast_2d(np.cov(chance, bias=True))
    along = np.sqrt(np.einsum("ni,ij,nj->n", reached, spread, reached)) / np.maximum(size, 1e-300)
    furthest: FloatArray = reached[int(np.argmax(size + 2.0 * along))]
    return furthest


def _dominant(
    rows: Sequence[Contributor], along: FloatArray, confidence: float
) -> tuple[Contributor, float]:
    """The row that matters most, and its share of the squares of means and half-widths."""
    weight: dict[str, float] = {}
    part = dict(zip(AXES, np.linalg.norm(along, axis=0), strict=True))
    for row in rows:
        size = (
            abs(row.mean_arcsec)
            + half_width(row.distribution, confidence, row.tail_997) * row.sigma_arcsec
        )
        weight[row.name] = weight.get(row.name, 0.0) + float(part[row.axis] * size) ** 2
    whole = sum(weight.values())
    name = max(weight, key=lambda key: weight[key])
    first = max((row for row in rows if row.name == name), key=lambda row: row.sigma_arcsec)
    return first, weight[name] / whole if whole > 0.0 else 0.0


def totals(
    rows: Sequence[Contributor],
    confidence: float,
    *,
    of_index: str = "AKE",
    at_most: Sequence[str] = (),
    n_samples: int = N_SAMPLES,
    seed: int = 0,
) -> tuple[tuple[Total, ...], Samples]:
    """All totals of an index: both scopes, three axes and the two across the boresight together,
    three interpretations.
    """
    samples = draw(rows, n_samples, seed)
    found = (
        total(rows, samples, scope=scope, axis=axis, interpretation=kind, confidence=confidence)
        for scope in SCOPES
        for axis in TOTAL_AXES
        for kind in ("mixed", "ensemble", "temporal")
    )
    return tuple(replace(one, of_index=of_index, at_most=tuple(at_most)) for one in found), samples
