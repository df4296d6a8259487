"""From observations to a calibration: the fit, its fallbacks and what excludes what."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Unpack, get_args

import numpy as np

from starcal_uq.calibration.fallback import fit_determined
from starcal_uq.calibration.methods import offered
from starcal_uq.calibration.plausibility import explained
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, like, with_axes
from starcal_uq.core.cluster import Scheduler, cluster
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.settings import RecursiveMethod, bounded
from starcal_uq.core.tasks import one_thread, processors
from starcal_uq.core.types import AnyDict, Progress
from starcal_uq.estimation.assemble import raise_unless_good
from starcal_uq.estimation.duplicates import repeating_frames
from starcal_uq.estimation.effects import with_effects, without_effects
from starcal_uq.estimation.fit import fit_weighed
from starcal_uq.estimation.partitioned import calibrate_partitions
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.robust import with_tail_weights
from starcal_uq.estimation.settings import METHODS as METHODS
from starcal_uq.estimation.settings import EstimationOptions, EstimationSettings
from starcal_uq.estimation.ties import with_ties
from starcal_uq.estimation.weighing import gains, with_weighing
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood import paths
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.observations.partitions import PartitionedObservations
from starcal_uq.observations.table import Observations

RECURSIVE_METHODS = get_args(RecursiveMethod)
OWN_METHODS = ("efficient", "three_stage")
_Stars = Observations | PartitionedObservations | Iterable[Observations]
# All passes of one process over 1.56 million stars took 7.5 s, two processes 6.2 s more than half
# of it. Starts differ between machines, so that processes have to save more.
_SECONDS_A_STAR, _START_S, _MARGIN = 4.8e-6, 6.2, 1.5
# Effects whose coefficients are those of the images of one frame or star.
_OF_FEW_IMAGES = ("frame", "star")


@bounded
@explained
@one_thread()
def calibrate(
    obs: Observations | PartitionedObservations | Iterable[Observations],
    camera: Camera,
    settings: EstimationSettings | None = None,
    *,
    throw: bool = True,
    scheduler: Scheduler = None,
    workers: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[EstimationOptions],
) -> Calibration:
    """Estimate optics and distortion from identified stars.

    Parameters
    ----------
    obs : Observations, PartitionedObservations or iterable of Observations
        Stars with pixel positions and catalogue directions; at least three per frame. Partitioned
        ones may exceed memory: a sample of their frames goes through the stages, then all of them
        are refined on, pass by pass; the result has residuals and attitudes of that sample. The
        recursive methods also take a stream: any iterable of Observations of one or several frames,
        such as `starcal_uq.paper.stream_frames`. They keep none of them, so that the result has no
        residuals and attitudes.
    camera : Camera
        Start values; its `distortion` names the model. The coefficients start from zero, as in the
        paper.
    settings : EstimationSettings, optional
        The settings; keywords change some of them.
    throw : bool
        Raise when the estimate is not good; otherwise `Calibration.status` says so, as long as
        there is an estimate.
    scheduler : str or distributed.Client, optional
        Dask scheduler, whose workers read partitioned observations; processes of this machine
        otherwise.
    workers : int, optional
        Number of these processes; 0 stays in this one. By default as many as processors where they
        save more than their start takes.
    progress : callable, optional
        Called with (partitions done, partitions) in every pass over partitioned observations.

    Returns
    -------
    Calibration
        With estimate, covariance, residuals, attitudes and the trajectory of every stage.

    Raises
    ------
    CalibrationError
        When there are too few stars, or, with `throw`, when the status is not CONVERGED.
    RepeatedFramesError
        When frames hold the same measurement, and `duplicates` is ``refuse``.

    Other Parameters
    ----------------
    model : str, optional
        Distortion model in place of the camera's. A model asked for here is fitted or refused. By
        default it is that of `camera`, and where the data do not determine it (methods
        ``efficient`` and ``three_stage`` on a table), the richest simpler one that they do:
        ``provenance["fallback"]`` then says which, and why. Where the distortion may be none,
        sigmas leave out what its coma tells of the principal point (`Calibration.coma_factors`).
    method : {"efficient", "three_stage", "least_squares", "samaan", "griffith"}
        ``three_stage`` is Ye & Yang 2017: interstar angles without distortion, linear distortion,
        interstar angles with both; its covariance is the sandwich of composite likelihood, from the
        scatter of frames if there are 50 for each parameter, else from Gaussian noise.
        ``efficient`` goes on to the attitude-marginalised likelihood, whose covariance is the
        Cramer-Rao bound. The others are what the paper compares itself with: ``least_squares`` fits
        the optics to interstar angles as if there were no distortion, and its result's model is
        ``none``; ``samaan`` filters the optics frame by frame from the least-squares solution of
        the first frames, and fits the distortion linearly afterwards; ``griffith`` is recursive
        least squares from the start values, for the optics alone (model ``none``) unless
        `recursion` says otherwise. Their covariances are the spread over repeated data sets; the
        bias from the distortion that they ignore is not in them.
    solver : {"lm", "minpack", "ipopt"}
        Levenberg-Marquardt on normal equations, MINPACK on explicit pairs (where there are at most
        500,000 of them), or IPOPT with the principal point kept on the detector, f > 0 and the
        distortion monotonic. The refinement always uses the first; the recursive methods use none.
    max_iterations : int
        Limit for each stage.
    effects : {"none", "auto"} or sequence of str
        Effects beyond the camera, by name or joined by commas; ``auto`` takes up those that the
        data support, beside any that are named (`Calibration.effects`). Scales of ``axes``,
        ``field``, ``radial``, ``frame``, ``zenith``, ``temperature``, ``time``, ``epoch``,
        ``star``, ``phase`` and ``magnitude`` are estimated by restricted likelihood and
        marginalised in estimate, covariance and `compressed`. Two effects decide how much the stars
        count:

        ``noise``: a variance that is fitted as a function of radius, magnitude, frame and axis, as
        far as the residuals ask for it (`Calibration.noise_model`). Everything that takes the
        result then weighs the stars by it, and `sigma` is a factor on it.

        ``tails``: a Student t per star, for tables with wrong identifications. The stages see only
        stars whose angles agree with those of their frame, the refinement sees all that can be in
        the field, `covariance` is the sandwich one, `information` the observed one, `sigma` the
        scale of the t, `chi2` is summed with the stars' weights, and `compressed` is the Gaussian
        likelihood of the reweighted stars, which keep these weights where there are further
        effects. With ``noise`` it is the scale of the t that varies.

        Effects need the ``efficient`` method.
    dof : float or "free", optional
        Degrees of freedom of ``tails``, 2 to 200; "free" estimates them, with the gamma prior of
        Juarez & Steel (2010) on what exceeds 2. By default they are estimated, but no less than 4:
        fewer take in stars a thousand sigma away, at the price of intervals that are a third wider.
    relative_attitudes : RelativeAttitudes or path, optional
        Rotations of the camera between frames that were measured without stars, with their errors
        (`starcal_uq.attitude.load_relative_attitudes` describes the file): they tie the attitudes,
        so that the principal point is told apart from the boresight. It needs the ``efficient``
        method.
    relative_alignment_arcsec : float, optional
        How well the axes of the instrument that measured them are known in the camera, standard
        deviation about each axis; by default, they are rotations of the camera itself.
    mount : {"none", "fixed"}
        ``fixed``: the Earth turns the camera, and nothing else. It needs times in the table.
    mount_sigma_arcsec : float, optional
        How far a fixed mount moves from frame to frame about each axis, standard deviation.
    recursion : RecursionOptions, optional
        Options of ``samaan`` and ``griffith`` (`starcal_uq.paper.RecursionOptions`).
    duplicates : {"refuse", "drop", "keep"}
        What to do with frames that hold the same measurement as an earlier one, whatever their
        numbers, order and stars (`starcal_uq.estimation.repeated_frames`): they would count twice.
        ``drop`` leaves them out, there and in all that takes the table with the result (`frame_ids`
        are those that stay); ``keep`` does not ask, nor are streams asked.
    """
    settings = (EstimationSettings() if settings is None else settings).changed(**options)
    partitioned = isinstance(obs, PartitionedObservations)
    settings.refuse_conflicts(scheduler=scheduler, workers=workers, partitioned=partitioned)
    calibration = _estimate(obs, camera, settings, throw, scheduler, workers, progress)
    if throw and not calibration.status.ok:
        raise_unless_good(calibration.status, calibration.remedy, calibration)
    if not isinstance(obs, Observations):
        return calibration
    repeating = repeating_frames(calibration, obs, settings.duplicates)
    if not len(repeating):
        return calibration
    kept = obs.select_frames(np.setdiff1d(obs.frame_ids, repeating))
    rest = calibrate(kept, camera, settings, throw=throw, duplicates="keep")
    return replace(rest, provenance=rest.provenance.adding(dropped_frames=repeating.tolist()))


def _estimate(
    obs: _Stars,
    camera: Camera,
    settings: EstimationSettings,
    throw: bool,
    scheduler: Scheduler,
    workers: int | None,
    progress: Progress | None,
) -> Calibration:
    """The calibration of all frames, whether it ended well or not."""
    method, sheet = settings.method, camera.distortion
    if settings.model is not None:
        camera = camera.replace(distortion=settings.model)
    if get_model(camera.distortion).axes:
        settings = _without_axes(settings)
    if method not in RECURSIVE_METHODS:
        if isinstance(obs, PartitionedObservations):
            parts = obs

            def of_partitions(camera: Camera, settings: EstimationSettings) -> Calibration:
                return _of_partitions(parts, camera, settings, scheduler, workers, progress)

            return _with_axes_of_camera(camera, settings, of_partitions)
        if not isinstance(obs, Observations):
            raise CalibrationError(
                f"method {method!r} needs all frames at once, as Observations: load them, or use "
                "samaan or griffith."
            )
        if method in OWN_METHODS:
            table = obs

            def of_table(camera: Camera, settings: EstimationSettings) -> Calibration:
                return _of_table(table, camera, settings, like(sheet, camera.distortion), throw)

            return _with_axes_of_camera(camera, settings, of_table)
    estimate = offered(method)
    return estimate(obs, camera, settings.recursion, settings.solver, settings.max_iterations)


def _without_axes(settings: EstimationSettings) -> EstimationSettings:
    """The settings for a camera whose axes are among its parameters."""
    rest = tuple(name for name in settings.names if name != "axes")
    return settings.changed(effects=rest or "none")


def _with_axes_of_camera(
    camera: Camera,
    settings: EstimationSettings,
    estimate: Callable[[Camera, EstimationSettings], Calibration],
) -> Calibration:
    """The calibration by `estimate`; the effect of the axes, where it was taken up or asked for,
    is two parameters of the camera.
    """
    found = estimate(camera, settings)
    held = found.known_effects
    taken = [e for e in held.fitted if e.name == "axes"]
    if not taken:
        return found
    free = camera.replace(distortion=with_axes(camera.distortion))
    try:
        again = estimate(free, _without_axes(settings))
    except CalibrationError:
        return found
    if not again.status.ok:
        return found
    # They have no scale any more.
    axes = replace(taken[0], scale_px=np.nan, low_px=np.nan, high_px=np.nan)
    effects = again.effects or Effects((), held.selected, (), held.penalty_nat)
    effects = replace(effects, of_camera=(axes,), asked=held.asked)
    record = again.provenance.with_settings(effects=list(effects.names))
    return replace(again, effects=effects, provenance=record)


def _of_partitions(
    obs: PartitionedObservations,
    camera: Camera,
    settings: EstimationSettings,
    scheduler: Scheduler,
    workers: int | None,
    progress: Progress | None,
) -> Calibration:
    """The calibration of all partitions, from that of a sample of their frames."""
    sample, plain = obs.sample(), settings.changed(effects="none")
    # What is compiled is compiled here, before other processes ask for it.
    with paths.using(paths.chosen(obs.n_stars)):
        start = calibrate(sample, camera, plain, model=camera.model)
    with cluster(scheduler, workers=_enough(workers, obs), caller="calibrate") as processes:
        return calibrate_partitions(
            obs,
            sample,
            start,
            processes,
            max_iterations=settings.max_iterations,
            duplicates=settings.duplicates,
            effects=settings.names,
            progress=progress,
        )


def _of_table(
    obs: Observations, camera: Camera, settings: EstimationSettings, sheet: str, throw: bool
) -> Calibration:
    """The calibration of a table with the model that it determines, and with its effects; `sheet`
    is the model of the camera's sheet.
    """
    if obs.stated_px is not None and not settings.noise:
        # Weights of another calibration's noise model are what this table states.
        obs = replace(obs, stated_px=None, noise_axes=None)
    calibration = fit_determined(
        obs,
        camera,
        lambda start: _tied(obs, fit_weighed(obs, start, settings), settings),
        sheet=sheet,
        asked=settings.model is not None,
        throw=throw,
    )
    if not (calibration.status.ok and settings.shifting):
        return with_weighing(obs, calibration, settings.noise, settings.tails)
    if "auto" in settings.names:
        return _selected(obs, calibration, settings)
    return _with_all(obs, calibration, settings)


def _selected(obs: Observations, cal: Calibration, settings: EstimationSettings) -> Calibration:
    """The calibration with the effects that the data support, noise and tails among them.

    Where one of these gains more than each effect that shifts stars, or enough beside all of them,
    these are selected again with it, and then the other one is tried beside it. One of them that
    gains too little beside the other is dropped.
    """
    asked = tuple(name for name in settings.names if name != "auto")
    found, moved = _with_all(obs, cal, settings), dict[str, AnyDict]()
    while True:
        left, least = _gained(obs, found, settings)
        best = max((name for name in left if name not in moved), key=left.__getitem__, default="")
        if not best or left[best] <= least:
            break
        more = settings.changed(effects=[*settings.names, best])
        trial = _refitted(obs, cal, more)
        if trial is None:
            break
        held = trial.known_effects
        gained = {one.name: one.gain_nat for one in held.weighing}
        weak = [n for n in gained if n not in asked and gained[n] <= held.penalty_nat]
        if best in weak:
            left |= {best: gained[best]}
            break
        if weak:
            more = settings.changed(effects=["auto", *asked, best])
            trial = _refitted(obs, cal, more) or trial
        sizes = np.abs(trial.theta - found.theta) / trial.sigmas
        worst = int(np.argmax(sizes))
        moved[best] = {"moved_sigma": float(sizes[worst]), "moved_name": cal.parameter_names[worst]}
        found, settings = trial, more
    held = found.known_effects
    refused = sorted((*held.refused, *left.items()), key=lambda one: -one[1])
    weighing = [replace(one, **moved.get(one.name, {})) for one in held.weighing]
    held = replace(held, weighing=tuple(weighing), refused=tuple(refused), asked=asked)
    return replace(found, effects=held)


def _refitted(
    obs: Observations, cal: Calibration, settings: EstimationSettings
) -> Calibration | None:
    """The calibration with other effects that weigh stars; None where there is none."""
    again = fit_weighed(obs, cal.nominal, settings)
    if not again.status.ok:
        return None
    known = {name: value for name, value in cal.provenance.items() if name == "fallback"}
    again = replace(again, provenance=again.provenance.adding(**known))
    return _with_all(obs, again, settings)


def _gained(
    obs: Observations, cal: Calibration, settings: EstimationSettings
) -> tuple[dict[str, float], float]:
    """What noise and tails that are not in the settings would gain, and what they have to: alone
    where that is more than any effect that shifts stars has gained, else beside these.

    What effects of few images leave is uneven by itself: beside the others noise and tails have to
    gain more than these.
    """
    fitted, least = cal.known_effects.fitted, cal.known_effects.penalty_nat
    few = [one.gain_nat for one in fitted if one.name in _OF_FEW_IMAGES]
    shared = [one.name for one in fitted if one.name not in _OF_FEW_IMAGES]
    gained = gains(obs, cal, settings.noise, settings.tails)
    if max(gained.values(), default=0.0) >= max((one.gain_nat for one in fitted), default=0.0):
        return gained, least
    if shared:
        cal = with_effects(weighed(obs, cal), cal, shared) if few else cal
        gained = gains(without_effects(obs, cal), cal, settings.noise, settings.tails)
    return gained, max([least, *few])


def _with_all(obs: Observations, cal: Calibration, settings: EstimationSettings) -> Calibration:
    """The calibration with effects that shift stars; others are found again beside these."""
    found = _with_shifts(obs, obs, cal, settings)
    if found.known_effects.fitted and (settings.noise or settings.tails):
        # Noise and tails of a camera without its effects hold these, too.
        again = fit_weighed(without_effects(obs, found), cal.nominal, settings)
        if again.status.ok:
            # It is still an estimate from the table as it is.
            made_of = cal.provenance.data_sha256
            again = replace(again, provenance=again.provenance.adding(data_sha256=made_of))
            found = _with_shifts(obs, without_effects(obs, found), again, settings)
    return with_weighing(obs, found, settings.noise, settings.tails)


def _with_shifts(
    obs: Observations, seen: Observations, calibration: Calibration, settings: EstimationSettings
) -> Calibration:
    """The calibration with effects that shift stars; tails weigh these as they are `seen`."""
    if settings.tails:
        calibration = with_tail_weights(weighed(seen, calibration), calibration)
    return with_effects(weighed(obs, calibration), calibration, settings.shifting)


def _tied(obs: Observations, calibration: Calibration, settings: EstimationSettings) -> Calibration:
    """The calibration with known rotations between its frames, which may tell what the stars leave
    open.
    """
    if settings.ties is None or not (calibration.status.ok or calibration.undetermined):
        return calibration
    if settings.tails:
        calibration = with_tail_weights(weighed(obs, calibration), calibration)
    return with_ties(weighed(obs, calibration), calibration, settings.ties)


def _enough(workers: int | None, obs: PartitionedObservations) -> int:
    """Processes that are worth their start: none for what one of them does in the same time."""
    if workers is not None:
        return workers
    several = min(processors(), len(obs.parts))
    saved = _SECONDS_A_STAR * obs.n_stars * (1.0 - 1.0 / several)
    return several if saved > _MARGIN * _START_S else 0
