"""Frames of the field experiment: rendered, searched for stars, chosen by the paper's rule, and
identified.

A star tracker in flight holds its camera for right: each frame is identified for itself with
tolerances that are the same whatever the camera. Tolerances of a number of pixels mean that the
camera may misplace a star in the corner of the field by so much, by its focal length or by its
distortion, and the principal point by so much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import random_rotations
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.store import Kept
from starcal_uq.core.tasks import run_tasks
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray, IntArray, PathLike, Progress
from starcal_uq.identification.proposers import Proposer, prepare_engine
from starcal_uq.identification.pyramid import CameraTolerance
from starcal_uq.identification.search import FrameTable, Search, field_geometry
from starcal_uq.images.centroids import COLUMNS, FRAME_COLUMNS, Centroids
from starcal_uq.images.extract import extract_centroids
from starcal_uq.paper.field.published import MORE_THAN_STARS, FieldReading
from starcal_uq.simulation.frames import Sky
from starcal_uq.simulation.rendering import Scene
from starcal_uq.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

# Stars this much fainter than the limit still shine.
_FAINTER_MAG = 2.0
# Attitudes that show too few stars down to so much beyond the limit are not rendered: noise would
# have to lift several stars by this much.
_DOUBTFUL_MAG = 0.5
_BATCH = 256
# Candidates for each frame wanted, and some more; a second helping is drawn where they do not
# suffice.
_CANDIDATES, _MORE_CANDIDATES = 1.9, 8
_MAX_BATCHES = 400
_CALLER = "field_experiment"
_CHUNK = 8
# A star is wrong if it truly is farther than this from the centroid that was given its name.
WRONG_PX = 3.0


@dataclass(frozen=True, eq=False)
class FieldFrames:
    """Centroids of frames 0 .. n - 1 with more than six stars, true R_cam_icrs (n, 3, 3), and how
    rare such frames are.

    `share` is the part of random attitudes that gave one.
    """

    centroids: Centroids
    rotations: FloatArray
    share: float

    def part(self, first: int, last: int) -> FieldFrames:
        """Frames first .. last - 1, numbered from 0."""
        part = self.centroids.select_frames(np.arange(first, last))
        part = replace(
            part, frame=part.frame - first, frame_ids=np.arange(last - first), messages=()
        )
        return FieldFrames(part, self.rotations[first:last], self.share)


@dataclass(frozen=True, eq=False)
class _RenderTask:
    """Renders candidate attitudes and finds the stars; every number has noise of its own."""

    scene: Scene
    rotations: FloatArray
    first: int
    seed: int

    def __call__(self, number: int) -> Centroids:
        frame = self.first + number
        rng = np.random.default_rng([self.seed, 1, frame])
        image = self.scene.render(self.rotations[number], rng, frame=frame).image
        return extract_centroids(image)


def take_frames(
    reading: FieldReading,
    n_frames: int,
    seed: int,
    workers: int | None,
    progress: Progress | None,
    keep: PathLike | None = None,
) -> FieldFrames:
    """Render random attitudes until `n_frames` of them show more than six stars; a folder keeps
    what is done.
    """
    stars, camera = load_catalogue(max_mag=reading.limit_mag + _FAINTER_MAG), reading.truth
    scene = Scene(stars, camera, reading.sensor)
    attitudes = _Attitudes(reading, np.random.default_rng([seed, 0]))
    chosen: list[Centroids] = []
    rotations: list[FloatArray] = []
    rank, done = 0, 0
    while len(chosen) < n_frames:
        missing = n_frames - len(chosen)
        some, ranks = attitudes.take(int(np.ceil(missing * _CANDIDATES)) + _MORE_CANDIDATES)
        before = len(chosen)

        def move(number: int, total: int, before: int = before) -> None:
            if progress is not None:
                progress(min(n_frames, before + number * (n_frames - before) // total), n_frames)

        task = _RenderTask(scene, some, done, seed)
        # A candidate depends on the seed and its own number.
        identity = ["field frames", reading.name, seed, done, stars.source]
        kept = None if keep is None else Kept(keep, identity, (Centroids,))
        tables, _ = run_tasks(
            task,
            len(some),
            caller=_CALLER,
            chunk=_CHUNK,
            workers=workers,
            progress=move,
            kept=kept,
            whole=True,
        )
        done += len(some)
        for table, rotation, number in zip(tables, some, ranks, strict=True):
            if len(chosen) < n_frames and len(table.frame) > MORE_THAN_STARS:
                chosen.append(table)
                rotations.append(rotation)
                rank = int(number)
    return FieldFrames(_joined(chosen), np.array(rotations), n_frames / (rank + 1))


class _Attitudes:
    """Random attitudes; those that cannot show enough stars are passed over, but counted."""

    def __init__(self, reading: FieldReading, rng: np.random.Generator) -> None:
        stars: StarCatalogue = load_catalogue(max_mag=reading.limit_mag + _DOUBTFUL_MAG)
        self.sky = Sky(stars, reading.truth, 0.0)
        self.rng, self.drawn = rng, 0
        self.rotations: list[FloatArray] = []
        self.ranks: list[int] = []

    def take(self, n: int) -> tuple[FloatArray, list[int]]:
        """The next n, and which of all random ones they are."""
        for _ in range(_MAX_BATCHES):
            if len(self.rotations) >= n:
                break
            batch = random_rotations(_BATCH, self.rng)
            for number, (seen, _xy) in enumerate(self.sky.views(batch)):
                if len(seen) > MORE_THAN_STARS:
                    self.rotations.append(batch[number])
                    self.ranks.append(self.drawn + number)
            self.drawn += _BATCH
        else:
            raise CalibrationError(
                "the field experiment: next to no attitude shows more than six stars."
            )
        rotations, ranks = np.array(self.rotations[:n]), self.ranks[:n]
        del self.rotations[:n], self.ranks[:n]
        return rotations, ranks


def _joined(tables: list[Centroids]) -> Centroids:
    """One table of many single frames, numbered anew."""
    columns: AnyDict = {
        name: np.concatenate([getattr(t, name) for t in tables]) for name in COLUMNS
    }
    columns["frame"] = np.repeat(np.arange(len(tables)), [len(t.frame) for t in tables])
    frames: AnyDict = {
        name: np.concatenate([getattr(t, name) for t in tables]) for name in FRAME_COLUMNS
    }
    frames["frame_ids"] = np.arange(len(tables))
    messages = dict.fromkeys(message for table in tables for message in table.messages)
    meta = {key: value for key, value in tables[0].meta.items() if key != "images_sha256"}
    return Centroids(**columns, **frames, messages=tuple(messages), meta=meta)


@dataclass(frozen=True, eq=False)
class FieldIdentification:
    """Every frame identified with one camera and one tolerance.

    Of each of m stars that were named there is its frame, its row in the table of centroids and in
    the catalogue; `correct` and `wrong` (n,) mark frames with an attitude and no wrong star, and
    with one.
    """

    camera: Camera
    tolerance_px: float
    frame: IntArray
    row: IntArray
    star: IntArray
    correct: BoolArray
    wrong: BoolArray

    @property
    def n_frames(self) -> int:
        """Frames tried."""
        return len(self.correct)


def corner_tolerance(camera: Camera, tolerance_px: float) -> CameraTolerance:
    """The tolerances that so many pixels stand for."""
    return CameraTolerance(tolerance_px / camera.corner_radius_px, tolerance_px, tolerance_px)


@dataclass(frozen=True, eq=False)
class _IdentifyTask:
    """Identifies all frames with one camera and one tolerance."""

    frames: FieldFrames
    truth: Camera
    stars: StarCatalogue
    jobs: list[tuple[Camera, float]]
    proposer: Proposer

    def __call__(self, number: int) -> FieldIdentification:
        camera, tolerance_px = self.jobs[number]
        field = FrameTable(self.frames.centroids, camera)
        # `identify` would try failed frames again with wider tolerances and refine the camera over
        # all frames.
        tolerance = corner_tolerance(camera, tolerance_px)
        search = Search(camera, self.stars, tolerance, lambda: self.proposer)
        n = len(field.ids)
        matches = [search.frame(field, k).match for k in range(n)]
        solved = [(k, match) for k, match in enumerate(matches) if match is not None]
        empty = [np.empty(0, dtype=np.int64)]
        frame = np.repeat([k for k, _ in solved], [len(match) for _, match in solved]).astype(
            np.int64
        )
        row = np.concatenate([field.rows[k][match.centroid] for k, match in solved] or empty)
        star = np.concatenate([match.star for _, match in solved] or empty)
        table = self.frames.centroids
        place = true_pixels(
            self.truth, self.frames.rotations[frame], self.stars.directions_icrs[star]
        )
        # Nowhere near is also wrong.
        bad = ~(np.hypot(table.x_px[row] - place[:, 0], table.y_px[row] - place[:, 1]) <= WRONG_PX)
        wrong = np.bincount(frame[bad], minlength=n) > 0
        correct = (np.bincount(frame, minlength=n) > 0) & ~wrong
        return FieldIdentification(camera, tolerance_px, frame, row, star, correct, wrong)


def true_pixels(truth: Camera, rotations: FloatArray, directions: FloatArray) -> FloatArray:
    """Where stars (m, 3) truly are under attitudes (m, 3, 3): (m, 2), NaN for those behind the
    camera.
    """
    b = np.einsum("nij,nj->ni", rotations, directions)
    place = np.full((len(b), 2), np.nan)
    ahead = b[:, 2] > 0.5
    place[ahead] = project(truth, b[ahead])
    return place


def identify_all(
    frames: FieldFrames,
    truth: Camera,
    stars: StarCatalogue,
    jobs: list[tuple[Camera, float]],
    workers: int | None,
    progress: Progress | None,
    kept: Kept | None = None,
) -> list[FieldIdentification]:
    """Identify the frames once for each job (camera, tolerance in px)."""
    # One set of pairs serves all cameras, whose fields differ little.
    wide = CameraTolerance(0.03, 0.0, 0.0)
    proposer = prepare_engine("pyramid", stars, field_geometry(truth), wide, None)
    task = _IdentifyTask(frames, truth, stars, jobs, proposer)
    found, _ = run_tasks(
        task,
        len(jobs),
        caller=_CALLER,
        chunk=1,
        workers=workers,
        progress=progress,
        kept=kept,
        whole=True,
    )
    return found
