"""Sums over parts of the frames, on the NumPy path and compiled."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.camera.projection import forward_kernel
from starcal_uq.core.errors import StarcalError
from starcal_uq.likelihood import arrays, paths
from starcal_uq.likelihood.compressed import gram_sums
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.likelihood.sums import Descent, frame_sums, settled_sums, sum_of
from starcal_uq.maths.linear import scaled_cholesky, scaled_inverse
from tests.helpers.outside import campaign
from tests.helpers.scenes import camera, observations, with_sigmas

needs_numba = pytest.mark.skipif(
    importlib.util.find_spec("numba") is None, reason="Numba is not installed"
)


def _scaled(matrix, reference):
    scale = np.sqrt(np.diag(reference))
    return matrix / np.outer(scale, scale)


def test_parts_add_up_wherever_they_are_cut():
    likelihood = MarginalLikelihood(with_sigmas(observations(n_frames=60)), "brown")
    frames, theta = likelihood.frames, camera().theta
    whole, attitudes = settled_sums(frames, "brown", theta, likelihood.start_rotations(theta))
    whitening = np.diag(1.0 / np.sqrt(np.diag(whole.matrix)))
    gram = gram_sums(frames, "brown", theta, whitening, (whole, attitudes))
    cuts = [(0, 1), (1, 27), (27, 60)]
    parts = [
        frame_sums(frames.part(a, b), "brown", theta, attitudes.rotations[a:b])[0] for a, b in cuts
    ]
    grams = [
        gram_sums(
            frames.part(a, b),
            "brown",
            theta,
            whitening,
            settled_sums(frames.part(a, b), "brown", theta, attitudes.rotations[a:b]),
        )
        for a, b in cuts
    ]
    total = sum_of(parts)
    assert total.cost == pytest.approx(whole.cost, rel=1e-12)
    assert total.turn == max(part.turn for part in parts) > min(part.turn for part in parts)
    assert np.allclose(
        _scaled(total.matrix, whole.matrix), _scaled(whole.matrix, whole.matrix), rtol=0, atol=1e-12
    )
    assert (total.n_stars, total.n_frames) == (frames.n_stars, 60)
    added = grams[0] + grams[1] + grams[2]
    assert (added.n_stars, added.n_frames) == (frames.n_stars, 60)
    assert np.allclose(
        _scaled(added.gram, gram.gram), _scaled(gram.gram, gram.gram), rtol=0, atol=1e-9
    )
    size = np.abs(gram.gram).max()
    assert np.allclose(added.gram, gram.gram, rtol=0, atol=1e-14 * size)
    assert added.log_determinant == pytest.approx(gram.log_determinant, rel=1e-12)


def test_blocks_of_any_size_give_the_same_sums_and_residuals(monkeypatch):
    likelihood = MarginalLikelihood(with_sigmas(observations(n_frames=12)), "brown")
    frames, theta = likelihood.frames, camera().theta
    rotations = likelihood.start_rotations(theta)
    both = []
    for block in (3000, 40):
        monkeypatch.setattr(arrays, "BLOCK_STARS", block)
        residuals = likelihood.residuals(theta, rotations)
        both.append((*frame_sums(frames, "brown", theta, rotations), residuals))
    assert len(frames.parts(40)) > 2
    (whole, attitudes, left), (cut, others, same) = both
    assert cut.cost == pytest.approx(whole.cost, rel=1e-12)
    assert np.allclose(
        _scaled(cut.matrix, whole.matrix), _scaled(whole.matrix, whole.matrix), rtol=0, atol=1e-12
    )
    assert np.allclose(others.shift, attitudes.shift, rtol=0, atol=1e-15)
    assert np.array_equal(same, left)
    b = frames.rotated(rotations)
    (xy,) = forward_kernel("brown", "value")(frames.n_stars, theta, b, np.zeros(2))
    assert np.allclose(left, (frames.pixel - xy) * frames.weight, rtol=0, atol=1e-9)


@pytest.mark.parametrize("field_deg", [0.5, 10.0])
def test_sums_of_single_frames_keep_their_digits_in_a_narrow_field(field_deg):
    c = campaign(np.random.default_rng(1), n_frames=6, stars_per_frame=9, field_deg=field_deg)
    likelihood = MarginalLikelihood(with_sigmas(sc.Observations(**c.columns)), "brown")
    frames = likelihood.frames
    _, attitudes = settled_sums(frames, "brown", c.theta, likelihood.start_rotations(c.theta))
    gram, volume, found = likelihood.frame_normals(c.theta, attitudes.rotations)
    b = frames.rotated(attitudes.rotations)
    xy, h, a = forward_kernel("brown", "first")(frames.n_stars, c.theta, b, np.zeros(2))
    e = (frames.pixel - xy)[None]
    own = np.empty_like(gram)
    for k, (first, last) in enumerate(zip(frames.starts[:-1], frames.starts[1:], strict=True)):
        rows = [
            (array[..., first:last] * frames.weight[first:last]).reshape(len(array), -1).T
            for array in (a, h, e)
        ]
        # Without differences of large numbers: what the orthogonal columns of the attitude leave.
        q, r = np.linalg.qr(rows[0])
        left = np.hstack(rows[1:]) - q @ (q.T @ np.hstack(rows[1:]))
        own[k] = left.T @ left
        assert volume[k] == pytest.approx(2.0 * np.sum(np.log(np.abs(np.diag(r)))), rel=1e-9)
    size = np.sqrt(np.einsum("kii->ki", own))
    assert np.max(np.abs(gram - own) / (size[:, :, None] * size[:, None])) < 1e-7
    assert np.max(np.abs(found - attitudes.rotations)) < 1e-9


def test_a_model_that_is_not_finite_costs_infinitely_much():
    likelihood = MarginalLikelihood(observations(n_frames=5), "brown")
    theta = np.array(camera().theta)
    rotations = likelihood.start_rotations(theta)
    theta[2] = np.nan
    assert frame_sums(likelihood.frames, "brown", theta, rotations)[0].normal.cost == np.inf


def test_attitudes_follow_the_parameters_in_one_pass():
    likelihood = MarginalLikelihood(observations(n_frames=40), "brown")
    frames, theta = likelihood.frames, np.array(camera().theta)
    descent = Descent(frames, "brown", likelihood.start_rotations(theta))
    first = descent.evaluate(theta)
    sigma = (
        np.sqrt(np.diag(np.linalg.inv(_scaled(first.matrix, first.matrix))))
        / np.sqrt(np.diag(first.matrix))
        * 0.05
    )
    moved = theta + 3.0 * sigma
    followed, exact = descent.evaluate(moved), likelihood.evaluate(moved)
    # The best point is the best, whichever came first.
    back = Descent(frames, "brown", likelihood.start_rotations(theta))
    costs = {cost: point for point in (moved, theta) for cost in [back.evaluate(point).cost]}
    for found in (back, descent):
        assert np.array_equal(found.best[1].theta, costs[min(costs)])
    assert followed.cost == pytest.approx(exact.cost, rel=1e-9)
    # Attitudes that stay where they were are far from the best: what the sums say is then no
    # evaluation of the model.
    stayed = likelihood.frames.pixel - _predicted(frames, moved, descent.best[1].rotations)
    left = likelihood.frames.pixel - _predicted(
        frames, moved, likelihood.profile(moved)[0].rotations
    )
    assert np.sum(stayed**2) > 1.01 * np.sum(left**2)


def _predicted(frames, theta, rotations):
    from starcal_uq.camera.projection import forward_kernel

    return forward_kernel("brown", "value")(
        frames.n_stars, theta, frames.rotated(rotations), np.zeros(2)
    )[0]


def test_switch_of_the_kernels(monkeypatch):
    monkeypatch.setenv(paths.SWITCH, "auto")
    # The size decides, and nothing that was compiled before.
    monkeypatch.setattr(paths, "installed", lambda: True)
    assert paths.chosen(paths.WORTH_LOADING - 1) == "numpy"
    assert paths.chosen(paths.WORTH_LOADING) == "numba"
    monkeypatch.setenv(paths.SWITCH, "numpy")
    assert paths.chosen(10**9) == "numpy"
    with pytest.raises(StarcalError, match="auto, numpy, numba"):
        paths.use("fortran")
    monkeypatch.setattr(paths, "installed", lambda: False)
    assert paths.SWITCH == "STARCAL_UQ_KERNELS"
    with pytest.raises(StarcalError, match=r"starcal-uq\[compiled\]"):
        paths.use("numba")


@needs_numba
@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "stated"), [("brown", False), ("brown", True), ("inverse", False), ("none", True)]
)
def test_compiled_loops_equal_numpy(model, stated, monkeypatch):
    obs = observations(model, n_frames=60)
    likelihood = MarginalLikelihood(with_sigmas(obs) if stated else obs, model)
    theta = camera(model).theta
    monkeypatch.setenv(paths.SWITCH, "numpy")
    rotations = likelihood.start_rotations(theta)
    plain, where = frame_sums(likelihood.frames, model, theta, rotations)
    monkeypatch.setenv(paths.SWITCH, "numba")
    fused, there = frame_sums(likelihood.frames, model, theta, rotations)
    assert fused.cost == pytest.approx(plain.cost, rel=1e-12)
    difference = _scaled(fused.matrix - plain.matrix, plain.matrix)
    assert np.max(np.abs(difference)) < 1e-12
    slope = (fused.gradient - plain.gradient) / np.sqrt(np.diag(plain.matrix) * plain.cost)
    assert np.max(np.abs(slope)) < 1e-12
    assert np.allclose(there.shift, where.shift, rtol=0, atol=1e-15)
    # The compiled loops turn to the best attitudes first: 0.2 nrad that are left change a
    # derivative by 5e-12.
    best = settled_sums(likelihood.frames, model, theta, rotations)[1].at(theta)
    _compare_gram(likelihood, model, theta, best, plain.matrix, monkeypatch)
    _compare_slope(likelihood, theta, where, plain.matrix, monkeypatch)
    _compare_pairs(likelihood.frames, model, theta, monkeypatch)
    # A theta at which the model is not finite is not finite on either path.
    bad = np.array(theta)
    bad[2] = np.nan
    assert frame_sums(likelihood.frames, model, bad, rotations)[0].normal.cost == np.inf


def _compare_gram(likelihood, model, theta, rotations, matrix, monkeypatch):
    whitening = scaled_cholesky(scaled_inverse(matrix))
    both = []
    for path in ("numba", "numpy"):
        monkeypatch.setenv(paths.SWITCH, path)
        known = settled_sums(likelihood.frames, model, theta, rotations)
        both.append(gram_sums(likelihood.frames, model, theta, whitening, known))
    fused, plain = both
    p = len(theta)
    difference = np.abs(_scaled(fused.gram - plain.gram, plain.gram))
    assert np.max(difference[: p + 1, : p + 1]) < 1e-12
    # What the attitudes take off the second derivatives is ten digits of them, and nothing of the
    # likelihood.
    assert np.max(difference) < 1e-8
    assert np.max(np.abs(fused.gram - plain.gram)) < 1e-12 * np.max(plain.gram)
    assert np.allclose(fused.log_determinant_slope, plain.log_determinant_slope, rtol=0, atol=1e-12)
    monkeypatch.setenv(paths.SWITCH, "numba")


def _compare_slope(likelihood, theta, attitudes, matrix, monkeypatch):
    both = []
    for path in ("numba", "numpy"):
        monkeypatch.setenv(paths.SWITCH, path)
        slope = likelihood.slope(theta, 0.7, attitudes)
        both.append((slope / np.sqrt(np.diag(matrix)), likelihood.start_rotations(theta)))
    (fused, turned), (plain, rotations) = both
    # In standard deviations of a unit of noise; terms of some hundreds of them add up.
    assert np.max(np.abs(plain)) > 1e-2
    assert np.allclose(fused, plain, rtol=0, atol=1e-9)
    assert np.allclose(turned, rotations, rtol=0, atol=1e-13)
    monkeypatch.setenv(paths.SWITCH, "numba")


def _compare_pairs(frames, model, theta, monkeypatch):
    both = []
    for path in ("numba", "numpy"):
        monkeypatch.setenv(paths.SWITCH, path)
        objective = PairObjective(frames, model)
        both.append((objective.evaluate(theta), objective.godambe(theta), objective.rotations))
        # Pixels beyond the fold of a strong distortion have no direction.
        folded = np.concatenate([theta[:3], np.full(len(theta) - 3, -4e-6)])
        assert np.isfinite(objective.evaluate(folded).cost) == (
            len(theta) == 3 or model == "inverse"
        )
    (fused, fused_covariance, turned), (plain, covariance, rotations) = both
    assert np.allclose(turned, rotations, rtol=0, atol=1e-13)
    # The matrix is what a common turn leaves of ten thousand times as much: neither path knows its
    # twelfth digit.
    assert fused.cost == pytest.approx(plain.cost, rel=1e-11)
    assert np.max(np.abs(_scaled(fused.matrix - plain.matrix, plain.matrix))) < 1e-10
    assert np.max(np.abs(_scaled(fused_covariance - covariance, covariance))) < 1e-7
    monkeypatch.setenv(paths.SWITCH, "numba")


@needs_numba
@pytest.mark.slow
def test_machine_code_is_kept_for_other_processes_and_not_needed(tmp_path, monkeypatch):
    script = (
        "import numpy as np\n"
        "from starcal_uq.likelihood.loops import attitudes\n"
        "from starcal_uq.observations.frames import StarFrames\n"
        "r = np.array([[0.1, 0.0], [0.0, 0.1], [0.995, 0.995]])\n"
        "r /= np.linalg.norm(r, axis=0)\n"
        "frames = StarFrames(500.0 * r[:2] / r[2], r, None, np.array([0, 2]))\n"
        "turn = attitudes(frames, 'none', np.array([0.0, 0.0, 500.0]))\n"
        "print(round(turn[0].trace(), 9))\n"
    )

    def run(folder):
        environment = {
            "NUMBA_CACHE_DIR": str(folder),
            "PATH": "",
            "HOME": str(tmp_path),
            "PYTHONPATH": sys.path[0],
        }
        done = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == ["3.0"]

    run(tmp_path / "cache")
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.nbc")}
    # A loop, and the kernel of the model.
    assert len(kept) == 2
    run(tmp_path / "cache")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.nbc")} == kept
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    run(blocked)


@needs_numba
def test_loops_are_compiled_for_the_process_where_nothing_can_be_kept(monkeypatch):
    from numba.core import caching

    from starcal_uq.likelihood.loops.common import compiled

    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    assert compiled(entry=True)(lambda x: x + 1.0)(2.0) == 3.0
