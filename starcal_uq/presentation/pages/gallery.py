"""Frames with their stars: the image as a small picture, and marks of lines over it that stay sharp
and can be read.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.core.errors import ImageError, MissingExtraError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_write_text
from starcal_uq.core.formatting import MINUS, count, fixed, plural, significant
from starcal_uq.core.provenance import NAME, installed_version
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
from starcal_uq.presentation.html import template_environment
from starcal_uq.presentation.words.images import frames_text, next_step, outcome_words
from starcal_uq.sky.names import short_name

if TYPE_CHECKING:
    from markupsafe import Markup

    from starcal_uq.camera.camera import Camera

# Width of a picture: sharp on a telephone and half a desk, or on the whole of one.
_WIDTH_PX, _LARGE_PX = 640, 1400
_QUALITY = 45
# Black above the sky and the length of the scale, in limits of zscale, and where asinh bends.
_BLACK, _SPAN, _BEND = 0.2, 4.0, 0.06
_BLUR_PX = 0.7
# Widths of the image that a typical residual's arrow is long.
_ARROW = 0.02
# So many marks of a kind have words of their own; beyond, they are one line.
_TOLD = 400
_NAMED = 4
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
    shown = list(frames)
    factor = _factor(frames)
    context = {
        "cards": [_card(frame, frames, factor) for frame in shown],
        "legend": [(key, _symbol(key), words) for key, _, words in _LEGEND],
        "intro": frames_text(frames),
        "factor": count(round(factor)) if factor >= 1.0 else significant(factor),
        "radius": significant(_radius(frames) / factor, 1),
        "arrows": bool(len(frames.residuals_px)),
        "inspect": Remedy("inspect", (frames.run,)).command,
        "without": sum(frame.path is None for frame in shown),
        "large": frames.large,
        "partial": len(frames) < (frames.n_run or len(frames)),
    }
    return template_environment().get_template("gallery.html.j2").render(context)


def frames_html(frames: Frames) -> str:
    """The frames for a notebook: the gallery of those that tell most."""
    return gallery(frames.telling(_NOTEBOOK))


def write_frames(frames: Frames, to: PathLike) -> Path:
    """Write the frames as one HTML file."""
    page = template_environment().get_template("frames.html.j2")
    atomic_write_text(
        to,
        page.render(
            title=f"Frames of {Path(frames.run).name}",
            gallery=_markup(gallery(frames)),
            version=_version(),
        )
        + "\n",
    )
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


def _card(frame: InspectedFrame, frames: Frames, factor: float) -> AnyDict:
    row = frame.row
    counts = (
        [(key, _symbol(key), kind, frame.n(kind)) for key, kind, _ in _LEGEND]
        if frame.solved
        else []
    )
    return {
        "name": row.image,
        "number": row.frame,
        "badge": "pass" if frame.n(IDENTIFIED) else "warning",
        "outcome": outcome_words(frame),
        "drawing": _drawing(frame, frames, factor),
        "facts": list(_facts(frame)),
        "counts": counts,
        "reasons": _reasons(frame),
        "step": next_step(frame, frames),
        "missing": ""
        if frame.path is not None
        else "The image is not where it was; its stars are drawn without it.",
    }


def _facts(frame: InspectedFrame) -> Iterable[tuple[str, str]]:
    if frame.solved:
        yield "RA", f"{fixed(frame.ra_deg, 4)}°"
        yield "Dec", f"{'+' if frame.dec_deg >= 0 else MINUS}{fixed(abs(frame.dec_deg), 4)}°"
        yield "Roll", f"{fixed(frame.roll_deg, 2)}°"
    if frame.n(IDENTIFIED):
        yield "Residual, rms", f"{significant(frame.rms_px)} px per axis"
        yield "Stars", count(frame.n(IDENTIFIED))
    else:
        yield "Detections", count(len(frame.detections))
    if np.isfinite(frame.limit_mag):
        yield "Limit", f"G {'≥ ' if frame.at_least else ''}{fixed(frame.limit_mag, 1)}"
    if np.isfinite(frame.seconds):
        yield "Identified in" if frame.solved else "Searched for", f"{significant(frame.seconds)} s"
    yield (
        "Time",
        f"{frame.row.time_utc.replace('T', ' ')[:19]} UTC" if frame.row.time_utc else "not known",
    )


def _reasons(frame: InspectedFrame) -> str:
    """Why detections were rejected, with their numbers."""
    found = frame.detections.loc[
        frame.detections["reason"] != "", ["kind", "reason"]
    ].value_counts()
    parts = [f"{count(int(n))} {str(reason).replace('_', ' ')}" for (_, reason), n in found.items()]
    return f"Rejected: {'; '.join(parts)}." if parts else ""


def _factor(frames: Frames) -> float:
    """How much residuals are enlarged: 1, 2 or 5 times a power of ten, for all frames alike."""
    squares = frames.residuals_px**2
    typical = float(np.sqrt(np.median(squares.sum(axis=1)))) if len(squares) else 0.0
    wanted = _ARROW * frames.camera.width_px / max(typical, 1e-6)
    return round_below(wanted)


def _radius(frames: Frames) -> float:
    """Radius of a circle, px of the image."""
    return frames.camera.width_px / (150.0 if frames.large else 90.0)


def _drawing(frame: InspectedFrame, frames: Frames, factor: float) -> AnyDict:
    """The picture with its marks, in px of the image."""
    r = _radius(frames)
    drawn: AnyDict = {
        "width": frame.width_px,
        "height": frame.height_px,
        "words": f"{frame.row.image}: {outcome_words(frame)}, {_told(frame)}",
    }
    if frame.path is not None:
        widest = _LARGE_PX if frames.large else _WIDTH_PX
        try:
            data = picture(frame.path, widest, frames.camera, flat=frame.solved)
            drawn["jpeg"] = base64.b64encode(data).decode("ascii")
        except (ImageError, MissingExtraError) as error:
            drawn["error"] = str(error)
    detections, stars = frame.detections, frame.stars
    by_key: AnyDict = {"e": stars}
    by_key |= {key: detections[detections["kind"] == kind] for key, kind, _ in _LEGEND[:3]}
    by_key["m"] = stars[stars["missed"]]
    found = by_key["i"]
    parts = [_marks(key, by_key[key], r) for key in "eulmi"]
    parts += [_arrows(found, factor), _names(found, r, frame.width_px)]
    if frame.solved:
        parts.append(_compass(frame, r))
    return drawn | {"marks": _markup("".join(parts))}


def _told(frame: InspectedFrame) -> str:
    if not frame.solved:
        return plural(len(frame.detections), "detection")
    return ", ".join(f"{count(frame.n(kind))} {kind}" for _, kind, _ in _LEGEND)


@cache
def _outline(key: str, r: float) -> str:
    """The outline of a mark about its place; each kind has a shape of its own, so that nothing
    rests on colour alone.
    """
    return re.sub(r"-?[\d.]+", lambda number: f"{r * float(number[0]):.1f}", _SHAPES[key])


def _shape(key: str, x: float, y: float, r: float) -> str:
    return f"M{x:.1f} {y:.1f}{_outline(key, r)}"


def _symbol(key: str) -> Markup:
    path = f'<path class="{key}" d="{_shape(key, 0.0, 0.0, 6.0)}"/>'
    return _markup(f'<svg class="key" viewBox="-8 -8 16 16" aria-hidden="true">{path}</svg>')


def _marks(key: str, table: Any, r: float) -> str:
    """All marks of a kind; those that can be few have their words, which browsers show beside the
    pointer.
    """
    # Stars that nobody has searched for do not need to catch the eye.
    size = (
        np.where(table["reason"] == FAINTER, 0.6 * r, r) if key == "u" else np.full(len(table), r)
    )
    paths = [
        _shape(key, x, y, s) for x, y, s in zip(table["x_px"], table["y_px"], size, strict=True)
    ]
    if not paths:
        return ""
    if key in "eu" or len(paths) > _TOLD:
        return f'<path class="{key}" d="{"".join(paths)}"/>'
    told = (
        f"<path d={path!r}><title>{escape(_words(key, row))}</title></path>"
        for path, row in zip(paths, table.itertuples(), strict=True)
    )
    return f'<g class="{key}">{"".join(told)}</g>'


def _words(key: str, row: Any) -> str:
    said = f"{row.star_id or 'star'}, G {row.mag:.2f}"
    if key == "i":
        return f"{said}, residual {row.dx_px:+.3f}, {row.dy_px:+.3f} px".replace("-", MINUS)
    return f"{said}, {'missed' if key == 'm' else row.reason}"


def _arrows(table: Any, factor: float) -> str:
    """Residuals, enlarged, from the detections outwards."""
    lines = []
    for row in table.itertuples():
        dx, dy = factor * row.dx_px, factor * row.dy_px
        tip = f"M{row.x_px + dx:.1f} {row.y_px + dy:.1f}"
        # The barbs point back, 20 degrees to either side.
        barbs = (
            (-0.23 * dx + side * 0.085 * dy, -0.23 * dy - side * 0.085 * dx) for side in (1.0, -1.0)
        )
        head = "".join(f"{tip}l{bx:.1f} {by:.1f}" for bx, by in barbs)
        lines.append(f"M{row.x_px:.1f} {row.y_px:.1f}l{dx:.1f} {dy:.1f}{head}")
    return f'<path class="r" d="{"".join(lines)}"/>' if lines else ""


def _names(table: Any, r: float, width: int) -> str:
    """The brightest stars by name."""
    texts = []
    for row in table.nsmallest(_NAMED, "mag").itertuples() if len(table) else ():
        side, anchor = (
            (-1.3 * r, ' text-anchor="end"') if row.x_px > 0.75 * width else (1.3 * r, "")
        )
        # Not above the picture.
        place = (
            f'x="{row.x_px + side:.1f}" '
            f'y="{row.y_px + (-r if row.y_px > 5.0 * r else 3.5 * r):.1f}"'
        )
        texts.append(f"<text {place}{anchor}>{escape(short_name(row.star_id, row.mag))}</text>")
    return "".join(texts)


def _compass(frame: InspectedFrame, r: float) -> str:
    """North and east."""
    length = 4.0 * r
    x, y = frame.width_px - 2.4 * length, frame.height_px - 2.4 * length
    north = np.radians(frame.north)
    east = north + (-0.5 if frame.east_is_left else 0.5) * np.pi
    parts = []
    for name, angle in (("N", north), ("E", east)):
        dx, dy = np.sin(angle), -np.cos(angle)
        parts.append(f'<path class="c" d="M{x:.1f} {y:.1f}l{length * dx:.1f} {length * dy:.1f}"/>')
        parts.append(
            f'<text class="middle" x="{x + 1.5 * length * dx:.1f}" '
            f'y="{y + 1.5 * length * dy + r:.1f}">{name}</text>'
        )
    return "".join(parts)


def _markup(html: str) -> Markup:
    from markupsafe import Markup

    return Markup(html)


def _version() -> str:
    return installed_version(NAME) or ""
