"""Effects: errors of the pixels that no parameter of the camera holds, linear, with a prior.

    pixel = project(theta; R_k r_s) + sum_e C_e a_e + noise,    a_e ~ N(0, tau_e^2 Lambda_e)

An effect belongs to the run, with one set of coefficients, to every frame, or to every star. The
coefficients of one whose prior is known may have an expected value that is not zero. In
units of the noise, with rho = (tau / sigma)^2 Lambda, the data have the covariance ``V = I + C rho
C^T``. Products with V^-1, the attitudes projected out, need the coefficients' own normal equations
alone, which are eliminated where they are small: frames one by one, then stars, then the run,

    x^T W y = x^T (I-P) y - sum over frames, stars, run of  c_x^T (1/rho + N)^-1 c_y,

with c the products of the effect's columns with x, and N those among themselves, less what was
eliminated before. It is a linear mixed model; determinants of ``1 + rho N`` are those of V.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from starcal_uq.camera.projection import unproject_theta
from starcal_uq.core.settings import EffectName
from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.likelihood.shapes import (
    TIME_DEGREE,
    Covariates,
    Shape,
    View,
    axes_shape,
    frame_shapes,
    magnitude_shape,
    over_time,
    phase_shape,
    seconds_utc,
)
from starcal_uq.likelihood.star_errors import StarModel
from starcal_uq.likelihood.terms import Eliminated, TermSums, add_by_group
from starcal_uq.likelihood.zenith import Zeniths
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera
    from starcal_uq.observations.table import Observations

# Highest order of the products of Legendre polynomials, and how fast higher orders shrink.
_ORDER, _SMOOTHNESS = 8, 1.5
# Points along the longer side of the detector on which a field is made orthogonal to the camera.
_GRID = 24
# Fewer stars than this that are seen twice do not tell their errors from noise.
_FEWEST_STARS = 5
# Hours without a frame that separate two nights.
_NIGHT_HOURS = 4.0


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect with columns of pixel shifts."""

    name: str
    grouping: Literal["run", "frame", "star"]
    columns: Shape
    prior: FloatArray  # (c,): standard deviations of the coefficients for a scale of 1 px
    stars: StarModel | None = None  # Of an effect of the stars, whose scale is px at the boresight
    # (c,): expected coefficients of an effect of the run whose prior is known, its scale being 1
    mean: FloatArray | None = None
    # (c,): slopes of the log prior there beyond its Gaussian
    pull: FloatArray | None = None

    @property
    def known(self) -> bool:
        """Whether its prior is known, so that its scale is one and nothing to estimate."""
        return self.mean is not None


def effects_of(
    obs: Observations,
    camera: Camera,
    *,
    seen: Observations | None = None,
    zeniths: Zeniths | None = None,
) -> dict[str, Effect]:
    """Every effect that a table allows, by name; its scale is px at the corner of the field.

    `camera`: the estimate. `seen`: other frames that the same effects are wanted on. `zeniths`:
    those of the frames, for the effect of air.
    """
    known = Covariates.of(obs, seen)
    corner = corner_unit(camera)
    fixed = place_effects(camera)
    found = [
        fixed["axes"],
        fixed["field"],
        Effect("frame", "frame", frame_shapes(camera), np.ones(3)),
    ]
    if known.warmth is not None:
        found.append(_run("temperature", _moving("temperature", known.warmth[None]), corner))
    if known.clock is not None:
        decay = 1.0 / np.arange(1.0, TIME_DEGREE + 1.0)
        found.append(
            _run("time", over_time(known.clock, known.called), np.outer(corner, decay).ravel())
        )
    nights = None if seen is not None else _nights(obs)
    if nights is not None:
        found.append(_run("epoch", _moving("epoch", nights), np.tile(corner, len(nights))))
    found.append(fixed["phase"])
    if zeniths is not None:
        found.append(zenith_effect(obs if seen is None else seen, zeniths))
    if known.magnitude is not None:
        found.append(_run("magnitude", magnitude_shape(known.magnitude, camera)))
    if seen is None:
        model = StarModel(obs, float(camera.focal_px))
        if model.n_recurring >= _FEWEST_STARS or np.any(model.stated2 > 0.0):
            shape = Shape("directions of the stars", "star", 2, lambda view: view.uv[None][:0])
            found.append(Effect("star", "star", shape, np.ones(2), model))
    return {effect.name: effect for effect in found}


