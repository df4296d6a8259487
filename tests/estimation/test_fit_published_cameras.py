"""Cameras in flight and from the literature."""

import numpy as np
import pytest

import starcal_uq as sc
from tests.helpers.effects import CORNER_PX, bump, moving, sheet, table, together
from tests.helpers.outside import Campaign, Displacement, campaign

SIDE_PX = 1024
SIGMA_PX = 0.05


def observed(
    seed: int, focal_px: float, shift: Displacement | None, n_frames: int, stars: int, **k1: float
) -> Campaign:
    field_deg = 2.0 * float(np.degrees(np.arctan(0.5 * SIDE_PX / focal_px)))
    return campaign(
        np.random.default_rng([seed, 24]),
        n_frames=n_frames,
        stars_per_frame=stars,
        field_deg=field_deg,
        corner_px=(0.2, 0.0),
        sigma_px=SIGMA_PX,
        displaced=shift,
        offset_px=(3.0, -2.0),
    )


def map_error_px(c: Campaign, cal: sc.Calibration, shift: Displacement | None) -> float:
    """Root mean square over the field and axes of directions by the calibration against those of
    the truth, after the rotation between both, px.
    """
    grid = np.linspace(20.0, SIDE_PX - 21.0, 21)
    ideal = np.array(np.meshgrid(grid, grid)).reshape(2, -1)
    x0, y0, f, k1, k2 = c.theta
    truth = np.array([(ideal[0] - x0) / f, (ideal[1] - y0) / f, np.ones(ideal.shape[1])])
    truth /= np.linalg.norm(truth, axis=0)
    uv = ideal - np.array([[x0], [y0]])
    r2 = np.sum(uv**2, axis=0)
    seen = np.array([[x0], [y0]]) + uv * (1.0 + k1 * r2 + k2 * r2**2)
    if shift is not None:
        seen = seen + shift(seen - np.array([[x0], [y0]]), seen, np.full(seen.shape[1], 4.0), 0)
    found = cal.directions(seen.T).T
    # Kabsch: the rotation that brings one set of directions onto the other.
    u, _, vt = np.linalg.svd(found @ truth.T)
    rotation = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return float(np.sqrt(np.mean((rotation @ found - truth) ** 2) * 1.5) * f)


def aspect(ratio: float) -> Displacement:
    """Pixels that are larger along y: x by this ratio, as f of x over f of y."""

    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        return np.array([0.5 * (ratio - 1.0) * uv[0], -0.5 * (ratio - 1.0) * uv[1]])

    return shift


def prism(s1: float, s2: float) -> Displacement:
    def shift(uv: np.ndarray, xy: np.ndarray, mag: np.ndarray, frame: int) -> np.ndarray:
        r2 = np.sum(uv**2, axis=0)
        return np.array([s1 * r2, s2 * r2])

    return shift


def test_directions_of_yan_are_within_the_noise() -> None:
    focal_px = 0.5 * SIDE_PX / np.tan(np.radians(10.0))
    shift = together(prism(2.3e-7, 4.5e-7), bump(0.4))
    c = observed(5, focal_px, shift, n_frames=60, stars=25)
    obs = table(c)
    cal = sc.calibrate(obs, sheet(c), effects="auto")
    error = map_error_px(c, cal, shift)
    plain = map_error_px(c, sc.calibrate(obs, sheet(c)), shift)
    print(cal.effects.names, f"{error:.4f} px with effects, {plain:.4f} px without")
    assert error < 0.5 * SIGMA_PX
    assert cal.sigma == pytest.approx(SIGMA_PX, rel=0.05)
    # Control: the camera alone is not within the noise.
    assert plain > 1.5 * error
    assert plain > 0.6 * SIGMA_PX


