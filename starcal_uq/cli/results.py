"""What results put under the keys of a document that are no attributes of theirs: functions of the
results, by the names of the parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from starcal_uq.core.types import AnyDict


def _calibration(result: Any) -> AnyDict:
    from starcal_uq.presentation.words.sentences import told

    cal, truth = result if isinstance(result, tuple) else (result, None)
    table = cal.to_dataframe()
    true = {} if truth is None else dict(zip(cal.parameter_names, truth.theta, strict=True))
    pitch = cal.camera.pixel_um
    table["truth"] = [true.get(name) for name in table["parameter"]]
    table["z"] = (table["estimate"] - table["truth"].astype(float)) / table["sigma"]
    return {
        "status": cal.status.name,
        "camera": cal.camera.to_dict(),
        "focal_mm": cal.camera.focal_mm,
        "focal_sigma_mm": None if pitch is None else cal.sigmas[2] * pitch * 1e-3,
        "parameters": table,
        "notes": [*filter(None, (told("fitted_noise", cal), told("fallback", cal)))],
    }


def _effects(result: Any) -> AnyDict:
    return {"refused": [{"name": name, "gain_nat": gain} for name, gain in result.refused]}


def _ties(result: Any) -> AnyDict:
    return {"n_ties": len(result.known), "of_mount": result.known.of_mount}


def _posterior(result: Any) -> AnyDict:
    return {
        "n_draws": len(result.draws),
        "level": result.diagnostics.level,
        "checks": result.diagnostics.checks,
        "parameters": result.summary().rename(
            columns={"q2.5": "low", "q50": "median", "q97.5": "high"}
        ),
    }


def _coupling(result: Any) -> AnyDict:
    rows = result.to_dataframe().assign(
        prior_sigma=result.prior_sigma, contraction=result.contraction
    )
    parameters = _nested(rows, "correlation", "corr_", result.extended_names)
    return {
        "parameters": parameters,
        "directions": [direction.words for direction in result.weak_directions],
    }


def _consistency(result: Any) -> AnyDict:
    runs = _nested(result.to_dataframe(), "z", "z_", result.parameter_names)
    return {"runs": runs}


def _nested(table: Any, key: str, start: str, names: Any) -> list[AnyDict]:
    """Rows in which the columns of names that start alike are one object."""
    return [
        row | {key: {name: row[start + name] for name in names}} for row in table.to_dict("records")
    ]


def _budget(result: Any) -> AnyDict:
    totals = result.totals_dataframe().assign(
        not_assessed=[total.not_assessed for total in result.totals]
    )
    return {**result.to_dict(), "totals": totals}


def _diagnosis(result: Any) -> AnyDict:
    tables = {"jackknife": result.jackknife, "stars": result.stars}
    return {
        "misfit": result.misfit.tests,
        **{key: [] if part is None else part.to_dataframe() for key, part in tables.items()},
        "models": [] if result.comparison is None else result.comparison.scores,
        "predictive": result.predictive.statistics,
        "notes": [part.text for part in (result.comparison, result.stars) if part is not None],
    }


def _plan(result: Any) -> AnyDict:
    open_radii = {"radius_least_arcsec": None, "radius_most_arcsec": None}
    own = {"n_frames", "noise_relative"}
    forecast = [
        open_radii
        | row
        | {"sigma": {key: row[key] for key in row if key not in own and key[:7] != "radius_"}}
        for row in result.to_dataframe().to_dict("records")
    ]
    costs = result.effects
    effects = [
        {
            "effects": model,
            "sigma": dict(zip(costs.names, costs.sigma[i].tolist(), strict=True)),
            "camera_alone": dict(zip(costs.names, costs.camera_alone[i].tolist(), strict=True)),
        }
        for i, model in enumerate(costs.models if costs is not None else ())
    ]
    return {"camera": result.camera.to_dict(), "forecast": forecast, "effects": effects}


def _study(result: Any) -> AnyDict:
    from starcal_uq.presentation.words.studies import study_advice, study_answer, study_limits

    found, folder, page = result
    numbers = found.ok.any()
    return {
        "name": found.definition.name,
        "question": found.definition.question,
        "n_ok": int(found.ok.sum()),
        "answer": study_answer(found) if numbers else [],
        "advice": study_advice(found) if numbers else [],
        "limits": study_limits(found),
        "data": Path(folder, "study.nc"),
        "table": Path(folder, "study.parquet"),
        "page": page,
    }


def _attitude(result: Any) -> AnyDict:
    from starcal_uq.propagation.onboard_error import side_by_side

    return {
        "contributors": result.to_dataframe(),
        "aboard": side_by_side(result.variants),
        "thermal": [] if result.thermal is None else result.thermal.to_dataframe(),
    }


def _table_as(key: str) -> Callable[[Any], AnyDict]:
    """A result whose table stands under a key."""
    return lambda result: {key: result.to_dataframe()}


TAKEN: Mapping[str, Callable[[Any], Mapping[str, Any]]] = {
    "Calibration": _calibration,
    "Effects": _effects,
    "Ties": _ties,
    "Posterior": _posterior,
    "Coupling": _coupling,
    "Attitude": _attitude,
    "Budget": _budget,
    "Consistency": _consistency,
    "Diagnosis": _diagnosis,
    "Choice": _table_as("frames"),
    "ForecastCheck": _table_as("rows"),
    "Plan": _plan,
    "Study": _study,
}
