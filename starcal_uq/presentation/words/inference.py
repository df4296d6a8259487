"""Priors, posteriors and what questions them in sentences and tables."""

from __future__ import annotations

import numpy as np

from starcal_uq.core.formatting import decimals_for, fixed, pretty_unit
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.power_scaling import CONFLICT, WEAK, PriorSensitivity
from starcal_uq.inference.prior_draws import PriorPredictive
from starcal_uq.inference.priors import Priors
from starcal_uq.inference.update import ShiftTest
from starcal_uq.presentation.tables import TextTable


def priors_text(priors: Priors) -> str:
    """Every prior as a statement."""
    table = priors.to_dataframe()
    return (
        "; ".join(
            f"{name}: {words}"
            for name, words in zip(table["parameter"], table["statement"], strict=True)
        )
        + "."
    )


def posterior_text(post: Posterior) -> str:
    """How many draws, and whether they can be used."""
    verdict = "passes every check" if post.diagnostics.ok else "must not be used as it is"
    return f"{len(post.draws)} draws of {post.n_ensembles} ensembles; {verdict}."


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


def predictive_text(predictive: PriorPredictive) -> str:
    """Whether the data are a surprise to the prior, and how the drawn cameras look."""
    words = "The data lie within what the prior expects."
    if not np.any(np.isfinite(predictive.observed)):
        words = "No observations were given to compare with."
    elif not predictive.ok:
        names = ", ".join(predictive.surprising)
        words = (
            f"The prior does not expect the data in {names}: check the nominal camera, or widen "
            "the prior."
        )
    return (
        f"{words} {100 * predictive.folded:.1f} % of the cameras drawn from the prior fold over "
        "inside the field, "
        f"{100 * predictive.off_detector:.1f} % have their principal point off the detector."
    )


def sensitivity_text(sensitivity: PriorSensitivity) -> str:
    """Whether the priors matter, and for which parameters."""
    if sensitivity.ok:
        largest = f"{sensitivity.prior.max():.2g}"
        return (
            f"The priors do not matter: largest sensitivity {largest}, threshold "
            f"{sensitivity.threshold:g}."
        )
    parts = [
        (
            f"{word} for "
            f"{', '.join(n for n, w in zip(sensitivity.names, sensitivity.diagnosis, strict=True) if w == word)}"
        )
        for word in (CONFLICT, WEAK)
        if word in sensitivity.diagnosis
    ]
    return f"The priors matter: {'; '.join(parts)}."


def shift_text(shift: ShiftTest) -> str:
    """Whether the camera changed between two runs."""
    largest = int(np.argmax(np.abs(shift.z)))
    where = (
        f"largest change {shift.names[largest]}, {shift.z[largest]:+.1f} sigma; p = "
        f"{shift.p_value:.2g}"
    )
    if shift.significant:
        return (
            f"The camera changed between the runs ({where}): widen the prior by an allowed "
            "shift, or start afresh."
        )
    return f"Nothing shows that the camera changed between the runs ({where})."