def test_the_slope_of_mdis_is_found() -> None:
    slope_mm, at_zero_mm = 0.001114498, 78.244824
    rng = np.random.default_rng(120)
    warmth = rng.uniform(-40.0, -10.0, 120)
    middle = at_zero_mm - 25.0 * slope_mm
    relative = slope_mm / middle
    shift = moving(relative * CORNER_PX, warmth + 25.0)
    c = observed(7, middle / 0.014, shift, n_frames=120, stars=20)
    obs = table(c, temperature_c=warmth[c.columns["frame"]])
    cal = sc.calibrate(obs, sheet(c), effects="auto")
    assert "temperature" in cal.effects.names
    _, spread = cal.effects.temperature_c
    at = cal.effects.at("temperature").start + 2
    found = cal.effects.coefficients[at] / spread
    error = np.sqrt(cal.effects.covariance[at, at]) / spread
    wanted = slope_mm / 0.014
    print("slope", found * 0.014, "+-", error * 0.014, "mm/K, published", slope_mm)
    assert abs(found - wanted) < 2.0 * error
    assert error < 0.1 * wanted
    for temperature in (-40.0, -25.0, -10.0):
        there = cal.at(temperature_c=temperature)
        truth = (at_zero_mm + slope_mm * temperature) / 0.014
        assert abs(there.camera.focal_px - truth) < 3.0 * there.sigmas[2]


def test_the_aspect_of_dawn_is_a_parameter_of_its_camera() -> None:
    shift = aspect(1.00064)
    c = observed(5, 150.07 / 0.014, shift, n_frames=60, stars=25)
    cal = sc.calibrate(table(c), sheet(c), model="brown+axes")
    stretch, skew = cal.theta[5:7]
    wanted = (1.0 - 0.00032) / (1.0 + 0.00032) - 1.0
    print("stretch", stretch, "+-", cal.sigmas[5], "wanted", wanted, "skew", skew)
    assert abs(stretch - wanted) < 3.0 * cal.sigmas[5] < 0.1 * abs(wanted)
    assert abs(skew) < 3.0 * cal.sigmas[6]
    # The effect of the axes, which the data take up, is the same two parameters.
    chosen = sc.calibrate(table(c), sheet(c), effects="auto")
    assert (chosen.effects.names, chosen.camera.distortion) == (("axes",), "brown+axes")
    np.testing.assert_allclose(chosen.theta, cal.theta, rtol=1e-9, atol=1e-12)
    assert (chosen.effects.scale("axes"), len(chosen.effects.coefficients)) == (0.0, 0)
    error = map_error_px(c, cal, shift)
    assert error < 0.5 * SIGMA_PX
    assert cal.sigma == pytest.approx(SIGMA_PX, rel=0.05)
    # Control: the camera alone is not within the noise.
    assert map_error_px(c, sc.calibrate(table(c), sheet(c)), shift) > max(
        1.5 * error, 0.6 * SIGMA_PX
    )


def test_the_thin_prism_of_yan_is_a_parameter_of_its_camera() -> None:
    focal_px, s1, s2 = 0.5 * SIDE_PX / np.tan(np.radians(10.0)), 2.3e-7, 4.5e-7
    shift = prism(s1, s2)
    c = observed(6, focal_px, shift, n_frames=60, stars=25)
    cal = sc.calibrate(table(c), sheet(c), model="thin_prism")
    z = (cal.theta[5:7] - (s1, s2)) / cal.sigmas[5:7]
    error = map_error_px(c, cal, shift)
    plain = map_error_px(c, sc.calibrate(table(c), sheet(c)), shift)
    print("s1, s2", cal.theta[5:7], "+-", cal.sigmas[5:7], f"{error:.4f} px, brown {plain:.4f} px")
    assert np.max(np.abs(z)) < 3.0
    assert np.all(cal.sigmas[5:7] < 0.3 * np.array([s1, s2]))
    assert error < 0.5 * SIGMA_PX
    assert cal.sigma == pytest.approx(SIGMA_PX, rel=0.05)
    # Control: without the prism the camera is worse.
    assert plain > 1.5 * error
