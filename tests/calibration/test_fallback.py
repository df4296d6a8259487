"""A model that the data do not determine."""

import re
from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError, SamplingError
from starcal_uq.core.remedy import PLAN
from starcal_uq.core.status import Level, Status
from starcal_uq.diagnostics.verdict import estimate
from starcal_uq.maths.intervals import student_quantile
from starcal_uq.maths.linear import symmetric_inverse
from starcal_uq.presentation.words.sentences import told
from tests.helpers.outside import Campaign, campaign


def few_stars(seed: int, **options) -> Campaign:
    """Three frames of five stars in a field of 3 degrees."""
    own = {
        "n_frames": 3,
        "stars_per_frame": 5,
        "field_deg": 3.0,
        "corner_px": (0.0, 0.0),
        "sigma_px": 0.1,
    }
    return campaign(np.random.default_rng(seed), **own | options)


def given(c: Campaign, model: str = "brown") -> tuple[sc.Observations, sc.Camera]:
    return sc.Observations(**c.columns), sc.Camera(**c.camera_toml()).replace(distortion=model)


# Where the richer model is left open, and where coma of noise tells its principal point.
OPEN, BY_COMA = 4, 0


def test_the_richest_model_that_the_data_determine_is_fitted_and_said(tmp_path):
    obs, camera = given(few_stars(OPEN))
    cal = sc.calibrate(obs, camera)
    assert cal.status.ok and cal.camera.distortion == cal.nominal.distortion == "none"
    record = cal.provenance["fallback"]
    assert (record["model"], record["used"], record["status"]) == ("brown", "none", "SINGULAR")
    assert told("fallback", cal) in cal.text and "k1 and k2 are zero" in told("fallback", cal)
    check = estimate.determined(cal)
    assert check.level is Level.WARN and "--model" not in check.remedy and check.remedies == PLAN
    cal.save(tmp_path / "calibration.json")
    assert told("fallback", sc.Calibration.load(tmp_path / "calibration.json")) == told(
        "fallback", cal
    )


def test_asking_for_the_simpler_model_removes_no_condition():
    obs, camera = given(few_stars(OPEN))
    taken, asked = sc.calibrate(obs, camera), sc.calibrate(obs, camera, model="none")
    assert np.array_equal(taken.theta, asked.theta)
    assert estimate.determined(asked) == estimate.determined(taken)
    # Data that determine the rest, and a sheet that states a camera without distortion, leave no
    # condition.
    plenty, sheet = given(few_stars(0, n_frames=10, stars_per_frame=20, field_deg=15.0))
    assert estimate.determined(sc.calibrate(plenty, sheet, model="none")) is None
    assert estimate.determined(sc.calibrate(obs, camera.replace(distortion="none"))) is None


def test_sigmas_are_those_without_the_coma_of_a_distortion_that_may_be_none():
    obs, camera = given(few_stars(BY_COMA))
    cal = sc.calibrate(obs, camera)
    assert cal.status.ok and cal.camera.distortion == "brown" and "fallback" not in cal.provenance
    factors = cal.coma_factors
    assert np.max(factors[:2]) > 1.25 and np.all(factors >= 1.0)
    formal = np.sqrt(np.diag(symmetric_inverse(cal.information)))
    np.testing.assert_allclose(cal.sigmas / formal, factors, rtol=1e-6)
    check = estimate.determined(cal)
    assert (
        check.level is Level.WARN
        and check.remedies == PLAN
        and "without its coma" in told("fallback", cal)
    )
    assert np.array_equal(sc.calibrate(obs, camera, model="brown").theta, cal.theta)
    # Draws are as wide.
    short = {
        "seed": 0,
        "n_ensembles": 2,
        "n_walkers": 16,
        "n_steps": 60,
        "evaluation": "compressed",
    }
    narrow = replace(
        cal, provenance={k: v for k, v in cal.provenance.items() if k != "without_coma"}
    )
    wide, as_found = (sc.sample(None, c, **short).sd for c in (cal, narrow))
    assert np.all(wide[:2] > 1.1 * as_found[:2])


