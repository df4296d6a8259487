"""The command for tables that do not fit into memory: filter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.cli.console import say, show_calibration
from starcal_uq.cli.options import parse_columns
from starcal_uq.cli.settings import RecursionSettings
from starcal_uq.core import settings


def filter_command(
    observations: Path,
    camera: Path,
    out: Path,
    recursion: RecursionSettings,
    method: settings.RecursiveMethod = "griffith",
    column: list[str] | None = None,
    force: bool = False,
) -> Answer:
    """Calibrate frame by frame, with an estimate after each; stars may exceed memory, an
    interrupted call resumes.
    """
    from starcal_uq.paper.recursive.folder import filter_run
    from starcal_uq.runs.folder import HISTORY

    options = sc.paper.RecursionOptions(**vars(recursion))
    if method == "samaan":
        options = replace(options, parameters="optics")
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
