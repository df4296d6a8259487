"""Compare two run folders: their posteriors where both have one, else their estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from starcal_uq.comparison.compare import compare, compare_halves
from starcal_uq.core.errors import ComparisonError, RunFolderError
from starcal_uq.core.settings import Seed, bounded
from starcal_uq.core.types import PathLike
from starcal_uq.estimation.duplicates import fingerprints_of
from starcal_uq.runs.run import Run

if TYPE_CHECKING:
    from starcal_uq.comparison.result import CameraComparison
    from starcal_uq.observations.table import Observations


def compare_runs(
    run_a: PathLike,
    run_b: PathLike,
    *,
    labels: tuple[str, str] | None = None,
    same_data: bool | None = None,
    **options: Any,
) -> CameraComparison:
    """Compare two runs, B minus A.

    Parameters
    ----------
    run_a, run_b : path
        Folders with a calibration each. Posteriors are compared if both hold one, else the
        estimates.
    labels : (str, str), optional
        Names in words and figures; by default those of the folders.
    same_data : bool, optional
        Overrules what the data of the runs say about the frames that they share.
    **options
        Further options of `compare`.

    Raises
    ------
    RunFolderError
        If a folder holds no calibration, or both are the same folder.
    ComparisonError
        If the two cannot be compared.
    """
    first, second = Run(run_a), Run(run_b)
    if first.path.resolve() == second.path.resolve():
        raise ComparisonError(
            f"{run_a}: both runs are the same folder; name two, or split one with --split odd-even."
        )
    calibrations = first.calibration, second.calibration
    if labels is None:
        labels = (
            (first.name, second.name) if first.name != second.name else (str(run_a), str(run_b))
        )
    table_a, table_b = _table(first), _table(second)
    observations = None if table_a is None or table_b is None else (table_a, table_b)
    fingerprints = (
        fingerprints_of(calibrations[0], table_a),
        fingerprints_of(calibrations[1], table_b),
    )
    sampled = first.has("posterior") and second.has("posterior")
    pair: tuple[Any, Any] = (first.posterior, second.posterior) if sampled else calibrations
    return compare(
        *pair,
        labels=labels,
        same_data=same_data,
        observations=observations,
        fingerprints=fingerprints,
        **options,
    )


@bounded
def compare_split(
    run: PathLike, how: str = "odd-even", *, seed: Seed = 0, **options: Any
) -> CameraComparison:
    """Calibrate two halves of a run's frames by themselves and compare them.

    Parameters
    ----------
    run : path
        Folder of a run. Its method and distortion model are used again.
    how : {"odd-even", "halves", "random"}
        As for `split_frames`.
    seed : int or Generator
        Seed of a random half.
    **options
        Further options of `compare`.

    Raises
    ------
    RunFolderError
        If the folder holds no calibration or no observations.
    ComparisonError
        For an unknown split or a single frame.
    CalibrationError
        When a half does not determine the camera.
    """
    whole = Run(run)
    cal = whole.calibration
    obs = _table(whole)
    if obs is None:
        raise RunFolderError(
            f"{run}: holds no observations to split; calibrate a table that it can keep."
        )
    return compare_halves(obs, cal.nominal, how, seed=seed, method=cal.method, **options)


def _table(run: Run) -> Observations | None:
    """The observations of a run; None for those of a stream, which kept none, and of partitions,
    but for a sample.
    """
    if run.calibration.partitions is not None:
        return None
    return run.observations if run.has("observations") and run.observations.n_stars else None
