"""Tests for structure in the residuals."""

import dataclasses
from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

import starcal_uq as sc
from starcal_uq.camera.distortion import parameter_names, rivals
from starcal_uq.diagnostics.misfit import ALPHA, Misfit, misfit_tests
from starcal_uq.diagnostics.residuals import of_some_frames
from starcal_uq.diagnostics.shape_sums import ShapeSums
from starcal_uq.diagnostics.verdict.estimate import misfit
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import View, shapes
from starcal_uq.observations.frames import StarFrames
from tests.helpers.outside import campaign, sky_angles
from tests.helpers.scenes import camera, nominal, observations, with_sigmas
from verification import regimes
from verification.misfit_power import SCENARIOS, main, power

N_NULL = 60


def refit(obs, model="brown"):
    return misfit_tests(obs, sc.calibrate(obs, nominal(camera(model))))


def named(found: Misfit, start: str):
    return next(test for test in found.tests if test.name.startswith(start))


def moved(obs, shift):
    return dataclasses.replace(obs, x_px=obs.x_px + shift[0], y_px=obs.y_px + shift[1])


@lru_cache(maxsize=1)
def null():
    """p-values of every test over simulated and refitted data sets without an error; and the
    overall ones.
    """
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    found = [
        refit(sc.simulate(stars, camera(), n_frames=25, min_stars=9, sigma_px=0.05, seed=7000 + i))
        for i in range(N_NULL)
    ]
    names = [test.name for test in found[0].tests]
    return (
        names,
        np.array([[t.p_value for t in f.tests] for f in found]),
        np.array([f.p_value for f in found]),
    )


def test_patterns_are_sought_in_all_stars_with_the_covariance_of_some_frames():
    obs = observations("brown", n_frames=120)
    wave = np.sin(2.0 * np.pi * obs.x_px)
    obs = moved(obs, (0.02 * wave, 0.0 * wave))
    cal = sc.calibrate(obs, nominal(camera("brown")))
    every, some = misfit_tests(obs, cal), misfit_tests(obs, cal, most_frames=60, seed=2)
    for one, other in zip(every.tests, some.tests, strict=True):
        if other.share == 1.0:
            assert other.statistic == pytest.approx(one.statistic, rel=0.2, abs=0.2), one.name
            assert other.dof_residual == one.dof_residual
    phase = "error with the pixel phase in x"
    assert named(some, phase).statistic > 10.0
    # The control: the same frames alone see half of it.
    alone, own, _ = of_some_frames(obs, cal, 60, 2)
    assert named(misfit_tests(alone, own), phase).statistic < 0.75 * named(some, phase).statistic


@pytest.mark.parametrize("stated", [False, True])
def test_sums_are_products_of_columns_without_attitudes(stated):
    obs = observations("brown", n_frames=6)
    obs = with_sigmas(obs) if stated else obs
    cal = sc.calibrate(obs, nominal(camera("brown")))
    families = shapes(obs, cal.camera)
    sums = ShapeSums(obs, cal, families)
    part = MarginalLikelihood(obs, "brown")
    state, _ = part.profile(cal.theta)
    view = View.of(part, state, cal.theta, slice(None))
    many = np.concatenate([family.columns(view) for family in families])
    part.frames.whiten(many)
    h = state.slopes
    columns = np.concatenate([h, state.e[None], many])
    size = np.linalg.norm(columns, axis=(1, 2))
    flat = part.project_out(state, columns).reshape(len(columns), -1) / size[:, None]
    assert np.allclose(sums.gram / np.outer(size, size), flat @ flat.T, atol=1e-7)
    assert np.allclose(sums.raw, np.sum(many**2, axis=(1, 2)))


@pytest.mark.slow
def test_false_alarms_are_nominal_after_refitting():
    names, p, overall = null()
    assert len(names) == 19
    n = len(p)
    for alpha in (0.01, 0.05, 0.2):
        # Over all tests together; they are correlated, so the error is taken from the scatter over
        # data sets.
        shares = np.mean(p < alpha, axis=1)
        assert np.mean(shares) == pytest.approx(alpha, abs=4.0 * np.std(shares) / np.sqrt(n) + 1e-3)
        assert np.mean(overall < alpha) <= alpha + 4.0 * np.sqrt(alpha / n)
    for j, name in enumerate(names):
        assert stats.kstest(p[:, j], "uniform").pvalue > 1e-4, name
        assert np.mean(p[:, j] < 0.05) == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / n)), (
            name
        )


