"""Centroids, identifications and runs from images in sentences and tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_uq.core.remedy import Remedy
from starcal_uq.pipeline.images import FAINTEST
from starcal_uq.pipeline.inspection import IDENTIFIED, Frames, InspectedFrame
from starcal_uq.pipeline.refine import ImageCalibration, identified_pairs
from starcal_uq.presentation.words.sentences import told

MOST_FRAMES = 40


def image_calibration_text(images: ImageCalibration) -> str:
    """What the second round of identification changed."""
    (before, _, first), (after, _, second) = images.rounds[0], images.rounds[-1]
    old, new = identified_pairs(before.observations), identified_pairs(after.observations)
    shift = (second.theta - first.theta) / second.sigmas
    moved = dict(zip(second.parameter_names, shift.tolist(), strict=True))
    return told(
        "image_calibration", images, before=before, after=after, old=old, new=new, moved=moved
    )


@dataclass(frozen=True)
class Step:
    """What to do next about a frame, in words, and the command that does it."""

    words: str
    remedy: Remedy


def next_step(frame: InspectedFrame, frames: Frames) -> Step | None:
    """What to do about a frame without a part in the calibration; None for others."""
    if frame.n(IDENTIFIED):
        return None
    image = str(frame.path) if frame.path is not None else frame.row.image
    run, outcome = frames.run, frame.row.outcome
    # Much fainter ones are not detected, and take longer to be told apart.
    faintest = min(np.ceil(frames.searched_mag + 1.0), FAINTEST)
    deeper = {"max_mag": f"{faintest:g}"} if frames.searched_mag > 0.0 else {}
    camera = (f"{run}/camera.toml",) if frames.known else ()
    found = {"out": "found.csv"} | ({"calibration": run} if frames.calibrated else {})
    again = Remedy("identify", (f"{run}/centroids.parquet", *camera), found)
    lens = {"camera": camera[0]} if camera else {}
    centroid = Remedy("centroid", (image,), lens | {"out": "stars.csv"})
    if other := next(
        (other for other in frames.record.others if frame.row.frame in other.frames), None
    ):
        paths = [str(frames.paths[number]) for number in other.frames if number in frames.paths]
        return Step(
            "another camera took it: calibrate the frames of that camera by themselves.",
            Remedy("run", tuple(paths), {"out": f"{run}-other"}),
        )
    if outcome == "identified":
        images = tuple(str(source) for source in frames.images) or ("IMAGES",)
        return Step(
            "too few of its stars can be calibrated; search among fainter ones.",
            Remedy("run", images + camera, {"out": f"{run}-deeper", **deeper}),
        )
    if outcome == "too few stars":
        return Step("look for fainter stars, or expose longer.", centroid.having(threshold=3.5))
    if outcome == "ambiguous":
        return Step("identify it with what the other frames have told about the camera.", again)
    if outcome in ("not identified", "not searched"):
        words = (
            "if it shows stars, and no clouds, trees or other field of view, search among "
            "fainter ones."
        )
        return Step(words, again.having(**deeper))
    return Step("hear the whole reason.", centroid)
