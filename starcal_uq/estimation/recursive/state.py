"""The state of a recursive calibration as a file: arrays to the last bit, all else as JSON, in one ``.npz``."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.files import atomic_path
from starcal_uq.core.status import Status
from starcal_uq.core.types import AnyDict
from starcal_uq.estimation.recursive.filter import FrameSums, History, Recursion
from starcal_uq.estimation.stages import Stage
from starcal_uq.observations.frames import StarFrames

_KIND = "starcal_uq recursive calibration"
_VERSION = 1
_HELD = ("waiting", "richest")
_HISTORY = ("estimates", "sigmas", "costs")
# A cut-off archive shows itself by any of these, depending on where it was cut.
_UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error)

Arrays = dict[str, Any]
State = tuple[AnyDict, Arrays]


def _split(record: Any, leave: tuple[str, ...] = ()) -> State:
    """Fields of a dataclass: plain values, and arrays."""
    plain: AnyDict = {}
    arrays: Arrays = {}
    for field in fields(record):
        value = getattr(record, field.name)
        if field.name in leave:
            continue
        if isinstance(value, np.ndarray):
            arrays[field.name] = value
        else:
            plain[field.name] = value
    return plain, arrays


def recursion_state(recursion: Recursion | None) -> State | None:
    """Everything that a recursion knows."""
    if recursion is None:
        return None
    plain, arrays = _split(recursion, ("sums", "history", "held"))
    plain["sums"], sums = _split(recursion.sums)
    plain["every"] = recursion.history.every
    q = len(recursion.offset)
    arrays |= {f"sums_{name}": value for name, value in sums.items()}
    for name in _HISTORY:
        values = np.array(getattr(recursion.history, name), dtype=np.float64)
        arrays[f"history_{name}"] = values if name == "costs" else values.reshape(-1, q)
    return plain, arrays | _frame_arrays("held", recursion.held)


def recursion_from(state: State | None) -> Recursion | None:
    """Inverse of `recursion_state`."""
    if state is None:
        return None
    plain, arrays = dict(state[0]), dict(state[1])
    sums = plain.pop("sums") | {name: arrays.pop(f"sums_{name}") for name in ("gram", "moments")}
    estimates, sigmas, costs = (arrays.pop(f"history_{name}") for name in _HISTORY)
    history = History(plain.pop("every"), list(estimates), list(sigmas), costs.tolist())
    held = _frames(arrays, "held")
    plain |= {name: value for name, value in arrays.items() if not name.startswith("held_")}
    return Recursion(**plain, held=held, sums=FrameSums(**sums), history=history)


def write_state(
    path: str | os.PathLike[str],
    header: AnyDict,
    frames: Mapping[str, StarFrames | None],
    stage: Stage | None,
    recursion: State | None,
) -> None:
    """Write a state, all or nothing; `frames` are those that it holds, by name.

    Raises
    ------
    RunFolderError
        When the file cannot be written.
    """
    header = {"kind": _KIND, "version": _VERSION, **header}
    arrays: Arrays = {}
    for name, held in frames.items():
        arrays |= _frame_arrays(name, held)
    if stage is not None:
        plain, values = _split(stage, ("status", "sigmas"))
        header["stage"] = plain | {"status": stage.status.name}
        arrays |= {f"stage_{name}": value for name, value in values.items()}
    if recursion is not None:
        header["recursion"] = recursion[0]
        arrays |= {f"recursion_{name}": value for name, value in recursion[1].items()}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, header=np.array(json.dumps(header)), **arrays)


def read_state(path: str | os.PathLike[str]) -> tuple[AnyDict, dict[str, StarFrames], Stage | None, State | None]:
    """Inverse of `write_state`.

    Raises
    ------
    RunFolderError
        When the file is missing, truncated, or no such state.
    """
    try:
        # Opened here, because the archive's reader leaves a file open that it cannot make sense of.
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(str(arrays.pop("header")))
        if header.pop("kind") != _KIND or header.pop("version") != _VERSION:
            raise ValueError("another kind or version")
        stage, recursion = None, None
        found = ((name, _frames(arrays, name)) for name in _HELD)
        frames = {name: held for name, held in found if held is not None}
        if "stage" in header:
            plain = header["stage"]
            stage = Stage(**(plain | _group(arrays, "stage") | {"status": Status[plain["status"]]}))
        if "recursion" in header:
            recursion = (header["recursion"], _group(arrays, "recursion"))
            recursion_from(recursion)
    except FileNotFoundError:
        raise RunFolderError(f"{path}: the file does not exist; check the path.") from None
    except _UNREADABLE as error:
        raise RunFolderError(
            f"{path}: is no saved recursive calibration, or an incomplete one ({type(error).__name__}): "
            "give a file written by RecursiveCalibration.save."
        ) from error
    return header, frames, stage, recursion


def _frame_arrays(prefix: str, frames: StarFrames | None) -> Arrays:
    if frames is None:
        return {}
    return {f"{prefix}_{name}": value for name, value in vars(frames).items() if value is not None}


def _frames(arrays: Arrays, prefix: str) -> StarFrames | None:
    """Inverse of `_frame_arrays`."""
    found = _group(arrays, prefix)
    if not found:
        return None
    found.setdefault("weight", None)
    return StarFrames(**found)


def _group(arrays: Arrays, prefix: str) -> Arrays:
    start = f"{prefix}_"
    return {name.removeprefix(start): value for name, value in arrays.items() if name.startswith(start)}
