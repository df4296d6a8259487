"""The estimate of a run, and the files that it stands in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from starcal_uq.camera.camera import Camera
from starcal_uq.core.conflicts import refuse_conflicts
from starcal_uq.core.errors import CalibrationError
from starcal_uq.core.files import atomic_write_text, check_new_folder, write_csv
from starcal_uq.core.runfile import written
from starcal_uq.core.types import Progress
from starcal_uq.estimation.result import Calibration
from starcal_uq.estimation.weights import weighed
from starcal_uq.observations.partitions import PartitionedObservations
from starcal_uq.observations.table import Observations
from starcal_uq.runs.folder import HISTORY
from starcal_uq.runs.stored import LOADED, StoredRun, save_results, writing

if TYPE_CHECKING:
    import pandas as pd

    from starcal_uq.calibration.screening.result import Screening


@writing
def calibrate(
    run: StoredRun,
    /,
    obs: Observations | PartitionedObservations,
    camera: Camera,
    *,
    screening: bool = False,
    undetermined: bool = False,
    force: bool = False,
    words: Sequence[str] = (),
    progress: Progress | None = None,
    **options: Any,
) -> Calibration:
    """Calibrate and write observations, camera and calibration; nothing is written when the
    estimate fails.

    Parameters
    ----------
    obs : Observations or PartitionedObservations
        Identified stars. Of partitioned ones the run keeps the sample of frames that its
        results are shown by.
    camera : Camera
        The nominal camera.
    screening : bool
        Whether to leave out wrong identifications first. The run then holds the kept rows,
        ``rejected.csv`` the others with their reasons, and `screening` of this object all about
        it.
    undetermined : bool
        Whether to write an estimate that leaves parameters open, to be sampled with priors that
        determine them.
    force : bool
        Whether to replace what the folder holds.
    words : sequence of str
        The command as it was typed, without the program's name: remedies repeat it.
    progress, **options
        Further options of `starcal_uq.calibrate`.

    Raises
    ------
    RunFolderError
        If the folder is not empty.
    CalibrationError
        If the data do not determine the camera.
    """
    screened: Screening | None = None
    if undetermined:
        options["throw"] = False
    refuse_conflicts(
        screening=screening,
        method=options.get("method"),
        partitioned=isinstance(obs, PartitionedObservations),
    )
    if screening:
        from starcal_uq.calibration.screening.screening import screen

        assert isinstance(obs, Observations)
        screened = screen(obs, camera, **options)
        obs, calibration = screened.observations, screened.calibration
    else:
        from starcal_uq.calibration.calibrate import calibrate
        from starcal_uq.diagnostics.explain import explain

        try:
            calibration = calibrate(obs, camera, progress=progress, **options)
        except CalibrationError as error:
            known = explain(error, obs) if isinstance(obs, Observations) else error
            if known is error:
                raise
            raise known from error
        if isinstance(obs, PartitionedObservations):
            # The stars stay where they are; the run holds the sample of frames that its results
            # are shown by.
            obs = obs.sample()
        elif calibration.n_frames < obs.n_frames:
            obs = obs.select_frames(calibration.frame_ids)
    if undetermined and not calibration.status.ok and not calibration.undetermined:
        status = calibration.status
        raise CalibrationError(
            f"the calibration did not end well ({status.name})", status, reason=calibration.remedy
        )
    if not run._making:
        check_new_folder(run.path, force)
        run._words = tuple(words)
    write(run, calibration, obs, screened)
    return calibration


@writing
def write(
    run: StoredRun,
    /,
    calibration: Calibration,
    obs: Observations | None,
    screened: Screening | None = None,
    history: pd.DataFrame | None = None,
) -> None:
    """Write a calibration with its nominal camera, and with observations and more where there
    are any.

    Whatever the run has written before goes.
    """
    table = None
    if obs is not None:
        obs = weighed(obs, calibration)
        table = obs.unweighted
    with run._step("calibrate", None, calibration.provenance.settings) as files:
        save_results(
            files,
            observations=table,
            camera=calibration.nominal,
            calibrated=calibration.camera,
            calibration=calibration,
        )
        if run._making and run._words[:1] == ("run",):
            atomic_write_text(files.run_file, written(run._words))
        if screened is not None:
            screened.save_rejected(files.rejected)
        if history is not None:
            write_csv(history, files.path / HISTORY)
    run._forget(*LOADED)
    if obs is not None:
        run.observations = obs
    run.camera, run.calibration, run.screening = calibration.nominal, calibration, screened
