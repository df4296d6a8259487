"""What a designer can do about what a study has found, and what it cannot: advice from its
numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import join_words, plural, significant
from starcal_uq.core.types import floats
from starcal_uq.presentation.words.axes import axis_name, capital, place, said, value_words
from starcal_uq.presentation.words.studies import (
    HARDLY,
    NATURE,
    TOLD,
    dashed,
    error_effects,
    model_bias,
    study_answer,
    study_limits,
    the,
)
from starcal_uq.presentation.words.study_tables import correlations
from starcal_uq.studies.findings import Curve, Pair, Sweep

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study

# What nobody chooses; a model is chosen.
_GIVEN = set(NATURE) - {"distortion"}
# A price in sigma from which it pays to do something about a coupling.
_DEAR = 2.0
# A common rotation that differs by this factor over the sweep is worth a word.
_MIND = 3.0


def study_advice(study: Study) -> list[str]:
    """What a designer can do with the answer."""
    sweep = study.sweep
    if not sweep.ok.any():
        return ["Nothing can be advised: see why the cells failed."]
    parts = [
        *_advice_couplings(study),
        *_advice_errors(sweep),
        _advice_target(study),
        _advice_models(study),
    ]
    return [part for part in parts if part]


def _advice_couplings(study: Study) -> list[str]:
    sweep = study.sweep
    parts = []
    best: dict[tuple[str, Any, bool], list[str]] = {}
    stuck = []
    for pair in sweep.coupled:
        found = pair.decoupling()
        free = [cost for size, cost in found if size.axis not in _GIVEN]
        if free:
            cost = free[0]
            key = cost.axis, cost.values[cost.least], _pays(study, pair, cost)
            best.setdefault(key, []).append(dashed(pair))
        elif not found and np.exp(max((c.median.min() for c in pair.costs), default=0.0)) >= _DEAR:
            stuck.append(dashed(pair))
    for (axis, value, pays), names in best.items():
        if not pays:
            parts.append(
                f"{join_words(names)} are least coupled with {said(axis, value)}, but their "
                "sigmas are no smaller "
                "there: that alone is no reason to go there."
            )
        elif axis == "distortion":
            parts.append(
                f"To tell {join_words(names)} apart, take the model {value} if its bias allows."
            )
        else:
            go = "take" if isinstance(value, str) else "go to"
            parts.append(f"To tell {join_words(names)} apart, {go} {said(axis, value)}.")
    if stuck:
        parts.append(
            f"Do not expect {join_words(stuck[:TOLD])} to come apart by what was varied here. "
            "Report them with their "
            "covariance, never one alone; to know one of them, measure it otherwise and give it "
            "as a prior, or take a "
            "model with fewer coefficients where its bias allows."
        )
    return parts


def _pays(study: Study, pair: Pair, cost: Curve) -> bool:
    """Whether both sigmas are smaller where the pair is least coupled than where it is most."""
    sweep = study.sweep
    for name in pair.names:
        known = np.isfinite(correlations(study, pair))
        sigma = np.where(known, study.values("sigma", parameter=name), np.nan)
        curve = sweep.along(sigma, cost.axis)
        if curve is None or curve.median[cost.least] >= curve.median[cost.most]:
            return False
    return True


def _advice_errors(sweep: Sweep) -> list[str]:
    """What is worth most for the attitude error, and what trades against what."""
    effects = [e for e in error_effects(sweep, sweep.frame_error) if e.factor >= HARDLY]
    parts = []
    top = next((e for e in effects if not isinstance(e.curve.values[0], str)), None)
    if top is not None:
        curve = top.curve
        parts.append(
            f"For the attitude error, {the(curve.axis)} is worth most within this sweep: a factor "
            f"of {significant(top.factor)} between {said(curve.axis, curve.values[curve.most])} "
            f"and {value_words(curve.values[curve.least])}."
        )
    laws = {
        e.curve.axis: e.exponent
        for e in effects
        if e.exponent is not None and e.curve.axis != "max_mag"
    }
    deeper = next((_per_magnitude(e.curve) for e in effects if e.curve.axis == "max_mag"), None)
    if deeper is not None and deeper > HARDLY:
        also = [
            words.format(significant(deeper ** (side / laws[axis])))
            for axis, side, words in (
                ("frames", -1.0, "{} times the frames"),
                ("sigma_px", 1.0, "noise {} times smaller"),
            )
            if laws.get(axis)
        ]
        same = f", as much as {join_words(also)}" if also else ""
        parts.append(
            "One magnitude more in the limit divides the attitude error by "
            f"{significant(deeper)}{same}."
        )
    per_frame = laws.pop("frames", None)
    worth = [
        f"{'half' if law > 0.0 else 'twice'} the {axis_name(axis)} is worth "
        f"{significant(2.0 ** (-abs(law) / per_frame))} times"
        for axis, law in laws.items()
        if per_frame and abs(law) > 0.2
    ]
    if worth:
        parts.append(
            f"{capital(join_words(worth))} the frames: they do the same to the attitude error."
        )
    common = sweep.over(sweep.common_rotation).ravel()
    least, most = int(np.nanargmin(common)), int(np.nanargmax(common))
    if sweep.axes and common[most] >= _MIND * common[least]:
        parts.append(
            "If alignment is not calibrated with the same parameters, mind the common rotation: "
            f"{significant(common[most])} arcsec with {place(sweep.at(most))}, "
            f"{significant(common[least])} with {place(sweep.at(least))}."
        )
    return parts


def _per_magnitude(curve: Curve) -> float | None:
    """By how much a magnitude divides an error, on average over the axis."""
    x = floats(curve.values)
    return float(np.exp(-np.polyfit(x, np.log(curve.median), 1)[0])) if len(x) > 1 else None


def _advice_target(study: Study) -> str:
    """The place that meets the target with the fewest frames, if frames can be chosen."""
    target, sweep = study.definition.target_arcsec, study.sweep
    if target is None:
        return ""
    errors = sweep.over(sweep.frame_error).ravel()
    met = np.flatnonzero(errors <= target)
    if not len(met):
        needed = sweep.over(study.frames_for(target)).ravel()
        if not np.isfinite(needed).any():
            return f"{target:g} arcsec is out of reach here: lower the noise, or relax the target."
        best = int(np.argmin(np.where(np.isfinite(needed), needed, np.inf)))
        at = place({axis: v for axis, v in sweep.at(best).items() if axis != "frames"})
        return (
            f"For {target:g} arcsec take "
            f"{plural(int(needed[best]), 'frame')}{f' with {at}' if at else ''}."
        )
    if "frames" not in sweep.axes:
        return ""
    # What the lens is, nobody chooses: the target is to be met whatever it is.
    given = [axis for axis in sweep.axes if axis in NATURE]
    position = tuple(map(sweep.axes.index, given))
    worst = np.max(sweep.over(sweep.frame_error), axis=position, keepdims=True)
    errors = np.broadcast_to(worst, sweep.shape).ravel()
    kept = errors <= target
    whatever = f", whatever {join_words(list(map(the, given)))} of this sweep" if given else ""
    if not kept.any():
        if not given:
            return ""
        return f"No place of this sweep keeps {target:g} arcsec{whatever}: take more frames."
    frames = np.array([sweep.at(i)["frames"] for i in range(len(kept))], dtype=np.float64)
    fewest = kept & (frames == frames[kept].min())
    # Of those, the one with most to spare.
    errors = np.where(fewest, errors, np.inf)
    best = int(np.argmin(errors))
    at = place({axis: value for axis, value in sweep.at(best).items() if axis not in NATURE})
    return (
        f"The fewest frames that keep {target:g} arcsec{whatever}: {at} "
        f"({significant(errors[best])} arcsec)."
    )


def _advice_models(study: Study) -> str:
    """The simplest model that is rich enough."""
    if "simpler" not in study.data.dims:
        return ""
    sweep = study.sweep
    good: list[str] = []
    bad: list[str] = []
    for model in map(str, study.data["simpler"].values):
        bias = model_bias(study, model)
        known = sweep.ok & np.isfinite(bias)
        # Where what it leaves out is zero, nothing was tried.
        if known.any() and np.any(bias[known] > 0.0):
            (good if np.all(bias[known] < sweep.frame_error[known]) else bad).append(model)
    order = sorted(good, key=lambda model: len(parameters(model)))
    if order:
        return (
            f"The model {order[0]} is rich enough everywhere in this sweep: more coefficients "
            "only add sigma."
        )
    if len(bad) == study.data.sizes["simpler"]:
        return (
            "No simpler distortion model is safe over the whole sweep: keep the coefficients, "
            "and live with their "
            "coupling."
        )
    return ""


def study_notes(study: Study) -> list[str]:
    """The whole answer, advice and limits, for a notebook."""
    advice = [f"Advice: {sentence[:1].lower() + sentence[1:]}" for sentence in study_advice(study)]
    return [*study_answer(study), *advice, *study_limits(study)]
