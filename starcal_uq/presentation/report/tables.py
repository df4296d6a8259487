"""The tables of a report: rows of finished text, with digits that end where the uncertainty
begins.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starcal_uq.camera.distortion import Parameter, parameters, sigma_parameter
from starcal_uq.core.constants import INTERACTION
from starcal_uq.core.formatting import (
    count,
    decimals_for,
    fixed,
    percent,
    plural,
    plus_minus,
    pretty_unit,
    significant,
    with_sigma,
)
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.estimate import truth_z
from starcal_uq.presentation.html import symbol
from starcal_uq.presentation.tables import TextTable, with_units
from starcal_uq.propagation.attitude_error import CONTRIBUTORS, IF_MODEL_HOLDS, WITH_MISFIT_FOUND

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.pipeline.record import ImageRecord
    from starcal_uq.presentation.report.results import Results
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.coupling import Coupling

Row = AnyDict


def all_parameters(results: Results) -> tuple[Parameter, ...]:
    """Camera parameters and the noise."""
    cal = results.calibration
    return (*parameters(cal.camera.distortion), sigma_parameter(cal.sigma_name == "sigma_scale"))


def parameter_rows(results: Results) -> list[Row]:
    """One row per parameter, and one for the focal length in millimetres."""
    cal, post, truth = results.calibration, results.posterior, results.truth
    mean, sd = np.append(cal.theta, cal.sigma), np.append(cal.sigmas, cal.sigma_std)
    low, high = np.vstack([cal.interval(), cal.sigma_interval()]).T
    prior: list[tuple[float, float] | None] = [None] * len(mean)
    if post is not None:
        mean, sd = post.draws.mean(axis=0), post.sd
        low, high = np.quantile(post.draws, (0.025, 0.975), axis=0)
        names = post.parameter_names
        prior = list(zip(post.priors.mean(names), post.priors.sd(names), strict=True))
    start: list[float | None] = [*cal.nominal.theta.tolist(), None]
    true: list[float | None] = [None] * len(mean)
    z = np.full(len(mean), np.nan)
    if truth is not None:
        true[: len(cal.theta)] = truth.theta.tolist()
        z[: len(cal.theta)] = truth_z(cal, truth, post)
    rows = []
    for i, parameter in enumerate(all_parameters(results)):
        numbers = _Numbers(mean[i], sd[i], low[i], high[i], prior[i], start[i], true[i], z[i])
        rows.append(_parameter_row(parameter, parameter.scaled_unit, parameter.scale, numbers))
        if parameter.name == "f" and cal.camera.pixel_um is not None:
            rows.append(_parameter_row(parameter, "mm", 1000.0 / cal.camera.pixel_um, numbers))
            rows[-1]["description"] = "the same in millimetres"
    return rows


class _Numbers(NamedTuple):
    """Numbers of a parameter, with the prior's mean and spread."""

    mean: float
    sd: float
    low: float
    high: float
    prior: tuple[float, float] | None
    start: float | None
    true: float | None
    z: float


def _parameter_row(parameter: Parameter, unit: str, scale: float, numbers: _Numbers) -> Row:
    mean, sd, low, high, prior, start, true, z = numbers
    spread = sd / scale
    decimals = decimals_for(spread)
    # A noise that was given has no spread: show it, and leave the rest empty.
    known = spread > 0.0
    prior_text = ""
    if prior is not None and known:
        if parameter.name.startswith("sigma"):
            prior_text = "log-normal, below"
        else:
            prior_text = plus_minus(prior[0] / scale, prior[1] / scale)
    return {
        "name": parameter.name,
        "symbol": symbol(parameter.name),
        "description": parameter.description,
        "unit": pretty_unit(unit),
        "estimate": fixed(mean / scale, decimals) if known else significant(mean / scale, 4),
        "sigma": significant(spread) if known else "given",
        "interval": f"{fixed(low / scale, decimals)} … {fixed(high / scale, decimals)}"
        if known
        else "",
        "prior": prior_text,
        "start": "" if start is None else with_sigma(start / scale, spread * 10.0),
        "truth": ""
        if true is None
        else with_sigma(true / scale, spread / 10.0).rstrip("0").rstrip("."),
        "z": "" if not np.isfinite(z) else ("+" if z > 0 else "") + fixed(z, 1),
    }


_ATTITUDE_NOTES = (
    "random, new in every frame",
    "one constant for the mission",
    "depends on where the stars are",
    "common rotation and rest together",
    "beyond the sum of both",
)


