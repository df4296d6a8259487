"""Effects beyond the camera in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table

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
    refused = [{"name": name, "gain_nat": gain} for name, gain in effects.refused if path]
    groups: dict[str, Sequence[Any]] = {
        "weighs": effects.weighing,
        "shifts": (*effects.of_camera, *effects.fitted),
        "refused": refused,
    }
    kinds = [kind for kind, group in groups.items() for _ in group]
    return table("effects", it=[*chain(*groups.values())], kind=kinds)
