"""Checks of the estimate itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.calibration.fallback import fallback_facts
from starcal_uq.camera.distortion import get_model, next_simpler
from starcal_uq.core.remedy import CAMERA, PLAN, Remedies, Remedy, calibrated, with_model
from starcal_uq.core.status import (
    Advice,
    Check,
    Code,
    Level,
    Order,
    Status,
    judged,
)
from starcal_uq.core.types import AnyDict, BoolArray, floats
from starcal_uq.diagnostics.misfit import ALPHA
from starcal_uq.diagnostics.predictive import EXTREME_P
from starcal_uq.diagnostics.verdict.effect import (
    Effect,
    largest,
    of_misfit,
    on_attitudes,
    on_directions,
)
from starcal_uq.diagnostics.verdict.observed import (
    EFFECTS,
    NOISE,
    PLAUSIBLE_NOISE_PX,
    ROBUST,
    SCREEN,
    lens_remedy,
)
from starcal_uq.likelihood.shapes import IN_FIELD
from starcal_uq.maths.intervals import student_quantile
from starcal_uq.maths.linear import root_diagonal

if TYPE_CHECKING:
    from starcal_uq.calibration.cameras import MixedCameras
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.types import FloatArray
    from starcal_uq.diagnostics.diagnose import Diagnosis, MultiStart
    from starcal_uq.diagnostics.jackknife import Jackknife
    from starcal_uq.diagnostics.misfit import Misfit
    from starcal_uq.diagnostics.misfit_test import MisfitTest
    from starcal_uq.diagnostics.models import ModelComparison
    from starcal_uq.diagnostics.predictive import PredictiveCheck
    from starcal_uq.diagnostics.stars import StarTest
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.onboard import Extended

# False alarms by design. A run whose model holds is warned of in at most 5 % of cases and failed in
# at most 1 %: the sizes of all checks that ask noise a question (these, and PATTERN_P and
# OUTLIER_P) add up to less, whatever the data.
MISFIT_P, JACKKNIFE_P, STAR_P = ALPHA, 0.01, 0.01
MISFIT_FAIL_P, STAR_FAIL_P, ESTIMATORS_P, TRUTH_P = 1e-4, 1e-3, 3e-4, 3e-4
ROTATIONS_P = 3e-4
_REMEDIES = {
    Status.MAX_ITERATIONS: calibrated(max_iterations=1000),
    Status.OUTSIDE_DETECTOR: calibrated(solver="ipopt"),
    Status.FOLDED: calibrated(solver="ipopt"),
    Status.INCONSISTENT: SCREEN,
    Status.STALLED: calibrated(solver="minpack"),
}
# Effects that frames which disagree ask for.
_OF_FRAMES_APART = {"frame", "zenith", "temperature", "time", "epoch"}


def estimation(cal: Calibration, post: Posterior | None = None) -> Check:
    """Did the optimiser reach an optimum in every stage?"""
    simpler, tilts = next_simpler(cal.camera.distortion), get_model(cal.camera.distortion).tilts
    known = {
        Status.SINGULAR: (with_model(simpler) if simpler else ()) + (() if tilts else PLAN),
        **_REMEDIES,
    }
    status: AnyDict = {"status": cal.status, "undetermined": cal.undetermined}
    status |= {"solver": cal.solver, "tilts": tilts}
    # Sampling refuses priors that do not determine what the data leave open.
    by_priors = post is not None and bool(cal.undetermined)
    return Check(
        Code.ESTIMATION,
        {
            "status": cal.status,
            "n_stages": len(cal.stages),
            "n_iterations": sum(len(stage.trajectory) - 1 for stage in cal.stages),
            "by_priors": cal.undetermined if by_priors else (),
        },
        Level.WARN if by_priors else Level.PASS if cal.status.ok else Level.FAIL,
        remedies=() if cal.solver == "filter" else known.get(cal.status, ()),
        orders=() if cal.status.ok else (Order(Advice.MEND_THE_ESTIMATE, status),),
    )


def determined(cal: Calibration) -> Check | None:
    """Do the data determine the model of the camera, without a simpler one and without the coma of
    noise?
    """
    found = fallback_facts(cal)
    if not found:
        return None
    # To ask for what was fitted would determine nothing.
    return Check(Code.MODEL_THAT_THE_DATA_DETERMINE, found, Level.WARN, remedies=PLAN)


def estimators_agree(cal: Calibration) -> Check | None:
    """Do the interstar angles alone (the paper's estimator) lead to the same camera?"""
    difference = np.abs(cal.pair_theta - cal.theta)
    # Angles alone know of no effects, which move them by more than their noise.
    if cal.known_effects.fitted or not np.any(difference > 0.0):
        return None
    # The pair estimator is the less efficient one, so its own covariance bounds that of the
    # difference.
    z = difference / root_diagonal(cal.pair_covariance)
    return _largest_error(Code.TWO_ESTIMATORS, z, ESTIMATORS_P, cal, SCREEN)


def rotations_agree(cal: Calibration) -> Check | None:
    """Do known rotations between frames agree with the stars?"""
    ties = cal.ties
    if ties is None:
        return None
    wider = float(f"{np.max(ties.known.sigma_arcsec) * ties.error_factor:.3g}")
    return judged(
        Code.KNOWN_ROTATIONS,
        {name: getattr(ties, name) for name in ("chi2", "dof", "p_value", "error_factor")},
        {"p_value_least": ROTATIONS_P},
        calibrated(mount="fixed", mount_sigma_arcsec=wider) if ties.known.of_mount else (),
        (Order(Advice.WITHOUT_ROTATIONS),),
        Level.FAIL,
    )


def _largest_error(
    code: Code, z: FloatArray, size: float, cal: Calibration, remedies: Remedies
) -> Check:
    """The largest of the parameters' errors in sigma (p,) against what it exceeds with probability
    `size` (Student, Bonferroni).
    """
    worst = int(np.argmax(z))
    facts = {"error_sigma": float(z[worst]), "parameter": cal.parameter_names[worst]}
    bounds = {"error_sigma_below": student_quantile(1.0 - size / len(cal.theta), cal.dof)}
    return judged(code, facts, bounds, remedies, otherwise=Level.FAIL)


def against_truth(cal: Calibration, truth: Camera, post: Posterior | None = None) -> Check:
    """Errors in units of sigma, where the truth is known."""
    z = np.abs(truth_z(cal, truth, post))
    validate = (Remedy("validate", (CAMERA,), form="command"),)
    return _largest_error(Code.KNOWN_TRUTH, z, TRUTH_P, cal, validate)


def truth_z(cal: Calibration, truth: Camera, post: Posterior | None = None) -> FloatArray:
    """(estimate - truth) / sigma of every camera parameter, from the posterior if there is one;
    shape (p,).
    """
    if post is not None:
        return floats((post.mean - truth.theta) / post.sd[: len(post.mean)])
    return floats((cal.theta - truth.theta) / cal.sigmas)


# Frames that scatter by less than this beyond the formal errors are of no consequence, however
# sure.
JACKKNIFE_RATIO = 1.1
_OF_FRAMES = Advice.FRAMES_APART
_NOT_OF_THE_LENS = {
    "pixel phase in x": Advice.ACCEPT_THE_PHASE,
    "pixel phase in y": Advice.ACCEPT_THE_PHASE,
    "magnitude": Advice.LEAVE_OUT_MAGNITUDES,
    "direction": Advice.CHECK_THE_DIRECTIONS,
}


def model_checks(
    diagnosis: Diagnosis,
    cal: Calibration,
    attitude: AttitudeError | None = None,
) -> list[Check]:
    """Every check that a diagnosis allows."""
    moving = EFFECTS if _OF_FRAMES_APART & set(diagnosis.effects) else ()
    # What tails do not describe either is no noise of these stars.
    robust = SCREEN if cal.has_tails else ROBUST
    checks = [
        misfit(diagnosis.misfit, cal, attitude, diagnosis.better, diagnosis.extended),
        even_noise(diagnosis.misfit, EFFECTS if diagnosis.effects else ()),
    ]
    asked: list[tuple[Callable[..., Check], object]] = [
        (one_camera, diagnosis.cameras),
        (partial(jackknife, moving=moving), diagnosis.jackknife),
        (stars, diagnosis.stars),
        (partial(comparison, attitude=attitude), diagnosis.comparison),
        (partial(predictive, remedies=robust), diagnosis.predictive),
    ]
    return [*checks, *(check(found) for check, found in asked if found is not None)]


def one_camera(found: MixedCameras) -> Check:
    """Do the frames' own focal lengths ask for several cameras?"""
    remedies = calibrated("command", frames=found.frames)
    facts = {"n_cameras": found.n, "clause": found.words}
    return Check(Code.ONE_CAMERA, facts, Level.FAIL, remedies=remedies)


# Standard errors by which a change of a parameter differs from none, and growth of its error that
# is far.
_HARDLY_TOLD = 3.0


def misfit(
    found: Misfit,
    cal: Calibration,
    attitude: AttitudeError | None = None,
    better: str | None = None,
    extended: Extended | None = None,
) -> Check:
    """Is there structure in the residuals, and does it do more than is stated? `better` as for
    `lens_remedy`; `extended` has the effects that the data would take up.
    """
    patterns = [test.p_holm for test in found.tests if not test.is_of_noise]
    facts: AnyDict = {"p_value": min(patterns, default=1.0), "n_tests": len(found.tests)}
    code, bounds = Code.UNEXPLAINED_STRUCTURE, {"p_value_least": MISFIT_P}
    rejected = [test for test in found.found(MISFIT_P) if not test.is_of_noise]
    if not rejected:
        return Check(code, facts, bounds=bounds)
    effect = largest([*of_misfit(extended, rejected, cal), *on_attitudes(attitude)])
    facts["tests"] = tuple((test.name, test.p_holm, test.size_px) for test in rejected)
    facts |= effect.facts | _hardly_told(rejected[0])
    level = effect.level if min(patterns) < MISFIT_FAIL_P else Level.WARN
    # A lens can follow what keeps its place in the field, and no option here what does not.
    remedies: Remedies = ()
    orders: tuple[Order, ...] = (Order(_NOT_OF_THE_LENS.get(rejected[0].against, _OF_FRAMES)),)
    if any(t.against in IN_FIELD for t in rejected):
        remedies, orders = lens_remedy(cal.camera.distortion, better)
    if extended is not None:
        facts["effects"] = extended.effects.names
        remedies, orders = EFFECTS + remedies, ()
    return Check(code, facts, level, bounds, remedies, orders)


def _hardly_told(test: MisfitTest) -> AnyDict:
    """Facts of shapes that can hardly be separated from the parameter that they move; else
    nothing.
    """
    if not test.moved_std > _HARDLY_TOLD or test.moved_sigma > _HARDLY_TOLD * test.moved_std:
        return {}
    return {"moved": test.moved_name, "error_times": float(np.hypot(1.0, test.moved_std))}


def even_noise(found: Misfit, helping: Remedies = ()) -> Check:
    """Is the noise what the weights of the stars say? `helping`: what the data would take up."""
    p_values = [test.p_holm for test in found.tests if test.is_of_noise]
    rejected = [test for test in found.found(MISFIT_P) if test.is_of_noise]
    facts: AnyDict = {
        "p_value": min(p_values, default=1.0),
        "tests": tuple(test.name for test in rejected),
        **_asked(found.n_asked, found.n_frames),
    }
    level = Level.PASS
    remedies: Remedies = ()
    orders: tuple[Order, ...] = ()
    uneven = found.uneven
    if rejected and uneven is not None:
        facts |= {"noise": uneven.model}
        if uneven.model.varies:
            worst = int(np.argmax(np.abs(np.log(uneven.ratios))))
            facts |= {
                "parameter": uneven.parameter_names[worst],
                "ratio": float(uneven.ratios[worst]),
            }
            level, remedies = Level.WARN, NOISE
    elif rejected:
        level, remedies = Level.WARN, helping
        orders = () if helping else (Order(_OF_FRAMES),)
    bounds = {"p_value_least": MISFIT_P}
    return Check(Code.EVENNESS_OF_THE_NOISE, facts, level, bounds, remedies, orders)


def disagreeing(found: Jackknife) -> BoolArray:
    """Parameters (p,) in which frames scatter by more than chance and by enough to matter."""
    return (found.p_values * len(found.p_values) < JACKKNIFE_P) & (found.ratio > JACKKNIFE_RATIO)


def jackknife(found: Jackknife, moving: Remedies = ()) -> Check:
    """Do frames scatter as their formal errors say? `moving`: what takes up how they differ."""
    worst, bad = int(np.argmax(found.ratio)), disagreeing(found)
    chance = found.expected(1.0 - 2.0 * JACKKNIFE_P / len(bad))[1]
    return judged(
        Code.JACKKNIFE_OVER_FRAMES,
        {
            "least": float(found.ratio.min()),
            "most": float(found.ratio.max()),
            "parameter": found.parameter_names[worst],
            "disagreeing": tuple(compress(found.parameter_names, bad)),
            **_asked(found.n_frames, found.of_frames),
        },
        {"ratio_most": max(float(chance[worst]), JACKKNIFE_RATIO)},
        moving,
        () if moving else (Order(_OF_FRAMES),),
        good=not np.any(bad),
    )


def _asked(n_frames: int, of_frames: int) -> AnyDict:
    """Frames that a check is made from and those of the estimate, where the first are a sample."""
    return {"n_frames": n_frames, "of_frames": of_frames} if n_frames < of_frames else {}


STAR_REMEDY = calibrated(effects="star")


def stars(found: StarTest) -> Check:
    """Do stars bring errors of their own along?"""
    code, facts = Code.ERRORS_OF_THE_STARS, star_facts(found)
    if found.included_px > PLAUSIBLE_NOISE_PX[1]:
        # What is wrong with the directions or the lens looks like this where all frames show one
        # field.
        bounds = {"error_most_px": PLAUSIBLE_NOISE_PX[1]}
        return Check(code, facts, Level.FAIL, bounds, (), (Order(Advice.WITHOUT_STAR_ERRORS),))
    bounds = {"p_value_least": STAR_P}
    if not found.applicable or found.p_value >= STAR_P or found.included_px > 0.0:
        return Check(code, facts, bounds=bounds)
    widening = float(np.max(found.widening))
    added = Effect(facts["parameter"], float(np.sqrt(max(widening**2 - 1.0, 0.0))))
    level = added.level if found.p_value < STAR_FAIL_P else Level.WARN
    return Check(code, facts, level, bounds, STAR_REMEDY)


def star_facts(found: StarTest) -> AnyDict:
    """Size of the stars' own errors, and what they do to sigma."""
    facts: AnyDict = {
        "included_px": found.included_px,
        "included_std_px": found.included_px_std,
        **_asked(found.n_frames, found.of_frames),
    }
    if not found.applicable:
        return facts
    widest = int(np.argmax(found.widening))
    return facts | {
        "p_value": found.p_value,
        "seen": found.p_value < STAR_P,
        "error_px": found.tau_px,
        "error_std_px": found.tau_px_std,
        "visible_px": found.visible_px,
        "arcsec_per_px": found.arcsec_per_px,
        "parameter": found.parameter_names[widest],
        "widening": float(found.widening[widest]),
    }


def comparison(models: ModelComparison, attitude: AttitudeError | None = None) -> Check:
    """Does another distortion model predict left-out frames better, and would it move more than is
    stated?
    """
    mine, facts = models.of(models.fitted), model_facts(models)
    level = Level.PASS
    remedies: Remedies = ()
    if mine is not None and mine.rejected:
        # A gain of one nat is what a displacement gives whose square is two units of the noise.
        more = models.of_frames / models.n_frames if models.of_frames else 1.0
        bent = on_directions(-2.0 * mine.difference * more, mine.n_parameters)
        effect = largest([bent, *on_attitudes(attitude)])
        level, remedies = effect.level, with_model(models.better)
        facts |= effect.facts
    return Check(Code.DISTORTION_MODEL, facts, level, remedies=remedies)


def model_facts(models: ModelComparison) -> AnyDict:
    """Whether another model predicts left-out frames better, and what attitudes would do under the
    others.
    """
    mine, simplest = models.of(models.fitted), models.simplest
    facts: AnyDict = {"fitted": models.fitted, "best": models.scores[0].model}
    facts |= _asked(models.n_frames, models.of_frames)
    if mine is not None:
        facts |= {
            "difference_nat": mine.difference,
            "difference_se_nat": mine.difference_se,
        }
    if mine is not None and mine.rejected:
        facts |= {"better": models.better}
    elif mine is not None and simplest.n_parameters < mine.n_parameters:
        fewer = _coefficients(simplest.model)
        extra = tuple(name for name in _coefficients(models.fitted) if name not in fewer)
        facts |= {"simplest": simplest.model, "not_needed": extra}
    others = [score for score in models.accepted if score.model != models.fitted]
    if others:
        facts |= {
            "others": tuple(score.model for score in others),
            "common_arcsec": max(float(np.hypot(*score.common_arcsec[:2])) for score in others),
            "rest_arcsec": max(float(np.hypot(*score.rest_arcsec[:2])) for score in others),
        }
    return facts


def _coefficients(model: str) -> list[str]:
    return [c.name for c in get_model(model).coefficients]


def predictive(found: PredictiveCheck, remedies: Remedies = ROBUST) -> Check:
    """Do replicated data look like the measured ones?"""
    extreme = tuple(s.name for s in found.statistics if s.extreme)
    low = min(found.statistics, key=lambda s: min(s.p_value, 1.0 - s.p_value))
    return judged(
        Code.POSTERIOR_PREDICTIVE_CHECK,
        {"p_value": low.p_value, "n_draws": found.n_draws, "extreme": extreme},
        dict(zip(("p_value_least", "p_value_most"), EXTREME_P, strict=True)),
        remedies,
        good=not extreme,
    )


def starts(found: MultiStart) -> Check:
    """Do other starts lead to the same optimum?"""
    level = Level.PASS
    remedies: Remedies = ()
    orders: tuple[Order, ...] = ()
    if found.better:
        level, orders = Level.FAIL, (Order(Advice.NEARER_START),)
        if found.start:
            names = (f"focal_{found.focal_unit}", "x0_px", "y0_px")
            remedies = calibrated(start=dict(zip(names, found.start, strict=True)))
    elif found.same < found.n:
        level, remedies = Level.WARN, SCREEN
        orders = (Order(Advice.ACCEPT_THE_FOCAL_LENGTH),)
    facts = {
        "n_starts": found.n,
        "same": found.same,
        "better": found.better,
        "n_frames": found.n_frames,
        "of_frames": found.of_frames,
    }
    return Check(Code.OTHER_STARTS, facts, level, remedies=remedies, orders=orders)
