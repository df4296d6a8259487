"""World coordinates of a frame by astropy, against the rotation and the camera alone."""

import numpy as np
import pytest

from starcal_uq.camera.sip import sip_header
from starcal_uq.core.errors import CameraError
from tests.camera.test_exchange import CAMERAS, largest, pixels
from tests.helpers.outside import unit_vectors


@pytest.fixture(params=CAMERAS.values(), ids=CAMERAS)
def camera(request):
    return request.param


@pytest.mark.extra("images")
def test_world_coordinates_of_a_frame_are_those_of_the_camera(camera):
    """Directions of pixels by astropy, and by the rotation and the camera alone."""
    rng = np.random.default_rng(5)
    poles = ([0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
    for attitude in (*rng.standard_normal((4, 4)), *poles):
        x, y, z, w = attitude / np.linalg.norm(attitude)
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        sky = camera.unproject(pixels(camera)) @ rotation
        wcs = camera.wcs(attitude, tolerance_px=1.0)
        theirs = unit_vectors(*wcs.all_pix2world(pixels(camera), 0).T)
        _, error = sip_header(camera)
        assert largest(camera.focal_px * (theirs - sky)) < 2.0 * error + 1e-5
    # A rotation of the camera by the thousandth part of a radian is seen.
    turned = camera.wcs([0.0, 0.0, 0.0005, 1.0], tolerance_px=1.0)
    assert largest(turned.wcs.cd - camera.wcs(poles[0], tolerance_px=1.0).wcs.cd) > 1e-6
    for attitude, tolerance, said in (([0, 0, 1], 1.0, "quaternion"), (poles[0], -1.0, "px off")):
        with pytest.raises(CameraError, match=said):
            camera.wcs(attitude, tolerance)
