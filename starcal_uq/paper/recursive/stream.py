"""Calibration of a stream of frames: each is used once and forgotten, and the state can be saved in
between.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.display import public_names
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.files import reading
from starcal_uq.core.records import to_plain
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray, PathLike
from starcal_uq.estimation.assemble import IMPLAUSIBLE_NOISE, noise_px, raise_unless_good
from starcal_uq.estimation.stages import Stage
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.recursive.filter import FrameSums, Recursion
from starcal_uq.paper.recursive.result import (
    JointEstimate,
    distortion_after,
    filter_stage,
    joint_estimate,
    stream_calibration,
)
from starcal_uq.paper.recursive.start import (
    RECURSIVE_METHODS,
    RecursionOptions,
    begin,
    prior_of,
)
from starcal_uq.paper.recursive.state import REMEDY, WHAT, State, read_state, write_state

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations


@dataclass(frozen=True)
class FilterStep:
    """The state of a recursive calibration after a frame.

    Attributes
    ----------
    parameter_names : tuple of str
        Names of the q parameters that the recursion estimates.
    theta : (q,) array
        Estimate, px units.
    covariance : (q, q) array
        The covariance that the filter claims, px units: right if its model of the camera and of the
        pairs is.
    sigma : float
        Noise, px or a factor on the stated noise: from the innovations so far, or as stated while
        there are few.
    chi2 : float
        Sum of whitened innovations so far, px^2 or in units of the stated noise.
    dof : float
        How many numbers `chi2` sums, less the parameters.
    n_frames, n_stars : int
        Seen so far.
    """

    parameter_names: tuple[str, ...]
    theta: FloatArray
    covariance: FloatArray
    sigma: float
    chi2: float
    dof: float
    n_frames: int
    n_stars: int

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviation of each parameter, (q,)."""
        return root_diagonal(self.covariance)


