"""Noise that varies: the fitted model, the weights that follow from it everywhere."""

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.core.status import Level
from starcal_uq.diagnostics.misfit import misfit_tests
from starcal_uq.diagnostics.verdict.estimate import even_noise
from starcal_uq.estimation.noise_model import fit_noise
from starcal_uq.estimation.stages import REFINEMENT_TOLERANCE, Search, refinement_stage
from starcal_uq.estimation.weights import weighed
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.noise_model import noise_model_of
from tests.helpers.outside import campaign


def even(radius, mag, frame):
    return np.full(len(radius), 0.05)


def worse_outside(radius, mag, frame):
    """Three times the noise at the edge of the field."""
    return 0.05 * (1.0 + 2.0 * (radius / 0.75) ** 4)


def worse_outside_and_for_faint(radius, mag, frame):
    """And 2.6 times the noise at magnitude 6 as at 2."""
    return worse_outside(radius, mag, frame) * 1.27 ** (mag - 4.0)


def all_at_once(radius, mag, frame):
    return 0.04 * (1.0 + 2.0 * radius**2) * 1.3 ** (mag - 4.0) * np.exp(0.4 * np.sin(13.0 * frame))


def scene(sigma, seed=3, **options):
    c = campaign(np.random.default_rng([4, seed]), **({"n_frames": 40} | options), sigma_px=sigma)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    return c, obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))


def test_few_stars_have_one_noise_unless_they_say_more():
    # Fifteen stars follow some quantity by chance: noise of x and y that is correlated by 0.99.
    found = []
    for seed in range(24):
        _, obs, camera = scene(even, seed, n_frames=3, stars_per_frame=5)
        model = sc.calibrate(obs, camera, effects="noise").noise_model
        found.append(model.varies)
    assert not any(found)


def test_the_noise_of_every_star_is_found():
    c, obs, camera = scene(all_at_once)
    cal = sc.calibrate(obs, camera, effects="noise")
    model = cal.noise_model
    assert {"radius", "magnitude"} <= set(model.terms) and model.frame_dof is not None
    radius = np.hypot(*(obs.xy - c.theta[:2]).T) / (
        0.5 * np.hypot(camera.width_px, camera.height_px)
    )
    ratio = np.log(model.sigma_px(obs) / all_at_once(radius, obs.mag, obs.frame))
    # 27 numbers a frame tell its noise to 14 %, less what shrinking saves.
    assert np.std(ratio) < 0.14 and abs(np.mean(ratio)) < 0.06
    control = np.log(cal.sigma / all_at_once(radius, obs.mag, obs.frame))
    assert np.std(control) > 0.4
    assert cal.sigma_name == "sigma_scale" and cal.sigma == pytest.approx(1.0, abs=0.02)
    assert "at its edge" in cal.text and "in every frame" in cal.text
    # A table that states the shape of the noise leaves the model little to say.
    stated = sc.Observations(
        **c.columns | {"sigma_px": 0.5 * all_at_once(radius, obs.mag, obs.frame)}
    )
    again = sc.calibrate(stated, camera, effects="noise")
    assert not again.noise_model.varies and again.sigma == pytest.approx(2.0, rel=0.1)


def test_even_noise_is_left_as_it_is():
    _, obs, camera = scene(even)
    common, fitted = sc.calibrate(obs, camera), sc.calibrate(obs, camera, effects="noise")
    assert not fitted.noise_model.varies
    assert np.array_equal(common.theta, fitted.theta) and np.array_equal(
        common.covariance, fitted.covariance
    )
    assert weighed(obs, fitted) is obs and fitted.sigma_name == "sigma"
    assert fitted.noise_model.axes is None


def test_every_reader_of_a_run_sees_the_same_weights_and_the_data_stay_what_they_are(tmp_path):
    _, obs, camera = scene(worse_outside, n_frames=20)
    run = sc.Run(tmp_path / "run")
    cal = run.calibrate(obs, camera, effects="noise")
    read = sc.Run(tmp_path / "run")
    assert np.array_equal(read.observations.sigma_px, cal.noise_model.sigma_px(obs))
    assert np.array_equal(run.observations.sigma_px, read.observations.sigma_px)
    assert read.observations.data_hash == obs.data_hash == cal.provenance["data_sha256"]
    assert sc.load_observations(read.folder.observations).sigma_px is None
    some = read.observations.select(obs.frame < 3)
    assert some.data_hash == obs.select(obs.frame < 3).data_hash and len(some.stated_px) == len(
        some
    )
    assert read.observations.unweighted.sigma_px is None
    # Calibrated again from what the run gives: the same data, the same model.
    again = sc.calibrate(read.observations, camera, effects="noise")
    assert np.array_equal(again.theta, cal.theta)
    draws = {"n_ensembles": 2, "n_walkers": 14, "n_steps": 8, "seed": 1}
    post = sc.sample(obs, cal, **draws)
    assert np.array_equal(post.draws, sc.sample(read.observations, cal, **draws).draws)
    edge, middle = (noise_model_of(post).at(x, x) for x in (np.array([1023.0]), np.array([512.0])))
    assert edge > 2.0 * middle
    mission = sc.Observations(
        **{n: v[obs.frame == 0] for n, v in obs.columns.items()}, meta={"frames": "a mission"}
    )
    assert np.array_equal(
        weighed(mission, post).sigma_px, cal.noise_model.at(mission.x_px, mission.y_px, mission.mag)
    )


