"""The report of a run, and the page of any result that has one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.core.types import PathLike
from starcal_uq.runs.run import Run

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.camera.camera import Camera
    from starcal_uq.comparison.result import CameraComparison
    from starcal_uq.core.settings import ReportFormat
    from starcal_uq.pipeline.inspection import Frames
    from starcal_uq.planning.planned import Plan
    from starcal_uq.studies.result import Study


def report(
    what: PathLike | Run | Plan | CameraComparison | Budget | Study | Frames,
    to: PathLike | None = None,
    *,
    truth: Camera | None = None,
    format: ReportFormat = "html",
) -> Path:
    """Write the report of a run, or the page of another result.

    Parameters
    ----------
    what : path, Run, Plan, CameraComparison, Budget, Study or Frames
        Folder of a run that holds a calibration at least, whose ``report.html`` and ``figures`` are
        written; what is missing beyond that is named in the report together with the command that
        makes it. Or a result.
    to : path, optional
        Folder for the page of a plan, a comparison or a study, file for that of frames
        (`Run.inspect`) or of a budget, whose ending names the format (``.html``, ``.xlsx``,
        ``.tex``, ``.csv``); a run has its own place.
    truth : Camera, optional
        The camera of a simulation, shown beside the estimate of a run. Observations made by
        `starcal_uq.simulate` carry it, and it is then taken from them.
    format : {"html", "pdf"}
        ``"pdf"`` prints the page of a run as well, by an installed browser or WeasyPrint.

    Returns
    -------
    Path
        The page, or its PDF. It needs no network, no script and no other file.

    Raises
    ------
    TypeError
        If the result has no page, or no PDF, or nothing says where it goes, or a run is to go
        elsewhere.
    MissingExtraError
        If nothing is installed that makes a PDF.
    RunFolderError
        If there is no calibration, a file cannot be read, or files of different runs are mixed.
    """
    if isinstance(what, Run | str | os.PathLike) and to is not None:
        raise TypeError("the report of a run is RUN/report.html: copy that file, or omit `to`.")
    if isinstance(what, Run):
        return what.pdf() if format == "pdf" else what.report()
    if isinstance(what, str | os.PathLike):
        run = Run(what, truth)
        # A truth that is given is not of the folder.
        return (run.pdf if format == "pdf" else run.report)(force=truth is not None)
    if format != "html":
        raise TypeError(
            f"only the report of a run is printed: open the page of a {type(what).__name__} in a "
            "browser."
        )
    if to is None:
        raise TypeError(f"say where the page of a {type(what).__name__} goes: report(what, to).")
    from starcal_uq.presentation.pages.write import write_page

    return write_page(what, to)
