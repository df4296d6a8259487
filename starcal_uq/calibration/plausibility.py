"""Why a calibration fails: the slip in table or camera file that would explain the stars, or what
is known of them.

Slips are tried on some frames: columns in other units or order, a mirrored image, frames put
together anew. What explains the stars lets those of each frame agree on one attitude (`consensus`),
at the focal length that their angles ask for. Nothing is blamed while the table as it is does
nearly as well.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import wraps
from itertools import islice, pairwise
from typing import ParamSpec, TypeVar

import numpy as np

from starcal_uq.attitude.rotations import unit_vectors
from starcal_uq.calibration.cameras import focals_of, frames_with_focals
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.planes import Plane
from starcal_uq.core.errors import CalibrationError, RepeatedFramesError
from starcal_uq.core.findings import Finding, clause
from starcal_uq.core.remedy import CAMERA, OBS, RUN, Remedy
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray, IntArray
from starcal_uq.estimation.consensus import consensus, directions, focal_lengths
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations

P = ParamSpec("P")
R = TypeVar("R")

_FRAMES, _STARS = 16, 30
# Frames of a stream, of which those are chosen.
_HEAD = 64
# Width of the field from which a focal length is looked for: angles are nearly proportional to it.
_FIELD_RAD = np.radians(20.0)
# Stars farther from their attitude's place than this fraction of the detector do not agree with it.
_TOLERANCE = 0.02
# Mean truncated square below which the stars are explained; that of other axes or units is above a
# half.
_EXPLAINED = 0.35
# A slip must explain the stars so many times better than the table as it is, or any other slip.
_CLEARLY = 0.5
# Focal lengths that are taken for the camera's own, and for those of a wrong unit.
_SAME_CAMERA, _SAME_UNIT = 1.6, 1.3
_NEIGHBOURS = 8
# Scatter of stars that agree, as a fraction of the tolerance: that of noise, or no reason for
# anything.
_NOISY, _QUIET = 0.2, 0.1
_FEW_WRONG = 0.02
# What is wrong with table or camera file.
Slip = Enum(
    "Slip",
    "HOURS RADIANS RA_IN_RADIANS DEC_IN_RADIANS SWAPPED MIRRORED OFF_CENTRE ONE_FRAME_NUMBER "
    "MIXED_UP FAR_APART MICROMETRES PITCH_IN_MILLIMETRES METRES PIXELS INCHES OTHER_CAMERA "
    "NO_ATTITUDE WRONG_STARS SCATTER",
)


@dataclass(frozen=True)
class _Table:
    """What is known of the stars of some frames, as given or without a slip.

    Pixels (2, N), directions (N,) in degrees, first rows of the frames (K + 1,); principal point
    (2,), width and height (2,) and focal length of the camera in px.
    """

    pixel: FloatArray
    ra: FloatArray
    dec: FloatArray
    starts: IntArray
    centre: FloatArray
    detector: IntArray
    focal_px: float
    plane: Plane

    @property
    def frames(self) -> StarFrames:
        """The stars, in pixels from the principal point."""
        r = unit_vectors(self.ra, self.dec).T
        return StarFrames(self.pixel - self.centre[:, None], r, None, self.starts)

    @property
    def tolerance_px(self) -> float:
        return _TOLERANCE * float(self.detector.max())

    @property
    def field_rad(self) -> float:
        return 2.0 * self.plane.angle(0.5 * float(np.hypot(*self.detector)) / self.focal_px)


# Tables without some slips, which stand before each.
_Slips = Iterator[tuple[tuple[Finding, ...], _Table]]


@dataclass(frozen=True)
class _Fit:
    """How well stars agree: mean truncated square, share that agrees, its scatter and the focal
    length over the camera's.
    """

    cost: float
    share: float
    scatter_px: float
    focal_ratio: float

    @property
    def badness(self) -> float:
        """Less is better; among what fits alike, the focal length nearest to the camera's."""
        return self.cost + 0.02 * abs(float(np.log(self.focal_ratio)))


