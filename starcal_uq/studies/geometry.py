"""Frames that a cell is about: which stars fall where, and what each frame says of the camera.

Nothing here knows the noise's size, the number of frames or a prior: cells that differ in those
alone share it.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.camera.camera import Camera
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import StudyError
from starcal_uq.core.types import AnyDict, AnyMapping, BoolArray, FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import star_term
from starcal_uq.likelihood.terms import add_by_group
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.observations.frames import StarFrames
from starcal_uq.planning.effects import JointMatrices, PlannedEffects
from starcal_uq.planning.information import frame_matrices
from starcal_uq.simulation.exclusion import Exclusion
from starcal_uq.simulation.frames import EDGE_SIGMAS, Window, brightest
from starcal_uq.simulation.pointing import pattern_rotations
from starcal_uq.simulation.sensor import Sensor, SensorNoise
from starcal_uq.studies.axes import CAMERA_AXES, EFFECT_AXES
from starcal_uq.studies.definition import Cell

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

# Stars that a set of frames holds: more of them make its mean information hardly better known.
_STARS, _LEAST_FRAMES = 6000, 64
# Frames of one campaign in which stars bring their own errors, and of a pattern: more repeat what
# these hold.
_MOST_FRAMES = 2000
_BLOCK, _BLOCKS, _LEAST_TRIES, _PLACES = 64, 128, 2560, 200
# Fewer attitudes than this that show enough stars are no night's work.
_LEAST_SKY = 0.01
_DEPTH_STEP = 0.5


class Attitudes(NamedTuple):
    """Some attitudes (n, 3, 3), and stars in a cone around each boresight.

    Frame number, index, magnitude and cosine of the angle of every such star, by frame and then by
    index, for all cosines above `least`.
    """

    rotations: FloatArray
    least: float
    frame: IntArray
    star: IntArray
    mag: FloatArray
    cosine: FloatArray


class Depth:
    """Stars to a magnitude, found by direction."""

    def __init__(self, stars: StarCatalogue) -> None:
        self.stars, self.directions = stars, stars.directions_icrs
        self._blocks: OrderedDict[tuple[int, ...], Attitudes] = OrderedDict()

    @cached_property
    def tree(self) -> Any:
        """KD-tree over the directions."""
        from scipy.spatial import cKDTree

        return cKDTree(self.directions)

    def around(self, rotations: FloatArray, least: float) -> Attitudes:
        """Stars whose direction has at least this cosine with the boresight of each attitude."""
        radius = np.sqrt(2.0 - 2.0 * max(least, -1.0))
        near = self.tree.query_ball_point(rotations[:, 2], radius, return_sorted=True)
        frame = np.repeat(np.arange(len(rotations)), [len(found) for found in near])
        star = np.concatenate([np.asarray(found, dtype=np.int64) for found in near])
        cosine = np.einsum("nj,nj->n", rotations[frame, 2], self.directions[star])
        return Attitudes(rotations, least, frame, star, self.stars.mag[star], cosine)

    def random(self, seed: tuple[int, ...], block: int, least: float) -> Attitudes:
        """A block of random attitudes with at least those stars; cells of all fields look at the
        same attitudes.
        """
        key = (*seed, block)
        found = self._blocks.get(key)
        if found is None or found.least > least:
            rotations = random_rotations(_BLOCK, np.random.default_rng([*key, 11]))
            # A little wider than asked for, so that a slightly wider field need not begin again.
            found = self.around(
                rotations, float(np.cos(min(1.2 * np.arccos(max(least, -1.0)), np.pi)))
            )
        self._blocks[key] = found
        self._blocks.move_to_end(key)
        if len(self._blocks) > _BLOCKS:
            self._blocks.popitem(last=False)
        return found


class Heaven:
    """The catalogue of a study, by magnitude limit."""

    def __init__(self, stars: StarCatalogue) -> None:
        self.stars = stars
        self._depths: dict[float, Depth] = {}
        self._hashes: dict[float, str] = {}

    def __getstate__(self) -> AnyDict:
        return {"stars": self.stars, "_depths": {}, "_hashes": {}}

    def depth(self, max_mag: float) -> Depth:
        """Stars at least to this limit; few trees serve many limits."""
        step = float(np.ceil(max_mag / _DEPTH_STEP) * _DEPTH_STEP)
        if step not in self._depths:
            self._depths[step] = Depth(self.stars.select(self.stars.mag <= step))
        return self._depths[step]

    def hash(self, max_mag: float) -> str:
        """What identifies the stars to this limit."""
        if max_mag not in self._hashes:
            some = self.stars.mag <= max_mag
            columns = (self.stars.ra_deg, self.stars.dec_deg, self.stars.mag)
            content = b"".join(np.ascontiguousarray(column[some]).tobytes() for column in columns)
            self._hashes[max_mag] = hashlib.sha256(content).hexdigest()[:16]
        return self._hashes[max_mag]


class _Views(Window):
    """The detector on the sky, for stars that a tree has found."""

    def __init__(self, depth: Depth, key: GeometryKey) -> None:
        super().__init__(key.camera, key.margin_px)
        self.depth, self.max_mag, self.exclusion = depth, key.max_mag, key.exclusion

    def frames(self, blocks: Sequence[Attitudes]) -> Geometry:
        """Frames of some attitudes, whatever they show."""
        rotations = np.concatenate([near.rotations for near in blocks])
        first = np.cumsum([0, *(len(near.rotations) for near in blocks)])
        kept = [(near.cosine > self.min_cosine) & (near.mag <= self.max_mag) for near in blocks]
        frame = np.concatenate(
            [n + near.frame[k] for n, near, k in zip(first[:-1], blocks, kept, strict=True)]
        )
        star = np.concatenate([near.star[k] for near, k in zip(blocks, kept, strict=True)])
        b = np.matmul(rotations[frame], self.depth.directions[star][:, :, None])[:, :, 0]
        xy, inside = self.seen(b)
        if self.exclusion is not None:
            free = ~np.any(self.exclusion.inside(rotations), axis=1)
            inside = inside & free[frame]
        sizes = np.bincount(frame[inside], minlength=len(rotations))
        return Geometry(
            self.camera, self.depth, rotations, _starts(sizes), star[inside], xy[inside]
        )


def _starts(sizes: IntArray) -> IntArray:
    """Bounds (M + 1,) of the stars of frames of these sizes."""
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Geometry:
    """M frames without noise, N stars: attitudes (M, 3, 3), R_cam_icrs, and the stars' pixels (N,
    2), px.

    ``starts`` (M + 1,) bounds the stars of each frame, and `star` (N,) counts in the catalogue of
    `depth`.
    """

    camera: Camera
    depth: Depth
    rotations: FloatArray
    starts: IntArray
    star: IntArray
    pixel: FloatArray

    @property
    def n_frames(self) -> int:
        """Number M of frames."""
        return len(self.rotations)

    def _with(
        self, rotations: FloatArray, starts: IntArray, kept: BoolArray | IntArray | slice
    ) -> Geometry:
        """Other frames, of the stars that are kept."""
        return replace(
            self,
            rotations=rotations,
            starts=starts,
            star=self.star[kept],
            pixel=self.pixel[kept],
        )

    def with_stars(self, n: int) -> Geometry:
        """The frames with at least n stars."""
        sizes = np.diff(self.starts)
        good = sizes >= n
        kept = np.repeat(good, sizes)
        return self._with(self.rotations[good], _starts(sizes[good]), kept)

    def first(self, n: int) -> Geometry:
        """The first n frames."""
        stars = slice(0, int(self.starts[min(n, self.n_frames)]))
        return self._with(self.rotations[:n], self.starts[: n + 1], stars)

    @classmethod
    def joined(cls, parts: Sequence[Geometry]) -> Geometry:
        """Frames of several parts, one after the other."""
        sizes = np.concatenate([np.diff(part.starts) for part in parts])
        return cls(
            parts[0].camera,
            parts[0].depth,
            np.concatenate([part.rotations for part in parts]),
            _starts(sizes),
            np.concatenate([part.star for part in parts]),
            np.concatenate([part.pixel for part in parts]),
        )

    @property
    def mag(self) -> FloatArray:
        """Magnitudes, (N,)."""
        return self.depth.stars.mag[self.star]

    def brightest(self, n: int | None) -> Geometry:
        """The same frames with their n brightest stars."""
        if n is None:
            return self
        kept = brightest(self.mag, self.starts, n)
        sizes = np.minimum(np.diff(self.starts), n)
        return self._with(self.rotations, _starts(sizes), kept)

    def frames(self, sigma_px: FloatArray) -> StarFrames:
        """Stars with this noise (N,), px per axis."""
        return StarFrames(
            pixel=np.ascontiguousarray(self.pixel.T),
            r=np.ascontiguousarray(self.depth.directions[self.star].T),
            weight=1.0 / sigma_px,
            starts=self.starts,
        )


NoiseShape = tuple[float, float, float, float] | SensorNoise


def noise_shape(settings: AnyMapping, focal_px: float) -> tuple[NoiseShape, float]:
    """How noise depends on magnitude (size, dex per magnitude, magnitude, floor; or that of a
    sensor), and a factor on all of it.
    """
    if "sensor" in settings:
        return SensorNoise(Sensor.from_dict(settings["sensor"]), focal_px), 1.0
    size, slope = settings["sigma_px"], settings["noise_per_mag"]
    if settings["noise_floor_px"] > 0.0:
        return (size, slope, settings["noise_mag"], settings["noise_floor_px"]), 1.0
    return (1.0, slope, settings["noise_mag"] if slope else 0.0, 0.0), size


def star_noise(mag: FloatArray, shape: NoiseShape) -> FloatArray:
    """Noise of stars of these magnitudes (n,), px per axis."""
    if isinstance(shape, SensorNoise):
        return shape(mag)
    size, slope, at, floor = shape
    return np.hypot(size * 10.0 ** (slope * (mag - at)), floor)


class GeometryKey(NamedTuple):
    """What a geometry depends on."""

    camera: Camera
    max_mag: float
    min_stars: int
    margin_px: float
    pointing: str
    n_frames: int | None
    seed: tuple[int, ...]
    exclusion: Exclusion | None = None


def margin_px(settings: AnyMapping, focal_px: float) -> float:
    """Stars nearer to the edge than this are left out: a power of two, so that many noises share
    their frames.
    """
    shape, scale = noise_shape(settings, focal_px)
    faintest = scale * float(star_noise(np.array([settings["max_mag"]]), shape)[0])
    return float(max(1.0, 2.0 ** np.ceil(np.log2(EDGE_SIGMAS * faintest))))


def geometry_key(
    camera: Camera, settings: AnyMapping, seed: int, seed_index: int, exact: bool
) -> GeometryKey:
    """What the frames of a cell depend on; `exact` asks for its own number of frames.

    Frames at random attitudes serve all repetitions, which draw campaigns from them; a pattern
    starts at another place each time, and stars that bring their own errors have to be counted over
    the frames that there are.
    """
    own = exact or settings["pointing"] != "random" or settings["direction_mas"] > 0.0
    return GeometryKey(
        camera,
        settings["max_mag"],
        settings["min_stars"],
        margin_px(settings, camera.focal_px),
        settings["pointing"],
        (settings["frames"] if exact else min(settings["frames"], _MOST_FRAMES)) if own else None,
        (seed, seed_index) if own else (seed,),
        Exclusion(**settings["exclusion"]) if "exclusion" in settings else None,
    )


def mission_key(key: GeometryKey) -> GeometryKey:
    """Random attitudes for the same camera: where a mission looks, whatever its calibration looked
    at.
    """
    return key._replace(pointing="random", n_frames=None, seed=key.seed[:1])


def frames_of(cell: Cell) -> tuple[Any, ...]:
    """What differs between cells that cannot share frames, without asking for their cameras."""
    settings = cell.settings
    own = settings["pointing"] != "random" or settings["direction_mas"] > 0.0
    frames = (settings["frames"], cell.seed_index) if own else ()
    names = (*CAMERA_AXES, "max_mag", "min_stars", "pointing")
    noise = repr(settings["sensor"]) if "sensor" in settings else margin_px(settings, 0.0)
    return (*(settings.get(name) for name in names), noise, *frames)


def weights_of(cell: Cell) -> str:
    """What differs between cells that share frames, but neither their stars nor the weights of
    these.
    """
    settings = cell.settings
    effects = [settings.get(name) for name in EFFECT_AXES]
    # A sensor may have no noise at all, which its cell finds.
    noise = settings.get("sensor") or settings["sigma_px"]
    if "sensor" not in settings and not effects[0]:
        noise = noise_shape(settings, 0.0)[0]
    return repr((settings.get("stars"), noise, settings["direction_mas"], effects))


def take_frames(key: GeometryKey, heaven: Heaven, most: int) -> Geometry:
    """Frames of a geometry; `most` limits those of random attitudes that serve many campaigns.

    StudyError when the catalogue cannot fill them.
    """
    depth = heaven.depth(key.max_mag)
    window = _Views(depth, key)
    if key.pointing == "random":
        n = key.n_frames
        if n is None:
            sky = float(np.prod(np.deg2rad(key.camera.fov_deg))) / (4.0 * np.pi)
            expected = max(
                float(np.sum(depth.stars.mag <= key.max_mag)) * sky, float(key.min_stars)
            )
            n = int(np.clip(_STARS / expected, min(_LEAST_FRAMES, most), most))
        return _random(key, window, n)
    # What seeds a place does not depend on what is swept: neighbouring cells look at one part of
    # the sky.
    rng = np.random.default_rng([*key.seed, 12])
    assert key.n_frames is not None
    field = key.camera.fov_deg[0]
    for _ in range(_PLACES):
        start = random_rotations(1, rng)
        if (
            window.frames([depth.around(start, window.min_cosine)])
            .with_stars(key.min_stars)
            .n_frames
        ):
            break
    rotations = pattern_rotations(key.pointing, key.n_frames, rng, field, start[0])
    found = window.frames([depth.around(rotations, window.min_cosine)]).with_stars(key.min_stars)
    if found.n_frames == 0:
        raise StudyError(
            f"no frame of the pattern {key.pointing!r} shows {key.min_stars} stars: raise "
            "max_mag, or lower min_stars."
        )
    return found


def _random(key: GeometryKey, window: _Views, n: int) -> Geometry:
    parts: list[Geometry] = []
    good = tries = 0
    while good < n:
        # As many blocks as will do if frames go on to show enough stars as often as so far.
        wanted = (
            int(np.ceil((n - good) * min(tries / max(good, 1), 4.0) / _BLOCK))
            if tries
            else -(-n // _BLOCK)
        )
        number = range(tries // _BLOCK, tries // _BLOCK + wanted)
        blocks = [window.depth.random(key.seed, block, window.min_cosine) for block in number]
        parts.append(window.frames(blocks).with_stars(key.min_stars))
        good += parts[-1].n_frames
        tries += _BLOCK * wanted
        if tries >= _LEAST_TRIES and good < _LEAST_SKY * tries:
            raise StudyError(
                f"only {good} of {tries} random attitudes show {key.min_stars} stars to "
                "magnitude "
                f"{key.max_mag:g}: raise max_mag, widen the field, or lower min_stars."
            )
    return Geometry.joined(parts).first(n)


@dataclass(frozen=True, eq=False)
class Statements:
    """What M frames say of p parameters, and what the parameters do to M attitudes.

    `information` (M, p, p) of each frame, its attitude eliminated; `weights` (M,), the sum over its
    stars of the squared inverse noise, px^-2; `common` (3, p), the common rotation, rad per unit of
    a parameter; `rest_forms` (3, p, p), the mean square over frames of what an attitude adds to it,
    rad^2; `noise` (3,), the mean over frames of the variance of an attitude, rad^2; `star_spread`,
    by errors of the stars, (p, p) each: variance of a frame's score beyond its information, and
    covariance of two frames'. With effects, their coefficients stand behind the parameters, and
    `joint` has their prior.
    """

    camera: Camera
    information: FloatArray
    weights: FloatArray
    mean_stars: float
    common: FloatArray
    rest_forms: FloatArray
    noise: FloatArray
    star_spread: tuple[FloatArray, FloatArray] | None = None
    joint: JointMatrices | None = None

    def for_mission(self, other: Statements) -> Statements:
        """The same information, for attitudes of other frames."""
        return replace(self, common=other.common, rest_forms=other.rest_forms, noise=other.noise)


def statements(
    geometry: Geometry,
    noise_px: FloatArray,
    offset_px: float = 0.0,
    effects: PlannedEffects | None = None,
) -> Statements:
    """What the frames of a geometry say with centroid noise (N,), px per axis.

    `offset_px` is the error of a star's direction, px at the boresight per axis, the same in all of
    its images; images are weighed by both together. `effects` are those that a calibration holds.
    """
    frames = geometry.frames(np.hypot(noise_px, offset_px))
    camera = geometry.camera
    joint = None
    if effects is None:
        information, response, noise = frame_matrices(camera, frames, geometry.rotations)
    else:
        seen = effects.seen(geometry.n_frames, 0)
        joint = seen.matrices(camera, frames, geometry.rotations, geometry.mag)
        information, response, noise = joint.information, joint.response, joint.noise
    common = response.mean(axis=0)
    rest = response - common
    return Statements(
        camera=camera,
        information=information,
        weights=frames.sum(np.asarray(frames.weight) ** 2),
        mean_stars=frames.n_stars / frames.n_frames,
        common=common,
        rest_forms=np.einsum("kap,kaq->apq", rest, rest, optimize=True) / len(rest),
        noise=np.diagonal(noise, axis1=1, axis2=2).mean(axis=0),
        star_spread=_star_spread(geometry, frames, noise_px, offset_px)
        if offset_px > 0.0
        else None,
        joint=joint,
    )


def _star_spread(
    geometry: Geometry, frames: StarFrames, noise_px: FloatArray, offset_px: float
) -> tuple[FloatArray, FloatArray]:
    """Variance of a frame's score beyond its information, and covariance of two frames' scores, by
    errors of stars.
    """
    camera, m = geometry.camera, geometry.n_frames
    likelihood = MarginalLikelihood(frames, camera.distortion)
    state, _ = likelihood.profile(camera.theta, geometry.rotations)
    h = likelihood.slopes(state)
    numbers = np.unique(geometry.star, return_inverse=True)[1]
    z = star_term(numbers, frames.r, camera.focal_px).columns(likelihood, state, slice(None))
    score = offset_px * np.einsum("pxn,jxn->pjn", h, z)
    total = np.zeros((int(numbers.max()) + 1, len(h), 2))
    add_by_group(total, score, numbers)
    own, every = np.einsum("pjn,qjn->pq", score, score), np.einsum("spj,sqj->pq", total, total)
    # Of the whole variance by which an image is weighed, centroid noise is this share.
    share = noise_px**2 / (noise_px**2 + offset_px**2)
    excess = own - np.einsum("pxn,qxn,n->pq", h, h, 1.0 - share, optimize=True)
    common = (every - own) / (m * (m - 1)) if m > 1 else np.zeros_like(own)
    # A difference of sums over stars that hardly repeat may be negative by chance.
    size = root_diagonal(own)
    values, vectors = np.linalg.eigh(common / np.outer(size, size))
    common = (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(size, size)
    return excess / m, common


def offset_of(camera: Camera, settings: AnyMapping) -> float:
    """Error of a star's direction in px at the boresight, per axis."""
    return float(camera.focal_px * settings["direction_mas"] / 1000.0 / ARCSEC)
