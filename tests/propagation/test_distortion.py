"""Distortion against radius: displacement by its formula, and bands that hold what they say."""

from types import SimpleNamespace

import numpy as np
import pytest

from starcal_uq.core.errors import DistortionError
from starcal_uq.propagation.distortion import distortion_curve
from tests.helpers.gaussian_camera import COVARIANCE
from tests.helpers.scenes import camera


def gaussian_posterior(
    model: str = "brown", covariance: np.ndarray = COVARIANCE
) -> SimpleNamespace:
    cam = camera(model)
    sd = np.sqrt(np.diag(covariance))
    root = sd[:, None] * np.linalg.cholesky(covariance / np.outer(sd, sd))

    def thin(n: int, seed: int) -> np.ndarray:
        draws = cam.theta + np.random.default_rng(seed).standard_normal((n, len(sd))) @ root.T
        return np.column_stack([draws, np.full(n, 0.05)])

    return SimpleNamespace(
        camera=cam, calibrated_camera=cam, mean=cam.theta, covariance=covariance, thin=thin
    )


DECENTRED = np.diag([0.15, 0.15, 0.028, 1e-10, 1e-16, 1e-9, 1e-9]) ** 2


def test_both_directions_of_a_model_give_the_same_sign() -> None:
    """``inverse`` maps distorted to ideal points; the curve shows distorted minus ideal all the
    same.
    """
    covariance = np.diag(np.diag(COVARIANCE))
    found = distortion_curve(gaussian_posterior("inverse", covariance), n=21, n_draws=300)
    k1, k2 = camera("inverse").coefficients
    r = found.radius_px
    np.testing.assert_allclose(found.mean_px[0], -(k1 * r**3 + k2 * r**5), atol=0.01)
    assert found.mean_px.max() > 0.1


def test_decentring_is_shown_along_azimuths() -> None:
    post = gaussian_posterior("brown_tangential", DECENTRED)
    found = distortion_curve(post, n=11, n_draws=300, azimuths_deg=(0, 90, 180))
    assert found.mean_px.shape == (3, 11)
    p1, p2 = camera("brown_tangential").coefficients[2:]
    r = found.radius_px[-1]
    # Along +x and -x the radial parts differ by twice 3 p2 r^2, along y they hold 3 p1 r^2.
    np.testing.assert_allclose(
        found.mean_px[0, -1] - found.mean_px[2, -1], 6 * p2 * r**2, rtol=0.05
    )
    mean = 0.5 * (found.mean_px[0, -1] + found.mean_px[2, -1])
    np.testing.assert_allclose(found.mean_px[1, -1] - mean, 3 * p1 * r**2, rtol=0.05)
    assert distortion_curve(post, n=3, n_draws=50).azimuth_deg.tolist() == [
        45.0 * step for step in range(8)
    ]
    assert (
        len(
            distortion_curve(
                gaussian_posterior(), n=3, n_draws=50, azimuths_deg=(0, 90)
            ).azimuth_deg
        )
        == 1
    )


def test_what_has_no_curve_is_said() -> None:
    with pytest.raises(DistortionError, match="is 'none'"):
        distortion_curve(gaussian_posterior("none", COVARIANCE[:3, :3]))
    with pytest.raises(DistortionError):
        distortion_curve(gaussian_posterior(covariance=COVARIANCE * 1e10), n=5, n_draws=200)
