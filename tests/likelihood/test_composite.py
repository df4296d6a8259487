"""Pairs as a composite likelihood: right curvature, right coverage, and what happens without it."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.projection import (
    backward_kernel,
    backward_root,
    backward_second_kernel,
    project,
    second_index,
)
from starcal_uq.core.errors import SamplingError
from starcal_uq.core.status import Level
from starcal_uq.inference.named import NaivePairsWarning
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.sample import sample
from starcal_uq.inference.target import laplace_approximation, start_target
from starcal_uq.likelihood import composite as module
from starcal_uq.likelihood.composite import (
    PairLikelihood,
    enough_frames,
    expected_godambe,
    pair_covariance,
    pair_likelihood,
)
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.maths.linear import symmetric_inverse
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.outside import campaign
from tests.helpers.scenes import USUAL, camera, nominal, observations, with_sigmas

QUICK: dict[str, Any] = {"n_ensembles": 2, "n_walkers": 32, "n_steps": 60, "n_burn": 10, "seed": 3}


def build(obs: Any, model: str = "brown", **options: Any) -> tuple[PairLikelihood, Any]:
    cal = calibrate(obs, nominal(camera(model)))
    frames = StarFrames.from_observations(obs)
    return pair_likelihood(
        frames, model, cal.pair_theta, chi2=cal.chi2, residual_dof=cal.dof, **options
    ), cal


def relative(matrix: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference in units of the reference's diagonal."""
    scale = np.sqrt(np.diag(reference))
    return float(np.max(np.abs(matrix - reference) / np.outer(scale, scale)))


@pytest.mark.parametrize("model", USUAL)
def test_second_derivatives_of_directions(model: str) -> None:
    theta = camera(model).theta
    pixel = np.random.default_rng(1).uniform(0.0, 1023.0, (2, 40))
    root = backward_root(model, theta, pixel)
    b, db, second = backward_second_kernel(model)(40, theta, pixel, root)
    value, first = backward_kernel(model, True)(40, theta, pixel, root)
    assert np.allclose(b, value, rtol=0, atol=1e-15)
    assert np.allclose(
        db, first, rtol=1e-12, atol=1e-12 * np.abs(first).max(axis=(1, 2), keepdims=True)
    )
    rows, columns = second_index(len(theta))
    # Steps that move the corner by about a pixel, whatever the parameter's unit.
    step = 1e-5 / np.abs(db).max(axis=(1, 2))
    for k, size in enumerate(step):
        unit = size * np.eye(len(theta))[k]
        up, down = (
            backward_kernel(model, True)(
                40, theta + s * unit, pixel, backward_root(model, theta + s * unit, pixel)
            )[1]
            for s in (1.0, -1.0)
        )
        slope = (up - down) / (2.0 * size)
        for entry in np.flatnonzero(rows == k):
            other = columns[entry]
            tolerance = 1e-4 * np.abs(db[other]).max() * np.abs(db[k]).max() * 10.0
            assert np.max(np.abs(second[entry] - slope[other])) < tolerance


@pytest.mark.parametrize("model", USUAL)
@pytest.mark.parametrize("stated", [False, True])
def test_generalised_least_squares_over_pairs_has_the_marginal_information(model, stated):
    """With their full covariance the pairs know what the pixels know once attitudes are free."""
    obs = observations(model, n_frames=6)
    obs = with_sigmas(obs) if stated else obs
    theta, cam = camera(model).theta, camera(model)
    frames = StarFrames.from_observations(obs)
    state, _ = MarginalLikelihood(frames, model).profile(theta)
    # Noise-free pixels, so that both linearise at the same point.
    frames = StarFrames(project(cam, state.b.T).T, frames.r, frames.weight, frames.starts)
    expected = MarginalLikelihood(frames, model).evaluate(theta).matrix
    total, unaware = np.zeros_like(expected), np.zeros_like(expected)
    for k in range(frames.n_frames):
        part = frames.part(k, k + 1)
        objective = PairObjective(part, model)
        _, jacobian = objective.residuals(theta)
        b, db = objective.directions(theta, part)
        i, j = objective.pair_indices()
        noise = np.ones(part.n_stars) if part.weight is None else 1.0 / part.weight
        design = np.zeros((len(i), 2 * part.n_stars))
        for axis in range(2):
            # Moving a pixel moves its direction as moving the principal point does, the other way
            # round.
            design[np.arange(len(i)), 2 * i + axis] = (
                -np.sum(db[axis][:, i] * b[:, j], axis=0) * noise[i]
            )
            design[np.arange(len(i)), 2 * j + axis] = (
                -np.sum(db[axis][:, j] * b[:, i], axis=0) * noise[j]
            )
        # Of m (m - 1) / 2 pairs 2 m - 3 are independent: their covariance has that rank.
        u, s, _ = np.linalg.svd(design, full_matrices=False)
        rank = 2 * part.n_stars - 3
        assert s[rank] < 1e-10 * s[rank - 1]
        whitened = (u[:, :rank].T @ jacobian) / s[:rank, None]
        total += whitened.T @ whitened
        variance = np.sum(design**2, axis=1)
        unaware += jacobian.T @ (jacobian / variance[:, None])
    assert relative(total, expected) < 1e-8
    # The control: weights without covariances claim several times the information.
    assert np.all(np.diag(unaware) > 3.0 * np.diag(expected))


