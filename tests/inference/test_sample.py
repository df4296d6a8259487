"""The sampler draws from the posterior it was given, again and again the same."""

import dataclasses
import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from starcal_uq.calibration.calibrate import calibrate
from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import SamplingError, SettingError
from starcal_uq.core.status import Level, Status
from starcal_uq.inference.checks import _DEFAULTS, check_compression
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.sample import sample
from starcal_uq.inference.target import laplace_approximation, start_target
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import symmetric_inverse
from starcal_uq.observations.table import Observations
from tests.helpers.gaussian_camera import COVARIANCE, SD, GaussianLikelihood, gaussian_calibration
from tests.helpers.outside import campaign
from tests.helpers.scenes import camera, nominal, observations, with_sigmas

QUICK: dict[str, Any] = {"n_ensembles": 2, "n_walkers": 16, "n_steps": 60, "n_burn": 5, "seed": 3}
# 50 steps of both ensembles together.
QUICKER = {**QUICK, "n_steps": 20}


def test_a_remedy_knows_what_sample_does_by_itself() -> None:
    own = inspect.signature(sample).parameters
    known = {name: default for name, default in _DEFAULTS.items() if name != "dof"}
    assert {name: own[name].default for name in known} == known


def whitened(draws: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    sd = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(sd, sd))
    return np.linalg.solve(factor, ((draws - mean) / sd).T).T


