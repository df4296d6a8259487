"""Coefficients of effects that belong to single frames and stars, with their standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from starcal_uq.core.types import FloatArray
from starcal_uq.likelihood.effect_likelihood import EffectLikelihood
from starcal_uq.likelihood.effect_sums import Cross
from starcal_uq.likelihood.fitted_effects import Effects
from starcal_uq.likelihood.marginal import Profile


def local_coefficients(
    effects: Effects,
    likelihood: EffectLikelihood,
    state: Profile,
    found: Cross,
    covariance: FloatArray,
    sigma: float,
) -> Effects:
    """The effects with `frames` and `frame_sigmas` (K, c), `stars` and `star_sigmas` (S, 2), px.

    `found` are the best coefficients at an estimate, whose `covariance` (p, p) and whose effects of
    the run are in the deviations; those of stars take the attitudes and frames as known.
    """
    solved = likelihood.solved
    follow = solved.coefficients(likelihood.columns.cross(likelihood.slopes(state)))
    own = solved.frame_vectors * solved.frame_root[:, None, :]
    by_run = own @ solved.frame_run
    run = sigma**2 * solved.run_covariance
    frames = sigma**2 * np.sum(own**2, axis=2) + _spread(by_run, run)
    frames += _spread(follow.frame, covariance)
    stars = np.zeros(0)
    if solved.stars is not None:
        stars = sigma**2 * solved.stars.eliminated.variances
        stars += _spread(follow.star, covariance)
    return replace(
        effects,
        frames=found.frame[:, :, 0],
        frame_sigmas=np.sqrt(frames),
        stars=found.star.reshape(-1, 2),
        star_sigmas=np.sqrt(stars).reshape(-1, 2),
    )


def _spread(slopes: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variances (...) by slopes (..., q) with a covariance (q, q)."""
    return np.asarray(np.sum((slopes @ covariance) * slopes, axis=-1))
