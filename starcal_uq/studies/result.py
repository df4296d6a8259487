"""The result of a study: one labelled data set over all cells, and the questions that are asked of
it.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq.camera.distortion import PARAMETERS
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import StudyError
from starcal_uq.core.files import atomic_path, check_hdf5, new_folder, reading, write_netcdf
from starcal_uq.core.manifest import read_manifest
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.settings import bounded
from starcal_uq.core.types import AnyMapping, BoolArray, FloatArray, PathLike, floats
from starcal_uq.studies.axes import AXES
from starcal_uq.studies.definition import StudyDefinition
from starcal_uq.studies.findings import Statistic, Sweep, cross

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

NETCDF, PARQUET = "study.nc", "study.parquet"
# An error that falls more slowly than this power of the frames, a thousand times more of them, is
# at its floor.
_NO_GAIN = -0.05
_PARAMETER = "parameter"
_OTHER = "parameter_2"
_AXIS = "axis"
_FACTOR = "frames_factor"
_SIMPLER = "simpler"

# In place of a unit: each parameter has its own.
OWN_UNIT = "unit of the parameter"
_DECLARED = tomllib.loads(Path(__file__).with_name("variables.toml").read_text("utf-8"))
# Dimensions beyond `cell`, unit, and words of every variable.
VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    name: (tuple(told.get("dims", ())), told.get("unit", ""), told["words"])
    for name, told in _DECLARED.items()
}
TEXTS = ("weak_words",)


@dataclass(frozen=True, eq=False)
class Study(Shown):
    """Results of a study.

    Attributes
    ----------
    data : xarray.Dataset
        Dimension ``cell``; coordinates are the swept axes, ``seed_index`` and ``key``. A cell whose
        `status` is not ``ok`` holds NaN.
    definition : StudyDefinition
        What was varied.
    """

    data: xr.Dataset
    definition: StudyDefinition

    @property
    def axes(self) -> tuple[str, ...]:
        """Swept axes with more than one value."""
        return tuple(name for name, values in self.definition.axes.items() if len(set(values)) > 1)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters of all models."""
        return tuple(str(name) for name in self.data["parameter"].values)

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return int(self.data.sizes["cell"])

    @property
    def ok(self) -> BoolArray:
        """Cells that have numbers, (C,)."""
        return self.sweep.ok

    @cached_property
    def sweep(self) -> Sweep:
        """The cells by their place in the sweep, and what they say together."""
        return Sweep(self.data, self.axes, tuple(self.definition.latin))

    @property
    def complete(self) -> bool:
        """False for an interrupted study; running it again continues it."""
        return not bool(self.data.attrs.get("missing_cells", 0))

    @property
    def problems(self) -> dict[str, int]:
        """Reasons for cells without numbers, with their counts, most frequent first."""
        return dict(self.sweep.failures)

    def values(
        self,
        variable: str,
        *,
        parameter: str | None = None,
        parameter_2: str | None = None,
        axis: str | None = None,
        simpler: str | None = None,
    ) -> FloatArray:
        """One number per cell, (C,): a variable at the labels of its other dimensions.

        `axis` may also be ``cross``: root mean square of pitch and yaw.

        Raises
        ------
        StudyError
            For an unknown variable or label, or one that is missing.
        """
        labels = {_PARAMETER: parameter, _OTHER: parameter_2, _AXIS: axis, _SIMPLER: simpler}
        if variable == "frames_needed" and variable not in self.data:
            raise StudyError("the study has no target: use needed(along, target_arcsec).")
        if variable not in self.data:
            raise StudyError(
                f"the study has no variable {variable!r}: use one of "
                f"{', '.join(map(str, self.data))}."
            )
        array = self.data[variable]
        if axis == "cross" and _AXIS in array.dims:
            array = cross(array)
        for name, label in labels.items():
            if name not in array.dims:
                continue
            known = [str(v) for v in array[name].values]
            if label not in known:
                raise StudyError(f"{variable} needs {name}=: give one of {', '.join(known)}.")
            array = array.sel({name: label})
        numbers: FloatArray = floats(array.values)
        if numbers.ndim != 1:
            raise StudyError(
                f"{variable} has more than one number per cell along "
                f"{', '.join(map(str, array.dims[1:]))}."
            )
        return numbers

    @bounded
    def frames_for(self, target_arcsec: float) -> FloatArray:
        """Frames (C,) that bring the frame-dependent error, 1 sigma per axis across the boresight,
        to a target.

        Infinite where errors of the stars, which more frames do not average, leave more than that;
        NaN without numbers.
        """
        curve, factors, frames = (
            self.data[name].values for name in ("error_curve_arcsec", _FACTOR, "n_frames")
        )
        return frames_for(curve, factors, frames, target_arcsec)

    def band(
        self,
        variable: str,
        along: str,
        *,
        at: AnyMapping | None = None,
        **labels: str | None,
    ) -> pd.DataFrame:
        """A variable along an axis, over seeds and all axes that `at` does not hold.

        Parameters
        ----------
        variable, **labels
            As for `values`.
        along : str
            The axis.
        at : dict, optional
            Values at which other axes are held; none by default.

        Returns
        -------
        pandas.DataFrame
            Columns ``value`` (of the axis), ``median``, ``low``, ``high`` (least and most), ``n``
            (cells).

        Raises
        ------
        StudyError
            For an axis or a value that is not in the sweep, and as `values` does.
        """
        return self._band(self.values(variable, **labels), along, at)

    def _band(self, numbers: FloatArray, along: str, at: AnyMapping | None) -> pd.DataFrame:
        import xarray as xr

        names: dict[str, Statistic] = {
            "median": "median",
            "low": "min",
            "high": "max",
            "n": "count",
        }
        try:
            self.sweep.check(along)
            found = {
                name: self.sweep.over(numbers, statistic, [along], at)
                for name, statistic in names.items()
            }
        except ValueError as error:
            raise StudyError(str(error)) from None
        return xr.Dataset(found).to_dataframe().rename_axis("value").reset_index()

    @bounded
    def needed(
        self, along: str, target_arcsec: float | None = None, *, at: AnyMapping | None = None
    ) -> pd.DataFrame:
        """Frames that a target takes, along an axis, as `band` gives a variable; by default the
        study's own target.

        Raises
        ------
        StudyError
            Without a target, and as `band` does.
        """
        return self._band(self.frames_for(self._target(target_arcsec)), along, at)

    def _target(self, target_arcsec: float | None) -> float:
        target = self.definition.target_arcsec if target_arcsec is None else target_arcsec
        if target is None or not target > 0.0:
            raise StudyError("no target is set: give target_arcsec above zero, here or in [study].")
        return target

    @bounded
    def met(
        self, along: str, target_arcsec: float | None = None, *, at: AnyMapping | None = None
    ) -> list[float]:
        """Values of an axis of numbers at which the median frame-dependent error crosses the
        target, interpolated.

        Raises
        ------
        StudyError
            Without a target, along names, and as `band` does.
        """
        target = self._target(target_arcsec)
        if AXES[along].kind == "name":
            raise StudyError(f"{along} has names for values: give an axis of numbers.")
        table = self._band(self.sweep.frame_error, along, at).dropna()
        value = table["value"].to_numpy(dtype=np.float64)
        excess = np.log(table["median"].to_numpy(dtype=np.float64) / target)
        changes = np.flatnonzero(np.sign(excess[:-1]) * np.sign(excess[1:]) < 0)
        return [
            float(value[i] + (value[i + 1] - value[i]) * excess[i] / (excess[i] - excess[i + 1]))
            for i in changes
        ]

    def table(self) -> pd.DataFrame:
        """One row per cell and parameter: the axes, what a cell has one number of, then the
        parameter's in its unit.
        """
        import xarray as xr

        data = self.data
        where = [*self.definition.axes, "seed_index", "key", "status"]
        flat: dict[str, xr.DataArray] = {}
        for key, array in data.drop_vars("status").data_vars.items():
            beyond = [str(dim) for dim in array.dims if dim not in ("cell", _PARAMETER)]
            if not beyond:
                flat[str(key)] = array
            elif len(beyond) == 1 and _FACTOR not in beyond:
                for label in data[beyond[0]].values:
                    flat[f"{key}_{label}"] = array.sel({beyond[0]: label}, drop=True)
        units = [PARAMETERS[name].unit for name in self.parameter_names]
        every = xr.Dataset(flat | {"unit": (_PARAMETER, units)}, {_PARAMETER: data[_PARAMETER]})
        table = every.assign({name: data[name].variable for name in where}).to_dataframe(
            dim_order=["cell", _PARAMETER]
        )
        own = [name for name, array in flat.items() if _PARAMETER in array.dims]
        whole = [name for name in flat if name not in own]
        return table.reset_index()[["cell", *where, _PARAMETER, "unit", *whole, *own]]

    def save(self, folder: PathLike) -> None:
        """Write ``study.nc`` and ``study.parquet`` into a folder, each all or nothing."""
        from xarray.backends import H5NetCDFStore

        path = new_folder(folder)
        packed = {
            name: {"zlib": True, "complevel": 1}
            for name, v in self.data.items()
            if v.dtype.kind in "fi"
        }
        write_netcdf(
            path / NETCDF,
            lambda file: self.data.dump_to_store(H5NetCDFStore(file), encoding=packed),
        )
        with atomic_path(path / PARQUET) as temporary:
            self.table().to_parquet(temporary, index=False)

    @classmethod
    def load(cls, path: PathLike) -> Study:
        """Read a study from its folder, or from its ``study.nc``.

        Raises
        ------
        RunFolderError
            If the file is missing or is no study.
        """
        import xarray as xr

        file = Path(path)
        if file.is_dir():
            # Puts results in their places whose writer was stopped.
            read_manifest(file)
            file = file / NETCDF
        with reading(file, "a study", Remedy("study", purpose="again")):
            check_hdf5(file)
            with xr.open_dataset(file, engine="h5netcdf", phony_dims="access") as opened:
                data = opened.load()
            study = cls(data, StudyDefinition.from_dict(json.loads(data.attrs["definition"])))
            study._check()
            return study

    def _check(self) -> None:
        """Refuse a data set that is not one of this definition, as a damaged file may hold it."""
        expected: dict[str, tuple[str, ...]] = dict.fromkeys(
            (*self.definition.axes, "seed_index", "key", "status"), ()
        )
        expected |= {name: dims for name, (dims, _, _) in VARIABLES.items() if name in self.data}
        for name, dims in expected.items():
            if name not in self.data.variables:
                raise ValueError(f"{name} is missing")
            if self.data[name].dims != ("cell", *dims):
                raise ValueError(f"{name} is not along cell{''.join(f', {dim}' for dim in dims)}")
        if self.parameter_names != tuple(self.definition.parameter_names):
            raise ValueError("its parameters are not those of its definition")

    def __repr__(self) -> str:
        swept = ", ".join(
            f"{name} ({len(values)})" for name, values in self.definition.axes.items()
        )
        return (
            f"<Study {self.definition.name!r}: {int(self.ok.sum())} of {self.n_cells} cells, "
            f"{swept}>"
        )


def frames_for(
    curve: FloatArray, factors: FloatArray, frames: FloatArray, target: float
) -> FloatArray:
    """Frames (C,) at which error curves (C, k), over factors (k,) on numbers of frames (C,), come
    down to a target.
    """
    x, wanted = np.log(factors), np.log(target)
    needed = np.full(len(frames), np.nan)
    for cell in np.flatnonzero(~np.isnan(curve).all(axis=1)):
        known = np.isfinite(curve[cell])
        step, errors = x[known], np.log(np.maximum(curve[cell][known], np.finfo(float).tiny))
        # Errors fall with every frame; beyond the ends they go on as they did.
        after = int(np.clip(np.sum(errors > wanted), 1, len(errors) - 1))
        slope = (errors[after] - errors[after - 1]) / (step[after] - step[after - 1])
        if errors[after] > wanted and slope > _NO_GAIN:
            needed[cell] = np.inf
            continue
        factor = np.exp(step[after] + (wanted - errors[after]) / slope)
        needed[cell] = max(np.ceil(frames[cell] * factor - 1e-6), 1.0)
    return needed
