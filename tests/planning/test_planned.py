"""Plans with effects: forecasts against calibrations that hold the same effects, and their costs."""

from dataclasses import replace

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import PlanningError
from starcal_uq.planning.costs import EffectCosts
from starcal_uq.planning.effects import PlannedEffects
from starcal_uq.planning.information import random_frames
from starcal_uq.planning.plan import plan
from starcal_uq.simulation.frames import Tracker
from tests.helpers.effects import breathing, moving, smooth, together
from tests.helpers.scenes import camera, nominal

SCALES = {"field": 0.3, "frame": 0.1, "temperature": 0.2}
FRAMES = 120
CORNER = ("x0_px", "y0_px", "f_px", "k1_per_px2", "k2_per_px4")


@pytest.fixture(scope="module")
def sky() -> sc.StarCatalogue:
    return sc.load_catalogue(max_mag=6.0)


def forecast(sky: sc.StarCatalogue, effects: PlannedEffects | None) -> EffectCosts | dict:
    """Standard deviations after as many frames as are simulated."""
    found = plan(
        camera(), sky, effects=effects, n_frames=(FRAMES,), sweeps=False, n_geometries=300, seed=7
    )
    return found.forecast.to_dataframe().iloc[0].to_dict()


@pytest.fixture(scope="module")
def calibrated(sky):
    """Calibrations of simulated frames whose pixels NumPy has moved, their tables, and slopes of f
    with the temperature, px/K, by the standard deviations that they state.
    """
    rows = []
    for seed in range(2):
        rng = np.random.default_rng([seed, 5])
        obs = sc.simulate(
            sky, camera(), n_frames=FRAMES, min_stars=10, sigma_px=0.05, seed=50 + seed
        )
        warmth = rng.uniform(-1.0, 1.0, FRAMES)
        shifts = together(
            smooth(rng, SCALES["field"]),
            breathing(rng, FRAMES, SCALES["frame"]),
            moving(SCALES["temperature"], np.sqrt(3.0) * warmth),
        )
        truth, xy = camera(), np.stack([obs.x_px, obs.y_px])
        moved = xy.copy()
        for k, (first, last) in enumerate(
            zip(obs.frame_starts[:-1], obs.frame_starts[1:], strict=True)
        ):
            own = xy[:, first:last]
            uv = own - np.array([[truth.x0_px], [truth.y0_px]])
            moved[:, first:last] += shifts(uv, own, obs.mag[first:last], k)
        inside = np.all((moved > 0.0) & (moved < 1023.0), axis=0)
        obs = replace(
            obs,
            x_px=moved[0],
            y_px=moved[1],
            temperature_c=20.0 + 10.0 * np.repeat(warmth, np.diff(obs.frame_starts)),
        ).select(inside)
        cal = sc.calibrate(obs, nominal(camera()), effects=",".join(SCALES))
        at = cal.effects.at("temperature")
        spread = cal.effects.temperature_c[1]
        slope = np.sqrt(np.diag(cal.effects.covariance[at, at]))[2] / spread
        rows.append((cal, obs, slope))
    return rows


def test_a_forecast_is_what_calibrations_with_the_same_effects_state(sky, calibrated) -> None:
    effects = PlannedEffects(SCALES)
    found = forecast(sky, effects)
    stated = np.mean([cal.sigmas for cal, _, _ in calibrated], axis=0)
    expected = np.array([found[name] for name in CORNER])
    np.testing.assert_allclose(stated, expected, rtol=0.1)
    slope = np.mean([slope for _, _, slope in calibrated])
    assert slope == pytest.approx(found["f_px_per_K"], rel=0.1)
    # Control: a forecast that knows no effects promises too much.
    plain = forecast(sky, None)
    assert stated[0] > 1.15 * plain["x0_px"] and stated[2] > 1.25 * plain["f_px"]


@pytest.mark.slow
def test_errors_of_attitude_are_those_of_propagation(sky, calibrated) -> None:
    cal, obs, _ = calibrated[0]
    # Three coefficients say little of the scale of temperature, on which the rest depends.
    found = forecast(sky, PlannedEffects({name: cal.effects.scale(name) for name in SCALES}))
    post = sc.sample(obs, cal, seed=1, n_ensembles=2, n_steps=100)
    error = sc.propagate(post, obs, onboard="effects", n_draws=50)
    expected = [found[f"rest_{axis}_arcsec"] for axis in ("pitch", "yaw", "roll")]
    np.testing.assert_allclose(error.analytic_rest_arcsec, expected, rtol=0.1)
    common = [found[f"common_{axis}_arcsec"] for axis in ("pitch", "yaw")]
    np.testing.assert_allclose(error.analytic_common_arcsec[:2], common, rtol=0.1)
    # Control: without effects the rest is hundreds of times smaller.
    assert expected[0] > 100.0 * forecast(sky, None)["rest_pitch_arcsec"]


def test_costs(sky) -> None:
    own = {"sweeps": False, "n_geometries": 100, "n_campaigns": 20}
    found = plan(camera(), sky, effects="field=0.3,frame=0.1", n_frames=(100,), **own)
    costs = found.effects
    assert costs is not None and costs.models == ("none", "field", "frame", "all")
    assert costs.growth("none", "f_px") == 1.0
    assert 1.0 < costs.growth("field", "f_px") < costs.growth("all", "f_px")
    alone = costs.to_dataframe().set_index("effects")["rest_pitch_arcsec_camera_alone"]
    assert alone["field"] > 5.0 * costs.of("field", "rest_pitch_arcsec")
    assert found.covariance.shape == (5, 5)
    assert sc.coupling(found).parameter_names == camera().parameter_names


def test_more_frames_keep_a_target_with_effects(sky) -> None:
    own = {"sweeps": False, "n_geometries": 100, "n_campaigns": 20, "target_arcsec": 20.0}
    found = plan(camera(), sky, effects="frame=0.1", **own)
    assert found.frames_needed > 1.1 * plan(camera(), sky, **own).frames_needed
    assert found.effects.n_frames == found.frames_needed


def test_a_wider_range_of_temperatures_tells_the_slope(sky) -> None:
    sigma = [
        plan(
            camera(),
            sky,
            effects=PlannedEffects.parsed("temperature", width),
            sweeps=False,
            n_geometries=100,
        ).effects.of("temperature", "f_px_per_K")
        for width in (5.0, 20.0)
    ]
    assert sigma[0] == pytest.approx(4.0 * sigma[1], rel=0.02)


def test_noise_and_window_keep_the_effects(sky) -> None:
    frames = random_frames(
        sky,
        Tracker(camera()),
        n_frames=50,
        seed=1,
        effects=PlannedEffects.parsed("axes,frame=0.1"),
    )
    quiet = frames.with_noise(1e-3)
    # What breathing leaves is no noise that smaller centroid noise would take away.
    ratio = quiet.information[:, 2, 2] / frames.information[:, 2, 2]
    assert np.median(ratio) < 1e2
    part = frames.seen_within(0.4)
    assert part.shape == frames.information.shape
    assert np.all(part[:, 2, 2] <= frames.information[:, 2, 2])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("star", "the effect 'star' cannot be planned: use some of axes, field"),
        ("field=big", "'field=big' is no effect with its scale in px"),
        ("field=0", "the scale of the effect 'field' is 0 px"),
        (" , ", "no effect is named"),
    ],
)
def test_effects_that_cannot_be_planned_are_refused(text, words) -> None:
    with pytest.raises(PlanningError, match=words):
        PlannedEffects.parsed(text)
