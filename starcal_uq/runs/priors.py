"""Priors of a run: from a file, or from the posterior of an earlier run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from starcal_uq.camera.camera import Camera
from starcal_uq.core.errors import PriorError
from starcal_uq.core.provenance import data_hashes
from starcal_uq.core.types import AnyDict
from starcal_uq.inference.posterior import Posterior
from starcal_uq.inference.priors import GaussianPriors, Priors, priors_from_table, read_priors_table
from starcal_uq.inference.update import SHIFT_KEYS, AllowedShift, check_chain, prior_from
from starcal_uq.runs.folder import RunFolder

_CHAIN_KEYS = ("prior_from", "inflation", "noise", "shift")


def _text(table: Mapping[str, Any], key: str) -> str:
    if not isinstance(table[key], str):
        raise PriorError(f"key {key!r} in [priors] must be a text.")
    return str(table[key])


def _numbers(table: Any, where: str, keys: Collection[str]) -> dict[str, float]:
    if not isinstance(table, Mapping):
        raise PriorError(f"{where!r} in [priors] must be a table with {', '.join(keys)}.")
    for key, value in table.items():
        if key not in keys:
            raise PriorError(f"unknown key {key!r} in [priors.{where}]; use one of {', '.join(keys)}.")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise PriorError(f"key {key!r} of [priors] must be a number.")
    return {key: float(value) for key, value in table.items()}


def prior_from_run(run: str | Path, **options: Any) -> GaussianPriors:
    """The posterior of a run folder as a prior; options as for `prior_from`."""
    from starcal_uq.estimation.calibration import Calibration

    folder = RunFolder(run)
    posterior = Posterior.load(folder.require("posterior"))
    hashes = data_hashes(Calibration.load(folder.calibration).provenance) if folder.calibration.exists() else set()
    return prior_from(posterior, name=folder.path.resolve().name, data_sha256=hashes, **options)


def load_priors(
    path: str | Path, camera: Camera, per_star_sigma: bool = False, data_sha256: Collection[str] = ()
) -> Priors:
    """Read a ``[priors]`` table: physical terms, or ``prior_from = "RUN"`` for the posterior of an earlier run.

    With ``prior_from`` (relative to the file), the table may hold ``inflation``, ``noise`` (``default``, ``posterior``)
    and a table ``[priors.shift]`` with ``principal_point_px``, ``focal_fraction`` and ``distortion_corner_px``.

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
        For a file that cannot be read, an unknown key, or an earlier run of another camera or of the same data.
    """
    table = read_priors_table(path)
    if "prior_from" not in table:
        return priors_from_table(path, table, camera, per_star_sigma)
    for key in table:
        if key not in _CHAIN_KEYS:
            raise PriorError(
                f"{path}: unknown key {key!r} in [priors] beside prior_from; use one of {', '.join(_CHAIN_KEYS)}."
            )
    try:
        run = Path(path).parent / _text(table, "prior_from")
        options: AnyDict = {"shift": AllowedShift(**_numbers(table.get("shift", {}), "shift", SHIFT_KEYS))}
        options |= _numbers({k: v for k, v in table.items() if k == "inflation"}, "priors", ("inflation",))
        if "noise" in table:
            options["noise"] = _text(table, "noise")
        priors = prior_from_run(run, per_star_sigma=per_star_sigma, **options)
        check_chain(priors, camera, data_sha256)
    except PriorError as error:
        raise PriorError(f"{path}: {error}") from None
    return priors