def conjugate(priors: Priors, cal: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the posterior with the noise given."""
    names = priors.names[:-1]
    covariance = symmetric_inverse(cal.information + priors.precision(names))
    pull = cal.information @ cal.theta + priors.precision(names) @ priors.mean(names)
    return covariance @ pull, covariance


def sentence_of(post: Any, name: str, level: Level | None = None) -> str:
    """What one check of the draws says, at the level that is expected."""
    (check,) = (check for check in post.diagnostics.checks if check.name == name)
    assert level is None or check.level is level, check
    return str(check.sentence)


def test_known_posterior_is_recovered_at_extreme_scales() -> None:
    cal = gaussian_calibration()
    post = sample(None, cal, seed=1, evaluation="compressed")
    mean, covariance = conjugate(post.priors, cal)
    z = whitened(post.theta_draws, mean, covariance)
    assert np.max(np.abs(z.mean(axis=0))) < 0.04
    assert np.max(np.abs(np.cov(z.T) - np.eye(5))) < 0.05
    assert np.allclose(post.laplace.covariance[:5, :5], covariance, rtol=1e-3)
    # The default settings give ten thousand effective draws.
    d = post.diagnostics
    assert d.ok, d.checks
    assert min(np.min(d.ess_bulk), np.min(d.ess_tail)) > 10_000
    assert np.max(d.autocorrelation) < 4.0
    assert d.psis_khat < 0.5
    assert "gives the same" in sentence_of(post, "Independent posterior")


def test_informative_prior_shifts_the_posterior_as_it_must() -> None:
    cal = gaussian_calibration()
    # A focal length known to 0.02 px, 0.05 px away from the estimate, also moves k1 and k2 through
    # their couplings.
    priors = Priors.default(cal.nominal).replace(
        focal_px=cal.theta[2] + 0.05, focal_fraction=0.02 / cal.theta[2]
    )
    post = sample(None, cal, priors, sigma=0.05, seed=1, evaluation="compressed")
    mean, covariance = conjugate(priors, cal)
    assert abs(mean[3] - cal.theta[3]) > 0.5 * SD[3]
    assert np.max(np.abs(post.mean - mean) / np.sqrt(np.diag(covariance))) < 0.05
    assert np.allclose(np.sqrt(np.diag(post.covariance)), np.sqrt(np.diag(covariance)), rtol=0.03)
    assert sentence_of(post, "Influence of the priors") == "The prior, not the data, decides f."


def test_noise_has_the_posterior_found_by_quadrature() -> None:
    # So few degrees of freedom that a forgotten Jacobian (a factor sigma) would move the mean by
    # about 0.2 sd.
    cal = gaussian_calibration(dof=12)
    post = sample(None, cal, seed=1, evaluation="compressed")
    s = np.geomspace(0.005, 2.0, 20_001)
    # Theta integrated out over its flat likelihood gives sigma^5.
    log_density = -6.0 * (0.05 / s) ** 2 - (12 - 5) * np.log(s)
    log_density += stats.lognorm.logpdf(s, post.priors.sigma_log_sd, scale=post.priors.sigma_median)
    density = np.exp(log_density - log_density.max())
    density /= integrate.trapezoid(density, s)
    cumulative = integrate.cumulative_trapezoid(density, s, initial=0.0)
    u = np.interp(post.sigma_draws, s, cumulative)
    assert np.max(np.abs(np.histogram(u, np.linspace(0, 1, 11))[0] / len(u) - 0.1)) < 0.012


@pytest.mark.slow
def test_stretch_move_agrees() -> None:
    cal = gaussian_calibration()
    post = sample(
        None, cal, sigma=0.05, moves="stretch", n_steps=400, seed=1, evaluation="compressed"
    )
    mean, covariance = conjugate(post.priors, cal)
    z = whitened(post.theta_draws, mean, covariance)
    assert np.max(np.abs(np.cov(z.T) - np.eye(5))) < 0.2
    assert np.nanmax(post.diagnostics.autocorrelation) > 10.0


def test_same_seed_same_bits_and_ensembles_differ() -> None:
    cal = gaussian_calibration()
    first, second, other = (
        sample(None, cal, **{**QUICK, "seed": seed}, evaluation="compressed") for seed in (3, 3, 4)
    )
    assert np.array_equal(first.draws, second.draws)
    assert np.array_equal(first.log_posterior, second.log_posterior)
    assert first.diagnostics.psis_khat == second.diagnostics.psis_khat
    assert not np.any(first.draws[:, 0] == other.draws[:, 0])
    ensembles = first.draws[:, 0].reshape(2, -1)
    assert not np.array_equal(ensembles[0], ensembles[1])


@pytest.mark.parametrize("stop", [40, 90])
def test_resumed_run_is_the_uninterrupted_run(tmp_path: Path, stop: int) -> None:
    cal, checkpoint = gaussian_calibration(), tmp_path / "run.ckpt"
    whole = sample(None, cal, **QUICK, evaluation="compressed")

    def interrupt(done: int, total: int) -> None:
        assert total == 2 * 65
        if done == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(
            None, cal, **QUICK, evaluation="compressed", checkpoint=checkpoint, progress=interrupt
        )
    seen: list[int] = []
    resumed = sample(
        None,
        cal,
        **QUICK,
        evaluation="compressed",
        checkpoint=checkpoint,
        progress=lambda done, _: seen.append(done),
    )
    assert np.array_equal(resumed.draws, whole.draws)
    assert np.array_equal(resumed.log_posterior, whole.log_posterior)
    assert np.array_equal(resumed.diagnostics.acceptance, whole.diagnostics.acceptance)
    # Work before the last checkpoint is not repeated.
    assert len(seen) <= 130 - stop + 25
    assert seen[-1] == 130
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_that_is_stale_or_damaged_is_passed_over(tmp_path: Path) -> None:
    cal, checkpoint = gaussian_calibration(), tmp_path / "run.ckpt"

    def interrupt(done: int, total: int) -> None:
        if done == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(
            None, cal, **QUICK, evaluation="compressed", checkpoint=checkpoint, progress=interrupt
        )
    content = checkpoint.read_bytes()
    other = {**QUICK, "seed": 4}
    wider = SimpleNamespace(**{**vars(cal), "inflation": np.full(5, 1.7)})
    cases = (
        (content, cal, other),
        (content, wider, QUICK),
        (content[:-100], cal, QUICK),
        (b"nothing", cal, QUICK),
    )
    for stale, calibration, settings in cases:
        checkpoint.write_bytes(stale)
        found = sample(
            None, calibration, **settings, evaluation="compressed", checkpoint=checkpoint
        )
        assert np.array_equal(
            found.draws, sample(None, calibration, **settings, evaluation="compressed").draws
        )


def test_given_noise_fills_the_last_column() -> None:
    post = sample(None, gaussian_calibration(), sigma=0.07, **QUICK, evaluation="compressed")
    assert np.all(post.sigma_draws == 0.07)
    assert not post.sigma_sampled
    assert post.draws.shape[1] == 6
    assert np.isnan(post.diagnostics.rhat[-1])
    # Information is proportional to sigma^-2.
    assert np.allclose(post.sd[:5], SD * 1.4, rtol=0.15)


def test_any_likelihood_with_the_right_method() -> None:
    cal = gaussian_calibration(compressed=None)
    likelihood = GaussianLikelihood(cal.theta, cal.information, cal.sigma, cal.dof)
    post = sample(None, cal, **QUICK, likelihood=likelihood)
    assert post.diagnostics.likelihood_used == "gaussian"
    with pytest.raises(SamplingError, match="log_likelihood"):
        sample(None, cal, **QUICK, likelihood=3)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"n_ensembles": 1}, "at least 2"),
        ({"n_walkers": 11}, "at least 12"),
        ({"n_steps": 61}, "even"),
        ({"n_burn": -1}, "n_burn"),
        ({"moves": "snooker"}, "mixture, stretch"),
        ({"sigma": 0.0}, "above zero"),
        ({"sigma": "free"}, "'sampled'"),
        ({"evaluation": "naive"}, "auto, compressed, exact"),
        ({"evaluation": "exact"}, "needs the observations"),
        ({"likelihood": "naive"}, "marginal, pairs, pairs_naive, student_t"),
        ({"likelihood": "exact"}, "use evaluation='exact'"),
        ({"likelihood": "pairs"}, "needs the observations"),
        ({"dof": 4.0}, "belong to likelihood='student_t'"),
    ],
)
def test_settings_that_cannot_work_are_refused(options: dict[str, Any], match: str) -> None:
    with pytest.raises((SamplingError, SettingError), match=match):
        sample(None, gaussian_calibration(), **{**QUICK, **options})


def test_unsound_calibrations_are_refused() -> None:
    cal, negative = gaussian_calibration(), -symmetric_inverse(COVARIANCE)
    for given, words in (
        ((gaussian_calibration(status=Status.STALLED),), "did not converge"),
        ((gaussian_calibration(information=negative),), "not positive definite"),
        ((cal, {"f": (70.0, 0.1)}), r"priors are a dict: .* Priors\.default"),
        ((cal, Priors.default(cal.nominal.replace(distortion="k1"))), r"Priors\.default"),
    ):
        with pytest.raises(SamplingError, match=words):
            sample(None, *given, **QUICK)


def test_starts_without_density_are_refused() -> None:
    cal = gaussian_calibration()
    inner = cal.compressed

    class Cut:
        def log_likelihood(self, theta: np.ndarray, sigma: np.ndarray) -> np.ndarray:
            # A wall one standard deviation from the mode.
            return np.where(
                theta[:, 0] > cal.theta[0] + SD[0], -np.inf, inner.log_likelihood(theta, sigma)
            )

    class Nowhere:
        def log_likelihood(self, theta: np.ndarray, sigma: np.ndarray) -> np.ndarray:
            return np.full(len(theta), np.nan)

    with pytest.raises(SamplingError, match="start points"):
        sample(None, cal, **QUICK, likelihood=Cut())
    with pytest.raises(SamplingError, match="not finite"):
        sample(None, cal, **QUICK, likelihood=Nowhere())


def test_compression_check_measures_the_difference() -> None:
    cal = gaussian_calibration()
    exact = cal.compressed.log_likelihood
    start = start_target(
        exact, Priors.default(cal.nominal), cal.theta, cal.information, 0.05, cal.dof, False
    )
    target, laplace = laplace_approximation(start)
    draws = target.natural(np.random.default_rng(1).standard_normal((300, 6)))

    def off_by(nat: float) -> Any:
        # The difference is nat times the square of the first parameter's deviation, plus a constant
        # that cannot matter.
        return lambda t, s: exact(t, s) + nat * ((t[:, 0] - cal.theta[0]) / SD[0]) ** 2 + 7.0

    fine = check_compression(off_by(0.001), exact, target, draws, laplace)
    assert fine.good
    assert fine.khat == 0.0
    assert 0.002 < fine.max_difference < 0.009
    bad = check_compression(off_by(0.2), exact, target, draws, laplace)
    assert not bad.good
    assert 0.5 < bad.max_difference < 1.9
    # What an expansion leaves out grows with the third power, in a direction that nobody knows.
    whiten = np.linalg.inv(laplace.transform[:5, :5] / SD[:, None])
    for direction in np.linalg.qr(np.random.default_rng(2).standard_normal((5, 5)))[0]:

        def cubic(t: Any, s: Any, to: Any = direction @ whiten) -> Any:
            return exact(t, s) + 2.0 * ((t - cal.theta) / SD @ to / 3.0) ** 3

        assert not check_compression(cubic, exact, target, draws, laplace).good


@pytest.fixture(scope="module")
def many_frames() -> tuple[Any, Any]:
    obs = observations(n_frames=100, sigma_px=1.0)
    return obs, calibrate(obs, nominal(camera()))


def test_a_sample_of_frames_bounds_the_error_of_the_expansion(many_frames, monkeypatch):
    obs, cal = many_frames
    monkeypatch.setattr("starcal_uq.inference.sample._N_CHECKED", 40)
    every = sample(obs, cal, **QUICKER, evaluation="compressed").diagnostics
    assert every.compressed_frames == (0, 0)
    monkeypatch.setattr("starcal_uq.inference.exact.SAMPLED_FRAMES", 40)
    some = sample(obs, cal, **QUICKER, evaluation="compressed")
    assert some.diagnostics.compressed_frames == (40, 100)
    # One px of noise: more than 0.005 nat are left out, and the sample's own uncertainty counts.
    assert 0.01 < every.compressed_max_difference < some.diagnostics.compressed_max_difference < 2.0
    # Controls: half of the frames counted twice, which no sample sees by itself, and second
    # derivatives left out.
    twice = sample(obs, spoilt(cal), **QUICKER, evaluation="compressed").diagnostics
    assert twice.compressed_max_difference > 1.5
    gram = cal.compressed.gram.copy()
    gram[6:] = gram[:, 6:] = 0.0
    flat = dataclasses.replace(cal, compressed=dataclasses.replace(cal.compressed, gram=gram))
    linear = sample(obs, flat, **QUICKER, evaluation="compressed").diagnostics
    assert linear.compressed_max_difference > 2.0 * every.compressed_max_difference


def test_a_check_by_a_sample_costs_the_same_at_any_number_of_frames(monkeypatch):
    from starcal_uq.likelihood.marginal import MarginalLikelihood

    monkeypatch.setattr("starcal_uq.inference.exact.SAMPLED_FRAMES", 20)
    # One point at a time, so that visits are counted.
    monkeypatch.setattr("starcal_uq.likelihood.marginal.BLOCK_STARS", 1)
    visited: list[int] = []
    sums = MarginalLikelihood.sums

    def counted(self: Any, *args: Any, **options: Any) -> Any:
        visited.append(self.frames.n_frames)
        return sums(self, *args, **options)

    of_sample = []
    for n_frames in (40, 160):
        obs = observations(n_frames=n_frames)
        cal = calibrate(obs, nominal(camera()))
        _ = cal.attitude_noise, cal.compressed  # Made from all frames when they are first read.
        monkeypatch.setattr(MarginalLikelihood, "sums", counted)
        visited.clear()
        sample(obs, cal, **QUICKER, evaluation="compressed")
        # The sample is visited at 24 points and the mode, all frames only where they are others.
        assert n_frames not in visited
        of_sample.append(sum(visited))
        others = dataclasses.replace(obs, x_px=obs.x_px + 1e-6)
        sample(others, cal, **QUICKER, evaluation="compressed")
        assert visited.count(n_frames) == 4
        monkeypatch.setattr(MarginalLikelihood, "sums", sums)
    assert of_sample[0] == of_sample[1]


def test_too_short_a_run_fails_its_checks() -> None:
    post = sample(None, gaussian_calibration(), **{**QUICK, "n_steps": 8}, evaluation="compressed")
    assert not post.diagnostics.ok
    assert "Too few effective draws" in sentence_of(post, "Effective draws", Level.FAIL)


@pytest.fixture(scope="module")
def few_frames() -> tuple[Any, Any]:
    obs = observations(n_frames=8)
    return obs, calibrate(obs, nominal(camera()))


@pytest.mark.usefixtures("few_importance_draws")
def test_compressed_and_exact_posteriors_are_the_same(few_frames: tuple[Any, Any]) -> None:
    obs, cal = few_frames
    auto, exact = (sample(obs, cal, **QUICK, evaluation=name) for name in ("auto", "exact"))
    assert auto.diagnostics.likelihood_used == "compressed"
    assert auto.diagnostics.compressed_max_difference < 0.1
    assert "equals the exact one" in sentence_of(auto, "Likelihood", Level.PASS)
    assert np.isnan(exact.diagnostics.compressed_max_difference)
    assert exact.diagnostics.likelihood_used == "exact"
    # The same random numbers decide, so the draws themselves agree.
    assert np.max(np.abs(auto.mean - exact.mean) / exact.sd[:5]) < 0.02
    assert np.allclose(auto.sd, exact.sd, rtol=0.02)


def spoilt(cal: Any) -> Any:
    """A calibration whose compressed likelihood has half of the data counted twice."""
    return dataclasses.replace(
        cal, compressed=dataclasses.replace(cal.compressed, gram=1.5 * cal.compressed.gram)
    )


@pytest.fixture
def no_polynomial() -> Any:
    """Chains of the exact likelihood follow those of a compressed one that is not good."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("starcal_uq.inference.sample._degrees", lambda run, evaluation: (0,))
        yield


@pytest.fixture
def replaced(few_frames: tuple[Any, Any], no_polynomial: Any) -> Any:
    obs, cal = few_frames
    return sample(obs, spoilt(cal), **QUICKER)


def test_a_wrong_compressed_likelihood_is_replaced(few_frames, replaced):
    obs, cal = few_frames
    assert replaced.diagnostics.likelihood_used == "exact"
    assert replaced.diagnostics.compressed_max_difference > 0.5
    assert "exact likelihood was sampled" in sentence_of(replaced, "Likelihood", Level.PASS)
    kept = sample(obs, spoilt(cal), **QUICKER, evaluation="compressed")
    assert "departs from the exact one" in sentence_of(kept, "Likelihood", Level.FAIL)


@pytest.mark.usefixtures("few_importance_draws", "no_polynomial")
@pytest.mark.parametrize("stop", [pytest.param(20, marks=pytest.mark.slow), 70])
def test_a_replaced_likelihood_is_resumed(few_frames, replaced, tmp_path, stop):
    obs, cal = few_frames
    wrong = spoilt(cal)
    calls = 0

    def interrupt(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls == stop:
            raise KeyboardInterrupt

    checkpoint = tmp_path / "run.ckpt"
    # 20 is in the compressed run, 70 in the exact run that follows it.
    with pytest.raises(KeyboardInterrupt):
        sample(obs, wrong, **QUICKER, progress=interrupt, checkpoint=checkpoint)
    post = sample(obs, wrong, **QUICKER, checkpoint=checkpoint)
    assert np.array_equal(post.draws, replaced.draws)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("model", ["none", "brown_tangential", "inverse"])
def test_every_distortion_model_and_stated_noise(model: str) -> None:
    obs = with_sigmas(observations(model))
    cal = calibrate(obs, nominal(camera(model)))
    post = sample(obs, cal, **{**QUICK, "n_walkers": 32, "n_steps": 100})
    assert post.parameter_names == (*camera(model).parameter_names, "sigma_scale")
    assert post.diagnostics.likelihood_used == "compressed"
    assert np.max(np.abs(post.mean - cal.theta) / cal.sigmas) < 0.3
    assert np.allclose(post.sd[:-1], cal.sigmas, rtol=0.2)


def test_stars_of_another_table_are_no_check_that_passes(tmp_path: Path) -> None:
    """Where the exact likelihood is not even finite."""
    cal, others = (
        calibrate(observations(n_frames=20), nominal(camera())),
        observations(n_frames=20, seed=4),
    )
    with pytest.raises(SamplingError, match="that the observations are its own"):
        sample(others, cal, **QUICK)
    post = sample(others, cal, evaluation="compressed", **QUICK)
    assert "departs from the exact one" in sentence_of(post, "Likelihood", Level.FAIL)
    post.save(tmp_path / "posterior.nc")
    assert Posterior.load(tmp_path / "posterior.nc").diagnostics.compressed_max_difference == np.inf


@pytest.mark.slow
def test_noisy_stars_do_not_take_chains_of_the_exact_likelihood(monkeypatch) -> None:
    """Where the expansion misses a little, a polynomial holds it."""
    c = campaign(np.random.default_rng(1), n_frames=20, stars_per_frame=32, sigma_px=5.0)
    obs, sheet = Observations(**c.columns), Camera(**c.camera_toml())
    cal = calibrate(obs, sheet)
    points = []
    whole = MarginalLikelihood.log_likelihoods

    def counted(self, theta, sigma):
        points.append(len(theta))
        return whole(self, theta, sigma)

    monkeypatch.setattr(MarginalLikelihood, "log_likelihoods", counted)
    post = sample(obs, cal, seed=0)
    assert post.diagnostics.likelihood_used == "compressed" and sum(points) < 5000
    assert post.diagnostics.compressed_khat < 0.7
    level = [check.level for check in post.diagnostics.checks if check.name == "Likelihood"]
    assert level == [Level.PASS]


FACTORS = np.array([1.7, 1.0, 2.5, 1.7, 1.7])


@pytest.fixture(scope="module")
def accepted() -> Any:
    """A calibration that an earlier version widened by `FACTORS`, and the one before."""
    obs = observations(n_frames=20)
    cal = calibrate(obs, nominal(camera()))
    record = cal.provenance.with_settings(
        inflation=dict(zip(cal.parameter_names, FACTORS.tolist(), strict=True))
    )
    wide = cal.covariance * np.outer(FACTORS, FACTORS)
    return dataclasses.replace(cal, covariance=wide, provenance=record), cal


@pytest.mark.parametrize(
    ("likelihood", "evaluation"),
    [("marginal", "compressed"), ("student_t", "auto")],
)
def test_draws_are_as_wide_as_a_calibration_of_an_earlier_version(accepted, likelihood, evaluation):
    obs, (cal, before) = observations(n_frames=20), accepted
    how = {**QUICK, "likelihood": likelihood, "evaluation": evaluation}
    post, formal = sample(obs, cal, **how), sample(obs, before, **how)
    assert post.sd[:-1] / formal.sd[:-1] == pytest.approx(FACTORS, rel=0.05)
    assert post.sd[-1] == pytest.approx(formal.sd[-1], rel=0.05)
    assert np.max(np.abs(post.mean - formal.mean) / cal.sigmas) < 0.1
    assert post.provenance.inflation and formal.provenance.inflation is None
    assert post.diagnostics.likelihood_used == formal.diagnostics.likelihood_used
    assert post.diagnostics.psis_khat < 0.7
    if likelihood == "marginal":
        assert post.sd[:-1] / cal.sigmas == pytest.approx(1.0, rel=0.1)
        # The control: draws of the formal errors are as much narrower than the calibration as was
        # accepted.
        assert cal.sigmas / formal.sd[:-1] == pytest.approx(FACTORS, rel=0.1)


def test_a_wider_calibration_widens_no_prior(accepted: Any) -> None:
    obs, (cal, before) = observations(n_frames=20), accepted
    # A prior that knows f as well as the formal errors do is as narrow beside the wider ones.
    tight = dataclasses.replace(
        Priors.default(cal.nominal),
        focal_px=cal.theta[2],
        focal_fraction=before.sigmas[2] / cal.theta[2],
    )
    post = sample(obs, cal, tight, **QUICK)
    information = before.information / np.outer(FACTORS, FACTORS)
    both = symmetric_inverse(information + tight.precision(cal.parameter_names))
    assert post.sd[:-1] == pytest.approx(np.sqrt(np.diag(both)), rel=0.1)
    assert both[2, 2] < 0.2 * cal.covariance[2, 2]
