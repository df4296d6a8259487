"""Star identification, lost in space: which catalogue star is each centroid?

Frame by frame, patterns give hypotheses (`pyramid`), each is matched with all stars of the field
and refined (`match`), and it is accepted when the number of wrong attitudes expected to match as
well is small. What the frames say together about the camera narrows the tolerances for a second
pass over all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from typing import Protocol

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import IdentificationError
from starcal_uq.core.files import default_cache_dir
from starcal_uq.core.settings import bounded
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import FloatArray, Progress, floats
from starcal_uq.identification.blind import (
    AGREEMENT,
    FIRST_GROUP,
    FOCAL_RANGE,
    BlindSearch,
    find_optics,
)
from starcal_uq.identification.growth import GrownField, Patch, grow, matched_patch
from starcal_uq.identification.match import CameraState, Match
from starcal_uq.identification.nearby import NearbyStars
from starcal_uq.identification.outcome import identification, moved
from starcal_uq.identification.proposers import Proposer, offered_engine, prepare_engine
from starcal_uq.identification.pyramid import CameraTolerance
from starcal_uq.identification.result import (
    FoundOptics,
    Identification,
    Parity,
)
from starcal_uq.identification.search import (
    MIN_STARS,
    NOT_SEARCHED,
    CentroidTable,
    Found,
    FrameTable,
    Search,
    field_geometry,
    flipped,
)
from starcal_uq.identification.sheet import (
    CENTRE,
    LARGEST_CENTRE_PX,
    CalibratedCamera,
    bending,
    calibrated_tolerance,
    much_narrower,
    sheet_of,
)
from starcal_uq.sky.catalogue import StarCatalogue

# Where few frames are found, the others are tried with a lens this much worse.
_WORSE_LENS = 4.0
# This many frames with most stars decide whether another way of searching is worth the time.
_PROBES = 10
# After so many frames in vain the focal length is looked for: that takes less time than one such
# frame.
_IN_VAIN = 3
# So many frames of a camera say enough of it to narrow the search for the others.
_AGREE = 3
# Frames with fewer stars say nothing about the common camera.
_CAMERA_STARS = 7
# After a search at any focal length in vain, of frames with so many stars, the other frames get so
# many triangles.
_RICH_STARS, _FEW_TRIANGLES = 8, 40
# A focal length is looked for within this factor of the camera's before it is looked for anywhere.
_NEAR = 2.0
# A frame says what the lens is where chance does so less often, log10.
_SURE = -9.0
# A lens that bends is worth a second look at all frames where it explains so many times the stars
# of one, or where so many frames are missed.
_MORE, _MISSED = 1.1, 0.1
# Stars that could be matched may lie just outside the detector: those inside are fewer by a seventh.
_WHOLE = 1.14 * _MORE


class StarsByDepth(Protocol):
    """A catalogue that is as deep as it needs to be."""

    def for_camera(self, camera: Camera) -> StarCatalogue:
        """The stars that frames of this camera are compared with."""

    def for_level(self, n: int) -> StarCatalogue:
        """At least the brightest n of the sky, if there are so many."""


@dataclass(frozen=True)
class OneDepth:
    """A catalogue that was given."""

    stars: StarCatalogue

    def for_camera(self, camera: Camera) -> StarCatalogue:
        return self.stars

    def for_level(self, n: int) -> StarCatalogue:
        return self.stars


@bounded
@one_thread()
def identify(
    centroids: CentroidTable,
    camera: Camera | None,
    stars: StarCatalogue | StarsByDepth,
    *,
    calibration: CalibratedCamera | None = None,
    focal_tolerance: float = 0.03,
    centre_tolerance_px: float | None = None,
    distortion_tolerance_px: float = 1.0,
    search_focal: bool = True,
    engine: str = "pyramid",
    share_camera: bool = True,
    cache: bool = True,
    cache_dir: str | PathLike[str] | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify the stars of every frame, knowing nothing about where the camera pointed.

    Parameters
    ----------
    centroids
        Measured stars: arrays `frame`, `x_px`, `y_px`, `flux`, `sigma_px` with a row for each, and
        `frame_ids`, `image`, `time_utc` with a row for each frame. Frames without stars keep their
        place. Flux is compared with the catalogue's magnitudes frame by frame (`brightness`),
        except where `saturated`, if there, says otherwise; equal fluxes say nothing.
    camera
        The nominal camera. Without one, its size is that of the images (``centroids.meta``), and
        its focal length what they say, or else what the stars say.
    stars
        Catalogue; it may be deeper than the sensor. Its directions are those of the result.
    calibration
        A `Calibration` or `Posterior`: its camera takes the place of `camera`, and four standard
        deviations the place of the tolerances. A better known camera identifies more.
    focal_tolerance
        Relative error of the focal length; 0.03 is three per cent.
    centre_tolerance_px
        Error of the principal point per axis, px; by default 2 % of the detector's width, but not
        more than 20.
    distortion_tolerance_px
        Displacement at the detector's corner by distortion that the nominal camera does not have,
        px. Where less than half of the frames are found, the others are tried with four times as
        much, and as mirror images.
    search_focal
        Whether the focal length is searched for, from the stars alone, where less than half of the
        frames are found: within a factor of two of the camera's first, and then for any field of
        view.
    engine
        Solver that finds attitudes: "pyramid", this package's pattern search, or one that another
        package offers under this name (entry points `starcal_uq.engines`). Matching and acceptance
        are the same.
    share_camera
        Whether all frames come from one camera, so that those that are found help to find the
        others. The result does not depend on the order of the frames.
    cache
        Whether the catalogue's pairs are kept on disk, and its patterns where the focal length is
        searched for: that saves 0.1 s to 1 s for pairs, and up to several seconds for patterns.
    cache_dir
        Folder of the cache; by default the platform's folder for caches
        (`$XDG_CACHE_HOME/starcal_uq`).
    progress
        Called with the number of frames done and to be done.

    Returns
    -------
    Identification
        A frame that is not identified has a status word and no stars; it is no error.

    Raises
    ------
    IdentificationError
        A centroid is not finite or off the detector, the catalogue is too small, or no package
        offers the engine.
    """
    sheet, told = (camera, True) if camera is not None else sheet_of(centroids)
    catalogue = OneDepth(stars) if isinstance(stars, StarCatalogue) else stars
    if centre_tolerance_px is None:
        centre_tolerance_px = min(CENTRE * sheet.width_px, LARGEST_CENTRE_PX)
    tolerance = CameraTolerance(focal_tolerance, centre_tolerance_px, distortion_tolerance_px)
    if calibration is not None:
        sheet, tolerance = calibration.camera, calibrated_tolerance(calibration, tolerance)
    offered_engine(engine)
    folder = (cache_dir or default_cache_dir()) if cache else None
    prepare = partial(prepare_engine, engine, folder=folder)
    attempt = _Attempt(centroids, catalogue, sheet, tolerance, prepare, share_camera)
    _check(centroids, sheet, attempt.stars)
    searching = search_focal and calibration is None
    if told:
        attempt.run(progress, searching)
        if searching and share_camera:
            attempt = attempt.filled(progress)
    optics = None
    if searching and not attempt.good:
        alone = _found_optics(attempt.field, catalogue, sheet, told, folder)
        if alone is not None:
            optics, frame, patch = alone
            other = _Attempt(
                centroids,
                catalogue,
                *_with(sheet, tolerance, optics, told),
                prepare,
                share_camera,
                optics.mirrored,
            )
            grown = other.grown(frame, patch)
            if grown is not None:
                optics = replace(
                    optics, focal_px=grown.camera.focal_px, distortion_px=abs(grown.bend_px)
                )
                other = other.bent(frame, grown, _with(sheet, tolerance, optics, told)[0])
            other.run(progress, False)
            if grown is not None and share_camera:
                other.by_patterns(catalogue, folder)
            if other.n_solved > attempt.n_solved or not told:
                attempt = other
    if told or optics is not None:
        rich = max(map(len, attempt.field.xy), default=0) >= _RICH_STARS
        attempt.finish(
            progress, hopeless=searching and rich and optics is None and not attempt.good
        )
    return attempt.result(optics)


