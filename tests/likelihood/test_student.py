"""Heavy tails: the likelihood itself."""

import dataclasses
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from starcal_uq.attitude.rotations import exp_rotation, quaternion_to_rotation
from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.projection import project
from starcal_uq.core.errors import SamplingError
from starcal_uq.inference.named import find_source
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.sample import sample
from starcal_uq.inference.surrogate import fit_polynomial
from starcal_uq.inference.target import Target
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.student import StudentLikelihood, log_excess_prior
from starcal_uq.maths.linear import scaled_cholesky, symmetric_inverse
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.table import Observations
from starcal_uq.pipeline.examples import example_data
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers.scenes import camera, nominal, observations, with_sigmas

QUICK: dict[str, Any] = {"n_ensembles": 2, "n_walkers": 32, "n_steps": 60, "n_burn": 10, "seed": 3}


def spoil(
    obs: Observations, share: float, kind: str = "random", seed: int = 0
) -> tuple[Observations, np.ndarray]:
    """Give some stars the direction of any star of the catalogue, or one within 60 px; also
    which.
    """
    rng = np.random.default_rng(seed)
    wrong = np.sort(rng.choice(obs.n_stars, round(share * obs.n_stars), replace=False))
    ra, dec = obs.ra_deg.copy(), obs.dec_deg.copy()
    if kind == "random":
        stars = load_catalogue(max_mag=6.0, epoch=2026.9)
        picks = rng.choice(len(stars), len(wrong))
        ra[wrong], dec[wrong] = stars.ra_deg[picks], stars.dec_deg[picks]
    else:
        angle = np.degrees(60.0 * np.sqrt(rng.uniform(0.01, 1.0, len(wrong))) / camera().focal_px)
        azimuth = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
        ra[wrong] = (ra[wrong] + angle * np.sin(azimuth) / np.cos(np.radians(dec[wrong]))) % 360.0
        dec[wrong] = np.clip(dec[wrong] + angle * np.cos(azimuth), -89.99, 89.99)
    return dataclasses.replace(obs, ra_deg=ra, dec_deg=dec, star_id=None), wrong


def student(obs: Observations, model: str = "brown") -> StudentLikelihood:
    frames = StarFrames.from_observations(obs)
    theta = camera(model).theta
    return StudentLikelihood(
        frames, model, theta, MarginalLikelihood(frames, model).start_rotations(theta)
    )


@pytest.mark.parametrize("stated", [False, True])
def test_many_degrees_of_freedom_are_the_gaussian(stated: bool) -> None:
    obs = observations(n_frames=20)
    obs = with_sigmas(obs) if stated else obs
    exact, heavy = MarginalLikelihood(obs, "brown"), student(obs)
    theta, sigma = camera().theta, 1.1 if stated else 0.055
    for shift in (0.0, 0.5):
        at = theta + np.array([shift, -shift, 0.1 * shift, 0.0, 0.0])
        assert heavy.log_likelihood(at, sigma, 1e9) == pytest.approx(
            exact.log_likelihood(at, sigma), abs=1e-3
        )
    # The control: at four degrees of freedom it is another likelihood.
    assert abs(heavy.log_likelihood(theta, sigma, 4.0) - exact.log_likelihood(theta, sigma)) > 5.0


