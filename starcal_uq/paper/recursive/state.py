"""The state of a recursive calibration as a file: arrays to the last bit, all else as JSON, in one
``.npz``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from starcal_uq.camera.camera import Camera
from starcal_uq.core.files import atomic_path, reading
from starcal_uq.core.records import Arrays, from_plain, read_arrays, to_plain
from starcal_uq.core.types import AnyDict, PathLike
from starcal_uq.estimation.stages import Stage
from starcal_uq.observations.frames import StarFrames
from starcal_uq.paper.recursive.filter import Recursion
from starcal_uq.paper.recursive.start import RecursionOptions

WHAT = "a saved recursive calibration, or is incomplete"
REMEDY = "give a file written by RecursiveCalibration.save"
_KIND = "starcal_uq recursive calibration"
_VERSION = 2


@dataclass(frozen=True, eq=False)
class State:
    """Everything that a recursive calibration knows; the fields are those of
    `RecursiveCalibration`.
    """

    method: str
    options: RecursionOptions
    nominal: Camera
    given_distortion: str
    per_star: bool | None
    digest: str
    seconds: float
    waiting: StarFrames | None
    richest: StarFrames | None
    stage: Stage | None
    recursion: Recursion | None


def write_state(state: State, path: PathLike) -> None:
    """Write a state, all or nothing."""
    arrays: Arrays = {}
    header = {"kind": _KIND, "version": _VERSION, **to_plain(state, arrays)}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, header=np.array(json.dumps(header)), **arrays)


def read_state(path: PathLike) -> State:
    """Inverse of `write_state`; `RunFolderError` for a file that is missing, truncated, or no such
    state.
    """
    with reading(path, WHAT, REMEDY):
        arrays = read_arrays(path)
        header = json.loads(str(arrays.pop("header")))
        kind, version = header.pop("kind"), header.pop("version")
        if kind != _KIND or version not in (1, _VERSION):
            raise ValueError("another kind or version")
        return from_plain(
            State, header if version == _VERSION else _upgraded(header, arrays), arrays
        )


def _upgraded(header: AnyDict, arrays: Arrays) -> AnyDict:
    """The header of version 1, which left out what was None."""

    def frames(name: str) -> AnyDict | None:
        return {"weight": None} if f"{name}_pixel" in arrays else None

    recursion = header.get("recursion")
    if recursion is not None:
        history = {"every": recursion.pop("every")}
        recursion = {
            "process": None,
            **recursion,
            "history": history,
            "held": frames("recursion_held"),
        }
    held = {name: frames(name) for name in ("waiting", "richest")}
    return {"stage": None, **header, **held, "recursion": recursion}
