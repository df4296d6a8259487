"""Sums over all stars from which tests of shapes and of unequal noise follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.attitude.rotations import quaternion_to_rotation
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.beside import (
    Freed,
    by_frame,
    effects_beside,
)
from starcal_uq.diagnostics.misfit_test import Amplitude, MisfitTest
from starcal_uq.diagnostics.noise_tests import NoiseSums, noise_weights
from starcal_uq.likelihood.effect_sums import EffectSums
from starcal_uq.likelihood.effects import Effect
from starcal_uq.likelihood.elimination import products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import (
    FRAME_BY_FRAME,
    Shape,
    View,
    frame_shapes,
)
from starcal_uq.maths.linear import principal, scaled_inverse, without_first
from starcal_uq.observations.frames import StarFrames

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Directions of which the fit absorbs all but this share of the square are not there to be tested.
_ABSORBED = 1e-8
# Share of the square of a shape that effects must leave in sight for it to be looked for: what they
# explain almost as large as the data could show it says how well their prior describes it, and not
# what they leave.
_SEEN = 0.1
_STARS_AT_ONCE = 10_000
LEAST_DOF = 10
# Frames with less than one degree of freedom have no noise of their own to compare.
_LEAST_FRAMES, _LEAST_FRAME_DOF = 3, 1.0
# Square of a scale that is none, in units of the noise and of the columns.
_FREE = 1e10


@dataclass(frozen=True)
class _Columns:
    """Whitened columns of some stars, the last of them the two axes of cells of the field, which
    are zero but for few stars.

    `dense` (d, 2, n) are the others; `cells` (q - d, 2 n) is sparse.
    """

    frames: StarFrames
    dense: FloatArray
    cells: Any

    @classmethod
    def of(cls, families: Sequence[Shape], view: View) -> _Columns:
        from scipy.sparse import csr_array

        *others, last = families
        frames = view.part.frames
        dense = np.concatenate([family.columns(view) for family in others])
        frames.whiten(dense)
        assert last.cell is not None
        cell = last.cell(view)
        # Shifts of every star along each axis.
        shifts = np.repeat(np.eye(2)[:, :, None], len(cell), axis=2)
        frames.whiten(shifts)
        rows, stars = (
            2 * cell + np.arange(2)[:, None, None],
            np.arange(2 * len(cell)).reshape(2, -1),
        )
        place = np.broadcast_arrays(rows, stars)
        cells = csr_array(
            (shifts.ravel(), tuple(index.ravel() for index in place)),
            shape=(last.size, stars.size),
        )
        cells.eliminate_zeros()
        return cls(frames, dense, cells)

    def all(self) -> FloatArray:
        """Every column (q, 2, n)."""
        return np.concatenate([self.dense, self.cells.toarray().reshape(-1, *self.dense.shape[1:])])

    def inner(self) -> FloatArray:
        """Products among themselves."""
        across = self.across(self.dense)
        d, q = len(self.dense), len(across)
        found = np.empty((q, q))
        found[:, :d], found[:d] = across, across.T
        found[d:, d:] = (self.cells @ self.cells.T).toarray()
        return found

    def across(self, columns: FloatArray) -> FloatArray:
        """Products (q, m) with columns (m, 2, n)."""
        flat = columns.reshape(len(columns), -1).T
        return np.concatenate([self.dense.reshape(len(self.dense), -1) @ flat, self.cells @ flat])

    def by_frame(self, few: FloatArray) -> FloatArray:
        """Products (i, q, K) with few columns (i, 2, n) over the stars of each frame."""
        from scipy.sparse import csr_array

        n, k = 2 * self.frames.n_stars, self.frames.n_frames
        frame = np.tile(np.repeat(np.arange(k), self.frames.sizes), 2)
        found = []
        for column in few:
            spread = csr_array((column.ravel(), frame, np.arange(n + 1)), shape=(n, k))
            of_cells = (self.cells @ spread).toarray()
            found.append(
                np.concatenate([_frame_products(self.frames, column, self.dense), of_cells])
            )
        return np.stack(found)


def _frame_products(frames: StarFrames, column: FloatArray, many: FloatArray) -> FloatArray:
    """Products (q, K) of a column (2, n) with many (q, 2, n) over the stars of each frame."""
    product = many[:, 0] * column[0]
    product += many[:, 1] * column[1]
    return frames.sum(product)


class ShapeSums:
    """Sums over all stars from which every test follows; the table is visited once, some frames at
    a time.

    Where there are effects, `gram` is weighted by them. `plain` is of the parameters and the
    residuals; beside effects it is that part of `gram`, and noise is that of residuals for which
    they are free.
    """

    def __init__(self, obs: Observations, cal: Calibration, families: tuple[Shape, ...]) -> None:
        likelihood = MarginalLikelihood(obs, cal.camera.distortion, axes=True)
        p, theta = len(cal.theta), cal.theta
        self.families, self.p, self.dof = families, p, likelihood.dof - p
        # Degrees of freedom that scale and shape of every frame by itself take, and what they
        # explain of parameters and residuals.
        self.block_rank, self.blocks = 0, np.zeros((p + 1, p + 1))
        # What `gram` would be without effects, where there are any
        self.before: FloatArray | None = None
        size = p + 1 + sum(family.size for family in families)
        # Products of parameters, residuals and columns of all families, attitudes removed, and
        # squares of the same before that
        self.gram, self.raw = np.zeros((size, size)), np.zeros(size)
        self.names, self.n_stars = cal.parameter_names, obs.n_stars
        self.noise = NoiseSums(noise_weights(obs, cal.camera), p)
        self.noise_dof = self.dof
        # What `independent` is of residuals for which effects are free, where there are any
        self.freed: tuple[FloatArray, FloatArray, float] | None = None
        self.noise_px = 1.0 if obs.sigma_px is None else float(np.sqrt(np.mean(obs.sigma_px**2)))
        self.plain, self.own = np.zeros((p + 1, p + 1)), frame_shapes(cal.camera)
        # Sums of squares of the frames, degrees of freedom that attitudes leave them, and their
        # normal matrices.
        self.frames: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        rotations = quaternion_to_rotation(cal.quaternions)
        effects, sums = effects_beside(obs, cal), None
        if effects:
            held = {effect.name for effect in effects}
            frame = Effect("frame", "frame", self.own, np.ones(3))
            every = effects if "frame" in held else [*effects, frame]
            sums = EffectSums(every, theta, cal.sigma)
        for part, state, rows in likelihood.pieces(theta, rotations, _STARS_AT_ONCE):
            fitted, columns, view = self._add(part, state, theta, rows)
            if sums is not None:
                every_one = np.concatenate([fitted, part.project_out(state, columns.all())])
                own = sums.add(part, state, every_one, rows).frame[-3:]
                if "frame" not in held:
                    self.block_rank += int(by_frame(part.frames, own)[1].sum())
                continue
            flat = fitted.reshape(p + 1, -1)
            self.plain += flat @ flat.T
            self._add_blocks(part, state, view, fitted)
            h, e = fitted[:p], fitted[p]
            self.noise.add(part.attitudes(state), h, e, rows)
            matrices = products_by_frame(part.frames, h, h)
            squares = part.frames.sum(np.sum(e**2, axis=0))
            self.frames.append((squares, np.asarray(2.0 * part.frames.sizes - 3.0), matrices))
        if sums is not None:
            self._with_effects(sums, obs, cal)

    def _with_effects(self, sums: EffectSums, obs: Observations, cal: Calibration) -> None:
        """Weigh everything by the effects of a calibration, and take them for free where the noise
        is looked at.
        """
        assert cal.effects is not None
        ratio, p = cal.effects.ratio(cal.sigma), self.p
        self.before, self.gram = self.gram, sums.solved(ratio).gram
        if "frame" not in ratio:
            size = np.mean(np.einsum("kaa->ka", sums.total.inner.frame[:, -3:, -3:]))
            free = sums.solved(ratio | {"frame": _FREE / float(size)}).gram
            self.blocks = (self.gram - free)[: p + 1, : p + 1]
        self.plain = self.gram[: p + 1, : p + 1]
        freed = Freed.of(obs, cal, axes=True)
        frames, h, e = freed.own.frames, freed.h, freed.e
        self.noise, self.noise_dof = NoiseSums(self.noise.weights, len(h)), freed.dof
        self.noise.add(freed.own, h, e, slice(None))
        self.freed = np.eye(len(h)), np.eye(len(h)), float(np.sum(e**2))
        squares = frames.sum(np.sum(e**2, axis=0))
        self.frames = [(squares, freed.frame_dof, products_by_frame(frames, h, h))]

    def _add(
        self, part: MarginalLikelihood, state: Any, theta: FloatArray, rows: slice
    ) -> tuple[FloatArray, _Columns, View]:
        """Add some frames: parameters and residuals, attitudes projected out, and all columns, as
        they are.

        A product of columns after projection is that before, less the products of what rotations of
        the frames make of both: nothing of the size of the many columns is written for it.
        """
        view = View.of(part, state, theta, rows)
        columns = _Columns.of(self.families, view)
        h = view.parameter_columns.copy()
        part.frames.whiten(h)
        own = np.concatenate([h, state.e[None]])
        fitted = part.project_out(state, own)
        n, flat = len(own), fitted.reshape(len(own), -1)
        inner, across = columns.inner(), columns.across(fitted)
        self.raw[:n] += np.sum(own**2, axis=(1, 2))
        self.raw[n:] += np.diag(inner)
        turned = columns.by_frame(state.attitude)
        answer = sum(turned[i][:, None] * state.inverse[i] for i in range(3))
        self.gram[:n, :n] += flat @ flat.T
        self.gram[n:, :n] += across
        self.gram[:n, n:] += across.T
        self.gram[n:, n:] += inner - np.tensordot(
            np.moveaxis(turned, 0, 1), answer, ((1, 2), (1, 2))
        )
        return fitted, columns, view

    def _add_blocks(
        self, part: MarginalLikelihood, state: Any, view: View, fitted: FloatArray
    ) -> None:
        """Scale and quadrupole of every frame by itself: three columns per frame, which no other
        frame sees.
        """
        frames = part.frames
        columns = self.own.columns(view)
        frames.whiten(columns)
        raw = np.sqrt(frames.sum(np.sum(columns**2, axis=1)))
        columns = part.project_out(state, columns / frames.spread(raw)[:, None])
        gram = products_by_frame(frames, columns, columns)
        values, vectors = np.linalg.eigh(gram)
        kept = values > _ABSORBED
        root = vectors * np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)[:, None, :]
        # Attitudes are out of these, and so out of their products with anything.
        with_fitted = np.stack([_frame_products(frames, column, fitted) for column in columns])
        explained = np.einsum("kab,ajk->kbj", root, with_fitted).reshape(-1, self.p + 1)
        self.blocks += explained.T @ explained
        self.block_rank += int(np.count_nonzero(kept))

    @cached_property
    def places(self) -> dict[str, slice]:
        """Columns of every family, from 0."""
        ends = np.cumsum([0, *(family.size for family in self.families)]).tolist()
        return {
            family.name: slice(*ends)
            for family, *ends in zip(self.families, ends[:-1], ends[1:], strict=True)
        }

    @cached_property
    def alone(self) -> FloatArray:
        """Residuals and columns (1 + q, 1 + q) with the parameters removed."""
        return without_first(self.gram, self.p, _ABSORBED, self._unit)[0]

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

    @cached_property
    def projection(self) -> FloatArray:
        """Inverse of the Gram matrix of the parameters, attitudes removed."""
        return scaled_inverse(self.gram[: self.p, : self.p])

    @property
    def rss(self) -> float:
        """Sum of squared residuals, what little the parameters could still explain taken off."""
        return float(self.alone[0, 0])

    @cached_property
    def independent(self) -> tuple[FloatArray, FloatArray, float]:
        """Gram matrix of the parameters, its inverse, and `rss`, of residuals that are
        independent.
        """
        matrix, slope = self.plain[: self.p, : self.p], self.plain[: self.p, self.p]
        inverse = scaled_inverse(matrix)
        return matrix, inverse, float(self.plain[self.p, self.p] - slope @ inverse @ slope)

    def family(self, family: Shape) -> MisfitTest | None:
        """The test of one family; None where nothing of it is left, or too few data."""
        at, system = self.places[family.name], self.alone
        norm, present = self.norms(at), np.count_nonzero(self.raw[self.p + 1 :][at])
        cross = self.gram[self.p + 1 :, : self.p][at]
        slope, left = system[1:, 0][at] / norm, system[1:, 1:][at, at] / np.outer(norm, norm)
        values, vectors = self.seen(left, at)
        rank = len(values)
        if rank == 0 or self.dof - rank < LEAST_DOF:
            return None
        scores = vectors.T @ slope
        explained = float(np.sum(scores**2 / values))
        test = self._f_test(family.name, family.against, explained, rank, self.rss)
        visible = float(np.trace(left) / max(present, 1))
        # What fitting the shapes takes from the parameters, in units of their standard deviations.
        fitted = vectors @ (scores / values) / norm
        unit = np.sqrt(np.diag(self.projection) * self.rss / self.dof)
        moved = np.abs(self.projection @ cross.T @ fitted) / unit
        worst = int(np.argmax(moved))
        variance = (self.rss - explained) / (self.dof - rank)
        turned = self.projection[worst] @ (cross / norm[:, None]).T @ (vectors / np.sqrt(values))
        error = float(np.sqrt(variance) * np.linalg.norm(turned) / unit[worst])
        amplitudes: tuple[Amplitude, ...] = ()
        if family.labels and rank == family.size:
            inverse = (vectors / values) @ vectors.T
            unit = np.array(family.per_amplitude) / norm
            best, errors = inverse @ slope * unit, np.sqrt(variance * np.diag(inverse)) * unit
            amplitudes = tuple(
                Amplitude(name, u, float(value), float(sigma))
                for (name, u), value, sigma in zip(family.labels, best, errors, strict=True)
            )
        largest, name = float(moved[worst]), self.names[worst]
        test = replace(test, visible=visible, amplitudes=amplitudes)
        return replace(test, moved_sigma=largest, moved_name=name, moved_std=error)

    def frame_by_frame(self) -> MisfitTest | None:
        """Does scale or shape change from frame to frame?"""
        matrix, _, rss = self.independent
        left, kept = without_first(
            self.plain - self.blocks,
            self.p,
            _ABSORBED,
            1.0 / np.sqrt(np.diag(matrix)),
        )
        rank = self.block_rank + kept - self.p
        if rank <= 0 or self.dof - rank < LEAST_DOF:
            return None
        return self._f_test(FRAME_BY_FRAME, "frame", rss - float(left[0, 0]), rank, rss)

    def noise_by_frame(self) -> tuple[float, float] | None:
        """Normal z and p-value of Bartlett's test that all frames have one noise; None for too few
        frames.

        With d_k degrees of freedom of the frames' sums of squares S_k, nu in all, the statistic is
        T = nu log(S / nu) - sum d_k log(S_k / d_k). Shares of S are independent of S, so that mean
        and variance of T follow exactly from those of logarithms of chi-squares; T is then taken as
        gamma-distributed. Many coefficients of effects that frames share couple their sums: mean
        and variance are then those of independent ones times what that does to them to first order.
        """
        from scipy.special import digamma, gammaincc, ndtri, polygamma

        squares, dof, matrices = (
            np.concatenate(column) for column in zip(*self.frames, strict=True)
        )
        dof = dof - np.einsum("kab,ba->k", matrices, (self.freed or self.independent)[1])
        nu = float(dof.sum())
        if (
            len(dof) < _LEAST_FRAMES
            or nu < LEAST_DOF
            or dof.min() < _LEAST_FRAME_DOF
            or squares.min() <= 0.0
        ):
            return None
        found = nu * np.log(squares.sum() / nu) - np.sum(dof * np.log(squares / dof))
        mean = nu * (digamma(nu / 2) - np.log(nu / 2)) - np.sum(
            dof * (digamma(dof / 2) - np.log(dof / 2))
        )
        variance = np.sum(dof**2 * polygamma(1, dof / 2)) - nu**2 * float(polygamma(1, nu / 2))
        if self.freed is not None:
            by_mean, by_variance = _coupled(matrices, dof)
            mean, variance = mean * by_mean, variance * by_variance
        p = float(gammaincc(mean**2 / variance, found * mean / variance))
        return float(-ndtri(np.clip(p, 1e-300, 1.0 - 1e-16))), p

    def _f_test(
        self, name: str, against: str, explained: float, rank: int, rss: float
    ) -> MisfitTest:
        from scipy.special import fdtrc

        rest = self.dof - rank
        variance = (rss - explained) / rest
        statistic = float(max(explained, 0.0) / rank / variance)
        excess = max(explained - rank * variance, 0.0) / (2.0 * self.n_stars)
        p = float(fdtrc(rank, rest, statistic))
        return MisfitTest(
            name,
            against,
            statistic,
            rank,
            rest,
            p,
            1.0,
            float(np.sqrt(excess)) * self.noise_px,
            float("nan"),
        )


def _coupled(matrices: FloatArray, dof: FloatArray) -> tuple[float, float]:
    """Factors on mean and variance of Bartlett's statistic where frames share what is fitted.

    `matrices` (K, r, r): products over each frame of what is orthonormal over all. `dof` (K,):
    degrees of freedom of the frames' sums of squares, whose covariance is twice G: T is near
    ``s^T K s / 2`` with s their departures from `dof` and ``K = diag(1 / d) - 1 1^T / nu``.
    """
    among = np.einsum("kab,lab->kl", matrices, matrices)
    among += np.diag(dof - np.einsum("kaa->k", matrices))
    by = among / dof[:, None] - among.sum(axis=0) / dof.sum()
    free = len(dof) - 1.0
    return float(np.trace(by)) / free, float(np.sum(by * by.T)) / free
