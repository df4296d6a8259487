"""Rotations against SciPy."""

import numpy as np
import pytest

from starcal_uq.attitude import rotations as attitude

Rotation = pytest.importorskip("scipy.spatial.transform").Rotation


def half_turns() -> np.ndarray:
    """Half turns about the axes, about diagonals and about random directions, and the identity."""
    axes = np.concatenate(
        (
            np.eye(3),
            [[1, 1, 0], [0, -1, 1], [1, 1, 1]],
            np.random.default_rng(4).standard_normal((20, 3)),
        )
    )
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate((2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3), np.eye(3)[None]))


def same_quaternion(a: np.ndarray, b: np.ndarray, tolerance: float) -> None:
    difference = np.minimum(np.abs(a - b).max(axis=-1), np.abs(a + b).max(axis=-1))
    assert difference.max() < tolerance


def test_quaternions_agree_with_scipy() -> None:
    rotations = np.concatenate(
        (attitude.random_rotations(500, np.random.default_rng(0)), half_turns())
    )
    quaternions = attitude.rotation_to_quaternion(rotations)
    same_quaternion(quaternions, Rotation.from_matrix(rotations).as_quat(), 1e-14)
    assert (quaternions[:, 3] >= 0.0).all()
    np.testing.assert_allclose(
        attitude.quaternion_to_rotation(-3.0 * quaternions), rotations, atol=1e-14
    )


def test_product_has_the_sense_of_matrices() -> None:
    a, b = attitude.random_rotations(2, np.random.default_rng(1))
    product = attitude.quaternion_multiply(
        attitude.rotation_to_quaternion(a), attitude.rotation_to_quaternion(b)
    )
    np.testing.assert_allclose(attitude.quaternion_to_rotation(product), a @ b, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 0.3, 3.0, np.pi - 1e-9])
def test_exponential_and_logarithm_are_inverse(angle: float) -> None:
    axes = np.random.default_rng(2).standard_normal((50, 3))
    phi = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    rotations = attitude.exp_rotation(phi)
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(attitude.rotation_vector(rotations), phi, rtol=1e-9, atol=1e-15)


def test_half_turns_have_a_logarithm() -> None:
    vectors = attitude.rotation_vector(half_turns()[:-1])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), np.pi, rtol=1e-14)
    np.testing.assert_allclose(attitude.exp_rotation(vectors), half_turns()[:-1], atol=1e-14)


def test_left_error_is_in_the_camera_frame() -> None:
    rng = np.random.default_rng(3)
    reference = attitude.random_rotations(20, rng)
    phi = 1e-5 * rng.standard_normal((7, 20, 3))
    turned = attitude.exp_rotation(phi) @ reference
    found = attitude.left_error(
        attitude.rotation_to_quaternion(turned), attitude.rotation_to_quaternion(reference)
    )
    np.testing.assert_allclose(found, phi, atol=2e-15)


def haar_angle(angle: np.ndarray) -> np.ndarray:
    """Distribution function of the angle of a uniformly random rotation."""
    return (angle - np.sin(angle)) / np.pi


def test_random_rotations_are_proper_and_uniform() -> None:
    from scipy import stats

    rotations = attitude.random_rotations(4000, np.random.default_rng(5))
    products = rotations @ np.swapaxes(rotations, 1, 2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-13)
    # Haar measure: every entry is uniform on [-1, 1], and the angle has density (1 - cos a) / pi.
    for i in range(3):
        for j in range(3):
            assert stats.kstest(rotations[:, i, j], stats.uniform(-1.0, 2.0).cdf).pvalue > 1e-3
    angle = np.linalg.norm(attitude.rotation_vector(rotations), axis=1)
    assert stats.kstest(angle, haar_angle).pvalue > 1e-3
    # Control: a uniform angle about a uniform axis is not Haar measure.
    assert stats.kstest(np.random.default_rng(6).uniform(0, np.pi, 4000), haar_angle).pvalue < 1e-6


@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (attitude.rotation_to_quaternion, (4, 4)),
        (attitude.quaternion_to_rotation, (3,)),
        (attitude.exp_rotation, (2,)),
    ],
)
def test_wrong_shapes_are_named(function, shape) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=r"shape \(\.\.\."):
        function(np.zeros(shape))


def test_zero_quaternion_is_refused() -> None:
    with pytest.raises(ValueError, match="norm zero"):
        attitude.quaternion_to_rotation(np.zeros((2, 4)))
