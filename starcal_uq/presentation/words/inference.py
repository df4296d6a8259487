"""Priors, posteriors and what questions them in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.formatting import decimals_for, fixed, pretty_unit
from starcal_uq.inference.posterior import Posterior
from starcal_uq.presentation.tables import TextTable


def posterior_table(post: Posterior) -> TextTable:
    """Mean, spread, interval and convergence of every parameter."""
    diagnostics, rows = post.diagnostics, []
    for index, parameter in enumerate(post.parameters):
        column = post.draws[:, index] / parameter.scale
        mean, sd = float(np.mean(column)), float(np.std(column))
        decimals = decimals_for(sd)
        rows.append(
            (
                parameter.name,
                *(
                    fixed(number, decimals)
                    for number in (mean, sd, *np.quantile(column, [0.025, 0.975]))
                ),
                fixed(diagnostics.rhat[index], 4),
                f"{diagnostics.ess_bulk[index]:.0f}",
                f"{diagnostics.ess_tail[index]:.0f}",
                pretty_unit(parameter.scaled_unit),
            )
        )
    heads = ("parameter", "mean", "sd", "2.5 %", "97.5 %", "R-hat", "ESS bulk", "ESS tail", "unit")
    return TextTable(heads, tuple(rows), f"Posterior: {len(post.draws)} draws", "lrrrrrrrl")
