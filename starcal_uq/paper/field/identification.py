"""Identification of the field experiment's frames, as a star tracker in flight would do it, and whether it is right.

A star tracker in flight holds its camera for right: each frame is identified for itself with tolerances that are the
same whatever the camera. `Tolerances` of a number of pixels mean that the camera may misplace a star in the corner of
the field by so much, by its focal length or by its distortion, and the principal point by so much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import project
from starcal_uq.core.tasks import Progress
from starcal_uq.core.types import BoolArray, FloatArray, IntArray
from starcal_uq.identification.proposers import Proposer, prepare_engine
from starcal_uq.identification.pyramid import CameraTolerance
from starcal_uq.identification.search import FrameTable, Search, field_geometry
from starcal_uq.paper.commands import run_or_stop
from starcal_uq.paper.field.frames import FieldFrames

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

# A star is wrong if it truly is farther than this from the centroid that was given its name.
WRONG_PX = 3.0


@dataclass(frozen=True, eq=False)
class FieldIdentification:
    """Every frame identified with one camera and one tolerance.

    Of each of m stars that were named there is its frame, its row in the table of centroids and in the catalogue;
    `correct` and `wrong` (n,) mark frames with an attitude and no wrong star, and with one.
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
        # `identify` would try failed frames again with wider tolerances and refine the camera over all frames.
        search = Search(camera, self.stars, corner_tolerance(camera, tolerance_px), self.proposer)
        n = len(field.ids)
        matches = [search.frame(field, k).match for k in range(n)]
        solved = [(k, match) for k, match in enumerate(matches) if match is not None]
        empty = [np.empty(0, dtype=np.int64)]
        frame = np.repeat([k for k, _ in solved], [len(match) for _, match in solved]).astype(np.int64)
        row = np.concatenate([field.rows[k][match.centroid] for k, match in solved] or empty)
        star = np.concatenate([match.star for _, match in solved] or empty)
        table = self.frames.centroids
        place = true_pixels(self.truth, self.frames.rotations[frame], self.stars.directions_icrs[star])
        # Nowhere near is also wrong.
        bad = ~(np.hypot(table.x_px[row] - place[:, 0], table.y_px[row] - place[:, 1]) <= WRONG_PX)
        wrong = np.bincount(frame[bad], minlength=n) > 0
        correct = (np.bincount(frame, minlength=n) > 0) & ~wrong
        return FieldIdentification(camera, tolerance_px, frame, row, star, correct, wrong)


def true_pixels(truth: Camera, rotations: FloatArray, directions: FloatArray) -> FloatArray:
    """Where stars (m, 3) truly are under attitudes (m, 3, 3): (m, 2), NaN for those behind the camera."""
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
) -> list[FieldIdentification]:
    """Identify the frames once for each job (camera, tolerance in px)."""
    # One set of pairs serves all cameras, whose fields differ little.
    wide = CameraTolerance(0.03, 0.0, 0.0)
    proposer = prepare_engine("pyramid", stars, field_geometry(truth), wide, False, None)
    task = _IdentifyTask(frames, truth, stars, jobs, proposer)
    return run_or_stop(task, len(jobs), chunk=1, workers=workers, progress=progress)