@pytest.mark.parametrize("model", USUAL)
def test_gram_equals_the_objective(model: str) -> None:
    found, _ = build(observations(model, n_frames=30), model)
    z = np.random.default_rng(2).standard_normal((60, len(found.theta_hat)))
    theta = found.theta_hat + z @ found.whitening.T
    sigma = np.full(60, found.sigma)
    difference = found.log_likelihood(theta, sigma) - found.exact_log_likelihood(theta, sigma)
    assert np.ptp(found.log_likelihood(theta, sigma)) > 3.0
    assert np.max(np.abs(difference)) < 0.01
    assert found.gram[0, 0] * found.tau**2 == pytest.approx(
        found.objective.cost(found.theta_hat), rel=1e-9
    )


def test_gram_does_not_depend_on_its_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    obs = observations(n_frames=30)
    whole, _ = build(obs)
    monkeypatch.setattr(module, "_PAIRS_AT_ONCE", 97)
    monkeypatch.setattr(module, "_STARS_AT_ONCE", 60)
    blocks, _ = build(obs)
    assert np.allclose(blocks.gram, whole.gram, rtol=1e-10, atol=1e-10 * whole.gram.max())
    assert blocks.pair_noise == pytest.approx(whole.pair_noise, rel=1e-12)
    assert relative(blocks.covariance, whole.covariance) < 1e-10


@pytest.mark.parametrize("variability", ["expected", "empirical"])
def test_curvature_is_godambes_information(variability: str) -> None:
    found, cal = build(observations(), variability=variability)
    priors = Priors.default(cal.nominal)
    for likelihood in (found, build(observations(), adjusted=False)[0]):
        start = start_target(
            likelihood.log_likelihood,
            priors,
            likelihood.theta_hat,
            symmetric_inverse(likelihood.covariance),
            likelihood.sigma,
            float(likelihood.dof),
            True,
        )
        _, laplace = laplace_approximation(start)
        expected = symmetric_inverse(
            symmetric_inverse(likelihood.covariance) + priors.precision(priors.names[:-1])
        )
        # The naive one is scaled by the expected noise of a pair; the observed noise differs by a
        # few percent.
        assert relative(laplace.covariance, expected) < (0.01 if likelihood.adjusted else 0.1)
    assert found.narrowness > 2.5
    # One takes V from the model and sigma, and loses the parameters' degrees of freedom when these
    # are integrated.
    theta, objective = cal.pair_theta, found.objective
    expected, more = expected_godambe(objective, theta, np.sqrt(cal.chi2 / cal.dof)), 5
    if variability == "empirical":
        expected, more = objective.godambe(theta), 0
    assert relative(found.covariance, expected) < 1e-12
    assert found.dof == cal.dof + more
    narrow = np.diag(found.covariance) / np.diag(
        build(observations(), adjusted=False)[0].covariance
    )
    assert found.narrowness == pytest.approx(np.sqrt(np.mean(narrow)), rel=1e-12)