def test_attitudes_are_integrated_out() -> None:
    """Laplace's method against a sum over a grid of rotations, for one frame with a wrong star."""
    obs = observations(n_frames=20)
    obs = obs.select_frames(obs.frame_ids[:1])
    obs = dataclasses.replace(obs, x_px=obs.x_px + np.where(np.arange(obs.n_stars) == 3, 8.0, 0.0))
    heavy, cam = student(obs), camera()
    grid = np.linspace(-6.0, 6.0, 41)
    values = []
    for sigma, nu in ((0.05, 4.0), (0.08, 4.0), (0.05, 2.0)):
        state = heavy.state(cam.theta, sigma, nu)
        # Standard deviations along the principal axes of the attitude's covariance.
        axes = np.linalg.cholesky(state.inverse[..., 0] * sigma**2)
        phi = (
            np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1).reshape(-1, 3) @ axes.T
        )
        total = 0.0
        for part in np.array_split(phi, 40):
            b = np.einsum(
                "gij,nj->gni", exp_rotation(part) @ state.rotations[0], obs.directions_icrs
            )
            xy = project(cam, b.reshape(-1, 3)).reshape(len(part), -1, 2)
            square = np.sum((obs.xy - xy) ** 2, axis=2) / sigma**2
            total += float(
                np.sum(np.exp(-0.5 * (nu + 2.0) * np.sum(np.log1p(square / nu), axis=1)))
            )
        volume = np.linalg.det(axes) * (grid[1] - grid[0]) ** 3 / (2.0 * np.pi) ** 1.5
        values.append(
            np.log(total * volume)
            - 2.0 * obs.n_stars * np.log(sigma)
            - heavy.log_likelihood(cam.theta, sigma, nu)
        )
    assert np.max(np.abs(values)) < 0.1


@pytest.mark.parametrize("model", ["brown", "inverse"])
def test_score_and_information_are_the_derivatives(model: str) -> None:
    obs, _ = spoil(with_sigmas(observations(model, n_frames=40)), 0.05, "neighbour")
    theta, sigma, nu = camera(model).theta, 1.2, 4.0
    heavy = student(obs, model)
    heavy.rotations = heavy.state(theta, sigma, nu).rotations
    found = heavy.information(theta, heavy.state(theta, sigma, nu), sigma)
    sd = 1.0 / np.sqrt(np.diag(found.matrix))
    at = theta + 0.5 * sd
    state = heavy.state(at, sigma, nu)
    score = heavy.information(at, state, sigma).score * sd
    mixed = np.array(
        [
            heavy.information(at + 0.01 * e, heavy.state(at + 0.01 * e, sigma, nu), sigma).score
            for e in np.diag(sd)
        ]
    )

    def without_volume(point: np.ndarray) -> float:
        # Scores leave out the volume of the attitudes.
        there = heavy.state(point, sigma, nu)
        return there.value - there.log_volume

    noise = heavy.information(at, state, sigma).attitude_noise
    assert np.allclose(noise, np.mean(state.inverse, axis=2) * sigma**2, rtol=1e-12, atol=0.0)
    assert state.log_volume == pytest.approx(
        0.5 * np.sum(np.linalg.slogdet(np.moveaxis(state.inverse, 2, 0))[1])
    )
    slope = [
        (without_volume(at + 0.05 * e) - without_volume(at - 0.05 * e)) / 0.1 for e in np.diag(sd)
    ]
    assert np.max(np.abs(score - slope)) < 0.01
    assert np.max(np.abs(score)) > 0.3
    information = heavy.information(at, state, sigma).matrix * np.outer(sd, sd)
    assert np.max(np.abs(-(mixed * sd - score) / 0.01 - information)) < 0.02


def test_stars_that_cannot_be_in_the_field_say_nothing() -> None:
    obs = observations(n_frames=20)
    theta = camera().theta
    far = obs.dec_deg.copy()
    far[5] = -far[5] if abs(far[5]) > 30.0 else far[5] - 60.0
    others = obs.select(np.arange(obs.n_stars) != 5)
    rotations = MarginalLikelihood(others, "brown").start_rotations(theta)
    with_far, without = (
        StudentLikelihood(StarFrames.from_observations(o), "brown", theta, rotations)
        for o in (dataclasses.replace(obs, dec_deg=far, star_id=None), others)
    )
    state = with_far.state(theta, 0.05, 4.0)
    assert list(np.flatnonzero(~state.seen)) == [5]
    assert not state.e[:, 5].any()
    assert state.value == pytest.approx(without.log_likelihood(theta, 0.05, 4.0), abs=1e-6)
    frames = with_far.by_frame(theta, 0.05, 4.0)
    assert np.sum(frames) == pytest.approx(state.value, abs=1e-6)
    assert np.allclose(frames, without.by_frame(theta, 0.05, 4.0), rtol=0, atol=1e-6)


