"""Equidistant models against OpenCV's fisheye, against their formula beyond 90 degrees."""

import numpy as np
import pytest

from starcal_uq.camera import projection
from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CameraError, DistortionError, IdentificationError
from starcal_uq.identification.search import field_geometry

F = 460.0
TERMS = np.array([-0.02, 0.004, -0.001, 1e-4])
SCALED = tuple((TERMS / F ** np.arange(2, 9, 2)).tolist())
WIDE = Camera(1024, 1024, 5.5, F * 5.5e-3, 508.0, 515.0, "fisheye", SCALED)


def directions(most_deg: float, n: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(8)
    angle = np.radians(most_deg) * np.sqrt(rng.uniform(0.0, 1.0, n))
    azimuth = rng.uniform(0.0, 2.0 * np.pi, n)
    x, y = np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth)
    return np.column_stack([x, y, np.cos(angle)])


def by_formula(camera: Camera, b: np.ndarray, terms: np.ndarray) -> np.ndarray:
    angle = np.arctan2(np.hypot(b[:, 0], b[:, 1]), b[:, 2])
    azimuth = np.arctan2(b[:, 1], b[:, 0])
    radius = camera.focal_px * angle
    for power, k in enumerate(terms, 1):
        radius = radius + camera.focal_px * k * angle ** (2 * power + 1)
    stretch, skew = camera.axes
    v = radius * np.sin(azimuth)
    return np.column_stack(
        [camera.x0_px + radius * np.cos(azimuth) + skew * v, camera.y0_px + (1.0 + stretch) * v]
    )


@pytest.mark.parametrize("axes", [(), (0.05, 0.0)])
def test_opencv_sees_the_same_pixels(axes):
    cv2 = pytest.importorskip("cv2")
    camera = WIDE
    if axes:
        camera = WIDE.replace(distortion="fisheye+axes", coefficients=(*SCALED, *axes))
    matrix, terms = camera.to_opencv()
    assert terms == pytest.approx(TERMS, rel=1e-12)
    b = directions(85.0)
    theirs, _ = cv2.fisheye.projectPoints(b[:, None], np.zeros(3), np.zeros(3), matrix, terms)
    assert np.max(np.abs(projection.project(camera, b) - theirs[:, 0])) < 1e-9
    back = Camera.from_opencv(matrix, terms, 1024, 1024, 5.5, fisheye=True)
    assert back.distortion == camera.distortion
    assert back.theta == pytest.approx(camera.theta, rel=1e-13)
    # Control: the pinhole's formula is another lens.
    pinhole, _ = cv2.projectPoints(b[:, None], np.zeros(3), np.zeros(3), matrix, terms)
    assert np.max(np.abs(projection.project(camera, b) - pinhole[:, 0])) > 100.0


@pytest.mark.parametrize(
    ("model", "n"), [("f_theta", 0), ("equidistant", 2), ("fisheye", 4), ("fisheye+axes", 4)]
)
def test_directions_beyond_the_horizon_of_a_pinhole(model, n):
    axes = (0.02, -0.01) if "axes" in model else ()
    camera = WIDE.replace(distortion=model, coefficients=(*SCALED[:n], *axes))
    b = directions(120.0)
    assert np.count_nonzero(b[:, 2] < 0.0) > 500
    b[:3] = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]
    xy = projection.project(camera, 3.0 * b)
    assert np.max(np.abs(xy - by_formula(camera, b, TERMS[:n]))) < 1e-9
    assert np.max(np.abs(projection.unproject(camera, xy) - b)) < 1e-12
    assert np.isnan(projection.project(camera, [[0.0, 1e-3, -1.0]])).all()


@pytest.mark.filterwarnings("error")
def test_all_derivatives_are_smooth_at_the_axis():
    kernel = projection.forward_kernel("fisheye", "bent")
    shift = np.array([0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3])
    b = np.array([shift, 0.5 * shift, np.ones(6)])
    b /= np.linalg.norm(b, axis=0)
    outputs = kernel(6, WIDE.theta, b, np.zeros(2))
    for output in outputs:
        flat = output.reshape(-1, 6)
        assert np.isfinite(flat).all()
        # A pole or cancellation would show near the axis first.
        assert np.all(np.abs(flat - flat[:, :1]) <= 10.0 * F**2 * shift + 1e-9)
    centre = WIDE.theta[:2, None] + 0.0 * shift
    for output in projection.backward_second_kernel("fisheye")(
        6, WIDE.theta, centre, np.zeros((2, 6))
    ):
        assert np.isfinite(output).all()


def test_what_a_model_does_not_reach_is_refused():
    with pytest.raises(DistortionError):
        projection.project(
            WIDE.replace(distortion="equidistant", coefficients=(-0.3 / F**2, 0.0)), [[1.0, 0, 0]]
        )
    short = WIDE.replace(distortion="f_theta", coefficients=(), focal_px=200.0)
    with pytest.raises(DistortionError, match="more than 150 degrees from the optical axis"):
        projection.unproject(short, [[0.0, 0.0]])
    with pytest.raises(IdentificationError):
        field_geometry(WIDE)
    with pytest.raises(CameraError):
        Camera.from_opencv(np.diag([F, F, 1.0]), [0.1], 10, 10, 5.0, distortion="fisheye")


def test_fields_and_pixels_of_the_horizon():
    camera = WIDE.replace(distortion="f_theta", coefficients=())
    assert camera.fov_deg[0] == pytest.approx(np.degrees(1024 / F))
    assert WIDE.replace(distortion="brown").coefficients == (0.0, 0.0)
    assert camera.data_sheet().distortion == "f_theta"
