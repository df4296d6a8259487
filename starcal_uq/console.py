"""Results as tables in the terminal and as JSON."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from starcal_uq._types import AnyDict
from starcal_uq.camera import Camera
from starcal_uq.distortion import parameters
from starcal_uq.formatting import decimals_for, fixed, pretty_unit, significant

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.calibration import Calibration
    from starcal_uq.couplings import Coupling
    from starcal_uq.observations import Observations
    from starcal_uq.posterior import Posterior
    from starcal_uq.propagation import AttitudeError

out = Console()
err = Console(stderr=True)

UNDECLARED = (
    "Neither time nor observer velocity was declared: annual aberration stretches a 10 degree field by up to "
    "3.6 arcsec, which can move f by many sigma. Declare --directions apparent, or --directions catalogue with a "
    "time_utc column."
)


def print_json(value: Any) -> None:
    """Plain JSON on standard output, nothing else."""
    print(json.dumps(_plain(value), indent=1, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, (float, np.floating)):
        # JSON has no NaN or infinity; null says "not known" to every reader.
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, np.bool_):
        return bool(value)
    return value


def records(frame: pd.DataFrame) -> list[AnyDict]:
    """A data frame as a list of rows."""
    rows: list[AnyDict] = frame.to_dict(orient="records")
    return rows


def show_calibration(calibration: Calibration, truth: Camera | None = None) -> None:
    """Table of start, estimate and sigma; with a truth, also truth and z."""
    table = Table(
        title=f"Calibration: {calibration.n_stars} stars in {calibration.n_frames} frames", title_justify="left"
    )
    table.add_column("parameter", style="bold")
    for heading in ("start", "estimate", "sigma"):
        table.add_column(heading, justify="right")
    if truth is not None:
        table.add_column("truth", justify="right")
        table.add_column("z", justify="right")
    table.add_column("unit")
    specs = parameters(calibration.camera.distortion)
    for index, (spec, value, sigma) in enumerate(zip(specs, calibration.theta, calibration.sigmas, strict=True)):
        decimals = decimals_for(sigma / spec.scale)
        cells = [fixed(number / spec.scale, decimals) for number in (calibration.nominal.theta[index], value, sigma)]
        if truth is not None:
            known = truth.theta[index]
            cells += [fixed(known / spec.scale, decimals), fixed((value - known) / sigma, 2)]
        table.add_row(spec.name, *cells, pretty_unit(spec.scaled_unit))
    blank = ["", ""] if truth is not None else []
    decimals = decimals_for(calibration.sigma_std)
    table.add_row(
        calibration.sigma_name,
        "",
        fixed(calibration.sigma, decimals),
        fixed(calibration.sigma_std, decimals),
        *blank,
        "px per axis" if calibration.sigma_name == "sigma" else "times the stated noise",
    )
    out.print(table)
    focal_sigma = calibration.sigmas[2] * calibration.camera.pixel_um * 1e-3
    decimals = decimals_for(focal_sigma)
    out.print(
        f"Focal length {fixed(calibration.camera.focal_mm, decimals)} +- {fixed(focal_sigma, decimals)} mm. "
        f"Status: {calibration.status.name.lower()}."
    )


def show_posterior(posterior: Posterior) -> None:
    """Table of posterior means, intervals and diagnostics."""
    table = Table(title=f"Posterior: {len(posterior.draws)} draws", title_justify="left")
    table.add_column("parameter", style="bold")
    for heading in ("mean", "sd", "2.5 %", "97.5 %", "R-hat", "ESS bulk", "ESS tail"):
        table.add_column(heading, justify="right")
    table.add_column("unit")
    specs = {spec.name: spec for spec in parameters(posterior.camera.distortion)}
    diagnostics = posterior.diagnostics
    low, high = np.quantile(posterior.draws, [0.025, 0.975], axis=0)
    for index, name in enumerate(posterior.parameter_names):
        spec = specs.get(name)
        scale = 1.0 if spec is None else spec.scale
        column = posterior.draws[:, index] / scale
        decimals = decimals_for(float(np.std(column)))
        numbers = (float(np.mean(column)), float(np.std(column)), low[index] / scale, high[index] / scale)
        unit = pretty_unit(spec.scaled_unit) if spec is not None else ("px" if name == "sigma" else "")
        table.add_row(
            name,
            *(fixed(number, decimals) for number in numbers),
            fixed(float(diagnostics.rhat[index]), 4),
            f"{diagnostics.ess_bulk[index]:.0f}",
            f"{diagnostics.ess_tail[index]:.0f}",
            unit,
        )
    out.print(table)
    for message in diagnostics.messages:
        out.print(message, style=None if diagnostics.ok else "yellow", highlight=False)


def show_coupling(found: Coupling) -> None:
    """Sigmas, inflation and correlations."""
    table = Table(title="Coupling", title_justify="left")
    table.add_column("parameter", style="bold")
    for heading in ("sigma", "others known", "variance inflation"):
        table.add_column(heading, justify="right")
    for name in found.extended_names:
        table.add_column(f"r({name})", justify="right")
    for index, name in enumerate(found.parameter_names):
        table.add_row(
            name,
            significant(float(found.sigma_marginal[index]), 3),
            significant(float(found.sigma_conditional[index]), 3),
            significant(float(found.variance_inflation[index]), 3),
            *(fixed(float(value), 2) for value in found.extended_correlation[index]),
        )
    out.print(table)
    for direction in found.weak_directions:
        out.print(f"  {direction.words}", highlight=False)


def show_attitude(error: AttitudeError) -> None:
    """Attitude error by contributor and axis."""
    table = Table(title="Attitude error, arcsec", title_justify="left")
    frame = error.to_dataframe()
    for column in frame.columns:
        table.add_column(str(column), justify="left" if frame[column].dtype == object else "right")
    for row in records(frame):
        table.add_row(*(significant(value, 3) if isinstance(value, float) else _word(value) for value in row.values()))
    out.print(table)


def _word(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return str(value)


def warn_undeclared(obs: Observations) -> None:
    """Say what follows when nothing is known of the observer's motion."""
    if not obs.directions_declared:
        err.print(f"warning: {UNDECLARED}", style="yellow", highlight=False)
    ignored = obs.meta.get("ignored_columns")
    if ignored:
        err.print(f"note: columns not used: {', '.join(ignored)}", highlight=False)
