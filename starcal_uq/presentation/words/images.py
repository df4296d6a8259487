"""Centroids, identifications and runs from images in sentences and tables."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.formatting import count, plural, superscript
from starcal_uq.core.remedy import Remedy
from starcal_uq.identification.result import STATUSES, FoundOptics, FrameStatus, Identification
from starcal_uq.images.centroids import Centroids
from starcal_uq.pipeline.images import FAINTEST
from starcal_uq.pipeline.inspection import IDENTIFIED, Frames, InspectedFrame
from starcal_uq.pipeline.record import ImageRecord
from starcal_uq.pipeline.refine import ImageCalibration, identified_pairs
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.inputs import focal_words

_MIRRORED = " The images are mirror images of the sky: x is counted from the right edge."
_REASONS: dict[FrameStatus, str] = {
    "identified": "identified",
    "not identified": "in which no attitude explains the centroids well enough",
    "ambiguous": "that fit more than one attitude",
    "too few stars": "with fewer than four centroids",
}
MOST_FRAMES = 40


def centroids_text(centroids: Centroids) -> str:
    """One sentence: stars, frames, and how many frames were left out and why."""
    left_out = centroids.n_left_out
    text = (
        f"{plural(centroids.n_stars, 'star')} in {plural(centroids.n_frames - left_out, 'frame')}"
    )
    if left_out:
        # The reason follows the name of the image, which differs from frame to frame.
        reasons, counts = np.unique(centroids.problem[centroids.problem != ""], return_counts=True)
        named = [f"{c} because {r}" for r, c in zip(reasons.tolist(), counts.tolist(), strict=True)]
        text += (
            f"; {plural(left_out, 'frame')} {'was' if left_out == 1 else 'were'} left out: "
            f"{', '.join(named)}"
        )
    return text + "."


def centroids_table(centroids: Centroids) -> TextTable:
    """The first frames."""
    columns = ("frame", "n_stars", "image", "background", "noise", "psf_sigma_px", "problem")
    formats = dict.fromkeys(("background", "noise", "psf_sigma_px"), "{:.4g}".format)
    return TextTable.of(centroids.frames_dataframe().head(MOST_FRAMES), "", columns, formats)


def identification_text(identification: Identification) -> str:
    """How many frames are identified, why the others are not, and what the nominal camera
    missed.
    """
    n_frames = len(identification.frames) - identification.n_left_out
    if not n_frames:
        return "There are no frames."
    counts = Counter(frame.status for frame in identification.frames)
    counts["too few stars"] -= identification.n_left_out
    be = "is" if 1 in (identification.n_identified, n_frames) else "are"
    words = f"{identification.n_identified} of {plural(n_frames, 'frame')} {be} identified"
    if identification.n_identified:
        stars = [
            frame.n_identified for frame in identification.frames if frame.status == "identified"
        ]
        words += f", with {np.mean(stars):.1f} stars on average"
    words += "."
    rest = [f"{counts[status]} {_REASONS[status]}" for status in STATUSES[1:] if counts[status]]
    if rest:
        words += f" Left out: {'; '.join(rest)}."
    unlike = sum(frame.n_unlike_brightness for frame in identification.frames)
    if unlike:
        words += (
            f" {plural(unlike, 'match', 'matches')} given up, because the brightness is unlike "
            "the star's."
        )
    if identification.optics is not None:
        words += f" {optics_text(identification.optics, identification.nominal)}"
    elif identification.n_identified:
        change = 100.0 * (identification.camera.focal_px / identification.nominal.focal_px - 1.0)
        words += (
            f" The focal length is {abs(change):.2f} % {'longer' if change >= 0 else 'shorter'} "
            "than nominal."
        )
    return words + _MIRRORED if identification.parity == "mirrored" else words


def optics_text(optics: FoundOptics, camera: Camera) -> str:
    """What the stars alone said of the lens, and how sure that is."""
    width, height = camera.fov_deg
    agree = f"{plural(optics.n_frames, 'frame says', 'frames say')} so"
    return (
        f"The stars alone tell the camera: a field of {width:.3g} x {height:.3g} degrees, f = "
        f"{focal_words(camera)}; "
        f"{agree}, by chance once in "
        f"10{superscript(round(-optics.log10_expected_false))}."
    )


def identification_table(identification: Identification) -> TextTable:
    """What became of the first frames."""
    columns = (
        "frame",
        "image",
        "status",
        "n_centroids",
        "n_identified",
        "log10_expected_false",
        "milliseconds",
    )
    return TextTable.of(identification.to_dataframe().head(MOST_FRAMES), "Identification", columns)


def image_calibration_text(images: ImageCalibration) -> str:
    """What the second round of identification changed."""
    (before, _, first), (after, _, second) = images.rounds[0], images.rounds[-1]
    old, new = identified_pairs(before.observations), identified_pairs(after.observations)
    words = (
        f"{plural(len(old), 'star')} in {plural(before.n_identified, 'frame')} with the nominal "
        "camera, "
        f"{plural(len(new), 'star')} in {plural(after.n_identified, 'frame')} with the "
        "calibrated one: "
        f"{len(new - old)} new, {len(old - new)} given up."
    )
    shift = (second.theta - first.theta) / second.sigmas
    moved = ", ".join(
        f"{name} {value:+.1f}"
        for name, value in zip(second.parameter_names, shift.tolist(), strict=True)
    )
    return f"{words} The estimate moved, in its standard deviations: {moved}."


def image_record_text(record: ImageRecord) -> str:
    """What was used of the images of a run."""
    used = len(record.rows) - len(record.left_out)
    measured = sum(row.n_centroids for row in record.rows)
    words = (
        f"{used} of {plural(len(record.rows), 'image')} used; {plural(measured, 'star image')} "
        "were found in them"
    )
    words += f", and {sum(row.n_last for row in record.rows)} of these were identified."
    if record.n_disturbed:
        words += (
            f" {plural(record.n_disturbed, 'star')} left out, because the light of a neighbour "
            "displaces them."
        )
    return words + _MIRRORED if record.parity == "mirrored" else words


def frames_text(frames: Frames) -> str:
    """How many frames of how many, and what they are."""
    n_run = frames.n_run or len(frames)
    calibrated = sum(row.frame in frames.rms_px for row in frames.record.rows)
    words = f"{plural(len(frames), 'frame')}"
    if len(frames) < n_run:
        words += (
            f" of {count(n_run)}"
            if frames.large
            else f" of {count(n_run)}: some that failed, some that fit worst"
        )
        words += "" if frames.large else ", and others spread over the run"
    return f"{words}; {calibrated} of them took part in the calibration."


def outcome_words(frame: InspectedFrame) -> str:
    """What became of a frame, in a few words."""
    if frame.n(IDENTIFIED):
        return "calibrated"
    return (
        f"{frame.row.outcome}, not calibrated"
        if frame.row.outcome == "identified"
        else frame.row.outcome
    )


def frame_text(frame: InspectedFrame) -> str:
    """A frame in one sentence."""
    detections = plural(len(frame.detections), "detection")
    words = f"Frame {frame.row.frame}, {frame.row.image}: {outcome_words(frame)}; {detections}"
    if not frame.solved:
        return f"{words}."
    missed = f"{frame.n('missed')} of {plural(frame.n('expected'), 'expected star')} missed"
    rms = f"; rms {frame.rms_px:.3f} px per axis" if frame.n(IDENTIFIED) else ""
    return f"{words}, {frame.n(IDENTIFIED)} identified, {missed}{rms}."


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
