"""One camera, one catalogue, one set of tolerances: identify frames with them, one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import cache
from time import perf_counter
from typing import TYPE_CHECKING, Protocol

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.camera.planes import PINHOLE
from starcal_uq.camera.projection import unproject
from starcal_uq.core.errors import IdentificationError
from starcal_uq.core.types import FloatArray, IntArray, StrArray, floats
from starcal_uq.identification.brightness import instrumental_mag
from starcal_uq.identification.match import CameraState, Match, match_frame, start_state
from starcal_uq.identification.nearby import NearbyStars
from starcal_uq.identification.proposers import Proposer
from starcal_uq.identification.pyramid import CameraTolerance, FieldGeometry, Hypothesis
from starcal_uq.identification.result import FrameStatus
from starcal_uq.maths.linear import root_diagonal, scaled_inverse
from starcal_uq.sky.catalogue import StarCatalogue

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# A frame is identified when fewer wrong attitudes than this are expected to match as well.
MAX_EXPECTED_FALSE = 1e-4
_LOG10_ACCEPTED = float(np.log10(MAX_EXPECTED_FALSE))
# Fewer stars than this are not identified: three have no redundancy beyond the focal length.
MIN_STARS = 4
# Centroids are not believed to be better than this: catalogue positions and the lens have errors of
# their own.
LEAST_SIGMA_PX = 0.05
# Above this expectation the search goes on after a first success, to see whether another attitude
# fits too.
_BEYOND_DOUBT = 1e-8
# Triangles are made of so many centroids first, and then of so many.
_CENTROIDS = (10, 16)
_MAX_TRIANGLES = 200
# A match with more than this noise, or with less than half of what can be, is compared with those
# of more triangles.
_POOR_FIT = 1.3
_MORE_TRIANGLES = 5
# Triangles of a frame that is tried once more with a worse lens, whose many hypotheses take long.
_MAX_TRIANGLES_WIDE = 60


class CentroidTable(Protocol):
    """What `identify` reads of a table of centroids: N rows, K frames."""

    @property
    def frame(self) -> IntArray: ...
    @property
    def x_px(self) -> FloatArray: ...
    @property
    def y_px(self) -> FloatArray: ...
    @property
    def flux(self) -> FloatArray: ...
    @property
    def sigma_px(self) -> FloatArray: ...
    @property
    def frame_ids(self) -> IntArray: ...
    @property
    def image(self) -> StrArray: ...
    @property
    def time_utc(self) -> StrArray: ...


@dataclass(frozen=True, eq=False)
class Found:
    """What became of a frame."""

    status: FrameStatus
    match: Match | None
    seconds: float


NOT_SEARCHED = Found("not identified", None, 0.0)


class FrameTable:
    """Centroids frame by frame, brightest first, as pixels and as ideal pixels of one camera."""

    def __init__(self, table: CentroidTable, camera: Camera, mirrored: bool = False) -> None:
        self.camera = flipped(camera) if mirrored else camera
        self.ids = [int(i) for i in table.frame_ids]
        x = floats(table.x_px)
        xy = np.column_stack([camera.width_px - 1 - x if mirrored else x, floats(table.y_px)])
        frame = np.asarray(table.frame)
        # lexsort is stable: centroids of equal brightness keep their order.
        order = np.lexsort((-floats(table.flux), frame))
        edges = (
            np.searchsorted(frame[order], self.ids, side="left"),
            np.searchsorted(frame[order], self.ids, "right"),
        )
        self.rows: list[IntArray] = [
            order[i:j].astype(np.int64) for i, j in zip(*edges, strict=True)
        ]
        self.xy: list[FloatArray] = [xy[rows] for rows in self.rows]
        sigma = np.hypot(floats(table.sigma_px), LEAST_SIGMA_PX)
        self.sigma: list[FloatArray] = [sigma[rows] for rows in self.rows]
        flux = floats(table.flux)
        if len(saturated := np.asarray(getattr(table, "saturated", ()), dtype=np.bool_)):
            flux = np.where(saturated, np.nan, flux)
        self.mag = [instrumental_mag(flux[rows]) for rows in self.rows]
        self.points = self._ideal(self.camera)
        self._trees: dict[int, cKDTree] = {}

    def _ideal(self, camera: Camera) -> list[FloatArray]:
        stacked = np.concatenate(self.xy) if self.xy else np.empty((0, 2))
        if not len(stacked):
            return [xy.copy() for xy in self.xy]
        b = unproject(camera, stacked)
        return np.split(
            camera.focal_px * b[:, :2] / b[:, 2:], np.cumsum([len(xy) for xy in self.xy])[:-1]
        )

    def seen_by(self, camera: Camera) -> FrameTable:
        """The same frames in the ideal pixels of another camera."""
        other = copy(self)
        other.camera, other.points, other._trees = camera, other._ideal(camera), {}
        return other

    def tree(self, k: int) -> cKDTree:
        """The points of a frame, to be searched by place."""
        from scipy.spatial import cKDTree

        if k not in self._trees:
            self._trees[k] = cKDTree(self.points[k])
        return self._trees[k]


class Search:
    """One camera, its tolerances and catalogue, which `prepare` makes ready when first needed."""

    def __init__(
        self,
        camera: Camera,
        stars: StarCatalogue,
        tolerance: CameraTolerance,
        prepare: Callable[[], Proposer],
    ) -> None:
        self.geometry = field_geometry(camera)
        self.tolerance, self.radial = tolerance, has_radial(camera)
        self.centroids: tuple[int, ...] = _CENTROIDS
        self.triangles = _MAX_TRIANGLES
        self.proposer = cache(prepare)
        self.sky = NearbyStars(stars, self.geometry)

    def widened(self, factor: float) -> Search:
        """The same for a lens with more distortion."""
        other = copy(self)
        other.tolerance = replace(
            self.tolerance, distortion_px=self.tolerance.distortion_px * factor
        )
        other.centroids, other.triangles = _CENTROIDS[:1], _MAX_TRIANGLES_WIDE
        return other

    def narrowed(self, camera: Camera, covariance: FloatArray) -> Search:
        """The same for a camera known from the frames so far."""
        other = copy(self)
        sd = 4.0 * root_diagonal(covariance)
        focal, dx, dy, kappa = sd.tolist()
        # Not below what a lens model with few terms leaves over.
        other.tolerance = self.tolerance.at_most(
            max(focal, 2e-4), max(dx, dy, 1.0), max(kappa, 0.3)
        )
        other.geometry = replace(
            self.geometry, focal_px=camera.focal_px, corner_px=camera.corner_radius_px
        )
        other.sky = self.sky.seen_by(other.geometry)
        return other

    def frame(self, field: FrameTable, k: int) -> Found:
        """Identify one frame from nothing."""
        if len(field.points[k]) < MIN_STARS:
            return Found("too few stars", None, 0.0)
        # No frame waits for the catalogue.
        self.proposer()
        clock = perf_counter()
        status, match = self._look(field, k)
        return Found(status, match, perf_counter() - clock)

    def near(self, field: FrameTable, k: int, rotation: FloatArray) -> Found:
        """Identify one frame whose attitude is known."""
        clock = perf_counter()
        match = self._matched(field, k, start_state(Hypothesis(rotation, 1.0)), polished=True)
        accepted = match is not None and match.log10_false < _LOG10_ACCEPTED
        return Found(
            "identified" if accepted else "not identified",
            match if accepted else None,
            perf_counter() - clock,
        )

    def again(self, field: FrameTable, k: int, first: Found, shared: FloatArray) -> Found:
        """The second pass: match anew with the common camera, or search once more."""
        clock = perf_counter()
        if first.match is None:
            second = self.frame(field, k)
            return replace(second, seconds=second.seconds + first.seconds)
        state = first.match.state
        start = CameraState(state.rotation, state.shared - shared)
        match = self._matched(field, k, start, polished=True)
        seconds = first.seconds + perf_counter() - clock
        # A frame that fits by itself but not with the camera of the others is not trusted.
        if match is None or match.log10_false > _LOG10_ACCEPTED:
            return Found("not identified", None, seconds)
        return Found(first.status, match, seconds)

    def _matched(
        self, field: FrameTable, k: int, start: CameraState, polished: bool = False
    ) -> Match | None:
        return match_frame(
            field.tree(k),
            field.sigma[k],
            self.sky,
            start,
            self.tolerance,
            mag=field.mag[k],
            radial=self.radial,
            polished=polished,
            log10_wanted=_LOG10_ACCEPTED,
        )

    def _look(self, field: FrameTable, k: int) -> tuple[FrameStatus, Match | None]:
        searched = 0
        for n_centroids in self.centroids:
            if len(field.xy[k]) <= searched:
                break
            accepted = list(self._accepted(field, k, n_centroids, searched))
            searched = n_centroids
            if accepted:
                best = min(accepted, key=lambda match: match.log10_false)
                # An attitude with far fewer matches is the same one caught on a neighbouring star,
                # or chance.
                rivals = [m for m in accepted if m.log10_false < 0.5 * best.log10_false]
                differ = any(_other_stars(m, best) for m in rivals)
                return ("ambiguous", None) if differ else ("identified", best)
        return "not identified", None

    def _accepted(
        self, field: FrameTable, k: int, n_centroids: int, searched: int
    ) -> Iterator[Match]:
        """Acceptable matches, up to the first that is beyond doubt and complete, or some triangles
        more.
        """
        points, sigma = field.points[k], field.sigma[k]
        batches = self.proposer()(
            points, sigma, self.geometry, self.tolerance, n_centroids, searched
        )
        left = self.triangles
        for batch in batches:
            if left <= 0:
                return
            left -= 1
            for hypothesis in batch:
                match = self._matched(field, k, start_state(hypothesis))
                if match is None or match.log10_false >= _LOG10_ACCEPTED:
                    continue
                yield match
                if match.log10_false < np.log10(_BEYOND_DOUBT):
                    # A triangle with the wrong star of a close pair gives nearly the right
                    # attitude: it matches too many stars for chance, but few of all that could be,
                    # and badly.
                    if match.noise_scale < _POOR_FIT and len(match) > 0.5 * match.n_possible:
                        return
                    left = min(left, _MORE_TRIANGLES)

    def common_camera(self, matches: list[Match]) -> tuple[FloatArray, FloatArray]:
        """Shared parameters (4,) from all frames with the tolerances as prior, and their covariance
        (4, 4).
        """
        prior = np.diag(self.tolerance.information(self.radial))
        information = prior + np.sum([m.information for m in matches], axis=0)
        covariance = scaled_inverse(information)
        return covariance @ np.sum([m.gradient for m in matches], axis=0), covariance


def _other_stars(one: Match, other: Match) -> bool:
    """Whether two matches of a frame say different things: less than half of the smaller one's
    stars are the other's.

    Attitudes do not tell: that of the same stars moves with the principal point, by degrees where
    it is hardly known.
    """
    pairs = set(zip(one.centroid.tolist(), one.star.tolist(), strict=True))
    common = pairs.intersection(zip(other.centroid.tolist(), other.star.tolist(), strict=True))
    return 2 * len(common) < min(len(one), len(other))


def flipped(camera: Camera) -> Camera:
    """The camera with x counted from the right edge."""
    return camera.replace(x0_px=camera.width_px - 1 - camera.x0_px)


def field_geometry(camera: Camera) -> FieldGeometry:
    """The camera as the search sees it; IdentificationError for one that is no pinhole."""
    if get_model(camera.distortion).plane is not PINHOLE:
        raise IdentificationError(
            f"the search looks for stars of a pinhole camera, and {camera.distortion!r} is none: "
            "identify them with another program, and calibrate from the table of its stars."
        )
    return FieldGeometry(
        camera.focal_px, camera.width_px, camera.height_px, camera.corner_radius_px
    )


def has_radial(camera: Camera) -> bool:
    """Whether the camera's model has a cubic radial term on ideal points, which takes up kappa."""
    model = get_model(camera.distortion)
    return model.direction == "forward" and any(c.name == "k1" for c in model.coefficients)
