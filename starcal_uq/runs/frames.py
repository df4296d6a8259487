"""The images that a run started from, read from the files of its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from starcal_uq.camera.camera import Camera
from starcal_uq.core.files import reading
from starcal_uq.core.remedy import RUN, SOME_IMAGES, Remedy
from starcal_uq.estimation.result import Calibration
from starcal_uq.identification.sheet import sheet_of
from starcal_uq.images.centroids import Centroids
from starcal_uq.observations.table import Observations, load_observations
from starcal_uq.pipeline.images import CENTROIDS, IDENTIFICATION, MATCHED
from starcal_uq.pipeline.inspection import Frames
from starcal_uq.pipeline.record import ImageRecord
from starcal_uq.runs.folder import RunFolder


def calibrated_frames(
    run: Path, folder: RunFolder, record: ImageRecord, obs: Observations, cal: Calibration
) -> Frames:
    """The images of a calibration, with what became of their stars.

    `run` is the folder that commands name, `folder` holds the files.

    Raises
    ------
    RunFolderError
        If a file is missing or damaged.
    """
    path = folder.path / IDENTIFICATION
    again = Remedy("run", (SOME_IMAGES,), {"out": RUN}, "again")
    with reading(path, "a table of identified frames", again):
        table = pd.read_csv(path)
        seconds = dict(
            zip(table["frame"].tolist(), (1e-3 * table["milliseconds"]).tolist(), strict=True)
        )
    reasons = {}
    if folder.rejected.exists():
        path = folder.rejected
        with reading(path, "a table of rejected stars", Remedy("calibrate", purpose="again")):
            table = pd.read_csv(path)
            stars = zip(table["frame"], table["star_id"], strict=True)
            reasons = dict(zip(stars, table["reason"], strict=True))
    return Frames(
        str(run),
        record,
        Centroids.load(folder.path / CENTROIDS),
        # Runs of versions before this one have calibrated stars only.
        _matched(folder, obs),
        obs,
        cal.residuals_px,
        cal.camera,
        dict(zip(cal.frame_ids.tolist(), cal.quaternions, strict=True)),
        reasons,
        seconds,
        tuple(map(Path, record.sources)),
    )


def uncalibrated_frames(folder: RunFolder, record: ImageRecord) -> Frames:
    """The images where nothing could be calibrated: detections, and stars where some were
    identified.
    """
    centroids = Centroids.load(folder.path / CENTROIDS)
    none = np.empty(0)
    nothing = Observations(frame=none.astype(int), x_px=none, y_px=none, ra_deg=none, dec_deg=none)
    matched = _matched(folder, nothing)
    known = folder.camera.exists()
    return Frames(
        str(folder.path),
        record,
        centroids,
        matched,
        nothing,
        np.empty((0, 2)),
        Camera.load(folder.require("camera")) if known else sheet_of(centroids)[0],
        {},
        images=tuple(map(Path, record.sources)),
        known=known,
    )


def _matched(folder: RunFolder, otherwise: Observations) -> Observations:
    """The stars that the last identification found, where they were kept."""
    path = folder.path / MATCHED
    return load_observations(path) if path.exists() else otherwise
