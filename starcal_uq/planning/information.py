"""What frames will say about the camera before they are taken: the information of each, from
geometry alone.

Of a frame, a calibration needs to know where its stars will fall and how well each will be located.
The information on the parameters with the frame's attitude eliminated, the response of the attitude
to the parameters, and the attitude's own noise then follow from the likelihood that calibrates, at
the camera's own parameters and without noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import PlanningError
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.observations.frames import StarFrames
from starcal_uq.planning.effects import JointMatrices, PlannedEffects, SeenEffects
from starcal_uq.simulation.frames import Tracker
from starcal_uq.simulation.noise import noise_of

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.sky.catalogue import StarCatalogue

# An attitude needs this many stars before it says anything about the camera.
LEAST_STARS = 3


@dataclass(frozen=True, eq=False)
class FrameSet:
    """Frames that could be taken, without noise, and what each says. M frames, N stars, p
    parameters.

    `frames` are noise-free pixels, directions and the inverse of each star's noise, with magnitudes
    `mag` (N,); `information` (M, p, p) is that of each frame on the parameters, its attitude
    eliminated (px units), `response` (M, 3, p) the derivative of its attitude (pitch, yaw, roll;
    rad) with respect to them, and `noise` (M, 3, 3) the covariance of its attitude due to centroid
    noise, rad^2. With effects, their `seen` columns and what they say together, the coefficients of
    the run stand behind the parameters, and what a frame has for itself is eliminated.
    """

    camera: Camera
    rotations: FloatArray
    frames: StarFrames
    mag: FloatArray
    information: FloatArray
    response: FloatArray
    noise: FloatArray
    seen: SeenEffects | None = None
    joint: JointMatrices | None = None

    @property
    def n_frames(self) -> int:
        """Number M of frames."""
        return len(self.rotations)

    @property
    def n_stars(self) -> IntArray:
        """Stars per frame, (M,)."""
        return self.frames.sizes

    @property
    def mean_stars(self) -> float:
        """Stars per frame on average."""
        return float(np.mean(self.n_stars))

    @cached_property
    def common(self) -> FloatArray:
        """Common rotation (3, p): the mean of `response` over the frames."""
        common: FloatArray = self.response.mean(axis=0)
        return common

    @cached_property
    def rest(self) -> FloatArray:
        """What the attitude of each frame adds to the common rotation, (M, 3, p)."""
        return self.response - self.common

    def seen_within(self, fraction: float) -> FloatArray:
        """Information (M, p, p) of the stars in a middle part of the detector's area, a window of
        the detector's shape.

        A frame with fewer than three stars in it has none.
        """
        centre = np.array(self.camera.centre_px)[:, None]
        half = 0.5 * np.sqrt(fraction) * np.array([[self.camera.width_px], [self.camera.height_px]])
        inside = np.all(np.abs(self.frames.pixel - centre) <= half, axis=0)
        enough = self.frames.sum(inside.astype(np.float64)) >= LEAST_STARS
        kept = inside & np.repeat(enough, self.frames.sizes)
        information = np.zeros_like(self.information)
        if enough.any():
            at = self.camera, self.frames.select(kept), self.rotations[enough]
            if self.seen is None:
                information[enough] = frame_matrices(*at)[0]
            else:
                some = self.seen.of(enough).matrices(*at, self.mag[kept])
                information[enough] = some.information
        return information

    def with_noise(self, factor: float) -> FrameSet:
        """The same frames with so many times the centroid noise."""
        if self.seen is None:
            return replace(
                self, information=self.information / factor**2, noise=self.noise * factor**2
            )
        frames = replace(self.frames, weight=np.asarray(self.frames.weight) / factor)
        return replace(self, frames=frames).with_effects(self.seen)

    def with_effects(self, seen: SeenEffects) -> FrameSet:
        """The same frames for a calibration that holds effects."""
        joint = seen.matrices(self.camera, self.frames, self.rotations, self.mag)
        return replace(
            self,
            information=joint.information,
            response=joint.response,
            noise=joint.noise,
            seen=seen,
            joint=joint,
        )


def look_at(stars: StarCatalogue, tracker: Tracker, rotations: FloatArray) -> FrameSet:
    """The frames at given attitudes that show enough stars; the others are left out, and none is an
    error.
    """
    views = tracker.sky(stars).views(rotations)
    enough = np.array([len(seen) >= tracker.min_stars for seen, _ in views], dtype=np.bool_)
    if not enough.any():
        raise PlanningError(
            f"none of the {len(rotations)} candidate attitudes shows {tracker.min_stars} stars: "
            "give others, lower min_stars or use a deeper catalogue."
        )
    kept = [view for view, good in zip(views, enough, strict=True) if good]
    return _frame_set(stars, tracker, rotations[enough], kept)


def random_frames(
    stars: StarCatalogue,
    tracker: Tracker,
    *,
    n_frames: int,
    seed: int,
    effects: PlannedEffects | None = None,
) -> FrameSet:
    """Frames of a tracker at uniformly random attitudes, as `simulate` takes them; for a
    calibration with `effects`, at random temperatures and times.
    """
    rng = np.random.default_rng(seed)
    found = _frame_set(stars, tracker, *tracker.frames(stars, rng, n_frames))
    return found if effects is None else found.with_effects(effects.seen(n_frames, seed))


def _frame_set(
    stars: StarCatalogue,
    tracker: Tracker,
    rotations: FloatArray,
    views: list[tuple[IntArray, FloatArray]],
) -> FrameSet:
    index = np.concatenate([seen for seen, _ in views])
    camera, noise, mag = tracker.camera, tracker.noise, stars.mag[index]
    pixel = np.ascontiguousarray(np.concatenate([xy for _, xy in views]).T)
    frames = StarFrames(
        pixel=pixel,
        r=np.ascontiguousarray(stars.directions_icrs[index].T),
        weight=1.0 / noise_of(noise, mag, pixel),
        starts=np.concatenate([[0], np.cumsum([len(seen) for seen, _ in views])]).astype(np.int64),
        axes=noise.axes if isinstance(noise, NoiseModel) else None,
    )
    return FrameSet(camera, rotations, frames, mag, *frame_matrices(camera, frames, rotations))


def frame_matrices(
    camera: Camera, frames: StarFrames, rotations: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (M, p, p), attitude response (M, 3, p) and attitude noise (M, 3, 3) of noise-free
    frames.
    """
    likelihood = MarginalLikelihood(frames, camera.distortion, rotations)
    _, attitudes = likelihood.sums(camera.theta)
    gram, *_ = likelihood.frame_normals(camera.theta, attitudes.rotations)
    return (
        gram[:, :-1, :-1],
        attitudes.response.transpose(2, 0, 1),
        attitudes.inverse.transpose(2, 0, 1),
    )
