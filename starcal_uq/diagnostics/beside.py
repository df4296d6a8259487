"""Residuals beside the effects of a calibration: less what these shift, or with their coefficients
taken for free.

Tests of shapes weigh the residuals by the covariance that effects give them. Tests of the noise
need residuals that are independent but for linear combinations that are fitted: there, coefficients
of effects have no prior, so that what is left is noise alone, however large the effects are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.core.types import FloatArray, IntArray, floats
from starcal_uq.estimation import effects
from starcal_uq.estimation.effects import beside_effects
from starcal_uq.estimation.normals import FrameNormals
from starcal_uq.estimation.zenith import Images, orthonormal
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.effect_sums import Columns
from starcal_uq.likelihood.effects import star_effect
from starcal_uq.likelihood.elimination import ByFrame, products_by_frame
from starcal_uq.likelihood.marginal import MarginalLikelihood
from starcal_uq.likelihood.star_errors import StarModel
from starcal_uq.maths.linear import principal, unit_diagonal
from starcal_uq.observations.frames import StarFrames
from starcal_uq.observations.splits import frame_sample

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.observations.table import Observations

# Images of some frames: most frames, and stars that they hold.
FRAMES, _STARS = 200, 4000
# Directions of which what is fitted already takes all but this share of the square are not there.
_ABSORBED = 1e-8
_STARS_AT_ONCE = 10_000


class StarNoise(NamedTuple):
    """Direction errors of the stars per axis, px, the noise of their images, and how many recur."""

    tau_px: float
    sigma: float
    n_recurring: int


def images_beside(
    obs: Observations,
    cal: Calibration,
    seed: int,
    errors: StarNoise | None = None,
    most: int = FRAMES,
) -> Images:
    """Images of some frames beside the effects of a calibration, or beside errors of stars."""
    most = min(most, max(_STARS * obs.n_frames // obs.n_stars, 3))
    some, chosen = frame_sample(obs, most, seed)
    model, rotations = cal.camera.distortion, cal.rotations[chosen]
    likelihood = None
    if errors is not None:
        stars = star_effect(StarModel(some, float(cal.theta[2])))
        ratio = {stars.name: (errors.tau_px / errors.sigma) ** 2}
        frames = StarFrames.from_observations(some)
        at = (cal.theta, rotations, errors.sigma)
        likelihood = EffectLikelihood(frames, model, [stars], ratio, *at)
    elif cal.known_effects.fitted:
        likelihood = beside_effects(some, cal, rotations, obs)
    return Images(some, cal, rotations, likelihood)


def without_effects(obs: Observations, cal: Calibration) -> Observations:
    """The table with its images where they would be without the effects of the calibration, as far
    as these are known; itself where there are none.
    """
    return effects.without_effects(obs, cal) if cal.known_effects.fitted else obs


def normals_beside(obs: Observations, cal: Calibration) -> FrameNormals:
    """What each frame says about the parameters beside the effects of a calibration.

    Those of frames are marginalised in each; those of the run and of stars, which frames share, are
    as the calibration has them.
    """
    exact = beside_effects(obs, cal, cal.rotations)
    return FrameNormals.beside(exact, cal.theta)


def by_frame(frames: StarFrames, columns: FloatArray) -> tuple[FloatArray, IntArray]:
    """Columns (c, 2, N) that span the same in every frame by itself, orthonormal or zero, and how
    many of them are there in each (K,).
    """
    raw = np.sqrt(frames.sum(np.sum(columns**2, axis=1)))
    columns = columns / frames.spread(np.where(raw > 0.0, raw, 1.0))[:, None]
    values, vectors = np.linalg.eigh(products_by_frame(frames, columns, columns))
    kept = values > _ABSORBED
    root = vectors * np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)[:, None, :]
    spread = frames.spread(np.ascontiguousarray(np.moveaxis(root, 0, 2)))
    return np.einsum("axn,abn->bxn", columns, spread), np.count_nonzero(kept, axis=1)


@dataclass(frozen=True, eq=False)
class Freed:
    """Residuals without what attitudes, parameters and effects reproduce, all of them free."""

    frames: StarFrames
    a: FloatArray  # (c, 2, N): attitudes and effects of frames, orthonormal in each
    h: FloatArray  # (r, 2, N): parameters and effects of the run beside these, orthonormal
    e: FloatArray  # (2, N): whitened residuals
    frame_dof: FloatArray  # (K,): degrees of freedom of every frame, `h` not fitted
    rows: slice  # Rows of the stars in the table

    @classmethod
    def pieces(cls, obs: Observations, cal: Calibration, gram: FloatArray) -> Iterator[Freed]:
        """Those of a calibration, some frames at a time where it has no effects.

        `gram` (p + 1, p + 1): products of parameters and residuals, attitudes removed.
        """
        if cal.known_effects.fitted:
            yield cls.of(obs, cal)
            return
        inner, unit = unit_diagonal(gram[:-1, :-1])
        values, vectors = principal(inner, _ABSORBED)
        turn = (unit[:, None] * vectors / np.sqrt(values)).T
        along = turn @ gram[:-1, -1]
        likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        for part, state, columns, rows in likelihood.linearised(
            cal.theta, np.ones(len(unit)), cal.rotations, _STARS_AT_ONCE
        ):
            a, h = part.attitudes(state).orthonormal, np.tensordot(turn, columns[:-1], axes=1)
            e = columns[-1] - np.tensordot(along, h, axes=1)
            yield cls(part.frames, a, h, e, floats(2.0 * part.frames.sizes - 3.0), rows)

    @classmethod
    def of(cls, obs: Observations, cal: Calibration) -> Freed:
        """Those of a calibration with effects. Stars have what the calibration took for their
        error.
        """
        rotations = cal.rotations
        likelihood = MarginalLikelihood(obs, cal.camera.distortion)
        state, _ = likelihood.profile(cal.theta, rotations)
        frames, e = likelihood.frames, state.e
        held = cal.known_effects.of(obs, cal.camera)
        if any(effect.grouping == "star" for effect in held):
            exact = beside_effects(obs, cal, rotations)
            _, found = exact.conditioned(state, e[None])
            e = e - exact.shifts(state, exact.of_effect("star", found))[0]
        linear = [effect for effect in held if effect.grouping != "star"]
        columns = Columns.of(linear, likelihood, state, cal.theta, slice(None))
        of_frames, rank = by_frame(frames, columns.frame)
        basis = np.concatenate([likelihood.attitudes(state).orthonormal, of_frames])
        unit = np.broadcast_to(np.eye(len(basis))[:, :, None], (len(basis),) * 2 + rank.shape)
        own = ByFrame(frames, basis, unit)
        h = np.concatenate([likelihood.slopes(state), columns.run])
        scale = np.linalg.norm(h.reshape(len(h), -1), axis=1)
        h = own.removed_from(h / np.where(scale > 0.0, scale, 1.0)[:, None, None])
        h = orthonormal(h.reshape(len(h), -1), _ABSORBED).reshape(-1, *e.shape)
        e = own.removed_from(e[None])[0]
        e = e - np.tensordot(np.tensordot(h, e, axes=2), h, axes=1)
        dof = floats(2.0 * frames.sizes - 3.0 - rank)
        return cls(frames, basis, h, e, dof, slice(0, frames.n_stars))