@pytest.fixture(scope="module")
def spoilt() -> tuple[Any, Any]:
    obs, _ = spoil(observations(n_frames=16), 0.05)
    return obs, calibrate(obs, nominal(camera()), effects="tails", dof=4.0)


@pytest.mark.usefixtures("few_importance_draws")
def test_sampling_with_given_degrees_of_freedom(spoilt: tuple[Any, Any]) -> None:
    obs, cal = spoilt
    post = sample(obs, cal, **QUICK, likelihood="student_t")
    d = post.diagnostics
    assert d.ok, d.checks
    assert (d.likelihood, d.likelihood_used) == ("student_t", "compressed")
    assert d.compressed_max_difference < 0.2
    assert post.dof_draws is None
    assert post.provenance["settings"]["dof"] == 4.0
    # The sandwich covariance, not the curvature of a t distribution that the stars do not follow.
    assert np.allclose(post.sd[:5], cal.sigmas, rtol=0.12)
    assert np.max(np.abs(post.mean - cal.theta) / cal.sigmas) < 0.2
    assert post.sigma_draws.mean() == pytest.approx(cal.sigma, rel=0.02)
    short = {**QUICK, "n_walkers": 12, "n_steps": 8, "n_burn": 2}
    both = [
        sample(obs, cal, **short, likelihood="student_t", evaluation=name)
        for name in ("compressed", "exact")
    ]
    assert both[1].diagnostics.likelihood_used == "exact"
    assert np.max(np.abs(both[0].mean - both[1].mean) / cal.sigmas) < 0.1


@pytest.mark.usefixtures("few_importance_draws")
def test_sampling_degrees_of_freedom(spoilt: tuple[Any, Any], tmp_path: Path) -> None:
    obs, cal = spoilt
    post = sample(obs, cal, **QUICK, likelihood="student_t", dof="free")
    assert post.dof_draws.shape == (len(post.draws),)
    assert np.all(post.dof_draws > 2.0)
    assert post.draws.shape[1] == 6
    assert len(post.diagnostics.rhat) == 6
    assert post.laplace.names[-1] == "log_sigma"
    assert any(check.sentence.startswith("dof has the median") for check in post.diagnostics.checks)
    post.save(tmp_path / "posterior.nc")
    again = Posterior.load(tmp_path / "posterior.nc")
    assert np.array_equal(again.dof_draws, post.dof_draws)
    assert again.diagnostics.likelihood == "student_t"
    given = sample(obs, cal, **QUICK, likelihood="student_t", dof="free", sigma=0.05)
    assert np.all(given.sigma_draws == 0.05)
    assert given.dof_draws is not None
    assert np.isnan(given.diagnostics.rhat[-1])


@pytest.mark.usefixtures("few_importance_draws")
def test_student_t_from_a_gaussian_calibration() -> None:
    obs = observations(n_frames=30)
    cal = calibrate(obs, nominal(camera()))
    post = sample(obs, cal, **QUICK, likelihood="student_t")
    # Four degrees of freedom on Gaussian stars: right, and wider by a tenth or two.
    assert np.max(np.abs(post.mean - cal.theta) / cal.sigmas) < 1.0
    assert np.all((post.sd[:5] / cal.sigmas > 0.95) & (post.sd[:5] / cal.sigmas < 1.5))
    with pytest.raises(SamplingError):
        sample(obs, cal, **QUICK, likelihood="student_t", dof=500.0)


@pytest.fixture(scope="module")
def esa() -> tuple[Any, Any]:
    """Real frames of 24 to 92 stars, some with wrong ones and with more than one attitude that is a
    maximum.
    """
    example = example_data("esa")
    return example.observations, calibrate(
        example.observations, example.camera, effects="tails", dof=4.0
    )


