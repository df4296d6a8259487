"""Replicates of a validation over processes."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from starcal_uq.core.tasks import Progress, run_tasks
from starcal_uq.diagnostics.validation.replicates import Outcome, Study, run_replicate

if TYPE_CHECKING:
    from starcal_uq.sky.catalogue import StarCatalogue

__all__ = ["Progress", "run_replicates"]

_CHUNK = 8


def run_replicates(
    study: Study, stars: StarCatalogue, n_replicates: int, workers: int | None, progress: Progress | None
) -> tuple[list[Outcome], bool]:
    """Run replicates 0 .. n_replicates - 1; parameters and exceptions as in `run_tasks`.

    Returns
    -------
    list of Outcome
        In order; all that were complete when Ctrl-C was pressed.
    bool
        True if it was.
    """
    return run_tasks(
        partial(run_replicate, study, stars),
        n_replicates,
        caller="validate",
        chunk=_CHUNK,
        workers=workers,
        progress=progress,
    )
