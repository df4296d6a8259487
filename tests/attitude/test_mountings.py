"""Mountings and their drift, against heads that are simulated here with NumPy and SciPy alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import starcal_uq as sc
from starcal_uq.attitude.mountings import misalignments
from starcal_uq.core.errors import HeadError

ARCSEC = 648_000.0 / np.pi
FRAMES, CAMPAIGNS = 40, 120
NOMINAL = np.stack([
    np.eye(3),
    Rotation.from_euler("y", 90.0, degrees=True).as_matrix(),
    Rotation.from_euler("xz", [50.0, 20.0], degrees=True).as_matrix(),
])  # fmt: skip
# Turns of the mountings about the body at 20 degC, and per degree; the first head defines them.
TRUE = np.array([[0.0, 0.0, 0.0], [900.0, -400.0, 250.0], [-60.0, 300.0, 1200.0]])
DRIFT = np.array([[0.0, 0.0, 0.0], [1.5, -0.5, 0.0], [0.0, 0.8, -2.0]])
SIGMA = np.array([[1.0, 1.0, 8.0], [2.0, 2.0, 15.0], [1.5, 1.0, 9.0]])
COVARIANCE = np.stack([np.diag((s / ARCSEC) ** 2) for s in SIGMA])[:, None]
HEADS = sc.attitude.HeadArray(("A", "B", "C"), NOMINAL)


def campaign(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Quaternions (3, K, 4) of heads in common frames, the temperature of each, and the truth."""
    truth = Rotation.random(FRAMES, random_state=int(rng.integers(2**31)))
    warmth = rng.uniform(-10.0, 50.0, FRAMES)
    found = []
    for mounting, turn, drift, sigma in zip(NOMINAL, TRUE, DRIFT, SIGMA, strict=True):
        moved = Rotation.from_rotvec((turn + np.outer(warmth - 20.0, drift)) / ARCSEC)
        noise = Rotation.from_rotvec(rng.standard_normal((FRAMES, 3)) * sigma / ARCSEC)
        found.append((noise * (moved * Rotation.from_matrix(mounting)).inv() * truth).as_quat())
    return np.stack(found), warmth, truth


def errors(found: sc.attitude.Misalignments) -> np.ndarray:
    """Corrections less the truth at the same temperature, and drifts less theirs."""
    wanted = TRUE + (found.temperature_c - 20.0) * DRIFT
    return np.concatenate(
        [(found.correction_arcsec - wanted).ravel(), (found.drift_arcsec_c - DRIFT).ravel()]
    )


def test_mountings_and_drift_are_found_as_well_as_stated():
    rng = np.random.default_rng(11)
    squares, ratios, covered = [], [], []
    free = np.array([3, 4, 5, 6, 7, 8, 12, 13, 14, 15, 16, 17])
    for _ in range(CAMPAIGNS):
        q, warmth, _ = campaign(rng)
        found = misalignments(HEADS, q, COVARIANCE, warmth)
        error = errors(found)
        assert not error[[0, 1, 2, 9, 10, 11]].any()
        inside = found.covariance[np.ix_(free, free)]
        squares.append(error[free] @ np.linalg.solve(inside, error[free]) / len(free))
        covered.append(np.abs(error[free]) < 1.96 * np.sqrt(np.diag(inside)))
        ratios.append(found.test.ratio)
    # Two standard errors of the mean square are 0.075, of a share 0.012.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.075)
    assert np.mean(covered) == pytest.approx(0.95, abs=0.02)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.02)


def test_an_ignored_drift_is_found_and_wrong():
    """The control: mountings that move with temperature, taken as fixed."""
    q, warmth, _ = campaign(np.random.default_rng(12))
    good, bad = misalignments(HEADS, q, COVARIANCE, warmth), misalignments(HEADS, q, COVARIANCE)
    assert good.test.p_value > 0.01
    assert bad.test.p_value < 1e-12
    assert not bad.drift_sigma_arcsec_c.any()
    assert np.isnan(bad.temperature_c)


def test_corrected_mountings_fuse_as_stated():
    """NEES of the fused attitude with mountings of another campaign; the control has the nominal
    ones.
    """
    rng = np.random.default_rng(13)
    many = [campaign(rng) for _ in range(30)]
    q, warmth = np.concatenate([one[0] for one in many], axis=1), np.concatenate([
        one[1] for one in many
    ])  # fmt: skip
    found = misalignments(HEADS, q, COVARIANCE, warmth)
    q, warmth, truth = campaign(rng)
    squares = []
    for k in range(FRAMES):
        fused = found.corrected(warmth[k]).fuse(q[:, k : k + 1], COVARIANCE)
        error = (Rotation.from_quat(fused.quaternions) * truth[k : k + 1].inv()).as_rotvec()[0]
        squares.append(error @ np.linalg.solve(fused.covariance[0], error) / 3.0)
    assert np.mean(squares) == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / (3 * FRAMES)))
    assert HEADS.fuse(q, COVARIANCE).test.p_value < 1e-12
    table = found.to_dataframe()
    assert list(table["head"][::3]) == ["A", "B", "C"]
    assert table["sigma_arcsec"][:3].tolist() == [0.0, 0.0, 0.0]


def test_another_reference_is_the_same_solution():
    """Relative mountings do not depend on which head defines the body."""
    q, warmth, _ = campaign(np.random.default_rng(14))
    one, other = (misalignments(HEADS, q, COVARIANCE, warmth, reference=name) for name in "AC")
    relative = [
        found.corrected(35.0).R_body_head[2].T @ found.corrected(35.0).R_body_head[1]
        for found in (one, other)
    ]
    np.testing.assert_allclose(*relative, atol=0.05 / ARCSEC)
    assert one.test.chi_square == pytest.approx(other.test.chi_square, rel=1e-4)


def test_what_frames_do_not_tell_is_refused():
    q, warmth, _ = campaign(np.random.default_rng(15))
    alone = sc.attitude.HeadArray(("A",), NOMINAL[:1])
    blind = np.where(np.arange(3)[:, None, None] == 2, np.nan, q)
    for given, options, words in (
        ((HEADS, q, COVARIANCE, np.full(FRAMES, 20.0)), {}, "temperature_c never changes"),
        ((HEADS, q, COVARIANCE, warmth[:-1]), {}, "give a number for each of 40 frames"),
        ((HEADS, q, COVARIANCE), {"reference": "D"}, "head 'D' is unknown"),
        ((alone, q[:1], COVARIANCE[:1]), {}, "one head alone"),
        ((HEADS, blind, COVARIANCE, warmth), {}, "too few frames in common"),
    ):
        with pytest.raises(HeadError, match=words):
            misalignments(*given, **options)
