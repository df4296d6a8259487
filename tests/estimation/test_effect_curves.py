"""Curves of effects hold what was planted, within the deviations that they state."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.estimation.effect_curves import effect_curves, found_zeniths
from tests.helpers.effects import (
    CORNER_PX,
    breathing,
    moving,
    of_magnitude,
    of_phase,
    sheet,
    table,
    together,
)
from tests.helpers.outside import campaign


@pytest.fixture(scope="module")
def breathed():
    """A calibration of frames that breathe, its table, and the scales and shears (K, 3)."""
    c = campaign(
        np.random.default_rng(3),
        n_frames=60,
        displaced=breathing(np.random.default_rng(4), 60, 0.2),
    )
    obs = table(c)
    planted = 0.2 * np.random.default_rng(4).standard_normal((60, 3))
    return sc.calibrate(obs, sheet(c), effects="frame"), obs, planted


def test_frames_have_the_scales_and_shears_that_were_planted(breathed) -> None:
    cal, obs, planted = breathed
    (curve,) = effect_curves(cal, obs)
    assert curve.names == ("scale", "stretch along x", "shear")

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(((curve.values - values.T) / curve.sigmas) ** 2)))

    assert 0.85 < rms(planted) < 1.15
    # Control: those of the frame before are far from it.
    assert rms(np.roll(planted, 1, axis=0)) > 3.0


def test_stars_have_the_offsets_that_were_planted() -> None:
    own = {"n_frames": 25, "stars_per_frame": 20, "patch_stars": 60}
    c = campaign(np.random.default_rng(8), star_sigma_px=0.2, **own)
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects="star")
    (curve,) = effect_curves(cal, obs)
    # The same draws without offsets are the stars as they shine.
    true = campaign(np.random.default_rng(8), star_sigma_px=0.0, **own)
    first = np.unique(c.columns["star_id"], return_index=True)[1]
    ra, dec = ((c.columns[n] - true.columns[n])[first] for n in ("ra_deg", "dec_deg"))
    ra = ra * np.cos(np.radians(c.columns["dec_deg"][first]))
    sizes = np.sort(np.radians(np.hypot(ra, dec)) * c.theta[2])
    found = np.sort(curve.values[0])
    assert np.corrcoef(sizes, found)[0, 1] > 0.95
    assert np.median(curve.sigmas) < 0.5 * 0.2


@pytest.fixture(scope="module")
def moved():
    """A calibration with effects of temperature, phase and magnitude, its table, and the
    temperatures of the frames in standard deviations.
    """
    rng = np.random.default_rng(9)
    warmth = rng.uniform(-1.7, 1.7, 40)
    shifts = together(moving(0.1, warmth), of_phase(0.04), of_magnitude(0.05))
    c = campaign(rng, n_frames=40, stars_per_frame=25, displaced=shifts)
    obs = table(c, temperature_c=15.0 + 8.0 * warmth[c.columns["frame"]])
    return sc.calibrate(obs, sheet(c), effects="temperature,phase,magnitude"), obs, c


def test_curves_of_the_run_hold_what_was_planted(moved) -> None:
    cal, obs, c = moved
    curves = {curve.effect: curve for curve in effect_curves(cal, obs)}
    warm, phase, bright = (curves[name] for name in ("temperature", "phase", "magnitude"))
    # A scale that is 0.1 px at the corner for 8 degrees moves f.
    slope = np.polyfit(warm.x, warm.values[2], 1)[0]
    sigma = warm.sigmas[2, -1] / abs(warm.x[-1] - obs.temperature_c.mean())
    true = 0.1 / 8.0 * c.theta[2] / CORNER_PX
    assert abs(slope - true) < 3.0 * sigma < 0.5 * true
    wave = 0.04 * np.sin(2.0 * np.pi * phase.x)
    assert np.abs((phase.values - wave) / phase.sigmas).max() < 4.0
    # Control: the wave half a pixel further on.
    assert np.abs((phase.values + wave) / phase.sigmas).max() > 6.0
    line = 0.05 * (bright.x - obs.mag.mean()) / np.sqrt(16.0 / 12.0)
    far = np.abs(bright.x - obs.mag.mean()) > 0.5
    assert np.abs((bright.values[0] - line) / bright.sigmas[0])[far].max() < 4.0


def test_each_effect_has_a_panel(moved, breathed) -> None:
    cal, obs, _ = moved
    axes = cal.plot.effects(obs).axes
    assert len(axes) == 4
    assert [ax.get_xlabel() for ax in axes[:3]] == [
        "temperature [°C]",
        "place in the pixel [px]",
        "magnitude",
    ]
    assert all("px" in ax.get_ylabel() for ax in axes[:3])
    assert len(cal.plot.effects(obs, "phase").axes) == 1
    assert [t.get_text() for t in cal.effects.plot.scales().get_yticklabels()] == list(
        cal.effects.names
    )
    with pytest.raises(CalibrationError, match="no effect 'field': it holds temperature, phase"):
        cal.plot.effects(obs, "field")
    plain = sc.calibrate(breathed[1], breathed[0].camera)
    with pytest.raises(CalibrationError, match="holds no effects: calibrate with effects='auto'"):
        plain.plot.effects(breathed[1])


def test_the_zenith_stands_beside_that_of_the_site() -> None:
    esa = sc.example_data("esa")
    obs = sc.sky.make_apparent(esa.observations)
    cal = sc.calibrate(obs, esa.camera, effects="zenith,noise")
    truth = sc.sky.refraction.site_among_stars(esa.site, obs.time_utc[obs.frame_starts[:-1]])[0]
    sky = found_zeniths(cal, truth)
    apart = sky.zeniths - sky.truth
    squares = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(sky.covariances), apart)
    assert squares.max() < 9.2
    # Control: the boresights are no zeniths.
    looks = sky.boresights - sky.truth
    assert np.einsum("ki,kij,kj->k", looks, np.linalg.inv(sky.covariances), looks).min() > 100.0
    (ax,) = cal.plot.effects(obs, "zenith", esa.site).axes
    assert "zenith of the site" in [text.get_text() for text in ax.get_legend().get_texts()]