def zenith_effect(obs: Observations, zeniths: Zeniths) -> Effect:
    """Refraction below zeniths, and their errors."""
    return Effect(
        "zenith",
        "run",
        zeniths.shape(obs),
        zeniths.prior,
        mean=zeniths.mean,
        pull=zeniths.pull if len(zeniths.pull) else None,
    )


def corner_unit(camera: Camera) -> FloatArray:
    """Changes (3,) of x0, y0 and f that move the corner of the field by one px."""
    return np.array([1.0, 1.0, float(camera.focal_px) / camera.corner_radius_px])


def _run(name: EffectName, columns: Shape, prior: FloatArray | None = None) -> Effect:
    return Effect(name, "run", columns, np.ones(columns.size) if prior is None else prior)


def _phase() -> Shape:
    both = phase_shape(0), phase_shape(1)
    return Shape(
        "error with the pixel phase",
        "pixel phase",
        sum(shape.size for shape in both),
        lambda view: np.concatenate([shape.columns(view) for shape in both]),
    )


def _moving(against: str, weights: FloatArray) -> Shape:
    """Changes of x0, y0 and f with each of the weights (w, N) of the stars."""

    def columns(view: View) -> FloatArray:
        moving = view.parameter_columns[:3]
        found = weights[:, None, None, view.rows] * moving
        return np.asarray(found.reshape(-1, *moving.shape[1:]))

    return Shape(f"change of x0, y0 and f with {against}", against, 3 * len(weights), columns)


def _nights(obs: Observations) -> FloatArray | None:
    """Membership (E, N) of the stars in nights; None where there is one."""
    seconds = None if obs.time_utc is None else seconds_utc(obs.time_utc)
    if seconds is None:
        return None
    moments, member = np.unique(seconds, return_inverse=True)
    night = np.concatenate([[0], np.cumsum(np.diff(moments) > 3600.0 * _NIGHT_HOURS)])
    return None if night[-1] == 0 else np.eye(int(night[-1]) + 1)[:, night[member]]


def field_effect(camera: Camera) -> Effect:
    """A smooth displacement over the field: products of Legendre polynomials of x and y along each
    axis.

    Over the detector it is orthogonal to what parameters of the camera and a rotation do, so that
    these keep their meaning: the camera is the one that is nearest to the map.
    """
    half = np.array([camera.width_px, camera.height_px]) / 2.0
    orders = [(i, j) for i in range(_ORDER + 1) for j in range(_ORDER + 1 - i)]
    size = 2 * len(orders)
    prior = np.array([(1.0 + i + j) ** -_SMOOTHNESS for i, j in orders])
    prior = np.repeat(prior / np.sqrt(np.sum(prior**2)), 2)

    def raw(xy: FloatArray) -> FloatArray:
        """Columns (size, 2, n) at pixels (2, n)."""
        from numpy.polynomial.legendre import legvander

        x, y = ((xy + 0.5) / half[:, None]) - 1.0
        along, across = legvander(x, _ORDER).T, legvander(y, _ORDER).T
        waves = np.stack([along[i] * across[j] for i, j in orders])
        found = np.zeros((len(orders), 2, 2, xy.shape[1]))
        found[:, 0, 0] = found[:, 1, 1] = waves
        return found.reshape(size, 2, -1)

    unit, taken = _of_camera(camera, raw)

    def columns(view: View) -> FloatArray:
        frames = view.part.frames
        turns = frames.in_pixels(view.state.attitude)
        held = np.concatenate([view.parameter_columns, turns]) / unit[:, None, None]
        xy = frames.pixel - frames.in_pixels(view.state.e)
        return np.asarray(raw(xy) - np.einsum("ps,pxn->sxn", taken, held, optimize=True))

    return Effect("field", "run", Shape("smooth field", "field", size, columns), prior)


