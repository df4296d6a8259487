"""Effects planted by a sensor of a second make: chosen, estimated, and covered."""

import numpy as np
import pytest

import starcal_uq as sc
from tests.helpers.effects import breathing, bump, nearest_camera, sheet, table, together
from tests.helpers.full_model import drawn
from tests.helpers.outside import campaign


def test_field_and_frame_effects_are_found_and_their_scales_are_right() -> None:
    rng = np.random.default_rng(11)
    shifts = together(bump(0.5), breathing(rng, 40, 0.2))
    c = campaign(rng, n_frames=40, displaced=shifts)
    obs = table(c)
    plain = sc.calibrate(obs, sheet(c))
    cal = sc.calibrate(obs, sheet(c), effects="auto")
    assert plain.sigma > 2.0 * cal.sigma
    assert cal.sigma == pytest.approx(0.05, rel=0.08)
    assert set(cal.effects.names) == {"field", "frame"}
    frame = next(e for e in cal.effects.fitted if e.name == "frame")
    assert frame.low_px < 0.2 < frame.high_px
    truth = nearest_camera(c.theta, bump(0.5))
    assert np.abs((cal.theta - truth) / cal.sigmas).max() < 4.0
    # Control: intervals this narrow refuse the camera that the field's own part is still on.
    assert np.abs((cal.theta - c.theta) / cal.sigmas).max() > 6.0


def test_clean_data_take_up_nothing_and_change_nothing() -> None:
    c = campaign(np.random.default_rng(12), n_frames=30)
    obs = table(c)
    plain, cal = sc.calibrate(obs, sheet(c)), sc.calibrate(obs, sheet(c), effects="auto")
    assert not cal.effects.fitted
    assert cal.effects.refused
    assert all(gain < cal.effects.penalty_nat for _, gain in cal.effects.refused)
    np.testing.assert_array_equal(cal.theta, plain.theta)
    np.testing.assert_array_equal(cal.covariance, plain.covariance)


def test_effects_beside_a_noise_model_are_those_of_the_table_as_it_is() -> None:
    rng = np.random.default_rng(15)
    c = campaign(
        rng,
        n_frames=12,
        stars_per_frame=25,
        sigma_px=lambda radius, mag, frame: 0.03 + 0.09 * radius**2,
        displaced=breathing(rng, 12, 0.3),
    )
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects="frame,noise")
    assert cal.provenance.data_sha256 == sc.calibrate(obs, sheet(c)).provenance.data_sha256


@pytest.mark.slow
def test_intervals_cover_with_the_effects_selected() -> None:
    z, chosen = [], []
    for seed in range(30):
        rng = np.random.default_rng(1000 + seed)
        shifts = together(bump(0.2), breathing(rng, 30, 0.2))
        c = campaign(rng, n_frames=30, displaced=shifts)
        cal = sc.calibrate(table(c), sheet(c), effects="auto")
        chosen.append(set(cal.effects.names) == {"field", "frame"})
        z.append((cal.theta - nearest_camera(c.theta, bump(0.2))) / cal.sigmas)
    covered = np.mean(np.abs(z) < 1.96, axis=0)
    print("covered", covered, "rms", np.sqrt(np.mean(np.square(z), axis=0)))
    assert np.mean(chosen) > 0.92
    # 150 intervals, few of them independent: a share of 30 has a standard error of 4 %.
    assert np.all(covered > 0.82)
    assert 0.89 < covered.mean() < 0.99


@pytest.mark.slow
def test_selection_takes_up_nothing_on_clean_data() -> None:
    taken = 0
    for seed in range(40):
        c = campaign(np.random.default_rng(seed), n_frames=12)
        taken += bool(sc.calibrate(table(c), sheet(c), effects="auto").effects.names)
    print("taken up", taken, "of 40")
    # 1 % on average: more than 3 of 40 has a probability of 1e-3.
    assert taken <= 3


@pytest.mark.slow
@pytest.mark.parametrize("weighing", ["tails", "noise"])
def test_weights_follow_what_effects_leave(weighing: str) -> None:
    """Tails and a noise model of the camera alone would hold the field's displacement as well."""
    c = campaign(np.random.default_rng(21), n_frames=40, displaced=bump(0.4))
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects=["auto", weighing])
    assert cal.effects.names == (weighing, "field")
    truth = nearest_camera(c.theta, bump(0.4))
    assert np.abs((cal.theta - truth) / cal.sigmas).max() < 3.5
    if weighing == "noise":
        assert not cal.noise_model.varies
        assert cal.sigma == pytest.approx(0.05, rel=0.06)
    else:
        # The noise is Gaussian: nearly every star keeps its weight, and the scale is that of a t.
        assert cal.star_weights.shape == (len(obs),)
        assert np.mean(cal.star_weights > 0.5) > 0.9
    # Control: without effects either of them answers to the displacement.
    plain = sc.calibrate(obs, sheet(c), effects=weighing)
    if weighing == "noise":
        assert plain.noise_model.varies
    else:
        assert plain.sigma > 1.2 * cal.tail_scale


@pytest.mark.slow
def test_draws_are_those_of_a_long_chain_on_the_full_model_with_its_scale() -> None:
    """Four frames tell the scale to 20 %, which widens what it moves: f."""
    rng = np.random.default_rng(5)
    c = campaign(rng, n_frames=4, stars_per_frame=30, displaced=breathing(rng, 4, 0.3))
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects="frame")
    draws = sc.sample(obs, cal, seed=1).theta_draws.reshape(-1, 5)
    at = cal.sigma, cal.effects.fitted[0].scale_px
    full, held = drawn(c, *at, sampled=True, seed=1), drawn(c, *at, sampled=False, seed=2)

    def width(values: np.ndarray) -> np.ndarray:
        return np.diff(np.quantile(values, [0.025, 0.975], axis=0), axis=0)[0]

    print("widths", width(draws) / width(full), "held", width(held) / width(full))
    assert np.max(np.abs(draws.mean(axis=0) - full.mean(axis=0)) / full.std(axis=0)) < 0.08
    np.testing.assert_allclose(width(draws), width(full), rtol=0.05)
    # Control: with the scale held the interval of f is too narrow.
    assert width(held)[2] < 0.92 * width(full)[2]
