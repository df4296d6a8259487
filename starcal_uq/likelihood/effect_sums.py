"""Sums over all stars from which products with the covariance of effects follow, and the exact
likelihood.

In units of the noise, with rho = (tau / sigma)^2 Lambda, the data have the covariance ``V = I + C rho
C^T``. Products with V^-1, the attitudes projected out, need the coefficients' own normal equations
alone, which are eliminated where they are small: frames one by one, then stars, then the run,

    x^T W y = x^T (I-P) y - sum over frames, stars, run of  c_x^T (1/rho + N)^-1 c_y,

with c the products of the effect's columns with x, and N those among themselves, less what was
eliminated before. It is a linear mixed model; determinants of ``1 + rho N`` are those of V.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.effects import Effect
from starcal_uq.likelihood.elimination import ByFrame, frame_blocks, products_by_frame
from starcal_uq.likelihood.frame_products import FrameProducts
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.likelihood.shapes import View
from starcal_uq.likelihood.star_errors import StarModel
from starcal_uq.likelihood.terms import Eliminated, TermSums, add_by_group
from starcal_uq.observations.frames import StarFrames


@dataclass(frozen=True, eq=False)
class Columns:
    """Whitened columns of effects at some stars, as they are where they are called raw, else with
    the attitudes projected out.
    """

    view: View
    attitudes: ByFrame
    of_run: tuple[Effect, ...]
    raw_frame: FloatArray  # (c, 2, n)
    star: FloatArray  # (s, 2, n), as they are
    groups: IntArray  # (n,): star of every image, from 0
    n_stars: int

    @classmethod
    def of(
        cls,
        effects: Sequence[Effect],
        part: MarginalLikelihood,
        state: Profile,
        theta: FloatArray,
        rows: slice | IntArray,
    ) -> Columns:
        """The columns at these rows of the table, run, frame and star by themselves."""
        view = View.of(part, state, theta, rows)
        of_run = tuple(effect for effect in effects if effect.of_run)
        of_frames = (e.columns.columns(view) for e in effects if e.grouping == "frame")
        frame = _whitened(part.frames, *of_frames)
        star, groups, n_stars = frame[:0], np.zeros(part.frames.n_stars, dtype=np.int64), 0
        stars = stars_of(effects)
        if stars is not None:
            star, groups = stars.term().columns(part, state, rows), stars.numbers[rows]
            n_stars = len(stars.images)
        return cls(view, part.attitudes(state), of_run, frame, star, groups, n_stars)

    @property
    def frames(self) -> StarFrames:
        """The frames of the stars."""
        return self.attitudes.frames

    @cached_property
    def raw(self) -> FloatArray:
        """Columns (m, 2, n) of the run."""
        return self._shifts(self.of_run)

    def _shifts(self, effects: Sequence[Effect]) -> FloatArray:
        return _whitened(self.frames, *(e.columns.columns(self.view) for e in effects))

    @property
    def _cells(self) -> Any:
        """Columns (2 n, m) of the run's last effect, sparse, where each star is in one cell of it."""
        from scipy.sparse import csr_array

        own, n = self.of_run[-1].columns if self.of_run else None, self.frames.n_stars
        if own is None or own.cells is None or self.n_stars:
            return None
        shifts = np.repeat(np.eye(2)[:, :, None], n, axis=2)
        self.frames.whiten(shifts)
        stars, axes = np.arange(n), np.arange(2)[:, None]
        place = np.broadcast_arrays(stars + n * axes, 2 * own.cells(self.view) + axes[:, None])
        entries = shifts.ravel(), tuple(index.ravel() for index in place)
        return csr_array(entries, shape=(2 * n, own.size))

    @cached_property
    def run(self) -> FloatArray:
        """The same, attitudes projected out."""
        return self.attitudes.removed_from(self.raw) if len(self.raw) else self.raw

    @cached_property
    def frame(self) -> FloatArray:
        """Columns (c, 2, n) of frames."""
        raw = self.raw_frame
        return self.attitudes.removed_from(raw) if len(raw) else raw

    @property
    def frame_turns(self) -> FloatArray:
        """Turns (c, 3, K) of the frames, rad, that columns of frames hold."""
        return self.attitudes.coefficients(self.raw_frame)

    @property
    def turning(self) -> FloatArray:
        """One where turns by a column of the run (m,) are the camera's, else zero: air bends light
        and does not turn the camera.
        """
        return by_run([np.full(len(effect.prior), 1.0 - effect.known) for effect in self.of_run])

    def cross(self, x: FloatArray) -> Cross:
        """Products with columns x (q, 2, n) whose attitudes are projected out."""
        size = 2 * self.frames.n_stars
        star = np.zeros((self.n_stars, len(self.star), len(x)))
        if self.n_stars:
            add_by_group(star, np.einsum("ixn,qxn->iqn", self.star, x), self.groups)
        return Cross(
            self.raw.reshape(len(self.raw), size) @ x.reshape(len(x), size).T,
            products_by_frame(self.frames, self.frame, x),
            star.reshape(self.n_stars * len(self.star), len(x)),
        )

    def along(self, e: FloatArray) -> FloatArray:
        """Products (m,) of the run's columns, the last ones those of cells, with residuals (2, n)."""
        # One effect after the other, whose columns stay in the cache.
        own = [np.tensordot(self._shifts([each]), e, axes=2) for each in self.of_run[:-1]]
        return np.concatenate([*own, e.ravel() @ self._cells])

    def products(self, added: FloatArray) -> Products:
        """Products with added columns (q, 2, n) and among themselves, attitudes projected out."""
        cells = self._cells
        dense = self.raw if cells is None else self._shifts(self.of_run[:-1])
        others = np.concatenate([dense, self.frame, added])
        local = np.concatenate([self.attitudes.columns, self.frame])
        blocks = frame_blocks(self.frames, local)
        flat = others.reshape(len(others), 2 * self.frames.n_stars)
        every, by_frame, m = flat @ flat.T, blocks @ flat.T, len(dense)
        if cells is not None:
            along = cells.T @ flat.T
            every = np.block([[every, along.T], [along, (cells.T @ cells).toarray()]])
            by_frame = np.concatenate([by_frame, (blocks @ cells).toarray()], axis=1)
            order = np.r_[:m, len(others) : len(every), m : len(others)]
            every, by_frame = every[np.ix_(order, order)], by_frame[:, order]
            m += len(along)
        by_frame = by_frame.reshape(self.frames.n_frames, len(local), len(every))
        root = np.linalg.cholesky(np.moveaxis(self.attitudes.inverse, 2, 0))
        turned = np.swapaxes(root, 1, 2) @ by_frame[:, :3]
        turned = turned.reshape(3 * self.frames.n_frames, len(every))
        # A view of few columns would keep all of them.
        frame, gram = by_frame[:, 3:].copy(), every - turned.T @ turned
        end, star = len(every) - len(added), np.zeros((0, len(every)))
        if self.n_stars:
            left = self.attitudes.removed_from(added)
            star = self.cross(np.concatenate([self.run, self.frame, left])).star
        return Products(
            gram[end:, end:],
            Cross(gram[:m, end:], frame[:, :, end:], star[:, end:]),
            Cross(gram[:m, :m], frame[:, :, :end], star[:, :end]),
            None,
            np.diag(every)[:m],
        )