def test_what_is_asked_for_is_refused_with_the_model_that_converges():
    obs, camera = given(few_stars(OPEN))
    with pytest.raises(CalibrationError, match=r"do not determine .*'none' converges") as caught:
        sc.calibrate(obs, camera, model="brown")
    assert caught.value.status is Status.SINGULAR and caught.value.undetermined
    assert sc.calibrate(obs, camera, model="brown", throw=False).status is Status.SINGULAR


def test_a_model_that_the_data_determine_stays():
    obs, camera = given(few_stars(0, field_deg=15.0, corner_px=(6.0, -2.0)))
    cal = sc.calibrate(obs, camera)
    assert cal.camera.distortion == "brown" and "fallback" not in cal.provenance
    assert np.array_equal(cal.theta, sc.calibrate(obs, camera, model="brown").theta)


@pytest.mark.parametrize(
    ("model", "n_stars", "used"),
    [("brown", 4, ("none", "k1")), ("brown_tangential", 5, ("brown", "k1"))],
)
def test_too_few_stars_for_a_model(model, n_stars, used):
    obs, camera = given(few_stars(0, n_frames=1, stars_per_frame=n_stars, field_deg=15.0), model)
    assert sc.calibrate(obs, camera).camera.distortion in used


def test_terms_that_the_stars_ask_for_are_not_left_out():
    """Too few iterations are no reason to fit another camera: its residuals ask for the terms."""
    obs, camera = given(campaign(np.random.default_rng(0), n_frames=20, corner_px=(6.0, -2.0)))
    with pytest.raises(CalibrationError) as caught:
        sc.calibrate(obs, camera, max_iterations=4)
    assert caught.value.status is Status.MAX_ITERATIONS and "converges" not in str(caught.value)
    # The same without distortion: nothing is asked for.
    obs, camera = given(campaign(np.random.default_rng(0), n_frames=20, corner_px=(0.0, 0.0)))
    assert sc.calibrate(obs, camera, max_iterations=4).camera.distortion in ("none", "k1", "brown")


def test_wrong_stars_are_not_blamed_on_the_model():
    c = few_stars(OPEN, n_frames=6, stars_per_frame=10)
    rng = np.random.default_rng(0)
    for name in ("x_px", "y_px"):
        c.columns[name] = rng.uniform(0.0, 1023.0, len(c.columns[name]))
    obs, camera = given(c)
    with pytest.raises(CalibrationError, match="fit no common attitude"):
        sc.calibrate(obs, camera)


def test_priors_determine_what_the_data_leave_open():
    """A narrow field does not tell where the principal point is; a data sheet may."""
    c = few_stars(0, n_frames=1, stars_per_frame=8, offset_px=(6.0, -9.0))
    obs, camera = given(c, "none")
    cal = sc.calibrate(obs, camera, throw=False)
    assert cal.status is Status.SINGULAR and cal.undetermined == ("x0", "y0")
    short = {"seed": 0, "n_ensembles": 2, "n_walkers": 14, "n_steps": 60}
    priors = sc.Priors.default(cal.nominal)
    for wide in (None, priors.replace(principal_point_px=1000.0)):
        with pytest.raises(SamplingError, match="or priors that determine x0 and y0"):
            sc.sample(obs, cal, priors=wide, **short)
    post = sc.sample(obs, cal, priors=priors.replace(principal_point_px=10.0), **short)
    assert np.all(np.abs(post.mean[:3] - c.theta[:3]) < 4.0 * post.sd[:3])
    # Of the point it knows what the priors say, of f what the stars do.
    assert post.sd[:2] == pytest.approx([10.0, 10.0], rel=0.2) and post.sd[2] < 5.0
    assert (
        estimate.estimation(cal, post).level is Level.WARN
        and estimate.estimation(cal).level is Level.FAIL
    )


