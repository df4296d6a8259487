"""The exact likelihood of images beside effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray
from starcal_uq.likelihood.effect_sums import Columns, Cross, EffectSums, by_run, expected, pull_of
from starcal_uq.likelihood.effects import Effect
from starcal_uq.likelihood.marginal import MarginalLikelihood, Profile
from starcal_uq.observations.frames import StarFrames


class EffectLikelihood(MarginalLikelihood):
    """Exact likelihood with effects marginalised at given scales, in units of sigma.

    Coefficients are linear over fractions of a pixel, and their columns and normal equations are
    those at the estimate. What they are expected to be, `mean` (m,) of those of the run, is taken
    off the images in `frames`; all others here are differences from that. Where those of the run are
    `given`, from more frames than these, there is no difference.

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
        given: FloatArray | None = None,
    ) -> None:
        super().__init__(frames, model_name)
        state, _ = self.profile(theta, rotations)
        self.effects = tuple(effect for effect in effects if effect.name in ratio)
        run = [effect for effect in self.effects if effect.of_run]
        self.mean, self.pull = expected(run, ratio) if given is None else given, pull_of(run)
        if self.mean.any() or given is not None:
            seen = Columns.of(self.effects, self, state, theta, slice(None))
            shift = self.project_out(state, np.tensordot(self.mean, seen.raw, 1)[None])[0]
            shift = frames.in_pixels(shift)
            self.frames = replace(frames, pixel=np.ascontiguousarray(frames.pixel - shift))
            state, _ = self.profile(theta, state.rotations)
        self.use_rotations(state.rotations)
        # What frames share may be known: products of its columns are not needed then.
        free = [e for e in self.effects if given is None or not e.of_run]
        sums = EffectSums(free, theta, sigma)
        nothing = np.zeros((0, 2, frames.n_stars))
        self.columns = sums.add(self, state, nothing, slice(None))
        self.solved = sums.solved(ratio)
        if given is not None:
            self.columns = replace(self.columns, of_run=seen.of_run)
            self.solved = self.solved.with_known(len(given))
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
        raw = self.columns.raw
        own = found.run.T @ raw.reshape(len(raw), 2 * self.frames.n_stars)
        own = self.columns.attitudes.removed_from(own.reshape(-1, *raw.shape[1:]))
        own += np.einsum("ncq,cxn->qxn", found.frame[member], self.columns.frame, optimize=True)
        if self.columns.n_stars:
            own += self.project_out(state, self._of_stars(found))
        return own

    def _of_stars(self, found: Cross) -> FloatArray:
        by_image = found.star.reshape(self.columns.n_stars, 2, -1)[self.columns.groups]
        return np.asarray(np.einsum("niq,ixn->qxn", by_image, self.columns.star, optimize=True))

    def turns(self, state: Profile, found: Cross) -> FloatArray:
        """Rotation vectors (q, 3, K) of the frames that such shifts cause, rad."""
        columns = self.columns
        raw = np.tensordot((found.run * columns.turning[:, None]).T, columns.raw, 1)
        own = columns.attitudes.coefficients(raw)
        own += np.einsum("kcq,cik->qik", found.frame, self.columns.frame_turns)
        if self.columns.n_stars:
            own += self.attitude_response(state, self._of_stars(found))
        return own

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
        run = by_run([np.full(len(e.prior), e.name == name) for e in self.effects if e.of_run])
        frame, star = float(name == "frame"), float(name == "star")
        return Cross(found.run * run[:, None], found.frame * frame, found.star * star)

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


def _over(values: FloatArray, root: FloatArray) -> FloatArray:
    """Coefficients (..., c) in units of their standard deviations (c,); zero where these are."""
    return np.divide(values, root, out=np.zeros_like(values), where=root > 0.0)
