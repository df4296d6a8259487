"""Where a recursion starts: its first estimate, and how little is believed of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, undistorted
from starcal_uq.core.errors import CalibrationError, check_known
from starcal_uq.core.settings import PairCovariance, RecursiveMethod
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray, floats
from starcal_uq.estimation.stages import Search, Stage, optics_stage
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.recursive.filter import REACH_SIGMAS, FrameSums, Recursion
from starcal_uq.paper.recursive.innovations import PAIR_COVARIANCES

# What is believed of a start before the first star: next to nothing. A hundred frames outweigh it a
# million times.
_PRINCIPAL_POINT_WIDTHS = 1.0
_FOCAL_FRACTION = 0.3
_DISTORTION_WIDTHS = 0.08
# Noise that sets the weight of that belief where none is stated, px.
_REFERENCE_PX = 0.1
_START_ITERATIONS = 200


@dataclass(frozen=True)
class StartPrior:
    """What a recursion believes before its first frame."""

    # (p,): units of the parameters: 1 px for the optics, 1 px of displacement in the corner for a
    # coefficient.
    scale: FloatArray
    deviation: FloatArray  # (q,): standard deviations of the q estimated parameters, in those units
    reference_px: (
        float  # Noise that weighs them: as stated, px, or 1 where the stars state their own
    )


def prior_of(camera: Camera, options: RecursionOptions, per_star: bool) -> StartPrior:
    """Diffuse start for a camera; `per_star` where the stars state their own noise."""
    orders = [coefficient.order for coefficient in get_model(camera.distortion).coefficients]
    radius = camera.half_diagonal_px
    point, bent = _PRINCIPAL_POINT_WIDTHS * camera.width_px, _DISTORTION_WIDTHS * camera.width_px
    deviation = np.array([point, point, _FOCAL_FRACTION * camera.focal_px, *(bent for _ in orders)])
    stated = _REFERENCE_PX if options.sigma_px is None else options.sigma_px
    return StartPrior(
        scale=np.array([1.0, 1.0, 1.0, *(radius**-order for order in orders)]),
        deviation=deviation[:3] if options.parameters == "optics" else deviation,
        reference_px=1.0 if per_star else stated,
    )


def begin(
    method: str, camera: Camera, options: RecursionOptions, prior: StartPrior, frames: StarFrames
) -> tuple[Recursion, Stage | None]:
    """The recursion before its first frame, and the least-squares start of ``samaan``.

    ``samaan`` starts where least squares on the first of `frames` ends. It takes only the point
    from there, and filters these frames as the others, so that none counts twice. The coefficients
    start from zero. CalibrationError when the least-squares start fails.
    """
    p, q, reference = len(camera.theta), len(prior.deviation), prior.reference_px
    origin, stage = undistorted(camera.distortion, camera.theta), None
    if method == "samaan":
        first = frames.part(0, min(options.start_frames, frames.n_frames))
        stage = optics_stage(first, camera, Search("lm", _START_ITERATIONS))
        if stage.status in (Status.NOT_FINITE, Status.SINGULAR):
            raise CalibrationError(
                f"the least-squares start on {first.n_frames} frames failed ({stage.status.name})",
                stage.status,
                reason=(
                    "raise start_frames, or use method='griffith', which starts from the nominal "
                    "camera"
                ),
            )
        origin = stage.theta.copy()
    process = None
    if options.process_noise is not None:
        walk = np.broadcast_to(floats(options.process_noise), (q,))
        process = (walk / reference) ** 2
    covariance = np.diag((prior.deviation / reference) ** 2)
    recursion = Recursion(
        model_name=camera.distortion,
        origin=origin,
        scale=prior.scale,
        offset=np.zeros(q),
        point=np.zeros(q),
        covariance=covariance,
        start_covariance=covariance,
        reference_px=reference,
        pair_covariance=options.pair_covariance,
        process=process,
        forgetting=options.forgetting,
        iterations=options.iterations,
        starting=options.iterations > 1,
        sums=FrameSums.empty(p, options.pair_covariance == "diagonal"),
        response=np.zeros((3, p)),
        noise=np.zeros((3, 3)),
        reach_sigmas=REACH_SIGMAS[options.pair_covariance],
    )
    return recursion, stage


RECURSIVE_METHODS = get_args(RecursiveMethod)


@dataclass(frozen=True)
class RecursionOptions:
    """Settings of a recursive method (``samaan``, ``griffith``).

    Attributes
    ----------
    pair_covariance : {"full", "diagonal"}
        Covariance of the interstar angles of a frame: with the correlations of pairs that share a
        star, or, as in the historical filters, as if pairs were independent.
    parameters : {"optics", "all"}
        Parameters to estimate: x0, y0 and f as in its source, or the distortion as well
        (``griffith`` only).
    process_noise : float or tuple of float, optional
        ``samaan`` only: standard deviation of each parameter's random walk from frame to frame, px;
        needs a stated noise. One number stands for all three.
    forgetting : float
        ``griffith`` only: weight of all earlier frames against the next, in (0, 1]; 1 forgets
        nothing. It remembers about ``1 / (1 - forgetting)`` frames.
    start_frames : int
        ``samaan`` only: frames whose least-squares solution starts the filter.
    sigma_px : float, optional
        Stated centroid noise per axis, px, where the stars do not state their own.
    iterations : int
        Most linearisations of a frame; 1 is the plain filter, which takes each frame once,
        linearised where the frame before has ended. From a start far off it keeps the error of its
        first frames.
    """

    pair_covariance: PairCovariance = "full"
    parameters: str = "optics"
    process_noise: float | tuple[float, ...] | None = None
    forgetting: float = 1.0
    start_frames: int = 10
    sigma_px: float | None = None
    iterations: int = 12

    def check(self, method: str) -> None:
        """Refuse what makes no sense, by a `CalibrationError` with the remedy."""
        check_known("pair_covariance", self.pair_covariance, PAIR_COVARIANCES, CalibrationError)
        check_known("parameters", self.parameters, ("optics", "all"), CalibrationError)
        if not 0.0 < self.forgetting <= 1.0:
            raise CalibrationError(
                f"forgetting is {self.forgetting}: use a number above 0 and up to 1."
            )
        if self.sigma_px is not None and not 0.0 < self.sigma_px < np.inf:
            raise CalibrationError(f"sigma_px is {self.sigma_px}: use a positive number of pixels.")
        for name in ("start_frames", "iterations"):
            if getattr(self, name) < 1:
                raise CalibrationError(f"{name} is {getattr(self, name)}: use 1 or more.")
        if self.process_noise is not None:
            noise = np.atleast_1d(floats(self.process_noise))
            if noise.shape not in ((1,), (3,)) or not (
                np.isfinite(noise).all() and (noise >= 0.0).all()
            ):
                raise CalibrationError(
                    f"process_noise is {self.process_noise}: use one number of pixels per frame "
                    "that is not negative, "
                    "or three, for x0, y0 and f."
                )
        if method == "samaan":
            if self.parameters == "all":
                raise CalibrationError(
                    "samaan filters the optics only: use griffith for parameters='all'."
                )
            if self.forgetting != 1.0:
                raise CalibrationError(
                    "samaan forgets by process_noise: leave forgetting out, or use griffith."
                )
        elif self.process_noise is not None:
            raise CalibrationError("griffith has no process noise: use forgetting, or samaan.")
