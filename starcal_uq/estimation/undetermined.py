"""Which parameters data leave open, and what would determine them."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import get_model, undistorted
from starcal_uq.core.findings import clause
from starcal_uq.core.status import Status
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.maths.linear import root_diagonal, scaled_inverse

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.types import AnyDict, FloatArray

# A standard deviation of a third of its natural size (`_natural`) is no knowledge: the likelihood
# bends before that.
_OPEN = 0.3
# So little is no reason to distrust an estimate, and enough to explain why there is none.
WEAK = 0.05
# Part of a direction below which a parameter does not count as one of those that it mixes.
_PART = 0.15
# Distortion that none explains with more probability than this may be none; the estimate has looked
# for it all around.
_NONE_P = 3e-7
# Principal points known to this part of half the detector without distortion do not depend on
# whether there is some.
_POINT = 0.03
# A factor on standard deviations, without the coma of a distortion that may be none, that is worth
# a warning.
COMA_MATTERS = 1.25
# Ends that undetermined parameters explain.
EXPLAINED = (
    *(Status.CONVERGED, Status.MAX_ITERATIONS, Status.SINGULAR, Status.STALLED),
    *(Status.OUTSIDE_DETECTOR, Status.FOLDED),
)


def open_parameters(
    matrix: FloatArray, noise: float, camera: Camera, limit: float = _OPEN
) -> tuple[str, ...]:
    """Names of the parameters of all directions that data leave open.

    `matrix` (p, p): Gauss-Newton matrix of the marginal likelihood, px units. `noise`: noise per
    axis, px, or the factor on the stated noise. `camera`: its detector, focal length and model say
    how large each parameter can be at most: half the detector, the
        focal length, a displacement of the corner as large as its distance.
    `limit`: standard deviation, as a fraction of that, from which on a direction is open.
    """
    natural = _natural(camera)
    scaled = matrix * np.outer(natural, natural) / noise**2
    if not np.isfinite(scaled).all():
        return ()
    values, vectors = np.linalg.eigh(scaled)
    # What is a hundred times better known than the rest is not what is missing.
    mixed = np.abs(
        vectors[:, values < min(1.0 / limit**2, max(1e4 * values[0], 1e-12 * values[-1]))]
    )
    named = (mixed > _PART * np.max(mixed, axis=0, initial=0.0)).any(axis=1)
    return tuple(name for name, flag in zip(camera.parameter_names, named, strict=True) if flag)


def _natural(camera: Camera) -> FloatArray:
    """Largest sensible size (p,) of each parameter, px units."""
    powers = np.array(
        [c.order for c in get_model(camera.distortion).coefficients], dtype=np.float64
    )
    sizes = [0.5 * camera.width_px, 0.5 * camera.height_px, camera.focal_px]
    return np.concatenate([sizes, camera.half_diagonal_px ** (1.0 - powers)])


def undetermined(
    likelihood: MarginalLikelihood,
    theta: FloatArray,
    matrix: FloatArray,
    noise: float,
    camera: Camera,
    status: Status,
) -> tuple[tuple[str, ...], FloatArray]:
    """What the data leave open at an estimate theta (p,), and what coma of noise seems to tell.

    The coma of the distortion tells where the principal point is, and in narrow fields nothing else
    does. Where the distortion may be none, coma of noise tells nothing: the data must determine the
    point without it.

    Returns
    -------
    names : tuple of str
        Parameters that the data leave open, if that can explain the status.
    factors : (p,) array
        Standard deviations without the coma over those of the matrix; ones where the coma does not
        matter.
    """
    from scipy.special import fdtrc

    as_found = np.ones(len(theta))
    if status not in EXPLAINED or not noise > 0.0:
        return (), as_found
    found = open_parameters(matrix, noise, camera)
    lens = get_model(camera.distortion).of_lens
    if found or not len(k := theta[lens]):
        return found, as_found
    covariance = scaled_inverse(matrix) * noise**2
    dof = max(likelihood.dof - len(theta), 1)
    # Chi-square of no distortion.
    size = float(k @ scaled_inverse(covariance[lens, lens]) @ k)
    if fdtrc(len(k), dof, size / len(k)) < _NONE_P:
        return (), as_found
    matrix = likelihood.evaluate(undistorted(camera.distortion, theta)).matrix
    if found := open_parameters(matrix, noise, camera):
        return found, as_found
    told = scaled_inverse(matrix) * noise**2
    unsure = root_diagonal(told) > _POINT * _natural(camera)
    factors = _without_coma(covariance, told, size, lens)
    by_coma = unsure[:2] & (factors[:2] > COMA_MATTERS)
    if by_coma.any() and not status.ok:
        # It is then also why no optimum was found.
        return tuple(
            name for name, flag in zip(camera.parameter_names, by_coma, strict=False) if flag
        ), as_found
    return (), factors if unsure[:2].any() else as_found


def _without_coma(covariance: FloatArray, told: FloatArray, size: float, lens: slice) -> FloatArray:
    """Factors (p,), at least 1, on the standard deviations of an estimate whose distortion may be
    none.

    `covariance` (p, p): that of the estimate; `told` (p, p): that without distortion, which leaves
    the point to the tilt of the field. A distortion of noise has noise for a coma: of the point it
    knows nothing, and a point that is free to follow it makes it larger. What the coma seems to
    know of the point, in units of what is known without it, is the chi-square of the distortion
    (`size`) times the relative variance that the point's own adds to the coefficients; f follows
    them by regression.
    """
    seeming = np.diag(told)[:2] / np.diag(covariance)[:2] - 1.0
    growth = float(np.sum(np.maximum(seeming, 0.0))) / size
    by_coefficients = told[:, lens] @ scaled_inverse(told[lens, lens]) @ told[lens]
    variance = np.diag(told + growth * by_coefficients)
    return np.maximum(np.sqrt(variance / np.diag(covariance)), 1.0)


def coma_record(camera: Camera, factors: FloatArray) -> AnyDict:
    """What a provenance keeps of the factors (p,) of `undetermined`; empty where the coma does not
    matter.
    """
    if not np.any(factors > 1.0):
        return {}
    return {"without_coma": dict(zip(camera.parameter_names, factors.tolist(), strict=True))}


# What the data leave open, and what would determine it.
Open = Enum("Open", "PARAMETERS RICHER REMEDY")


def remedy_of(status: Status, names: tuple[str, ...], model: str, solver: str = "") -> str:
    """The remedy of a status of a model, in terms of the parameters that the data leave open, where
    there are some.
    """
    tilts = get_model(model).tilts
    return clause(Open.REMEDY, status=status, names=names, tilts=tilts, solver=solver)
