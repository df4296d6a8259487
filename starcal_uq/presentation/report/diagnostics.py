"""The tables on what questions the model: tests for misfit, jackknife, models, replicated data,
derived quantities.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import count, decimals_for, fixed, p_words, percent, significant
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.estimate import MISFIT_P
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.presentation.sentences.estimate import models_sentence, star_sentence
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.diagnostics import (
    jackknife_table,
    jackknife_text,
    misfit_table,
    models_table,
    predictive_table,
    sensitivity,
    star_table,
)
from starcal_uq.presentation.words.effects import MEANINGS, effects_table, effects_text

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior


def effects_context(cal: Calibration) -> AnyDict:
    """What the section on effects shows; empty where none were looked for."""
    if cal.effects is None:
        return {}
    return {
        "effects_table": effects_table(cal.effects, path=True),
        "effects_sentence": effects_text(cal.effects),
        "effects_meanings": [(name, MEANINGS[name]) for name in cal.effects.names],
    }


def diagnosis_context(diagnosis: Diagnosis | None, cal: Calibration) -> AnyDict:
    """What the misfit section shows; empty where there is no diagnosis."""
    if diagnosis is None:
        return {}
    jackknife, models, stars = diagnosis.jackknife, diagnosis.comparison, diagnosis.stars
    unit = " px" if cal.sigma_name == "sigma" else ""
    return {
        "misfit_table": misfit_table(diagnosis.misfit),
        "misfit_sentence": f"{_misfit_sentence(diagnosis)} {sensitivity(diagnosis)}".strip(),
        "jackknife_table": None
        if jackknife is None
        else jackknife_table(jackknife, parameters(cal.camera.distortion)),
        "jackknife_sentence": "" if jackknife is None else jackknife_text(jackknife),
        "star_table": None
        if stars is None or not stars.applicable
        else star_table(stars, parameters(cal.camera.distortion)),
        "star_sentence": "" if stars is None else star_sentence(stars),
        "models_table": None if models is None else models_table(models, unit, "this report"),
        "models_sentence": "" if models is None else models_sentence(models),
        "predictive_table": predictive_table(diagnosis.predictive),
    }


def _misfit_sentence(diagnosis: Diagnosis) -> str:
    rejected = diagnosis.misfit.found(MISFIT_P)
    said = f"of the {len(diagnosis.misfit.tests)} tests found {'some' if rejected else 'any'}"
    return f"{len(rejected) or 'None'} {said} (overall {p_words(diagnosis.misfit.p_value)})."


def derived_table(post: Posterior) -> TextTable:
    """Convergence of what follows from the parameters."""
    rows = []
    for d in post.diagnostics.derived or derived_quantities(post):
        mean = "0" if d.name.startswith("common") else fixed(d.mean, decimals_for(d.sd))
        share = percent(d.mcse / d.sd if d.sd > 0.0 else 0.0)
        ess = (count(int(d.ess_bulk)), count(int(d.ess_tail)))
        name = d.name[0].upper() + d.name[1:]
        rows.append((name, f"{mean} ± {significant(d.sd)}", d.unit, fixed(d.rhat, 4), *ess, share))
    heads = ("", "Mean ± σ", "Unit", "R-hat", "ESS, bulk", "ESS, tail", "MCSE / σ")
    return TextTable(heads, tuple(rows), align="lrlrrrr")
