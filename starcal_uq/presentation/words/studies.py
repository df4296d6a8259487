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
from starcal_uq.core.formatting import count, percent, significant
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.figures.coupling import correlation_text
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import axis_label, axis_name, place, value_words
from starcal_uq.presentation.words.sentences import say, table
from starcal_uq.propagation.coupling import COUPLED, PART
from starcal_uq.studies.axes import EFFECT_AXES
from starcal_uq.studies.findings import Curve, Pair, place_of

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study

_COMMON, _REST = "Common [arcsec]", "Rest [arcsec]"
# Properties of a lens and a catalogue, which a designer does not choose.
_GIVEN = ("distortion_px", "direction_mas", *COEFFICIENTS)
# What templates write axes, values and places with.
_WRITTEN: AnyDict = {
    one.__name__: one for one in (axis_label, correlation_text, place, value_words)
}
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
        ends=(pairs[0].strongest, pairs[0].weakest),
        form=correlation_text,
        changing=[axis_name(axis) for axis in sweep.axes if axis in axes],
    )


def study_answer(study: Study) -> list[str]:
    """The whole answer, a sentence for every question."""
    sweep = study.sweep
    if not sweep.ok.any():
        return [study_text(study)]
    inflation = study.data["variance_inflation"][sweep.ok] ** 0.5
    price = inflation.median("cell").to_series().dropna()
    return [
        study_text(study),
        say("Study.weakest", **_weakest(study)),
        say("Study.price", price=price.to_dict()),
        say("Study.attitude", rest=_ends(sweep.frame_error), common=_ends(sweep.common_rotation)),
        *best_axis(study),
        *_targets(study),
        *_simpler(study),
        *_simulated(study),
    ]


def best_axis(study: Study) -> list[str]:
    """The axis, of those that can be chosen, that changes the frame-dependent error most, and what
    effects of the sensor do to it; nothing where none matters.
    """
    curves = study.sweep.curves(np.log(study.sweep.frame_error))
    chosen: dict[str, Curve] = {}
    for curve in sorted(curves, key=lambda curve: curve.change):
        if curve.matters and curve.axis not in _GIVEN:
            chosen["sensitive" if curve.axis == EFFECT_AXES[0] else "best"] = curve
    return [say(f"Study.{kind}", it=curve, **_WRITTEN) for kind, curve in chosen.items()]


def _ends(values: Any) -> tuple[float, float]:
    """Least and most of what is finite."""
    return float(np.nanmin(values)), float(np.nanmax(values))


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
    goal = study.definition.target_arcsec
    aims: list[Any] = (
        [] if goal is None else [(None, goal, study.sweep.frame_error, study.frames_for(goal))]
    )
    for name, target in study.definition.target_sigma.items():
        sigma = study.values("sigma", parameter=name)
        needed = study.values("frames_needed_sigma", parameter=name)
        aims.append((parameter_called(name), target, sigma, needed))
    for spec, target, found, cells in aims:
        needed = study.sweep.over(cells).values
        finite = needed[np.isfinite(needed)]
        yield say(
            "Study.target",
            spec=spec,
            target=target,
            met=_share(study, found, target),
            frames=[_frames(n) for n in _ends(finite)] if len(finite) else [],
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
            yield say("Study.simpler", model=model, share=share, left=_ends(study.sweep.over(bias)))


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
    groups: list[AnyDict] = [{axis: value} for axis in choices for value in sweep.values[axis]]
    looks = [(name, at) for at in ({}, *groups) for name in sweep.names]
    # One false alarm in a hundred studies, however many intervals are looked at.
    level = 1.0 - 0.01 / len(looks)
    rates, wrong = [], []
    for name, at in looks:
        covered = study.values("covered_95", parameter=name)
        n, rate = (float(sweep.over(covered, of, [], at)) for of in ("count", "mean"))
        if n:
            words = f"{name} {percent(rate, 3)}{f' ({place(at)})' if at else ''}"
            low, high = binomial_interval(round(n * rate), int(n), level)
            rates += [] if at else [words]
            wrong += [] if low <= 0.95 <= high else [words]
    if not rates:
        return []
    answer = [say("Study.covered", rates=rates, wrong=wrong, n_cells=int(sweep.ok.sum()))]
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
    if cost.axis in (*_GIVEN, EFFECT_AXES[0]):
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
    pairs = (*study.sweep.coupled, *study.sweep.turned)
    return table("coupled", _WRITTEN | {"place_of": place_of}, it=pairs)


def _changes_table(study: Study) -> TextTable:
    """One row for every axis that changes a coupling, a sigma or an attitude error."""
    changes: list[Any] = [
        (dashed(p), cost, _size) for p in study.sweep.coupled for cost in p.decoupling()
    ]
    for name, sigma in sigmas(study).items():
        curves = study.sweep.curves(np.log(sigma))
        changes += [(name, curve, _sigma) for curve in curves if curve.matters]
    columns = zip(*changes, strict=True) if changes else ((), (), ())
    return table("changes", _WRITTEN, **dict(zip(("name", "it", "form"), columns, strict=True)))


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
        values = study.sweep.values[axis]
        along = [axis_label(axis), *[""] * (len(values) - 1)]
        part = {"Along": along, "Value": map(value_words, values)}
        for head, numbers in columns.items():
            part[head] = study.sweep.over(numbers, dims=[axis])
        parts.append(pd.DataFrame(part))
    title = "Medians over seeds and all other axes"
    return TextTable.of(pd.concat(parts), title, formats=forms)


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
