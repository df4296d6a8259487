"""Heads against simulations that are made here, with NumPy and SciPy's rotations alone."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import starcal_uq as sc
from starcal_uq.core.errors import HeadError

ARCSEC = 648_000.0 / np.pi
K = 6_000
# Two standard errors of a squared error per degree of freedom are 0.02: half of what is allowed.
NEES = 0.05
# Boresights along body Z and along body X.
MOUNTINGS = np.stack([np.eye(3), Rotation.from_euler("y", 90.0, degrees=True).as_matrix()])


def noise(scale: float, tilt: float = 0.3) -> np.ndarray:
    """Covariance of a head, rad^2: the turn about the boresight is known worst, and leans on X."""
    root = scale / ARCSEC * np.diag([1.0, 1.5, 9.0])
    root[2, 0] = tilt * scale / ARCSEC * 9.0
    return np.asarray(root @ root.T)


COVARIANCES = np.stack([noise(1.0), noise(3.0)])


def measured(
    mountings: np.ndarray, covariances: np.ndarray, seed: int, size: int = K
) -> tuple[Rotation, np.ndarray]:
    """Attitudes of the body, and quaternions (H, K, 4) of heads with errors about their axes."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(size, random_state=seed)
    found = []
    for mounting, covariance in zip(mountings, covariances, strict=True):
        error = rng.standard_normal((size, 3)) @ np.linalg.cholesky(covariance).T
        found.append(Rotation.from_rotvec(error) * Rotation.from_matrix(mounting.T) * truth)
    return truth, np.stack([one.as_quat() for one in found])


def nees(fused: sc.attitude.FusedAttitudes, truth: Rotation) -> float:
    """Mean squared error in the stated covariance, per degree of freedom."""
    error = (Rotation.from_quat(fused.quaternions) * truth.inv()).as_rotvec()
    square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(fused.covariance), error)
    return float(square.mean() / 3.0)


@pytest.fixture(scope="module")
def pair() -> sc.attitude.HeadArray:
    return sc.attitude.HeadArray(("A", "B"), MOUNTINGS)


def test_fused_error_is_as_large_as_stated(pair):
    truth, q = measured(MOUNTINGS, COVARIANCES, seed=1)
    fused = pair.fuse(q, COVARIANCES[:, None])
    assert nees(fused, truth) == pytest.approx(1.0, abs=NEES)
    assert fused.test.ratio == pytest.approx(1.0, abs=NEES)
    assert fused.test.p_value > 0.01
    inverses = np.linalg.inv(COVARIANCES)
    expected = np.linalg.inv(np.einsum("hij,hjk,hlk->il", MOUNTINGS, inverses, MOUNTINGS))
    np.testing.assert_allclose(fused.covariance, np.tile(expected, (K, 1, 1)), rtol=1e-9)
    # The second head knows the turn about the first one's boresight, and that is the gain.
    alone = ARCSEC * np.sqrt(np.diag(COVARIANCES[0]))
    assert fused.sigma_arcsec[2] < 0.7 * alone[2]


@pytest.mark.parametrize(
    "wrong", [COVARIANCES[::-1], COVARIANCES * np.array([1.0, 0.25])[:, None, None]]
)
def test_wrong_weights_are_found(pair, wrong):
    """Swapped covariances, and those of a head that claims half of its noise."""
    truth, q = measured(MOUNTINGS, COVARIANCES, seed=2)
    right, fused = pair.fuse(q, COVARIANCES[:, None]), pair.fuse(q, wrong[:, None])
    assert abs(nees(fused, truth) - 1.0) > 3.0 * NEES
    assert fused.test.p_value < 1e-6
    error = [
        np.sum((Rotation.from_quat(one.quaternions) * truth.inv()).as_rotvec() ** 2)
        for one in (right, fused)
    ]
    assert error[1] > error[0]


def test_gains_carry_errors_of_heads_into_the_fused_attitude(pair):
    """Weights of one covariance, errors of another: the budget of a wrong weighting."""
    wrong = COVARIANCES[::-1]
    truth, q = measured(MOUNTINGS, COVARIANCES, seed=3)
    fused = pair.fuse(q, wrong[:, None])
    error = (Rotation.from_quat(fused.quaternions) * truth.inv()).as_rotvec()
    gains, _ = pair.gains(wrong)
    expected = sum(gain @ own @ gain.T for gain, own in zip(gains, COVARIANCES, strict=True))
    found = error.T @ error / K
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale),
                               atol=0.06)  # fmt: skip
    # What turns all heads alike turns the body as much.
    sums = (gains @ np.swapaxes(MOUNTINGS, 1, 2)).sum(axis=0)
    np.testing.assert_allclose(sums, np.eye(3), atol=1e-12)


