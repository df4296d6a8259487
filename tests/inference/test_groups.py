"""ArviZ's groups against integration over the attitude, a second exposure."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import starcal_uq as sc
from starcal_uq.core.errors import SamplingError
from starcal_uq.diagnostics.models import compare_models
from starcal_uq.inference import groups
from starcal_uq.inference.groups import GROUPS, LOG_LIKELIHOOD, arviz_data
from starcal_uq.inference.posterior import Posterior
from starcal_uq.likelihood.student import StudentLikelihood
from starcal_uq.observations.frames import StarFrames
from tests.helpers import outside, scenes

SIGMA = 0.05


@pytest.fixture(scope="module")
def night() -> outside.Campaign:
    """Few stars a frame, where the attitude takes up much."""
    return outside.campaign(
        np.random.default_rng(4), n_frames=150, stars_per_frame=5, sigma_px=SIGMA
    )


@pytest.fixture(scope="module")
def obs(night: outside.Campaign) -> sc.Observations:
    return sc.Observations(**night.columns)


@pytest.fixture(scope="module")
def post(night: outside.Campaign, obs: sc.Observations) -> Posterior:
    cal = sc.calibrate(obs, sc.Camera(**night.camera_toml(), coefficients=(0.0, 0.0)))
    return sc.sample(obs, cal, seed=1, n_walkers=32, n_steps=100)


@pytest.fixture(scope="module")
def data(post: Posterior, obs: sc.Observations) -> Any:
    return arviz_data(post, obs, n_draws=400, n_frames=150, seed=2)


def project(theta: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of directions (n, 3), Brown's distortion, written again."""
    xy = theta[2] * b[:, :2] / b[:, 2:]
    square = np.sum(xy**2, axis=1, keepdims=True)
    return theta[:2] + xy * (1.0 + theta[3] * square + theta[4] * square**2)


def test_groups_have_names_units_and_the_same_draws(data, post, obs):
    for group in ("posterior", "sample_stats", *GROUPS):
        dataset = data[group]
        assert all(dataset[name].attrs["units"] for name in dataset.data_vars), group
    likelihood = data["log_likelihood"][LOG_LIKELIHOOD]
    assert likelihood.dims == ("chain", "draw", "frame")
    assert np.array_equal(likelihood["frame"].values, obs.frame_ids)
    assert dict(likelihood.sizes) == {"chain": 4, "draw": 100, "frame": 150}
    assert data["posterior"]["f"].shape == (4, 100)
    assert np.isin(data["posterior"]["f"].values, post.data["posterior"]["f"].values).all()
    assert set(data["prior"].data_vars) == set(data["posterior"].data_vars)
    assert data["prior"]["x0"].values.std() > 50.0 * data["posterior"]["x0"].values.std()
    assert np.array_equal(data["observed_data"]["x_px"].values, obs.x_px)
    assert np.array_equal(data["observed_data"]["star_frame"].values, obs.frame)


def test_arviz_writes_all_of_it(data: Any, tmp_path: Path) -> None:
    import xarray as xr

    data.to_netcdf(tmp_path / "all.nc", engine="h5netcdf")
    again = xr.open_dataset(tmp_path / "all.nc", group="log_likelihood", engine="h5netcdf")
    assert np.array_equal(
        again[LOG_LIKELIHOOD].values, data["log_likelihood"][LOG_LIKELIHOOD].values
    )


def test_sampled_degrees_of_freedom_are_a_variable(post: Posterior, tmp_path: Path) -> None:
    assert "dof" not in post.data["posterior"]
    free = replace(post, dof_draws=np.linspace(3.0, 9.0, len(post.draws)))
    free.save(tmp_path / "free.nc")
    for one in (free, Posterior.load(tmp_path / "free.nc")):
        dof = one.data["posterior"]["dof"]
        assert dof.dims == ("chain", "draw") and dof.attrs["units"] == "1"
        assert np.array_equal(dof.values.ravel(), free.dof_draws)


def test_the_same_seed_gives_the_same_images(post: Posterior, obs: sc.Observations) -> None:
    one, same, other = (
        arviz_data(post, obs, groups=["posterior_predictive"], n_draws=8, n_frames=3, seed=seed)
        for seed in (5, 5, 6)
    )
    images = [d["posterior_predictive"]["x_px"].values for d in (one, same, other)]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