def test_the_exact_likelihood_does_not_jump_between_attitudes(esa: tuple[Any, Any]) -> None:
    source = find_source("student_t", *esa, 4.0)
    root, rng = scaled_cholesky(symmetric_inverse(source.information)), np.random.default_rng(0)
    along = np.linspace(-2.0, 2.0, 41)
    for direction in rng.standard_normal((4, 5)):
        points = source.theta + along[:, None] * (root @ (direction / np.linalg.norm(direction)))
        values = source.exact(points, np.full(len(along), source.sigma))
        fitted = np.polynomial.Polynomial.fit(along, values, 4)(along)
        assert np.max(np.abs(values - fitted)) < 2e-3


def test_points_together_are_as_alone(esa: tuple[Any, Any]) -> None:
    obs, cal = esa
    start, rng = quaternion_to_rotation(cal.quaternions), np.random.default_rng(4)
    heavy = StudentLikelihood(StarFrames.from_observations(obs), "brown", cal.theta, start)
    # Far and near, so that searches end after different numbers of steps; and more stars than go
    # together.
    theta = cal.theta + rng.choice([0.01, 3.0], (30, 1)) * cal.sigmas * rng.standard_normal((30, 5))
    sigma, nu = cal.sigma * rng.uniform(0.7, 1.5, 30), rng.uniform(2.5, 20.0, 30)
    alone = [heavy.log_likelihood(*at) for at in zip(theta, sigma, nu, strict=True)]
    assert np.isfinite(alone).all()
    assert np.max(np.abs(heavy.many(theta, sigma, nu) - alone)) < 1e-9


@pytest.mark.slow
def test_a_polynomial_for_few_stars_gives_the_draws_of_the_exact_likelihood(esa):
    obs, cal = esa
    long: dict[str, Any] = {"n_walkers": 32, "n_steps": 100, "seed": 3, "likelihood": "student_t"}
    fast, exact = (sample(obs, cal, **long, evaluation=e) for e in ("auto", "exact"))
    assert fast.diagnostics.likelihood_used == "compressed" and fast.diagnostics.ok
    assert exact.diagnostics.likelihood_used == "exact" and exact.diagnostics.ok

    def apart(post: Any) -> float:
        return float(
            np.max(np.abs(np.quantile(post.draws, [0.05, 0.5, 0.95], axis=0) - middle) / exact.sd)
        )

    middle = np.quantile(exact.draws, [0.05, 0.5, 0.95], axis=0)
    # Quantiles of 10,000 effective draws differ by 0.03 sigma at the outer ones.
    assert apart(fast) < 0.08
    assert apart(sample(obs, cal, **long | {"dof": 3.0})) > 0.15


