"""JSON documents: how an object of one is declared, by its keys or by a record, and how a result
becomes one.

NaN and infinity are null: not known, not determined, or not assessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from inspect import getdoc
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema

from starcal_uq.core.types import AnyDict, unaliased

Number = float | None
PREFIX = "starcal-uq/"


def says(text: str, unit: str = "") -> Any:
    """What a key holds; its unit where the name does not end in it."""
    return Field(description=text, json_schema_extra={"unit": unit} if unit else None)


def plain(value: Any) -> Any:
    """Numbers, texts, lists and mappings for JSON; a result among them is left to the part that
    takes it.
    """
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return plain(value.to_dict("records")) if hasattr(value, "iterrows") else value


class Part(BaseModel):
    """An object of a document."""

    # Names such as model_... are free, and what no call needs is not built.
    model_config = ConfigDict(defer_build=True, protected_namespaces=())

    @model_validator(mode="before")
    @classmethod
    def _taken(cls, value: Any) -> Any:
        taken = value if isinstance(value, Mapping) else cls.take(value)
        return {key: plain(item) for key, item in taken.items()}

    @classmethod
    def take(cls, result: Any) -> Mapping[str, Any]:
        """What a result holds, by key."""
        return {key: getattr(result, key) for key in cls.model_fields}


def document(name: str, version: int, part: type[Part], results: Any, status: int) -> AnyDict:
    """The document of a schema, its name and version first."""
    head = {"schema": PREFIX + name, "version": version, "exit_status": status}
    return head | part.model_validate(results).model_dump()


@cache
def part_of(record: type) -> type[Part]:
    """The part with the fields of a record of ours, whose docstring says what they are.

    Properties are in it that its class variable ``DOCUMENTED`` names.
    """
    said: dict[str, str] = {}
    for names, text in re.findall(
        r"^(\w[\w, ]*) : .*\n((?: {4}.*\n?)+)", getdoc(record) or "", re.MULTILINE
    ):
        said |= dict.fromkeys(names.split(", "), " ".join(text.split()).removesuffix("."))
    hints = get_type_hints(record)
    keys: AnyDict = {}
    for name in getattr(record, "DOCUMENTED", ()):
        getter = getattr(record, name).fget
        text = (getdoc(getter) or "").partition("\n")[0].removesuffix(".")
        keys[name] = (_kind(get_type_hints(getter)["return"]), says(text))
    keys |= {
        field.name: (_kind(hints[field.name]), says(said[field.name])) for field in fields(record)
    }
    return create_model(
        record.__name__, __base__=Part, __doc__=(getdoc(record) or "").partition("\n")[0], **keys
    )


def _kind(hint: Any) -> Any:
    """The type in JSON of an annotation of a record."""
    hint = unaliased(hint)
    origin, args = get_origin(hint), get_args(hint)
    if hint is float or hint is np.float64:
        return Number
    if origin in (Union, UnionType):
        return Union[tuple(_kind(arg) for arg in args)]  # noqa: UP007
    if origin is np.ndarray:
        return list[Number]
    if origin in (tuple, list):
        return list[_kind(args[0])]  # type: ignore[misc]
    if isinstance(hint, type) and issubclass(hint, Enum):
        return Literal[tuple(member.value for member in hint)]
    return part_of(hint) if is_dataclass(hint) and isinstance(hint, type) else hint


class Of:
    """A part made of a record, given as ``module:Class``, and more keys; loaded when it is asked
    for.
    """

    def __init__(self, record: str, **more: tuple[Any, str]) -> None:
        self._record, self._more = record, more

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        module, name = self._record.split(":")
        part = part_of(getattr(import_module(f"starcal_uq.{module}"), name))
        if self._more:
            keys: AnyDict = {key: (kind, says(text)) for key, (kind, text) in self._more.items()}
            part = create_model(name, __base__=part, __doc__=part.__doc__, **keys)
        origin = get_origin(source)
        return handler.generate_schema(
            list[part] if origin is list else part | None if origin in (Union, UnionType) else part  # type: ignore[valid-type]
        )
