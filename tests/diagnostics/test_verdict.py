"""Every check of the verdict, turned to its other outcome."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.formatting import significant
from starcal_uq.core.remedy import calibrated
from starcal_uq.core.status import Advice, Check, Code, Level, Order, Question
from starcal_uq.diagnostics.diagnose import diagnose
from starcal_uq.diagnostics.models import REJECT_P
from starcal_uq.diagnostics.residuals import (
    bin_residuals,
    normalised_residuals,
    of_heard,
    residual_scale,
)
from starcal_uq.diagnostics.verdict import estimate
from starcal_uq.diagnostics.verdict import limits as limiting
from starcal_uq.diagnostics.verdict.draws import propagation_difference
from starcal_uq.diagnostics.verdict.judge import judge
from starcal_uq.diagnostics.verdict.observed import OUTLIER_P, PATTERN_P, aberration_size
from starcal_uq.inference.checks import check_draws
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.presentation.words.numbers import mean_to_mcse
from starcal_uq.presentation.words.sentences import say, told
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.onboard import Extended
from starcal_uq.propagation.onboard_error import OnboardError
from tests.helpers.outside import campaign
from tests.helpers.scenes import camera, observations, with_sigmas


def limits(*results, **more):
    """What limits a run, in sentences."""
    return [one.sentence for one in limiting.limits(*results, **more)]


@pytest.fixture(scope="module")
def run():
    obs = observations(n_frames=120)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    return SimpleNamespace(
        obs=obs, cal=cal, post=sc.sample(obs, cal, seed=1, n_steps=100), truth=camera()
    )


def outcome(name: str, obs, cal, post=None, truth=None):
    return next(check for check in judge(obs, cal, post, truth).checks if check.name == name)


def judged(post):
    """Changed draws with the checks that sampling would have made of them."""
    return dataclasses.replace(
        post, diagnostics=dataclasses.replace(post.diagnostics, checks=check_draws(post))
    )


def with_diagnostics(post, **changes):
    return judged(
        dataclasses.replace(post, diagnostics=dataclasses.replace(post.diagnostics, **changes))
    )


def test_a_good_run_passes_every_check(run):
    verdict = judge(run.obs, run.cal, run.post, run.truth)
    assert verdict.level is Level.PASS, verdict.at(Level.FAIL) + verdict.at(Level.WARN)
    assert len(verdict.checks) == 18
    # Requirements belong to a budget, which is not here.
    assert {check.question for check in verdict.checks} == {
        Question.CONVERGED,
        Question.TRUSTWORTHY,
    }
    assert all(
        check.sentence.endswith(".") and check.value and check.bound for check in verdict.checks
    )
    assert "every check passed" in verdict.headline
    unsampled = judge(run.obs, run.cal)
    assert unsampled.level is Level.PASS and "not been sampled" in unsampled.headline


@pytest.mark.parametrize(
    ("level", "words"),
    [
        (Level.FAIL, "Violated: requirement 'R-1'. Converged, and every check passed"),
        (Level.WARN, "can be used. Open: requirement 'R-1'."),
        (Level.PASS, "Converged, and every check passed: the stated uncertainties can be used."),
    ],
)
def test_a_requirement_of_the_budget_is_part_of_the_verdict(run, level, words):
    required = Check(
        Code.REQUIREMENT,
        level=level,
        title="Requirement 'R-1'",
    )
    verdict = judge(run.obs, run.cal, run.post, run.truth, requirements=[required])
    assert verdict.level is level and verdict.level.exit_status == (level is Level.FAIL)
    assert words in verdict.headline and verdict.of(Question.REQUIRED) == (required,)
    # Control: the numbers themselves are judged as they were.
    assert judge(run.obs, run.cal, run.post, run.truth).level is Level.PASS


STRUCTURE = Check(
    Code.UNEXPLAINED_STRUCTURE,
    {"effects": ("field", "phase")},
    Level.FAIL,
    remedies=calibrated(effects="auto"),
)
REFRACTION = Check(
    Code.CATALOGUE_DIRECTIONS, {}, Level.FAIL, remedies=calibrated("command", site="S", time="T")
)
STARS = Check(Code.ERRORS_OF_THE_STARS, {}, Level.FAIL, orders=(Order(Advice.WITHOUT_STAR_ERRORS),))
SITE = {"latitude_deg": 52.0, "longitude_deg": 4.4}


@pytest.mark.parametrize(
    ("check", "words"),
    [
        (
            STRUCTURE,
            "unexplained structure failed; if nothing to try helps, these data would tell: the same "
            "stars at other places of the detector and frames that are shifted by parts of a pixel.",
        ),
        (
            REFRACTION,
            "catalogue directions failed; if nothing to try helps, these data would tell: the time "
            "of every frame in UTC and the site.",
        ),
        (
            STARS,
            "errors of the stars failed and no model here explains this; these data would tell: "
            "directions from another catalogue.",
        ),
    ],
)
def test_what_is_not_usable_is_one_statement_with_the_data_that_would_tell(run, check, words):
    verdict = judge(run.obs, run.cal, requirements=[check])
    assert verdict.headline == f"Not usable, because {words}"
    assert verdict.ended == (verdict.headline if check is STARS else "")
    assert words in verdict.text
    # The control: a warning asks for no data.
    mild = judge(run.obs, run.cal, requirements=[dataclasses.replace(check, level=Level.WARN)])
    assert "would tell" not in mild.headline


def test_data_that_were_given_are_not_asked_for(run):
    placed = run.obs.with_origin(site=SITE)
    assert "would tell: the time" in judge(placed, run.cal, requirements=[REFRACTION]).headline
    times = np.full(run.obs.n_stars, "2026-11-26T02:00:00")
    timed = dataclasses.replace(placed, time_utc=times)
    verdict = judge(timed, run.cal, requirements=[REFRACTION])
    assert verdict.headline == "Not usable, because catalogue directions failed."


def test_digits_that_monte_carlo_error_reaches_warn(run):
    check = outcome("Digits", run.obs, run.cal, with_diagnostics(run.post, mcse=0.2 * run.post.sd))
    assert check.level is Level.WARN
    assert mean_to_mcse(12.34567, 0.012) == "12.3"
    assert mean_to_mcse(12.34567, 0.0008) == "12.346"


def test_a_posterior_of_other_data_fails(run):
    other = dataclasses.replace(
        run.post, provenance={**run.post.provenance, "data_sha256": "0" * 64}
    )
    assert outcome("Data of the posterior", run.obs, run.cal, other).level is Level.FAIL


@pytest.fixture(scope="module")
def found(run):
    return diagnose(run.obs, run.cal, models=("k1", "brown"), n_starts=2)


class TestDiagnosis:
    """Every check of the model, as it is and turned to its other outcome."""

    def check(self, run, found, name):
        verdict = judge(run.obs, run.cal, diagnosis=found)
        return next(check for check in verdict.checks if check.name == name)

    def test_all_pass_on_data_of_the_model(self, run, found):
        verdict = judge(run.obs, run.cal, diagnosis=found)
        assert verdict.level is Level.PASS, verdict.at(Level.WARN) + verdict.at(Level.FAIL)
        names = {check.name for check in verdict.checks}
        assert names >= {
            "Unexplained structure",
            "Jackknife over frames",
            "Distortion model",
            "Other starts",
        }
        assert "Posterior predictive check" in names
        assert all(
            check.sentence.endswith(".") and check.value and check.bound for check in verdict.checks
        )
        assert not any(s.startswith("The model") for s in limits(run.obs, run.cal, diagnosis=found))

    def reject(self, found, start, p):
        tests = tuple(
            dataclasses.replace(
                t, p_value=p, p_holm=p, statistic=20.0, size_px=0.02 if t.dof else t.size_px
            )
            if t.name.startswith(start)
            else t
            for t in found.misfit.tests
        )
        return dataclasses.replace(found, misfit=dataclasses.replace(found.misfit, tests=tests))

    def test_structure_warns_or_fails_by_what_it_does(self, run, found):
        weak = self.check(run, self.reject(found, "decentring", 0.005), "Unexplained structure")
        strong = self.check(run, self.reject(found, "decentring", 1e-6), "Unexplained structure")
        phase = self.check(
            run,
            self.reject(found, "error with the pixel phase in x", 1e-9),
            "Unexplained structure",
        )
        noise = self.check(
            run, self.reject(found, "noise that changes with mag", 1e-9), "Evenness of the noise"
        )
        assert [c.level for c in (weak, strong, phase, noise)] == [
            Level.WARN,
            Level.FAIL,
            Level.WARN,
            Level.WARN,
        ]
        assert (
            "decentring" in strong.sentence
            and "moves directions over the field by" in strong.sentence
        )
        assert "moves no parameter" in phase.sentence
        # The same shapes, once the fit has taken up so much of them that a parameter is off.
        for taken, level in ((0.5, Level.WARN), (2.0, Level.FAIL)):
            changed = self.reject(found, "error with the pixel phase in x", 1e-9)
            theta = run.cal.theta - taken * run.cal.sigmas * np.array([0.0, 1.0, 0.0, 0.0, 0.0])
            extended = Extended(
                run.cal.camera.with_theta(theta),
                run.cal.covariance,
                Effects((), True, (), 0.0),
                run.cal.provenance,
            )
            changed = dataclasses.replace(changed, extended=extended)
            check = self.check(run, changed, "Unexplained structure")
            assert check.level is level and f"y0 by {significant(taken)}" in check.sentence

    def test_frames_that_disagree_warn_with_the_factor(self, run, found):
        scatter = dataclasses.replace(
            found.jackknife, sandwich_covariance=4.0 * found.jackknife.formal_covariance
        )
        check = self.check(
            run, dataclasses.replace(found, jackknife=scatter), "Jackknife over frames"
        )
        assert check.level is Level.WARN
        assert "up to 2.00" in check.sentence

    def test_a_rejected_model_fails(self, run, found):
        poor = dataclasses.replace(
            found, comparison=dataclasses.replace(found.comparison, fitted="k1")
        )
        check = self.check(run, poor, "Distortion model")
        assert check.level is Level.FAIL and "use 'brown'" in check.sentence

    def test_replicates_and_starts(self, run, found):
        odd = dataclasses.replace(found.predictive.statistics[1], p_value=0.0)
        predictive = dataclasses.replace(found.predictive, statistics=(odd,))
        check = self.check(
            run, dataclasses.replace(found, predictive=predictive), "Posterior predictive check"
        )
        assert check.level is Level.WARN and "largest residual" in check.sentence
        for change, level in (
            ({"better": 1, "same": 1}, Level.FAIL),
            ({"same": 1, "failed": 1}, Level.WARN),
        ):
            starts = dataclasses.replace(found.starts, **change)
            assert (
                self.check(run, dataclasses.replace(found, starts=starts), "Other starts").level
                is level
            )

    def test_a_structure_is_a_limit(self, run, found):
        bent = self.reject(found, "decentring", 1e-6)
        assert "decentring" in limits(run.obs, run.cal, diagnosis=bent)[0]


def test_an_estimate_that_did_not_converge_fails_with_its_remedy(run):
    cal = dataclasses.replace(run.cal, status=sc.core.Status.MAX_ITERATIONS)
    check = outcome("Estimation", run.obs, cal)
    assert check.level is Level.FAIL
    assert sc.core.Status.MAX_ITERATIONS.remedy[1:] in check.advice


def test_estimators_that_disagree_fail(run):
    shifted = run.cal.theta + 6.0 * np.sqrt(np.diag(run.cal.pair_covariance)) * np.array(
        [0, 0, 1, 0, 0]
    )
    check = outcome("Two estimators", run.obs, dataclasses.replace(run.cal, pair_theta=shifted))
    assert check.level is Level.FAIL
    assert "(f)" in check.value


@pytest.mark.parametrize("declared", ["undeclared", "catalogue"])
def test_undeclared_directions_warn_with_the_size_of_the_effect(run, declared):
    obs = dataclasses.replace(run.obs, meta={**run.obs.meta, "directions": declared})
    check = outcome("Catalogue directions", obs, run.cal)
    assert check.level is Level.WARN
    assert ("Neither time nor observer velocity was declared" in check.sentence) == (
        declared == "undeclared"
    )
    # 20.5 arcsec of aberration times the field's diagonal of 0.246 rad.
    assert "5.0 arcsec" in check.sentence


def test_wrong_truth_fails(run):
    wrong = run.truth.replace(focal_mm=run.truth.focal_mm * 1.001)
    assert outcome("Known truth", run.obs, run.cal, run.post, wrong).level is Level.FAIL
    assert outcome("Known truth", run.obs, run.cal, None, run.truth).level is Level.PASS


def test_outliers_warn_and_are_located(run):
    residuals = run.cal.residuals_px.copy()
    residuals[[5, 400]] += 0.4
    check = outcome("Outliers", run.obs, dataclasses.replace(run.cal, residuals_px=residuals))
    assert check.level is Level.WARN
    assert check.value.startswith("2 stars")
    assert (
        f"frame {run.obs.frame[5]}" in check.sentence
        or f"frame {run.obs.frame[400]}" in check.sentence
    )


@pytest.mark.parametrize("wrong", [(), (5, 40, 77)])
def test_wrong_stars_that_tails_outweigh_are_named(run, wrong):
    x = np.array(run.obs.x_px)
    x[list(wrong)] += 30.0
    obs = dataclasses.replace(run.obs, x_px=x)
    cal = sc.calibrate(obs, sc.paper.paper_start(), effects="tails")
    check = outcome("Outliers", obs, cal)
    named = {(one["frame"], one["x_px"]) for one in check.values["beyond_tails"]}
    assert named == {(int(obs.frame[row]), float(x[row])) for row in wrong}
    assert ("3 stars are probably identified wrongly" in check.sentence) == bool(wrong)


@pytest.mark.parametrize(
    ("sigma", "level"), [(0.05, Level.PASS), (2.0, Level.WARN), (0.0001, Level.WARN)]
)
def test_noise_must_be_that_of_centroids(run, sigma, level):
    cal = dataclasses.replace(run.cal, sigma=sigma)
    assert outcome("Centroid noise per axis", run.obs, cal).level is level


def test_few_frames_and_an_empty_corner_warn(run):
    few = run.obs.select_frames(run.obs.frame_ids[:3])
    cal = sc.calibrate(few, sc.paper.paper_start())
    assert outcome("Coverage of the field", few, cal).level is Level.WARN
    half = np.asarray(run.obs.x_px < 600)
    cal = dataclasses.replace(run.cal, residuals_px=run.cal.residuals_px[half])
    check = outcome("Coverage of the field", run.obs.select(half), cal)
    assert check.level is Level.WARN
    assert "extrapolated" in check.sentence


def test_a_pattern_in_the_residuals_is_found_and_sized(run):
    """A displacement of 0.05 px across the field, which the fit did not see."""
    pattern = 0.05 * np.stack([np.sin(run.obs.x_px / 200.0), np.cos(run.obs.y_px / 200.0)], axis=1)
    cal = dataclasses.replace(run.cal, residuals_px=run.cal.residuals_px + pattern)
    assert bin_residuals(cal, run.obs).pattern_px == pytest.approx(0.05 / np.sqrt(2.0), rel=0.15)
    check = outcome("Pattern in the residuals", run.obs, cal)
    assert check.level is Level.FAIL
    assert "not in any interval" in check.sentence
    assert limits(run.obs, cal)[0].startswith("The model")
    assert "moves directions over the field by" in check.sentence


@pytest.mark.slow
def test_wrong_stars_of_a_robust_estimate_are_no_pattern(run):
    rng = np.random.default_rng(2)
    wrong = rng.random(run.obs.n_stars) < 0.05
    obs = dataclasses.replace(
        run.obs, dec_deg=run.obs.dec_deg + 0.8 * wrong * rng.choice([-1.0, 1.0], run.obs.n_stars)
    )
    cal = sc.calibrate(obs, sc.paper.paper_start(), effects="tails")
    assert outcome("Pattern in the residuals", obs, cal).level is Level.PASS
    assert outcome("Outliers", obs, cal).level is not Level.PASS
    # A pattern of the others is found, and their mean is one with the wrong stars where no tails
    # were asked for.
    pattern = 0.05 * np.stack([np.sin(obs.x_px / 200.0), np.cos(obs.y_px / 200.0)], axis=1)
    bent = dataclasses.replace(cal, residuals_px=cal.residuals_px + pattern)
    assert bin_residuals(bent, obs).pattern_px == pytest.approx(0.05 / np.sqrt(2.0), rel=0.2)
    plain = dataclasses.replace(cal, provenance={})
    assert outcome("Pattern in the residuals", obs, plain).level is Level.FAIL
    # So it is with the tests of the model, in frames that keep three stars.
    first = obs.frame == obs.frame_ids[0]
    obs = dataclasses.replace(
        obs, dec_deg=run.obs.dec_deg + 0.8 * (wrong & ~first | first & (np.cumsum(first) == 3))
    )
    obs = obs.select(~first | (np.cumsum(first) <= 3))
    cal = sc.calibrate(obs, sc.paper.paper_start(), effects="tails")
    assert of_heard(obs, cal)[0].n_frames < obs.n_frames
    tests, control = (
        sc.diagnostics.misfit_tests(obs, c) for c in (cal, dataclasses.replace(cal, provenance={}))
    )
    assert estimate.misfit(tests, cal).level is estimate.even_noise(tests).level is Level.PASS
    assert estimate.even_noise(control).level is Level.WARN


def test_the_pattern_test_raises_no_more_false_alarms_than_it_says(run):
    """Residuals that are noise alone, 400 times."""
    rng = np.random.default_rng(5)
    scale = residual_scale(run.cal, run.obs)[:, None]
    p = [
        bin_residuals(
            dataclasses.replace(
                run.cal, residuals_px=scale * rng.standard_normal((run.obs.n_stars, 2))
            ),
            run.obs,
        ).p_value
        for _ in range(400)
    ]
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 400))


def test_binned_means_are_means_of_the_cells(run):
    binned = bin_residuals(run.cal, run.obs)
    assert binned.counts.sum() <= run.obs.n_stars
    assert binned.counts.min() >= 5
    k = 7
    inside = np.all(np.abs(run.obs.xy - binned.centres[k]) <= binned.cell_px / 2.0, axis=1)
    assert np.count_nonzero(inside) == binned.counts[k]
    assert binned.means[k] == pytest.approx(run.cal.residuals_px[inside].mean(axis=0))


def test_stated_noise_is_a_factor():
    obs = with_sigmas(observations(n_frames=60))
    cal = sc.calibrate(obs, sc.paper.paper_start())
    assert cal.sigma_name == "sigma_scale"
    assert np.std(normalised_residuals(cal, obs)) == pytest.approx(1.0, abs=0.02)
    verdict = judge(obs, cal)
    assert "Factor on the stated noise" in [check.name for check in verdict.checks]


def test_limits_name_the_largest_term_and_the_coupling(run):
    sizes = [np.array([0.5, 0.5, 7.0]), np.array([5.4, 5.5, 0.1]), np.array([0.02, 0.02, 0.2])]
    nothing = np.full((5, 4), np.nan)
    error = AttitudeError(*sizes, nothing, nothing, *sizes, n_draws=300, n_frames=100)
    sentences = limits(run.obs, run.cal, sc.coupling(run.post), error)
    assert "common rotation, one constant, exceeds centroid noise. Alignment" in sentences[0]
    line = told("attitude_line", error)
    assert line.startswith("0.020 arcsec per axis across the boresight and 0.20 in roll after")
    assert "a common rotation of 5.5 and 0.10 (1 sigma, if the model holds; with the" in line
    parts = error.common_arcsec, np.array([0.5, 0.5, 7.0]), np.array([5.5, 5.5, 7.0])
    found = OnboardError("model", *parts, ())
    tested = told("attitude_line", dataclasses.replace(error, misfit=found))
    assert tested.startswith("0.50 (0.020) arcsec per axis across the boresight and 7.0 (0.20) in")
    assert "(1 sigma, with the misfit found; in brackets if the model holds)" in tested
    assert "k1 trades against k2" in sentences[1] or "f trades against" in sentences[1]
    small = dataclasses.replace(error, common_arcsec=np.full(3, 0.1))
    assert (
        "centroid noise of a single frame dominates" in limits(run.obs, run.cal, attitude=small)[0]
    )


def test_propagation_that_departs_from_first_order_warns(run):
    error = sc.propagate(run.post, run.obs, n_draws=200, seed=1)
    verdict = judge(run.obs, run.cal, run.post, run.truth, error)
    assert verdict.level is Level.PASS
    assert verdict.checks[-2].name == "Propagation to attitude"
    other = dataclasses.replace(error, analytic_rest_arcsec=error.analytic_rest_arcsec * 1.6)
    check = judge(run.obs, run.cal, run.post, None, other).checks[-1]
    assert check.level is Level.WARN
    assert propagation_difference(other) == pytest.approx(0.375, abs=0.1)


def test_false_alarms_add_up_to_less_than_five_and_one_per_cent():
    """By design, whatever the data are."""
    warns = [estimate.MISFIT_P, estimate.JACKKNIFE_P, estimate.STAR_P, PATTERN_P, OUTLIER_P]
    fails = [
        estimate.MISFIT_FAIL_P,
        estimate.STAR_FAIL_P,
        PATTERN_P,
        estimate.ESTIMATORS_P,
        estimate.TRUTH_P,
        REJECT_P,
    ]
    assert sum(warns) < 0.05 < sum(warns) - estimate.MISFIT_P + 0.05
    assert sum(fails) < 0.01


def test_the_smallest_effect_that_few_data_show_is_said(run, found):
    few = dataclasses.replace(
        found.jackknife, effective_frames=found.jackknife.effective_frames / 20.0
    )
    words, fewer = (
        told("sensitivity", d) for d in (found, dataclasses.replace(found, jackknife=few))
    )
    assert (
        "120 frames" in words
        and "smooth pattern over radius" in words
        and words.endswith("less may be there.")
    )
    ratio = [float(w.split("make sigma ")[1].split(" times")[0]) for w in (words, fewer)]
    assert 1.0 < ratio[0] < 1.6 < ratio[1]


def test_annual_aberration_is_that_of_the_field(run):
    """The sentence that named 10 degrees and 3.6 arcsec for every camera is the control."""
    narrow = run.truth.replace(focal_mm=5.0 * run.truth.focal_mm)
    said, of_narrow = (
        say("Part.aberration", **aberration_size(camera)) for camera in (run.truth, narrow)
    )
    assert "5.0 arcsec" in said and "1.0 arcsec" in of_narrow


def test_a_stated_noise_that_is_not_in_pixels_is_recognised():
    c = campaign(np.random.default_rng(3), n_frames=25)
    sheet = sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))
    arcsec_per_px = 648000.0 / np.pi / c.theta[2]
    unnamed = {name: values for name, values in c.columns.items() if name != "mag"}
    uneven = np.random.default_rng(4).uniform(0.04, 0.06, len(c.columns["mag"]))
    for columns, stated, words in (
        (c.columns, c.columns["mag"], "Column sigma_px holds the magnitudes"),
        (unnamed, c.columns["mag"], "looks like magnitudes"),
        (c.columns, uneven * arcsec_per_px, "looks like arcseconds, of which a pixel has"),
        # Wrong by a factor that is no unit's, and right.
        (c.columns, 4.0 * uneven, "the stated noise is too large"),
        (c.columns, uneven, "is confirmed"),
    ):
        obs = sc.Observations(**columns, sigma_px=stated)
        found = outcome("Factor on the stated noise", obs, sc.calibrate(obs, sheet))
        assert words in found.sentence, found.sentence
        assert (found.level is Level.PASS) == (words == "is confirmed")
