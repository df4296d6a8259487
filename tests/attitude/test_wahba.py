"""QUEST against SciPy, against Davenport's eigenvalue solution, and against its own statistics."""

from itertools import pairwise

import numpy as np
import pytest

from starcal_uq.attitude.rotations import (
    exp_rotation,
    left_error,
    random_rotations,
    rotation_to_quaternion,
    rotation_vector,
)
from starcal_uq.attitude.wahba import DegenerateFrameError, quest
from tests.attitude.test_rotations import half_turns
from tests.helpers.speed import times_as_long

stats = pytest.importorskip("scipy.stats")
Rotation = pytest.importorskip("scipy.spatial.transform").Rotation


def directions(n: int, field_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors uniform over a square field about +Z."""
    half = np.tan(np.radians(0.5 * field_deg))
    b = np.concatenate((rng.uniform(-half, half, (n, 2)), np.ones((n, 1))), axis=1)
    return b / np.linalg.norm(b, axis=1, keepdims=True)


def perturbed(b: np.ndarray, sigma_rad: np.ndarray | float, rng: np.random.Generator) -> np.ndarray:
    """Directions with Gaussian noise of sigma_rad per axis of the tangent plane."""
    noise = rng.standard_normal(b.shape) * np.asarray(sigma_rad)[..., None]
    noisy = b + noise - b * np.sum(noise * b, axis=-1, keepdims=True)
    return noisy / np.linalg.norm(noisy, axis=-1, keepdims=True)


def frames(
    counts: list[int],
    field_deg: float,
    sigma_rad: float,
    seed: int,
    rotations: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    starts = np.concatenate(([0], np.cumsum(counts)))
    rotations = random_rotations(len(counts), rng) if rotations is None else rotations
    b = directions(int(starts[-1]), field_deg, rng)
    r = np.einsum("nji,nj->ni", np.repeat(rotations, counts, axis=0), b)
    return perturbed(b, np.full(len(b), sigma_rad), rng), r, starts, rotations


def davenport(
    b: np.ndarray, r: np.ndarray, starts: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvector of the largest eigenvalue of K, frame by frame."""
    quaternions, values = [], []
    for i, j in pairwise(starts):
        B = np.einsum("n,ni,nj->ij", w[i:j] / w[i:j].sum(), b[i:j], r[i:j])
        z = [[B[2, 1] - B[1, 2]], [B[0, 2] - B[2, 0]], [B[1, 0] - B[0, 1]]]
        K = np.block(
            [[B + B.T - np.trace(B) * np.eye(3), np.array(z)], [np.array(z).T, np.trace(B)]]
        )
        value, vector = np.linalg.eigh(K)
        quaternions.append(vector[:, -1])
        values.append(value[-1])
    return np.array(quaternions), np.array(values)


@pytest.mark.parametrize(
    ("field_deg", "tolerance_rad"),
    # A relative error of 1e-16 in K turns the frame by about 1e-16 / (mean squared field angle):
    # below 10 degrees the eigenvalue solution itself is not good to 1e-12.
    [(1.0, 1e-10), (10.0, 1e-12), (20.0, 2e-13), (100.0, 1e-14)],
)
@pytest.mark.parametrize("sigma_rad", [0.0, 1e-5, 1e-3])
def test_agrees_with_davenport(field_deg: float, tolerance_rad: float, sigma_rad: float) -> None:
    counts = list(np.random.default_rng(1).integers(5, 30, 400))
    b, r, starts, _ = frames(counts, field_deg, sigma_rad, seed=2)
    w = np.random.default_rng(3).uniform(0.5, 2.0, len(b))
    result = quest(b, r, starts, w)
    quaternions, lambda_max = davenport(b, r, starts, w)
    assert np.abs(left_error(result.quaternions, quaternions)).max() < tolerance_rad
    np.testing.assert_allclose(result.lambda_max, lambda_max, rtol=0, atol=4e-15)


def test_agrees_with_davenport_for_large_residuals() -> None:
    rng = np.random.default_rng(8)
    starts = np.arange(0, 6001, 6)
    b, r = rng.standard_normal((2, 6000, 3))
    b, r = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (b, r))
    result = quest(b, r, starts)
    quaternions, lambda_max = davenport(b, r, starts, np.ones(6000))
    np.testing.assert_allclose(result.lambda_max, lambda_max, rtol=1e-13)
    # Unrelated directions sometimes leave two attitudes almost equally good.
    assert (
        np.max(np.abs(left_error(result.quaternions, quaternions)) * result.observability[:, None])
        < 1e-14
    )
    np.testing.assert_allclose(result.loss, quest(b, r, starts, sigma_rad=1.0).loss, rtol=1e-12)


