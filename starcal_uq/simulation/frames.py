"""Observations of a catalogue through a camera, with known truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

import numpy as np

from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.projection import fold_radius_px, project, unproject
from starcal_uq.core.errors import CatalogueError, SettingError, StarcalError, require
from starcal_uq.core.settings import Seed, bounded, check_memory, seed_of
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray
from starcal_uq.observations.origin import SIMULATED, Origin
from starcal_uq.observations.table import Observations
from starcal_uq.simulation.exclusion import Exclusion
from starcal_uq.simulation.noise import Noise, largest_noise, noise_of, one_noise

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from starcal_uq.sky.catalogue import StarCatalogue

# Of a row of a table: seven columns.
_BYTES_PER_STAR = 56.0
# Attitudes drawn at once; also how many are tried before a camera is declared too narrow for its
# catalogue.
_BATCH = 256
_MAX_TRIES_PER_FRAME = 2000
# More attitudes than this take minutes: refused as soon as the first tries say that so many would
# be needed.
_MAX_TRIES = 500_000
# Stars nearer to the edge than this many sigma are left out, so that noise does not decide which
# stars are seen.
EDGE_SIGMAS = 6.0
# Of cones wider than 60 degrees from the axis, a tree finds the stars no faster than a look at all
# of them.
_TREE_COSINE = 0.5


@dataclass(frozen=True)
class Campaign:
    """Data of one calibration, as simulated studies take them.

    Frames, the least stars in each (3 or more), centroid noise in px per axis, and the sensor's
    magnitude limit.
    """

    n_frames: int
    min_stars: int = 10
    sigma_px: float = 0.05
    max_mag: float = 6.0

    def check(self, error: type[StarcalError]) -> None:
        """Raise `error` for a number that cannot work."""
        require(
            error,
            (self.min_stars >= 3, f"min_stars is {self.min_stars}: an attitude needs at least 3."),
            (
                0.0 < self.sigma_px < np.inf,
                f"sigma_px is {self.sigma_px:g}: give a noise above zero.",
            ),
        )

    def simulate(
        self, stars: StarCatalogue, camera: Camera, seed: int | np.integer
    ) -> Observations:
        """`simulate` with these settings; `stars` are those to the magnitude limit."""
        return simulate(
            stars,
            camera,
            n_frames=self.n_frames,
            min_stars=self.min_stars,
            sigma_px=self.sigma_px,
            seed=int(seed),
        )

    def settings(self, stars: StarCatalogue | None) -> AnyDict:
        """Entries of a provenance; `stars` are None where the embedded catalogue is used."""
        return {**asdict(self), "stars": "embedded" if stars is None else stars.source}


class TrackerOptions(TypedDict, total=False):
    """Fields of a `Tracker` beside its camera, as keywords; `sigma_px` is its noise."""

    sigma_px: Noise
    min_stars: int
    max_stars: int | None
    exclusion: Exclusion | None


@dataclass(frozen=True)
class Tracker:
    """What takes frames: a camera, its centroid noise, and the stars that it uses.

    Attributes
    ----------
    camera : Camera
        Optics and detector.
    noise : float, callable or NoiseModel
        Centroid noise, px per axis.
    min_stars : int
        Frames with fewer stars are not taken.
    max_stars : int or None
        Stars that are used of a frame, the brightest ones; all of them where it is None.
    exclusion : Exclusion or None
        Cones that the boresight keeps out of.

    Raises
    ------
    SettingError
        If fewer stars are used than a frame must have.
    """

    camera: Camera
    noise: Noise = 0.05
    min_stars: int = 10
    max_stars: int | None = None
    exclusion: Exclusion | None = None

    def __post_init__(self) -> None:
        if self.max_stars is not None and self.max_stars < self.min_stars:
            raise SettingError(
                f"max_stars is {self.max_stars} and min_stars {self.min_stars}: use at least as "
                "many stars of a frame as it must have."
            )

    @classmethod
    def of(cls, camera: Camera, *, sigma_px: Noise = 0.05, **options: Any) -> Tracker:
        """The tracker of keywords (`TrackerOptions`)."""
        return cls(camera, sigma_px, **options)

    def sky(self, stars: StarCatalogue) -> Sky:
        """The stars of a catalogue on the detector, so far from the edge that noise does not decide
        which of them are seen.
        """
        margin_px = EDGE_SIGMAS * largest_noise(self.noise, stars.mag, self.camera)
        return Sky(stars, self.camera, margin_px, self.max_stars, self.exclusion)

    def frames(
        self,
        stars: StarCatalogue,
        rng: np.random.Generator,
        n_frames: int,
        attitudes: FloatArray | None = None,
    ) -> tuple[FloatArray, list[tuple[IntArray, FloatArray]]]:
        """Attitudes (n, 3, 3), random or given, that show enough stars, and their `Sky.views`.

        CatalogueError when a given attitude shows fewer stars or is excluded, or random ones nearly
        always are.
        """
        sky = self.sky(stars)
        if attitudes is not None:
            self._refuse_excluded(attitudes)
            frames = sky.views(attitudes)
            for number, (seen, _) in enumerate(frames):
                if len(seen) < self.min_stars:
                    raise CatalogueError(
                        f"the attitude with index {number} shows {len(seen)} stars, fewer than "
                        f"min_stars={self.min_stars}: "
                        "choose other attitudes, a deeper catalogue or a smaller min_stars."
                    )
            return attitudes, frames
        chosen: list[FloatArray] = []
        frames = []
        tries = 0
        while len(frames) < n_frames:
            rotations = random_rotations(_BATCH, rng)
            views = sky.views(rotations)
            enough = [number for number, view in enumerate(views) if len(view[0]) >= self.min_stars]
            frames += [views[number] for number in enough]
            chosen.append(rotations[enough])
            tries += _BATCH
            hopeless = tries >= _MAX_TRIES_PER_FRAME and n_frames * tries > _MAX_TRIES * (
                len(frames) + 1
            )
            if hopeless or tries > _MAX_TRIES_PER_FRAME * (len(frames) + 1):
                raise CatalogueError(
                    f"only {len(frames)} of {tries} random attitudes show {self.min_stars} stars of the "
                    "catalogue: "
                    "raise max_mag (--max-mag), or lower min_stars (--min-stars)."
                )
        return np.concatenate(chosen)[:n_frames], frames[:n_frames]

    def _refuse_excluded(self, attitudes: FloatArray) -> None:
        if self.exclusion is None:
            return
        for number, body in np.argwhere(self.exclusion.inside(attitudes)):
            raise CatalogueError(
                f"the attitude with index {number} looks within "
                f"{self.exclusion.angles_deg[body]:.4g} degrees of the {self.exclusion.bodies[body]}: "
                "choose other attitudes, or a smaller exclusion."
            )

    def observe(
        self,
        stars: StarCatalogue,
        rng: np.random.Generator,
        n_frames: int,
        meta: AnyDict,
        attitudes: FloatArray | None = None,
    ) -> Observations:
        """The stars of `frames` with noise, as a table that says `meta` of itself."""
        _, frames = self.frames(stars, rng, n_frames, attitudes)
        index, xy = map(np.concatenate, zip(*frames, strict=True))
        sigma = noise_of(self.noise, stars.mag[index], xy.T)
        xy = xy + sigma[:, None] * rng.standard_normal(xy.shape)
        return Observations(
            frame=np.repeat(np.arange(len(frames)), [len(seen) for seen, _ in frames]),
            x_px=xy[:, 0],
            y_px=xy[:, 1],
            **stars.named(index),
            sigma_px=None if one_noise(self.noise) is not None else sigma,
            meta=meta,
        )


@bounded
def simulate(
    stars: StarCatalogue,
    camera: Camera,
    *,
    n_frames: int = 1000,
    seed: Seed = 0,
    attitudes: FloatArray | None = None,
    **options: Unpack[TrackerOptions],
) -> Observations:
    """Simulate identified stars in frames at uniformly random attitudes.

    Parameters
    ----------
    stars : StarCatalogue
        Catalogue; its magnitude limit is the sensor's.
    camera : Camera
        The truth.
    n_frames : int
        Number of frames.
    seed : int or Generator
        Repeats bit for bit.
    attitudes : (n_frames, 3, 3) array, optional
        R_cam_icrs to use instead of random ones; `n_frames` is then ignored, and every frame must
        hold `min_stars`.

    Returns
    -------
    Observations
        Directions are those of the catalogue as given, so that they are exactly what the camera saw
        (``origin.directions`` is "apparent").

    Raises
    ------
    CatalogueError
        When the field is too narrow for the catalogue to show `min_stars`.
    DistortionError
        When the camera's distortion folds over inside the field.

    Other Parameters
    ----------------
    sigma_px : float, callable or NoiseModel
        Gaussian centroid noise, px per axis, 0.05 by default; a function from magnitudes (n,) to
        noise (n,), or the noise model of a calibration, is stated star by star in the table.
    min_stars : int
        Attitudes with fewer stars in the field are drawn again (at least 3; 10 by default).
    max_stars : int, optional
        Stars of a frame, the brightest ones; all on the detector by default.
    exclusion : Exclusion, optional
        Cones around Sun, Moon and Earth that the boresight keeps out of.
    """
    seed = seed_of(seed)
    tracker = Tracker.of(camera, **options)
    min_stars = tracker.min_stars
    if min_stars < 3:
        raise SettingError(f"min_stars is {min_stars}: a frame needs at least 3 stars.")
    if attitudes is None:
        check_memory(
            f"n_frames={n_frames}, min_stars={min_stars}", _BYTES_PER_STAR * n_frames * min_stars
        )
    meta = simulated_meta(camera, tracker.noise, seed)
    return tracker.observe(stars, np.random.default_rng(seed), n_frames, meta, attitudes)


def simulated_meta(camera: Camera, noise: Noise, seed: int) -> AnyDict:
    """What a simulated table says of itself."""
    return Origin(SIMULATED, "apparent", seed, one_noise(noise), camera.to_dict()).plain()


class Window:
    """The detector on the sky.

    Stars nearer to the edge than `margin_px` are left out; a negative margin lets in stars outside
    the detector. `min_cosine` is that of the cone around the optical axis that holds everything on
    it.
    """

    def __init__(self, camera: Camera, margin_px: float) -> None:
        self.camera = camera
        self.low = -0.5 + margin_px
        self.high = np.array([camera.width_px, camera.height_px]) - 0.5 - margin_px
        size = np.array([camera.width_px, camera.height_px])
        low, (right, down) = min(-0.5, self.low), np.maximum(size - 0.5, self.high)
        b = unproject(camera, np.array([(x, y) for x in (low, right) for y in (low, down)]))
        # A little wider than the farthest corner; the exact cut is made in pixels.
        self.min_cosine = float(np.cos(1.02 * np.max(np.arccos(b[:, 2]))))
        plane = get_model(camera.distortion).plane
        if (edge_rad := float(np.arccos(self.min_cosine))) < plane.limit_rad:
            ideal_px = camera.focal_px * plane.radius(edge_rad)
            if fold_radius_px(camera.distortion, camera.theta, ideal_px) <= ideal_px:
                self.min_cosine = float(np.min(b[:, 2]))

    def seen(self, b: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (N, 2) of directions (N, 3) in the camera, and which of them are on the detector
        (N,).
        """
        xy = project(self.camera, b)
        return xy, np.all((xy > self.low) & (xy < self.high), axis=1)


