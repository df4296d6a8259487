"""The tables of a report: rows of finished text, with digits that end where the uncertainty
begins.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import Parameter, parameters, scales_of, sigma_parameter
from starcal_uq.core.formatting import (
    count,
    decimals_for,
    plural,
    significant,
    with_sigma,
)
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.estimate import truth_z
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.presentation.figures.scales import symbol as written
from starcal_uq.presentation.html import symbol
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.sentences import table, told

if TYPE_CHECKING:
    from starcal_uq.estimation.result import Calibration
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.pipeline.record import ImageRecord
    from starcal_uq.presentation.report.results import Results

Row = AnyDict


def all_parameters(results: Results) -> tuple[Parameter, ...]:
    """Camera parameters and the noise."""
    cal = results.calibration
    return (*parameters(cal.camera.distortion), sigma_parameter(cal.sigma_name == "sigma_scale"))


def parameter_rows(results: Results) -> list[Row]:
    """One row per parameter, and one for the focal length in millimetres."""
    cal, post, truth = results.calibration, results.posterior, results.truth
    start, mean, sd = cal.with_noise
    low, high = np.vstack([cal.interval(), cal.sigma_interval()]).T
    unknown = np.full(len(mean), np.nan)
    prior, prior_sd, true, z = unknown, unknown, unknown.copy(), unknown.copy()
    if post is not None:
        mean, sd = post.draws.mean(axis=0), post.sd
        low, high = np.quantile(post.draws, (0.025, 0.975), axis=0)
        prior, prior_sd = (of(post.parameter_names) for of in (post.priors.mean, post.priors.sd))
    if truth is not None:
        true[:-1], z[:-1] = truth.theta, truth_z(cal, truth, post)
    specs = all_parameters(results)
    order, scale = np.arange(len(specs)), scales_of(specs)
    units = [spec.scaled_unit for spec in specs]
    if cal.camera.pixel_um is not None:
        after = cal.parameter_names.index("f") + 1
        order = np.insert(order, after, after - 1)
        scale = np.insert(scale, after, 1000.0 / cal.camera.pixel_um)
        units.insert(after, "mm")
    columns = {"mean": mean, "sd": sd, "low": low, "high": high, "start": start, "known": true}
    columns |= {"prior": prior, "prior_sd": prior_sd}
    scaled = {name: values[order] / scale for name, values in columns.items()}
    shown = [specs[place] for place in order]
    rows = table("parameters", spec=shown, unit=units, z=z[order], **scaled).records
    return [{**row, "symbol": symbol(row["name"])} for row in rows]


def diagnostics_table(post: Posterior) -> TextTable:
    """Convergence of every sampled parameter."""
    d, sampled = post.diagnostics, list(post.sampled)
    specs = [post.parameters[i] for i in sampled]
    scale = scales_of(specs)
    return table(
        "diagnostics",
        it=specs,
        rhat=d.rhat[sampled],
        bulk=d.ess_bulk[sampled],
        tail=d.ess_tail[sampled],
        mean=post.draws.mean(axis=0)[sampled] / scale,
        mcse=d.mcse[sampled] / scale,
        share=(d.mcse / post.sd)[sampled],
        autocorrelation=d.autocorrelation[sampled],
    )


def methods_table(cal: Calibration, post: Posterior) -> TextTable:
    """Estimate, Laplace approximation, importance sampling and emcee side by side."""
    d, sampled = post.diagnostics, list(post.sampled)
    specs = [post.parameters[i] for i in sampled]
    scale = scales_of(specs)
    both: AnyDict = {
        "calibration": cal.with_noise[1:],
        "laplace": (d.laplace_mean, d.laplace_sd),
        "psis": (d.psis_mean, d.psis_sd),
        "emcee": (post.draws.mean(axis=0), post.sd),
    }
    pairs = {name: np.array([v[sampled] / scale for v in pair]).T for name, pair in both.items()}
    # One digit more than elsewhere: the table is there to show small differences.
    decimals = [decimals_for(sd, 3) for sd in pairs["emcee"][:, 1]]
    return table("methods", it=specs, n=decimals, **pairs)


def stage_table(results: Results) -> TextTable:
    """What each stage of the estimation did."""
    cal = results.calibration
    specs = parameters(cal.camera.distortion)
    rows = []
    for number, stage in enumerate(cal.stages, 1):
        ends = [
            with_sigma(float(v) / p.scale, float(s) / p.scale)
            for v, s, p in zip(stage.trajectory[-1], cal.sigmas, specs, strict=True)
        ]
        status = stage.status.name.lower().replace("_", " ")
        milliseconds = f"{significant(1000.0 * stage.seconds)} ms"
        iterations = str(len(stage.trajectory) - 1)
        rows.append((str(number), stage.name, iterations, *ends, status, milliseconds))
    names = [written(p.name) for p in specs]
    heads = ("Stage", "What it estimates", "Iterations", *names, "Ended", "Time")
    return TextTable(heads, tuple(rows), align="rlr" + "r" * len(names) + "lr")


def pair_table(cal: Calibration) -> TextTable:
    """The paper's estimator beside the efficient one: its sigma and the price in precision."""
    specs = parameters(cal.camera.distortion)
    scale = scales_of(specs)
    return table(
        "pairs",
        it=specs,
        theta=cal.pair_theta / scale,
        sigma=root_diagonal(cal.pair_covariance) / scale,
        best=cal.theta / scale,
        least=cal.sigmas / scale,
    )


