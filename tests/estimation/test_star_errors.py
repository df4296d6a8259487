"""Errors of the stars in the covariance."""

import json

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.effects import star_effect
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import StarModel, sky_axes
from starcal_uq.observations.frames import StarFrames
from tests.helpers.outside import campaign


def observed(seed, star_sigma_px=0.03, n_frames=60, **options):
    """Frames on one patch of forty stars, and the data sheet."""
    options = {"patch_stars": 40, "star_sigma_px": star_sigma_px} | options
    c = campaign(np.random.default_rng([seed, 5]), n_frames=n_frames, **options)
    obs = sc.Observations(**c.columns, meta={"directions": "apparent"})
    return c, obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))


@pytest.fixture(scope="module")
def made():
    c, obs, camera = observed(1)
    return c, obs, camera, sc.calibrate(obs, camera), sc.calibrate(obs, camera, effects="star")


def dense(obs, cal, model, ratio):
    """Residuals (2 N,) and their weight W (2 N, 2 N) in units of sigma^-2, attitudes integrated
    out, as written.
    """
    likelihood = MarginalLikelihood(obs, cal.camera.distortion)
    state, _ = likelihood.profile(cal.theta, quaternion_to_rotation(cal.quaternions))
    n, s = obs.n_stars, len(model.images)
    z, a = np.zeros((2, n, 2 * s)), np.zeros((2, n, 3 * obs.n_frames))
    frame = np.searchsorted(obs.frame_ids, obs.frame)
    # Derivatives by finite turns of the directions and of the camera, without the columns under
    # test.
    axes = sky_axes(model.directions, model.numbers)[:, :, model.numbers]
    for i in range(2):
        step = 1e-7
        turned = np.einsum("nij,jn->in", state.rotations[frame], axes[i])
        z[:, np.arange(n), 2 * model.numbers + i] = (
            (
                sc.camera.project(cal.camera, (state.b + step * turned).T).T
                - sc.camera.project(cal.camera, state.b.T).T
            )
            / step
            / model.focal_px
        )
    for i in range(3):
        a[:, np.arange(n), 3 * frame + i] = state.attitude[i]
    z, a = z.reshape(2 * n, -1), a.reshape(2 * n, -1)
    v = np.linalg.inv(np.eye(2 * n) + z * ratio @ z.T)
    return state.e.ravel(), v - v @ a @ np.linalg.solve(a.T @ v @ a, a.T @ v)


def exact_likelihood(obs, cal, tau_px, sigma):
    stars = star_effect(StarModel(obs, cal.theta[2]))
    frames, ratio = StarFrames.from_observations(obs), {"star": (tau_px / sigma) ** 2}
    at = (cal.theta, quaternion_to_rotation(cal.quaternions), sigma)
    return EffectLikelihood(frames, "brown", [stars], ratio, *at)


def test_products_are_those_of_the_covariance_as_written():
    _, obs, camera = observed(4, n_frames=12, stars_per_frame=8)
    cal = sc.calibrate(obs, camera)
    model = StarModel(obs, cal.theta[2])
    e, w = dense(obs, cal, model, np.full(2 * len(model.images), (0.03 / 0.05) ** 2))
    exact = exact_likelihood(obs, cal, 0.03, 0.05)
    state, _ = exact.profile(cal.theta, exact.rotations)
    found = exact.whitened(state, state.e[None])[0]
    assert found @ found == pytest.approx(e @ w @ e, rel=1e-6)
    # The control: star errors matter here.
    assert found @ found < 0.9 * e @ e


def star_of(cal):
    (star,) = cal.effects.fitted
    return star


def test_the_scale_is_found_and_the_intervals_grow(made):
    c, _, _, plain, cal = made
    star = star_of(cal)
    assert star.low_px < 0.03 < star.high_px < 0.05
    assert cal.sigma == pytest.approx(0.05, rel=0.07)
    # The estimate is another one as well, which has less to bear than the plain one.
    assert np.max(cal.sigmas / plain.sigmas) > 1.15
    assert np.max(np.abs(cal.theta - c.theta) / cal.sigmas) < 3.5


