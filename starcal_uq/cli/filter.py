"""The command for tables that do not fit into memory: filter."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import say, show_calibration
from starcal_uq.cli.options import (
    LEAST_SIGMA_PX,
    CameraFile,
    Columns,
    Force,
    NewRun,
    number,
    parse_columns,
    read_path,
)
from starcal_uq.core import settings
from starcal_uq.core.settings import Limit

_FORGETTING = Limit(1e-9, 1.0, whole=False)
_WALK_PX = Limit(0.0, 1e6, whole=False)


def filter_command(
    observations: Annotated[
        Path,
        typer.Argument(
            metavar="OBS",
            help="Stars in pixels, the frames in order: CSV, Parquet, or a folder of them.",
            parser=read_path,
        ),
    ],
    camera: CameraFile,
    out: NewRun,
    method: Annotated[
        settings.RecursiveMethod,
        typer.Option(
            help=(
                "griffith (recursive least squares) or samaan (Kalman filter, distortion "
                "afterwards)."
            )
        ),
    ] = "griffith",
    parameters: Annotated[
        settings.Filtered,
        typer.Option(
            help=(
                "optics (x0, y0, f; the distortion is ignored, as in the source) or all "
                "(griffith only)."
            )
        ),
    ] = "all",
    pair_covariance: Annotated[
        settings.PairCovariance,
        typer.Option(
            help=(
                "full, or diagonal: pairs that share a star taken as independent, as filters "
                "used to."
            )
        ),
    ] = "full",
    forgetting: Annotated[
        float,
        number(
            _FORGETTING,
            "Weight of all earlier frames against the next, above 0 and up to 1 (griffith).",
        ),
    ] = 1.0,
    process_noise: Annotated[
        float | None,
        number(_WALK_PX, "Random walk of the optics, px per frame; needs --sigma (samaan)."),
    ] = None,
    sigma: Annotated[
        float | None,
        number("sigma_px", "Stated centroid noise, px per axis.", least=LEAST_SIGMA_PX),
    ] = None,
    column: Columns = None,
    force: Force = False,
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
