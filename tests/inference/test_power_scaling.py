"""Sensitivity of the posterior to the priors, by power scaling."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from starcal_uq.core.errors import PriorError
from starcal_uq.inference.arviz import is_legacy
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.power_scaling import CONFLICT, FINE, WEAK, cjs_distance, prior_sensitivity
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
    with pytest.raises(PriorError, match="one value for each"):
        prior_sensitivity(post, {"x": np.zeros(3)})


def test_distance_is_zero_for_equal_weights_and_large_for_other_draws() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal(4000)
    assert cjs_distance(x, np.full(4000, 1 / 4000)) < 1e-6
    w = np.exp(3.0 * x)
    assert cjs_distance(x, w / w.sum()) > 0.3
    # The same for draws turned around, with weights that follow.
    assert cjs_distance(-x, w / w.sum()) == pytest.approx(cjs_distance(x, w / w.sum()), rel=1e-9)


@pytest.mark.skipif(is_legacy(), reason="ArviZ 0.23 has no power scaling to compare with")
def test_sensitivity_is_arvizs() -> None:
    from arviz_stats.base import array_stats

    post = posterior(0.15, (500.0, 530.9))
    found = prior_sensitivity(post)
    log_prior = post.priors.log_density_theta(post.theta_draws)
    log_prior = log_prior + post.priors.log_density_log_sigma(np.log(post.sigma_draws))
    for i in range(3):
        values = post.draws[:, i][None]
        weights = [np.exp((alpha - 1.0) * (log_prior - log_prior.mean())) for alpha in (0.99, 1.01)]
        lower, upper = ((w / w.sum())[None] for w in weights)
        theirs = array_stats.power_scale_sense(
            values, lower, upper, lower_alpha=0.99, upper_alpha=1.01
        )
        assert found.prior[i] == pytest.approx(float(theirs), rel=0.03)
