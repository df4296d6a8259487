"""What questions a result, in sentences and tables: misfit, jackknife, models, predictive checks,
validation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starcal_uq.camera.distortion import Parameter
from starcal_uq.core.formatting import (
    count,
    decimals_for,
    fixed,
    p_value,
    percent,
    plural,
    significant,
)
from starcal_uq.core.types import FloatArray
from starcal_uq.diagnostics.diagnose import Diagnosis
from starcal_uq.diagnostics.jackknife import Jackknife
from starcal_uq.diagnostics.misfit import Misfit
from starcal_uq.diagnostics.models import ModelComparison
from starcal_uq.diagnostics.predictive import PredictiveCheck
from starcal_uq.diagnostics.stars import StarTest
from starcal_uq.diagnostics.validation.replicates import LOG_LIKELIHOOD
from starcal_uq.diagnostics.validation.result import Validation
from starcal_uq.diagnostics.verdict.estimate import MISFIT_P
from starcal_uq.diagnostics.verdict.judge import Verdict
from starcal_uq.inference.checks import COMPRESSED_BOUND
from starcal_uq.presentation.tables import TextTable, with_units
from starcal_uq.presentation.words.sentences import told

# Errors this far from one posterior standard deviation are said to be too narrow or too wide; a
# mean error this far from zero is said to be a bias.
_SCALE_NOTED = 0.03
_BIAS_NOTED = 0.1


def verdict_notes(verdict: Verdict) -> list[str]:
    """Every check that did not pass; files of remedies as they are called from the current
    folder.
    """
    here = f"{Path.cwd()}/"
    return [str(check).replace(here, "") for check in verdict.doubts]


def misfit_table(found: Misfit, *, found_only: bool = False) -> TextTable:
    """One row per test; what found something is marked, and alone has amplitudes where so asked."""
    rows = tuple(
        (
            test.name[0].upper() + test.name[1:],
            test.against,
            f"F({count(test.dof)}, {count(test.dof_residual)}) = {fixed(test.statistic, 2)}"
            if test.dof
            else f"z = {fixed(test.statistic, 2)}",
            p_value(test.p_value),
            p_value(test.p_holm),
            "" if np.isnan(test.size_px) else significant(test.size_px),
            "" if np.isnan(test.visible) else percent(test.visible),
            "" if found_only and test.p_holm >= MISFIT_P else "; ".join(map(str, test.amplitudes)),
        )
        for test in found.tests
    )
    heads = (
        "Looks for",
        "Against",
        "Statistic",
        "p",
        "p, corrected",
        "Size [px]",
        "Visible",
        "Amplitudes",
    )
    marks = tuple("warning" if test.p_holm < MISFIT_P else "" for test in found.tests)
    return TextTable(heads, rows, "Misfit", "llrrrrrl", marks)


def _sigmas(covariance: FloatArray, specs: Sequence[Parameter]) -> list[str]:
    """Sigmas in the units of `specs`, or in px units."""
    scales = [spec.scale for spec in specs] or 1.0
    return [significant(v) for v in np.sqrt(np.diag(covariance)) / scales]


def jackknife_table(found: Jackknife, specs: Sequence[Parameter] = ()) -> TextTable:
    """One row per parameter; sigmas in the units of `specs`, or in px units."""
    low, high = found.expected()
    columns = (
        _sigmas(found.formal_covariance, specs),
        _sigmas(found.sandwich_covariance, specs),
        [fixed(v, 2) for v in found.ratio],
        [f"{fixed(a, 2)} to {fixed(b, 2)}" for a, b in zip(low, high, strict=True)],
        [fixed(v, 2) for v in found.jackknife_ratio],
        [significant(v) for v in found.p_values],
    )
    heads = (
        "Formal σ",
        "Over frames σ",
        "Ratio",
        "By chance (95 %)",
        "Jackknife ratio",
        "p",
    )
    rows = tuple(zip(found.parameter_names, *columns, strict=True))
    table = TextTable(("", *heads), rows, "Jackknife over frames")
    return with_units(table, specs) if specs else table


def star_table(found: StarTest, specs: Sequence[Parameter] = ()) -> TextTable:
    """One row per parameter: sigmas with the star as the unit of what is independent."""
    covariances = (
        found.formal_covariance,
        found.model_covariance,
        found.sandwich_covariance,
        found.jackknife_covariance,
    )
    columns = [_sigmas(c, specs) for c in covariances]
    heads = ("Formal σ", "With star errors", "Ratio", "Cluster-robust σ", "Jackknife σ")
    ratio = [fixed(v, 2) for v in found.widening]
    rows = tuple(zip(found.parameter_names, *columns[:2], ratio, *columns[2:], strict=True))
    table = TextTable(("", *heads), rows, "Errors of the stars")
    return with_units(table, specs) if specs else table


def models_table(found: ModelComparison, sigma_unit: str = "", fitted: str = "fitted") -> TextTable:
    """One row per model, the best first; common and rest are the attitudes' move across the
    boresight / in roll.
    """

    def moved(part: tuple[float, float, float]) -> str:
        return f"{significant(np.hypot(*part[:2]))} / {significant(abs(part[2]))}"

    rows = []
    for score in found.scores:
        mine, best = score.model == found.fitted, score.difference == 0.0
        replaced = f" ({score.n_replaced} in closed form)" if score.n_replaced else ""
        rows.append(
            (
                f"{score.model} ({fitted})" if mine else score.model,
                str(score.n_parameters),
                significant(score.sigma, 4) + sigma_unit,
                "best"
                if best
                else f"{fixed(score.difference, 1)} ± {fixed(score.difference_se, 1)}",
                "rejected" if score.rejected else "not rejected",
                *(("–", "–") if mine else (moved(score.common_arcsec), moved(score.rest_arcsec))),
                fixed(score.max_khat, 2) + replaced,
            )
        )
    heads = (
        "Model",
        "Parameters",
        "Noise",
        "Difference [nat]",
        "Outcome",
        "Common [arcsec]",
        "Rest [arcsec]",
        "k-hat",
    )
    some = found.n_sampled_frames < found.n_frames
    of = (
        f" (k-hat of {count(found.n_sampled_frames)} of {plural(found.n_frames, 'frame')})"
        if some
        else ""
    )
    return TextTable(heads, tuple(rows), f"Distortion models{of}", "lrrrlrrr")


def predictive_table(found: PredictiveCheck) -> TextTable:
    """One row per statistic: the data, and the range of 95 % of the replicates."""
    rows = []
    for s in found.statistics:
        decimals = decimals_for(s.replicated_high - s.replicated_low)
        low, high = fixed(s.replicated_low, decimals), fixed(s.replicated_high, decimals)
        p = p_value(s.p_value, 1.0 / found.n_draws)
        rows.append((s.name, fixed(s.observed, decimals), f"{low} to {high}", p))
    return TextTable(
        ("Statistic", "Data", "Replicates (95 %)", "p"), tuple(rows), "Predictive checks"
    )


def diagnosis_html(found: Diagnosis) -> str:
    """Every part, one after the other."""
    parts = (found.misfit, found.jackknife, found.stars, found.comparison, found.predictive)
    return "".join(part._repr_html_() or "" for part in parts if part is not None)


def validation_table(found: Validation) -> TextTable:
    """Coverage and ranks, one row per quantity."""
    columns = (
        "quantity",
        "unit",
        "coverage_95",
        "coverage_low",
        "coverage_high",
        "coverage_p",
        "rank_p",
    )
    return TextTable.of(found.to_dataframe(), "Validation", columns)


def validation_text(found: Validation) -> str:
    """One paragraph: is all well, on what evidence, what does not hold, and what else to know."""
    # Errors of camera parameters that are rejected together; the log likelihood has no symmetric
    # error.
    wrong = {f.quantity for f in found.findings if f.rejected} - {LOG_LIKELIHOOD}
    names = [n for n in found.quantities if n in wrong] or found.quantities[: found.n_parameters]
    z = {name: found.z[:, found.quantities.index(name)] for name in names}
    spread = {name: float(np.std(values)) for name, values in z.items()}
    mean = {name: float(np.mean(values)) for name, values in z.items()}
    root = np.sqrt(found.n_replicates)
    return told(
        "validation",
        found,
        chance_percent=196.0 * np.sqrt(0.95 * 0.05) / root,
        narrow={n: s for n, s in spread.items() if s > 1.0 + _SCALE_NOTED},
        wide={n: 1.0 / s for n, s in spread.items() if s < 1.0 - _SCALE_NOTED},
        biased={n: m for n, m in mean.items() if abs(m) > max(_BIAS_NOTED, 3 * spread[n] / root)},
        far=int(np.sum(np.abs(found.compression_error) > COMPRESSED_BOUND)),
    )
