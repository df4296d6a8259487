"""What a recursion has found: estimate and covariance of all parameters, and a `Calibration`
without the frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict, FloatArray
from starcal_uq.estimation.kept import KeptFrames
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.stages import Stage
from starcal_uq.likelihood.compressed import CompressedLikelihood
from starcal_uq.likelihood.solvers import is_singular
from starcal_uq.maths.linear import correlation_of, root_diagonal, symmetric
from starcal_uq.paper.recursive.filter import FrameSums, Recursion, entry_count, frame_entries
from starcal_uq.paper.recursive.innovations import frame_normals

# The scatter of fewer frames than this per parameter says less about the covariance than the model
# does: less is needed where the distortion is ignored, because the model is then known to be wrong.
_FRAMES_PER_PARAMETER = 30
_FRAMES_PER_PARAMETER_IGNORING = 10
# A parameter whose sigma is still this share of the start's has not been measured.
_UNMEASURED = 0.5


@dataclass(frozen=True)
class JointEstimate:
    """Estimate of all p parameters."""

    theta: FloatArray  # (p,): px units
    covariance: FloatArray  # (p, p): px units
    source: str  # "scatter of the frames" or "filter": origin of the covariance


def joint_estimate(recursion: Recursion, sums: FrameSums | None = None) -> JointEstimate:
    """Optics from the filter, distortion by linear least squares at them, and the covariance of
    both.

    With g the frames' scores of the optics (gradient of their innovations at the estimate) and h
    those of the distortion, the estimates move by ``P g`` and ``N^-1 (h - E P g)``: N is the
    information on the distortion at fixed optics, E its derivative with respect to them, attitudes
    eliminated throughout. The sum over frames of the outer products of these influences is the
    sandwich covariance. It is the spread that the method really has, also where the distortion is
    ignored or pairs are taken as independent; the filter's own claim, which presumes its model, is
    in the sigmas of the stage. With few frames, or with process noise, the model's covariance is
    given. `sums` are those of a second pass at the final optics, where there was one.
    """
    sums = recursion.sums if sums is None else sums
    q, p = len(recursion.offset), len(recursion.origin)
    gradient, matrix = sums.gram[1:, 0], sums.gram[1:, 1:]
    offset = np.zeros(p)
    offset[:q] = recursion.offset
    influence = np.zeros((p, p))
    influence[:q, :q] = recursion.covariance
    if p > q:
        if is_singular(matrix[q:, q:]):
            raise CalibrationError(
                f"the distortion cannot be estimated ({Status.SINGULAR.name})",
                Status.SINGULAR,
                reason=Status.SINGULAR.remedy,
            )
        inverse = np.linalg.inv(matrix[q:, q:])
        offset[q:] = inverse @ (gradient[q:] - matrix[q:, :q] @ recursion.offset)
        influence[q:, q:] = inverse
        influence[q:, :q] = -inverse @ matrix[q:, :q] @ recursion.covariance
    frames = sums.effective_frames
    full = recursion.pair_covariance == "full"
    enough = q * (_FRAMES_PER_PARAMETER_IGNORING if q == 3 else _FRAMES_PER_PARAMETER)
    if not full:
        # The filter's own claim is wrong by a factor of three, and any scatter better.
        enough = q + 2
    scatter = recursion.process is None and frames >= enough
    if scatter:
        scores = _score_map(offset, q, full)
        meat = scores @ sums.moments @ scores.T
        covariance = frames / (frames - q) * (influence @ meat @ influence.T)
    else:
        covariance = recursion.sigma**2 * _model_covariance(
            influence, matrix, q, recursion.process is not None
        )
    scale = recursion.scale
    return JointEstimate(
        theta=recursion.origin + scale * offset,
        covariance=symmetric(covariance) * np.outer(scale, scale),
        source="scatter of the frames" if scatter else "filter",
    )


def _model_covariance(
    influence: FloatArray, matrix: FloatArray, q: int, drifting: bool
) -> FloatArray:
    """Covariance per noise variance if the model holds: optics as the filter claims, distortion
    given them.
    """
    covariance = influence.copy()
    optics, inverse = influence[:q, :q], influence[q:, q:]
    if len(inverse):
        slope = inverse @ matrix[q:, :q]
        carried = slope @ optics @ slope.T
        # Scores of the distortion and errors of the optics come from the same centroids: what they
        # share cancels. With process noise the optics' error is another, and the sum is on the safe
        # side.
        covariance[q:, q:] = inverse + carried if drifting else inverse - carried
        covariance[q:, :q] = -slope @ optics if drifting else 0.0
        covariance[:q, q:] = covariance[q:, :q].T
    return covariance


def _score_map(offset: FloatArray, q: int, full: bool) -> FloatArray:
    """Matrix (p, s) that takes a frame's entries to its score at an offset: gradient minus
    information times it.
    """
    p = len(offset)
    rows, columns = np.triu_indices(1 + p)
    place = {
        (int(i), int(j)): index
        for index, (i, j) in enumerate(zip(rows[1:], columns[1:], strict=True))
    }
    count = entry_count(p)
    scores = np.zeros((p, count if full else 2 * count))
    for i in range(p):
        # The optics know no distortion; their equations are the filter's, those of the distortion
        # the pixels'.
        base, known = (0 if full else count, q) if i < q else (0, p)
        scores[i, base + place[0, 1 + i]] = 1.0
        for j in range(known):
            scores[i, base + place[1 + min(i, j), 1 + max(i, j)]] -= offset[j]
    return scores


def sums_at_estimate(recursion: Recursion, parts: Any) -> FrameSums:
    """Sums over all frames (an iterable of StarFrames) linearised at the final optics."""
    sums = FrameSums.empty(len(recursion.origin), recursion.pair_covariance == "diagonal")
    moved = np.zeros(len(recursion.origin))
    moved[: len(recursion.offset)] = recursion.offset
    frames = 0
    for part in parts:
        normals = frame_normals(
            part, recursion.model_name, recursion.theta, recursion.scale, recursion.pair_covariance
        )
        grams, entries = frame_entries(normals, moved)
        for gram, entry, size in zip(grams, entries, part.sizes.tolist(), strict=True):
            sums.add(gram, entry, size)
        frames += part.n_frames
    if frames != recursion.n_frames:
        raise CalibrationError(
            f"the source gave {recursion.n_frames} frames at first and {frames} when it was read "
            "again: "
            "pass a source that repeats itself, or an iterator, which is read once."
        )
    return sums


def filter_stage(recursion: Recursion, seconds: float) -> Stage:
    """The trajectory of a filter."""
    history, p, q = recursion.history, len(recursion.origin), len(recursion.offset)
    n = len(history.costs)
    trajectory, sigmas = np.tile(recursion.origin, (n, 1)), np.zeros((n, p))
    trajectory[:, :q] += recursion.scale[:q] * np.array(history.estimates).reshape(n, q)
    sigmas[:, :q] = recursion.scale[:q] * np.array(history.sigmas).reshape(n, q)
    if n and not np.array_equal(trajectory[-1], recursion.theta):
        # A thinned history may have left out the last frame.
        trajectory[-1] = recursion.theta
        sigmas[-1, :q] = recursion.sigma * root_diagonal(recursion.covariance) * recursion.scale[:q]
    cost = np.array(history.costs)
    return Stage(
        "filter", trajectory, cost, filter_status(recursion), recursion.n_frames, seconds, sigmas
    )


def filter_status(recursion: Recursion) -> Status:
    """Whether the frames determined every parameter, and the last estimate agrees with its
    linearisation.
    """
    prior = root_diagonal(recursion.start_covariance)
    if np.any(root_diagonal(recursion.covariance) > _UNMEASURED * prior):
        return Status.SINGULAR
    return Status.CONVERGED if recursion.settled else Status.MAX_ITERATIONS


def distortion_after(
    recursion: Recursion, estimate: JointEstimate, sums: FrameSums | None
) -> Stage:
    """The linear step from no distortion to the estimated one, as a stage."""
    gram = (recursion.sums if sums is None else sums).gram
    ends = np.stack([recursion.theta, estimate.theta])
    offsets = (ends - recursion.origin) / recursion.scale
    columns = np.concatenate([np.ones((2, 1)), -offsets], axis=1)
    cost = np.einsum("ni,ij,nj->n", columns, gram, columns)
    return Stage("distortion", ends, cost, Status.CONVERGED, 1, 0.0)


def stream_calibration(
    recursion: Recursion,
    nominal: Camera,
    method: str,
    stages: list[Stage],
    status: Status,
    settings: AnyDict,
    data_hash: str | None,
    per_star: bool,
    estimate: JointEstimate,
) -> Calibration:
    """A `Calibration` from what the recursion has summed; the arrays over frames and stars are
    empty.

    `Calibration.information` and `Calibration.compressed` are those of the frames where they were
    linearised: for ``samaan`` without distortion.
    """
    theta, scale = estimate.theta, recursion.scale
    p, sums = len(theta), recursion.sums
    offset = (theta - recursion.origin) / scale
    matrix = sums.gram[1:, 1:]
    gradient = sums.gram[1:, 0] - matrix @ offset
    chi2 = float(sums.gram[0, 0] - (sums.gram[1:, 0] + gradient) @ offset)
    dof = round(sums.degrees) - p
    if dof <= 0 or is_singular(matrix):
        raise CalibrationError(
            f"{recursion.n_stars} stars in {recursion.n_frames} frames do not determine {p} "
            "parameters and the noise",
            Status.SINGULAR,
            reason=Status.SINGULAR.remedy,
        )
    sigma = float(np.sqrt(max(chi2, 0.0) / dof))
    frames = recursion.n_frames
    return Calibration.of(
        nominal,
        KeptFrames.none(per_star, data_hash),
        {"method": method, "solver": "filter"} | settings,
        theta=theta,
        sigma=sigma,
        dof=dof,
        status=status,
        covariance=estimate.covariance,
        stages=tuple(stages),
        chi2=chi2,
        information=matrix / np.outer(scale, scale) / sigma**2,
        rotation_per_theta=recursion.response / frames / scale,
        attitude_noise=recursion.noise / frames * sigma**2,
        pair_theta=theta,
        pair_covariance=estimate.covariance,
        compressed=_quadratic(recursion, theta, chi2, gradient, sigma, dof + p),
    )


def _quadratic(
    recursion: Recursion,
    theta: FloatArray,
    chi2: float,
    gradient: FloatArray,
    sigma: float,
    degrees: int,
) -> CompressedLikelihood:
    """The likelihood of the linearised frames; the slope of the attitudes' volume, 0.01 sigma, is
    left out.
    """
    p, matrix = len(theta), recursion.sums.gram[1:, 1:]
    reduced, unit = correlation_of(matrix)
    whitening = np.linalg.cholesky(np.linalg.inv(reduced)) / unit[:, None] * sigma
    q = (p + 1) * (p + 2) // 2
    gram = np.zeros((q, q))
    gram[0, 0] = chi2
    gram[0, 1 : p + 1] = gram[1 : p + 1, 0] = -(whitening.T @ gradient)
    gram[1 : p + 1, 1 : p + 1] = whitening.T @ matrix @ whitening
    return CompressedLikelihood(
        theta_hat=theta,
        whitening=whitening * recursion.scale[:, None],
        gram=gram,
        log_determinant=0.0,
        log_determinant_slope=np.zeros(p),
        dof=degrees,
        n_stars=recursion.n_stars,
        n_frames=recursion.n_frames,
    )
