"""Screening of observations for wrong identifications: which rows are left out, and why.

Before any calibration the stars of a frame vote on its attitude (`consensus`). Then, in rounds:
calibrate on the stars in use, vote again with the calibrated camera and the noise it shows, reject
the worst star of each frame while it is farther from the prediction of the others than chance
explains (`outliers`) or while the frame's TASTE fails, and take back stars that pass. The rounds
end when they no longer change anything.

Where more stars are rejected just beyond the limit than noise and wrong stars let expect, or the
rounds do not settle, the model is wrong and not the stars (`tails`): what hangs together with the
others is kept, with a Student t where the tails ask for it.

Every right star and every right frame takes the same risk of being rejected: with N stars and K
frames and an expected number E of false rejections, a star is rejected at p < E / (2N) and a frame
at p < E / (2K) (Bonferroni's bound).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.calibration.plausibility import explained
from starcal_uq.calibration.screening.result import (
    MARGINAL,
    Screening,
    ScreeningRound,
    add_dropped_frames,
    rejected_table,
    warnings_about,
)
from starcal_uq.calibration.screening.tails import (
    Tails,
    allowed_near,
    blamed,
    fit_tails,
    follows_place,
    mark_beyond,
)
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.findings import Finding
from starcal_uq.core.settings import WEIGHING, effect_names, joined_effects
from starcal_uq.core.status import Note, Status
from starcal_uq.core.tasks import one_thread
from starcal_uq.core.types import AnyDict, BoolArray, FloatArray
from starcal_uq.estimation.consensus import (
    consensus,
    measured_directions,
    pre_screen,
)
from starcal_uq.estimation.duplicates import check_duplicates, repeating_frames
from starcal_uq.estimation.outliers import (
    StarResiduals,
    star_residuals,
    star_threshold,
    truncated_variance,
)
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

CONTROLS = ("table", "star")
# A vote with the calibrated camera: wide enough for the noise of attitudes from two stars, which
# the tests see to.
_VOTE_SIGMAS = 10.0
# The tests of one round remove one star per frame at a time.
_MAX_PASSES = 60
_MAX_STAR_RATE = 0.05
# Share of a frame that may be out and yet not far off.
_NEAR_FRACTION = 0.25


@dataclass(frozen=True)
class _Rates:
    """p-values below which a star and a frame are rejected, and the shrinkage of the variance that
    follows.
    """

    star: float
    frame: float
    shrinkage: float


@explained
@one_thread()
def screen(
    obs: Observations,
    camera: Camera,
    *,
    significance: float = 0.05,
    control: str = "table",
    max_rounds: int = 10,
    throw: bool = True,
    duplicates: str = "refuse",
    **options: Any,
) -> Screening:
    """Find wrong identifications and calibrate on the rest.

    Parameters
    ----------
    obs : Observations
        Identified stars, some of them wrongly. Stated noise per star (`sigma_px`) is respected.
    camera : Camera
        Nominal camera: the focal length may be tens of per cent off, the principal point tens of
        pixels, the distortion unknown.
    significance : float
        With ``control="table"``, the probability that anything at all is rejected from a table
        without wrong identifications; with ``control="star"``, the fraction of right stars that is
        rejected (at most 0.05). Both are bounds: tests that overlap reject less.
    control : {"table", "star"}
        Meaning of `significance`. Only ``"star"`` shortens the tails of the noise so that it shows
        in the estimated sigma (`Screening.sigma_shrinkage`).
    max_rounds : int
        Limit on the rounds of calibrating and testing.
    throw : bool
        Whether to raise an error where the calibration does not converge.
    duplicates : {"refuse", "drop", "keep"}
        As for `calibrate`; asked once, of the rows that are kept. With ``drop``, the result is of
        the other frames.
    **options
        Passed on to `calibrate`, such as ``solver``. With the effect ``noise``, stars are screened
        a second time, with the noise that the model fitted to those kept at first gives each.

    Returns
    -------
    Screening
        Rows that are kept, every rejected row with its reason, and the calibration of the kept
        rows.

    Raises
    ------
    CalibrationError
        When no three stars of any frame agree, or as for `calibrate`.
    ValueError
        For a significance, control or number of rounds that makes no sense.
    """
    check_duplicates(duplicates)
    options["duplicates"] = "keep"
    names = effect_names(options.get("effects"))
    settings: AnyDict = {"significance": significance, "control": control}
    settings |= {"max_rounds": max_rounds, "throw": throw}
    if "noise" in names:
        settings |= {"duplicates": duplicates}
        return _with_noise_model(obs.unweighted, camera, settings, options, names)
    frames = StarFrames.from_observations(obs)
    rates = _rates(frames, significance, control, max_rounds)
    use, start = pre_screen(camera, frames)
    if not use.any():
        raise CalibrationError(
            "no three stars of any frame agree with their catalogue directions",
            Status.INCONSISTENT,
            reason=(
                "check the star identifications, the parity of the axes and the nominal camera"
            ),
        )
    found_before = int(np.count_nonzero(~use))
    rounds: list[ScreeningRound] = []
    states: list[tuple[BoolArray, Calibration, _Tested]] = []
    n_changed = -1
    while (
        n_changed
        and len(rounds) < max_rounds
        and not any(np.array_equal(use, seen) for seen, _, _ in states)
    ):
        calibration, tested = _round(obs, frames, camera, use, rates, options)
        n_changed = int(np.count_nonzero(tested.in_use != use))
        rounds.append(
            ScreeningRound(
                int(np.count_nonzero(use)), n_changed, calibration.sigma, calibration.theta
            )
        )
        states.append((use, calibration, tested))
        use = tested.in_use
    # Rounds that go in circles have no natural end: the search continues from the state that fits
    # best.
    use, calibration, tested = (
        states[-1] if n_changed == 0 else min(states, key=lambda state: state[1].sigma)
    )
    stable, tails = n_changed == 0, None
    blame: AnyDict = {}
    found = star_residuals(frames, calibration.camera.distortion, calibration.theta, use)
    statistic, dof = found.studentised(rates.shrinkage)
    out = ~use & np.repeat(found.frame_count > 0, frames.sizes)
    limit = star_threshold(rates.star, dof)
    near, allowed = allowed_near(statistic[out], limit[out], 2.0 * rates.star * frames.n_stars)
    last = options
    if near > allowed or not stable:
        use, tails = _all_that_hangs_together(frames, calibration, use, rates)
        last = _with_tails(options, tails)
        calibration = calibrate(obs.select(use), camera, throw=False, **last)
        follows = follows_place(obs.select(use).xy, calibration)
        if follows and last is not options:
            # Tails would take what the lens does at some places for noise, and believe the others
            # all the more.
            last = options
            calibration = calibrate(obs.select(use), camera, throw=False, **last)
        blame = blamed(near, allowed, len(rounds), stable, calibration, follows)
    kept = obs.select(use)
    if throw and not calibration.status.ok:
        # For the error alone.
        calibration = calibrate(kept, camera, **last)
    repeating = repeating_frames(calibration, kept, duplicates)
    if len(repeating):
        rest = obs.select_frames(np.setdiff1d(obs.frame_ids, repeating))
        return screen(rest, camera, **settings, **options)
    residuals = star_residuals(frames, calibration.camera.distortion, calibration.theta, use)
    table = rejected_table(obs, residuals, rates.star, rates.frame, rates.shrinkage)
    add_dropped_frames(
        table, obs, calibration.camera, tested.vote_rad, tested.disturbed, rates.frame
    )
    if tails is not None:
        mark_beyond(table, residuals, tails, rates.star)
    n_rejected = int(np.count_nonzero(~use))
    taste, taste_p = residuals.taste(rates.shrinkage)
    # Readers of the table find the words of it, checks the facts.
    told = Finding(Note.MODEL_IS_WRONG, blame).sentence if blame else ""
    return Screening(
        kept=use,
        observations=kept.with_origin(
            screening={
                "rejected": n_rejected,
                "of": obs.n_stars,
                "significance": significance,
                "control": control,
            }
            | ({"blame": told, "blamed": blame} if blame else {})
        ),
        rejected=table,
        rounds=tuple(rounds),
        calibration=calibration,
        significance=significance,
        control=control,
        expected_false=2.0 * rates.star * frames.n_stars,
        star_p_value=rates.star,
        frame_p_value=rates.frame,
        star_threshold=float(star_threshold(rates.star, max(residuals.dof, 1))),
        sigma_shrinkage=1.0 - float(np.sqrt(rates.shrinkage)),
        frame_ids=obs.frame_ids,
        frame_count=residuals.frame_count,
        taste=taste,
        taste_p_value=taste_p,
        focal_ratio=start.focal_px / camera.focal_px,
        n_pre_screened=found_before,
        stable=stable,
        warnings=(told,) if blame else warnings_about(obs, calibration.camera, use, table),
        model_is_wrong=bool(blame),
    )


def _all_that_hangs_together(
    frames: StarFrames, calibration: Calibration, use: BoolArray, rates: _Rates
) -> tuple[BoolArray, Tails]:
    """Stars (N,) that lie within the tails of the others, those of frames that were dropped among
    them.
    """
    model, theta = calibration.camera.distortion, calibration.theta
    found = star_residuals(frames, model, theta, use)
    # Frames without stars in use get an attitude from those that agree, however roughly.
    tolerance = (
        np.sqrt(MARGINAL * -2.0 * np.log(rates.star) * found.robust_variance())
        / calibration.camera.focal_px
    )
    vote = consensus(
        measured_directions(calibration.camera, frames),
        frames.r,
        frames.starts,
        4.0 * tolerance * frames.noise,
    )
    lost = np.repeat(found.frame_count == 0, frames.sizes)
    found = star_residuals(frames, model, theta, np.where(lost, vote.agree, use))
    t = np.where(np.isnan(found.t), np.inf, found.t)
    tails = fit_tails(t, rates.star)
    return tails.within, tails


def _with_tails(options: AnyDict, tails: Tails) -> AnyDict:
    """Options of the last calibration: Student's tails where the stars have them and nothing else
    was asked for.
    """
    free = not {"tails", "star"} & set(effect_names(options.get("effects")))
    suits = free and options.get("method", "efficient") == "efficient"
    if not (suits and tails.heavy):
        return options
    return options | {"effects": joined_effects(options.get("effects"), "tails")}


def _with_noise_model(
    obs: Observations,
    camera: Camera,
    settings: AnyDict,
    options: AnyDict,
    effects: tuple[str, ...],
) -> Screening:
    """Screen with one noise, fit how it varies, screen with that; what is kept gets a model of its
    own.
    """
    # The noise model is what explains tails.
    plain = {name: value for name, value in options.items() if name != "duplicates"}
    plain["effects"] = [name for name in effects if name not in WEIGHING]
    first = screen(obs, camera, **settings, **plain)
    model = calibrate(first.observations, camera, throw=settings["throw"], **options).noise_model
    if model is not None and model.varies:
        first = screen(obs.weighted(model.sigma_px(obs), model.axes), camera, **settings, **plain)
    kept = first.observations.unweighted
    calibration = calibrate(kept, camera, throw=settings["throw"], **options)
    return replace(first, observations=kept, calibration=calibration)


def _round(
    obs: Observations,
    frames: StarFrames,
    camera: Camera,
    use: BoolArray,
    rates: _Rates,
    options: AnyDict,
) -> tuple[Calibration, _Tested]:
    """Calibrate on the stars in use, and test all stars."""
    try:
        calibration = calibrate(obs.select(use), camera, throw=False, **options)
        return calibration, _tested(frames, calibration, use, rates)
    except CalibrationError as error:
        n_agree = int(np.count_nonzero(use))
        if n_agree > 0.5 * obs.n_stars:
            raise
        raise CalibrationError(
            f"only {n_agree} of {obs.n_stars} stars agree on attitudes, and no calibration fits "
            "them",
            Status.INCONSISTENT,
            reason=Status.INCONSISTENT.remedy,
        ) from error


def _rates(frames: StarFrames, significance: float, control: str, max_rounds: int) -> _Rates:
    if control not in CONTROLS:
        raise ValueError(f"control={control!r} is unknown: use one of {', '.join(CONTROLS)}.")
    highest = 1.0 if control == "table" else _MAX_STAR_RATE
    if not 0.0 < significance <= highest:
        raise ValueError(
            f"significance={significance}: give a number above 0 and up to {highest:g}."
        )
    if max_rounds < 1:
        raise ValueError(f"max_rounds={max_rounds}: at least one round is needed.")
    expected = significance * (frames.n_stars if control == "star" else 1.0)
    star = 0.5 * expected / frames.n_stars
    # Where frames are few, half of the false rejections cannot all come from them.
    frame = min(0.5 * expected / frames.n_frames, 0.1)
    return _Rates(star, frame, truncated_variance(star))


@dataclass(frozen=True)
class _Tested:
    """Stars in use after a round (N,); angle of every star from its frame's vote (N,); TASTE of
    disturbed frames (K,).

    TASTE is NaN for frames that were not dropped for it.
    """

    in_use: BoolArray
    vote_rad: FloatArray
    disturbed: FloatArray


def _tested(frames: StarFrames, calibration: Calibration, use: BoolArray, rates: _Rates) -> _Tested:
    """One round at a fixed camera: vote, remove with the robust noise, then remove and take back
    with the final one.
    """
    model, theta, camera = calibration.camera.distortion, calibration.theta, calibration.camera
    robust = star_residuals(frames, model, theta, use).robust_variance()
    tolerance = _VOTE_SIGMAS * np.sqrt(robust) * frames.noise / camera.focal_px
    vote = consensus(measured_directions(camera, frames), frames.r, frames.starts, tolerance)
    use = np.where(frames.in_threes(vote.agree), vote.agree, use)
    # While wrong stars inflate the sum of squares, only the median tells the noise.
    for _ in range(_MAX_PASSES):
        found = star_residuals(frames, model, theta, use)
        # The median of few values is itself uncertain: two of its standard errors are allowed for.
        allowance = 1.0 + 2.0 / (np.log(2.0) * np.sqrt(np.count_nonzero(found.in_use)))
        limit = -2.0 * np.log(rates.star) * found.robust_variance() * allowance
        worst = _first_per_frame(frames, found.in_use & (found.t > limit), found.t)
        use = found.in_use & ~worst
        if not worst.any():
            break
    use, disturbed = _settled(frames, model, theta, use, rates)
    return _Tested(use, vote.offset_rad, disturbed)


def _settled(
    frames: StarFrames, model: str, theta: FloatArray, use: BoolArray, rates: _Rates
) -> tuple[BoolArray, FloatArray]:
    """Remove and take back stars, at most one of a frame at a time, until nothing changes.

    A frame may lose its worst stars, but not one after the other until the rest happens to fit:
    where more than a quarter of its stars are out without any being far off, the frame is dropped.
    Returns the stars in use, and TASTE of frames dropped so (NaN for others).
    """
    barred = np.zeros(frames.n_stars, dtype=bool)
    disturbed = np.full(frames.n_frames, np.nan)
    for _ in range(_MAX_PASSES):
        found = star_residuals(frames, model, theta, use)
        statistic, dof = found.studentised(rates.shrinkage)
        fails = statistic > star_threshold(rates.star, dof)
        taste_fails = np.repeat(found.taste(rates.shrinkage)[1] < rates.frame, frames.sizes)
        worst = _first_per_frame(frames, found.in_use & (fails | taste_fails), found.t)
        if worst.any():
            # A star that was taken back and fails again stays out: no endless exchange.
            barred |= worst
            use = found.in_use & ~worst
            continue
        back = _first_per_frame(frames, _passing(frames, found, ~fails & ~barred, rates), -found.t)
        if back.any():
            use = found.in_use | back
            continue
        near = ~found.in_use & (statistic < MARGINAL * star_threshold(rates.star, dof))
        drop = frames.sum(near.astype(np.int64)) > np.maximum(_NEAR_FRACTION * frames.sizes, 1.0)
        # Without another frame to compare with, the noise of all of them is simply what it is.
        if not drop.any() or np.array_equal(drop, found.frame_count > 0):
            break
        together = found.frame_cost + frames.sum(np.where(near, found.t, 0.0))
        disturbed[drop] = together[drop] / found.variance(rates.shrinkage)
        dropped = np.repeat(drop, frames.sizes)
        barred |= dropped
        use = found.in_use & ~dropped
    return found.in_use, disturbed


def _passing(
    frames: StarFrames, residuals: StarResiduals, candidates: BoolArray, rates: _Rates
) -> BoolArray:
    """Stars not in use, in frames that are, which pass and with which their frame passes as
    well.
    """
    from scipy.special import chdtrc

    candidates = candidates & ~residuals.in_use & np.isfinite(residuals.t)
    together = frames.spread(residuals.frame_cost) + np.where(candidates, residuals.t, 0.0)
    together = together / residuals.variance(rates.shrinkage)
    dof = frames.spread(np.maximum(2 * residuals.frame_count - 1, 1))
    passing: BoolArray = candidates & (chdtrc(dof, together) >= rates.frame)
    return passing


def _first_per_frame(frames: StarFrames, chosen: BoolArray, order: FloatArray) -> BoolArray:
    """Of the chosen stars of each frame, the one with the largest `order`."""
    value = np.where(chosen, order, -np.inf)
    largest = frames.spread(np.maximum.reduceat(value, frames.starts[:-1]))
    tied = np.flatnonzero(chosen & (value == largest))
    first = np.zeros(frames.n_stars, dtype=bool)
    if tied.size:
        frame = np.repeat(np.arange(frames.n_frames), frames.sizes)[tied]
        first[tied[np.unique(frame, return_index=True)[1]]] = True
    return first
