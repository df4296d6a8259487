"""The recursion: innovations against explicit pairs, recursive against batch, order, noise,
files.
"""

import dataclasses

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.recursive import filter as recursion_module
from starcal_uq.paper.recursive import filter as recursion_sums
from starcal_uq.paper.recursive.filter import FrameSums, Recursion
from starcal_uq.paper.recursive.innovations import PairNormals, frame_normals
from starcal_uq.paper.recursive.start import RecursionOptions
from starcal_uq.paper.recursive.stream import RecursiveCalibration
from tests.helpers.same import assert_same
from tests.helpers.scenes import USUAL, camera, nominal, observations, with_sigmas

SCALES = {
    "f": 1.0,
    "k1": 1e-9,
    "k2": 1e-14,
    "k3": 1e-20,
    "p1": 1e-6,
    "p2": 1e-6,
    "x0": 1.0,
    "y0": 1.0,
}


def scale_of(model):
    return np.array([SCALES[name] for name in camera(model).parameter_names])


def explicit(frame, model, theta):
    """Innovations, H and G of one frame, pair by pair; G per unit of each star's noise."""
    objective = PairObjective(frame, model)
    residual, slopes = objective.residuals(theta)
    b, db = objective.directions(theta, frame)
    first, second = objective.pair_indices()
    by_pixel = np.zeros((len(first), 2 * frame.n_stars))
    noise = np.ones(frame.n_stars) if frame.weight is None else 1.0 / frame.weight
    for row, (i, j) in enumerate(zip(first, second, strict=True)):
        for axis in range(2):
            by_pixel[row, 2 * i + axis] = -db[axis, :, i] @ b[:, j] * noise[i]
            by_pixel[row, 2 * j + axis] = -db[axis, :, j] @ b[:, i] * noise[j]
    return -residual, slopes, by_pixel


def relative(a, b):
    unit = np.sqrt(np.diag(b))
    return np.max(np.abs(a - b) / np.outer(unit, unit))


@pytest.mark.parametrize("model", USUAL)
@pytest.mark.parametrize("stated", [False, True])
def test_innovations_are_generalised_least_squares_over_explicit_pairs(model, stated):
    obs = with_sigmas(observations(model)) if stated else observations(model)
    frames, theta, scale = (
        StarFrames.from_observations(obs),
        camera(model).theta.copy(),
        scale_of(model),
    )
    theta[:3] += [0.4, -0.3, 0.8]
    full = frame_normals(frames, model, theta, scale)
    diagonal = frame_normals(frames, model, theta, scale, "diagonal")
    assert np.array_equal(full.grams, diagonal.grams)
    differs = []
    for k in (0, 7, 31):
        z, slopes, by_pixel = explicit(frames.part(k, k + 1), model, theta)
        columns = np.column_stack([z, slopes * scale])
        covariance = by_pixel @ by_pixel.T
        assert np.linalg.matrix_rank(by_pixel, tol=1e-9 * np.max(np.abs(by_pixel))) == full.pairs[k]
        # The pseudo-inverse of the pairs' whole covariance, which has rank 2 m - 3.
        gls = columns.T @ np.linalg.pinv(covariance, rcond=1e-11) @ columns
        assert relative(full.grams[k], gls) < 1e-6
        smallest = np.linalg.pinv(by_pixel, rcond=1e-9) @ columns
        assert relative(full.grams[k], smallest.T @ smallest) < 1e-9
        independent = (columns / np.diag(covariance)[:, None]).T @ columns
        assert relative(diagonal.weighted[k], independent) < 1e-9
        assert diagonal.pairs[k] == len(z)
        differs.append(relative(independent, gls))
    # Control: taking pairs as independent is something else.
    assert min(differs) > 0.3