class _Attempt:
    """All frames, identified with one camera and its tolerances."""

    def __init__(
        self,
        centroids: CentroidTable,
        catalogue: StarsByDepth,
        camera: Camera,
        tolerance: CameraTolerance,
        prepare: Callable[..., Proposer],
        share_camera: bool,
        mirrored: bool = False,
    ) -> None:
        self.centroids, self.camera = centroids, camera
        self.prepare, self.share_camera = prepare, share_camera
        self.nominal, self.stars, self.tolerance = camera, catalogue.for_camera(camera), tolerance
        self.parity: Parity = "mirrored" if mirrored else "normal"
        self.field = FrameTable(centroids, camera, mirrored)
        self.results: dict[int, Found] = {}
        # The tolerances of frames that were searched with the camera of others.
        self._narrowed: dict[int, CameraTolerance] = {}
        self._search: Search | None = None

    @property
    def search(self) -> Search:
        """The catalogue prepared for the camera, when it is first needed."""
        if self._search is None:
            geometry = field_geometry(self.field.camera)
            prepare = partial(self.prepare, self.stars, geometry, self.tolerance)
            self._search = Search(self.field.camera, self.stars, self.tolerance, prepare)
        return self._search

    @property
    def n_solved(self) -> int:
        return _solved(self.results.values())

    @property
    def n_stars(self) -> int:
        """Stars identified in all frames."""
        return sum(len(f.match) for f in self.results.values() if f.match is not None)

    @property
    def good(self) -> bool:
        """Whether all frames were searched, and half of them are found."""
        return len(self.results) == len(self.field.ids) and len(self._failed()) <= self.n_solved

    def grown(self, k: int, patch: Patch) -> GrownField | None:
        """What a frame shows of the lens around its matched stars, where that is beyond doubt."""
        sky = NearbyStars(self.stars, field_geometry(self.field.camera))
        found = grow(self.field.xy[k], self.field.sigma[k], patch, sky, self.field.camera)
        return found if found is not None and found.log10_false < _SURE else None

    def bent(self, k: int, grown: GrownField, nominal: Camera) -> _Attempt:
        """The same frames, to be searched with a lens that one of them shows, whose own attitude is
        known.
        """
        other = copy(self)
        mirrored = self.parity == "mirrored"
        largest = bending(self.tolerance, self.camera, grown.bend_px)
        other.camera = flipped(grown.camera) if mirrored else grown.camera
        other.nominal, other.tolerance = nominal, calibrated_tolerance(grown, largest)
        other.field = FrameTable(self.centroids, other.camera, mirrored)
        other.results, other._narrowed, other._search = {}, {}, None
        known = other.search.near(other.field, k, grown.patch.rotation)
        if known.match is not None:
            other.results[k] = known
        return other

    def by_patterns(self, catalogue: StarsByDepth, folder: str | PathLike[str] | None) -> None:
        """Look in frames that failed at patterns of more of their brightest detections, which may
        be hot pixels.

        All frames are looked at where one of the first few is found so.
        """
        camera = self.field.camera
        search = BlindSearch(
            catalogue.for_level(FIRST_GROUP), camera.width_px, camera.height_px, folder
        )
        limits = camera.focal_px * (1.0 - AGREEMENT), camera.focal_px * (1.0 + AGREEMENT)
        failed = self._failed()
        for number, k in enumerate(failed):
            if number == _PROBES and all(self.results[i].match is None for i in failed[:number]):
                return
            solved = search.solve(
                self.field.points[k], self.field.sigma[k], search.sizes(FIRST_GROUP, limits), limits
            )
            if solved is not None:
                self.results[k] = self.search.near(self.field, k, solved.patch.rotation)

    def filled(self, progress: Progress | None) -> _Attempt:
        """The frames with the lens that the best of them shows, where that explains more than this
        camera does.

        All frames are looked at again where that one shows many more stars, where many others are
        not identified, or where the lens bends by more than is allowed for.
        """
        solved = [(k, found.match) for k, found in self.results.items() if found.match is not None]
        if not solved:
            return self
        k, match = max(solved, key=lambda one: len(one[1]))
        missed = len(self._failed()) > _MISSED * len(self.results)
        if not missed and _is_whole(match, self.tolerance):
            return self
        focal_px = self.field.camera.focal_px
        grown = self.grown(k, matched_patch(match, focal_px, self.stars.directions_icrs))
        if grown is None:
            return self
        other = self.bent(k, grown, self.nominal)
        more = len(grown.patch.centroid) > _MORE * len(match)
        beyond = self.tolerance.distortion_px + other.tolerance.distortion_px
        bends = not any(self.camera.coefficients) and abs(grown.bend_px) > beyond
        if not (more or missed or bends):
            return self
        other.run(progress, False)
        return other if other.n_stars > self.n_stars else self

    def _failed(self) -> list[int]:
        """Frames with enough stars that are not identified, those with most stars first."""
        sizes = [len(points) for points in self.field.xy]
        failed = (k for k, found in self.results.items() if found.match is None)
        return sorted((k for k in failed if sizes[k] >= MIN_STARS), key=lambda k: -sizes[k])

    def run(self, progress: Progress | None, stop: bool) -> None:
        """Search every frame, those with most stars first; with `stop`, only while a third of them
        is found.

        What the first ones found say of the camera narrows the search for the others.
        """
        useful, n_solved = _useful(self.results.values()), self.n_solved
        narrow: tuple[Search, FrameTable, FloatArray] | None = None
        enough = _AGREE
        for k in self._in_turn():
            if k in self.results:
                continue
            tried = len(self.results)
            if (
                stop
                and tried >= _IN_VAIN
                and 3 * n_solved < tried
                and len(self.field.xy[k]) >= MIN_STARS
            ):
                return
            if self.share_camera and len(useful) >= enough:
                narrow, enough = self._narrow(useful), 2 * len(useful)
            if narrow is None:
                found = self.search.frame(self.field, k)
            else:
                found = _relative(narrow[0].frame(narrow[1], k), narrow[2])
                self._narrowed[k] = narrow[0].tolerance
            self.results[k] = found
            useful += _useful([found])
            n_solved += found.match is not None
            if progress is not None:
                progress(len(self.results), len(self.field.ids))

    def _in_turn(self) -> list[int]:
        """Frames with most stars first, but a middling one early: most stars may be those of trees
        or clouds.
        """
        xy = self.field.xy
        order = sorted(range(len(xy)), key=lambda k: (-len(xy[k]), xy[k][:1].tolist()))
        middle = sum(len(points) >= MIN_STARS for points in xy) // 2
        if middle >= _IN_VAIN:
            order.insert(_IN_VAIN - 1, order.pop(middle))
        return order

    def _narrow(self, useful: list[Match]) -> tuple[Search, FrameTable, FloatArray]:
        """The search with the camera that matches agree on, its frames, and by what that camera
        differs.
        """
        shared, covariance = self.search.common_camera(useful)
        camera = moved(self.field.camera, shared)
        return self.search.narrowed(camera, covariance), self.field.seen_by(camera), shared

    def finish(self, progress: Progress | None, hopeless: bool = False) -> None:
        """Search what is left, as mirror images and with a worse lens where most frames fail.

        Where a search at any focal length, mirror images included, was in vain, the frames left get
        a short look each.
        """
        if hopeless and not self.n_solved:
            self.search.triangles = min(self.search.triangles, _FEW_TRIANGLES)
        self.run(progress, False)
        failed = self._failed()
        most = len(failed) > self.n_solved
        # Perhaps the first frames do not speak for the others: those may be of another camera.
        lost = [k for k in failed if k in self._narrowed]
        self.results |= _retry(self.search, self.field, lost, _PROBES if most else _IN_VAIN)
        if most:
            self._narrowed = {}
        failed = self._failed()
        if (
            len(failed) > self.n_solved
            and self.n_solved < 2
            and self.parity == "normal"
            and not hopeless
        ):
            # Every frame of a camera has one handedness: the one that more frames have.
            field = FrameTable(self.centroids, self.camera, mirrored=True)
            mirror = Search(field.camera, self.stars, self.tolerance, self.search.proposer)
            other = _retry(mirror, field, failed)
            if _solved(other.values()) > self.n_solved:
                self.parity, self.field, self._search = "mirrored", field, mirror
                self.results = {
                    k: other[k] if k in other else mirror.frame(field, k) for k in self.results
                }
        # Two attitudes that explain a frame are not told apart by knowing less.
        failed = [k for k in self._failed() if self.results[k].status != "ambiguous"]
        # What shows no lens at any focal length, however it bends, does not show a worse one.
        if len(failed) > self.n_solved and (self.n_solved or not hopeless):
            worse = self.search.widened(_WORSE_LENS)
            other = _retry(worse, self.field, failed)
            self.results |= other
            self._search = worse if _solved(other.values()) else self.search

    def result(self, optics: FoundOptics | None) -> Identification:
        """What became of all frames, with what they say together about the camera."""
        results = [self.results.get(k, NOT_SEARCHED) for k in range(len(self.field.ids))]
        useful = _useful(results)
        refined = self.field.camera
        if self.share_camera and len(useful) > 1:
            second, again, shared = self._narrow(useful)
            # What was not found with a camera known as well is not looked for once more.
            known = {k for k, t in self._narrowed.items() if not much_narrower(second.tolerance, t)}
            given_up = {k for k in known if results[k].match is None}
            results = [
                f if k in given_up else second.again(again, k, f, shared)
                for k, f in enumerate(results)
            ]
            refined, useful = again.camera, _useful(results)
            if useful:
                refined = moved(refined, second.common_camera(useful)[0])
        elif useful:
            refined = moved(refined, self.search.common_camera(useful)[0])
        nominal = flipped(self.nominal) if self.parity == "mirrored" else self.nominal
        return identification(
            self.field, results, refined, nominal, self.stars, self.parity, self.centroids, optics
        )


