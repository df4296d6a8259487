"""Replicated data against the data."""

import dataclasses

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.diagnostics.predictive import predictive_check
from tests.helpers.scenes import camera


def test_replicates_look_like_data_of_the_model_and_unlike_others(obs, cal):
    good = predictive_check(obs, cal, n_draws=200)
    assert not any(s.extreme for s in good.statistics)
    residuals = np.random.default_rng(1).standard_t(3, (2, obs.n_stars)) * 0.05
    tails = dataclasses.replace(obs, x_px=obs.x_px + residuals[0], y_px=obs.y_px + residuals[1])
    bad = predictive_check(tails, sc.calibrate(tails, sc.paper.paper_start()), n_draws=300)
    assert {s.name for s in bad.statistics if s.extreme} >= {"excess kurtosis"}
    truth = camera("brown3").replace(
        coefficients=(2e-10, -3.5e-15, 8.0 / camera().corner_radius_px ** 7)
    )
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    bent = sc.simulate(stars, truth, n_frames=300, min_stars=10, sigma_px=0.05, seed=1)
    ring = predictive_check(bent, sc.calibrate(bent, sc.paper.paper_start()), n_draws=200)
    assert (
        ring.statistics[3].name.startswith("radial pattern") and ring.statistics[3].p_value < 0.05
    )


@pytest.mark.parametrize("effects", ["tails", "tails,time"])
def test_replicates_have_the_tails_of_the_model(obs, effects):
    """Noise with four degrees of freedom looks like itself, beside effects, which keep the weights
    of the stars, and without; wrong stars do not.
    """
    some = obs.select(obs.frame < 60)
    rng = np.random.default_rng(3)
    noise = 0.05 * rng.standard_normal((2, len(some))) / np.sqrt(rng.chisquare(4, len(some)) / 4)
    wrong = (rng.random((2, len(some))) < 0.05) * rng.uniform(3.0, 30.0, (2, len(some)))
    extreme = []
    for x, y in (noise, wrong):
        data = dataclasses.replace(some, x_px=some.x_px + x, y_px=some.y_px + y)
        cal = sc.calibrate(data, sc.paper.paper_start(), effects=effects)
        found = predictive_check(data, cal, n_draws=200)
        extreme.append([s.name for s in found.statistics if s.extreme])
    assert not extreme[0] and extreme[1]


def test_replicates_on_some_frames_say_so(obs, cal, monkeypatch):
    monkeypatch.setattr("starcal_uq.diagnostics.predictive._MAX_STARS", 500)
    some = predictive_check(obs, cal, n_draws=100)
    assert some.of_frames == obs.n_frames and some.n_frames == pytest.approx(
        500 * obs.n_frames / obs.n_stars, abs=1
    )
    assert f"on {some.n_frames} of {obs.n_frames} frames" in some.text
    assert not any(s.extreme for s in some.statistics)


def test_replicates_use_the_posterior(obs, cal):
    post = sc.sample(obs, cal, seed=1, n_steps=50)
    assert not any(s.extreme for s in predictive_check(obs, cal, post, n_draws=100).statistics)
    # The control: a posterior with noise that is too small cannot have made these data.
    draws = post.draws.copy()
    draws[:, -1] *= 0.8
    small = predictive_check(obs, cal, dataclasses.replace(post, draws=draws), n_draws=100)
    assert small.statistics[0].extreme
