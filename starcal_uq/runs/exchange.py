"""What a run gives to other programs: its camera in their files, the covariance, the draws, and
tables for a text.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import parameters
from starcal_uq.camera.exchange import CAMERA_FORMATS, Exported, export_camera, write_kernel
from starcal_uq.camera.spice import NO_INSTRUMENT
from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_write_text, ensure_new, split_part, write_csv
from starcal_uq.core.formatting import join_words
from starcal_uq.core.records import write_json
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.settings import bounded
from starcal_uq.core.types import AnyDict, PathLike, Progress
from starcal_uq.estimation.result import Calibration
from starcal_uq.inference.groups import write_arviz
from starcal_uq.inference.posterior import Posterior
from starcal_uq.maths.linear import root_diagonal
from starcal_uq.presentation.tables import TextTable
from starcal_uq.presentation.words.estimation import calibration_table
from starcal_uq.presentation.words.inference import posterior_table
from starcal_uq.runs.run import Run

COVARIANCE = "starcal_uq covariance 1"


@bounded
def export(
    what: PathLike | Run | Calibration | Posterior | Camera,
    to: str,
    path: PathLike | None = None,
    *,
    instrument: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write a calibrated camera, or what is known of it, for another program.

    Parameters
    ----------
    what : path, Run, Calibration, Posterior or Camera
        A run gives the mean of its posterior, or its estimate where there is no posterior. A path
        is that of a run folder, or of a camera.
    to : str
        One of `FORMATS`. ``opencv``, ``ros``, ``kalibr``, ``mrcal``, ``giant``, ``tetra3rs``, ``tetra3``,
        ``sip``, ``spice`` and ``asdf`` hold the camera; ``covariance`` (JSON) parameters and their covariance,
        ``csv`` and ``netcdf`` the draws, ``arviz`` (netCDF) a thousand of them with all of ArviZ's
        groups, ``latex`` and ``markdown`` the table of the parameters.
    path : path, optional
        File to write; by default one in the current folder, named after the run and the format.
    instrument : int, optional
        NAIF ID of the camera in a ``spice`` kernel.
    force : bool
        Whether to replace a file.
    progress : callable, optional
        Called as ``progress(done, total)`` while the log likelihood of ``arviz`` is computed.

    Returns
    -------
    Exported
        The file, how far it is from the camera (px), and one sentence on it.

    Raises
    ------
    CameraError
        For a camera that the format cannot hold.
    MissingExtraError
        If the format's library is not installed.
    RunFolderError
        For an unknown format, a run without what the format holds, or a file that exists.
    """
    if to not in FORMATS:
        raise RunFolderError(f"{to!r} is no format: use one of {', '.join(FORMATS)}.")
    if isinstance(what, str | os.PathLike):
        is_file = os.path.isfile(split_part(what)[0])
        what = Camera.load(what) if is_file else Run(what)
    name = "camera"
    run = None
    if isinstance(what, Run):
        name, run, what = what.name, what, what.best
    place = Path(f"{name}-{to}{FORMATS[to]}" if path is None else path)
    if to in CAMERA_FORMATS:
        camera = what if isinstance(what, Camera) else _camera_of(what)
        write = None
        if to == "spice":
            specs = parameters(camera.distortion)
            known = () if isinstance(what, Camera) else root_diagonal(what.covariance).tolist()
            sigmas = tuple(zip(specs, known, strict=False))
            write = partial(write_kernel, instrument=instrument or NO_INSTRUMENT, sigmas=sigmas)
        return export_camera(camera, to, place, force=force, write=write)
    if isinstance(what, Camera):
        raise RunFolderError(f"a camera alone has no {to}: name the folder of a run.")
    if to in _OF_DRAWS and not isinstance(what, Posterior):
        raise RunFolderError(
            f"{name}: has no draws for {to}; {Remedy('sample', (RUN,), purpose='first')}, or "
            "export covariance."
        )
    ensure_new(place, force)
    if to == "arviz":
        if run is None or not isinstance(what, Posterior):
            raise RunFolderError("arviz holds draws and data: name the folder of a run.")
        groups = write_arviz(what, run.observations, place, progress=progress)
        return Exported(place, 0.0, f"{join_words(groups)}, for `az.from_netcdf`.")
    return Exported(place, 0.0, _RESULTS[to](what, place))


