"""Checks of the estimate itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.calibration.fallback import fallback_words
from starcal_uq.camera.distortion import get_model, next_simpler
from starcal_uq.core.formatting import count, fixed, join_words, p_words, plural, significant
from starcal_uq.core.remedy import CAMERA, PLAN, Remedies, Remedy, calibrated, with_model
from starcal_uq.core.status import (
    Check,
    Code,
    Level,
    Status,
    pass_or_fail,
    pass_or_warn,
)
from starcal_uq.core.types import BoolArray
from starcal_uq.diagnostics.misfit import ALPHA
from starcal_uq.diagnostics.shapes import IN_FIELD
from starcal_uq.diagnostics.verdict.effect import (
    Effect,
    largest,
    of_pattern,
    on_attitudes,
    on_directions,
)
from starcal_uq.diagnostics.verdict.observed import (
    NOISE,
    PLAUSIBLE_NOISE_PX,
    ROBUST,
    SCREEN,
    lens_remedy,
)
from starcal_uq.estimation.undetermined import what_is_open
from starcal_uq.inference.checks import resample
from starcal_uq.inference.named import LIKELIHOODS
from starcal_uq.maths.intervals import student_quantile

if TYPE_CHECKING:
    from starcal_uq.calibration.cameras import MixedCameras
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.types import FloatArray
    from starcal_uq.diagnostics.diagnose import Diagnosis, MultiStart
    from starcal_uq.diagnostics.jackknife import Jackknife
    from starcal_uq.diagnostics.misfit import Misfit, MisfitTest
    from starcal_uq.diagnostics.models import ModelComparison
    from starcal_uq.diagnostics.predictive import PredictiveCheck
    from starcal_uq.diagnostics.stars import StarTest
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.attitude_error import AttitudeError

# False alarms by design. A run whose model holds is warned of in at most 5 % of cases and failed in
# at most 1 %: the sizes of all checks that ask noise a question (these, and PATTERN_P and
# OUTLIER_P) add up to less, whatever the data.
MISFIT_P, JACKKNIFE_P, STAR_P = ALPHA, 0.01, 0.01
MISFIT_FAIL_P, STAR_FAIL_P, ESTIMATORS_P, TRUTH_P = 1e-4, 1e-3, 3e-4, 3e-4
_REMEDIES = {
    Status.MAX_ITERATIONS: calibrated(max_iterations=1000),
    Status.OUTSIDE_DETECTOR: calibrated(solver="ipopt"),
    Status.FOLDED: calibrated(solver="ipopt"),
    Status.INCONSISTENT: SCREEN,
    Status.STALLED: calibrated(solver="minpack"),
}
_INFLATE = calibrated(accept_inflation=True)


def estimation(cal: Calibration, post: Posterior | None = None) -> Check:
    """Did the optimiser reach an optimum in every stage?"""
    steps = sum(len(stage.trajectory) - 1 for stage in cal.stages)
    words = cal.status.name.lower().replace("_", " ")
    if cal.status.ok:
        sentence = (
            f"All {plural(len(cal.stages), 'stage')} ended at an optimum, after "
            f"{plural(steps, 'iteration')}."
        )
    else:
        sentence = "The estimate is not an optimum."
    simpler = next_simpler(cal.camera.distortion)
    known = {
        Status.SINGULAR: with_model(simpler) + PLAN if simpler else PLAN,
        **_REMEDIES,
    }
    level = pass_or_fail(cal.status.ok)
    remedies = () if cal.solver == "filter" else known.get(cal.status, ())
    advice = "" if cal.status.ok else f"{cal.remedy[0].upper()}{cal.remedy[1:]}."
    if post is not None and cal.undetermined:
        # Sampling refuses priors that do not determine what the data leave open.
        level, said = Level.WARN, what_is_open(cal.undetermined)
        sentence = f"{said[0].upper()}{said[1:]}: there the posterior is that of the priors."
    return Check(Code.ESTIMATION, level, words, "converged", sentence, remedies, advice)


def determined(cal: Calibration) -> Check | None:
    """Do the data determine the model of the camera, without a simpler one and without the coma of
    noise?
    """
    record, sentence = cal.provenance.fallback, fallback_words(cal)
    if record:
        value, bound = str(record["used"]), str(record["model"])
    elif sentence:
        value, bound = "principal point from coma alone", "without"
    else:
        return None
    # To ask for what was fitted would determine nothing.
    return Check(
        Code.MODEL_THAT_THE_DATA_DETERMINE,
        Level.WARN,
        value,
        bound,
        sentence,
        PLAN,
    )


def estimators_agree(cal: Calibration) -> Check | None:
    """Do the interstar angles alone (the paper's estimator) lead to the same camera?"""
    difference = np.abs(cal.pair_theta - cal.theta)
    if not np.any(difference > 0.0):
        return None
    # The pair estimator is the less efficient one, so its own covariance bounds that of the
    # difference.
    z = difference / np.sqrt(np.diag(cal.pair_covariance))
    name, largest = cal.parameter_names[int(np.argmax(z))], float(np.max(z))
    limit = _largest_z(ESTIMATORS_P, cal)
    good = largest < limit
    sentence = (
        "Interstar angles alone, which do not involve the attitude, give the same camera."
        if good
        else (
            f"Interstar angles alone give another {name}: the data do not fit the model, or a "
            "wrong optimum was found."
        )
    )
    level = pass_or_fail(good)
    value = f"{fixed(largest, 1)} sigma ({name})"
    remedies = () if good else SCREEN
    return Check(
        Code.TWO_ESTIMATORS,
        level,
        value,
        f"< {fixed(limit, 1)} sigma",
        sentence,
        remedies,
    )


def _largest_z(size: float, cal: Calibration) -> float:
    """What the largest of the parameters' errors in sigma exceeds with this probability (Student,
    Bonferroni).
    """
    return student_quantile(1.0 - size / len(cal.theta), cal.dof)


def against_truth(cal: Calibration, truth: Camera, post: Posterior | None = None) -> Check:
    """Errors in units of sigma, where the truth is known."""
    z = truth_z(cal, truth, post)
    name, largest = cal.parameter_names[int(np.argmax(np.abs(z)))], float(np.max(np.abs(z)))
    limit = _largest_z(TRUTH_P, cal)
    good = largest < limit
    sentence = (
        "The truth of the simulation lies where the uncertainties say."
        if good
        else f"{name} is further from the truth than its sigma allows: the uncertainties are wrong."
    )
    value = f"largest |z| {fixed(largest, 1)} ({name})"
    level, bound = pass_or_fail(good), f"< {fixed(limit, 1)}"
    remedies = () if good else (Remedy("validate", (CAMERA,), form="command"),)
    return Check(Code.KNOWN_TRUTH, level, value, bound, sentence, remedies)


def truth_z(cal: Calibration, truth: Camera, post: Posterior | None = None) -> FloatArray:
    """(estimate - truth) / sigma of every camera parameter, from the posterior if there is one;
    shape (p,).
    """
    if post is not None:
        return np.asarray((post.mean - truth.theta) / post.sd[: len(post.mean)], dtype=np.float64)
    return np.asarray((cal.theta - truth.theta) / cal.sigmas, dtype=np.float64)


# Frames that scatter by less than this beyond the formal errors are of no consequence, however
# sure.
JACKKNIFE_RATIO = 1.1
_OF_FRAMES = "Calibrate stretches of frames apart (--only-frames), and compare the runs."
_OF_PHASE = "Accept it as noise, or point between frames by parts of a pixel more or less."
_NOT_OF_THE_LENS = {
    "pixel phase in x": _OF_PHASE,
    "pixel phase in y": _OF_PHASE,
    "magnitude": "Leave out the brightest or the faintest stars, and compare the runs.",
    "direction": "Check the times, and what the directions were declared to be.",
}


def model_checks(
    diagnosis: Diagnosis,
    cal: Calibration,
    post: Posterior | None = None,
    attitude: AttitudeError | None = None,
) -> list[Check]:
    """Every check that a diagnosis allows, of a calibration whose inflation may be accepted, and of
    its draws.
    """
    inflated = cal.inflation is not None
    better = None if diagnosis.comparison is None else diagnosis.comparison.better
    checks = [
        misfit(diagnosis.misfit, cal, attitude, better),
        even_noise(diagnosis.misfit, inflated),
    ]
    checks += [] if diagnosis.cameras is None else [one_camera(diagnosis.cameras)]
    checks += (
        [] if diagnosis.jackknife is None else [jackknife(diagnosis.jackknife, inflated, post)]
    )
    checks += [] if diagnosis.stars is None else [stars(diagnosis.stars)]
    checks += [] if diagnosis.comparison is None else [comparison(diagnosis.comparison, attitude)]
    return [*checks, predictive(diagnosis.predictive)]


def one_camera(found: MixedCameras) -> Check:
    """Do the frames' own focal lengths ask for several cameras?"""
    remedies = calibrated("command", frames=found.frames)
    sentence = f"{found.words[0].upper()}{found.words[1:]}."
    return Check(
        Code.ONE_CAMERA,
        Level.FAIL,
        f"{found.n} cameras",
        "1",
        sentence,
        remedies,
    )


# Standard errors by which a change of a parameter differs from none, and growth of its error that
# is far.
_HARDLY_TOLD = 3.0


def misfit(
    found: Misfit,
    cal: Calibration,
    attitude: AttitudeError | None = None,
    better: str | None = None,
) -> Check:
    """Is there structure in the residuals, and does it do more than is stated? `better` as for
    `lens_remedy`.
    """
    name, bound = Code.UNEXPLAINED_STRUCTURE, f"p ≥ {MISFIT_P:g}"
    patterns = [test.p_holm for test in found.tests if not test.is_of_noise]
    value = (
        f"{p_words(min(patterns, default=1.0))}, corrected for {plural(len(found.tests), 'test')}"
    )
    rejected = [test for test in found.found(MISFIT_P) if not test.is_of_noise]
    if not rejected:
        sentence = (
            "The residuals show no structure beyond noise, in any of the ways that were looked for."
        )
        return Check(name, Level.PASS, value, bound, sentence)
    words = []
    for test in rejected[:3]:
        size = "" if np.isnan(test.size_px) else f", {significant(test.size_px)} px"
        words.append(f"{test.name} ({p_words(test.p_holm)}{size})")
    more = "" if len(rejected) <= 3 else f" and {plural(len(rejected) - 3, 'other test')}"
    booked = on_attitudes(attitude) if found.pattern is not None and found.pattern.families else []
    effect = largest([*of_pattern(found.pattern, rejected, cal), *booked])
    sentence = (
        f"The residuals hold more than noise: {join_words(words)}{more}. "
        f"{effect}{_hardly_told(rejected[0])}"
    )
    level = effect.level if min(patterns) < MISFIT_FAIL_P else Level.WARN
    # A lens can follow what keeps its place in the field, and no option here what does not.
    remedies: Remedies = ()
    advice = _NOT_OF_THE_LENS.get(rejected[0].against, _OF_FRAMES)
    if any(t.against in IN_FIELD for t in rejected):
        remedies, advice = lens_remedy(cal.camera.distortion, better)
    return Check(name, level, value, bound, sentence, remedies, advice)


def _hardly_told(test: MisfitTest) -> str:
    """Statement that shapes can hardly be separated from the parameter that they move; else
    nothing.
    """
    if not test.moved_std > _HARDLY_TOLD or test.moved_sigma > _HARDLY_TOLD * test.moved_std:
        return ""
    return (
        f" These data hardly tell {test.name} from {test.moved_name}: with both fitted, the "
        f"error of {test.moved_name} "
        f"would be {significant(float(np.hypot(1.0, test.moved_std)))} times as large."
    )


def even_noise(found: Misfit, inflated: bool = False) -> Check:
    """Is the noise what the weights of the stars say?"""
    tests = [test for test in found.tests if test.is_of_noise]
    rejected = [test for test in found.found(MISFIT_P) if test.is_of_noise]
    name, bound = Code.EVENNESS_OF_THE_NOISE, f"p ≥ {MISFIT_P:g}"
    value = p_words(min((test.p_holm for test in tests), default=1.0))
    if not rejected:
        sentence = (
            "The noise does not change with radius, magnitude, time, frame or axis beyond what "
            "the weights know of it."
        )
        return Check(name, Level.PASS, value, bound, sentence)
    changes = f"The residuals hold {join_words([test.name for test in rejected])}"
    if found.uneven is None and inflated:
        sentence = (
            f"{changes}, which the weights of the stars do not know; the accepted inflation "
            "holds it."
        )
        return Check(name, Level.PASS, value, bound, sentence)
    if found.uneven is None:
        sentence = (
            f"{changes}, which the weights of the stars do not know: the stated sigmas may be "
            "wrong."
        )
        return Check(name, Level.WARN, value, bound, sentence, _INFLATE)
    uneven = found.uneven
    if not uneven.model.varies:
        sentence = f"{changes}, too little of it to change a stated sigma."
        return Check(name, Level.PASS, value, bound, sentence)
    of_attitude = (
        "" if uneven.model.axes is None else " and the attitude noise of each axis is another"
    )
    worst = int(np.argmax(np.abs(np.log(uneven.ratios))))
    sentence = (
        f"{changes}: {uneven.model}. The stated sigmas do not know it: that of "
        f"{uneven.parameter_names[worst]} should "
        f"be {significant(float(uneven.ratios[worst]))} times as large{of_attitude}; with fitted "
        "weights the estimate "
        "itself would be more precise."
    )
    return Check(name, Level.WARN, value, bound, sentence, NOISE)


def sensitivity(diagnosis: Diagnosis) -> str:
    """The smallest effects that the checks find nine times in ten, with as many data as there
    were.
    """
    found, frames = diagnosis.misfit, diagnosis.jackknife
    smooth = [test for test in found.tests if test.against == "radius" and test.detectable_px > 0.0]
    seen = []
    if smooth:
        test = smooth[-1]
        seen.append(
            f"a {test.name} of {significant(test.detectable_px)} px (rms per axis, beyond what "
            "the fit absorbs)"
        )
    if frames is not None:
        ratio = float(frames.detectable(JACKKNIFE_P / len(frames.ratio)).min())
        seen.append(f"frames that make sigma {significant(ratio)} times as large as stated")
    if not seen:
        return ""
    data = f"{plural(found.n_frames, 'frame')} and {plural(found.n_stars, 'star')}"
    return (
        f"What {data} let these checks see nine times in ten: {join_words(seen)}; less may be "
        "there."
    )


def disagreeing(found: Jackknife) -> BoolArray:
    """Parameters (p,) in which frames scatter by more than chance and by enough to matter."""
    return np.asarray(
        (found.p_values * len(found.p_values) < JACKKNIFE_P) & (found.ratio > JACKKNIFE_RATIO)
    )


def jackknife(found: Jackknife, inflated: bool = False, post: Posterior | None = None) -> Check:
    """Do frames scatter as their formal errors say?"""
    worst, bad = int(np.argmax(found.ratio)), disagreeing(found)
    low, high = float(found.ratio.min()), float(found.ratio.max())
    value = f"ratios {fixed(low, 2)} to {fixed(high, 2)} ({found.parameter_names[worst]})"
    chance = found.expected(1.0 - 2.0 * JACKKNIFE_P / len(bad))[1]
    bound = f"≤ {fixed(max(float(chance[worst]), JACKKNIFE_RATIO), 2)}"
    remedies: Remedies = ()
    formal = inflated and post is not None and post.inflation is None
    if np.any(bad):
        names = [name for name, flag in zip(found.parameter_names, bad, strict=True) if flag]
        accepted = (
            "The inflation is accepted: it has multiplied"
            if inflated
            else "Accepting the inflation multiplies"
        )
        draws = ", but not that of the draws" if formal else ""
        sentence = (
            f"Frames disagree more than their formal errors allow, in {join_words(names)}: "
            "something makes stars of "
            f"a frame err together. {accepted} sigma by up to {fixed(high, 2)}{draws}."
        )
        if not inflated:
            remedies = _INFLATE
        elif formal and post is not None:
            remedies = _resample(post)
    else:
        sentence = "Frames scatter as the formal errors say."
    level = pass_or_warn(not remedies)
    return Check(Code.JACKKNIFE_OVER_FRAMES, level, value, bound, sentence, remedies)


def _resample(post: Posterior) -> Remedies:
    """Sampling again; by the default likelihood where it was an object of the user's, which is used
    as it is.
    """
    return (
        resample(post)
        if post.diagnostics.likelihood in LIKELIHOODS
        else resample(post, likelihood="marginal")
    )


STAR_REMEDY = calibrated(star_errors=True)


def stars(found: StarTest) -> Check:
    """Do stars bring errors of their own along?"""
    name, bound = Code.ERRORS_OF_THE_STARS, f"p ≥ {STAR_P:g}"
    if found.included_px > PLAUSIBLE_NOISE_PX[1]:
        # What is wrong with the directions or the lens looks like this where all frames show one
        # field.
        value = f"{significant(found.included_px)} ± {significant(found.included_px_std)} px"
        bound = f"≤ {PLAUSIBLE_NOISE_PX[1]:g} px"
        sentence = (
            f"{star_sentence(found)} No catalogue errs by that: something else is wrong, and is "
            "hidden by it."
        )
        advice = "Leave --star-errors out (star_errors=False), and see which checks then fail."
        return Check(name, Level.FAIL, value, bound, sentence, advice=advice)
    if not found.applicable:
        value = "too few stars recur"
        return Check(name, Level.PASS, value, bound, star_sentence(found))
    widest = int(np.argmax(found.widening))
    ratio = float(found.widening[widest])
    value = (
        f"p = {significant(found.p_value)}, sigma × {fixed(ratio, 2)} "
        f"({found.parameter_names[widest]})"
    )
    if found.p_value >= STAR_P:
        return Check(name, Level.PASS, value, bound, star_sentence(found))
    if found.included_px > 0.0:
        value, bound = (
            f"{significant(found.included_px)} ± {significant(found.included_px_std)} px",
            "in the intervals",
        )
        return Check(name, Level.PASS, value, bound, star_sentence(found))
    added = Effect(found.parameter_names[widest], float(np.sqrt(max(ratio**2 - 1.0, 0.0))))
    level = added.level if found.p_value < STAR_FAIL_P else Level.WARN
    return Check(name, level, value, bound, star_sentence(found), STAR_REMEDY)


def star_sentence(found: StarTest) -> str:
    """Size of the stars' own errors, and what they do to sigma."""

    def sized(px: float) -> str:
        return f"{significant(px)} px ({significant(px * found.arcsec_per_px)} arcsec)"

    if not found.applicable:
        return (
            "Too few stars are seen in several frames to test whether a star errs alike in all "
            "of them; where none is, "
            "such errors act as noise."
        )
    if found.p_value >= STAR_P:
        return (
            "Residuals of one star in different frames are as independent as noise; a direction "
            "error of "
            f"{sized(found.visible_px)} would have been seen nine times in ten."
        )
    if found.included_px > 0.0:
        return (
            f"Each star brings a direction error of {sized(found.included_px)} ± "
            f"{significant(found.included_px_std)} "
            "px per axis along into every frame; estimate and intervals hold that."
        )
    widest = int(np.argmax(found.widening))
    error = significant(found.tau_px_std)
    return (
        f"Each star brings a direction error of {sized(found.tau_px)} ± {error} px per axis "
        "along into every frame: "
        "more frames of the same stars do not average it out, and sigma of "
        f"{found.parameter_names[widest]} is "
        f"{fixed(float(found.widening[widest]), 2)} times what is stated."
    )


def comparison(models: ModelComparison, attitude: AttitudeError | None = None) -> Check:
    """Does another distortion model predict left-out frames better, and would it move more than is
    stated?
    """
    mine = models.of(models.fitted)
    if mine is None or mine.difference == 0.0:
        value = f"{models.fitted!r} predicts best"
    else:
        value = (
            f"{fixed(mine.difference, 1)} ± {fixed(mine.difference_se, 1)} nat from "
            f"{models.scores[0].model!r}"
        )
    level, sentence = Level.PASS, models_sentence(models)
    remedies: Remedies = ()
    if mine is not None and mine.rejected:
        # A gain of one nat is what a displacement gives whose square is two units of the noise.
        bent = on_directions(-2.0 * mine.difference, mine.n_parameters)
        effect = largest([bent, *on_attitudes(attitude)])
        level, remedies = effect.level, with_model(models.better)
        sentence = f"{sentence} {effect}"
    return Check(Code.DISTORTION_MODEL, level, value, "not rejected", sentence, remedies)


def models_sentence(models: ModelComparison) -> str:
    """Whether another model predicts left-out frames better, and what attitudes would do under the
    others.
    """
    mine, simplest = models.of(models.fitted), models.simplest
    if mine is not None and mine.rejected:
        best = models.scores[0]
        first = (
            f"The model {models.fitted!r} predicts left-out frames worse than {best.model!r} by "
            f"{fixed(-mine.difference, 1)} ± {fixed(mine.difference_se, 1)} nat: use "
            f"{models.better!r}."
        )
    elif mine is not None and simplest.n_parameters < mine.n_parameters:
        fewer, all_of_them = (_coefficients(model) for model in (simplest.model, models.fitted))
        extra = [name for name in all_of_them if name not in fewer]
        verb = "is" if len(extra) == 1 else "are"
        first = (
            f"{join_words(extra)} {verb} not needed: {simplest.model!r} predicts left-out frames "
            "no worse than "
            f"{models.fitted!r}."
        )
    else:
        first = (
            f"No other model predicts left-out frames better than {models.fitted!r} beyond doubt."
        )
    others = [score for score in models.accepted if score.model != models.fitted]
    if not others:
        return first + " All other models are rejected."
    common = max(float(np.hypot(*score.common_arcsec[:2])) for score in others)
    rest = max(float(np.hypot(*score.rest_arcsec[:2])) for score in others)
    return (
        f"{first} Under the other models that the data do not reject "
        f"({join_words([score.model for score in others])}), attitudes across the boresight "
        "would move by up to "
        f"{significant(common)} arcsec in common and {significant(rest)} arcsec (rms) frame by "
        "frame."
    )


def _coefficients(model: str) -> list[str]:
    return [c.name for c in get_model(model).coefficients]


def predictive(found: PredictiveCheck) -> Check:
    """Do replicated data look like the measured ones?"""
    extreme = [s for s in found.statistics if s.extreme]
    low = min(found.statistics, key=lambda s: min(s.p_value, 1.0 - s.p_value))
    value = f"most extreme {p_words(low.p_value, 1.0 / found.n_draws)}"
    if extreme:
        sentence = (
            "Data made by the model differ from the measured ones in: "
            f"{join_words([s.name for s in extreme])}."
        )
    else:
        sentence = (
            "Data made by the model have the same spread, tails and patterns as the measured ones."
        )
    name = Code.POSTERIOR_PREDICTIVE_CHECK
    level, remedies = pass_or_warn(not extreme), ROBUST if extreme else ()
    return Check(name, level, value, "0.001 to 0.999", sentence, remedies)


def starts(found: MultiStart) -> Check:
    """Do other starts lead to the same optimum?"""
    value = f"{found.same} of {found.n} starts"
    if found.n_frames < found.of_frames:
        value += f", {count(found.n_frames)} of {plural(found.of_frames, 'frame')}"
    remedies: Remedies = ()
    advice = ""
    if found.better:
        level, sentence = Level.FAIL, "A start elsewhere reached a better optimum."
        advice = "Calibrate again from there, or from a camera file that is nearer to the lens."
        if found.start:
            names = (f"focal_{found.focal_unit}", "x0_px", "y0_px")
            remedies = calibrated(start=dict(zip(names, found.start, strict=True)))
    elif found.same < found.n:
        stuck = found.n - found.same
        level = Level.WARN
        sentence = (
            f"{plural(stuck, 'start')} did not reach this optimum, and no start reached a better "
            "one."
        )
        remedies = SCREEN
        advice = "Accept it if the focal length of the camera file is surely good to 5 %."
    else:
        level, sentence = (
            Level.PASS,
            "Starts scattered around the nominal camera all lead to this optimum.",
        )
    return Check(
        Code.OTHER_STARTS,
        level,
        value,
        "all at the same optimum",
        sentence,
        remedies,
        advice,
    )
