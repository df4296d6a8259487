"""Attitude errors of the field experiment, and what they consist of.

The error of a frame is the rotation from the true attitude to that of QUEST, about the camera's
axes x (pitch), y (yaw) and z (roll). It has three parts. *Noise* is what changes when the centroids
are put where the stars truly are. What is left then is the camera's: its mean over the frames is
the *common rotation*, which a calibration of the alignment takes out, and the *rest* differs from
frame to frame with the places of the stars.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.attitude.rotations import left_error, rotation_to_quaternion
from starcal_uq.attitude.wahba import quest
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import unproject
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.errors import CalibrationError, DistortionError
from starcal_uq.core.store import Kept
from starcal_uq.core.tasks import run_tasks
from starcal_uq.core.types import FloatArray, IntArray, Progress
from starcal_uq.identification.search import LEAST_SIGMA_PX
from starcal_uq.paper.field.frames import FieldFrames, FieldIdentification, true_pixels
from starcal_uq.paper.published import PAPER_METHODS

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations
    from starcal_uq.sky.catalogue import StarCatalogue

# What can be wrong with a camera, by itself.
SOURCES = ("principal point", "focal length", "distortion")
PARTS = ("rms", "aligned", "common", "rest", "noise")
_CHUNK = 4


@dataclass(frozen=True, eq=False)
class FieldStars:
    """Identified stars of frames, ready for QUEST; m stars in k frames.

    Places measured and true (m, 2), catalogue directions (m, 3), stated noise (m,) px per axis, the
    first star of each frame and their number (k + 1,), and true attitudes (k, 4).
    """

    xy_px: FloatArray
    true_px: FloatArray
    directions: FloatArray
    sigma_px: FloatArray
    starts: IntArray
    quaternions: FloatArray

    @property
    def n_frames(self) -> int:
        """Number of frames k."""
        return len(self.quaternions)

    @property
    def noise_scale(self) -> float:
        """Noise of the centroids over what is stated, from the truth; outliers do not count."""
        squared = np.sum((self.xy_px - self.true_px) ** 2, axis=1) / self.sigma_px**2
        # The median of chi-square with two degrees of freedom is 2 ln 2.
        return float(np.sqrt(np.median(squared) / (2.0 * np.log(2.0))))

    def frames(self, chosen: IntArray) -> FieldStars:
        """Some frames, in any order and number."""
        lengths = np.diff(self.starts)[chosen]
        rows = np.concatenate([np.arange(self.starts[k], self.starts[k + 1]) for k in chosen])
        return FieldStars(
            self.xy_px[rows],
            self.true_px[rows],
            self.directions[rows],
            self.sigma_px[rows],
            np.concatenate([[0], np.cumsum(lengths)]),
            self.quaternions[chosen],
        )


@dataclass(frozen=True, eq=False)
class AttitudeErrors:
    """Attitude errors of frames with one camera, arcsec; columns pitch, yaw, roll.

    `total` (k, 3) is against the true attitude, and `rms` (3,) its size; `aligned` its scatter
    about the mean, which is left when the alignment was calibrated with the same camera. The parts
    are `noise`, what centroid noise does; `common`, the rotation common to all frames without
    noise, with its sign; and the `rest`, what the camera does differently from frame to frame; all
    (3,).
    """

    total: FloatArray
    rms: FloatArray
    aligned: FloatArray
    common: FloatArray
    rest: FloatArray
    noise: FloatArray

    @property
    def sum_of_squares(self) -> FloatArray:
        """Root of the sum of the squared parts, (3,); `rms` up to the chance correlation of noise
        with the others.
        """
        return np.sqrt(self.common**2 + self.rest**2 + self.noise**2)


def identified_stars(
    frames: FieldFrames, truth: Camera, stars: StarCatalogue, found: FieldIdentification
) -> FieldStars | None:
    """The stars of the correctly identified frames; None where there is no such frame."""
    keep = found.correct[found.frame]
    frame, row, star = found.frame[keep], found.row[keep], found.star[keep]
    chosen = np.flatnonzero(found.correct)
    if not len(chosen):
        return None
    table = frames.centroids
    return FieldStars(
        np.column_stack([table.x_px[row], table.y_px[row]]),
        true_pixels(truth, frames.rotations[frame], stars.directions_icrs[star]),
        stars.directions_icrs[star],
        table.sigma_px[row],
        np.append(np.searchsorted(frame, chosen), len(frame)),
        rotation_to_quaternion(frames.rotations[chosen]),
    )


def attitude_errors(stars: FieldStars, camera: Camera) -> AttitudeErrors:
    """Attitudes by QUEST with a camera, against the truth, with and without noise."""
    weights = np.hypot(stars.sigma_px, LEAST_SIGMA_PX) / camera.focal_px
    b = np.stack([unproject(camera, stars.xy_px), unproject(camera, stars.true_px)])
    found = quest(b, stars.directions, stars.starts, sigma_rad=weights, covariance=False)
    total, exact = left_error(found.quaternions, stars.quaternions) * ARCSEC
    common = np.mean(exact, axis=0)
    return AttitudeErrors(
        total=total,
        rms=_rms(total),
        aligned=_rms(total - np.mean(total, axis=0)),
        common=common,
        rest=_rms(exact - common),
        noise=_rms(total - exact),
    )


def single_faults(truth: Camera, camera: Camera) -> dict[str, Camera]:
    """Cameras that have one of another camera's faults each, and are right otherwise; keys are
    `SOURCES`.
    """
    return {
        "principal point": truth.replace(x0_px=camera.x0_px, y0_px=camera.y0_px),
        "focal length": truth.replace(focal_mm=camera.focal_mm),
        "distortion": truth.replace(distortion=camera.distortion, coefficients=camera.coefficients),
    }


def _rms(error: FloatArray) -> FloatArray:
    size: FloatArray = np.sqrt(np.mean(error**2, axis=0))
    return size


@dataclass(frozen=True, eq=False)
class FieldReplicates:
    """Errors (n, 3) over repetitions by camera and part, arcsec, columns pitch, yaw, roll.

    The common rotation has its sign. A repetition in which a method failed is missing from its
    arrays.
    """

    draws: Mapping[str, Mapping[str, FloatArray]]

    def interval(self, camera: str, part: str) -> tuple[FloatArray, FloatArray]:
        """Ends (3,), (3,) of the range that 95 of 100 repetitions stay in; NaN without
        repetitions.
        """
        values = np.abs(self.draws[camera][part])
        if len(values) < 2:
            return np.full(3, np.nan), np.full(3, np.nan)
        low, high = np.quantile(values, (0.025, 0.975), axis=0)
        return low, high


@dataclass(frozen=True, eq=False)
class Repetition:
    """Calibration and test again with other noise, by number: {camera: {part: (3,)}}, without
    methods that failed.

    `campaign_px` (m, 2) is where the stars of the campaign truly are, `scale` its noise over what
    is stated, `tests` are the stars that each camera identified; those of the paper's methods are
    calibrated again from `nominal`.
    """

    campaign: Observations
    campaign_px: FloatArray
    scale: float
    nominal: Camera
    tests: Mapping[str, FieldStars]
    cameras: Mapping[str, Camera]
    seed: int

    def __call__(self, number: int) -> dict[str, dict[str, FloatArray]]:
        rng = np.random.default_rng([self.seed, 2, number])
        sigma = (
            np.ones(len(self.campaign_px))
            if self.campaign.sigma_px is None
            else self.campaign.sigma_px
        )
        xy = (
            self.campaign_px
            + rng.standard_normal(self.campaign_px.shape) * (self.scale * sigma)[:, None]
        )
        obs = replace(self.campaign, x_px=xy[:, 0], y_px=xy[:, 1])
        found = {}
        for index, (name, stars) in enumerate(self.tests.items()):
            camera = self.cameras[name]
            if name in PAPER_METHODS:
                try:
                    camera = calibrate(obs, self.nominal, method=name).camera
                except (CalibrationError, DistortionError):
                    continue
            # A source of its own for each camera: what one of them does leaves the others alone.
            rng = np.random.default_rng([self.seed, 3, number, index])
            chosen = rng.integers(stars.n_frames, size=stars.n_frames)
            errors = attitude_errors(stars.frames(chosen), camera)
            found[name] = {part: getattr(errors, part) for part in PARTS}
        return found


def replicate_field(
    repetition: Repetition,
    n_replicates: int,
    workers: int | None,
    progress: Progress | None,
    kept: Kept | None = None,
) -> FieldReplicates:
    """Every repetition; `FieldReplicates`."""
    results, _ = run_tasks(
        repetition,
        n_replicates,
        caller="field_experiment",
        chunk=_CHUNK,
        workers=workers,
        progress=progress,
        kept=kept,
        whole=True,
    )
    empty = np.empty((0, 3))
    return FieldReplicates(
        {
            name: {
                part: np.array([one[name][part] for one in results if name in one] or empty)
                for part in PARTS
            }
            for name in repetition.tests
        }
    )
