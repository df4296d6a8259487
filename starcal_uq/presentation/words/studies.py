"""Answer of a coupling study: three tables, a sentence for each question, advice and limits.

The tables hold the numbers: which pairs are coupled, what changes them and the errors, and medians
along every axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import COEFFICIENTS, parameter_called
from starcal_uq.core.formatting import (
    count,
    percent,
    pretty_unit,
    significant,
)
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.figures.coupling import correlation_text
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import axis_label, axis_name, place, value_words
from starcal_uq.presentation.words.sentences import say, table
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
        return say("Study.empty")
    pairs = sweep.coupled or sweep.pairs[:1]
    if not pairs:
        return say("Study.uncoupled")
    axes = {cost.axis for pair in sweep.coupled for cost in pair.decoupling()}
    return say(
        "Study.coupled",
        n_coupled=len(sweep.coupled),
        n_pairs=len(sweep.pairs),
        limit=COUPLED,
        strongest=dashed(pairs[0]),
        span=_span([float(pairs[0].strongest), float(pairs[0].weakest)], correlation_text),
        changing=[axis_name(axis) for axis in sweep.axes if axis in axes],
    )


def study_answer(study: Study) -> list[str]:
    """The whole answer, a sentence for every question."""
    sweep = study.sweep
    if not sweep.ok.any():
        return [study_text(study)]
    inflation = study.data["variance_inflation"][sweep.ok] ** 0.5
    medians = inflation.median("cell").to_series().dropna()
    price = [f"{name} {significant(factor)}" for name, factor in medians.items()]
    spans = {"rest": _span(sweep.frame_error), "common": _span(sweep.common_rotation)}
    return [
        study_text(study),
        say("Study.weakest", **_weakest(study)),
        say("Study.price", price=price),
        say("Study.attitude", **spans),
        *best_axis(study),
        *_targets(study),
        *_simpler(study),
        *_simulated(study),
    ]


def best_axis(study: Study) -> list[str]:
    """The axis, of those that can be chosen, that changes the frame-dependent error most; nothing
    where none matters.
    """
    curves = study.sweep.curves(np.log(study.sweep.frame_error))
    mattering = [curve for curve in curves if curve.matters and curve.axis not in _GIVEN]
    best = max(mattering, key=lambda curve: curve.change, default=None)
    if best is None:
        return []
    least, most = (value_words(best.values[i]) for i in (best.least, best.most))
    return [say("Study.best", it=best, axis=axis_label(best.axis), least=least, most=most)]


def _span(values: Any, form: Callable[[float], str] = lambda value: significant(value, 3)) -> str:
    """Least to most of what is finite."""
    low, high = form(np.nanmin(values)), form(np.nanmax(values))
    return low if low == high else f"{low} to {high}"


def _weakest(study: Study) -> AnyDict:
    """The parameters that most often make up the weakest direction, and its variance."""
    parts = np.abs(study.data["weak_direction"].values[study.ok]) >= PART
    kinds, n = np.unique(parts, axis=0, return_counts=True)
    return {
        "names": list(compress(study.parameter_names, kinds[np.argmax(n)])),
        "share": n.max() / len(parts),
        "variance": np.median(study.data["weak_variance"].values[study.ok]),
    }


def _targets(study: Study) -> Iterator[str]:
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
    for text, target, found, cells in aims:
        needed = study.sweep.over(cells).values
        finite = needed[np.isfinite(needed)]
        yield say(
            "Study.target",
            target=text,
            met=_share(study, found, target),
            frames=_span(finite, _frames) if len(finite) else "",
            never=int(np.isinf(needed).sum()),
        )


def _share(study: Study, found: FloatArray, limit: Any) -> str:
    """At how many of its places a number stays below a limit."""
    known = np.isfinite(found)
    numbers, limits = (study.sweep.over(each) for each in (found, np.where(known, limit, np.nan)))
    return f"{count(int((numbers <= limits).sum()))} of {count(int(numbers.notnull().sum()))}"


def _simpler(study: Study) -> Iterator[str]:
    """Share of the places where a simpler distortion model would do."""
    for model in simpler_models(study):
        bias = model_bias(study, model)
        if np.isfinite(bias).any():
            share = _share(study, bias, study.sweep.frame_error)
            left = _span(study.sweep.over(bias))
            yield say("Study.simpler", model=model, share=share, left=left)


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
    n_cells = int(sweep.ok.sum())
    answer = [say("Study.covered", rates=rates, wrong=wrong, n_cells=n_cells)]
    if "posterior_sigma" in study.data:
        ratio = (study.data["posterior_sigma"] / study.data["sigma"]).values[study.ok]
        low, middle, high = np.nanquantile(ratio, (0.05, 0.5, 0.95))
        answer.append(say("Study.posteriors", low=low, middle=middle, high=high))
    return answer


def study_advice(study: Study) -> list[str]:
    """What a designer can do with the answer."""
    if not study.ok.any():
        return [say("Study.nothing_to_advise")]
    pairs: dict[str, list[str]] = {}
    for pair in study.sweep.coupled:
        # Where the pair is least coupled, if its sigmas are smaller there.
        costs = [cost for cost in pair.decoupling() if _pays(study, pair, cost)]
        where = place({costs[0].axis: costs[0].values[costs[0].least]}) if costs else ""
        pairs.setdefault(where, []).append(dashed(pair))
    apart = (say("Study.apart", where=where, names=names) for where, names in pairs.items())
    return [*apart, *_cheapest(study)]


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
        return [say("Study.more_frames", target=target)]
    fewest = kept.isel(frames=[0])
    best = fewest.isel(fewest.argmin(list(fewest.dims)))
    return [say("Study.fewest", target=target, where=place(place_of(best)))]


def study_limits(study: Study) -> list[str]:
    """What was not assessed, and which cells failed."""
    sweep = study.sweep
    parts = []
    if sweep.failures:
        n, of = int((~sweep.ok).sum()), len(sweep.ok)
        parts.append(say("Study.failed", n=n, of=of, failures=sweep.failures[:3]))
    if sweep.drawn:
        parts.append(say("Study.drawn", axes=[axis_name(axis) for axis in sweep.drawn]))
    elif len(study.definition.seeds) == 1:
        parts.append(say("Study.one_seed"))
    return [*parts, say(f"Study.{study.definition.mode}")]


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
    names, curves, forms = zip(*changes, strict=True) if changes else ((), (), ())
    ends = {
        end: [
            (form(float(c.median[i])), value_words(c.values[i]))
            for c, form, i in zip(curves, forms, (getattr(c, end) for c in curves), strict=True)
        ]
        for end in ("most", "least")
    }
    along = [axis_label(curve.axis) for curve in curves]
    return table("changes", name=names, it=curves, along=along, **ends)


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