def test_control_shapes_that_the_fit_absorbed_are_not_nominal():
    """Without the projection the same statistic is far from uniform."""
    obs = observations(n_frames=25)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    family = next(
        s for s in shapes(obs, cal.camera) if s.name.startswith("smooth pattern over radius")
    )
    likelihood = MarginalLikelihood(obs, "brown")
    state, _ = likelihood.profile(cal.theta)
    h = state.slopes
    view = View.of(likelihood, state, cal.theta, slice(None))
    naive, _ = np.linalg.qr(family.columns(view).reshape(family.size, -1).T)
    fitted = likelihood.project_out(state, h).reshape(len(h), -1)
    fitted, _ = np.linalg.qr((fitted / np.linalg.norm(fitted, axis=1, keepdims=True)).T)
    rng = np.random.default_rng(1)
    p = []
    for _ in range(200):
        e = likelihood.project_out(state, rng.standard_normal((1, 2, obs.n_stars)))[0].ravel()
        e -= fitted @ (fitted.T @ e)
        explained, rest = np.sum((naive.T @ e) ** 2), cal.dof - family.size
        p.append(
            stats.f.sf(explained / family.size / ((e @ e - explained) / rest), family.size, rest)
        )
    assert stats.kstest(p, "uniform").pvalue < 1e-10
    assert np.mean(np.array(p) < 0.05) < 0.01


def test_control_noise_that_depends_on_magnitude_is_found_by_its_test_only():
    obs = observations(n_frames=60)
    rng = np.random.default_rng(3)
    z = (obs.mag - obs.mag.mean()) / obs.mag.std()
    found = refit(moved(obs, 0.05 * np.clip(z, 0.0, None) * rng.standard_normal((2, obs.n_stars))))
    assert named(found, "noise that changes with magnitude").p_holm < 1e-6
    assert named(found, "noise that changes with magnitude").statistic > 0
    assert named(found, "decentring").p_value > 1e-3


@pytest.mark.parametrize(
    ("model", "term", "value"), [("brown3", "k3", 1.0), ("brown_tangential", "p2", -0.06)]
)
def test_score_tests_estimate_the_term_that_is_missing(model, term, value):
    """The amplitude is that of the richer model."""
    names = list(camera(model).parameter_names[3:])
    base = camera("brown")
    order = 7 if term == "k3" else 2
    coefficients = [*base.coefficients, *([0.0] * (len(names) - 2))]
    coefficients[names.index(term)] = value / base.corner_radius_px**order
    truth = base.replace(distortion=model, coefficients=tuple(coefficients))
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    obs = sc.simulate(stars, truth, n_frames=200, min_stars=10, sigma_px=0.05, seed=5)
    poor = sc.calibrate(obs, sc.paper.paper_start())
    found = misfit_tests(obs, poor)
    amplitude = next(a for t in found.tests for a in t.amplitudes if a.name.startswith(f"{term} "))
    rich = sc.calibrate(obs, nominal(truth))
    index = rich.parameter_names.index(term)
    scale = poor.camera.corner_radius_px**order
    assert amplitude.sigma == pytest.approx(rich.sigmas[index] * scale, rel=0.1)
    assert amplitude.value == pytest.approx(rich.theta[index] * scale, abs=0.3 * amplitude.sigma)
    assert abs(amplitude.value) > 5.0 * amplitude.sigma
    assert found.found()[0].p_holm < 1e-4
    test = next(t for t in found.tests if amplitude in t.amplitudes)
    if term == "k3":
        # The move that it announces is the one that fitting the term makes.
        move = np.abs(rich.theta[:5] - poor.theta) / poor.sigmas
        assert test.moved_sigma == pytest.approx(move.max(), rel=0.1)
        assert (
            test.moved_name == poor.parameter_names[int(move.argmax())] and test.moved_sigma > 3.0
        )


