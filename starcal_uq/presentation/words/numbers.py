"""Numbers and names as sentences and tables write them, beside `core.formatting`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from starcal_uq.budgeting.file import SENSOR, Requirement
from starcal_uq.budgeting.rows import AXIS_LABELS
from starcal_uq.camera.distortion import PARAMETERS
from starcal_uq.core.formatting import (
    MINUS,
    count,
    decimals_for,
    fixed,
    plural,
    plus_minus,
    significant,
)
from starcal_uq.propagation.attitude_error import IF_MODEL_HOLDS, NOT_ASSESSED, WITH_MISFIT_FOUND

if TYPE_CHECKING:
    from starcal_uq.budgeting.totals import Total
    from starcal_uq.planning.open_distortion import DistortionRange
    from starcal_uq.planning.planned import Need
    from starcal_uq.propagation.attitude_error import AttitudeError

NOT_RESOLVED = "not resolved"
# A number, or the least and the most of several.
Number: TypeAlias = float | tuple[float, float]


def capital(text: str) -> str:
    """First letter of a sentence; the name of a parameter stays as it is written."""
    return text if text.split(" ")[0].rstrip(":") in PARAMETERS else text[:1].upper() + text[1:]


def two_figures(pair: Sequence[float]) -> str:
    """One error by its two names, arcsec, for a sentence; once, where both print alike."""
    found, held = (significant(float(value)) for value in pair)
    if np.isnan(pair[0]):
        return f"{held} arcsec {IF_MODEL_HOLDS} ({WITH_MISFIT_FOUND}: {NOT_ASSESSED})"
    more = f" {WITH_MISFIT_FOUND} ({held} {IF_MODEL_HOLDS})" if found != held else ""
    return f"{found} arcsec{more}"


def both(error: AttitudeError, part: int, axis: int) -> str:
    """A term of the attitude error on an axis, arcsec, with the misfit found; in brackets if the
    model holds, where that prints otherwise.
    """
    held = significant(error.if_model_holds_arcsec[part, axis])
    if error.misfit is None:
        return held
    found = significant(error.with_misfit_found_arcsec[part, axis])
    return held if found == held else f"{found} ({held})"


def with_error(value: float, sigma: float) -> str:
    """A number and its sigma, both with the decimals that sigma leaves."""
    decimals = decimals_for(sigma)
    return f"{fixed(value, decimals)} ± {fixed(sigma, decimals)}"


def change(value: float, sigma: float) -> str:
    """A difference with its sigma; what no one can tell from zero without digits that mean
    nothing.
    """
    if not np.isfinite(sigma):
        return significant(value) if abs(value) >= 1e-6 else "0"
    return f"{fixed(value, 3)} ± 0.000" if sigma < 5e-4 else plus_minus(value, sigma)


def numbers(values: Sequence[float]) -> str:
    """Numbers of the axes, in their order."""
    return ", ".join(significant(v) if np.isfinite(v) else "an unknown number of" for v in values)


def digits(value: Number, n: int = 2, scale: float = 1.0) -> str:
    """A number, or the range of several, with significant digits."""
    ends = value if isinstance(value, tuple) else (value,)
    return " to ".join(dict.fromkeys(significant(scale * end, n) for end in ends))


def percents(value: Number, n: int = 2) -> str:
    """A fraction, or the range of several, in per cent."""
    return f"{digits(value, n, 100.0)}\N{NO-BREAK SPACE}%"


def least(value: Any) -> Any:
    """The least of a range, or a number itself."""
    return value[0] if isinstance(value, tuple) else value


def bound(value: float, at_least: bool, n: int = 3) -> str:
    """A bound in arcsec, with "≥" while contributors are missing."""
    if math.isnan(value):
        return NOT_ASSESSED
    return ("≥ " if at_least else "") + significant(value, n)


def sampled(total: Total) -> str:
    """The sampled bound of a total in arcsec, with the digits that its standard error leaves."""
    if total.unresolved:
        return NOT_RESOLVED
    if math.isnan(total.sampled_arcsec):
        return NOT_ASSESSED
    digits = max(decimals_for(total.sampled_se_arcsec, 1), decimals_for(total.sampled_arcsec, 2))
    digits = min(digits, decimals_for(total.sampled_arcsec, 3))
    return ("≥ " if total.at_least else "") + fixed(total.sampled_arcsec, digits)


def requirement_axis(asked: Requirement) -> str:
    """Axis of a requirement, with its index and frame where these are not the usual ones."""
    label = AXIS_LABELS[asked.axis]
    if asked.frame != SENSOR:
        label = f"{label} of {asked.frame}"
    return label if asked.index == "AKE" else f"{asked.limited.label}, {label}"


def frames(number: int | None) -> str:
    """A number of frames to three digits, rounded up; what cannot be reached is said."""
    if number is None:
        return "no number of frames"
    step = 10 ** max(0, len(str(number)) - 3)
    return plural(-(-number // step) * step, "frame")


def need_words(need: Need, number: int | None) -> str:
    """`frames` of a need, or why there is no number."""
    if number is None and not need.floor_arcsec > 0.0:
        return "more than ten million"
    return frames(number)


def range_words(ends: tuple[float, float]) -> str:
    """A range of numbers of frames; infinite where none does."""
    low, high = (frames(None if np.isinf(n) else int(n)) for n in ends)
    return low if low == high else f"{low.removesuffix('s').removesuffix(' frame')} to {high}"


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


def mean_to_mcse(mean: float, mcse: float) -> str:
    """A mean with the digits that its Monte Carlo error leaves: the last one is larger than the
    error.
    """
    decimals = 0 if not mcse > 0.0 else max(0, int(np.floor(-np.log10(mcse))))
    return fixed(mean, decimals)


def pair(values: Sequence[float], decimals: int) -> str:
    """A number and its sigma with so many decimals."""
    return " ± ".join(fixed(value, decimals) for value in values)


def across_and_roll(angles: Sequence[float]) -> str:
    """Angles about the three axes: across the boresight, and in roll."""
    pitch, yaw, roll = angles
    return f"{significant(np.hypot(pitch, yaw))} / {significant(abs(roll))}"


def correlation_text(value: float, diagonal: bool = False) -> str:
    """Two decimals; three near one, because 0.99 and 0.999 differ by a factor of three in sigma."""
    if diagonal:
        return "1"
    if abs(value) >= 0.99:
        text = f"{np.clip(value, -0.9999, 0.9999):.{4 if abs(value) >= 0.999 else 3}f}"
    else:
        text = f"{value:.2f}"
    return text.replace("-", MINUS) if float(text) != 0.0 else "0.00"


def frames_needed(number: float) -> str:
    """Frames that a target takes, where some number of them does it."""
    return "never" if np.isinf(number) else count(int(np.ceil(number)))


def ends(values: Any) -> tuple[float, float]:
    """Least and most of what is finite."""
    finite = values[np.isfinite(values)]
    return float(finite.min()), float(finite.max())


def sigma_or_size(logarithm: float, coupling: bool) -> str:
    """A sigma by its logarithm, or the size of the correlation whose price in sigma has it."""
    if coupling:
        return correlation_text(float(np.sqrt(-np.expm1(-2.0 * logarithm))))
    return significant(np.exp(logarithm))
