"""The command for tables that do not fit into memory: filter."""

from __future__ import annotations

from pathlib import Path

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import say, show_calibration
from starcal_uq.cli.options import (
    parse_columns,
)
from starcal_uq.core import settings


def filter_command(
    observations: Path,
    camera: Path,
    out: Path,
    method: settings.RecursiveMethod = "griffith",
    parameters: settings.Filtered = "all",
    pair_covariance: settings.PairCovariance = "full",
    forgetting: float = 1.0,
    process_noise: float | None = None,
    sigma: float | None = None,
    column: list[str] | None = None,
    force: bool = False,
) -> Answer:
    """Calibrate frame by frame, with an estimate after each; stars may exceed memory, an
    interrupted call goes on.
    """
    from starcal_uq.paper.recursive.folder import filter_run
    from starcal_uq.runs.folder import HISTORY

    options = sc.paper.RecursionOptions(
        pair_covariance=pair_covariance,
        parameters="optics" if method == "samaan" else parameters,
        forgetting=forgetting,
        process_noise=process_noise,
        sigma_px=sigma,
    )
    calibration = filter_run(
        observations,
        sc.Camera.load(camera),
        out,
        method=method,
        options=options,
        columns=parse_columns(column),
        force=force,
    )
    show_calibration(calibration, None)
    say(
        f"Run folder: {out}; estimates after every frame: {out / HISTORY}. Next: starcal-uq "
        f"sample {out}"
    )
    return Answer({"run": out, "history": out / HISTORY, "calibration": calibration})
