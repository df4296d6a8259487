"""Where a recursion starts: its first estimate, and how little is believed of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.recursive.filter import REACH_SIGMAS, Recursion
from starcal_uq.estimation.recursive.recursion_options import RecursionOptions
from starcal_uq.estimation.recursive.recursion_sums import FrameSums
from starcal_uq.estimation.stages import Stage, optics_stage
from starcal_uq.observations.frames import StarFrames

# What is believed of a start before the first star: next to nothing. A hundred frames outweigh it a million times.
_PRINCIPAL_POINT_WIDTHS = 1.0
_FOCAL_FRACTION = 0.3
_DISTORTION_WIDTHS = 0.08
# Noise that sets the weight of that belief where none is stated, px.
_REFERENCE_PX = 0.1
_START_ITERATIONS = 200


@dataclass(frozen=True)
class StartPrior:
    """What a recursion believes before its first frame.

    Attributes
    ----------
    scale : (p,) array
        Units of the parameters: 1 px for the optics, 1 px of displacement in the corner for a coefficient.
    deviation : (q,) array
        Standard deviations of the q estimated parameters, in those units.
    reference_px : float
        Noise that weighs them: as stated, px, or 1 where the stars state their own.
    """

    scale: FloatArray
    deviation: FloatArray
    reference_px: float


def prior_of(camera: Camera, options: RecursionOptions, per_star: bool) -> StartPrior:
    """Diffuse start for a camera; `per_star` where the stars state their own noise."""
    orders = [coefficient.order for coefficient in get_model(camera.distortion).coefficients]
    radius = float(np.hypot(camera.width_px, camera.height_px)) / 2.0
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
    """The recursion before its first frame.

    Parameters
    ----------
    method : {"griffith", "samaan"}
        ``samaan`` starts where least squares on the first of `frames` ends. It takes only the point from there, and
        filters these frames as the others, so that none counts twice.
    camera : Camera
        Start values; the coefficients start from zero.
    options : RecursionOptions
        Options.
    prior : StartPrior
        As from `prior_of`.
    frames : StarFrames
        First frames.

    Returns
    -------
    Recursion
        With no frame taken.
    Stage or None
        The least-squares start of ``samaan``.

    Raises
    ------
    CalibrationError
        When the least-squares start fails.
    """
    p, q, reference = len(camera.theta), len(prior.deviation), prior.reference_px
    origin, stage = np.concatenate([camera.theta[:3], np.zeros(p - 3)]), None
    if method == "samaan":
        first = frames.part(0, min(options.start_frames, frames.n_frames))
        stage = optics_stage(first, camera, "lm", _START_ITERATIONS)
        if stage.status in (Status.NOT_FINITE, Status.SINGULAR):
            raise CalibrationError(
                f"the least-squares start on {first.n_frames} frames failed ({stage.status.name}): "
                "raise start_frames, or use method='griffith', which starts from the nominal camera.",
                stage.status,
            )
        origin = stage.theta.copy()
    process = None
    if options.process_noise is not None:
        walk = np.broadcast_to(np.asarray(options.process_noise, dtype=np.float64), (q,))
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
