"""Questions to the model of a run, and the attitude error with what they find."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcal_uq.core.files import read_parquet, reading, write_csv
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.tables import arrow_columns
from starcal_uq.observations.table import Observations
from starcal_uq.runs.folder import DIAGNOSIS_TABLES
from starcal_uq.runs.stored import StoredRun, save_results, writing

if TYPE_CHECKING:
    from starcal_uq.diagnostics.diagnose import Diagnosis
    from starcal_uq.propagation.attitude_error import AttitudeError


@writing
def diagnose(run: StoredRun, /, *, force: bool = False, **options: Any) -> Diagnosis:
    """Test the model; writes ``diagnosis.json``, with the tables as CSV beside it.

    The attitude error is written again with what was found, and a budget that rested on it is
    removed.

    Parameters
    ----------
    force : bool
        Whether to replace the earlier diagnosis.
    **options
        Those of `starcal_uq.diagnose`.
    """
    from starcal_uq.diagnostics.diagnose import diagnose

    run._keep("diagnosis", force)

    posterior = run.posterior if run.has("posterior") else None
    diagnosis = diagnose(run.observations, run.calibration, posterior, **options)
    found = None
    if posterior is not None and run.has("attitude"):
        run.diagnosis = diagnosis if diagnosis.is_of(run.calibration) else None
        found = with_misfit(run, run.attitude)
    others = ("progress", "apart", "left_out", "seed")
    settings = {name: value for name, value in options.items() if name not in others}
    with run._step("diagnose", diagnosis.provenance.seed, settings) as files:
        for name, file_name in DIAGNOSIS_TABLES.items():
            part = getattr(diagnosis, name)
            if part is not None:
                write_csv(part.to_dataframe(), files.path / file_name)
        save_results(files, diagnosis=diagnosis, attitude=found)
    run._forget("diagnosis")
    if found is not None:
        # As the file holds it, without its frames.
        run.attitude = replace(found, seen=None, aligned=None)
    return diagnosis


def with_misfit(run: StoredRun, error: AttitudeError) -> AttitudeError:
    """The attitude error with what the diagnosis of this run found, if there is one."""
    diagnosis = run.diagnosis
    if diagnosis is None:
        return error
    from starcal_uq.diagnostics import found

    if error.seen is None:
        aligned = _frames_of(run.folder.alignment) if run.has("alignment") else None
        error = replace(error, seen=seen_by(run), aligned=aligned)
    return found.with_misfit(error, diagnosis, run.posterior, run.observations)


def seen_by(run: StoredRun) -> Observations:
    """Frames that the attitude errors of a run are of."""
    return _frames_of(run.folder.mission) if run.has("mission") else run.observations


def _frames_of(path: Path) -> Observations:
    """Frames that a run keeps for itself; random places of a drawn sky may coincide, which no
    measured table may.
    """
    again = Remedy("propagate", (RUN,), {"force": True}, "to write it again")
    with reading(path, "a table of frames", again):
        return Observations(**arrow_columns(read_parquet(path)))
