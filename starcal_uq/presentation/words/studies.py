"""Answer of a coupling study: three tables, a sentence for each question, advice and limits.

The tables hold the numbers: which pairs are coupled, what changes them and the errors, and medians
along every axis.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import COEFFICIENTS, parameter_called, parameters
from starcal_uq.core.constants import AXES
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
from starcal_uq.propagation.coupling import ALONE, COUPLED, PART
from starcal_uq.studies.findings import Curve, Pair, Sweep

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study

# An error that changes by less than this factor along an axis hardly depends on it.
_HARDLY = 1.1
# Properties of a lens and a catalogue, which a designer does not choose.
_GIVEN = ("distortion_px", "direction_mas", *COEFFICIENTS)
_MISSING = "–"


def study_text(study: Study) -> str:
    """The answer in two sentences: the strongest coupling, and what would decouple it."""
    sweep = study.sweep
    if not sweep.ok.any():
        return "No cell of the study has numbers."
    return f"{_coupling(sweep)} {_decoupling(sweep)}".strip()


def study_answer(study: Study) -> list[str]:
    """The whole answer, a sentence for every question."""
    if not study.sweep.ok.any():
        return [study_text(study)]
    parts = [
        study_text(study),
        _weakest(study),
        _price(study),
        _errors(study.sweep),
        *_targets(study),
        *_simpler(study),
        *_simulated(study),
    ]
    return [part for part in parts if part]


def dashed(pair: Pair) -> str:
    return "\N{EN DASH}".join(pair.names)


def _coupling(sweep: Sweep) -> str:
    if not sweep.pairs:
        return "No two parameters were estimated together: there is nothing to couple."
    pair = sweep.pairs[0]
    if not sweep.coupled:
        return (
            "No pair of parameters is coupled: the largest correlation anywhere is "
            f"{correlation_text(pair.strongest)} ({dashed(pair)})."
        )
    low, high = map(correlation_text, sorted((pair.strongest, pair.weakest)))
    ends = low if low == high else f"{low} to {high}"
    return (
        f"{len(sweep.coupled)} of {plural(len(sweep.pairs), 'pair')} of parameters are coupled "
        f"(correlation {COUPLED:g} or more), {dashed(pair)} most: {ends}."
    )


def _decoupling(sweep: Sweep) -> str:
    if not sweep.axes or not sweep.coupled:
        return ""
    axes = {size.axis for pair in sweep.coupled for size, _ in pair.decoupling()}
    helping = [axis_name(axis) for axis in sweep.axes if axis in axes]
    idle = [axis_name(axis) for axis in sweep.axes if axis not in axes]
    parts = []
    if helping:
        parts.append(f"Correlations change with {join_words(helping)}.")
    if idle:
        parts.append(f"No coupling changes with {join_words(idle)}.")
    return " ".join(parts)


def _weakest(study: Study) -> str:
    """The most common weakest direction."""
    data, ok = study.data, study.sweep.ok
    weights = data["weak_direction"].values[ok]
    # Nothing takes part in a direction that is hardly worse than the parameters themselves.
    weak = data["weak_variance"].values[ok] >= ALONE[1]
    signs = np.where((np.abs(weights) >= PART) & weak[:, None], np.sign(weights), 0.0)
    kinds = Counter(_direction(study.parameter_names, sign) for sign in signs)
    kind, n = kinds.most_common(1)[0]
    return f"The weakest direction is {kind} in {percent(n / len(signs))} of the cells."


def _direction(names: tuple[str, ...], signs: FloatArray) -> str:
    """Parameters that grow together, against those that shrink meanwhile."""
    used = np.flatnonzero(signs)
    if len(used) < 2:
        return "no combination of parameters"
    together = signs == signs[used[0]]
    up = join_words([names[i] for i in used if together[i]])
    down = join_words([names[i] for i in used if not together[i]])
    return f"{up} against {down}" if down else f"{up} together"


def _price(study: Study) -> str:
    factors = np.sqrt(study.data["variance_inflation"].values[study.sweep.ok])
    known = np.isfinite(factors).any(axis=0)
    words = [
        f"{name} {significant(np.nanmedian(factors[:, i]))}"
        for i, name in enumerate(study.parameter_names)
        if known[i]
    ]
    return f"Coupling multiplies sigma (median over cells): {join_words(words)}."


def _errors(sweep: Sweep) -> str:
    frame, common = _span(sweep.frame_error), _span(sweep.common_rotation)
    return (
        "Attitude errors of the calibration across the boresight, 1 sigma per axis: "
        f"{frame} arcsec from frame to frame, {common} arcsec common to all frames."
    )


def _span(values: FloatArray) -> str:
    """Least to most of what is finite."""
    low, high = significant(np.nanmin(values), 3), significant(np.nanmax(values), 3)
    return low if low == high else f"{low} to {high}"


def _targets(study: Study) -> list[str]:
    """Share of the places that meet each target, and the frames that it takes."""
    sweep, definition = study.sweep, study.definition
    parts = []
    if definition.target_arcsec is not None:
        target = definition.target_arcsec
        met = sweep.over(sweep.frame_error), target
        parts.append(_target(f"{target:g} arcsec", sweep, *met, study.frames_for(target)))
    for name, target in definition.target_sigma.items():
        spec = parameter_called(name)
        text = f"{significant(target / spec.scale)} {pretty_unit(spec.scaled_unit)} for {name}"
        sigma = sweep.over(study.values("sigma", parameter=name))
        needed = study.values("frames_needed_sigma", parameter=name)
        if np.isfinite(sigma).any():
            parts.append(_target(text, sweep, sigma, target, needed))
    return parts


def _target(text: str, sweep: Sweep, found: FloatArray, target: float, cells: FloatArray) -> str:
    known = int(np.isfinite(found).sum())
    met = f"The target of {text} is met in {count(int(np.sum(found <= target)))} of {count(known)}"
    needed = sweep.over(cells)
    finite = needed[np.isfinite(needed)]
    never = int(np.isinf(needed).sum())
    if not len(finite):
        return f"{met} places; no number of frames meets it."
    low, high = (count(int(edge)) for edge in (finite.min(), finite.max()))
    frames = f"{low} frames" if low == high else f"{low} to {high} frames"
    floor = f"; errors of the stars prevent it in {count(never)}" if never else ""
    return f"{met} places; it takes {frames}{floor}."


def _simpler(study: Study) -> list[str]:
    """Share of the places where a simpler distortion model would do."""
    models = map(str, study.data["simpler"].values) if "simpler" in study.data.dims else ()
    parts = []
    for model in models:
        bias = model_bias(study, model)
        left = study.sweep.over(bias)
        error = study.sweep.over(np.where(np.isfinite(bias), study.sweep.frame_error, np.nan))
        # Where the coefficients that it leaves out are zero, nothing was tried.
        tried = left > 0.0
        if tried.any():
            met = f"{count(int(np.sum(left[tried] < error[tried])))} of {count(int(tried.sum()))}"
            parts.append(
                f"The distortion model {model} would do in {met} places: it leaves "
                f"{_span(left[tried])} arcsec."
            )
        elif np.isfinite(left).any():
            parts.append(f"The distortion model {model} lacks nothing here.")
    return parts


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
    covered = np.where(sweep.ok[:, None], study.data["covered_95"].values, np.nan)
    groups = {"": np.ones_like(sweep.ok)}
    for axis in {"method", "likelihood", "prior"} & set(sweep.axes):
        for value in sweep.values[axis]:
            groups[f" ({axis} {value})"] = study.data[axis].values == value
    # One false alarm in a hundred studies, however many intervals are looked at.
    level = 1.0 - 0.01 / (len(groups) * len(sweep.names))
    rates, wrong = [], []
    for words, cells in groups.items():
        for name, column in zip(sweep.names, covered[cells].T, strict=True):
            held = column[np.isfinite(column)]
            if not len(held):
                continue
            low, high = binomial_interval(int(held.sum()), len(held), level)
            rate = f"{name}{words} {percent(float(held.mean()), 3)}"
            if not words:
                rates.append(rate)
            if not low <= 0.95 <= high:
                wrong.append(rate)
    if not rates:
        return []
    text = f"95 % intervals hold the truth in {join_words(rates)} of {count(int(sweep.ok.sum()))}"
    verdict = "chance explains the differences from 95 %"
    if wrong:
        verdict = f"chance does not explain {join_words(wrong)}: do not use these intervals"
    return [f"{text} simulated cells; {verdict}.", *_posteriors(study)]


def _posteriors(study: Study) -> list[str]:
    if "posterior_sigma" not in study.data:
        return []
    ratio = (study.data["posterior_sigma"] / study.data["sigma"]).values[study.sweep.ok]
    if not np.isfinite(ratio).any():
        return []
    low, middle, high = (fixed(q, 2) for q in np.nanquantile(ratio, (0.05, 0.5, 0.95)))
    return [f"Posterior sigma over forecast: median {middle}, 90 % between {low} and {high}."]


def study_advice(study: Study) -> list[str]:
    """What a designer can do with the answer."""
    sweep = study.sweep
    if not sweep.ok.any():
        return ["Nothing can be advised: see why the cells failed."]
    parts = [*_apart(study), _worth_most(sweep), _cheapest(study), _simplest(study)]
    return [part for part in parts if part]


def _apart(study: Study) -> list[str]:
    """Where pairs are least coupled, if their sigmas are smaller there, and pairs that stay."""
    best: dict[str, list[str]] = {}
    stuck = []
    for pair in study.sweep.coupled:
        found = pair.decoupling()
        costs = [cost for _, cost in found if cost.axis not in _GIVEN and _pays(study, pair, cost)]
        if costs:
            at = place({costs[0].axis: costs[0].values[costs[0].least]})
            best.setdefault(at, []).append(dashed(pair))
        elif not found:
            stuck.append(dashed(pair))
    parts = [f"To tell {join_words(names)} apart, choose {at}." for at, names in best.items()]
    if stuck:
        parts.append(
            f"Nothing that was varied tells {join_words(stuck)} apart: report their covariance, "
            "give one of each pair as a prior, or use a model with fewer coefficients."
        )
    return parts


def _pays(study: Study, pair: Pair, cost: Curve) -> bool:
    """Whether both sigmas are smaller where the pair is least coupled than where it is most."""
    known = np.isfinite(correlations(study, pair))
    for name in pair.names:
        sigma = np.where(known, study.values("sigma", parameter=name), np.nan)
        curve = study.sweep.along(sigma, cost.axis)
        if curve is None or curve.median[cost.least] >= curve.median[cost.most]:
            return False
    return True


def _worth_most(sweep: Sweep) -> str:
    """The axis of numbers that changes the attitude error most."""
    curves = [curve for curve in sweep.curves(sweep.frame_error) if np.isfinite(curve.factor)]
    curves = [curve for curve in curves if not isinstance(curve.values[0], str)]
    curve = max(curves, key=lambda curve: curve.factor, default=None)
    if curve is None or curve.factor < _HARDLY:
        return ""
    low, high = (value_words(curve.values[i]) for i in (curve.most, curve.least))
    return (
        f"The {axis_name(curve.axis)} is worth most for the attitude error: a factor of "
        f"{significant(curve.factor)} between {low} and {high}."
    )


def _cheapest(study: Study) -> str:
    """The fewest frames that keep the target whatever the lens is; the most to spare among them."""
    target, sweep = study.definition.target_arcsec, study.sweep
    if target is None or "frames" not in sweep.axes:
        return ""
    given = tuple(i for i, axis in enumerate(sweep.axes) if axis in ("distortion", *_GIVEN))
    errors = sweep.over(sweep.frame_error)
    worst = np.max(errors, axis=given, keepdims=True)
    errors = np.broadcast_to(worst, errors.shape).ravel()
    if not np.any(errors <= target):
        return f"No place of this sweep keeps {target:g} arcsec: take more frames."
    frames = np.array([sweep.at(i)["frames"] for i in range(errors.size)])
    kept = errors <= target
    best = int(np.argmin(np.where(kept & (frames == frames[kept].min()), errors, np.inf)))
    at = {axis: v for axis, v in sweep.at(best).items() if sweep.axes.index(axis) not in given}
    return f"The fewest frames that keep {target:g} arcsec: {place(at)}."


def _simplest(study: Study) -> str:
    """The simplest distortion model that is rich enough everywhere."""
    models = list(map(str, study.data["simpler"].values)) if "simpler" in study.data.dims else []
    for model in sorted(models, key=lambda model: len(parameters(model))):
        bias = model_bias(study, model)
        known = study.sweep.ok & np.isfinite(bias)
        small = bias[known] < study.sweep.frame_error[known]
        if np.any(bias[known] > 0.0) and small.all():
            return f"The distortion model {model} is rich enough everywhere in this sweep."
    return ""


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
    elif len(np.unique(study.data["seed_index"].values)) == 1:
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
    if not study.sweep.ok.any():
        return []
    tables = [_pairs_table(study)]
    if study.sweep.axes:
        tables += [_changes_table(study.sweep), _medians_table(study)]
    return [table for table in tables if table.rows]


def correlations(study: Study, pair: Pair) -> FloatArray:
    """Correlation of a pair in every cell (C,)."""
    return study.values("correlation", parameter=pair.names[0], parameter_2=pair.names[1])


def _pairs_table(study: Study) -> TextTable:
    sweep = study.sweep
    rows = [
        (
            dashed(pair),
            correlation_text(pair.strongest),
            place(pair.strongest_at),
            correlation_text(pair.weakest),
            place(pair.weakest_at),
            significant(0.5 * pair.seeds, 1),
        )
        for pair in sweep.coupled
    ]
    for i, name in enumerate(sweep.names):
        for j, axis in enumerate(AXES):
            r = study.data["attitude_correlation"].values[:, i, j]
            grid = sweep.over(r).ravel()
            size = np.abs(grid)
            if np.isfinite(size).any() and np.nanmin(size) >= COUPLED:
                row = [f"{name} and common {axis}"]
                for index in (int(np.nanargmax(size)), int(np.nanargmin(size))):
                    row += [correlation_text(grid[index]), place(sweep.at(index))]
                rows.append((*row, significant(0.5 * sweep.seeds(r), 1)))  # type: ignore[arg-type]
    heads = ("Coupled", "Strongest", "At", "Weakest", "At", "± over seeds")
    return TextTable(heads, tuple(rows), "Correlations, median over seeds", "lrlrlr")


def _changes_table(sweep: Sweep) -> TextTable:
    """One row for every axis that changes a coupling or an attitude error."""
    rows = []
    for pair in sweep.coupled:
        for size, cost in pair.decoupling():
            most, least = (correlation_text(size.median[i]) for i in (cost.most, cost.least))
            price = float(np.exp(cost.median.max() - cost.median.min()))
            rows.append(_change(dashed(pair), cost, most, least, price))
    errors = {"Error from frame to frame": sweep.frame_error, "Common": sweep.common_rotation}
    for words, numbers in errors.items():
        for curve in sweep.curves(numbers):
            if curve.factor >= _HARDLY:
                most, least = (
                    f'{significant(curve.median[i])}"' for i in (curve.most, curve.least)
                )
                law = None if curve.axis == "max_mag" else curve.exponent
                power = _MISSING if law is None else fixed(law, 2)
                rows.append(_change(words, curve, most, least, curve.factor, power))
    heads = ("What", "Along", "Most", "At", "Least", "At", "Factor in sigma", "Power")
    return TextTable(heads, tuple(rows), "What changes couplings and attitude errors", "llrlrlrr")


def _change(
    words: str, curve: Curve, most: str, least: str, factor: float, power: str = _MISSING
) -> tuple[str, ...]:
    at_most, at_least = (value_words(curve.values[i]) for i in (curve.most, curve.least))
    ends = most, at_most, least, at_least
    return (words, axis_label(curve.axis), *ends, significant(factor), power)


def _medians_table(study: Study) -> TextTable:
    """One row for every value of every axis, all else at its median."""
    sweep = study.sweep
    columns = summary_columns(study)
    rows = []
    for axis in sweep.axes:
        grids = [sweep.pooled(numbers, axis) for _, numbers, _ in columns]
        for i, value in enumerate(sweep.values[axis]):
            cells = [
                form(float(grid[i])) for (_, _, form), grid in zip(columns, grids, strict=True)
            ]
            rows.append((axis_label(axis) if i == 0 else "", value_words(value), *cells))
    heads = ("Along", "Value", *(head for head, _, _ in columns))
    return TextTable(
        heads, tuple(rows), "Medians over seeds and all other axes", "ll" + "r" * len(columns)
    )


def summary_columns(study: Study) -> list[tuple[str, FloatArray, Any]]:
    """Heads, numbers (C,) and forms of what a row of a table shows of a cell."""
    sweep = study.sweep
    coupled = sorted(sweep.coupled or sweep.pairs[:1], key=lambda pair: -pair.mean_size)
    unit = pretty_unit(parameter_called("f").scaled_unit)
    inflation = np.sqrt(study.values("variance_inflation", parameter="f"))
    columns: list[tuple[str, FloatArray, Any]] = [
        *((dashed(pair), correlations(study, pair), _correlation) for pair in coupled[:2]),
        (f"Sigma f [{unit}]", study.values("sigma", parameter="f"), _number),
        ("Price f", inflation, _number),
        ("Common [arcsec]", sweep.common_rotation, _number),
        ("Rest [arcsec]", sweep.frame_error, _number),
    ]
    target = study.definition.target_arcsec
    if target is not None:
        columns.append((f"Frames for {target:g} arcsec", study.frames_for(target), _frames))
    return columns


def _correlation(value: float) -> str:
    return _MISSING if np.isnan(value) else correlation_text(value)


def _number(value: float) -> str:
    return _MISSING if np.isnan(value) else significant(value, 3)


def _frames(value: float) -> str:
    if np.isfinite(value):
        return count(int(np.ceil(value)))
    return "never" if np.isinf(value) else _MISSING
