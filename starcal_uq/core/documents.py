"""JSON documents: how an object of one is declared, in words or by a record, and how a result
becomes one.

NaN and infinity are null: not known, not determined, or not assessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cache
from inspect import getdoc
from os import PathLike
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from starcal_uq.core.provenance import NAME
from starcal_uq.core.records import to_plain
from starcal_uq.core.types import AnyDict, unaliased

PREFIX = f"{NAME}/"
# Endings of keys that tell the unit.
_UNITS = {
    "arcsec": "arcsec",
    "px": "px",
    "mm": "mm",
    "deg": "deg",
    "percent": "%",
    "seconds": "s",
    "milliseconds": "ms",
}
_TYPES: Mapping[str, tuple[type, ...]] = {
    "string": (str,),
    "integer": (int, np.integer),
    "boolean": (bool, np.bool_),
    "number": (int, float, np.number),
}
_WORDS = {str: "string", int: "integer", bool: "boolean", float: "number", np.float64: "number"}


@dataclass(frozen=True)
class Part:
    """An object of a document.

    Attributes
    ----------
    name, text : str
        Name of the object, and what it is.
    keys : mapping of str to dict
        JSON Schema of what stands under each key.
    take : callable, optional
        What stands under keys that are no attributes of a result, or of the first of several.
    """

    name: str
    text: str
    keys: Mapping[str, AnyDict]
    take: Callable[[Any], Mapping[str, Any]] | None = None

    def of(self, result: Any, find: Callable[[str], Part]) -> AnyDict:
        """The object that holds a result; `find` gives the parts that it refers to by their
        names.
        """
        own = result if isinstance(result, Mapping) else {}
        if self.take is not None and not own:
            own = self.take(result)
        if type(result) is tuple:
            result, *_ = result
        return {
            key: _fitted(
                kind,
                own[key] if key in own else getattr(result, key),
                find,
                f"{self.name}.{key}",
            )
            for key, kind in self.keys.items()
        }

    @property
    def schema(self) -> AnyDict:
        """Its JSON Schema."""
        return {
            "description": self.text,
            "properties": dict(self.keys),
            "required": list(self.keys),
            "title": self.name,
            "type": "object",
        }


def key(name: str, words: str, text: str, unit: str = "") -> AnyDict:
    """The schema of a key of a kind, such as "list of Frame or null", and what it holds; the unit
    where its name does not end in it.
    """
    schema = _schema(words) | {"description": text}
    unit = unit or _UNITS.get(name.rsplit("_", 1)[-1], "")
    if unit:
        schema["unit"] = unit
    return dict(sorted(schema.items()))


def _schema(words: str) -> AnyDict:
    if words.endswith(" or null"):
        return {"anyOf": [_schema(words.removesuffix(" or null")), {"type": "null"}]}
    for start, place, kind in (
        ("list of ", "items", "array"),
        ("object of ", "additionalProperties", "object"),
    ):
        if words.startswith(start):
            return {place: _schema(words.removeprefix(start)), "type": kind}
    if words == "number":
        return {"anyOf": [{"type": "number"}, {"type": "null"}]}
    if words == "object":
        return {"additionalProperties": True, "type": "object"}
    if "|" in words:
        return {"enum": words.split("|"), "type": "string"}
    return {"type": words} if words in _TYPES else {"$ref": f"#/$defs/{words}"}


def _fitted(kind: AnyDict, value: Any, find: Callable[[str], Part], name: str) -> Any:
    """A value as its kind of JSON has it; TypeError for another kind."""
    if "anyOf" in kind:
        missing = value is None or (isinstance(value, float) and not math.isfinite(value))
        return None if missing else _fitted(kind["anyOf"][0], value, find, name)
    if "$ref" in kind:
        return find(referred(kind)).of(value, find)
    if "items" in kind:
        if hasattr(value, "iterrows"):
            value = value.to_dict("records")
        return [_fitted(kind["items"], item, find, name) for item in value]
    if kind["type"] == "object":
        inner = kind["additionalProperties"]
        if inner is True:
            return to_plain(value, null=True)
        return {str(each): _fitted(inner, item, find, name) for each, item in value.items()}
    value = value.value if isinstance(value, Enum) else value
    value = str(value) if isinstance(value, PathLike) else value
    if not isinstance(value, _TYPES[kind["type"]]):
        raise TypeError(f"{name} is {type(value).__name__}, not {kind['type']}")
    plain: Any = value.item() if isinstance(value, np.generic) else value
    return float(plain) if kind["type"] == "number" else plain


def referred(kind: AnyDict) -> str:
    """The name of the part that a key, or a list of it, is made of; empty where there is none."""
    if "$ref" in kind:
        return str(kind["$ref"].rpartition("/")[2])
    return "".join(map(referred, filter(None, [kind.get("items"), *kind.get("anyOf", ())])))


def document(
    name: str,
    version: int,
    part: Part,
    results: Any,
    status: int,
    find: Callable[[str], Part] | None = None,
) -> AnyDict:
    """The document of a schema, its name and version first."""
    head = {"schema": PREFIX + name, "version": version, "exit_status": status}
    return head | part.of(results, find or RECORDS.__getitem__)


# Parts of records by their names.
RECORDS: dict[str, Part] = {}


@cache
def part_of(record: type) -> Part:
    """The part with the fields of a record of ours, whose docstring says what they are.

    Properties are in it that its class variable ``DOCUMENTED`` names, and those that stand for a
    field by ``WRITTEN_AS``.
    """
    said: dict[str, str] = {}
    for names, text in re.findall(
        r"^(\w[\w, ]*) : .*\n((?: {4}.*\n?)+)", getdoc(record) or "", re.MULTILINE
    ):
        said |= dict.fromkeys(names.split(", "), " ".join(text.split()).removesuffix("."))
    hints = get_type_hints(record)
    written = getattr(record, "WRITTEN_AS", {})
    names = [*getattr(record, "DOCUMENTED", ())]
    for field in fields(record):
        names += written.get(field.name, (field.name,))
    for name in set(names) - hints.keys():
        getter = getattr(record, name).fget
        said[name] = _first_paragraph(getter).removesuffix(".")
        hints[name] = get_type_hints(getter)["return"]
    keys = {name: key(name, _words(hints[name]), said[name]) for name in names}
    part = RECORDS[record.__name__] = Part(record.__name__, _first_paragraph(record), keys)
    return part


def _first_paragraph(documented: Any) -> str:
    return " ".join((getdoc(documented) or "").partition("\n\n")[0].split())


def _words(hint: Any) -> str:
    """The kind of JSON of an annotation of a record, in words."""
    hint = unaliased(hint)
    origin, args = get_origin(hint), get_args(hint)
    if hint in _WORDS:
        return _WORDS[hint]
    if NoneType in args:
        return f"{_words(args[0])} or null"
    if origin is np.ndarray:
        return "list of number"
    if origin in (tuple, list):
        return f"list of {_words(args[0])}"
    if origin is Literal:
        return "|".join(args)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return "|".join(member.value for member in hint)
    if is_dataclass(hint) and isinstance(hint, type):
        return part_of(hint).name
    raise TypeError(f"no document holds {hint}")
