"""A validation to and from one ``.npz`` file."""

from __future__ import annotations

import json
import os
import zipfile
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq._types import AnyDict
from starcal_uq.camera import Camera
from starcal_uq.errors import RunFolderError, StarcalError
from starcal_uq.priors import Priors
from starcal_uq.runfolder import atomic_path

if TYPE_CHECKING:
    from starcal_uq.validation_result import Validation

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
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, format=np.array(_FORMAT), document=np.array(json.dumps(document)), **arrays
        )


def load_validation(path: str | os.PathLike[str]) -> Validation:
    """Read what `save_validation` wrote.

    Raises
    ------
    RunFolderError
        If the file is missing or is not a validation.
    """
    from starcal_uq.validation_result import Validation

    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
            if str(content["format"]) != _FORMAT:
                raise ValueError(f"format {content['format']}")
            document: AnyDict = json.loads(str(content["document"]))
            arrays = {name: content[name] for name in _ARRAYS}
        values: AnyDict = {name: document[name] for name in _PLAIN}
        values |= {name: tuple(document[name]) for name in _TUPLES}
        return Validation(
            camera=Camera.from_dict(document["camera"]),
            nominal=Camera.from_dict(document["nominal"]),
            priors=Priors.from_dict(document["priors"]),
            **arrays,
            **values,
        )
    except OSError as error:
        raise RunFolderError(
            f"{path}: cannot be read ({error.strerror or error}); run `starcal-uq validate CAMERA` first."
        ) from error
    except (KeyError, ValueError, TypeError, EOFError, AttributeError, zipfile.BadZipFile, StarcalError) as error:
        raise RunFolderError(
            f"{path}: is not a validation; run `starcal-uq validate CAMERA` to write it again."
        ) from error
