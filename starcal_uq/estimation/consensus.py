"""Stars of a frame that agree on one attitude, found without trusting any of them.

Two stars fix an attitude, and the other stars of the frame vote on it (random sample consensus,
Fischler & Bolles 1981, Comm. ACM 24(6), 381-395, scored by the truncated sum of squares of Torr &
Zisserman 2000, MSAC). Before any calibration the focal length may be several per cent off, which
bends every attitude; it is the same for all frames, so that it is found first, as the mode of the
ratios of catalogue angle to measured angle over pairs of all frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from starcal_uq.attitude.wahba import quest
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, undistorted
from starcal_uq.camera.planes import PINHOLE, Plane
from starcal_uq.camera.projection import unproject_theta
from starcal_uq.core.types import BoolArray, FloatArray, IntArray, floats
from starcal_uq.observations.frames import StarFrames

# Pairs tried per frame; with a third of all stars wrong, none of 32 pairs is right in one frame of
# a hundred million.
_TRIALS = 32
_SEED = 20170925
MIN_STARS = 3
# First tolerance of the pre-screen as a fraction of the detector: distortion and a wrong principal
# point stay below.
_WIDE_FRACTION = 0.02
_NARROWEST_PX = 2.0
_NARROW_MADS = 6.0


@dataclass(frozen=True)
class Consensus:
    """What the stars of each frame agree on."""

    # (N,): stars within the tolerance of their frame's best attitude; all false in a frame without
    # three such stars.
    agree: BoolArray
    # (N,): angle between measurement and catalogue direction at that attitude, approximately; NaN
    # without an attitude.
    offset_rad: FloatArray


def consensus(
    b: FloatArray, r: FloatArray, starts: IntArray, tolerance_rad: FloatArray | float
) -> Consensus:
    """Find the largest set of stars in each frame that one attitude explains.

    `b` are measured and `r` catalogue unit vectors (3, N); frame k holds the stars
    ``starts[k]:starts[k + 1]``. A star with NaN never agrees, the others do within the tolerance
    (one, or (N,)).
    """
    sizes = np.diff(starts)
    tolerance = np.broadcast_to(floats(tolerance_rad), b.shape[1:])
    with np.errstate(invalid="ignore", divide="ignore"):
        best, rotations = np.full(len(sizes), np.inf), np.full((len(sizes), 3, 3), np.nan)
        for first, second in pair_trials(starts):
            candidate = _two_star_attitude(b, r, first, second)
            share = np.minimum((_offset(b, r, candidate, sizes) / tolerance) ** 2, 1.0)
            # A star that cannot be compared disagrees.
            score = np.add.reduceat(np.where(np.isnan(share), 1.0, share), starts[:-1])
            score[np.isnan(candidate[:, 0, 0])] = np.inf
            better = score < best
            best[better], rotations[better] = score[better], candidate[better]
        # The least-squares attitude of all that agree is better than that of two.
        for _ in range(2):
            agree, offset = _agreeing(b, r, rotations, starts, tolerance)
            rotations = _refined(b, r, agree, starts, rotations)
        agree, offset = _agreeing(b, r, rotations, starts, tolerance)
    return Consensus(agree, offset)


def pair_trials(starts: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Pairs of stars to try, one per frame and trial, as two arrays (K,) of rows; the same on every
    call.

    Frames with few stars have all their pairs tried. A frame with a single star is given it twice.
    """
    sizes = np.diff(starts)
    n_pairs = np.maximum(sizes * (sizes - 1) // 2, 1)
    rng = np.random.default_rng(_SEED)
    trials = []
    for trial in range(_TRIALS):
        random = (rng.random(len(sizes)) * n_pairs).astype(np.int64)
        number = np.where(n_pairs <= _TRIALS, trial % n_pairs, random)
        # Pairs (i, j), i < j, counted 0-1, 0-2, 1-2, 0-3 ...
        j = ((1.0 + np.sqrt(1.0 + 8.0 * number)) / 2.0).astype(np.int64)
        i = number - j * (j - 1) // 2
        trials.append((starts[:-1] + i, np.minimum(starts[:-1] + j, starts[1:] - 1)))
    return trials


def _triad(u: FloatArray, v: FloatArray) -> FloatArray:
    """Orthonormal axes (K, 3, 3) of two directions each, as columns: their middle, their normal and
    the third.
    """
    middle, normal = u + v, np.cross(u, v, axis=0)
    middle = middle / np.linalg.norm(middle, axis=0)
    normal = normal / np.linalg.norm(normal, axis=0)
    return np.stack([middle, normal, np.cross(middle, normal, axis=0)], axis=-1).transpose(1, 0, 2)


def rough_attitudes(frames: StarFrames, model_name: str, theta: FloatArray) -> FloatArray:
    """Attitudes (K, 3, 3) at theta (p,) from two stars of each frame: the first one, and the middle
    or the last one, whichever is farther from it; NaN where these are one.
    """
    first, end = frames.starts[:-1], frames.starts[1:]
    others = np.stack([(first + end) // 2, end - 1])
    apart = np.sum((frames.pixel[:, others] - frames.pixel[:, None, first]) ** 2, axis=0)
    rows = np.stack([first, np.where(apart[0] > apart[1], *others)])
    b = unproject_theta(model_name, theta, frames.pixel[:, rows.ravel()].T)
    with np.errstate(invalid="ignore"):
        return _two_star_attitude(b.T.reshape(3, *rows.shape), frames.r[:, rows], 0, 1)


def _two_star_attitude(
    b: FloatArray, r: FloatArray, first: IntArray | int, second: IntArray | int
) -> FloatArray:
    """Rotations (K, 3, 3) that take two catalogue directions to two measured ones, the misfit
    shared equally.
    """
    return _triad(b[:, first], b[:, second]) @ _triad(r[:, first], r[:, second]).transpose(0, 2, 1)


def _offset(b: FloatArray, r: FloatArray, rotations: FloatArray, sizes: IntArray) -> FloatArray:
    """Chord |b - R r| of every star, (N,)."""
    total = np.zeros(b.shape[1])
    for i in range(3):
        row = np.repeat(rotations[:, i].T, sizes, axis=1)
        total += (b[i] - np.einsum("jn,jn->n", row, r)) ** 2
    return np.sqrt(total)


def _agreeing(
    b: FloatArray, r: FloatArray, rotations: FloatArray, starts: IntArray, tolerance: FloatArray
) -> tuple[BoolArray, FloatArray]:
    sizes = np.diff(starts)
    offset = _offset(b, r, rotations, sizes)
    agree = offset <= tolerance
    enough = np.add.reduceat(agree.astype(np.int64), starts[:-1]) >= MIN_STARS
    return agree & np.repeat(enough, sizes), 2.0 * np.arcsin(np.minimum(offset / 2.0, 1.0))


def _refined(
    b: FloatArray, r: FloatArray, agree: BoolArray, starts: IntArray, rotations: FloatArray
) -> FloatArray:
    """QUEST on the stars that agree; the given rotations where there are none."""
    counts = np.add.reduceat(agree.astype(np.int64), starts[:-1])
    some = counts > 0
    refined = np.array(rotations)
    if some.any():
        offsets = np.concatenate([[0], np.cumsum(counts[some])])
        found = quest(b[:, agree].T, r[:, agree].T, offsets, covariance=False, on_degenerate="flag")
        where = np.flatnonzero(some)[found.ok]
        refined[where] = found.rotations[found.ok]
    return refined


def measured_directions(camera: Camera, frames: StarFrames) -> FloatArray:
    """Unit vectors (3, N) of the measured pixels; NaN where the distortion cannot be inverted."""
    return unproject_theta(camera.distortion, camera.theta, frames.pixel.T).T


def ideal_frames(camera: Camera, frames: StarFrames) -> StarFrames:
    """Frames with ideal points from the principal point in place of measured pixels, which stay
    where the distortion cannot be inverted at one of them.

    The displacement is one of pixels, so that ideal points are the same for every focal length.
    """
    b, plane = measured_directions(camera, frames), get_model(camera.distortion).plane
    point = np.stack(plane.onto(b, camera.focal_px))
    if not np.isfinite(point).all():
        point = frames.pixel - camera.theta[:2, None]
    return replace(frames, pixel=point)


def directions(
    point: FloatArray, focal_px: FloatArray | float, plane: Plane = PINHOLE
) -> FloatArray:
    """Unit vectors (3, N) of ideal points (2, N), for one focal length or one of each star."""
    u, v = point
    b = np.stack(plane.back(u, v, np.broadcast_to(focal_px, u.shape)))
    unit: FloatArray = b / np.linalg.norm(b, axis=0)
    return unit


def focal_lengths(
    ideal: StarFrames, start_px: float, plane: Plane = PINHOLE, *, by_frame: bool = False
) -> FloatArray:
    """Focal length, px, that the angles between ideal points ask for, wrong identifications or not:
    one of all frames (1,), or one of each (K,).

    The mode over pairs of the ratio of measured to catalogue angle: at least a quarter of the pairs
    must be right, so that half of the stars may be wrong.
    """
    pairs = np.array(pair_trials(ideal.starts)).transpose(1, 2, 0)
    first, second = pairs if by_frame else pairs.reshape(2, 1, -1)
    catalogue = _angle(ideal.r, first, second)
    focal_px = np.full(len(first), start_px)
    for _ in range(3):
        b = directions(ideal.pixel, ideal.spread(focal_px) if by_frame else focal_px, plane)
        focal_px *= _factors(_angle(b, first, second), catalogue)
    return focal_px


def _angle(vectors: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    chord = np.linalg.norm(vectors[:, first] - vectors[:, second], axis=0)
    angle: FloatArray = 2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0))
    return angle


def _factors(measured: FloatArray, catalogue: FloatArray) -> FloatArray:
    """Mode of the ratios of angles (K, P) in each row, (K,); 1 where none can be used."""
    usable = np.isfinite(measured) & (measured > 0.0) & (catalogue > 0.0)
    n = np.count_nonzero(usable, axis=1)
    # Close pairs say little about scale.
    half = _middle(np.sort(np.where(usable, measured, np.inf), axis=1), 0 * n, n)
    usable &= measured >= half[:, None]
    ratios = np.divide(measured, catalogue, out=np.ones_like(measured), where=usable)
    return np.where(n > 0, np.exp(_modes(np.log(ratios), usable)), 1.0)


def _modes(values: FloatArray, usable: BoolArray) -> FloatArray:
    """In each row, the median of what lies around the shortest interval that holds a quarter of its
    usable values.
    """
    ordered = np.sort(np.where(usable, values, np.inf), axis=1)
    place, count = np.arange(values.shape[1]), np.count_nonzero(usable, axis=1)[:, None]
    end = place + np.maximum(count // 4, 1)
    with np.errstate(invalid="ignore"):
        widths = np.take_along_axis(ordered, np.minimum(end, place[-1]), axis=1) - ordered
        widths = np.where(end < count, widths, np.inf)
        start = np.argmin(widths, axis=1)[:, None]
        half = np.where(count > 1, np.take_along_axis(widths, start, axis=1) / 2.0, 0.0)
        middle = np.take_along_axis(ordered, start, axis=1) + half
        near = (np.abs(ordered - middle) <= 4.0 * half) & (place < count)
    return _middle(ordered, np.argmax(near, axis=1), np.count_nonzero(near, axis=1))


def _middle(ordered: FloatArray, first: IntArray, n: IntArray) -> FloatArray:
    """Median of n values from the first on, of sorted rows; what stands first where there are
    none.
    """
    row, before, after = np.arange(len(ordered)), first + np.maximum(n - 1, 0) // 2, first + n // 2
    middle: FloatArray = (ordered[row, before] + ordered[row, after]) / 2.0
    return middle


def pre_screen(camera: Camera, frames: StarFrames) -> tuple[BoolArray, Camera]:
    """Stars that can be calibrated on, found with a camera that has not been calibrated, and that
    camera refocused.

    The stars (N,) agree on their frame's attitude within what the uncalibrated camera allows. The
    nominal focal length may be tens of per cent off; the camera that comes back has that of
    `focal_lengths`.
    """
    if not np.isfinite(measured_directions(camera, frames)).all():
        camera = camera.with_theta(undistorted(camera.distortion, camera.theta))
    ideal, plane = ideal_frames(camera, frames), get_model(camera.distortion).plane
    camera = camera.replace(focal_px=float(focal_lengths(ideal, camera.focal_px, plane)[0]))
    b = directions(ideal.pixel, camera.focal_px, plane)
    wide_rad = _WIDE_FRACTION * max(camera.width_px, camera.height_px) / camera.focal_px
    wide = consensus(b, frames.r, frames.starts, wide_rad)
    if not wide.agree.any():
        return wide.agree, camera
    spread = 1.4826 * float(np.median(wide.offset_rad[wide.agree]))
    narrow_rad = np.clip(
        _NARROW_MADS * spread, min(_NARROWEST_PX / camera.focal_px, wide_rad), wide_rad
    )
    stated = 0.0 if frames.weight is None else 10.0 / frames.weight / camera.focal_px
    narrow = consensus(b, frames.r, frames.starts, np.maximum(narrow_rad, stated))
    # A frame that falls apart within the narrow tolerance is judged after the calibration.
    return np.where(frames.in_threes(narrow.agree), narrow.agree, wide.agree), camera
