"""The prior predictive check flags a prior that the data contradict."""

import numpy as np
import pytest
from scipy import stats

from starcal_uq.core.errors import PriorError
from starcal_uq.inference.prior_draws import prior_predictive
from starcal_uq.inference.priors import Priors
from starcal_uq.simulation.frames import simulate
from starcal_uq.sky.catalogue import load_catalogue
from tests.helpers import scenes

NOMINAL = scenes.nominal(scenes.camera())
DEFAULT = Priors.default(NOMINAL)


def test_default_priors_expect_the_paper_s_camera() -> None:
    found = prior_predictive(DEFAULT, NOMINAL, scenes.observations(), n_draws=100)
    assert found.ok, found.to_dataframe()
    assert "lie within" in found.text
    table = found.to_dataframe().set_index("quantity")
    assert table.loc["fov_h_deg", "q50"] == pytest.approx(NOMINAL.fov_deg[0], rel=0.05)
    # The nominal focal length is 2.5 % too long.
    assert table.loc["scale_percent", "observed"] == pytest.approx(-100 * 0.025 / 1.025, abs=0.1)
    assert found.shift_px.shape == (100, 25)
    assert found.folded < 0.1


@pytest.mark.parametrize(
    ("change", "quantity"),
    [
        ({"focal_fraction": 1e-3, "distortion_corner_px": 0.5}, "scale_percent"),
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
def test_priors_that_the_data_contradict_are_flagged(change, quantity):
    found = prior_predictive(
        DEFAULT.replace(**change), NOMINAL, scenes.observations(n_frames=20), n_draws=100
    )
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
    """Tail probabilities of data from the prior itself are uniform."""
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
    found = prior_predictive(DEFAULT.replace(principal_point_px=400.0), NOMINAL, n_draws=100)
    assert np.all(np.isnan(found.tail))
    assert "No observations" in found.text
    assert found.off_detector > 0.05
    # 20 times the default displacement folds most of these cameras.
    folding = DEFAULT.replace(distortion_corner_px=700.0)
    assert prior_predictive(folding, NOMINAL, n_draws=100).folded > 0.3


def test_predictive_check_repeats_and_refuses() -> None:
    obs = scenes.observations(n_frames=20)
    a, b = (prior_predictive(DEFAULT, NOMINAL, n_draws=100, seed=4) for _ in range(2))
    assert np.array_equal(a.draws, b.draws, equal_nan=True)
    for given, options, words in (
        ((NOMINAL,), {"n_draws": 10}, "at least 100"),
        ((scenes.camera("k1"),), {}, "use one model"),
        ((NOMINAL, scenes.with_sigmas(obs)), {}, "per_star_sigma"),
    ):
        with pytest.raises(PriorError, match=words):
            prior_predictive(DEFAULT, *given, **options)
    assert prior_predictive(
        Priors.default(NOMINAL, True), NOMINAL, scenes.with_sigmas(obs), n_draws=100
    ).ok
