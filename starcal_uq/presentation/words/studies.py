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
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.axes import axis_label, place, value_words
from starcal_uq.presentation.words.numbers import correlation_text, frames_needed
from starcal_uq.presentation.words.sentences import table, told
from starcal_uq.propagation.coupling import PART
from starcal_uq.studies.axes import EFFECT_AXES
from starcal_uq.studies.findings import Curve, Pair, place_of

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study

_COMMON, _REST = "Common [arcsec]", "Rest [arcsec]"
# Properties of a lens and a catalogue, which a designer does not choose.
_GIVEN = ("distortion_px", "direction_mas", *COEFFICIENTS)
Forms = Mapping[str, Callable[[float], str]]


def dashed(pair: Pair) -> str:
    return "\N{EN DASH}".join(pair.names)


def study_text(study: Study) -> str:
    """The strongest coupling, and what changes correlations."""
    return told("study", study)


def study_answer(study: Study) -> list[str]:
    """The whole answer, a sentence for every question."""
    sweep = study.sweep
    if not study.ok.any():
        return [study_text(study)]
    inflation = study.data["variance_inflation"][study.ok] ** 0.5
    biases = {model: model_bias(study, model) for model in simpler_models(study)}
    posteriors = None
    if "posterior_sigma" in study.data:
        ratio = (study.data["posterior_sigma"] / study.data["sigma"]).values[study.ok]
        posteriors = np.nanquantile(ratio, (0.05, 0.5, 0.95))
    answer = told(
        "study_answer",
        study,
        **_weakest(study),
        price=inflation.median("cell").to_series().dropna().to_dict(),
        best=best_axis(study),
        aims=_aims(study),
        errors=sweep.over(sweep.frame_error),
        simpler={model: sweep.over(bias) for model, bias in biases.items()},
        looks=_coverage(study) if "covered_95" in study.data else [],
        posteriors=posteriors,
    )
    return [study_text(study), *answer.splitlines()]


def best_axis(study: Study) -> list[str]:
    """The axis, of those that can be chosen, that changes the frame-dependent error most, and what
    effects of the sensor do to it; nothing where none matters.
    """
    curves = study.sweep.curves(np.log(study.sweep.frame_error))
    chosen: dict[str, Curve] = {}
    for curve in sorted(curves, key=lambda curve: curve.change):
        if curve.matters and curve.axis not in _GIVEN:
            chosen["sensitive" if curve.axis == EFFECT_AXES[0] else "best"] = curve
    return [told(f"{kind}_axis", curve) for kind, curve in chosen.items()]


def _weakest(study: Study) -> AnyDict:
    """The parameters that most often make up the weakest direction, and its variance."""
    parts = np.abs(study.data["weak_direction"].values[study.ok]) >= PART
    kinds, n = np.unique(parts, axis=0, return_counts=True)
    return {
        "names": list(compress(study.parameter_names, kinds[np.argmax(n)])),
        "share_of_cells": n.max() / len(parts),
        "variance": np.median(study.data["weak_variance"].values[study.ok]),
    }


def _aims(study: Study) -> list[tuple[Any, ...]]:
    """Each target with its parameter, if it is of one, the errors at all places, and the frames
    that it takes there.
    """
    over, goal = study.sweep.over, study.definition.target_arcsec
    aims: list[tuple[Any, ...]] = []
    if goal is not None:
        aims.append((None, goal, over(study.sweep.frame_error), over(study.frames_for(goal))))
    for name, target in study.definition.target_sigma.items():
        both = (study.values(of, parameter=name) for of in ("sigma", "frames_needed_sigma"))
        aims.append((parameter_called(name), target, *map(over, both)))
    return aims


def simpler_models(study: Study) -> list[str]:
    """Distortion models that would be simpler than those of cells."""
    return list(map(str, study.data["simpler"].values)) if "simpler" in study.data.dims else []


def model_bias(study: Study, simpler: str) -> FloatArray:
    """Frame-dependent attitude error across the boresight (C,) that a simpler model would leave,
    arcsec.
    """
    return study.values("model_bias_attitude_arcsec", axis="cross", simpler=simpler)