def _found_optics(
    field: FrameTable,
    catalogue: StarsByDepth,
    sheet: Camera,
    told: bool,
    folder: str | PathLike[str] | None,
) -> tuple[FoundOptics, int, Patch] | None:
    """What the stars alone say of the lens, and which of one frame say so."""
    frames = []
    for xy, sigma in zip(field.xy, field.sigma, strict=True):
        frames.append((xy - np.array(sheet.centre_px), sigma))
    shortest, longest = FOCAL_RANGE[0] * sheet.width_px, FOCAL_RANGE[1] * sheet.width_px
    ranges = [(shortest, longest)]
    if told:
        low, high = sheet.focal_px / _NEAR, sheet.focal_px * _NEAR
        ranges = [(low, high), *((a, b) for a, b in ((shortest, low), (high, longest)) if a < b)]
    size = sheet.width_px, sheet.height_px
    return find_optics(frames, catalogue.for_level, *size, ranges, folder)


def _with(
    sheet: Camera, tolerance: CameraTolerance, optics: FoundOptics, told: bool
) -> tuple[Camera, CameraTolerance]:
    """The camera with the focal length found, and its tolerances; a sheet that allows it is
    kept.
    """
    if told and abs(optics.focal_px / sheet.focal_px - 1.0) < tolerance.focal:
        camera = sheet
    else:
        name = f"{sheet.name}, " if sheet.name else ""
        camera = sheet.replace(focal_px=optics.focal_px, name=f"{name}focal length from the stars")
        tolerance = replace(tolerance, focal=min(tolerance.focal, AGREEMENT))
    if told:
        return camera, tolerance
    return camera, bending(tolerance, sheet, optics.distortion_px)