def _whitened(frames: StarFrames, *columns: FloatArray) -> FloatArray:
    """Columns (c, 2, n) in one array that is whitened."""
    found = np.concatenate([np.zeros((0, 2, frames.n_stars)), *columns])
    frames.whiten(found)
    return found


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


@dataclass(frozen=True, eq=False)
class Products:
    """Products over some frames, which add up: of the added columns (q, q), of these with the
    effects', and of the effects' among themselves, those of the run with the run alone.

    `frames` sums up what frames take of the others; where it is None, these are known frame by
    frame.
    """

    gram: FloatArray
    outer: Cross
    inner: Cross
    frames: FrameProducts | None
    squares: FloatArray  # (m,): those of the run with themselves, attitudes in them

    @classmethod
    def joined(cls, parts: Sequence[Products]) -> Products:
        """Those of all frames."""
        frames = [part.frames for part in parts if part.frames is not None]
        return cls(
            np.sum([part.gram for part in parts], axis=0),
            Cross.joined([part.outer for part in parts]),
            Cross.joined([part.inner for part in parts]),
            FrameProducts.joined(frames) if frames else None,
            np.sum([part.squares for part in parts], axis=0),
        )

    def summed(self) -> Products:
        """The same without the frames one by one."""
        size = self.inner.frame.shape[1]
        m = self.inner.frame.shape[2] - size
        others = np.concatenate([self.inner.frame[:, :, :m], self.outer.frame], axis=2)
        frames = FrameProducts.of(self.inner.frame[:, :, m:], others)
        outer = replace(self.outer, frame=self.outer.frame[:0])
        return replace(
            self, outer=outer, inner=replace(self.inner, frame=self.inner.frame[:0]), frames=frames
        )


