"""Replicates to and from one ``.npz`` file."""

from __future__ import annotations

import json
import os
import zipfile
from typing import TYPE_CHECKING

import numpy as np

from starcal_uq._types import AnyDict
from starcal_uq.camera import Camera
from starcal_uq.errors import RunFolderError, StarcalError
from starcal_uq.reproduction.methods import Method
from starcal_uq.runfolder import atomic_path

if TYPE_CHECKING:
    from starcal_uq.reproduction.replicates_result import Replicates

_FORMAT = "starcal_uq replicates 1"
_ARRAYS = ("replicate", "estimates", "claimed", "classical", "crlb", "map_px", "map_arcsec", "reprojection_px")
_PLAIN = ("n_requested", "interrupted", "provenance")


def save_replicates(found: Replicates, path: str | os.PathLike[str]) -> None:
    """Write everything, atomically; overwritten."""
    document: AnyDict = {name: getattr(found, name) for name in (*_PLAIN, "failures")}
    document["methods"] = [method.to_dict() for method in found.methods]
    document |= {"truth": found.truth.to_dict(), "start": found.start.to_dict()}
    arrays = {name: getattr(found, name) for name in _ARRAYS}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, allow_pickle=False, format=np.array(_FORMAT), document=np.array(json.dumps(document)), **arrays
        )


def load_replicates(path: str | os.PathLike[str]) -> Replicates:
    """Read what `save_replicates` wrote.

    Raises
    ------
    RunFolderError
        If the file is missing or is not a set of replicates.
    """
    from starcal_uq.reproduction.replicates_result import Replicates

    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
            if str(content["format"]) != _FORMAT:
                raise ValueError(f"format {content['format']}")
            document: AnyDict = json.loads(str(content["document"]))
            arrays = {name: content[name] for name in _ARRAYS}
        values: AnyDict = {name: document[name] for name in _PLAIN}
        return Replicates(
            methods=tuple(Method.from_dict(method) for method in document["methods"]),
            truth=Camera.from_dict(document["truth"]),
            start=Camera.from_dict(document["start"]),
            failures=tuple(tuple(reasons) for reasons in document["failures"]),
            **arrays,
            **values,
        )
    except OSError as error:
        raise RunFolderError(
            f"{path}: cannot be read ({error.strerror or error}); run `starcal-uq reproduce` first."
        ) from error
    except (KeyError, ValueError, TypeError, EOFError, AttributeError, zipfile.BadZipFile, StarcalError) as error:
        raise RunFolderError(
            f"{path}: does not hold replicates; run `starcal-uq reproduce` to write it again."
        ) from error
