"""A validation to and from one ``.npz`` file."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from starcal_uq.camera.camera import Camera
from starcal_uq.core.files import reading_archive, write_archive
from starcal_uq.core.types import AnyDict
from starcal_uq.inference.priors import Priors

if TYPE_CHECKING:
    from starcal_uq.diagnostics.validation.result import Validation

_FORMAT = "starcal_uq validation 1"
_ARRAYS = (
    *("replicate", "truth", "ranks", "covered", "error", "sd"),
    *("nees", "nees_calibration", "compression_error", "dof"),
)
_PLAIN = ("n_ranked", "n_requested", "interrupted", "provenance")
_TUPLES = ("quantities", "units", "failures")


def save_validation(found: Validation, path: str | os.PathLike[str]) -> None:
    """Write everything, atomically; overwritten."""
    document: AnyDict = {name: getattr(found, name) for name in (*_PLAIN, *_TUPLES)}
    document |= {name: getattr(found, name).to_dict() for name in ("camera", "nominal", "priors")}
    arrays = {name: getattr(found, name) for name in _ARRAYS}
    write_archive(path, _FORMAT, document, arrays)


def load_validation(path: str | os.PathLike[str]) -> Validation:
    """Read what `save_validation` wrote.

    Raises
    ------
    RunFolderError
        If the file is missing or is not a validation.
    """
    from starcal_uq.diagnostics.validation.result import Validation

    words = {
        "missing": "run `starcal-uq validate CAMERA` first",
        "wrong": "is not a validation; run `starcal-uq validate CAMERA` to write it again",
    }
    with reading_archive(path, _FORMAT, **words) as (document, arrays):
        values: AnyDict = {name: document[name] for name in _PLAIN}
        values |= {name: tuple(document[name]) for name in _TUPLES}
        return Validation(
            camera=Camera.from_dict(document["camera"]),
            nominal=Camera.from_dict(document["nominal"]),
            priors=Priors.from_dict(document["priors"]),
            **{name: arrays[name] for name in _ARRAYS},
            **values,
        )