class EffectSums:
    """Sums over all stars from which products with the covariance of effects follow, at any scales.

    `effects`: of the run, of frames and of stars. `theta` (p,): parameters of their columns, px
    units. `sigma`: noise that what the catalogue states of the stars is relative to. Added columns
    are q others, such as parameters and residuals; the residuals are the one at `place`, from which
    what effects are expected to do is taken off. Frames are summed up where they are not needed
    `apart`; stars, which several of them show, need them.
    """

    def __init__(
        self,
        effects: Sequence[Effect],
        theta: FloatArray,
        sigma: float = 1.0,
        place: int = -1,
        apart: bool = True,
    ) -> None:
        self.effects, self._theta = tuple(effects), np.asarray(theta, dtype=np.float64)
        self._place = place
        self.parts: list[Products] = []
        self.stars, self._sigma = stars_of(effects), sigma
        self.of_stars = None if self.stars is None else TermSums(self.stars.term())
        self._apart = apart or self.stars is not None
        self._local: dict[tuple[float, ...], Solved] = {}

    def add(
        self,
        part: MarginalLikelihood,
        state: Profile,
        added: FloatArray,
        rows: slice | IntArray,
    ) -> Columns:
        """Add frames, with columns (q, 2, n)."""
        columns = Columns.of(self.effects, part, state, self._theta, rows)
        own = columns.products(added)
        self.parts.append(own if self._apart else own.summed())
        if self.of_stars is not None:
            self.of_stars.add(part, state, added[:0], rows, columns.frame)
        return columns

    @cached_property
    def total(self) -> Products:
        """The products over all stars."""
        return Products.joined(self.parts)

    def ratios(self, ratio: Mapping[str, float], grouping: str) -> FloatArray:
        """Variances of the coefficients of one grouping in units of sigma squared; `ratio` holds
        that of the scale of every effect, none for those that are not there.
        """
        own = [e for e in self.effects if e.grouping == grouping]
        return by_run([ratio.get(e.name, 0.0) * e.prior**2 for e in own])

    def solved(self, ratio: Mapping[str, float]) -> Solved:
        """Eliminate all coefficients, whose scales have these squares in units of sigma squared."""
        local = [effect.name for effect in self.effects if not effect.of_run]
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
        sizes = {e.name: len(e.prior) for e in self.effects if e.of_run}
        ends = np.cumsum([0, *sizes.values()]).tolist()
        return {n: slice(*at) for n, *at in zip(sizes, ends[:-1], ends[1:], strict=True)}

    def mean(self, ratio: Mapping[str, float]) -> FloatArray:
        """Expected coefficients (m,) of the run, zero of effects that are not there."""
        return expected([e for e in self.effects if e.of_run], ratio)

    def coefficients(self, ratio: Mapping[str, float]) -> FloatArray:
        """Best coefficients (m, q) of the run for the added columns."""
        found = self.solved(ratio).of_run
        found[:, self._place] += self.mean(ratio)
        return found

    def _eliminated(self, ratio: Mapping[str, float]) -> Solved:
        """Frames and stars eliminated; coefficients of the run are none."""
        total, own = self.total, ratio.get("frame", 0.0)
        m = len(total.outer.run)
        if total.frames is not None:
            taken, volume = total.frames.taken(own)
            c = total.inner.frame.shape[1]
            none = np.zeros((0, c)), np.zeros((0, c, c)), np.zeros((0, c, m))
            return self._less(*none, taken, volume, None)
        values, vectors, along = self._of_frames
        root = np.sqrt(own / (1.0 + own * values))
        log_determinant = float(np.sum(np.log1p(own * values)))
        left = root[:, :, None] * along
        flat = left.reshape(left.shape[0] * left.shape[1], left.shape[2])
        taken = flat.T @ flat
        stars = None
        if self.of_stars is not None and self.stars is not None and "star" in ratio:
            also = self.of_stars.coupling_of(vectors * root[:, None])
            outer, inner = total.outer.star, total.inner.star
            cross = np.concatenate([inner[:, :m], outer], axis=1) - also @ flat
            variance = ratio["star"] + self.stars.stated2 / self._sigma**2
            eliminated = Eliminated(self.of_stars, np.repeat(variance, 2), also)
            found = eliminated.coefficients(cross)
            taken = taken + 0.5 * (cross.T @ found + found.T @ cross)
            log_determinant += eliminated.log_determinant
            stars = _Stars(eliminated, also, cross[:, :m], found[:, :m])
        return self._less(root, vectors, left[:, :, :m], taken, log_determinant, stars)

    def _less(
        self,
        root: FloatArray,
        vectors: FloatArray,
        along: FloatArray,
        taken: FloatArray,
        log_determinant: float,
        stars: _Stars | None,
    ) -> Solved:
        """The products of the others less what frames and stars take of them."""
        total = self.total
        m = len(total.outer.run)
        return Solved(
            root,
            vectors,
            along,
            stars,
            total.inner.run - taken[:m, :m],
            total.outer.run - taken[:m, m:],
            total.gram - taken[m:, m:],
            log_determinant,
            np.zeros(m),
        )

    @cached_property
    def _of_frames(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Eigenvalues (K, c) and vectors (K, c, c) of the products of each frame's columns, and
        products (K, c, m + q) of what is along these with the others.

        All columns of frames have one scale, so that they are independent along the vectors at any.
        """
        outer, inner = self.total.outer, self.total.inner
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

    def with_known(self, m: int) -> Solved:
        """The same with m coefficients of the run that are known."""
        k, c, _ = self.frame_run.shape
        none = np.zeros((m, len(self.outer)))
        frame_run = np.zeros((k, c, m))
        return replace(
            self, frame_run=frame_run, own=np.zeros((m, m)), cross=none, run_root=np.zeros(m)
        )

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
        return half.T @ half

    @property
    def of_run(self) -> FloatArray:
        """Best coefficients (m, q) of the run for the added columns."""
        root = self.run_root[:, None]
        half = np.linalg.solve(self.run_factor, root * self.cross)
        return root * np.linalg.solve(self.run_factor.T, half)

    @cached_property
    def gram(self) -> FloatArray:
        """Products (q, q) of the added columns with W."""
        left = np.linalg.solve(self.run_factor, self.run_root[:, None] * self.cross)
        return self.outer - left.T @ left

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
        return Cross(run, self.frame_vectors @ (root * half), star)


def expected(effects: Sequence[Effect], present: Mapping[str, Any]) -> FloatArray:
    """Expected coefficients (m,) of effects, zero of those that are not present."""
    own = (effect.mean if effect.name in present else None for effect in effects)
    return by_run([_or_zero(one, effect) for one, effect in zip(own, effects, strict=True)])


def pull_of(effects: Sequence[Effect]) -> FloatArray:
    """Slopes (m,) of the log prior of the coefficients of effects beyond its Gaussian."""
    return by_run([_or_zero(effect.pull, effect) for effect in effects])


def _or_zero(values: FloatArray | None, effect: Effect) -> FloatArray:
    return 0.0 * effect.prior if values is None else values


def by_run(parts: Sequence[FloatArray]) -> FloatArray:
    """Values (m,) of all coefficients from those of each effect; none of no effect."""
    return np.concatenate([np.zeros(0), *parts])
