"""Plans in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.constants import AXES
from starcal_uq.core.formatting import MINUS, count, fixed, join_words, percent, plural, significant
from starcal_uq.planning.check import ForecastCheck
from starcal_uq.planning.costs import EffectCosts
from starcal_uq.planning.design import FrameChoice
from starcal_uq.planning.open_distortion import AFTER_FRAMES, DistortionRange
from starcal_uq.planning.planned import Need, Plan
from starcal_uq.presentation.tables import TextTable

# Radii that differ by less than this over the open distortion hardly matter.
LITTLE = 1.2
SCOPE_NAMES = {
    "common": "common rotation",
    "rest": "rest of the calibration",
    "calibration": "calibration (common rotation and rest)",
    "total": "calibration and centroid noise",
}


# Quantities that known rotations between frames tell, and their units.
_TOLD_BY_TIES = {
    "x0_px": ("x0", "px"),
    "y0_px": ("y0", "px"),
    "common_pitch_arcsec": ("the common rotation in pitch", "arcsec"),
    "common_yaw_arcsec": ("in yaw", "arcsec"),
}


def frames(number: int | None) -> str:
    """A number of frames to three digits, rounded up; what cannot be reached is said."""
    if number is None:
        return "no number of frames"
    step = 10 ** max(0, len(str(number)) - 3)
    return plural(-(-number // step) * step, "frame")


def need_words(need: Need, number: int | None) -> str:
    """`frames` of a need, or why there is no number."""
    if number is None:
        return "no number of frames" if need.floor_arcsec > 0.0 else "more than ten million"
    return frames(number)


def need_text(need: Need) -> str:
    """`frames` to three digits, rounded up, as it is printed; or why there is no number."""
    return need_words(need, need.frames)


def level(confidence: float) -> str:
    """A confidence in per cent, with all its digits."""
    return f"{100.0 * confidence:.6g}\N{NO-BREAK SPACE}%"


def plan_text(plan: Plan) -> str:
    """The plan in a few sentences: what the target takes, else what the largest campaign gives."""
    if plan.need is None:
        return _largest(plan)
    target = f"{plan.target_arcsec:g} arcsec across the boresight at {level(plan.confidence)}"
    return f"{_needed(plan.need, target)}{_range(plan)}{_others(plan)}"


def _range(plan: Plan) -> str:
    """The range of frames over the distortion that the sheet leaves open."""
    if plan.distortion is None or plan.frames_range is None:
        return ""
    words, percent = range_words(*plan.frames_range), plan.distortion.own_percent
    own = "without distortion" if percent == 0.0 else f"at {corner(percent)}"
    return (
        f" That is {own}; over the distortion that the sheet leaves open "
        f"({span(plan.distortion)} at the corner) it is {words}."
    )


def range_words(least: float, most: float) -> str:
    """A range of numbers of frames; infinite where none does."""
    ends = [frames(None if np.isinf(n) else int(n)) for n in (least, most)]
    return (
        ends[0]
        if ends[0] == ends[1]
        else f"{ends[0].removesuffix('s').removesuffix(' frame')} to {ends[1]}"
    )


def corner(percent: float) -> str:
    """A displacement of the corner by the distortion."""
    if percent == 0.0:
        return "no distortion"
    kind = "barrel" if percent < 0.0 else "pincushion"
    return f"{significant(abs(percent))} % of {kind} distortion"


def span(found: DistortionRange) -> str:
    """The range of the displacement of the corner."""
    low, high = (f"{significant(p)} %" for p in (found.percent[0], found.percent[-1]))
    return f"{low} to {high}".replace("-", MINUS)


def distortion_sentence(plan: Plan) -> str:
    """What the open distortion does, which distortion is the worst, and why; empty where the
    distortion is known.
    """
    found = plan.distortion
    if found is None:
        return ""
    radius = found.radius_after_arcsec
    open_words = f"The sheet leaves the distortion open ({span(found)} at the corner)."
    if np.max(radius) < LITTLE * np.min(radius):
        return f"{open_words} It hardly matters for the {SCOPE_NAMES[plan.scope]}."
    point = found.principal_point_px
    return (
        f"{open_words} The worst is {corner(found.percent[np.argmax(radius)])}. What decides is how "
        "well the principal point can be told from a rotation of the camera: its sigma after "
        f"{frames(AFTER_FRAMES)} is {significant(point.min())} to {significant(point.max())} px. "
        "Barrel distortion makes them alike, most nearly in an f-theta lens "
        f"({significant(abs(found.f_theta_percent))} %). If the lens is known better, narrow the "
        "range with --distortion-percent LOW HIGH, or give the coefficients."
    )


def _needed(need: Need, target: str) -> str:
    name = SCOPE_NAMES[need.scope]
    if need.frames is None:
        if need.floor_arcsec > 0.0:
            return (
                f"No number of frames keeps {target} for {name}: centroid noise alone is "
                f"{significant(need.floor_arcsec, 3)} arcsec."
            )
        return f"Not even ten million frames keep {target} for the {name}."
    surely = (
        ""
        if need.frames_surely is None
        else f" ({frames(need.frames_surely)} for 95 % of campaigns to keep it)"
    )
    return f"To keep {target} for the {name} takes {frames(need.frames)}{surely}."


def _others(plan: Plan) -> str:
    """The need of the part that alignment leaves, beside that of the common rotation."""
    if plan.scope != "common":
        return ""
    rest = next(need for need in plan.needs if need.scope == "rest")
    return (
        " If alignment is calibrated with the same parameters, only the rest counts: "
        f"{need_words(rest, rest.frames)}."
    )


def _largest(plan: Plan) -> str:
    last = plan.to_dataframe().iloc[-1]
    common, rest, noise = (
        significant(last[f"{part}_pitch_arcsec"]) for part in ("common", "rest", "nea")
    )
    return (
        f"{frames(int(last['n_frames']))} of {significant(plan.mean_stars, 3)} stars at "
        f"{significant(plan.sigma_px)} px give a common rotation of {common} and a rest of {rest} "
        f"arcsec (1 sigma in pitch), beside centroid noise of {noise} arcsec in every frame."
    )


def ties_sentence(plan: Plan) -> str:
    """What known rotations bring to the largest campaign; empty without any."""
    if plan.ties is None or plan.without_ties is None:
        return ""
    known = f"to {plan.ties.sigma_arcsec:g} arcsec from each frame to the next"
    what = f"Rotations that are known {known}"
    if plan.ties.of_mount:
        what = f"A fixed mount that moves by {plan.ties.sigma_arcsec:g} arcsec"
    elif plan.ties.alignment_arcsec:
        what += f", in axes that are known to {plan.ties.alignment_arcsec:g} arcsec,"
    before, after = plan.without_ties, plan.forecast
    changes = [
        f"{name} from {significant(before.of(key)[-1])} to {significant(after.of(key)[-1])} {unit}"
        for key, (name, unit) in _TOLD_BY_TIES.items()
    ]
    n = count(int(plan.forecast.n_frames[-1]))
    verb = "changes" if plan.ties.of_mount else "change"
    return f"{what} {verb} standard deviations after {n} frames: {join_words(changes)}."


def settings_sentence(plan: Plan) -> str:
    """What the forecast assumes."""
    return (
        f"Stars to magnitude {plan.max_mag:.2f} ({significant(plan.mean_stars, 3)} a frame on "
        "average), centroid noise "
        f"of {significant(plan.sigma_px)} px per axis, frames at random attitudes with at least "
        f"{plan.min_stars} "
        f"stars: {percent(plan.sky_fraction)} of the sky shows them."
    )


def choice_text(choice: FrameChoice) -> str:
    """What the choice is worth."""
    main = "rest" if choice.scope == "rest" else "common"
    aim = "parameters as a whole" if choice.criterion == "D" else SCOPE_NAMES[choice.scope]
    worth = choice.worth().set_index("quantity").loc[f"{main}_pitch_arcsec"]
    low, mean, high = (fixed(worth[name], 2) for name in ("factor_low", "factor", "factor_high"))
    richest = fixed(worth["richest"] / worth["chosen"], 2)
    return (
        f"{frames(len(choice.rotations))} of {count(choice.n_candidates)} candidates, chosen for "
        f"the {aim}. As many random frames leave a {SCOPE_NAMES[main]} {mean} times as large in "
        f"pitch ({low} to {high} for 90 % of random sets), the frames with most stars one "
        f"{richest} times as large."
    )


def check_text(check: ForecastCheck) -> str:
    """Whether forecast and simulation agree."""
    table = check.to_dataframe()
    worst = table.loc[(table["ratio"] - 1.0).abs().idxmax()]
    outside = np.array(check.forecast.n_frames)[check.nees_rejected]
    errors = "what they should be"
    if len(outside):
        errors = f"not {errors} with {join_words([count(int(n)) for n in outside])} frames"
    return (
        f"{count(check.n_campaigns)} simulated campaigns of each size: the sigmas they state "
        f"differ from the forecast by at most {percent(check.largest_difference)} "
        f"({worst['quantity']}, {plural(int(worst['n_frames']), 'frame')}); their squared errors "
        f"are {errors}."
    )


def plan_table(plan: Plan) -> TextTable:
    """The forecast by number of frames."""
    focal = "f_px" if plan.camera.pixel_um is None else "f_mm"
    columns = (
        "n_frames",
        "x0_px",
        focal,
        "common_pitch_arcsec",
        "rest_pitch_arcsec",
        "nea_pitch_arcsec",
    )
    title = "Forecast, standard deviations; the radius holds the stated confidence"
    spread = () if plan.distortion is None else ("radius_least_arcsec", "radius_most_arcsec")
    return TextTable.of(plan.to_dataframe(), title, (*columns, "radius_arcsec", *spread))


def costs_table(costs: EffectCosts) -> TextTable:
    """What effects cost: the growth of what is known of the camera, and attitude errors."""
    import pandas as pd

    grown = {
        "x₀": ("x0_px", "y0_px"),
        "f": ("f_px",),
        "corner": ("distortion_corner_px",),
        "common": ("common_pitch_arcsec", "common_yaw_arcsec"),
    }
    known = {head: names for head, names in grown.items() if set(names) <= set(costs.names)}
    rest = [costs.names.index(f"rest_{axis}_arcsec") for axis in AXES[:2]]
    table = pd.DataFrame({"effects": costs.models})
    table["scale [px]"] = table["effects"].map(costs.planned.scales)
    for head, names in known.items():
        table[head] = [costs.growth(model, *names) for model in costs.models]
    table["rest [arcsec]"], table["camera alone aboard"] = (
        np.sqrt(np.mean(sigma[:, rest] ** 2, axis=1)) for sigma in (costs.sigma, costs.camera_alone)
    )
    title = f"What effects cost after {frames(costs.n_frames)}: growth of sigmas, and the rest"
    forms = dict.fromkeys(known, lambda factor: f"× {fixed(factor, 2)}")
    return TextTable.of(table, title, formats=forms, missing="")


def costs_sentence(costs: EffectCosts) -> str:
    """What the costs rest on, and how well slopes with the temperature are known."""
    planned = costs.planned
    assumed = (
        "The scales are assumptions, standard deviations in px at the corner. Attitudes are those "
        "of a mission whose software knows the effects; with the camera alone aboard they err by "
        "the effects themselves."
    )
    if "temperature" not in planned.scales:
        return assumed
    slopes = [
        f"{name} to {significant(costs.of('temperature', f'{name}_px_per_K'))}"
        for name in ("x0", "y0", "f")
    ]
    return (
        f"{assumed} Over {planned.temperature_range_c:g} K, slopes with the temperature are known "
        f"({join_words(slopes)} px/K); half the range doubles these."
    )


def need_sentence(plan: Plan, need: Need) -> str:
    """`need_text` after the part of the error, with the range over the open distortion."""
    spread = plan.distortion
    words = (
        ""
        if spread is None
        else f" ({range_words(*spread.frames_range(need.scope))} over the open distortion)"
    )
    return f"{need.scope}: {need_text(need)}{words}"


def choice_table(choice: FrameChoice, n: int = 20) -> TextTable:
    """The first frames to take, most valuable first."""
    return TextTable.of(
        choice.to_dataframe().head(n), f"The first {min(n, len(choice.candidate))} frames to take"
    )