def test_three_stars_in_line_do_no_harm():
    obs = observations()
    line = dataclasses.replace(
        obs.select(np.arange(obs.n_stars) < 3),
        x_px=[100.0, 400.0, 900.0],
        y_px=[110.0, 408.0, 905.0 + 1.0 / 3.0],
    )
    frames = StarFrames.from_observations(line)
    normals = frame_normals(frames, "none", camera("none").theta, np.ones(3))
    assert np.isfinite(normals.grams).all()
    # Such a frame must not claim what it cannot know.
    usual = frame_normals(
        StarFrames.from_observations(obs), "none", camera("none").theta, np.ones(3)
    )
    assert (np.diag(normals.grams[0])[1:] < 0.5 * np.diag(np.median(usual.grams, axis=0))[1:]).all()
    assert np.linalg.eigvalsh(normals.grams[0, 1:, 1:])[0] > -1e-12


def blank(p, sd=50.0, **changes):
    """A filter for p parameters that has seen nothing."""
    start = np.eye(p) * sd**2
    values = {
        "model_name": "none",
        "origin": np.zeros(p),
        "scale": np.ones(p),
        "offset": np.zeros(p),
        "point": np.zeros(p),
        "covariance": start,
        "start_covariance": start,
        "reference_px": 1.0,
        "pair_covariance": "full",
        "process": None,
        "forgetting": 1.0,
        "iterations": 1,
        "sums": FrameSums.empty(p, False),
        "response": np.zeros((3, p)),
        "noise": np.zeros((3, 3)),
        "reach_sigmas": np.inf,
        "starting": False,
    }
    return Recursion(**(values | changes))


def linear_frames(n_frames, m, p, seed=0):
    """Random linear measurements d = J u + noise, and frames that only carry their number."""
    rng = np.random.default_rng(seed)
    u = rng.normal(0.0, 10.0, p)
    slopes = rng.normal(size=(n_frames, m, p)) * np.logspace(0, -2, p)
    d = slopes @ u + 0.3 * rng.normal(size=(n_frames, m))
    frames = StarFrames(
        np.zeros((2, n_frames * 5)), np.zeros((3, n_frames * 5)), None, np.arange(n_frames + 1) * 5
    )
    frames.pixel[0] = np.repeat(np.arange(n_frames), 5)
    return slopes, d, frames


def use_linear(monkeypatch, slopes, d):
    """Let the filter see a model that is linear, in place of interstar angles."""
    columns = np.concatenate([d[:, :, None], slopes], axis=2)

    def normals(frames, model_name, theta, scale, covariance="full"):
        k = frames.pixel[0, frames.starts[:-1]].astype(int)
        shifted = columns[k].copy()
        shifted[:, :, 0] -= columns[k, :, 1:] @ theta
        grams = shifted.transpose(0, 2, 1) @ shifted
        n, p = len(k), len(theta)
        return PairNormals(
            grams, grams, np.full(n, float(d.shape[1])), np.zeros((n, 3, p)), np.zeros((n, 3, 3))
        )

    monkeypatch.setattr(recursion_module, "frame_normals", normals)


@pytest.mark.parametrize("forgetting", [1.0, 0.97])
def test_recursive_equals_batch_in_the_linear_case(monkeypatch, forgetting):
    slopes, d, frames = linear_frames(200, 7, 5)
    use_linear(monkeypatch, slopes, d)
    for iterations, reach in ((1, np.inf), (12, 2.0)):
        filtered = blank(5, forgetting=forgetting, iterations=iterations, reach_sigmas=reach)
        filtered.advance(frames)
        weights = forgetting ** (199.0 - np.arange(200))
        rows = np.concatenate(
            [
                (slopes * np.sqrt(weights)[:, None, None]).reshape(-1, 5),
                np.eye(5) / 50.0 * forgetting**100,
            ]
        )
        right = np.concatenate([(d * np.sqrt(weights)[:, None]).ravel(), np.zeros(5)])
        batch, misfit = np.linalg.lstsq(rows, right, rcond=None)[:2]
        covariance = np.linalg.inv(rows.T @ rows)
        assert np.max(np.abs(filtered.offset - batch) / np.sqrt(np.diag(covariance))) < 1e-9
        assert relative(filtered.covariance, covariance) < 1e-9
        # The innovations add up to the batch solution's sum of squares, prior included.
        assert filtered.chi2 == pytest.approx(misfit[0], rel=1e-9)
        if forgetting == 1.0:
            assert filtered.sigma == pytest.approx(0.3, rel=0.06)
    # Control: the batch solution without the prior is not the same.
    without = np.linalg.lstsq(rows[:-5], right[:-5], rcond=None)[0]
    assert np.max(np.abs(filtered.offset - without) / np.sqrt(np.diag(covariance))) > 1e-7


