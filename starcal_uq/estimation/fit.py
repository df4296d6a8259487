"""Stages and refinement on observations in memory: what a likelihood makes of them, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from starcal_uq.attitude.wahba import DegenerateFrameError
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, undistorted
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.assemble import (
    IMPLAUSIBLE_NOISE,
    PairEstimate,
    Way,
    assemble,
    calibration_at,
    check_count,
    check_noise,
    failed,
    noise_of,
    noise_px,
    peak_near,
    raise_unless_good,
)
from starcal_uq.estimation.consensus import rough_attitudes
from starcal_uq.estimation.kept import KeptFrames
from starcal_uq.estimation.noise_model import Refit, Refitting, fit_noise, without_tails
from starcal_uq.estimation.result import Calibration, check_camera
from starcal_uq.estimation.robust import compress_reweighted, refine, robust_start
from starcal_uq.estimation.settings import EstimationSettings
from starcal_uq.estimation.stages import (
    REFINEMENT_TOLERANCE,
    Search,
    Stage,
    begun_on_sample,
    direct_stage,
    distortion_stage,
    focal_stage,
    joint_stage,
    optics_stage,
    refinement_stage,
)
from starcal_uq.estimation.undetermined import EXPLAINED, coma_record, undetermined
from starcal_uq.likelihood.composite import enough_frames, pair_covariance
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.noise_model import NoiseModel
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.likelihood.solvers import is_singular
from starcal_uq.likelihood.student import DEFAULT_DOF, parse_dof
from starcal_uq.maths.linear import scaled_inverse
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.splits import one_of_each
from starcal_uq.observations.table import Observations

# Stage 1 that moves the principal point by more than this fraction of the width has met strong
# distortion.
_FAR = 0.05
# Stars whose residuals are below this, px per axis, are identified correctly.
_PLAIN_NOISE_PX = 1.0
# Frames and stars of a sample that is near enough to the minimum of all.
_SAMPLE_FRAMES, _SAMPLE_STARS = 150, 2500
# Stages that nobody reads need only lead to the next: to other stages, and to steps on all frames.
_LEADING, _NEARLY = (Search(tolerance=gain, seen=False) for gain in (1e-4, 0.1))
# Standard deviations of the last step: of the estimate from interstar angles of all frames, which
# is then known to a thousandth of that, and of the refinement, which is left to Newton's method on
# the expansion: a few 1e-9 of them.
_LAST_PAIR_STEP, _LAST_STEP = 0.05, 0.006


def fit_weighed(obs: Observations, camera: Camera, settings: EstimationSettings) -> Calibration:
    """Calibrate with a nominal camera, with the effects ``noise`` and ``tails`` of the settings.

    Weights that the table has from another result's noise model are what its stars state.
    CalibrationError when there is no estimate.
    """
    fitted = _robust_fit if settings.tails else _gaussian_fit
    if not settings.noise:
        return fitted(obs, camera, settings)
    obs = obs.unweighted
    calibration = fitted(obs, camera, settings)
    if not calibration.status.ok:
        return calibration
    model, weighted = _with_noise_model(obs, camera, calibration, settings)
    return replace(weighted, provenance=weighted.provenance.adding(noise_model=model.record()))


def _gaussian_fit(obs: Observations, camera: Camera, settings: EstimationSettings) -> Calibration:
    likelihood = MarginalLikelihood(obs, camera.distortion)
    check_count(likelihood, camera)
    pairs = PairObjective(likelihood.frames, camera.distortion)
    search = Search(settings.solver, settings.max_iterations)
    made = settings.made
    refinement = None
    if settings.method == "efficient":
        refinement = replace(search, tolerance=_gain(likelihood, _LAST_STEP), seen=False)
        # A solver and a limit of the iterations are those of every stage.
        near = _near(likelihood, camera) if search == Search() else None
        peak = near and peak_near(likelihood, near.theta)
        if near and peak and noise_of(peak.normal.cost, likelihood.frames) <= _PLAIN_NOISE_PX:
            way = partial(_way, pairs, camera, search, refinement, near)
            found = calibration_at(obs, camera, likelihood, peak, near.status, way, made)
            if found.status.ok:
                return found
    stages, status = _stages(pairs, camera, likelihood, search, refinement)
    estimate = partial(_pair_estimate, pairs, likelihood, stages)
    return assemble(obs, camera, likelihood, stages, status, estimate, made)


def _near(likelihood: MarginalLikelihood, camera: Camera) -> Stage | None:
    """The refinement from a nominal camera, on a sample of the frames where that saves time; None
    where it strays.
    """
    own = MarginalLikelihood(_sample(likelihood.frames), camera.distortion)
    search = _LEADING
    if own.frames is not likelihood.frames:
        search = _NEARLY
        _begin(own, camera.theta)
    stage = refinement_stage(own, camera.theta, search)
    if _strayed(stage, camera):
        return None
    if search is _NEARLY:
        _begin(likelihood, stage.theta)
    return stage


def _begin(likelihood: MarginalLikelihood, theta: FloatArray) -> None:
    """Start attitude searches from two stars of each frame at theta (p,), where these tell all
    attitudes: one step from there finds the best ones.
    """
    rotations = rough_attitudes(likelihood.frames, likelihood.model_name, theta)
    if np.isfinite(rotations).all():
        likelihood.use_rotations(rotations)


def _way(
    pairs: PairObjective, camera: Camera, search: Search, refinement: Search, near: Stage
) -> Way:
    """Stages to an estimate through interstar angles, or else from `near`."""
    own = MarginalLikelihood(pairs.frames, camera.distortion)
    try:
        stages, _ = _stages(pairs, camera, own, search, refinement)
    except DegenerateFrameError:
        none = np.full((len(near.theta), len(near.theta)), np.nan)
        return [near], PairEstimate(none[0], none)
    last = [] if stages[-1].name == near.name else [near]
    return stages + last, _pair_estimate(pairs, own, stages)


def _pair_estimate(
    pairs: PairObjective, likelihood: MarginalLikelihood, stages: Sequence[Stage]
) -> PairEstimate:
    pair_theta = [stage.theta for stage in stages if stage.name != "refinement"][-1]
    # The scatter of many frames needs no noise.
    chi2 = (
        np.nan if enough_frames(pairs) else likelihood.profile(pair_theta, likelihood.rotations)[1]
    )
    # The last step was not followed by an evaluation.
    near = _gain(likelihood, _LAST_PAIR_STEP)
    covariance = pair_covariance(pairs, pair_theta, chi2, likelihood.dof - len(pair_theta), near)
    return PairEstimate(pair_theta, covariance)


@one_thread()
def refit(obs: Observations, cal: Calibration, model: str) -> tuple[FloatArray, FloatArray]:
    """Estimate (p,), px units, of another distortion model on the same stars, from the optics and
    attitudes of a calibration, and the best attitudes (K, 3, 3) there.

    CalibrationError when neither they nor the nominal camera lead to an estimate.
    """
    likelihood = MarginalLikelihood(obs, model, cal.rotations)
    start = cal.nominal.replace(distortion=model)
    start = start.with_theta(undistorted(model, start.theta))
    check_count(likelihood, start)
    theta = cal.camera.replace(distortion=model).theta
    search = Search(tolerance=_gain(likelihood, _LAST_STEP), seen=False)
    stage = refinement_stage(likelihood, theta, search)
    if check_camera(start.with_theta(stage.theta), stage.status).ok:
        sums, attitudes = likelihood.sums(stage.theta)
        noise = noise_of(sums.normal.cost, likelihood.frames)
        if check_noise(noise, start, stage.status).ok:
            return stage.theta, attitudes.rotations
    found = _gaussian_fit(obs, start, EstimationSettings())
    raise_unless_good(found.status)
    return found.theta, found.rotations


def _gain(likelihood: MarginalLikelihood, step: float) -> float:
    """Relative gain of a step of so many standard deviations."""
    return step**2 / max(likelihood.dof, 1)


def _stages(
    pairs: PairObjective,
    camera: Camera,
    likelihood: MarginalLikelihood,
    search: Search,
    refinement: Search | None,
) -> tuple[list[Stage], Status]:
    """All stages of a Gaussian fit, and how they ended: those on interstar angles by one search,
    the refinement, if there is one, by another.
    """
    stages: list[Stage] = []
    if refinement is not None and search.solver == "lm":
        near = replace(search, tolerance=_gain(likelihood, _LAST_PAIR_STEP), seen=False)
        stages = _sampled_stages(pairs, camera, near)
    stages = stages or _pair_stages(pairs, camera, search)
    most = IMPLAUSIBLE_NOISE * camera.width_px
    noise = _noise_at(pairs, likelihood, stages[-1].theta)
    if _strayed(stages[-1], camera) or noise > most:
        # In a field of few degrees interstar angles hardly see the principal point, and where stars
        # state very unequal noise they go by the worst ones; positions lead to the estimate from
        # the nominal optics in a few steps.
        own = MarginalLikelihood(likelihood.frames, camera.distortion)
        direct = direct_stage(own, camera, search.max_iterations)
        if direct.status.ok:
            if search.seen or noise_px(own, direct.theta) > noise:
                again = joint_stage(pairs, camera, direct.theta, search)
                stages[-1] = min(stages[-1], again, key=_badness)
                noise = _noise_at(pairs, likelihood, stages[-1].theta)
            if refinement is not None and noise_px(own, direct.theta) <= min(noise, most):
                likelihood.use_sums(*own.sums(direct.theta))
                return [*stages, direct], direct.status
    # Interstar angles do not see a mirror, nor does their noise show a few wrong stars; positions
    # do.
    status = check_noise(noise, camera, stages[-1].status)
    if status.ok and refinement is not None:
        stages.append(refinement_stage(likelihood, stages[-1].theta, refinement))
        status = stages[-1].status
    return stages, status


def _noise_at(pairs: PairObjective, likelihood: MarginalLikelihood, theta: FloatArray) -> float:
    rotations = pairs.rotations_at(theta)
    likelihood.use_rotations(likelihood.start_rotations(theta) if rotations is None else rotations)
    return noise_px(likelihood, theta)


def _strayed(stage: Stage, camera: Camera) -> bool:
    """Whether a stage did not converge, or ended far from the nominal principal point."""
    return not stage.status.ok or _far(stage, camera)


def _far(stage: Stage, camera: Camera) -> bool:
    return float(np.max(np.abs(stage.theta[:2] - camera.theta[:2]))) > _FAR * camera.width_px


def _with_noise_model(
    obs: Observations, camera: Camera, calibration: Calibration, settings: EstimationSettings
) -> tuple[NoiseModel, Calibration]:
    """How the noise varies, and the calibration with the weights that follow; even noise changes
    nothing.
    """
    max_iterations = settings.max_iterations
    refit = (
        _with_tails(calibration, max_iterations)
        if settings.tails
        else without_tails(calibration.camera, max_iterations)
    )
    model, theta = fit_noise(obs, calibration.camera, refit)
    if not model.varies:
        return model, calibration
    obs = obs.weighted(model.sigma_px(obs), model.axes)
    if settings.tails:
        return model, _robust_fit(obs, camera, settings)
    likelihood = MarginalLikelihood(obs, camera.distortion)
    # The estimate from interstar angles has no weights; its covariance and the refinement do.
    search = Search(max_iterations=max_iterations, tolerance=REFINEMENT_TOLERANCE)
    stages = [*calibration.stages[:-1], refinement_stage(likelihood, theta, search)]
    pairs = PairObjective(likelihood.frames, camera.distortion)
    estimate = partial(_pair_estimate, pairs, likelihood, stages)
    made = settings.made
    return model, assemble(obs, camera, likelihood, stages, stages[-1].status, estimate, made)


def _with_tails(cal: Calibration, max_iterations: int) -> Refitting:
    """The fit of stars whose residuals have tails."""
    nu = cal.provenance.settings["dof"]

    def refit(frames: StarFrames, theta: FloatArray, turn: int) -> Refit | None:
        found = refine(
            frames,
            cal.camera.distortion,
            theta,
            cal.rotations,
            None if nu == "free" else nu,
            max_iterations,
        )
        if not found.stage.status.ok:
            return None
        return Refit(found.stage.theta, found.state.weight, found.nu)

    return refit


def _robust_fit(obs: Observations, camera: Camera, settings: EstimationSettings) -> Calibration:
    search = Search(settings.solver, settings.max_iterations)
    nu = None if settings.dof is None else parse_dof(settings.dof, CalibrationError)
    frames = StarFrames.from_observations(obs)
    check_count(MarginalLikelihood(frames, camera.distortion), camera)
    model = camera.distortion

    def fit(trusted: StarFrames, all_parameters: bool) -> list[Stage]:
        if not all_parameters:
            stage = optics_stage(trusted, camera, search)
            most = search.max_iterations
            return [stage if stage.status.ok else focal_stage(trusted, camera, most)]
        pairs = PairObjective(trusted, model)
        stages = _pair_stages(pairs, camera, search)
        if _strayed(stages[-1], camera):
            own = MarginalLikelihood(trusted, model)
            direct = direct_stage(own, camera, search.max_iterations)
            noise = _noise_at(pairs, MarginalLikelihood(trusted, model), stages[-1].theta)
            if direct.status.ok and not (
                stages[-1].status.ok and noise < noise_px(own, direct.theta)
            ):
                stages[-1] = replace(direct, name=stages[-1].name)
        return stages

    try:
        start = robust_start(frames, model, camera.theta, fit)
    except CalibrationError as error:
        if error.status is None or error.status not in EXPLAINED:
            raise
        raise failed(
            MarginalLikelihood(frames, model), camera.theta, camera, error.status
        ) from None
    pair_theta = start.stages[-1].theta
    found = refine(frames, model, pair_theta, start.rotations, nu, search.max_iterations)
    if settings.dof is None and found.nu < DEFAULT_DOF:
        nu = DEFAULT_DOF
        near = found.stage.theta
        found = refine(frames, model, near, found.state.rotations, nu, search.max_iterations)
    theta = found.stage.theta
    sigma = found.sigma
    state = found.state
    information = found.information
    status = found.stage.status
    if (
        not np.isfinite(state.value)
        or is_singular(information.matrix)
        or is_singular(found.covariance)
    ):
        reason = status if not status.ok else Status.SINGULAR
        raise failed(MarginalLikelihood(start.frames, model), theta, camera, reason)
    status = check_camera(camera.with_theta(theta), status)
    gaussian = MarginalLikelihood(start.frames, model)
    matrix = scaled_inverse(found.covariance) * sigma**2
    names, factors = undetermined(gaussian, theta, matrix, sigma, camera, status)
    made: AnyDict = {"method": "efficient", "solver": search.solver, "distortion": model}
    student: AnyDict = {
        "dof": found.nu,
        "dof_std": found.nu_std,
        "stars_out_of_field": int(np.sum(~state.seen)),
    }
    pairs = PairObjective(start.frames, model)
    return Calibration.of(
        camera,
        KeptFrames.of(obs, frames, state.rotations, state.e, camera),
        made | {"likelihood": "student_t", "dof": "free" if nu is None else nu},
        theta=theta,
        sigma=sigma,
        dof=state.dof - len(theta),
        status=Status.SINGULAR if names else status,
        record=coma_record(camera, factors) | {"student_t": student},
        covariance=found.covariance * np.outer(factors, factors),
        sigma_std=found.sigma_std,
        stages=(*start.stages, found.stage),
        undetermined=names,
        chi2=float(np.sum(state.weight * state.e**2)),
        information=information.matrix,
        rotation_per_theta=information.rotation_per_theta,
        attitude_noise=information.attitude_noise,
        pair_theta=pair_theta,
        pair_covariance=_pair_estimate(pairs, gaussian, start.stages).covariance,
        compressed=compress_reweighted(found),
    )


def _sampled_stages(pairs: PairObjective, camera: Camera, search: Search) -> list[Stage]:
    """The stages on interstar angles, from their start values near to the minimum on a sample of
    the frames alone.

    The last stage ends on all frames, by `search`, so that the estimate is theirs. Empty where there are not so
    many frames that it saves time, or where the sample or all frames from its estimate do not
    converge.
    """
    frames = pairs.frames
    some = _sample(pairs.frames)
    if some is frames:
        return []
    sample = PairObjective(some, pairs.model_name)
    leading = replace(_LEADING, max_iterations=search.max_iterations)
    stages = _pair_stages(sample, camera, leading)
    if not stages[-1].status.ok:
        return []
    last = joint_stage(pairs, camera, stages[-1].theta, search)
    if not last.status.ok:
        return []
    scales = {"distortion": frames.n_stars / sample.frames.n_stars}
    by_pair = pairs.n_pairs / sample.n_pairs
    first = [
        replace(stage, cost=stage.cost * scales.get(stage.name, by_pair)) for stage in stages[:-1]
    ]
    return [*first, begun_on_sample(stages[-1], last, by_pair)]


def _sample(frames: StarFrames) -> StarFrames:
    """Some of the frames, where there are so many that it saves time."""
    wanted = max(_SAMPLE_FRAMES, -(-_SAMPLE_STARS * frames.n_frames // frames.n_stars))
    if frames.n_frames < 3 * wanted:
        return frames
    chosen = np.isin(np.arange(frames.n_frames), one_of_each(frames.n_frames, wanted))
    return frames.select(np.repeat(chosen, frames.sizes))


def _pair_stages(pairs: PairObjective, camera: Camera, search: Search) -> list[Stage]:
    frames = pairs.frames
    stages = [optics_stage(frames, camera, search)]
    # Without an optical axis there is nothing to attach the distortion to; later stages would only
    # hide it.
    if get_model(camera.distortion).lens and stages[0].status is not Status.NOT_FINITE:
        stages.append(distortion_stage(frames, camera, stages[0].theta))
        stages.append(joint_stage(pairs, camera, stages[1].theta, search))
        if not stages[-1].status.ok or _far(stages[0], camera):
            # Distortion of tens of pixels pulls the undistorted fit far from the axis, and the
            # linear stage may then lead to another minimum or into a fold; the nominal optics
            # without distortion are the safer start.
            start = undistorted(camera.distortion, camera.theta)
            again = joint_stage(pairs, camera, start, search)
            stages[-1] = min(stages[-1], again, key=_badness)
    return stages


def _badness(stage: Stage) -> tuple[bool, float]:
    """Converged before not, then by cost."""
    cost = float(stage.cost[-1])
    return not stage.status.ok, cost if np.isfinite(cost) else float("inf")
