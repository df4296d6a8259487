"""All methods on one data set, without doing the same work twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.errors import StarcalError
from starcal_uq.core.types import FloatArray
from starcal_uq.estimation.pairs import PairObjective

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.observations.frames import StarFrames
    from starcal_uq.observations.table import Observations
    from starcal_uq.paper.methods import Method


@dataclass(frozen=True)
class Solved:
    """What a method found.

    Attributes
    ----------
    camera : Camera
        The estimate.
    theta : (p,) array
        Its parameters, px units.
    sigmas : (p,) array
        Its standard deviations, as the method claims them.
    classical : (p,) array
        Those of textbooks: for least squares over pairs ``(J^T J)^-1 s^2``, which presumes that pairs are independent,
        although the m (m - 1) / 2 pairs of m stars hold 2 m - 3 independent numbers; for a filter its own, which
        presume that its model holds. NaN where there is none, or where it is what the method claims anyway.
    """

    camera: Camera
    theta: FloatArray
    sigmas: FloatArray
    classical: FloatArray


def solve_all(
    methods: Sequence[Method], obs: Observations, frames: StarFrames, start: Camera
) -> list[Solved | StarcalError]:
    """Every method's result, or why it has none; `frames` are those of `obs`.

    The first stage of the efficient method is least squares, and its third is the paper's method: where it is among the
    methods and converges, they are taken from it.
    """
    found: dict[Method, Solved | StarcalError] = {}
    efficient = [method for method in methods if method.method == "efficient"]
    others = [method for method in methods if method.method != "efficient"]
    whole: Calibration | None = None
    for method in (*efficient, *others):
        try:
            if whole is not None and method.method in _STAGES:
                found[method] = _STAGES[method.method](whole, frames)
                continue
            cal = method.calibrate(obs, start)
            found[method] = _solved(cal, frames)
            whole = cal if method.method == "efficient" else whole
        except StarcalError as error:
            found[method] = error
    return [found[method] for method in methods]


def _solved(cal: Calibration, frames: StarFrames) -> Solved:
    classical = np.full(len(cal.theta), np.nan)
    if cal.method in _STAGES:
        classical = textbook_sigmas(PairObjective(frames, cal.camera.distortion), cal.theta)
    for stage in cal.stages:
        if stage.sigmas is not None:
            classical = np.where(stage.sigmas[-1] > 0.0, stage.sigmas[-1], np.nan)
    return Solved(cal.camera, cal.theta, cal.sigmas, classical)


def _first_stage(whole: Calibration, frames: StarFrames) -> Solved:
    theta = whole.stages[0].theta[:3]
    pairs = PairObjective(frames, "none")
    camera = whole.nominal.replace(distortion="none", coefficients=()).with_theta(theta)
    return Solved(camera, theta, np.sqrt(np.diag(pairs.godambe(theta))), textbook_sigmas(pairs, theta))


def _third_stage(whole: Calibration, frames: StarFrames) -> Solved:
    theta = whole.pair_theta
    pairs = PairObjective(frames, whole.nominal.distortion)
    sigmas = np.sqrt(np.diag(whole.pair_covariance))
    return Solved(whole.nominal.with_theta(theta), theta, sigmas, textbook_sigmas(pairs, theta))


_STAGES = {"least_squares": _first_stage, "three_stage": _third_stage}


def textbook_sigmas(pairs: PairObjective, theta: FloatArray) -> FloatArray:
    """Standard deviations (p,) of least squares over pairs, ``(J^T J)^-1 s^2``, as if pairs were independent."""
    normal = pairs.evaluate(theta)
    variance = normal.cost / (pairs.n_pairs - len(theta))
    return np.sqrt(inverse_diagonal(normal.matrix) * variance)


def inverse_diagonal(matrix: FloatArray) -> FloatArray:
    """Diagonal of the inverse of an information matrix, whose entries may span thirty orders of magnitude."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.diag(np.linalg.inv(matrix * np.outer(scale, scale))) * scale**2)
