"""The tables on what questions the model: tests for misfit, jackknife, models, replicated data, derived quantities."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from starcal_uq.camera.distortion import parameters
from starcal_uq.core.formatting import count, decimals_for, fixed, percent, plural, pretty_unit, significant
from starcal_uq.diagnostics.verdict.estimate import MISFIT_P, models_sentence
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.presentation.report.tables import Row, symbol

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.diagnostics.jackknife import Jackknife
    from starcal_uq.diagnostics.misfit import Misfit
    from starcal_uq.diagnostics.models import ModelComparison
    from starcal_uq.diagnostics.predictive import PredictiveCheck
    from starcal_uq.estimation.calibration import Calibration
    from starcal_uq.inference.posterior import Posterior


def diagnosis_context(diagnosis: Diagnosis | None, cal: Calibration) -> dict[str, Any]:
    """What the misfit section shows; empty where there is no diagnosis."""
    if diagnosis is None:
        return {}
    return {
        "misfit_rows": misfit_rows(diagnosis.misfit),
        "misfit_sentence": _misfit_sentence(diagnosis),
        "jackknife_rows": [] if diagnosis.jackknife is None else jackknife_rows(diagnosis.jackknife, cal),
        "jackknife_sentence": "" if diagnosis.jackknife is None else _jackknife_sentence(diagnosis.jackknife),
        "comparison_rows": [] if diagnosis.comparison is None else comparison_rows(diagnosis.comparison, cal),
        "comparison_sentence": "" if diagnosis.comparison is None else models_sentence(diagnosis.comparison),
        "predictive_rows": predictive_rows(diagnosis.predictive),
    }


def misfit_rows(misfit: Misfit) -> list[Row]:
    """One row per test."""
    rows = []
    for test in misfit.tests:
        kind = f"F({count(test.dof)}, {count(test.dof_residual)}) = {fixed(test.statistic, 2)}"
        rows.append(
            {
                "name": test.name[0].upper() + test.name[1:],
                "statistic": kind if test.dof else f"z = {fixed(test.statistic, 2)}",
                "p": significant(test.p_value),
                "p_holm": significant(test.p_holm),
                "found": test.p_holm < MISFIT_P,
                "size": "" if np.isnan(test.size_px) else significant(test.size_px),
                "visible": "" if np.isnan(test.visible) else percent(test.visible),
                "amplitudes": "; ".join(str(a) for a in test.amplitudes),
            }
        )
    return rows


def _misfit_sentence(diagnosis: Diagnosis) -> str:
    rejected = diagnosis.misfit.found(MISFIT_P)
    several = f"{plural(len(diagnosis.misfit.tests), 'test')}, overall p = {significant(diagnosis.misfit.p_value)}"
    if not rejected:
        return f"None found anything ({several})."
    return f"{len(rejected)} of {several}."


def jackknife_rows(jackknife: Jackknife, cal: Calibration) -> list[Row]:
    """One row per parameter."""
    formal, robust = (np.sqrt(np.diag(c)) for c in (jackknife.formal_covariance, jackknife.jackknife_covariance))
    low, high = jackknife.expected()
    p_values = jackknife.p_values
    return [
        {
            "symbol": symbol(p.name),
            "unit": pretty_unit(p.scaled_unit),
            "formal": significant(float(formal[i]) / p.scale),
            "jackknife": significant(float(robust[i]) / p.scale),
            "ratio": fixed(float(jackknife.ratio[i]), 2),
            "expected": f"{fixed(float(low[i]), 2)} to {fixed(float(high[i]), 2)}",
            "sandwich": fixed(float(jackknife.sandwich_ratio[i]), 2),
            "p": significant(float(p_values[i])),
            "factor": fixed(float(jackknife.factors[i]), 2),
        }
        for i, p in enumerate(parameters(cal.camera.distortion))
    ]


def _jackknife_sentence(jackknife: Jackknife) -> str:
    low, high = float(jackknife.ratio.min()), float(jackknife.ratio.max())
    return f"Here the ratios are {fixed(low, 2)} to {fixed(high, 2)}, over {plural(jackknife.n_frames, 'frame')}."


def comparison_rows(models: ModelComparison, cal: Calibration) -> list[Row]:
    """One row per model, the best first."""
    unit = " px" if cal.sigma_name == "sigma" else ""
    rows = []
    for score in models.scores:
        parts = [
            f"{significant(float(np.hypot(*part[:2])))} / {significant(abs(part[2]))}"
            for part in (score.common_arcsec, score.rest_arcsec)
        ]
        mine = score.model == models.fitted
        best = score.difference == 0.0
        rows.append(
            {
                "model": score.model,
                "fitted": mine,
                "parameters": score.n_parameters,
                "sigma": f"{significant(score.sigma, 4)}{unit}",
                "difference": "best" if best else f"{fixed(score.difference, 1)} ± {fixed(score.difference_se, 1)}",
                "outcome": "rejected" if score.rejected else "not rejected",
                "common": "–" if mine else parts[0],
                "rest": "–" if mine else parts[1],
                "khat": fixed(score.max_khat, 2)
                + (f" ({score.n_replaced} in closed form)" if score.n_replaced else ""),
            }
        )
    return rows


def predictive_rows(predictive: PredictiveCheck) -> list[Row]:
    """One row per statistic."""
    rows = []
    for s in predictive.statistics:
        decimals = decimals_for(s.replicated_high - s.replicated_low)
        low, high = fixed(s.replicated_low, decimals), fixed(s.replicated_high, decimals)
        rows.append(
            {
                "name": s.name,
                "observed": fixed(s.observed, decimals),
                "range": f"{low} to {high}",
                "p": significant(s.p_value),
            }
        )
    return rows


def derived_rows(post: Posterior) -> list[Row]:
    """Convergence of what follows from the parameters."""
    rows = []
    for d in derived_quantities(post):
        decimals = decimals_for(d.sd)
        mean = "0" if d.name.startswith("common") else fixed(d.mean, decimals)
        rows.append(
            {
                "name": d.name[0].upper() + d.name[1:],
                "value": f"{mean} ± {significant(d.sd)}",
                "unit": d.unit,
                "rhat": fixed(d.rhat, 4),
                "bulk": count(int(d.ess_bulk)),
                "tail": count(int(d.ess_tail)),
                "mcse_share": percent(d.mcse / d.sd if d.sd > 0.0 else 0.0),
            }
        )
    return rows
