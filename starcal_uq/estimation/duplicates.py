"""What becomes of frames that hold the same measurement twice: refused, left out or kept."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, get_args

import numpy as np

from starcal_uq.core.errors import CalibrationError, RepeatedFramesError, check_known
from starcal_uq.core.findings import clause
from starcal_uq.core.settings import Duplicates
from starcal_uq.core.types import IntArray
from starcal_uq.observations.repeats import (
    REACH_PX,
    REACH_SIGMAS,
    Fingerprints,
    alike,
    repeats,
    shared,
)

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

DUPLICATES = get_args(Duplicates)
# Part of the detector's width over which stars tell the roll of their frame.
_SPAN = 0.25
# What frames have in common.
Repeats = Enum("Repeats", "FRAMES")


def fingerprints_of(
    calibration: Calibration, obs: Observations | None = None
) -> Fingerprints | None:
    """Those of a calibration; where a version before this one made it, from its observations, if
    there are any.
    """
    if (
        calibration.fingerprints is not None
        or obs is None
        or len(obs) != len(calibration.residuals_px)
    ):
        return calibration.fingerprints
    return Fingerprints.of(obs, calibration.residuals_px, calibration.camera.centre_px)


def repeated_frames(a: Calibration, b: Calibration | None = None) -> IntArray:
    """Frames that hold the same measurement, whatever their numbers, order and stars.

    Parameters
    ----------
    a : Calibration
        A calibration with fingerprints.
    b : Calibration, optional
        Another, whose frames are compared with those of `a`; otherwise those of `a` are compared
        with each other.

    Returns
    -------
    (n, 2) array of int
        Frame numbers: of the first and the repeating frame, or of the frame of `a` and that of `b`.

    Raises
    ------
    RepeatedFramesError
        If a calibration has no fingerprints: it was made from a stream or by a version without
        them.
    """
    given = [a] if b is None else [a, b]
    marks = [calibration.fingerprints for calibration in given]
    present = [one for one in marks if one is not None]
    if len(present) < len(given):
        raise RepeatedFramesError(
            "a calibration without fingerprints of its frames cannot be checked: calibrate again."
        )
    if b is None:
        return a.frame_ids[repeats(present[0])]
    pairs = shared(*present)
    return np.column_stack([a.frame_ids[pairs[:, 0]], b.frame_ids[pairs[:, 1]]])


def check_duplicates(duplicates: str) -> None:
    """Refuse a word that says nothing about repeated frames."""
    check_known("duplicates", duplicates, DUPLICATES, CalibrationError)


def repeated(what: str, pairs: IntArray, n_frames: int) -> str:
    """First part of a sentence about so many frames that hold the same as others; pairs (n, 2) of
    frame numbers.
    """
    first, later = pairs[0]
    return clause(Repeats.FRAMES, what=what, first=first, later=later, more=n_frames - 1)


def repeating_frames(calibration: Calibration, obs: Observations, duplicates: str) -> IntArray:
    """Numbers of the frames to leave out of the observations of a calibration: none where they are
    kept, and an error where they are refused.
    """
    if duplicates == "keep" or not calibration.has_residuals:
        return np.empty(0, dtype=np.int64)
    # A measurement has its attitude, too, and most frames are alone with theirs. The stars of the
    # worst frames span a part of the detector.
    camera, noise = calibration.camera, calibration.sigma * float(np.mean(obs.sigma_or_one))
    reach = REACH_PX / camera.focal_px + REACH_SIGMAS * noise / (_SPAN * camera.width_px)
    near = alike(calibration.rotations, reach)
    if not len(near):
        return near
    marks = Fingerprints.of(obs, calibration.residuals_px, camera.centre_px, near)
    pairs = calibration.frame_ids[near[repeats(marks, n_frames=obs.n_frames)]]
    later = np.unique(pairs[:, 1])
    if len(later) and duplicates == "refuse":
        raise RepeatedFramesError(
            f"{repeated('measurement', pairs, len(later))}: their stars differ by far less than "
            "their noise, and would count twice; leave the later ones out (duplicates='drop', "
            "--duplicates drop), or, if you know them to be exposures of their own, keep them "
            "(duplicates='keep', "
            "--duplicates keep).",
            pairs=pairs.tolist(),
        )
    return later
