"""What questions a result, in sentences and tables: misfit, jackknife, models, predictive checks,
validation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.camera.distortion import Parameter, scales_of
from starcal_uq.core.types import AnyDict, FloatArray
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
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table, told

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
    given: AnyDict = {"level": MISFIT_P, "brief": found_only}
    given |= {"n_frames": found.n_asked, "of_frames": found.n_frames}
    return table("misfit", given, it=found.tests)


def _sigmas(
    of: str,
    found: Jackknife | StarTest,
    specs: Sequence[Parameter],
    covariances: Iterable[FloatArray],
    /,
    **columns: Any,
) -> TextTable:
    """A table with sigmas in the units of `specs`, or in px units."""
    scales = scales_of(specs) if specs else 1.0
    kinds = ("formal", "sandwich", "model", "jackknifed")
    sigmas = {
        kind: root_diagonal(matrix) / scales
        for kind, matrix in zip(kinds, covariances, strict=False)
    }
    units = [spec.scaled_unit for spec in specs] or [""] * len(columns["ratio"])
    given = {"n": found.n_frames, "of": found.of_frames}
    return table(of, given, () if specs else ("Unit",), unit=units, **columns, **sigmas)


def jackknife_table(found: Jackknife, specs: Sequence[Parameter] = ()) -> TextTable:
    """One row per parameter; sigmas in the units of `specs`, or in px units."""
    low, high = found.expected()
    return _sigmas(
        "jackknife",
        found,
        specs,
        (found.formal_covariance, found.sandwich_covariance),
        name=found.parameter_names,
        ratio=found.ratio,
        low=low,
        high=high,
        jackknife=found.jackknife_ratio,
        p=found.p_values,
    )


def star_table(found: StarTest, specs: Sequence[Parameter] = ()) -> TextTable:
    """One row per parameter: sigmas with the star as the unit of what is independent."""
    covariances = (
        found.formal_covariance,
        found.sandwich_covariance,
        found.model_covariance,
        found.jackknife_covariance,
    )
    names, ratio = found.parameter_names, found.widening
    return _sigmas("stars", found, specs, covariances, name=names, ratio=ratio)


def models_table(found: ModelComparison, sigma_unit: str = "", fitted: str = "fitted") -> TextTable:
    """One row per model, the best first; common and rest are the attitudes' move across the
    boresight / in roll.
    """
    given: AnyDict = {"mine": found.fitted, "fitted": fitted, "unit": sigma_unit}
    given |= {"n_sampled": found.n_sampled_frames, "n_frames": found.n_frames}
    given |= {"of_frames": found.of_frames}
    return table("models", given, it=found.scores)


def predictive_table(found: PredictiveCheck) -> TextTable:
    """One row per statistic: the data, and the range of 95 % of the replicates."""
    return table("predictive", {"n_draws": found.n_draws}, it=found.statistics)


def diagnosis_html(found: Diagnosis) -> str:
    """Every part, one after the other."""
    parts = (found.misfit, found.jackknife, found.stars, found.comparison, found.predictive)
    return "".join(part._repr_html_() or "" for part in parts if part is not None)


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