def test_without_errors_nothing_changes():
    _, obs, camera = observed(1, star_sigma_px=0.0)
    plain, cal = sc.calibrate(obs, camera), sc.calibrate(obs, camera, effects="star")
    assert star_of(cal).scale_px < 0.006
    assert cal.sigmas == pytest.approx(plain.sigmas, rel=0.1)


def test_compressed_and_exact_agree(made):
    _, obs, _, _, cal = made
    exact = exact_likelihood(obs, cal, star_of(cal).scale_px, cal.sigma)
    rng = np.random.default_rng(0)
    theta = (
        cal.theta
        + rng.standard_normal((12, 5)) @ np.linalg.cholesky(cal.correlation).T * cal.sigmas
    )
    difference = [exact.log_likelihood(t, 0.05) for t in theta] - cal.compressed.log_likelihood(
        theta, 0.05
    )
    assert np.ptp(difference) < 0.02
    # The control: the likelihood that knows of no stars.
    plain = MarginalLikelihood(obs, "brown")
    assert (
        np.ptp(
            [plain.log_likelihood(t, 0.05) for t in theta]
            - cal.compressed.log_likelihood(theta, 0.05)
        )
        > 1.0
    )


def test_files_of_earlier_versions_have_their_errors_of_the_stars_as_an_effect(made, tmp_path):
    _, obs, _, _, cal = made
    path, star = tmp_path / "calibration.json", star_of(cal)
    cal.save(path)
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["effects"]
    document["star_errors"] = {
        "tau_px": star.scale_px,
        "tau_px_std": 0.003,
        "stated_px": 0.01,
        "focal_px": float(cal.theta[2]),
        "n_stars": 40,
        "n_recurring": 40,
    }
    path.write_text(json.dumps(document), encoding="utf-8")
    again = sc.Calibration.load(path)
    assert again.effects.names == ("star",)
    assert again.effects.star_px == pytest.approx(np.hypot(star.scale_px, 0.01))
    theta = cal.theta[None] + cal.sigmas
    plain = cal.compressed.log_likelihood(theta, np.array([cal.sigma]))
    assert again.log_likelihood(theta, np.array([cal.sigma])) == pytest.approx(plain)
    post = sc.sample(obs, again, n_ensembles=2, n_walkers=32, n_steps=100, n_burn=30, seed=3)
    assert np.allclose(np.std(post.draws[:, :5], axis=0), cal.sigmas, rtol=0.3)


def test_stated_errors_are_taken_and_only_the_rest_is_estimated(made):
    c, obs, camera, _, cal = made
    mas = np.full(obs.n_stars, 1e3 * np.degrees(0.03 / c.theta[2]) * 3600.0)
    stated = sc.calibrate(sc.Observations(**c.columns, direction_mas=mas), camera, effects="star")
    assert stated.effects.stated_px == pytest.approx(0.03, rel=0.01)
    assert star_of(stated).scale_px < 0.02
    # The total is what is estimated without being told, as far as 40 stars can say.
    assert stated.effects.star_px == pytest.approx(cal.effects.star_px, rel=0.2)
    assert stated.sigmas == pytest.approx(cal.sigmas, rel=0.2)


def test_other_models_are_compared_without_what_stars_bring_along(made):
    _, obs, _, plain, cal = made
    moves = [
        sc.diagnostics.compare_models(obs, one, ("brown3",)).of("brown3").common_arcsec
        for one in (plain, cal)
    ]
    assert np.linalg.norm(moves[1]) < np.linalg.norm(moves[0])


@pytest.mark.slow
def test_coverage_is_nominal_with_the_option_and_not_without():
    """Thirty runs; `verification/regimes.py` has 150 of each regime."""
    inside, without, squared = [], [], []
    for i in range(30):
        c, obs, camera = observed(500 + i)
        cal = sc.calibrate(obs, camera, effects="star")
        error = (cal.theta - c.theta) / cal.sigmas
        squared.append(error @ np.linalg.solve(cal.correlation, error) / 5.0)
        inside.append(np.abs(error) < 1.96)
        if i < 20:
            plain = sc.calibrate(obs, camera)
            without.append(np.abs((plain.theta - c.theta) / plain.sigmas) < 1.96)
    assert 0.89 < np.mean(inside) < 0.99
    assert np.mean(squared) == pytest.approx(1.0, abs=0.3)
    # The control.
    assert np.mean(without) < 0.87