def test_process_noise_is_the_textbook_kalman_filter(monkeypatch):
    slopes, d, frames = linear_frames(60, 7, 3)
    use_linear(monkeypatch, slopes, d)
    process = np.array([0.01, 0.02, 0.5])
    filtered = blank(3, process=process)
    filtered.advance(frames)
    u, covariance = np.zeros(3), np.eye(3) * 2500.0
    for j, y in zip(slopes, d, strict=True):
        covariance = covariance + np.diag(process)
        gain = covariance @ j.T @ np.linalg.inv(j @ covariance @ j.T + np.eye(7))
        u = u + gain @ (y - j @ u)
        covariance = (np.eye(3) - gain @ j) @ covariance
    assert np.max(np.abs(filtered.offset - u) / np.sqrt(np.diag(covariance))) < 1e-9
    assert relative(filtered.covariance, covariance) < 1e-9
    still = blank(3)
    still.advance(frames)
    assert relative(still.covariance, covariance) > 0.1


def test_stays_positive_definite_where_rounding_bites(monkeypatch):
    """Ten thousand frames from a start that is believed a billion times less than a frame."""
    slopes, d, frames = linear_frames(10_000, 4, 5)
    use_linear(monkeypatch, slopes * np.logspace(0, -3, 5), d)
    filtered = blank(5, sd=3e4)
    filtered.advance(frames)
    assert np.array_equal(filtered.covariance, filtered.covariance.T)
    np.linalg.cholesky(filtered.covariance)


def plain_start():
    return nominal(camera("none")).replace(focal_mm=72.0)


def filtered_theta(obs, start, **options):
    steps = RecursiveCalibration(start, "griffith", RecursionOptions(**options))
    step = steps.update(obs)
    return step.theta, step


def test_the_order_of_frames_does_not_matter():
    """Beyond linearisation: less than 0.04 sigma, although every permutation starts on other
    frames.
    """
    obs = observations("none", 200)
    ids, rng = obs.frame_ids, np.random.default_rng(1)
    spread, control = [], []
    for _ in range(4):
        renamed = dict(zip(ids.tolist(), rng.permutation(ids).tolist(), strict=True))
        shuffled = dataclasses.replace(obs, frame=[renamed[k] for k in obs.frame.tolist()])
        spread.append(filtered_theta(shuffled, plain_start())[0])
        control.append(filtered_theta(shuffled, plain_start(), iterations=1)[0])
    sigmas = filtered_theta(obs, plain_start())[1].sigmas
    assert np.max(np.ptp(spread, axis=0) / sigmas) < 0.04
    assert np.max(np.ptp(control, axis=0) / sigmas) > 0.1


def test_sharing_linearisations_changes_nothing_that_counts(monkeypatch):
    obs = observations("none", 200)
    theta, step = filtered_theta(obs, plain_start())
    calls = []
    original = frame_normals

    def counted(frames, *rest):
        calls.append(frames.n_frames)
        return original(frames, *rest)

    monkeypatch.setattr(recursion_module, "frame_normals", counted)
    filtered_theta(obs, plain_start())
    shared = sum(calls)
    calls.clear()
    steps = RecursiveCalibration(plain_start())
    steps.take(StarFrames.from_observations(obs.select_frames(obs.frame_ids[:1])))
    steps._recursion.reach_sigmas = 0.02
    always = steps.update(obs.select_frames(obs.frame_ids[1:]))
    assert np.max(np.abs(always.theta - theta) / step.sigmas) < 0.01
    assert shared < 0.7 * sum(calls)


