"""A calibration of observations in partitions, which need not fit into memory or stand on one
machine.

Each step is one pass: every partition is read where it is worked on, becomes a few small matrices,
and these are added up in a fixed tree. The refinement solves the sums of the partitions' normal
equations, whose attitudes are eliminated frame by frame; the partitions' Gram matrices at the
estimate add up to the compressed likelihood. Only a stated sample of frames is kept, for what looks
at stars one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from starcal_uq.attitude.rotations import rotation_to_quaternion
from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, like, model_names, simpler_models
from starcal_uq.core.cluster import Cluster
from starcal_uq.core.errors import CalibrationError, RepeatedFramesError
from starcal_uq.core.provenance import provenance
from starcal_uq.core.types import FloatArray, IntArray, Progress
from starcal_uq.estimation.assemble import check_noise
from starcal_uq.estimation.duplicates import repeated
from starcal_uq.estimation.effects import Around, with_effects_of
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.estimation.partitioned_effects import Beside, FileStars
from starcal_uq.estimation.residual_map import (
    OUTLIER_SIGMA,
    FrameScatter,
    PartitionSums,
    ResidualMap,
    RicherModel,
)
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.stages import Stage
from starcal_uq.likelihood import paths
from starcal_uq.likelihood.compressed import GramSums, gram_sums, optimum, settled
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.solvers import Normal, is_singular, levenberg_marquardt, reason_of
from starcal_uq.likelihood.sums import NormalSums, frame_sums, sum_of
from starcal_uq.maths.linear import scaled_cholesky, scaled_inverse, unit_diagonal
from starcal_uq.observations.checks import row_hashes
from starcal_uq.observations.partitions import (
    Partition,
    PartitionedObservations,
    PartitionReader,
    joined_hash,
)
from starcal_uq.observations.table import Observations

T = TypeVar("T")
# Standard deviations of the estimate: last step of the solver, from where one of Newton's on the
# expansion finds the optimum, and its length that needs no new expansion.
_LAST_STEP, _NEAR = 0.5, 1e-5


@dataclass(frozen=True)
class _Seen:
    """What the first pass has seen: normal equations, data hashes; number and content of every
    frame if asked for.
    """

    sums: NormalSums
    hashes: tuple[str, ...]
    frames: IntArray
    content: NDArray[np.uint64]


def _with_kernels(kernels: str, one: Callable[[Partition], T], part: Partition) -> T:
    with paths.using(kernels):
        return one(part)


def _look(
    reader: PartitionReader, model: str, theta: FloatArray, by_content: bool, part: Partition
) -> _Seen:
    obs = reader.load(part, check=True)
    sums, hashes = _sums(obs, model, theta), (obs.data_hash,)
    if not by_content:
        return _Seen(sums, hashes, obs.frame_ids[:0], np.empty(0, dtype=np.uint64))
    # Equal pixels in any order of the stars have equal sums.
    with np.errstate(over="ignore"):
        content = np.add.reduceat(row_hashes(obs.x_px, obs.y_px), obs.frame_starts[:-1])
    return _Seen(sums, hashes, obs.frame_ids, content)


def _seen_together(parts: Sequence[_Seen]) -> _Seen:
    return _Seen(
        sum_of([part.sums for part in parts]),
        tuple(value for part in parts for value in part.hashes),
        np.concatenate([part.frames for part in parts]),
        np.concatenate([part.content for part in parts]),
    )


def _normal(reader: PartitionReader, model: str, theta: FloatArray, part: Partition) -> NormalSums:
    return _sums(reader.load(part), model, theta)


def _sums(obs: Observations, model: str, theta: FloatArray) -> NormalSums:
    return MarginalLikelihood(obs, model).sums(theta)[0]


def _gram(
    reader: PartitionReader, model: str, theta: FloatArray, whitening: FloatArray, part: Partition
) -> GramSums:
    likelihood = MarginalLikelihood(reader.load(part), model)
    return gram_sums(likelihood.frames, model, theta, whitening, likelihood.sums(theta))


@dataclass(frozen=True)
class _Residuals:
    """Sums over stars and frames at the estimate: normal equations, attitudes' response and
    covariance, residuals.

    `richer` are the normal equations of the models of which that of the camera is a special case.
    """

    normal: NormalSums
    response: FloatArray
    inverse: FloatArray
    sums: PartitionSums
    richer: tuple[NormalSums, ...]


def _richer(camera: Camera) -> list[Camera]:
    """The same camera by every model with more terms that models are compared with."""
    return [
        camera.replace(distortion=name)
        for name in (like(base, camera.distortion) for base in model_names())
        if get_model(name).compared and camera.distortion in simpler_models(name)
    ]


def _residuals(
    reader: PartitionReader,
    camera: Camera,
    theta: FloatArray,
    scale: float,
    n_stars: int,
    beside: Beside | None,
    part: Partition,
) -> _Residuals:
    obs, frames = (
        (reader.load(part), None) if beside is None else beside.cleared(part, np.ones_like(theta))
    )
    likelihood = MarginalLikelihood(obs, camera.distortion)
    whole = likelihood.frames
    normal, attitudes = likelihood.sums(theta)
    e = likelihood.residuals(theta, attitudes.rotations)
    if frames is not None:
        slopes, matrix = frames.slopes.sum(axis=0), frames.matrix
        normal = replace(normal, gradient=-slopes, matrix=matrix)
    stated = obs.sigma_or_one
    size = np.max(np.abs(e), axis=0) / scale
    worst = int(np.argmax(size))
    sums = PartitionSums(
        n_stars=np.array([obs.n_stars]),
        n_frames=np.array([obs.n_frames]),
        chi2=np.array([float(np.sum(e**2))]),
        residuals=ResidualMap.of(camera, n_stars, whole.pixel, whole.in_pixels(e), stated),
        stated2=float(np.sum(stated**2)),
        n_beyond=int(np.count_nonzero(size > OUTLIER_SIGMA)),
        largest=float(size[worst]),
        largest_frame=int(obs.frame[worst]),
    )
    # Without their further terms these models are the camera's: the attitudes are known, and one
    # pass is enough.
    with paths.using("numpy"):
        richer = tuple(
            frame_sums(whole, other.distortion, other.theta, attitudes.at(theta))[0]
            for other in _richer(camera)
        )
    return _Residuals(
        normal, np.sum(attitudes.response, axis=2), np.sum(attitudes.inverse, axis=2), sums, richer
    )


def _added_residuals(parts: Sequence[_Residuals]) -> _Residuals:
    return _Residuals(
        sum_of([part.normal for part in parts]),
        np.sum([part.response for part in parts], axis=0),
        np.sum([part.inverse for part in parts], axis=0),
        PartitionSums.joined([part.sums for part in parts]),
        tuple(sum_of(some) for some in zip(*(part.richer for part in parts), strict=True)),
    )


def _scatter(
    reader: PartitionReader,
    model: str,
    theta: FloatArray,
    whole: Normal,
    beside: Beside | None,
    part: Partition,
) -> FrameScatter:
    matrix, scale = unit_diagonal(whole.matrix)
    scaled = matrix, -whole.gradient * scale
    obs, own = (reader.load(part), None) if beside is None else beside.cleared(part, scale)
    if own is None:
        own = FrameNormals.around(obs, model, theta, None, scale)
    return own.scatter(scaled)


def _stepped(
    camera: Camera, sums: Sequence[NormalSums], variance: float
) -> tuple[RicherModel, ...]:
    """The richer models of `_richer` after one step; those that the stars do not determine are left
    out.
    """
    found = []
    for other, total in zip(_richer(camera), sums, strict=True):
        normal = total.normal
        if not np.isfinite(normal.cost) or is_singular(normal.matrix):
            continue
        step = -scaled_inverse(normal.matrix) @ normal.gradient
        n_terms = len(step) - len(camera.theta)
        found.append(
            RicherModel(
                other.distortion,
                other.theta + step,
                n_terms,
                float(-step @ normal.gradient) / variance,
            )
        )
    return tuple(found)


def calibrate_partitions(
    obs: PartitionedObservations,
    sample: Observations,
    start: Calibration,
    cluster: Cluster,
    *,
    max_iterations: int,
    duplicates: str,
    effects: Sequence[str] = (),
    progress: Progress | None = None,
) -> Calibration:
    """Refine a calibration of a sample of frames on all partitions.

    `start`: calibration of the sample by the ``efficient`` method; its estimate from interstar
    angles stays. `cluster`: processes that read the partitions. `effects`: those that shift
    stars; with ``auto`` also those that the data support.
    `duplicates`: what to do with frames that hold the same pixels as another. `progress`: called
    with (partitions done, partitions) in every pass. CalibrationError when there is no estimate.
    RepeatedFramesError when frames hold the same pixels and are refused. ObservationError for bad
    rows, with the file.
    """
    reader, model, began = obs.reader, start.camera.distortion, perf_counter()
    # Chosen here once: what one process has compiled in the meantime must not change the digits of
    # another.
    kernels = paths.chosen(obs.n_stars)
    first = start.stages[-1].theta

    def total(one: Callable[[Partition], T], together: Callable[[Sequence[T]], T]) -> T:
        return cluster.reduce(
            partial(_with_kernels, kernels, one), obs.parts, together, progress=progress
        )

    seen = total(partial(_look, reader, model, first, duplicates == "refuse"), _seen_together)
    _refuse_repeated(seen)
    n_stars, n_frames = seen.sums.n_stars, seen.sums.n_frames
    dof = 2 * n_stars - 3 * n_frames - len(first)

    def evaluate(theta: FloatArray) -> Normal:
        known = np.array_equal(theta, first)
        return (
            seen.sums if known else total(partial(_normal, reader, model, theta), sum_of)
        ).normal

    found = levenberg_marquardt(
        evaluate, first, max_iterations=max_iterations, tolerance=_LAST_STEP**2 / dof
    )
    theta, normal, status = found.theta, found.normal, found.status
    if not np.isfinite(normal.cost) or is_singular(normal.matrix):
        reason = reason_of(status, normal.cost)
        raise CalibrationError(
            f"the calibration failed ({reason.name})", reason, reason=reason.remedy
        )
    whitening = scaled_cholesky(scaled_inverse(normal.matrix) * normal.cost / dof)
    for _ in range(max_iterations):
        gram = total(partial(_gram, reader, model, theta, whitening), sum_of)
        here = gram.likelihood(theta, whitening)
        best = optimum(settled(here))
        theta = best.theta
        # The expansion is exact to second order: so near, its optimum is that of all stars to
        # rounding.
        if float(np.max(np.abs(here.whiten(theta)))) < _NEAR:
            break
    compressed, sigma = best.compressed, best.sigma
    sampled = replace(start.stages[-1], name="sample")
    ways, costs = np.vstack([found.trajectory, theta]), np.append(found.costs, best.sum_of_squares)
    stage = Stage("refinement", ways, costs, status, found.evaluations + 1, perf_counter() - began)
    # As in `assemble`: the rotation-volume term moves the maximum by about 0.01 sigma of a small
    # table.
    theta = theta - 0.5 * compressed.whitening @ compressed.log_determinant_slope
    likelihood = MarginalLikelihood(sample, model)
    state, _ = likelihood.profile(theta)
    record = provenance(None, start.provenance.settings, joined_hash(seen.hashes))
    about = {
        "folder": str(obs.folder),
        "n_files": len(obs.parts),
        "n_stars": n_stars,
        "n_frames": n_frames,
        "sample_frames": sample.n_frames,
        "sample_stars": sample.n_stars,
        "sample_sha256": sample.data_hash,
        # By which another folder that has some of the files is known.
        "data_sha256": sorted(seen.hashes),
    }
    cal = start.moved(
        theta,
        sigma,
        dof,
        status,
        covariance=best.covariance,
        stages=(*start.stages[:-1], sampled, stage),
        quaternions=rotation_to_quaternion(state.rotations),
        residuals_px=likelihood.frames.in_pixels(state.e).T,
        chi2=best.sum_of_squares,
        information=best.information,
        compressed=compressed,
        provenance=record.adding(partitions=about, kernels=kernels),
        fingerprints=None,
    )
    beside = None
    if effects:
        n = dof + len(first)
        stars = FileStars(obs, sample, Around.of(cal), n, effects, total)
        cal = with_effects_of(stars, cal, effects)
        held = cal.known_effects
        if held.fitted:
            held = replace(held, node_grams=held.node_grams[:0])
            beside = Beside(stars.files, held, cal.theta, cal.sigma)
    camera, theta, sigma = cal.camera, cal.theta, cal.sigma
    scale = sigma * float(np.sqrt(dof / (2.0 * n_stars)))
    looking = partial(_residuals, reader, camera, theta, scale, n_stars, beside)
    rest = total(looking, _added_residuals)
    scatter = total(partial(_scatter, reader, model, theta, rest.normal.normal, beside), sum_of)
    size = float(np.sqrt(np.mean(cal.residuals_px**2)))
    richer = _stepped(camera, rest.richer, sigma**2)
    return replace(
        cal,
        status=check_noise(size, camera, cal.status),
        chi2=float(np.sum(rest.sums.chi2)) if beside is None else cal.chi2,
        rotation_per_theta=rest.response / n_frames,
        attitude_noise=rest.inverse / n_frames * sigma**2,
        partitions=replace(rest.sums, richer=richer, scatter=scatter),
    )


def _refuse_repeated(seen: _Seen) -> None:
    order = np.argsort(seen.content, kind="stable")
    same = np.flatnonzero(seen.content[order][1:] == seen.content[order][:-1])
    if not len(same):
        return
    pairs = np.sort(
        np.column_stack([seen.frames[order[same]], seen.frames[order[same + 1]]]), axis=1
    )
    raise RepeatedFramesError(
        f"{repeated('pixels', pairs, len(pairs))}: they would count twice; remove the "
        "later ones from the files, or, if you know them to be exposures of their own, keep them "
        "(duplicates='keep', "
        "--duplicates keep).",
        pairs=pairs.tolist(),
    )
