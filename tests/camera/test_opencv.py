"""Cameras of OpenCV, to and fro."""

import numpy as np
import pytest

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CameraError
from tests.camera.test_camera import awkward, matrix

PAPER = Camera(1024, 1024, 12.0, 70.2262, 500.0, 530.0, "brown", (2.0e-10, -3.5e-15))


@pytest.mark.parametrize("distortion", ["brown", "brown3", "brown_tangential", "none", "k1"])
def test_opencv_round_trip(distortion):
    camera = awkward(distortion)
    matrix, dist = camera.to_opencv()
    assert (matrix.shape, dist.shape) == ((3, 3), (5,))
    # Terms that are zero do not tell these from richer models.
    named = {"distortion": distortion} if distortion in ("none", "k1") else {}
    back = Camera.from_opencv(matrix, dist, 640, 480, camera.pixel_um, name=camera.name, **named)
    assert back.distortion == distortion
    np.testing.assert_allclose(back.theta, camera.theta, rtol=1e-14)


def test_opencv_scales_by_powers_of_the_focal_length():
    f = PAPER.focal_px
    np.testing.assert_allclose(
        PAPER.to_opencv()[1], [2e-10 * f**2, -3.5e-15 * f**4, 0, 0, 0], rtol=1e-15
    )
    camera = PAPER.replace(distortion="brown_tangential", coefficients=(0.0, 0.0, 1e-7, 2e-7))
    np.testing.assert_allclose(camera.to_opencv()[1], [0, 0, 1e-7 * f, 2e-7 * f, 0], rtol=1e-15)
    assert Camera.from_opencv(PAPER.to_opencv()[0], None, 1024, 1024, 12.0).coefficients == (
        0.0,
        0.0,
    )
    assert (
        Camera.from_opencv(PAPER.to_opencv()[0], np.zeros((1, 14)), 1024, 1024, 12.0).distortion
        == "brown"
    )


@pytest.mark.parametrize(
    ("camera_matrix", "dist", "options", "message"),
    [
        (matrix(fy=5001.0), None, {"distortion": "k1"}, "square pixels; use 'k1\\+axes'"),
        (matrix(skew=0.1), None, {"distortion": "brown"}, "skew.*use 'brown\\+axes'"),
        (matrix().T, None, {}, "below its diagonal"),
        (matrix(fx=-1.0, fy=-1.0), None, {}, "focal lengths are -1.0"),
        (np.eye(2), None, {}, "3x3"),
        (matrix(), [0, 0, 0, 0, 0, 1e-3, 0, 0], {}, "rational"),
        (matrix(), [np.nan], {}, "finite"),
        (matrix(), [0.1, 0, 1e-4, 0, 0.2], {}, "'brown_tangential' cannot hold k3"),
        (matrix(), [0.1, 0.2], {"distortion": "k1"}, "'k1' cannot hold k2"),
        (matrix(), [0.1], {"distortion": "inverse"}, "'inverse' cannot hold"),
        (matrix(), [0.1], {"distortion": "unheard"}, "unknown"),
    ],
)
def test_from_opencv_refuses_what_it_cannot_hold(camera_matrix, dist, options, message):
    with pytest.raises(CameraError, match=message):
        Camera.from_opencv(camera_matrix, dist, 1000, 1000, 10.0, **options)


def test_two_focal_lengths_and_skew_of_opencv_are_axes_of_the_detector():
    camera = Camera.from_opencv(matrix(fy=5001.0, skew=0.5), [0.1], 1000, 1000, 10.0)
    assert camera.distortion == "brown+axes"
    assert camera.focal_px == 5000.0
    assert camera.axes == pytest.approx((2e-4, 1e-4), rel=1e-12)
    np.testing.assert_allclose(camera.to_opencv()[0], matrix(fy=5001.0, skew=0.5), rtol=1e-15)


def test_inverse_model_has_no_opencv_form():
    with pytest.raises(CameraError):
        awkward("inverse").to_opencv()
