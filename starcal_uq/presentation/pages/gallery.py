"""Frames with their stars: the image as a small picture, and marks of lines over it that stay sharp
and can be read.
"""

from __future__ import annotations

import base64
import io
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError, MissingExtraError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_write_text
from starcal_uq.core.provenance import NAME, Provenance, installed_version
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.pipeline.inspection import (
    FAINTER,
    IDENTIFIED,
    LEFT_OUT,
    NOT_MATCHED,
    Frames,
    InspectedFrame,
)
from starcal_uq.presentation.figures.scales import round_below
from starcal_uq.presentation.html import page, template_environment
from starcal_uq.presentation.words.images import next_step
from starcal_uq.presentation.words.sentences import told
from starcal_uq.sky.names import proper_name, short_name

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.camera.camera import Camera

# Width of a picture: sharp on a telephone and half a desk, or on the whole of one.
_WIDTH_PX, _LARGE_PX = 640, 1400
_QUALITY = 45
# Black above the sky and the length of the scale, in limits of zscale, and where asinh bends.
_BLACK, _SPAN, _BEND = 0.2, 4.0, 0.06
_BLUR_PX = 0.7
# Widths of the image that a typical residual's arrow is long.
_ARROW = 0.02
# Stars with a label at most, and the room of a label over the width of the image, at each zoom.
_NAMED, _ROOM = {1: 12, 2: 30, 4: 80}, (0.15, 0.035)
# A notebook shows at most so many frames.
_NOTEBOOK = 24
# Outlines of marks of unit radius, in relative commands: a circle, a cross, a triangle, a cross
# that is open in the middle, where the star is, and a square.
_SHAPES = {
    "i": "m-1 0c0 -1.33 2 -1.33 2 0c0 1.33 -2 1.33 -2 0",
    "l": "m-.8 -.8l1.6 1.6m0 -1.6l-1.6 1.6",
    "u": "m-.6 -.36h1.2l-.6 1.02z",
    "e": "m.3 0h.35m-.95 0h-.35m.65 .3v.35m0 -.95v-.35",
    "m": "m-1 -1h2v2h-2z",
}
# Name in the page, kind, what it is.
_LEGEND = (
    ("i", IDENTIFIED, "identified: a star of the catalogue, calibrated"),
    ("l", LEFT_OUT, "rejected: has a star, but was left out of the calibration"),
    ("u", NOT_MATCHED, "rejected: detected, and not matched with a star"),
    (
        "e",
        "expected",
        "expected: where the calibrated camera puts a star bright enough to be detected",
    ),
    ("m", "missed", "missed: expected, and not detected"),
)


def gallery(frames: Frames) -> str:
    """The frames as a piece of a page, with its legend and style; it needs no script and no other
    file.
    """
    squares = frames.residuals_px**2
    typical = float(np.sqrt(np.median(squares.sum(axis=1)))) if len(squares) else 0.0
    context = {
        "frames": frames,
        "shown": [_card(frame, frames) for frame in frames],
        "legend": _LEGEND,
        "intro": told("frames", frames),
        # How much residuals are enlarged: 1, 2 or 5 times a power of ten, for all frames alike.
        "factor": round_below(_ARROW * frames.camera.width_px / max(typical, 1e-6)),
        # Of a circle, px of the image.
        "radius": frames.camera.width_px / (150.0 if frames.large else 90.0),
        "outline": _outline,
        "proper_name": proper_name,
        "short_name": short_name,
        "isfinite": np.isfinite,
        "FAINTER": FAINTER,
        "turned": lambda degrees: (np.sin(np.radians(degrees)), -np.cos(np.radians(degrees))),
        "inspect": Remedy("inspect", (frames.run,)).command,
    }
    return template_environment().get_template("gallery.html.j2").render(context)


def frames_html(frames: Frames) -> str:
    """The frames for a notebook: the gallery of those that tell most."""
    return gallery(frames.telling(_NOTEBOOK))


def write_frames(frames: Frames, to: PathLike) -> Path:
    """Write the frames as one HTML file."""
    made = Provenance(versions={NAME: installed_version(NAME)})
    title = f"Frames of {Path(frames.run).name}"
    atomic_write_text(to, page("frames.html.j2", made, title=title, gallery=gallery(frames)))
    return Path(to)


