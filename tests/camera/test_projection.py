"""The camera model against OpenCV, against CasADi's own evaluation."""

import numpy as np
import pytest

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera import projection
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, parameters
from tests.helpers.scenes import MODELS, camera

RNG = np.random.default_rng(5)


def _grid(cam: Camera, factor: float) -> np.ndarray:
    """Pixels over the detector and out to `factor` times the corner radius."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    radius = np.linspace(0.0, factor * cam.corner_radius_px, 40)
    ring = np.stack(
        [np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()], axis=1
    )
    return ring + cam.theta[:2]


@pytest.mark.parametrize("model", MODELS)
def test_round_trip_over_and_beyond_the_detector(model):
    cam = camera(model)
    xy = _grid(cam, 1.2)
    back = projection.project(cam, projection.unproject(cam, xy))
    assert np.max(np.abs(back - xy)) < 1e-10
    b = projection.unproject(cam, xy)
    assert np.max(np.abs(projection.unproject(cam, projection.project(cam, b)) - b)) < 1e-13
    assert np.allclose(np.linalg.norm(b, axis=1), 1.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    "model",
    [
        "none",
        "k1",
        "brown",
        "brown3",
        "brown_tangential",
        "thin_prism",
        "none+axes",
        "thin_prism+axes",
    ],
)
def test_forward_models_agree_with_opencv(model):
    """With fx != fy too; OpenCV has no skew."""
    cv2 = pytest.importorskip("cv2")
    cam = camera(model)
    if any(cam.axes):
        cam = cam.replace(coefficients=(*cam.coefficients[:-2], 0.1, 0.0))
    matrix, dist = cam.to_opencv()
    b = projection.unproject(cam, _grid(cam, 1.0))
    expected, _ = cv2.projectPoints(b.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, dist)
    assert np.max(np.abs(projection.project(cam, b) - expected[:, 0])) < 1e-9


def test_models_differ_where_they_should():
    """Control for the comparison with OpenCV: without its coefficients the agreement is lost."""
    cam = camera("brown")
    b = projection.unproject(cam, _grid(cam, 1.0))
    assert (
        np.max(
            np.abs(
                projection.project(cam.replace(coefficients=(0.0, 0.0)), b)
                - projection.project(cam, b)
            )
        )
        > 0.1
    )


def _shift(cam: Camera, index: int) -> float:
    """A step in parameter `index` that moves the corner by about a pixel."""
    if index < 3:
        return 1.0
    order = get_model(cam.distortion).coefficients[index - 3].order
    return cam.corner_radius_px**-order


def _predict(model, theta, b):
    bb = np.ascontiguousarray(b)
    return projection.forward_kernel(model, "value")(
        bb.shape[1], theta, bb, projection.forward_root(model, theta, bb)
    )[0]


@pytest.mark.parametrize("model", MODELS)
def test_jacobians_and_second_derivatives_against_finite_differences(model):
    cam = camera(model)
    theta, p = cam.theta, len(cam.theta)
    b = np.ascontiguousarray(projection.unproject(cam, RNG.uniform(0, 1023, (60, 2))).T)
    kernel = projection.forward_kernel(model, "bent")
    _, d_theta, d_phi, second = kernel(60, theta, b, projection.forward_root(model, theta, b))
    # Those that the kernel leaves out vanish.
    rows, columns = projection.bent_index(model)
    full = np.zeros((p + 3, p + 3, 2, 60))
    full[rows, columns] = second
    full[columns, rows] = second
    first = np.concatenate([d_theta, d_phi])
    steps = np.array([_shift(cam, i) for i in range(p)] + [1e-4] * 3)

    def value(delta):
        turned = exp_rotation(delta[p:]) @ b
        return _predict(model, theta + delta[:p], turned)

    unit = np.diag(steps)
    for i in range(p + 3):
        h = 0.05 * unit[i]
        slope = (8 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12 * 0.05)
        assert np.allclose(slope, first[i] * steps[i], rtol=1e-6, atol=1e-7)
        for j in range(p + 3):
            g = unit[j]
            mixed = (
                value(unit[i] + g) - value(unit[i] - g) - value(g - unit[i]) + value(-unit[i] - g)
            ) / 4.0
            assert np.allclose(mixed, full[i, j] * steps[i] * steps[j], rtol=2e-2, atol=2e-5)


@pytest.mark.parametrize("model", MODELS)
def test_backward_jacobian_against_finite_differences(model):
    cam = camera(model)
    xy = RNG.uniform(0, 1023, (50, 2))
    _, jacobian = projection.unproject_jacobian(model, cam.theta, xy)
    for i in range(len(cam.theta)):
        h = 0.1 * _shift(cam, i)
        up, down = cam.theta, cam.theta
        up[i] += h
        down[i] -= h
        numeric = (
            projection.unproject_theta(model, up, xy) - projection.unproject_theta(model, down, xy)
        ) / (2 * h)
        assert np.max(np.abs(numeric - jacobian[:, :, i])) < 2e-6 * np.max(
            np.abs(jacobian[:, :, i])
        )


def test_a_direction_behind_the_camera_has_no_image():
    xy = projection.project(camera(), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(xy[0]).all()
    assert np.allclose(xy[1], [500.0, 530.0])


@pytest.mark.parametrize("model", ["brown_tangential", "inverse", "fisheye", "brown+axes"])
def test_a_shift_of_pixels_is_one_of_the_principal_point(model: str) -> None:
    """Rotations of noise are made of the derivatives of the principal point."""
    theta = np.array([500.0, 530.0, 5850.0, *[p.scale for p in parameters(model)[3:]]])
    if model.endswith("axes"):
        theta[-2:] = 1e-3
    xy = np.random.default_rng(1).uniform(0.0, 1023.0, (50, 2))
    _, jacobian = projection.unproject_jacobian(model, theta, xy)
    for axis, step in enumerate(0.5 * np.eye(2)):
        up, down = (projection.unproject_theta(model, theta, xy + s) for s in (step, -step))
        np.testing.assert_allclose(up - down, -jacobian[..., axis], rtol=1e-5, atol=1e-10)


def test_methods_of_the_camera_take_any_shape_and_return_to_the_pixels():
    cam = camera("brown")
    grid = np.stack(np.meshgrid([0.0, 300.0, 900.0], [5.0, 700.0]), axis=-1)
    seen = cam.unproject(grid)
    assert seen.shape == (2, 3, 3) and np.allclose(np.linalg.norm(seen, axis=-1), 1.0)
    assert cam.project(seen) == pytest.approx(grid, abs=1e-9)
    assert cam.project(seen[1, 2]).shape == (2,)
