"""Posterior to and from one netCDF file.

The groups ``posterior`` and ``sample_stats`` follow ArviZ's schema, for other tools. The root group holds what this
package reads back: the draws in px units (dividing by a scale and multiplying again would change the last bit), the
matrices, and one JSON text with everything small.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path, ensure_new
from starcal_uq.inference.posterior import Diagnostics, Laplace, Posterior
from starcal_uq.inference.priors import Priors

_FORMAT = "starcal_uq posterior 1"
_Record = TypeVar("_Record", Laplace, Diagnostics)
_ARRAYS = {
    "draws": ("sample", "parameter"),
    "log_posterior": ("sample",),
    "information": ("camera_parameter", "camera_parameter_2"),
    "rotation_per_theta": ("axis", "camera_parameter"),
    "attitude_noise": ("axis", "axis_2"),
}
# Present only where the likelihood has such a parameter.
_OPTIONAL = {"dof_draws": ("sample",)}
_PLAIN = ("n_ensembles", "n_walkers", "n_steps", "sigma_sampled", "provenance")


def to_json(value: Any) -> str:
    """JSON text with exact floats; arrays become lists."""
    return json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return vars(value)
    return str(value)


def _record(cls: type[_Record], values: Mapping[str, Any]) -> _Record:
    kinds = {field.name: str(field.type) for field in dataclasses.fields(cls)}
    converted: dict[str, Any] = {}
    for name, value in values.items():
        if kinds[name] == "FloatArray":
            converted[name] = np.asarray(value, dtype=np.float64)
        else:
            converted[name] = tuple(value) if kinds[name].startswith("tuple") else value
    return cls(**converted)


def save_posterior(posterior: Posterior, path: str | os.PathLike[str], force: bool) -> None:
    """Write a posterior; see `Posterior.save`."""
    import xarray as xr

    ensure_new(path, force)
    record = {
        "parameter_names": posterior.parameter_names,
        "camera": posterior.camera.to_dict(),
        "priors": posterior.priors.to_dict(),
        "laplace": posterior.laplace,
        "diagnostics": posterior.diagnostics,
        **{name: getattr(posterior, name) for name in _PLAIN},
    }
    arrays = {name: (dims, getattr(posterior, name)) for name, dims in (_ARRAYS | _OPTIONAL).items()}
    root = xr.Dataset(
        {name: value for name, value in arrays.items() if value[1] is not None},
        attrs={"format": _FORMAT, "record": to_json(record)},
    )
    tree = xr.DataTree.from_dict({"/": root, **posterior.datasets()})
    with atomic_path(path) as temporary:
        tree.to_netcdf(temporary, engine="h5netcdf")


def load_posterior(path: str | os.PathLike[str]) -> Posterior:
    """Read a posterior; see `Posterior.load`."""
    import h5netcdf

    if not Path(path).is_file():
        raise RunFolderError(f"{path}: there is no such file; run `starcal-uq sample RUN` first.")
    try:
        with h5netcdf.File(path, "r") as file:
            if file.attrs.get("format") != _FORMAT:
                raise RunFolderError(f"{path}: is not a posterior of this version; run `starcal-uq sample RUN` again.")
            record = json.loads(str(file.attrs["record"]))
            arrays: dict[str, Any] = {name: np.asarray(file.variables[name][...], dtype=np.float64) for name in _ARRAYS}
            present = [name for name in _OPTIONAL if name in file.variables]
            arrays |= {name: np.asarray(file.variables[name][...], dtype=np.float64) for name in present}
    except (OSError, KeyError, ValueError) as error:
        raise RunFolderError(
            f"{path}: cannot be read as a posterior ({error}); run `starcal-uq sample RUN` again."
        ) from error
    return Posterior(
        parameter_names=tuple(record["parameter_names"]),
        priors=Priors.from_dict(record["priors"]),
        laplace=_record(Laplace, record["laplace"]),
        diagnostics=_record(Diagnostics, record["diagnostics"]),
        camera=Camera.from_dict(record["camera"]),
        **{name: record[name] for name in _PLAIN},
        **arrays,
    )