@pytest.mark.slow
def test_estimates_after_a_fall_err_as_their_sigmas_say():
    inside = []
    for seed in range(40):
        c = few_stars(seed, n_frames=1, stars_per_frame=4, field_deg=15.0)
        obs, camera = given(c)
        try:
            cal = sc.calibrate(obs, camera)
        except CalibrationError:
            continue
        if "fallback" in cal.provenance:
            z = abs(cal.theta[2] - c.theta[2]) / cal.sigmas[2]
            inside.append(z < student_quantile(0.9, cal.dof))
    # All are fitted with 1 or 2 degrees of freedom; two in a million fall outside of this.
    assert len(inside) == 40 and sum(inside) > 26


def narrow_fields(n: int) -> tuple[list[str], np.ndarray]:
    """Models and errors of f, in sigma, of tables of a field of 0.7 degrees without distortion."""
    models, z = [], []
    for seed in range(n):
        c = few_stars(seed, n_frames=60, stars_per_frame=12, field_deg=0.7, size_px=2048)
        cal = sc.calibrate(*given(c))
        models.append(cal.camera.distortion)
        z.append((cal.theta[2] - c.theta[2]) / cal.sigmas[2])
    return models, np.array(z)


@pytest.mark.slow
def test_noise_in_the_distortion_of_a_narrow_field_tells_no_principal_point(monkeypatch):
    models, z = narrow_fields(25)
    assert np.sqrt(np.mean(z**2)) < 1.3
    # Believed, it does: many estimates come with sigmas that are too small.
    monkeypatch.setattr(
        "starcal_uq.estimation.undetermined._without_coma",
        lambda covariance, told, size, lens: np.ones(len(told)),
    )
    models, z = narrow_fields(20)
    kept = np.array(models) == "brown"
    assert kept.sum() > 5 and np.sqrt(np.mean(z[kept] ** 2)) > 1.4


NOISY = (
    {"n_frames": 40, "stars_per_frame": 16},
    {"n_frames": 20, "stars_per_frame": 32, "corner_px": (6.0, -2.0)},
    {"n_frames": 8, "stars_per_frame": 20},
)


def noisy(model: str | None, n: int = 16) -> np.ndarray:
    """Whether x0, y0, f, and k1, k2 where fitted, lie in their 95 % intervals: tables with 5 px of
    noise.
    """
    inside = []
    for options in NOISY:
        for seed in range(n):
            c = campaign(np.random.default_rng(seed), sigma_px=5.0, **options)
            cal = sc.calibrate(*given(c), model=model)
            p = len(cal.theta)
            low, high = cal.interval(0.95).T
            inside.append((low < c.theta[:p]) & (c.theta[:p] < high))
    return np.concatenate(inside)


@pytest.mark.slow
def test_intervals_of_noisy_stars_hold():
    taken = noisy(None)
    # 240 intervals, of which five of a table go together.
    assert 0.91 < np.mean(taken) < 0.999
    # Distortion that is left out moves f by several of its sigmas.
    assert np.mean(noisy("none", 10)) < 0.85


def test_a_lens_that_imitates_a_tilt_is_refused_with_one_that_does_not():
    stars = sc.load_catalogue(max_mag=7.0, epoch=2026.9)
    truth = sc.Camera(2048, 2048, 15.0, 200.0, 1023.5, 1023.5, "brown_tangential", (0.0,) * 4)
    obs = sc.simulate(stars, truth, n_frames=40, seed=1, min_stars=8)
    start = truth.data_sheet()
    with pytest.raises(CalibrationError, match=r"imitate a tilt .* any number of frames") as caught:
        sc.calibrate(obs, start, model="cubic")
    remedy = re.search(r"'(\w+)' converges \(--model \1", str(caught.value))
    assert remedy is not None and "wider field" not in str(caught.value)
    found = sc.calibrate(obs, start, model=remedy[1])
    assert found.status.ok and found.camera.distortion == "brown_tangential"
    errors = (found.theta - truth.theta) / np.sqrt(np.diag(found.covariance))
    assert np.abs(errors).max() < 4.0
    # Control: more frames, which other lenses are told to take, leave this one open.
    more = sc.simulate(stars, truth, n_frames=100, seed=2, min_stars=8)
    with pytest.raises(CalibrationError, match="imitate a tilt"):
        sc.calibrate(more, start, model="cubic")
