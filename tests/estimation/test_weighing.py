"""Effects that weigh stars, and others."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.estimation.weights import weighed
from tests.estimation.test_noise_model import worse_outside
from tests.helpers.outside import campaign

DRAWS = {"n_ensembles": 2, "n_walkers": 32, "n_steps": 100, "n_burn": 30, "seed": 3}


def spoilt(seed, share=0.05, **options):
    """A campaign with wrong identifications: a third anywhere, the others within 60 px."""
    rng = np.random.default_rng([77, seed])
    c = campaign(rng, **options)
    columns = {name: np.array(values) for name, values in c.columns.items()}
    n = len(columns["x_px"])
    wrong = rng.choice(n, round(share * n), replace=False)
    radius = 60.0 * np.sqrt(rng.uniform(0.01, 1.0, len(wrong)))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
    columns["x_px"][wrong] += radius * np.cos(angle)
    columns["y_px"][wrong] += radius * np.sin(angle)
    far = wrong[: len(wrong) // 3]
    for name in ("ra_deg", "dec_deg"):
        columns[name][far] = rng.permutation(columns[name][far])
    obs = sc.Observations(**columns, meta={"directions": "apparent"})
    return c, obs, sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))


def uneven(seed, **options):
    return spoilt(seed, **({"n_frames": 40, "sigma_px": worse_outside} | options))


def starred(seed):
    return spoilt(seed, n_frames=60, patch_stars=40, star_sigma_px=0.1)


@pytest.mark.slow
def test_tails_and_noise_that_varies_go_together():
    _, obs, camera = uneven(1)
    cal = sc.calibrate(obs, camera, effects="tails,noise")
    alone = sc.calibrate(obs, camera, effects="tails")
    assert "radius" in cal.noise_model.terms and cal.noise_model.frame_dof is None
    assert np.all(cal.sigmas[2:] < 0.93 * alone.sigmas[2:]) and cal.sigma_name == "sigma_scale"
    assert cal.effects.names == ("noise", "tails")
    assert all(effect.gain_nat > 20.0 for effect in cal.effects.weighing)
    assert cal.sampled_likelihood == "student_t"
    # The control: without tails the wrong stars spoil the fit.
    with pytest.raises(sc.errors.CalibrationError, match="do not fit the others"):
        sc.calibrate(obs, camera, effects="noise")


def test_even_noise_with_tails_stays_even():
    _, obs, camera = uneven(2, sigma_px=0.05)
    cal = sc.calibrate(obs, camera, effects="tails,noise")
    alone = sc.calibrate(obs, camera, effects="tails")
    assert not cal.noise_model.varies and np.array_equal(cal.theta, alone.theta)


@pytest.mark.slow
def test_tails_and_errors_of_the_stars_go_together():
    c, obs, camera = starred(1)
    cal = sc.calibrate(obs, camera, effects="tails,star")
    assert cal.effects.names == ("tails", "star")
    (star,) = cal.effects.fitted
    assert star.low_px < 0.1 < star.high_px < 0.15
    assert np.all(np.abs(cal.theta - c.theta) < 3.0 * cal.sigmas)
    assert np.all(cal.tail_factors >= 1.0) and cal.residuals_px.shape == (obs.n_stars, 2)
    # Weights are the same whenever they are taken, and wrong stars have hardly any.
    seen = weighed(obs, cal)
    assert np.array_equal(weighed(seen, cal).sigma_px, seen.sigma_px)
    right = np.hypot(*cal.residuals_px.T) < 5.0
    assert np.min(seen.sigma_px[~right]) > 5.0 * np.median(seen.sigma_px[right])
    post = sc.sample(obs, cal, **DRAWS)
    assert np.allclose(np.std(post.draws[:, :5], axis=0), cal.sigmas, rtol=0.3)
    # The control: without tails the wrong stars are errors of the stars or noise.
    gaussian = sc.calibrate(obs, camera, effects="star", throw=False)
    assert gaussian.sigmas[2] > 5.0 * cal.sigmas[2]


@pytest.mark.slow
def test_intervals_of_parts_together_hold():
    """Of 16 campaigns; the control, of 8 of them, has the tails alone."""
    z, plain = [], []
    for seed in range(16):
        c, obs, camera = starred(100 + seed)
        for kept, parts in ((z, ["star"]), (plain, []))[: 1 + (seed < 8)]:
            cal = sc.calibrate(obs, camera, effects=["tails", *parts])
            kept.append((cal.theta - c.theta) / cal.sigmas)
    coverage, control = (np.mean(np.abs(np.array(kept)) < 1.96) for kept in (z, plain))
    assert coverage > 0.88, coverage
    assert control < 0.87, control


def uneven_gaussian(rng):
    return campaign(rng, n_frames=30, sigma_px=worse_outside), None


def heavy(rng):
    """One star in twenty is off by several times the noise."""
    c = campaign(rng, n_frames=30)
    wrong = rng.random(len(c.columns["x_px"])) < 0.05
    return c, 0.3 * rng.standard_normal((2, len(wrong))) * wrong


def uneven_and_wrong(rng):
    """Noise that is worse outside, and one star in twenty that is off by more than that."""
    c = campaign(rng, n_frames=30, sigma_px=worse_outside)
    wrong = rng.random(len(c.columns["x_px"])) < 0.05
    return c, 0.6 * rng.standard_normal((2, len(wrong))) * wrong


def clean(rng):
    return campaign(rng, n_frames=30), None


def selected(made, seed, effects="auto"):
    c, off = made(np.random.default_rng([seed, 92]))
    columns = {name: np.array(values) for name, values in c.columns.items()}
    if off is not None:
        columns["x_px"], columns["y_px"] = np.array([columns["x_px"], columns["y_px"]]) + off
    obs = sc.Observations(**columns, meta={"directions": "apparent"})
    camera = sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0))
    return c, sc.calibrate(obs, camera, effects=effects)


@pytest.mark.parametrize(
    ("made", "chosen"),
    [
        (clean, ()),
        (uneven_gaussian, ("noise",)),
        (heavy, ("tails",)),
    ],
)
def test_auto_takes_up_noise_and_tails_where_the_data_ask_for_them(made, chosen):
    c, cal = selected(made, 1)
    assert cal.effects.names == chosen and cal.effects.asked == ()
    assert np.all(np.abs(cal.theta - c.theta) < 4.0 * cal.sigmas)
    refused = dict(cal.effects.refused)
    assert {"noise", "tails"} - set(chosen) == {"noise", "tails"} & refused.keys()
    for effect in cal.effects.weighing:
        assert effect.gain_nat > 30.0 and effect.moved_name in cal.parameter_names


@pytest.mark.slow
def test_auto_adds_tails_to_noise_that_was_asked_for():
    _, cal = selected(uneven_and_wrong, 2, "auto,noise")
    assert cal.effects.names == ("noise", "tails") and cal.effects.asked == ("noise",)
    noise, tails = cal.effects.weighing
    assert not noise.moved_name and tails.moved_name and tails.gain_nat > 30.0
    # The control: noise alone is enough where no star is wrong.
    assert selected(uneven_gaussian, 2, "auto,noise")[1].effects.names == ("noise",)


@pytest.mark.slow
def test_auto_takes_up_noise_and_tails_in_every_campaign_that_has_them():
    for seed in range(100, 103):
        assert selected(uneven_gaussian, seed)[1].effects.names == ("noise",)
        assert selected(heavy, seed)[1].effects.names == ("tails",)
        assert selected(uneven_and_wrong, seed)[1].effects.names == ("noise", "tails")