@pytest.mark.parametrize("sigma_rad", [0.0, 1e-5])
def test_agrees_with_scipy_also_at_half_turns(sigma_rad: float) -> None:
    rng = np.random.default_rng(5)
    rotations = np.concatenate((half_turns(), random_rotations(100, rng)))
    rotations = np.concatenate(
        (rotations, exp_rotation(1e-9 * rng.standard_normal(rotations.shape[:2])) @ rotations)
    )
    b, r, starts, _ = frames([12] * len(rotations), 15.0, sigma_rad, seed=6, rotations=rotations)
    w = rng.uniform(0.1, 3.0, len(b))
    result = quest(b, r, starts, w)
    for k, (i, j) in enumerate(pairwise(starts)):
        expected, _ = Rotation.align_vectors(b[i:j], r[i:j], weights=w[i:j])
        assert np.abs(rotation_vector(result.rotations[k] @ expected.as_matrix().T)).max() < 1e-12
    if sigma_rad == 0.0:
        np.testing.assert_allclose(result.rotations, rotations, atol=1e-12)


def test_draws_give_the_same_as_one_call_each(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = list(np.random.default_rng(1).integers(2, 30, 60))
    b, r, starts, _ = frames(counts, 10.0, 1e-5, seed=7)
    draws = np.stack([perturbed(b, 1e-5, np.random.default_rng(s)) for s in range(5)])
    sigma = np.random.default_rng(2).uniform(1e-5, 2e-5, len(b))
    single = [quest(d, r, starts, sigma_rad=sigma) for d in draws]
    for block in (1, 100, 300, 10**6):
        monkeypatch.setattr("starcal_uq.attitude.wahba._BLOCK", block)
        for references in (r, np.broadcast_to(r, draws.shape)):
            batch = quest(draws, references, starts, sigma_rad=sigma)
            assert batch.rotations.shape == (5, 60, 3, 3)
            for field in (
                "quaternions",
                "lambda_max",
                "loss",
                "observability",
                "ok",
                "covariance",
                "taste",
            ):
                np.testing.assert_allclose(
                    getattr(batch, field),
                    np.stack([getattr(s, field) for s in single]),
                    rtol=1e-12,
                    err_msg=field,
                )


def test_weights_and_sigmas_are_two_names_of_one_thing() -> None:
    b, r, starts, _ = frames([9] * 20, 10.0, 1e-5, seed=9)
    sigma = np.random.default_rng(2).uniform(1e-5, 2e-5, len(b))
    by_sigma, by_weight = quest(b, r, starts, sigma_rad=sigma), quest(b, r, starts, sigma**-2.0)
    np.testing.assert_array_equal(by_sigma.quaternions, by_weight.quaternions)
    np.testing.assert_array_equal(by_sigma.covariance, by_weight.covariance)
    plain = quest(b, r, starts)
    np.testing.assert_allclose(
        plain.covariance * 1e-10, quest(b, r, starts, sigma_rad=1e-5).covariance, rtol=1e-12
    )
    i, j = starts[3], starts[4]
    information = np.sum(
        (np.eye(3) - b[i:j, :, None] * b[i:j, None, :]) * sigma[i:j, None, None] ** -2.0, axis=0
    )
    np.testing.assert_allclose(by_sigma.covariance[3] @ information, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(
        plain.loss, 0.5e-10 * quest(b, r, starts, sigma_rad=1e-5).taste / 9, rtol=1e-4
    )
    # Where 1 - lambda is rounding, the residuals still tell.
    b, r, starts, _ = frames([9] * 20, 10.0, 1e-9, seed=9)
    fine = quest(b, r, starts, sigma_rad=1e-9)
    residuals = b - np.einsum("nij,nj->ni", np.repeat(fine.rotations, 9, axis=0), r)
    np.testing.assert_allclose(
        fine.loss, 0.5 * np.sum(residuals.reshape(20, -1) ** 2, axis=1) / 9, rtol=1e-5
    )


def whitened_excess(errors: np.ndarray, covariance: np.ndarray) -> float:
    """Largest deviation of the sample covariance from the predicted one, in standard errors."""
    z = errors @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    sample = z.T @ z / len(z)
    return float(np.max(np.abs(sample - np.eye(3)) / np.sqrt((1.0 + np.eye(3)) / len(z))))


@pytest.mark.parametrize("count", [2, 3, 12])
def test_covariance_is_that_of_the_errors(count: int) -> None:
    b, r, starts, truth = frames([count], 12.0, 0.0, seed=11)
    sigma = np.random.default_rng(12).uniform(0.5e-5, 2e-5, count)
    noisy = perturbed(np.broadcast_to(b, (20_000, *b.shape)), sigma, np.random.default_rng(13))
    result = quest(noisy, r, starts, sigma_rad=sigma)
    errors = left_error(result.quaternions, rotation_to_quaternion(truth))[:, 0]
    covariance = result.covariance.mean(axis=0)[0]
    assert whitened_excess(errors, covariance) < 4.5
    # Controls: sigmas 5 % wrong; covariance of the right error, i.e. in the wrong frame.
    assert whitened_excess(errors, covariance / 1.05**2) > 7.0
    assert whitened_excess(errors, truth[0].T @ covariance @ truth[0]) > 30.0


def test_taste_is_chi_square() -> None:
    counts = list(np.random.default_rng(1).integers(2, 20, 4000))
    b, r, starts, _ = frames(counts, 12.0, 0.0, seed=14)
    sigma = np.random.default_rng(15).uniform(0.5e-5, 2e-5, len(b))
    result = quest(perturbed(b, sigma, np.random.default_rng(16)), r, starts, sigma_rad=sigma)
    np.testing.assert_array_equal(result.dof, 2 * np.array(counts) - 3)
    assert stats.kstest(stats.chi2.cdf(result.taste, result.dof), "uniform").pvalue > 1e-3
    # Controls: a frame has 2m-3 independent numbers, not 2m; sigmas 5 % wrong.
    assert stats.kstest(stats.chi2.cdf(result.taste, 2 * np.array(counts)), "uniform").pvalue < 1e-9
    assert stats.kstest(stats.chi2.cdf(result.taste * 1.05**2, result.dof), "uniform").pvalue < 1e-9


def test_taste_shows_a_wrong_identification() -> None:
    b, r, starts, _ = frames([12] * 50, 12.0, 1e-5, seed=17)
    r[12 * 7 + 3] = r[12 * 7 + 4]
    taste = quest(b, r, starts, sigma_rad=1e-5).taste
    assert np.flatnonzero(taste > 100.0).tolist() == [7]


@pytest.mark.parametrize("scene", ["two stars", "stars on a line", "cluster off the axis"])
def test_nearly_collinear_stars_have_an_honest_covariance(scene: str) -> None:
    """Ill-conditioned, not degenerate."""
    rng = np.random.default_rng(24)
    along, across = {
        "two stars": (np.array([0.0, 2e-4]), np.array([0.0, 1e-4])),
        "stars on a line": (np.linspace(-0.1, 0.1, 9), 1e-6 * rng.standard_normal(9)),
        "cluster off the axis": (
            0.09 + 1e-4 * rng.standard_normal(6),
            0.08 + 1e-4 * rng.standard_normal(6),
        ),
    }[scene]
    b = np.column_stack((along, across, np.ones_like(along)))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    rotation = random_rotations(1, rng)[0]
    sigma = 1e-7
    noisy = perturbed(np.broadcast_to(b, (20_000, *b.shape)), np.full(len(b), sigma), rng)
    result = quest(noisy, b @ rotation, np.array([0, len(b)]), sigma_rad=sigma)
    assert result.ok.all()
    errors = left_error(result.quaternions, rotation_to_quaternion(rotation))[:, 0]
    covariance = np.linalg.inv(np.sum(np.eye(3) - b[:, :, None] * b[:, None, :], axis=0) / sigma**2)
    assert whitened_excess(errors, covariance) < 4.5
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    np.testing.assert_allclose(root @ result.covariance[0, 0] @ root.T, np.eye(3), atol=0.05)
    # Control: the covariance of a sound frame of as many stars is wrong by far.
    sound = directions(len(b), 12.0, rng)
    other = np.linalg.inv(
        np.sum(np.eye(3) - sound[:, :, None] * sound[:, None, :], axis=0) / sigma**2
    )
    assert whitened_excess(errors, other) > 30.0


def degenerate_frames() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sound, one star, coinciding stars, opposite stars, NaN, sound."""
    b, r, starts, _ = frames([5, 1, 3, 2, 4, 5], 12.0, 1e-5, seed=18)
    for v in (b, r):
        v[6:9] = v[6]
        v[10] = -v[9]
    b[12, 1] = np.nan
    return b, r, starts


def test_degenerate_frames_raise() -> None:
    b, r, starts = degenerate_frames()
    with pytest.raises(DegenerateFrameError) as caught:
        quest(b, r, starts)
    assert caught.value.frames.tolist() == [1, 2, 3, 4]
    with pytest.raises(DegenerateFrameError):
        quest(b[:1], r[:1], np.array([0, 1]))


def test_degenerate_frames_are_flagged() -> None:
    b, r, starts = degenerate_frames()
    result = quest(b, r, starts, sigma_rad=1e-5, on_degenerate="flag")
    assert result.ok.tolist() == [True, False, False, False, False, True]
    for array in (result.quaternions, result.covariance, result.taste, result.rotations):
        assert np.isnan(array[1:5]).all()
        assert np.isfinite(array[[0, 5]]).all()
    alone = quest(b[:5], r[:5], np.array([0, 5]))
    np.testing.assert_allclose(result.quaternions[0], alone.quaternions[0], atol=1e-13)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-15, 1e-8])
def test_coinciding_stars_never_pass_unnoticed(angle_rad: float) -> None:
    rng = np.random.default_rng(19)
    centre = rng.standard_normal((500, 1, 3))
    b = centre / np.linalg.norm(centre, axis=-1, keepdims=True) + angle_rad * rng.standard_normal(
        (500, 4, 3)
    )
    b = (b / np.linalg.norm(b, axis=-1, keepdims=True)).reshape(-1, 3)
    rotation = random_rotations(1, rng)[0]
    result = quest(b, b @ rotation, np.arange(0, 2001, 4), on_degenerate="flag")
    assert not result.ok.any()


def test_mirrored_field_is_not_solved_silently() -> None:
    b, r, starts, _ = frames([12] * 30, 12.0, 0.0, seed=20)
    result = quest(b * np.array([1.0, -1.0, 1.0]), r, starts, sigma_rad=1e-5)
    assert (result.taste > 1e5).all()


def test_wrong_arguments_are_named() -> None:
    b, r, starts, _ = frames([5, 5], 12.0, 1e-5, seed=21)
    for arguments, keywords, message in (
        ((b[:, :2], r, starts), {}, "b has shape"),
        ((b, r[:4], starts), {}, "r has shape"),
        ((b, r, [0, 5]), {}, "starts must be"),
        ((b, r, [0, 5, 5, 10]), {}, "frame number 1 has no stars"),
        ((b * (1.0 + 0.7e-6), r, starts), {}, "unit vectors"),
        ((b, r, starts, np.ones(3)), {}, "weights has shape"),
        ((b, r, starts, np.zeros(10)), {}, "weights must be finite and positive"),
        ((b, r, starts), {"sigma_rad": -1.0}, "sigma_rad must be finite and positive"),
        ((b, r, starts, np.ones(10)), {"sigma_rad": 1.0}, "not both"),
    ):
        with pytest.raises(ValueError, match=message):
            quest(*arguments, **keywords)


def test_takes_a_fraction_of_as_many_decompositions() -> None:
    """A quarter of what NumPy takes to decompose as many 3 x 3 matrices."""
    b, r, starts, _ = frames([12] * 20_000, 12.0, 1e-5, seed=22)
    matrices = np.random.default_rng(0).random((20_000, 3, 3))
    assert (
        times_as_long(
            lambda: quest(b, r, starts, covariance=False), lambda: np.linalg.svd(matrices)
        )
        < 0.6
    )