def noise_table(cal: Calibration) -> TextTable | None:
    """The fitted noise model, term by term; None where there is none."""
    if (model := cal.fitted_noise) is None:
        return None
    terms, values, errors = [*model.terms], [*model.coefficients], [*model.errors]
    if model.frame_dof is not None:
        terms, values, errors = [*terms, "frames"], [*values, model.frame_dof], [*errors, np.nan]
    return table("noise", term=terms, value=values, error=errors)


# More images than this are counted, and only those left out are listed.
_LISTED = 40


def image_context(record: ImageRecord | None, cal: Calibration) -> AnyDict:
    """What the section shows; empty where the run did not start from images."""
    if record is None:
        return {"image_record": None}
    left_out, few = record.left_out, len(record.rows) <= _LISTED
    reasons = Counter(row.outcome for row in left_out).most_common()
    return {
        "image_record": record,
        "image_rows": record.rows if few else left_out[:_LISTED],
        "image_reasons": [f"{plural(number, 'image')}: {reason}" for reason, number in reasons],
        "image_listing": told("listing", record, few=few, most=_LISTED),
        "round_table": _round_table(record, cal),
    }


def _round_table(record: ImageRecord, cal: Calibration) -> TextTable | None:
    """One row per quantity, after the first and the last round; None where both have the same
    stars.
    """
    both = _, last = record.rounds[0], record.rounds[-1]
    if last.n_stars and not (last.new or last.given_up):
        return None
    specs = [
        spec
        for spec in parameters(cal.camera.distortion)
        if all(spec.name in r.parameters for r in both)
    ]
    old, new = ([np.array(r.parameters[spec.name]) / spec.scale for spec in specs] for r in both)
    found = table("rounds", it=specs, old=old, new=new)
    anew = f"{count(last.new)} identified again, {count(last.given_up)} given up"
    unit = "times the stated noise" if last.sigma_name == "sigma_scale" else "px per axis"
    rows = (
        ("Images identified", *(count(r.n_frames) for r in both), "", ""),
        ("Stars calibrated", *(count(r.n_stars) for r in both), anew, ""),
        *found.rows,
        ("Noise", *(significant(r.sigma, 3) for r in both), "", unit),
    )
    return replace(found, rows=rows)


def derived_table(post: Posterior) -> TextTable:
    """Convergence of what follows from the parameters."""
    return table("derived", it=post.diagnostics.derived or derived_quantities(post))