CASES = [
    ("griffith", {}),
    ("griffith", {"parameters": "all", "forgetting": 0.99}),
    ("griffith", {"pair_covariance": "diagonal"}),
    ("samaan", {"process_noise": (0.01, 0.01, 0.02), "sigma_px": 0.05}),
    ("samaan", {"pair_covariance": "diagonal", "start_frames": 7}),
]


@pytest.mark.parametrize(
    ("method", "options", "cut"),
    [(*case, cut) for case, cut in zip(CASES, (0, 40, 40, 3, 3), strict=True)],
)
def test_saved_and_resumed_equals_uninterrupted(tmp_path, method, options, cut):
    """Bit for bit, wherever it is cut: before the first frame, while the start still waits, and in
    full swing.
    """
    obs = observations(n_frames=60)
    frames = [obs.select_frames([k]) for k in obs.frame_ids]
    whole = RecursiveCalibration(sc.paper.paper_start(), method, RecursionOptions(**options))
    for frame in frames:
        last = whole.update(frame)
    first = RecursiveCalibration(sc.paper.paper_start(), method, RecursionOptions(**options))
    for frame in frames[:cut]:
        first.update(frame)
    first.save(tmp_path / "state.npz")
    second = RecursiveCalibration.load(tmp_path / "state.npz")
    for frame in frames[cut:]:
        again = second.update(frame)
    assert np.array_equal(again.theta, last.theta)
    assert np.array_equal(again.covariance, last.covariance)
    assert (again.sigma, again.chi2, again.n_frames, again.n_stars) == (
        last.sigma,
        last.chi2,
        60,
        obs.n_stars,
    )
    assert_same(second._recursion, whole._recursion)
    ours, theirs = second.result(throw=False), whole.result(throw=False)
    for field in dataclasses.fields(ours):
        if isinstance(getattr(ours, field.name), np.ndarray):
            assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name)), (
                field.name
            )
    for a, b in zip(ours.stages, theirs.stages, strict=True):
        assert np.array_equal(a.trajectory, b.trajectory)
    assert ours.provenance["data_sha256"] == theirs.provenance["data_sha256"]


@pytest.mark.parametrize(("method", "options"), CASES)
def test_grouping_of_frames_does_not_matter(method, options):
    obs = observations(n_frames=60)
    states = []
    for size in (1, 7, 60):
        steps = RecursiveCalibration(sc.paper.paper_start(), method, RecursionOptions(**options))
        for first in range(0, 60, size):
            steps.update(obs.select_frames(obs.frame_ids[first : first + size]))
        states.append(steps)
    for other in states[1:]:
        assert_same(states[0]._recursion, other._recursion)
        assert states[0]._digest == other._digest
    # Control: another order of the same frames is another computation.
    backwards = RecursiveCalibration(sc.paper.paper_start(), method, RecursionOptions(**options))
    for k in obs.frame_ids[::-1]:
        backwards.update(obs.select_frames([k]))
    assert not np.array_equal(backwards.step.theta, states[0].step.theta)
    assert backwards._digest != states[0]._digest


def test_steps_tell_estimate_and_covariance_after_every_frame():
    obs = observations("none", n_frames=60)
    steps = RecursiveCalibration(plain_start())
    before = steps.step
    assert before.parameter_names == ("x0", "y0", "f")
    assert np.allclose(before.theta, plain_start().theta)
    assert before.n_frames == 0
    widths, told = [before.sigmas], [before.theta]
    for k in obs.frame_ids:
        step = steps.update(obs.select_frames([k]))
        widths.append(step.sigmas)
        told.append(step.theta)
    # Information only grows; the noise is estimated again after each frame, which moves all sigmas
    # together.
    covariances = np.array(widths)[5:]
    assert (covariances[-1] < 0.4 * covariances[0]).all()
    cal = steps.result()
    assert np.allclose(cal.stages[0].trajectory, told, rtol=0, atol=1e-9)
    assert np.allclose(cal.stages[0].sigmas, widths, rtol=1e-12)
    assert (np.diff(cal.stages[0].cost) >= 0.0).all()
    assert np.allclose(steps.camera.theta, step.theta)


