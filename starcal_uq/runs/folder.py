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

# Attribute of RunFolder -> file name, and the command that makes it.
_FILES: dict[str, tuple[str, str]] = {
    "observations": ("observations.parquet", _CALIBRATE),
    "camera": ("camera.toml", _CALIBRATE),
    "calibration": ("calibration.json", _CALIBRATE),
    "arrays": ("calibration.npz", _CALIBRATE),
    "posterior": ("posterior.nc", "run `starcal-uq sample RUN` first"),
    "coupling": ("coupling.csv", "run `starcal-uq coupling RUN` first"),
    "attitude": ("attitude.csv", "run `starcal-uq propagate RUN` first"),
    "field_map": ("field_map.npz", "run `starcal-uq propagate RUN` first"),
    "spectrum": ("error_spectrum.npz", "run `starcal-uq propagate RUN --attitudes PROFILE` first"),
    "budget": ("budget.csv", "run `starcal-uq budget RUN` first"),
    "diagnosis": ("diagnosis.json", "run `starcal-uq diagnose RUN` first"),
    "rejected": ("rejected.csv", "run `starcal-uq calibrate OBS CAMERA -o RUN --screen` first"),
    "figures": ("figures", "run `starcal-uq report RUN` first"),
    "report": ("report.html", "run `starcal-uq report RUN` first"),
}

# Part of a diagnosis -> its table.
DIAGNOSIS_TABLES = {
    "misfit": "misfit.csv",
    "jackknife": "jackknife.csv",
    "comparison": "comparison.csv",
    "predictive": "predictive.csv",
}

# Files that rest on the draws, and all files that rest on the calibration, which is among them.
DERIVED = ("coupling", "attitude", "field_map", "spectrum", "budget", "report")
RESULTS = ("observations", "camera", "calibration", "arrays", "posterior", "rejected", "diagnosis", *DERIVED)


@dataclass(frozen=True)
class RunFolder:
    """A folder that holds one run; each property is the path of one of its files, which need not exist yet.

    Attributes
    ----------
    path : Path
        The folder; a string is accepted.
    """

    path: Path

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

    def _file(self, name: str) -> Path:
        return self.path / _FILES[name][0]

    @property
    def observations(self) -> Path:
        """The table that was calibrated on (Parquet)."""
        return self._file("observations")

    @property
    def camera(self) -> Path:
        """The nominal camera, as it was given (TOML)."""
        return self._file("camera")

    @property
    def calibration(self) -> Path:
        """Estimate, covariance, stages, status and provenance (JSON)."""
        return self._file("calibration")

    @property
    def arrays(self) -> Path:
        """The long arrays of the calibration: residuals, quaternions (NPZ)."""
        return self._file("arrays")

    @property
    def posterior(self) -> Path:
        """Draws and diagnostics (netCDF)."""
        return self._file("posterior")

    @property
    def coupling(self) -> Path:
        """Table of couplings (CSV)."""
        return self._file("coupling")

    @property
    def attitude(self) -> Path:
        """Table of attitude errors (CSV)."""
        return self._file("attitude")

    @property
    def field_map(self) -> Path:
        """Direction uncertainty over the field (NPZ)."""
        return self._file("field_map")

    @property
    def spectrum(self) -> Path:
        """Spectrum of the frame-dependent error along an attitude profile (NPZ)."""
        return self._file("spectrum")

    @property
    def budget(self) -> Path:
        """Error budget (CSV)."""
        return self._file("budget")

    @property
    def diagnosis(self) -> Path:
        """Tests for misfit, jackknife, comparison of models (JSON)."""
        return self._file("diagnosis")

    @property
    def rejected(self) -> Path:
        """Rows that screening left out, with their reasons (CSV)."""
        return self._file("rejected")

    @property
    def figures(self) -> Path:
        """Folder of the figures."""
        return self._file("figures")

    @property
    def report(self) -> Path:
        """The report (HTML, self-contained)."""
        return self._file("report")

    def require(self, name: str) -> Path:
        """Path of a file that must exist, such as ``"calibration"``.

        Raises
        ------
        RunFolderError
            If the folder or the file is missing; the message names the command that makes it.
        ValueError
            If a run folder has no file of that name.
        """
        if name not in _FILES:
            raise ValueError(f"a run folder has no {name!r}: use one of {', '.join(_FILES)}")
        if os.path.exists(self.path) and not os.path.isdir(self.path):
            raise RunFolderError(f"{self.path}: is not a run folder but a file; name the folder given to -o.")
        file_name, remedy = _FILES[name]
        if not os.path.isdir(self.path):
            raise RunFolderError(f"{self.path}: the run folder does not exist; check the path, or {remedy}.")
        path = self.path / file_name
        if not os.path.exists(path):
            raise RunFolderError(f"{self.path}: the run folder has no {file_name}; {remedy}.")
        return path
