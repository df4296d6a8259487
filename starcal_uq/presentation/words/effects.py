"""Effects beyond the camera in sentences and tables."""

from __future__ import annotations

import math

from starcal_uq.core.formatting import decimals_for, fixed, significant
from starcal_uq.likelihood.fitted_effects import Effects, FittedEffect
from starcal_uq.presentation.tables import TextTable

# What every effect is, in one sentence.
MEANINGS = {
    "axes": "Pixels that are not square, or skewed axes: stretch and skew, parameters of the camera.",
    "field": "The lens shifts images smoothly over the field, as no polynomial of the radius does.",
    "radial": "The lens shifts images along the radius, alike all around.",
    "frame": "Every frame has a scale and two shears of its own: breathing, refraction, seeing.",
    "zenith": "Air raises stars towards a zenith that is estimated.",
    "temperature": "Focal length and principal point change with the temperature.",
    "time": "Focal length and principal point change smoothly over the run.",
    "epoch": "Every night has a focal length and a principal point of its own.",
    "star": "A star's direction errs alike in every frame: catalogue, blend, colour.",
    "phase": "Centroids err with where within a pixel the star is.",
    "magnitude": "Images shift, and the scale changes, with the brightness of the star.",
    "noise": "The noise varies with radius, magnitude, frame or axis.",
    "tails": "Residuals have the tails of a Student t, so that wrong stars hardly count.",
}


def effects_table(effects: Effects, *, path: bool = False) -> TextTable | None:
    """One row per effect of the calibration, in the order in which they were taken up; None without
    any. With `path` those that were not taken up follow, with what they would gain.
    """
    if not effects.names:
        return None
    rows = (
        *map(_weighing_row, effects.weighing),
        *map(_row, (*effects.of_camera, *effects.fitted)),
    )
    if path:
        rows += tuple(
            (name, "", "", "", fixed(gain, 1), "not taken up") for name, gain in effects.refused
        )
    heads = ("effect", "scale", "95 % interval", "shift rms", "gain [nat]", "moved most")
    title = "Effects beyond the camera [px; scale: 1 sigma at the corner]"
    return TextTable(heads, rows, title, "lrrrrl")


def _weighing_row(effect: FittedEffect) -> tuple[str, ...]:
    """Of noise, how far it varies from star to star; of tails, their degrees of freedom."""
    scale = significant(effect.scale_px if effect.dof is None else effect.dof)
    scale += "" if effect.dof is None else " dof"
    moved = f"{effect.moved_name} by {significant(effect.moved_sigma)} sigma"
    return effect.name, scale, "", "", fixed(effect.gain_nat, 1), moved if effect.moved_name else ""


def _row(effect: FittedEffect) -> tuple[str, ...]:
    scale, interval = "known", ""
    if math.isnan(effect.scale_px):
        scale = "in the camera"
    elif effect.low_px != effect.high_px:
        decimals = decimals_for(effect.low_px)
        scale = fixed(effect.scale_px, decimals)
        interval = f"{fixed(effect.low_px, decimals)} – {fixed(effect.high_px, decimals)}"
    return (
        effect.name,
        scale,
        interval,
        significant(effect.size_px),
        fixed(effect.gain_nat, 1),
        f"{effect.moved_name} by {significant(effect.moved_sigma)} sigma",
    )