def test_expected_variability_is_what_the_stated_noise_of_each_star_does_to_the_score() -> None:
    """By moving one pixel after the other, where the model fits exactly."""
    exact = observations(n_frames=3, sigma_px=0.0)
    obs = dataclasses.replace(
        exact, sigma_px=np.random.default_rng(1).uniform(0.02, 0.1, len(exact))
    )
    frames, theta, step = StarFrames.from_observations(obs), camera().theta, 1e-3
    objective = PairObjective(frames, "brown")
    v = np.zeros((5, 5))
    for axis in range(2):
        for star in range(frames.n_stars):
            scores = []
            for sign in (-1.0, 1.0):
                pixel = frames.pixel.copy()
                pixel[axis, star] += sign * step
                scores.append(
                    PairObjective(dataclasses.replace(frames, pixel=pixel), "brown")
                    .evaluate(theta)
                    .gradient
                )
            change = (scores[1] - scores[0]) / (2.0 * step) * obs.sigma_px[star]
            v += np.outer(change, change)
    inverse = symmetric_inverse(objective.evaluate(theta).matrix)
    for factor in (1.0, 1.3):
        assert (
            relative(expected_godambe(objective, theta, factor), factor**2 * inverse @ v @ inverse)
            < 1e-4
        )


def test_scatter_counts_from_fifty_frames_per_parameter_on() -> None:
    frames = StarFrames.from_observations(observations(n_frames=250))
    assert enough_frames(PairObjective(frames, "brown"))
    assert not enough_frames(PairObjective(frames.part(0, 249), "brown"))


def test_fewer_frames_than_parameters_have_the_covariance_of_gaussian_noise() -> None:
    """The scatter of four frames knows nothing of a fifth direction: that is the control."""
    obs = observations(n_frames=60).select_frames(range(4))
    cal = calibrate(obs, nominal(camera()), method="three_stage")
    objective = PairObjective(StarFrames.from_observations(obs), "brown")
    expected = expected_godambe(objective, cal.pair_theta, cal.sigma)
    assert relative(cal.pair_covariance, expected) < 1e-9 and cal.covariance is cal.pair_covariance
    unit = np.outer(cal.sigmas, cal.sigmas)
    assert np.linalg.eigvalsh(cal.covariance / unit)[0] > 1e-4
    assert np.linalg.eigvalsh(objective.godambe(cal.pair_theta) / unit)[0] < 1e-12
    unknown = pair_covariance(objective, cal.pair_theta, np.inf, cal.dof, 0.0)
    assert unknown.shape == (5, 5) and np.isnan(unknown).all()


@pytest.mark.slow
def test_intervals_of_the_pair_estimate_cover_with_three_frames() -> None:
    """Against a simulator of another make; the sandwich over frames of before is the control."""
    inside, before = [], []
    for seed in range(100):
        c = campaign(np.random.default_rng(seed), n_frames=3)
        obs = Observations(**c.columns, meta={"directions": "apparent"})
        cal = calibrate(
            obs, Camera(**c.camera_toml(), coefficients=(0.0, 0.0)), method="three_stage"
        )
        low, high = cal.interval().T
        inside.append((low <= c.theta) & (c.theta <= high))
        spread = PairObjective(StarFrames.from_observations(obs), "brown").godambe(cal.theta)
        before.append(np.abs(cal.theta - c.theta) <= 1.96 * np.sqrt(np.diag(spread)))
    assert 0.92 < np.mean(inside) < 0.98
    assert np.mean(before) < 0.9


def test_noise_of_a_pair_is_predicted() -> None:
    for obs, sigma in (
        (observations(n_frames=200), 0.05),
        (with_sigmas(observations(sigma_px=0.0)), 1.0),
    ):
        found, _ = build(obs)
        assert found.tau / found.pair_noise == pytest.approx(sigma, rel=0.06)


def test_stars_other_than_those_of_the_estimate_are_refused() -> None:
    frames = StarFrames.from_observations(observations())
    _, cal = build(observations())
    naive = pair_likelihood(frames, "brown", cal.pair_theta, chi2=cal.chi2, residual_dof=cal.dof)
    # One parameter after the other: none is told by the size of its unit.
    for shift in 2.0 * np.diag(np.sqrt(np.diag(naive.covariance))):
        with pytest.raises(
            SamplingError,
            match=r"lies (1\.9|2\.0) standard deviations from the minimum of the pair",
        ):
            pair_likelihood(
                frames, "brown", cal.pair_theta + shift, chi2=cal.chi2, residual_dof=cal.dof
            )