def test_a_pattern_of_the_detectable_size_is_found_nine_times_in_ten():
    """Sums of squares of noise and a pattern of the announced size, drawn without the package."""
    found = refit(observations(n_frames=30))
    test, rng = named(found, "decentring"), np.random.default_rng(8)
    limit = stats.f.isf(ALPHA / len(found.tests), test.dof, test.dof_residual)
    for strength, low, high in ((1.0, 0.88, 0.92), (0.5, 0.0, 0.4)):
        # Twice the number of stars times the mean square is the pattern's sum of squares, here in
        # units of the noise.
        root = np.sqrt(2 * found.n_stars) * strength * test.detectable_px / found.sigma
        squares = (root + rng.standard_normal(20_000)) ** 2 + rng.chisquare(test.dof - 1, 20_000)
        f = squares / test.dof / (rng.chisquare(test.dof_residual, 20_000) / test.dof_residual)
        assert low < np.mean(f > limit) < high
    assert 0.0 < test.detectable_px < 0.05


def test_aberration_is_measured_as_a_velocity():
    obs = observations(n_frames=200)
    velocity = np.array([20.0, -15.0, 10.0])
    ra, dec = sky_angles(sc.sky.aberrate(obs.directions_icrs, -velocity))
    found = refit(dataclasses.replace(obs, ra_deg=ra, dec_deg=dec))
    test = named(found, "aberration")
    assert test.p_holm < 1e-6
    for amplitude, true in zip(test.amplitudes, velocity, strict=True):
        assert amplitude.unit == "km/s"
        assert abs(amplitude.value - true) < 4.0 * amplitude.sigma
        assert amplitude.sigma < 3.0


def test_what_the_data_hardly_tell_apart_is_said_to_be_so():
    """On one patch of sky, aberration is nearly a focal length."""
    c = campaign(np.random.default_rng(1), n_frames=60, patch_stars=40, star_sigma_px=0.03)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    cal = sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)))
    found = misfit_tests(obs, cal)
    test = named(found, "aberration")
    assert test.p_holm < ALPHA and test.moved_name == "f" and test.moved_sigma > 30.0
    # The velocity that it would be is hundreds of times less certain than the Earth's is small.
    assert test.moved_sigma < 3.0 * test.moved_std
    sentence = misfit(dataclasses.replace(found, tests=(test,)), cal).sentence
    assert "hardly tell aberration of a constant velocity from f" in sentence
    # The control: frames all over the sky tell them apart.
    c = campaign(np.random.default_rng(1), n_frames=60)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    cal = sc.calibrate(obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)))
    test = named(misfit_tests(obs, cal), "aberration")
    assert test.moved_std < 1.0
    sentence = misfit(
        dataclasses.replace(found, tests=(dataclasses.replace(test, p_holm=1e-9),)), cal
    ).sentence
    assert "more than noise" in sentence and "hardly tell" not in sentence


def test_drift_follows_time_where_there_is_time_and_temperature_where_there_is_temperature():
    obs = observations(n_frames=60)
    rng = np.random.default_rng(0)
    minute = rng.permutation(obs.n_frames)
    clock = np.repeat(minute, obs.stars_per_frame)
    times = np.array([f"2026-11-21T{m // 60:02d}:{m % 60:02d}:00" for m in clock])
    offset = obs.xy.T - camera().theta[:2, None]
    growth = 0.5 / camera().focal_px * (2.0 * clock / clock.max() - 1.0)
    timed = dataclasses.replace(
        moved(obs, offset * growth), time_utc=times, temperature_c=20.0 + 0.1 * clock
    )
    found = refit(timed)
    drift = named(found, "linear drift")
    assert drift.against == "time"
    assert drift.amplitudes[0].value == pytest.approx(1.0, abs=4.0 * drift.amplitudes[0].sigma)
    warmth = named(found, "focal length with temperature").amplitudes[0]
    span = 0.1 * (obs.n_frames - 1)
    assert warmth.value == pytest.approx(drift.amplitudes[0].value / span, rel=1e-3)
    # The control: in the order of frames the same drift is noise.
    untimed = dataclasses.replace(timed, time_utc=None, temperature_c=None)
    control = refit(untimed)
    assert named(control, "linear drift").against == "order of frames"
    assert abs(named(control, "linear drift").statistic) < 0.2 * drift.statistic
    assert named(control, "scale and shape that change").p_value < 1e-3