def attitude_rows(error: AttitudeError) -> list[Row]:
    """Contributions to the attitude error by both their figures: 1 sigma, 95 % and 99.7 % for each
    axis, arcsec.
    """
    table = error.to_dataframe()
    rows = []
    for (contributor, group), note in zip(
        table.groupby("contributor", sort=False), _ATTITUDE_NOTES, strict=True
    ):
        text = str(contributor)
        shown = _small if text == INTERACTION else significant
        figures = []
        for name, column in (
            (WITH_MISFIT_FOUND, "with_misfit_found"),
            (IF_MODEL_HOLDS, "if_model_holds"),
        ):
            untested = column == "with_misfit_found" and error.misfit is None
            values = {
                head: []
                if untested
                else [shown(float(v)) for v in group[f"{start}{column}_arcsec"]]
                for head, start in (("sigma", ""), ("p95", "p95_"), ("p997", "p997_"))
            }
            figures.append({"name": name, "untested": untested, **values})
        if all(figures[0][head] == figures[1][head] for head in ("sigma", "p95", "p997")):
            figures = [{**figures[0], "name": "both"}]
        if group["if_model_holds_arcsec"].isna().any():
            note = "not sampled by the version that wrote this run"
        absorbed = str(group["absorbed_by_alignment"].iloc[0])
        name = text[0].upper() + text[1:]
        rows.append(
            {
                "name": name,
                "note": note,
                "absorbed": absorbed,
                "total": text == CONTRIBUTORS[3],
                "figures": figures,
                "first_order": [shown(float(v)) for v in group["first_order_arcsec"]],
            }
        )
    return rows


def _small(arcsec: float) -> str:
    """The interaction is shown to be small, and no more: twelve columns leave no room for powers of
    ten.
    """
    if np.isnan(arcsec):
        return "—"
    return (
        "< 0.001".replace(" ", "\N{NO-BREAK SPACE}")
        if 0.0 < arcsec < 0.001
        else significant(arcsec)
    )


def weak_directions(coupling: Coupling) -> list[Row]:
    """The directions that the data determine worst, in words and as weights."""
    rows = []
    for direction in coupling.weak_directions:
        if direction.variance <= 1.4:
            continue
        weights = zip(coupling.parameter_names, direction.weights, strict=True)
        parts = [(symbol(name), fixed(w, 2)) for name, w in weights if abs(w) >= 0.1]
        share = direction.variance / len(coupling.parameter_names)
        rows.append({"words": direction.words, "weights": parts, "share": percent(share)})
    return rows


def diagnostics_table(post: Posterior) -> TextTable:
    """Convergence of every sampled parameter."""
    d = post.diagnostics
    rows = []
    for i in post.sampled:
        parameter = post.parameters[i]
        mcse = d.mcse[i] / parameter.scale
        rows.append(
            (
                parameter.name,
                fixed(d.rhat[i], 4),
                count(int(d.ess_bulk[i])),
                count(int(d.ess_tail[i])),
                mean_to_mcse(post.draws[:, i].mean() / parameter.scale, mcse),
                _with_unit(significant(mcse), parameter),
                percent(d.mcse[i] / post.sd[i]),
                fixed(d.autocorrelation[i], 1),
            )
        )
    heads = (
        "",
        "R-hat",
        "ESS, bulk",
        "ESS, tail",
        "Mean, to the digits of its MCSE",
        "MCSE of the mean",
        "MCSE / σ",
    )
    return TextTable((*heads, "Autocorrelation [steps]"), tuple(rows))


def mean_to_mcse(mean: float, mcse: float) -> str:
    """A mean with the digits that its Monte Carlo error leaves: the last one is larger than the
    error.
    """
    decimals = 0 if not mcse > 0.0 else max(0, int(np.floor(-np.log10(mcse))))
    return fixed(mean, decimals)


def _with_unit(number: str, parameter: Parameter) -> str:
    unit = pretty_unit(parameter.scaled_unit)
    return f"{number} × {unit}" if parameter.scale != 1.0 else f"{number} {unit}".strip()


def methods_rows(results: Results) -> list[Row]:
    """Estimate, Laplace approximation, importance sampling and emcee side by side."""
    cal, post = results.calibration, results.posterior
    if post is None:
        return []
    d, estimate = post.diagnostics, np.append(cal.theta, cal.sigma)
    spread, draws_mean = np.append(cal.sigmas, cal.sigma_std), post.draws.mean(axis=0)
    sources = (
        (estimate, spread),
        (d.laplace_mean, d.laplace_sd),
        (d.psis_mean, d.psis_sd),
        (draws_mean, post.sd),
    )
    rows = []
    for i in post.sampled:
        parameter = post.parameters[i]
        # One digit more than elsewhere: the table is there to show small differences.
        decimals = decimals_for(post.sd[i] / parameter.scale, 3)
        cells = [
            (
                f"{fixed(m[i] / parameter.scale, decimals)} ± "
                f"{fixed(s[i] / parameter.scale, decimals)}"
            )
            for m, s in sources
        ]
        unit = pretty_unit(parameter.scaled_unit)
        rows.append({"symbol": symbol(parameter.name), "unit": unit, "cells": cells})
    return rows


