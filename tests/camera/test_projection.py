"""The camera model against OpenCV, against CasADi's own evaluation, and against finite
differences.
"""

from __future__ import annotations

import numpy as np
import pytest

from starcal_uq.attitude.rotations import exp_rotation
from starcal_uq.camera import projection
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import DistortionError
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


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("order", ["value", "attitude", "first", "bent"])
def test_kernels_equal_casadi(model, order):
    cam = camera(model)
    b = np.ascontiguousarray(projection.unproject(cam, RNG.uniform(-50, 1074, (3000, 2))).T)
    root = projection.forward_root(model, cam.theta, b)
    kernel = projection.forward_kernel(model, order)
    outputs = kernel(b.shape[1], cam.theta, b, root)
    shared = root if root.ndim == 2 else np.zeros((2, b.shape[1]))
    picks = slice(0, 3000, 61)
    reference = kernel.function(cam.theta, b[:, picks], shared[:, picks])
    reference = reference if isinstance(reference, tuple) else (reference,)
    for ours, theirs in zip(outputs, reference, strict=True):
        flat = ours.reshape(-1, b.shape[1])[:, picks]
        expected = np.array(theirs).reshape(flat.shape)
        scale = np.max(np.abs(expected), axis=1, keepdims=True) + 1e-300
        assert np.max(np.abs(flat - expected) / scale) < 1e-13


@pytest.mark.parametrize("model", MODELS)
def test_backward_kernel_equals_casadi(model):
    cam = camera(model)
    pixel = RNG.uniform(0, 1023, (2, 200))
    root = projection.backward_root(model, cam.theta, pixel)
    kernel = projection.backward_kernel(model, True)
    shared = root if root.ndim == 2 else np.zeros((2, 200))
    for ours, theirs in zip(
        kernel(200, cam.theta, pixel, root), kernel.function(cam.theta, pixel, shared), strict=True
    ):
        assert np.max(np.abs(ours.reshape(-1, 200) - np.array(theirs).reshape(-1, 200))) < 1e-13


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


@pytest.mark.parametrize("model", ["k1", "inverse"])
def test_folding_distortion_is_an_error_and_not_a_number(model):
    cam = camera("brown").replace(
        distortion=model, coefficients=(-2e-6,) if model == "k1" else (-2e-6, 0.0)
    )
    fold = projection.fold_radius_px(model, cam.theta, cam.corner_radius_px)
    assert fold == pytest.approx(np.sqrt(1 / (3 * 2e-6)), rel=0.01)
    with pytest.raises(DistortionError, match="folds over"):
        projection.unproject(cam, [[0.0, 0.0]])
    with pytest.raises(DistortionError, match="folds over"):
        projection.project(cam, [[0.1, 0.1, 1.0]])
    inside = cam.theta[:2] + np.array([[100.0, 50.0]])
    assert np.allclose(
        projection.project(cam, projection.unproject(cam, inside)), inside, atol=1e-10
    )


@pytest.mark.parametrize(
    ("model", "k"),
    [
        ("k1", (-1e-4,)),
        ("brown", (-1e-5, 1e-11)),
        ("brown3", (2e-6, -5e-11, 1e-16)),
        ("brown_tangential", (-1e-5, 0.0, 1e-5, 0.0)),
        ("inverse", (-1e-5, 1e-11)),
    ],
)
def test_no_direction_beyond_a_fold(model, k):
    """Radii of radial models against roots of the polynomial; Newton's method steps over such
    folds.
    """
    theta, xy = np.array([500.0, 530.0, 4000.0, *k]), RNG.uniform(0, 1023, (2000, 2))
    b = projection.unproject_theta(model, theta, xy)
    seen = np.isfinite(b).all(axis=1)
    assert 0.003 < seen.mean() < 0.9
    np.testing.assert_array_equal(
        projection.unproject_theta(model, np.tile(theta[:, None], 2000), xy), b
    )
    np.testing.assert_array_equal(projection.unproject_jacobian(model, theta, xy)[0], b)
    if model == "brown_tangential":
        fold = projection.fold_radius_px(model, theta, 2000.0)
        assert np.hypot(*(theta[2] * b[seen, :2] / b[seen, 2:]).T).max() < 1.1 * fold
        return
    terms = np.array([1.0, *(k[j] * (2 * j + 3) for j in range(len(k)))])
    roots = np.roots(terms[::-1])
    fold = np.sqrt(
        min(root.real for root in roots if abs(root.imag) < 1e-12 * abs(root) and root.real > 0)
    )
    rim = fold * np.polyval(np.array([1.0, *k])[::-1], fold**2)
    radius = np.hypot(*(xy - theta[:2]).T)
    np.testing.assert_array_equal(seen, radius < (fold if model == "inverse" else rim))


@pytest.mark.parametrize("model", ["k1", "brown", "brown3", "brown_tangential", "inverse"])
def test_a_fold_is_where_a_dense_scan_has_it(model):
    """Random coefficients, some of which fold over a stretch of a few px only; in one direction,
    and in all of them.
    """
    rng, reach, folds = np.random.default_rng(7), 700.0, 0
    radius = np.linspace(0.0, reach, 4001)[1:]
    angle = (
        np.zeros(1)
        if get_model(model).radial
        else np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    )
    rays = np.array([np.cos(angle), np.sin(angle)])
    points = (rays[:, :, None] * radius).reshape(2, -1)
    for _ in range(40):
        sizes = [
            10.0 ** rng.uniform(-2.0, 0.3) / reach ** (c.order - 1)
            for c in get_model(model).coefficients
        ]
        theta = np.array([0.0, 0.0, 4000.0, *rng.choice([-1.0, 1.0], len(sizes)) * sizes])
        with np.errstate(all="ignore"):
            determinant = projection.newton_kernel(model)(points.shape[1], theta, points, points)[
                1
            ][0]
        bad = determinant.reshape(angle.size, -1) <= 0.0
        first = np.where(bad.any(axis=1), radius[np.argmax(bad, axis=1)], np.inf)
        assert projection.fold_radius_px(model, theta, reach) == pytest.approx(
            np.min(first), abs=0.4
        )
        for where, clear in ((np.minimum(first, reach) - 1.0, True), (first + 1.0, False)):
            some = np.isfinite(where)
            assert (
                projection.before_fold(model, theta, where[some] * rays[:, some]) == clear
            ).all()
        folds += int(np.isfinite(first).any())
    assert 3 < folds < 40


def test_where_a_bound_excludes_folds_there_are_none() -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, [1024.0, 768.0], (200, 2))
    said = []
    for k1 in -np.geomspace(1e-9, 1e-5, 25):
        thetas = np.array(
            [[500.0, 380.0, 4000.0, k1, 0.0], [520.0, 390.0, 4010.0, 0.5 * k1, 0.1 * k1**2]]
        )
        whole = all(
            np.isfinite(projection.unproject_theta("brown", theta, xy)).all() for theta in thetas
        )
        said.append(projection.cannot_fold("brown", thetas, xy))
        assert whole or not said[-1]
    assert said[0]
    assert not said[-1]


def test_a_direction_behind_the_camera_has_no_image():
    xy = projection.project(camera(), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(xy[0]).all()
    assert np.allclose(xy[1], [500.0, 530.0])


def test_unknown_model_is_named():
    with pytest.raises(DistortionError, match="unheard"):
        get_model("unheard")
