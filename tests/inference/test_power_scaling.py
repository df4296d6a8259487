"""Sensitivity of the posterior to the priors, by power scaling."""

from functools import lru_cache

import numpy as np
import pytest

from starcal_uq.core.errors import PriorError
from starcal_uq.inference.arviz import power_sensitivity
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.power_scaling import CONFLICT, FINE, WEAK, prior_sensitivity
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.sample import sample
from tests.helpers.gaussian_camera import gaussian_calibration


@lru_cache(maxsize=8)
def posterior(
    principal_point_px: float = 100.0, centre: tuple[float, float] = (500.0, 530.0)
) -> Posterior:
    """Known sigmas: 0.15 px of x0 and y0 from the data."""
    cal = gaussian_calibration()
    priors = Priors.default(cal.nominal).replace(
        principal_point_px=principal_point_px, principal_point_centre_px=centre
    )
    return sample(None, cal, priors, seed=1)


def test_wide_priors_do_not_matter() -> None:
    found = prior_sensitivity(posterior())
    assert found.ok
    assert set(found.diagnosis) == {FINE}
    assert np.all(found.prior < 0.01)
    assert np.all(found.likelihood > 0.05)
    # A Gaussian posterior's sigma goes with the inverse root of the likelihood's power.
    assert np.allclose(found.likelihood_sd_change[:5], -0.5 * np.log(2.0), atol=0.03)
    assert max(found.prior_khat, found.likelihood_khat) < 0.7
    assert "do not matter" in found._repr_html_()


def test_a_tight_prior_is_found() -> None:
    found = prior_sensitivity(posterior(0.03))
    assert found.diagnosis[:2] == (WEAK, WEAK)
    assert set(found.diagnosis[2:]) == {FINE}
    assert "weak likelihood for x0, y0" in found.text


def test_a_conflict_is_found_and_its_direction() -> None:
    found = prior_sensitivity(posterior(0.15, (500.0, 530.9)))
    assert found.diagnosis[1] == CONFLICT
    assert set(found.diagnosis[2:]) == {FINE}
    # The prior pulls y0 up and the data pull it down.
    assert found.prior_mean_shift[1] > 0.3
    assert found.likelihood_mean_shift[1] < -0.3


def test_mean_shift_is_the_derivative_in_closed_form() -> None:
    """Normal prior and normal likelihood."""
    tau, s, distance = 0.15, 0.15, 0.9
    found = prior_sensitivity(posterior(tau, (500.0, 530.0 + distance)))
    a, b = tau**-2, s**-2
    derivative = distance * a * b / (a + b) ** 2 * np.sqrt(a + b) * np.log(2.0)
    assert found.prior_mean_shift[1] == pytest.approx(derivative, rel=0.05)
    assert found.likelihood_mean_shift[1] == pytest.approx(-derivative, rel=0.05)
    assert found.prior_sd_change[1] == pytest.approx(-0.5 * a / (a + b) * np.log(2.0), rel=0.1)


def test_further_quantities_are_scaled_too() -> None:
    post = posterior(0.15, (500.0, 530.9))
    found = prior_sensitivity(
        post, {"radius": np.hypot(*post.draws[:, :2].T), "f_mm": post.draws[:, 2] * 0.012}
    )
    assert found.names[-2:] == ("radius", "f_mm")
    assert found.diagnosis[-2:] == (CONFLICT, FINE)
    # Units do not matter.
    assert found.prior[-1] == pytest.approx(found.prior[2], rel=1e-6)
    with pytest.raises(PriorError):
        prior_sensitivity(post, {"x": np.zeros(3)})


def distance(values: np.ndarray, weights: np.ndarray) -> float:
    """Cumulative Jensen-Shannon distance (Nguyen & Vreeken 2015) of two distribution functions."""
    order = np.argsort(values)
    width = np.diff(values[order])
    p = np.arange(1, len(values)) / len(values)
    q = np.cumsum(weights[order])[:-1]

    def of(p: np.ndarray, q: np.ndarray) -> float:
        middle = 0.5 * (p + q)
        terms = p * np.log2(p / middle) + q * np.log2(np.maximum(q, 1e-300) / middle)
        return float(np.sqrt(width @ terms / (width @ (p + q))))

    return max(of(p, q), of(1.0 - p, 1.0 - q))


def test_sensitivity_is_the_distance_per_doubling() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal(4000)
    powers = (1.0 / 1.5, 1.5)
    weights = [np.exp((power - 1.0) * x) for power in powers]
    weights = [w / w.sum() for w in weights]
    expected = np.mean([distance(x, w) for w in weights]) / np.log2(1.5)
    found = power_sensitivity(x, weights, powers)
    assert found == pytest.approx(expected, rel=1e-6) and found > 0.1
    # The same for draws turned around, with weights that follow; nothing for equal weights.
    assert power_sensitivity(-x, weights, powers) == pytest.approx(found, rel=1e-6)
    assert power_sensitivity(x, 2 * [np.full(4000, 1 / 4000)], powers) < 1e-6


def test_sensitivity_of_a_posterior_is_that_of_plain_importance_weights() -> None:
    post = posterior(0.15, (500.0, 530.9))
    found = prior_sensitivity(post)
    log_prior = post.priors.log_density_theta(post.theta_draws)
    log_prior = log_prior + post.priors.log_density_log_sigma(np.log(post.sigma_draws))
    weights = [np.exp((alpha - 1.0) * (log_prior - log_prior.mean())) for alpha in (0.99, 1.01)]
    for i in range(3):
        both = [distance(post.draws[:, i], w / w.sum()) for w in weights]
        expected = np.mean(both / np.abs(np.log2([0.99, 1.01])))
        assert found.prior[i] == pytest.approx(expected, rel=0.03)
