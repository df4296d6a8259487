"""The run folder: its file names, atomic writes, and the provenance stored with every result.

A file is written under a temporary name in its own folder and then renamed, so that a killed run leaves
either the old file or the new one, never half of one.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import PathLike, new_folder

_CALIBRATE = "run `starcal-uq calibrate OBS CAMERA -o RUN` first"


class _File:
    """A file of a run folder: its name, and the command that makes it."""

    def __init__(self, name: str, remedy: str) -> None:
        self.name, self.remedy = name, remedy

    def __get__(self, folder: RunFolder | None, _: type) -> Path:
        return Path(self.name) if folder is None else folder.path / self.name


# Part of a diagnosis -> its table.
DIAGNOSIS_TABLES = {
    "misfit": "misfit.csv",
    "jackknife": "jackknife.csv",
    "stars": "stars.csv",
    "comparison": "comparison.csv",
    "predictive": "predictive.csv",
}

# Files that rest on the draws, and all files that rest on the calibration, which is among them.
DERIVED = ("coupling", "attitude", "mission", "alignment", "field_map", "spectrum", "budget", "report")
RESULTS = ("observations", "camera", "calibration", "arrays", "posterior", "rejected", "diagnosis", *DERIVED)


@dataclass(frozen=True)
class RunFolder:
    """A folder that holds one run; its files are paths, which need not exist yet.

    Attributes
    ----------
    path : Path
        The folder; a string is accepted.
    observations : Path
        The table that was calibrated on (Parquet).
    camera : Path
        The nominal camera, as it was given (TOML).
    calibration : Path
        Estimate, covariance, stages, status and provenance (JSON).
    arrays : Path
        The long arrays of the calibration: residuals, quaternions (NPZ).
    posterior : Path
        Draws and diagnostics (netCDF).
    coupling : Path
        Table of couplings (CSV).
    attitude : Path
        Table of attitude errors (CSV).
    mission : Path
        Frames that the attitude errors are of, where they are not the observed ones (Parquet).
    alignment : Path
        Frames on which alignment is calibrated, where they are not the observed ones (Parquet).
    field_map : Path
        Direction uncertainty over the field (NPZ).
    spectrum : Path
        Spectrum of the frame-dependent error along an attitude profile (NPZ).
    budget : Path
        Error budget (CSV).
    diagnosis : Path
        Tests for misfit, jackknife, comparison of models (JSON).
    rejected : Path
        Rows that screening left out, with their reasons (CSV).
    figures : Path
        Folder of the figures.
    report : Path
        The report (HTML, self-contained).
    """

    path: Path

    observations = _File("observations.parquet", _CALIBRATE)
    camera = _File("camera.toml", _CALIBRATE)
    calibration = _File("calibration.json", _CALIBRATE)
    arrays = _File("calibration.npz", _CALIBRATE)
    posterior = _File("posterior.nc", "run `starcal-uq sample RUN` first")
    coupling = _File("coupling.csv", "run `starcal-uq coupling RUN` first")
    attitude = _File("attitude.csv", "run `starcal-uq propagate RUN` first")
    mission = _File("mission_frames.parquet", "run `starcal-uq propagate RUN --attitudes random` first")
    alignment = _File("alignment_frames.parquet", "run `starcal-uq propagate RUN` first")
    field_map = _File("field_map.npz", "run `starcal-uq propagate RUN` first")
    spectrum = _File("error_spectrum.npz", "run `starcal-uq propagate RUN --attitudes PROFILE` first")
    budget = _File("budget.csv", "run `starcal-uq budget RUN` first")
    diagnosis = _File("diagnosis.json", "run `starcal-uq diagnose RUN` first")
    rejected = _File("rejected.csv", "run `starcal-uq calibrate OBS CAMERA -o RUN --screen` first")
    figures = _File("figures", "run `starcal-uq report RUN` first")
    report = _File("report.html", "run `starcal-uq report RUN` first")

    def __init__(self, path: PathLike) -> None:
        object.__setattr__(self, "path", Path(path))

    def create(self) -> RunFolder:
        """Make the folder, with its parents, if it does not exist.

        Raises
        ------
        RunFolderError
            If a file is in the way or the operating system refuses.
        """
        new_folder(self.path)
        return self

    def require(self, name: str) -> Path:
        """Path of a file that must exist, such as ``"calibration"``.

        Raises
        ------
        RunFolderError
            If the folder or the file is missing; the message names the command that makes it.
        ValueError
            If a run folder has no file of that name.
        """
        files = {key: value for key, value in vars(RunFolder).items() if isinstance(value, _File)}
        if name not in files:
            raise ValueError(f"a run folder has no {name!r}: use one of {', '.join(files)}")
        if os.path.exists(self.path) and not os.path.isdir(self.path):
            raise RunFolderError(f"{self.path}: is not a run folder but a file; name the folder given to -o.")
        file_name, remedy = files[name].name, files[name].remedy
        if not os.path.isdir(self.path):
            raise RunFolderError(f"{self.path}: the run folder does not exist; check the path, or {remedy}.")
        path = self.path / file_name
        if not os.path.exists(path):
            raise RunFolderError(f"{self.path}: the run folder has no {file_name}; {remedy}.")
        return path