def brightest(mag: FloatArray, starts: IntArray, n: int) -> IntArray:
    """Places, ascending, of the n brightest stars of each frame; `starts` (M + 1,) bounds their
    stars.
    """
    sizes = np.diff(starts)
    order = np.lexsort((mag, np.repeat(np.arange(len(sizes)), sizes)))
    rank = np.arange(len(order)) - np.repeat(starts[:-1], sizes)
    return np.sort(order[rank < n])


class Sky(Window):
    """Finds the stars of a catalogue on the detector (`Window`), the brightest `max_stars` of
    each frame. A frame whose boresight is excluded shows none.
    """

    def __init__(
        self,
        stars: StarCatalogue,
        camera: Camera,
        margin_px: float,
        max_stars: int | None = None,
        exclusion: Exclusion | None = None,
    ) -> None:
        super().__init__(camera, margin_px)
        self.exclusion = exclusion
        self.directions, self.mag, self.max_stars = stars.directions_icrs, stars.mag, max_stars

    def views(self, rotations: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """Catalogue indices (m,) and noise-free pixels (m, 2) of the stars on the detector, for
        each rotation.
        """
        frame, star = self._near(rotations[:, 2])
        b = np.einsum("nij,nj->ni", rotations[frame], self.directions[star])
        xy, inside = self.seen(b)
        if self.exclusion is not None:
            free = ~np.any(self.exclusion.inside(rotations), axis=1)
            inside = inside & free[frame]
        frame, star, xy = frame[inside], star[inside], xy[inside]
        number = np.arange(len(rotations) + 1)
        edges = np.searchsorted(frame, number)
        if self.max_stars is not None:
            kept = brightest(self.mag[star], edges, self.max_stars)
            star, xy = star[kept], xy[kept]
            edges = np.searchsorted(frame[kept], number)
        return [(star[i:j], xy[i:j]) for i, j in pairwise(edges)]

    def _near(self, axes: FloatArray) -> tuple[IntArray, IntArray]:
        """Frames and stars within the cone around optical axes (n, 3), both ascending."""
        if self.min_cosine < _TREE_COSINE:
            frame, star = np.nonzero(axes @ self.directions.T > self.min_cosine)
            return frame, star
        found = self._tree.query_ball_point(
            axes, np.sqrt(2.0 - 2.0 * self.min_cosine), return_sorted=True
        )
        sizes = np.fromiter(map(len, found), dtype=np.int64, count=len(found))
        star = np.fromiter(chain.from_iterable(found), dtype=np.int64, count=int(sizes.sum()))
        return np.repeat(np.arange(len(axes)), sizes), star

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.directions)
