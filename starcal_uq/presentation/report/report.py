"""The report: one self-contained HTML file that a mission engineer can forward, made from whatever a run holds."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.presentation.report.page import render
from starcal_uq.runs.run import Missing, Results, load_results

if TYPE_CHECKING:
    from starcal_uq.camera.camera import Camera

__all__ = ["Missing", "Results", "load_results", "render", "report"]


def report(run_path: str | os.PathLike[str], truth: Camera | None = None) -> Path:
    """Write ``RUN/report.html`` and the figures in ``RUN/figures``.

    Parameters
    ----------
    run_path : path
        Folder of a run that holds a calibration at least. What is missing beyond that is named in the report together
        with the command that makes it.
    truth : Camera, optional
        The camera of a simulation, shown beside the estimate. Observations made by `starcal_uq.simulate` carry it, and
        it is then taken from them.

    Returns
    -------
    Path
        The report. It needs no network, no script and no other file.

    Raises
    ------
    RunFolderError
        If there is no calibration, a file cannot be read, or files of different runs are mixed.
    """
    from starcal_uq.presentation.report.figures import draw_figures
    from starcal_uq.runs.folder import RunFolder, atomic_write_bytes, atomic_write_text

    run = RunFolder(run_path)
    results = load_results(run, truth)
    figures = draw_figures(results)
    page = render(results, figures)
    run.figures.mkdir(exist_ok=True)
    for name, png in figures.items():
        atomic_write_bytes(run.figures / f"{name}.png", png)
    atomic_write_text(run.report, page)
    return run.report