def test_stated_noise_whitens_the_tests():
    obs = with_sigmas(observations(n_frames=60, sigma_px=0.0))
    found = refit(obs)
    assert found.p_value > 0.01
    assert found.sigma == pytest.approx(1.0, abs=0.05)
    phase = 0.2 * np.stack([np.sin(2 * np.pi * obs.x_px), np.zeros(obs.n_stars)])
    test = named(refit(moved(obs, phase)), "error with the pixel phase in x")
    assert test.p_holm < 1e-10
    assert test.amplitudes[0].value == pytest.approx(0.2, abs=5 * test.amplitudes[0].sigma + 0.01)


@pytest.mark.parametrize("model", ["none", "brown", "brown3", "brown_tangential", "inverse"])
def test_every_model_is_tested_for_the_terms_it_lacks(model):
    found = refit(observations(model, n_frames=30), model)
    text = " ".join(test.name for test in found.tests)
    known = {name for rival in rivals(model) for name in parameter_names(rival)}
    for name in ("k1", "k2", "k3", "p1", "p2"):
        lacking = name in known and name not in camera(model).parameter_names
        assert (f"{name}," in text or f"{name})" in text) == lacking
    # Data of the model have no structure.
    assert found.p_value > 0.01 and found.found() == ()


def test_one_frame_and_few_stars_leave_out_what_cannot_be_tested():
    obs = observations(n_frames=60)
    one = obs.select_frames(obs.frame_ids[:3])
    found = refit(one, "brown")
    assert found.tests
    assert all(t.dof_residual >= 10 for t in found.tests)
    assert all(0.0 <= t.p_value <= 1.0 and t.p_holm >= t.p_value for t in found.tests)


def test_parts_of_the_table_give_the_same_sums(monkeypatch):
    obs = observations(n_frames=60)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    whole = misfit_tests(obs, cal)
    monkeypatch.setattr("starcal_uq.diagnostics.shape_sums._STARS_AT_ONCE", 100)
    parts = misfit_tests(obs, cal)
    assert len(StarFrames.from_observations(obs).parts(100)) > 5
    for a, b in zip(whole.tests, parts.tests, strict=True):
        assert a.p_value == pytest.approx(b.p_value, rel=1e-6), a.name


def test_power_table_has_a_row_for_every_error(capsys):
    assert main(["--replicates", "1", "--null", "1", "--frames", "40"]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert len(lines) == len(SCENARIOS) + 2
    assert all(line.count("|") == 7 for line in lines)


def test_regimes_are_written_between_their_markers(monkeypatch, tmp_path, capsys):
    page = tmp_path / "docs" / "explanation" / "misfit.md"
    page.parent.mkdir(parents=True)
    page.write_text("before\n<!-- misfit regimes -->\n<!-- /misfit regimes -->\nafter\n")
    monkeypatch.setattr(regimes, "ROOT", tmp_path)
    for frames in (5, 3):
        assert (
            regimes.main(
                ["--only", f"scatter of {frames} f", "--runs", "2", "--processes", "0", "--write"]
            )
            == 0
        )
    assert "Alarm (nominal 1 %)" in capsys.readouterr().out
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "--seed 1 --write" in text
    # Rows keep the order of the registry, whatever was run last, and another run replaces its own.
    assert [row["Regime"] for row in regimes.stored("misfit")] == [
        "scatter of 3 frames",
        "scatter of 5 frames",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
def test_power_at_a_thousand_frames(scenario):
    """What is flagged, and what cannot be: as the table of the documentation says."""
    found = power(scenario, 4, 1000, seed=900)
    if not scenario.test:
        assert found.specific < 0.14 and found.overall <= 0.25
        assert found.error < 2.0
    elif "one pointing" in scenario.name:
        # The scale of one direction of sight is that of f: nothing is left to see, and f is wrong.
        assert found.overall < 0.6 and found.error > 3.0
    elif "within 8°" in scenario.name:
        # A velocity along the line of sight hides in f; one across it does not.
        assert found.specific > 0.7 and found.error > 3.0
    elif "drift" in scenario.name:
        assert found.specific > 0.5
    else:
        assert found.specific == 1.0 and found.overall == 1.0