def test_polynomial_stands_for_a_likelihood_and_stays_tame() -> None:
    priors = Priors.default(nominal(camera()))
    theta, sd = camera().theta, np.array([0.5, 0.5, 0.1, 1e-10, 2e-16])

    def likelihood(at: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        u = (at - theta) / sd
        return (
            1e6
            - 0.5 * np.sum(u * u, axis=1)
            + 0.1 * u[:, 0] ** 2 * u[:, 1]
            - 200.0 * (np.log(sigma) + 3.0) ** 2
        )

    target = Target(likelihood, priors, np.append(theta, -3.0), np.diag(np.append(sd, 0.05)), None)
    fitted = [fit_polynomial(target, degree, np.random.default_rng(1)) for degree in (3, 2)]
    cubic, flat = (one.log_likelihood for one in fitted)
    u = 0.8 * np.random.default_rng(2).standard_normal((500, 6))
    exact = target.likelihood_at(u)
    assert np.max(np.abs(cubic(*target.arguments(target.natural(u))) - exact)) < 1e-6
    # The control: without the third order it misses by more than the bound on compressed
    # likelihoods.
    assert np.max(np.abs(flat(*target.arguments(target.natural(u))) - exact)) > 0.5
    far = target.natural(30.0 * u)
    assert np.all(cubic(*target.arguments(far)) < 1e6 - 100.0)

    def two_peaks(at: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        u = (at - theta) / sd
        return likelihood(at, sigma) + 0.5 * u[:, 4] ** 2 - 2.0 * np.abs(np.abs(u[:, 4]) - 1.5)

    assert (
        fit_polynomial(
            dataclasses.replace(target, log_likelihood=two_peaks), 2, np.random.default_rng(1)
        )
        is None
    )


def test_a_noise_beyond_all_numbers_is_impossible_and_no_error() -> None:
    obs = observations(n_frames=5)
    cal = calibrate(obs, nominal(camera()))
    rotations = quaternion_to_rotation(cal.quaternions)
    student = StudentLikelihood(StarFrames.from_observations(obs), "brown", cal.theta, rotations)
    values = student.many(
        np.stack([cal.theta] * 3), np.array([0.05, 1e200, np.inf]), np.full(3, 4.0)
    )
    assert np.isfinite(values[0])
    assert values[1] < values[0] - 1e4
    assert values[2] == -np.inf


def test_prior_of_the_tails_is_a_gamma_density():
    from scipy.stats import gamma

    log_excess = np.linspace(-3.0, 6.0, 20)
    # The density of a logarithm has the number itself as a factor.
    expected = gamma.logpdf(np.exp(log_excess), 2.0, scale=10.0) + log_excess
    assert np.ptp(log_excess_prior(log_excess) - expected) < 1e-12


def _curvature(state: Any, frame_stars: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Curvatures (3, 3) of one frame: as observed, with what is negative counted as none, and
    reweighted.
    """
    curvatures = np.zeros((3, 3, 3))
    for i in range(*frame_stars.indices(state.e.shape[1])):
        e, a, w = state.e[:, i], state.attitude[:, :, i], state.weight[i]
        own = w * np.eye(2) - state.radial[i] * np.outer(e, e)
        values, vectors = np.linalg.eigh(own)
        mild = (vectors * np.maximum(values, 0.0)) @ vectors.T
        curvatures += [a @ own @ a.T, a @ mild @ a.T, w * a @ a.T]
    return tuple(curvatures)


def test_a_frame_of_doubtful_stars_is_curved_by_the_first_way_that_curves_it() -> None:
    obs = with_sigmas(observations(n_frames=60))
    heavy, theta = student(obs), camera().theta
    starts, sigma, ways = heavy.frames.starts, 1.2, []
    turn = np.radians(np.linspace(0.0, 90.0, len(starts) - 1) / 3600.0)
    at = (
        exp_rotation(turn[:, None] * np.random.default_rng(3).standard_normal((len(turn), 3)))
        @ heavy._rotations
    )
    _, state, step, gain = heavy._step(theta[None], np.array([sigma]), np.array([4.0]), at)
    volume = 0.0
    for k, (first, last) in enumerate(pairwise(starts)):
        curvatures = _curvature(state, slice(first, last))
        enough = 0.01 * np.linalg.det(curvatures[2])
        curved = [np.linalg.eigvalsh(c)[0] > 0.0 for c in curvatures]
        way = next(i for i, c in enumerate(curvatures) if curved[i] and np.linalg.det(c) > enough)
        ways.append((way, curved.index(True)))
        assert np.allclose(state.inverse[..., k] @ curvatures[way], np.eye(3), atol=1e-6)
        volume -= 0.5 * np.linalg.slogdet(curvatures[way])[1]
        # The step never overshoots: where it is long it is the reweighted one.
        slope = np.einsum(
            "iun,un,n->i", *(x[..., first:last] for x in (state.attitude, state.e, state.weight))
        )
        assert gain[k] == pytest.approx(
            0.5 * slope @ np.linalg.solve(curvatures[way], slope) / sigma**2, rel=1e-5
        )
        chosen = curvatures[way] if gain[k] < 1.0 else curvatures[2]
        assert np.allclose(step[:, k], np.linalg.solve(chosen, slope), rtol=1e-5, atol=1e-15)
    assert state.log_volume == pytest.approx(volume, abs=1e-6)
    # All ways are gone, and one is left that curves, but by too little.
    assert {way for way, _ in ways} == {0, 1, 2}
    assert any(way > first for way, first in ways)
