"""Attitude errors from the posterior: against attitudes solved one by one, and against simulated campaigns."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from starcal_uq.attitude import left_error, rotation_to_quaternion, rotation_vector
from starcal_uq.calibration import Calibration
from starcal_uq.errors import DistortionError, ObservationError, RunFolderError, SamplingError
from starcal_uq.estimation import calibrate
from starcal_uq.observations import Observations
from starcal_uq.projection import unproject_theta
from starcal_uq.propagation import AXES, CONTRIBUTORS, AttitudeError, propagate
from starcal_uq.wahba import quest
from tests.scenes import camera, nominal, observations, with_sigmas

ARCSEC = 648_000.0 / np.pi


def gaussian_posterior(cal: Calibration, n: int = 4000, scale: float = 1.0, seed: int = 0) -> SimpleNamespace:
    """What `propagate` reads of a posterior, with Gaussian draws; sigmas `scale` times those of the calibration."""
    rng = np.random.default_rng(seed)
    sd = np.sqrt(np.diag(cal.covariance))
    root = np.linalg.cholesky(cal.covariance / np.outer(sd, sd))
    theta = cal.theta + scale * sd * (rng.standard_normal((n, len(sd))) @ root.T)
    draws = np.column_stack((theta, cal.sigma + cal.sigma_std * rng.standard_normal(n)))
    return SimpleNamespace(
        camera=cal.camera,
        draws=draws,
        theta_draws=theta,
        sigma_draws=draws[:, -1],
        sigma_name=cal.sigma_name,
        mean=theta.mean(axis=0),
        covariance=np.cov(theta, rowvar=False),
        rotation_per_theta=cal.rotation_per_theta,
        attitude_noise=cal.attitude_noise,
        thin=lambda count, seed: draws[np.random.default_rng(seed).permutation(n)[:count]],
    )


@lru_cache
def scene(model: str = "brown", stated: bool = False) -> tuple[Observations, Calibration]:
    obs = observations(model)
    obs = with_sigmas(obs) if stated else obs
    return obs, calibrate(obs, nominal(camera(model)))


@lru_cache
def error(n_draws: int = 300) -> AttitudeError:
    obs, cal = scene()
    return propagate(gaussian_posterior(cal), obs, n_draws=n_draws, seed=1)


@pytest.mark.parametrize("stated", [False, True])
def test_rotations_are_those_of_scipy(stated: bool) -> None:
    from scipy.spatial.transform import Rotation

    obs, cal = scene(stated=stated)
    post = gaussian_posterior(cal)
    found = propagate(post, obs, n_draws=4, seed=3)
    weights = np.ones(obs.n_stars) if obs.sigma_px is None else obs.sigma_px**-2.0

    def attitudes(theta: np.ndarray) -> np.ndarray:
        b, r = unproject_theta("brown", theta, obs.xy), obs.directions_icrs
        frames = (slice(*obs.frame_starts[k : k + 2]) for k in range(obs.n_frames))
        return np.array([Rotation.align_vectors(b[s], r[s], weights=weights[s])[0].as_matrix() for s in frames])

    reference = attitudes(post.mean)
    phi = np.array([rotation_vector(attitudes(d[:-1]) @ np.swapaxes(reference, 1, 2)) for d in post.thin(4, 3)])
    np.testing.assert_allclose(found.common_draws_arcsec, phi.mean(axis=1) * ARCSEC, atol=1e-6)


def test_with_all_draws_sigmas_are_plain_standard_deviations() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal, n=60)
    found = propagate(post, obs, n_draws=60)
    reference = quest(unproject_theta("brown", post.mean, obs.xy), obs.directions_icrs, obs.frame_starts)
    b = np.stack([unproject_theta("brown", theta, obs.xy) for theta in post.theta_draws])
    phi = ARCSEC * left_error(quest(b, obs.directions_icrs, obs.frame_starts).quaternions, reference.quaternions)
    common = phi.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(found.common_arcsec, common[:, 0].std(axis=0, ddof=1), rtol=1e-8)
    rest = (phi - common).std(axis=0, ddof=1)
    np.testing.assert_allclose(found.rest_rms_per_frame_arcsec, rest, rtol=1e-4)
    np.testing.assert_allclose(found.rest_arcsec, np.sqrt(np.mean(rest**2, axis=0)), rtol=1e-4)
    total = np.sqrt(np.mean(phi.var(axis=0, ddof=1), axis=0))
    np.testing.assert_allclose(found.calibration_total_arcsec, total, rtol=1e-6)


def test_few_draws_tell_nearly_as_much_as_all() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    few, many = propagate(post, obs, n_draws=20, seed=4), propagate(post, obs, n_draws=4000)
    for name in ("common_arcsec", "rest_arcsec"):
        np.testing.assert_allclose(getattr(few, name), getattr(many, name), rtol=2e-3)
    # Control: without the control variate, 20 draws are good to 16 % only.
    plain = few.common_draws_arcsec.std(axis=0, ddof=1)
    assert np.max(np.abs(plain / many.common_arcsec - 1.0)) > 0.05


@pytest.mark.parametrize("model", ["none", "brown", "brown_tangential", "inverse"])
@pytest.mark.parametrize("stated", [False, True])
def test_sampled_and_first_order_agree(model: str, stated: bool) -> None:
    obs, cal = scene(model, stated)
    found = propagate(gaussian_posterior(cal), obs, n_draws=50)
    # First order weights pixels, QUEST directions; across the boresight that makes hardly a difference.
    np.testing.assert_allclose(found.common_arcsec[:2], found.analytic_common_arcsec[:2], rtol=0.01)
    np.testing.assert_allclose(found.common_arcsec[2], found.analytic_common_arcsec[2], rtol=0.15)
    np.testing.assert_allclose(found.rest_arcsec, found.analytic_rest_arcsec, rtol=0.01)
    np.testing.assert_allclose(found.nea_arcsec, found.analytic_nea_arcsec, rtol=0.02)


def test_sampling_sees_what_first_order_does_not() -> None:
    """Principal points wrong by tens of pixels and k1 by a hundred sigmas: their product is no longer small."""
    obs, cal = scene()
    found = propagate(gaussian_posterior(cal, n=500, scale=100.0), obs, n_draws=500)
    raw = found.common_draws_arcsec.std(axis=0, ddof=1)
    np.testing.assert_allclose(found.common_arcsec, raw, rtol=1e-6)
    assert np.max(np.abs(found.common_arcsec / found.analytic_common_arcsec - 1.0)) > 0.1


def test_principal_point_is_a_rotation_of_the_camera() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal, n=3)
    f = cal.theta[2]
    theta = cal.theta + np.array([[-1.0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0], [0, 0, 0, 0, 0]])
    post.theta_draws = theta
    post.draws = np.column_stack((theta, np.full(3, 0.05)))
    post.thin = lambda n, seed: post.draws
    post.mean, post.covariance = theta.mean(axis=0), np.cov(theta, rowvar=False)
    found = propagate(post, obs)
    # x0 larger: every direction moves to -x, which is a negative yaw (rotation about +Y) of the camera-frame vectors.
    expected = np.array([[0, 1, 0], [0, -1, 0], [0, 0, 0]]) * ARCSEC / f
    np.testing.assert_allclose(found.common_draws_arcsec, expected, atol=0.02 * ARCSEC / f)
    assert found.rest_arcsec[1] < 0.01 * found.common_arcsec[1]


@pytest.mark.parametrize("stated", [False, True])
def test_noise_term_is_that_of_noisy_frames(stated: bool) -> None:
    obs, cal = scene(stated=stated)
    post = gaussian_posterior(cal)
    sigma = post.sigma_draws.mean() * (np.ones(obs.n_stars) if obs.sigma_px is None else obs.sigma_px)
    weights = None if obs.sigma_px is None else obs.sigma_px**-2.0
    rng = np.random.default_rng(5)
    clean = quest(unproject_theta("brown", post.mean, obs.xy), obs.directions_icrs, obs.frame_starts, weights)
    noise = sigma[:, None] * rng.standard_normal((1000, obs.n_stars, 2))
    b = np.stack([unproject_theta("brown", post.mean, obs.xy + e) for e in noise])
    noisy = quest(b, obs.directions_icrs, obs.frame_starts, weights)
    errors = ARCSEC * left_error(noisy.quaternions, clean.quaternions)
    found = propagate(post, obs, n_draws=2)
    ratio = errors.std(axis=0) / found.nea_per_frame_arcsec
    # 60 frames of 3 axes, each good to 2.2 %.
    assert np.abs(ratio - 1.0).max() < 4.5 / np.sqrt(2000)
    assert abs(ratio.mean() - 1.0) < 0.01
    pooled = np.abs(errors.reshape(-1, 3))
    pooled = np.column_stack((pooled, np.hypot(pooled[:, 0], pooled[:, 1])))
    np.testing.assert_allclose(found.p95_arcsec[0], np.quantile(pooled, 0.95, axis=0), rtol=0.02)
    np.testing.assert_allclose(found.p997_arcsec[0], np.quantile(pooled, 0.997, axis=0), rtol=0.06)


def test_quantiles_are_those_of_the_draws() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    found = propagate(post, obs, n_draws=4000)
    draws = np.abs(found.common_draws_arcsec - found.common_draws_arcsec.mean(axis=0))
    draws = np.column_stack((draws, np.hypot(draws[:, 0], draws[:, 1])))
    np.testing.assert_allclose(found.p95_arcsec[1], np.quantile(draws, 0.95, axis=0), rtol=2e-3)
    np.testing.assert_allclose(found.p997_arcsec[1], np.quantile(draws, 0.997, axis=0), rtol=2e-3)
    # Gaussian draws, two alike axes: 2.45 sigma, not 1.96.
    assert found.p95_arcsec[1, 3] / np.sqrt(np.mean(found.common_arcsec[:2] ** 2)) == pytest.approx(2.45, abs=0.1)
    assert found.p95_arcsec[1, 0] / found.common_arcsec[0] == pytest.approx(1.96, abs=0.1)
    # The mixture over frames has longer tails than a Gaussian.
    assert (found.p997_arcsec[2, :3] > 2.97 * found.rest_arcsec).all()


def test_seed_repeats_and_changes_the_draws() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    one, again, other = (propagate(post, obs, n_draws=10, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.common_draws_arcsec, again.common_draws_arcsec)
    np.testing.assert_array_equal(one.p997_arcsec, again.p997_arcsec)
    assert (one.common_draws_arcsec != other.common_draws_arcsec).all()


def test_batches_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    whole = propagate(post, obs, n_draws=10)
    monkeypatch.setattr("starcal_uq.propagation._STARS_AT_ONCE", 3 * obs.n_stars)
    parts = propagate(post, obs, n_draws=10)
    np.testing.assert_array_equal(whole.common_draws_arcsec, parts.common_draws_arcsec)
    np.testing.assert_allclose(whole.rest_arcsec, parts.rest_arcsec, rtol=1e-10)


def test_table_has_one_row_per_contributor_and_axis() -> None:
    found = error()
    table = found.to_dataframe()
    assert list(table.columns) == [
        "contributor",
        "axis",
        "sigma_arcsec",
        "p95_arcsec",
        "p997_arcsec",
        "first_order_arcsec",
        "absorbed_by_alignment",
    ]
    assert list(table["axis"]) == [*AXES, "cross-boresight"] * 4
    assert list(table["contributor"].unique()) == list(CONTRIBUTORS)
    absorbed = table.groupby("contributor", sort=False)["absorbed_by_alignment"].first()
    assert list(absorbed) == ["no", "yes", "no", "in part"]
    rows = table.set_index(["contributor", "axis"])["sigma_arcsec"]
    assert rows["calibration, common rotation", "yaw"] == found.common_arcsec[1]
    across = np.sqrt(np.mean(found.nea_arcsec[:2] ** 2))
    assert rows["centroid noise (NEA)", "cross-boresight"] == pytest.approx(across)
    assert (table["p95_arcsec"] > table["sigma_arcsec"]).all()
    assert (table["p997_arcsec"] > table["p95_arcsec"]).all()
    html = found._repr_html_()
    assert "300 posterior draws" in html
    assert "cross-boresight" in html


def test_file_keeps_every_digit(tmp_path: Path) -> None:
    found = error()
    path = tmp_path / "attitude.csv"
    path.write_text("old")
    found.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["attitude.csv"]
    loaded = AttitudeError.load(path)
    for field in dataclasses.fields(AttitudeError)[:10]:
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(found, field.name), err_msg=field.name)
    assert loaded.common_draws_arcsec is None
    assert loaded.to_dataframe().equals(found.to_dataframe())


@pytest.mark.parametrize(
    "text", ["", "contributor,axis\n", "contributor,axis,sigma_arcsec\na,b,c\n", "\x00\x01", "a,b\n1,2,3\n4\n"]
)
def test_broken_files_are_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "attitude.csv"
    path.write_text(text)
    with pytest.raises(RunFolderError, match=r"attitude\.csv: is not a table of attitude errors"):
        AttitudeError.load(path)
    with pytest.raises(RunFolderError, match=r"none\.csv: cannot be read .*; run `starcal-uq propagate RUN`"):
        AttitudeError.load(tmp_path / "none.csv")


def test_what_cannot_be_propagated_is_said() -> None:
    obs, cal = scene()
    post = gaussian_posterior(cal)
    with pytest.raises(SamplingError, match="at least two"):
        propagate(post, obs, n_draws=1)
    folded = gaussian_posterior(cal)
    folded.theta_draws[:, 3] = folded.draws[:, 3] = -1e-5
    with pytest.raises(DistortionError, match="10 of 10 posterior draws the distortion 'brown' folds over"):
        propagate(folded, obs, n_draws=10)
    scaled = gaussian_posterior(scene(stated=True)[1])
    with pytest.raises(ObservationError, match="no sigma_px"):
        propagate(scaled, obs, n_draws=10)


def test_plots_itself() -> None:
    from matplotlib.axes import Axes

    assert isinstance(error().plot_attitude(), Axes)


@pytest.mark.slow
def test_errors_of_simulated_campaigns_are_as_predicted() -> None:
    """Two hundred campaigns on one set of frames: attitudes at the estimate against the true ones."""
    from scipy import stats

    clean = observations(n_frames=60, sigma_px=0.0)
    truth = camera("brown")
    r, starts = clean.directions_icrs, clean.frame_starts
    true = quest(unproject_theta("brown", truth.theta, clean.xy), r, starts).quaternions
    rng = np.random.default_rng(6)
    n = 200
    common, rest = np.empty((n, 3)), np.empty((n, clean.n_frames, 3))
    for i in range(n):
        noise = 0.05 * rng.standard_normal((2, clean.n_stars))
        obs = dataclasses.replace(clean, x_px=clean.x_px + noise[0], y_px=clean.y_px + noise[1])
        theta = calibrate(obs, nominal(truth)).theta
        # The calibration alone: its camera with the pixels it has not been fitted to.
        phi = ARCSEC * left_error(quest(unproject_theta("brown", theta, clean.xy), r, starts).quaternions, true)
        common[i] = phi.mean(axis=0)
        rest[i] = phi - common[i]
    predicted = propagate(gaussian_posterior(calibrate(obs, nominal(truth))), obs)
    chi2 = np.sum(common**2, axis=0) / predicted.common_arcsec**2
    assert (stats.chi2.cdf(chi2, n) > 1e-3).all()
    assert (stats.chi2.sf(chi2, n) > 1e-3).all()
    np.testing.assert_allclose(np.sqrt(np.mean(rest**2, axis=(0, 1))), predicted.rest_arcsec, rtol=0.15)
    # Control: whoever takes the rest for the whole is wrong by far.
    assert np.max(stats.chi2.sf(np.sum(common[:, :2] ** 2, axis=0) / predicted.rest_arcsec[:2] ** 2, n)) < 1e-12


def test_quaternions_of_the_calibration_are_those_of_quest() -> None:
    """The attitudes that the likelihood profiles and those of QUEST differ by a small part of the noise."""
    obs, cal = scene()
    found = quest(unproject_theta("brown", cal.theta, obs.xy), obs.directions_icrs, obs.frame_starts)
    difference = ARCSEC * left_error(rotation_to_quaternion(found.rotations), cal.quaternions)
    assert (np.sqrt(np.mean(difference**2, axis=0)) < 0.2 * error().nea_arcsec).all()
