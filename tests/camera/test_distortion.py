"""Where a distortion folds over."""

import numpy as np
import pytest

from starcal_uq.camera import projection
from starcal_uq.camera.distortion import get_model
from starcal_uq.core.errors import DistortionError
from tests.helpers.scenes import camera

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("model", ["k1", "inverse"])
def test_folding_distortion_is_an_error_and_not_a_number(model):
    cam = camera("brown").replace(
        distortion=model, coefficients=(-2e-6,) if model == "k1" else (-2e-6, 0.0)
    )
    fold = projection.fold_radius_px(model, cam.theta, cam.corner_radius_px)
    assert fold == pytest.approx(np.sqrt(1 / (3 * 2e-6)), rel=0.01)
    with pytest.raises(DistortionError):
        projection.unproject(cam, [[0.0, 0.0]])
    with pytest.raises(DistortionError):
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
    """Radii of radial models against roots of the polynomial."""
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
    """Random coefficients, some of which fold over a stretch of a few px only."""
    rng, reach, folds = np.random.default_rng(7), 700.0, 0
    radius = np.linspace(0.0, reach, 4001)[1:]
    angle = (
        np.zeros(1)
        if get_model(model).radial
        else np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    )
    rays = np.array([np.cos(angle), np.sin(angle)])
    points = (rays[:, :, None] * radius).reshape(2, -1)
    for _ in range(30):
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
    assert 1 <= folds < 30


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


def test_unknown_model_is_named():
    with pytest.raises(DistortionError):
        get_model("unheard")
