"""Which parameters data leave open, and what would determine them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import get_model
from starcal_uq.core.formatting import join_words
from starcal_uq.core.status import Status
from starcal_uq.estimation.marginal import MarginalLikelihood
from starcal_uq.maths.linear import scaled_inverse

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.core.types import FloatArray

# A standard deviation of a third of its natural size (`_natural`) is no knowledge: the likelihood bends before that.
_OPEN = 0.3
# So little is no reason to distrust an estimate, and enough to explain why there is none.
WEAK = 0.05
# Part of a direction below which a parameter does not count as one of those that it mixes.
_PART = 0.15
# Distortion that none explains with more probability than this may be none; the estimate has looked for it all around.
_NONE_P = 3e-7
# Principal points known to this part of half the detector without distortion do not depend on whether there is some.
_POINT = 0.03
# Part that is left of the point's standard deviation where the coma of a distortion that may be none tells it.
_FROM_COMA = 0.8
# Ends that undetermined parameters explain.
EXPLAINED = (
    *(Status.CONVERGED, Status.MAX_ITERATIONS, Status.SINGULAR, Status.STALLED),
    *(Status.OUTSIDE_DETECTOR, Status.FOLDED),
)


def open_parameters(matrix: FloatArray, noise: float, camera: Camera, limit: float = _OPEN) -> tuple[str, ...]:
    """Names of the parameters of all directions that data leave open.

    `matrix` (p, p): Gauss-Newton matrix of the marginal likelihood, px units.
    `noise`: noise per axis, px, or the factor on the stated noise.
    `camera`: its detector, focal length and model say how large each parameter can be at most: half the detector, the
        focal length, a displacement of the corner as large as its distance.
    `limit`: standard deviation, as a fraction of that, from which on a direction is open.
    """
    natural = _natural(camera)
    scaled = matrix * np.outer(natural, natural) / noise**2
    if not np.isfinite(scaled).all():
        return ()
    values, vectors = np.linalg.eigh(scaled)
    # What is a hundred times better known than the rest is not what is missing.
    mixed = np.abs(vectors[:, values < min(1.0 / limit**2, max(1e4 * values[0], 1e-12 * values[-1]))])
    named = (mixed > _PART * np.max(mixed, axis=0, initial=0.0)).any(axis=1)
    return tuple(name for name, flag in zip(camera.parameter_names, named, strict=True) if flag)


def _natural(camera: Camera) -> FloatArray:
    """Largest sensible size (p,) of each parameter, px units."""
    powers = np.array([c.order for c in get_model(camera.distortion).coefficients], dtype=np.float64)
    sizes = [0.5 * camera.width_px, 0.5 * camera.height_px, camera.focal_px]
    return np.concatenate([sizes, camera.half_diagonal_px ** (1.0 - powers)])


def undetermined(
    likelihood: MarginalLikelihood, theta: FloatArray, matrix: FloatArray, noise: float, camera: Camera, status: Status
) -> tuple[str, ...]:
    """Names of the parameters that the data leave open at an estimate theta (p,), if that can explain the status.

    The coma of the distortion tells where the principal point is, and in narrow fields nothing else does: where the
    distortion may be none, the data must determine the point without it, and about as well.
    """
    from scipy.special import fdtrc

    if status not in EXPLAINED or not noise > 0.0:
        return ()
    found = open_parameters(matrix, noise, camera)
    if found or len(theta) == 3:
        return found
    covariance = scaled_inverse(matrix) * noise**2
    point, k, dof = np.sqrt(np.diag(covariance))[:2], theta[3:], max(likelihood.dof - len(theta), 1)
    if fdtrc(len(k), dof, float(k @ scaled_inverse(covariance[3:, 3:]) @ k) / len(k)) < _NONE_P:
        return ()
    without = MarginalLikelihood(likelihood.frames, likelihood.model_name)
    if likelihood.rotations is not None:
        without.use_rotations(likelihood.rotations)
    plain = np.concatenate([theta[:3], np.zeros(len(k))])
    matrix = without.evaluate(plain).matrix
    if found := open_parameters(matrix, noise, camera):
        return found
    told = np.sqrt(np.diag(scaled_inverse(matrix)))[:2] * noise
    by_coma = (told > _POINT * _natural(camera)[:2]) & (point < _FROM_COMA * told)
    return tuple(name for name, flag in zip(camera.parameter_names, by_coma, strict=False) if flag)


def what_is_open(names: tuple[str, ...]) -> str:
    """One clause: what the data leave open."""
    apart = len(names) > 1 and not set(names) <= {"x0", "y0"}
    return (
        f"the data do not tell {join_words(names)} apart" if apart else f"the data do not determine {join_words(names)}"
    )


def what_is_missing(names: tuple[str, ...]) -> str:
    """One clause: what the data leave open, and what would determine it."""
    if set(names) <= {"x0", "y0"}:
        return f"{what_is_open(names)}: more frames, or stars over a wider field, are needed"
    where = "over the whole field, along both axes," if set(names) & {"x0", "y0", "p1", "p2"} else "at more radii"
    fewer = ", or a distortion model with fewer coefficients" if set(names) - {"x0", "y0", "f"} else ""
    return f"{what_is_open(names)}: stars {where} are needed{fewer}"


# A filter has no solver to choose and no iterations to raise: it saw the frames one by one.
_ASTRAY = {
    Status.OUTSIDE_DETECTOR: "the principal point left the detector",
    Status.FOLDED: "the distortion folds over inside the field",
    Status.MAX_ITERATIONS: "its first frames lead to no optimum",
    Status.SINGULAR: "its frames, one by one, do not determine the optics",
}


def remedy_of(status: Status, names: tuple[str, ...], solver: str = "") -> str:
    """The remedy of a status, in terms of the parameters that the data leave open, where there are some."""
    if solver == "filter" and status in _ASTRAY and not names:
        return f"{_ASTRAY[status]}: use method='efficient', which weighs all frames together"
    return what_is_missing(names) if names else status.remedy
