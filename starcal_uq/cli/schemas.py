"""Every command's document by its name and version, and what it promises as JSON Schema and in
words.

A document may get further keys; where a key goes or changes its meaning, the version of its schema
rises.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from starcal_uq.cli.documents import (
    Budgeted,
    Calibrate,
    Centroid,
    Compare,
    Couple,
    Diagnose,
    Error,
    Export,
    Filter,
    Identify,
    Inspect,
    Merge,
    New,
    Planned,
    Propagate,
    Report,
    Reproduce,
    ReproduceField,
    Run,
    Sample,
    Schema,
    Simulate,
    Studied,
    Validate,
)
from starcal_uq.core import documents
from starcal_uq.core.documents import PREFIX, Part, part_of
from starcal_uq.core.types import AnyDict
from starcal_uq.diagnostics.verdict.judge import VERSION, Verdict

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

# Name -> version and content: of commands by their names, and of what is no answer of one.
SCHEMAS: Mapping[str, tuple[int, type[Part]]] = {
    "demo": (1, Run),
    "run": (1, Run),
    "new": (1, New),
    "plan": (1, Planned),
    "simulate": (1, Simulate),
    "study": (1, Studied),
    "validate": (1, Validate),
    "centroid": (1, Centroid),
    "identify": (1, Identify),
    "calibrate": (1, Calibrate),
    "sample": (1, Sample),
    "coupling": (1, Couple),
    "propagate": (1, Propagate),
    "diagnose": (1, Diagnose),
    "budget": (1, Budgeted),
    "report": (1, Report),
    "inspect": (1, Inspect),
    "export": (1, Export),
    "compare": (1, Compare),
    "merge": (1, Merge),
    "filter": (1, Filter),
    "reproduce": (1, Reproduce),
    "reproduce-field": (1, ReproduceField),
    "schema": (1, Schema),
    "verdict": (VERSION, part_of(Verdict)),
    "error": (1, Error),
}
_HEAD = {
    "schema": "Name of the schema",
    "version": "Its version",
    "exit_status": "0, 1 for a result that should not be trusted, 2 for bad input, 70 for a fault of the "
    "program, 130 "
    "or 143 after an interrupt",
}


def document(name: str, results: Any, status: int) -> AnyDict:
    """The document of a schema that holds some results."""
    return documents.document(name, *SCHEMAS[name], results, status)


def json_schema(name: str) -> AnyDict:
    """The JSON Schema of a document; ``unit`` says the unit of a number."""
    version, part = SCHEMAS[name]
    schema = part.model_json_schema(mode="serialization")
    for place in (schema, *schema.get("$defs", {}).values()):
        for key, content in place.get("properties", {}).items():
            content.pop("title", None)
            unit = content.get("unit") or _UNITS.get(key.rsplit("_", 1)[-1])
            content |= {"unit": unit} if unit else {}
    head: AnyDict = {key: {"description": text} for key, text in _HEAD.items()}
    head["schema"] |= {"const": PREFIX + name}
    head["version"] |= {"const": version}
    head["exit_status"] |= {"type": "integer"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "title": f"{PREFIX}{name} {version}",
        "properties": head | schema["properties"],
        "required": [*head, *schema["required"]],
    }


def keys(name: str) -> Iterator[tuple[str, str, str, str]]:
    """Every key of a document with its type, unit and meaning; ``a[].b`` is b of every object in
    the list a.
    """
    schema = json_schema(name)
    yield from _keys(schema, schema.get("$defs", {}), "")


def _keys(place: AnyDict, parts: AnyDict, above: str) -> Iterator[tuple[str, str, str, str]]:
    for key, content in place["properties"].items():
        kind, inner = type_words(content), _inner(content)
        yield f"{above}{key}", kind, content.get("unit", ""), content.get("description", "")
        if inner:
            yield from _keys(
                parts[inner], parts, f"{above}{key}{'[]' if kind.startswith('list') else ''}."
            )


def type_words(content: AnyDict) -> str:
    """The type of a key in words."""
    if "const" in content:
        return (
            f'"{content["const"]}"' if isinstance(content["const"], str) else str(content["const"])
        )
    if "anyOf" in content:
        return " or ".join(map(type_words, content["anyOf"]))
    kind = content.get("type", "object")
    if kind == "array":
        return f"list of {_several(content['items'])}"
    values = content.get("additionalProperties")
    return f"object of {_several(values)}" if isinstance(values, dict) else str(kind)


def _several(content: AnyDict) -> str:
    return type_words(content).replace(" or ", "s or ") + "s"


def _inner(content: AnyDict) -> str:
    """The name of the part that a key, or a list of it, is made of; empty where there is none."""
    within = [content.get("items", {}), *content.get("anyOf", ())]
    return (
        str(content["$ref"].rpartition("/")[2])
        if "$ref" in content
        else "".join(map(_inner, filter(None, within)))
    )
