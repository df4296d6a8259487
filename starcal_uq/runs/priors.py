"""Priors of a run: from a file, or from the posterior of an earlier run."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import sigma_parameter
from starcal_uq.core.errors import PriorError
from starcal_uq.core.provenance import data_hashes
from starcal_uq.core.toml import Key, Section, read_section
from starcal_uq.inference.priors import GaussianPriors, Priors, priors_from_table
from starcal_uq.inference.update import SHIFT_KEYS, AllowedShift, check_chain, prior_from
from starcal_uq.runs.run import Run

_CHAIN = Section(
    {
        "prior_from": Key(str, "the folder of the earlier run, a text in quotes"),
        "inflation": Key(float, "the factor on all standard deviations, a number of at least 1"),
        "noise": Key(str, "default or posterior, a text in quotes"),
        "shift": Key(dict[str, Any], f"a table with {', '.join(SHIFT_KEYS)}"),
    },
    PriorError,
)
_SHIFT = Section(
    {name: Key(float, "a number, zero or more", ge=0.0) for name in SHIFT_KEYS}, PriorError
)


def prior_from_run(run: str | Path, **options: Any) -> GaussianPriors:
    """The posterior of a run folder as a prior; options as for `prior_from`."""
    earlier = Run(run)
    posterior = earlier.posterior
    hashes = data_hashes(earlier.calibration.provenance) if earlier.has("calibration") else set()
    return prior_from(posterior, name=earlier.name, data_sha256=hashes, **options)


def read_priors(run: Run, path: str | Path) -> Priors:
    """Priors of a TOML file for the camera and the data of a run; see `load_priors`."""
    cal = run.calibration
    per_star = cal.sigma_name == sigma_parameter(True).name
    return load_priors(path, cal.nominal, per_star, data_hashes(cal.provenance))


def load_priors(
    path: str | Path,
    camera: Camera,
    per_star_sigma: bool = False,
    data_sha256: Collection[str] = (),
) -> Priors:
    """Read a ``[priors]`` table: physical terms, or ``prior_from = "RUN"`` for the posterior of an
    earlier run.

    With ``prior_from`` (relative to the file), the table may hold ``inflation``, ``noise``
    (``default``, ``posterior``) and a table ``[priors.shift]`` with ``principal_point_px``,
    ``focal_fraction`` and ``distortion_corner_px``.

    Parameters
    ----------
    path : path
        TOML file.
    camera : Camera
        Nominal camera of the run that is to be sampled.
    per_star_sigma : bool
        Whether its stars state their noise.
    data_sha256 : collection of str
        Hashes of its data; an earlier posterior that holds them already is refused.

    Raises
    ------
    PriorError
        For a file that cannot be read, an unknown key, or an earlier run of another camera or of
        the same data.
    """
    table = read_section(path, "priors", PriorError, alone=False)
    if "prior_from" not in table:
        return priors_from_table(path, table, camera, per_star_sigma)
    options = _CHAIN.check(table, f"{path}, section [priors] with prior_from")
    shift = _SHIFT.check(options.pop("shift", {}), f"{path}, section [priors.shift]")
    run = Path(path).parent / options.pop("prior_from")
    try:
        priors = prior_from_run(
            run, per_star_sigma=per_star_sigma, shift=AllowedShift(**shift), **options
        )
        check_chain(priors, camera, data_sha256)
    except PriorError as error:
        raise PriorError(f"{path}: {error}") from None
    return priors
