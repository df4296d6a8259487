"""One verb for every page that is made from a result in memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from starcal_uq.budgeting.result import Budget
from starcal_uq.comparison.result import CameraComparison
from starcal_uq.core.types import PathLike
from starcal_uq.pipeline.inspection import Frames
from starcal_uq.planning.planned import Plan
from starcal_uq.presentation.pages.budgeting import write_budget
from starcal_uq.presentation.pages.comparison import write_comparison
from starcal_uq.presentation.pages.gallery import write_frames
from starcal_uq.presentation.pages.planning import write_plan
from starcal_uq.presentation.pages.studies import write_study
from starcal_uq.studies.result import Study

_WRITERS: dict[type, Callable[..., Path]] = {
    Plan: write_plan,
    CameraComparison: write_comparison,
    Budget: write_budget,
    Study: write_study,
    Frames: write_frames,
}


def write_page(
    what: Plan | CameraComparison | Budget | Study | Frames,
    to: PathLike,
    **options: Any,
) -> Path:
    """Write a result for people to read.

    Parameters
    ----------
    what : Plan, CameraComparison, Budget, Study or Frames
        The result.
    to : path
        A folder for a plan, a comparison or a study, made if it is missing; a file for frames, and
        for a budget, whose ending names the format (``.html``, ``.xlsx``, ``.tex``, ``.csv``). What
        is there is overwritten.
    **options
        For a plan, ``choice`` and ``check``: frames to take, and the forecast against simulation.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    TypeError
        For anything else.
    RunFolderError
        If it cannot be written.
    """
    for kind, write in _WRITERS.items():
        if isinstance(what, kind):
            return write(what, to, **options)
    raise TypeError(
        f"there is no page for a {type(what).__name__}: give a Plan, a CameraComparison, a "
        "Budget, a Study or Frames."
    )
