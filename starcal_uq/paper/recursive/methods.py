"""The methods that Ye & Yang 2017 compare theirs with, at full strength: least squares, Samaan's
and Griffith's.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import CalibrationError
from starcal_uq.estimation.assemble import (
    PairEstimate,
    assemble,
    check_count,
    check_noise,
    noise_px,
)
from starcal_uq.estimation.stages import Search, optics_stage
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations
from starcal_uq.paper.recursive.result import (
    distortion_after,
    joint_estimate,
    sums_at_estimate,
)
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.paper.recursive.stream import RecursiveCalibration

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration

# Frames of a stream that are taken together, for speed; the result does not depend on it.
_CHUNK = 64
# Stars of a second pass that are linearised together.
_PART_STARS = 4096


def least_squares(
    obs: Observations,
    camera: Camera,
    options: RecursionOptions | None,
    solver: str,
    max_iterations: int,
    /,
) -> Calibration:
    """Least squares over interstar angles for x0, y0 and f, the distortion ignored.

    The estimate is that of stage 1. The covariance is the sandwich over frames, which holds
    although the model is wrong and pairs are dependent: the spread over repeated data sets, not the
    distance from the truth.
    """
    plain = camera.replace(distortion=get_model(camera.distortion).bare)
    likelihood = MarginalLikelihood(obs, plain.distortion)
    check_count(likelihood, plain)
    frames = likelihood.frames
    stage = optics_stage(frames, plain, Search(solver, max_iterations))
    covariance = PairObjective(frames, plain.distortion).godambe(stage.theta)
    # A mirror or wrong stars, which interstar angles do not see.
    status = (
        check_noise(noise_px(likelihood, stage.theta), plain, stage.status)
        if stage.status.ok
        else stage.status
    )
    ignored = camera.distortion != plain.distortion
    settings = {"ignored_distortion": camera.distortion} if ignored else {}
    return assemble(
        obs,
        plain,
        likelihood,
        [stage],
        status,
        lambda: PairEstimate(stage.theta, covariance),
        {"method": "least_squares", "solver": solver} | settings,
    )


def recursive(
    method: str,
    obs: Observations | Iterable[Observations],
    camera: Camera,
    options: RecursionOptions | None,
    solver: str,
    max_iterations: int,
    /,
) -> Calibration:
    """Samaan's or Griffith's method, neither of which has a solver, on a table or a stream of
    frames.

    From a table the distortion of ``samaan`` is found in a second pass at the final optics, and the
    result has residuals and attitudes. From a stream it has none; the second pass takes place where
    the source can be read twice (a list, `stream_frames`), and an iterator has its running sums,
    brought to the final optics to first order.
    """
    filtering = RecursiveCalibration(camera, method, options)
    if not isinstance(obs, Observations):
        return _from_stream(filtering, obs)
    frames = StarFrames.from_observations(obs)
    likelihood = MarginalLikelihood(frames, filtering.nominal.distortion)
    check_count(likelihood, filtering.nominal)
    filtering.take(frames)
    recursion, stages, status = filtering.finish()
    sums = None
    if len(recursion.offset) < len(recursion.origin):
        sums = sums_at_estimate(
            recursion, (frames.part(*ends) for ends in frames.parts(_PART_STARS))
        )
    estimate = joint_estimate(recursion, sums)
    if sums is not None:
        stages.append(distortion_after(recursion, estimate, sums))
    status = (
        check_noise(noise_px(likelihood, estimate.theta), camera, status) if status.ok else status
    )
    return assemble(
        obs,
        filtering.nominal,
        likelihood,
        stages,
        status,
        lambda: PairEstimate(estimate.theta, estimate.covariance),
        filtering.settings(estimate, stream=False),
    )


samaan, griffith = partial(recursive, "samaan"), partial(recursive, "griffith")


def _from_stream(filtering: RecursiveCalibration, source: Iterable[Observations]) -> Calibration:
    for frames in _chunks(source):
        filtering.take(frames, fingerprint=True)
    recursion, _, _ = filtering.finish()
    sums = None
    if len(recursion.offset) < len(recursion.origin) and iter(source) is not source:
        sums = sums_at_estimate(recursion, _chunks(source))
    return filtering.result(throw=False, sums=sums)


def _chunks(source: Iterable[Observations]) -> Iterator[StarFrames]:
    """Some frames at a time."""
    pieces = iter(source)
    while chunk := list(islice(pieces, _CHUNK)):
        for piece in chunk:
            if not isinstance(piece, Observations):
                raise CalibrationError(
                    f"the stream of frames holds a {type(piece).__name__}: give Observations, or "
                    "stream_frames(path)."
                )
        yield StarFrames.joined([StarFrames.from_observations(piece) for piece in chunk])
