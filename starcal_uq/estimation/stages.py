"""The steps of a calibration: the three stages of Ye & Yang 2017, and the refinement on the
marginal likelihood.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter
from typing import ClassVar

import numpy as np

from starcal_uq.attitude.wahba import DegenerateFrameError
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import DistortionModel, get_model
from starcal_uq.camera.projection import monotonic_expression
from starcal_uq.core.status import Status
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.settings import ITERATIONS
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.pairs import PairObjective
from starcal_uq.likelihood.paths import sums_for
from starcal_uq.likelihood.solvers import (
    Constraints,
    Evaluate,
    Normal,
    Solution,
    levenberg_marquardt,
    minpack,
)
from starcal_uq.likelihood.sums import Descent
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.observations.frames import StarFrames

# Relative gain that the last step of a pair stage promises: 1e-4 sigma or less for 30,000
# residuals.
PAIR_TOLERANCE = 1e-13
# The estimate itself is taken to rounding, so that every start ends in the same digits.
REFINEMENT_TOLERANCE = 1e-18
# What a start value for the principal point needs: places to try in widths and heights, on so many
# stars.
_HELD_TOLERANCE = 1e-6
_GRID = 0.25 * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
_GRID_STARS, _GRID_ITERATIONS = 20_000, 12
# From the nominal optics positions take some fifteen.
_DIRECT_ITERATIONS = 60
# Explicit pairs need about 100 bytes each and parameter; beyond this the normal equations serve.
MAX_EXPLICIT_PAIRS = 500_000


@dataclass(frozen=True)
class Search:
    """How a stage looks for its minimum, and how well it ends there."""

    solver: str = "lm"
    max_iterations: int = ITERATIONS
    # Relative gain of the last step of Levenberg-Marquardt, and whether the model is evaluated after it.
    tolerance: float = PAIR_TOLERANCE
    seen: bool = True

    def minimum(self, evaluate: Evaluate, start: FloatArray) -> Solution:
        """Levenberg-Marquardt from a start (p,)."""
        return levenberg_marquardt(
            evaluate,
            start,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            seen=self.seen,
        )


@dataclass(frozen=True)
class Stage:
    """One stage of a calibration.

    Attributes
    ----------
    name : str
        ``optics``, ``distortion``, ``all`` (the paper's three), ``refinement``, ``stars``, or
        ``filter`` (recursive methods).
    trajectory : (n, p) array
        Estimates after each iteration, px units, the start first; of a filter, after each frame.
    cost : (n,) array
        The stage's own cost along the trajectory: rad^2 over pairs, px^2 in the linear stage and
        the refinement; of a filter, the sum of its whitened innovations so far, px^2 (or in units
        of the stated noise). Where the first steps were taken on a sample of the frames, their
        costs are scaled to all.
    status : Status
        How it ended.
    evaluations : int
        Evaluations of the model.
    seconds : float
        Wall time.
    sigmas : (n, p) array or None
        Standard deviations that a filter claims after each frame, px units; zero where a parameter
        is not estimated.
    """

    name: str
    trajectory: FloatArray
    cost: FloatArray
    status: Status
    evaluations: int
    seconds: float
    sigmas: FloatArray | None = None

    SHAPES: ClassVar = """
        n p: trajectory sigmas
        n: cost
    """

    @property
    def iterations(self) -> int:
        """Steps taken; of a filter, frames."""
        return len(self.trajectory) - 1

    @property
    def theta(self) -> FloatArray:
        """The stage's result, (p,)."""
        last: FloatArray = self.trajectory[-1]
        return last


def constraints_for(camera: Camera, n_parameters: int) -> Constraints:
    """Principal point on the detector, positive focal length and monotonic distortion over the
    field.
    """
    p = len(camera.theta)
    lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
    lower[:3] = (0.0, 0.0, 0.01 * camera.focal_px)
    upper[:3] = (camera.width_px - 1.0, camera.height_px - 1.0, 100.0 * camera.focal_px)
    model = get_model(camera.distortion)
    if model.axes:
        lower[model.of_lens.stop] = -0.99
    if n_parameters < p:
        return Constraints(np.delete(lower, model.of_lens), np.delete(upper, model.of_lens))
    radius = camera.half_diagonal_px
    return Constraints(
        lower, upper, lambda theta: monotonic_expression(camera.distortion, theta, radius)
    )


def _solve(objective: PairObjective, start: FloatArray, camera: Camera, search: Search) -> Solution:
    most = search.max_iterations
    if search.solver == "ipopt":
        # CasADi takes a while to load, and few need it.
        from starcal_uq.likelihood.ipopt import ipopt

        constraints = constraints_for(camera, objective.n_parameters)
        return ipopt(objective.evaluate, start, constraints, max_iterations=most)
    if search.solver == "minpack" and objective.n_pairs <= MAX_EXPLICIT_PAIRS:
        return minpack(objective.residuals, objective.evaluate, start, max_iterations=most)
    return search.minimum(objective.evaluate, start)


def _timed(name: str, run: Callable[[], Solution], without: DistortionModel | None = None) -> Stage:
    """The stage of a solver's run, which leaves the coefficients of a lens at zero."""
    began = perf_counter()
    solution = run()
    trajectory = solution.trajectory
    if without is not None:
        trajectory = np.insert(trajectory, [3] * len(without.lens), 0.0, axis=1)
    return Stage(
        name=name,
        trajectory=trajectory,
        cost=solution.costs,
        status=solution.status,
        evaluations=solution.evaluations,
        seconds=perf_counter() - began,
    )


def begun_on_sample(sample: Stage, whole: Stage, scale: float) -> Stage:
    """One stage of two: its way on a sample of the frames, with costs times `scale`, and then on
    all.
    """
    return Stage(
        name=sample.name,
        trajectory=np.concatenate([sample.trajectory[:-1], whole.trajectory]),
        cost=np.concatenate([sample.cost[:-1] * scale, whole.cost]),
        status=whole.status,
        evaluations=sample.evaluations + whole.evaluations,
        seconds=sample.seconds + whole.seconds,
    )


def optics_stage(frames: StarFrames, camera: Camera, search: Search) -> Stage:
    """Stage 1: x0, y0 and f on interstar angles, distortion ignored (the paper's section 2.1);
    also the axes of the detector, where they are free.
    """
    model = get_model(camera.distortion)
    objective = PairObjective(frames, model.bare)
    start = np.delete(camera.theta, model.of_lens)
    return _timed("optics", lambda: _solve(objective, start, camera, search), model)


def focal_stage(frames: StarFrames, camera: Camera, max_iterations: int) -> Stage:
    """Stage 1 for stars that do not determine the principal point without distortion: f alone, on
    positions.
    """
    model = get_model(camera.distortion)
    own, start = MarginalLikelihood(frames, model.bare), np.delete(camera.theta, model.of_lens)
    return _timed("optics", lambda: _held(own, start, max_iterations), model)


def distortion_stage(frames: StarFrames, camera: Camera, theta: FloatArray) -> Stage:
    """Stage 2: the coefficients by linear least squares at fixed optics (the paper's section 2.2).

    Ideal points need attitudes, which come from QUEST with the stage-1 optics. The attitudes and f
    have absorbed much of the distortion by then, so that this is a start value and nothing else.
    """
    began = perf_counter()
    model = get_model(camera.distortion)
    x, y = frames.pixel - theta[:2, None]
    offset = np.stack(model.unstretched(x, y, theta))
    bare = np.delete(theta, model.of_lens)
    rotations = sums_for(frames).attitudes(frames, model.bare, bare)
    if not np.isfinite(rotations).all():
        raise DegenerateFrameError(np.flatnonzero(np.isnan(rotations[:, 0, 0])))
    b = frames.rotated(rotations)
    ideal = np.stack(model.plane.onto(b, theta[2]))
    # Every model is linear in its coefficients; forward models act on ideal points, inverse ones on
    # measured points.
    forward = model.direction == "forward"
    at, target = (ideal, offset - ideal) if forward else (offset, ideal - offset)
    n = len(model.lens)
    design = np.array(
        [model.displacement(at[0], at[1], tuple(unit)) for unit in np.eye(n)]
    ).reshape(n, -1)
    matrix, shift = design @ design.T, design @ target.ravel()
    scale = root_diagonal(matrix)
    k = np.linalg.lstsq(matrix / np.outer(scale, scale), shift / scale, rcond=None)[0] / scale
    cost = [float(np.sum(target**2)), float(np.sum((target.ravel() - k @ design) ** 2))]
    trajectory = np.stack([np.insert(bare, [3] * n, found) for found in (np.zeros(n), k)])
    return Stage(
        "distortion", trajectory, np.array(cost), Status.CONVERGED, 1, perf_counter() - began
    )


def joint_stage(
    objective: PairObjective, camera: Camera, theta: FloatArray, search: Search
) -> Stage:
    """Stage 3: all parameters on interstar angles (the paper's section 2.3)."""
    return _timed("all", lambda: _solve(objective, theta, camera, search))


def refinement_stage(likelihood: MarginalLikelihood, theta: FloatArray, search: Search) -> Stage:
    """Stage 4: all parameters on the attitude-marginalised likelihood, which reaches the Cramer-Rao
    bound.

    The attitudes move along; `likelihood` starts its later searches from where they end. The solver
    is Levenberg-Marquardt, whichever the other stages have.
    """
    return _timed("refinement", lambda: _descended(likelihood, theta, search))


def direct_stage(likelihood: MarginalLikelihood, camera: Camera, max_iterations: int) -> Stage:
    """As `refinement_stage`, from a data sheet: focal length and coefficients first, then all
    parameters.

    In a narrow field the principal point hardly matters until the others fit. Moved together with a
    focal length that is per cent off it leaves along a valley, where the tilt of the field and the
    coma of the distortion make up for each other. The others are fitted with the principal point
    held where the data sheet has it and at eight places around; where they fit best, all are set
    free.
    """

    max_iterations = min(max_iterations, _DIRECT_ITERATIONS)

    def run() -> Solution:
        theta = camera.theta
        first = _held(likelihood, theta, max_iterations)
        best = first
        few = likelihood.frames.part(
            0, max(1, int(np.searchsorted(likelihood.frames.starts, _GRID_STARS)) - 1)
        )
        trial = MarginalLikelihood(few, likelihood.model_name)
        costs = [_held(trial, first.theta, _GRID_ITERATIONS).normal.cost]
        for shift in _GRID:
            moved = np.concatenate(
                [theta[:2] + shift * (camera.width_px, camera.height_px), first.theta[2:]]
            )
            there = _held(trial, moved, _GRID_ITERATIONS)
            costs.append(there.normal.cost)
            if costs[-1] == min(costs):
                best = there
        search = Search(max_iterations=max_iterations, tolerance=REFINEMENT_TOLERANCE)
        last = _descended(likelihood, best.theta, search)
        return replace(
            last,
            trajectory=np.concatenate([first.trajectory, last.trajectory]),
            costs=np.concatenate([first.costs, last.costs]),
            evaluations=first.evaluations + last.evaluations,
        )

    return _timed("refinement", run)


def _held(likelihood: MarginalLikelihood, theta: FloatArray, max_iterations: int) -> Solution:
    """The best focal length and coefficients for the principal point of theta (p,), from QUEST's
    attitudes.
    """
    descent = Descent(likelihood.frames, likelihood.model_name, likelihood.start_rotations(theta))

    def evaluate(rest: FloatArray) -> Normal:
        normal = descent.evaluate(np.concatenate([theta[:2], rest]))
        return Normal(normal.cost, normal.gradient[2:], normal.matrix[2:, 2:])

    search = Search(max_iterations=max_iterations, tolerance=_HELD_TOLERANCE)
    found = search.minimum(evaluate, theta[2:])
    trajectory = np.hstack([np.tile(theta[:2], (len(found.costs), 1)), found.trajectory])
    return replace(found, theta=trajectory[-1], trajectory=trajectory)


def _descended(likelihood: MarginalLikelihood, theta: FloatArray, search: Search) -> Solution:
    """The minimum of the likelihood's sum of squares, near whose attitudes its later searches
    start.
    """
    best = likelihood.last_sums
    start = best[1].rotations if best is not None else likelihood.rotations
    start = likelihood.start_rotations(theta) if start is None else start
    descent = Descent(likelihood.frames, likelihood.model_name, start, best)
    solution = search.minimum(descent.evaluate, theta)
    if descent.best is not None:
        likelihood.use_sums(*descent.best)
    return solution
