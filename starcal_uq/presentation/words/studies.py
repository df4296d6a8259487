"""Coupling studies in words: what couples with what, what would decouple it, and what a designer
can do about it.

Every sentence is made from the numbers at hand: a study that finds no coupling says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from starcal_uq.core.types import BoolArray, FloatArray
from starcal_uq.maths.intervals import binomial_interval
from starcal_uq.presentation.figures.coupling import correlation_text
from starcal_uq.presentation.words.axes import (
    axis_name,
    capital,
    place,
    said,
    value_words,
)
from starcal_uq.propagation.coupling import COUPLED
from starcal_uq.studies.findings import Curve, Direction, Pair, Sweep

if TYPE_CHECKING:
    from starcal_uq.studies.result import Study

# Pairs that are told one by one.
TOLD = 4
# A parameter and the common rotation cannot be told apart from this correlation on.
_SAME = 0.99
# An error that changes by less than this factor along an axis hardly depends on it.
HARDLY = 1.1
# What a lens and a catalogue are, and nobody chooses.
NATURE = ("distortion", "distortion_px", "direction_mas", *COEFFICIENTS)


def study_text(study: Study) -> str:
    """The answer in two sentences: what is coupled most, and what would decouple it."""
    sweep = study.sweep
    if not sweep.ok.any():
        return "No cell of the study has numbers."
    if not sweep.coupled:
        return _uncoupled(sweep)
    pair = sweep.coupled[0]
    text = f"{capital(' and '.join(pair.names))} are coupled most ({_range(pair)})."
    if not sweep.axes:
        return text
    if "distortion" in sweep.axes:
        text = f"{text} {_price_of_models(study)}".strip()
    found = [(other, *other.decoupling()[0]) for other in sweep.coupled if other.decoupling()]
    if not found:
        return f"{text} {capital(_nothing_decouples(sweep))}."
    # What can be chosen comes before what a lens is.
    other, size, cost = max(found, key=lambda entry: (entry[1].axis not in NATURE, entry[2].change))
    return (
        f"{text} {capital(the(size.axis))} changes how {dashed(other)} are coupled: "
        f"{_ends(size, cost)}."
    )


def study_answer(study: Study) -> list[str]:
    """The whole answer, a sentence or two for every question."""
    sweep = study.sweep
    if not sweep.ok.any():
        return [study_text(study)]
    parts = [
        _couplings(sweep),
        *_what_decouples(sweep),
        _weakest(sweep),
        _price(study),
        _gauge(study),
        *_errors(sweep),
        _target(study),
        *_target_sigmas(study),
        *_models(study),
        *_simpler(study),
        *_simulated(study),
    ]
    return [part for part in parts if part]


def dashed(pair: Pair) -> str:
    return "\N{EN DASH}".join(pair.names)


def _range(pair: Pair) -> str:
    """The correlations of a pair over the sweep, and how much other seeds change them."""
    low, high = map(correlation_text, sorted((pair.strongest, pair.weakest)))
    text = f"correlation {high if low == high else f'{low} to {high}'}"
    seeds = f", ±{significant(0.5 * pair.seeds, 1)} over seeds" if pair.seeds >= 5e-4 else ""
    return text + seeds


def _uncoupled(sweep: Sweep) -> str:
    if not sweep.pairs:
        return "No two parameters were estimated together: there is nothing to couple."
    pair = sweep.pairs[0]
    at = f", with {place(pair.strongest_at)}" if pair.strongest_at else ""
    return (
        "No pair of parameters is coupled: the largest correlation anywhere is "
        f"{correlation_text(pair.strongest)} ({' and '.join(pair.names)}{at})."
    )


def _couplings(sweep: Sweep) -> str:
    if not sweep.coupled:
        return _uncoupled(sweep)
    told = [
        f"{dashed(pair)} ({_range(pair).removeprefix('correlation ')})"
        for pair in sweep.coupled[:TOLD]
    ]
    more = len(sweep.coupled) - len(told)
    rest = f"; {plural(more, 'more pair')} above {COUPLED:g} in size somewhere" if more > 0 else ""
    others = len(sweep.pairs) - len(sweep.coupled)
    free = f" The other {plural(others, 'pair')} stay below {COUPLED:g}." if others else ""
    return f"Coupled are, with their correlations, {join_words(told)}{rest}.{free}"


def _what_decouples(sweep: Sweep) -> list[str]:
    """What changes each of the couplings, and which axes do nothing about any."""
    if not sweep.axes or not sweep.coupled:
        return []
    # Pairs of which the same is to be said share a sentence.
    told: dict[tuple[str, str], list[str]] = {}
    for pair in sweep.coupled[:TOLD]:
        for size, cost in pair.decoupling()[:1]:
            told.setdefault((capital(the(size.axis)), _ends(size, cost)), []).append(dashed(pair))
    parts = [
        f"{axis} changes how {join_words(pairs)} are coupled: {ends}."
        for (axis, ends), pairs in told.items()
    ]
    helping = {size.axis for pair in sweep.coupled for size, _ in pair.decoupling()}
    idle = [axis for axis in sweep.axes if axis not in helping]
    if not helping:
        parts.append(capital(_nothing_decouples(sweep)) + ".")
    elif idle:
        changes = [c for pair in sweep.coupled for c in pair.sizes if c.axis in idle]
        names = join_words([the(axis) for axis in idle])
        do, them = ("does", "it") if len(idle) == 1 else ("do", "them")
        most = (
            f": along {them} no correlation changes by more than {_change(changes)}"
            if changes
            else ""
        )
        parts.append(f"{capital(names)} {do} little to the couplings{most}.")
    return parts


def _ends(size: Curve, cost: Curve) -> str:
    """From what to what an axis changes a coupling."""
    ends = [
        f"{correlation_text(size.median[i])} with {said(size.axis, size.values[i])}"
        for i in (cost.most, cost.least)
    ]
    prices = [fixed(np.exp(cost.median[i]), 1) for i in (cost.most, cost.least)]
    return (
        f"from {' to '.join(ends)} in size, which takes the price in sigma from "
        f"{' to '.join(prices)}"
    )


def _nothing_decouples(sweep: Sweep) -> str:
    names = join_words([axis_name(axis) for axis in sweep.axes])
    changes = [curve for pair in sweep.coupled for curve in pair.sizes]
    return (
        f"nothing that was varied ({names}) decouples "
        f"{'them' if len(sweep.coupled) == 1 else 'any pair'}: along no "
        f"axis does a correlation change by more than {_change(changes)}"
    )


def _change(curves: Sequence[Curve]) -> str:
    largest = max((curve.change for curve in curves), default=0.0)
    return significant(max(largest, 0.001), 1)


def the(axis: str) -> str:
    return f"the {axis_name(axis)}"


def _weakest(sweep: Sweep) -> str:
    """The weakest direction, and where it becomes another one."""
    kinds, _ = sweep.directions
    if not kinds:
        return ""
    variance = sweep.over(sweep.data["weak_variance"].values)
    sizes = _span(variance)
    if len(kinds) == 1:
        if not kinds[0].together:
            return (
                "No combination of parameters is much worse determined than the parameters "
                "themselves."
            )
        return (
            f"The weakest direction is {_direction(kinds[0])} everywhere, with {sizes} times the "
            "variance of uncoupled "
            "parameters."
        )
    turn = sweep.turn
    if turn is None or turn.told < max(0.75, kinds[0].share + 0.05):
        told = [f"{_direction(kind)} in {percent(kind.share)}" for kind in kinds[:3]]
        return (
            f"The weakest direction is {join_words(told)} of the places, and no one axis tells "
            "which."
        )
    runs = [
        f"{_direction(kinds[kind])} {_run(turn.axis, values)}" for values, kind in turn.runs[:6]
    ]
    right = "" if turn.told > 0.999 else f" (so in {percent(turn.told)} of the places)"
    return f"The weakest direction turns with {the(turn.axis)}: {'; '.join(runs)}{right}."


def _direction(kind: Direction) -> str:
    if not kind.together:
        return "nothing in particular"
    if not kind.against:
        return f"{join_words(kind.together)} together"
    return f"{join_words(kind.together)} against {join_words(kind.against)}"


def _run(axis: str, values: Sequence[Any]) -> str:
    if len(values) == 1 or isinstance(values[0], str):
        return _with(axis, values)
    return f"from {said(axis, values[0])} to {value_words(values[-1])}"


def _with(axis: str, values: Sequence[Any]) -> str:
    """Values of an axis, the first of them with its name."""
    return f"with {join_words([said(axis, values[0]), *map(value_words, values[1:])])}"


def _price(study: Study) -> str:
    """How many times a sigma is what it would be if all other parameters were known."""
    sweep = study.sweep
    found = []
    for i, name in enumerate(sweep.names):
        factor = sweep.over(np.sqrt(study.data["variance_inflation"].values[:, i]))
        if np.isfinite(factor).any():
            found.append((float(np.nanmedian(factor)), name, _span(factor)))
    dear = [entry for entry in sorted(found, reverse=True) if entry[0] >= HARDLY]
    if not dear:
        return (
            "Coupling costs nothing: every sigma is what it would be if the other parameters "
            "were known."
        )
    told = [f"{name} {words} times" for _, name, words in dear[:TOLD]]
    return (
        "The price, as sigma over what it would be if the other parameters were known: "
        f"{join_words(told)}."
    )


def _span(values: FloatArray) -> str:
    """Least to most of what is finite."""
    good = values[np.isfinite(values)]
    low, high = (significant(v, 3 if abs(v) >= 0.1 else 2) for v in (good.min(), good.max()))
    return low if low == high else f"{low} to {high}"


def _gauge(study: Study) -> str:
    """Parameters that cannot be told from a common rotation anywhere."""
    sweep = study.sweep
    found = []
    for i, name in enumerate(sweep.names):
        for j, axis in enumerate(AXES):
            r = np.abs(sweep.over(study.data["attitude_correlation"].values[:, i, j]))
            if np.isfinite(r).any() and np.nanmin(r) >= _SAME:
                found.append((f"{name} with {axis}", np.nanmin(r)))
    if not found:
        return ""
    least = correlation_text(min(0.9999, *(r for _, r in found)))
    return (
        f"In the whole sweep, {join_words([words for words, _ in found])} cannot be told apart "
        f"(at least {least} in size): a rotation common to all frames, which an alignment with "
        "the same parameters absorbs."
    )


@dataclass(frozen=True)
class Effect:
    """What an axis does to an error: the largest over the smallest median, and the law between if
    there is one.
    """

    curve: Curve
    factor: float
    exponent: float | None


def error_effects(sweep: Sweep, numbers: FloatArray) -> list[Effect]:
    """What every axis does to an error, the strongest first."""
    found = [
        Effect(curve, float(curve.median.max() / curve.median.min()), curve.exponent)
        for curve in sweep.curves(numbers)
        if curve.median.min() > 0.0
    ]
    return sorted(found, key=lambda effect: -effect.factor)


def _errors(sweep: Sweep) -> list[str]:
    """Sizes of both attitude errors of the calibration, and what each axis does to them."""
    return [
        _error(
            "Across the boresight, 1 sigma per axis, the error that differs from frame to frame is",
            sweep,
            sweep.frame_error,
        ),
        _error("The rotation common to all frames is", sweep, sweep.common_rotation),
    ]


def _error(head: str, sweep: Sweep, numbers: FloatArray) -> str:
    effects = error_effects(sweep, numbers)
    grid = sweep.over(numbers).ravel()
    least, most = int(np.nanargmin(grid)), int(np.nanargmax(grid))
    text = f"{head} {_span(grid)} arcsec"
    if len(sweep.axes) > 1 and grid[most] >= HARDLY * grid[least]:
        text += f", least with {place(sweep.at(least))}, most with {place(sweep.at(most))}"
    strong = [_effect(effect) for effect in effects if effect.factor >= HARDLY]
    weak = [axis_name(effect.curve.axis) for effect in effects if effect.factor < HARDLY]
    if strong:
        text += ". Medians: " if len(sweep.axes) > 1 else ". It goes from "
        text += ", ".join(strong)
    if weak:
        so = "; it hardly depends on {}" if strong else ", whatever {} may be"
        text += so.format(join_words(weak))
    return text + "."


def _effect(effect: Effect) -> str:
    curve = effect.curve
    first, last = 0, len(curve.values) - 1
    if isinstance(curve.values[0], str):
        ends = curve.least, curve.most
    elif curve.most not in (first, last):
        ends = curve.most, curve.least
    else:
        ends = first, last
    words = " to ".join(
        f"{significant(curve.median[i])} with {said(curve.axis, curve.values[i])}" for i in ends
    )
    if effect.exponent is None or curve.axis == "max_mag":
        return words
    return f"{words} (proportional to its power {fixed(effect.exponent, 2)})"


def _target(study: Study) -> str:
    """Where the target is met, and what it takes."""
    target = study.definition.target_arcsec
    if target is None:
        return ""
    sweep = study.sweep
    errors = sweep.over(sweep.frame_error)
    share = _share(sweep, errors <= target, np.isfinite(errors))
    head = f"The target of {target:g} arcsec is met {share}{_crossings(study)}."
    return f"{head} {_range_of_frames(sweep, study.frames_for(target))}".strip()


def _share(sweep: Sweep, flag: BoolArray, known: BoolArray, everywhere: int | None = None) -> str:
    """In which of the known places something holds: everywhere where it does in so many."""
    holds = known & flag
    if holds.sum() == (known.sum() if everywhere is None else everywhere):
        return "everywhere"
    if not holds.any():
        return "nowhere"
    return f"in {count(holds.sum())} of {count(known.sum())} places{_where(sweep, holds, known)}"


def _crossings(study: Study) -> str:
    """Where the median error comes to the target along an axis of numbers, between its values."""
    sweep = study.sweep
    told = []
    for axis in sweep.axes:
        if axis in sweep.drawn or isinstance(sweep.values[axis][0], str):
            continue
        places = study.met(axis)
        if len(places) == 1:
            told.append(said(axis, places[0]))
    return f", and the median error comes to it with {join_words(told)}" if told else ""


def _target_sigmas(study: Study) -> list[str]:
    """The same for targets of single parameters."""
    sweep = study.sweep
    parts = []
    for name, target in study.definition.target_sigma.items():
        spec = parameter_called(name)
        sigma = sweep.over(study.values("sigma", parameter=name))
        known = np.isfinite(sigma)
        if not known.any():
            continue
        unit = pretty_unit(spec.scaled_unit)
        head = f"The target of {significant(target / spec.scale)} {unit} for {name} is met"
        needed = study.values("frames_needed_sigma", parameter=name)
        text = f"{head} {_share(sweep, sigma <= target, known, known.size)}."
        parts.append(f"{text} {_range_of_frames(sweep, needed)}".strip())
    return parts


def _range_of_frames(sweep: Sweep, cells: FloatArray) -> str:
    """The fewest and the most frames that a target takes over the sweep, and where."""
    needed = sweep.over(cells).ravel()
    if not np.isfinite(needed).any():
        return "No number of frames meets it." if np.isinf(needed).any() else ""
    good = np.where(np.isfinite(needed), needed, np.nan)
    least, most = int(np.nanargmin(good)), int(np.nanargmax(good))

    def told(index: int) -> str:
        at = place({axis: value for axis, value in sweep.at(index).items() if axis != "frames"})
        return f"{plural(int(good[index]), 'frame')}{f' ({at})' if at else ''}"

    never = int(np.isinf(needed).sum())
    floor = (
        f" In {plural(never, 'place')} no number of frames does: errors of the stars stay."
        if never
        else ""
    )
    if good[least] == good[most]:
        return f"It takes {plural(int(good[least]), 'frame')}.{floor}"
    return f"It takes from {told(least)} to {told(most)}.{floor}"


def _where(sweep: Sweep, flag: BoolArray, known: BoolArray) -> str:
    """The cut along one axis that tells best where something holds; nothing where none does."""
    best = (0.0, "")
    total = float(known.sum())
    base = max(flag.sum(), (known & ~flag).sum()) / total

    def right(inside: Any) -> float:
        return float((known & (flag == inside)).sum()) / total

    for position, axis in enumerate(sweep.axes):
        values = sweep.values[axis]
        index = np.arange(len(values)).reshape([-1] + [1] * (flag.ndim - position - 1))
        if isinstance(values[0], str):
            others = tuple(i for i in range(flag.ndim) if i != position)
            chosen = 2 * flag.sum(axis=others) > known.sum(axis=others)
            inside = [value for value, there in zip(values, chosen, strict=True) if there]
            if 0 < len(inside) < len(values):
                best = max(best, (right(chosen[index]), _with(axis, inside)))
            continue
        for cut in range(1, len(values)):
            best = max(
                best,
                (right(index >= cut), f"from {said(axis, values[cut])} on"),
                (right(index < cut), f"from {said(axis, values[cut - 1])} downwards"),
                key=lambda entry: entry[0],
            )
    told, words = best
    if told < max(0.8, base + 0.05):
        return ""
    return f": {words}" if told > 0.999 else f": {words} (so in {percent(told)} of the places)"


def _price_of_models(study: Study) -> str:
    """The sigma of f with richer models beside that with the simplest, medians."""
    sweep = study.sweep
    curve = sweep.along(study.values("sigma", parameter="f"), "distortion")
    if curve is None:
        return ""
    first, *others = sorted(
        range(len(curve.values)), key=lambda i: len(parameters(curve.values[i]))
    )
    told = [
        f"{significant(curve.median[i] / curve.median[first])} with {curve.values[i]}"
        for i in others
    ]
    return (
        f"Beside the model {curve.values[first]}, the sigma of f is larger by factors of "
        f"{join_words(told)}."
    )


def _models(study: Study) -> list[str]:
    """What richer models cost, beside the simplest that was swept."""
    sweep = study.sweep
    if "distortion" not in sweep.axes:
        return []
    known = sweep.values["distortion"]
    first, *others = sorted(known, key=lambda model: len(parameters(model)))
    position = sweep.axes.index("distortion")
    numbers = {
        "the sigma of f": study.values("sigma", parameter="f"),
        "the error from frame to frame": sweep.frame_error,
        "the common rotation": sweep.common_rotation,
    }
    told = []
    for model in others:
        factors = []
        for words, array in numbers.items():
            grid = np.moveaxis(sweep.over(array), position, 0)
            ratio = grid[known.index(model)] / grid[known.index(first)]
            if np.isfinite(ratio).any():
                factors.append(f"{_span(ratio)} times {words}")
        if factors:
            told.append(f"{model} has {join_words(factors)}")
    return [f"Beside the model {first}: {'; '.join(told)}."] if told else []


def _simpler(study: Study) -> list[str]:
    """Whether a simpler model would do."""
    if "simpler" not in study.data.dims:
        return []
    sweep = study.sweep
    parts = []
    for model in map(str, study.data["simpler"].values):
        bias = model_bias(study, model)
        grid = sweep.over(bias)
        error = sweep.over(np.where(np.isfinite(bias), sweep.frame_error, np.nan))
        known = np.isfinite(grid) & np.isfinite(error)
        if not known.any():
            continue
        # Where the coefficients that it leaves out are zero, nothing was tried.
        known &= grid > 0.0
        if not known.any():
            parts.append(
                f"The model {model} lacks nothing here: the coefficients that it leaves out are "
                "zero."
            )
            continue
        share = _share(sweep, grid < error, known)
        size = f"{_span(grid[known])} arcsec against {_span(error[known])} of the calibration"
        parts.append(f"The model {model} would do {share}: it leaves {size}.")
    return parts


def model_bias(study: Study, simpler: str) -> FloatArray:
    """Frame-dependent attitude error across the boresight (C,) that a simpler model would leave,
    arcsec.
    """
    return study.values("model_bias_attitude_arcsec", axis="cross", simpler=simpler)


def _simulated(study: Study) -> list[str]:
    """Whether intervals of simulated cells hold the truth as often as they say, and posteriors are
    as forecast.
    """
    if "covered_95" not in study.data:
        return []
    sweep = study.sweep
    covered = np.where(sweep.ok[:, None], study.data["covered_95"].values, np.nan)
    groups = [("", np.ones_like(sweep.ok))]
    for axis in ("method", "likelihood", "prior"):
        if axis in sweep.axes:
            names = study.data[axis].values
            groups += [
                (f" with {said(axis, value)}", names == value) for value in sweep.values[axis]
            ]
    told, wrong = [], []
    # One false alarm in a hundred studies, however many intervals are looked at.
    level = 1.0 - 0.01 / (len(groups) * len(sweep.names))
    for words, cells in groups:
        for i, name in enumerate(sweep.names):
            held = covered[cells, i]
            held = held[np.isfinite(held)]
            if not len(held):
                continue
            n, hits = len(held), int(held.sum())
            low, high = binomial_interval(hits, n, level)
            if not words:
                told.append(f"{name} {percent(hits / n, 3)}")
            if not low <= 0.95 <= high:
                wrong.append(f"{name}{words} ({percent(hits / n, 3)} of {count(n)})")
    if not told:
        return []
    text = (
        f"In {count(sweep.ok.sum())} simulated cells the 95 % intervals hold the truth as often as "
        f"this: {join_words(told)}"
    )
    if not wrong:
        text += "; chance explains what differs from 95 %."
    else:
        text += (
            f". That is not 95 % for {join_words(wrong)}: do not use these intervals as they are."
        )
    return [text, *_posteriors(study)]


def _posteriors(study: Study) -> list[str]:
    """Sigmas of the posteriors beside what the information forecast."""
    if "posterior_sigma" not in study.data:
        return []
    ratio = study.data["posterior_sigma"].values / study.data["sigma"].values
    ratio = np.where(study.sweep.ok[:, None], ratio, np.nan)
    if not np.isfinite(ratio).any():
        return []
    low, middle, high = (fixed(q, 2) for q in np.nanquantile(ratio, (0.05, 0.5, 0.95)))
    return [
        f"Sigmas of the posteriors are {middle} times what the information forecasts (median; "
        f"{low} to {high} for 90 % "
        "of cells and parameters)."
    ]


def study_limits(study: Study) -> list[str]:
    """What was not assessed, and which cells failed."""
    sweep = study.sweep
    total, failed = len(sweep.ok), int((~sweep.ok).sum())
    parts = []
    if failed:
        reasons = [f"{count(n)}: {reason.rstrip('.')}" for reason, n in sweep.failures[:3]]
        more = len(sweep.failures) - len(reasons)
        rest = f"; {plural(more, 'further reason')}" if more > 0 else ""
        parts.append(
            f"{count(failed)} of {plural(total, 'cell')} have no numbers "
            f"({'; '.join(reasons)}{rest})."
        )
    seeds = len(np.unique(study.data["seed_index"].values))
    if seeds == 1 and not sweep.drawn:
        parts.append("One seed: what another sky or other frames would change was not assessed.")
    if sweep.drawn:
        parts.append(
            "Drawn from a Latin hypercube: "
            f"{join_words([axis_name(axis) for axis in sweep.drawn])}. Each is told in "
            "parts of equal number, by their middles."
        )
    if study.definition.mode == "simulate":
        parts.append(
            "Simulated with the noise and the distortion model that the calibration assumes."
        )
    else:
        parts.append(
            "From Fisher information: Gaussian noise, right identifications and a right "
            "distortion model are assumed. "
            "Coverage, bias of the estimates and convergence were not assessed; mode = "
            '"simulate" does.'
        )
    return parts