@pytest.mark.slow
def test_screening_measures_stars_by_the_noise_where_they_are():
    _, obs, camera = scene(worse_outside, n_frames=60)
    plain, fitted = (
        sc.calibration.screen(obs, camera, effects=effects) for effects in ("none", "noise")
    )
    assert plain.model_is_wrong and not fitted.model_is_wrong and fitted.n_rejected == 0
    assert fitted.observations.sigma_px is None and fitted.calibration.noise_model.varies


def test_keywords_of_earlier_versions_name_the_effect_in_their_place():
    _, obs, camera = scene(even, n_frames=6)
    earlier = {"noise": "model", "likelihood": "student_t", "star_errors": True}
    for (name, value), effect in zip(earlier.items(), ("noise", "tails", "star"), strict=True):
        with pytest.raises(TypeError, match=f"use effects='{effect}'"):
            sc.calibrate(obs, camera, **{name: value})


def test_the_check_says_that_sigma_is_wrong_and_by_how_much():
    _, obs, camera = scene(worse_outside)
    cal = sc.calibrate(obs, camera)
    found = misfit_tests(obs, cal)
    check = even_noise(found)
    assert check.level is Level.WARN and "effects='noise'" in check.remedy
    k2 = cal.parameter_names.index("k2")
    assert (
        found.uneven.ratios[k2] > 1.3 and "k2" in check.sentence and "at its edge" in check.sentence
    )
    fitted = sc.calibrate(obs, camera, effects="noise")
    assert even_noise(misfit_tests(obs, fitted)).level is Level.PASS
    _, obs, camera = scene(even)
    assert even_noise(misfit_tests(obs, sc.calibrate(obs, camera))).level is Level.PASS


def test_the_test_of_frames_is_nominal_on_even_noise_and_finds_what_varies():
    def p_value(sigma, seed):
        _, obs, camera = scene(sigma, seed, n_frames=12, stars_per_frame=6)
        tests = misfit_tests(obs, sc.calibrate(obs, camera), max_cells=2).tests
        return next(
            test.p_value
            for test in tests
            if test.name.endswith("frame to frame") and test.is_of_noise
        )

    p = [p_value(even, seed) for seed in range(12)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert p_value(lambda r, m, f: 0.05 * np.exp(0.6 * np.cos(2.0 * f)), 0) < 1e-4


def quick(sigma, seed):
    """Squared z of the parameters (2, p): with one noise, and with the model; started at the
    truth.
    """
    c, obs, camera = scene(sigma, seed, n_frames=24, stars_per_frame=12)
    camera = camera.with_theta(c.theta)
    plain = MarginalLikelihood(obs, "brown")
    plain.use_rotations(plain.start_rotations(c.theta))
    theta = refinement_stage(
        plain, c.theta, Search(max_iterations=50, tolerance=REFINEMENT_TOLERANCE)
    ).theta
    model, fitted = fit_noise(obs, camera.with_theta(theta))
    weighted = MarginalLikelihood(obs.weighted(model.sigma_px(obs)), "brown")
    z = []
    for likelihood, estimate in ((plain, theta), (weighted, fitted)):
        normal = likelihood.evaluate(estimate)
        variance = np.diag(np.linalg.inv(normal.matrix)) * normal.cost / (likelihood.dof - 5)
        z.append((estimate - c.theta) ** 2 / variance)
    return z


@pytest.mark.slow
def test_intervals_hold_the_truth_with_the_model_and_not_without():
    bound = stats.t.ppf(0.975, 2 * 24 * 12 - 3 * 24 - 5) ** 2
    squares = [quick(worse_outside_and_for_faint, seed) for seed in range(200)]
    inside = np.mean(np.array(squares) < bound, axis=0)
    print("coverage with one noise", inside[0], "with the model", inside[1])
    k2 = 4
    assert inside[0, k2] < 0.80
    # One parameter's share of 200 has a standard error of 1.5 %.
    assert 0.93 < np.mean(inside[1]) < 0.97 and np.all(inside[1] > 0.90)
