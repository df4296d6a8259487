"""Timings of the main job beside the straightforward way of doing it, measured in one run.

Run with ``make bench``. Every line is the median of several repeats on one core; ratios compare the two columns of the
same run, so that they mean something on any machine.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

import starcal_uq as sc
from starcal_uq.camera.projection import forward_kernel, forward_root
from starcal_uq.estimation.calibrate import calibrate
from starcal_uq.estimation.marginal import MarginalLikelihood
from starcal_uq.estimation.pairs import PairObjective
from starcal_uq.estimation.recursive.innovations import frame_normals
from starcal_uq.estimation.recursive.start import RecursionOptions
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.streams import stream_frames


def seconds(run: Callable[[], object], repeats: int) -> float:
    """Median wall time."""
    times = []
    for _ in range(repeats):
        began = perf_counter()
        run()
        times.append(perf_counter() - began)
    return statistics.median(times)


def explicit_pairs(obs: sc.Observations) -> np.ndarray:
    """The paper's three stages with SciPy's Levenberg-Marquardt on explicitly formed pairs, analytic Jacobian.

    The rival is given the same generated kernels and derivatives and the same linear stage; only the sums over pairs
    are formed one by one. Its covariance is the naive inverse of J^T J, which is all that SciPy offers.
    """
    from scipy.optimize import least_squares

    from starcal_uq.estimation.stages import distortion_stage

    frames, start = StarFrames.from_observations(obs), sc.paper.paper_start()
    theta = np.array(start.theta)
    first = PairObjective(frames, "none")
    joint = PairObjective(frames, "brown")
    pairs = joint.pair_indices()
    for objective in (first, joint):
        # Indices are formed once, as anyone would.
        objective.pair_indices = lambda: pairs  # type: ignore[method-assign]

    def solve(objective: PairObjective, x: np.ndarray) -> np.ndarray:
        return least_squares(
            lambda t: objective.residuals(t)[0],
            x,
            jac=lambda t: objective.residuals(t)[1],
            method="lm",
            x_scale="jac",
            xtol=1e-12,
            ftol=1e-12,
        ).x

    theta[:3] = solve(first, theta[:3])
    theta = distortion_stage(frames, start, theta).theta
    theta = solve(joint, np.array(theta))
    jacobian = joint.residuals(theta)[1]
    scale = np.linalg.norm(jacobian, axis=0)
    np.linalg.inv((jacobian / scale).T @ (jacobian / scale))
    return theta


def explicit_innovations(frames: StarFrames, theta: np.ndarray, count: int) -> np.ndarray:
    """Information of the first frames on the optics, from explicitly formed pairs and the pseudo-inverse.

    The rival is given the same directions and derivatives; it forms every pair's derivatives with respect to the pixels
    and the parameters, and the minimum-norm solution by NumPy.
    """
    total = np.zeros((3, 3))
    for k in range(count):
        frame = frames.part(k, k + 1)
        objective = PairObjective(frame, "none")
        b, db = objective.directions(theta, frame)
        i, j = np.triu_indices(frame.n_stars, 1)
        rows = np.arange(len(i))
        by_pixel = np.zeros((len(i), 2, frame.n_stars))
        for axis in range(2):
            by_pixel[rows, axis, i] = -np.sum(db[axis][:, i] * b[:, j], axis=0)
            by_pixel[rows, axis, j] = -np.sum(db[axis][:, j] * b[:, i], axis=0)
        slopes = np.sum(db[:, :, i] * b[:, j] + db[:, :, j] * b[:, i], axis=1).T
        reduced = np.linalg.pinv(by_pixel.reshape(len(i), -1), rcond=1e-9) @ slopes
        total += reduced.T @ reduced
    return total


def add_baselines(table: Table, obs: sc.Observations, efficient: float, repeats: int) -> None:
    """Rows of the methods that the paper compares itself with, per 1000 frames."""
    start, thousands = sc.paper.paper_start(), obs.n_frames / 1000.0
    for label, method, options in (
        ("least squares, distortion ignored", "least_squares", None),
        ("Samaan: filter and linear distortion", "samaan", None),
        ("Griffith: recursive least squares", "griffith", None),
        ("Griffith with the distortion", "griffith", RecursionOptions(parameters="all")),
        ("Griffith, pairs as if independent", "griffith", RecursionOptions(pair_covariance="diagonal")),
    ):
        time = seconds(lambda m=method, o=options: calibrate(obs, start, method=m, recursion=o), repeats)  # type: ignore[misc]
        table.add_row(
            f"{label}, 1000 frames",
            f"{1e3 * time / thousands:.0f} ms",
            f"{1e3 * efficient / thousands:.0f} ms",
            f"{efficient / time:.1f}",
            "method='efficient'",
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames.parquet"
        obs.save(path)
        streamed = seconds(lambda: calibrate(stream_frames(path), start, method="griffith"), repeats)
    table.add_row("Griffith from a file, frame by frame", f"{1e3 * streamed / thousands:.0f} ms", "", "", "")
    frames, theta, few = StarFrames.from_observations(obs), start.theta[:3], min(100, obs.n_frames)
    ours = seconds(lambda: frame_normals(frames, "none", theta, np.ones(3)), repeats) / obs.n_frames
    rival = seconds(lambda: explicit_innovations(frames, theta, few), 3) / few
    total = np.sum(frame_normals(frames.part(0, few), "none", theta, np.ones(3)).grams, axis=0)[1:, 1:]
    difference = np.max(np.abs(explicit_innovations(frames, theta, few) / total - 1.0))
    table.add_row(
        "a frame's pairs with their full covariance",
        f"{1e6 * ours:.0f} us",
        f"{1e6 * rival:.0f} us",
        f"{rival / ours:.0f}",
        f"explicit pairs, pseudo-inverse (same to {difference:.0e})",
    )


def import_seconds() -> float:
    """Median time of ``import starcal_uq`` in fresh interpreters, beyond starting Python."""
    code = "import time; t = time.perf_counter(); import starcal_uq; print(time.perf_counter() - t)"
    times = [float(subprocess.check_output([sys.executable, "-c", code], text=True)) for _ in range(7)]
    return statistics.median(times)


def quest_rates(obs: sc.Observations) -> tuple[float, float]:
    """12-star attitudes per second: batch QUEST, and SciPy's align_vectors called per frame."""
    from scipy.spatial.transform import Rotation

    from starcal_uq.attitude.rotations import random_rotations

    rng = np.random.default_rng(0)
    k, m = 4000, 12
    b = rng.normal(0.0, 0.07, (k, m, 3)) + np.array([0.0, 0.0, 1.0])
    b /= np.linalg.norm(b, axis=2, keepdims=True)
    r = np.einsum("kji,kmj->kmi", random_rotations(k, rng), b)
    starts = np.arange(k + 1) * m
    flat_b, flat_r = b.reshape(-1, 3), r.reshape(-1, 3)
    ours = seconds(lambda: sc.attitude.quest(flat_b, flat_r, starts, covariance=False), 7)
    few = 300
    theirs = seconds(lambda: [Rotation.align_vectors(b[i], r[i]) for i in range(few)], 3)
    return k / ours, few / theirs


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    obs = sc.simulate(stars, sc.paper.paper_camera(), n_frames=options.frames, sigma_px=0.05, seed=2017)
    start = sc.paper.paper_start()
    n_pairs = PairObjective(StarFrames.from_observations(obs), "brown").n_pairs
    console = Console(width=110)
    console.print(f"{obs.n_frames} frames, {obs.n_stars} stars, {n_pairs} pairs; medians, one core")
    table = Table()
    for heading, justify in (
        ("what", "left"),
        ("ours", "right"),
        ("rival", "right"),
        ("ratio", "right"),
        ("rival is", "left"),
    ):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]

    calibrate(obs, start, method="three_stage")
    three = seconds(lambda: _three_stages(obs), options.repeats)
    rival = seconds(lambda: explicit_pairs(obs), 3)
    difference = np.max(np.abs(explicit_pairs(obs) - _three_stages(obs)[0]) / np.sqrt(np.diag(_three_stages(obs)[1])))
    table.add_row(
        "three stages with sandwich covariance",
        f"{1e3 * three:.0f} ms",
        f"{1e3 * rival:.0f} ms",
        f"{rival / three:.0f}",
        f"SciPy LM on explicit pairs (same optimum to {difference:.0e} sigma)",
    )
    whole = seconds(lambda: calibrate(obs, start), options.repeats)
    table.add_row("the same, refined, with compressed likelihood", f"{1e3 * whole:.0f} ms", "", "", "")

    add_baselines(table, obs, whole, options.repeats)

    cal = calibrate(obs, start)
    sc.sample(obs, cal, seed=0, n_steps=40)
    began = perf_counter()
    post = sc.sample(obs, cal, seed=1)
    sampling = perf_counter() - began
    mixture = float(np.min(post.diagnostics.ess_bulk)) / post.diagnostics.n_evaluations
    stretch_post = sc.sample(obs, cal, seed=1, moves="stretch", n_steps=2000)
    stretch = float(np.min(stretch_post.diagnostics.ess_bulk)) / stretch_post.diagnostics.n_evaluations
    table.add_row(
        f"sampling: {np.min(post.diagnostics.ess_bulk):.0f} effective draws in",
        f"{sampling:.2f} s",
        "",
        "",
        "",
    )
    table.add_row(
        "effective draws per 1000 evaluations",
        f"{1e3 * mixture:.0f}",
        f"{1e3 * stretch:.0f}",
        f"{mixture / stretch:.0f}",
        "emcee's stretch move",
    )

    exact = MarginalLikelihood(obs, "brown")
    exact.use_rotations(exact.rotations_at(cal.theta))
    thetas, sigmas = np.tile(cal.theta, (128, 1)), np.full(128, cal.sigma)
    one = seconds(lambda: exact.log_likelihood(cal.theta, cal.sigma), 15)
    many = seconds(lambda: cal.compressed.log_likelihood(thetas, sigmas), 50) / 128
    table.add_row(
        "one likelihood evaluation",
        f"{1e6 * many:.1f} us",
        f"{1e6 * one:.0f} us",
        f"{one / many:.0f}",
        "exact likelihood",
    )

    frames = StarFrames.from_observations(obs)
    b = frames.rotated(exact.rotations_at(cal.theta))
    root = forward_root("brown", cal.theta, b)
    kernel = forward_kernel("brown", "first")
    mapped = kernel.function.map(frames.n_stars)
    shared = np.zeros((2, frames.n_stars))
    ours = seconds(lambda: kernel(frames.n_stars, cal.theta, b, root), 30)
    casadi_time = seconds(lambda: mapped(np.tile(cal.theta[:, None], frames.n_stars), b, shared), 5)
    table.add_row(
        "model with both Jacobians, all stars",
        f"{1e3 * ours:.1f} ms",
        f"{1e3 * casadi_time:.1f} ms",
        f"{casadi_time / ours:.0f}",
        "CasADi's mapped function",
    )
    rate, scipy_rate = quest_rates(obs)
    table.add_row(
        "12-star attitudes per second",
        f"{rate:,.0f}",
        f"{scipy_rate:,.0f}",
        f"{rate / scipy_rate:.0f}",
        "SciPy align_vectors",
    )
    table.add_row("import starcal_uq", f"{1e3 * import_seconds():.0f} ms", "", "", "")
    console.print(table)


def _three_stages(obs: sc.Observations) -> tuple[np.ndarray, np.ndarray]:
    """The paper's three stages and their sandwich covariance, without the refinement."""
    from starcal_uq.estimation.stages import distortion_stage, joint_stage, optics_stage

    frames, start = StarFrames.from_observations(obs), sc.paper.paper_start()
    optics = optics_stage(frames, start, "lm", 200)
    linear = distortion_stage(frames, start, optics.theta)
    pairs = PairObjective(frames, "brown")
    theta = joint_stage(pairs, start, linear.theta, "lm", 200).theta
    return theta, pairs.godambe(theta)


if __name__ == "__main__":
    main()