def stage_rows(results: Results) -> list[Row]:
    """What each stage of the estimation did."""
    cal = results.calibration
    names = parameters(cal.camera.distortion)
    rows = []
    for i, stage in enumerate(cal.stages, 1):
        ends = [
            with_sigma(float(v) / p.scale, float(s) / p.scale)
            for v, s, p in zip(stage.trajectory[-1], cal.sigmas, names, strict=True)
        ]
        rows.append(
            {
                "number": i,
                "name": stage.name,
                "iterations": len(stage.trajectory) - 1,
                "ends": ends,
                "status": stage.status.name.lower().replace("_", " "),
                "seconds": f"{significant(1000.0 * stage.seconds)} ms",
            }
        )
    return rows


def pair_table(cal: Calibration) -> TextTable:
    """The paper's estimator beside the efficient one: its sigma and the price in precision."""
    specs = parameters(cal.camera.distortion)
    pair_sigmas = np.sqrt(np.diag(cal.pair_covariance))
    rows = tuple(
        (
            p.name,
            plus_minus(cal.pair_theta[i] / p.scale, pair_sigmas[i] / p.scale),
            plus_minus(cal.theta[i] / p.scale, cal.sigmas[i] / p.scale),
            fixed((pair_sigmas[i] / cal.sigmas[i]) ** 2, 2),
        )
        for i, p in enumerate(specs)
    )
    heads = (
        "",
        "Interstar angles (stage 3)",
        "Marginal likelihood (stage 4)",
        "Ratio of variances",
    )
    return with_units(TextTable(heads, rows), specs)


def noise_table(cal: Calibration) -> TextTable | None:
    """The fitted noise model, term by term; None where there is none."""
    if (model := cal.fitted_noise) is None:
        return None
    rows = [
        (term.replace("^2", "²"), plus_minus(value, error))
        for term, value, error in zip(model.terms, model.coefficients, model.errors, strict=True)
    ]
    if model.frame_dof is not None:
        rows.append(
            ("frames", f"inverse chi-square, {significant(model.frame_dof)} degrees of freedom")
        )
    return TextTable(("Term", "Coefficient of the log variance"), tuple(rows))


# More images than this are counted, and only those left out are listed.
_LISTED = 40


def image_context(record: ImageRecord | None, cal: Calibration) -> AnyDict:
    """What the section shows; empty where the run did not start from images."""
    if record is None:
        return {"image_record": None}
    rows = record.rows if len(record.rows) <= _LISTED else record.left_out[:_LISTED]
    reasons = Counter(row.outcome for row in record.left_out)
    return {
        "image_record": record,
        "image_rows": rows,
        "image_reasons": [
            f"{plural(number, 'image')}: {reason}" for reason, number in reasons.most_common()
        ],
        "image_listing": "Every image."
        if len(record.rows) <= _LISTED
        else _listing(len(record.left_out)),
        "round_rows": _round_rows(record, cal),
    }


def _listing(left_out: int) -> str:
    if left_out > _LISTED:
        return f"The first {_LISTED} of {count(left_out)} images that were left out."
    return "The images that were left out."


def _round_rows(record: ImageRecord, cal: Calibration) -> list[Row]:
    """One row per quantity, after the first and the last round; none where both have the same
    stars.
    """
    first, last = record.rounds[0], record.rounds[-1]
    if last.n_stars and not (last.new or last.given_up):
        return []
    both = (first, last)

    def row(name: str, values: list[str], change: str = "", unit: str = "") -> Row:
        return {"name": name, "values": values, "change": change, "unit": unit}

    anew = f"{count(last.new)} identified anew, {count(last.given_up)} given up"
    rows = [
        row("images identified", [count(r.n_frames) for r in both]),
        row("stars calibrated", [count(r.n_stars) for r in both], anew),
    ]
    for parameter in parameters(cal.camera.distortion):
        if parameter.name not in first.parameters or parameter.name not in last.parameters:
            continue
        (old, old_sigma), (new, sigma) = (r.parameters[parameter.name] for r in both)
        scale = parameter.scale
        values = [plus_minus(a / scale, b / scale) for a, b in ((old, old_sigma), (new, sigma))]
        change = f"{fixed((new - old) / sigma, 1)} σ" if sigma > 0.0 else ""
        unit = pretty_unit(parameter.scaled_unit)
        rows.append(row(symbol(parameter.name), values, change, unit))
    unit = "times the stated noise" if last.sigma_name == "sigma_scale" else "px per axis"
    rows.append(row("noise", [significant(r.sigma, 3) for r in both], unit=unit))
    return rows