def _is_whole(match: Match, tolerance: CameraTolerance) -> bool:
    """Whether a match leaves no star to be found, in a lens that bends by what is allowed for."""
    bend_px = abs(float(match.state.shared[3]))
    return (
        _WHOLE * len(match) > match.n_possible
        and match.noise_scale == 1.0
        and bend_px < _WHOLE * tolerance.distortion_px
    )


def _useful(results: Iterable[Found]) -> list[Match]:
    """Matches that say something about the common camera."""
    return [f.match for f in results if f.match is not None and len(f.match) >= _CAMERA_STARS]


def _relative(found: Found, shared: FloatArray) -> Found:
    """A frame matched with a camera moved by `shared`, as seen from the camera that was moved."""
    if (m := found.match) is None:
        return found
    state = CameraState(m.state.rotation, m.state.shared + shared)
    return replace(
        found, match=replace(m, state=state, gradient=m.gradient + m.information @ shared)
    )


def _solved(results: Iterable[Found]) -> int:
    return sum(f.match is not None for f in results)


def _retry(
    search: Search, field: FrameTable, frames: list[int], probes: int = _PROBES
) -> dict[int, Found]:
    """Frames searched in another way: all of them, if one of the first few is found so."""
    result = {k: search.frame(field, k) for k in frames[:probes]}
    if _solved(result.values()):
        result |= {k: search.frame(field, k) for k in frames[probes:]}
    return result


def _check(table: CentroidTable, camera: Camera, stars: StarCatalogue) -> None:
    if len(stars) < 100:
        raise IdentificationError(
            f"the catalogue has {len(stars)} stars, too few to find patterns in: raise its "
            "magnitude limit."
        )
    xy = np.column_stack([floats(table.x_px), floats(table.y_px)])
    outside = np.flatnonzero(~camera.contains(xy))
    if outside.size:
        row = int(outside[0])
        raise IdentificationError(
            f"centroid {row + 1} (frame {int(table.frame[row])}) at ({xy[row, 0]:g}, "
            f"{xy[row, 1]:g}) px is not on the "
            f"{camera.width_px} x {camera.height_px} detector of the camera: give the camera "
            "that took the images."
        )
    sigma = floats(table.sigma_px)
    if (
        not np.all(np.isfinite(sigma) & (sigma >= 0.0))
        or not np.isfinite(np.asarray(table.flux)).all()
    ):
        raise IdentificationError(
            "a centroid has noise or flux that is no finite number: leave such centroids out."
        )
