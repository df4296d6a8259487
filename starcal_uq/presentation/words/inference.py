"""Priors, posteriors and what questions them in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.camera.distortion import scales_of
from starcal_uq.inference.posterior import Posterior
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table


def posterior_table(post: Posterior) -> TextTable:
    """Mean, spread, interval and convergence of every parameter."""
    scale = scales_of(post.parameters)
    draws = post.draws / scale
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    return table(
        "posterior",
        {"n": len(draws)},
        it=post.parameters,
        mean=draws.mean(axis=0),
        sd=draws.std(axis=0),
        low=low,
        high=high,
        rhat=post.diagnostics.rhat,
        bulk=post.diagnostics.ess_bulk,
        tail=post.diagnostics.ess_tail,
    )


def posterior_notes(post: Posterior) -> list[str]:
    """Its checks."""
    return [*map(str, post.diagnostics.checks)]
