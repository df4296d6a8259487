"""The camera at a temperature, a time and on another night, of a sensor of a second make."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from tests.helpers.effects import CORNER_PX, moving, sheet, table
from tests.helpers.outside import campaign

FRAMES = 40


def warmed(seed: int, slope_px: float = 0.5, n_frames: int = FRAMES, **options: object):
    """Frames from -40 to -10 degC whose focal length grows with the temperature: the campaign, the
    table, and what is true.
    """
    rng = np.random.default_rng([seed, 3])
    warmth = rng.uniform(-1.0, 1.0, n_frames)
    c = campaign(rng, n_frames=n_frames, displaced=moving(slope_px, warmth), **options)
    obs = table(c, temperature_c=-25.0 + 15.0 * warmth[c.columns["frame"]])

    def focal_px(temperature_c: float) -> float:
        return c.theta[2] * (1.0 + slope_px * (temperature_c + 25.0) / 15.0 / CORNER_PX)

    return c, obs, focal_px


def test_focal_length_is_predicted_at_any_temperature() -> None:
    c, obs, focal_px = warmed(1)
    cal = sc.calibrate(obs, sheet(c), effects="auto")
    assert cal.effects.names == ("temperature",)
    for temperature in (-40.0, -25.0, -10.0, 5.0):
        found = cal.at(temperature_c=temperature)
        off = (found.camera.focal_px - focal_px(temperature)) / found.sigmas[2]
        assert abs(off) < 3.5
    # Beyond what was seen the error grows; the slope is then what counts.
    assert cal.at(temperature_c=60.0).sigmas[2] > 2.0 * cal.at(temperature_c=-25.0).sigmas[2]
    slope = (cal.at(temperature_c=-10.0).camera.focal_px - cal.at().camera.focal_px) / (
        -10.0 - cal.effects.temperature_c[0]
    )
    assert slope == pytest.approx(0.5 / 15.0 / CORNER_PX * c.theta[2], rel=0.05)
    # Control: one camera for all temperatures is far off at the ends.
    plain = sc.calibrate(obs, sheet(c))
    assert abs(plain.theta[2] - focal_px(-40.0)) / plain.sigmas[2] > 8.0


def test_what_no_effect_moves_is_refused() -> None:
    c, obs, _ = warmed(2, slope_px=0.0)
    plain = sc.calibrate(obs, sheet(c))
    np.testing.assert_array_equal(plain.at().covariance, plain.covariance)
    with pytest.raises(CalibrationError, match="no effect that moves the camera"):
        plain.at(temperature_c=20.0)
    cal = sc.calibrate(obs, sheet(c), effects="temperature")
    with pytest.raises(CalibrationError, match="no effect 'epoch'"):
        cal.at(new_night=True)


@pytest.mark.slow
def test_predictions_cover() -> None:
    z = []
    for seed in range(40):
        c, obs, focal_px = warmed(seed, slope_px=0.2, n_frames=20)
        cal = sc.calibrate(obs, sheet(c), effects="temperature")
        z.append(
            [
                (found.camera.focal_px - focal_px(t)) / found.sigmas[2]
                for t in (-40.0, -10.0, 20.0)
                for found in [cal.at(temperature_c=t)]
            ]
        )
    covered = np.mean(np.abs(z) < 1.96, axis=0)
    print("covered", covered)
    # A share of 40 has a standard error of 3.4 %.
    assert np.all(covered > 0.85)
    assert np.sqrt(np.mean(np.square(z))) > 0.75


@pytest.mark.slow
def test_a_night_that_was_left_out_is_covered() -> None:
    nights, per_night, z, narrow = 8, 6, [], []
    for seed in range(30):
        rng = np.random.default_rng([seed, 9])
        offsets = 0.4 * rng.standard_normal(nights)
        night = np.repeat(np.arange(nights), per_night)
        c = campaign(rng, n_frames=len(night), displaced=moving(1.0, offsets[night]))
        frame = c.columns["frame"]
        hours = 24 * night + np.tile(np.arange(per_night), nights) // 2
        times = np.datetime64("2026-01-01T20:00:00") + hours.astype("timedelta64[h]")
        obs = table(c, time_utc=times.astype(str)[frame])
        left = night[frame] == nights - 1
        cal = sc.calibrate(obs.select(~left), sheet(c), effects="epoch")
        alone = sc.calibrate(obs.select(left), sheet(c))
        found = cal.at(new_night=True)
        off = alone.theta[2] - found.camera.focal_px
        z.append(off / np.hypot(found.sigmas[2], alone.sigmas[2]))
        narrow.append(off / np.hypot(cal.sigmas[2], alone.sigmas[2]))
    covered = float(np.mean(np.abs(z) < 1.96))
    print("covered", covered, "without the spread of nights", np.mean(np.abs(narrow) < 1.96))
    assert 0.84 < covered <= 1.0
    # Control: the camera of the nights that were seen does not cover another one.
    assert np.mean(np.abs(narrow) < 1.96) < 0.8