class RecursiveCalibration:
    """Calibrate from frames as they come.

    Parameters
    ----------
    camera : Camera
        Start values; its `distortion` names the model. The coefficients start from zero.
    method : {"griffith", "samaan"}
        ``griffith`` (Griffith & Junkins): recursive least squares from the start values. ``samaan``
        (Samaan et al. 2001): a Kalman filter from the least-squares solution of the first frames,
        which wait until there are ``options.start_frames`` of them; the distortion follows at the
        end by linear least squares.
    options : RecursionOptions, optional
        The defaults otherwise.

    Raises
    ------
    CalibrationError
        For an unknown method, or options that the method does not have.
    """

    __dir__ = public_names

    def __init__(
        self, camera: Camera, method: str = "griffith", options: RecursionOptions | None = None
    ) -> None:
        if method not in RECURSIVE_METHODS:
            raise CalibrationError(
                f"method {method!r} is not recursive: use one of {', '.join(RECURSIVE_METHODS)}."
            )
        self.options = options or RecursionOptions()
        self.options.check(method)
        self.method = method
        keeps_distortion = method == "samaan" or self.options.parameters == "all"
        bare = get_model(camera.distortion).bare
        self.nominal = camera if keeps_distortion else camera.replace(distortion=bare)
        self._given_distortion = camera.distortion
        self._recursion: Recursion | None = None
        self._start_stage: Stage | None = None
        self._waiting: StarFrames | None = None
        self._per_star: bool | None = None
        self._richest: StarFrames | None = None
        self._digest = ""
        self._seconds = 0.0

    @property
    def n_frames(self) -> int:
        """Frames seen, waiting ones included."""
        waiting = 0 if self._waiting is None else self._waiting.n_frames
        return waiting + (0 if self._recursion is None else self._recursion.n_frames)

    @property
    def camera(self) -> Camera:
        """The estimate so far; for ``samaan`` with the distortion that follows from the sums so
        far.
        """
        if self._recursion is None:
            return self.nominal
        try:
            return self.nominal.with_theta(joint_estimate(self._recursion).theta)
        except CalibrationError:
            return self.nominal.with_theta(self._recursion.theta)

    @property
    def step(self) -> FilterStep:
        """The state now."""
        recursion = self._recursion
        if recursion is None:
            prior = prior_of(self.nominal, self.options, bool(self._per_star))
            q = len(prior.deviation)
            scale = prior.scale[: len(prior.deviation)]
            sigma = prior.reference_px
            theta = self.nominal.theta[:q]
            covariance, chi2, dof, stars = np.diag((scale * prior.deviation) ** 2), 0.0, 0.0, 0
        else:
            q = len(recursion.offset)
            theta, sigma, chi2 = recursion.theta[:q], recursion.sigma, recursion.chi2
            scale = recursion.scale[:q]
            covariance = sigma**2 * recursion.covariance * np.outer(scale, scale)
            dof, stars = recursion.numbers - q, recursion.n_stars
        if self._waiting is not None:
            stars += self._waiting.n_stars
        names = self.nominal.parameter_names[:q]
        return FilterStep(names, theta, covariance, sigma, chi2, dof, self.n_frames, stars)

    def update(self, frame: Observations) -> FilterStep:
        """Take in one frame, or several in their order.

        Parameters
        ----------
        frame : Observations
            Stars of the next frame or frames. What is kept are sums, and the one frame with the
            most stars, which guards against mirrored axes.

        Returns
        -------
        FilterStep
            Estimate and covariance after them.

        Raises
        ------
        CalibrationError
            When stars state their own noise in some frames only, or process noise has no stated
            noise to go with.
        """
        self.take(StarFrames.from_observations(frame), fingerprint=True)
        return self.step

    def take(self, frames: StarFrames, *, fingerprint: bool = False) -> None:
        """As `update`, for arrays; `fingerprint` adds the frames to the hash of the data."""
        began = perf_counter()
        self._check_noise(frames)
        self._keep_richest(frames)
        if fingerprint:
            self._hash(frames)
        if self._recursion is None:
            waiting = (
                frames if self._waiting is None else StarFrames.joined([self._waiting, frames])
            )
            if self.method == "samaan" and waiting.n_frames < self.options.start_frames:
                self._waiting = waiting
                self._seconds += perf_counter() - began
                return
            frames = waiting
        self._filter(frames)
        self._seconds += perf_counter() - began

    def _filter(self, frames: StarFrames) -> None:
        self._waiting = None
        if self._recursion is None:
            start = prior_of(self.nominal, self.options, bool(self._per_star))
            self._recursion, self._start_stage = begin(
                self.method, self.nominal, self.options, start, frames
            )
        self._recursion.advance(frames)

    def _keep_richest(self, frames: StarFrames) -> None:
        """Remember the frame with the most stars: interstar angles do not see a mirror, its
        positions do.
        """
        index = int(np.argmax(frames.sizes))
        if self._richest is None or frames.sizes[index] > self._richest.n_stars:
            # A copy, because a part would keep all the frames in memory that came with it.
            self._richest = frames.select(
                np.repeat(np.arange(frames.n_frames) == index, frames.sizes)
            )

    def _check_noise(self, frames: StarFrames) -> None:
        per_star = frames.weight is not None
        if self._per_star is None:
            self._per_star = per_star
            if per_star and self.options.sigma_px is not None:
                raise CalibrationError(
                    "the stars state their own noise (column sigma_px): leave sigma_px out."
                )
            if (
                self.options.process_noise is not None
                and not per_star
                and self.options.sigma_px is None
            ):
                raise CalibrationError(
                    "process noise needs a stated noise to be weighed against: give sigma_px, or "
                    "a column sigma_px."
                )
        if per_star is not self._per_star:
            raise CalibrationError(
                "some frames state the noise of their stars and others do not: give the column "
                "sigma_px in all or none."
            )

    def _hash(self, frames: StarFrames) -> None:
        """A chain of hashes, frame by frame: the same however the frames are grouped into
        updates.
        """
        for start, stop in zip(frames.starts[:-1], frames.starts[1:], strict=True):
            digest = hashlib.sha256(self._digest.encode())
            for values in (frames.pixel, frames.r, frames.weight):
                if values is not None:
                    digest.update(np.ascontiguousarray(values[..., start:stop]).tobytes())
            self._digest = digest.hexdigest()

    def finish(self) -> tuple[Recursion, list[Stage], Status]:
        """Filter what still waits; the recursion, its stages and how it ended."""
        if self._waiting is not None:
            self._filter(self._waiting)
        if self._recursion is None:
            raise CalibrationError(
                "there is no frame yet", Status.SINGULAR, reason="give frames to update() first"
            )
        stage = filter_stage(self._recursion, self._seconds)
        stages = [stage] if self._start_stage is None else [self._start_stage, stage]
        return self._recursion, stages, self._plausible(stage.status)

    def _plausible(self, status: Status) -> Status:
        recursion, limit = self._recursion, IMPLAUSIBLE_NOISE * self.nominal.width_px
        if recursion is None or self._richest is None:
            return status
        positions = noise_px(
            MarginalLikelihood(self._richest, recursion.model_name), recursion.theta
        )
        wrong = positions > limit or (not self._per_star and recursion.sigma > limit)
        return Status.INCONSISTENT if wrong else status

    def settings(self, estimate: JointEstimate, *, stream: bool) -> AnyDict:
        """For the provenance; `stream` where the frames are gone."""
        settings: AnyDict = {
            "method": self.method,
            "solver": "filter",
            "distortion": self.nominal.distortion,
            "recursion": to_plain(self.options),
            "covariance": estimate.source,
            "stream": stream,
        }
        if self._given_distortion != self.nominal.distortion:
            settings["ignored_distortion"] = self._given_distortion
        return settings

    def result(self, *, throw: bool = True, sums: FrameSums | None = None) -> Calibration:
        """The calibration so far; more frames may follow.

        Parameters
        ----------
        throw : bool
            Raise when the estimate is not good; otherwise `Calibration.status` says so.
        sums : FrameSums, optional
            Sums of a second pass over the frames (``samaan``); the sums of the first pass
            otherwise.

        Returns
        -------
        Calibration
            With empty arrays over frames and stars, because these are gone.

        Raises
        ------
        CalibrationError
            When there are too few stars, or, with `throw`, when the status is not CONVERGED.
        """
        recursion, stages, status = self.finish()
        estimate = joint_estimate(recursion, sums)
        if len(recursion.offset) < len(recursion.origin):
            stages.append(distortion_after(recursion, estimate, sums))
        calibration = stream_calibration(
            recursion,
            self.nominal,
            self.method,
            stages,
            status,
            self.settings(estimate, stream=True),
            self._digest or None,
            bool(self._per_star),
            estimate,
        )
        if throw:
            raise_unless_good(calibration.status, calibration.remedy)
        return calibration

    def save(self, path: PathLike) -> None:
        """Write the state to a file (``.npz``), atomically; `load` continues from it.

        Raises
        ------
        RunFolderError
            When the file cannot be written.
        """
        state = State(
            self.method,
            self.options,
            self.nominal,
            self._given_distortion,
            self._per_star,
            self._digest,
            self._seconds,
            self._waiting,
            self._richest,
            self._start_stage,
            self._recursion,
        )
        write_state(state, path)

    @classmethod
    def load(cls, path: PathLike) -> RecursiveCalibration:
        """Inverse of `save`.

        Raises
        ------
        RunFolderError
            When the file is missing, truncated, or something else.
        """
        state = read_state(path)
        with reading(path, WHAT, REMEDY):
            loaded = cls(state.nominal, state.method, state.options)
        loaded._given_distortion, loaded._per_star = state.given_distortion, state.per_star
        loaded._digest, loaded._seconds = state.digest, state.seconds
        loaded._waiting, loaded._richest = state.waiting, state.richest
        loaded._start_stage, loaded._recursion = state.stage, state.recursion
        return loaded
