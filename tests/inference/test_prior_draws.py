"""The prior predictive check flags a prior that the data contradict; power scaling finds what the
prior decides.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy import stats

from starcal_uq.core.errors import PriorError
from starcal_uq.inference.arviz import is_legacy
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.power_scaling import CONFLICT, FINE, WEAK, cjs_distance, prior_sensitivity
from starcal_uq.inference.prior_draws import prior_predictive
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.sample import sample
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers import scenes
from tests.helpers.gaussian_camera import gaussian_calibration

NOMINAL = scenes.nominal(scenes.camera())
DEFAULT = Priors.default(NOMINAL)


# --- prior predictive
# ------------------------------------------------------------------------------------------------


def test_default_priors_expect_the_paper_s_camera() -> None:
    found = prior_predictive(DEFAULT, NOMINAL, scenes.observations())
    assert found.ok, found.to_dataframe()
    assert "lie within" in found.text
    table = found.to_dataframe().set_index("quantity")
    assert table.loc["fov_h_deg", "q50"] == pytest.approx(NOMINAL.fov_deg[0], rel=0.05)
    # The nominal focal length is 2.5 % too long.
    assert table.loc["scale_percent", "observed"] == pytest.approx(-100 * 0.025 / 1.025, abs=0.1)
    assert found.shift_px.shape == (200, 25)
    assert found.folded < 0.1


@pytest.mark.parametrize(
    ("change", "quantity"),
    [
        ({"focal_fraction": 1e-3, "distortion_corner_px": 0.5}, "scale_percent"),
        ({"focal_px": 7000.0, "focal_fraction": 0.01}, "scale_percent"),
        (
            {
                "sigma_median": 1e-4,
                "sigma_log_sd": 0.1,
                "distortion_corner_px": 1e-3,
                "principal_point_px": 1e-2,
            },
            "residual",
        ),
    ],
)
def test_priors_that_the_data_contradict_are_flagged(
    change: dict[str, float], quantity: str
) -> None:
    found = prior_predictive(DEFAULT.replace(**change), NOMINAL, scenes.observations())
    assert not found.ok
    assert any(name.startswith(quantity) for name in found.surprising)
    assert "check the nominal camera" in found._repr_html_()


def test_focal_prior_is_the_scale_s_prior() -> None:
    """Without distortion, the predicted scale is the relative focal length, as drawn."""
    camera = scenes.nominal(scenes.camera("none"))
    priors = Priors.default(camera).replace(
        focal_fraction=0.01, principal_point_px=1e-3, sigma_median=0.01
    )
    found = prior_predictive(priors, camera, scenes.observations("none"), n_draws=400)
    scale = found.draws[:, found.names.index("scale_percent")]
    assert np.mean(scale) == pytest.approx(0.0, abs=0.2)
    assert np.std(scale) == pytest.approx(1.0, rel=0.15)


@pytest.mark.slow
def test_a_prior_is_calibrated_when_cameras_are_drawn_from_it() -> None:
    """Tail probabilities of data from the prior itself are uniform; of data from a wider one they
    are not.
    """
    priors = DEFAULT.replace(
        focal_fraction=0.005, distortion_corner_px=1.0, sigma_log_sd=0.2, principal_point_px=5.0
    )
    sky = load_catalogue(max_mag=6.0, epoch=2026.9)
    rng = np.random.default_rng(7)

    def tails(factor: float, n: int) -> np.ndarray:
        wide = priors.replace(focal_fraction=0.005 * factor, distortion_corner_px=factor)
        found = []
        for i, draw in enumerate(wide.draw(n, rng)):
            truth = NOMINAL.with_theta(draw[:-1])
            obs = simulate(sky, truth, n_frames=5, min_stars=6, sigma_px=float(draw[-1]), seed=i)
            found.append(prior_predictive(priors, NOMINAL, obs, n_draws=100, seed=i).tail[-3])
        return np.array(found)

    assert stats.kstest(tails(1.0, 25), "uniform").pvalue > 1e-3
    assert stats.kstest(tails(8.0, 15), "uniform").pvalue < 1e-3


def test_without_observations_only_the_prior_is_shown() -> None:
    found = prior_predictive(DEFAULT.replace(principal_point_px=400.0), NOMINAL)
    assert np.all(np.isnan(found.tail))
    assert "No observations" in found.text
    assert found.off_detector > 0.05
    # 20 times the default displacement folds most of these cameras.
    assert prior_predictive(DEFAULT.replace(distortion_corner_px=700.0), NOMINAL).folded > 0.3


def test_predictive_check_repeats_and_refuses() -> None:
    obs = scenes.observations(n_frames=20)
    a, b = (prior_predictive(DEFAULT, NOMINAL, obs, n_draws=100, seed=4) for _ in range(2))
    assert np.array_equal(a.draws, b.draws, equal_nan=True)
    with pytest.raises(PriorError, match="at least 100"):
        prior_predictive(DEFAULT, NOMINAL, n_draws=10)
    with pytest.raises(PriorError, match="use one model"):
        prior_predictive(DEFAULT, scenes.camera("k1"))
    with pytest.raises(PriorError, match="per_star_sigma"):
        prior_predictive(DEFAULT, NOMINAL, scenes.with_sigmas(obs))
    assert prior_predictive(
        Priors.default(NOMINAL, True), NOMINAL, scenes.with_sigmas(obs), n_draws=100
    ).ok


# --- power scaling
# --------------------------------------------------------------------------------------------------


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
    """Normal prior and normal likelihood: the mean's derivative with respect to the power is
    known.
    """
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
