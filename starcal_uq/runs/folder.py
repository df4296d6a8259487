"""The run folder: its file names, atomic writes, and the provenance stored with every result.

A file is written under a temporary name in its own folder and then renamed, so that a killed run leaves
either the old file or the new one, never half of one.
"""

from __future__ import annotations

import os
import platform
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from starcal_uq.core.errors import RunFolderError

PathLike = str | os.PathLike[str]

_VERSIONED = ("starcal-uq", "numpy", "scipy", "casadi", "emcee", "arviz")

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
    "figures": ("figures", "run `starcal-uq report RUN` first"),
    "report": ("report.html", "run `starcal-uq report RUN` first"),
}


def ensure_new(path: PathLike, force: bool = False) -> None:
    """Refuse to write over an existing file unless ``force`` is set.

    Raises
    ------
    RunFolderError
        If `path` exists and `force` is false, or if it exists and is no regular file.
    """
    path = Path(path)
    # os.path, because Path.exists raises in a folder that may not be searched; the write itself reports that.
    if not os.path.exists(path):
        return
    if path.is_dir():
        raise RunFolderError(f"{path}: is a directory; name a file to write to.")
    if not path.is_file():
        raise RunFolderError(f"{path}: is not a regular file; name a file to write to.")
    if not force:
        raise RunFolderError(
            f"{path}: the file exists already; choose another name or use --force (force=True in Python)."
        )


@contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` if the block succeeds.

    The temporary name keeps the ending, because many writers choose the format by it. If the block raises,
    the temporary file is removed and `path` is as it was.

    Raises
    ------
    RunFolderError
        If the folder is missing, `path` is a directory or a device, or the system refuses the write.
    """
    # A link is followed: replacing it by a file would silently detach the place it points to.
    target = Path(os.path.realpath(path))
    ensure_new(target, force=True)
    if not os.path.isdir(target.parent):
        raise RunFolderError(f"{path}: the folder {target.parent} does not exist; create it first.")
    # No tempfile.mkstemp: its files are private to the user, and would stay so after the rename.
    temporary = target.parent / f".{secrets.token_hex(8)}.tmp{target.suffix}"
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunFolderError(
            f"{path}: cannot be written ({reason}); check the permissions of the folder and the free space."
        ) from error
    finally:
        # Asked first: in a folder that may not be searched, unlink would raise and hide the reason.
        if os.path.lexists(temporary):
            temporary.unlink()


def atomic_write_bytes(path: PathLike, data: bytes) -> None:
    """Write `data` to `path`, all or nothing."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def atomic_write_text(path: PathLike, text: str) -> None:
    """Write `text` to `path` in UTF-8 with line feeds as they are, all or nothing."""
    atomic_write_bytes(path, text.encode("utf-8"))


@lru_cache(maxsize=32)
def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def provenance(seed: int | None, settings: Mapping[str, Any], data_hash: str | None) -> dict[str, Any]:
    """What is needed to repeat a result.

    Parameters
    ----------
    seed
        Seed of the random numbers, None where none were drawn.
    settings
        The options of the step, as plain values that JSON can hold.
    data_hash
        ``Observations.data_hash`` of the data.

    Returns
    -------
    dict
        ``created_utc``, ``seed``, ``settings``, ``data_sha256`` and ``versions`` (of Python and of the
        packages that decide the numbers; None for one that is not installed).
    """
    versions: dict[str, str | None] = {"python": platform.python_version()}
    # Read from the installed metadata: importing casadi or arviz to ask for its version would cost a second.
    versions.update({name.replace("-", "_"): _version(name) for name in _VERSIONED})
    return {
        "created_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "seed": seed,
        "settings": dict(settings),
        "data_sha256": data_hash,
        "versions": versions,
    }


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
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunFolderError(
                f"{self.path}: the run folder cannot be made ({error.strerror}); choose another place."
            ) from error
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


def check_new_run(run: RunFolder, force: bool) -> None:
    """Refuse a folder that holds anything, unless forced; called before any work is done.

    Raises
    ------
    RunFolderError
        When the folder exists and is not empty, or is a file.
    """
    if run.path.exists() and not run.path.is_dir():
        raise RunFolderError(f"{run.path}: is a file, not a folder for results; name another folder.")
    if run.path.is_dir() and any(run.path.iterdir()) and not force:
        raise RunFolderError(
            f"{run.path}: the folder exists and is not empty; name another, or replace its results with --force."
        )