def uncertain_values(
    what: PathLike | Run | Calibration | Posterior,
    library: Literal["uncertainties", "gtc"] = "uncertainties",
) -> dict[str, Any]:
    """Parameters as correlated uncertain numbers of another library, for error propagation there.

    Parameters
    ----------
    what : path, Run, Calibration or Posterior
        A run, or its folder, gives its posterior, or its estimate where there is no posterior.
    library : str
        ``uncertainties`` (``UFloat``) or ``gtc`` (``UncertainReal`` of GTC).

    Returns
    -------
    dict
        Number by name of the parameter, px units: mean, standard deviation and correlations.

    Raises
    ------
    MissingExtraError
        If the library is not installed.
    """
    opened = Run(what) if isinstance(what, str | os.PathLike) else what
    best = opened.best if isinstance(opened, Run) else opened
    camera = _camera_of(best)
    covariance = best.covariance
    names = camera.parameter_names
    mean = camera.theta.tolist()
    with extra("uncertain", "uncertain numbers"):
        if library == "uncertainties":
            from uncertainties import correlated_values

            return dict(zip(names, correlated_values(mean, covariance), strict=True))
        import GTC

    sigma = root_diagonal(covariance)
    found = GTC.multiple_ureal(mean, sigma.tolist(), math.inf, label_seq=names)
    for (i, one), (j, other) in itertools.combinations(enumerate(found), 2):
        GTC.set_correlation(float(covariance[i, j] / (sigma[i] * sigma[j])), one, other)
    return dict(zip(names, found, strict=True))


def _camera_of(best: Calibration | Posterior) -> Camera:
    return best.calibrated_camera if isinstance(best, Posterior) else best.camera


def _write_covariance(best: Calibration | Posterior, path: Path) -> str:
    """Parameters with their units and covariance, px units, as a filter takes them for its
    state.
    """
    specs = parameters(best.camera.distortion)
    content: AnyDict = {
        "format": COVARIANCE,
        "source": "posterior" if isinstance(best, Posterior) else "estimate",
        "distortion": best.camera.distortion,
        "parameter_names": [p.name for p in specs],
        "units": [p.unit for p in specs],
        "mean": (best.calibrated_camera if isinstance(best, Posterior) else best).theta,
        "covariance": best.covariance,
        "data_sha256": best.provenance.data_sha256,
        "versions": best.provenance.versions,
    }
    write_json(content, path)
    return (
        f"mean and covariance of {', '.join(p.name for p in specs)}, of the {content['source']}, "
        "in px units."
    )


def _write_draws(best: Calibration | Posterior, path: Path) -> str:
    import pandas as pd

    assert isinstance(best, Posterior)
    names = [f"{p.name} [{p.unit}]" for p in best.parameters]
    write_csv(pd.DataFrame(best.draws, columns=names), path)
    return f"{len(best.draws)} draws of {', '.join(best.parameter_names)}, a row each."


def _write_netcdf(best: Calibration | Posterior, path: Path) -> str:
    assert isinstance(best, Posterior)
    # Whether it may be replaced was asked before.
    best.save(path, force=True)
    return f"{len(best.draws)} draws, as ArviZ and xarray read them."


def _write_table(
    mark: Callable[[TextTable], str], needs: str = ""
) -> Callable[[Calibration | Posterior, Path], str]:
    def write(best: Calibration | Posterior, path: Path) -> str:
        table = posterior_table(best) if isinstance(best, Posterior) else calibration_table(best)
        atomic_write_text(path, mark(table) + "\n")
        return f"the table of {len(table.rows)} parameters{needs}."

    return write


_OF_DRAWS = ("csv", "netcdf", "arviz")
_RESULTS = {
    "covariance": _write_covariance,
    "csv": _write_draws,
    "netcdf": _write_netcdf,
    "latex": _write_table(TextTable.latex, ", for the package booktabs"),
    "markdown": _write_table(TextTable.markdown),
}
# Format -> ending of its file.
FORMATS = {name: form.ending for name, form in CAMERA_FORMATS.items()} | {
    "covariance": ".json",
    "csv": ".csv",
    "netcdf": ".nc",
    "arviz": ".nc",
    "latex": ".tex",
    "markdown": ".md",
}
