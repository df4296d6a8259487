"""The pattern that the misfit tests found, fitted, and what it does to attitudes.

A test says that residuals hold structure; it does not say what that does to a mission. So the
shapes that the tests found are fitted together, the strongest first and each further one only as
far as it explains what those before leave. The attitude of a frame then errs by its least-squares
response

    phi = (A^T W A)^-1 A^T W (C - B G) a,

with A the attitude Jacobian of that frame, C the shapes at its own stars, a their amplitudes, B the
derivatives by the camera's parameters and G what the calibration's parameters took up of each
shape. Amplitudes have an error, so that the square of what they give is too large by its own
variance on average: that is taken off, and what is left has a bound.

Shapes that are a basis for any smooth misfit hold combinations that attitudes or parameters
imitate, and by which even a small leak of another misfit would be divided. Their amplitudes have a
prior, as large in every combination, px over the stars, as those are that the residuals show well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.constants import ARCSEC
from starcal_uq.core.types import FloatArray, Shapes, floats
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import (
    FRAME_BY_FRAME,
    MAX_CELLS,
    OVER_FIELD,
    Shape,
    View,
    frame_shapes,
    shapes,
)
from starcal_uq.maths.linear import principal, scaled_inverse, truncated_inverse, without_first
from starcal_uq.propagation.alignment import alignment_weights
from starcal_uq.propagation.geometry import FrameGeometry

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.observations.table import Observations

_STARS_AT_ONCE = 10_000
# One-sided 95 % quantile of the normal distribution.
_UPPER = 1.645
# Directions of which attitudes and parameters absorb all but this share of the square are not
# there.
_ABSORBED = 1e-8
_DIRECTION_P = 0.05
# Share of the square of a shape that attitudes and parameters must leave in sight for its amplitude
# to set a prior, and effects for it to be looked for: one that these explain almost as large as the
# data could show it says how well their prior describes them, and not what they leave.
_SEEN = 0.1
# Standard errors that a variance over frames has to exceed.
_SAID = 3.0


@dataclass(frozen=True, eq=False)
class Pattern:
    """Shapes of displacement that the residuals ask for, fitted together."""

    families: tuple[str, ...]  # Names of the tests whose shapes are in it, the strongest first
    # (q, J): combinations of the families' columns, px, that the residuals determine, but for
    # frames by themselves.
    directions: FloatArray
    amplitudes: FloatArray  # (J,): amplitude of every direction
    covariance: FloatArray  # (J, J): covariance of the amplitudes
    parameters: (
        FloatArray  # (J, p): what the calibrated parameters took up of every direction, px units
    )
    # (3, 3): covariance over frames of scale and of two components of shape, px at the corner; zero
    # where frames agree.
    frame_covariance: FloatArray
    variance: float  # Variance of the noise that is left, px^2, or relative to what stars state
    n_frames: int = 0  # Number of frames behind it
    max_cells: int = MAX_CELLS  # Largest number of field cells along the longer side
    n_with_prior: int = 0  # Number of directions, the last ones, whose amplitudes have a prior
    left_out: tuple[
        int, ...
    ] = ()  # Rows of the table that had no say in the fit, and in the families' columns

    SHAPES: ClassVar[Shapes] = {
        **{
            "directions": ("q", "j"),
            "amplitudes": ("j",),
            "covariance": ("j", "j"),
            "parameters": ("j", "p"),
        },
        "frame_covariance": (3, 3),
    }

    @property
    def products(self) -> FloatArray:
        """Expected products (J, J) of the true amplitudes.

        What has a prior is as large as that leaves it, what has none by its noise smaller than it
        is estimated.
        """
        first = len(self.amplitudes) - self.n_with_prior
        made = np.outer(self.amplitudes, self.amplitudes) - self.covariance
        made[first:, first:] += 2.0 * self.covariance[first:, first:]
        return made

    def among(self, families: Sequence[Shape]) -> list[Shape]:
        """Its own families, in the order of the rows of `directions`; LookupError where one is not
        among these.
        """
        known = {family.name: family for family in families}
        return [known[name] for name in self.families if name != FRAME_BY_FRAME]


@dataclass(frozen=True, eq=False)
class Response:
    """What a pattern does to the attitudes of some frames."""

    # `common_arcsec`, `rest_arcsec`, (3,): common rotation, and root mean square over frames of the
    # rest, about pitch, yaw and roll; the noise of the amplitudes is taken off their squares.
    common_arcsec: FloatArray
    rest_arcsec: FloatArray
    # `common_upper_arcsec`, `rest_upper_arcsec`, (3,): bounds of both at 95 %.
    common_upper_arcsec: FloatArray
    rest_upper_arcsec: FloatArray

    SHAPES: ClassVar[Shapes] = {
        **dict.fromkeys(
            ("common_arcsec", "rest_arcsec", "common_upper_arcsec", "rest_upper_arcsec"), (3,)
        )
    }


def response(
    pattern: Pattern,
    theta: Sequence[float],
    post: Posterior,
    obs: Observations,
    seen: Observations,
    aligned: Observations | None = None,
) -> Response:
    """What a pattern does to attitudes.

    `pattern`: the pattern, at least of one family.
    `theta`: estimate of the camera that it was found beside, px units. `post`, `obs`: posterior and
    data of the calibration.
    `seen`, `aligned`: frames of the mission, and those of its alignment, which decide what is
    common; `seen` if they
        are not given. Where frames have no time, temperature or magnitudes, they get those of the
        calibration's frames and stars.
    LookupError if the data do not offer a shape of the pattern, which then is not of them.
    """
    if pattern.left_out:
        # Which shapes there are, and their scales, follow from the stars that they were fitted to.
        fitted = obs.select(~np.isin(np.arange(obs.n_stars), pattern.left_out))
        seen, aligned, obs = (
            fitted if seen is obs else seen,
            fitted if aligned is obs else aligned,
            fitted,
        )
    camera = post.camera.with_theta(floats(theta))
    here = _Turned.of(pattern, camera, post, obs, seen)
    there = (
        here
        if aligned is None or aligned is seen
        else _Turned.of(pattern, camera, post, obs, aligned)
    )
    weights, _ = alignment_weights(there.noise_covariance)
    together = np.einsum("nij,njk->ik", weights, there.direct)
    apart = here.direct - together
    common = common_error = rest = rest_error = np.zeros(3)
    if len(pattern.amplitudes):
        common, common_error = _square(np.einsum("ij,ik->ijk", together, together), pattern)
        rest, rest_error = _square(np.einsum("kij,kil->ijl", apart, apart) / len(apart), pattern)
    own = np.mean(
        np.einsum("kia,ab,kib->ki", here.moving, pattern.frame_covariance, here.moving), axis=0
    )
    rest = rest + own
    # A variance over this many frames is known to this share of itself.
    rest_error = np.hypot(rest_error, own * np.sqrt(2.0 / max(pattern.n_frames - 1, 1)))

    def arcsec(square: FloatArray) -> FloatArray:
        root: FloatArray = np.sqrt(np.maximum(square, 0.0)) * ARCSEC
        return root

    return Response(
        common_arcsec=arcsec(common),
        rest_arcsec=arcsec(rest),
        common_upper_arcsec=arcsec(np.maximum(common, 0.0) + _UPPER * common_error),
        rest_upper_arcsec=arcsec(np.maximum(rest, 0.0) + _UPPER * rest_error),
    )


@dataclass(frozen=True, eq=False)
class _Turned:
    """Turns of frames by directions (K, 3, J) and by scale and shape of their own (K, 3, 3), rad;
    their noise.
    """

    direct: FloatArray
    moving: FloatArray
    noise_covariance: FloatArray

    @classmethod
    def of(
        cls,
        pattern: Pattern,
        camera: Camera,
        post: Posterior,
        obs: Observations,
        frames: Observations,
    ) -> _Turned:
        chosen = pattern.among(shapes(obs, camera, max_cells=pattern.max_cells, seen=frames))
        geometry = FrameGeometry.of(post, frames)
        own = frame_shapes(camera)

        def columns(view: View) -> FloatArray:
            found = own.columns(view)
            if not chosen:
                return found
            shifts = np.concatenate([family.columns(view) for family in chosen])
            return np.concatenate([found, np.einsum("qj,qan->jan", pattern.directions, shifts)])

        turned = geometry.turned(frames, camera, columns)
        moving, direct = np.split(turned, [3], axis=2)
        if chosen:
            direct = direct + geometry.response @ pattern.parameters.T
        return cls(direct, moving, geometry.noise_covariance)


def _square(matrices: FloatArray, pattern: Pattern) -> tuple[FloatArray, FloatArray]:
    """Expected quadratic forms (3,) of the true amplitudes, and their standard errors."""
    a, C = pattern.amplitudes, pattern.covariance
    noisy = matrices @ C
    value = np.einsum("ijk,jk->i", matrices, pattern.products)
    linear, quadratic = (
        np.einsum("j,ijk,k->i", a, noisy @ matrices, a),
        np.einsum("ijk,ikj->i", noisy, noisy),
    )
    # At the estimate the first term counts the noise once too often; it can then not fall below the
    # second.
    return value, np.sqrt(np.maximum(4.0 * linear - 2.0 * quadratic, 2.0 * quadratic))


@dataclass(eq=False)
class Fit:
    """Sums over all stars from which shapes are fitted, nothing added yet."""

    families: tuple[Shape, ...]
    p: int  # Parameters
    dof: int  # Degrees of freedom of the residuals
    # Those that scale and shape of every frame by itself take
    block_rank: int = field(default=0, init=False)
    # What `gram` would be without effects, where there are any
    before: FloatArray | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        q = sum(family.size for family in self.families)
        size = self.p + 1 + q
        # (p + 1 + q, p + 1 + q): products of parameters, residuals and columns of all families,
        # attitudes removed; and the part of them that scale and shape of every frame by itself
        # explain.
        self.gram, self.blocks = np.zeros((size, size)), np.zeros((size, size))
        # (p + 1 + q,): squares of the same before attitudes were removed
        self.raw = np.zeros(size)
        # (q, q): products of the columns among themselves before attitudes were removed
        self.inner = np.zeros((q, q))

    @cached_property
    def places(self) -> dict[str, slice]:
        """Columns of every family, from 0."""
        ends = np.cumsum([0, *(family.size for family in self.families)]).tolist()
        return {
            family.name: slice(*ends)
            for family, *ends in zip(self.families, ends[:-1], ends[1:], strict=True)
        }

    @cached_property
    def alone(self) -> tuple[FloatArray, int]:
        """Residuals and columns (1 + q, 1 + q) with the parameters removed, and degrees of
        freedom.
        """
        left, _ = without_first(self.gram, self.p, _ABSORBED, self._unit)
        return left, self.dof

    @cached_property
    def beside_frames(self) -> tuple[FloatArray, int]:
        """The same with scale and shape of every frame by itself removed as well."""
        left, rank = without_first(self.gram - self.blocks, self.p, _ABSORBED, self._unit)
        return left, self.dof - self.block_rank + self.p - rank

    @property
    def _unit(self) -> FloatArray:
        return np.asarray(1.0 / np.sqrt(np.diag(self.gram)[: self.p]))

    def seen(self, left: FloatArray, at: slice) -> tuple[FloatArray, FloatArray]:
        """Directions (j, r) of some columns, in units of their lengths, and squares (r,) of what
        `left` (j, j), their products, leaves of each.
        """
        if self.before is None:
            return principal(left, _ABSORBED)
        norm = self.norms(at)
        plain, _ = without_first(self.before, self.p, _ABSORBED, self._unit)
        values, vectors = principal(plain[1:, 1:][at, at] / np.outer(norm, norm), _ABSORBED)
        unit = vectors / np.sqrt(values)
        shares, turn = principal(unit.T @ left @ unit, _SEEN)
        return shares, unit @ turn

    def norms(self, at: slice) -> FloatArray:
        """Lengths of some columns before attitudes were removed; 1 where there is none."""
        norm = np.sqrt(self.raw[self.p + 1 :][at])
        return np.where(norm > 0.0, norm, 1.0)

    def pattern(self, found: Sequence[str], alpha: float) -> Pattern:
        """Fit the families of these names, and frames by themselves, the strongest first.

        `alpha` is the level of a single test; what does not reach it beside those before is left
        out. A family without labels is a basis for any smooth misfit: amplitudes of the first one,
        and of all that come after it, have a prior. One over the field counts with all of its
        shapes, as a misfit has no reason to be only where attitudes and parameters leave it in
        sight; terms of a known form are then no longer separated from it.
        """
        left = {family.name: family for family in self.families if family.name in found}
        frame_by_frame = FRAME_BY_FRAME in found
        chosen: list[str] = []
        directions = np.zeros((len(self.inner), 0))
        own, certain = False, None
        while left or (frame_by_frame and not own):
            system, dof = self.beside_frames if own else self.alone
            rest, dof = _without(system, directions), dof - directions.shape[1]
            steps = {name: self._step(rest, dof, self.places[name], alpha) for name in left}
            gains = {name: step[0] for name, step in steps.items() if step is not None}
            if frame_by_frame and not own:
                both, least = self.beside_frames
                explained = rest[0, 0] - _without(both, directions)[0, 0]
                gain = _gain(rest[0, 0], explained, dof, self.dof - least, alpha)
                gains |= {} if gain is None else {FRAME_BY_FRAME: gain}
            if not gains:
                break
            best = max(gains, key=lambda name: gains[name])
            chosen.append(best)
            if best == FRAME_BY_FRAME:
                own = True
                continue
            step, shape, at = steps[best], left.pop(best), self.places[best]
            assert step is not None
            if certain is None and not shape.labels:
                certain = directions.shape[1]
            combinations = step[1]
            if not shape.labels and shape.against in OVER_FIELD:
                combinations = np.diag(1.0 / self.norms(at))[:, self.raw[self.p + 1 :][at] > 0.0]
                left = {
                    name: other
                    for name, other in left.items()
                    if not other.labels or other.against not in OVER_FIELD
                }
            placed = np.zeros((len(self.inner), combinations.shape[1]))
            placed[at] = combinations
            directions = np.column_stack((directions, placed))
        if certain is None:
            certain = directions.shape[1]
        return self._fitted(tuple(chosen), directions, own, certain)

    def _step(
        self, rest: FloatArray, dof: int, at: slice, alpha: float
    ) -> tuple[float, FloatArray] | None:
        """Gain and directions (columns, j) of one family beside what was removed; None if it is not
        significant.
        """
        from scipy.special import fdtrc

        norm = self.norms(at)
        values, vectors = self.seen(rest[1:, 1:][at, at] / np.outer(norm, norm), at)
        rank = len(values)
        if rank == 0 or dof - rank < 1:
            return None
        squares = (vectors.T @ (rest[1:, 0][at] / norm)) ** 2 / values
        explained = float(np.sum(squares))
        gain = _gain(rest[0, 0], explained, dof, rank, alpha)
        if gain is None:
            return None
        # What is found is what the test found: directions that say nothing by themselves would add
        # their noise only.
        variance = (rest[0, 0] - explained) / (dof - rank)
        said = fdtrc(1.0, dof - rank, squares / variance) * rank < _DIRECTION_P
        return gain, vectors[:, said if said.any() else slice(None)] / norm[:, None]

    def _fitted(
        self, chosen: tuple[str, ...], directions: FloatArray, own: bool, certain: int
    ) -> Pattern:
        """The pattern of all directions, of which the first `certain` have no prior."""
        system, dof = self.beside_frames if own else self.alone
        matrix, slope = directions.T @ system[1:, 1:] @ directions, directions.T @ system[1:, 0]
        inverse = truncated_inverse(matrix, _ABSORBED)
        variance = float(system[0, 0] - slope @ inverse @ slope) / (dof - len(slope))
        covariance = variance * inverse
        if certain < len(slope):
            loose = _without(system, directions[:, :certain])
            free = directions[:, certain:]
            lengths = free.T @ self.inner @ free
            # Columns of two families may make the same shape.
            raw = lengths + _ABSORBED * np.diag(np.diag(lengths))
            precision = np.zeros_like(matrix)
            size = _prior_variance(
                free.T @ loose[1:, 1:] @ free, raw, free.T @ loose[1:, 0], variance
            )
            precision[certain:, certain:] = raw / size
            covariance = floats(np.linalg.inv(matrix / variance + precision))
        amplitudes = covariance @ slope / variance
        absorbed = (
            scaled_inverse(self.gram[: self.p, : self.p])
            @ self.gram[: self.p, self.p + 1 :]
            @ directions
        )
        names = [name for name in chosen if name != FRAME_BY_FRAME]
        rows = [directions[:0], *(directions[self.places[name]] for name in names)]
        arrays = (np.concatenate(rows), amplitudes, covariance, absorbed.T)
        # Nothing is nothing, also when it is read from a file.
        directions, amplitudes, covariance, parameters = (
            a if a.size else np.zeros(0) for a in arrays
        )
        return Pattern(
            families=chosen,
            directions=directions,
            amplitudes=amplitudes,
            covariance=covariance,
            parameters=parameters,
            frame_covariance=np.zeros((3, 3)),
            variance=variance,
            n_with_prior=len(slope) - certain,
        )


def _prior_variance(
    matrix: FloatArray, raw: FloatArray, slope: FloatArray, variance: float
) -> float:
    """Variance of every amplitude of a pattern that is as large in any direction of its shapes.

    `matrix`, `slope`: normal equations of the amplitudes, attitudes and parameters removed. `raw`:
    products of the shapes before that; in combinations that are orthonormal in it the amplitudes
    are independent. Those set the size that are in sight: a leak of another misfit into what
    attitudes imitate is divided by nearly nothing.
    """
    from scipy.linalg import eigh

    shares, vectors = eigh(matrix, raw)
    seen = shares >= min(_SEEN, shares[-1])
    squares = (vectors[:, seen].T @ slope) ** 2 / shares[seen] ** 2
    noise = variance / shares[seen]
    return float(max(np.mean(squares - noise), np.mean(noise) / np.sqrt(len(noise))))


def _without(system: FloatArray, directions: FloatArray) -> FloatArray:
    """The system with some directions of its columns removed."""
    if not directions.shape[1]:
        return system
    along = system[:, 1:] @ directions
    # Lengths were 1; what frames by themselves absorb of them is left out.
    inverse = truncated_inverse(directions.T @ along[1:], _ABSORBED)
    left: FloatArray = system - along @ inverse @ along.T
    return left


def _gain(rss: float, explained: float, dof: int, rank: int, alpha: float) -> float | None:
    """How much likelier the data become, less the price of the columns (Akaike); None if that may
    be chance.
    """
    from scipy.special import fdtrc

    if rank <= 0 or dof - rank < 1 or not 0.0 < explained < rss:
        return None
    statistic = explained / rank / ((rss - explained) / (dof - rank))
    if fdtrc(rank, dof - rank, statistic) >= alpha:
        return None
    return dof * float(np.log(rss / (rss - explained))) - 2.0 * rank


def frame_covariance(
    pattern: Pattern, families: Sequence[Shape], obs: Observations, cal: Calibration
) -> FloatArray:
    """Covariance (3, 3) over frames of their own scale and shape, beside the rest of a pattern, px
    at the corner.

    By moments: with w = C^T e of a frame and L = C^T C, both without its attitude, E[w w^T] = L S L
    + variance L.
    """
    chosen = pattern.among(families)
    own = frame_shapes(cal.camera)
    likelihood = MarginalLikelihood(obs, cal.camera.distortion)
    rotations = quaternion_to_rotation(cal.quaternions)
    grams, slopes = [], []
    for part, state, rows in likelihood.pieces(cal.theta, rotations, _STARS_AT_ONCE):
        view = View.of(part, state, cal.theta, rows)
        weight = 1.0 if part.frames.weight is None else part.frames.weight
        e = state.e.copy()
        if chosen:
            columns = np.concatenate([family.columns(view) for family in chosen])
            shift = np.einsum("q,qan->an", pattern.directions @ pattern.amplitudes, columns)
            shift -= np.einsum(
                "p,pan->an", pattern.amplitudes @ pattern.parameters, view.parameter_columns
            )
            e -= weight * shift
        projected = part.project_out(state, np.concatenate([own.columns(view) * weight, e[None]]))
        products = products_by_frame(part.frames, projected[:3], projected)
        grams.append(products[:, :, :3])
        slopes.append(products[:, :, 3])
    # The mean over frames went into the parameters, and with it one frame's worth of the spread.
    lost = obs.n_frames / max(obs.n_frames - 1, 1)
    return _moments(np.concatenate(grams), np.concatenate(slopes), pattern.variance) * lost


def _moments(grams: FloatArray, slopes: FloatArray, variance: float) -> FloatArray:
    """The covariance (3, 3) from L (K, 3, 3) and w (K, 3), without components whose variance is
    within its error.
    """
    covariance, error = _solved(grams, slopes, variance)
    kept = np.flatnonzero(np.diag(covariance) > _SAID * np.diag(error))
    if not len(kept):
        kept = np.arange(3)
    covariance, _ = _solved(grams[:, kept][:, :, kept], slopes[:, kept], variance)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    found = np.zeros((3, 3))
    found[np.ix_(kept, kept)] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return found


def _solved(
    grams: FloatArray, slopes: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """Solution of the equations of moments, and its standard errors by their scatter over
    frames.
    """
    size = slopes.shape[1]
    pairs = np.einsum("kab,kcd->kacbd", grams, grams).reshape(len(grams), size**2, size**2)
    moments = (slopes[:, :, None] * slopes[:, None, :] - variance * grams).reshape(len(grams), -1)
    inverse = np.linalg.inv(pairs.sum(axis=0))
    solution = inverse @ moments.sum(axis=0)
    left = (moments - pairs @ solution) @ inverse
    return solution.reshape(size, size), np.sqrt(np.sum(left**2, axis=0)).reshape(size, size)