@pytest.mark.parametrize("frame", [0, 77])
def test_log_likelihood_is_the_integral_over_the_attitude(frame, data, post, night, obs):
    draw = data["posterior"].isel(chain=1, draw=7)
    theta = np.array([float(draw[p.name]) * p.scale for p in post.parameters[:-1]])
    sigma = float(draw["sigma"])
    rows = obs.frame == obs.frame_ids[frame]
    r, pixel = outside.unit_vectors(obs.ra_deg, obs.dec_deg)[rows], obs.xy[rows]

    def residuals(phi: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(phi).as_matrix() @ night.attitudes[frame]
        return (pixel - project(theta, r @ turn.T)).ravel() / sigma

    best = least_squares(residuals, np.zeros(3), x_scale=1e-5, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    root = np.linalg.inv(np.linalg.cholesky(best.jac.T @ best.jac)).T
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    total = 0.0
    for i, j, k in np.ndindex(7, 7, 7):
        u = nodes[[i, j, k]]
        e = residuals(best.x + root @ u)
        total += (
            weights[i] * weights[j] * weights[k] * np.exp(-0.5 * e @ e + best.cost + 0.5 * u @ u)
        )
    n = 2 * len(r)
    expected = (
        np.log(total * np.linalg.det(root))
        - best.cost
        - n * np.log(sigma)
        - 0.5 * n * np.log(2.0 * np.pi)
    )
    found = float(data["log_likelihood"][LOG_LIKELIHOOD].values[1, 7, frame])
    assert found == pytest.approx(expected, abs=1e-3)


def test_drawn_images_are_those_of_a_second_exposure(data, post, night, obs, monkeypatch):
    rng = np.random.default_rng(8)
    seen = outside.unit_vectors(obs.ra_deg, obs.dec_deg)
    b = np.einsum("nij,nj->ni", np.repeat(night.attitudes, 5, axis=0), seen)
    again = project(night.theta, b) + SIGMA * rng.standard_normal((len(b), 2))

    def inside(made: Any, share: float) -> float:
        images = made["posterior_predictive"]
        hits = []
        for axis, name in enumerate(("x_px", "y_px")):
            low, high = np.quantile(
                images[name].values, [0.5 - share / 2, 0.5 + share / 2], axis=(0, 1)
            )
            hits.append((low < again[:, axis]) & (again[:, axis] < high))
        return float(np.mean(hits))

    # 1500 numbers: 0.0056 and 0.013 are one standard error.
    assert abs(inside(data, 0.95) - 0.95) < 0.017
    assert abs(inside(data, 0.5) - 0.5) < 0.039
    # The control does not draw the attitude, which takes up 3 of the 10 numbers of a frame.
    monkeypatch.setattr(groups, "_roots", np.zeros_like)
    assert (
        inside(
            arviz_data(post, obs, groups=["posterior_predictive"], n_draws=400, n_frames=150), 0.95
        )
        < 0.93
    )


def test_residuals_of_data_and_drawn_images_are_alike(data: Any) -> None:
    observed, drawn = (
        data[g]["residual_x_px"].values for g in ("observed_data", "posterior_predictive")
    )
    spread = drawn.std(axis=-1)
    assert np.mean(spread < observed.std()) == pytest.approx(0.5, abs=0.49)
    # What an attitude takes up is no residual: 0.7 of the variance is left.
    assert spread.mean() == pytest.approx(SIGMA * np.sqrt(0.7), rel=0.05)


@pytest.mark.slow
def test_loo_is_the_comparison_of_the_product() -> None:
    import arviz as az

    obs = scenes.observations("brown", 40)
    cal = sc.calibrate(obs, scenes.nominal(scenes.camera()))
    own = compare_models(obs, cal, ["brown", "k1"])
    elpd, pointwise = {}, {}
    for name in ("brown", "k1"):
        fitted = sc.calibrate(obs, scenes.nominal(scenes.camera(name)))
        made = arviz_data(
            sc.sample(obs, fitted, seed=3, n_steps=100), obs, groups=["log_likelihood"], n_draws=600
        )
        found = az.loo(made, pointwise=True)
        elpd[name] = float(found["elpd_loo"] if hasattr(found, "elpd_loo") else found.elpd)
        pointwise[name] = np.asarray(found.loo_i if hasattr(found, "loo_i") else found.elpd_i)
        score = own.of(name)
        # Their Monte Carlo error; one nat is what a parameter costs.
        assert elpd[name] == pytest.approx(score.elpd, abs=0.4)
        assert elpd[name] == pytest.approx(score.closed_form, abs=0.4)
    worse = own.of("k1")
    assert elpd["k1"] - elpd["brown"] == pytest.approx(
        worse.difference, abs=0.1 * worse.difference_se
    )
    spread = float(np.sqrt(40) * np.std(pointwise["k1"] - pointwise["brown"], ddof=1))
    assert spread == pytest.approx(worse.difference_se, rel=0.05)


def test_frames_of_a_student_likelihood_add_up() -> None:
    obs = scenes.observations("brown", 20)
    camera = scenes.camera()
    frames = StarFrames.from_observations(obs)
    start = groups.MarginalLikelihood(frames, "brown").start_rotations(camera.theta)
    likelihood = StudentLikelihood(frames, "brown", camera.theta, start)
    at = (camera.theta, SIGMA, 4.0)
    assert likelihood.by_frame(*at).sum() == pytest.approx(likelihood.log_likelihood(*at), abs=1e-5)


def test_student_draws_have_tails_and_stated_noise_its_density(post, obs):
    settings = {"settings": {**post.provenance["settings"], "dof": 3.0}}
    heavy = replace(
        post,
        diagnostics=replace(post.diagnostics, likelihood="student_t"),
        provenance=post.provenance | settings,
    )
    made = arviz_data(
        heavy, obs, groups=["log_likelihood", "posterior_predictive"], n_draws=40, n_frames=150
    )
    drawn = made["posterior_predictive"]["residual_x_px"].values.ravel()
    assert np.mean((drawn / drawn.std()) ** 4) > 5.0
    assert np.isfinite(made["log_likelihood"][LOG_LIKELIHOOD].values).all()


def test_what_there_is_not_says_why(post, obs):
    other = obs.select_frames(obs.frame_ids[:20])
    pairs = replace(post, diagnostics=replace(post.diagnostics, likelihood="pairs"))
    for draws, table, group, words in (
        (post, obs, "likelihood", "group 'likelihood' is unknown"),
        (post, other, "log_likelihood", "all of them"),
        (pairs, obs, "posterior_predictive", "none of star positions"),
        (replace(post, star_error_px=0.1), obs, "log_likelihood", "depend on each other"),
    ):
        with pytest.raises(SamplingError, match=words):
            arviz_data(draws, table, groups=[group])
    made = arviz_data(post, other, n_draws=8)
    assert made["posterior"].attrs["left_out"].startswith("log_likelihood: ")
    assert made["posterior_predictive"]["x_px"].sizes["star"] == other.n_stars
