"""Replicates to and from one ``.npz`` file."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from starcal_uq.camera.camera import Camera
from starcal_uq.core.files import reading_archive, write_archive
from starcal_uq.core.types import AnyDict
from starcal_uq.paper.methods import Method

if TYPE_CHECKING:
    from starcal_uq.paper.replicates_result import Replicates

_FORMAT = "starcal_uq replicates 1"
_ARRAYS = ("replicate", "estimates", "claimed", "classical", "crlb", "map_px", "map_arcsec", "reprojection_px")
_PLAIN = ("n_requested", "interrupted", "provenance")


def save_replicates(found: Replicates, path: str | os.PathLike[str]) -> None:
    """Write everything, atomically; overwritten."""
    document: AnyDict = {name: getattr(found, name) for name in (*_PLAIN, "failures")}
    document["methods"] = [method.to_dict() for method in found.methods]
    document |= {"truth": found.truth.to_dict(), "start": found.start.to_dict()}
    arrays = {name: getattr(found, name) for name in _ARRAYS}
    write_archive(path, _FORMAT, document, arrays)


def load_replicates(path: str | os.PathLike[str]) -> Replicates:
    """Read what `save_replicates` wrote.

    Raises
    ------
    RunFolderError
        If the file is missing or is not a set of replicates.
    """
    from starcal_uq.paper.replicates_result import Replicates

    words = {
        "missing": "run `starcal-uq reproduce` first",
        "wrong": "does not hold replicates; run `starcal-uq reproduce` to write it again",
    }
    with reading_archive(path, _FORMAT, **words) as (document, arrays):
        values: AnyDict = {name: document[name] for name in _PLAIN}
        return Replicates(
            methods=tuple(Method.from_dict(method) for method in document["methods"]),
            truth=Camera.from_dict(document["truth"]),
            start=Camera.from_dict(document["start"]),
            failures=tuple(tuple(reasons) for reasons in document["failures"]),
            **{name: arrays[name] for name in _ARRAYS},
            **values,
        )