@pytest.mark.usefixtures("few_importance_draws")
def test_sampling_pairs() -> None:
    obs = observations(n_frames=30)
    cal = calibrate(obs, nominal(camera()))
    found, _ = build(obs)
    post = sample(obs, cal, **QUICK, likelihood="pairs")
    d = post.diagnostics
    assert d.ok, d.checks
    assert (d.likelihood, d.likelihood_used) == ("pairs", "compressed")
    assert d.compressed_max_difference < 0.1
    assert np.max(np.abs(post.mean - cal.pair_theta) / post.sd[:5]) < 0.15
    assert np.allclose(post.sd[:5], np.sqrt(np.diag(found.covariance)), rtol=0.1)
    # Sigma comes from the pixels, with their own degrees of freedom.
    assert post.sigma_draws.mean() == pytest.approx(cal.sigma, rel=0.01)
    assert post.sd[5] == pytest.approx(cal.sigma_std, rel=0.1)
    short = {**QUICK, "n_walkers": 12, "n_steps": 20}
    both = [
        sample(obs, cal, **short, likelihood="pairs", evaluation=name)
        for name in ("compressed", "exact")
    ]
    assert [post.diagnostics.likelihood_used for post in both] == ["compressed", "exact"]
    # The same random numbers decide, so the draws themselves agree.
    assert np.max(np.abs(both[0].mean - both[1].mean) / post.sd[:5]) < 0.02


def test_sigma_given_scales_the_pairs() -> None:
    obs = observations(n_frames=30)
    cal = calibrate(obs, nominal(camera()))
    one, two = (sample(obs, cal, **QUICK, likelihood="pairs", sigma=s) for s in (0.05, 0.1))
    assert np.allclose(two.sd[:5] / one.sd[:5], 2.0, rtol=0.02)


def test_naive_pairs_warn_and_fail_their_checks() -> None:
    obs = observations(n_frames=30)
    cal = calibrate(obs, nominal(camera()))
    with pytest.warns(NaivePairsWarning):
        post = sample(obs, cal, **QUICK, likelihood="pairs_naive")
    assert not post.diagnostics.ok
    assert post.diagnostics.likelihood == "pairs_naive"
    (failed,) = (check for check in post.diagnostics.checks if check.level is Level.FAIL)
    assert "must not be used" in failed.sentence and failed.name == "Kind of likelihood"
    ratio = np.sqrt(np.diag(cal.covariance)) / post.sd[:5]
    assert np.all(ratio > 2.0)


@pytest.mark.slow
def test_godambe_is_the_covariance_of_the_pair_estimate() -> None:
    stars, truth = load_catalogue(max_mag=6.0, epoch=2026.9), camera()
    errors, predicted, naive = [], [], []
    for seed in range(300):
        obs = simulate(stars, truth, n_frames=40, min_stars=8, sigma_px=0.05, seed=40_000 + seed)
        objective = PairObjective(StarFrames.from_observations(obs), "brown")
        # One Gauss-Newton step from the truth reaches the minimum to second order in the noise.
        normal = objective.evaluate(truth.theta)
        inverse = symmetric_inverse(normal.matrix)
        estimate = truth.theta - inverse @ normal.gradient
        normal = objective.evaluate(estimate)
        estimate = estimate - symmetric_inverse(normal.matrix) @ normal.gradient
        errors.append(estimate - truth.theta)
        # Predictions differ by per cents: the mean of a few is known better than the scatter of all.
        if seed < 60:
            predicted.append(expected_godambe(objective, estimate, 0.05))
            naive.append(inverse * normal.cost / objective.n_pairs)
    sampled, godambe = np.cov(np.array(errors).T), np.mean(predicted, axis=0)
    correlation = godambe / np.sqrt(np.outer(np.diag(godambe), np.diag(godambe)))
    matters = np.abs(correlation) > 0.5
    assert matters.sum() == 11
    # A variance of 300 is known to 8 %.
    assert np.all(np.abs(sampled / godambe - 1.0)[matters] < 0.25), sampled / godambe
    # The control: independent pairs explain a tenth of it.
    assert np.all(np.diag(sampled) > 5.0 * np.diag(np.mean(naive, axis=0)))