def _coverage(study: Study) -> list[tuple[str, AnyDict, float, bool]]:
    """Share of the 95 % intervals of each parameter that hold the truth, over all cells and at each
    way to estimate, and whether chance explains it.
    """
    sweep = study.sweep
    ways: list[str] = [axis for axis in ("method", "likelihood", "prior") if axis in sweep.axes]
    places: list[AnyDict] = [{}, *({axis: one} for axis in ways for one in sweep.values[axis])]
    found = []
    # One false alarm in a hundred studies, however many intervals are looked at.
    level = 1.0 - 0.01 / (len(places) * len(sweep.names))
    for at in places:
        for name in sweep.names:
            covered = study.values("covered_95", parameter=name)
            n, rate = (float(sweep.over(covered, of, [], at)) for of in ("count", "mean"))
            if n:
                low, high = binomial_interval(round(n * rate), int(n), level)
                found.append((name, at, rate, low <= 0.95 <= high))
    return found


def study_advice(study: Study) -> list[str]:
    """What a designer can do with the answer."""
    apart: dict[str, list[str]] = {}
    for pair in study.sweep.coupled if study.ok.any() else ():
        # Where the pair is least coupled, if its sigmas are smaller there.
        costs = [cost for cost in pair.decoupling() if _pays(study, pair, cost)]
        where = place({cost.axis: cost.values[cost.least] for cost in costs[:1]})
        apart.setdefault(where, []).append(dashed(pair))
    return told("study_advice", study, apart=apart, cheapest=_cheapest(study)).splitlines()


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


def _cheapest(study: Study) -> AnyDict | None:
    """Where the fewest frames keep the target whatever the lens is, with the most to spare; nowhere
    if no number does, None where frames were not varied for a target.
    """
    target, sweep = study.definition.target_arcsec, study.sweep
    if target is None or "frames" not in sweep.axes or not study.ok.any():
        return None
    given = [axis for axis in sweep.axes if axis in ("distortion", *_GIVEN)]
    worst = sweep.over(sweep.frame_error).max(given, skipna=False)
    kept = worst.where(worst <= target).dropna("frames", how="all").isel(frames=slice(1))
    return place_of(kept.isel(kept.argmin(list(kept.dims)))) if kept.size else {}


def study_limits(study: Study) -> list[str]:
    """What was not assessed, and which cells failed."""
    return told("study_limits", study).splitlines()


def study_notes(study: Study) -> list[str]:
    """Answer beyond the headline, advice and limits, for a notebook."""
    return [*study_answer(study)[1:], *study_advice(study), *study_limits(study)]


def study_tables(study: Study) -> list[TextTable]:
    """Coupled pairs, what changes them and the errors, and medians along every axis."""
    if not study.ok.any():
        return []
    pairs = table("coupled", it=(*study.sweep.coupled, *study.sweep.turned))
    return [each for each in (pairs, _changes(study), _medians(study)) if each.rows]


def _changes(study: Study) -> TextTable:
    """One row for every axis that changes a coupling, a sigma or an attitude error."""
    found: list[Any] = [
        (dashed(pair), cost, True) for pair in study.sweep.coupled for cost in pair.decoupling()
    ]
    for name, sigma in sigmas(study).items():
        curves = study.sweep.curves(np.log(sigma))
        found += [(name, curve, False) for curve in curves if curve.matters]
    columns = zip(*found, strict=True) if found else ((), (), ())
    return table("changes", **dict(zip(("name", "it", "coupling"), columns, strict=True)))


def _medians(study: Study) -> TextTable:
    """One row for every value of every axis, all else at its median."""
    import pandas as pd

    columns, forms = summary(study)
    parts = []
    for axis in study.axes:
        values = study.sweep.values[axis]
        along = [axis_label(axis), *[""] * (len(values) - 1)]
        medians = {head: study.sweep.over(of, dims=[axis]) for head, of in columns.items()}
        parts.append(pd.DataFrame({"Along": along, "Value": map(value_words, values)} | medians))
    return TextTable.of(pd.concat(parts), "Medians over seeds and all other axes", formats=forms)


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
    pairs = study.sweep.coupled or study.sweep.pairs[:1]
    coupled = sorted(pairs, key=lambda pair: -pair.mean_size)
    columns = {dashed(pair): pair.correlation for pair in coupled[:2]}
    forms: dict[str, Callable[[float], str]] = dict.fromkeys(columns, correlation_text)
    columns["Price f"] = np.sqrt(study.values("variance_inflation", parameter="f"))
    columns |= sigmas(study)
    if (target := study.definition.target_arcsec) is not None:
        head = f"Frames for {target:g} arcsec"
        columns[head], forms[head] = study.frames_for(target), frames_needed
    return columns, forms
