"""Read what a run folder holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import RunFolderError
from starcal_uq.estimation.calibration import Calibration
from starcal_uq.observations.table import load_observations
from starcal_uq.presentation.report.results import Missing, Results

if TYPE_CHECKING:
    from starcal_uq.budgeting.result import Budget
    from starcal_uq.pipeline.record import ImageRecord
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.field import FieldMap
    from starcal_uq.runs.folder import RunFolder


def load_results(run: RunFolder, truth: Camera | None = None) -> Results:
    """Load every result of a run.

    Raises
    ------
    RunFolderError
        If there is no calibration, or its data are not those of the run.
    """
    from starcal_uq.inference.posterior import Posterior
    from starcal_uq.propagation.coupling import coupling
    from starcal_uq.runs.steps import load_diagnosis

    calibration = Calibration.load(run.require("calibration"))
    observations = load_observations(run.require("observations"))
    if observations.data_hash != calibration.provenance.get("data_sha256"):
        raise RunFolderError(
            f"{run.path}: the calibration was made from other observations than {run.observations.name} holds; run "
            "`starcal-uq calibrate` again."
        )
    missing = []
    posterior = Posterior.load(run.posterior) if run.posterior.exists() else None
    if posterior is None:
        missing.append(Missing("The posterior", f"starcal-uq sample {run.path}"))
    attitude, field_map = _attitude(run)
    if attitude is None or field_map is None:
        missing.append(Missing("The attitude error and the map over the field", f"starcal-uq propagate {run.path}"))
    diagnosis = load_diagnosis(run, calibration)
    if diagnosis is None:
        what = "The tests for misfit, the jackknife and the comparison of distortion models"
        missing.append(Missing(what, f"starcal-uq diagnose {run.path}"))
    if posterior is not None and attitude is not None and not run.budget.exists():
        missing.append(Missing("The error budget", f"starcal-uq budget {run.path}"))
    if truth is None and "truth" in observations.meta:
        truth = Camera.from_dict(observations.meta["truth"])
    return Results(
        name=run.path.resolve().name,
        observations=observations,
        calibration=calibration,
        posterior=posterior,
        coupling=coupling(calibration if posterior is None else posterior),
        attitude=attitude,
        field_map=field_map,
        diagnosis=diagnosis,
        truth=truth if truth is not None and truth.parameter_names == calibration.parameter_names else None,
        images=load_image_record(run),
        budget=_budget(run),
        missing=tuple(missing),
    )


def _budget(run: RunFolder) -> Budget | None:
    from starcal_uq.budgeting.result import Budget

    return Budget.load(run.budget) if run.budget.exists() else None


def load_image_record(run: RunFolder) -> ImageRecord | None:
    """The record of the images that a run started from, if it did."""
    from starcal_uq.pipeline.record import IMAGES, ImageRecord

    path = run.path / IMAGES
    return ImageRecord.load(path) if path.exists() else None


def _attitude(run: RunFolder) -> tuple[AttitudeError | None, FieldMap | None]:
    from starcal_uq.propagation.attitude_error import AttitudeError
    from starcal_uq.propagation.field import FieldMap

    return (
        AttitudeError.load(run.attitude) if run.attitude.exists() else None,
        FieldMap.load(run.field_map) if run.field_map.exists() else None,
    )