def test_history_of_a_long_stream_is_thinned(monkeypatch):
    monkeypatch.setattr(recursion_sums, "_MAX_HISTORY", 16)
    obs = observations("none", n_frames=60)
    steps = RecursiveCalibration(plain_start())
    step = steps.update(obs)
    stage = steps.result().stages[0]
    assert len(stage.trajectory) <= 17
    assert np.array_equal(stage.trajectory[-1], step.theta)
    assert np.array_equal(stage.trajectory[0], plain_start().theta)


@pytest.mark.parametrize("method", ["griffith", "samaan"])
def test_too_little_is_said_to_be_too_little(method):
    with pytest.raises(CalibrationError, match="no frame yet"):
        RecursiveCalibration(plain_start(), method).result()
    obs = observations()
    three = obs.select(np.isin(np.arange(obs.n_stars), [0, 1, 2]))
    steps = RecursiveCalibration(sc.paper.paper_start(), method)
    with pytest.raises(CalibrationError) as caught:
        steps.update(three)
        steps.result()
    assert caught.value.status is Status.SINGULAR


@pytest.mark.parametrize(
    ("method", "options", "words"),
    [
        ("griffith", {"pair_covariance": "none"}, "'none' is unknown: use one of full, diagonal"),
        ("griffith", {"parameters": "f"}, "use one of optics, all"),
        ("griffith", {"forgetting": 0.0}, "forgetting is 0.0: use a number above 0 and up to 1"),
        ("griffith", {"forgetting": 1.01}, "forgetting is 1.01"),
        ("griffith", {"forgetting": float("nan")}, "forgetting is nan"),
        ("griffith", {"sigma_px": -1.0}, "use a positive number of pixels"),
        ("griffith", {"iterations": 0}, "iterations is 0: use 1 or more"),
        ("griffith", {"process_noise": 0.1, "sigma_px": 0.1}, "griffith has no process noise"),
        ("samaan", {"start_frames": 0}, "start_frames is 0"),
        ("samaan", {"process_noise": -1.0}, "not negative"),
        ("samaan", {"process_noise": (1.0, 2.0)}, "or three, for x0, y0 and f"),
        ("samaan", {"forgetting": 0.9}, "samaan forgets by process_noise"),
        ("samaan", {"parameters": "all"}, "samaan filters the optics only"),
        ("three_stage", {}, "is not recursive: use one of samaan, griffith"),
    ],
)
def test_options_that_make_no_sense(method, options, words):
    with pytest.raises(CalibrationError, match=words):
        RecursiveCalibration(sc.paper.paper_start(), method, RecursionOptions(**options))


def test_noise_must_be_stated_for_process_noise_and_the_same_way_throughout():
    obs = observations()
    with pytest.raises(CalibrationError, match="process noise needs a stated noise"):
        RecursiveCalibration(
            sc.paper.paper_start(), "samaan", RecursionOptions(process_noise=0.1)
        ).update(obs)
    stated = with_sigmas(obs)
    with pytest.raises(CalibrationError, match="leave sigma_px out"):
        RecursiveCalibration(
            sc.paper.paper_start(), "griffith", RecursionOptions(sigma_px=0.1)
        ).update(stated)
    steps = RecursiveCalibration(sc.paper.paper_start())
    steps.update(obs)
    with pytest.raises(CalibrationError, match="some frames state the noise"):
        steps.update(stated)
