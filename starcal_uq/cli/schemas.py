"""Every command's document by its name and version, and what it promises as JSON Schema and in
words.

What the documents hold is declared in ``documents.toml``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Any

from starcal_uq.cli.results import TAKEN
from starcal_uq.core import documents
from starcal_uq.core.documents import PREFIX, RECORDS, Part, key, part_of, referred
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.judge import VERSION

_DECLARED = tomllib.loads((files("starcal_uq.cli") / "documents.toml").read_text("utf-8"))


@cache
def find(name: str) -> Part:
    """The part of a name: as it is declared, and else that of a record which another one holds."""
    if name not in _DECLARED:
        return RECORDS[name]
    declared = dict(_DECLARED[name])
    text, record = declared.pop("about", ""), declared.pop("record", "")
    keys = {each: key(each, *content) for each, content in declared.items()}
    if record:
        module, class_name = record.split(":")
        part = part_of(getattr(import_module(f"starcal_uq.{module}"), class_name))
        text, keys = part.text, {**part.keys, **keys}
    return Part(name, text, keys, TAKEN.get(name))


# Name -> version and content: of commands by their names, and of what is no answer of one.
SCHEMAS: Mapping[str, tuple[int, Part]] = {
    name: (version, find(part)) for name, (part, version) in _DECLARED["documents"].items()
} | {"verdict": (VERSION, find("Verdict")), "error": (1, find("Error"))}
_HEAD = {
    "schema": "Name of the schema",
    "version": "Its version",
    "exit_status": "0, 1 for a result that should not be trusted, 2 for bad input, 70 for a fault of the "
    "program, 130 or 143 after an interrupt",
}


def document(name: str, results: Any, status: int) -> AnyDict:
    """The document of a schema that holds some results."""
    return documents.document(name, *SCHEMAS[name], results, status, find)


def json_schema(name: str) -> AnyDict:
    """The JSON Schema of a document; ``unit`` says the unit of a number."""
    version, part = SCHEMAS[name]
    parts: dict[str, Part] = {}
    _gather(part, parts)
    schema = part.schema
    head: AnyDict = {each: {"description": text} for each, text in _HEAD.items()}
    head["schema"] |= {"const": PREFIX + name}
    head["version"] |= {"const": version}
    head["exit_status"] |= {"type": "integer"}
    inner = {each: parts[each].schema for each in sorted(parts)}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **({"$defs": inner} if inner else {}),
        **schema,
        "title": f"{PREFIX}{name} {version}",
        "properties": head | schema["properties"],
        "required": [*head, *schema["required"]],
    }


def _gather(part: Part, parts: dict[str, Part]) -> None:
    """Put all parts that one refers to under their names."""
    for name in filter(None, map(referred, part.keys.values())):
        if name not in parts:
            parts[name] = find(name)
            _gather(parts[name], parts)
