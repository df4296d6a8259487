"""Sums over all stars from which tests of shapes follow."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.diagnostics.beside import (
    by_frame,
)
from starcal_uq.diagnostics.misfit_test import LEAST_DOF, Amplitude, MisfitTest
from starcal_uq.likelihood.effect_sums import Columns, EffectSums, Solved
from starcal_uq.likelihood.effects import Effect
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.shapes import (
    FRAME_BY_FRAME,
    Shape,
    frame_shapes,
)
from starcal_uq.maths.linear import principal, scaled_inverse, without_first

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Directions of which the fit absorbs all but this share of the square are not there to be tested.
_ABSORBED = 1e-8
# Share of the square of a shape that effects must leave in sight for it to be looked for: what they
# explain almost as large as the data could show it says how well their prior describes it, and not
# what they leave.
_SEEN = 0.1
_STARS_AT_ONCE, _ALL_AT_ONCE = 10_000, 20_000
# Square of a scale that leaves coefficients free, in units of the noise and of the columns.
_FREE = 1e10


class ShapeSums:
    """Sums over all stars from which every test follows; the table is visited once, some frames at
    a time.

    Shapes are effects of the run without a prior: where a calibration has effects, everything is
    weighed by these.

    `places` (N,): rows of the stars in the table that the shapes are of, where that is another one.
    """

    def __init__(
        self,
        obs: Observations,
        cal: Calibration,
        families: tuple[Shape, ...],
        places: IntArray | None = None,
    ) -> None:
        likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        p, theta, effects = len(cal.theta), cal.theta, cal.known_effects.of(obs, cal.camera)
        self.p, self.dof = p, likelihood.dof - p
        self.names, self.n_stars = cal.parameter_names, obs.n_stars
        self.noise_px = float(np.sqrt(np.mean(obs.sigma_or_one**2)))
        self._looked_for = [Effect(own.name, "run", own, np.ones(own.size)) for own in families]
        sums = EffectSums([*effects, *self._looked_for], theta, cal.sigma)
        frame = Effect("frame", "frame", frame_shapes(cal.camera), np.ones(3))
        held = any(effect.name == frame.name for effect in effects)
        of_frames = None if held else EffectSums([*effects, frame], theta, cal.sigma, apart=False)
        # Degrees of freedom that scale and shape of every frame by itself take.
        self.places, self.block_rank, square = sums.places, 0, 0.0
        rotations = cal.rotations
        for part, state, rows in likelihood.pieces(theta, rotations, _STARS_AT_ONCE):
            h, where = state.slopes, rows if places is None else places[rows]
            fitted = part.project_out(state, np.concatenate([h, state.e[None]]))
            sums.add(part, state, fitted, where)
            if of_frames is not None:
                own = of_frames.add(part, state, fitted, where).frame
                self.block_rank += int(by_frame(part.frames, own)[1].sum())
                square += float(np.sum(own**2))
        # Squares of the columns before attitudes are removed
        self.raw = sums.total.squares
        ratio = cal.known_effects.ratio(cal.sigma)
        # Products of parameters, residuals and columns of effects and of all families, attitudes
        # removed, and what they would be without effects, where there are any.
        self.gram = _without_effects(sums.solved(ratio))
        self.before = _without_effects(sums.solved({})) if effects else None
        # What scale and shape of every frame explain of parameters and residuals
        self.blocks = np.zeros((p + 1, p + 1))
        if of_frames is not None:
            free = ratio | {frame.name: _FREE * 3.0 * obs.n_frames / square}
            self.blocks = self.gram[: p + 1, : p + 1] - of_frames.solved(free).gram

    def for_all(self, obs: Observations, cal: Calibration) -> ShapeSums:
        """The sums over all frames, of which these are a sample, of a calibration without effects.

        Products with the residuals, on which the power of the tests rests, are those of all stars;
        products of parameters and columns, their covariance, are these scaled up.
        """
        likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        along = np.zeros(len(self.gram))
        for part, state, rows in likelihood.pieces(cal.theta, cal.rotations, _ALL_AT_ONCE):
            columns = Columns.of(self._looked_for, part, state, cal.theta, rows)
            plain = np.concatenate([state.slopes, state.e[None]])
            along += np.append(np.tensordot(plain, state.e, axes=2), columns.along(state.e))
        found, more = copy(self), obs.n_stars / self.n_stars
        found.n_stars, found.dof = obs.n_stars, likelihood.dof - self.p
        found.raw, found.gram = self.raw * more, self.gram * more
        found.gram[self.p] = found.gram[:, self.p] = along
        return found

    @cached_property
    def alone(self) -> FloatArray:
        """Residuals and columns (1 + q, 1 + q) with the parameters removed."""
        return without_first(self.gram, self.p, _ABSORBED, self._unit)[0]

    @property
    def _unit(self) -> FloatArray:
        return 1.0 / np.sqrt(np.diag(self.gram)[: self.p])

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
        norm = np.sqrt(self.raw[at])
        return np.where(norm > 0.0, norm, 1.0)

    @cached_property
    def projection(self) -> FloatArray:
        """Inverse of the Gram matrix of the parameters, attitudes removed."""
        return scaled_inverse(self.gram[: self.p, : self.p])

    @property
    def unit_px(self) -> float:
        """Root mean square per axis of a pattern whose square is one unit of the noise, px."""
        return float(np.sqrt(self.rss / self.dof / (2.0 * self.n_stars)) * self.noise_px)

    @property
    def rss(self) -> float:
        """Sum of squared residuals, what little the parameters could still explain taken off."""
        return float(self.alone[0, 0])

    def family(self, family: Shape) -> MisfitTest | None:
        """The test of one family; None where nothing of it is left, or too few data."""
        at, system = self.places[family.name], self.alone
        norm, present = self.norms(at), np.count_nonzero(self.raw[at])
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
        test = replace(test, visible=visible, amplitudes=amplitudes, moved_std=error)
        return replace(test, moved_sigma=float(moved[worst]), moved_name=self.names[worst])

    def frame_by_frame(self) -> MisfitTest | None:
        """Does scale or shape change from frame to frame?"""
        p = self.p
        left, kept = without_first(
            self.gram[: p + 1, : p + 1] - self.blocks, p, _ABSORBED, self._unit
        )
        rank = self.block_rank + kept - self.p
        if rank <= 0 or self.dof - rank < LEAST_DOF:
            return None
        return self._f_test(FRAME_BY_FRAME, "frame", self.rss - float(left[0, 0]), rank, self.rss)

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
            detectable_px=self.unit_px,
        )


def _without_effects(solved: Solved) -> FloatArray:
    """Products of the added columns and the run's that effects leave."""
    cross = np.concatenate([solved.cross, solved.own], axis=1)
    left = np.linalg.solve(solved.run_factor, solved.run_root[:, None] * cross)
    every = np.concatenate([np.concatenate([solved.outer, solved.cross.T], axis=1), cross])
    return np.asarray(every - left.T @ left)