def _of_camera(
    camera: Camera, raw: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Units (p + 3,) of the camera's parameters and a rotation, and coefficients (p + 3, s) by
    which they imitate columns over the detector.
    """
    longer = max(camera.width_px, camera.height_px)
    sides = [
        np.linspace(-0.5, side - 0.5, max(2, round(_GRID * side / longer)))
        for side in (camera.width_px, camera.height_px)
    ]
    xy = np.stack([axis.ravel() for axis in np.meshgrid(*sides)])
    good = np.isfinite(unproject_theta(camera.distortion, camera.theta, xy.T)).all(axis=1)
    xy = np.ascontiguousarray(xy[:, good])
    view = pixels_of(camera, xy)
    held = np.concatenate([view.parameter_columns, view.state.attitude])
    flat = held.reshape(len(held), -1)
    unit = np.linalg.norm(flat, axis=1)
    taken = np.linalg.lstsq((flat / unit[:, None]).T, raw(xy).reshape(-1, flat.shape[1]).T)[0]
    return unit, np.asarray(taken)


def pixels_of(camera: Camera, xy: FloatArray) -> View:
    """Pixels (2, n) of the detector as stars of one frame, for columns of effects there."""
    b = np.ascontiguousarray(unproject_theta(camera.distortion, camera.theta, xy.T).T)
    frames = StarFrames(np.ascontiguousarray(xy), b, None, np.array([0, xy.shape[1]]))
    whole = MarginalLikelihood(frames, camera.distortion)
    state, _ = whole.profile(camera.theta, np.eye(3)[None])
    return View.of(whole, state, camera.theta, slice(None))


def place_effects(camera: Camera) -> dict[str, Effect]:
    """Effects of the place on the detector alone, by name."""
    found = _run("axes", axes_shape(camera)), field_effect(camera), _run("phase", _phase())
    return {effect.name: effect for effect in found}


@dataclass(frozen=True, eq=False)
class Columns:
    """Whitened columns of effects at some stars, attitudes projected out but for the stars' own;
    and the turns of the frames, rad, that were.
    """

    frames: StarFrames
    run: FloatArray  # (m, 2, n)
    frame: FloatArray  # (c, 2, n)
    run_turns: FloatArray  # (m, 3, K)
    frame_turns: FloatArray  # (c, 3, K)
    star: FloatArray  # (s, 2, n)
    groups: IntArray  # (n,): star of every image, from 0
    n_stars: int

    @classmethod
    def of(
        cls,
        effects: Sequence[Effect],
        part: MarginalLikelihood,
        state: Profile,
        theta: FloatArray,
        rows: slice,
    ) -> Columns:
        """The columns at these rows of the table, run, frame and star by themselves."""
        view, attitudes = View.of(part, state, theta, rows), part.attitudes(state)
        nothing = np.zeros((0, 2, part.frames.n_stars))

        def removed(grouping: str) -> tuple[FloatArray, FloatArray]:
            own = [e.columns.columns(view) for e in effects if e.grouping == grouping]
            columns = np.concatenate([nothing, *own])
            part.frames.whiten(columns)
            left = attitudes.removed_from(columns) if own else columns
            turns = attitudes.coefficients(columns)
            if grouping == "run":
                # Air bends light: it does not turn the camera.
                turns *= _repeated([not effect.known for effect in effects], effects)[:, None, None]
            return left, turns

        (run, run_turns), (frame, frame_turns) = removed("run"), removed("frame")
        star, groups, n_stars = nothing, np.zeros(part.frames.n_stars, dtype=np.int64), 0
        stars = stars_of(effects)
        if stars is not None:
            star, groups = stars.term().columns(part, state, rows), stars.numbers[rows]
            n_stars = len(stars.images)
        return cls(part.frames, run, frame, run_turns, frame_turns, star, groups, n_stars)

    def cross(self, x: FloatArray) -> Cross:
        """Products with columns x (q, 2, n) whose attitudes are projected out."""
        size = 2 * self.frames.n_stars
        star = np.zeros((self.n_stars, len(self.star), len(x)))
        if self.n_stars:
            add_by_group(star, np.einsum("ixn,qxn->iqn", self.star, x), self.groups)
        return Cross(
            self.run.reshape(len(self.run), size) @ x.reshape(len(x), size).T,
            products_by_frame(self.frames, self.frame, x),
            star.reshape(self.n_stars * len(self.star), len(x)),
        )


@dataclass(frozen=True, eq=False)
class Cross:
    """Products of the effects' columns with q others; or coefficients for these."""

    run: FloatArray  # (m, q)
    frame: FloatArray  # (K, c, q)
    star: FloatArray  # (2 S, q)

    @classmethod
    def joined(cls, parts: Sequence[Cross]) -> Cross:
        """Those of all frames, from some frames each."""
        return cls(
            np.sum([part.run for part in parts], axis=0),
            np.concatenate([part.frame for part in parts]),
            np.sum([part.star for part in parts], axis=0),
        )


def stars_of(effects: Sequence[Effect]) -> StarModel | None:
    """The stars of an effect of theirs; None where there is none."""
    return next((effect.stars for effect in effects if effect.stars is not None), None)


class EffectSums:
    """Sums over all stars from which products with the covariance of effects follow, at any scales.

    `effects`: of the run, of frames and of stars. `theta` (p,): parameters of their columns, px
    units. `sigma`: noise that what the catalogue states of the stars is relative to. Added columns
    are q others, such as parameters and residuals; the residuals are the one at `place`, from which
    what effects are expected to do is taken off.
    """

    def __init__(
        self, effects: Sequence[Effect], theta: FloatArray, sigma: float = 1.0, place: int = -1
    ) -> None:
        self.effects, self._theta = tuple(effects), np.asarray(theta, dtype=np.float64)
        self._place = place
        self._parts: list[tuple[FloatArray, Cross, Cross]] = []
        self.stars, self._sigma = stars_of(effects), sigma
        self.of_stars = None if self.stars is None else TermSums(self.stars.term())
        self._local: dict[tuple[float, ...], Solved] = {}

    def add(
        self,
        part: MarginalLikelihood,
        state: Profile,
        projected: FloatArray,
        rows: slice,
    ) -> Columns:
        """Add frames, with columns (q, 2, n) whose attitudes are projected out."""
        columns = Columns.of(self.effects, part, state, self._theta, rows)
        flat = projected.reshape(len(projected), 2 * columns.frames.n_stars)
        among = columns.cross(np.concatenate([columns.run, columns.frame]))
        self._parts.append((flat @ flat.T, columns.cross(projected), among))
        if self.of_stars is not None:
            self.of_stars.add(part, state, projected[:0], rows, columns.frame)
        return columns

    @cached_property
    def sums(self) -> tuple[FloatArray, Cross, Cross]:
        """Products (q, q) of the added columns, those with the effects', and those of the effects'
        (run, then frame) among themselves.
        """
        grams, outer, inner = zip(*self._parts, strict=True)
        return np.sum(grams, axis=0), Cross.joined(outer), Cross.joined(inner)

    def ratios(self, ratio: Mapping[str, float], grouping: str) -> FloatArray:
        """Variances of the coefficients of one grouping in units of sigma squared; `ratio` holds
        that of the scale of every effect, none for those that are not there.
        """
        own = [ratio.get(e.name, 0.0) * e.prior**2 for e in self.effects if e.grouping == grouping]
        return np.concatenate([np.zeros(0), *own])

    def solved(self, ratio: Mapping[str, float]) -> Solved:
        """Eliminate all coefficients, whose scales have these squares in units of sigma squared."""
        local = [effect.name for effect in self.effects if effect.grouping != "run"]
        key = tuple(ratio.get(name, -1.0) for name in local)
        if key not in self._local:
            # The one before is wanted again where another scale is tried beside it.
            while len(self._local) > 2:
                self._local.pop(next(iter(self._local)))
            self._local[key] = self._eliminated(ratio)
        run_root = np.sqrt(self.ratios(ratio, "run"))
        found = replace(self._local[key], run_root=run_root)
        mean = self.mean(ratio)
        return found.less(mean, self._place) if mean.any() and found.outer.size else found

    @property
    def places(self) -> dict[str, slice]:
        """Places of the coefficients of effects of the run."""
        sizes = {e.name: len(e.prior) for e in self.effects if e.grouping == "run"}
        ends = np.cumsum([0, *sizes.values()]).tolist()
        return {n: slice(*at) for n, *at in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def mean(self, ratio: Mapping[str, float]) -> FloatArray:
        """Expected coefficients (m,) of the run, zero of effects that are not there."""
        return expected([e for e in self.effects if e.grouping == "run"], ratio)

    def coefficients(self, ratio: Mapping[str, float]) -> FloatArray:
        """Best coefficients (m, q) of the run for the added columns."""
        mean = self.mean(ratio)
        outer, inner = self.sums[1:]
        outer = Cross(outer.run.copy(), outer.frame.copy(), outer.star.copy())
        outer.run[:, self._place] -= inner.run[:, : len(mean)] @ mean
        outer.frame[:, :, self._place] -= inner.frame[:, :, : len(mean)] @ mean
        outer.star[:, self._place] -= inner.star[:, : len(mean)] @ mean
        run = self.solved(ratio).coefficients(outer).run
        run[:, self._place] += mean
        return run

    def _eliminated(self, ratio: Mapping[str, float]) -> Solved:
        """Frames and stars eliminated; coefficients of the run are none."""
        gram, outer, inner = self.sums
        values, vectors, along = self._of_frames
        m, own = len(outer.run), ratio.get("frame", 0.0)
        root = np.sqrt(own / (1.0 + own * values))
        log_determinant = float(np.sum(np.log1p(own * values)))
        left = root[:, :, None] * along
        flat = left.reshape(left.shape[0] * left.shape[1], left.shape[2])
        taken = flat.T @ flat
        stars = None
        if self.of_stars is not None and self.stars is not None and "star" in ratio:
            also = self.of_stars.coupling_of(vectors * root[:, None])
            cross = np.concatenate([inner.star[:, :m], outer.star], axis=1) - also @ flat
            variance = ratio["star"] + self.stars.stated2 / self._sigma**2
            eliminated = Eliminated(self.of_stars, np.repeat(variance, 2), also=also)
            found = eliminated.coefficients(cross)
            taken = taken + 0.5 * (cross.T @ found + found.T @ cross)
            log_determinant += eliminated.log_determinant
            stars = _Stars(eliminated, also, cross[:, :m], found[:, :m])
        return Solved(
            root,
            vectors,
            left[:, :, :m],
            stars,
            inner.run[:, :m] - taken[:m, :m],
            outer.run - taken[:m, m:],
            gram - taken[m:, m:],
            log_determinant,
            np.zeros(m),
        )

    @cached_property
    def _of_frames(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Eigenvalues (K, c) and vectors (K, c, c) of the products of each frame's columns, and
        products (K, c, m + q) of what is along these with the others.

        All columns of frames have one scale, so that they are independent along the vectors at any.
        """
        _, outer, inner = self.sums
        m = len(outer.run)
        values, vectors = np.linalg.eigh(inner.frame[:, :, m:])
        others = np.concatenate([inner.frame[:, :, :m], outer.frame], axis=2)
        return np.maximum(values, 0.0), vectors, np.swapaxes(vectors, 1, 2) @ others


@dataclass(frozen=True, eq=False)
class _Stars:
    """Stars eliminated after the frames."""

    eliminated: Eliminated
    also: Any  # (2 S, c K): products of their columns with those of frames, of unit square
    run: FloatArray  # (2 S, m): products with the columns of the run, and best coefficients
    found: FloatArray


@dataclass(frozen=True, eq=False)
class Solved:
    """Normal equations of effects at given scales, those of frames and stars eliminated."""

    frame_root: FloatArray  # (K, c): standard deviations of the coefficients after the data
    frame_vectors: FloatArray  # (K, c, c): directions along which they are independent
    frame_run: FloatArray  # (K, c, m): products of these with the columns of the run
    stars: _Stars | None
    own: FloatArray  # (m, m): products of the run's columns among themselves
    cross: FloatArray  # (m, q): with the added columns
    outer: FloatArray  # (q, q): products of the added columns
    local_log_determinant: float
    run_root: FloatArray  # (m,)

    def less(self, mean: FloatArray, place: int) -> Solved:
        """The same with the added column at `place` less the run's columns times `mean` (m,)."""
        cross, outer = self.cross.copy(), self.outer.copy()
        taken = mean @ self.cross
        outer[place] -= taken
        outer[:, place] -= taken
        outer[place, place] += mean @ self.own @ mean
        cross[:, place] -= self.own @ mean
        return replace(self, cross=cross, outer=outer)

    @cached_property
    def run_factor(self) -> FloatArray:
        """Cholesky factor (m, m) of ``1 + rho N`` of the run."""
        root = self.run_root
        return np.asarray(np.linalg.cholesky(self.own * np.outer(root, root) + np.eye(len(root))))

    @property
    def run_covariance(self) -> FloatArray:
        """Covariance (m, m) of the coefficients of the run, the added columns given, in units of
        sigma squared.
        """
        half = np.linalg.solve(self.run_factor, np.diag(self.run_root))
        return np.asarray(half.T @ half)

    @cached_property
    def gram(self) -> FloatArray:
        """Products (q, q) of the added columns with W."""
        left = np.linalg.solve(self.run_factor, self.run_root[:, None] * self.cross)
        return np.asarray(self.outer - left.T @ left)

    @property
    def log_determinant(self) -> float:
        """Log determinant of the covariance of the data, attitudes removed, in units of sigma."""
        return self.local_log_determinant + 2.0 * float(np.sum(np.log(np.diag(self.run_factor))))

    def coefficients(self, cross: Cross) -> Cross:
        """Best coefficients for columns of these products."""
        root = self.frame_root[:, :, None]
        half = root * (np.swapaxes(self.frame_vectors, 1, 2) @ cross.frame)
        slope = cross.run - np.tensordot(self.frame_run, half, ((0, 1), (0, 1)))
        star = np.zeros_like(cross.star)
        if self.stars is not None:
            flat = half.reshape(half.shape[0] * half.shape[1], half.shape[2])
            star = self.stars.eliminated.coefficients(cross.star - self.stars.also @ flat)
            slope = slope - self.stars.run.T @ star
        own = np.linalg.solve(self.run_factor, self.run_root[:, None] * slope)
        run = self.run_root[:, None] * np.linalg.solve(self.run_factor.T, own)
        half = half - self.frame_run @ run
        if self.stars is not None:
            star = star - self.stars.found @ run
            half = half - (self.stars.also.T @ star).reshape(half.shape)
        return Cross(run, np.asarray(self.frame_vectors @ (root * half)), star)


class EffectLikelihood(MarginalLikelihood):
    """Exact likelihood with effects marginalised at given scales, in units of sigma.

    Coefficients are linear over fractions of a pixel, and their columns and normal equations are
    those at the estimate. What they are expected to be, `mean` (m,) of those of the run, is taken
    off the images in `frames`; all others here are differences from that.

    `frames`: data, with any weights and axes of the noise. `ratio`: square of every effect's scale
    in units of `sigma` squared. `theta` (p,): estimate, px units. `rotations` (K, 3, 3): attitudes
    there.
    """

    def __init__(
        self,
        frames: StarFrames,
        model_name: str,
        effects: Sequence[Effect],
        ratio: Mapping[str, float],
        theta: FloatArray,
        rotations: FloatArray,
        sigma: float = 1.0,
    ) -> None:
        super().__init__(frames, model_name)
        state, _ = self.profile(theta, rotations)
        self.effects = tuple(effect for effect in effects if effect.name in ratio)
        run = [effect for effect in self.effects if effect.grouping == "run"]
        self.mean, self.pull = expected(run, ratio), pull_of(run)
        if self.mean.any():
            seen = Columns.of(self.effects, self, state, theta, slice(None))
            shift = frames.in_pixels(np.tensordot(self.mean, seen.run, 1))
            self.frames = replace(frames, pixel=np.ascontiguousarray(frames.pixel - shift))
            state, _ = self.profile(theta, state.rotations)
        self.use_rotations(state.rotations)
        sums = EffectSums(self.effects, theta, sigma)
        nothing = np.zeros((0, 2, frames.n_stars))
        self.columns = sums.add(self, state, nothing, slice(None))
        self.solved = sums.solved(ratio)
        self._frame_root = np.sqrt(sums.ratios(ratio, "frame"))

    def conditioned(self, state: Profile, columns: FloatArray) -> tuple[FloatArray, Cross]:
        """Columns (q, 2, N) less what attitudes and effects take of them, and the effects'
        coefficients.
        """
        projected = self.project_out(state, columns)
        found = self.solved.coefficients(self.columns.cross(projected))
        return projected - self.shifts(state, found), found

    def shifts(self, state: Profile, found: Cross) -> FloatArray:
        """Whitened shifts (q, 2, N) by coefficients, without what rotations reproduce."""
        member: IntArray = np.repeat(np.arange(self.frames.n_frames), self.frames.sizes)
        own = np.einsum("mq,mxn->qxn", found.run, self.columns.run, optimize=True)
        own += np.einsum("ncq,cxn->qxn", found.frame[member], self.columns.frame, optimize=True)
        if self.columns.n_stars:
            own += self.project_out(state, self._of_stars(found))
        return np.asarray(own)

    def _of_stars(self, found: Cross) -> FloatArray:
        by_image = found.star.reshape(self.columns.n_stars, 2, -1)[self.columns.groups]
        return np.asarray(np.einsum("niq,ixn->qxn", by_image, self.columns.star, optimize=True))

    def turns(self, state: Profile, found: Cross) -> FloatArray:
        """Rotation vectors (q, 3, K) of the frames that such shifts cause, rad."""
        own = np.einsum("mq,mik->qik", found.run, self.columns.run_turns)
        own += np.einsum("kcq,cik->qik", found.frame, self.columns.frame_turns)
        if self.columns.n_stars:
            own += self.attitude_response(state, self._of_stars(found))
        return np.asarray(own)

    def random_shifts(self, state: Profile, rng: np.random.Generator) -> FloatArray:
        """Whitened shifts (1, 2, N) of all images by random coefficients, in units of sigma."""
        solved, k = self.solved, self.frames.n_frames
        run, frame = solved.run_root[:, None], self._frame_root[:, None]
        star = np.zeros((self.columns.n_stars * len(self.columns.star), 1))
        if solved.stars is not None:
            star = np.sqrt(solved.stars.eliminated.ratio)[:, None]
        drawn = Cross(
            run * rng.standard_normal(run.shape),
            frame * rng.standard_normal((k, *frame.shape)),
            star * rng.standard_normal(star.shape),
        )
        return self.shifts(state, drawn)

    def of_effect(self, name: str, found: Cross) -> Cross:
        """The coefficients of one effect, those of the others zero."""
        run, frame = (
            np.concatenate(
                [
                    np.zeros(0),
                    *(
                        np.full(len(e.prior), float(e.name == name))
                        for e in self.effects
                        if e.grouping == grouping
                    ),
                ]
            )
            for grouping in ("run", "frame")
        )
        star = float(name == "star")
        return Cross(found.run * run[:, None], found.frame * frame[:, None], found.star * star)

    def whitened(self, state: Profile, columns: FloatArray) -> FloatArray:
        rest, found = self.conditioned(state, columns)
        q, solved = len(columns), self.solved
        frame = np.moveaxis(found.frame, 2, 0)
        parts = [rest.reshape(q, -1), _over(found.run.T, solved.run_root)]
        # Scales of frames are alike; with none of them there are no coefficients.
        parts.append(_over(frame, self._frame_root).reshape(q, frame[0].size if q else 0))
        if solved.stars is not None:
            parts.append(_over(found.star.T, np.sqrt(solved.stars.eliminated.ratio)))
        return np.concatenate(parts, axis=1)

    def log_likelihood(self, theta: FloatArray, sigma: float) -> float:
        state, cost = self.profile(theta, self._rotations)
        if not np.isfinite(cost):
            return -np.inf
        left = self.whitened(state, state.e[None])
        run = left[0, state.e.size : state.e.size + len(self.mean)] * self.solved.run_root
        return float(
            self.pull @ run
            - 0.5 * np.sum(left**2) / sigma**2
            - self.dof * np.log(sigma)
            - 0.5 * np.sum(state.log_determinant)
        )


def _repeated(values: Sequence[Any], effects: Sequence[Effect]) -> FloatArray:
    """Values of the effects for each coefficient of those of the run, (m,)."""
    own = [
        np.full(len(e.prior), v)
        for v, e in zip(values, effects, strict=True)
        if e.grouping == "run"
    ]
    return np.concatenate([np.zeros(0), *own])


def expected(effects: Sequence[Effect], present: Mapping[str, Any]) -> FloatArray:
    """Expected coefficients (m,) of effects, zero of those that are not present."""
    own = [
        effect.mean if effect.mean is not None and effect.name in present else 0.0 * effect.prior
        for effect in effects
    ]
    return np.concatenate([np.zeros(0), *own])


def pull_of(effects: Sequence[Effect]) -> FloatArray:
    """Slopes (m,) of the log prior of the coefficients of effects beyond its Gaussian."""
    own = [0.0 * effect.prior if effect.pull is None else effect.pull for effect in effects]
    return np.concatenate([np.zeros(0), *own])


def _over(values: FloatArray, root: FloatArray) -> FloatArray:
    """Coefficients (..., c) in units of their standard deviations (c,); zero where these are."""
    return np.divide(values, root, out=np.zeros_like(values), where=root > 0.0)
