"""Compare two run folders: their posteriors where both have one, else their estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from starcal_uq.comparison.compare import compare, compare_halves
from starcal_uq.core.errors import ComparisonError, RunFolderError
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.observations.table import load_observations
from starcal_uq.runs.folder import RunFolder

if TYPE_CHECKING:
    from starcal_uq.comparison.result import CameraComparison
    from starcal_uq.core.files import PathLike
    from starcal_uq.inference.posterior import Posterior
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
        Folders with a calibration each. Posteriors are compared if both hold one, else the estimates.
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
    folders = RunFolder(run_a), RunFolder(run_b)
    if folders[0].path.resolve() == folders[1].path.resolve():
        raise ComparisonError(f"{run_a}: both runs are the same folder; name two, or split one with --split odd-even.")
    first, second = (Calibration.load(folder.require("calibration")) for folder in folders)
    if labels is None:
        names = [folder.path.resolve().name for folder in folders]
        labels = (names[0], names[1]) if names[0] != names[1] else (str(run_a), str(run_b))
    tables = [_table(folder) for folder in folders]
    observations = (tables[0], tables[1]) if tables[0] is not None and tables[1] is not None else None
    posteriors = _posteriors(folders)
    pair: tuple[Any, Any] = (first, second) if posteriors is None else posteriors
    return compare(*pair, labels=labels, same_data=same_data, observations=observations, **options)


def compare_split(run: PathLike, how: str = "odd-even", *, seed: int = 0, **options: Any) -> CameraComparison:
    """Calibrate two halves of a run's frames by themselves and compare them.

    Parameters
    ----------
    run : path
        Folder of a run. Its method and distortion model are used again.
    how : {"odd-even", "halves", "random"}
        As for `split_frames`.
    seed : int
        Of a random half.
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
    folder = RunFolder(run)
    cal = Calibration.load(folder.require("calibration"))
    obs = _table(folder)
    if obs is None:
        raise RunFolderError(f"{run}: holds no observations to split; calibrate a table that it can keep.")
    return compare_halves(obs, cal.nominal, how, seed=seed, method=cal.method, **options)


def _table(folder: RunFolder) -> Observations | None:
    """The observations of a run; None for those of a stream, which kept none."""
    if not folder.observations.exists():
        return None
    table = load_observations(folder.observations)
    return table if table.n_stars else None


def _posteriors(folders: tuple[RunFolder, RunFolder]) -> tuple[Posterior, Posterior] | None:
    from starcal_uq.inference.posterior import Posterior

    if not all(folder.posterior.exists() for folder in folders):
        return None
    first, second = (Posterior.load(folder.posterior) for folder in folders)
    return first, second
