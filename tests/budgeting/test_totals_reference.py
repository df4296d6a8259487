"""All totals of a budget a second time, row by row and by other formulas."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy import linalg, optimize, special, stats

from starcal_uq.budgeting.rows import GAUSSIAN_997, Contributor
from starcal_uq.budgeting.shapes import RAYLEIGH_MEAN, half_width, mixture_spread, two_axis_radius
from starcal_uq.budgeting.totals import Difference, Total, explain, totals
from starcal_uq.core.constants import AXES, CROSS_BORESIGHT, TOTAL_AXES

CONFIDENCE, SAMPLES, SEED = 0.95, 20_000, 3
CORRELATION = ((1.0, 0.3, -0.1), (0.3, 1.0, 0.8), (-0.1, 0.8, 1.0))
SCOPES = ("before alignment", "after alignment")
KINDS = ("mixed", "ensemble", "temporal")


def row(
    name: str, axis: str, sigma: float, interpretation: str = "ensemble", **changes: Any
) -> Contributor:
    stated: dict[str, Any] = {
        "mean_arcsec": 0.0,
        "sigma_arcsec": sigma,
        "source": "file",
        **changes,
    }
    return Contributor(name, "other", axis, interpretation=interpretation, **stated)


def rows_of_all_kinds() -> list[Contributor]:
    """Each shape, group, kind of randomness, place in an alignment and state of knowledge at least
    once.
    """
    lines = dict(zip(AXES, CORRELATION, strict=True))
    kept: list[Contributor] = []
    for axis, noise, rest, common in zip(
        AXES, (1.0, 1.2, 6.0), (0.5, 0.6, 0.8), (4.0, 5.0, 0.1), strict=True
    ):
        kept += [
            row("noise", axis, noise, "temporal", tail_997=3.4),
            row("rest", axis, rest, "mixed", tail_997=3.1, axis_correlation=lines[axis]),
            row("common", axis, common, axis_correlation=lines[axis], absorbed_by_alignment="yes"),
            row("lens", axis, 0.4, absorbed_by_alignment="caused by it"),
            row("step", axis, 0.9, "mixed", distribution="uniform"),
            row(
                "slow",
                axis,
                1.1,
                distribution="gaussian",
                tail_997=3.9,
                absorbed_by_alignment="in part",
            ),
        ]
    return [
        *kept,
        row("ground", "pitch", 0.7, distribution="rayleigh", mean_arcsec=0.7 * RAYLEIGH_MEAN),
        row("shift", "yaw", 2.0, distribution="uniform", absorbed_by_alignment="in part"),
        row("shift", "roll", 3.0, distribution="uniform", absorbed_by_alignment="in part"),
        row("wave", "pitch", 0.8, "temporal", distribution="arcsine", correlation_group="heat"),
        row("wave", "yaw", 0.3, "temporal", distribution="arcsine", correlation_group="heat"),
        row("bend", "yaw", 0.5, "temporal", correlation_group=" - heat "),
        row("twist", "yaw", 0.2, "ensemble", correlation_group="cold"),
        row("tilt", "pitch", 0.6, "ensemble", correlation_group="-cold"),
        row("offset", "roll", 0.0, distribution="constant", mean_arcsec=-0.7),
        row("offset", "yaw", 0.0, distribution="constant", mean_arcsec=-0.3),
        row("slip", "pitch", 0.0, applies=False),
        Contributor("pixel", "pixel spatial", "pitch"),
        Contributor("pixel", "pixel spatial", "roll"),
        Contributor("launch", "bias", "yaw", absorbed_by_alignment="yes"),
    ]


# Expectations over a standard normal variable.
_U = np.linspace(-9.0, 9.0, 181)
_W = stats.norm.pdf(_U) / stats.norm.pdf(_U).sum()
_NODES, _SHARES = np.polynomial.legendre.leggauss(80)


@lru_cache
def log_spread(tail: float) -> float:
    """Standard deviation of log sigma with which 0.3 % of all errors of unit variance lie beyond
    the tail.
    """

    def beyond(spread: float) -> float:
        return float(_W @ (2.0 * special.ndtr(-tail / np.exp(spread * _U - spread**2))))

    return (
        0.0
        if tail == GAUSSIAN_997
        else float(optimize.brentq(lambda s: beyond(s) - 0.003, 0.0, 0.6))
    )


def reach(covariance: np.ndarray, tail: float = GAUSSIAN_997) -> float:
    """Half-width of an error on one axis or two, by integration over the first of its own axes."""
    sizes = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    if sizes[-1] == 0.0:
        return 0.0
    spread = log_spread(tail)
    scales = np.exp(spread * _U - spread**2) if spread else np.ones(1)
    weights = _W if spread else np.ones(1)

    def held(radius: float) -> float:
        large = sizes[-1] * scales
        if len(sizes) == 1 or sizes[0] < 1e-9 * sizes[1]:
            return float(weights @ special.erf(radius / large / math.sqrt(2.0)))
        angle = 0.5 * math.pi * _NODES
        one, other = radius * np.sin(angle), radius * np.cos(angle)
        density = np.exp(-0.5 * (one / large[:, None]) ** 2) / (
            math.sqrt(2.0 * math.pi) * large[:, None]
        )
        within = density * special.erf(other / (sizes[0] * scales[:, None]) / math.sqrt(2.0))
        return float(weights @ (within @ (0.5 * math.pi * _SHARES * other)))

    return float(
        optimize.brentq(lambda r: held(r) - CONFIDENCE, 1e-6, 20.0 * sizes[-1], xtol=1e-12)
    )


ENDS = {"uniform": math.sqrt(3.0), "arcsine": math.sqrt(2.0), "constant": 0.0}
# One-sided: below its mean it ends, above it there is a quantile.
_RAYLEIGH = stats.rayleigh.mean(), stats.rayleigh.std()
ENDS["rayleigh"] = max(_RAYLEIGH[0], stats.rayleigh.ppf(CONFIDENCE) - _RAYLEIGH[0]) / _RAYLEIGH[1]


def group_of(entry: Contributor) -> tuple[str, float]:
    text = entry.correlation_group.strip()
    return text.removeprefix("-").strip(), -1.0 if text.startswith("-") else 1.0


def group_reach(rows: list[Contributor], axes: list[int]) -> float:
    """Largest error of rows that share their probability, over all of it; Gaussian rows end at
    their half-width.
    """
    probability = np.concatenate((np.linspace(0.0, 1.0, 4001), [0.5 + 0.5 * CONFIDENCE]))
    limit = stats.norm.ppf(0.5 + 0.5 * CONFIDENCE)
    shapes = {
        "gaussian": np.clip(stats.norm.ppf(probability), -limit, limit),
        "arcsine": -math.sqrt(2.0) * np.cos(np.pi * probability),
    }
    errors = np.zeros((3, len(probability)))
    for entry in rows:
        errors[AXES.index(entry.axis)] += (
            group_of(entry)[1] * entry.sigma_arcsec * shapes[entry.distribution]
        )
    return float(np.linalg.norm(errors[axes], axis=0).max())


def correlation(one: Contributor, other: Contributor) -> float:
    if group_of(one)[0] or group_of(other)[0]:
        return group_of(one)[1] * group_of(other)[1] * (group_of(one)[0] == group_of(other)[0])
    if one is other:
        return 1.0
    return (
        one.axis_correlation[AXES.index(other.axis)]
        if one.name == other.name and one.axis_correlation
        else 0.0
    )


def covariance(rows: list[Contributor]) -> np.ndarray:
    matrix = np.zeros((3, 3))
    for one, other in itertools.product(rows, rows):
        place = AXES.index(one.axis), AXES.index(other.axis)
        matrix[place] += correlation(one, other) * one.sigma_arcsec * other.sigma_arcsec
    return matrix


def exists(entry: Contributor, scope: str, least: bool = False) -> bool:
    absorbed = entry.absorbed_by_alignment
    if scope == "before alignment":
        return absorbed != "caused by it"
    return absorbed != "yes" and not (least and absorbed == "in part")


def sampled_rows(rows: list[Contributor]) -> list[np.ndarray | None]:
    """Errors of each row around its mean from the streams of its seed: once it is drawn, a group
    has one of them.
    """
    shared: dict[str, np.ndarray] = {}
    scales: dict[str, np.ndarray] = {}
    found: list[np.ndarray | None] = []
    first = {entry.name: place for place, entry in reversed([*enumerate(rows)])}
    root = linalg.sqrtm(np.array(CORRELATION)).real
    for index, entry in enumerate(rows):
        if not entry.assessed or not entry.sigma_arcsec > 0.0:
            found.append(None)
            continue
        group, sign = group_of(entry)
        stream = np.random.default_rng(
            (SEED, 1, first[entry.name] if entry.axis_correlation else index)
        )
        if entry.axis_correlation:
            plain = stream.standard_normal((SAMPLES, 3))
            uniform = stats.norm.cdf(plain @ root[AXES.index(entry.axis)])
        else:
            uniform = stream.random(SAMPLES)
        uniform = shared.setdefault(group, uniform) if group else uniform
        shape = entry.distribution
        if shape == "uniform":
            error = math.sqrt(3.0) * (2.0 * uniform - 1.0)
        elif shape == "arcsine":
            error = -math.sqrt(2.0) * np.cos(np.pi * uniform)
        elif shape == "rayleigh":
            error = (stats.rayleigh.ppf(uniform) - _RAYLEIGH[0]) / _RAYLEIGH[1]
        else:
            error = stats.norm.ppf(uniform)
            if (spread := log_spread(entry.tail_997)) > 0.0:
                drawn = np.random.default_rng((SEED, 2, index)).standard_normal(SAMPLES)
                error = error * np.exp(spread * scales.setdefault(entry.name, drawn) - spread**2)
        found.append(sign * entry.sigma_arcsec * error)
    return found


def quantile(errors: np.ndarray) -> tuple[float, float]:
    """The 19,000th of 20,000 sizes, and from two standard errors of its place to either side its
    own.
    """
    size = np.sort(np.linalg.norm(errors, axis=0))
    if size[0] == size[-1]:
        return float(size[0]), 0.0
    step = 2.0 * math.sqrt(SAMPLES * CONFIDENCE * (1.0 - CONFIDENCE))
    low, here, high = (
        size[math.ceil(SAMPLES * CONFIDENCE + s - 1e-6) - 1] for s in (-step, 0.0, step)
    )
    return float(here), float(high - low) / 4.0


def bounds(
    rows: list[Contributor], errors: list[np.ndarray | None], names: tuple[str, ...], kind: str
) -> dict[str, float]:
    """Rule and samples of what is assessed, without the question what alignment leaves at the
    least.
    """
    axes = [AXES.index(name) for name in names]
    spreads = [
        entry.interpretation == "mixed" or kind in ("mixed", entry.interpretation) for entry in rows
    ]
    mean = np.array(
        [sum(entry.mean_arcsec for entry in rows if entry.axis == name) for name in names]
    )
    matrix = covariance([entry for entry, yes in zip(rows, spreads, strict=True) if yes])[
        np.ix_(axes, axes)
    ]
    worst: dict[bool, dict[str, float]] = {False: {}, True: {}}
    for by_shape, name in itertools.product(
        (False, True), dict.fromkeys(entry.name for entry in rows)
    ):
        own = [
            entry
            for entry, yes in zip(rows, spreads, strict=True)
            if entry.name == name and not yes
        ]
        own = [entry for entry in own if not group_of(entry)[0]]
        if not own:
            continue
        gaussian = [entry for entry in own if entry.distribution == "gaussian"]
        tail = (
            max([GAUSSIAN_997, *(entry.tail_997 for entry in gaussian)])
            if by_shape
            else GAUSSIAN_997
        )
        size = reach(covariance(gaussian)[np.ix_(axes, axes)], tail)
        size += math.hypot(
            *(ENDS[e.distribution] * e.sigma_arcsec for e in own if e.distribution != "gaussian")
        )
        worst[by_shape][name] = size
    for by_shape, group in itertools.product(
        (False, True), dict.fromkeys(group_of(entry)[0] for entry in rows)
    ):
        own = [
            e
            for e, yes in zip(rows, spreads, strict=True)
            if group and group_of(e)[0] == group and not yes
        ]
        if own:
            worst[by_shape][f"group {group}"] = group_reach(own, axes)
    chance, rest = np.zeros((len(axes), SAMPLES)), np.zeros((len(axes), SAMPLES))
    for entry, error, yes in zip(rows, errors, spreads, strict=True):
        if error is not None:
            (chance if yes else rest)[axes.index(AXES.index(entry.axis))] += error
    far, most = sum(worst[True].values()), -math.inf
    towards = (
        [(1.0,), (-1.0,)]
        if len(axes) == 1
        else [(math.cos(a), math.sin(a)) for a in np.radians(range(360))]
    )
    at = mean
    for direction in towards if far > 0.0 else []:
        end = mean + far * np.array(direction)
        along = math.sqrt(
            np.mean((end @ (chance - chance.mean(axis=1, keepdims=True))) ** 2)
        ) / np.linalg.norm(end)
        if np.linalg.norm(end) + 2.0 * along > most:
            at, most = end, np.linalg.norm(end) + 2.0 * along
    sampled, error_of_it = quantile(at[:, None] + chance)
    least = sampled
    if far > 0.0:
        rest = mean[:, None] + rest
        order = np.argsort(np.linalg.norm(rest, axis=0))
        place = math.ceil(CONFIDENCE * SAMPLES) - 1
        near = order[place - 4 : place + 5] if len(axes) == 2 else order[place : place + 1]
        least = min(
            sampled, float(np.mean([quantile(rest[:, [case]] + chance)[0] for case in near]))
        )
    length = float(np.linalg.norm(mean))
    certain = length + reach(matrix)
    return {
        "mean_arcsec": length if len(axes) == 2 else float(mean[0]),
        "sigma_arcsec": math.sqrt(np.trace(matrix) / len(axes)),
        "factor": reach(matrix) / math.sqrt(np.trace(matrix) / len(axes)),
        "worst_arcsec": sum(worst[False].values()),
        "rule_arcsec": certain + sum(worst[False].values()),
        "sampled_arcsec": sampled,
        "sampled_se_arcsec": error_of_it,
        "rule_least_arcsec": certain + math.hypot(*worst[False].values()),
        "sampled_least_arcsec": least,
    }


def second(
    rows: list[Contributor], errors: list[np.ndarray | None], scope: str, axis: str, kind: str
) -> Any:
    """Fields of a `Total` but its sentence."""
    names = AXES[:2] if axis == CROSS_BORESIGHT else (axis,)
    pairs = [
        (e, s) for e, s in zip(rows, errors, strict=True) if e.axis in names and exists(e, scope)
    ]
    counted = [(e, s) for e, s in pairs if e.assessed and e.applies]
    found: dict[str, Any] = bounds([e for e, _ in counted], [s for _, s in counted], names, kind)
    sure = [(e, s) for e, s in counted if exists(e, scope, least=True)]
    at_least = bounds([e for e, _ in sure], [s for _, s in sure], names, kind)
    for name in ("rule_least_arcsec", "sampled_least_arcsec"):
        found[name] = min(at_least[name], found[name.replace("_least", "")])
    # The rule may call nothing least that samples do not reach.
    found["rule_least_arcsec"] = min(found["rule_least_arcsec"], found["sampled_least_arcsec"])
    weight: dict[str, float] = {}
    for entry, _ in counted:
        size = reach(np.array([[entry.sigma_arcsec**2]]), entry.tail_997)
        size = (
            size
            if entry.distribution == "gaussian"
            else ENDS[entry.distribution] * entry.sigma_arcsec
        )
        weight[entry.name] = weight.get(entry.name, 0.0) + (abs(entry.mean_arcsec) + size) ** 2
    name = max(weight, key=lambda key: weight[key])
    share = weight[name] / sum(weight.values())
    missing = tuple(dict.fromkeys(e.name for e, _ in pairs if not e.assessed))
    told = {
        "scope": scope,
        "axis": axis,
        "interpretation": kind,
        "confidence": CONFIDENCE,
        "not_assessed": missing,
    }
    return {**told, **found, "dominant": name if share > 0.5 else "", "dominant_share": share}


def test_all_totals_are_those_of_a_second_make() -> None:
    rows = rows_of_all_kinds()
    found, _ = totals(rows, CONFIDENCE, n_samples=SAMPLES, seed=SEED)
    errors = sampled_rows(rows)
    wanted = [second(rows, errors, *each) for each in itertools.product(SCOPES, TOTAL_AXES, KINDS)]
    for one, expected in zip(found, wanted, strict=True):
        values = {k: v for k, v in vars(one).items() if k not in ("difference", "at_most")}
        assert values.pop("of_index") == "AKE"
        assert values.keys() == expected.keys()
        for name, value in values.items():
            close = (
                pytest.approx(expected[name], rel=2e-7)
                if isinstance(value, float)
                else expected[name]
            )
            assert value == close, (name, one.scope, one.axis, one.interpretation)
    # Among them: shares above and below a half, worst cases, missing rows, and bounds that are
    # lower at the least.
    assert {bool(one.dominant) for one in found} == {True, False} == {one.at_least for one in found}
    assert sum(one.rule_least_arcsec < one.rule_arcsec for one in found) > 12


BIG = row("big", "pitch", 1.0)
STEP = row("step", "pitch", 1.0, distribution="uniform")
LONG = row("long", "pitch", 1.0, tail_997=3.9)
TILT = row("tilt", "pitch", 1.0, distribution="rayleigh")
BELOW = {"rule_arcsec": 8.0}
ACROSS = {"axis": CROSS_BORESIGHT}


def small(name: str, sigma: float, **changes: Any) -> Contributor:
    return row(name, "pitch", sigma, **{"distribution": "uniform", **changes})


def grouped(one: str, other: str) -> list[Contributor]:
    names = zip("ab", (one, other), strict=True)
    return [STEP, *(row(name, "pitch", 1.0, correlation_group=group) for name, group in names)]


@pytest.mark.parametrize(
    ("rows", "numbers", "code", "reasons"),
    [
        ([BIG], {"rule_arcsec": 0.0}, "NO_ERROR", ""),
        ([BIG], {"rule_arcsec": 10.19}, "AGREE", ""),
        ([BIG], {"rule_arcsec": 9.81}, "AGREE", ""),
        ([BIG], {"rule_arcsec": 10.21}, "DIFFER", ""),
        ([BIG], {"rule_arcsec": 10.39, "sampled_se_arcsec": 0.13333}, "AGREE", ""),
        ([BIG], {"rule_arcsec": 9.59, "sampled_se_arcsec": 0.13333}, "DIFFER", ""),
        # A tail of one per cent more is none.
        ([row("a", "pitch", 1.0, tail_997=1.009 * GAUSSIAN_997)], {}, "DIFFER", ""),
        ([LONG], {}, "DIFFER", "SMALL_MOSTLY"),
        ([BIG, LONG], {}, "DIFFER", "SMALL_MOSTLY"),
        ([LONG], BELOW, "DIFFER", "CHANGING_SIGMA"),
        ([BIG, LONG], BELOW, "DIFFER", "CHANGING_SIGMA"),
        ([LONG, row("heavy", "pitch", 9.0, tail_997=3.3)], BELOW, "DIFFER", "CHANGING_SIGMA"),
        ([TILT, LONG], BELOW, "DIFFER", "CHANGING_SIGMA"),
        ([TILT, STEP], BELOW, "DIFFER", "ONE_SIDED"),
        (grouped("x", "-x"), BELOW, "DIFFER", "GROUP"),
        (grouped("x", "y"), BELOW, "DIFFER", "REACHES_FURTHER"),
        ([BIG, STEP], BELOW, "DIFFER", ""),
        ([STEP, BIG], {}, "DIFFER", "ENDS"),
        # Without being random a bounded row is no reason.
        ([small("fixed", 1.0, interpretation="temporal"), BIG], {}, "DIFFER", ""),
        ([BIG], {"mean_arcsec": 0.051}, "DIFFER", "MEAN_SHIFTS"),
        ([BIG], {"mean_arcsec": -0.051}, "DIFFER", "MEAN_SHIFTS"),
        ([BIG], {"mean_arcsec": 0.049}, "DIFFER", ""),
        ([BIG], {"mean_arcsec": 0.06, **ACROSS}, "DIFFER", "MEAN_ADDED"),
        ([BIG], {"worst_arcsec": 0.051}, "DIFFER", "WORST_CASE"),
        ([BIG], {"worst_arcsec": 0.049}, "DIFFER", ""),
        ([BIG], {"worst_arcsec": 9.0, "sigma_arcsec": 0.0}, "DIFFER", ""),
        # A mean beyond one sigma says it all.
        ([BIG], {"mean_arcsec": 0.9, "worst_arcsec": 1.0}, "DIFFER", "MEAN_SHIFTS WORST_CASE"),
        ([BIG], {"mean_arcsec": -1.1, "worst_arcsec": 1.0}, "DIFFER", "MEAN_SHIFTS"),
        ([BIG, LONG], {"mean_arcsec": 0.9}, "DIFFER", "MEAN_SHIFTS"),
        # A quarter of the largest, and of all, is worth naming.
        ([BIG, small("one", 0.26)], {}, "DIFFER", "BOUNDED one"),
        ([BIG, small("one", 0.24)], {}, "DIFFER", ""),
        (
            [BIG, *map(small, ("one", "two", "three"), (0.8, 0.21, 0.19))],
            {},
            "DIFFER",
            "BOUNDED one two",
        ),
        ([BIG, small("one", 0.18), small("two", 0.18)], ACROSS, "DIFFER", "CORNERS"),
        ([BIG, small("one", 0.17), small("two", 0.17)], ACROSS, "DIFFER", ""),
        ([BIG, small("one", 0.5)], {"sigma_arcsec": 0.0}, "DIFFER", ""),
    ],
)
def test_a_difference_is_explained_by_what_is_large_enough(rows, numbers, code, reasons):
    told = Total(
        *("after alignment", "pitch", "ensemble", 0.997, 0.0, 1.0, 2.968, 0.0, 12.0, 10.0, 0.01),
        dominant_share=0.45,
    )
    told = dataclasses.replace(told, **numbers)
    random = [entry for entry in rows if entry.interpretation == "ensemble"]
    found = explain(told, rows, random, rows[0])
    assert found.code is Difference[code]
    given = found.values.get("reasons", ())
    names = [word for one in given for word in (one.code.name, *one.values.get("rows", ()))]
    assert names == reasons.split()
    # Every reason has its words.
    assert found.sentence.endswith(".")


def test_half_widths_and_quantiles_to_their_last_digits() -> None:
    one, held = stats.rayleigh, 0.997
    for shape, expected in (
        ("uniform", math.sqrt(3.0)),
        ("arcsine", math.sqrt(2.0)),
        ("constant", 0.0),
        ("rayleigh", (one.ppf(held) - one.mean()) / one.std()),
        ("gaussian", stats.norm.isf(0.0015)),
    ):
        assert half_width(shape, held) == pytest.approx(expected, rel=1e-12)
    assert half_width("rayleigh", 0.5) == pytest.approx(one.mean() / one.std(), rel=1e-12)
    assert pytest.approx(stats.norm.isf(0.0015), rel=1e-12) == GAUSSIAN_997
    # Two axes with a common factor on both: an average over that factor.
    for spread, confidence in ((0.0, 0.9), (0.3, 0.9), (0.3, 1.0 - 1e-9), (1.2, 0.997)):
        nodes = np.linspace(-12.0, 12.0, 2001)
        weight = stats.norm.pdf(nodes) / stats.norm.pdf(nodes).sum()
        radius = two_axis_radius(confidence, 3.0, 3.0, spread)
        missed = weight @ np.exp(-0.5 * (radius / 3.0 / np.exp(spread * nodes - spread**2)) ** 2)
        # Sixty nodes are good to a thousandth where the tail is longest.
        assert missed == pytest.approx(1.0 - confidence, rel=1e-3 if spread > 1.0 else 1e-6)
    # Too long for any mixture: that with the most beyond, and no more.
    assert mixture_spread(8.0) == mixture_spread(9.0) == 1.2
