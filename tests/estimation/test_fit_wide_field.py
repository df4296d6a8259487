"""Fisheyes of 100 and 180 degrees, whose stars NumPy alone projects, from calibration to report."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import starcal_uq as sc
from tests.helpers.outside import sky_angles

SIDE_PX, SIGMA_PX = 1024, 0.05
CENTRE = np.array([508.0, 515.0])


def radius(angle: np.ndarray, terms: tuple[float, ...]) -> np.ndarray:
    """In units of the focal length."""
    return angle * (1.0 + sum(k * angle ** (2 * n) for n, k in enumerate(terms, 1)))


def observed(
    focal_px: float, terms: tuple[float, ...], n_frames: int = 8, n_sky: int = 1000
) -> tuple[sc.Observations, np.ndarray, np.ndarray]:
    """A table, and pixels and directions without noise over the detector."""
    rng = np.random.default_rng(77)
    z = rng.uniform(-1.0, 1.0, n_sky)
    azimuth = rng.uniform(0.0, 2.0 * np.pi, n_sky)
    flat = np.sqrt(1.0 - z**2)
    sky = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
    frame, xy, which, seen = [], [], [], []
    for k, turn in enumerate(Rotation.random(n_frames, random_state=5).as_matrix()):
        b = sky @ turn.T
        across = np.hypot(b[:, 0], b[:, 1])
        angle = np.arctan2(across, b[:, 2])
        place = CENTRE + (focal_px * radius(angle, terms) / across)[:, None] * b[:, :2]
        on = (angle < np.radians(92.0)) & np.all((place > 0) & (place < SIDE_PX - 1), axis=1)
        frame.append(np.full(on.sum(), k))
        which.append(np.flatnonzero(on))
        xy.append(place[on])
        seen.append(b[on])
    pixels, directions = np.concatenate(xy), np.concatenate(seen)
    noisy = pixels + SIGMA_PX * rng.standard_normal(pixels.shape)
    ra, dec = sky_angles(sky[np.concatenate(which)])
    table = sc.Observations(
        frame=np.concatenate(frame), x_px=noisy[:, 0], y_px=noisy[:, 1], ra_deg=ra, dec_deg=dec
    )
    return table, pixels, directions


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "focal_px", "terms"),
    [("equidistant", 586.7, (-0.02, 0.004)), ("fisheye", 326.0, (-0.02, 0.001, 0.0, 0.0))],
)
def test_a_fisheye_is_found_and_sampled(model, focal_px, terms):
    obs, pixels, directions = observed(focal_px, terms)
    widest = np.degrees(np.arccos(directions[:, 2].min()))
    assert widest > (90.0 if model == "fisheye" else 60.0)
    start = sc.Camera(SIDE_PX, SIDE_PX, None, None, 511.5, 511.5, model, focal_px=1.03 * focal_px)
    wanted = np.array(
        [*CENTRE, focal_px, *(k / focal_px ** (2 * n) for n, k in enumerate(terms, 1))]
    )
    cal = sc.calibrate(obs, start)
    three = sc.calibrate(obs, start, method="three_stage")
    print(model, "z", (cal.theta - wanted) / cal.sigmas, "sigma", cal.sigma)
    for found in (cal, three):
        assert np.max(np.abs((found.theta - wanted) / found.sigmas)) < 4.0
    assert cal.sigma == pytest.approx(SIGMA_PX, rel=0.05)
    error = np.linalg.norm(sc.camera.unproject(cal.camera, pixels) - directions, axis=1)
    assert np.max(error) * focal_px < SIGMA_PX
    # Control: without distortion this is no model of these stars.
    assert sc.calibrate(obs, start, model="f_theta", throw=False).sigma > 5.0 * SIGMA_PX
    post = sc.sample(obs, cal, seed=3, n_steps=300)
    assert np.max(np.abs((post.mean - cal.theta) / cal.sigmas)) < 0.3
    assert np.isfinite(sc.coupling(post).correlation).all()
    assert np.isfinite(sc.propagate(post, obs).rest_arcsec).all()
