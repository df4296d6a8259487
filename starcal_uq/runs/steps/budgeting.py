"""The attitude error budget of a run."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_uq.core.records import write_json
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import Seed, bounded, seed_of
from starcal_uq.core.types import PathLike
from starcal_uq.runs.steps.misfit import seen_by
from starcal_uq.runs.stored import StoredRun, writing

if TYPE_CHECKING:
    from starcal_uq.budgeting.file import BudgetFile
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.propagation.thermal import TemperatureProfile


@bounded
@writing
def budget(
    run: StoredRun,
    /,
    *,
    file: BudgetFile | PathLike | None = None,
    confidence: float | None = None,
    temperature_profile: TemperatureProfile | PathLike | None = None,
    seed: Seed = 0,
    force: bool = False,
) -> Budget:
    """Make the attitude error budget and write it.

    The attitude errors are those of ``attitude.csv``, with the misfit found if the run was
    diagnosed. A report stays, and is older than the budget until it is made again; the verdict
    has the new requirements at once.

    Parameters
    ----------
    file, confidence, temperature_profile, seed
        As for `starcal_uq.budget`.
    force : bool
        Whether a budget that was made with another file goes. It is kept as ``budget-1.csv``,
        or the next free number, otherwise.

    Raises
    ------
    RunFolderError
        If a part is missing, or the data are not those of the run.
    BudgetError
        If the file is wrong.
    """
    seed = seed_of(seed)
    from starcal_uq.budgeting.budget import budget
    from starcal_uq.budgeting.file import stated_in

    stated = stated_in(file)
    posterior, attitude = run.posterior, run.attitude
    if stated.sensor is not None and attitude.seen is None:
        attitude = replace(attitude, seen=seen_by(run))
    made = budget(
        posterior,
        run.observations,
        attitude,
        file=stated,
        confidence=confidence,
        temperature_profile=temperature_profile,
        spectrum=run.spectrum if run.has("spectrum") else None,
        seed=seed,
    )
    settings = {"file": file, "confidence": confidence}
    if temperature_profile is not None:
        settings["temperature_profile"] = made.provenance.settings["temperature_profile"]
    with run._step("budget", seed, settings) as files:
        made.save(files.budget)
        if not force and run.has("budget") and not _of_one_file(made, run.error_budget):
            shutil.copyfile(
                run.folder.budget, files.path / _free_name(run.folder.path, "budget-{}.csv")
            )
        if run.has("verdict"):
            write_json(replace(run.results, budget=made).verdict.to_dict(), files.verdict)
    run.error_budget = made
    if run.folder.is_older("report"):
        again = Remedy("report", (str(run.path),), purpose="to make it again")
        run._tell(f"report.html is older than the budget; {again}.")
    return made


def _free_name(folder: Path, name: str) -> str:
    """The first name of numbered ones that no file of the folder has."""
    numbered = (name.format(number) for number in itertools.count(1))
    return next(one for one in numbered if not (folder / one).exists())


def _of_one_file(one: Budget, other: Budget) -> bool:
    """Whether the second of two budgets holds no file of the user's that the first does not
    hold.
    """
    first, second = (made.provenance.settings.get("file", "") for made in (one, other))
    return not second or Path(first).resolve() == Path(second).resolve()