def explained(function: Callable[P, R]) -> Callable[P, R]:
    """A calibration of observations with a camera, whose error says what is wrong with them where
    that can be told.
    """
    names = tuple(inspect.signature(function).parameters)

    @wraps(function)
    def calibrated(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except RepeatedFramesError:
            raise
        except CalibrationError as error:
            given = dict(zip(names, args, strict=False)) | kwargs
            found = explanation(
                error, given["obs"], given["camera"], screened=function.__name__ == "screen"
            )
            if found is None:
                raise
            raise found from error

    return calibrated


def explanation(
    error: CalibrationError, obs: object, camera: object, *, screened: bool = False
) -> Exception | None:
    """The error of a calibration with what is wrong with its stars, where that can be told; a
    stream by its head.
    """
    if error.status is None or not isinstance(camera, Camera):
        return None
    if not isinstance(obs, Observations):
        obs = _head(obs)
    sentence = None if obs is None else find_reason(obs, camera, error.status, screened=screened)
    if sentence is not None:
        return CalibrationError(error.outcome, error.status, reason=sentence)
    return None


def _head(stream: object) -> Observations | None:
    """The first frames of a stream that can be read again, numbered anew."""
    if not isinstance(stream, Iterable) or isinstance(stream, Iterator | str):
        return None
    parts = list(islice(stream, _HEAD))
    if not parts or not all(isinstance(part, Observations) for part in parts):
        return None
    columns: AnyDict = {
        n: np.concatenate([getattr(part, n) for part in parts])
        for n in ("x_px", "y_px", "ra_deg", "dec_deg")
    }
    # Frames of one part need not be those of another, whatever their numbers.
    sizes = np.concatenate([np.diff(part.frame_starts) for part in parts])
    return Observations(frame=np.repeat(np.arange(len(sizes)), sizes), **columns)


def find_reason(
    obs: Observations, camera: Camera, status: Status, *, screened: bool = False
) -> str | None:
    """What explains that a calibration of these stars with this camera fails, in a clause with its
    remedy.

    None where the stars agree, so that the status has said all there is: too few of them, or the
    wrong model.
    """
    table = _sample(obs, camera)
    plain = _fit(table)
    if plain.cost > _EXPLAINED:
        enough = min(_EXPLAINED, _CLEARLY * plain.cost)
        for slips in (_one_slip(table, obs), _two_slips(table)):
            tried = [(_fit(other), found) for found, other in slips]
            good = [one for one in tried if one[0].cost < enough]
            if good:
                fit, found = min(good, key=lambda one: one[0].badness)
                parts = (*(one.sentence for one in found), _wrong_focal(fit, camera))
                return "; and ".join(filter(None, parts))
        if _far_apart(table):
            field_deg = float(np.degrees(table.field_rad))
            code = Slip.ONE_FRAME_NUMBER if obs.n_frames == 1 else Slip.FAR_APART
            return clause(code, field_deg=field_deg)
    # Distortion bends attitudes and focal lengths less than slips and other cameras do.
    numbers, frames = frames_with_focals(obs)
    pinhole = replace(frames, pixel=frames.pixel - table.centre[:, None])
    focals = focals_of(numbers, pinhole, table.focal_px, table.plane)
    if focals.n_groups > 1:
        return focals.words(camera)
    if plain.share < 1.0 - _FEW_WRONG and plain.scatter_px > _NOISY * table.tolerance_px:
        # Stars that noise throws beyond the tolerance are not wrong ones.
        wider = (_fit(table, by) for by in (3.0, 9.0))
        plain = next((fit for fit in wider if fit.share >= 1.0 - _FEW_WRONG), plain)
    quiet = plain.scatter_px < _QUIET * table.tolerance_px
    return _wrong_focal(plain, camera) or _as_it_is(plain, quiet, status, screened)


def _sample(obs: Observations, camera: Camera) -> _Table:
    """Some frames, spread over the table, of those with the most stars, and some stars of each."""
    sizes = np.diff(obs.frame_starts)
    most = np.flatnonzero(sizes >= np.median(sizes))
    chosen = most[np.unique(np.linspace(0, len(most) - 1, min(_FRAMES, len(most))).astype(int))]
    rows = []
    for frame in chosen:
        first, n = int(obs.frame_starts[frame]), int(sizes[frame])
        rows.append(first + np.unique(np.linspace(0, n - 1, min(n, _STARS)).astype(np.int64)))
    return _Table(
        **_columns(obs, rows),
        centre=camera.theta[:2],
        detector=np.array([camera.width_px, camera.height_px]),
        focal_px=camera.focal_px,
        plane=get_model(camera.distortion).plane,
    )


def _columns(obs: Observations, frames: list[IntArray]) -> AnyDict:
    """The rows of each frame, as fields of `_Table`."""
    rows = np.concatenate(frames)
    return {
        "pixel": np.ascontiguousarray(obs.xy[rows].T),
        "ra": obs.ra_deg[rows],
        "dec": obs.dec_deg[rows],
        "starts": np.cumsum([0, *map(len, frames)]),
    }


def _fit(table: _Table, wider: float = 1.0) -> _Fit:
    """How well the stars of each frame agree on an attitude, without distortion, with the focal
    length that their angles ask for.
    """
    frames, tolerance_px = table.frames, wider * table.tolerance_px
    start_px = 0.5 * float(table.detector.max()) / table.plane.radius(0.5 * _FIELD_RAD)
    focal_px = float(focal_lengths(frames, start_px, table.plane)[0])
    b = directions(frames.pixel, focal_px, table.plane)
    best = consensus(b, frames.r, frames.starts, tolerance_px / focal_px)
    offset_px = np.where(np.isfinite(best.offset_rad), best.offset_rad, np.inf) * focal_px
    cost = float(np.mean(np.minimum((offset_px / tolerance_px) ** 2, 1.0)))
    # Of two axes, with as many degrees of freedom as three stars more than an attitude has.
    scatter = float(np.median(offset_px[best.agree])) / 1.1774 if best.agree.any() else np.inf
    return _Fit(cost, float(np.mean(best.agree)), scatter, focal_px / table.focal_px)


def _one_slip(table: _Table, obs: Observations) -> _Slips:
    """Slips that the numbers allow."""
    yield from _units(table)
    yield _mirrored(table)
    yield _off_centre(table)
    yield from _regrouped(table, obs)


def _two_slips(table: _Table) -> _Slips:
    """Two of them at once."""
    for first, other in _units(table):
        second, both = _mirrored(other)
        yield (*first, *second), both
        if other.dec is table.dec and _dec_in_radians(table):
            dec = Finding(Slip.DEC_IN_RADIANS, {"most": np.abs(table.dec).max(), "alone": False})
            yield (*first, dec), replace(other, dec=np.degrees(table.dec))


def _units(table: _Table) -> _Slips:
    """Columns in other units or exchanged."""
    ra, dec, most = table.ra, table.dec, table.ra.max()
    in_radians = most <= 2.0 * np.pi
    of_ra: AnyDict = {"least": ra.min(), "most": most}
    of_dec = {"most": np.abs(dec).max(), "alone": True}
    ra_turned, dec_turned = np.degrees(ra), np.degrees(dec)
    both_in_radians = in_radians and _within_radians(dec)
    slips: tuple[tuple[bool, Slip, AnyDict, FloatArray, FloatArray], ...] = (
        (most <= 24.0, Slip.HOURS, of_ra, 15.0 * ra, dec),
        (both_in_radians, Slip.RADIANS, of_ra, ra_turned, dec_turned),
        (in_radians, Slip.RA_IN_RADIANS, of_ra, ra_turned, dec),
        (_dec_in_radians(table), Slip.DEC_IN_RADIANS, of_dec, ra, dec_turned),
        (most <= 90.0, Slip.SWAPPED, {}, dec % 360.0, ra),
    )
    for possible, code, facts, right_ra, right_dec in slips:
        if possible:
            yield (Finding(code, facts),), replace(table, ra=right_ra, dec=right_dec)


def _within_radians(dec: FloatArray) -> bool:
    return bool(np.abs(dec).max() <= 0.5 * np.pi)


def _dec_in_radians(table: _Table) -> bool:
    return _within_radians(table.dec) and bool(table.ra.max() > 0.5 * np.pi)


def _mirrored(table: _Table) -> tuple[tuple[Finding, ...], _Table]:
    (x, y), (width, height) = table.pixel, table.detector
    exchanged = x.max() <= height - 0.5 and y.max() <= width - 0.5
    found = Finding(Slip.MIRRORED, {"last_px": width - 1, "exchanged": exchanged})
    return (found,), replace(table, pixel=np.array([width - 1.0 - x, y]))


def _off_centre(table: _Table) -> tuple[tuple[Finding, ...], _Table]:
    middle: FloatArray = (table.detector - 1) / 2.0
    found = Finding(Slip.OFF_CENTRE, {"given_px": table.centre, "middle_px": middle})
    return (found,), replace(table, centre=middle)


def _regrouped(table: _Table, obs: Observations) -> _Slips:
    """Whether stars that are neighbours in the sky are so in an image, whatever frame they are said
    to be of.
    """
    from scipy.spatial import cKDTree

    if obs.n_stars < 2 * _NEIGHBOURS:
        return
    sky = cKDTree(obs.directions_icrs)
    seeds = np.unique(np.linspace(0, obs.n_stars - 1, _FRAMES).astype(np.int64))
    near = [np.sort(rows) for rows in sky.query(obs.directions_icrs[seeds], k=_NEIGHBOURS)[1]]
    code = Slip.ONE_FRAME_NUMBER if obs.n_frames == 1 else Slip.MIXED_UP
    yield (Finding(code),), replace(table, **_columns(obs, near))


def _far_apart(table: _Table) -> bool:
    """Whether most frames hold stars that cannot be in one field."""
    r = table.frames.r
    spans = []
    for start, stop in pairwise(table.starts):
        chord = np.linalg.norm(r[:, start:stop, None] - r[:, None, start:stop], axis=0).max()
        spans.append(2.0 * np.arcsin(min(0.5 * chord, 1.0)))
    return float(np.median(spans)) > 2.0 * table.field_rad


def _wrong_focal(plain: _Fit, camera: Camera) -> str | None:
    """A focal length that the stars contradict, with the unit that would explain it."""
    if plain.cost > _EXPLAINED:
        return None
    ratio = plain.focal_ratio
    if 1.0 / _SAME_CAMERA < ratio < _SAME_CAMERA:
        return None
    lengths = {
        name: camera.length_text(px, digits)
        for name, px, digits in (
            ("found", ratio * camera.focal_px, 3),
            ("given", camera.focal_px, 6),
        )
    }
    close = (
        code
        for factor, code in _other_units(camera).items()
        if 1.0 / _SAME_UNIT < ratio / factor < _SAME_UNIT
    )
    sizes = {"focal_mm": camera.focal_mm, "pixel_um": camera.pixel_um}
    return clause(next(close, Slip.OTHER_CAMERA), **lengths, **sizes)


def _other_units(camera: Camera) -> dict[float, Slip]:
    """What the lengths of a camera file look like when they are off by these factors."""
    if camera.pixel_um is None or camera.focal_mm is None:
        return {}
    return {
        1e-3: Slip.PITCH_IN_MILLIMETRES if camera.pixel_um < 0.5 else Slip.MICROMETRES,
        1e3: Slip.METRES,
        1e-3 * camera.pixel_um: Slip.PIXELS,
        25.4: Slip.INCHES,
    }


def _as_it_is(plain: _Fit, quiet: bool, status: Status, screened: bool) -> str | None:
    """What is known of stars that no slip explains."""
    wrong = 1.0 - plain.share
    if wrong > 0.8:
        return clause(Slip.NO_ATTITUDE)
    # Where the others agree closely, a few spoil the fit.
    if wrong > (0.0 if quiet and status is Status.INCONSISTENT else _FEW_WRONG):
        screen = Remedy("calibrate", (OBS, CAMERA), {"out": RUN, "screening": True})
        again = screened or wrong > 0.6
        return clause(Slip.WRONG_STARS, share=wrong, screen=None if again else screen)
    if quiet or status in (Status.SINGULAR, Status.FOLDED, Status.OUTSIDE_DETECTOR):
        return None
    return clause(Slip.SCATTER, scatter_px=plain.scatter_px)
