"""One codec for results: frozen dataclasses of arrays, plain values, enumerations, tuples and other
such records.

What a field may hold is what its annotation says; anything else is refused, in writing and in
reading. Numbers keep every bit. A class that has its own form in files (a camera, a prior) says so
by `to_dict` and `from_dict`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import IO, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from starcal_uq.core.files import atomic_path, atomic_write_text, check_size, reading, shown
from starcal_uq.core.remedy import Remedy
from starcal_uq.core.types import AnyDict, PathLike, unaliased

Record = TypeVar("Record")
S = TypeVar("S", bound="Saved")
Arrays = dict[str, Any]

_FORMAT, _DOCUMENT = "format", "document"
# Kinds of arrays that each kind may be made of.
_FROM = {"f": "fiu", "i": "iu", "u": "iu"}
_SCALARS: dict[Any, tuple[tuple[type, ...], str]] = {
    bool: ((bool,), "true or false"),
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    str: ((str,), "text"),
}
# Halves of characters, which JSON can write by their numbers and UTF-8 cannot hold.
_HALVES = re.compile("[\ud800-\udfff]")


def to_plain(
    record: Any,
    arrays: Arrays | None = None,
    apart: Collection[str] | None = None,
    *,
    null: bool = False,
) -> Any:
    """A record, or anything that a record may hold, as dictionaries, lists, numbers and text, for
    JSON.

    `arrays` takes arrays under the names of their fields (``stages`` holds ``stage0_cost``,
    ``stage1_cost``...), or those of the fields `apart` alone, which are then left out of the
    result; without it they become lists. `null` writes what is not finite as None, because strict
    JSON has no other word for it; `from_plain` reads it as NaN. TypeError for a value that no file
    of ours can hold.
    """

    def plain(value: Any, name: str) -> Any:
        value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        if isinstance(value, Enum):
            return value.name
        if isinstance(value, float):
            return None if null and not math.isfinite(value) else value
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, list | tuple):
            start = name.removesuffix("s")
            return [plain(item, f"{start}{i}") for i, item in enumerate(value)]
        if is_dataclass(value) and not isinstance(value, type):
            # Both: a class that only tells itself in plain values, for readers, is read field by
            # field.
            own = getattr(value, "to_dict", None) if hasattr(value, "from_dict") else None
            value = (
                {f.name: getattr(value, f.name) for f in fields(value)} if own is None else own()
            )
        if not isinstance(value, Mapping):
            raise TypeError(f"a file cannot hold {name or 'this'}: {type(value).__name__}")
        kept: AnyDict = {}
        for key, item in value.items():
            if not isinstance(key, str):
                raise TypeError(f"a file cannot hold the key {key!r} of {name}")
            place = _below(name, key)
            wanted = apart is None or key in apart or place in apart
            if arrays is not None and wanted and isinstance(item, np.ndarray):
                arrays[place] = item
            else:
                kept[key] = plain(item, place)
        return kept

    return plain(record, "")


def _below(name: str, key: str) -> str:
    """The name of a field in a record of that name."""
    return f"{name}_{key}" if name else key


def from_plain(cls: type[Record], data: Any, arrays: Arrays | None = None) -> Record:
    """Inverse of `to_plain`.

    A field that is missing has its default; a name that is a property of the class was written for
    readers and is passed over. ValueError or TypeError for a field that is missing, unknown, or
    holds something else.
    """
    made: Record = _value(cls, data, arrays or {}, "")
    return made


def _value(hint: Any, data: Any, arrays: Arrays, name: str) -> Any:
    hint = unaliased(hint)
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return data
    if hint in _SCALARS:
        return _scalar(hint, data, name)
    if origin is Literal:
        return _one_word(data, {word: word for word in args}, name)
    if origin in (Union, UnionType):
        return _one_of(args, data, arrays, name)
    if origin is np.ndarray:
        if data is None:
            raise ValueError(f"{name} is missing")
        return _as_array(data, np.dtype(get_args(args[1])[0]), name)
    if origin in (tuple, list):
        return _sequence(origin, args, data, arrays, name)
    if origin is dict:
        return {
            key: _value(args[1], item, arrays, f"{name}_{key}")
            for key, item in _mapping(data, name).items()
        }
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _one_word(data, hint.__members__, name)
    if hasattr(hint, "from_dict"):
        start = f"{name}_"
        inside = {
            key.removeprefix(start): value for key, value in arrays.items() if key.startswith(start)
        }
        return hint.from_dict({**_mapping(data, name), **inside})
    if is_dataclass(hint):
        return _record(hint, _mapping(data, name), arrays, name)
    raise TypeError(f"no file holds {name}: {hint}")


def _scalar(kind: type, data: Any, name: str) -> Any:
    if kind is float and data is None:
        return float("nan")
    types, words = _SCALARS[kind]
    fits = isinstance(data, types) and isinstance(data, bool) == (kind is bool)
    if not fits:
        raise ValueError(f"{name} is {shown(data)}, not {words}")
    if kind is int and not -(2**63) <= data < 2**63:
        raise ValueError(f"{name} is {shown(data)}, too large a number")
    if kind is str and _HALVES.search(data):
        raise ValueError(f"{name} is {shown(data)}, which no file can hold")
    return float(data) if kind is float else data


def _as_array(data: Any, kind: np.dtype[Any], name: str) -> Any:
    array = np.asarray(data)
    if array.dtype.kind not in _FROM.get(kind.kind, kind.kind):
        # Lists of JSON, in which None stands for NaN, and an empty list for no value of any type.
        listed = isinstance(data, list) and (array.dtype.kind == "O" or not array.size)
        if not listed or (kind.kind != "f" and array.size):
            raise ValueError(f"{name} does not hold what it should")
    return array.astype(kind) if array.dtype != kind else array


def _one_word(data: Any, words: Mapping[Any, Any], name: str) -> Any:
    if data not in list(words):
        raise ValueError(f"{name} is {shown(data)}, not one of {', '.join(map(str, words))}")
    return words[data]


def _mapping(data: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(data, Mapping):
        raise ValueError(f"{name or 'the document'} is {shown(data)}, not a table")
    return data


def _one_of(kinds: tuple[Any, ...], data: Any, arrays: Arrays, name: str) -> Any:
    if data is None and NoneType in kinds:
        return None
    *others, last = (kind for kind in kinds if kind is not NoneType)
    for kind in others:
        try:
            return _value(kind, data, arrays, name)
        except (TypeError, ValueError):
            continue
    return _value(last, data, arrays, name)


def _sequence(kind: Any, items: tuple[Any, ...], data: Any, arrays: Arrays, name: str) -> Any:
    if not isinstance(data, list | tuple):
        raise ValueError(f"{name} is {shown(data)}, not a list")
    kinds = [items[0]] * len(data) if kind is list or items[-1] is ... else items
    if len(kinds) != len(data):
        raise ValueError(f"{name} has {len(data)} entries, not {len(kinds)}")
    place = name.removesuffix("s")
    return kind(
        _value(hint, item, arrays, f"{place}{i}")
        for i, (hint, item) in enumerate(zip(kinds, data, strict=True))
    )


@cache
def _hints(cls: type) -> AnyDict:
    return get_type_hints(cls)


def _record(cls: Any, data: Mapping[str, Any], arrays: Arrays, name: str) -> Any:
    hints, known = _hints(cls), fields(cls)
    # Files of earlier versions hold more.
    for key in set(data) - {field.name for field in known} - set(getattr(cls, "GONE", ())):
        if not isinstance(getattr(cls, key, None), property):
            raise ValueError(f"{cls.__name__} has no field {key!r}")
    values: AnyDict = {}
    for field in known:
        place = _below(name, field.name)
        if place in arrays:
            values[field.name] = _value(hints[field.name], arrays[place], arrays, place)
        elif field.name in data:
            values[field.name] = _value(hints[field.name], data[field.name], arrays, place)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{place} is missing")
    made = cls(**values)
    _check_sizes(made, name)
    return made


@cache
def _sizes(shapes: str) -> dict[str, list[str]]:
    """Sizes by field."""
    lines = [line.split(":") for line in shapes.strip().splitlines()]
    return {field: sizes.split() for sizes, names in lines for field in names.split()}


def _check_sizes(record: Any, name: str) -> None:
    """Arrays must have the sizes that the class states, and where it says so no gap.

    ``SHAPES`` of a class has a line for each shape, with its fields (or properties): digits, or
    names of sizes that are the same wherever they stand, such as ``n p+1: draws``; a tuple has its
    length. Fields in ``FINITE`` hold neither NaN nor infinities.
    """
    # A number is its own size.
    sizes = {str(number): number for number in range(10)}
    empty: dict[str, set[str]] = {}
    for field, wanted in _sizes(getattr(record, "SHAPES", "")).items():
        value = getattr(record, field)
        if value is None:
            continue
        shape = value.shape if isinstance(value, np.ndarray) else (len(value),)
        place = _below(name, field)
        if shape == (0,) and len(wanted) > 1:
            empty[place] = {want.partition("+")[0] for want in wanted}
            continue
        if len(shape) != len(wanted):
            raise ValueError(f"{place} has {len(shape)} dimensions, not {len(wanted)}")
        for size, want in zip(shape, wanted, strict=True):
            letter, _, more = want.partition("+")
            extra = int(more or 0)
            right = sizes.setdefault(letter, size - extra) + extra
            if size != right:
                raise ValueError(f"{place} has {size} entries where there should be {right}")
    # A list of JSON does not tell the sizes of an array that holds nothing.
    for place, letters in empty.items():
        if all(sizes.get(letter, 0) for letter in letters):
            raise ValueError(f"{place} holds nothing")
    for field in getattr(record, "FINITE", ()):
        if not np.isfinite(getattr(record, field)).all():
            raise ValueError(f"{_below(name, field)} holds a value that is not finite")


def to_json(record: Any, **options: Any) -> str:
    """A record, or plain values, as JSON; `options` are those of ``json.dumps``."""
    return json.dumps(to_plain(record), **options)


def hash_of(value: Any) -> str:
    """SHA-256 of a record, or of plain values, that does not depend on the order of keys."""
    return hashlib.sha256(to_json(value, sort_keys=True).encode()).hexdigest()


def write_json(record: Any, path: PathLike) -> None:
    """Write a record, or plain values, as JSON for readers too; atomically, overwritten."""
    atomic_write_text(path, to_json(record, indent=1) + "\n")


def read_json(cls: type[Record], path: PathLike, what: str, remedy: str | Remedy) -> Record:
    """Read what `write_json` wrote; `what` and `remedy` as for `starcal_uq.core.files.reading`."""
    with reading(path, what, remedy), open(path, encoding="utf-8") as file:
        return from_plain(cls, json.load(file))


def write(record: Any, path: PathLike, kind: str) -> None:
    """Write a record as one ``.npz`` file: arrays to the last bit, all else as JSON beside them;
    overwritten.

    The `kind` says what the file is; it is empty for a record of nothing but arrays, whose file
    needs no word for it.
    """
    arrays: Arrays = {}
    document = to_plain(record, arrays)
    if kind:
        arrays = {_FORMAT: np.array(kind), _DOCUMENT: np.array(json.dumps(document)), **arrays}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read(cls: type[Record], path: PathLike, kind: str, what: str, remedy: str | Remedy) -> Record:
    """Inverse of `write`; `what` and `remedy` as for `starcal_uq.core.files.reading`."""
    with reading(path, what, remedy):
        arrays = read_arrays(path)
        if kind and str(arrays.pop(_FORMAT)) != kind:
            raise ValueError("another format")
        return from_plain(cls, json.loads(str(arrays.pop(_DOCUMENT))) if kind else {}, arrays)


class Saved:
    """A record with a file of its own, ``.npz`` or JSON; `FILE` says what it is and what to do
    where it is none.

    A `KIND` is that of `write`; None is JSON.
    """

    KIND: ClassVar[str | None] = None
    FILE: ClassVar[tuple[str, str | Remedy]]

    def save(self, path: PathLike) -> None:
        """Write everything to one file, atomically and without loss; overwritten."""
        if self.KIND is None:
            write_json(self, path)
        else:
            write(self, path, self.KIND)

    @classmethod
    def load(cls: type[S], path: PathLike) -> S:
        """Read what `save` wrote.

        Raises
        ------
        RunFolderError
            If the file is missing or is something else.
        """
        if cls.KIND is None:
            return read_json(cls, path, *cls.FILE)
        return read(cls, path, cls.KIND, *cls.FILE)


def read_arrays(path: PathLike) -> Arrays:
    """All arrays of an ``.npz`` file.

    One that holds Python objects is refused, as is an array that declares more than its file has,
    before memory is taken for it.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        check_size(sum(info.file_size for info in members), os.path.getsize(path))
        arrays = {}
        for info in members:
            name = info.filename.removesuffix(".npy")
            if name in arrays:
                raise ValueError(f"it holds {name} twice")
            with archive.open(info) as member:
                arrays[name] = _array(member, info.file_size, name)
        return arrays


def _array(member: IO[bytes], size: int, name: str) -> Any:
    """The array of a member of `size` bytes, whose header is believed only where it fits to
    them.
    """
    version = np.lib.format.read_magic(member)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"{name} is no array")
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(member)
    if dtype.hasobject:
        raise ValueError(f"{name} holds Python objects")
    if math.prod(shape) * dtype.itemsize != size - member.tell():
        raise ValueError(f"{name} declares another size than it has")
    member.seek(0)
    return np.lib.format.read_array(member, allow_pickle=False)
