"""Answer of a coupling study: three tables, a sentence for each question, advice and limits.

The tables hold the numbers: which pairs are coupled, what changes them and the errors, and medians
along every axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import COEFFICIENTS, parameter_called
from starcal_uq.core.formatting import (
    count,
    fixed,
    join_words,
    percent,
    plural,
    pretty_unit,
    significant,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.figures.coupling import correlation_text
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import axis_label, axis_name, place, value_words
from starcal_uq.propagation.coupling import COUPLED, PART
from starcal_uq.studies.findings import Curve, Pair, place_of

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study

_COMMON, _REST = "Common [arcsec]", "Rest [arcsec]"
# Properties of a lens and a catalogue, which a designer does not choose.
_GIVEN = ("distortion_px", "direction_mas", *COEFFICIENTS)
_MISSING = "–"
Forms = Mapping[str, Callable[[float], str]]


def dashed(pair: Pair) -> str:
    return "\N{EN DASH}".join(pair.names)


def study_text(study: Study) -> str:
    """The strongest coupling, and what changes correlations."""
    sweep = study.sweep
    if not sweep.ok.any():
        return "No cell of the study has numbers."
    pairs = sweep.coupled or sweep.pairs[:1]
    if not pairs:
        return "No two parameters were estimated together: there is nothing to couple."
    ends = sorted((float(pairs[0].strongest), float(pairs[0].weakest)))
    axes = {cost.axis for pair in sweep.coupled for cost in pair.decoupling()}
    changing = [axis_name(axis) for axis in sweep.axes if axis in axes]
    changed = "Nothing that was varied changes them by much."
    if changing:
        changed = f"Correlations change with {join_words(changing)}."
    return (
        f"{len(sweep.coupled)} of {plural(len(sweep.pairs), 'pair')} of parameters are coupled "
        f"(correlation {COUPLED:g} or more); the strongest is {dashed(pairs[0])}: "
        f"{_span(ends, correlation_text)}. {changed}"
    )


def study_answer(study: Study) -> list[str]:
    """The whole answer, a sentence for every question."""
    sweep = study.sweep
    if not sweep.ok.any():
        return [study_text(study)]
    inflation = study.data["variance_inflation"][sweep.ok] ** 0.5
    medians = inflation.median("cell").to_series().dropna()
    price = [f"{name} {significant(factor)}" for name, factor in medians.items()]
    return [
        study_text(study),
        _weakest(study),
        f"Coupling multiplies sigma (median over cells): {join_words(price)}.",
        "Attitude errors of the calibration across the boresight, 1 sigma per axis: "
        f"{_span(sweep.frame_error)} arcsec from frame to frame, {_span(sweep.common_rotation)} "
        "arcsec common to all frames.",
        *_targets(study),
        *_simpler(study),
        *_simulated(study),
    ]


def _span(values: Any, form: Callable[[float], str] = lambda value: significant(value, 3)) -> str:
    """Least to most of what is finite."""
    low, high = form(np.nanmin(values)), form(np.nanmax(values))
    return low if low == high else f"{low} to {high}"


def _weakest(study: Study) -> str:
    """The parameters that most often make up the weakest direction, and its variance."""
    parts = np.abs(study.data["weak_direction"].values[study.ok]) >= PART
    kinds, n = np.unique(parts, axis=0, return_counts=True)
    names = compress(study.parameter_names, kinds[np.argmax(n)])
    variance = significant(np.median(study.data["weak_variance"].values[study.ok]))
    return (
        f"The weakest direction is one of {join_words(list(names))} in "
        f"{percent(n.max() / len(parts))} of the cells, with {variance} times the variance of "
        "uncoupled parameters (median)."
    )


def _targets(study: Study) -> list[str]:
    """Share of the places that meet each target, and the frames that it takes."""
    aims = []
    if (target := study.definition.target_arcsec) is not None:
        needed = study.frames_for(target)
        aims.append((f"{target:g} arcsec", target, study.sweep.frame_error, needed))
    for name, target in study.definition.target_sigma.items():
        spec = parameter_called(name)
        text = f"{significant(target / spec.scale)} {pretty_unit(spec.scaled_unit)} for {name}"
        sigma = study.values("sigma", parameter=name)
        aims.append((text, target, sigma, study.values("frames_needed_sigma", parameter=name)))
    sentences = []
    for text, target, found, cells in aims:
        met, needed = _share(study, found, target), study.sweep.over(cells).values
        finite = needed[np.isfinite(needed)]
        frames = f"it takes {_span(finite, _frames)} frames" if len(finite) else "no number does it"
        never = int(np.isinf(needed).sum())
        floor = f"; errors of the stars prevent it in {count(never)}" if never else ""
        sentences.append(f"The target of {text} is met in {met} places; {frames}{floor}.")
    return sentences


def _share(study: Study, found: FloatArray, limit: Any) -> str:
    """At how many of its places a number stays below a limit."""
    known = np.isfinite(found)
    numbers, limits = (study.sweep.over(each) for each in (found, np.where(known, limit, np.nan)))
    return f"{count(int((numbers <= limits).sum()))} of {count(int(numbers.notnull().sum()))}"


def _simpler(study: Study) -> list[str]:
    """Share of the places where a simpler distortion model would do."""
    sentences = []
    for model in simpler_models(study):
        bias = model_bias(study, model)
        if np.isfinite(bias).any():
            share = _share(study, bias, study.sweep.frame_error)
            left = _span(study.sweep.over(bias))
            sentences.append(
                f"The distortion model {model} would do in {share} places: it leaves {left} arcsec."
            )
    return sentences


def simpler_models(study: Study) -> list[str]:
    """Distortion models that would be simpler than those of cells."""
    return list(map(str, study.data["simpler"].values)) if "simpler" in study.data.dims else []


def model_bias(study: Study, simpler: str) -> FloatArray:
    """Frame-dependent attitude error across the boresight (C,) that a simpler model would leave,
    arcsec.
    """
    return study.values("model_bias_attitude_arcsec", axis="cross", simpler=simpler)


def _simulated(study: Study) -> list[str]:
    """Coverage of the 95 % intervals of simulated cells, and their posteriors against forecasts."""
    if "covered_95" not in study.data:
        return []
    sweep = study.sweep
    choices = [axis for axis in ("method", "likelihood", "prior") if axis in sweep.axes]
    groups: list[dict[str, Any]] = [{}]
    groups += [{axis: value} for axis in choices for value in sweep.values[axis]]
    # One false alarm in a hundred studies, however many intervals are looked at.
    level = 1.0 - 0.01 / (len(groups) * len(sweep.names))
    rates, wrong = [], []
    for at in groups:
        for name in sweep.names:
            covered = study.values("covered_95", parameter=name)
            n, rate = (float(sweep.over(covered, of, [], at)) for of in ("count", "mean"))
            if n:
                words = f"{name} {percent(rate, 3)}{f' ({place(at)})' if at else ''}"
                low, high = binomial_interval(round(n * rate), int(n), level)
                rates += [] if at else [words]
                wrong += [] if low <= 0.95 <= high else [words]
    if not rates:
        return []
    verdict = "chance explains the differences from 95 %"
    if wrong:
        verdict = f"chance does not explain {join_words(wrong)}: do not use these intervals"
    n_cells = count(int(sweep.ok.sum()))
    held = f"95 % intervals hold the truth in {join_words(rates)} of {n_cells} simulated cells"
    return [f"{held}; {verdict}.", *_posteriors(study)]


def _posteriors(study: Study) -> list[str]:
    if "posterior_sigma" not in study.data:
        return []
    ratio = (study.data["posterior_sigma"] / study.data["sigma"]).values[study.ok]
    low, middle, high = (fixed(q, 2) for q in np.nanquantile(ratio, (0.05, 0.5, 0.95)))
    return [f"Posterior sigma over forecast: median {middle}, 90 % between {low} and {high}."]


def study_advice(study: Study) -> list[str]:
    """What a designer can do with the answer."""
    if not study.ok.any():
        return ["Nothing can be advised: see why the cells failed."]
    return [*_apart(study), *_cheapest(study)]


def _apart(study: Study) -> list[str]:
    """Where pairs are least coupled, if their sigmas are smaller there, and pairs that stay."""
    pairs: dict[str, list[str]] = {}
    for pair in study.sweep.coupled:
        costs = [cost for cost in pair.decoupling() if _pays(study, pair, cost)]
        where = place({costs[0].axis: costs[0].values[costs[0].least]}) if costs else ""
        pairs.setdefault(where, []).append(dashed(pair))
    return [
        f"To tell {join_words(names)} apart, choose {where}."
        if where
        else f"No choice in this sweep tells {join_words(names)} apart and makes their sigmas "
        "smaller: report their covariance, give one of each pair as a prior, or use a model with "
        "fewer coefficients."
        for where, names in pairs.items()
    ]


def _pays(study: Study, pair: Pair, cost: Curve) -> bool:
    """Whether a designer can choose the axis, and both sigmas are smaller where the pair is least
    coupled than where it is most.
    """
    if cost.axis in _GIVEN:
        return False
    known = np.isfinite(pair.correlation)
    for name in pair.names:
        sigma = np.where(known, study.values("sigma", parameter=name), np.nan)
        curve = study.sweep.along(sigma, cost.axis)
        if curve is None or curve.median[cost.least] >= curve.median[cost.most]:
            return False
    return True


def _cheapest(study: Study) -> list[str]:
    """The fewest frames that keep the target whatever the lens is; the most to spare among them."""
    target, sweep = study.definition.target_arcsec, study.sweep
    if target is None or "frames" not in sweep.axes:
        return []
    given = [axis for axis in sweep.axes if axis in ("distortion", *_GIVEN)]
    worst = sweep.over(sweep.frame_error).max(given, skipna=False)
    kept = worst.where(worst <= target).dropna("frames", how="all")
    if not kept.size:
        return [f"No place of this sweep keeps {target:g} arcsec: take more frames."]
    fewest = kept.isel(frames=[0])
    best = fewest.isel(fewest.argmin(list(fewest.dims)))
    return [f"The fewest frames that keep {target:g} arcsec: {place(place_of(best))}."]


def study_limits(study: Study) -> list[str]:
    """What was not assessed, and which cells failed."""
    sweep = study.sweep
    parts = []
    if sweep.failures:
        reasons = [f"{count(n)}: {reason.rstrip('.')}" for reason, n in sweep.failures[:3]]
        failed = f"{count(int((~sweep.ok).sum()))} of {plural(len(sweep.ok), 'cell')}"
        parts.append(f"{failed} have no numbers ({'; '.join(reasons)}).")
    if sweep.drawn:
        drawn = join_words([axis_name(axis) for axis in sweep.drawn])
        parts.append(f"Drawn from a Latin hypercube, and shown in parts of equal number: {drawn}.")
    elif len(study.definition.seeds) == 1:
        parts.append("One seed: what another sky or other frames would change was not assessed.")
    if study.definition.mode == "simulate":
        parts.append(
            "Simulated with the noise and the distortion model that the calibration assumes."
        )
    else:
        parts.append(
            "Fisher information assumes Gaussian noise, right identifications and a right "
            "distortion model. Coverage, bias and convergence were not assessed; "
            'mode = "simulate" does.'
        )
    return parts


def study_notes(study: Study) -> list[str]:
    """Answer beyond the headline, advice and limits, for a notebook."""
    return [*study_answer(study)[1:], *study_advice(study), *study_limits(study)]


def study_tables(study: Study) -> list[TextTable]:
    """Coupled pairs, what changes them and the errors, and medians along every axis."""
    if not study.ok.any():
        return []
    tables = [_pairs_table(study), _changes_table(study), _medians_table(study)]
    return [table for table in tables if table.rows]


def _pairs_table(study: Study) -> TextTable:
    rows = []
    for pair in (*study.sweep.coupled, *study.sweep.turned):
        row = [dashed(pair)]
        for number in (pair.strongest, pair.weakest):
            row += [correlation_text(float(number)), place(place_of(number))]
        rows.append((*row, significant(0.5 * pair.seeds, 1)))
    heads = ("Coupled", "Strongest", "At", "Weakest", "At", "± over seeds")
    title = "Correlations, median over seeds; pitch, yaw and roll are those of all frames"
    return TextTable(heads, tuple(rows), title, "lrlrlr")


def _changes_table(study: Study) -> TextTable:
    """One row for every axis that changes a coupling, a sigma or an attitude error."""
    changes: list[tuple[str, Curve, Callable[[float], str]]] = [
        (dashed(p), cost, _size) for p in study.sweep.coupled for cost in p.decoupling()
    ]
    for name, sigma in sigmas(study).items():
        curves = study.sweep.curves(np.log(sigma))
        changes += [(name, curve, _sigma) for curve in curves if curve.matters]
    rows = []
    for name, curve, form in changes:
        row = [name, axis_label(curve.axis)]
        for i in (curve.most, curve.least):
            row += [form(float(curve.median[i])), value_words(curve.values[i])]
        power = fixed(curve.exponent, 2) if np.isfinite(curve.exponent) else _MISSING
        rows.append((*row, significant(curve.factor), power))
    heads = ("What", "Along", "Most", "At", "Least", "At", "Factor in sigma", "Power")
    return TextTable(heads, tuple(rows), "What changes couplings and errors", "llrlrlrr")


def _size(cost: float) -> str:
    """Size of the correlation that costs this."""
    return correlation_text(float(np.sqrt(-np.expm1(-2.0 * cost))))


def _sigma(logarithm: float) -> str:
    return significant(np.exp(logarithm))


def _medians_table(study: Study) -> TextTable:
    """One row for every value of every axis, all else at its median."""
    import pandas as pd

    columns, forms = summary(study)
    parts = []
    for axis in study.axes:
        medians = {
            head: study.sweep.over(numbers, dims=[axis]).to_series()
            for head, numbers in columns.items()
        }
        part = pd.DataFrame(medians)
        part.insert(0, "Value", [value_words(value) for value in part.index])
        part.insert(0, "Along", [axis_label(axis), *[""] * (len(part) - 1)])
        parts.append(part)
    title = "Medians over seeds and all other axes"
    table = pd.concat(parts) if parts else pd.DataFrame()
    return TextTable.of(table, title, formats=forms)


def sigmas(study: Study) -> dict[str, FloatArray]:
    """Standard deviations that tables show, (C,), by their heads."""
    names = ("x0", "f") if "effects" in study.axes else ("f",)
    found = {f"Sigma {name} [px]": study.values("sigma", parameter=name) for name in names}
    if "slope_f" in study.data:
        found["df/dT [px/K]"] = study.values("slope_f")
    return found | {_COMMON: study.sweep.common_rotation, _REST: study.sweep.frame_error}


def summary(study: Study) -> tuple[dict[str, FloatArray], Forms]:
    """What a row of a table shows of a cell: numbers (C,) by their heads, and how some are
    written.
    """
    sweep = study.sweep
    coupled = sorted(sweep.coupled or sweep.pairs[:1], key=lambda pair: -pair.mean_size)
    columns = {
        dashed(pair): study.values(
            "correlation", parameter=pair.names[0], parameter_2=pair.names[1]
        )
        for pair in coupled[:2]
    }
    forms: dict[str, Callable[[float], str]] = dict.fromkeys(columns, correlation_text)
    columns["Price f"] = np.sqrt(study.values("variance_inflation", parameter="f"))
    columns |= sigmas(study)
    if (target := study.definition.target_arcsec) is not None:
        head = f"Frames for {target:g} arcsec"
        columns[head], forms[head] = study.frames_for(target), _frames
    return columns, forms


def _frames(value: float) -> str:
    return "never" if np.isinf(value) else count(int(np.ceil(value)))
