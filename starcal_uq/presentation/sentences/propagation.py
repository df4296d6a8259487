"""Attitude errors, and what limits a result, in words."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.formatting import significant
from starcal_uq.diagnostics.verdict.limits import Limit
from starcal_uq.presentation.sentences.table import SENTENCES, entry
from starcal_uq.propagation.attitude_error import (
    IF_MODEL_HOLDS,
    NOT_ASSESSED,
    WITH_MISFIT_FOUND,
)

_LIMITS = {
    Limit.DIRECTIONS: (
        "Knowledge of the directions: until they are known to be apparent, f is conditional on "
        "that."
    ),
    Limit.AIR: (
        "Refraction: until the site is stated, or that the camera was in space, f is conditional "
        "on it."
    ),
    Limit.FRAMES: (
        "Coupling: no two parameters are strongly coupled; every sigma falls as one over the root "
        "of the frames."
    ),
}
SENTENCES |= {code: limit.format for code, limit in _LIMITS.items()}


def two_figures(with_misfit_found: float, if_model_holds: float) -> str:
    """One error by its two names, arcsec, for a sentence; once, where both print alike."""
    found, held = significant(float(with_misfit_found)), significant(float(if_model_holds))
    if np.isnan(with_misfit_found):
        return f"{held} arcsec {IF_MODEL_HOLDS} ({WITH_MISFIT_FOUND}: {NOT_ASSESSED})"
    return (
        f"{held} arcsec"
        if found == held
        else f"{found} arcsec {WITH_MISFIT_FOUND} ({held} {IF_MODEL_HOLDS})"
    )


@entry(Limit.PATTERN)
def _pattern(pattern_arcsec: float) -> str:
    return (
        f"The model: residuals keep a pattern of {significant(pattern_arcsec)} arcsec, which more "
        "frames will not remove."
    )


@entry(Limit.STRUCTURE)
def _structure(name: str, size_px: float, size_arcsec: float) -> str:
    return (
        f"The model: the largest structure that it leaves in the residuals is {name}, "
        f"{significant(size_px)} px ({significant(size_arcsec)} arcsec) per star."
    )


_PARTS = {
    "noise": "centroid noise of a single frame",
    "common": "the calibration's common rotation",
    "rest": "the calibration's rest",
}


@entry(Limit.ATTITUDE)
def _attitude(largest: str, alignment: str, **sizes: tuple[float, float]) -> str:
    noise, common, rest = (two_figures(*sizes[f"{part}_arcsec"]) for part in _PARTS)
    if largest == "common":
        return (
            f"Attitude across the boresight: {_PARTS[largest]}, one constant, exceeds centroid "
            f"noise: {common} against {noise} per frame. Alignment calibration with these "
            f"parameters, on {alignment}, absorbs it; what remains is {rest}."
        )
    return (
        f"Attitude across the boresight: {_PARTS[largest]} dominates. Noise: {noise}; common "
        f"rotation: {common}; rest: {rest}."
    )


@entry(Limit.COUPLED)
def _coupled(pair: tuple[str, str], correlation: float, parameter: str, times: float) -> str:
    first, second = pair
    return (
        f"Coupling: {first} trades against {second} (correlation {correlation:.2f}); with the "
        f"other parameters known, {parameter} would be {significant(times)} times better "
        "determined."
    ).replace("-", "−")