def test_heads_that_see_nothing_have_no_weight(pair):
    truth, q = measured(MOUNTINGS, COVARIANCES, seed=4)
    q[0, : K // 2] = np.nan
    q[1, K // 2 :] = np.nan
    fused = pair.fuse(q, COVARIANCES[:, None])
    assert nees(fused, truth) == pytest.approx(1.0, abs=NEES)
    assert set(fused.heads) == {1}
    assert np.isnan(fused.test.ratio)
    assert np.isnan(fused.test.p_value)
    q[:, 7] = np.nan
    with pytest.raises(HeadError, match="frame 7 has an attitude of no head"):
        pair.fuse(q, COVARIANCES[:, None])


def test_geometry_is_that_of_each_axis(pair):
    """Heads at right angles: the turn about a boresight is that of the other head."""
    across, about = 1.0, 12.0
    noise = np.diag(np.array([across, across, about]) / ARCSEC) ** 2
    table = pair.geometry(noise)
    both = (across**-2.0 + about**-2.0) ** -0.5
    assert table["heads"].tolist() == ["A", "B", "A + B"]
    found = table.set_index("heads")[["x_arcsec", "y_arcsec", "z_arcsec"]]
    np.testing.assert_allclose(found.loc["A"], [across, across, about])
    np.testing.assert_allclose(found.loc["B"], [about, across, across])
    np.testing.assert_allclose(found.loc["A + B"], [both, across / np.sqrt(2.0), both])
    three = sc.attitude.HeadArray(("A", "B", "C"), MOUNTINGS[[0, 1, 0]]).geometry(noise)
    assert len(three) == 7
    assert three["heads"].iloc[-1] == "A + B + C"


def test_far_attitudes_meet_in_the_middle():
    """Two equal heads, three degrees apart: the mean is the middle of the turn between them."""
    turn = Rotation.from_rotvec(np.radians([[1.0, 2.0, -2.0]]))
    start = Rotation.random(1, random_state=5)
    pair = sc.attitude.HeadArray(("A", "B"), np.stack([np.eye(3)] * 2))
    q = np.stack([start.as_quat(), (turn * start).as_quat()])
    fused = pair.fuse(q, np.eye(3)[None, None] * 1e-10)
    middle = Rotation.from_rotvec(0.5 * turn.as_rotvec()) * start
    apart = (Rotation.from_quat(fused.quaternions) * middle.inv()).magnitude()
    assert apart.max() < 1e-12


def test_wrong_arrays_are_refused(pair):
    _, q = measured(MOUNTINGS, COVARIANCES, seed=6, size=3)
    for given, words in (
        ((q[:1], COVARIANCES[:, None]), r"give \(heads, frames, 4\), with 2 heads"),
        ((q, COVARIANCES[:, 0]), "covariances have shape"),
        ((q, np.zeros((2, 1, 3, 3))), "not positive"),
    ):
        with pytest.raises(HeadError, match=words):
            pair.fuse(*given)


FILE = """
[[head]]
name = "A"
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
run = "first"

[[head]]
name = "B"
rotation = [0.0, 1.0, 0.0, 1.0]
"""


def test_mountings_are_read(tmp_path: Path):
    path = tmp_path / "heads.toml"
    path.write_text(FILE)
    heads = sc.attitude.load_heads(path)
    assert heads.names == ("A", "B")
    assert heads.runs == (str(tmp_path / "first"), "")
    np.testing.assert_allclose(heads.R_body_head, MOUNTINGS, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no head"),
        ("head = 3", "holds no head"),
        ("head = [3]", r"\[\[head\]\] 1: is no table"),
        ('[[head]]\nname = "A"', "key rotation is missing"),
        ('[[head]]\nname = "A"\nrotation = [1.0, 2.0]', r"no rotation; .* \(v_body = R v_head\)"),
        (FILE.replace("[1.0, 0.0, 0.0]", "[-1.0, 0.0, 0.0]"), "key rotation mirrors"),
        (FILE.replace('"B"', '"A"'), "give each a name of its own"),
        (FILE.replace("run =", "folder ="), "key folder is unknown"),
    ],
)
def test_wrong_files_are_one_sentence(tmp_path: Path, text: str, words: str):
    path = tmp_path / "heads.toml"
    path.write_text(text)
    with pytest.raises(HeadError, match=words):
        sc.attitude.load_heads(path)