def picture(path: Path, width_px: int, camera: Camera, flat: bool = True) -> bytes:
    """An image as astronomers look at it: limits by zscale, brightness by asinh, no wider than
    `width_px`.

    JPEG, which a PDF holds as it is; any other format it would hold pixel by pixel.

    `width_px`: width of the picture, at most.
    `camera`: its detector has the size that the image must have. `flat`: whether the background is
    taken out, so that stars show; clouds and the Moon then do not. ImageError if it cannot be read
    or is of another size.
    """
    with extra("images", "pictures of frames"):
        from astropy.visualization import AsinhStretch, ZScaleInterval
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    from starcal_uq.images.background import prepare_image
    from starcal_uq.images.read import read_image

    image = read_image(path, camera)
    if flat:
        sky = prepare_image(image, 1.0, None, None)[0].counts
    else:
        sky = image.data.astype(np.float32)
        known = np.isfinite(sky)
        sky[~known] = np.median(sky[known]) if known.any() else 0.0
    small = Image.fromarray(sky)
    if small.width > width_px:
        small = small.resize(
            (width_px, max(1, round(small.height * width_px / small.width))), Image.Resampling.BOX
        )
    # Stars are wider than pixels, and noise is not.
    sky = gaussian_filter(np.asarray(small), _BLUR_PX)
    sky -= np.median(sky)
    low, high = ZScaleInterval().get_limits(sky)
    # Black is a little above the sky, and the scale so long that asinh leaves stars their shapes.
    floor, span = -_BLACK * low, max(_SPAN * (high - low), 1e-12)
    bright = AsinhStretch(_BEND)(np.clip((sky - floor) / span, 0.0, 1.0))
    out = io.BytesIO()
    Image.fromarray((255.0 * bright).astype(np.uint8)).save(
        out, "JPEG", quality=_QUALITY, optimize=True
    )
    return out.getvalue()


def _card(frame: InspectedFrame, frames: Frames) -> AnyDict:
    """What is told of a frame, its picture, and its marks by their names in the page."""
    detections, stars = frame.detections, frame.stars
    reasons = detections.loc[detections["reason"] != "", ["kind", "reason"]].value_counts()
    kinds = {key: detections[detections["kind"] == kind] for key, kind, _ in _LEGEND[:3]}
    card: AnyDict = {
        "frame": frame,
        "outcome": told("outcome_of_frame", frame),
        "marks": {"e": stars, **kinds, "m": stars[stars["missed"]]},
        "named": labelled(kinds["i"].sort_values("mag") if frame.solved else detections, frame),
        "reasons": [(reason, n) for (_, reason), n in reasons.items()],
        "step": next_step(frame, frames),
    }
    if frame.path is not None:
        widest = _LARGE_PX if frames.large else _WIDTH_PX
        try:
            data = picture(frame.path, widest, frames.camera, flat=frame.solved)
            card["jpeg"] = base64.b64encode(data).decode("ascii")
        except (ImageError, MissingExtraError) as error:
            card["error"] = str(error)
    return card


def labelled(stars: pd.DataFrame, frame: InspectedFrame) -> dict[int, dict[tuple[Any, ...], Any]]:
    """The first stars whose labels do not touch those of others, nor the compass, by zoom and by
    the middle of the label.
    """
    width, shown = frame.width_px, {}
    for zoom, most in _NAMED.items():
        kept = shown[zoom] = dict[tuple[Any, ...], Any]()
        wide, high = width * _ROOM[0] / zoom, width * _ROOM[1] / zoom
        for star in stars.itertuples():
            x, y = star.x_px + (-0.5 if star.x_px > 0.85 * width else 0.5) * wide, star.y_px
            corner = x > 0.75 * width and y > 0.75 * frame.height_px
            near = (abs(x - a) < wide and abs(y - b) < high for a, b in kept)
            if len(kept) < most and not corner and not any(near):
                kept[x, y] = star
    return shown


@cache
def _outline(key: str, r: float) -> str:
    """The outline of a mark about its place; each kind has a shape of its own, so that nothing
    rests on colour alone.
    """
    return re.sub(r"-?[\d.]+", lambda number: f"{r * float(number[0]):.1f}", _SHAPES[key])
