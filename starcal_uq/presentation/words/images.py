"""Centroids, identifications and runs from images in sentences and tables."""

from __future__ import annotations

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


def next_step(frame: InspectedFrame, frames: Frames) -> tuple[str, Remedy] | None:
    """What to do about a frame without a part in the calibration, in words, and the command that
    does it; None for others.
    """
    if frame.n(IDENTIFIED):
        return None
    image = frame.row.image if frame.path is None else str(frame.path)
    run, outcome = frames.run, frame.row.outcome
    # Much fainter ones are not detected, and take longer to be told apart.
    faintest = min(np.ceil(frames.searched_mag + 1.0), FAINTEST)
    deeper = {"max_mag": f"{faintest:g}"} if frames.searched_mag > 0.0 else {}
    camera = (f"{run}/camera.toml",) if frames.known else ()
    found = {"out": "found.csv"} | ({"calibration": run} if frames.calibrated else {})
    again = Remedy("identify", (f"{run}/centroids.parquet", *camera), found)
    lens = {"camera": camera[0]} if camera else {}
    centroid = Remedy("centroid", (image,), lens | {"out": "stars.csv"})
    images = tuple(map(str, frames.images)) or ("IMAGES",)
    remedies = {
        "identified": Remedy("run", images + camera, {"out": f"{run}-deeper", **deeper}),
        "too few stars": centroid.having(threshold=3.5),
        "ambiguous": again,
        "not identified": again.having(**deeper),
        "not searched": again.having(**deeper),
    }
    remedy = remedies.get(outcome, centroid)
    others = (other.frames for other in frames.record.others if frame.row.frame in other.frames)
    if other := next(others, None):
        paths = tuple(str(frames.paths[number]) for number in other if number in frames.paths)
        remedy = Remedy("run", paths, {"out": f"{run}-other"})
    return told("next_step", frame, other=other), remedy
